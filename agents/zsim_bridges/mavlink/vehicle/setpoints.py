"""Setpoints of MAVLink as what is to be held: all frames and masks that make sense.

Source: https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED.
"""

import math
from typing import NamedTuple

from zsim.math.frames import turned_about_up
from zsim.math.rotation import Vector
from zsim_bridges.mavlink.autopilot import ned_axes
from zsim_bridges.mavlink.autopilot.enums import AttitudeMask, MavFrame, TypeMask
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState
from zsim_bridges.mavlink.flight.mission import ABSOLUTE, DEGREES, RELATIVE, from_int
from zsim_bridges.mavlink.flight.position_guidance import NOWHERE, Axes, Target, TiltTarget, is_place
from zsim_bridges.mavlink.wire import dialect

POSITION = TypeMask.X | TypeMask.Y | TypeMask.Z
VELOCITY = TypeMask.VX | TypeMask.VY | TypeMask.VZ
ALONG_HEADING = (MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED, MavFrame.BODY_FRD)
FROM_HERE = (
    MavFrame.LOCAL_OFFSET_NED,
    MavFrame.BODY_NED,
    MavFrame.BODY_OFFSET_NED,
    MavFrame.BODY_FRD,
)
LOCAL_FRAMES = (MavFrame.LOCAL_NED, *FROM_HERE)
HOVER_THRUST = 0.5  # of the thrust of a setpoint; MPC_THR_HOVER
SPEED_MAX_M_S = 1e3  # m/s; beyond it nothing flies here

Setpoint = Target | TiltTarget


class SetpointRefusal(NamedTuple):
    """Why a setpoint is not flown."""

    reason: str


def from_local(message: dialect.SetPositionTargetLocalNed, state: VehicleState) -> Setpoint | SetpointRefusal:
    """Return what SET_POSITION_TARGET_LOCAL_NED asks for."""
    if message.coordinate_frame not in LOCAL_FRAMES:
        return SetpointRefusal(f"frame {message.coordinate_frame} of a local setpoint is not flown")
    place = message.x, message.y, message.z
    along_heading = message.coordinate_frame in ALONG_HEADING
    if message.coordinate_frame in FROM_HERE:
        position = _from_here(ned_axes.frd(place) if along_heading else ned_axes.ned(place), along_heading, state)
    else:
        position = ned_axes.ned(place)
    return _target(message, position, along_heading, state)


def from_global(message: dialect.SetPositionTargetGlobalInt, state: VehicleState) -> Setpoint | SetpointRefusal:
    """Return what SET_POSITION_TARGET_GLOBAL_INT asks for."""
    if message.coordinate_frame not in (*ABSOLUTE, *RELATIVE):
        return SetpointRefusal(f"frame {message.coordinate_frame} of a global setpoint is not flown")
    own = state.to_global(state.position_m)
    height_m = message.alt
    if message.coordinate_frame in RELATIVE:
        height_m += state.to_global(state.home_m or state.position_m)[2]
    given = from_int(message.lat_int, DEGREES), from_int(message.lon_int, DEGREES), height_m
    known = [value if math.isfinite(value) else here for value, here in zip(given, own, strict=True)]
    x, y, z = state.to_local(known[0], known[1], known[2])
    latitude_deg, longitude_deg, _ = given
    place = x if math.isfinite(longitude_deg) else math.nan, y if math.isfinite(latitude_deg) else math.nan
    return _target(message, (*place, z if math.isfinite(height_m) else math.nan), False, state)


def _from_here(offset: Vector, along_heading: bool, state: VehicleState) -> Vector:
    """Return a place that is given from where the vehicle is."""
    x, y, z = offset
    if along_heading:
        c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        x, y = c * x - s * y, s * x + c * y
    own_x, own_y, own_z = state.position_m
    return own_x + x, own_y + y, own_z + z


def _target(
    message: dialect.SetPositionTargetLocalNed | dialect.SetPositionTargetGlobalInt,
    position_m: Vector,
    along_heading: bool,
    state: VehicleState,
) -> Setpoint | SetpointRefusal:
    mask = TypeMask(message.type_mask)
    position = _axes(mask, position_m)
    given = message.vx, message.vy, message.vz
    velocity = _velocity(mask, given, along_heading)
    if position == NOWHERE and velocity is None:
        return SetpointRefusal("a setpoint without position and velocity is not flown")
    if not _is_sane(position, velocity or (0.0, 0.0, 0.0)):
        return SetpointRefusal("a setpoint is beyond all bounds")
    along = along_heading and position == NOWHERE
    if along_heading and not along and velocity is not None:
        velocity = turned_about_up(velocity, state.yaw_rad)
    yaw, yaw_rate = _yaw(mask, message.yaw, message.yaw_rate, message.coordinate_frame, state)
    return Target(position, velocity or (0.0, 0.0, 0.0), yaw, yaw_rate, along)


def _axes(mask: TypeMask, position_m: Vector) -> Axes:
    """Return the axes in W that are given; x of W is y of MAVLink."""
    bits = (TypeMask.Y, TypeMask.X, TypeMask.Z)
    x, y, z = (None if mask & bit or not math.isfinite(p) else p for p, bit in zip(position_m, bits, strict=True))
    return x, y, z


def _velocity(mask: TypeMask, given: Vector, along_heading: bool) -> Vector | None:
    bits = (TypeMask.VX, TypeMask.VY, TypeMask.VZ)
    if all(mask & bit or not math.isfinite(v) for v, bit in zip(given, bits, strict=True)):
        return None
    x, y, z = (0.0 if mask & bit or not math.isfinite(v) else v for v, bit in zip(given, bits, strict=True))
    return ned_axes.frd((x, y, z)) if along_heading else ned_axes.ned((x, y, z))


def _is_sane(position: Axes, velocity: Vector) -> bool:
    return is_place(position) and all(abs(v) < SPEED_MAX_M_S for v in velocity)


def _yaw(mask: TypeMask, yaw: float, yaw_rate: float, frame: int, state: VehicleState) -> tuple[float | None, float]:
    """Return the yaw counter-clockwise from east, None where it is not given, and the rate."""
    rate = 0.0 if mask & TypeMask.YAW_RATE or not math.isfinite(yaw_rate) else -max(-100.0, min(100.0, yaw_rate))
    if mask & TypeMask.YAW or not math.isfinite(yaw) or abs(yaw) > 1e3:
        return None, rate
    if frame in (MavFrame.BODY_OFFSET_NED, MavFrame.BODY_FRD):
        return ned_axes.wrapped(state.yaw_rad - yaw), 0.0
    return ned_axes.yaw_ned(yaw), 0.0


def from_attitude(message: dialect.SetAttitudeTarget, weight_n: float) -> Setpoint | SetpointRefusal:
    """Return what SET_ATTITUDE_TARGET asks for; half of the thrust carries the weight [N]."""
    mask = AttitudeMask(message.type_mask & 0xFF)
    values = (*message.q, message.thrust, message.body_yaw_rate)
    if mask & AttitudeMask.ATTITUDE:
        return SetpointRefusal("body rates alone are not flown; give an attitude")
    length = math.hypot(*message.q)
    if not all(map(math.isfinite, values)) or not 0.5 < length < 2.0:
        return SetpointRefusal("the attitude of a setpoint is no quaternion")
    w, x, y, z = ned_axes.attitude_ned((message.q[0], message.q[1], message.q[2], message.q[3]))
    q_WB = w / length, x / length, y / length, z / length
    thrust = HOVER_THRUST if mask & AttitudeMask.THRUST else max(0.0, min(1.0, message.thrust))
    rate = 0.0 if mask & AttitudeMask.YAW_RATE else -max(-10.0, min(10.0, message.body_yaw_rate))
    return TiltTarget(q_WB, weight_n * thrust / HOVER_THRUST, rate)
