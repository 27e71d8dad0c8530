"""From where a vehicle is to be to the velocity that takes it there.

The position loop is proportional: the firmware holds velocities itself, with loops three times as fast.
"""

import math
from typing import NamedTuple

from zsim.math.rotation import Quaternion, Vector
from zsim_bridges.mavlink.autopilot.ned_axes import wrapped
from zsim_bridges.mavlink.autopilot.personality import SpeedLimits

K_POSITION_1_S = 0.8  # 1/s; that of the firmware's own hold
K_YAW_1_S = 1.5  # 1/s, chosen: a turn of 90 deg in 2 s
YAW_RATE_MAX_RAD_S = 1.0  # rad/s, chosen: half of MC_YAWRAUTO_MAX's 60 deg/s would be slow at this gain

PLACE_MAX_M = 1e6  # m; farther away is no place to fly to

Axes = tuple[float | None, float | None, float | None]
NOWHERE: Axes = (None, None, None)


class Target(NamedTuple):
    """What is to be held.

    Attributes:
        position_m: in W, an axis None where only the velocity counts.
        velocity_m_s: flown, and added to what the position asks for.
        yaw_rad: counter-clockwise from east; None: turn at the rate.
        yaw_rate_rad_s: counter-clockwise.
        along_heading: the velocity is forward, left, up instead of in W.
        speed_m_s: limit of the horizontal speed; None for the vehicle's.
    """

    position_m: Axes = NOWHERE
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    yaw_rad: float | None = None
    yaw_rate_rad_s: float = 0.0
    along_heading: bool = False
    speed_m_s: float | None = None

    @property
    def is_moving(self) -> bool:
        """Whether it goes on somewhere for ever."""
        return any(self.velocity_m_s) or (self.yaw_rad is None and self.yaw_rate_rad_s != 0.0)

    def leads_up(self, z_m: float) -> bool:
        """Return whether it leads above z in W."""
        z = self.position_m[2]
        return self.velocity_m_s[2] > 0.0 or (z is not None and z > z_m)


class TiltTarget(NamedTuple):
    """A tilt that is to be held: attitude B to W, thrust [N], yaw rate [rad/s] counter-clockwise."""

    q_WB: Quaternion
    thrust_n: float
    yaw_rate_rad_s: float

    @property
    def is_moving(self) -> bool:
        """A tilt that is held for ever flies away."""
        return True

    def leads_up(self, z_m: float) -> bool:
        """No take-off begins with a tilt."""
        return False


class Steering(NamedTuple):
    """A velocity in W, or forward, left, up [m/s], and a yaw rate [rad/s]."""

    velocity_m_s: Vector
    yaw_rate_rad_s: float
    along_heading: bool


def steer(target: Target, position_m: Vector, yaw_rad: float, limits: SpeedLimits) -> Steering:
    """Return what to ask of the drone now."""
    x, y, z = (
        v + (0.0 if p is None else K_POSITION_1_S * (p - own))
        for v, p, own in zip(target.velocity_m_s, target.position_m, position_m, strict=True)
    )
    most = limits.horizontal_m_s if target.speed_m_s is None else min(target.speed_m_s, limits.horizontal_m_s)
    speed = math.hypot(x, y)
    share = most / speed if speed > most else 1.0
    climb = max(-limits.down_m_s, min(limits.up_m_s, z))
    return Steering((share * x, share * y, climb), _yaw_rate(target, yaw_rad), target.along_heading)


def _yaw_rate(target: Target, yaw_rad: float) -> float:
    if target.yaw_rad is None:
        return target.yaw_rate_rad_s
    rate = K_YAW_1_S * wrapped(target.yaw_rad - yaw_rad)
    return max(-YAW_RATE_MAX_RAD_S, min(YAW_RATE_MAX_RAD_S, rate))


def is_place(position_m: Axes) -> bool:
    """Return whether a position is finite and not beyond all bounds."""
    return all(p is None or (math.isfinite(p) and abs(p) < PLACE_MAX_M) for p in position_m)


def distance_m(target: Target, position_m: Vector) -> float:
    """Return how far a vehicle is from the position of a target."""
    return math.hypot(*(0.0 if p is None else p - own for p, own in zip(target.position_m, position_m, strict=True)))
