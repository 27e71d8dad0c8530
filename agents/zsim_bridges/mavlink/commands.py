"""What clients ask of a vehicle: commands, which are answered, and setpoints in all sensible frames and masks.

Sources: https://mavlink.io/en/services/command.html,
https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from zsim.math.frames import turned_about_up
from zsim.math.rotation import Vector
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import (
    DEGREES,
    LAYOUTS,
    LOCAL_M,
    WireMessage,
    attitude_ned,
    frd,
    from_int,
    ned,
    wrapped,
    yaw_ned,
)
from zsim_bridges.mavlink.enums import FORCE, AttitudeMask, Cmd, MavFrame, Result, TypeMask
from zsim_bridges.mavlink.flight_control import NOWHERE, Target, TiltTarget, is_place
from zsim_bridges.mavlink.mission import ABSOLUTE, FRAMES, LOCAL, RELATIVE, PlanItem, place_of
from zsim_bridges.mavlink.personality import FlightMode, Parameters, Personality, Setting, px4_mode
from zsim_bridges.mavlink.telemetry import Telemetry
from zsim_bridges.mavlink.vehicle_flight import Flight
from zsim_bridges.mavlink.vehicle_state import VehicleState

AUTOPILOT_VERSION, HOME_POSITION = LAYOUTS[dialect.AutopilotVersion].id, LAYOUTS[dialect.HomePosition].id
SPEEDS: dict[int, Setting] = {2: "up_m_s", 3: "down_m_s"}  # SPEED_TYPE; else the horizontal one
ALONG_HEADING = (MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED, MavFrame.BODY_FRD)
FROM_HERE = (MavFrame.LOCAL_OFFSET_NED, *ALONG_HEADING)
HOVER_THRUST = 0.5  # of the thrust of a setpoint; MPC_THR_HOVER
SPEED_MAX_M_S = 1e3  # m/s; no vehicle here flies faster
Setpoint = Target | TiltTarget


class Request(NamedTuple):
    """A command: seven parameters, the fifth and sixth in degrees or metres, and the frame of the place."""

    command: int
    params: tuple[float, float, float, float, float, float, float]
    frame: int

    @classmethod
    def of(cls, message: dialect.CommandLong | dialect.CommandInt) -> "Request":
        """Return the command in a message."""
        m, frame = message, 0
        place: tuple[float, float, float]
        if isinstance(m, dialect.CommandLong):
            place = m.param5, m.param6, m.param7
        else:
            frame, unit = m.frame, LOCAL_M if m.frame in LOCAL else DEGREES
            place = from_int(m.x, unit), from_int(m.y, unit), m.z
        return cls(m.command, (m.param1, m.param2, m.param3, m.param4, *place), frame)

    def integer(self, place: int) -> int:
        """Return a parameter that is a whole number; -1 if it is none."""
        value = self.params[place]
        return int(value) if math.isfinite(value) and 0 <= value < 2**31 else -1


class Answer(NamedTuple):
    """The result of a command, and the reason of a refusal."""

    result: Result
    reason: str = ""


ACCEPTED, UNSUPPORTED = Answer(Result.ACCEPTED), Answer(Result.UNSUPPORTED)


def _denied(reason: str) -> Answer:
    return Answer(Result.DENIED, reason)


def _answered(refusal: str | None) -> Answer:
    return ACCEPTED if refusal is None else _denied(refusal)


class VehicleParts(NamedTuple):
    """What commands act on; `send` sends a message, `version` returns AUTOPILOT_VERSION."""

    personality: Personality
    parameters: Parameters
    state: VehicleState
    flight: Flight
    telemetry: Telemetry
    send: Callable[[WireMessage], None]
    version: Callable[[], WireMessage]


Handler = Callable[[VehicleParts, Request], Answer]


def carry_out(vehicle: VehicleParts, request: Request) -> Answer:
    """Carry out a command; return its result."""
    handler = HANDLERS.get(request.command)
    return handler(vehicle, request) if handler else UNSUPPORTED


def put_custom_mode(vehicle: VehicleParts, custom: int) -> Answer:
    """Change the mode by its number."""
    mode = vehicle.personality.mode_of(custom)
    if mode is None:
        return Answer(Result.UNSUPPORTED, f"no mode {custom:#x}")
    return _answered(vehicle.flight.set_mode(mode))


def _mode_setter(mode: FlightMode) -> Handler:
    return lambda vehicle, _: _answered(vehicle.flight.set_mode(mode))


def _arm(vehicle: VehicleParts, request: Request) -> Answer:
    if request.params[0] not in (0.0, 1.0):
        return _denied(f"arm or disarm? {request.params[0]:g}")
    arm = vehicle.flight.arm if request.params[0] else vehicle.flight.disarm
    return _answered(arm(request.params[1] == FORCE))


def _take_off(vehicle: VehicleParts, request: Request) -> Answer:
    altitude_m, state, is_px4 = request.params[6], vehicle.state, vehicle.personality.is_px4
    if not math.isfinite(altitude_m) or (is_px4 and altitude_m == 0.0):
        altitude_m = vehicle.parameters["takeoff_altitude_m"]
    elif is_px4:  # PX4 has it over the sea
        altitude_m -= state.to_global(state.home_or_here_m)[2]
    if not 0.0 < altitude_m <= 10_000.0:
        return _denied(f"take-off to {altitude_m:.1f} m over home")
    return _answered(vehicle.flight.take_off(altitude_m))


def _set_mode(vehicle: VehicleParts, request: Request) -> Answer:
    main, sub = request.integer(1), request.integer(2)
    base_mode = request.params[0]
    if not int(base_mode if math.isfinite(base_mode) else 0) & 1:
        return _denied("a mode must be a custom mode")
    return put_custom_mode(vehicle, px4_mode(main, sub) if vehicle.personality.is_px4 else main)


def _reposition(vehicle: VehicleParts, request: Request) -> Answer:
    speed_m_s, _, _, yaw = request.params[:4]
    place = _place(vehicle.state, request)
    if place is None:
        return _denied("no place to go to")
    yaw_rad = yaw_ned(yaw) if math.isfinite(yaw) else None
    speed = speed_m_s if math.isfinite(speed_m_s) and speed_m_s > 0 else None
    return _answered(vehicle.flight.go_to(Target(place, yaw_rad=yaw_rad, speed_m_s=speed)))


def _place(state: VehicleState, request: Request) -> Vector | None:
    """Return the place of a command in W; coordinates that are not finite are the vehicle's."""
    params, frame = request.params, request.frame
    item = PlanItem(frame, request.command, params[:4], *params[4:])
    if frame not in FRAMES or (abs(item.x) > 180.0 and frame not in LOCAL):
        return None
    own = state.position_m
    if not math.isfinite(item.z):
        if frame in LOCAL:
            item = item._replace(z=-own[2] if frame == MavFrame.LOCAL_NED else own[2])
        else:
            item = item._replace(z=state.to_global(own)[2], frame=ABSOLUTE[0])
    place = place_of(item, state)
    return place if is_place(place) else None


def _pause(vehicle: VehicleParts, request: Request) -> Answer:
    flight = vehicle.flight
    return _answered(flight.set_mode(FlightMode.HOLD) if request.params[0] == 0.0 else flight.start_mission())


def _change_speed(vehicle: VehicleParts, request: Request) -> Answer:
    speed_m_s = request.params[1]
    if not math.isfinite(speed_m_s) or speed_m_s <= 0.0:
        return _denied(f"a speed of {speed_m_s} m/s")
    return _answered(vehicle.parameters.put_setting(SPEEDS.get(request.integer(0), "speed_m_s"), speed_m_s))


def _set_home(vehicle: VehicleParts, request: Request) -> Answer:
    place = vehicle.state.position_m if request.params[0] == 1.0 else _place(vehicle.state, request)
    if place is None:
        return _denied("no place for home")
    vehicle.state.home_m = place
    return _send_message(vehicle, HOME_POSITION)


def _terminate(vehicle: VehicleParts, request: Request) -> Answer:
    if request.params[0] > 0.5:
        vehicle.flight.terminate()
    return ACCEPTED


def _set_mission_current(vehicle: VehicleParts, request: Request) -> Answer:
    return ACCEPTED if vehicle.flight.mission.set_current(request.integer(0)) else _denied("no such item")


def _enable_fence(vehicle: VehicleParts, request: Request) -> Answer:
    if "FENCE_ENABLE" not in vehicle.parameters.values:
        return UNSUPPORTED
    return _answered(vehicle.parameters.put("FENCE_ENABLE", float(request.params[0] == 1.0)))


def _start_mission(vehicle: VehicleParts, request: Request) -> Answer:
    return _answered(vehicle.flight.start_mission(request.integer(0) or None))


def _turn(vehicle: VehicleParts, request: Request) -> Answer:
    """Turn to an angle [deg] from north, or by one in a direction, and hold the position."""
    angle, _, direction, relative = request.params[:4]
    state = vehicle.state
    if not math.isfinite(angle) or not state.is_steerable:
        return _denied("not flying" if math.isfinite(angle) else "no angle")
    turn = math.radians(angle) * (-1.0 if direction >= 0 else 1.0)
    yaw = wrapped(state.yaw_rad + turn) if relative == 1.0 else yaw_ned(math.radians(angle))
    return _answered(vehicle.flight.go_to(Target(state.position_m, yaw_rad=yaw)))


def _reboot(vehicle: VehicleParts, request: Request) -> Answer:
    return _answered(vehicle.flight.reboot()) if request.params[0] in (1.0, 3.0) else UNSUPPORTED


def _send_message(vehicle: VehicleParts, message_id: int) -> Answer:
    message = vehicle.version() if message_id == AUTOPILOT_VERSION else vehicle.telemetry.build(message_id)
    if message is None:
        return UNSUPPORTED
    vehicle.send(message)
    return ACCEPTED


def _set_interval(vehicle: VehicleParts, request: Request) -> Answer:
    interval_us = request.params[1]
    if not math.isfinite(interval_us):
        return _denied(f"an interval of {interval_us} us")
    return ACCEPTED if vehicle.telemetry.put_interval(request.integer(0), interval_us) else UNSUPPORTED


def _get_interval(vehicle: VehicleParts, request: Request) -> Answer:
    message_id = request.integer(0)
    vehicle.send(dialect.MessageInterval(message_id & 0xFFFF, vehicle.telemetry.interval_us(message_id)))
    return ACCEPTED


HANDLERS: dict[int, Handler] = {
    Cmd.COMPONENT_ARM_DISARM: _arm,
    Cmd.NAV_TAKEOFF: _take_off,
    Cmd.NAV_LAND: _mode_setter(FlightMode.LAND),
    Cmd.NAV_RETURN_TO_LAUNCH: _mode_setter(FlightMode.RETURN),
    Cmd.NAV_LOITER_UNLIM: _mode_setter(FlightMode.HOLD),
    Cmd.DO_SET_MODE: _set_mode,
    Cmd.DO_REPOSITION: _reposition,
    Cmd.DO_PAUSE_CONTINUE: _pause,
    Cmd.DO_CHANGE_SPEED: _change_speed,
    Cmd.DO_SET_HOME: _set_home,
    Cmd.DO_FLIGHTTERMINATION: _terminate,
    Cmd.DO_SET_MISSION_CURRENT: _set_mission_current,
    Cmd.DO_FENCE_ENABLE: _enable_fence,
    Cmd.MISSION_START: _start_mission,
    Cmd.CONDITION_YAW: _turn,
    Cmd.PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    Cmd.GET_HOME_POSITION: lambda vehicle, _: _send_message(vehicle, HOME_POSITION),
    Cmd.REQUEST_MESSAGE: lambda vehicle, request: _send_message(vehicle, request.integer(0)),
    Cmd.REQUEST_AUTOPILOT_CAPABILITIES: lambda vehicle, _: _send_message(vehicle, AUTOPILOT_VERSION),
    Cmd.SET_MESSAGE_INTERVAL: _set_interval,
    Cmd.GET_MESSAGE_INTERVAL: _get_interval,
}


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
