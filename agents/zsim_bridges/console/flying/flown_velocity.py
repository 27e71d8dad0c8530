"""Velocities of a drone that is flown from a page: of a stick, or towards a place. Pure."""

import math
from typing import NamedTuple

from zsim.math.frames import turned_about_up
from zsim.math.rotation import Vector
from zsim.vehicles.vehicle import Limits
from zsim_bridges.console.flying.geofence import Geofence

CLIMB_SHARE = 0.5  # of the speed over the ground, up and down; chosen: on a page a height is harder to see
YAW_RATE_RAD_S = math.radians(45.0)  # chosen: once around in 8 s
SPEED_M_S = 1.5  # towards a place; chosen: as the formations of the paper
GAIN_1_S = 0.6  # of the way to a place; as formations, `Gains.proportional_1_s`


class Stick(NamedTuple):
    """How far a stick is moved, or keys are held: each from -1 to 1; in the drone's heading frame, and yaw to the left.

    Attributes:
        speed_m_s: at a full stick.
    """

    forward: float
    left: float
    up: float
    turn: float
    speed_m_s: float


class DronePose(NamedTuple):
    """Where a drone is by its estimator [m; W], and its heading [rad]."""

    p_W: Vector
    yaw_rad: float


class FlownVelocity(NamedTuple):
    """A velocity command in the heading frame."""

    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    yaw_rate_rad_s: float = 0.0


HOVER = FlownVelocity()


def stick_velocity(stick: Stick, pose: DronePose, limits: Limits, fence: Geofence) -> FlownVelocity:
    """Return what a stick asks of a drone, within its limits and the fence."""
    speed = min(max(stick.speed_m_s, 0.0), limits.horizontal_speed_m_s)
    deflection = max(1.0, math.hypot(stick.forward, stick.left))
    climb = stick.up * min(CLIMB_SHARE * speed, limits.vertical_speed_m_s)
    wanted = (stick.forward / deflection * speed, stick.left / deflection * speed, climb)
    yaw_rate = stick.turn * min(YAW_RATE_RAD_S, math.radians(limits.yaw_rate_deg_s))
    return FlownVelocity(_fenced(turned_about_up(wanted, pose.yaw_rad), pose, fence), yaw_rate)


def velocity_to(place_W: Vector, pose: DronePose, limits: Limits, fence: Geofence) -> FlownVelocity:
    """Return the velocity towards a place [m; W], without turning."""
    x, y, z = (GAIN_1_S * (there - here) for there, here in zip(place_W, pose.p_W, strict=True))
    speed = min(SPEED_M_S, limits.horizontal_speed_m_s)
    excess = max(1.0, math.hypot(x, y) / speed)
    climb_max = min(CLIMB_SHARE * speed, limits.vertical_speed_m_s)
    return FlownVelocity(_fenced((x / excess, y / excess, min(max(z, -climb_max), climb_max)), pose, fence))


def _fenced(velocity_W: Vector, pose: DronePose, fence: Geofence) -> Vector:
    """Return a velocity of W in the heading frame, without what leads out of the fence."""
    x, y, z = fence.within(velocity_W, pose.p_W)
    return turned_about_up((x, y, z), -pose.yaw_rad)
