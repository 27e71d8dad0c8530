"""Navdata of one aircraft: which packets are due, with which options, to which programs, and what stands in them.

The SDK's body axes are x forward, y right, z down; its angles theta nose up, phi to the right, psi clockwise, 0 where
the aircraft was switched on. What no sensor of the drone measures is zero.
"""

import math
import struct
from collections.abc import Callable, Hashable
from itertools import pairwise
from typing import Any

from zsim.contract import flight_messages, messages
from zsim.math.rotation import Quaternion, Vector
from zsim.schema.quantities import G_M_S2
from zsim_bridges.ardrone import navdata
from zsim_bridges.ardrone.configuration import Configuration
from zsim_bridges.ardrone.navdata import FULL_TAGS, GPS_TAG, LAYOUTS, SECONDS_SHIFT, TAG_OF, NavdataTemplate
from zsim_bridges.vehicle_links.drone_link import OnboardState

CLIENTS_MAX = 8  # programs that are sent navdata, chosen; beyond, the one that asked first is dropped
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

Send = Callable[[bytes, Hashable], None]
"""Sends a datagram to an address."""


class NavdataSender:
    """Sends an aircraft's navdata.

    Args:
        content: of the packets.
        configuration: of the aircraft.
        send: sends a datagram.
        state_bits: returns the state word without the bits of the mode of navdata.
        ctrl_state: returns the state of the flight.
        refuse: counts what cannot be sent, with the reason.

    Attributes:
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
        self._clients: dict[Hashable, None] = {}
        self._sequence = 0
        self._prepare(())
        self.is_bootstrap = True

    def on_request(self, datagram: bytes, address: Hashable, t_ns: int) -> bool:
        """Send navdata to an address from now on; return False for a datagram that does not ask for it."""
        if not datagram.startswith(REQUESTS):
            return False
        if address not in self._clients:
            while len(self._clients) >= CLIENTS_MAX:
                del self._clients[next(iter(self._clients))]
            self._clients[address] = None
            self._send(self._packet(t_ns), address)
        return True

    def drop_clients(self) -> None:
        """Send no more until it is asked for again."""
        self._clients.clear()

    def on_instant(self, t_ns: int) -> None:
        """Send the packet that is due: a fixed number in each simulated second, without drift."""
        is_full = not (self.is_bootstrap or self._configuration.flag("general:navdata_demo"))
        rate_hz = navdata.FULL_RATE_HZ if is_full else navdata.DEMO_RATE_HZ
        number = rate_hz, t_ns * rate_hz // SECOND_NS
        if self._clients and number != self._last:
            self._last = number
            packet = self._packet(t_ns)
            for address in tuple(self._clients):
                self._send(packet, address)

    def on_gate(self) -> None:
        """Renew what changes at gates."""
        self._is_gate_new = True

    def _packet(self, t_ns: int) -> bytes:
        tags = self._tags()
        if tags != self._template.tags:
            self._prepare(tags)
        try:
            if self._is_gate_new:
                self._is_gate_new = False
                self._fill_gate()
            self._fill_packet(self._ctrl_state(), t_ns)
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
        self._fill_packet, self._fill_gate = self._content.fillers(self._template)
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
    """Fills packets with what is known of one aircraft.

    Args:
        state: what its electronics know.
        rotor_max_rad_s: greatest speed of a rotor.
    """

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
        return magnetic_heading_deg(mag.field_ut, math.radians(phi_deg), math.radians(-theta_deg))

    @property
    def angles_deg(self) -> Vector:
        """Theta nose up, phi to the right, psi clockwise."""
        if self._attitude is not self._state.attitude:
            self._attitude = self._state.attitude
            last_psi_deg = self._angles_deg[2]
            self._angles_deg = angles_deg(self._attitude)
            self._unwrapped_deg += (self._angles_deg[2] - last_psi_deg + 180.0) % 360.0 - 180.0
        return self._angles_deg

    def fillers(self, template: NavdataTemplate) -> tuple[Callable[[int, int], None], Callable[[], None]]:
        """Return what fills a packet of these options: each time, with ctrl_state and time [ns]; once a gate."""
        put = {name: template.filler(tag) for name, tag in TAG_OF.items()}
        at_gates = [
            (fill, put[name])
            for name, fill in (
                ("pwm", self._fill_pwm),
                ("altitude", self._fill_altitude),
                ("pressure_raw", self._fill_pressure),
                ("magneto", self._fill_magneto),
                ("kalman_pressure", self._fill_height),
                ("gps", self._fill_gps),
            )
            if TAG_OF[name] in template.tags  # an option that is left out costs nothing
        ]

        def fill_packet(ctrl_state: int, t_ns: int) -> None:
            self._fill_packet(put, ctrl_state, t_ns)

        def fill_gate() -> None:
            for fill, put_option in at_gates:
                fill(put_option)

        return fill_packet, fill_gate

    def _fill_packet(self, put: dict[str, Callable[..., None]], ctrl_state: int, t_ns: int) -> None:
        state = self._state
        theta, phi, psi = (1e3 * angle for angle in self.angles_deg)
        battery = round(state.status.battery_percent) if state.status else 0
        velocity = state.flow.velocity_m_s if state.flow else (0.0, 0.0, 0.0)
        vx, vy, vz = 1e3 * velocity[0], -1e3 * velocity[1], -1e3 * velocity[2]
        altitude_mm = max(0, round(1e3 * state.altitude_m))
        put["demo"](ctrl_state, battery, theta, phi, psi, altitude_mm, vx, vy, vz, *_UNUSED_OF_DEMO)
        put["time"](sdk_time(t_ns))
        put["euler_angles"](theta, phi)
        if state.imu is not None:
            self._fill_inertial(put, state.imu)

    def _fill_inertial(self, put: dict[str, Callable[..., None]], imu: messages.Imu) -> None:
        fx, fy, fz = (accel / G_M_S2 for accel in imu.accel_m_s2)
        p, q, r = (math.degrees(rate) for rate in imu.gyro_rad_s)
        put["phys_measures"](0.0, 0, 1e3 * fx, -1e3 * fy, -1e3 * fz, p, -q, -r, 0, 0, 0)
        accs = [round(min(max(ACCEL_ZERO_LSB + ACCEL_LSB_PER_G * f, 0), 2 * _INT16)) for f in (fx, -fy, fz)]
        gyros = [_int16(GYRO_LSB_PER_DEG_S * rate) for rate in (p, -q, -r)]
        charge = self._state.status.battery_percent if self._state.status else 0.0
        put["raw_measures"](*accs, *gyros, 0, 0, round(voltage_mv(charge)), *(0,) * 10, self._echo_mm(), 0)

    def _echo_mm(self) -> int:
        return round(1e3 * self._sonar.range_m) if self._sonar and self._sonar.valid else 0

    def _climb_mm_s(self) -> float:
        return 1e3 * self._state.flow.velocity_m_s[2] if self._state.flow else 0.0

    def _fill_pwm(self, put: Callable[..., None]) -> None:
        motors = [0, 0, 0, 0]
        for i, speed in enumerate(self._rotors_rad_s[:4]):
            motors[i] = min(PWM_MAX, max(0, round(PWM_MAX * speed / self._rotor_max_rad_s)))
        put(*motors, *(0,) * 4, *(0.0,) * 4, *(0,) * 3, 0.0, *(0,) * 3, 0.0, *(0,) * 4, 0.0, 0.0)

    def _fill_altitude(self, put: Callable[..., None]) -> None:
        altitude_mm = max(0, round(1e3 * self._state.altitude_m))
        put(altitude_mm, self._climb_mm_s(), 0, self._echo_mm(), *(0.0,) * 5, 0, 0.0, 0.0, 0)

    def _fill_pressure(self, put: Callable[..., None]) -> None:
        baro = self._state.baro
        put(0, 0, 0, round(baro.pressure_pa) if baro else 0)

    def _fill_magneto(self, put: Callable[..., None]) -> None:
        mag = self._state.mag
        x, y, z = mag.field_ut if mag else (0.0, 0.0, 0.0)
        field_ut = (x, -y, -z)
        lsb = [_int16(each / MAG_UT_PER_LSB) for each in field_ut]
        field_mg = [MG_PER_UT * each for each in field_ut]
        heading_deg, radius = self.heading_deg, math.hypot(*field_ut) / MAG_UT_PER_LSB
        headings = (heading_deg, self._unwrapped_deg, heading_deg)
        put(*lsb, *field_mg, *field_mg, 0.0, 0.0, 0.0, *headings, int(mag is not None), 0, radius, 0.0, 0.0)

    def _fill_height(self, put: Callable[..., None]) -> None:
        put(0.0, 1e3 * self._state.altitude_m, self._climb_mm_s(), *(0.0,) * 7, 0, 0.0, 0, 0.0, 0.0, 0, 0)

    def _fill_gps(self, put: Callable[..., None]) -> None:
        gps = self._gps
        if gps is None:
            return
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


def magnetic_heading_deg(field_ut: Vector, roll_rad: float, pitch_rad: float) -> float:
    """Return the heading clockwise from magnetic north, in (-180, 180].

    Args:
        field_ut: in B, forward, left, up.
        roll_rad, pitch_rad: of B, right side down, nose down.
    """
    x, y, z = field_ut
    sine_roll, cosine_roll = math.sin(roll_rad), math.cos(roll_rad)
    forward = x * math.cos(pitch_rad) + math.sin(pitch_rad) * (sine_roll * y + cosine_roll * z)
    left = cosine_roll * y - sine_roll * z
    return math.degrees(math.atan2(left, forward))


def sdk_time(t_ns: int) -> int:
    """Return simulated time in the form of the option `time`, which begins again after 2048 s."""
    seconds, rest_ns = divmod(max(0, t_ns), 1_000_000_000)
    return (seconds & SECONDS_MASK) << SECONDS_SHIFT | rest_ns // 1000


def voltage_mv(charge_percent: float) -> float:
    """Return the battery's voltage [mV] at a charge [%]."""
    for (low, low_mv), (high, high_mv) in pairwise(VOLTAGE_MV):
        if charge_percent <= high:
            return low_mv + (high_mv - low_mv) * max(0.0, charge_percent - low) / (high - low)
    return VOLTAGE_MV[-1][1]


def _int16(value: float) -> int:
    return round(min(max(value, -_INT16), _INT16))
