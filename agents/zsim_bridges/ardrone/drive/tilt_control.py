"""Velocities flown with an AR.Drone, whose commands are tilts. Pure."""

import math
from typing import NamedTuple

from zsim.math.rotation import Vector
from zsim.schema.quantities import G_M_S2

VELOCITY_1_S = 1.5  # chosen: a third of what command delay (0.1 s) and tilt lag (0.14 s) leave stable
INTEGRAL_1_S2 = 0.4  # chosen: takes a steady wind away within 5 s
DRAG_1_S = 0.58  # 1/s, of speed (tum_ardrone's flight-fitted model)
STEP_S_MAX = 0.1  # s; longer pauses are not integrated over


class TiltShares(NamedTuple):
    """Shares of the aircraft's limits in [-1, 1]."""

    forward: float
    left: float
    up: float
    yaw_left: float


class TiltControl:
    """A velocity loop about the aircraft's own tilt loop.

    Args:
        tilt_rad, climb_m_s, yaw_rate_rad_s: limits that its configuration has, which a share of 1 means.
    """

    def __init__(self, tilt_rad: float, climb_m_s: float, yaw_rate_rad_s: float) -> None:
        self._slope = math.tan(tilt_rad)
        self._climb_m_s, self._yaw_rate_rad_s = climb_m_s, yaw_rate_rad_s
        self._wind_m_s2 = [0.0, 0.0]
        self._then_ns: int | None = None

    def reset(self) -> None:
        """Forget the wind."""
        self._wind_m_s2, self._then_ns = [0.0, 0.0], None

    def shares(self, now_ns: int, wanted_m_s: Vector, measured_m_s: Vector, yaw_rate_rad_s: float) -> TiltShares:
        """Return the command towards a velocity.

        Args:
            now_ns: time of the command.
            wanted_m_s, measured_m_s: velocities in the heading frame.
            yaw_rate_rad_s: counter-clockwise.
        """
        dt_s = 0.0 if self._then_ns is None else (now_ns - self._then_ns) * 1e-9
        self._then_ns = now_ns
        forward, left = (self._tilt(axis, wanted_m_s[axis], measured_m_s[axis], dt_s) for axis in (0, 1))
        up, yaw = wanted_m_s[2] / self._climb_m_s, yaw_rate_rad_s / self._yaw_rate_rad_s
        return TiltShares(forward, left, _clipped(up), _clipped(yaw))

    def _tilt(self, axis: int, wanted: float, measured: float, dt_s: float) -> float:
        """Return the share of tilt along an axis; the integral stands still where the tilt is at its limit."""
        error = wanted - measured
        accel = VELOCITY_1_S * error + DRAG_1_S * wanted + self._wind_m_s2[axis]
        share = accel / (G_M_S2 * self._slope)
        if abs(share) < 1.0 and dt_s < STEP_S_MAX:
            self._wind_m_s2[axis] += INTEGRAL_1_S2 * error * dt_s
        return _clipped(share)


def _clipped(share: float) -> float:
    return max(-1.0, min(1.0, share))
