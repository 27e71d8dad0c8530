"""The telemetry of a MAVLink vehicle as poses and readings, by the clock of this process. Pure.

Units and axes: https://mavlink.io/en/messages/common.html.
"""

import math
from typing import Any

from zsim.math.frames import geodetic_to_enu, heading
from zsim.math.rotation import LEVEL, Vector
from zsim.schema.quantities import G_M_S2
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.conversions import UINT16_UNKNOWN, attitude_ned, frd, ned
from zsim_bridges.vehicle_links.aircraft_readings import STILL, AircraftPose, AircraftReadings, ClockOffset

ACCEL_GYRO, MAG, PRESSURE = 0x003F, 0x01C0, 0x0200  # HIGHRES_IMU_UPDATED_FLAGS
DOWNWARD = 25  # MAV_SENSOR_ROTATION_PITCH_270
FLOW_NS = 66_000_000  # 15 Hz, the rate of the AR.Drone's own: between two velocities while no flow is measured
FLOW_LOST_NS = 1_000_000_000  # chosen: then the estimated velocity replaces the flow
UT_PER_GAUSS, PA_PER_HPA = 100.0, 100.0
DOP_M = 2.0  # m for a dilution of 1, usual for a single frequency


class TelemetryReadings(AircraftReadings):
    """What one vehicle tells of itself.

    Args:
        origin: of W: latitude, longitude [deg], height [m].
        local_origin_m: origin of its local frame [m; W]; None for what its GPS_GLOBAL_ORIGIN says, or that of W.

    Attributes:
        battery_percent: of its charge.
        clock, unix_clock: of messages stamped with the time since its start, and with the time since 1970.
        has_origin: whether the origin of its local frame is known.
    """

    def __init__(self, origin: tuple[float, float, float], local_origin_m: Vector | None = None) -> None:
        super().__init__(origin)
        self._local_origin_m = local_origin_m or (0.0, 0.0, 0.0)
        self.has_origin = local_origin_m is not None
        self.battery_percent = 0.0
        self.unix_clock = ClockOffset()
        self._q_WB, self._w_WB_B = LEVEL, STILL
        self._flow_ns = self._measured_flow_ns = -FLOW_LOST_NS
        self._pressure_pa = 0.0
        self._handlers = {
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
        self.clock.add_round_trip(duration_ns, now_ns)
        self.unix_clock.add_round_trip(duration_ns, now_ns)

    def receive(self, message: Any, now_ns: int) -> bool:
        """Take a message that arrives now; return whether it is one that is read here, and finite."""
        handler = self._handlers.get(type(message))
        values = (getattr(message, name) for name in message.__struct_fields__)
        if handler is None or not all(math.isfinite(value) for value in values if isinstance(value, float)):
            return False
        handler(message, now_ns)
        return True

    def _since_boot(self, m: Any, now_ns: int) -> int:
        """Return when a message was made, by the clock of this process."""
        return self.clock.taken_ns(m.time_boot_ms * 1_000_000, now_ns)

    def _since_1970(self, m: Any, now_ns: int) -> int:
        return self.unix_clock.taken_ns(m.time_usec * 1_000, now_ns)

    # State

    def _on_attitude(self, m: Any, now_ns: int) -> None:
        q = attitude_ned((m.q1, m.q2, m.q3, m.q4))
        length = math.hypot(*q)
        if length > 0.5:  # else it is no attitude at all
            w, x, y, z = (part / length for part in q)
            self._q_WB, self._w_WB_B = (w, x, y, z), frd((m.rollspeed, m.pitchspeed, m.yawspeed))

    def _on_position(self, m: Any, now_ns: int) -> None:
        x, y, z = ned((m.x, m.y, m.z))
        ox, oy, oz = self._local_origin_m
        vx, vy, vz = velocity = ned((m.vx, m.vy, m.vz))
        taken_ns = self._since_boot(m, now_ns)
        self.pose = AircraftPose(taken_ns, (x + ox, y + oy, z + oz), velocity, self._q_WB, self._w_WB_B)
        if taken_ns - max(self._measured_flow_ns + FLOW_LOST_NS, self._flow_ns + FLOW_NS) >= 0:
            self._flow_ns = taken_ns
            yaw = float(heading(self._q_WB))
            forward, left = vx * math.cos(yaw) + vy * math.sin(yaw), vy * math.cos(yaw) - vx * math.sin(yaw)
            self.read("flow", taken_ns, (forward, left, vz), 1.0)

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
        taken_ns, updated = self._since_1970(m, now_ns), m.fields_updated
        if updated & ACCEL_GYRO == ACCEL_GYRO:
            self.read("imu", taken_ns, frd((m.xacc, m.yacc, m.zacc)), frd((m.xgyro, m.ygyro, m.zgyro)))
        if updated & MAG == MAG:
            self._read_field(taken_ns, UT_PER_GAUSS, m)
        if updated & PRESSURE:
            self._read_new_pressure(taken_ns, PA_PER_HPA * m.abs_pressure)

    def _on_scaled_imu(self, m: Any, now_ns: int) -> None:
        """Take what ArduPilot sends: mg, mrad/s, mgauss."""
        taken_ns, g = self._since_boot(m, now_ns), G_M_S2 / 1e3
        accel, gyro = (g * m.xacc, g * m.yacc, g * m.zacc), (m.xgyro / 1e3, m.ygyro / 1e3, m.zgyro / 1e3)
        self.read("imu", taken_ns, frd(accel), frd(gyro))
        if m.xmag or m.ymag or m.zmag:
            self._read_field(taken_ns, UT_PER_GAUSS / 1e3, m)

    def _read_field(self, taken_ns: int, unit_ut: float, m: Any) -> None:
        self.read("mag", taken_ns, frd((unit_ut * m.xmag, unit_ut * m.ymag, unit_ut * m.zmag)))

    def _on_pressure(self, m: Any, now_ns: int) -> None:
        self._read_new_pressure(self._since_boot(m, now_ns), PA_PER_HPA * m.press_abs)

    def _read_new_pressure(self, taken_ns: int, pressure_pa: float) -> None:
        if pressure_pa != self._pressure_pa:
            self._pressure_pa = pressure_pa
            self.read_pressure(taken_ns, pressure_pa, self.pose.position_m[2] if self.pose else 0.0)

    def _on_gps(self, m: Any, now_ns: int) -> None:
        place = m.lat / 1e7, m.lon / 1e7, (m.alt_ellipsoid or m.alt) / 1e3
        if (place, m.time_usec) == self._fix:
            return
        self._fix = place, m.time_usec
        sigma_m = m.h_acc / 1e3 or (DOP_M * m.eph / 100.0 if m.eph != UINT16_UNKNOWN else 0.0)
        course = math.radians(m.cog / 100.0)
        values = self.gps_values(place, m.vel / 100.0, course, sigma_m, min(m.fix_type, 3), m.satellites_visible)
        self.read("gps", self._since_1970(m, now_ns), *values)

    def _on_flow(self, m: Any, now_ns: int) -> None:
        taken_ns = self._measured_flow_ns = self._since_1970(m, now_ns)
        self.read("flow", taken_ns, (m.flow_comp_m_x, -m.flow_comp_m_y, self.climb_m_s), m.quality / 255.0)

    def _on_distance(self, m: Any, now_ns: int) -> None:
        if m.orientation == DOWNWARD:
            valid = m.min_distance <= m.current_distance <= m.max_distance
            self.read("sonar", self._since_boot(m, now_ns), m.current_distance / 100.0, valid)
