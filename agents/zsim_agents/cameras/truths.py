"""The true states of all drones at the last gates, and where they were between two of them. Pure."""

from collections.abc import Sequence

import numpy as np

from zsim.contract.flight_messages import Truth
from zsim.math.interpolation import pose_between
from zsim_agents.cameras.rendering.scene import DroneStates

PENDING_MAX = 64  # gates of which the truth of a drone may be lacking


class TruthHistory:
    """The last gates of which the truth of every drone is there.

    Args:
        drones: how many there are.
        gate_ns: time between two gates.
        span_ns: how far back it reaches, at least.
    """

    def __init__(self, drones: int, gate_ns: int, span_ns: int) -> None:
        self._drones, self._gate_ns = drones, gate_ns
        self._kept = 2 + span_ns // gate_ns
        self._pending: dict[int, dict[int, Truth]] = {}
        self._whole: dict[int, list[Truth]] = {}  # by gate, in order
        self.newest_ns = -1

    def add(self, drone: int, truth: Truth) -> None:
        """Take the truth of a drone, by its number."""
        t_ns = truth.t_ns
        if t_ns <= self.newest_ns:
            return
        states = self._pending.setdefault(t_ns, {})
        states[drone] = truth
        if len(states) == self._drones:
            self._whole[t_ns] = [states[i] for i in range(self._drones)]
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
