"""Messages that steer a vehicle; axes: north, east, down, and forward, right, down.

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


@message(84)
class SetPositionTargetLocalNed(WireMessage):
    """Fly to a position, or at a velocity, in a local frame; the mask names what is ignored."""

    time_boot_ms: UInt32 = 0  # [ms]
    target_system: UInt8 = 0
    target_component: UInt8 = 0
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


@message(86)
class SetPositionTargetGlobalInt(WireMessage):
    """Fly to a position on the Earth, or at a velocity; the mask names what is ignored."""

    time_boot_ms: UInt32 = 0  # [ms]
    target_system: UInt8 = 0
    target_component: UInt8 = 0
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


@message(82)
class SetAttitudeTarget(WireMessage):
    """Hold an attitude or rates, with a thrust."""

    time_boot_ms: UInt32 = 0  # [ms]
    target_system: UInt8 = 0
    target_component: UInt8 = 0
    type_mask: UInt8 = 0
    q: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4
    body_roll_rate: Float = 0.0  # [rad/s]
    body_pitch_rate: Float = 0.0  # [rad/s]
    body_yaw_rate: Float = 0.0  # [rad/s]
    thrust: Float = 0.0


@message(69, extensions=10)
class ManualControl(WireMessage):
    """The axes and buttons of a joystick, each axis within 1000."""

    target: UInt8 = 0
    x: Int16 = 0
    y: Int16 = 0
    z: Int16 = 0
    r: Int16 = 0
    buttons: UInt16 = 0
    buttons2: UInt16 = 0
    enabled_extensions: UInt8 = 0
    s: Int16 = 0
    t: Int16 = 0
    aux1: Int16 = 0
    aux2: Int16 = 0
    aux3: Int16 = 0
    aux4: Int16 = 0
    aux5: Int16 = 0
    aux6: Int16 = 0


@message(70, extensions=10)
class RcChannelsOverride(WireMessage):
    """Channels in place of those of the radio control."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
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


@message(144)
class FollowTarget(WireMessage):
    """Where a target that is followed is."""

    timestamp: UInt64 = 0  # [ms]
    est_capabilities: UInt8 = 0
    lat: Int32 = 0  # [degE7]
    lon: Int32 = 0  # [degE7]
    alt: Float = 0.0  # [m]
    vel: Annotated[tuple[float, ...], "float[3]"] = (0.0,) * 3  # [m/s]
    acc: Annotated[tuple[float, ...], "float[3]"] = (0.0,) * 3  # [m/s/s]
    attitude_q: Annotated[tuple[float, ...], "float[4]"] = (0.0,) * 4
    rates: Annotated[tuple[float, ...], "float[3]"] = (0.0,) * 3
    position_cov: Annotated[tuple[float, ...], "float[3]"] = (0.0,) * 3
    custom_state: UInt64 = 0
