"""The true states of all drones at the last gates, and where they were between two of them. Pure."""

import math
from collections.abc import Mapping, Sequence
from operator import attrgetter

import numpy as np
from msgspec.structs import replace

from zsim.contract.flight_messages import Truth, moved_on, truth_fault
from zsim.math.rotation import pose_between
from zsim.scenario.scenario import Drone
from zsim_agents.cameras.rendering.scene import DroneStates

PENDING_MAX = 64  # gates of which the truth of a drone may be lacking


class TruthHistory:
    """The last gates of which the truth of every simulated drone is there.

    An external drone, whose driver may skip gates, is where its last pose leads to.

    Args:
        drones: how many there are.
        gate_ns: time between two gates.
        span_ns: how far back it reaches, at least.
        external: of the drones by their numbers, with where each stands until its driver publishes.
    """

    def __init__(self, drones: int, gate_ns: int, span_ns: int, external: Mapping[int, Truth] = {}) -> None:
        self._drones, self._gate_ns = drones, gate_ns
        self._external = dict(external)
        self._simulated = frozenset(range(drones)) - external.keys()
        self._kept = 2 + span_ns // gate_ns
        self._pending: dict[int, dict[int, Truth]] = {}
        self._whole: dict[int, list[Truth]] = {}  # by gate, in order
        self.newest_ns = -1

    def add(self, drone: int, truth: Truth) -> None:
        """Take the truth of a drone, by its number."""
        t_ns = truth.t_ns
        if drone in self._external:
            if truth_fault(truth, len(self._external[drone].rotor_rad_s)):
                return  # which the world refuses
            self._external[drone] = max(self._external[drone], truth, key=attrgetter("t_ns"))
        if t_ns <= self.newest_ns:
            return
        states = self._pending.setdefault(t_ns, {})
        states[drone] = truth
        if states.keys() >= self._simulated:
            self._whole[t_ns] = [states.get(i) or _at(self._external[i], t_ns) for i in range(self._drones)]
            self.newest_ns = t_ns
            self._pending = {t: left for t, left in self._pending.items() if t > t_ns}
            while len(self._whole) > self._kept:
                del self._whole[next(iter(self._whole))]
        elif len(self._pending) > PENDING_MAX:
            del self._pending[min(self._pending)]

    def bodies(self, t_ns: int) -> DroneStates | None:
        """Return all drones at an instant, or None where a gate beside it is lacking."""
        before_ns = t_ns // self._gate_ns * self._gate_ns
        before, after = self._whole.get(before_ns), self._whole.get(before_ns + self._gate_ns)
        if before is None:
            return None
        if t_ns == before_ns:
            after = before
        return None if after is None else _between((t_ns - before_ns) / 1e9, self._gate_ns / 1e9, before, after)


def standing(drone: Drone, rotors: int) -> Truth:
    """Return where the scenario puts a drone, its rotors at rest."""
    half = 0.5 * math.radians(drone.yaw_deg)
    still, q_WB = (0.0, 0.0, 0.0), (math.cos(half), 0.0, 0.0, math.sin(half))
    return Truth(0, 0, drone.position_m, still, q_WB, still, still, (0.0,) * rotors)


def _at(last: Truth, t_ns: int) -> Truth:
    """Return the truth at a gate of an external drone, by the last one of its driver."""
    return replace(last, t_ns=t_ns, position_m=moved_on(last.position_m, last.velocity_m_s, t_ns - last.t_ns))


def _between(t_s: float, gate_s: float, before: Sequence[Truth], after: Sequence[Truth]) -> DroneStates:
    share = t_s / gate_s
    poses = [
        pose_between(
            t_s,
            0.0,
            a.position_m,
            a.velocity_m_s,
            a.orientation_wxyz,
            gate_s,
            b.position_m,
            b.velocity_m_s,
            b.orientation_wxyz,
        )
        for a, b in zip(before, after, strict=True)
    ]
    rates = [
        _mean(a.angular_velocity_rad_s, b.angular_velocity_rad_s, share) for a, b in zip(before, after, strict=True)
    ]
    rotors = [_mean(a.rotor_rad_s, b.rotor_rad_s, share) for a, b in zip(before, after, strict=True)]
    p, v, q = (np.array([pose[k] for pose in poses]) for k in range(3))
    return DroneStates(p, v, q, np.array(rates), rotors)


def _mean(a: Sequence[float], b: Sequence[float], share: float) -> list[float]:
    return [x + share * (y - x) for x, y in zip(a, b, strict=True)]
