"""One drone as a MAVLink vehicle: messages of its clients and of the drone in, messages and commands to both out.

Pure: no clock, no sockets.
"""

from typing import Any, NamedTuple

from zsim.contract.messages import Origin
from zsim.contract.run_messages import Event
from zsim.errors import without_figures
from zsim.scenario.scenario import Drone
from zsim.schema.quantities import G_M_S2
from zsim_bridges.mavlink import commands, dialect
from zsim_bridges.mavlink.commands import Request, VehicleParts, carry_out, put_custom_mode
from zsim_bridges.mavlink.dialect import WireMessage
from zsim_bridges.mavlink.drone_watch import DroneWatch
from zsim_bridges.mavlink.enums import COMPONENT_AUTOPILOT, FENCE, MISSION, Capability, Result, Severity
from zsim_bridges.mavlink.flight_control import Target
from zsim_bridges.mavlink.frame import Received
from zsim_bridges.mavlink.mission import Address, MissionProtocol, PlanItem, home_item, item_fault, item_of, place_of
from zsim_bridges.mavlink.personality import Parameters, Personality
from zsim_bridges.mavlink.telemetry import Level, Telemetry, TelemetrySource, heartbeat, mission_current
from zsim_bridges.mavlink.vehicle_flight import Flight
from zsim_bridges.mavlink.vehicle_state import VehicleState
from zsim_bridges.vehicle_links.drone_link import CommandSender

TEXT_MAX = 50  # characters of a STATUSTEXT
REFUSED_MAX = 100  # reasons remembered, so that each is reported once
DO_GO_TO = 2  # MISSION_ITEM.current: fly there now, of ArduPilot's older clients
HEARTBEAT_NS = 1_000_000_000  # ns of wall time
STICK = 1000.0  # full deflection in MANUAL_CONTROL
STICKS_UNUSED = 32767
NO_SUCH_PARAMETER = 1  # MAV_PARAM_ERROR_DOES_NOT_EXIST


class Options(NamedTuple):
    """How a vehicle presents itself: system id, autopilot, telemetry, name of this process, and its id of 64 bits."""

    system_id: int
    personality: Personality
    level: Level
    source: str
    unique_id: int


class MavlinkVehicle:
    """One drone as a MAVLink vehicle.

    Args:
        drone: of the scenario.
        origin: of W on the Earth.
        sender: of commands to the drone.
        options: how it presents itself.

    Attributes:
        name: of the drone.
        state: of the drone, to be kept up to date.
        outbox: messages for its clients, to be taken.
    """

    def __init__(self, drone: Drone, origin: Origin, sender: CommandSender, options: Options) -> None:
        self.name = drone.name
        self._options = options
        person, source = options.personality, options.source
        self.outbox: list[WireMessage] = []
        self.state = VehicleState(drone, origin)
        self._parameters = Parameters(person, drone, options.system_id)
        self.flight = Flight(source, person, self._parameters, self.state, sender, self.report)
        self._source = TelemetrySource(drone, self.state, self.flight, person)
        self._watch = DroneWatch(drone.name, source, self._source, self._parameters, self.report)
        self._telemetry = Telemetry(self._source, options.level)
        home = None if person.is_px4 else lambda: home_item(*self.state.to_global(self.state.home_or_here_m))
        self._missions = MissionProtocol(self._send, self._on_mission, home)
        self._parts = VehicleParts(
            person, self._parameters, self.state, self.flight, self._telemetry, self._send, self._version
        )
        self._heartbeat_ns: int | None = None
        self._weight_n = drone.mass_kg * G_M_S2
        self._refused: set[str] = set()

    def _send(self, message: WireMessage) -> None:
        """Send a message to all clients; `take` replaces the outbox."""
        self.outbox.append(message)

    def report(self, severity: Severity, text: str) -> None:
        """Send a text for the operator."""
        self._send(dialect.Statustext(severity, text[:TEXT_MAX]))

    def take(self) -> list[WireMessage]:
        """Return what is to be sent, and forget it."""
        taken, self.outbox = self.outbox, []
        return taken

    # From the drone

    def step(self) -> None:
        """Do what is due at a gate, after the state has been updated."""
        self._watch.look()
        self.flight.step()
        self.outbox += map(dialect.MissionItemReached, self.flight.mission.reached)
        self.flight.mission.reached.clear()
        self.outbox += self._telemetry.due(self.state.t_ns)

    def tick(self, wall_ns: int) -> None:
        """Do what is due by wall time, also while simulated time stands: heartbeats, repeated requests."""
        if self._heartbeat_ns is None or wall_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = wall_ns
            self._send(heartbeat(self._source))
        self._missions.tick(wall_ns)

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
        message: Any = received.message
        sender = received.system_id, received.component_id
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if system not in (0, self._options.system_id) or component not in (0, COMPONENT_AUTOPILOT):
            return
        if isinstance(message, dialect.MissionItem | dialect.MissionItemInt) and message.current == DO_GO_TO:
            self._go_to(message, sender)
        elif not self._missions.on_message(message, sender, wall_ns):
            self._dispatch(message, sender)

    def _dispatch(self, message: WireMessage, sender: Address) -> None:
        match message:
            case dialect.CommandLong() | dialect.CommandInt():
                result, reason = carry_out(self._parts, Request.of(message))
                self._send(dialect.CommandAck(message.command, result, 0, 0, *sender))
                if result is not Result.UNSUPPORTED:
                    self._deny(reason)
            case dialect.SetPositionTargetLocalNed():
                self._set_point(commands.from_local(message, self.state))
            case dialect.SetPositionTargetGlobalInt():
                self._set_point(commands.from_global(message, self.state))
            case dialect.SetAttitudeTarget():
                self._set_point(commands.from_attitude(message, self._weight_n))
            case dialect.ManualControl(target=target) if target in (0, self._options.system_id):
                self._steer(message)
            case dialect.SetMode():
                self._deny(put_custom_mode(self._parts, message.custom_mode).reason)
            case dialect.ParamRequestList():
                self.outbox += self._parameters.messages()
            case dialect.ParamRequestRead():
                self._send_parameter(message.param_id, message.param_index, sender)
            case dialect.ParamSet():
                self._deny(self._parameters.put(message.param_id, self._parameters.decoded(message)))
                self._send_parameter(message.param_id, -1, sender)
            case dialect.RequestDataStream():
                self._telemetry.put_stream(message.req_stream_id, message.req_message_rate * message.start_stop)
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
            case dialect.FileTransferProtocol(payload=payload):  # no files here: NAK, UnknownCommand
                seq = int.from_bytes(payload[:2], "little") + 1 & 0xFFFF
                answer = seq.to_bytes(2, "little") + bytes((0, 129, 1, payload[3], 0, 0, 0, 0, 0, 0, 7))
                self._send(dialect.FileTransferProtocol(0, *sender, answer))
            case dialect.SetGpsGlobalOrigin():
                self._deny("the origin is the scenario's")

    def _deny(self, reason: str | None) -> None:
        """Tell the operator why something was not done; no reason: it was."""
        if reason:
            self.report(Severity.WARNING, f"Denied: {reason}")

    def _set_point(self, setpoint: commands.Setpoint | commands.SetpointRefusal) -> None:
        reason = setpoint.reason if isinstance(setpoint, commands.SetpointRefusal) else self.flight.set_point(setpoint)
        if reason and without_figures(reason) not in self._refused and len(self._refused) < REFUSED_MAX:
            self._refused.add(without_figures(reason))  # a stream would fill the operator's screen
            self._deny(reason)

    def _steer(self, message: dialect.ManualControl) -> None:
        sticks = (message.x, message.y, message.z - 500, message.r)
        forward, right, up, turn = (
            0.0 if stick == STICKS_UNUSED else max(-1.0, min(1.0, stick / STICK)) for stick in sticks
        )
        speeds = self._parameters.speeds
        level, climb = speeds.horizontal_m_s, min(speeds.up_m_s, speeds.down_m_s)
        velocity = (level * forward, -level * right, 2.0 * climb * up)
        self.flight.steer_by_sticks(Target(velocity_m_s=velocity, yaw_rate_rad_s=-turn, along_heading=True))

    def _send_parameter(self, param_id: str, index: int, sender: Address) -> None:
        name = self._parameters.find(param_id, index)
        if name is None:
            self._send(dialect.ParamError(*sender, param_id, index, NO_SUCH_PARAMETER))
        else:
            self._send(self._parameters.message(name))

    def _go_to(self, message: dialect.MissionItem | dialect.MissionItemInt, sender: Address) -> None:
        item = item_of(message)
        fault = item_fault(item, MISSION)
        reason = "no place to go to" if fault else self.flight.go_to(Target(place_of(item, self.state)))
        self._deny(reason)
        self._send(dialect.MissionAck(*sender, type=fault or (1 if reason else 0)))

    def _on_mission(self, type_: int, items: list[PlanItem]) -> None:
        if type_ == MISSION:
            self.flight.mission.abort("a client replaced it", failsafe=False)
            self.flight.mission.load(items)
        elif type_ == FENCE:
            self._watch.load_fence(items)

    def _version(self) -> WireMessage:
        major, minor, patch, type_ = self._options.personality.version
        capabilities = sum(capability.value for capability in Capability)
        if not self._options.personality.is_px4:
            capabilities &= ~Capability.PARAM_ENCODE_BYTEWISE
        return dialect.AutopilotVersion(
            capabilities=capabilities,
            flight_sw_version=major << 24 | minor << 16 | patch << 8 | type_,
            uid=self._options.unique_id,
        )
