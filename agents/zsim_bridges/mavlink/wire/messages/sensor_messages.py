"""Messages with what sensors measured.

Definitions: https://mavlink.io/en/messages/common.html and ardupilotmega.html; units as written there.
"""

from typing import Annotated

from zsim_bridges.mavlink.wire.wire_message import (
    Float,
    Int16,
    Int32,
    UInt8,
    UInt16,
    UInt32,
    UInt64,
    WireMessage,
    message,
)


@message(24, extensions=6)
class GpsRawInt(WireMessage):
    """The fix of a GPS receiver."""

    time_usec: UInt64 = 0  # [us]
    fix_type: UInt8 = 0
    lat: Int32 = 0  # [degE7]
    lon: Int32 = 0  # [degE7]
    alt: Int32 = 0  # [mm]
    eph: UInt16 = 0
    epv: UInt16 = 0
    vel: UInt16 = 0  # [cm/s]
    cog: UInt16 = 0  # [cdeg]
    satellites_visible: UInt8 = 0
    alt_ellipsoid: Int32 = 0  # [mm]
    h_acc: UInt32 = 0  # [mm]
    v_acc: UInt32 = 0  # [mm]
    vel_acc: UInt32 = 0  # [mm/s]
    hdg_acc: UInt32 = 0  # [degE5]
    yaw: UInt16 = 0  # [cdeg]


@message(27, extensions=2)
class RawImu(WireMessage):
    """Raw readings of an inertial unit."""

    time_usec: UInt64 = 0  # [us]
    xacc: Int16 = 0  # [mG]
    yacc: Int16 = 0  # [mG]
    zacc: Int16 = 0  # [mG]
    xgyro: Int16 = 0  # [mrad/s]
    ygyro: Int16 = 0  # [mrad/s]
    zgyro: Int16 = 0  # [mrad/s]
    xmag: Int16 = 0  # [mgauss]
    ymag: Int16 = 0  # [mgauss]
    zmag: Int16 = 0  # [mgauss]
    id: UInt8 = 0
    temperature: Int16 = 0  # [cdegC]


@message(26, extensions=1)
class ScaledImu(WireMessage):
    """Readings of an inertial unit in the body, forward, right, down."""

    time_boot_ms: UInt32 = 0  # [ms]
    xacc: Int16 = 0  # [mG]
    yacc: Int16 = 0  # [mG]
    zacc: Int16 = 0  # [mG]
    xgyro: Int16 = 0  # [mrad/s]
    ygyro: Int16 = 0  # [mrad/s]
    zgyro: Int16 = 0  # [mrad/s]
    xmag: Int16 = 0  # [mgauss]
    ymag: Int16 = 0  # [mgauss]
    zmag: Int16 = 0  # [mgauss]
    temperature: Int16 = 0  # [cdegC]


@message(116, extensions=1)
class ScaledImu2(WireMessage):
    """Readings of the second inertial unit."""

    time_boot_ms: UInt32 = 0  # [ms]
    xacc: Int16 = 0  # [mG]
    yacc: Int16 = 0  # [mG]
    zacc: Int16 = 0  # [mG]
    xgyro: Int16 = 0  # [mrad/s]
    ygyro: Int16 = 0  # [mrad/s]
    zgyro: Int16 = 0  # [mrad/s]
    xmag: Int16 = 0  # [mgauss]
    ymag: Int16 = 0  # [mgauss]
    zmag: Int16 = 0  # [mgauss]
    temperature: Int16 = 0  # [cdegC]


@message(29, extensions=1)
class ScaledPressure(WireMessage):
    """Readings of a barometer."""

    time_boot_ms: UInt32 = 0  # [ms]
    press_abs: Float = 0.0  # [hPa]
    press_diff: Float = 0.0  # [hPa]
    temperature: Int16 = 0  # [cdegC]
    temperature_press_diff: Int16 = 0  # [cdegC]


@message(105, extensions=1)
class HighresImu(WireMessage):
    """Readings of inertial unit, magnetometer and barometer in the body, forward, right, down."""

    time_usec: UInt64 = 0  # [us]
    xacc: Float = 0.0  # [m/s/s]
    yacc: Float = 0.0  # [m/s/s]
    zacc: Float = 0.0  # [m/s/s]
    xgyro: Float = 0.0  # [rad/s]
    ygyro: Float = 0.0  # [rad/s]
    zgyro: Float = 0.0  # [rad/s]
    xmag: Float = 0.0  # [gauss]
    ymag: Float = 0.0  # [gauss]
    zmag: Float = 0.0  # [gauss]
    abs_pressure: Float = 0.0  # [hPa]
    diff_pressure: Float = 0.0  # [hPa]
    pressure_alt: Float = 0.0
    temperature: Float = 0.0  # [degC]
    fields_updated: UInt16 = 0
    id: UInt8 = 0


@message(100, extensions=2)
class OpticalFlow(WireMessage):
    """Flow of a camera that looks down."""

    time_usec: UInt64 = 0  # [us]
    sensor_id: UInt8 = 0
    flow_x: Int16 = 0  # [rad/s]
    flow_y: Int16 = 0  # [rad/s]
    flow_comp_m_x: Float = 0.0  # [m/s]
    flow_comp_m_y: Float = 0.0  # [m/s]
    quality: UInt8 = 0
    ground_distance: Float = 0.0  # [m]
    flow_rate_x: Float = 0.0  # [rad/s]
    flow_rate_y: Float = 0.0  # [rad/s]


@message(106)
class OpticalFlowRad(WireMessage):
    """Integrated flow of a camera that looks down."""

    time_usec: UInt64 = 0  # [us]
    sensor_id: UInt8 = 0
    integration_time_us: UInt32 = 0  # [us]
    integrated_x: Float = 0.0  # [rad]
    integrated_y: Float = 0.0  # [rad]
    integrated_xgyro: Float = 0.0  # [rad]
    integrated_ygyro: Float = 0.0  # [rad]
    integrated_zgyro: Float = 0.0  # [rad]
    temperature: Int16 = 0  # [cdegC]
    quality: UInt8 = 0
    time_delta_distance_us: UInt32 = 0  # [us]
    distance: Float = 0.0  # [m]


@message(132, extensions=4)
class DistanceSensor(WireMessage):
    """A measured distance."""

    time_boot_ms: UInt32 = 0  # [ms]
    min_distance: UInt16 = 0  # [cm]
    max_distance: UInt16 = 0  # [cm]
    current_distance: UInt16 = 0  # [cm]
    type: UInt8 = 0
    id: UInt8 = 0
    orientation: UInt8 = 0
    covariance: UInt8 = 0  # [cm^2]
    horizontal_fov: Float = 0.0  # [rad]
    vertical_fov: Float = 0.0  # [rad]
    quaternion: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4
    signal_quality: UInt8 = 0  # [%]


@message(173)
class Rangefinder(WireMessage):
    """Distance to the ground, of ArduPilot."""

    distance: Float = 0.0  # [m]
    voltage: Float = 0.0  # [V]


@message(241)
class Vibration(WireMessage):
    """Levels of vibration, and how often accelerometers clipped."""

    time_usec: UInt64 = 0  # [us]
    vibration_x: Float = 0.0
    vibration_y: Float = 0.0
    vibration_z: Float = 0.0
    clipping_0: UInt32 = 0
    clipping_1: UInt32 = 0
    clipping_2: UInt32 = 0


@message(231)
class WindCov(WireMessage):
    """Estimated wind with its uncertainty."""

    time_usec: UInt64 = 0  # [us]
    wind_x: Float = 0.0  # [m/s]
    wind_y: Float = 0.0  # [m/s]
    wind_z: Float = 0.0  # [m/s]
    var_horiz: Float = 0.0  # [m/s]
    var_vert: Float = 0.0  # [m/s]
    wind_alt: Float = 0.0  # [m]
    horiz_accuracy: Float = 0.0  # [m/s]
    vert_accuracy: Float = 0.0  # [m/s]


@message(65)
class RcChannels(WireMessage):
    """What a radio control receiver received."""

    time_boot_ms: UInt32 = 0  # [ms]
    chancount: UInt8 = 0
    chan1_raw: UInt16 = 0  # [us]
    chan2_raw: UInt16 = 0  # [us]
    chan3_raw: UInt16 = 0  # [us]
    chan4_raw: UInt16 = 0  # [us]
    chan5_raw: UInt16 = 0  # [us]
    chan6_raw: UInt16 = 0  # [us]
    chan7_raw: UInt16 = 0  # [us]
    chan8_raw: UInt16 = 0  # [us]
    chan9_raw: UInt16 = 0  # [us]
    chan10_raw: UInt16 = 0  # [us]
    chan11_raw: UInt16 = 0  # [us]
    chan12_raw: UInt16 = 0  # [us]
    chan13_raw: UInt16 = 0  # [us]
    chan14_raw: UInt16 = 0  # [us]
    chan15_raw: UInt16 = 0  # [us]
    chan16_raw: UInt16 = 0  # [us]
    chan17_raw: UInt16 = 0  # [us]
    chan18_raw: UInt16 = 0  # [us]
    rssi: UInt8 = 0


@message(36, extensions=8)
class ServoOutputRaw(WireMessage):
    """Pulses to servos and motors."""

    time_usec: UInt32 = 0  # [us]
    port: UInt8 = 0
    servo1_raw: UInt16 = 0  # [us]
    servo2_raw: UInt16 = 0  # [us]
    servo3_raw: UInt16 = 0  # [us]
    servo4_raw: UInt16 = 0  # [us]
    servo5_raw: UInt16 = 0  # [us]
    servo6_raw: UInt16 = 0  # [us]
    servo7_raw: UInt16 = 0  # [us]
    servo8_raw: UInt16 = 0  # [us]
    servo9_raw: UInt16 = 0  # [us]
    servo10_raw: UInt16 = 0  # [us]
    servo11_raw: UInt16 = 0  # [us]
    servo12_raw: UInt16 = 0  # [us]
    servo13_raw: UInt16 = 0  # [us]
    servo14_raw: UInt16 = 0  # [us]
    servo15_raw: UInt16 = 0  # [us]
    servo16_raw: UInt16 = 0  # [us]
