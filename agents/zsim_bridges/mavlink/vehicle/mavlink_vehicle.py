"""One drone as a MAVLink vehicle: what its clients send, what its drone reports, and what it sends to both."""

from typing import Any, NamedTuple

from zsim.contract.messages import Origin
from zsim.contract.run_messages import Event
from zsim.errors import without_figures
from zsim.scenario.scenario import Drone
from zsim.schema.quantities import G_M_S2
from zsim_bridges.mavlink.autopilot import personality as personalities
from zsim_bridges.mavlink.autopilot.enums import COMPONENT_AUTOPILOT, FENCE, MISSION, Capability, Result, Severity
from zsim_bridges.mavlink.autopilot.personality import Personality, Settings
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState
from zsim_bridges.mavlink.flight.command_output import CommandOutput
from zsim_bridges.mavlink.flight.mission import PlanItem, place_of
from zsim_bridges.mavlink.flight.position_guidance import Target
from zsim_bridges.mavlink.flight.vehicle_fence import VehicleFence
from zsim_bridges.mavlink.flight.vehicle_flight import Flight
from zsim_bridges.mavlink.telemetry import state_telemetry
from zsim_bridges.mavlink.telemetry.telemetry import Level, Telemetry
from zsim_bridges.mavlink.telemetry.telemetry_source import TelemetrySource
from zsim_bridges.mavlink.vehicle import setpoints
from zsim_bridges.mavlink.vehicle.commands import Commands, request_of
from zsim_bridges.mavlink.vehicle.drone_watch import DroneWatch
from zsim_bridges.mavlink.vehicle.mission_protocol import MissionProtocol, home_item, item_fault, item_of
from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.mavlink.wire.frame import Received
from zsim_bridges.mavlink.wire.wire_message import WireMessage
from zsim_bridges.vehicle_links.command_sender import CommandSender

TEXT_MAX = 50  # characters of a STATUSTEXT
DO_GO_TO = 2  # MISSION_ITEM.current: fly there now, of ArduPilot's older clients
HEARTBEAT_NS = 1_000_000_000  # ns of wall time
STICK = 1000.0  # of MANUAL_CONTROL, all the way
STICKS_UNUSED = 32767
NO_SUCH_PARAMETER = 1  # MAV_PARAM_ERROR_DOES_NOT_EXIST


class Options(NamedTuple):
    """How a vehicle shows itself: system id, autopilot, telemetry, name of this process, and its id of 64 bits."""

    system_id: int
    personality: Personality
    level: Level
    source: str
    unique_id: int


class MavlinkVehicle:
    """One drone as a MAVLink vehicle.

    Args:
        drone: as the scenario has it.
        origin: of W on the Earth.
        sender: of commands to the drone.
        options: how it shows itself.

    Attributes:
        name: of the drone.
        state: of the drone, to be kept up to date.
        outbox: messages for its clients, to be taken.
    """

    def __init__(self, drone: Drone, origin: Origin, sender: CommandSender, options: Options) -> None:
        self._drone, self.name = drone, drone.name
        self._options = options
        person = options.personality
        self.outbox: list[WireMessage] = []
        self.state = VehicleState(drone, origin)
        self._parameters = personalities.parameters(person, drone, options.system_id)
        self._settings = Settings(person, self._parameters)
        self._fence = VehicleFence()
        output = CommandOutput(sender)
        self.flight = Flight(options.source, person, self._settings, self.state, output, self.report)
        self._source = TelemetrySource(drone, self.state, self.flight, person)
        self._watch = DroneWatch(drone.name, options.source, self._source, self._settings, self._fence, self.report)
        self._telemetry = Telemetry(self._source, options.level)
        self._missions = self._mission_protocol()
        self._commands = self._command_table()
        self._heartbeat_ns: int | None = None
        self._weight_n = drone.mass_kg * G_M_S2
        self._refused: set[str] = set()

    def _mission_protocol(self) -> MissionProtocol:
        def home() -> PlanItem:
            return home_item(*self.state.to_global(self.state.home_m or self.state.position_m))

        is_px4 = self._options.personality.needs_stream
        return MissionProtocol(self.outbox_append, self._on_mission, None if is_px4 else home, asks_int=is_px4)

    def _command_table(self) -> Commands:
        return Commands(
            self._options.personality,
            self._settings,
            self._parameters,
            self.state,
            self.flight,
            self._telemetry,
            self.outbox_append,
            self._version,
        )

    def outbox_append(self, message: WireMessage) -> None:
        """Send a message to all clients."""
        self.outbox.append(message)

    def report(self, severity: Severity, text: str) -> None:
        """Send a text for the operator."""
        self.outbox.append(dialect.Statustext(severity, text[:TEXT_MAX]))

    def take(self) -> list[WireMessage]:
        """Return what is to be sent, and forget it."""
        taken, self.outbox = self.outbox, []
        return taken

    # From the drone

    def step(self) -> None:
        """Do what is due at a gate, after the state has been updated."""
        self._watch.look()
        self.flight.step()
        self._report_reached()
        self.outbox += self._telemetry.due(self.state.t_ns)

    def tick(self, wall_ns: int) -> None:
        """Do what wall time brings, also while simulated time stands: heartbeats, and requests once more."""
        if self._heartbeat_ns is None or wall_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = wall_ns
            self.outbox.append(state_telemetry.heartbeat(self._source))
        self._missions.tick(wall_ns)

    def _report_reached(self) -> None:
        for number in self.flight.mission.reached:
            self.outbox.append(dialect.MissionItemReached(number))
        self.flight.mission.reached.clear()

    def on_event(self, event: Event) -> None:
        """Take an event of the run."""
        self._watch.on_event(event)

    # From clients

    def on_message(self, received: Received, wall_ns: int) -> None:
        """Take a message of a client.

        Args:
            received: message and sender.
            wall_ns: wall time, of any zero.
        """
        message, sender = received.message, (received.system_id, received.component_id)
        if not self._is_for_us(message):
            return
        if isinstance(message, dialect.MissionItem | dialect.MissionItemInt) and message.current == DO_GO_TO:
            self._go_to(message, sender)
        elif not self._missions.on_message(message, sender, wall_ns):
            self._dispatch(message, sender, wall_ns)

    def _is_for_us(self, message: Any) -> bool:
        """Return whether it is addressed to this vehicle, or to all."""
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        return system in (0, self._options.system_id) and component in (0, COMPONENT_AUTOPILOT)

    def _dispatch(self, message: WireMessage, sender: tuple[int, int], wall_ns: int) -> None:
        match message:
            case dialect.CommandLong() | dialect.CommandInt():
                self._command(message, sender)
            case dialect.SetPositionTargetLocalNed():
                self._set_point(setpoints.from_local(message, self.state))
            case dialect.SetPositionTargetGlobalInt():
                self._set_point(setpoints.from_global(message, self.state))
            case dialect.SetAttitudeTarget():
                self._set_point(setpoints.from_attitude(message, self._weight_n))
            case dialect.ManualControl(target=target) if target in (0, self._options.system_id):
                self._steer(message)
            case dialect.SetMode():
                self._answer(self._commands.put_custom_mode(message.custom_mode).reason)
            case dialect.ParamRequestList():
                self.outbox += self._parameters.messages()
            case dialect.ParamRequestRead() | dialect.ParamSet():
                self._parameter(message, sender)
            case dialect.RequestDataStream():
                self._telemetry.put_stream(message.req_stream_id, message.req_message_rate * message.start_stop)
            case dialect.MissionSetCurrent():
                self._set_current(message.seq)
            case _:
                self._answer_link(message, sender, wall_ns)

    def _command(self, message: dialect.CommandLong | dialect.CommandInt, sender: tuple[int, int]) -> None:
        result, reason = self._commands.carry_out(request_of(message))
        self.outbox.append(dialect.CommandAck(message.command, result, 0, 0, *sender))
        if result is not Result.UNSUPPORTED:
            self._answer(reason)

    def _answer(self, reason: str) -> None:
        """Tell the operator why something was not done."""
        if reason:
            self.report(Severity.WARNING, f"Denied: {reason}")

    def _set_point(self, setpoint: setpoints.Setpoint | setpoints.SetpointRefusal) -> None:
        reason = setpoint.reason if isinstance(setpoint, setpoints.SetpointRefusal) else self.flight.set_point(setpoint)
        if reason and without_figures(reason) not in self._refused and len(self._refused) < 100:
            self._refused.add(without_figures(reason))  # a stream would fill the operator's screen
            self._answer(reason)

    def _steer(self, message: dialect.ManualControl) -> None:
        sticks = (message.x, message.y, message.z - 500, message.r)
        forward, right, up, turn = (
            0.0 if stick == STICKS_UNUSED else max(-1.0, min(1.0, stick / STICK)) for stick in sticks
        )
        speeds = self._settings.speeds
        level, climb = speeds.horizontal_m_s, min(speeds.up_m_s, speeds.down_m_s)
        velocity = (level * forward, -level * right, 2.0 * climb * up)
        self.flight.steer_by_sticks(Target(velocity_m_s=velocity, yaw_rate_rad_s=-turn, along_heading=True))

    def _parameter(self, message: dialect.ParamRequestRead | dialect.ParamSet, sender: tuple[int, int]) -> None:
        if isinstance(message, dialect.ParamSet):
            self._answer(self._parameters.put(message.param_id, self._parameters.decoded(message)) or "")
            index = -1
        else:
            index = message.param_index
        name = self._parameters.find(message.param_id, index)
        if name is None:
            self.outbox.append(dialect.ParamError(*sender, message.param_id, index, NO_SUCH_PARAMETER))
        else:
            self.outbox.append(self._parameters.message(name))

    def _set_current(self, number: int) -> None:
        if not self.flight.mission.set_current(number):
            self._answer(f"no item {number}")
        self.outbox.append(state_telemetry.mission_current(self._source))

    def _go_to(self, message: dialect.MissionItem | dialect.MissionItemInt, sender: tuple[int, int]) -> None:
        item = item_of(message)
        fault = item_fault(item, MISSION)
        reason = "no place to go to" if fault else self.flight.go_to(Target(place_of(item, self.state)))
        self._answer(reason or "")
        self.outbox.append(dialect.MissionAck(*sender, type=fault or (1 if reason else 0)))

    def _on_mission(self, type_: int, items: list[PlanItem]) -> None:
        if type_ == MISSION:
            self.flight.mission.abort("a client replaced it", failsafe=False)
            self.flight.mission.load(items)
        elif type_ == FENCE:
            self._fence.load(items, self.state)

    def _answer_link(self, message: WireMessage, sender: tuple[int, int], wall_ns: int) -> None:
        match message:
            case dialect.Ping(target_system=0):
                self.outbox.append(dialect.Ping(message.time_usec, message.seq, *sender))
            case dialect.Timesync(tc1=0):
                self.outbox.append(dialect.Timesync(tc1=self.state.t_ns, ts1=message.ts1))
            case dialect.AutopilotVersionRequest():
                self.outbox.append(self._version())
            case dialect.LogRequestList():
                self.outbox.append(dialect.LogEntry())
            case dialect.CommandCancel():
                self.outbox.append(dialect.CommandAck(message.command, Result.DENIED, 0, 0, *sender))
            case dialect.FileTransferProtocol():
                self._refuse_files(message, sender)
            case dialect.SetGpsGlobalOrigin():
                self._answer("the origin is the scenario's")

    def _refuse_files(self, message: dialect.FileTransferProtocol, sender: tuple[int, int]) -> None:
        """Answer a request of MAVLink FTP with NAK, UnknownCommand: there are no files here."""
        seq = int.from_bytes(message.payload[:2], "little")
        payload = (seq + 1 & 0xFFFF).to_bytes(2, "little") + bytes((0, 129, 1, message.payload[3], 0, 0, 0, 0, 0, 0, 7))
        self.outbox.append(dialect.FileTransferProtocol(0, *sender, payload))

    def _version(self) -> WireMessage:
        major, minor, patch, type_ = self._options.personality.version
        capabilities = sum(capability.value for capability in Capability)
        if not self._options.personality.needs_stream:
            capabilities &= ~Capability.PARAM_ENCODE_BYTEWISE
        return dialect.AutopilotVersion(
            capabilities=capabilities,
            flight_sw_version=major << 24 | minor << 16 | patch << 8 | type_,
            uid=self._options.unique_id,
        )
