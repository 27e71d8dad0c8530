"""Messages with what a vehicle measures, each made of it at a gate; None where the sensor has failed."""

import math
from typing import Any

from zsim.schema.quantities import G_M_S2
from zsim_bridges.mavlink.autopilot import ned_axes
from zsim_bridges.mavlink.autopilot.enums import GpsFix
from zsim_bridges.mavlink.telemetry.telemetry_source import TelemetrySource, int16
from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.mavlink.wire.wire_message import WireMessage

UNKNOWN_16, UNKNOWN_8 = 65535, 255
GAUSS_PER_UT, MILLIGAUSS_PER_UT = 0.01, 10.0
INERTIAL = 0x3F  # HIGHRES_IMU_UPDATED_FLAGS: accelerometer and gyroscope; 0x1C0 the magnetometer, 0xA00 the barometer
MG_PER_M_S2 = 1000.0 / G_M_S2


def gps_raw_int(s: TelemetrySource) -> WireMessage:
    gps = s.state.samples.get("gps")
    if gps is None or s.state.has_failed("gps"):
        fix = GpsFix.NO_GPS if gps is None else GpsFix.NO_FIX
        return dialect.GpsRawInt(s.boot_us, fix, eph=UNKNOWN_16, epv=UNKNOWN_16, vel=UNKNOWN_16, cog=UNKNOWN_16)
    vx, vy, _ = gps.velocity_m_s
    course = math.degrees(math.atan2(vx, vy)) % 360.0
    sigma_mm = min(round(1000 * gps.sigma_m), 2**32 - 1)
    return dialect.GpsRawInt(
        time_usec=gps.t_sample_ns // 1000,
        fix_type=min(gps.fix, 8),
        lat=round(1e7 * gps.latitude_deg),
        lon=round(1e7 * gps.longitude_deg),
        alt=round(1000 * gps.altitude_m),
        eph=100,  # HDOP 1: zsim has a standard deviation alone
        epv=100,
        vel=min(65534, round(100 * math.hypot(vx, vy))),
        cog=round(100 * course) % 36000,
        satellites_visible=min(gps.satellites, 254),
        alt_ellipsoid=round(1000 * gps.altitude_m),
        h_acc=sigma_mm,
        v_acc=sigma_mm,
    )


def battery_status(s: TelemetrySource) -> WireMessage:
    used = round(s.capacity_mah * (1.0 - s.battery_percent / 100.0))
    return dialect.BatteryStatus(
        current_consumed=max(0, used),
        energy_consumed=-1,
        temperature=32767,
        voltages=(min(65534, round(1000 * s.voltage_v)), *(UNKNOWN_16,) * 9),
        current_battery=-1,
        type=1,  # MAV_BATTERY_TYPE_LIPO
        battery_remaining=round(s.battery_percent),
        charge_state=2 if s.state.is_battery_low else 1,  # LOW, OK of MAV_BATTERY_CHARGE_STATE
    )


def scaled_imu(s: TelemetrySource) -> WireMessage | None:
    imu, mag = s.state.samples.get("imu"), s.state.samples.get("mag")
    if imu is None or s.state.has_failed("imu"):
        return None
    accel = (int16(MG_PER_M_S2 * a) for a in ned_axes.frd(imu.accel_m_s2))
    gyro = (int16(1000 * w) for w in ned_axes.frd(imu.gyro_rad_s))
    field = (int16(MILLIGAUSS_PER_UT * b) for b in ned_axes.frd(mag.field_ut)) if mag else (0, 0, 0)
    return dialect.ScaledImu(s.boot_ms, *accel, *gyro, *field)


def raw_imu(s: TelemetrySource) -> WireMessage | None:
    scaled = scaled_imu(s)
    if not isinstance(scaled, dialect.ScaledImu):
        return None
    m = scaled
    return dialect.RawImu(s.boot_us, m.xacc, m.yacc, m.zacc, m.xgyro, m.ygyro, m.zgyro, m.xmag, m.ymag, m.zmag)


def inertial(imu: Any) -> WireMessage:
    """Return HIGHRES_IMU of a sample of the inertial unit alone."""
    t_us = imu.t_sample_ns // 1000
    return dialect.HighresImu(
        t_us, *ned_axes.frd(imu.accel_m_s2), *ned_axes.frd(imu.gyro_rad_s), fields_updated=INERTIAL
    )


def highres_imu(s: TelemetrySource) -> WireMessage | None:
    imu = s.state.samples.get("imu")
    if imu is None or s.state.has_failed("imu"):
        return None
    mag, baro = s.state.samples.get("mag"), s.state.samples.get("baro")
    ax, ay, az = ned_axes.frd(imu.accel_m_s2)
    wx, wy, wz = ned_axes.frd(imu.gyro_rad_s)
    mx, my, mz = (GAUSS_PER_UT * b for b in ned_axes.frd(mag.field_ut)) if mag else (0.0, 0.0, 0.0)
    pressure, height = (baro.pressure_pa / 100.0, baro.altitude_m) if baro else (0.0, 0.0)
    updated = INERTIAL | (0x1C0 if mag else 0) | (0xA00 if baro else 0)
    t_us = imu.t_sample_ns // 1000
    return dialect.HighresImu(
        t_us, ax, ay, az, wx, wy, wz, mx, my, mz, pressure, 0.0, height, 0.0, fields_updated=updated
    )


def scaled_pressure(s: TelemetrySource) -> WireMessage | None:
    baro = s.state.samples.get("baro")
    if baro is None or s.state.has_failed("baro"):
        return None
    return dialect.ScaledPressure(s.boot_ms, baro.pressure_pa / 100.0)


def distance_sensor(s: TelemetrySource) -> WireMessage | None:
    sonar = s.state.samples.get("sonar")
    if sonar is None or s.state.has_failed("sonar"):
        return None
    return dialect.DistanceSensor(
        s.boot_ms,
        min_distance=3,
        max_distance=600,
        current_distance=max(0, min(65535, round(100 * sonar.range_m))) if sonar.valid else 601,
        type=1,  # MAV_DISTANCE_SENSOR_ULTRASOUND
        orientation=25,  # MAV_SENSOR_ROTATION_PITCH_270: downwards
        covariance=UNKNOWN_8,
    )


def optical_flow(s: TelemetrySource) -> WireMessage | None:
    flow = s.state.samples.get("flow")
    if flow is None or s.state.has_failed("flow"):
        return None
    forward, left, _ = flow.velocity_m_s
    quality = max(0, min(255, round(255 * flow.quality)))
    return dialect.OpticalFlow(s.boot_us, 0, 0, 0, forward, -left, quality, s.state.altitude_m)


def vibration(s: TelemetrySource) -> WireMessage:
    return dialect.Vibration(s.boot_us)
