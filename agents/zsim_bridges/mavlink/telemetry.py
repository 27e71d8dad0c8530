"""The telemetry of a vehicle: its messages, each built from the state at one gate, and their rates.

A builder returns None if there is nothing to send, for example after its sensor has failed. Messages that are due at
the same gate are sent in the order of TELEMETRY_ROWS, followed by those that a client has switched on.
"""

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any, Literal, NamedTuple

from zsim.math import frames
from zsim.math.rotation import Vector
from zsim.scenario.scenario import Drone
from zsim.schema.quantities import G_M_S2
from zsim.vehicles.vehicle import vehicle_of
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import (
    UINT16_UNKNOWN,
    BaseMode,
    LandedState,
    MavFrame,
    SystemStatus,
    TypeMask,
    WireMessage,
    frd,
    global_ints,
    int16,
    ned,
)
from zsim_bridges.mavlink.personality import MANUAL_MODES, FlightMode, Personality
from zsim_bridges.mavlink.vehicle_flight import Flight
from zsim_bridges.mavlink.vehicle_state import ALL_HEALTHY, Target, VehicleState

Level = Literal["normal", "full"]
SECOND_NS = 1_000_000_000
RATE_MAX_HZ = 50.0  # Hz; one message of each type per gate of 20 ms
IMU_RATE_MAX_HZ = 200.0  # Hz; one message for each sample of the IMU
GATE_NS = round(SECOND_NS / RATE_MAX_HZ)
MAVLINK_VERSION = 3  # in HEARTBEAT
NAN = math.nan
MG_PER_M_S2 = 1000.0 / G_M_S2
GAUSS_PER_UT, MILLIGAUSS_PER_UT = 0.01, 10.0
INERTIAL, MAGNETIC, BAROMETRIC = 0x03F, 0x1C0, 0xA00  # HIGHRES_IMU_UPDATED_FLAGS
LANDED_STATES = {
    "landed": LandedState.ON_GROUND,
    "taking_off": LandedState.TAKEOFF,
    "hovering": LandedState.IN_AIR,
    "flying": LandedState.IN_AIR,
    "landing": LandedState.LANDING,
    "emergency": LandedState.UNDEFINED,
}
BREACH_NONE, BREACH_ALTITUDE, BREACH_BOUNDARY = 0, 2, 3  # FENCE_BREACH


class TelemetrySource:
    """The data behind the telemetry; values that several messages need are computed once per gate.

    Attributes:
        voltage_v, capacity_mah: nominal voltage and capacity of the battery.
        breach: which limit of the fence is breached (FENCE_BREACH); breaches: how many so far; breach_ns: since when.
    """

    def __init__(self, drone: Drone, state: VehicleState, flight: Flight, personality: Personality) -> None:
        self.state = state
        self.flight = flight
        self.personality = personality
        self.voltage_v = vehicle_of(drone.model).battery.voltage_v
        self.capacity_mah = drone.battery_mah
        self.breach = BREACH_NONE
        self.breaches = self.breach_ns = 0

    def advance(self) -> None:
        """Discard the values computed for the previous gate."""
        for name in ("rpy_ned_rad", "place", "position_ned_m", "velocity_ned_m_s"):
            self.__dict__.pop(name, None)

    def sample(self, sensor: str) -> Any:
        """Return the newest sample of a sensor; None before the first, or if the sensor has failed."""
        sample = self.state.samples.get(sensor)
        return None if sample is None or self.state.has_failed(sensor) else sample

    @property
    def boot_ms(self) -> int:
        return self.state.t_ns // 1_000_000 & 0xFFFFFFFF

    @property
    def boot_us(self) -> int:
        return self.state.t_ns // 1000

    @property
    def battery_percent(self) -> float:
        return self.state.status.battery_percent if self.state.status else 0.0

    @cached_property
    def rpy_ned_rad(self) -> Vector:
        return self.state.rpy_ned_rad

    @cached_property
    def place(self) -> Vector:
        """Latitude [deg], longitude [deg], height [m]."""
        return self.state.to_global(self.state.position_m)

    @cached_property
    def position_ned_m(self) -> Vector:
        return ned(self.state.position_m)

    @cached_property
    def velocity_ned_m_s(self) -> Vector:
        return ned(self.state.velocity_m_s)


def heartbeat(s: TelemetrySource) -> WireMessage:
    flight, modes = s.flight, s.personality.modes
    base_mode = BaseMode.CUSTOM | BaseMode.STABILIZE
    base_mode |= BaseMode.MANUAL_INPUT if flight.mode in MANUAL_MODES else BaseMode.GUIDED | BaseMode.AUTO
    if flight.is_armed:
        base_mode |= BaseMode.ARMED
    status = SystemStatus.ACTIVE if flight.is_armed else SystemStatus.STANDBY
    if s.state.state == "emergency":
        status = SystemStatus.EMERGENCY
    elif s.state.is_airborne and (s.state.is_battery_low or s.breach):
        status = SystemStatus.CRITICAL
    custom_mode = modes[FlightMode.MISSION if flight.foreign_commander else flight.mode]
    return dialect.Heartbeat(
        dialect.TYPE_QUADROTOR, s.personality.autopilot, base_mode, custom_mode, status, MAVLINK_VERSION
    )


def sys_status(s: TelemetrySource) -> WireMessage:
    return dialect.SysStatus(
        onboard_control_sensors_present=int(ALL_HEALTHY),
        onboard_control_sensors_enabled=int(ALL_HEALTHY),
        onboard_control_sensors_health=int(s.state.health()),
        voltage_battery=round(1000 * s.voltage_v),
        current_battery=-1,
        battery_remaining=round(s.battery_percent),
    )


def global_position_int(s: TelemetrySource) -> WireMessage:
    velocity = (int16(100 * v) for v in s.velocity_ned_m_s)
    heading = round(math.degrees(s.rpy_ned_rad[2]) % 360.0 * 100) % 36000
    altitude_mm = round(1000 * s.state.altitude_m)
    return dialect.GlobalPositionInt(s.boot_ms, *global_ints(s.place), altitude_mm, *velocity, heading)


def gps_raw_int(s: TelemetrySource) -> WireMessage:
    gps = s.sample("gps")
    if gps is None:
        return dialect.GpsRawInt(s.boot_us, dialect.NO_FIX if "gps" in s.state.samples else dialect.NO_GPS)
    vx, vy, _ = gps.velocity_m_s
    course = math.degrees(math.atan2(vx, vy)) % 360.0
    latitude, longitude, altitude = global_ints((gps.latitude_deg, gps.longitude_deg, gps.altitude_m))
    sigma_mm = min(round(1000 * gps.sigma_m), 2**32 - 1)
    return dialect.GpsRawInt(
        time_usec=gps.t_sample_ns // 1000,
        fix_type=min(gps.fix, 8),
        lat=latitude,
        lon=longitude,
        alt=altitude,
        eph=100,  # HDOP 1: zsim knows only a standard deviation
        epv=100,
        vel=min(UINT16_UNKNOWN - 1, round(100 * math.hypot(vx, vy))),
        cog=round(100 * course) % 36000,
        satellites_visible=min(gps.satellites, 254),
        alt_ellipsoid=altitude,
        h_acc=sigma_mm,
        v_acc=sigma_mm,
    )


def vfr_hud(s: TelemetrySource) -> WireMessage:
    vx, vy, vz = s.state.velocity_m_s
    speed = math.hypot(vx, vy)
    heading = round(math.degrees(s.rpy_ned_rad[2])) % 360
    return dialect.VfrHud(speed, speed, heading, 50 if s.state.is_airborne else 0, s.place[2], vz)


def battery_status(s: TelemetrySource) -> WireMessage:
    voltage_mv = min(UINT16_UNKNOWN - 1, round(1000 * s.voltage_v))
    return dialect.BatteryStatus(
        current_consumed=max(0, round(s.capacity_mah * (1.0 - s.battery_percent / 100.0))),
        voltages=(voltage_mv, *(UINT16_UNKNOWN,) * 9),
        type=1,  # MAV_BATTERY_TYPE_LIPO
        battery_remaining=round(s.battery_percent),
        charge_state=2 if s.state.is_battery_low else 1,  # MAV_BATTERY_CHARGE_STATE: LOW, OK
    )


def home_position(s: TelemetrySource) -> WireMessage | None:
    home_m = s.state.home_m
    if home_m is None:
        return None
    geodetic = global_ints(s.state.to_global(home_m))
    return dialect.HomePosition(*geodetic, *ned(home_m), (1.0, 0.0, 0.0, 0.0), time_usec=s.boot_us)


def position_target_local_ned(s: TelemetrySource) -> WireMessage | None:
    target = s.flight.target
    if not isinstance(target, Target):
        return None
    x, y, z = target.position_m
    mask = TypeMask.AX | TypeMask.AY | TypeMask.AZ
    for p, bit in ((x, TypeMask.Y), (y, TypeMask.X), (z, TypeMask.Z)):  # x in W is y in MAVLink
        mask |= bit if p is None else TypeMask(0)
    mask |= TypeMask.YAW_RATE if target.yaw_rad is not None else TypeMask.YAW
    frame, axes = (MavFrame.BODY_NED, frd) if target.along_heading else (MavFrame.LOCAL_NED, ned)
    position = ned((0.0 if x is None else x, 0.0 if y is None else y, 0.0 if z is None else z))
    yaw = dialect.yaw_ned(target.yaw_rad) if target.yaw_rad is not None else 0.0
    return dialect.PositionTargetLocalNed(
        s.boot_ms, frame, mask, *position, *axes(target.velocity_m_s), 0.0, 0.0, 0.0, yaw, -target.yaw_rate_rad_s
    )


def mission_current(s: TelemetrySource) -> WireMessage:
    mission = s.flight.mission
    return dialect.MissionCurrent(mission.current, mission.first + len(mission.items))


def distance_sensor(s: TelemetrySource) -> WireMessage | None:
    sonar = s.sample("sonar")
    if sonar is None:
        return None
    return dialect.DistanceSensor(
        s.boot_ms,
        min_distance=3,
        max_distance=600,
        current_distance=max(0, min(65535, round(100 * sonar.range_m))) if sonar.valid else 601,
        type=1,  # MAV_DISTANCE_SENSOR_ULTRASOUND
        orientation=25,  # MAV_SENSOR_ROTATION_PITCH_270: downwards
    )


def odometry(s: TelemetrySource) -> WireMessage:
    w, x, y, z = s.state.q_WB
    forward, left, up = frames.rotate((w, -x, -y, -z), s.state.velocity_m_s).tolist()
    horizontal, vertical = (sigma * sigma for sigma in s.state.sigma_m)
    return dialect.Odometry(
        s.boot_us,
        MavFrame.LOCAL_NED,
        MavFrame.BODY_FRD,
        *s.position_ned_m,
        dialect.attitude_ned(s.state.q_WB),
        *frd((forward, left, up)),
        *frd(s.state.rate_rad_s),
        (horizontal, *(0.0,) * 5, horizontal, *(0.0,) * 4, vertical, *(0.0,) * 3, NAN, 0.0, 0.0, NAN, 0.0, NAN),
        (NAN, *(0.0,) * 20),
        estimator_type=3,  # MAV_ESTIMATOR_TYPE_GPS_INS
    )


def highres_imu(s: TelemetrySource) -> WireMessage | None:
    imu = s.sample("imu")
    if imu is None:
        return None
    mag, baro = s.state.samples.get("mag"), s.state.samples.get("baro")
    field = tuple(GAUSS_PER_UT * b for b in frd(mag.field_ut)) if mag else (0.0, 0.0, 0.0)
    pressure_hpa, height_m = (baro.pressure_pa / 100.0, baro.altitude_m) if baro else (0.0, 0.0)
    updated = INERTIAL | (MAGNETIC if mag else 0) | (BAROMETRIC if baro else 0)
    return dialect.HighresImu(
        imu.t_sample_ns // 1000,
        *frd(imu.accel_m_s2),
        *frd(imu.gyro_rad_s),
        *field,
        abs_pressure=pressure_hpa,
        pressure_alt=height_m,
        fields_updated=updated,
    )


def _inertial(imu: Any) -> WireMessage:
    t_us = imu.t_sample_ns // 1000
    return dialect.HighresImu(t_us, *frd(imu.accel_m_s2), *frd(imu.gyro_rad_s), fields_updated=INERTIAL)


def altitude(s: TelemetrySource) -> WireMessage:
    z, height = s.state.position_m[2], s.place[2]
    return dialect.Altitude(s.boot_us, z, height, z, s.state.altitude_m, NAN, NAN)


def _estimator_flags(s: TelemetrySource) -> int:
    """Return the estimator's flags: all, except the absolute position's if it is estimated and the GPS has failed."""
    if s.state.is_estimated and s.state.has_failed("gps"):
        return dialect.ALL_ESTIMATED & ~(dialect.POS_HORIZ_ABS | dialect.PRED_POS_HORIZ_ABS)
    return dialect.ALL_ESTIMATED


def estimator_status(s: TelemetrySource) -> WireMessage:
    horizontal, vertical = s.state.sigma_m
    flags = _estimator_flags(s)
    return dialect.EstimatorStatus(s.boot_us, flags, pos_horiz_accuracy=horizontal, pos_vert_accuracy=vertical)


def _milli_readings(s: TelemetrySource) -> tuple[int, ...] | None:
    """Return specific force [mg], body rate [mrad/s] and magnetic field [mgauss] along forward, right, down."""
    imu, mag = s.sample("imu"), s.state.samples.get("mag")
    if imu is None:
        return None
    accel = (int16(MG_PER_M_S2 * a) for a in frd(imu.accel_m_s2))
    gyro = (int16(1000 * w) for w in frd(imu.gyro_rad_s))
    field = (int16(MILLIGAUSS_PER_UT * b) for b in frd(mag.field_ut)) if mag else (0, 0, 0)
    return *accel, *gyro, *field


def raw_imu(s: TelemetrySource) -> WireMessage | None:
    values = _milli_readings(s)
    return dialect.RawImu(s.boot_us, *values) if values else None


def scaled_imu(s: TelemetrySource) -> WireMessage | None:
    values = _milli_readings(s)
    return dialect.ScaledImu(s.boot_ms, *values) if values else None


def scaled_pressure(s: TelemetrySource) -> WireMessage | None:
    baro = s.sample("baro")
    return dialect.ScaledPressure(s.boot_ms, baro.pressure_pa / 100.0) if baro else None


def optical_flow(s: TelemetrySource) -> WireMessage | None:
    flow = s.sample("flow")
    if flow is None:
        return None
    forward, left, _ = flow.velocity_m_s
    quality = max(0, min(255, round(255 * flow.quality)))
    return dialect.OpticalFlow(s.boot_us, 0, 0, 0, forward, -left, quality, s.state.altitude_m)


Builder = Callable[[TelemetrySource], WireMessage | None]
Rates = tuple[float, float]
"""Rates at the levels normal and full [Hz of simulated time]."""


class TelemetryRow(NamedTuple):
    """A message: its builder, its rates by autopilot (None: on request), and the sensor whose samples it awaits."""

    build: Builder
    px4: Rates | None = None
    ardupilot: Rates | None = None
    sensor: str | None = None


TELEMETRY_ROWS: dict[type[WireMessage], TelemetryRow] = {
    dialect.Heartbeat: TelemetryRow(heartbeat),
    dialect.SysStatus: TelemetryRow(sys_status, (1.0, 5.0), (1.0, 5.0)),
    dialect.SystemTime: TelemetryRow(lambda s: dialect.SystemTime(time_boot_ms=s.boot_ms), (1.0, 1.0), (1.0, 1.0)),
    dialect.Attitude: TelemetryRow(
        lambda s: dialect.Attitude(s.boot_ms, *s.rpy_ned_rad, *frd(s.state.rate_rad_s)), (10.0, 50.0), (10.0, 50.0)
    ),
    dialect.LocalPositionNed: TelemetryRow(
        lambda s: dialect.LocalPositionNed(s.boot_ms, *s.position_ned_m, *s.velocity_ned_m_s),
        (10.0, 50.0),
        (10.0, 50.0),
    ),
    dialect.GlobalPositionInt: TelemetryRow(global_position_int, (5.0, 50.0), (5.0, 50.0)),
    dialect.GpsRawInt: TelemetryRow(gps_raw_int, (5.0, 5.0), (5.0, 5.0), "gps"),
    dialect.VfrHud: TelemetryRow(vfr_hud, (4.0, 20.0), (4.0, 20.0)),
    dialect.BatteryStatus: TelemetryRow(battery_status, (0.5, 1.0), (0.5, 1.0)),
    dialect.ExtendedSysState: TelemetryRow(
        lambda s: dialect.ExtendedSysState(0, LANDED_STATES[s.state.state]), (2.0, 5.0), (2.0, 5.0)
    ),
    dialect.HomePosition: TelemetryRow(home_position, (0.5, 1.0), (0.5, 1.0)),
    dialect.GpsGlobalOrigin: TelemetryRow(
        lambda s: dialect.GpsGlobalOrigin(*global_ints(s.state.origin), s.boot_us), (0.2, 1.0), (0.2, 1.0)
    ),
    dialect.PositionTargetLocalNed: TelemetryRow(position_target_local_ned, (2.0, 10.0), (2.0, 10.0)),
    dialect.MissionCurrent: TelemetryRow(mission_current, (1.0, 1.0), (1.0, 1.0)),
    dialect.DistanceSensor: TelemetryRow(distance_sensor, (2.0, 10.0), (2.0, 10.0), "sonar"),
    dialect.Vibration: TelemetryRow(lambda s: dialect.Vibration(s.boot_us), (0.1, 1.0), (0.1, 1.0)),
    dialect.AttitudeQuaternion: TelemetryRow(
        lambda s: dialect.AttitudeQuaternion(s.boot_ms, *dialect.attitude_ned(s.state.q_WB), *frd(s.state.rate_rad_s)),
        (10.0, 50.0),
    ),
    dialect.Odometry: TelemetryRow(odometry, (0.0, 30.0)),
    dialect.HighresImu: TelemetryRow(highres_imu, (5.0, 50.0), None, "imu"),
    dialect.Altitude: TelemetryRow(altitude, (1.0, 10.0)),
    dialect.EstimatorStatus: TelemetryRow(estimator_status, (1.0, 5.0)),
    dialect.RawImu: TelemetryRow(raw_imu, None, (2.0, 50.0)),
    dialect.ScaledImu: TelemetryRow(scaled_imu, None, (0.0, 50.0)),
    dialect.EkfStatusReport: TelemetryRow(lambda s: dialect.EkfStatusReport(_estimator_flags(s)), None, (1.0, 10.0)),
    dialect.FenceStatus: TelemetryRow(
        lambda s: dialect.FenceStatus(int(s.breach != 0), min(s.breaches, 0xFFFF), s.breach, s.breach_ns // 1_000_000),
        None,
        (1.0, 2.0),
    ),
    dialect.ScaledPressure: TelemetryRow(scaled_pressure, (1.0, 5.0), (2.0, 10.0)),
    dialect.OpticalFlow: TelemetryRow(optical_flow, (0.0, 15.0), None, "flow"),
}
STREAMS: dict[int, tuple[type[WireMessage], ...]] = {  # MAV_DATA_STREAM; contents as in ArduCopter
    1: (dialect.RawImu, dialect.ScaledPressure, dialect.ScaledImu),
    2: (dialect.SysStatus, dialect.MissionCurrent, dialect.GpsRawInt, dialect.FenceStatus),
    6: (dialect.GlobalPositionInt, dialect.LocalPositionNed),
    10: (dialect.Attitude,),
    11: (dialect.VfrHud,),
    12: (dialect.SystemTime, dialect.EkfStatusReport, dialect.DistanceSensor, dialect.BatteryStatus, dialect.Vibration),
}
ALL_STREAMS = 0
MESSAGE_TYPES_BY_ID = {dialect.LAYOUTS[kind].id: kind for kind in TELEMETRY_ROWS}


class Telemetry:
    """The messages of one vehicle and their rates, which clients may change."""

    def __init__(self, source: TelemetrySource, level: Level) -> None:
        self._source = source
        self._defaults: dict[type[WireMessage], float] = {}
        self._interval_ns: dict[type[WireMessage], int] = {}
        self._due_ns: dict[type[WireMessage], int] = {}
        for kind, row in TELEMETRY_ROWS.items():
            rates = row.px4 if source.personality.is_px4 else row.ardupilot
            if rates:
                self._defaults[kind] = rates[1 if level == "full" else 0]
                self._set_rate(kind, self._defaults[kind])

    def _set_rate(self, kind: type[WireMessage], rate_hz: float) -> None:
        if rate_hz <= 0:
            self._interval_ns.pop(kind, None)
            return
        max_hz = IMU_RATE_MAX_HZ if kind is dialect.HighresImu else RATE_MAX_HZ
        self._interval_ns[kind] = round(SECOND_NS / min(rate_hz, max_hz))
        self._due_ns[kind] = 0

    def due(self, t_ns: int) -> list[WireMessage]:
        self._source.advance()
        new_samples = self._source.state.take_new_samples()
        messages: list[WireMessage] = []
        for kind, interval_ns in self._interval_ns.items():
            due_ns, delay_ns, sensor = self._due_ns[kind], 0, TELEMETRY_ROWS[kind].sensor
            if sensor is not None:  # wait for a sample, at most two intervals
                delay_ns = -interval_ns // 2 if new_samples.get(sensor) else 2 * interval_ns
            if t_ns >= due_ns + delay_ns:
                self._due_ns[kind] = max(due_ns + interval_ns, t_ns + interval_ns // 2)
                message = TELEMETRY_ROWS[kind].build(self._source)
                if message is not None:
                    if kind is dialect.HighresImu and interval_ns < GATE_NS:  # every sample since the last gate
                        messages += map(_inertial, new_samples.get("imu", ())[:-1])
                    messages.append(message)
        return messages

    def build(self, message_id: int) -> WireMessage | None:
        """Return the current message; None if there is none, or this vehicle does not send it."""
        kind = MESSAGE_TYPES_BY_ID.get(message_id)
        self._source.advance()
        return TELEMETRY_ROWS[kind].build(self._source) if kind else None

    def set_interval(self, message_id: int, interval_us: float) -> bool:
        """Set the interval of a message (-1: never, 0: the default); return False if this vehicle does not send it.

        The interval of the heartbeat is fixed.
        """
        kind = MESSAGE_TYPES_BY_ID.get(message_id)
        if kind is None:
            return False
        if kind is not dialect.Heartbeat:
            default_hz = self._defaults.get(kind, 0.0)
            self._set_rate(kind, default_hz if interval_us == 0 else max(0.0, 1e6 / interval_us))
        return True

    def interval_us(self, message_id: int) -> int:
        """Return the interval of a message; -1 if it is off, 0 if this vehicle has no such message."""
        kind = MESSAGE_TYPES_BY_ID.get(message_id)
        if kind is None:
            return 0
        if kind is dialect.Heartbeat:
            return 1_000_000
        return self._interval_ns[kind] // 1000 if kind in self._interval_ns else -1

    def set_stream(self, stream: int, rate_hz: float) -> None:
        """Set the rate of a group of messages, as in the deprecated REQUEST_DATA_STREAM."""
        for number, kinds in STREAMS.items():
            if stream in (ALL_STREAMS, number):
                for kind in kinds:
                    if kind in self._defaults:
                        self._set_rate(kind, rate_hz)
