"""A cluster's variables three ways, at the same instants: desired, estimated, true."""

from dataclasses import dataclass

import numpy as np

from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, SingularClusterError
from zsim_agents.formation.spaces.scenario_space import cluster_space, scenario_space
from zsim_analysis.reading.flight import Array, States, Times, Track
from zsim_analysis.reading.formation_errors import Errors, common_instants, errors


@dataclass
class Formation:
    """K instants of a cluster of n drones; m or rad, NaN where unknown.

    Attributes:
        t_s: (K,) simulated time.
        desired, value, true: (K, 4n).
        est_error, true_error: (K, 4n) value − desired and true − desired, angles the short way.
        phases: (K,).
    """

    name: str
    drones: tuple[str, ...]
    names: tuple[str, ...]
    t_s: Array
    desired: Array
    value: Array
    true: Array
    est_error: Array
    true_error: Array
    phases: list[str]

    def column(self, name: str) -> int:
        return self.names.index(name)

    def within(self, window_s: tuple[float, float]) -> np.ndarray:
        """Return which instants (K,) are in a window."""
        return (self.t_s >= window_s[0]) & (self.t_s <= window_s[1])

    def errors(self, window_s: tuple[float, float]) -> dict[str, Errors]:
        """Return the statistics of every parameter over a window."""
        rows = self.within(window_s)
        return {name: errors(self.est_error[rows, i], self.true_error[rows, i]) for i, name in enumerate(self.names)}


def formation(states: States, tracks: list[Track], scenario: Scenario | None) -> Formation | None:
    """Return a cluster's formation.

    None if its controller published nothing, or variables of another convention than the scenario's.
    """
    by_name = {track.name: track for track in tracks}
    space = _space(states, scenario) if len(states.t_ns) else None
    if space is None or states.names != space.names:
        return None
    value, desired = _known(states.value), _known(states.desired)
    members = [by_name[name] for name in states.drones if name in by_name]
    true = _true(space, members, states.t_ns)
    return Formation(
        name=states.name,
        drones=states.drones,
        names=states.names,
        t_s=states.t_ns / 1e9,
        desired=desired,
        value=value,
        true=true,
        est_error=_difference(space, value, desired),
        true_error=_difference(space, true, desired),
        phases=states.phases,
    )


def _space(states: States, scenario: Scenario | None) -> ClusterSpace | None:
    """Return the cluster space that a scenario gives the cluster of these states, else that of so many drones."""
    clusters = {cluster.name: cluster for cluster in scenario.clusters} if scenario else {}
    try:
        if scenario and states.name in clusters:
            return scenario_space(scenario, clusters[states.name])
        return cluster_space(len(states.drones))
    except ValueError:
        return None


def _known(rows: Array) -> Array:
    """Return rows (K, 4n) with NaN where all are zero: on the wire that stands for unknown."""
    return np.where(rows.any(axis=1, keepdims=True), rows, np.nan)


def _difference(space: ClusterSpace, to: Array, desired: Array) -> Array:
    """Return to − desired (K, 4n), angles that wrap the short way."""
    return np.array([space.difference(*pair) for pair in zip(to, desired, strict=True)])


def _true(space: ClusterSpace, members: list[Track], wanted_ns: Times) -> Array:
    """Return the cluster variables (K, 4n) of where the drones truly were; NaN without truth or frame."""
    true = np.full((len(wanted_ns), space.size), np.nan)
    if len(members) < space.n:
        return true
    t_ns, places = common_instants(members)
    _, rows, found = np.intersect1d(wanted_ns, t_ns, assume_unique=True, return_indices=True)
    p_W = np.stack([track.p_W[place[found]] for track, place in zip(members, places, strict=True)], axis=1)
    yaw = np.stack([track.yaw[place[found]] for track, place in zip(members, places, strict=True)], axis=1)
    for row, position, heading in zip(rows, p_W, yaw, strict=True):
        try:
            true[row] = space.forward(position, heading)
        except SingularClusterError:
            continue
    return true
