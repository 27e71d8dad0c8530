"""The session with one MAVLink vehicle: requests, monitors and decodes its telemetry, and makes it carry out demands.

No I/O. Sources: https://mavlink.io/en/services/ (heartbeat, command, timesync, message intervals); PX4
px4_custom_mode.h; ArduPilot Copter mode.h; https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_MODE.
"""

import math
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from zsim.contract.flight_messages import DroneState
from zsim.contract.messages import Info
from zsim.math import elementary as el
from zsim.math.frames import geodetic_to_enu, heading, turned_about_up
from zsim.math.rotation import LEVEL, Vector
from zsim.scenario.scenario import Scenario
from zsim.schema.quantities import G_M_S2
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import (
    Autopilot,
    Cmd,
    LandedState,
    Link,
    Parser,
    Received,
    Signing,
    TypeMask,
    frd,
    ned,
)
from zsim_bridges.mavlink.personality import COPTER_MODES, PX4_MODES, FlightMode
from zsim_bridges.vehicle_links.driver import DriverOptions
from zsim_bridges.vehicle_links.vehicle_session import (
    ZERO_VECTOR,
    Action,
    AircraftPose,
    AircraftReadings,
    AircraftState,
    ClockOffset,
    Demand,
    LinkQuality,
    UdpChannel,
    VehicleSession,
)

SYSTEM, COMPONENT = 245, 191  # ids of this driver; the component is MAV_COMP_ID_ONBOARD_COMPUTER
HEARTBEAT_NS = 1_000_000_000  # https://mavlink.io/en/services/heartbeat.html
TIMESYNC_NS = 500_000_000  # design choice: ten round trips within the window of the clock offset
REQUEST_NS = 3_000_000_000  # time after which a missing stream is requested again: three periods of the slowest one
SENDERS_REPORTED_MAX = 256  # other senders reported, each only once
CLIMBED_FRACTION = 0.85  # fraction of the take-off height at which the climb ends; reported heights are inexact
REPEAT_NS = 1_000_000_000  # period of repeated commands; ample, since an autopilot answers within about 0.1 s
KILL_REPEAT_NS = 200_000_000  # shorter than REPEAT_NS, since this is the one command that must not be lost
SETPOINT_NS = 40_000_000  # 25 Hz; PX4 treats setpoints at less than 2 Hz as lost
CHANGE_INTERVAL_NS = 15_000_000  # minimum spacing of changed setpoints; less than a gate, so that each gate's is sent
STREAM_DURATION_NS = 600_000_000  # duration of the stream before OFFBOARD, which PX4 refuses without setpoints
VELOCITY_AND_YAW_RATE = 0xFFF & ~(TypeMask.VX | TypeMask.VY | TypeMask.VZ | TypeMask.FORCE | TypeMask.YAW_RATE)
# First six parameters of NAV_LAND and NAV_TAKEOFF: no position given
NO_POSITION = (0.0, 0.0, 0.0, math.nan, math.nan, math.nan)
_RATES_HZ: dict[type, float] = {
    dialect.AttitudeQuaternion: 50,
    dialect.LocalPositionNed: 50,
    dialect.GpsRawInt: 5,
    dialect.GlobalPositionInt: 5,
    dialect.OpticalFlow: 15,
    dialect.DistanceSensor: 25,
    dialect.ExtendedSysState: 10,
    dialect.SysStatus: 1,
}
ACCEL_GYRO, MAG, PRESSURE = 0x003F, 0x01C0, 0x0200  # HIGHRES_IMU_UPDATED_FLAGS
DOWNWARD = 25  # MAV_SENSOR_ROTATION_PITCH_270
FLOW_NS = 66_000_000  # 15 Hz, as on the AR.Drone; period of the estimated velocities that replace missing flow readings
FLOW_LOST_NS = 1_000_000_000  # time without flow after which the estimated velocity replaces it: 15 periods
UT_PER_GAUSS, PA_PER_HPA = 100.0, 100.0
DOP_M = 2.0  # position error per unit of HDOP [m], typical of single-frequency receivers


class ExternalControl(NamedTuple):
    """How to control an autopilot's velocity externally: the mode for it, and how to enter this mode.

    Attributes:
        custom_mode: the mode, as in heartbeats; parameters: those of DO_SET_MODE for it, from the second on.
        takes_off: whether the vehicle takes off in this mode, rather than in a separate one.
        own: further modes in which this driver remains in control, and from which it may return to `custom_mode`.
        landing: mode in which the vehicle lands, whether demanded by this driver, by the pilot, or by its own failsafe.
        rates_hz: requested rates, by telemetry message.
    """

    custom_mode: int
    parameters: tuple[float, ...]
    takes_off: bool
    own: tuple[int, ...]
    landing: int
    rates_hz: dict[type, float]


CONTROL = {
    Autopilot.PX4: ExternalControl(
        PX4_MODES[FlightMode.OFFBOARD],
        (6, 0),
        takes_off=False,
        own=(PX4_MODES[FlightMode.TAKEOFF], PX4_MODES[FlightMode.HOLD]),  # PX4 also holds when setpoints stop
        landing=PX4_MODES[FlightMode.LAND],
        rates_hz={**_RATES_HZ, dialect.HighresImu: 200.0},
    ),
    Autopilot.ARDUPILOTMEGA: ExternalControl(  # ArduPilot has no HIGHRES_IMU
        COPTER_MODES[FlightMode.OFFBOARD],
        (4,),
        takes_off=True,
        own=(),
        landing=COPTER_MODES[FlightMode.LAND],
        rates_hz={**_RATES_HZ, dialect.ScaledImu: 200.0, dialect.ScaledPressure: 25.0},
    ),
}


class AutopilotSession(VehicleSession):
    """A session with one vehicle.

    Args:
        origin: origin of W: latitude, longitude [deg], height [m].
        system: the vehicle's system id; 0 for the first autopilot that appears.
        local_origin_m: origin of the vehicle's local frame [m; W]; None for the origin that it reports.
        key: signing key for both directions; None for unsigned messages.
        unix_s: returns the wall time [s since 1970] for signatures.
    """

    def __init__(
        self,
        channel: UdpChannel,
        origin: tuple[float, float, float],
        takeoff_height_m: float,
        system: int = 0,
        local_origin_m: Vector | None = None,
        key: bytes | None = None,
        unix_s: Callable[[], float] = time.time,
    ) -> None:
        self._telemetry = TelemetryReadings(origin, local_origin_m)
        super().__init__((channel,), self._telemetry, modulus=256)
        self._system = system
        self._takeoff_height_m = takeoff_height_m
        self._sequence = DemandSequence(takeoff_height_m)
        self._signing = Signing(key) if key else None
        self._unix_s = unix_s
        self._link, self._parser = Link(SYSTEM, COMPONENT, self._signing), Parser(self._signing)
        self._autopilot: AutopilotState | None = None
        self._newest_ns: dict[type, int] = {}
        self._requested_ns: dict[type, int] = {}
        self._heartbeat_ns = self._timesync_ns = -HEARTBEAT_NS
        self._reported_senders: set[tuple[int, int]] = set()
        self._ground_m: float | None = None
        self._action: Action = "none"
        self._was_taken_over = False
        self._replies: list[Any] = []

    @classmethod
    def from_run(
        cls,
        info: Info,
        scenario: Scenario,
        options: DriverOptions,
        channel: UdpChannel,
        system: int = 0,
        key: bytes | None = None,
    ) -> "AutopilotSession":
        origin = info.origin.latitude_deg, info.origin.longitude_deg, info.origin.height_m
        height_m = scenario.drone(options.drone).takeoff_height_m
        return cls(channel, origin, height_m, system, options.origin_m, key)

    # From the vehicle

    def receive(self, channel: int, datagram: bytes, now_ns: int) -> None:
        for received in self._parser.feed(datagram):
            if self._is_vehicle(received):
                self._loss.add(received.seq)
                self._received_ns = now_ns
                self._newest_ns[type(received.message)] = now_ns
                self._process(received.message, now_ns)

    def _is_vehicle(self, received: Received) -> bool:
        """Return whether a message is from the vehicle; the first heartbeat from a known autopilot identifies it."""
        message: Any = received.message
        address = received.system_id, received.component_id
        if self._autopilot is not None and address == self._autopilot.address:
            return True
        may_identify = self._autopilot is None and self._system in (0, received.system_id)
        if may_identify and isinstance(message, dialect.Heartbeat) and message.autopilot in CONTROL:
            self._autopilot = AutopilotState(address, CONTROL[message.autopilot])
            return True
        system = self._autopilot.address[0] if self._autopilot else self._system
        if system not in (0, received.system_id):
            self._refused += 1
            if address not in self._reported_senders and len(self._reported_senders) < SENDERS_REPORTED_MAX:
                self._reported_senders.add(address)
                self.texts.append(f"messages from system {address[0]}, component {address[1]}, are ignored")
        return False

    def _process(self, message: Any, now_ns: int) -> None:
        assert self._autopilot is not None
        match message:
            case dialect.Timesync(tc1=0):
                self._replies = [dialect.Timesync(tc1=now_ns, ts1=message.ts1)]
            case dialect.Timesync():
                if 0 <= now_ns - message.ts1 < HEARTBEAT_NS:
                    self._telemetry.add_round_trip(now_ns - message.ts1, now_ns)
            case dialect.Statustext():
                self.texts.append(f"the vehicle reports: {message.text}")
            case dialect.CommandAck() if message.result not in (dialect.Result.ACCEPTED, dialect.Result.IN_PROGRESS):
                self.texts.append(f"the vehicle answers command {message.command} with MAV_RESULT {message.result}")
            case _:
                self._autopilot.receive(message)
                self._telemetry.receive(message, now_ns)
                is_taken_over = self._autopilot.is_taken_over(self._action == "land")
                if is_taken_over != self._was_taken_over:
                    self._was_taken_over = is_taken_over
                    change = "another program or pilot has control" if is_taken_over else "control has been given back"
                    self.texts.append(f"{change} (mode {self._autopilot.custom_mode:#x})")

    # To the vehicle

    def advance(self, now_ns: int, demand: Demand) -> Iterator[tuple[int, bytes]]:
        self._action = demand.action
        for message in self._messages(now_ns, demand):
            yield 0, self._link.pack(message)

    def _messages(self, now_ns: int, demand: Demand) -> Iterator[Any]:
        yield from self._replies
        self._replies = []
        if now_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            if self._signing:
                self._signing.advance(self._unix_s())
            yield dialect.Heartbeat(
                dialect.TYPE_ONBOARD_CONTROLLER, Autopilot.INVALID, 0, 0, dialect.SystemStatus.ACTIVE, 3
            )
        autopilot = self._autopilot
        if autopilot is None:
            return
        if now_ns - self._timesync_ns >= TIMESYNC_NS:
            self._timesync_ns = now_ns
            yield dialect.Timesync(tc1=0, ts1=now_ns)
        for kind, rate_hz in autopilot.control.rates_hz.items():
            if now_ns - max(self._newest_ns.get(kind, 0), self._requested_ns.get(kind, 0)) > REQUEST_NS:
                self._requested_ns[kind] = now_ns
                yield autopilot.command(Cmd.SET_MESSAGE_INTERVAL, dialect.LAYOUTS[kind].id, 1e6 / rate_hz)
        kind = dialect.GpsGlobalOrigin
        if not self._telemetry.has_origin and now_ns - self._requested_ns.get(kind, 0) > REQUEST_NS:
            self._requested_ns[kind] = now_ns
            yield autopilot.command(Cmd.REQUEST_MESSAGE, dialect.LAYOUTS[kind].id)
        yield from self._sequence.advance(now_ns, demand, autopilot)

    # State

    @property
    def state(self) -> AircraftState:
        if self._autopilot is None:
            return AircraftState(received_ns=self._received_ns)
        state = self._autopilot.state(self._action == "fly", self._has_climbed(self._autopilot))
        return AircraftState(state, self._telemetry.battery_percent, self._telemetry.pose, self._received_ns)

    def _has_climbed(self, autopilot: "AutopilotState") -> bool:
        """Return whether the vehicle has reached its take-off height since it was last disarmed."""
        pose = self._telemetry.pose
        if pose is None:
            return False
        height_m = pose.position_m[2]
        if not autopilot.armed:
            self._ground_m = height_m
        if self._ground_m is None:
            return True  # it was in the air when this driver started
        if height_m - self._ground_m >= CLIMBED_FRACTION * self._takeoff_height_m:
            self._ground_m = None
        return self._ground_m is None

    def link_quality(self) -> LinkQuality:
        quality = super().link_quality()
        return quality._replace(refused=quality.refused + sum(self._parser.refused.values()))


class AutopilotState:
    """The flight state that an autopilot reports; `landed` is its MAV_LANDED_STATE."""

    def __init__(self, address: tuple[int, int], control: ExternalControl) -> None:
        self.address = address
        self.control = control
        self.armed = False
        self.custom_mode = 0
        self.landed: int = LandedState.UNDEFINED
        self.sea_height_m = 0.0
        self._is_terminated = False

    def receive(self, message: Any) -> None:
        match message:
            case dialect.Heartbeat():
                self.armed = bool(message.base_mode & dialect.BaseMode.ARMED)
                self.custom_mode = message.custom_mode
                self._is_terminated = message.system_status == dialect.SystemStatus.TERMINATED
            case dialect.ExtendedSysState():
                self.landed = message.landed_state
            case dialect.GlobalPositionInt():
                self.sea_height_m = message.alt / 1e3

    def is_taken_over(self, is_landing: bool) -> bool:
        """Return whether another controller, usually the pilot, has changed the mode in flight.

        Args:
            is_landing: whether this driver is landing the vehicle.
        """
        control, mode = self.control, self.custom_mode
        is_own_mode = mode in (control.custom_mode, *control.own) or (is_landing and mode == control.landing)
        return self.armed and self.landed in (LandedState.IN_AIR, LandedState.LANDING) and not is_own_mode

    @property
    def is_controlled(self) -> bool:
        return self.custom_mode == self.control.custom_mode

    def command(self, number: int, *parameters: float) -> dialect.CommandLong:
        """Return a command to the vehicle; `parameters` are its first ones, and the rest are 0."""
        return dialect.CommandLong(*self.address, number, 0, *parameters)

    def state(self, is_flying: bool, has_climbed: bool) -> DroneState:
        """Return the vehicle's state in terms of the contract.

        Args:
            is_flying: whether the vehicle is to follow a velocity, rather than hold its position.
            has_climbed: whether it has reached its take-off height.
        """
        if self._is_terminated:
            return "emergency"
        if not self.armed or self.landed in (LandedState.UNDEFINED, LandedState.ON_GROUND):
            return "landed"
        if self.landed == LandedState.LANDING:
            return "landing"
        if self.landed == LandedState.TAKEOFF or not has_climbed:
            return "taking_off"
        return "flying" if is_flying else "hovering"


class DemandSequence:
    """The commands and setpoints that make one autopilot carry out demands.

    Commands are repeated until the telemetry shows their effect, a kill as long as it is demanded; setpoints are sent
    when they change, at most once per CHANGE_INTERVAL_NS, and repeated while they do not.
    """

    def __init__(self, takeoff_height_m: float) -> None:
        self._takeoff_height_m = takeoff_height_m
        self._action = "none"
        self._commanded_ns: dict[str, int] = {}
        self._setpoint: Demand | None = None
        self._setpoint_ns = self._stream_ns = 0

    def advance(self, now_ns: int, demand: Demand, autopilot: AutopilotState) -> Iterator[Any]:
        if demand.action != self._action:
            self._action = demand.action
            self._commanded_ns.clear()
        match demand.action:
            case "hold" | "fly" | "land" if autopilot.is_taken_over(demand.action == "land"):
                return
            case "take_off":
                yield from self._take_off(now_ns, autopilot)
            case "hold" | "fly":
                yield from self._fly(now_ns, demand, autopilot)
            case "land" if autopilot.landed not in (LandedState.LANDING, LandedState.ON_GROUND):
                yield from self._repeat("land", now_ns, autopilot.command(Cmd.NAV_LAND, *NO_POSITION, 0.0))
            case "kill":
                kill = autopilot.command(Cmd.COMPONENT_ARM_DISARM, 0, dialect.FORCE)
                yield from self._repeat("kill", now_ns, kill, KILL_REPEAT_NS if autopilot.armed else REPEAT_NS)

    def _take_off(self, now_ns: int, autopilot: AutopilotState) -> Iterator[Any]:
        """Yield the next command: enter the mode for external control if the vehicle takes off in it, arm, take off."""
        takes_off = autopilot.control.takes_off
        if takes_off and not autopilot.is_controlled:
            yield from self._enter_mode(now_ns, autopilot)
        elif not autopilot.armed:
            yield from self._repeat("arm", now_ns, autopilot.command(Cmd.COMPONENT_ARM_DISARM, 1))
        elif autopilot.landed == LandedState.ON_GROUND:
            # ArduPilot's height is above home, PX4's above sea level.
            height_m = (0.0 if takes_off else autopilot.sea_height_m) + self._takeoff_height_m
            yield from self._repeat("take off", now_ns, autopilot.command(Cmd.NAV_TAKEOFF, *NO_POSITION, height_m))

    def _fly(self, now_ns: int, demand: Demand, autopilot: AutopilotState) -> Iterator[Any]:
        """Yield the setpoint that is due, and the command to enter the mode that accepts setpoints."""
        age_ns = now_ns - self._setpoint_ns
        if age_ns > STREAM_DURATION_NS:
            self._stream_ns = now_ns
        if age_ns >= (CHANGE_INTERVAL_NS if demand != self._setpoint else SETPOINT_NS):
            self._setpoint, self._setpoint_ns = demand, now_ns
            is_flying = demand.action == "fly"
            vx, vy, vz = ned(demand.velocity_m_s if is_flying else ZERO_VECTOR)
            yield dialect.SetPositionTargetLocalNed(
                0,
                *autopilot.address,
                dialect.MavFrame.LOCAL_NED,
                VELOCITY_AND_YAW_RATE,
                vx=vx,
                vy=vy,
                vz=vz,
                yaw_rate=-demand.yaw_rate_rad_s if is_flying else 0.0,
            )
        has_streamed = now_ns - self._stream_ns >= STREAM_DURATION_NS
        if has_streamed and autopilot.landed == LandedState.IN_AIR and not autopilot.is_controlled:
            yield from self._enter_mode(now_ns, autopilot)

    def _enter_mode(self, now_ns: int, autopilot: AutopilotState) -> Iterator[Any]:
        enter = autopilot.command(Cmd.DO_SET_MODE, dialect.BaseMode.CUSTOM, *autopilot.control.parameters)
        return self._repeat("mode", now_ns, enter)

    def _repeat(self, name: str, now_ns: int, message: Any, period_ns: int = REPEAT_NS) -> Iterator[Any]:
        if now_ns - self._commanded_ns.get(name, -REPEAT_NS) >= period_ns:
            self._commanded_ns[name] = now_ns
            yield message


class TelemetryReadings(AircraftReadings):
    """Converts one vehicle's telemetry to sensor readings.

    Args:
        origin: origin of W: latitude, longitude [deg], height [m].
        local_origin_m: origin of the vehicle's local frame [m; W]; None for its GPS_GLOBAL_ORIGIN, and before that
            arrives, the origin of W.

    Attributes:
        clock, unix_clock: clock offsets for messages whose timestamps count from boot and from 1970.
        has_origin: whether the origin of the vehicle's local frame is known.
    """

    def __init__(self, origin: tuple[float, float, float], local_origin_m: Vector | None = None) -> None:
        super().__init__(origin)
        self._local_origin_m = local_origin_m or (0.0, 0.0, 0.0)
        self.has_origin = local_origin_m is not None
        self.battery_percent = 0.0
        self.unix_clock = ClockOffset()
        self._q_WB, self._w_WB_B = LEVEL, ZERO_VECTOR
        self._flow_ns = self._measured_flow_ns = -FLOW_LOST_NS
        self._pressure_pa = 0.0

    def add_round_trip(self, duration_ns: int, now_ns: int) -> None:
        self.clock.add_round_trip(duration_ns, now_ns)
        self.unix_clock.add_round_trip(duration_ns, now_ns)

    def receive(self, m: Any, now_ns: int) -> None:
        """Decode a message that arrived at `now_ns`; ignore a message with non-finite values."""
        values = (getattr(m, name) for name in m.__struct_fields__)
        if not all(math.isfinite(value) for value in values if isinstance(value, float)):
            return
        match m:
            case dialect.AttitudeQuaternion():
                q = dialect.attitude_ned((m.q1, m.q2, m.q3, m.q4))
                length = el.length(q)
                if length > 0.5:  # otherwise not an attitude
                    w, x, y, z = (part / length for part in q)
                    self._q_WB, self._w_WB_B = (w, x, y, z), frd((m.rollspeed, m.pitchspeed, m.yawspeed))
            case dialect.LocalPositionNed():
                self._on_position(m, now_ns)
            case dialect.GpsGlobalOrigin() if not self.has_origin:
                geodetic = m.latitude / 1e7, m.longitude / 1e7, m.altitude / 1e3
                x, y, z = geodetic_to_enu(geodetic, self._origin).tolist()
                self._local_origin_m = (x, y, z)
                self.has_origin = True
            case dialect.SysStatus() if m.battery_remaining >= 0:  # -1: unknown
                self.battery_percent = float(min(100, m.battery_remaining))
            case dialect.HighresImu():
                taken_ns, updated = self._since_1970(m, now_ns), m.fields_updated
                if updated & ACCEL_GYRO == ACCEL_GYRO:
                    self.read("imu", taken_ns, frd((m.xacc, m.yacc, m.zacc)), frd((m.xgyro, m.ygyro, m.zgyro)))
                if updated & MAG == MAG:
                    self._read_field(taken_ns, UT_PER_GAUSS, m)
                if updated & PRESSURE:
                    self._read_new_pressure(taken_ns, PA_PER_HPA * m.abs_pressure)
            case dialect.ScaledImu():  # from ArduPilot, in mg, mrad/s and mgauss
                taken_ns, g = self._since_boot(m, now_ns), G_M_S2 / 1e3
                accel, gyro = (g * m.xacc, g * m.yacc, g * m.zacc), (m.xgyro / 1e3, m.ygyro / 1e3, m.zgyro / 1e3)
                self.read("imu", taken_ns, frd(accel), frd(gyro))
                if m.xmag or m.ymag or m.zmag:
                    self._read_field(taken_ns, UT_PER_GAUSS / 1e3, m)
            case dialect.ScaledPressure():
                self._read_new_pressure(self._since_boot(m, now_ns), PA_PER_HPA * m.press_abs)
            case dialect.GpsRawInt():
                self._on_gps(m, now_ns)
            case dialect.OpticalFlow():
                taken_ns = self._measured_flow_ns = self._since_1970(m, now_ns)
                self.read("flow", taken_ns, (m.flow_comp_m_x, -m.flow_comp_m_y, self.climb_m_s), m.quality / 255.0)
            case dialect.DistanceSensor() if m.orientation == DOWNWARD:
                is_valid = m.min_distance <= m.current_distance <= m.max_distance
                self.read("sonar", self._since_boot(m, now_ns), m.current_distance / 100.0, is_valid)

    def _since_boot(self, m: Any, now_ns: int) -> int:
        return self.clock.taken_ns(m.time_boot_ms * 1_000_000, now_ns)

    def _since_1970(self, m: Any, now_ns: int) -> int:
        return self.unix_clock.taken_ns(m.time_usec * 1_000, now_ns)

    def _on_position(self, m: Any, now_ns: int) -> None:
        x, y, z = ned((m.x, m.y, m.z))
        ox, oy, oz = self._local_origin_m
        velocity = ned((m.vx, m.vy, m.vz))
        taken_ns = self._since_boot(m, now_ns)
        self.pose = AircraftPose(taken_ns, (x + ox, y + oy, z + oz), velocity, self._q_WB, self._w_WB_B)
        if taken_ns - max(self._measured_flow_ns + FLOW_LOST_NS, self._flow_ns + FLOW_NS) >= 0:
            self._flow_ns = taken_ns
            self.read("flow", taken_ns, turned_about_up(velocity, -float(heading(self._q_WB))), 1.0)

    def _read_field(self, taken_ns: int, unit_ut: float, m: Any) -> None:
        self.read("mag", taken_ns, frd((unit_ut * m.xmag, unit_ut * m.ymag, unit_ut * m.zmag)))

    def _read_new_pressure(self, taken_ns: int, pressure_pa: float) -> None:
        if pressure_pa != self._pressure_pa:
            self._pressure_pa = pressure_pa
            self.read_pressure(taken_ns, pressure_pa, self.pose.position_m[2] if self.pose else 0.0)

    def _on_gps(self, m: Any, now_ns: int) -> None:
        geodetic = m.lat / 1e7, m.lon / 1e7, (m.alt_ellipsoid or m.alt) / 1e3
        if (geodetic, m.time_usec) == self._fix:
            return
        self._fix = geodetic, m.time_usec
        sigma_m = m.h_acc / 1e3 or (DOP_M * m.eph / 100.0 if m.eph != dialect.UINT16_UNKNOWN else 0.0)
        course = math.radians(m.cog / 100.0)
        values = self.gps_values(geodetic, m.vel / 100.0, course, sigma_m, min(m.fix_type, 3), m.satellites_visible)
        self.read("gps", self._since_1970(m, now_ns), *values)
