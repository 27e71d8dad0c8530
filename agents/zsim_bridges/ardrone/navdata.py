"""Navdata: the packets that an aircraft sends from UDP port 5554, the table of their options, and their contents.

A packet consists of a header (magic, state bits, sequence number, vision flag; uint32 each), options, and finally the
checksum option, the sum of all bytes before it. An option begins with its tag and its size in bytes, both uint16; the
size includes these four bytes. Everything is little-endian and packed. The table has the format described in
`wire_table`. Angles, in millidegrees where a name says so: theta nose up, phi right side down, psi clockwise from the
heading at switch-on. The body axes are x forward, y right, z down.

The packets come first, then `NavdataSender`, which schedules them, and `NavdataContent`, which fills them. No I/O.
Source: AR.Drone Developer Guide SDK 2.0, chapter 7; ARDroneLib (SDK 2.0.1), navdata_common.h and config.h; for the GPS
option of firmware 2.4 and later, ARDroneLib's branch `gps`.
"""

import math
import struct
from collections import namedtuple
from collections.abc import Callable, Hashable, Iterable, Sequence
from enum import IntEnum, IntFlag
from typing import Any, NamedTuple

import numpy as np

from zsim.contract import flight_messages, messages
from zsim.math.rotation import Quaternion, Vector
from zsim.schema.quantities import G_M_S2
from zsim_bridges.ardrone.at_commands import Configuration
from zsim_bridges.vehicle_links.drone_link import OnboardState
from zsim_bridges.vehicle_links.wire_table import Entry, WireLayout, read_table

PORT = 5554  # UDP (ARDroneLib, config.h)
REQUEST_UNICAST = b"\x01\x00\x00\x00"  # a program's request for navdata (ARDroneLib, navdata client)
MAGIC = 0x5566_7788
MAGICS = (MAGIC, 0x5566_7789)  # the second is sent by newer firmware (npm ar-drone, parseNavdata.js)
DEMO_RATE_HZ, FULL_RATE_HZ = 15, 200  # Developer Guide 7.1
# Option `time`: seconds above, microseconds below (navdata_common.h)
SECONDS_SHIFT, MICROSECONDS_MASK = 21, (1 << 21) - 1
OPTION_HEADER = struct.Struct("<HH")  # tag and size of an option
CHECKSUM_TAG = 0xFFFF
GPS_TAG = 27  # in older SDKs, the tag of option zimmu_3000, of 12 bytes
CLIENTS_MAX = 8  # maximum number of programs that receive navdata; a further one displaces the oldest
REQUEST_PREFIXES = (b"\x01", b"Init")  # first bytes of a request for navdata (ARDroneLib; its Windows client)
SECOND_NS = 1_000_000_000
# Nominal scale and zero of the raw accelerometer (measured: 516 to 518, 2031 to 2038)
ACCEL_LSB_PER_G, ACCEL_ZERO_LSB = 512, 2048
GYRO_LSB_PER_DEG_S = 16.4  # scale of the raw gyro (measured on an aircraft)
MAG_UT_PER_LSB = 0.3  # uT (AK8975 datasheet)
MG_PER_UT = 10.0  # milligauss per microtesla
PWM_MAX = 255  # PWM at a motor's maximum speed; assumed proportional to speed, since the true curve is not published
VOLTAGE_MV = (0.0, 10.0, 50.0, 100.0), (9000.0, 10_500.0, 11_686.0, 12_500.0)
"""Charges [%] and voltages [mV] of the battery: 0 % is the SDK's vbat_min, 50 % was measured on an aircraft, and the
other points are assumed."""
SECONDS_MASK = 0x7FF  # the seconds in option `time` have 11 bits
FIX_3D = 3  # fix type of a GPS receiver, as in NMEA
_INT16 = 32_767
_DEMO_UNUSED = (0, *(0.0,) * 12, 0, 0, *(0.0,) * 12)  # frame count and camera detections
Send = Callable[[bytes, Hashable], None]
"""Sends a datagram to an address."""
OptionWriters = dict[str, Callable[..., None]]
"""Functions that write an option's numbers, by the option's name."""
_PACKET_HEADER = struct.Struct("<IIII")
_CHECKSUM = struct.Struct("<HHI")
_CHECKSUM_MODULUS = 1 << 32

_TABLE = f"""
0 demo ctrl_state,battery_percent:I theta_mdeg,phi_mdeg,psi_mdeg:f altitude_mm:i vx_mm_s,vy_mm_s,vz_mm_s:f
    num_frames:I detection_camera_rot:9f detection_camera_trans:3f detection_tag_index,detection_camera_type:I
    drone_camera_rot:9f drone_camera_trans:3f
1 time time:I
2 raw_measures raw_accs:3H raw_gyros:3h raw_gyros_110:2h vbat_raw_mv:I us_debut_echo,us_fin_echo:H
    us_association_echo,us_distance_echo,us_courbe_temps,us_courbe_valeur,us_courbe_ref,flag_echo_ini,nb_echo:H
    sum_echo:I alt_temp_raw_mm:i gradient:h
3 phys_measures accs_temp_degc:f gyro_temp:H phys_accs_mg:3f phys_gyros_deg_s:3f alim3V3,vrefEpson,vrefIDG:I
4 gyros_offsets offset_g:3f
5 euler_angles theta_a_mdeg,phi_a_mdeg:f
6 references ref_theta,ref_phi,ref_theta_I,ref_phi_I,ref_pitch,ref_roll,ref_yaw,ref_psi:i
    vx_ref,vy_ref,theta_mod,phi_mod,k_v_x,k_v_y:f k_mode:I ui_time,ui_theta,ui_phi,ui_psi,ui_psi_accuracy:f ui_seq:i
7 trims angular_rates_trim_r,euler_angles_trim_theta,euler_angles_trim_phi:f
8 rc_references rc_ref_pitch,rc_ref_roll,rc_ref_yaw,rc_ref_gaz,rc_ref_ag:i
9 pwm motor:4B sat_motor:4B gaz_feed_forward,gaz_altitude,altitude_integral,vz_ref:f u_pitch,u_roll,u_yaw:i yaw_u_I:f
    u_pitch_planif,u_roll_planif,u_yaw_planif:i u_gaz_planif:f current_motor_ma:4H altitude_prop,altitude_der:f
10 altitude altitude_vision_mm:i altitude_vz:f altitude_ref_mm,altitude_raw_mm:i obs_accZ,obs_alt:f obs_x:3f
    obs_state:I est_vb:2f est_state:I
11 vision_raw vision_tx_raw,vision_ty_raw,vision_tz_raw:f
12 vision_of of_dx:5f of_dy:5f
13 vision vision_state:I vision_misc:i vision_phi_trim,vision_phi_ref_prop,vision_theta_trim,vision_theta_ref_prop:f
    new_raw_picture:i theta_capture,phi_capture,psi_capture:f altitude_capture:i time_capture:I body_v:3f
    delta_phi,delta_theta,delta_psi:f gold_defined,gold_reset:I gold_x,gold_y:f
14 vision_perf time_szo,time_corners,time_compute,time_tracking,time_trans,time_update:f time_custom:20f
15 trackers_send locked:30i point:60i
16 vision_detect nb_detected:I type:4I xc:4I yc:4I width:4I height:4I dist_cm:4I orientation_angle_deg:4f rotation:36f
    translation:12f camera_source:4I
17 watchdog watchdog:i
18 adc_data_frame version:I data_frame:32B
19 video_stream quant:B frame_size,frame_number,atcmd_ref_seq,atcmd_mean_ref_gap_ms:I atcmd_var_ref_gap:f
    atcmd_ref_quality,out_bitrate,desired_bitrate:I data:5i tcp_queue_level,fifo_queue_level:I
20 games double_tap_counter,finish_line_counter:I
21 pressure_raw up:i ut:h temperature_ddegc,pressure_pa:i
22 magneto mx,my,mz:h magneto_raw_mg:3f magneto_rectified:3f magneto_offset:3f
    heading_unwrapped_deg,heading_gyro_unwrapped_deg,heading_fusion_unwrapped_deg:f magneto_calibration_ok:B
    magneto_state:I magneto_radius,error_mean,error_var:f
23 wind_speed wind_speed_m_s,wind_angle_rad,wind_compensation_theta,wind_compensation_phi:f state_x:6f magneto_debug:3f
24 kalman_pressure offset_pressure,est_z_mm,est_zdot_mm_s,est_bias_PWM,est_biais_pression,offset_US,prediction_US:f
    cov_alt,cov_PWM,cov_vitesse:f bool_effet_sol:I somme_inno:f flag_rejet_US:I u_multisinus,gaz_altitude:f
    flag_multisinus,flag_multisinus_debut:I
25 hdvideo_stream hdvideo_state,storage_fifo_nb_packets,storage_fifo_size,usbkey_size_kb,usbkey_freespace_kb:I
    frame_number,usbkey_remaining_time_s:I
26 wifi link_quality:I
{GPS_TAG} gps latitude_deg,longitude_deg,elevation_m,hdop:d data_available,zero_validated,wpt_validated:i
    lat0_deg,lon0_deg,lat_fused_deg,lon_fused_deg:d gps_state:I X_traj,X_ref,Y_traj,Y_ref:f
    theta_p,phi_p,theta_i,phi_i,theta_d,phi_d:f vdop,pdop:d speed_m_s:f last_frame_time:I
    degree,degree_mag,ehpe_m,ehve_m_s,c_n0:f satellites:I channels:24B plugged:i ephemeris:I vx_traj,vy_traj:f
    firmware_status:I
28 camera_settings temperature:h
29 host flag:i gaz,yaw,phi,theta,magneto_psi,magneto_psi_accuracy:f
{CHECKSUM_TAG} cks value:I
"""


class OptionLayout(WireLayout):
    """The layout of an option; `size` [bytes] includes the header; `make` builds a NamedTuple of the fields."""

    def __init__(self, entry: Entry) -> None:
        super().__init__(entry.fields)
        self.tag, self.name = entry.number, entry.name
        self.size = OPTION_HEADER.size + self.codec.size
        self.make: Callable[..., Any] = namedtuple(entry.name, [field.name for field in entry.fields])

    def zeros(self) -> Any:
        return self.option(self.codec.unpack(bytes(self.codec.size)))

    def option(self, numbers: Sequence[Any]) -> Any:
        return self.make(*self.nested(numbers))


LAYOUTS = {entry.number: OptionLayout(entry) for entry in read_table(_TABLE)}
"""Layouts by tag."""
TAGS_BY_NAME = {layout.name: tag for tag, layout in LAYOUTS.items()}
FULL_TAGS = tuple(tag for tag in LAYOUTS if tag < GPS_TAG)
"""The options of a full packet, which has 1904 bytes. The GPS option is sent only on request, because clients disagree
about the meaning of its tag."""
DEMO, TIME, PHYS, PWM = (TAGS_BY_NAME[name] for name in ("demo", "time", "phys_measures", "pwm"))
ALTITUDE, PRESSURE, MAGNETO = (TAGS_BY_NAME[name] for name in ("altitude", "pressure_raw", "magneto"))
KALMAN_PRESSURE = TAGS_BY_NAME["kalman_pressure"]


StateBit = IntFlag(
    "StateBit",
    "FLYING VIDEO VISION ANGULAR_SPEED_CONTROL ALTITUDE_CONTROL USER_FEEDBACK COMMAND_ACK CAMERA_READY "
    "TRAVELLING USB_READY NAVDATA_DEMO NAVDATA_BOOTSTRAP MOTORS_FAULT COM_LOST SOFTWARE_FAULT BATTERY_LOW "
    "USER_EMERGENCY TIMER_ELAPSED MAGNETO_NEEDS_CALIBRATION ANGLES_OUT_OF_RANGE TOO_MUCH_WIND "
    "ULTRASOUND_DEAF CUTOUT PIC_VERSION_OK AT_THREAD NAVDATA_THREAD VIDEO_THREAD ACQUISITION_THREAD "
    "CONTROL_WATCHDOG ADC_WATCHDOG COM_WATCHDOG EMERGENCY",
)
"""The bits of a packet's state word (ARDroneLib, config.h)."""


ControlState = IntEnum(
    "ControlState", "DEFAULT INIT LANDED FLYING HOVERING TEST TAKING_OFF GO_TO_FIX LANDING LOOPING", start=0
)
"""The upper half of demo's ctrl_state (ARDroneLib, control_states.h)."""


LOST_COM, MAGNETO_CALIBRATION = 8, 12  # values of the lower half of ctrl_state while hovering (control_states.h)


class NavdataError(ValueError):
    """A datagram is not valid navdata; the message states why."""


class Navdata(NamedTuple):
    """A packet.

    Attributes:
        vision: the vision flag, which states whether the camera defines a frame.
        options: options by tag, each a NamedTuple of its fields.
        unknown: contents, by tag, of options that are not in the table or have another size there.
    """

    state: StateBit
    sequence: int
    vision: int
    options: dict[int, Any]
    unknown: dict[int, bytes]

    @property
    def bootstrap(self) -> bool:
        return StateBit.NAVDATA_BOOTSTRAP in self.state


def checksum(packet: bytes | bytearray | memoryview) -> int:
    """Return the checksum of a packet without its checksum option: the sum of all bytes."""
    return int(np.frombuffer(packet, np.uint8).sum(dtype=np.uint64)) % _CHECKSUM_MODULUS


def pack(state: int, sequence: int, vision: int, options: Iterable[tuple[int, Iterable[Any]]] = ()) -> bytes:
    """Return a packet; sequence numbers begin with 1, `options` are pairs of a tag and its values in wire order.

    Raises:
        struct.error: a value is out of range for its field.
    """
    parts = [_PACKET_HEADER.pack(MAGIC, state, sequence, vision)]
    for tag, values in options:
        layout = LAYOUTS[tag]
        parts += [OPTION_HEADER.pack(tag, layout.size), layout.codec.pack(*layout.flat(values))]
    body = b"".join(parts)
    return body + _CHECKSUM.pack(CHECKSUM_TAG, _CHECKSUM.size, checksum(body))


def unpack(datagram: bytes) -> Navdata:
    """Decode a packet.

    Raises:
        NavdataError: the datagram is not a packet, or its checksum is wrong.
    """
    if len(datagram) < _PACKET_HEADER.size + _CHECKSUM.size:
        raise NavdataError(f"has {len(datagram)} bytes; must have at least {_PACKET_HEADER.size + _CHECKSUM.size}")
    magic, state, sequence, vision = _PACKET_HEADER.unpack_from(datagram)
    if magic not in MAGICS:
        raise NavdataError(f"begins with 0x{magic:08x}; must be one of {', '.join(f'0x{each:08x}' for each in MAGICS)}")
    options: dict[int, Any] = {}
    unknown: dict[int, bytes] = {}
    offset = _PACKET_HEADER.size
    while True:
        if offset + OPTION_HEADER.size > len(datagram):
            raise NavdataError("has no checksum")
        tag, size = OPTION_HEADER.unpack_from(datagram, offset)
        smallest, largest = OPTION_HEADER.size, len(datagram) - offset
        if not smallest <= size <= largest:
            allowed = f"at least {smallest}" if size < smallest else f"at most {largest}"
            raise NavdataError(f"option {tag} at byte {offset} has {size} bytes; must have {allowed}")
        if tag == CHECKSUM_TAG:
            if size != _CHECKSUM.size:
                raise NavdataError(f"the checksum's size is {size}; must be {_CHECKSUM.size}")
            received, expected = _CHECKSUM.unpack_from(datagram, offset)[2], checksum(datagram[:offset])
            if received != expected:
                raise NavdataError(f"the checksum is {received}; must be {expected}")
            return Navdata(StateBit(state), sequence, vision, options, unknown)
        layout = LAYOUTS.get(tag)
        if layout is not None and layout.size == size:
            options[tag] = layout.option(layout.codec.unpack_from(datagram, offset + OPTION_HEADER.size))
        else:
            unknown[tag] = datagram[offset + OPTION_HEADER.size : offset + size]
        offset += size


class NavdataTemplate:
    """A packet that is built once and refilled for each transmission; options keep their values until refilled."""

    def __init__(self, tags: Sequence[int]) -> None:
        self.tags = tuple(tags)
        self._packet = bytearray(pack(0, 0, 0, ((tag, LAYOUTS[tag].zeros()) for tag in tags)))
        self._end = len(self._packet) - _CHECKSUM.size
        self._body = np.frombuffer(self._packet, np.uint8)[: self._end]
        self._offsets: dict[int, int] = {}
        offset = _PACKET_HEADER.size
        for tag in tags:
            self._offsets[tag] = offset + OPTION_HEADER.size
            offset += LAYOUTS[tag].size

    def option_writer(self, tag: int) -> Callable[..., None]:
        """Return a function that writes an option's numbers in wire order, or does nothing if the packet lacks it."""
        offset, packet = self._offsets.get(tag), self._packet
        if offset is None:
            return lambda *_: None
        pack_into = LAYOUTS[tag].codec.pack_into
        return lambda *numbers: pack_into(packet, offset, *numbers)

    def packet(self, state: int, sequence: int, vision: int) -> bytes:
        _PACKET_HEADER.pack_into(self._packet, 0, MAGIC, state, sequence, vision)
        total = int(self._body.sum(dtype=np.uint64)) % _CHECKSUM_MODULUS
        _CHECKSUM.pack_into(self._packet, self._end, CHECKSUM_TAG, _CHECKSUM.size, total)
        return bytes(self._packet)


class NavdataSender:
    """Sends an aircraft's navdata: decides when packets are due, which options they contain, and who receives them.

    Args:
        state_bits: returns the state word without the bits of the navdata mode.
        ctrl_state: returns demo's ctrl_state.
        refuse: reports why something cannot be sent.

    Attributes:
        clients: addresses to which navdata is sent, in order of their requests.
        is_bootstrap: whether packets do not contain options yet.
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
        self._last_packet: tuple[int, int] | None = None  # rate [Hz] of the last packet, and its number since time 0
        self.clients: dict[Hashable, None] = {}
        self._sequence = 0
        self._build_template(())
        self.is_bootstrap = True

    def on_request(self, datagram: bytes, address: Hashable, t_ns: int) -> bool:
        """Send navdata to an address from now on; return False if the datagram does not request it."""
        if not datagram.startswith(REQUEST_PREFIXES):
            return False
        if address not in self.clients:
            while len(self.clients) >= CLIENTS_MAX:
                del self.clients[next(iter(self.clients))]
            self.clients[address] = None
            self._send(self._packet(t_ns), address)
        return True

    def on_instant(self, t_ns: int) -> None:
        """Send a packet if one is due: a fixed number in each simulated second, without drift."""
        is_full = not (self.is_bootstrap or self._configuration.flag("general:navdata_demo"))
        rate_hz = FULL_RATE_HZ if is_full else DEMO_RATE_HZ
        slot = rate_hz, t_ns * rate_hz // SECOND_NS
        if self.clients and slot != self._last_packet:
            self._last_packet = slot
            packet = self._packet(t_ns)
            for address in tuple(self.clients):
                self._send(packet, address)

    def on_gate(self) -> None:
        """Have the values that change at gates updated in the next packet."""
        self._is_gate_pending = True

    def _packet(self, t_ns: int) -> bytes:
        tags = self._tags()
        if tags != self._template.tags:
            self._build_template(tags)
        try:
            if self._is_gate_pending:
                self._is_gate_pending = False
                self._content.fill_gate(self._writers, tags)
            self._content.fill_packet(self._writers, self._ctrl_state(), t_ns)
        except (struct.error, ArithmeticError, ValueError) as error:
            self._refuse(f"navdata has a value out of range for its field ({error})")
        self._sequence += 1
        bits = self._state_bits()
        if self.is_bootstrap:
            bits += StateBit.NAVDATA_BOOTSTRAP + StateBit.NAVDATA_DEMO
        elif self._configuration.flag("general:navdata_demo"):
            bits += StateBit.NAVDATA_DEMO
        return self._template.packet(bits, self._sequence & 0xFFFF_FFFF, 0)

    def _build_template(self, tags: tuple[int, ...]) -> None:
        self._template = NavdataTemplate(tags)
        self._writers = {name: self._template.option_writer(tag) for name, tag in TAGS_BY_NAME.items()}
        self._is_gate_pending = True

    def _tags(self) -> tuple[int, ...]:
        """Return the tags of a packet's options; GPS only if its bit in navdata_options is set."""
        if self.is_bootstrap:
            return ()
        options = int(self._configuration.number("general:navdata_options"))
        gps = (GPS_TAG,) if options >> GPS_TAG & 1 else ()
        if not self._configuration.flag("general:navdata_demo"):
            return (*FULL_TAGS, *gps)
        return (*(tag for tag in FULL_TAGS if tag == 0 or options >> tag & 1), *gps)


class NavdataContent:
    """Fills packets with the state of one aircraft; values that no sensor of the drone measures are zero."""

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
        """Store a message of the drone that the onboard state does not store."""
        match message:
            case messages.Gps():
                self._gps = message
            case messages.Sonar():
                self._sonar = message
            case flight_messages.Truth():
                self._rotors_rad_s = message.rotor_rad_s

    @property
    def is_sonar_deaf(self) -> bool:
        """Whether the last sonar reading had no echo."""
        return self._sonar is not None and not self._sonar.valid

    @property
    def heading_deg(self) -> float:
        """Heading from the magnetometer, clockwise from magnetic north, in (-180, 180]; 0 without a reading."""
        mag = self._state.mag
        if mag is None:
            return 0.0
        theta_deg, phi_deg, _ = self.angles_deg
        roll, pitch = math.radians(phi_deg), math.radians(-theta_deg)  # positive right side down, positive nose down
        x, y, z = mag.field_ut
        sine_roll, cosine_roll = math.sin(roll), math.cos(roll)
        forward = x * math.cos(pitch) + math.sin(pitch) * (sine_roll * y + cosine_roll * z)
        left = cosine_roll * y - sine_roll * z
        return math.degrees(math.atan2(left, forward))

    @property
    def angles_deg(self) -> Vector:
        """Angles theta nose up, phi right side down, psi clockwise [deg]."""
        if self._attitude is not self._state.attitude:
            self._attitude = self._state.attitude
            last_psi_deg = self._angles_deg[2]
            self._angles_deg = angles_deg(self._attitude)
            self._unwrapped_deg += (self._angles_deg[2] - last_psi_deg + 180.0) % 360.0 - 180.0
        return self._angles_deg

    def fill_packet(self, write: OptionWriters, ctrl_state: int, t_ns: int) -> None:
        state = self._state
        theta, phi, psi = (1e3 * angle for angle in self.angles_deg)
        charge = state.status.battery_percent if state.status else 0.0
        velocity = state.flow.velocity_m_s if state.flow else (0.0, 0.0, 0.0)
        vx, vy, vz = 1e3 * velocity[0], -1e3 * velocity[1], -1e3 * velocity[2]
        altitude_mm = max(0, round(1e3 * state.altitude_m))
        write["demo"](ctrl_state, round(charge), theta, phi, psi, altitude_mm, vx, vy, vz, *_DEMO_UNUSED)
        seconds, rest_ns = divmod(max(0, t_ns), SECOND_NS)
        write["time"]((seconds & SECONDS_MASK) << SECONDS_SHIFT | rest_ns // 1000)  # wraps around after 2048 s
        write["euler_angles"](theta, phi)
        if state.imu is not None:
            fx, fy, fz = (accel / G_M_S2 for accel in state.imu.accel_m_s2)
            p, q, r = (math.degrees(rate) for rate in state.imu.gyro_rad_s)
            write["phys_measures"](0.0, 0, 1e3 * fx, -1e3 * fy, -1e3 * fz, p, -q, -r, 0, 0, 0)
            accs = [round(min(max(ACCEL_ZERO_LSB + ACCEL_LSB_PER_G * f, 0), 2 * _INT16)) for f in (fx, -fy, fz)]
            gyros = [_int16(GYRO_LSB_PER_DEG_S * rate) for rate in (p, -q, -r)]
            write["raw_measures"](
                *accs, *gyros, 0, 0, round(np.interp(charge, *VOLTAGE_MV)), *(0,) * 10, self._echo_mm(), 0
            )

    def _echo_mm(self) -> int:
        return round(1e3 * self._sonar.range_m) if self._sonar and self._sonar.valid else 0

    def fill_gate(self, write: OptionWriters, tags: tuple[int, ...]) -> None:
        """Fill in the values that change at gates, of the options in `tags` only, to save time."""
        state = self._state
        climb_mm_s = 1e3 * state.flow.velocity_m_s[2] if state.flow else 0.0
        if PWM in tags:
            motors = [0, 0, 0, 0]
            for i, speed in enumerate(self._rotors_rad_s[:4]):
                motors[i] = min(PWM_MAX, max(0, round(PWM_MAX * speed / self._rotor_max_rad_s)))
            write["pwm"](*motors, *(0,) * 4, *(0.0,) * 4, *(0,) * 3, 0.0, *(0,) * 3, 0.0, *(0,) * 4, 0.0, 0.0)
        if ALTITUDE in tags:
            altitude_mm = max(0, round(1e3 * state.altitude_m))
            write["altitude"](altitude_mm, climb_mm_s, 0, self._echo_mm(), *(0.0,) * 5, 0, 0.0, 0.0, 0)
        if PRESSURE in tags:
            write["pressure_raw"](0, 0, 0, round(state.baro.pressure_pa) if state.baro else 0)
        if MAGNETO in tags:
            x, y, z = state.mag.field_ut if state.mag else (0.0, 0.0, 0.0)
            field_ut = (x, -y, -z)
            lsb = [_int16(each / MAG_UT_PER_LSB) for each in field_ut]
            field_mg = [MG_PER_UT * each for each in field_ut]
            heading_deg, radius = self.heading_deg, math.hypot(*field_ut) / MAG_UT_PER_LSB
            headings = (heading_deg, self._unwrapped_deg, heading_deg)
            is_calibrated = int(state.mag is not None)
            write["magneto"](*lsb, *field_mg, *field_mg, 0.0, 0.0, 0.0, *headings, is_calibrated, 0, radius, 0.0, 0.0)
        if KALMAN_PRESSURE in tags:
            height_mm = 1e3 * state.altitude_m
            write["kalman_pressure"](0.0, height_mm, climb_mm_s, *(0.0,) * 7, 0, 0.0, 0, 0.0, 0.0, 0, 0)
        if GPS_TAG in tags and self._gps is not None:
            self._fill_gps(write["gps"], self._gps)

    def _fill_gps(self, write: Callable[..., None], gps: messages.Gps) -> None:
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
        write(*LAYOUTS[GPS_TAG].flat(option))


def angles_deg(q_WB: Quaternion) -> Vector:
    """Return the angles theta nose up, phi right side down, psi clockwise from east [deg] of an attitude."""
    w, x, y, z = q_WB
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return -math.degrees(pitch), math.degrees(roll), -math.degrees(yaw)


def _int16(value: float) -> int:
    return round(min(max(value, -_INT16), _INT16))
