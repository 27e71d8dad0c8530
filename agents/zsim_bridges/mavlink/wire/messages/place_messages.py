"""Messages about places: origin, home, targets, fence; axes: north, east, down.

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


@message(49, extensions=1)
class GpsGlobalOrigin(WireMessage):
    """Origin of the local frame on the Earth."""

    latitude: Int32 = 0  # [degE7]
    longitude: Int32 = 0  # [degE7]
    altitude: Int32 = 0  # [mm]
    time_usec: UInt64 = 0  # [us]


@message(48, extensions=1)
class SetGpsGlobalOrigin(WireMessage):
    """Set the origin of the local frame."""

    target_system: UInt8 = 0
    latitude: Int32 = 0  # [degE7]
    longitude: Int32 = 0  # [degE7]
    altitude: Int32 = 0  # [mm]
    time_usec: UInt64 = 0  # [us]


@message(242, extensions=1)
class HomePosition(WireMessage):
    """Where a vehicle took off, and returns to."""

    latitude: Int32 = 0  # [degE7]
    longitude: Int32 = 0  # [degE7]
    altitude: Int32 = 0  # [mm]
    x: Float = 0.0  # [m]
    y: Float = 0.0  # [m]
    z: Float = 0.0  # [m]
    q: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4
    approach_x: Float = 0.0  # [m]
    approach_y: Float = 0.0  # [m]
    approach_z: Float = 0.0  # [m]
    time_usec: UInt64 = 0  # [us]


@message(243, extensions=1)
class SetHomePosition(WireMessage):
    """Set where a vehicle returns to."""

    target_system: UInt8 = 0
    latitude: Int32 = 0  # [degE7]
    longitude: Int32 = 0  # [degE7]
    altitude: Int32 = 0  # [mm]
    x: Float = 0.0  # [m]
    y: Float = 0.0  # [m]
    z: Float = 0.0  # [m]
    q: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4
    approach_x: Float = 0.0  # [m]
    approach_y: Float = 0.0  # [m]
    approach_z: Float = 0.0  # [m]
    time_usec: UInt64 = 0  # [us]


@message(62)
class NavControllerOutput(WireMessage):
    """Desired attitude, and errors of the course."""

    nav_roll: Float = 0.0  # [deg]
    nav_pitch: Float = 0.0  # [deg]
    nav_bearing: Int16 = 0  # [deg]
    target_bearing: Int16 = 0  # [deg]
    wp_dist: UInt16 = 0  # [m]
    alt_error: Float = 0.0  # [m]
    aspd_error: Float = 0.0  # [m/s]
    xtrack_error: Float = 0.0  # [m]


@message(85)
class PositionTargetLocalNed(WireMessage):
    """The position, velocity, acceleration, yaw that are flown to, in the local frame."""

    time_boot_ms: UInt32 = 0  # [ms]
    coordinate_frame: UInt8 = 0
    type_mask: UInt16 = 0
    x: Float = 0.0  # [m]
    y: Float = 0.0  # [m]
    z: Float = 0.0  # [m]
    vx: Float = 0.0  # [m/s]
    vy: Float = 0.0  # [m/s]
    vz: Float = 0.0  # [m/s]
    afx: Float = 0.0  # [m/s/s]
    afy: Float = 0.0  # [m/s/s]
    afz: Float = 0.0  # [m/s/s]
    yaw: Float = 0.0  # [rad]
    yaw_rate: Float = 0.0  # [rad/s]


@message(87)
class PositionTargetGlobalInt(WireMessage):
    """The position, velocity, acceleration, yaw that are flown to, on the Earth."""

    time_boot_ms: UInt32 = 0  # [ms]
    coordinate_frame: UInt8 = 0
    type_mask: UInt16 = 0
    lat_int: Int32 = 0  # [degE7]
    lon_int: Int32 = 0  # [degE7]
    alt: Float = 0.0  # [m]
    vx: Float = 0.0  # [m/s]
    vy: Float = 0.0  # [m/s]
    vz: Float = 0.0  # [m/s]
    afx: Float = 0.0  # [m/s/s]
    afy: Float = 0.0  # [m/s/s]
    afz: Float = 0.0  # [m/s/s]
    yaw: Float = 0.0  # [rad]
    yaw_rate: Float = 0.0  # [rad/s]


@message(83)
class AttitudeTarget(WireMessage):
    """The attitude, rates and thrust that are held."""

    time_boot_ms: UInt32 = 0  # [ms]
    type_mask: UInt8 = 0
    q: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4
    body_roll_rate: Float = 0.0  # [rad/s]
    body_pitch_rate: Float = 0.0  # [rad/s]
    body_yaw_rate: Float = 0.0  # [rad/s]
    thrust: Float = 0.0


@message(162, extensions=1)
class FenceStatus(WireMessage):
    """Whether a geofence is breached."""

    breach_status: UInt8 = 0
    breach_count: UInt16 = 0
    breach_type: UInt8 = 0
    breach_time: UInt32 = 0  # [ms]
    breach_mitigation: UInt8 = 0


@message(149, extensions=6)
class LandingTarget(WireMessage):
    """Where a place to land is seen."""

    time_usec: UInt64 = 0  # [us]
    target_num: UInt8 = 0
    frame: UInt8 = 0
    angle_x: Float = 0.0  # [rad]
    angle_y: Float = 0.0  # [rad]
    distance: Float = 0.0  # [m]
    size_x: Float = 0.0  # [rad]
    size_y: Float = 0.0  # [rad]
    x: Float = 0.0  # [m]
    y: Float = 0.0  # [m]
    z: Float = 0.0  # [m]
    q: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4
    type: UInt8 = 0
    position_valid: UInt8 = 0


@message(102, extensions=2)
class VisionPositionEstimate(WireMessage):
    """A pose by a camera."""

    usec: UInt64 = 0  # [us]
    x: Float = 0.0  # [m]
    y: Float = 0.0  # [m]
    z: Float = 0.0  # [m]
    roll: Float = 0.0  # [rad]
    pitch: Float = 0.0  # [rad]
    yaw: Float = 0.0  # [rad]
    covariance: Annotated[tuple[float, ...], "float[21]"] = (0.0,) * 21
    reset_counter: UInt8 = 0


@message(138, extensions=1)
class AttPosMocap(WireMessage):
    """A pose by motion capture."""

    time_usec: UInt64 = 0  # [us]
    q: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4
    x: Float = 0.0  # [m]
    y: Float = 0.0  # [m]
    z: Float = 0.0  # [m]
    covariance: Annotated[tuple[float, ...], "float[21]"] = (0.0,) * 21
