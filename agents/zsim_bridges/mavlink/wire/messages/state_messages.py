"""Messages with the estimated state of a vehicle; axes: north, east, down, and forward, right, down.

Definitions: https://mavlink.io/en/messages/common.html and ardupilotmega.html; units as written there.
"""

from typing import Annotated

from zsim_bridges.mavlink.wire.wire_message import (
    Float,
    Int8,
    Int16,
    Int32,
    UInt8,
    UInt16,
    UInt32,
    UInt64,
    WireMessage,
    message,
)


@message(30)
class Attitude(WireMessage):
    """Attitude as Euler angles, and body rates."""

    time_boot_ms: UInt32 = 0  # [ms]
    roll: Float = 0.0  # [rad]
    pitch: Float = 0.0  # [rad]
    yaw: Float = 0.0  # [rad]
    rollspeed: Float = 0.0  # [rad/s]
    pitchspeed: Float = 0.0  # [rad/s]
    yawspeed: Float = 0.0  # [rad/s]


@message(31, extensions=1)
class AttitudeQuaternion(WireMessage):
    """Attitude as a quaternion, body to NED, w first, and body rates."""

    time_boot_ms: UInt32 = 0  # [ms]
    q1: Float = 0.0
    q2: Float = 0.0
    q3: Float = 0.0
    q4: Float = 0.0
    rollspeed: Float = 0.0  # [rad/s]
    pitchspeed: Float = 0.0  # [rad/s]
    yawspeed: Float = 0.0  # [rad/s]
    repr_offset_q: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4


@message(32)
class LocalPositionNed(WireMessage):
    """Position and velocity relative to the local origin."""

    time_boot_ms: UInt32 = 0  # [ms]
    x: Float = 0.0  # [m]
    y: Float = 0.0  # [m]
    z: Float = 0.0  # [m]
    vx: Float = 0.0  # [m/s]
    vy: Float = 0.0  # [m/s]
    vz: Float = 0.0  # [m/s]


@message(33)
class GlobalPositionInt(WireMessage):
    """Fused position and velocity on the Earth."""

    time_boot_ms: UInt32 = 0  # [ms]
    lat: Int32 = 0  # [degE7]
    lon: Int32 = 0  # [degE7]
    alt: Int32 = 0  # [mm]
    relative_alt: Int32 = 0  # [mm]
    vx: Int16 = 0  # [cm/s]
    vy: Int16 = 0  # [cm/s]
    vz: Int16 = 0  # [cm/s]
    hdg: UInt16 = 0  # [cdeg]


@message(331, extensions=3)
class Odometry(WireMessage):
    """Pose and twist with covariances, in frames that the message names."""

    time_usec: UInt64 = 0  # [us]
    frame_id: UInt8 = 0
    child_frame_id: UInt8 = 0
    x: Float = 0.0  # [m]
    y: Float = 0.0  # [m]
    z: Float = 0.0  # [m]
    q: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4
    vx: Float = 0.0  # [m/s]
    vy: Float = 0.0  # [m/s]
    vz: Float = 0.0  # [m/s]
    rollspeed: Float = 0.0  # [rad/s]
    pitchspeed: Float = 0.0  # [rad/s]
    yawspeed: Float = 0.0  # [rad/s]
    pose_covariance: Annotated[tuple[float, ...], "float[21]"] = (0.0,) * 21
    velocity_covariance: Annotated[tuple[float, ...], "float[21]"] = (0.0,) * 21
    reset_counter: UInt8 = 0
    estimator_type: UInt8 = 0
    quality: Int8 = 0  # [%]


@message(74)
class VfrHud(WireMessage):
    """What a head-up display shows."""

    airspeed: Float = 0.0  # [m/s]
    groundspeed: Float = 0.0  # [m/s]
    heading: Int16 = 0  # [deg]
    throttle: UInt16 = 0  # [%]
    alt: Float = 0.0  # [m]
    climb: Float = 0.0  # [m/s]


@message(141)
class Altitude(WireMessage):
    """Altitudes over several zeros."""

    time_usec: UInt64 = 0  # [us]
    altitude_monotonic: Float = 0.0  # [m]
    altitude_amsl: Float = 0.0  # [m]
    altitude_local: Float = 0.0  # [m]
    altitude_relative: Float = 0.0  # [m]
    altitude_terrain: Float = 0.0  # [m]
    bottom_clearance: Float = 0.0  # [m]


@message(230)
class EstimatorStatus(WireMessage):
    """Flags and test ratios of an estimator, of PX4."""

    time_usec: UInt64 = 0  # [us]
    flags: UInt16 = 0
    vel_ratio: Float = 0.0
    pos_horiz_ratio: Float = 0.0
    pos_vert_ratio: Float = 0.0
    mag_ratio: Float = 0.0
    hagl_ratio: Float = 0.0
    tas_ratio: Float = 0.0
    pos_horiz_accuracy: Float = 0.0  # [m]
    pos_vert_accuracy: Float = 0.0  # [m]


@message(193, extensions=1)
class EkfStatusReport(WireMessage):
    """Flags and variances of an estimator, of ArduPilot."""

    flags: UInt16 = 0
    velocity_variance: Float = 0.0
    pos_horiz_variance: Float = 0.0
    pos_vert_variance: Float = 0.0
    compass_variance: Float = 0.0
    terrain_alt_variance: Float = 0.0
    airspeed_variance: Float = 0.0


@message(178)
class Ahrs2(WireMessage):
    """Attitude and position of the second estimator, of ArduPilot."""

    roll: Float = 0.0  # [rad]
    pitch: Float = 0.0  # [rad]
    yaw: Float = 0.0  # [rad]
    altitude: Float = 0.0  # [m]
    lat: Int32 = 0  # [degE7]
    lng: Int32 = 0  # [degE7]
