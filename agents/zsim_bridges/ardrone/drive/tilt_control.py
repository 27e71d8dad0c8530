"""Velocities flown with an AR.Drone, whose commands are tilts. Pure."""

import math
from typing import NamedTuple

from zsim.math.rotation import Vector
from zsim.schema.quantities import G_M_S2

VELOCITY_1_S = 2.5  # chosen: 49 deg of phase with 0.14 s of delay and 0.14 s of tilt lag
INTEGRAL_1_S2 = 1.5  # chosen: as fast as that phase allows; gusts last some seconds
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
        dt_s = 0.0 if self._then_ns is None else (now_ns - self._then_ns) * 1e-9
        self._then_ns = now_ns
        errors = [wanted - measured for wanted, measured in zip(wanted_m_s[:2], measured_m_s[:2], strict=True)]
        x, y = (
            VELOCITY_1_S * error + DRAG_1_S * wanted + wind
            for error, wanted, wind in zip(errors, wanted_m_s[:2], self._wind_m_s2, strict=True)
        )
        if math.hypot(x, y) < G_M_S2 * self._slope and dt_s < STEP_S_MAX:  # else the tilt is at its limit
            for axis in (0, 1):
                self._wind_m_s2[axis] += INTEGRAL_1_S2 * errors[axis] * dt_s
        c, s, full = math.cos(yaw_rad), math.sin(yaw_rad), G_M_S2 * self._slope
        up, turn = wanted_m_s[2] / self._climb_m_s, yaw_rate_rad_s / self._yaw_rate_rad_s
        return TiltShares(*map(_clipped, ((x * c + y * s) / full, (y * c - x * s) / full, up, turn)))


def _clipped(share: float) -> float:
    return max(-1.0, min(1.0, share))
