"""Messages about what a vehicle does and where it is, each made at a gate; None where there is nothing to send."""

import math

from zsim.math import frames
from zsim_bridges.mavlink.autopilot import ned_axes
from zsim_bridges.mavlink.autopilot.enums import (
    TYPE_QUADROTOR,
    BaseMode,
    EstimatorFlag,
    LandedState,
    MavFrame,
    SensorBit,
    SystemStatus,
    TypeMask,
)
from zsim_bridges.mavlink.autopilot.personality import BY_STICKS, FlightMode
from zsim_bridges.mavlink.flight.position_guidance import Target
from zsim_bridges.mavlink.telemetry.telemetry_source import TelemetrySource, int16
from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.mavlink.wire.wire_message import WireMessage

MAVLINK_VERSION = 3  # of HEARTBEAT
NAN = math.nan
LANDED_STATES = {
    "landed": LandedState.ON_GROUND,
    "taking_off": LandedState.TAKEOFF,
    "hovering": LandedState.IN_AIR,
    "flying": LandedState.IN_AIR,
    "landing": LandedState.LANDING,
    "emergency": LandedState.UNDEFINED,
}


def heartbeat(s: TelemetrySource) -> dialect.Heartbeat:
    flight, modes = s.flight, s.personality.modes
    mode = flight.mode
    base = BaseMode.CUSTOM | BaseMode.STABILIZE
    base |= BaseMode.MANUAL_INPUT if mode in BY_STICKS else BaseMode.GUIDED | BaseMode.AUTO
    if flight.is_armed:
        base |= BaseMode.ARMED
    custom = modes[FlightMode.MISSION] if flight.foreign_commander else modes[mode]
    return dialect.Heartbeat(TYPE_QUADROTOR, s.personality.autopilot, base, custom, _system_status(s), MAVLINK_VERSION)


def _system_status(s: TelemetrySource) -> SystemStatus:
    if s.state.state == "emergency":
        return SystemStatus.EMERGENCY
    if s.state.is_airborne and (s.state.is_battery_low or s.breach):
        return SystemStatus.CRITICAL
    return SystemStatus.ACTIVE if s.flight.is_armed else SystemStatus.STANDBY


def sys_status(s: TelemetrySource) -> WireMessage:
    present = int(SensorBit(0x3FFFFFFF) & _ALL_HEALTH)
    return dialect.SysStatus(
        onboard_control_sensors_present=present,
        onboard_control_sensors_enabled=present,
        onboard_control_sensors_health=int(s.state.health()),
        voltage_battery=round(1000 * s.voltage_v),
        current_battery=-1,
        battery_remaining=round(s.battery_percent),
    )


_ALL_HEALTH = SensorBit(sum(part.value for part in SensorBit if part is not SensorBit.GEOFENCE))


def system_time(s: TelemetrySource) -> WireMessage:
    return dialect.SystemTime(time_unix_usec=0, time_boot_ms=s.boot_ms)


def attitude(s: TelemetrySource) -> WireMessage:
    return dialect.Attitude(s.boot_ms, *s.rpy_ned_rad, *ned_axes.frd(s.state.rate_rad_s))


def attitude_quaternion(s: TelemetrySource) -> WireMessage:
    return dialect.AttitudeQuaternion(
        s.boot_ms, *ned_axes.attitude_ned(s.state.q_WB), *ned_axes.frd(s.state.rate_rad_s)
    )


def local_position_ned(s: TelemetrySource) -> WireMessage:
    return dialect.LocalPositionNed(s.boot_ms, *s.position_ned_m, *s.velocity_ned_m_s)


def odometry(s: TelemetrySource) -> WireMessage:
    vx, vy, vz = _body_velocity(s)
    level, up = (sigma * sigma for sigma in s.state.sigma_m)
    pose = (level, *(0.0,) * 5, level, *(0.0,) * 4, up, *(0.0,) * 3, NAN, 0.0, 0.0, NAN, 0.0, NAN)
    return dialect.Odometry(
        time_usec=s.boot_us,
        frame_id=MavFrame.LOCAL_NED,
        child_frame_id=MavFrame.BODY_FRD,
        x=s.position_ned_m[0],
        y=s.position_ned_m[1],
        z=s.position_ned_m[2],
        q=ned_axes.attitude_ned(s.state.q_WB),
        vx=vx,
        vy=vy,
        vz=vz,
        rollspeed=s.state.rate_rad_s[0],
        pitchspeed=-s.state.rate_rad_s[1],
        yawspeed=-s.state.rate_rad_s[2],
        pose_covariance=pose,
        velocity_covariance=(NAN, *(0.0,) * 20),
        estimator_type=3,  # MAV_ESTIMATOR_TYPE_GPS_INS
    )


def _body_velocity(s: TelemetrySource) -> tuple[float, float, float]:
    w, x, y, z = s.state.q_WB
    v = frames.rotate((w, -x, -y, -z), s.state.velocity_m_s).tolist()
    return ned_axes.frd((v[0], v[1], v[2]))


def global_position_int(s: TelemetrySource) -> WireMessage:
    latitude, longitude, height = s.place
    north, east, down = (int16(100 * v) for v in s.velocity_ned_m_s)
    return dialect.GlobalPositionInt(
        s.boot_ms,
        round(1e7 * latitude),
        round(1e7 * longitude),
        round(1000 * height),
        round(1000 * s.state.altitude_m),
        north,
        east,
        down,
        round(math.degrees(s.rpy_ned_rad[2]) % 360.0 * 100) % 36000,
    )


def vfr_hud(s: TelemetrySource) -> WireMessage:
    vx, vy, vz = s.state.velocity_m_s
    speed = math.hypot(vx, vy)
    heading = round(math.degrees(s.rpy_ned_rad[2])) % 360
    return dialect.VfrHud(speed, speed, heading, 50 if s.state.is_airborne else 0, s.place[2], vz)


def altitude(s: TelemetrySource) -> WireMessage:
    z, height = s.state.position_m[2], s.place[2]
    return dialect.Altitude(s.boot_us, z, height, z, s.state.altitude_m, NAN, NAN)


def extended_sys_state(s: TelemetrySource) -> WireMessage:
    return dialect.ExtendedSysState(0, LANDED_STATES[s.state.state])


def estimator_flags(s: TelemetrySource) -> int:
    """Return what is known: all, but for the absolute position without GPS."""
    flags = sum(flag.value for flag in EstimatorFlag)
    if s.state.is_estimated and s.state.has_failed("gps"):
        flags &= ~(EstimatorFlag.POS_HORIZ_ABS | EstimatorFlag.PRED_POS_HORIZ_ABS)
    return flags


def estimator_status(s: TelemetrySource) -> WireMessage:
    level, up = s.state.sigma_m
    return dialect.EstimatorStatus(
        time_usec=s.boot_us, flags=estimator_flags(s), pos_horiz_accuracy=level, pos_vert_accuracy=up
    )


def ekf_status_report(s: TelemetrySource) -> WireMessage:
    return dialect.EkfStatusReport(estimator_flags(s))


def home_position(s: TelemetrySource) -> WireMessage | None:
    if s.state.home_m is None:
        return None
    latitude, longitude, height = s.home_place
    return dialect.HomePosition(
        round(1e7 * latitude),
        round(1e7 * longitude),
        round(1000 * height),
        *ned_axes.ned(s.state.home_m),
        (1.0, 0.0, 0.0, 0.0),
        time_usec=s.boot_us,
    )


def gps_global_origin(s: TelemetrySource) -> WireMessage:
    latitude, longitude, height = s.state.origin
    return dialect.GpsGlobalOrigin(round(1e7 * latitude), round(1e7 * longitude), round(1000 * height), s.boot_us)


def position_target_local_ned(s: TelemetrySource) -> WireMessage | None:
    target = s.flight.target
    if not isinstance(target, Target):
        return None
    position = ned_axes.ned(tuple(0.0 if p is None else p for p in target.position_m))  # type: ignore[arg-type]
    mask = TypeMask.AX | TypeMask.AY | TypeMask.AZ
    for p, bit in zip(target.position_m, (TypeMask.Y, TypeMask.X, TypeMask.Z), strict=True):
        mask |= bit if p is None else TypeMask(0)
    mask |= TypeMask.YAW_RATE if target.yaw_rad is not None else TypeMask.YAW
    frame = MavFrame.BODY_NED if target.along_heading else MavFrame.LOCAL_NED
    velocity = ned_axes.frd(target.velocity_m_s) if target.along_heading else ned_axes.ned(target.velocity_m_s)
    yaw = ned_axes.yaw_ned(target.yaw_rad) if target.yaw_rad is not None else 0.0
    return dialect.PositionTargetLocalNed(
        s.boot_ms, frame, mask, *position, *velocity, 0.0, 0.0, 0.0, yaw, -target.yaw_rate_rad_s
    )


def mission_current(s: TelemetrySource) -> WireMessage:
    mission = s.flight.mission
    return dialect.MissionCurrent(mission.current, mission.first + len(mission.items))


def fence_status(s: TelemetrySource) -> WireMessage:
    breached = s.breach != 0
    return dialect.FenceStatus(int(breached), min(s.breaches, 0xFFFF), s.breach, s.breach_ns // 1_000_000)
