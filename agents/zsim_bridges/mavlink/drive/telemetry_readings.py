"""The telemetry of a MAVLink vehicle as poses and readings, by the clock of this process. Pure.

Units and axes: https://mavlink.io/en/messages/common.html.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

from zsim.math.frames import geodetic_to_enu, heading
from zsim.math.rotation import LEVEL, Vector
from zsim.schema.quantities import G_M_S2
from zsim_bridges.mavlink.autopilot import ned_axes
from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.vehicle_links.aircraft_state import STILL, AircraftPose, Reading
from zsim_bridges.vehicle_links.clock_offset import ClockOffset
from zsim_bridges.vehicle_links.standard_atmosphere import FieldBarometer

ACCEL_GYRO, MAG, PRESSURE = 0x003F, 0x01C0, 0x0200  # HIGHRES_IMU_UPDATED_FLAGS
DOWNWARD = 25  # MAV_SENSOR_ROTATION_PITCH_270
FLOW_NS = 66_000_000  # 15 Hz, the rate of the AR.Drone's own: between two velocities where no flow is measured
FLOW_LOST_NS = 1_000_000_000  # chosen: then the estimated velocity stands for the flow
UT_PER_GAUSS, PA_PER_HPA = 100.0, 100.0
SIGMA_UNKNOWN_M = 2.0  # m, of a receiver that does not tell (paper, section VI)
DOP_M = 2.0  # m for a dilution of 1, usual for a single frequency
LOCAL_UNKNOWN: Vector = (0.0, 0.0, 0.0)


class TelemetryReadings:
    """What a vehicle tells of itself.

    Args:
        origin: of W: latitude, longitude [deg], height [m].
        local_origin_m: where the vehicle's local frame begins [m; W]; None: as its GPS_GLOBAL_ORIGIN says, or there.

    Attributes:
        pose: newest, None before the first position.
        battery_percent: of its charge.
        boot_clock, unix_clock: of its messages.
        readings: not yet taken.
        has_origin: whether it is known where its local frame begins.
    """

    def __init__(self, origin: tuple[float, float, float], local_origin_m: Vector | None = None) -> None:
        self._origin = origin
        self._local_origin_m = local_origin_m or LOCAL_UNKNOWN
        self.has_origin = local_origin_m is not None
        self.pose: AircraftPose | None = None
        self.battery_percent = 0.0
        self.boot_clock, self.unix_clock = ClockOffset(), ClockOffset()
        self.readings: list[Reading] = []
        self._q_WB, self._w_WB_B = LEVEL, STILL
        self._flow_ns = self._measured_flow_ns = -FLOW_LOST_NS
        self._last: dict[str, tuple] = {}
        self._pressure_pa = 0.0
        self._fix: tuple = ()
        self._barometer = FieldBarometer()
        self._handlers: dict[type, Callable[[Any, int], None]] = {
            dialect.AttitudeQuaternion: self._on_attitude,
            dialect.LocalPositionNed: self._on_position,
            dialect.HighresImu: self._on_imu,
            dialect.ScaledImu: self._on_scaled_imu,
            dialect.ScaledPressure: self._on_pressure,
            dialect.GpsRawInt: self._on_gps,
            dialect.GpsGlobalOrigin: self._on_origin,
            dialect.OpticalFlow: self._on_flow,
            dialect.DistanceSensor: self._on_distance,
            dialect.SysStatus: self._on_system,
        }

    def add_round_trip(self, duration_ns: int, now_ns: int) -> None:
        """Take how long a question for the vehicle's time took."""
        self.boot_clock.add_round_trip(duration_ns, now_ns)
        self.unix_clock.add_round_trip(duration_ns, now_ns)

    def receive(self, message: Any, now_ns: int) -> bool:
        """Take a message that arrived now; return whether it is one that is read here, and finite."""
        handler = self._handlers.get(type(message))
        if handler is None or not all(map(math.isfinite, _floats(message))):
            return False
        handler(message, now_ns)
        return True

    # State

    def _on_attitude(self, m: Any, now_ns: int) -> None:
        q = ned_axes.attitude_ned((m.q1, m.q2, m.q3, m.q4))
        length = math.hypot(*q)
        if length > 0.5:  # else it is no attitude at all
            w, x, y, z = (part / length for part in q)
            self._q_WB, self._w_WB_B = (w, x, y, z), ned_axes.frd((m.rollspeed, m.pitchspeed, m.yawspeed))

    def _on_position(self, m: Any, now_ns: int) -> None:
        x, y, z = ned_axes.ned((m.x, m.y, m.z))
        ox, oy, oz = self._local_origin_m
        velocity = ned_axes.ned((m.vx, m.vy, m.vz))
        taken_ns = self._boot(m, now_ns)
        self.pose = AircraftPose(taken_ns, (x + ox, y + oy, z + oz), velocity, self._q_WB, self._w_WB_B)
        if taken_ns - max(self._measured_flow_ns + FLOW_LOST_NS, self._flow_ns + FLOW_NS) >= 0:
            self._flow_ns = taken_ns
            self._read("flow", taken_ns, self._in_heading(velocity), 1.0)

    def _on_origin(self, m: Any, now_ns: int) -> None:
        if not self.has_origin:
            x, y, z = geodetic_to_enu((m.latitude / 1e7, m.longitude / 1e7, m.altitude / 1e3), self._origin).tolist()
            self._local_origin_m = (x, y, z)
            self.has_origin = True

    def _on_system(self, m: Any, now_ns: int) -> None:
        if m.battery_remaining >= 0:  # -1: it does not know
            self.battery_percent = float(min(100, m.battery_remaining))

    # Sensors

    def _on_imu(self, m: Any, now_ns: int) -> None:
        taken_ns, updated = self._unix(m, now_ns), m.fields_updated
        if updated & ACCEL_GYRO == ACCEL_GYRO:
            self._read(
                "imu", taken_ns, ned_axes.frd((m.xacc, m.yacc, m.zacc)), ned_axes.frd((m.xgyro, m.ygyro, m.zgyro))
            )
        if updated & MAG == MAG:
            self._read("mag", taken_ns, ned_axes.frd(_scaled(UT_PER_GAUSS, m)))
        if updated & PRESSURE:
            self._on_static_pressure(taken_ns, PA_PER_HPA * m.abs_pressure)

    def _on_scaled_imu(self, m: Any, now_ns: int) -> None:
        """Take what ArduPilot sends: mg, mrad/s, mgauss."""
        taken_ns, g = self._boot(m, now_ns), G_M_S2 / 1e3
        accel, gyro = (g * m.xacc, g * m.yacc, g * m.zacc), (m.xgyro / 1e3, m.ygyro / 1e3, m.zgyro / 1e3)
        self._read("imu", taken_ns, ned_axes.frd(accel), ned_axes.frd(gyro))
        if m.xmag or m.ymag or m.zmag:
            self._read("mag", taken_ns, ned_axes.frd(_scaled(UT_PER_GAUSS / 1e3, m)))

    def _on_pressure(self, m: Any, now_ns: int) -> None:
        self._on_static_pressure(self._boot(m, now_ns), PA_PER_HPA * m.press_abs)

    def _on_static_pressure(self, taken_ns: int, pressure_pa: float) -> None:
        if pressure_pa == self._pressure_pa:
            return
        self._pressure_pa = pressure_pa
        height_m = self.pose.position_m[2] if self.pose else 0.0
        self._read("baro", taken_ns, pressure_pa, self._barometer.altitude_m(pressure_pa, height_m))

    def _on_gps(self, m: Any, now_ns: int) -> None:
        """Take a fix; its vertical velocity, which it does not have, is that of the vehicle's estimate."""
        height_m = (m.alt_ellipsoid or m.alt) / 1e3
        place = m.lat / 1e7, m.lon / 1e7, height_m
        speed, course = m.vel / 100.0, math.radians(m.cog / 100.0)
        climb = self.pose.velocity_m_s[2] if self.pose else 0.0
        sigma_m = m.h_acc / 1e3 or (DOP_M * m.eph / 100.0 if m.eph != 0xFFFF else 0.0) or SIGMA_UNKNOWN_M
        if (place, m.time_usec) == self._fix:
            return
        self._fix = place, m.time_usec
        x, y, z = geodetic_to_enu(place, self._origin).tolist()
        velocity = speed * math.sin(course), speed * math.cos(course), climb
        fix, satellites = min(m.fix_type, 3), m.satellites_visible
        self._read("gps", self._unix(m, now_ns), *place, (x, y, z), velocity, sigma_m, fix, satellites)

    def _on_flow(self, m: Any, now_ns: int) -> None:
        taken_ns = self._unix(m, now_ns)
        self._measured_flow_ns = taken_ns
        climb = self.pose.velocity_m_s[2] if self.pose else 0.0
        self._read("flow", taken_ns, (m.flow_comp_m_x, -m.flow_comp_m_y, climb), m.quality / 255.0)

    def _on_distance(self, m: Any, now_ns: int) -> None:
        if m.orientation == DOWNWARD:
            valid = m.min_distance <= m.current_distance <= m.max_distance
            self._read("sonar", self._boot(m, now_ns), m.current_distance / 100.0, valid)

    def _in_heading(self, v: Vector) -> Vector:
        """Return a velocity of W in the heading frame."""
        yaw = float(heading(self._q_WB))
        return v[0] * math.cos(yaw) + v[1] * math.sin(yaw), v[1] * math.cos(yaw) - v[0] * math.sin(yaw), v[2]

    def _read(self, sensor: str, taken_ns: int, *values: Any) -> None:
        """Add a reading if it differs from the last one: vehicles repeat what slow sensors measured before."""
        if self._last.get(sensor) != values:
            self._last[sensor] = values
            self.readings.append(Reading(sensor, taken_ns, values))

    def _boot(self, m: Any, now_ns: int) -> int:
        return _taken(self.boot_clock, m.time_boot_ms * 1_000_000, now_ns)

    def _unix(self, m: Any, now_ns: int) -> int:
        return _taken(self.unix_clock, m.time_usec * 1_000, now_ns)


def _taken(clock: ClockOffset, stamp_ns: int, now_ns: int) -> int:
    """Return when a message that arrives now was made, by the clock of this process."""
    clock.add(stamp_ns, now_ns)
    return min(now_ns, clock.to_local(stamp_ns))


def _scaled(unit: float, m: Any) -> Vector:
    """Return the magnetic field of a message."""
    return unit * m.xmag, unit * m.ymag, unit * m.zmag


def _floats(message: Any) -> Iterable[float]:
    """Yield the numbers of a message that may be no number."""
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if isinstance(value, float):
            yield value
