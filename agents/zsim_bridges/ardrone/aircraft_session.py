"""The session with one AR.Drone 2.0: it configures the aircraft, requests and decodes navdata, and carries out demands.

No I/O. Units and axes of navdata: millidegrees, millimetres, milli-g; x forward, y right, z down; psi clockwise from
the heading at which the aircraft was switched on. Source: AR.Drone Developer Guide SDK 2.0, chapters 6 to 8.
"""

import math
from collections import deque
from collections.abc import Iterator
from typing import Any

from zsim.contract.flight_messages import DroneState
from zsim.contract.messages import Info
from zsim.math.frames import heading, quaternion_from_rpy, turned_about_up
from zsim.math.rotation import Vector
from zsim.scenario.scenario import Scenario
from zsim.schema.quantities import G_M_S2
from zsim_bridges.ardrone import at_commands, navdata
from zsim_bridges.ardrone.at_commands import Command, Config, Control, Pcmd, ResetWatchdog
from zsim_bridges.ardrone.navdata import (
    ALTITUDE,
    DEMO,
    FIX_3D,
    FULL_TAGS,
    GPS_TAG,
    MAG_UT_PER_LSB,
    MAGNETO,
    MICROSECONDS_MASK,
    PHYS,
    PRESSURE,
    SECONDS_SHIFT,
    TIME,
    ControlState,
    Navdata,
    NavdataError,
    StateBit,
)
from zsim_bridges.vehicle_links.driver import DriverOptions
from zsim_bridges.vehicle_links.vehicle_session import (
    ZERO_VECTOR,
    AircraftPose,
    AircraftReadings,
    AircraftState,
    Demand,
    UdpChannel,
    VehicleSession,
)

NAVDATA, AT = 0, 1  # channels
REQUEST_NS = 100_000_000  # silence after which navdata is requested again, as in npm ar-drone
CONFIG_NS = 500_000_000  # time without an acknowledgement after which an entry is sent again
WATCHDOG_NS = 1_000_000_000  # period of watchdog resets: half of the aircraft's com_watchdog
RESTART_DROP_MIN = 100  # packets; a sequence number that falls by at least this much shows a restart of the aircraft
PERIOD_NS = 30_000_000  # maximum time between commands (Developer Guide, 6.3)
CHANGE_INTERVAL_NS = 15_000_000  # minimum time between changed demands; design choice: below a gate, which brings one
PULSE_NS = 90_000_000  # duration of an emergency pulse: three datagrams carry the bit, so two of them may be lost
# Minimum time between emergency pulses: longer than navdata takes to show one, since a second would undo the first
PULSE_INTERVAL_NS = 400_000_000
VELOCITY_1_S = 2.5  # velocity gain; tuned: 46 deg of phase margin with 0.14 s of delay and 0.14 s of tilt lag
INTEGRAL_1_S2 = 2.0  # integral gain; tuned: as fast as that margin allows, since gusts last only a few seconds
DRAG_1_S = 0.58  # deceleration by drag per unit of speed (tum_ardrone's model, fitted to flights)
STEP_S_MAX = 0.1  # maximum time step of the integration; longer pauses are clipped to it
RESPONSE_NS = 240_000_000  # command delay and tilt lag (tum_ardrone: 0.1 s and 0.14 s)
HOVER = Pcmd(0, 0, 0.0, 0.0, 0.0, 0.0)  # flag 0: hold the position
STATES: dict[int, DroneState] = {
    ControlState.FLYING: "flying",
    ControlState.HOVERING: "hovering",
    ControlState.TAKING_OFF: "taking_off",
    ControlState.GO_TO_FIX: "flying",
    ControlState.LANDING: "landing",
    ControlState.LOOPING: "flying",
}
OPTIONS_MASK = sum(1 << tag for tag in (*FULL_TAGS, GPS_TAG))
SONAR_MM = range(30, 6000)  # valid readings; any other value means that there was no echo
GPS_1_S = 0.1  # rate at which the position follows the GPS; design choice: reduces 2 m of noise at 5 Hz to 0.3 m
YAW_1_S = 0.1  # rate at which the heading follows the magnetometer
GAP_S_MAX = 0.5  # gap in navdata at or above which the velocity is not integrated


# Limits set in the aircraft: the SDK's outdoor tilt and climb rate, and its indoor yaw rate
TILT_RAD, CLIMB_M_S, YAW_RATE_RAD_S = 0.35, 1.0, 1.75
SETTINGS = {  # `outdoor` precedes the limits, since setting it replaces them
    "general:navdata_demo": "FALSE",
    "general:navdata_options": str(OPTIONS_MASK),
    "control:outdoor": "TRUE",
    "control:euler_angle_max": f"{TILT_RAD:g}",
    "control:control_vz_max": f"{1e3 * CLIMB_M_S:g}",
    "control:control_yaw": f"{YAW_RATE_RAD_S:g}",
    "control:altitude_max": "100000",  # mm; no limit in the aircraft, since the driver enforces its fence
}


class AircraftSession(VehicleSession):
    """The session with one aircraft; `ultrasound` sets its sonar's frequency, 7 (22.2 Hz) or 8 (25 Hz)."""

    def __init__(self, host: str, readings: "NavdataReadings", ultrasound: int) -> None:
        channels = UdpChannel(host, navdata.PORT), UdpChannel(host, at_commands.PORT)
        super().__init__(channels, readings, modulus=1 << 32)
        self._navdata = readings
        self._commands = FlightCommands()
        settings = SETTINGS | {"pic:ultrasound_freq": str(ultrasound)}
        self._entries = [Config(0, key, value) for key, value in settings.items()]
        self._pending: deque[Config] = deque(self._entries)
        self._sequence = 0
        self._newest_sequence = 0
        self._state_bits = StateBit(0)
        self._state: DroneState = "landed"
        self._battery = 0.0
        self._requested_ns = self._config_ns = self._cleared_ns = self._watchdog_ns = -WATCHDOG_NS
        self._sent: Config | None = None  # the entry that awaits its acknowledgement

    @classmethod
    def from_run(
        cls, info: Info, scenario: Scenario, options: DriverOptions, host: str, ultrasound: int
    ) -> "AircraftSession":
        origin = info.origin.latitude_deg, info.origin.longitude_deg, info.origin.height_m
        start_m = options.origin_m or scenario.drone(options.drone).position_m
        yaw_rad = None if options.yaw_deg is None else math.radians(options.yaw_deg)
        return cls(host, NavdataReadings(origin, start_m, scenario.environment.magnetic_field_ut, yaw_rad), ultrasound)

    # From the aircraft

    def receive(self, channel: int, datagram: bytes, now_ns: int) -> None:
        if channel != NAVDATA:
            return
        try:
            packet = navdata.unpack(datagram)
        except NavdataError:
            self._refused += 1
            return
        if self._newest_sequence - RESTART_DROP_MIN < packet.sequence <= self._newest_sequence:
            return  # duplicated or out of order
        if packet.sequence < self._newest_sequence:
            self._loss.restart()
        self._newest_sequence = packet.sequence
        self._loss.add(packet.sequence)
        self._received_ns = now_ns
        self._process(packet, now_ns)

    def _process(self, packet: Navdata, now_ns: int) -> None:
        if StateBit.COM_LOST in packet.state and StateBit.COM_LOST not in self._state_bits:
            self.texts.append("the aircraft has not received our commands for a while")
        if packet.bootstrap and not self._pending:
            self._pending.extend(self._entries)  # the aircraft was restarted
        self._state_bits = packet.state
        demo = packet.options.get(DEMO)
        if demo is not None:
            self._battery = float(min(100, demo.battery_percent))
            self._state = STATES.get(demo.ctrl_state >> 16, "flying" if StateBit.FLYING in packet.state else "landed")
        elif StateBit.FLYING not in packet.state:  # without options, such as a bootstrap packet after a restart
            self._state = "landed"
        if StateBit.EMERGENCY in packet.state:
            self._state = "emergency"
        self._navdata.receive(packet, now_ns)

    # To the aircraft

    def advance(self, now_ns: int, demand: Demand) -> Iterator[tuple[int, bytes]]:
        silent_ns = now_ns - max(self._received_ns or 0, self._requested_ns)
        if silent_ns >= REQUEST_NS:
            self._requested_ns = now_ns
            yield NAVDATA, navdata.REQUEST_UNICAST
        is_emergency = StateBit.EMERGENCY in self._state_bits
        flight = self._commands.advance(now_ns, demand, is_emergency, self._navdata.pose)
        datagram = b""
        for command in [*self._setup_commands(now_ns), *flight]:
            self._sequence += 1
            datagram += at_commands.format_command(command._replace(sequence=self._sequence))
        if datagram:
            yield AT, datagram

    def _setup_commands(self, now_ns: int) -> Iterator[Command]:
        """Yield the watchdog resets and entries that are due; an acknowledgement is cleared before the next entry."""
        if self._received_ns is None:
            return
        is_acknowledged = StateBit.COMMAND_ACK in self._state_bits
        if now_ns - self._watchdog_ns >= WATCHDOG_NS:
            self._watchdog_ns = now_ns
            yield ResetWatchdog(0)
        if is_acknowledged and now_ns - self._cleared_ns >= REQUEST_NS:
            self._cleared_ns = now_ns
            if self._sent is not None:
                self._pending.popleft()
                self._sent = None
            yield Control(0, at_commands.ACKNOWLEDGE)
        elif not is_acknowledged and self._pending and (self._sent is None or now_ns - self._config_ns >= CONFIG_NS):
            self._config_ns, self._sent = now_ns, self._pending[0]
            yield self._pending[0]

    @property
    def state(self) -> AircraftState:
        return AircraftState(self._state, self._battery, self._navdata.pose, self._received_ns)


class FlightCommands:
    """Generates the AT commands that make one aircraft carry out demands; sequence numbers are left at 0.

    REF commands a take-off, a landing or an emergency pulse, and is repeated while that is demanded; from take-off to
    landing, PCMD accompanies it at least every 30 ms.
    Source: AR.Drone Developer Guide SDK 2.0, chapter 6.
    """

    def __init__(self) -> None:
        self._axes = _Axis(), _Axis()
        self._sent_ns = -PERIOD_NS
        self._last: Demand | None = None
        self._pulse_start_ns = -PULSE_INTERVAL_NS  # when the emergency bit last rose

    def advance(self, now_ns: int, demand: Demand, is_emergency: bool, pose: AircraftPose | None) -> Iterator[Command]:
        """Yield the commands that are due; `is_emergency` states whether the aircraft is in an emergency."""
        if now_ns - self._sent_ns < (PERIOD_NS if demand == self._last else CHANGE_INTERVAL_NS):
            return
        self._last, self._sent_ns = demand, now_ns
        match demand.action:
            case "none":
                return
            case "kill":
                yield self._emergency_ref(now_ns, is_due=not is_emergency)
            case "land":
                yield at_commands.ref(0, takes_off=False)
                yield HOVER
            case "reset":
                yield self._emergency_ref(now_ns, is_due=is_emergency)
            case _ if is_emergency:
                return
            case _:
                yield at_commands.ref(0, takes_off=True)
                yield self._pcmd(now_ns, demand, pose)

    def _emergency_ref(self, now_ns: int, is_due: bool) -> Command:
        """Return the next REF, starting an emergency pulse if `is_due`; the aircraft responds to the rising edge."""
        if is_due and now_ns - self._pulse_start_ns >= PULSE_INTERVAL_NS:
            self._pulse_start_ns = now_ns
        return at_commands.ref(0, takes_off=False, emergency=now_ns - self._pulse_start_ns < PULSE_NS)

    def _pcmd(self, now_ns: int, demand: Demand, pose: AircraftPose | None) -> Command:
        """Return the PCMD for a demand; its values are fractions of the limits in the aircraft's configuration."""
        if demand.action != "fly" or pose is None:
            self._axes = _Axis(), _Axis()
            return HOVER
        demanded, yaw_rad = demand.velocity_m_s, float(heading(pose.q_WB))
        max_accel_m_s2 = G_M_S2 * math.tan(TILT_RAD)
        x, y = (
            axis.accel(now_ns, demanded[k], pose.velocity_m_s[k], max_accel_m_s2) for k, axis in enumerate(self._axes)
        )
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        up, turn = demanded[2] / CLIMB_M_S, demand.yaw_rate_rad_s / YAW_RATE_RAD_S
        fractions = (y * c - x * s) / max_accel_m_s2, (x * c + y * s) / max_accel_m_s2, up, turn
        left, forward, up, yaw_left = (max(-1.0, min(1.0, fraction)) for fraction in fractions)
        return Pcmd(0, at_commands.PROGRESSIVE, -left, -forward, up, -yaw_left)


class _Axis:
    """A velocity loop along one axis of W, around the aircraft's own tilt loop.

    The velocity follows a reference that approaches the demand with a lag. The measured velocity responds to the
    reference of RESPONSE_NS ago; any deviation from that is attributed to wind, and is integrated.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._reference = 0.0
        self._wind_m_s2 = 0.0
        self._references: deque[tuple[int, float]] = deque()

    def accel(self, now_ns: int, demanded: float, measured: float, max_m_s2: float) -> float:
        """Return the acceleration [m/s^2] that the tilt must produce; if below `max_m_s2`, update the wind estimate."""
        dt_s = 0.0 if self._last_ns is None else min(STEP_S_MAX, (now_ns - self._last_ns) * 1e-9)
        if self._last_ns is None:
            self._reference = measured
        self._last_ns = now_ns
        slope = VELOCITY_1_S * (demanded - self._reference)
        self._reference += dt_s * slope
        references = self._references
        references.append((now_ns, self._reference))
        while len(references) > 1 and references[1][0] <= now_ns - RESPONSE_NS:
            references.popleft()
        error = references[0][1] - measured  # relative to the reference to which the measured velocity responds
        accel = slope + DRAG_1_S * self._reference + VELOCITY_1_S * error + self._wind_m_s2
        if abs(accel) < max_m_s2:
            self._wind_m_s2 += INTEGRAL_1_S2 * error * dt_s
        return accel


class NavdataReadings(AircraftReadings):
    """The measurements of one aircraft, and its position, integrated from its velocity since the start.

    Args:
        origin: latitude and longitude [deg] and height [m] of the origin of W.
        position_m: the aircraft's position at the start [W].
        field_ut: the Earth's magnetic field [uT; W], from which the heading is determined.
        yaw_rad: the aircraft's heading at the start; None to take it from the magnetometer.
    """

    def __init__(
        self,
        origin: tuple[float, float, float],
        position_m: Vector,
        field_ut: Vector,
        yaw_rad: float | None = None,
    ) -> None:
        super().__init__(origin)
        self._x, self._y, self._ground_m = position_m
        self._north_rad = math.atan2(field_ut[1], field_ut[0])
        self._stated_yaw_rad = yaw_rad
        self._yaw_offset_rad: float | None = None
        self._last_demo_ns: int | None = None
        self._gps_ns: int | None = None

    def receive(self, packet: Navdata, now_ns: int) -> None:
        options, taken_ns = packet.options, now_ns
        if time := options.get(TIME):
            stamp_ns = (time.time >> SECONDS_SHIFT) * 1_000_000_000 + (time.time & MICROSECONDS_MASK) * 1_000
            taken_ns = self.clock.taken_ns(stamp_ns, now_ns)
        if demo := options.get(DEMO):
            self._on_demo(demo, options, taken_ns)
        if phys := options.get(PHYS):
            accel = tuple(G_M_S2 * part / 1e3 for part in _frd_to_flu(phys.phys_accs_mg))
            gyro = tuple(map(math.radians, _frd_to_flu(phys.phys_gyros_deg_s)))
            self.read("imu", taken_ns, accel, gyro)
        if mag := options.get(MAGNETO):
            self.read("mag", taken_ns, tuple(MAG_UT_PER_LSB * part for part in _frd_to_flu((mag.mx, mag.my, mag.mz))))
        if (pressure := options.get(PRESSURE)) and pressure.pressure_pa > 0:
            height_m = self.pose.position_m[2] if self.pose else self._ground_m
            self.read_pressure(taken_ns, float(pressure.pressure_pa), height_m)
        if altitude := options.get(ALTITUDE):
            raw_mm = altitude.altitude_raw_mm
            self.read("sonar", taken_ns, raw_mm / 1e3, raw_mm in SONAR_MM)
        if (gps := options.get(GPS_TAG)) and gps.data_available:
            self._on_gps(gps, taken_ns)

    def _on_demo(self, demo: Any, options: dict[int, Any], taken_ns: int) -> None:
        """Update the pose, integrating the velocity that the aircraft measures relative to its heading."""
        roll, pitch = math.radians(demo.phi_mdeg / 1e3), -math.radians(demo.theta_mdeg / 1e3)
        yaw = -math.radians(demo.psi_mdeg / 1e3)
        dt_s = 0.0 if self._last_demo_ns is None else (taken_ns - self._last_demo_ns) * 1e-9
        self._last_demo_ns = taken_ns
        if mag := options.get(MAGNETO):
            m = _frd_to_flu((mag.mx, mag.my, mag.mz))  # the Earth's magnetic field in B
            my, mz = m[1] * math.cos(roll) - m[2] * math.sin(roll), m[1] * math.sin(roll) + m[2] * math.cos(roll)
            mx = m[0] * math.cos(pitch) + mz * math.sin(pitch)
            self._align(yaw, self._north_rad - math.atan2(my, mx), dt_s)
        yaw += self._yaw_offset_rad or 0.0
        body_velocity = _frd_to_flu((demo.vx_mm_s / 1e3, demo.vy_mm_s / 1e3, demo.vz_mm_s / 1e3))
        velocity = turned_about_up(body_velocity, yaw)
        if 0.0 < dt_s < GAP_S_MAX:
            self._x, self._y = self._x + dt_s * velocity[0], self._y + dt_s * velocity[1]
        w, x, y, z = quaternion_from_rpy((roll, pitch, yaw)).tolist()
        position = self._x, self._y, self._ground_m + max(0, demo.altitude_mm) / 1e3
        rate = self._last["imu"][1] if "imu" in self._last else ZERO_VECTOR
        self.pose = AircraftPose(taken_ns, position, velocity, (w, x, y, z), rate)
        self.read("flow", taken_ns, body_velocity, 1.0)

    def _align(self, yaw: float, magnetic: float, dt_s: float) -> None:
        """Let the heading slowly follow the magnetometer, unless the initial heading was given."""
        if self._stated_yaw_rad is not None:
            if self._yaw_offset_rad is None:
                self._yaw_offset_rad = self._stated_yaw_rad - yaw
            return
        if self._yaw_offset_rad is None:
            self._yaw_offset_rad = magnetic - yaw
        error = math.remainder(magnetic - yaw - self._yaw_offset_rad, 2 * math.pi)
        self._yaw_offset_rad += min(1.0, YAW_1_S * max(0.0, dt_s)) * error

    def _on_gps(self, gps: Any, taken_ns: int) -> None:
        """Process each fix once, and let the position follow it slowly."""
        geodetic = gps.latitude_deg, gps.longitude_deg, gps.elevation_m
        values = self.gps_values(geodetic, gps.speed_m_s, math.radians(gps.degree), gps.ehpe_m, FIX_3D, gps.satellites)
        previous_ns, fix = self._gps_ns, (geodetic, gps.speed_m_s, gps.degree)
        if fix != self._fix and self.read("gps", taken_ns, *values):
            self._gps_ns, self._fix = taken_ns, fix
            if previous_ns is not None:  # the first fix is less accurate than the given position
                x, y, _ = values[3]
                weight = min(1.0, GPS_1_S * (taken_ns - previous_ns) * 1e-9)
                self._x, self._y = self._x + weight * (x - self._x), self._y + weight * (y - self._y)


def _frd_to_flu(v: Any) -> Vector:
    """Convert a body vector from forward-right-down axes to B."""
    return float(v[0]), -float(v[1]), -float(v[2])
