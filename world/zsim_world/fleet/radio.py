"""Determines which drones hear which others at a gate, from the scenario's topology, its radio and true positions."""

from collections.abc import Iterable

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.contract.run_messages import Fault, RadioLinks
from zsim.math import elementary as el
from zsim.math.compiled import kernel
from zsim.math.held import Held, hold
from zsim.math.rotation import norm, scaled, subtract
from zsim.scenario.scenario import RECEPTION_MIN, Radio, Scenario, Topology
from zsim_world.physics.fleet_arrays import vector
from zsim_world.physics.rays import Scene, cast_parts

Matrix = NDArray[np.bool_]


class RadioChannel:
    """The links between N drones and, at the last index, the ground station if there is one.

    Args:
        scene: the obstacles and surfaces that block lines of sight.

    Raises:
        ValueError: `scenario.radio_of_agents` is None.
    """

    def __init__(self, scenario: Scenario, scene: Scene) -> None:
        radio = scenario.radio_of_agents
        if radio is None:
            raise ValueError(f"{scenario.name} has neither a radio nor a topology")
        self._radio: Radio = radio
        self._topology = Topology() if scenario.topology is UNSET else scenario.topology
        self._count = len(scenario.drones)
        self._clusters = {
            each.name: np.array([drone.name in each.drones for drone in scenario.drones]) for each in scenario.clusters
        }
        self._station = np.array([radio.station_m] if radio.station_m is not None else [], dtype=float).reshape(-1, 3)
        self._allowed = np.pad(
            allowed([drone.name for drone in scenario.drones], self._topology),
            (0, len(self._station)),
            constant_values=True,
        )
        np.fill_diagonal(self._allowed, False)
        self._scene = hold(scene)
        self._is_open = not len(scene.tree.part)

    def links(self, t_ns: int, seq: int, position_m: NDArray[np.float64], faults: Iterable[Fault] = ()) -> RadioLinks:
        """Return the links at a gate, as a message.

        Args:
            position_m: positions of the drones in W, (N, 3).
            faults: active faults; those of kind `radio` lower reception on all links of the drones that they target.
        """
        radio, topology, n = self._radio, self._topology, self._count
        place_m = np.concatenate([position_m, self._station])
        x, y, z = (place_m[:, None, axis] - place_m[None, :, axis] for axis in range(3))
        distance_m = np.sqrt(x * x + y * y + z * z)
        hears, reception = self._allowed.copy(), np.ones_like(distance_m)
        if topology.within_m is not None:
            hears[:n, :n] &= distance_m[:n, :n] <= topology.within_m
        if radio.range_m is not None and radio.spread_m:
            reception = _received(distance_m, radio.range_m, radio.spread_m)
        elif radio.range_m is not None:
            hears &= distance_m <= radio.range_m
        radio_faults = [fault for fault in faults if fault.kind == "radio"]
        for fault in radio_faults:
            is_target = self._target_mask(fault.target)
            reduced = reception * _received(distance_m, fault.parameters["range_m"], fault.parameters["spread_m"])
            reception = np.where(is_target[:, None] | is_target[None, :], reduced, reception)
        hears &= reception >= RECEPTION_MIN
        if radio.line_of_sight and not self._is_open:
            clear_lines(place_m, self._scene, hears)
        if topology.nearest is not None:
            masked_m = np.where(hears, distance_m, np.inf)[:n, :n]
            too_far = np.argsort(masked_m, axis=1, kind="stable")[:, topology.nearest :]
            np.put_along_axis(hears[:n, :n], too_far, False, axis=1)
        if topology.symmetric:
            hears |= hears.T
        heard = [np.flatnonzero(row).tolist() for row in hears]
        is_random = bool(radio_faults) or (radio.range_m is not None and radio.spread_m > 0.0)
        chances = (
            tuple(tuple(row[senders].tolist()) for row, senders in zip(reception, heard, strict=True))
            if is_random
            else ()
        )
        return RadioLinks(t_ns, seq, tuple(map(tuple, heard)), chances)

    def _target_mask(self, target: str) -> Matrix:
        """Return which indices are drones of a cluster; all drones if the target is the world rather than a cluster."""
        is_target = np.zeros(len(self._allowed), dtype=bool)
        is_target[: self._count] = self._clusters.get(target, True)
        return is_target


def _received(distance_m: NDArray[np.float64], range_m: float, spread_m: float) -> NDArray[np.float64]:
    exponent = np.minimum((distance_m - range_m) / spread_m, 700.0)  # exp(700) is finite
    return 1.0 / (1.0 + el.elementwise(el.exp)(exponent))


def allowed(drones: list[str], topology: Topology) -> Matrix:
    """Return whether the graph lets drone i hear drone j, (N, N)."""
    n, graph = len(drones), topology.graph
    if graph == "complete":
        return np.ones((n, n), dtype=bool)
    hears = np.zeros((n, n), dtype=bool)
    if isinstance(graph, dict):
        for hearer, senders in graph.items():
            hears[drones.index(hearer), [drones.index(name) for name in senders]] = True
        return hears
    for i in range(n if graph == "ring" else n - 1):
        hears[i, (i + 1) % n] = hears[(i + 1) % n, i] = True
    return hears


@kernel()
def clear_lines(position_m: NDArray, scene: Held, hears: NDArray) -> None:
    """Remove from `hears` the pairs whose line of sight meets an obstacle or a surface."""
    for i in range(position_m.shape[0]):
        for j in range(i):
            if not (hears[i, j] or hears[j, i]):
                continue
            start = vector(position_m[i], 0)
            to = subtract(vector(position_m[j], 0), start)
            length = norm(to)
            if length > 0.0 and cast_parts(scene.content, start, scaled(to, 1.0 / length), length) < length:
                hears[i, j] = hears[j, i] = False
