"""Setpoints of MAVLink as targets to be held, in all sensible frames and masks.

Source: https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED.
"""

import math
from typing import NamedTuple

from zsim.math.frames import turned_about_up
from zsim.math.rotation import Vector
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.conversions import DEGREES, attitude_ned, frd, from_int, ned, wrapped, yaw_ned
from zsim_bridges.mavlink.enums import AttitudeMask, MavFrame, TypeMask
from zsim_bridges.mavlink.flight_control import NOWHERE, Target, TiltTarget, is_place
from zsim_bridges.mavlink.mission import ABSOLUTE, RELATIVE
from zsim_bridges.mavlink.vehicle_state import VehicleState

ALONG_HEADING = (MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED, MavFrame.BODY_FRD)
FROM_HERE = (MavFrame.LOCAL_OFFSET_NED, *ALONG_HEADING)
HOVER_THRUST = 0.5  # of the thrust of a setpoint; MPC_THR_HOVER
SPEED_MAX_M_S = 1e3  # m/s; no vehicle here flies faster

Setpoint = Target | TiltTarget


class SetpointRefusal(NamedTuple):
    """Why a setpoint is not flown."""

    reason: str


def from_local(message: dialect.SetPositionTargetLocalNed, state: VehicleState) -> Setpoint | SetpointRefusal:
    """Return what SET_POSITION_TARGET_LOCAL_NED asks for."""
    frame, place = message.coordinate_frame, (message.x, message.y, message.z)
    if frame == MavFrame.LOCAL_NED:
        return _target(message, ned(place), False, state)
    if frame not in FROM_HERE:
        return SetpointRefusal(f"frame {frame} of a local setpoint is not flown")
    along_heading = frame in ALONG_HEADING
    x, y, z = frd(place) if along_heading else ned(place)
    if along_heading:
        c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        x, y = c * x - s * y, s * x + c * y
    own_x, own_y, own_z = state.position_m
    return _target(message, (own_x + x, own_y + y, own_z + z), along_heading, state)


def from_global(message: dialect.SetPositionTargetGlobalInt, state: VehicleState) -> Setpoint | SetpointRefusal:
    """Return what SET_POSITION_TARGET_GLOBAL_INT asks for."""
    if message.coordinate_frame not in (*ABSOLUTE, *RELATIVE):
        return SetpointRefusal(f"frame {message.coordinate_frame} of a global setpoint is not flown")
    own = state.to_global(state.position_m)
    height_m = message.alt
    if message.coordinate_frame in RELATIVE:
        height_m += state.to_global(state.home_or_here_m)[2]
    given = from_int(message.lat_int, DEGREES), from_int(message.lon_int, DEGREES), height_m
    known = [value if math.isfinite(value) else here for value, here in zip(given, own, strict=True)]
    x, y, z = state.to_local(known[0], known[1], known[2])
    latitude_deg, longitude_deg, _ = given
    place = x if math.isfinite(longitude_deg) else math.nan, y if math.isfinite(latitude_deg) else math.nan
    return _target(message, (*place, z if math.isfinite(height_m) else math.nan), False, state)


def _target(
    message: dialect.SetPositionTargetLocalNed | dialect.SetPositionTargetGlobalInt,
    position_m: Vector,
    along_heading: bool,
    state: VehicleState,
) -> Setpoint | SetpointRefusal:
    mask = TypeMask(message.type_mask)
    bits = (TypeMask.Y, TypeMask.X, TypeMask.Z)  # x of W is y of MAVLink
    x, y, z = (None if mask & bit or not math.isfinite(p) else p for p, bit in zip(position_m, bits, strict=True))
    position = x, y, z
    velocity = _velocity(mask, (message.vx, message.vy, message.vz), along_heading)
    if position == NOWHERE and velocity is None:
        return SetpointRefusal("a setpoint without position and velocity is not flown")
    velocity_m_s = velocity or (0.0, 0.0, 0.0)
    if not is_place(position) or not all(abs(v) < SPEED_MAX_M_S for v in velocity_m_s):
        return SetpointRefusal("a setpoint is beyond all bounds")
    along = along_heading and position == NOWHERE
    if along_heading and not along and velocity is not None:
        velocity_m_s = turned_about_up(velocity, state.yaw_rad)
    yaw, yaw_rate = _yaw(mask, message.yaw, message.yaw_rate, message.coordinate_frame, state)
    return Target(position, velocity_m_s, yaw, yaw_rate, along)


def _velocity(mask: TypeMask, given: Vector, along_heading: bool) -> Vector | None:
    bits = (TypeMask.VX, TypeMask.VY, TypeMask.VZ)
    known = [not mask & bit and math.isfinite(v) for v, bit in zip(given, bits, strict=True)]
    if not any(known):
        return None
    x, y, z = (v if is_known else 0.0 for v, is_known in zip(given, known, strict=True))
    return frd((x, y, z)) if along_heading else ned((x, y, z))


def _yaw(mask: TypeMask, yaw: float, yaw_rate: float, frame: int, state: VehicleState) -> tuple[float | None, float]:
    """Return the yaw counter-clockwise from east, None if it is not given, and the rate."""
    if mask & TypeMask.YAW or not math.isfinite(yaw) or abs(yaw) > 1e3:
        is_given = not mask & TypeMask.YAW_RATE and math.isfinite(yaw_rate)
        return None, -max(-100.0, min(100.0, yaw_rate)) if is_given else 0.0
    if frame in (MavFrame.BODY_OFFSET_NED, MavFrame.BODY_FRD):
        return wrapped(state.yaw_rad - yaw), 0.0
    return yaw_ned(yaw), 0.0


def from_attitude(message: dialect.SetAttitudeTarget, weight_n: float) -> Setpoint | SetpointRefusal:
    """Return what SET_ATTITUDE_TARGET asks for; half of the thrust carries the weight [N]."""
    mask = AttitudeMask(message.type_mask & 0xFF)
    values = (*message.q, message.thrust, message.body_yaw_rate)
    if mask & AttitudeMask.ATTITUDE:
        return SetpointRefusal("body rates alone are not flown; give an attitude")
    length = math.hypot(*message.q)
    if not all(map(math.isfinite, values)) or not 0.5 < length < 2.0:
        return SetpointRefusal("the attitude of a setpoint is no quaternion")
    w, x, y, z = attitude_ned((message.q[0], message.q[1], message.q[2], message.q[3]))
    q_WB = w / length, x / length, y / length, z / length
    thrust = HOVER_THRUST if mask & AttitudeMask.THRUST else max(0.0, min(1.0, message.thrust))
    rate = 0.0 if mask & AttitudeMask.YAW_RATE else -max(-10.0, min(10.0, message.body_yaw_rate))
    return TiltTarget(q_WB, weight_n * thrust / HOVER_THRUST, rate)
