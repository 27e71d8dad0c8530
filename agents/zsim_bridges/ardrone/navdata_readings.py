"""Navdata as readings and pose of a drone, by the clock of this process. Pure.

Units and axes of navdata: millidegrees, millimetres, milli-g; x forward, y right, z down; psi clockwise from where the
aircraft was switched on.
"""

import math
from typing import Any

from zsim.math.frames import quaternion_from_rpy
from zsim.math.rotation import Vector
from zsim.schema.quantities import G_M_S2
from zsim_bridges.ardrone.navdata import GPS_TAG, MICROSECONDS, SECONDS_SHIFT, TAG_OF, Navdata
from zsim_bridges.vehicle_links.aircraft_readings import STILL, AircraftPose, AircraftReadings

DEMO, TIME, PHYS, ALTITUDE = (TAG_OF[name] for name in ("demo", "time", "phys_measures", "altitude"))
PRESSURE, MAGNETO = TAG_OF["pressure_raw"], TAG_OF["magneto"]
UT_PER_LSB = 0.3  # uT, AK8975 data sheet
SONAR_MM = range(30, 6000)  # mm; outside there was no echo
GPS_1_S = 0.1  # 1/s, chosen: how fast the position follows the GPS, whose noise is 2 m at 5 Hz, for 0.3 m
YAW_1_S = 0.1  # 1/s, chosen: how fast the heading follows the magnetometer
STEP_S_MAX = 0.5  # s; over longer gaps nothing is integrated
GPS_FIX = 3  # three-dimensional


class NavdataReadings(AircraftReadings):
    """What one aircraft measures, and where it has flown since the start.

    Args:
        origin: of W: latitude, longitude [deg], height [m].
        position_m: where it stands at the start [W].
        field_ut: of the Earth [uT; W], by which its heading is known.
        yaw_rad: its heading at the start, if that is stated; None for the magnetometer.
    """

    def __init__(
        self,
        origin: tuple[float, float, float],
        position_m: Vector,
        field_ut: Vector,
        yaw_rad: float | None = None,
    ) -> None:
        super().__init__(origin)
        self._x, self._y, self._ground_m = position_m
        self._north_rad = math.atan2(field_ut[1], field_ut[0])
        self._stated_yaw_rad = yaw_rad
        self._yaw_offset_rad: float | None = None
        self._then_ns: int | None = None
        self._gps_ns: int | None = None

    def receive(self, packet: Navdata, now_ns: int) -> None:
        """Take a packet that arrives now."""
        options, taken_ns = packet.options, now_ns
        if time := options.get(TIME):
            stamp_ns = (time.time >> SECONDS_SHIFT) * 1_000_000_000 + (time.time & MICROSECONDS) * 1_000
            taken_ns = self.clock.taken_ns(stamp_ns, now_ns)
        if demo := options.get(DEMO):
            self._on_demo(demo, options, taken_ns)
        if phys := options.get(PHYS):
            accel = tuple(G_M_S2 * part / 1e3 for part in _flipped(phys.phys_accs_mg))
            gyro = tuple(map(math.radians, _flipped(phys.phys_gyros_deg_s)))
            self.read("imu", taken_ns, accel, gyro)
        if mag := options.get(MAGNETO):
            self.read("mag", taken_ns, tuple(UT_PER_LSB * part for part in _flipped((mag.mx, mag.my, mag.mz))))
        if (pressure := options.get(PRESSURE)) and pressure.pressure_pa > 0:
            height_m = self.pose.position_m[2] if self.pose else self._ground_m
            self.read_pressure(taken_ns, float(pressure.pressure_pa), height_m)
        if altitude := options.get(ALTITUDE):
            raw_mm = altitude.altitude_raw_mm
            self.read("sonar", taken_ns, raw_mm / 1e3, raw_mm in SONAR_MM)
        if (gps := options.get(GPS_TAG)) and gps.data_available:
            self._on_gps(gps, taken_ns)

    def _on_demo(self, demo: Any, options: dict[int, Any], taken_ns: int) -> None:
        """Integrate the aircraft's own velocity, in its heading."""
        roll, pitch = math.radians(demo.phi_mdeg / 1e3), -math.radians(demo.theta_mdeg / 1e3)
        yaw = -math.radians(demo.psi_mdeg / 1e3)
        dt_s = 0.0 if self._then_ns is None else (taken_ns - self._then_ns) * 1e-9
        self._then_ns = taken_ns
        if mag := options.get(MAGNETO):
            self._align(yaw, self._magnetic_yaw(roll, pitch, _flipped((mag.mx, mag.my, mag.mz))), dt_s)
        yaw += self._yaw_offset_rad or 0.0
        vx, vy, vz = own = _flipped((demo.vx_mm_s / 1e3, demo.vy_mm_s / 1e3, demo.vz_mm_s / 1e3))
        velocity = vx * math.cos(yaw) - vy * math.sin(yaw), vx * math.sin(yaw) + vy * math.cos(yaw), vz
        if 0.0 < dt_s < STEP_S_MAX:
            self._x, self._y = self._x + dt_s * velocity[0], self._y + dt_s * velocity[1]
        w, x, y, z = quaternion_from_rpy((roll, pitch, yaw)).tolist()
        position = self._x, self._y, self._ground_m + max(0, demo.altitude_mm) / 1e3
        rate = self._last["imu"][1] if "imu" in self._last else STILL
        self.pose = AircraftPose(taken_ns, position, velocity, (w, x, y, z), rate)
        self.read("flow", taken_ns, own, 1.0)

    def _magnetic_yaw(self, roll: float, pitch: float, m: Vector) -> float:
        """Return the heading by the field of the Earth seen in B."""
        y, z = m[1] * math.cos(roll) - m[2] * math.sin(roll), m[1] * math.sin(roll) + m[2] * math.cos(roll)
        x = m[0] * math.cos(pitch) + z * math.sin(pitch)
        return self._north_rad - math.atan2(y, x)

    def _align(self, yaw: float, magnetic: float, dt_s: float) -> None:
        """Let the heading follow the magnetometer slowly; a stated one is kept."""
        if self._stated_yaw_rad is not None:
            if self._yaw_offset_rad is None:
                self._yaw_offset_rad = self._stated_yaw_rad - yaw
            return
        if self._yaw_offset_rad is None:
            self._yaw_offset_rad = magnetic - yaw
        error = math.remainder(magnetic - yaw - self._yaw_offset_rad, 2 * math.pi)
        self._yaw_offset_rad += min(1.0, YAW_1_S * max(0.0, dt_s)) * error

    def _on_gps(self, gps: Any, taken_ns: int) -> None:
        """Take a fix once, and let the position follow it."""
        place = gps.latitude_deg, gps.longitude_deg, gps.elevation_m
        values = self.gps_values(place, gps.speed_m_s, math.radians(gps.degree), gps.ehpe_m, GPS_FIX, gps.satellites)
        before_ns, fix = self._gps_ns, (place, gps.speed_m_s, gps.degree)
        if fix != self._fix and self.read("gps", taken_ns, *values):
            self._gps_ns, self._fix = taken_ns, fix
            if before_ns is not None:  # the first one is worse than the place that is stated
                x, y, _ = values[3]
                share = min(1.0, GPS_1_S * (taken_ns - before_ns) * 1e-9)
                self._x, self._y = self._x + share * (x - self._x), self._y + share * (y - self._y)


def _flipped(v: Any) -> Vector:
    """Return a vector in forward, right, down of the body in B."""
    return float(v[0]), -float(v[1]), -float(v[2])
