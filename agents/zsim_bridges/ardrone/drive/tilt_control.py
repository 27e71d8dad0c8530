"""Velocities flown with an AR.Drone, whose commands are tilts. Pure."""

import math
from collections import deque
from typing import NamedTuple

from zsim.math.rotation import Vector
from zsim.schema.quantities import G_M_S2

VELOCITY_1_S = 2.5  # chosen: 46 deg of phase with 0.14 s of delay and 0.14 s of tilt lag
INTEGRAL_1_S2 = 2.0  # chosen: as fast as that phase allows; gusts last some seconds
DRAG_1_S = 0.58  # 1/s, of speed (tum_ardrone's flight-fitted model)
STEP_S_MAX = 0.1  # s; over longer pauses no more is integrated
ANSWER_NS = 240_000_000  # command delay and tilt lag (tum_ardrone: 0.1 s and 0.14 s)


class TiltShares(NamedTuple):
    """Shares of the aircraft's limits in [-1, 1]."""

    forward: float
    left: float
    up: float
    yaw_left: float


class TiltControl:
    """A velocity loop about the aircraft's own tilt loop.

    The velocity follows a reference that answers with a lag. What it is beside the reference of the time when the
    aircraft got its commands is wind, and is integrated.

    Args:
        tilt_rad, climb_m_s, yaw_rate_rad_s: limits that its configuration has, which a share of 1 means.
    """

    def __init__(self, tilt_rad: float, climb_m_s: float, yaw_rate_rad_s: float) -> None:
        self._slope = math.tan(tilt_rad)
        self._climb_m_s, self._yaw_rate_rad_s = climb_m_s, yaw_rate_rad_s
        self._axes = _Axis(), _Axis()

    def reset(self) -> None:
        """Forget what was flown."""
        self._axes = _Axis(), _Axis()

    def shares(
        self, now_ns: int, wanted_m_s: Vector, measured_m_s: Vector, yaw_rad: float, yaw_rate_rad_s: float
    ) -> TiltShares:
        """Return the command towards a velocity.

        Args:
            now_ns: time of the command.
            wanted_m_s, measured_m_s: velocities [W].
            yaw_rad: heading of the aircraft.
            yaw_rate_rad_s: counter-clockwise, wanted.
        """
        full = G_M_S2 * self._slope
        x, y = (axis.accel(now_ns, wanted_m_s[k], measured_m_s[k], most_m_s2=full) for k, axis in enumerate(self._axes))
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        up, turn = wanted_m_s[2] / self._climb_m_s, yaw_rate_rad_s / self._yaw_rate_rad_s
        return TiltShares(*map(_clipped, ((x * c + y * s) / full, (y * c - x * s) / full, up, turn)))


class _Axis:
    """The loop along one axis of W."""

    def __init__(self) -> None:
        self._then_ns: int | None = None
        self._reference = 0.0
        self._wind_m_s2 = 0.0
        self._references: deque[tuple[int, float]] = deque()

    def accel(self, now_ns: int, wanted: float, measured: float, most_m_s2: float) -> float:
        """Return the acceleration that the tilt is to give."""
        dt_s = 0.0 if self._then_ns is None else min(STEP_S_MAX, (now_ns - self._then_ns) * 1e-9)
        if self._then_ns is None:
            self._reference = measured
        self._then_ns = now_ns
        slope = VELOCITY_1_S * (wanted - self._reference)
        self._reference += dt_s * slope
        error = self._reference_then(now_ns) - measured
        accel = slope + DRAG_1_S * self._reference + VELOCITY_1_S * error + self._wind_m_s2
        if abs(accel) < most_m_s2:
            self._wind_m_s2 += INTEGRAL_1_S2 * error * dt_s
        return accel

    def _reference_then(self, now_ns: int) -> float:
        """Return the reference that the velocity measured now answers to."""
        references = self._references
        references.append((now_ns, self._reference))
        while len(references) > 1 and references[1][0] <= now_ns - ANSWER_NS:
            references.popleft()
        return references[0][1]


def _clipped(share: float) -> float:
    return max(-1.0, min(1.0, share))
