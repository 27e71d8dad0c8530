"""Navdata as readings and pose of a drone, by the clock of this process. Pure.

Units and axes of navdata: millidegrees, millimetres, milli-g; x forward, y right, z down; psi clockwise from where the
aircraft was switched on.
"""

import math
from typing import Any

from zsim.math.frames import geodetic_to_enu, quaternion_from_rpy
from zsim.math.rotation import Vector
from zsim.schema.quantities import G_M_S2
from zsim_bridges.ardrone.wire.navdata import Navdata
from zsim_bridges.ardrone.wire.navdata_options import GPS_TAG, TAG_OF
from zsim_bridges.vehicle_links.aircraft_state import AircraftPose, Reading
from zsim_bridges.vehicle_links.clock_offset import ClockOffset
from zsim_bridges.vehicle_links.standard_atmosphere import FieldBarometer

DEMO, TIME, PHYS, ALTITUDE = (TAG_OF[name] for name in ("demo", "time", "phys_measures", "altitude"))
PRESSURE, MAGNETO = TAG_OF["pressure_raw"], TAG_OF["magneto"]
SECONDS_SHIFT, MICROSECONDS = 21, (1 << 21) - 1  # of option time (ARDroneLib, navdata_common.h)
UT_PER_LSB = 0.3  # uT, AK8975 data sheet
SONAR_MM = range(30, 6000)  # mm; outside there was no echo
GPS_1_S = 0.1  # 1/s, chosen: how fast the position follows the GPS, whose noise is 2 m at 5 Hz, for 0.3 m
YAW_1_S = 0.1  # 1/s, chosen: how fast the heading follows the magnetometer
STEP_S_MAX = 0.5  # s; over longer gaps nothing is integrated
SIGMA_UNKNOWN_M = 2.0  # m (paper, section VI)
GPS_FIX = 3  # three-dimensional


class NavdataReadings:
    """What one aircraft measures, and where it has flown since it was placed.

    Args:
        origin: of W: latitude, longitude [deg], height [m].
        position_m: where it stands at the start [W].
        field_ut: of the Earth [uT; W], by which its heading is known.
        yaw_rad: its heading at the start where that is stated; None: by the magnetometer.

    Attributes:
        pose: newest, None before the first packet with what it needs.
        clock: of the aircraft.
        readings: not yet taken.
    """

    def __init__(
        self,
        origin: tuple[float, float, float],
        position_m: Vector,
        field_ut: Vector,
        yaw_rad: float | None = None,
    ) -> None:
        self._origin = origin
        self._x, self._y, self._ground_m = position_m
        self._north_rad = math.atan2(field_ut[1], field_ut[0])
        self._stated_yaw_rad = yaw_rad
        self._yaw_offset_rad: float | None = None
        self.pose: AircraftPose | None = None
        self.clock = ClockOffset()
        self.readings: list[Reading] = []
        self._last: dict[str, tuple] = {}
        self._barometer = FieldBarometer()
        self._then_ns: int | None = None
        self._gps_ns: int | None = None
        self._fix: tuple = ()

    def receive(self, packet: Navdata, now_ns: int) -> None:
        """Take a packet that arrived now."""
        options = packet.options
        taken_ns = self._taken(options.get(TIME), now_ns)
        if demo := options.get(DEMO):
            self._on_demo(demo, options, taken_ns)
        if phys := options.get(PHYS):
            accel = tuple(G_M_S2 * part / 1e3 for part in _flipped(phys.phys_accs_mg))
            gyro = tuple(map(math.radians, _flipped(phys.phys_gyros_deg_s)))
            self._read_new("imu", taken_ns, accel, gyro)
        if mag := options.get(MAGNETO):
            self._read_new("mag", taken_ns, tuple(UT_PER_LSB * part for part in _flipped((mag.mx, mag.my, mag.mz))))
        if (pressure := options.get(PRESSURE)) and pressure.pressure_pa > 0:
            height_m = self.pose.position_m[2] if self.pose else self._ground_m
            altitude_m = self._barometer.altitude_m(pressure.pressure_pa, height_m)
            self._read_new("baro", taken_ns, float(pressure.pressure_pa), altitude_m)
        if altitude := options.get(ALTITUDE):
            raw_mm = altitude.altitude_raw_mm
            self._read_new("sonar", taken_ns, raw_mm / 1e3, raw_mm in SONAR_MM)
        if (gps := options.get(GPS_TAG)) and gps.data_available:
            self._on_gps(gps, taken_ns)

    def _taken(self, time: Any, now_ns: int) -> int:
        """Return when a packet was made, by the clock of this process."""
        if time is None:
            return now_ns
        stamp_ns = (time.time >> SECONDS_SHIFT) * 1_000_000_000 + (time.time & MICROSECONDS) * 1_000
        self.clock.add(stamp_ns, now_ns)
        return min(now_ns, self.clock.to_local(stamp_ns))

    def _on_demo(self, demo: Any, options: dict[int, Any], taken_ns: int) -> None:
        """Move on by the aircraft's own velocity, in its heading."""
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
        rate = self._last.get("imu", ((), (0.0, 0.0, 0.0)))[1]
        self.pose = AircraftPose(taken_ns, position, velocity, (w, x, y, z), rate)
        self._read_new("flow", taken_ns, own, 1.0)

    def _magnetic_yaw(self, roll: float, pitch: float, m: Vector) -> float:
        """Return the heading of which the field of the Earth, seen in B, tells."""
        y, z = m[1] * math.cos(roll) - m[2] * math.sin(roll), m[1] * math.sin(roll) + m[2] * math.cos(roll)
        x = m[0] * math.cos(pitch) + z * math.sin(pitch)
        return self._north_rad - math.atan2(y, x)

    def _align(self, yaw: float, magnetic: float, dt_s: float) -> None:
        """Let the heading follow the magnetometer slowly; a stated one stands."""
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
        x, y, z = geodetic_to_enu(place, self._origin).tolist()
        course = math.radians(gps.degree)
        velocity = (
            gps.speed_m_s * math.sin(course),
            gps.speed_m_s * math.cos(course),
            self.pose.velocity_m_s[2] if self.pose else 0.0,
        )
        sigma_m = gps.ehpe_m or SIGMA_UNKNOWN_M
        before_ns, fix = self._gps_ns, (place, gps.speed_m_s, gps.degree)
        if fix != self._fix and self._read_new(
            "gps", taken_ns, *place, (x, y, z), velocity, sigma_m, GPS_FIX, gps.satellites
        ):
            self._gps_ns, self._fix = taken_ns, fix
            if before_ns is not None:  # the first tells nothing of a place that is stated better
                share = min(1.0, GPS_1_S * (taken_ns - before_ns) * 1e-9)
                self._x, self._y = self._x + share * (x - self._x), self._y + share * (y - self._y)

    def _read_new(self, sensor: str, taken_ns: int, *values: Any) -> bool:
        """Add a reading if it differs from the last one: packets repeat what slow sensors measured before."""
        if self._last.get(sensor) == values or not _finite(values):
            return False
        self._last[sensor] = values
        self.readings.append(Reading(sensor, taken_ns, values))
        return True


def _flipped(v: Any) -> Vector:
    """Return a vector of the body's forward, right, down in B."""
    return float(v[0]), -float(v[1]), -float(v[2])


def _finite(values: tuple) -> bool:
    return all(_finite(value) if isinstance(value, tuple) else math.isfinite(value) for value in values)
