"""Which messages of telemetry a vehicle sends, and how often; what clients change of that."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

from zsim_bridges.mavlink.telemetry import sensor_telemetry, state_telemetry
from zsim_bridges.mavlink.telemetry.telemetry_source import TelemetrySource
from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.mavlink.wire.wire_message import LAYOUTS, WireMessage

Level = Literal["normal", "full"]
SECOND_NS = 1_000_000_000
RATE_MAX_HZ = 50.0  # Hz; one of each with a gate of 20 ms
IMU_RATE_MAX_HZ = 200.0  # Hz; each sample of the inertial unit
GATE_NS = round(SECOND_NS / RATE_MAX_HZ)

Builder = Callable[[TelemetrySource], WireMessage | None]
BUILDERS: dict[type[WireMessage], Builder] = {
    dialect.Heartbeat: state_telemetry.heartbeat,
    dialect.SysStatus: state_telemetry.sys_status,
    dialect.SystemTime: state_telemetry.system_time,
    dialect.Attitude: state_telemetry.attitude,
    dialect.AttitudeQuaternion: state_telemetry.attitude_quaternion,
    dialect.LocalPositionNed: state_telemetry.local_position_ned,
    dialect.Odometry: state_telemetry.odometry,
    dialect.GlobalPositionInt: state_telemetry.global_position_int,
    dialect.GpsRawInt: sensor_telemetry.gps_raw_int,
    dialect.VfrHud: state_telemetry.vfr_hud,
    dialect.Altitude: state_telemetry.altitude,
    dialect.BatteryStatus: sensor_telemetry.battery_status,
    dialect.ExtendedSysState: state_telemetry.extended_sys_state,
    dialect.EstimatorStatus: state_telemetry.estimator_status,
    dialect.EkfStatusReport: state_telemetry.ekf_status_report,
    dialect.HomePosition: state_telemetry.home_position,
    dialect.GpsGlobalOrigin: state_telemetry.gps_global_origin,
    dialect.PositionTargetLocalNed: state_telemetry.position_target_local_ned,
    dialect.ScaledImu: sensor_telemetry.scaled_imu,
    dialect.RawImu: sensor_telemetry.raw_imu,
    dialect.HighresImu: sensor_telemetry.highres_imu,
    dialect.ScaledPressure: sensor_telemetry.scaled_pressure,
    dialect.DistanceSensor: sensor_telemetry.distance_sensor,
    dialect.OpticalFlow: sensor_telemetry.optical_flow,
    dialect.MissionCurrent: state_telemetry.mission_current,
    dialect.FenceStatus: state_telemetry.fence_status,
    dialect.Vibration: sensor_telemetry.vibration,
}
SAMPLED: dict[type[WireMessage], str] = {
    dialect.HighresImu: "imu",
    dialect.GpsRawInt: "gps",
    dialect.OpticalFlow: "flow",
    dialect.DistanceSensor: "sonar",
}
"""Messages that are of a sample of a sensor, and are sent when there is one."""
Rates = dict[type[WireMessage], tuple[float, float]]
"""Rates at the levels normal and full [Hz of simulated time]."""

BOTH: Rates = {
    dialect.SysStatus: (1.0, 5.0),
    dialect.SystemTime: (1.0, 1.0),
    dialect.Attitude: (10.0, 50.0),
    dialect.LocalPositionNed: (10.0, 50.0),
    dialect.GlobalPositionInt: (5.0, 50.0),
    dialect.GpsRawInt: (5.0, 5.0),
    dialect.VfrHud: (4.0, 20.0),
    dialect.BatteryStatus: (0.5, 1.0),
    dialect.ExtendedSysState: (2.0, 5.0),
    dialect.HomePosition: (0.5, 1.0),
    dialect.GpsGlobalOrigin: (0.2, 1.0),
    dialect.PositionTargetLocalNed: (2.0, 10.0),
    dialect.MissionCurrent: (1.0, 1.0),
    dialect.DistanceSensor: (2.0, 10.0),
    dialect.Vibration: (0.1, 1.0),
}
PX4: Rates = {
    dialect.AttitudeQuaternion: (10.0, 50.0),
    dialect.Odometry: (0.0, 30.0),
    dialect.HighresImu: (5.0, 50.0),
    dialect.Altitude: (1.0, 10.0),
    dialect.EstimatorStatus: (1.0, 5.0),
    dialect.ScaledPressure: (1.0, 5.0),
    dialect.OpticalFlow: (0.0, 15.0),
}
ARDUPILOT: Rates = {
    dialect.RawImu: (2.0, 50.0),
    dialect.ScaledImu: (0.0, 50.0),
    dialect.EkfStatusReport: (1.0, 10.0),
    dialect.FenceStatus: (1.0, 2.0),
    dialect.ScaledPressure: (2.0, 10.0),
}
STREAMS: dict[int, tuple[type[WireMessage], ...]] = {  # MAV_DATA_STREAM, as ArduCopter fills them
    1: (dialect.RawImu, dialect.ScaledPressure, dialect.ScaledImu),
    2: (dialect.SysStatus, dialect.MissionCurrent, dialect.GpsRawInt, dialect.FenceStatus),
    6: (dialect.GlobalPositionInt, dialect.LocalPositionNed),
    10: (dialect.Attitude,),
    11: (dialect.VfrHud,),
    12: (dialect.SystemTime, dialect.EkfStatusReport, dialect.DistanceSensor, dialect.BatteryStatus, dialect.Vibration),
}
ALL_STREAMS = 0
BY_ID = {LAYOUTS[kind].id: kind for kind in BUILDERS}


class Telemetry:
    """What one vehicle sends of itself.

    Args:
        source: of what is sent.
        level: of the rates at the start.
    """

    def __init__(self, source: TelemetrySource, level: Level) -> None:
        rates = {**BOTH, **(PX4 if source.personality.name == "px4" else ARDUPILOT)}
        column = 1 if level == "full" else 0
        self._source = source
        self._defaults = {kind: pair[column] for kind, pair in rates.items()}
        self._interval_ns: dict[type[WireMessage], int] = {}
        self._due_ns: dict[type[WireMessage], int] = {}
        for kind in self._defaults:
            self._put(kind, self._defaults[kind])

    def _put(self, kind: type[WireMessage], rate_hz: float) -> None:
        if rate_hz <= 0:
            self._interval_ns.pop(kind, None)
            return
        most_hz = IMU_RATE_MAX_HZ if kind is dialect.HighresImu else RATE_MAX_HZ
        self._interval_ns[kind] = round(SECOND_NS / min(rate_hz, most_hz))
        self._due_ns[kind] = 0

    def due(self, t_ns: int) -> list[WireMessage]:
        """Return the messages that are due at a gate."""
        self._source.advance()
        arrived = self._source.state.take_arrived()
        messages: list[WireMessage] = []
        for kind, interval_ns in self._interval_ns.items():
            due_ns = self._due_ns[kind]
            if t_ns >= due_ns + _waits_ns(kind, interval_ns, arrived):
                self._due_ns[kind] = max(due_ns + interval_ns, t_ns + interval_ns // 2)
                messages += self._made(kind, interval_ns, arrived)
        return messages

    def _made(
        self, kind: type[WireMessage], interval_ns: int, arrived: Mapping[str, Sequence[Any]]
    ) -> list[WireMessage]:
        """Return what is sent of a message at a gate: more than one of an inertial unit that samples more often."""
        message = BUILDERS[kind](self._source)
        if message is None:
            return []
        if kind is not dialect.HighresImu or interval_ns >= GATE_NS:
            return [message]
        return [*map(sensor_telemetry.inertial, arrived.get("imu", ())[:-1]), message]

    def build(self, message_id: int) -> WireMessage | None:
        """Return a message now; None for one that this vehicle has not."""
        kind = BY_ID.get(message_id)
        self._source.advance()
        return BUILDERS[kind](self._source) if kind else None

    def put_interval(self, message_id: int, interval_us: float) -> bool:
        """Send a message at an interval: -1 never, 0 as at the start; False for one that this vehicle has not."""
        kind = BY_ID.get(message_id)
        if kind is None:
            return False
        if kind is not dialect.Heartbeat:
            default_hz = self._defaults.get(kind, 0.0)
            self._put(kind, default_hz if interval_us == 0 else max(0.0, 1e6 / interval_us))
        return True

    def interval_us(self, message_id: int) -> int:
        """Return the interval of a message: -1 where it is not sent, 0 where there is no such message."""
        kind = BY_ID.get(message_id)
        if kind is None:
            return 0
        if kind is dialect.Heartbeat:
            return 1_000_000
        return self._interval_ns[kind] // 1000 if kind in self._interval_ns else -1

    def put_stream(self, stream: int, rate_hz: float) -> None:
        """Send a group of messages at a rate, of the old protocol."""
        for number, kinds in STREAMS.items():
            if stream in (ALL_STREAMS, number):
                for kind in kinds:
                    if kind in self._defaults:
                        self._put(kind, rate_hz)


def _waits_ns(kind: type[WireMessage], interval_ns: int, arrived: Mapping[str, Sequence[Any]]) -> int:
    """Return how long after it is due a message waits: one of a sample comes with it, or two intervals later."""
    sensor = SAMPLED.get(kind)
    if sensor is None:
        return 0
    return -interval_ns // 2 if arrived.get(sensor) else 2 * interval_ns
