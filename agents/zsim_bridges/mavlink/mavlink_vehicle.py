"""One drone presented as a MAVLink vehicle: handles messages from clients and the drone, and sends to both.

Has neither clock nor sockets. Sources: https://mavlink.io/en/services/command.html; for setpoints,
https://mavlink.io/en/messages/common.html#SET_POSITION_TARGET_LOCAL_NED.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from zsim.contract.messages import Origin
from zsim.contract.run_messages import Event
from zsim.errors import without_numbers
from zsim.math import elementary as el
from zsim.math.frames import turned_about_up
from zsim.math.rotation import Vector
from zsim.scenario.scenario import Drone, Piloted
from zsim.schema.quantities import G_M_S2
from zsim_agents.references.cruise import Course
from zsim_agents.references.flight import limits_of
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import (
    DEGREES,
    AttitudeMask,
    Cmd,
    MavFrame,
    Received,
    Result,
    Severity,
    TypeMask,
    WireMessage,
    from_int,
    ned,
    yaw_ned,
)
from zsim_bridges.mavlink.mission import (
    ABSOLUTE,
    FRAMES,
    LOCAL,
    RELATIVE,
    Address,
    MissionProtocol,
    PlanItem,
    item_fault,
    item_of,
    position_of,
)
from zsim_bridges.mavlink.personality import FenceAction, FlightMode, Parameters, Personality, Setting, px4_mode
from zsim_bridges.mavlink.telemetry import (
    BREACH_ALTITUDE,
    BREACH_BOUNDARY,
    BREACH_NONE,
    Level,
    Telemetry,
    TelemetrySource,
    heartbeat,
    mission_current,
)
from zsim_bridges.mavlink.vehicle_flight import Flight, Report
from zsim_bridges.mavlink.vehicle_state import NO_POSITION, Target, TiltTarget, VehicleState, is_valid_position
from zsim_bridges.vehicle_links.drone_link import CommandSender

HEADING_FRAMES = (MavFrame.BODY_NED, MavFrame.BODY_OFFSET_NED, MavFrame.BODY_FRD)
OFFSET_FRAMES = (MavFrame.LOCAL_OFFSET_NED, *HEADING_FRAMES)
HOVER_THRUST = 0.5  # thrust of a setpoint, in [0, 1], that balances the weight; PX4's MPC_THR_HOVER
YAW_RATE_MAX_RAD_S = math.radians(60.0)  # MPC_YAWRAUTO_MAX
SPEED_MAX_M_S = 1e3  # m/s; faster setpoints are refused, since no vehicle here flies that fast
Setpoint = Target | TiltTarget
TEXT_MAX = 50  # characters in a STATUSTEXT
REFUSED_MAX = 100  # refusal reasons remembered, so that each is reported only once
GUIDED_ITEM = 2  # value of MISSION_ITEM.current with which older ArduPilot clients send the vehicle to an item at once
HEARTBEAT_NS = 1_000_000_000  # heartbeat period [ns of wall time]
STICK_FULL_SCALE = 1000.0  # full deflection in MANUAL_CONTROL
STICK_UNUSED = 32767
NO_SUCH_PARAMETER = 1  # MAV_PARAM_ERROR_DOES_NOT_EXIST
AUTOPILOT_VERSION = dialect.LAYOUTS[dialect.AutopilotVersion].id
HOME_POSITION = dialect.LAYOUTS[dialect.HomePosition].id
SPEED_SETTINGS: dict[int, Setting] = {2: "up_m_s", 3: "down_m_s"}  # by SPEED_TYPE; other types set the horizontal speed
FAULT_SUFFIXES = {"fault": "", "fault_end": " is over", "fault_clear": " cleared"}
FENCE_MODES = {
    FenceAction.HOLD: FlightMode.HOLD,
    FenceAction.RETURN: FlightMode.RETURN,
    FenceAction.LAND: FlightMode.LAND,
}
Point = tuple[float, float]


class Options(NamedTuple):
    """The options of a vehicle: system id, autopilot, telemetry level, name of this process, and 64-bit unique id."""

    system_id: int
    personality: Personality
    level: Level
    source: str
    unique_id: int


class Request(NamedTuple):
    """A command with its seven parameters, the fifth and sixth in degrees or metres, and the frame of its position."""

    command: int
    params: tuple[float, float, float, float, float, float, float]
    frame: int

    @classmethod
    def from_message(cls, message: dialect.CommandLong | dialect.CommandInt) -> "Request":
        m, frame = message, 0
        position: tuple[float, float, float]
        if isinstance(m, dialect.CommandLong):
            position = m.param5, m.param6, m.param7
        else:
            frame, unit = m.frame, dialect.LOCAL_M if m.frame in LOCAL else DEGREES
            position = from_int(m.x, unit), from_int(m.y, unit), m.z
        return cls(m.command, (m.param1, m.param2, m.param3, m.param4, *position), frame)

    def integer(self, index: int) -> int:
        """Return parameter `index` (from 0) truncated to an integer; -1 if not finite, negative, or 2**31 or more."""
        value = self.params[index]
        return int(value) if math.isfinite(value) and 0 <= value < 2**31 else -1


class MavlinkVehicle:
    """One drone presented as a MAVLink vehicle.

    Attributes:
        state: the drone's state, which the caller keeps up to date.
        monitor: the drone's monitor, which the caller notifies of events.
        outbox: messages for the clients, until `take` returns them.
    """

    def __init__(self, drone: Drone, origin: Origin, sender: CommandSender, options: Options) -> None:
        self.name = drone.name
        self._options = options
        self._personality = personality = options.personality
        source = options.source
        self.outbox: list[WireMessage] = []
        self.state = VehicleState(drone, origin)
        self._parameters = Parameters(personality, drone, options.system_id)
        limits = limits_of(drone, G_M_S2)
        limits = limits._replace(yaw_rate_rad_s=min(limits.yaw_rate_rad_s, YAW_RATE_MAX_RAD_S))
        course = Course(limits, drone.reference or Piloted())
        self.flight = Flight(source, personality, self._parameters, self.state, sender, course, self.report)
        self._source = TelemetrySource(drone, self.state, self.flight, personality)
        self.monitor = DroneMonitor(drone.name, source, self._source, self._parameters, self.report)
        self._telemetry = Telemetry(self._source, options.level)
        self._missions = MissionProtocol(self._send, self._on_mission, None if personality.is_px4 else self._home_item)
        self._heartbeat_ns: int | None = None
        self._weight_n = drone.mass_kg * G_M_S2
        self._refused: set[str] = set()

    def _home_item(self) -> PlanItem:
        position = self.state.to_global(self.state.home_or_current_m)
        return PlanItem(MavFrame.GLOBAL, Cmd.NAV_WAYPOINT, (0.0, 0.0, 0.0, 0.0), *position)

    def _send(self, message: WireMessage) -> None:
        """Send a message to all clients; reads `outbox` on each call, since `take` replaces the list."""
        self.outbox.append(message)

    def report(self, severity: dialect.Severity, text: str) -> None:
        self._send(dialect.Statustext(severity, text[:TEXT_MAX]))

    def take(self) -> list[WireMessage]:
        messages, self.outbox = self.outbox, []
        return messages

    # From the drone

    def step(self) -> None:
        """Carry out what is due at a gate, once the state has been updated."""
        self.monitor.check()
        self.flight.step()
        self.outbox += map(dialect.MissionItemReached, self.flight.mission.reached)
        self.flight.mission.reached.clear()
        self.outbox += self._telemetry.due(self.state.t_ns)

    def tick(self, wall_ns: int) -> None:
        """Send what is due by wall time, even while simulated time is paused: heartbeats and repeated requests."""
        if self._heartbeat_ns is None or wall_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = wall_ns
            self._send(heartbeat(self._source))
        self._missions.tick(wall_ns)

    # From clients

    def on_message(self, received: Received, wall_ns: int) -> None:
        """Handle a client's message; `wall_ns` is wall time from an arbitrary epoch."""
        message: Any = received.message
        sender = received.system_id, received.component_id
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if system not in (0, self._options.system_id) or component not in (0, dialect.COMPONENT_AUTOPILOT):
            return
        if isinstance(message, dialect.MissionItem | dialect.MissionItemInt) and message.current == GUIDED_ITEM:
            self._go_to(message, sender)
        elif not self._missions.on_message(message, sender, wall_ns):
            self._dispatch(message, sender)

    def _dispatch(self, message: WireMessage, sender: Address) -> None:
        match message:
            case dialect.CommandLong() | dialect.CommandInt():
                refusal = self._carry_out(Request.from_message(message))
                result = Result.DENIED if isinstance(refusal, str) else refusal or Result.ACCEPTED
                self._send(dialect.CommandAck(message.command, result, 0, 0, *sender))
                self._deny(refusal if isinstance(refusal, str) else None)
            case dialect.SetPositionTargetLocalNed():
                self._set_point(from_local(message, self.state))
            case dialect.SetPositionTargetGlobalInt():
                self._set_point(from_global(message, self.state))
            case dialect.SetAttitudeTarget():
                self._set_point(from_attitude(message, self._weight_n))
            case dialect.ManualControl(target=target) if target in (0, self._options.system_id):
                self._steer(message)
            case dialect.SetMode():
                mode = self._personality.mode_of(message.custom_mode)
                self._deny(self.flight.set_mode(mode) if mode else f"no mode {message.custom_mode:#x}")
            case dialect.ParamRequestList():
                self.outbox += self._parameters.messages()
            case dialect.ParamRequestRead():
                self._send_parameter(message.param_id, message.param_index, sender)
            case dialect.ParamSet():
                self._deny(self._parameters.put(message.param_id, self._parameters.decode_value(message)))
                self._send_parameter(message.param_id, -1, sender)
            case dialect.RequestDataStream():
                self._telemetry.set_stream(message.req_stream_id, message.req_message_rate * message.start_stop)
            case dialect.MissionSetCurrent():
                if not self.flight.mission.set_current(message.seq):
                    self._deny(f"no item {message.seq}")
                self._send(mission_current(self._source))
            case dialect.Ping(target_system=0):
                self._send(dialect.Ping(message.time_usec, message.seq, *sender))
            case dialect.Timesync(tc1=0):
                self._send(dialect.Timesync(tc1=self.state.t_ns, ts1=message.ts1))
            case dialect.AutopilotVersionRequest():
                self._send(self._version())
            case dialect.LogRequestList():
                self._send(dialect.LogEntry())
            case dialect.CommandCancel():
                self._send(dialect.CommandAck(message.command, Result.DENIED, 0, 0, *sender))
            case dialect.FileTransferProtocol(payload=payload):  # no files are offered: answer NAK, UnknownCommand
                seq = int.from_bytes(payload[:2], "little") + 1 & 0xFFFF
                answer = seq.to_bytes(2, "little") + bytes((0, 129, 1, payload[3], 0, 0, 0, 0, 0, 0, 7))
                self._send(dialect.FileTransferProtocol(0, *sender, answer))
            case dialect.SetGpsGlobalOrigin():
                self._deny("the origin is the scenario's")

    def _carry_out(self, request: Request) -> str | Result | None:
        """Carry out a command; return None, the reason for a refusal, or UNSUPPORTED."""
        flight, state, parameters = self.flight, self.state, self._parameters
        first, second = request.params[:2]
        match request.command:
            case Cmd.COMPONENT_ARM_DISARM:
                if first not in (0.0, 1.0):
                    return f"param1 is {first:g}; must be 0 or 1"
                arm = flight.arm if first else flight.disarm
                return arm(second == dialect.FORCE)
            case Cmd.NAV_TAKEOFF:
                return self._take_off(request.params[6])
            case Cmd.NAV_LAND:
                return flight.set_mode(FlightMode.LAND)
            case Cmd.NAV_RETURN_TO_LAUNCH:
                return flight.set_mode(FlightMode.RETURN)
            case Cmd.NAV_LOITER_UNLIM:
                return flight.set_mode(FlightMode.HOLD)
            case Cmd.DO_SET_MODE:
                if not int(first if math.isfinite(first) else 0) & 1:
                    return "a mode must be a custom mode"
                main, sub = request.integer(1), request.integer(2)
                mode = self._personality.mode_of(px4_mode(main, sub) if self._personality.is_px4 else main)
                return Result.UNSUPPORTED if mode is None else flight.set_mode(mode)
            case Cmd.DO_REPOSITION:
                return self._reposition(request)
            case Cmd.DO_PAUSE_CONTINUE:
                return flight.set_mode(FlightMode.HOLD) if first == 0.0 else flight.start_mission()
            case Cmd.DO_CHANGE_SPEED:
                if not math.isfinite(second) or second <= 0.0:
                    return f"invalid speed {second} m/s"
                return parameters.put_setting(SPEED_SETTINGS.get(request.integer(0), "speed_m_s"), second)
            case Cmd.DO_SET_HOME:
                position = state.position_m if first == 1.0 else _requested_position(state, request)
                if position is None:
                    return "no valid position for home"
                state.home_m = position
                return self._send_message(HOME_POSITION)
            case Cmd.DO_FLIGHTTERMINATION:
                if first > 0.5:
                    flight.terminate()
                return None
            case Cmd.DO_SET_MISSION_CURRENT:
                return None if flight.mission.set_current(request.integer(0)) else "no such item"
            case Cmd.DO_FENCE_ENABLE if "FENCE_ENABLE" in parameters.values:
                return parameters.put("FENCE_ENABLE", float(first == 1.0))
            case Cmd.MISSION_START:
                return flight.start_mission(request.integer(0) or None)
            case Cmd.CONDITION_YAW:
                return self._turn(request)
            case Cmd.PREFLIGHT_REBOOT_SHUTDOWN if first in (1.0, 3.0):
                return flight.reboot()
            case Cmd.GET_HOME_POSITION:
                return self._send_message(HOME_POSITION)
            case Cmd.REQUEST_MESSAGE:
                return self._send_message(request.integer(0))
            case Cmd.REQUEST_AUTOPILOT_CAPABILITIES:
                return self._send_message(AUTOPILOT_VERSION)
            case Cmd.SET_MESSAGE_INTERVAL:
                if not math.isfinite(second):
                    return f"invalid interval {second} us"
                is_sent = self._telemetry.set_interval(request.integer(0), second)
                return None if is_sent else Result.UNSUPPORTED
            case Cmd.GET_MESSAGE_INTERVAL:
                message_id = request.integer(0)
                self._send(dialect.MessageInterval(message_id & 0xFFFF, self._telemetry.interval_us(message_id)))
                return None
            case _:
                return Result.UNSUPPORTED

    def _take_off(self, altitude_m: float) -> str | None:
        state, is_px4 = self.state, self._personality.is_px4
        if not math.isfinite(altitude_m) or (is_px4 and altitude_m == 0.0):
            altitude_m = self._parameters["takeoff_altitude_m"]
        elif is_px4:  # PX4's altitude is above sea level
            altitude_m -= state.to_global(state.home_or_current_m)[2]
        if not 0.0 < altitude_m <= 10_000.0:
            return f"invalid altitude {altitude_m:.1f} m above home"
        return self.flight.take_off(altitude_m)

    def _reposition(self, request: Request) -> str | None:
        speed_m_s, _, _, yaw = request.params[:4]
        position = _requested_position(self.state, request)
        if position is None:
            return "no valid target position"
        yaw_rad = yaw_ned(yaw) if math.isfinite(yaw) else None
        speed = speed_m_s if math.isfinite(speed_m_s) and speed_m_s > 0 else None
        return self.flight.go_to(Target(position, yaw_rad=yaw_rad, speed_m_s=speed))

    def _turn(self, request: Request) -> str | None:
        """Turn to a heading [deg from north], or by an angle in a given direction, and hold the position."""
        angle, _, direction, relative = request.params[:4]
        state = self.state
        if not math.isfinite(angle) or not state.is_steerable:
            return "not flying" if math.isfinite(angle) else "no angle"
        turn = math.radians(angle) * (-1.0 if direction >= 0 else 1.0)
        yaw = dialect.wrapped(state.yaw_rad + turn) if relative == 1.0 else yaw_ned(math.radians(angle))
        return self.flight.go_to(Target(state.position_m, yaw_rad=yaw))

    def _send_message(self, message_id: int) -> Result | None:
        message = self._version() if message_id == AUTOPILOT_VERSION else self._telemetry.build(message_id)
        if message is None:
            return Result.UNSUPPORTED
        self._send(message)
        return None

    def _deny(self, reason: str | None) -> None:
        """Report the reason for a refusal to the operator, if there is one."""
        if reason:
            self.report(dialect.Severity.WARNING, f"Denied: {reason}")

    def _set_point(self, setpoint: Setpoint | str) -> None:
        reason = setpoint if isinstance(setpoint, str) else self.flight.set_point(setpoint)
        if reason and without_numbers(reason) not in self._refused and len(self._refused) < REFUSED_MAX:
            self._refused.add(without_numbers(reason))  # a stream of refusals would flood the operator's screen
            self._deny(reason)

    def _steer(self, message: dialect.ManualControl) -> None:
        sticks = (message.x, message.y, message.z - 500, message.r)
        forward, right, up, turn = (
            0.0 if stick == STICK_UNUSED else max(-1.0, min(1.0, stick / STICK_FULL_SCALE)) for stick in sticks
        )
        speeds = self._parameters.speeds
        horizontal, climb = speeds.horizontal_m_s, min(speeds.up_m_s, speeds.down_m_s)
        velocity = (horizontal * forward, -horizontal * right, 2.0 * climb * up)
        self.flight.steer_by_sticks(Target(velocity_m_s=velocity, yaw_rate_rad_s=-turn, along_heading=True))

    def _send_parameter(self, param_id: str, index: int, sender: Address) -> None:
        name = self._parameters.find(param_id, index)
        if name is None:
            self._send(dialect.ParamError(*sender, param_id, index, NO_SUCH_PARAMETER))
        else:
            self._send(self._parameters.message(name))

    def _go_to(self, message: dialect.MissionItem | dialect.MissionItemInt, sender: Address) -> None:
        item = item_of(message)
        fault = item_fault(item, dialect.MISSION)
        reason = "no valid target position" if fault else self.flight.go_to(Target(position_of(item, self.state)))
        self._deny(reason)
        self._send(dialect.MissionAck(*sender, type=fault or (1 if reason else 0)))

    def _on_mission(self, type_: int, items: list[PlanItem]) -> None:
        if type_ == dialect.MISSION:
            self.flight.mission.abort("a client replaced it", failsafe=False)
            self.flight.mission.load(items)
        elif type_ == dialect.FENCE:
            self.monitor.load_fence(items)

    def _version(self) -> WireMessage:
        major, minor, patch, type_ = self._personality.version
        capabilities = sum(capability.value for capability in dialect.Capability)
        if not self._personality.is_px4:
            capabilities &= ~dialect.Capability.PARAM_ENCODE_BYTEWISE
        return dialect.AutopilotVersion(
            capabilities=capabilities,
            flight_sw_version=major << 24 | minor << 16 | patch << 8 | type_,
            uid=self._options.unique_id,
        )


def _requested_position(state: VehicleState, request: Request) -> Vector | None:
    """Return a command's position in W, with the vehicle's own for non-finite coordinates; None if it is invalid."""
    params, frame = request.params, request.frame
    item = PlanItem(frame, request.command, params[:4], *params[4:])
    if frame not in FRAMES or (abs(item.x) > 180.0 and frame not in LOCAL):
        return None
    current = state.position_m
    if not math.isfinite(item.z):
        if frame in LOCAL:
            item = item._replace(z=-current[2] if frame == MavFrame.LOCAL_NED else current[2])
        else:
            item = item._replace(z=state.to_global(current)[2], frame=ABSOLUTE[0])
    position = position_of(item, state)
    return position if is_valid_position(position) else None


def from_local(message: dialect.SetPositionTargetLocalNed, state: VehicleState) -> Setpoint | str:
    frame, offset = message.coordinate_frame, (message.x, message.y, message.z)
    if frame == MavFrame.LOCAL_NED:
        return _target(message, ned(offset), False, state)
    if frame not in OFFSET_FRAMES:
        return f"unsupported frame {frame} of a local setpoint"
    along_heading = frame in HEADING_FRAMES
    x, y, z = turned_about_up(dialect.frd(offset), state.yaw_rad) if along_heading else ned(offset)
    current_x, current_y, current_z = state.position_m
    return _target(message, (current_x + x, current_y + y, current_z + z), along_heading, state)


def from_global(message: dialect.SetPositionTargetGlobalInt, state: VehicleState) -> Setpoint | str:
    if message.coordinate_frame not in (*ABSOLUTE, *RELATIVE):
        return f"unsupported frame {message.coordinate_frame} of a global setpoint"
    current_global = state.to_global(state.position_m)
    height_m = message.alt
    if message.coordinate_frame in RELATIVE:
        height_m += state.to_global(state.home_or_current_m)[2]
    requested = from_int(message.lat_int, DEGREES), from_int(message.lon_int, DEGREES), height_m
    resolved = [
        value if math.isfinite(value) else current for value, current in zip(requested, current_global, strict=True)
    ]
    x, y, z = state.to_local(resolved[0], resolved[1], resolved[2])
    latitude_deg, longitude_deg, _ = requested
    horizontal = x if math.isfinite(longitude_deg) else math.nan, y if math.isfinite(latitude_deg) else math.nan
    return _target(message, (*horizontal, z if math.isfinite(height_m) else math.nan), False, state)


def _target(
    message: dialect.SetPositionTargetLocalNed | dialect.SetPositionTargetGlobalInt,
    position_m: Vector,
    along_heading: bool,
    state: VehicleState,
) -> Setpoint | str:
    mask = TypeMask(message.type_mask)
    bits = (TypeMask.Y, TypeMask.X, TypeMask.Z)  # x in W is y in MAVLink
    x, y, z = (None if mask & bit or not math.isfinite(p) else p for p, bit in zip(position_m, bits, strict=True))
    position = x, y, z
    bits = (TypeMask.VX, TypeMask.VY, TypeMask.VZ)
    velocity = (message.vx, message.vy, message.vz)
    given_axes = [not mask & bit and math.isfinite(v) for v, bit in zip(velocity, bits, strict=True)]
    if position == NO_POSITION and not any(given_axes):
        return "no position or velocity in a setpoint"
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    if any(given_axes):
        vx, vy, vz = (v if is_axis_given else 0.0 for v, is_axis_given in zip(velocity, given_axes, strict=True))
        velocity_m_s = dialect.frd((vx, vy, vz)) if along_heading else ned((vx, vy, vz))
    if not is_valid_position(position) or not all(abs(v) < SPEED_MAX_M_S for v in velocity_m_s):
        return "a setpoint is out of bounds"
    is_along_heading = along_heading and position == NO_POSITION
    if along_heading and not is_along_heading and any(given_axes):
        velocity_m_s = turned_about_up(velocity_m_s, state.yaw_rad)
    yaw, yaw_rate = _yaw(mask, message.yaw, message.yaw_rate, message.coordinate_frame, state)
    return Target(position, velocity_m_s, yaw, yaw_rate, is_along_heading)


def _yaw(mask: TypeMask, yaw: float, yaw_rate: float, frame: int, state: VehicleState) -> tuple[float | None, float]:
    """Return the yaw counter-clockwise from east [rad], None if it is not given, and the yaw rate [rad/s]."""
    if mask & TypeMask.YAW or not math.isfinite(yaw) or abs(yaw) > 1e3:
        is_given = not mask & TypeMask.YAW_RATE and math.isfinite(yaw_rate)
        return None, -max(-100.0, min(100.0, yaw_rate)) if is_given else 0.0
    if frame in (MavFrame.BODY_OFFSET_NED, MavFrame.BODY_FRD):
        return dialect.wrapped(state.yaw_rad - yaw), 0.0
    return yaw_ned(yaw), 0.0


def from_attitude(message: dialect.SetAttitudeTarget, weight_n: float) -> Setpoint | str:
    """Return the target of a SET_ATTITUDE_TARGET, or the reason for a refusal; half thrust balances the weight."""
    mask = AttitudeMask(message.type_mask & 0xFF)
    values = (*message.q, message.thrust, message.body_yaw_rate)
    if mask & AttitudeMask.ATTITUDE:
        return "body rates need an attitude too"
    length = el.length(message.q)
    if not all(map(math.isfinite, values)) or not 0.5 < length < 2.0:
        return "invalid attitude, thrust or yaw rate"
    w, x, y, z = dialect.attitude_ned((message.q[0], message.q[1], message.q[2], message.q[3]))
    q_WB = w / length, x / length, y / length, z / length
    thrust = HOVER_THRUST if mask & AttitudeMask.THRUST else max(0.0, min(1.0, message.thrust))
    rate = 0.0 if mask & AttitudeMask.YAW_RATE else -max(-10.0, min(10.0, message.body_yaw_rate))
    return TiltTarget(q_WB, weight_n * thrust / HOVER_THRUST, rate)


class DroneMonitor:
    """Monitors one drone, reports changes, and acts on breaches of its fence.

    It reports sensor losses, a low battery, faults, refused commands and collisions. The fence consists of a circle
    and a ceiling set by parameters, and of circles and polygons that clients upload, all in W. Source of fence items:
    https://mavlink.io/en/services/mission.html#fence.

    Args:
        source: name of this process; refusals of its commands are reported.
        telemetry_source: state and flight of the drone; fence breaches are recorded in it.
    """

    def __init__(
        self, drone: str, source: str, telemetry_source: TelemetrySource, parameters: Parameters, report: Report
    ) -> None:
        self._drone = drone
        self._source_name = source
        self._telemetry_source = telemetry_source
        self._parameters = parameters
        self._report = report
        self._shapes: list[Circle | Polygon] = []
        self._failed: set[str] = set()
        self._was_low = False

    def load_fence(self, items: Sequence[PlanItem]) -> None:
        self._shapes = fence_shapes(items, self._telemetry_source.state)

    def on_event(self, event: Event) -> None:
        """Report an event that concerns the drone."""
        if event.kind in FAULT_SUFFIXES and event.data.get("target") == self._drone:
            severity = Severity.CRITICAL if event.kind == "fault" else Severity.NOTICE
            self._report(severity, f"Fault {event.data.get('kind')}{FAULT_SUFFIXES[event.kind]}")
        elif event.kind == "collision" and self._drone in (pair := (event.subject, event.data.get("other"))):
            self._report(Severity.CRITICAL, f"Collision with {pair[1] if pair[0] == self._drone else pair[0]}")
        elif event.kind == "refused" and event.source == self._source_name and f"/{self._drone}/" in event.subject:
            is_overtaken = not event.subject.endswith("/mode") and self._telemetry_source.flight.target is None
            if not is_overtaken:  # a setpoint refused because a landing had begun is not worth reporting
                self._report(Severity.WARNING, f"Refused: {event.data.get('reason', event.text)}")

    def check(self) -> None:
        """Report what has changed since the last gate, and act on a breach of the fence."""
        state = self._telemetry_source.state
        failed = set(state.failed_sensors())
        for name in sorted(failed - self._failed):
            self._report(Severity.CRITICAL, f"{name.upper()} lost")
        for name in sorted(self._failed - failed):
            self._report(Severity.INFO, f"{name.upper()} back")
        self._failed = failed
        if state.is_battery_low and not self._was_low:
            self._report(Severity.CRITICAL, f"Low battery: {self._telemetry_source.battery_percent:.0f} %")
        self._was_low = state.is_battery_low
        telemetry_source, action = self._telemetry_source, self._parameters.fence_action
        if action is FenceAction.NONE or not state.is_steerable:
            telemetry_source.breach = BREACH_NONE
            return
        breach = self._breach(state.position_m)
        if breach and not telemetry_source.breach:
            telemetry_source.breaches += 1
            telemetry_source.breach_ns = state.t_ns
            self._report(Severity.CRITICAL, f"Geofence breached: {action.name.lower()}")
            if action in FENCE_MODES and not telemetry_source.flight.foreign_commander:
                telemetry_source.flight.mission.abort("it left its geofence", failsafe=True)
                telemetry_source.flight.set_mode(FENCE_MODES[action])
        telemetry_source.breach = breach

    def _breach(self, position_m: Vector) -> int:
        (x, y, z), (home_x, home_y, home_z) = position_m, self._telemetry_source.state.home_or_current_m
        ceiling_m, radius_m = self._parameters["fence_altitude_m"], self._parameters["fence_radius_m"]
        if ceiling_m > 0 and z - home_z > ceiling_m:
            return BREACH_ALTITUDE
        is_within_radius = radius_m <= 0 or math.hypot(x - home_x, y - home_y) <= radius_m
        return (
            BREACH_NONE if is_within_radius and all(shape.allows(x, y) for shape in self._shapes) else BREACH_BOUNDARY
        )


class Circle(NamedTuple):
    """A circle of the fence, which must not be left (if `inside`) or not be entered."""

    centre_m: Point
    radius_m: float
    inside: bool

    def allows(self, x: float, y: float) -> bool:
        return (math.hypot(x - self.centre_m[0], y - self.centre_m[1]) <= self.radius_m) == self.inside


class Polygon(NamedTuple):
    """A polygon of the fence, which must not be left (if `inside`) or not be entered."""

    corners_m: tuple[Point, ...]
    inside: bool

    def allows(self, x: float, y: float) -> bool:
        """Return whether a point is permitted, by the parity of the edges crossed to the east of it."""
        is_inside = False
        for (x1, y1), (x2, y2) in zip(self.corners_m, (*self.corners_m[1:], self.corners_m[0]), strict=True):
            if (y1 > y) != (y2 > y) and x < x1 + (x2 - x1) * (y - y1) / (y2 - y1):
                is_inside = not is_inside
        return is_inside == self.inside


def fence_shapes(items: Sequence[PlanItem], state: VehicleState) -> list[Circle | Polygon]:
    """Return the fence shapes that uploaded items describe; a polygon has one item per corner."""
    shapes: list[Circle | Polygon] = []
    corners: list[Point] = []
    for item in items:
        x, y, _ = position_of(item, state)
        if item.command in (Cmd.FENCE_CIRCLE_INCLUSION, Cmd.FENCE_CIRCLE_EXCLUSION):
            shapes.append(Circle((x, y), item.params[0], item.command == Cmd.FENCE_CIRCLE_INCLUSION))
        elif item.command in (Cmd.FENCE_POLYGON_INCLUSION, Cmd.FENCE_POLYGON_EXCLUSION):
            corners.append((x, y))
            if len(corners) >= item.params[0]:
                shapes.append(Polygon(tuple(corners), item.command == Cmd.FENCE_POLYGON_INCLUSION))
                corners = []
    return shapes
