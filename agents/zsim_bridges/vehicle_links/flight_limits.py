"""What a driver never asks of a real aircraft, whoever commands: speeds, and where it may fly. Pure."""

import math
from collections.abc import Sequence
from typing import NamedTuple

BRAKING_M_S2 = 1.0  # chosen: half of what an AR.Drone at 12 deg of tilt has; the speed towards a fence follows from it
RETURN_M_S = 0.5  # chosen: slow, since nobody asked for it
BREACH_M = 1.0  # chosen: how far outside it lands; the fence itself stops it before


class FlightLimits(NamedTuple):
    """Limits in W; a fence is a cylinder about the origin.

    Attributes:
        speed_m_s, climb_m_s, yaw_rate_rad_s: greatest, in any direction, up or down, either way.
        radius_m, ceiling_m: of the fence; inf for none.
    """

    speed_m_s: float = 2.0  # chosen: what a person can walk after
    climb_m_s: float = 1.0  # chosen: control_vz_max of the AR.Drone outdoors
    yaw_rate_rad_s: float = 1.75  # rad/s, control_yaw of the AR.Drone indoors
    radius_m: float = math.inf
    ceiling_m: float = math.inf

    def limited(self, velocity_m_s: Sequence[float], position_m: Sequence[float] | None) -> tuple[float, float, float]:
        """Return a velocity [m/s; W] within the limits, of which nothing leads through the fence.

        Args:
            velocity_m_s: that is asked for [W].
            position_m: of the aircraft [W]; None where it is not known: then no fence acts.
        """
        x, y, z = velocity_m_s
        speed = math.hypot(x, y)
        share = min(1.0, self.speed_m_s / speed) if speed else 1.0
        x, y, z = x * share, y * share, max(-self.climb_m_s, min(self.climb_m_s, z))
        if position_m is None:
            return x, y, z
        x, y = self._within_radius(x, y, position_m)
        return x, y, min(z, _approach(self.ceiling_m - position_m[2]))

    def _within_radius(self, x: float, y: float, position_m: Sequence[float]) -> tuple[float, float]:
        distance = math.hypot(position_m[0], position_m[1])
        if math.isinf(self.radius_m) or distance == 0.0:
            return x, y
        out_x, out_y = position_m[0] / distance, position_m[1] / distance
        outward = x * out_x + y * out_y
        excess = outward - _approach(self.radius_m - distance)
        return (x - excess * out_x, y - excess * out_y) if excess > 0.0 else (x, y)

    def yaw_rate(self, yaw_rate_rad_s: float) -> float:
        """Return a yaw rate [rad/s] within the limit."""
        return max(-self.yaw_rate_rad_s, min(self.yaw_rate_rad_s, yaw_rate_rad_s))

    def is_breached(self, position_m: Sequence[float]) -> bool:
        """Tell whether an aircraft at a position [m; W] is so far outside that it is to land."""
        distance = math.hypot(position_m[0], position_m[1])
        return distance > self.radius_m + BREACH_M or position_m[2] > self.ceiling_m + BREACH_M


def _approach(distance_m: float) -> float:
    """Return the greatest speed towards a fence from which the aircraft still stops before it; outside, back to it."""
    return math.sqrt(2.0 * BRAKING_M_S2 * distance_m) if distance_m > 0.0 else max(-RETURN_M_S, distance_m)
