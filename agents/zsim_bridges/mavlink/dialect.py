"""The MAVLink messages, enumerations (common and ardupilotmega) and frames that vehicles and clients use.

`dialect.Heartbeat(type=2)` is a HEARTBEAT, a record with the fields of its definition. The message table has the format
described in `wire_table` and the units of the definitions; a default is the definition's value for "unknown". Next come
the conversions between axes: W is east, north, up and B forward, left, up, whereas MAVLink uses north, east, down and
forward, right, down. The frames of MAVLink 1 and 2 come last: `Link` packs and signs them, `Parser` decodes datagrams.

Sources: https://mavlink.io/en/messages/common.html and ardupilotmega.html for the definitions;
https://mavlink.io/en/guide/serialization.html for the byte order, CRC_EXTRA, the checksum and frames;
https://mavlink.io/en/guide/message_signing.html for signatures;
https://mavlink.io/en/services/mission.html#mission_item_int for integer coordinates.
"""

import hmac
import math
from binascii import crc_hqx
from collections import Counter
from enum import IntEnum, IntFlag
from hashlib import sha256
from operator import attrgetter
from struct import calcsize
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec

from zsim.math.rotation import Quaternion, Vector
from zsim_bridges.vehicle_links.wire_table import Entry, WireLayout, read_table


class Cmd(IntEnum):
    """MAV_CMD."""

    NAV_WAYPOINT = 16
    NAV_LOITER_UNLIM = 17
    NAV_LOITER_TIME = 19
    NAV_RETURN_TO_LAUNCH = 20
    NAV_LAND = 21
    NAV_TAKEOFF = 22
    NAV_DELAY = 93
    CONDITION_YAW = 115
    DO_SET_MODE = 176
    DO_JUMP = 177
    DO_CHANGE_SPEED = 178
    DO_SET_HOME = 179
    DO_FLIGHTTERMINATION = 185
    DO_REPOSITION = 192
    DO_PAUSE_CONTINUE = 193
    DO_FENCE_ENABLE = 207
    DO_SET_MISSION_CURRENT = 224
    PREFLIGHT_REBOOT_SHUTDOWN = 246
    MISSION_START = 300
    COMPONENT_ARM_DISARM = 400
    GET_HOME_POSITION = 410
    GET_MESSAGE_INTERVAL = 510
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_AUTOPILOT_CAPABILITIES = 520
    FENCE_RETURN_POINT = 5000
    FENCE_POLYGON_INCLUSION = 5001
    FENCE_POLYGON_EXCLUSION = 5002
    FENCE_CIRCLE_INCLUSION = 5003
    FENCE_CIRCLE_EXCLUSION = 5004


Result = IntEnum("Result", "ACCEPTED TEMPORARILY_REJECTED DENIED UNSUPPORTED FAILED IN_PROGRESS", start=0)
"""MAV_RESULT."""


Severity = IntEnum("Severity", "EMERGENCY ALERT CRITICAL ERROR WARNING NOTICE INFO", start=0)
"""MAV_SEVERITY."""


class MissionResult(IntEnum):
    """MAV_MISSION_RESULT."""

    ACCEPTED = 0
    UNSUPPORTED_FRAME = 2
    UNSUPPORTED = 3
    NO_SPACE = 4
    INVALID = 5
    INVALID_SEQUENCE = 13
    OPERATION_CANCELLED = 15


MavFrame = IntEnum(
    "MavFrame",
    "GLOBAL LOCAL_NED MISSION GLOBAL_RELATIVE_ALT LOCAL_ENU GLOBAL_INT GLOBAL_RELATIVE_ALT_INT "
    "LOCAL_OFFSET_NED BODY_NED BODY_OFFSET_NED GLOBAL_TERRAIN_ALT GLOBAL_TERRAIN_ALT_INT BODY_FRD",
    start=0,
)
"""MAV_FRAME."""


class Autopilot(IntEnum):
    """MAV_AUTOPILOT."""

    ARDUPILOTMEGA = 3
    INVALID = 8
    PX4 = 12


class BaseMode(IntFlag):
    """MAV_MODE_FLAG."""

    CUSTOM = 1
    AUTO = 4
    GUIDED = 8
    STABILIZE = 16
    MANUAL_INPUT = 64
    ARMED = 128


class SystemStatus(IntEnum):
    """MAV_STATE."""

    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5
    EMERGENCY = 6
    TERMINATED = 8


LandedState = IntEnum("LandedState", "UNDEFINED ON_GROUND IN_AIR TAKEOFF LANDING", start=0)
"""MAV_LANDED_STATE."""


class SensorBit(IntFlag):
    """MAV_SYS_STATUS_SENSOR: the sensors and subsystems of the vehicles that this bridge presents."""

    GYRO = 0x01
    ACCEL = 0x02
    MAG = 0x04
    BARO = 0x08
    GPS = 0x20
    FLOW = 0x40
    LASER_POSITION = 0x100
    RATE_CONTROL = 0x400
    ATTITUDE_CONTROL = 0x800
    YAW_POSITION = 0x1000
    ALTITUDE_CONTROL = 0x2000
    POSITION_CONTROL = 0x4000
    MOTORS = 0x8000
    AHRS = 0x200000
    BATTERY = 0x2000000
    PREARM_CHECK = 0x10000000


class Capability(IntFlag):
    """MAV_PROTOCOL_CAPABILITY."""

    MISSION_FLOAT = 1
    PARAM_FLOAT = 2
    MISSION_INT = 4
    COMMAND_INT = 8
    PARAM_ENCODE_BYTEWISE = 16
    SET_ATTITUDE_TARGET = 64
    SET_POSITION_TARGET_LOCAL_NED = 128
    SET_POSITION_TARGET_GLOBAL_INT = 256
    FLIGHT_TERMINATION = 2048
    MAVLINK2 = 8192
    MISSION_FENCE = 16384


TypeMask = IntFlag("TypeMask", "X Y Z VX VY VZ AX AY AZ FORCE YAW YAW_RATE")
"""POSITION_TARGET_TYPEMASK: the parts of a setpoint to be ignored; FORCE: the acceleration is a force."""


class AttitudeMask(IntFlag):
    """ATTITUDE_TARGET_TYPEMASK: the parts of a setpoint to be ignored."""

    YAW_RATE = 4
    THRUST = 64
    ATTITUDE = 128


POS_HORIZ_ABS, PRED_POS_HORIZ_ABS = 16, 512  # ESTIMATOR_STATUS_FLAGS, and ArduPilot's EKF_STATUS_FLAGS
ALL_ESTIMATED = 0x37F  # attitude, velocities, height above ground; relative, absolute and predicted positions


class ParamType(IntEnum):
    """MAV_PARAM_TYPE."""

    UINT8 = 1
    INT8 = 2
    UINT16 = 3
    INT16 = 4
    UINT32 = 5
    INT32 = 6
    REAL32 = 9


NO_GPS, NO_FIX = 0, 1  # GPS_FIX_TYPE
FORCE = 21196.0  # param2 of COMPONENT_ARM_DISARM: skip the checks, even in flight
TYPE_QUADROTOR, TYPE_ONBOARD_CONTROLLER = 2, 18  # MAV_TYPE
COMPONENT_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
MISSION, FENCE = 0, 1  # MAV_MISSION_TYPE
ALL_MISSION_TYPES = 255


DEGREES, LOCAL_M = 1e-7, 1e-4  # units of x and y in messages that carry them as integers
INT32_UNKNOWN = 2**31 - 1  # INT32_MAX, which stands for "unknown" in 32-bit integer fields
UINT16_UNKNOWN = 65535  # UINT16_MAX, likewise in unsigned 16-bit fields
_SQRT_HALF = math.sqrt(0.5)
_TARGET = "target_system,target_component:B"
_SETPOINT = "vx,vy,vz:f[m/s] afx,afy,afz:f[m/s/s] yaw:f[rad] yaw_rate:f[rad/s]"
_IMU = "xacc,yacc,zacc:h[mG] xgyro,ygyro,zgyro:h[mrad/s] xmag,ymag,zmag:h[mgauss]"
_GEODETIC = "latitude,longitude:i[degE7] altitude:i[mm]"
_HOME = f"{_GEODETIC} x,y,z:f[m] q:4f approach_x,approach_y,approach_z:f[m] | time_usec:Q[us]"
_CHANNELS = [f"chan{i}_raw:H[us]" for i in range(1, 19)]
_SERVOS = [f"servo{i}_raw:H[us]" for i in range(1, 17)]
_PARAMS = "param1,param2,param3,param4:f"
_ITEM = f"{_TARGET} seq:H frame:B command:H current,autocontinue:B {_PARAMS}"

_TABLE = f"""
# A system and its link: heartbeat, time, versions, texts, files, signing
0 HEARTBEAT type,autopilot,base_mode:B custom_mode:I system_status,mavlink_version:B
1 SYS_STATUS onboard_control_sensors_present,onboard_control_sensors_enabled,onboard_control_sensors_health:I
    load:H[d%] voltage_battery:H[mV] current_battery:h[cA] battery_remaining:b[%] drop_rate_comm:H[c%]
    errors_comm,errors_count1,errors_count2,errors_count3,errors_count4:H | onboard_control_sensors_present_extended:I
    onboard_control_sensors_enabled_extended,onboard_control_sensors_health_extended:I
2 SYSTEM_TIME time_unix_usec:Q[us] time_boot_ms:I[ms]
4 PING time_usec:Q[us] seq:I {_TARGET}
5 CHANGE_OPERATOR_CONTROL target_system,control_request,version:B passkey:25c
109 RADIO_STATUS rssi,remrssi:B txbuf:B[%] noise,remnoise:B rxerrors,fixed:H
110 FILE_TRANSFER_PROTOCOL target_network,{_TARGET} payload:251s
111 TIMESYNC tc1,ts1:q[ns]
117 LOG_REQUEST_LIST {_TARGET} start,end:H
118 LOG_ENTRY id,num_logs,last_log_num:H time_utc:I[s] size:I[bytes]
125 POWER_STATUS Vcc,Vservo:H[mV] flags:H
147 BATTERY_STATUS id,battery_function,type:B temperature:h[cdegC]=32767 voltages:10H[mV]=65535 current_battery:h[cA]=-1
    current_consumed:i[mAh]=-1 energy_consumed:i[hJ]=-1 battery_remaining:b[%]=-1
    | time_remaining:i[s] charge_state:B voltages_ext:4H[mV] mode:B fault_bitmask:I
148 AUTOPILOT_VERSION capabilities:Q flight_sw_version,middleware_sw_version,os_sw_version,board_version:I
    flight_custom_version,middleware_custom_version,os_custom_version:8s vendor_id,product_id:H uid:Q | uid2:18s
152 MEMINFO brkval:H freemem:H[bytes] | freemem32:I[bytes]
183 AUTOPILOT_VERSION_REQUEST {_TARGET}
245 EXTENDED_SYS_STATE vtol_state,landed_state:B
253 STATUSTEXT severity:B text:50c | id:H chunk_seq:B
256 SETUP_SIGNING {_TARGET} secret_key:32s initial_timestamp:Q

# Commands, parameters, rates
11 SET_MODE target_system,base_mode:B custom_mode:I
20 PARAM_REQUEST_READ {_TARGET} param_id:16c param_index:h
21 PARAM_REQUEST_LIST {_TARGET}
22 PARAM_VALUE param_id:16c param_value:f param_type:B param_count,param_index:H
23 PARAM_SET {_TARGET} param_id:16c param_value:f param_type:B
66 REQUEST_DATA_STREAM {_TARGET} req_stream_id:B req_message_rate:H[Hz] start_stop:B
67 DATA_STREAM stream_id:B message_rate:H[Hz] on_off:B
75 COMMAND_INT {_TARGET} frame:B command:H current,autocontinue:B {_PARAMS} x,y:i z:f
76 COMMAND_LONG {_TARGET} command:H confirmation:B {_PARAMS} param5,param6,param7:f
77 COMMAND_ACK command:H result:B | progress:B result_param2:i {_TARGET}
80 COMMAND_CANCEL {_TARGET} command:H
244 MESSAGE_INTERVAL message_id:H interval_us:i[us]
345 PARAM_ERROR {_TARGET} param_id:16c param_index:h error:B

# Missions, geofences and rally points; x and y of an integer item are in 1e-7 deg, in local frames in 1e-4 m
37 MISSION_REQUEST_PARTIAL_LIST {_TARGET} start_index,end_index:h | mission_type:B
38 MISSION_WRITE_PARTIAL_LIST {_TARGET} start_index,end_index:h | mission_type:B
39 MISSION_ITEM {_ITEM} x,y,z:f | mission_type:B
40 MISSION_REQUEST {_TARGET} seq:H | mission_type:B
41 MISSION_SET_CURRENT {_TARGET} seq:H
42 MISSION_CURRENT seq:H | total:H mission_state,mission_mode:B
43 MISSION_REQUEST_LIST {_TARGET} | mission_type:B
44 MISSION_COUNT {_TARGET} count:H | mission_type:B
45 MISSION_CLEAR_ALL {_TARGET} | mission_type:B
46 MISSION_ITEM_REACHED seq:H
47 MISSION_ACK {_TARGET} type:B | mission_type:B
51 MISSION_REQUEST_INT {_TARGET} seq:H | mission_type:B
73 MISSION_ITEM_INT {_ITEM} x,y:i z:f | mission_type:B

# What steers a vehicle
69 MANUAL_CONTROL target:B x,y,z,r:h buttons:H
    | buttons2:H enabled_extensions:B s,t,aux1,aux2,aux3,aux4,aux5,aux6:h
70 RC_CHANNELS_OVERRIDE {_TARGET} {" ".join(_CHANNELS[:8])} | {" ".join(_CHANNELS[8:])}
82 SET_ATTITUDE_TARGET time_boot_ms:I[ms] {_TARGET} type_mask:B q:4f
    body_roll_rate,body_pitch_rate,body_yaw_rate:f[rad/s] thrust:f
84 SET_POSITION_TARGET_LOCAL_NED time_boot_ms:I[ms] {_TARGET} coordinate_frame:B type_mask:H x,y,z:f[m] {_SETPOINT}
86 SET_POSITION_TARGET_GLOBAL_INT time_boot_ms:I[ms] {_TARGET} coordinate_frame:B type_mask:H
    lat_int,lon_int:i[degE7] alt:f[m] {_SETPOINT}
144 FOLLOW_TARGET timestamp:Q[ms] est_capabilities:B lat,lon:i[degE7] alt:f[m] vel:3f[m/s] acc:3f[m/s/s] attitude_q:4f
    rates:3f position_cov:3f custom_state:Q

# Places: origin, home, targets, fence, external pose measurements
48 SET_GPS_GLOBAL_ORIGIN target_system:B {_GEODETIC} | time_usec:Q[us]
49 GPS_GLOBAL_ORIGIN {_GEODETIC} | time_usec:Q[us]
62 NAV_CONTROLLER_OUTPUT nav_roll,nav_pitch:f[deg] nav_bearing,target_bearing:h[deg] wp_dist:H[m] alt_error:f[m]
    aspd_error:f[m/s] xtrack_error:f[m]
83 ATTITUDE_TARGET time_boot_ms:I[ms] type_mask:B q:4f body_roll_rate,body_pitch_rate,body_yaw_rate:f[rad/s] thrust:f
85 POSITION_TARGET_LOCAL_NED time_boot_ms:I[ms] coordinate_frame:B type_mask:H x,y,z:f[m] {_SETPOINT}
87 POSITION_TARGET_GLOBAL_INT time_boot_ms:I[ms] coordinate_frame:B type_mask:H
    lat_int,lon_int:i[degE7] alt:f[m] {_SETPOINT}
102 VISION_POSITION_ESTIMATE usec:Q[us] x,y,z:f[m] roll,pitch,yaw:f[rad] | covariance:21f reset_counter:B
138 ATT_POS_MOCAP time_usec:Q[us] q:4f x,y,z:f[m] | covariance:21f
149 LANDING_TARGET time_usec:Q[us] target_num,frame:B angle_x,angle_y:f[rad] distance:f[m] size_x,size_y:f[rad]
    | x,y,z:f[m] q:4f type,position_valid:B
162 FENCE_STATUS breach_status:B breach_count:H breach_type:B breach_time:I[ms] | breach_mitigation:B
242 HOME_POSITION {_HOME}
243 SET_HOME_POSITION target_system:B {_HOME}

# Estimated state of a vehicle; attitudes are body to NED, w first
30 ATTITUDE time_boot_ms:I[ms] roll,pitch,yaw:f[rad] rollspeed,pitchspeed,yawspeed:f[rad/s]
31 ATTITUDE_QUATERNION time_boot_ms:I[ms] q1,q2,q3,q4:f rollspeed,pitchspeed,yawspeed:f[rad/s] | repr_offset_q:4f
32 LOCAL_POSITION_NED time_boot_ms:I[ms] x,y,z:f[m] vx,vy,vz:f[m/s]
33 GLOBAL_POSITION_INT time_boot_ms:I[ms] lat,lon:i[degE7] alt,relative_alt:i[mm] vx,vy,vz:h[cm/s] hdg:H[cdeg]
74 VFR_HUD airspeed,groundspeed:f[m/s] heading:h[deg] throttle:H[%] alt:f[m] climb:f[m/s]
141 ALTITUDE time_usec:Q[us]
    altitude_monotonic,altitude_amsl,altitude_local,altitude_relative,altitude_terrain,bottom_clearance:f[m]
178 AHRS2 roll,pitch,yaw:f[rad] altitude:f[m] lat,lng:i[degE7]
193 EKF_STATUS_REPORT flags:H velocity_variance,pos_horiz_variance,pos_vert_variance,compass_variance:f
    terrain_alt_variance:f | airspeed_variance:f
230 ESTIMATOR_STATUS time_usec:Q[us] flags:H
    vel_ratio,pos_horiz_ratio,pos_vert_ratio,mag_ratio,hagl_ratio,tas_ratio:f pos_horiz_accuracy,pos_vert_accuracy:f[m]
331 ODOMETRY time_usec:Q[us] frame_id,child_frame_id:B x,y,z:f[m] q:4f vx,vy,vz:f[m/s]
    rollspeed,pitchspeed,yawspeed:f[rad/s] pose_covariance,velocity_covariance:21f
    | reset_counter,estimator_type:B quality:b[%]

# What sensors measured
24 GPS_RAW_INT time_usec:Q[us] fix_type:B lat,lon:i[degE7] alt:i[mm] eph,epv:H=65535 vel:H[cm/s]=65535
    cog:H[cdeg]=65535 satellites_visible:B
    | alt_ellipsoid:i[mm] h_acc,v_acc:I[mm] vel_acc:I[mm/s] hdg_acc:I[degE5] yaw:H[cdeg]
26 SCALED_IMU time_boot_ms:I[ms] {_IMU} | temperature:h[cdegC]
27 RAW_IMU time_usec:Q[us] {_IMU} | id:B temperature:h[cdegC]
29 SCALED_PRESSURE time_boot_ms:I[ms] press_abs,press_diff:f[hPa] temperature:h[cdegC]
    | temperature_press_diff:h[cdegC]
36 SERVO_OUTPUT_RAW time_usec:I[us] port:B {" ".join(_SERVOS[:8])} | {" ".join(_SERVOS[8:])}
65 RC_CHANNELS time_boot_ms:I[ms] chancount:B {" ".join(_CHANNELS)} rssi:B
100 OPTICAL_FLOW time_usec:Q[us] sensor_id:B flow_x,flow_y:h flow_comp_m_x,flow_comp_m_y:f[m/s] quality:B
    ground_distance:f[m] | flow_rate_x,flow_rate_y:f[rad/s]
105 HIGHRES_IMU time_usec:Q[us] xacc,yacc,zacc:f[m/s/s] xgyro,ygyro,zgyro:f[rad/s] xmag,ymag,zmag:f[gauss]
    abs_pressure,diff_pressure:f[hPa] pressure_alt:f temperature:f[degC] fields_updated:H | id:B
106 OPTICAL_FLOW_RAD time_usec:Q[us] sensor_id:B integration_time_us:I[us] integrated_x,integrated_y:f[rad]
    integrated_xgyro,integrated_ygyro,integrated_zgyro:f[rad] temperature:h[cdegC] quality:B
    time_delta_distance_us:I[us] distance:f[m]
116 SCALED_IMU2 time_boot_ms:I[ms] {_IMU} | temperature:h[cdegC]
132 DISTANCE_SENSOR time_boot_ms:I[ms] min_distance,max_distance,current_distance:H[cm] type,id,orientation:B
    covariance:B[cm^2]=255 | horizontal_fov,vertical_fov:f[rad] quaternion:4f signal_quality:B[%]
173 RANGEFINDER distance:f[m] voltage:f[V]
231 WIND_COV time_usec:Q[us] wind_x,wind_y,wind_z:f[m/s] var_horiz,var_vert:f[m/s] wind_alt:f[m]
    horiz_accuracy,vert_accuracy:f[m/s]
241 VIBRATION time_usec:Q[us] vibration_x,vibration_y,vibration_z:f clipping_0,clipping_1,clipping_2:I
"""

_C_TYPES = {
    "c": "char", "s": "uint8_t", "B": "uint8_t", "b": "int8_t", "H": "uint16_t", "h": "int16_t", "I": "uint32_t",
    "i": "int32_t", "Q": "uint64_t", "q": "int64_t", "f": "float", "d": "double",
}  # fmt: skip
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def checksum(data: bytes) -> int:
    """Return the CRC-16/MCRF4XX of data: the CCITT polynomial with reflected bits and the initial value 0xFFFF.

    `crc_hqx`, written in C, uses the same polynomial with the opposite bit order.
    """
    crc = crc_hqx(data.translate(_REVERSED), 0xFFFF)
    return _REVERSED[crc & 0xFF] << 8 | _REVERSED[crc >> 8]


class WireMessage(msgspec.Struct, gc=False):
    """Base class of all messages."""


class MessageLayout(WireLayout):
    """The payload layout of one message type: fields with the largest elements first, then extensions as defined.

    Attributes:
        crc_extra: checksum of the definition, so that peers with different definitions reject each other's messages.
        size, base_size: payload size [bytes] with the extensions, and without them as in MAVLink 1.
        wire_order: field names in payload order.
    """

    def __init__(self, entry: Entry) -> None:
        base = sorted(entry.fields, key=lambda field: -calcsize(f"<{field.code}"))
        super().__init__([*entry.fields, *entry.extensions], [*base, *entry.extensions])
        self.id, self.name = entry.number, entry.name
        self.size, self.base_size = self.codec.size, WireLayout(base).codec.size
        text = f"{self.name} ".encode()
        for field in base:
            text += f"{_C_TYPES[field.code]} {field.name} ".encode() + bytes([field.length] if field.length else [])
        crc = checksum(text)
        self.crc_extra = crc & 0xFF ^ crc >> 8
        self.wire_order = tuple(field.name for field in (*base, *entry.extensions))
        self._wire_values = attrgetter(*self.wire_order) if len(self.wire_order) > 1 else self._only_value
        name = self.name.replace("_", " ").title().replace(" ", "")
        fields = [(field.name, type(field.default_value), field.default_value) for field in self.fields]
        kind: Any = msgspec.defstruct(name, fields, bases=(WireMessage,), gc=False, module=__name__)
        self.kind: type[WireMessage] = kind

    def _only_value(self, message: WireMessage) -> tuple[Any]:
        return (getattr(message, self.wire_order[0]),)

    def pack(self, message: WireMessage) -> bytes:
        """Return the complete payload, with its extensions and trailing zeros.

        Raises:
            struct.error, OverflowError: a value is out of range for its type, or an array has the wrong length.
        """
        values = self._wire_values(message)
        return self.codec.pack(*(values if self.is_flat else self.flat(values)))

    def unpack(self, payload: bytes) -> WireMessage:
        """Return the message in a payload; missing trailing bytes are taken as 0, excess bytes ignored."""
        if len(payload) != self.size:
            payload = payload[: self.size].ljust(self.size, b"\0")
        return self.kind(*self.nested(self.codec.unpack(payload)))


BY_ID = {entry.number: MessageLayout(entry) for entry in read_table(_TABLE)}
LAYOUTS: dict[type[WireMessage], MessageLayout] = {layout.kind: layout for layout in BY_ID.values()}
globals().update({kind.__name__: kind for kind in LAYOUTS})

if TYPE_CHECKING:

    def __getattr__(name: str) -> Any: ...


def ned(v_W: Vector) -> Vector:
    """Convert a vector from W to north, east, down, or back."""
    return v_W[1], v_W[0], -v_W[2]


def frd(v_B: Vector) -> Vector:
    """Convert a vector from B to forward, right, down, or back."""
    return v_B[0], -v_B[1], -v_B[2]


def attitude_ned(q_WB: Quaternion) -> Quaternion:
    """Convert an attitude from B-to-W to FRD-to-NED, or back; w comes first, and is non-negative in the result.

    W to NED is a half-turn about (1, 1, 0), FRD to B a half-turn about x.
    """
    w, x, y, z = q_WB
    w, x, y, z = -x, w, z, -y
    q = -_SQRT_HALF * (x + y), _SQRT_HALF * (w + z), _SQRT_HALF * (w - z), _SQRT_HALF * (y - x)
    return q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])


def wrapped(angle_rad: float) -> float:
    """Return an angle wrapped to [-pi, pi]."""
    return math.remainder(angle_rad, math.tau)


def yaw_ned(yaw_W: float) -> float:
    """Convert a yaw [rad] counter-clockwise from east to one clockwise from north, or back."""
    return wrapped(0.5 * math.pi - yaw_W)


def from_int(value: int, unit: float) -> float:
    """Return the value of an integer field with a given unit; NaN if it is unknown."""
    return math.nan if value == INT32_UNKNOWN else unit * value


def to_int(value: float, unit: float) -> int:
    """Return a value as an integer multiple of a unit; INT32_UNKNOWN if it is not finite."""
    return round(value / unit) if math.isfinite(value) else INT32_UNKNOWN


def global_ints(geodetic: Vector) -> tuple[int, int, int]:
    """Return latitude [deg], longitude [deg] and height [m] as integers [1e-7 deg, 1e-7 deg, mm]."""
    return round(1e7 * geodetic[0]), round(1e7 * geodetic[1]), round(1000 * geodetic[2])


def int16(value: float) -> int:
    """Return the nearest integer, clipped to [-32767, 32767]."""
    return max(-32767, min(32767, round(value)))


MAGIC_1, MAGIC_2 = 0xFE, 0xFD  # first byte of a frame
HEADER_1, HEADER_2 = 6, 10  # bytes before the payload
CHECKSUM_BYTES = 2
SIGNED = 0x01  # MAVLINK_IFLAG_SIGNED
ID_MAX_1 = 255  # message ids have one byte in MAVLink 1
KEY_BYTES = 32  # length of a secret key
SIGNATURE_BYTES = 13  # 1 for the link id, 6 for the timestamp, 6 for the hash
HASH_BYTES = 6  # the leading bytes of a SHA-256 digest
LINK_ID = b"\0"  # link id in all signatures
TICKS_PER_S = 100_000  # timestamps are in units of 10 us
EPOCH_S = 1_420_070_400  # 2015-01-01, the epoch of timestamps, in seconds since 1970
TIMESTAMP_LAG_MAX = 6_000_000  # ticks (one minute): maximum lag of a new stream's first timestamp
TIMESTAMP_MAX = 2**48 - 1
STREAMS_MAX = 4096  # streams remembered; only holders of the key can start one
Version = Literal[1, 2]


class Received(NamedTuple):
    """A message, its sender, its sequence number on the link, and whether it was signed."""

    message: WireMessage
    system_id: int
    component_id: int
    seq: int
    signed: bool


class Signing:
    """Signs frames with a 32-byte key, and checks the signatures of received frames.

    Attributes:
        timestamp: time of the newest frame signed or accepted [10 us since 2015].
    """

    def __init__(self, key: bytes) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"the signing key has {len(key)} bytes; must have {KEY_BYTES}")
        self._key = key
        self._streams: dict[tuple[int, int, int], int] = {}
        self.timestamp = 0

    def advance(self, unix_s: float) -> None:
        """Advance the timestamp to the wall clock [s since 1970]; it never goes back."""
        self.timestamp = max(self.timestamp, min(TIMESTAMP_MAX, int((unix_s - EPOCH_S) * TICKS_PER_S)))

    def sign(self, frame: bytes) -> bytes:
        """Return the signature to append to a frame, given from its header to its checksum."""
        self.timestamp += 1
        prefix = LINK_ID + self.timestamp.to_bytes(6, "little")
        return prefix + self._hash(frame + prefix)

    def refusal(self, frame: bytes, signature: bytes, system_id: int, component_id: int) -> str | None:
        """Return why a signed frame is rejected, `bad_signature` or `replayed`; None if it is accepted."""
        if not hmac.compare_digest(self._hash(frame + signature[:-HASH_BYTES]), signature[-HASH_BYTES:]):
            return "bad_signature"
        stream = system_id, component_id, signature[0]
        timestamp = int.from_bytes(signature[1:7], "little")
        last = self._streams.get(stream)
        oldest = self.timestamp - TIMESTAMP_LAG_MAX if last is None else last + 1
        if timestamp < oldest or (last is None and len(self._streams) >= STREAMS_MAX):
            return "replayed"
        self._streams[stream] = timestamp
        self.timestamp = max(self.timestamp, timestamp)
        return None

    def _hash(self, data: bytes) -> bytes:
        return sha256(self._key + data).digest()[:HASH_BYTES]


class Link:
    """Packs and numbers the messages of one component on one link; MAVLink 1 has no extensions or signatures."""

    def __init__(self, system_id: int, component_id: int, signing: Signing | None = None, version: Version = 2) -> None:
        self._address = bytes([system_id, component_id])
        self._signing = signing
        self._version = version
        self._seq = 0

    def pack(self, message: WireMessage) -> bytes:
        """Return the frame of a message.

        Raises:
            ValueError: the message id exceeds the range of MAVLink 1.
            struct.error, OverflowError: a value is out of range for its type, or an array has the wrong length.
        """
        layout = LAYOUTS[type(message)]
        payload = layout.pack(message)
        seq, self._seq = self._seq, self._seq + 1 & 0xFF
        if self._version == 1:
            if layout.id > ID_MAX_1:
                raise ValueError(f"{layout.name} has the id {layout.id}; MAVLink 1 has ids up to {ID_MAX_1}")
            payload = payload[: layout.base_size]
            body = bytes((len(payload), seq)) + self._address + bytes([layout.id]) + payload
            return b"\xfe" + body + _crc(body, layout)
        payload = payload.rstrip(b"\0") or b"\0"  # trailing zeros are dropped, but one byte must remain
        header = bytes((len(payload), SIGNED if self._signing else 0, 0, seq))
        body = header + self._address + layout.id.to_bytes(3, "little") + payload
        frame = b"\xfd" + body + _crc(body, layout)
        return frame + self._signing.sign(frame) if self._signing else frame


class Parser:
    """Splits received datagrams into frames and decodes them.

    Args:
        signing: checks signatures, which frames must then have; None: signatures are neither required nor checked.

    Attributes:
        refused: number of refused frames by reason: `bad_crc`, `unknown` (not in the dialect), `incompatible` (unknown
            incompat_flags), `truncated`, `unsigned`, `bad_signature`, `replayed`; and `noise`, bytes outside frames.
    """

    def __init__(self, signing: Signing | None = None) -> None:
        self._signing = signing
        self.refused: Counter[str] = Counter()

    def feed(self, data: bytes) -> list[Received]:
        received, start = [], 0
        while (begin := self._next_magic(data, start)) is not None:
            end = _frame_end(data, begin)
            result = "truncated" if end is None else self._accept(data, begin, end)
            start = begin + 1 if end is None or result == "bad_crc" else end
            if isinstance(result, str):
                self.refused[result] += 1
            else:
                received.append(result)
        return received

    def _next_magic(self, data: bytes, start: int) -> int | None:
        if start < len(data) and data[start] in (MAGIC_1, MAGIC_2):
            return start
        positions = [position for position in (data.find(b"\xfd", start), data.find(b"\xfe", start)) if position >= 0]
        self.refused["noise"] += (min(positions) if positions else len(data)) - start
        return min(positions) if positions else None

    def _accept(self, data: bytes, begin: int, end: int) -> Received | str:
        """Return the message in a complete frame, or the reason for refusing it."""
        is_version_2 = data[begin] == MAGIC_2
        flags = data[begin + 2] if is_version_2 else 0
        seq_index = begin + (4 if is_version_2 else 2)  # index of the sequence number; sender and message id follow
        payload_start = begin + (HEADER_2 if is_version_2 else HEADER_1)
        payload_end = payload_start + data[begin + 1]
        signed_end = payload_end + CHECKSUM_BYTES
        sender = data[seq_index + 1], data[seq_index + 2]
        layout = BY_ID.get(int.from_bytes(data[seq_index + 3 : payload_start], "little"))
        if layout is None:
            return "unknown"
        if _crc(data[begin + 1 : payload_end], layout) != data[payload_end:signed_end]:
            return "bad_crc"
        if flags & ~SIGNED:
            return "incompatible"
        if self._signing is not None:
            if not flags & SIGNED:
                return "unsigned"
            if refusal := self._signing.refusal(data[begin:signed_end], data[signed_end:end], *sender):
                return refusal
        return Received(layout.unpack(data[payload_start:payload_end]), *sender, data[seq_index], bool(flags & SIGNED))


def _frame_end(data: bytes, begin: int) -> int | None:
    """Return the end index of the frame that starts at `begin`; None if the frame is incomplete."""
    is_version_2 = data[begin] == MAGIC_2
    header = HEADER_2 if is_version_2 else HEADER_1
    if begin + header + CHECKSUM_BYTES > len(data):
        return None
    signature = SIGNATURE_BYTES if is_version_2 and data[begin + 2] & SIGNED else 0
    end = begin + header + data[begin + 1] + CHECKSUM_BYTES + signature
    return end if end <= len(data) else None


def _crc(body: bytes, layout: MessageLayout) -> bytes:
    """Return the checksum of a frame; `body` runs from its second byte to the end of its payload."""
    return checksum(body + bytes([layout.crc_extra])).to_bytes(2, "little")
