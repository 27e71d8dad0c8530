"""Values of MAVLink's enumerations, as far as they are used. Source: https://mavlink.io/en/messages/common.html."""

from enum import IntEnum, IntFlag


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
    DO_SET_ROI_NONE = 197
    DO_FENCE_ENABLE = 207
    DO_SET_MISSION_CURRENT = 224
    PREFLIGHT_CALIBRATION = 241
    PREFLIGHT_REBOOT_SHUTDOWN = 246
    MISSION_START = 300
    COMPONENT_ARM_DISARM = 400
    GET_HOME_POSITION = 410
    GET_MESSAGE_INTERVAL = 510
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_PROTOCOL_VERSION = 519
    REQUEST_AUTOPILOT_CAPABILITIES = 520
    FENCE_RETURN_POINT = 5000
    FENCE_POLYGON_INCLUSION = 5001
    FENCE_POLYGON_EXCLUSION = 5002
    FENCE_CIRCLE_INCLUSION = 5003
    FENCE_CIRCLE_EXCLUSION = 5004


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5


class Severity(IntEnum):
    """MAV_SEVERITY."""

    EMERGENCY = 0
    ALERT = 1
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class MissionResult(IntEnum):
    """MAV_MISSION_RESULT."""

    ACCEPTED = 0
    ERROR = 1
    UNSUPPORTED_FRAME = 2
    UNSUPPORTED = 3
    NO_SPACE = 4
    INVALID = 5
    INVALID_SEQUENCE = 13
    DENIED = 14
    OPERATION_CANCELLED = 15


class MavFrame(IntEnum):
    """MAV_FRAME."""

    GLOBAL = 0
    LOCAL_NED = 1
    MISSION = 2
    GLOBAL_RELATIVE_ALT = 3
    LOCAL_ENU = 4
    GLOBAL_INT = 5
    GLOBAL_RELATIVE_ALT_INT = 6
    LOCAL_OFFSET_NED = 7
    BODY_NED = 8
    BODY_OFFSET_NED = 9
    GLOBAL_TERRAIN_ALT = 10
    GLOBAL_TERRAIN_ALT_INT = 11
    BODY_FRD = 12


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


class LandedState(IntEnum):
    """MAV_LANDED_STATE."""

    UNDEFINED = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class SensorBit(IntFlag):
    """MAV_SYS_STATUS_SENSOR: sensors and parts of a vehicle."""

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
    GEOFENCE = 0x100000
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


class TypeMask(IntFlag):
    """POSITION_TARGET_TYPEMASK: the ignored parts of a setpoint."""

    X = 1
    Y = 2
    Z = 4
    VX = 8
    VY = 16
    VZ = 32
    AX = 64
    AY = 128
    AZ = 256
    FORCE = 512
    YAW = 1024
    YAW_RATE = 2048


class AttitudeMask(IntFlag):
    """ATTITUDE_TARGET_TYPEMASK: the ignored parts of a setpoint."""

    ROLL_RATE = 1
    PITCH_RATE = 2
    YAW_RATE = 4
    THRUST = 64
    ATTITUDE = 128


class EstimatorFlag(IntFlag):
    """ESTIMATOR_STATUS_FLAGS; EKF_STATUS_FLAGS of ArduPilot has the same bits."""

    ATTITUDE = 1
    VELOCITY_HORIZ = 2
    VELOCITY_VERT = 4
    POS_HORIZ_REL = 8
    POS_HORIZ_ABS = 16
    POS_VERT_ABS = 32
    POS_VERT_AGL = 64
    PRED_POS_HORIZ_REL = 256
    PRED_POS_HORIZ_ABS = 512


class GpsFix(IntEnum):
    """GPS_FIX_TYPE."""

    NO_GPS = 0
    NO_FIX = 1
    FIX_3D = 3


class ParamType(IntEnum):
    """MAV_PARAM_TYPE."""

    UINT8 = 1
    INT8 = 2
    UINT16 = 3
    INT16 = 4
    UINT32 = 5
    INT32 = 6
    REAL32 = 9


FORCE = 21196.0  # param2 of COMPONENT_ARM_DISARM: without checks, also in flight
TYPE_QUADROTOR = 2  # MAV_TYPE
TYPE_GCS = 6  # MAV_TYPE
TYPE_ONBOARD_CONTROLLER = 18  # MAV_TYPE
COMPONENT_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
MISSION, FENCE, RALLY = 0, 1, 2  # MAV_MISSION_TYPE
ALL_MISSION_TYPES = 255
