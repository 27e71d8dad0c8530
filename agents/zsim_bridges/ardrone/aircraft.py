"""One drone of a run as an AR.Drone 2.0: messages and datagrams in, commands and datagrams out. Pure.

The session of one aircraft: AT commands, configuration, watchdogs and state, between a run and pilots' programs.
"""

import math
import struct
from collections.abc import Callable, Hashable
from itertools import pairwise
from typing import Any, NamedTuple

from zsim.contract import flight_messages, messages
from zsim.math import frames as rotations
from zsim.math.rotation import Quaternion, Vector
from zsim.scenario.scenario import Drone
from zsim.schema.quantities import G_M_S2
from zsim.sensors.camera import CAMERAS
from zsim_bridges.ardrone import at_commands, configuration, navdata
from zsim_bridges.ardrone.at_commands import Command
from zsim_bridges.ardrone.configuration import Configuration, ConfigurationError
from zsim_bridges.ardrone.navdata import (
    FULL_TAGS,
    GPS_TAG,
    LAYOUTS,
    LOST_COM,
    MAGNETO_CALIBRATION,
    SECONDS_SHIFT,
    TAG_OF,
    ControlState,
    NavdataTemplate,
    StateBit,
)
from zsim_bridges.ardrone.pilot import IN_THE_AIR, Pilot, SetpointSender
from zsim_bridges.vehicle_links.drone_link import CommandSender, OnboardState

WATCHDOG_NS = 50_000_000  # ns without an AT command until the watchdog's bit (Developer Guide 6.6, COMWDG)
LAND_AFTER_NS = 2_000_000_000  # ns of hovering without a pilot's program before it lands, chosen
MALFORMED_SHOWN = 20  # chosen; reports of invalid parts of datagrams, further ones are only counted
LOW_BATTERY_PERCENT = 10.0  # %, below it zsim's firmware does not take off; below 5 % it lands
RANGE_COSINE = math.cos(math.radians(75.0))  # of the tilt at which the firmware cuts the motors
THREADS = StateBit.AT_THREAD | StateBit.NAVDATA_THREAD | StateBit.VIDEO_THREAD | StateBit.ACQUISITION_THREAD
ALWAYS = int(StateBit.ALTITUDE_CONTROL | StateBit.PIC_VERSION_OK | THREADS)  # of an aircraft on the ground
CONTROL_STATES = {
    "landed": ControlState.LANDED,
    "taking_off": ControlState.TAKING_OFF,
    "hovering": ControlState.HOVERING,
    "flying": ControlState.FLYING,
    "landing": ControlState.LANDING,
    "emergency": ControlState.DEFAULT,
}
FRONT_CHANNELS = (0, 2)  # video_channel: 0 front, 1 bottom, 2 and 3 with the other one small, 4 the next one
NEXT_CHANNEL = 4
FIGURES = "figures are not flown here; the aircraft's flips are its firmware's"
CLIENTS_MAX = 8  # programs that receive navdata, chosen; beyond it the oldest one is dropped
REQUESTS = (b"\x01", b"Init")  # how a request for navdata begins (ARDroneLib; its Windows client)
SECOND_NS = 1_000_000_000
ACCEL_LSB_PER_G, ACCEL_ZERO_LSB = 512, 2048  # of the raw accelerometer, nominal (measured: 516 to 518, 2031 to 2038)
GYRO_LSB_PER_DEG_S = 16.4  # of the raw gyro (measured on an aircraft)
MAG_UT_PER_LSB = 0.3  # uT (AK8975 datasheet)
MG_PER_UT = 10.0  # milligauss
PWM_MAX = 255  # of a motor at its greatest speed; below, in proportion, chosen: the curve is not published
VOLTAGE_MV = ((0.0, 9000.0), (10.0, 10_500.0), (50.0, 11_686.0), (100.0, 12_500.0))
"""Battery [mV] by charge [%]: vbat_min of the SDK, two chosen, and 50 % as an aircraft showed it."""
SECONDS_MASK = 0x7FF  # 11 bits
FIX_3D = 3  # of a GPS receiver, as in NMEA
_INT16 = 32_767
_UNUSED_OF_DEMO = (0, *(0.0,) * 12, 0, 0, *(0.0,) * 12)  # frames, and what the cameras detect
PWM, ALTITUDE, PRESSURE, MAGNETO, KALMAN_PRESSURE = (
    TAG_OF[name] for name in ("pwm", "altitude", "pressure_raw", "magneto", "kalman_pressure")
)
Send = Callable[[bytes, Hashable], None]
"""Sends a datagram to an address."""
Putters = dict[str, Callable[..., None]]
"""By the name of an option, what writes its numbers."""


class Outlets(NamedTuple):
    """The outputs of an aircraft: commands to the run, navdata to programs, bytes to the control port, refusals."""

    put: Callable[[str, Any], None]
    send_navdata: Send
    send_control: Callable[[bytes], None]
    refuse: Callable[[str], None]


class Aircraft:
    """One aircraft, flown by its pilot's programs; `gate_ns` is the resolution of arrival times."""

    def __init__(self, drone: Drone, source: str, gate_ns: int, outlets: Outlets) -> None:
        self._name = drone.name
        self._gate_ns = gate_ns
        self._outlets = outlets
        self._state = OnboardState(drone.sensors.imu.mount, drone.sensors.mag.mount)
        limits = drone.limits
        highest = {
            "euler_angle_max": math.radians(limits.tilt_deg),
            "control_vz_max": 1e3 * limits.vertical_speed_m_s,
            "control_yaw": math.radians(limits.yaw_rate_deg_s),
        }
        self.configuration = Configuration(
            {f"control:{place}{name}": v for name, v in highest.items() for place in ("", "indoor_", "outdoor_")},
            {"general:ardrone_name": drone.name, "network:ssid_single_player": f"ardrone2_{drone.name}"},
        )
        sender = CommandSender(drone.name, source, outlets.put)
        self._setpoints = SetpointSender(sender, limits, self.configuration)
        self.pilot = Pilot(sender, self._setpoints, source, self._refuse)
        self._content = NavdataContent(self._state, drone.rotor_max_rad_s)
        outputs = outlets.send_navdata, self._state_bits, self._ctrl_state, self._refuse
        self._navdata = NavdataSender(self._content, self.configuration, *outputs)
        self._has_camera = bool(drone.sensors.front_camera or drone.sensors.bottom_camera)
        self._now_ns = 0
        self._command_ns: int | None = None  # when the last AT command arrived
        self._last_sequence = -1
        self._is_lost = self._ack = False
        self._ids: at_commands.ConfigIds | None = None
        self._channel = 0
        self._malformed = 0

    @property
    def camera(self) -> str:
        """The camera whose pictures are streamed."""
        return CAMERAS[0] if self._channel in FRONT_CHANNELS else CAMERAS[1]

    # The run

    def update(self, message: Any) -> None:
        message = self._state.update(message)
        self._content.update(message)
        match message:
            case messages.Imu():
                self._navdata.on_instant(message.t_ns)
            case flight_messages.Status():
                self._now_ns = message.t_ns
                self._setpoints.altitude_m = self._state.altitude_m
                self._setpoints.heading_rad = math.radians(self._content.heading_deg)
                self._watch_pilot()
                self.pilot.on_status(message)
                self._navdata.on_gate()
                self._navdata.on_instant(message.t_ns)

    def _watch_pilot(self) -> None:
        """Hover, and later land, when the pilot's program is silent."""
        silent_ns = self._silent_ns()
        lost_ns = round(self.configuration.number("general:com_watchdog") * SECOND_NS)
        if silent_ns <= lost_ns:
            return
        if not self._is_lost:
            self._is_lost = True
            self._navdata.clients.clear()
            self.pilot.on_lost()
        elif silent_ns > lost_ns + LAND_AFTER_NS:
            self.pilot.land()

    def _silent_ns(self) -> int:
        """Return how long no AT command has arrived, less the gate that is the resolution of its arrival."""
        return 0 if self._command_ns is None else max(0, self._now_ns - self._command_ns - self._gate_ns)

    # Pilots' programs

    def on_navdata_request(self, datagram: bytes, address: Hashable) -> None:
        if not self._navdata.on_request(datagram, address, self._now_ns):
            self._refuse(f"a datagram of {len(datagram)} bytes on the navdata port is not a request for navdata")

    def on_at(self, datagram: bytes) -> None:
        commands, refusals = at_commands.parse(datagram)
        for refusal in refusals:
            self._malformed += 1
            self._refuse(refusal if self._malformed <= MALFORMED_SHOWN else "more data that are not AT commands")
        for command in commands:
            # numbers begin again with 0 or 1, and after a silence
            if command.sequence > self._last_sequence or command.sequence in (0, 1) or self._is_lost:
                self._last_sequence = command.sequence
                self._command_ns, self._is_lost = self._now_ns, False
                self._obey(command)
            else:
                self._refuse("AT commands come with sequence numbers that are not above the last one")

    def _obey(self, command: Command) -> None:
        ids, self._ids = self._ids, None
        match command:
            case at_commands.Ref():
                self.pilot.on_ref(command)
            case at_commands.Pcmd() | at_commands.PcmdMag():
                self.pilot.on_pcmd(command)
            case at_commands.ConfigIds():
                self._ids = command
            case at_commands.Config():
                self._configure(command, ids)
            case at_commands.Control(mode=at_commands.ACKNOWLEDGE):
                self._ack = False
            case at_commands.Control(mode=at_commands.SEND_CONFIGURATION):
                self._outlets.send_control(configuration.format_configuration(self.configuration.all()))
                self._ack = True
            case at_commands.Control(mode=at_commands.SEND_CUSTOM_LIST):
                self._outlets.send_control(configuration.format_custom_list(self.configuration.custom_list()))
                self._ack = True
            case at_commands.Calibrate():
                self.pilot.calibrate()
            case at_commands.FlatTrim() if self.pilot.state != "landed":
                self._refuse(f"FTRIM is not obeyed: the drone is {self.pilot.state}; must be landed")
            case at_commands.Animation():
                self._refuse(f"ANIM is not obeyed: {FIGURES}")

    def _configure(self, config: at_commands.Config, ids: at_commands.ConfigIds | None) -> None:
        """Set an entry, and acknowledge it even if it is refused, as the aircraft does."""
        self._ack = True
        key = config.key.lower()
        is_foreign = ids and not self.configuration.is_current(ids.session, ids.user, ids.application)
        if is_foreign and not key.startswith("custom:"):
            self._refuse(f"CONFIG {key[:60]} is not obeyed: its identifiers are not those in force")
            return
        if key == "control:flight_anim":
            self._refuse(f"CONFIG {key} is not obeyed: {FIGURES}")
            return
        try:
            self.configuration.set(key, config.value)
        except ConfigurationError as error:
            self._refuse(f"CONFIG is not obeyed: {error}")
            return
        if key == "general:navdata_demo":
            self._navdata.is_bootstrap = False
        elif key == "video:video_channel":
            wanted = int(self.configuration.number("video:video_channel"))
            self._channel = int(self.camera == CAMERAS[0]) if wanted == NEXT_CHANNEL else wanted

    # State

    def _refuse(self, reason: str) -> None:
        self._outlets.refuse(f"{self._name}: {reason}")

    def _ctrl_state(self) -> int:
        major, minor = CONTROL_STATES[self.pilot.state], 0
        if major == ControlState.HOVERING and self._is_lost:
            minor = LOST_COM
        elif self.pilot.calibrates:
            major, minor = ControlState.HOVERING, MAGNETO_CALIBRATION
        return major << 16 | minor

    def _state_bits(self) -> int:
        status = self._state.status
        is_silent = self._command_ns is None or self._silent_ns() > WATCHDOG_NS
        bits = (
            (StateBit.FLYING, self.pilot.state in (*IN_THE_AIR, "landing")),
            (StateBit.COMMAND_ACK, self._ack),
            (StateBit.CAMERA_READY, self._has_camera),
            (StateBit.COM_WATCHDOG, is_silent),
            (StateBit.COM_LOST, self._is_lost),
            (StateBit.ULTRASOUND_DEAF, self._content.is_sonar_deaf),
            (StateBit.BATTERY_LOW, status is not None and status.battery_percent < LOW_BATTERY_PERCENT),
        )
        state = sum((bit for bit, is_set in bits if is_set), ALWAYS)  # a flag's `|` is slow
        if self.pilot.state == "emergency":
            state += StateBit.EMERGENCY + (StateBit.USER_EMERGENCY if self.pilot.stopped_by_pilot else StateBit.CUTOUT)
            if float(rotations.rotation_matrix(self._state.attitude)[2, 2]) < RANGE_COSINE:
                state += StateBit.ANGLES_OUT_OF_RANGE
        return state


class NavdataSender:
    """Sends an aircraft's navdata: when packets are due, their options, receivers and contents.

    The SDK's body axes are x forward, y right, z down; its angles theta nose up, phi to the right, psi clockwise, 0
    where the aircraft was switched on. What no sensor of the drone measures is zero.

    Args:
        state_bits: returns the state word without the bits of the mode of navdata.
        ctrl_state: returns the state of the flight.
        refuse: counts what cannot be sent, with the reason.

    Attributes:
        clients: addresses to which navdata is sent, the first that asked first.
        is_bootstrap: whether packets have no options yet.
    """

    def __init__(
        self,
        content: "NavdataContent",
        configuration: Configuration,
        send: Send,
        state_bits: Callable[[], int],
        ctrl_state: Callable[[], int],
        refuse: Callable[[str], None],
    ) -> None:
        self._content = content
        self._configuration = configuration
        self._send = send
        self._state_bits = state_bits
        self._ctrl_state = ctrl_state
        self._refuse = refuse
        self._last: tuple[int, int] | None = None  # rate [Hz], and number of the packet within the simulated time
        self.clients: dict[Hashable, None] = {}
        self._sequence = 0
        self._prepare(())
        self.is_bootstrap = True

    def on_request(self, datagram: bytes, address: Hashable, t_ns: int) -> bool:
        """Send navdata to an address from now on; return False for a datagram that does not ask for it."""
        if not datagram.startswith(REQUESTS):
            return False
        if address not in self.clients:
            while len(self.clients) >= CLIENTS_MAX:
                del self.clients[next(iter(self.clients))]
            self.clients[address] = None
            self._send(self._packet(t_ns), address)
        return True

    def on_instant(self, t_ns: int) -> None:
        """Send the packet that is due: a fixed number in each simulated second, without drift."""
        is_full = not (self.is_bootstrap or self._configuration.flag("general:navdata_demo"))
        rate_hz = navdata.FULL_RATE_HZ if is_full else navdata.DEMO_RATE_HZ
        number = rate_hz, t_ns * rate_hz // SECOND_NS
        if self.clients and number != self._last:
            self._last = number
            packet = self._packet(t_ns)
            for address in tuple(self.clients):
                self._send(packet, address)

    def on_gate(self) -> None:
        """Update the values that change at gates."""
        self._is_gate_new = True

    def _packet(self, t_ns: int) -> bytes:
        tags = self._tags()
        if tags != self._template.tags:
            self._prepare(tags)
        try:
            if self._is_gate_new:
                self._is_gate_new = False
                self._content.fill_gate(self._put, tags)
            self._content.fill_packet(self._put, self._ctrl_state(), t_ns)
        except (struct.error, ArithmeticError, ValueError) as error:
            self._refuse(f"navdata has a value beyond what its field can hold ({error})")
        self._sequence += 1
        bits = self._state_bits()
        if self.is_bootstrap:
            bits += navdata.StateBit.NAVDATA_BOOTSTRAP + navdata.StateBit.NAVDATA_DEMO
        elif self._configuration.flag("general:navdata_demo"):
            bits += navdata.StateBit.NAVDATA_DEMO
        return self._template.packet(bits, self._sequence & 0xFFFF_FFFF, 0)

    def _prepare(self, tags: tuple[int, ...]) -> None:
        self._template = NavdataTemplate(tags)
        self._put = {name: self._template.filler(tag) for name, tag in TAG_OF.items()}
        self._is_gate_new = True

    def _tags(self) -> tuple[int, ...]:
        """Return the options of a packet; the GPS only if it was requested by its bit."""
        if self.is_bootstrap:
            return ()
        options = int(self._configuration.number("general:navdata_options"))
        gps = (GPS_TAG,) if options >> GPS_TAG & 1 else ()
        if not self._configuration.flag("general:navdata_demo"):
            return (*FULL_TAGS, *gps)
        return (*(tag for tag in FULL_TAGS if tag == 0 or options >> tag & 1), *gps)


class NavdataContent:
    """Fills packets with the state of one aircraft."""

    def __init__(self, state: OnboardState, rotor_max_rad_s: float) -> None:
        self._state = state
        self._rotor_max_rad_s = rotor_max_rad_s
        self._gps: messages.Gps | None = None
        self._rotors_rad_s: tuple[float, ...] = ()
        self._sonar: messages.Sonar | None = None
        self._attitude: Quaternion | None = None
        self._angles_deg = (0.0, 0.0, 0.0)
        self._unwrapped_deg = 0.0

    def update(self, message: Any) -> None:
        """Keep a message of the drone that the onboard state does not keep."""
        match message:
            case messages.Gps():
                self._gps = message
            case messages.Sonar():
                self._sonar = message
            case flight_messages.Truth():
                self._rotors_rad_s = message.rotor_rad_s

    @property
    def is_sonar_deaf(self) -> bool:
        """Whether the sonar had no echo last."""
        return self._sonar is not None and not self._sonar.valid

    @property
    def heading_deg(self) -> float:
        """Heading by the magnetometer, clockwise from magnetic north, in (-180, 180]; 0 without one."""
        mag = self._state.mag
        if mag is None:
            return 0.0
        theta_deg, phi_deg, _ = self.angles_deg
        roll, pitch = math.radians(phi_deg), math.radians(-theta_deg)  # right side down, nose down
        x, y, z = mag.field_ut
        sine_roll, cosine_roll = math.sin(roll), math.cos(roll)
        forward = x * math.cos(pitch) + math.sin(pitch) * (sine_roll * y + cosine_roll * z)
        left = cosine_roll * y - sine_roll * z
        return math.degrees(math.atan2(left, forward))

    @property
    def angles_deg(self) -> Vector:
        """Theta nose up, phi to the right, psi clockwise."""
        if self._attitude is not self._state.attitude:
            self._attitude = self._state.attitude
            last_psi_deg = self._angles_deg[2]
            self._angles_deg = angles_deg(self._attitude)
            self._unwrapped_deg += (self._angles_deg[2] - last_psi_deg + 180.0) % 360.0 - 180.0
        return self._angles_deg

    def fill_packet(self, put: Putters, ctrl_state: int, t_ns: int) -> None:
        state = self._state
        theta, phi, psi = (1e3 * angle for angle in self.angles_deg)
        charge = state.status.battery_percent if state.status else 0.0
        velocity = state.flow.velocity_m_s if state.flow else (0.0, 0.0, 0.0)
        vx, vy, vz = 1e3 * velocity[0], -1e3 * velocity[1], -1e3 * velocity[2]
        altitude_mm = max(0, round(1e3 * state.altitude_m))
        put["demo"](ctrl_state, round(charge), theta, phi, psi, altitude_mm, vx, vy, vz, *_UNUSED_OF_DEMO)
        seconds, rest_ns = divmod(max(0, t_ns), SECOND_NS)
        put["time"]((seconds & SECONDS_MASK) << SECONDS_SHIFT | rest_ns // 1000)  # begins again after 2048 s
        put["euler_angles"](theta, phi)
        if state.imu is not None:
            fx, fy, fz = (accel / G_M_S2 for accel in state.imu.accel_m_s2)
            p, q, r = (math.degrees(rate) for rate in state.imu.gyro_rad_s)
            put["phys_measures"](0.0, 0, 1e3 * fx, -1e3 * fy, -1e3 * fz, p, -q, -r, 0, 0, 0)
            accs = [round(min(max(ACCEL_ZERO_LSB + ACCEL_LSB_PER_G * f, 0), 2 * _INT16)) for f in (fx, -fy, fz)]
            gyros = [_int16(GYRO_LSB_PER_DEG_S * rate) for rate in (p, -q, -r)]
            put["raw_measures"](*accs, *gyros, 0, 0, round(voltage_mv(charge)), *(0,) * 10, self._echo_mm(), 0)

    def _echo_mm(self) -> int:
        return round(1e3 * self._sonar.range_m) if self._sonar and self._sonar.valid else 0

    def fill_gate(self, put: Putters, tags: tuple[int, ...]) -> None:
        """Fill the values that change with a gate; omitted options cost nothing."""
        state = self._state
        climb_mm_s = 1e3 * state.flow.velocity_m_s[2] if state.flow else 0.0
        if PWM in tags:
            motors = [0, 0, 0, 0]
            for i, speed in enumerate(self._rotors_rad_s[:4]):
                motors[i] = min(PWM_MAX, max(0, round(PWM_MAX * speed / self._rotor_max_rad_s)))
            put["pwm"](*motors, *(0,) * 4, *(0.0,) * 4, *(0,) * 3, 0.0, *(0,) * 3, 0.0, *(0,) * 4, 0.0, 0.0)
        if ALTITUDE in tags:
            altitude_mm = max(0, round(1e3 * state.altitude_m))
            put["altitude"](altitude_mm, climb_mm_s, 0, self._echo_mm(), *(0.0,) * 5, 0, 0.0, 0.0, 0)
        if PRESSURE in tags:
            put["pressure_raw"](0, 0, 0, round(state.baro.pressure_pa) if state.baro else 0)
        if MAGNETO in tags:
            x, y, z = state.mag.field_ut if state.mag else (0.0, 0.0, 0.0)
            field_ut = (x, -y, -z)
            lsb = [_int16(each / MAG_UT_PER_LSB) for each in field_ut]
            field_mg = [MG_PER_UT * each for each in field_ut]
            heading_deg, radius = self.heading_deg, math.hypot(*field_ut) / MAG_UT_PER_LSB
            headings = (heading_deg, self._unwrapped_deg, heading_deg)
            is_calibrated = int(state.mag is not None)
            put["magneto"](*lsb, *field_mg, *field_mg, 0.0, 0.0, 0.0, *headings, is_calibrated, 0, radius, 0.0, 0.0)
        if KALMAN_PRESSURE in tags:
            height_mm = 1e3 * state.altitude_m
            put["kalman_pressure"](0.0, height_mm, climb_mm_s, *(0.0,) * 7, 0, 0.0, 0, 0.0, 0.0, 0, 0)
        if GPS_TAG in tags and self._gps is not None:
            self._fill_gps(put["gps"], self._gps)

    def _fill_gps(self, put: Callable[..., None], gps: messages.Gps) -> None:
        has_fix = int(gps.fix >= FIX_3D)
        option = LAYOUTS[GPS_TAG].zeros()
        option = option._replace(
            latitude_deg=gps.latitude_deg,
            longitude_deg=gps.longitude_deg,
            elevation_m=gps.altitude_m,
            hdop=1.0,
            data_available=has_fix,
            zero_validated=has_fix,
            lat_fused_deg=gps.latitude_deg,
            lon_fused_deg=gps.longitude_deg,
            gps_state=has_fix,
            speed_m_s=math.hypot(gps.velocity_m_s[0], gps.velocity_m_s[1]),
            degree=math.degrees(math.atan2(gps.velocity_m_s[0], gps.velocity_m_s[1])) % 360.0,
            ehpe_m=gps.sigma_m,
            satellites=gps.satellites,
            plugged=1,
        )
        put(*LAYOUTS[GPS_TAG].flat(option))


def angles_deg(q_WB: Quaternion) -> Vector:
    """Return theta nose up, phi to the right and psi clockwise [deg] of an attitude; psi is 0 towards east."""
    w, x, y, z = q_WB
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return -math.degrees(pitch), math.degrees(roll), -math.degrees(yaw)


def voltage_mv(charge_percent: float) -> float:
    for (low, low_mv), (high, high_mv) in pairwise(VOLTAGE_MV):
        if charge_percent <= high:
            return low_mv + (high_mv - low_mv) * max(0.0, charge_percent - low) / (high - low)
    return VOLTAGE_MV[-1][1]


def _int16(value: float) -> int:
    return round(min(max(value, -_INT16), _INT16))
