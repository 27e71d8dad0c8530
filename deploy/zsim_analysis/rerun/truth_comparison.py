"""Two flights of one run, instant by instant. Pure."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.schema.message import Message

COUNTED = ("position_m", "velocity_m_s", "orientation_wxyz", "angular_velocity_rad_s")  # of truth_sha256


class Difference(NamedTuple):
    """How two flights differ: when, which drone, and by how much [m, m/s, rad, rad/s]."""

    t_ns: int
    drone: str
    position_m: float
    velocity_m_s: float
    angle_rad: float
    rate_rad_s: float

    def __str__(self) -> str:
        angle_deg, rate_deg_s = math.degrees(self.angle_rad), math.degrees(self.rate_rad_s)
        by = f"{self.position_m:.3g} m, {self.velocity_m_s:.3g} m/s, {angle_deg:.3g} deg, {rate_deg_s:.3g} deg/s"
        return f"{self.drone} at {self.t_ns / 1e9:.3f} s by {by}"


class TruthComparison:
    """Compares the truth of two flights gate by gate.

    Args:
        drones: in scenario order.

    Attributes:
        instants: compared so far.
        first, last: the first difference, and the last.
    """

    def __init__(self, drones: Sequence[str]) -> None:
        self._drones = tuple(drones)
        self.instants = 0
        self.first: Difference | None = None
        self.last: Difference | None = None

    def add(self, t_ns: int, recorded: Mapping[str, bytes], flown: Mapping[str, bytes]) -> None:
        """Compare the truth of a gate of both, by drone."""
        self.instants += 1
        for drone in self._drones:
            if recorded[drone] != flown[drone] and (
                differing := difference(t_ns, drone, recorded[drone], flown[drone])
            ):
                self.first = self.first or differing
                self.last = differing


class OutputComparison:
    """Compares what agents put out with what they put out on record; each may come before the other.

    Args:
        patience_ns: simulated time after which the other comes no more.
    """

    def __init__(self, patience_ns: int) -> None:
        self._patience_ns = patience_ns
        self._unmatched: dict[tuple[str, int, int], Message] = {}
        self._different: list[tuple[int, str]] = []

    @property
    def first(self) -> str:
        """Return the first output that differs, or that only one of the two has, and when; empty if there is none."""
        if not self._different:
            return ""
        t_ns, key = min(self._different)
        return f"{key} at {t_ns / 1e9:.2f} s"

    def add(self, key: str, output: Any) -> None:
        """Add an output of either."""
        identity = (key, output.seq, output.t_ns)
        other = self._unmatched.pop(identity, None)
        if other is None:
            self._unmatched[identity] = output
        elif other != output:
            self._note(key, output.t_ns)

    def expire(self, t_ns: int) -> None:
        """Count those as different whose counterpart has not come within the patience before t_ns."""
        for identity in [identity for identity in self._unmatched if identity[2] < t_ns - self._patience_ns]:
            del self._unmatched[identity]
            self._note(identity[0], identity[2])

    def _note(self, key: str, t_ns: int) -> None:
        if not self._different or t_ns <= min(self._different)[0]:
            self._different.append((t_ns, key))


def difference(t_ns: int, drone: str, recorded: bytes, flown: bytes) -> Difference | None:
    """Return the difference of two true states; None if the COUNTED fields are the same to the bit.

    Raises:
        DecodeError: one of them is no truth.
    """
    key = keys.truth(drone)
    a, b = messages.decode(key, recorded), messages.decode(key, flown)
    if all(getattr(a, part) == getattr(b, part) for part in COUNTED):
        return None
    cosine = abs(sum(p * q for p, q in zip(a.orientation_wxyz, b.orientation_wxyz, strict=True)))
    return Difference(
        t_ns,
        drone,
        math.dist(a.position_m, b.position_m),
        math.dist(a.velocity_m_s, b.velocity_m_s),
        2 * math.acos(min(1.0, cosine)),
        math.dist(a.angular_velocity_rad_s, b.angular_velocity_rad_s),
    )
