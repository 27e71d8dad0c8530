"""What an aircraft tells of itself as poses and readings, stamped by the clock of this process. Pure."""

import math
from collections import deque
from typing import Any, NamedTuple

from zsim.math.frames import geodetic_to_enu
from zsim.math.rotation import LEVEL, Quaternion, Vector

WINDOW_NS = 5_000_000_000  # chosen: long against queues, short against the drift of two clocks (50 ppm: 0.25 ms)
SIGMA_UNKNOWN_M = 2.0  # m, of a GPS receiver that does not tell (paper, section VI)
P0_PA = 101_325.0  # Pa, at sea level (ISO 2533)
SCALE_M = 44_330.77  # m, T0 / lapse rate = 288.15 K / 6.5 K/km (ISO 2533)
EXPONENT = 0.190263  # R lapse / g (ISO 2533)
PRESSURES = 250  # chosen: 10 s at 25 Hz average 0.1 m of noise to less than 1 cm
STILL: Vector = (0.0, 0.0, 0.0)


class AircraftPose(NamedTuple):
    """Where an aircraft is, and how it moves.

    Attributes:
        taken_ns: when, by the clock of this process.
        position_m, velocity_m_s: of its centre of mass [W].
        q_WB: its attitude.
        w_WB_B: its rate [rad/s; B].
    """

    taken_ns: int
    position_m: Vector
    velocity_m_s: Vector = STILL
    q_WB: Quaternion = LEVEL
    w_WB_B: Vector = STILL


class Reading(NamedTuple):
    """A measurement of one of its sensors.

    Attributes:
        sensor: name of the sensor, the last part of its key.
        taken_ns: when, by the clock of this process.
        values: the fields of its message after `t_sample_ns`.
    """

    sensor: str
    taken_ns: int
    values: tuple


class AircraftReadings:
    """What one aircraft measures.

    Args:
        origin: of W: latitude, longitude [deg], height [m].

    Attributes:
        pose: newest; None before the first.
        clock: of the aircraft.
        readings: not yet taken.
    """

    def __init__(self, origin: tuple[float, float, float]) -> None:
        self._origin = origin
        self.pose: AircraftPose | None = None
        self.clock = ClockOffset()
        self.readings: list[Reading] = []
        self._last: dict[str, tuple] = {}
        self._fix: tuple = ()
        self._pressure_offset_m = 0.0
        self._pressures = 0

    def take(self) -> list[Reading]:
        """Return what has been measured since the last call."""
        taken, self.readings = self.readings, []
        return taken

    def read(self, sensor: str, taken_ns: int, *values: Any) -> bool:
        """Add a reading if it differs from the last one: aircraft repeat what slow sensors measured before."""
        if self._last.get(sensor) == values or not _is_finite(values):
            return False
        self._last[sensor] = values
        self.readings.append(Reading(sensor, taken_ns, values))
        return True

    def read_pressure(self, taken_ns: int, pressure_pa: float, height_m: float) -> None:
        """Add a reading of the barometer, whose height is over the origin of W.

        Args:
            height_m: of the aircraft by its own estimate; the first readings are compared with it, because the standard
                atmosphere does not know the weather.
        """
        altitude_m = pressure_altitude_m(pressure_pa)
        if self._pressures < PRESSURES:
            self._pressures += 1
            self._pressure_offset_m += (altitude_m - height_m - self._pressure_offset_m) / self._pressures
        self.read("baro", taken_ns, pressure_pa, altitude_m - self._pressure_offset_m)

    def gps_values(
        self, place: Vector, speed_m_s: float, course_rad: float, sigma_m: float, fix: int, satellites: int
    ) -> tuple:
        """Return the values of a fix, with its position in W; the wires have no climb, so it is that of the pose.

        Args:
            place: latitude, longitude [deg], height [m].
            course_rad: clockwise from north.
            sigma_m: 0 if it is not known.
        """
        x, y, z = geodetic_to_enu(place, self._origin).tolist()
        velocity = speed_m_s * math.sin(course_rad), speed_m_s * math.cos(course_rad), self.climb_m_s
        return *place, (x, y, z), velocity, sigma_m or SIGMA_UNKNOWN_M, fix, satellites

    @property
    def climb_m_s(self) -> float:
        return self.pose.velocity_m_s[2] if self.pose else 0.0


def _is_finite(values: tuple) -> bool:
    return all(_is_finite(value) if isinstance(value, tuple) else math.isfinite(value) for value in values)


def pressure_altitude_m(pressure_pa: float) -> float:
    """Return the height above the sea at which the standard atmosphere has a pressure, below 11 km."""
    return SCALE_M * (1.0 - (max(pressure_pa, 0.0) / P0_PA) ** EXPONENT)


class ClockOffset:
    """The offset of another clock from this one, by the messages that arrive.

    The least difference between arrival and stamp within a window counts, since the delay by a link or a busy process
    is never negative. The delay of the fastest way is half of the shortest round trip, if round trips are measured.

    Args:
        window_ns: how long a difference counts.
    """

    def __init__(self, window_ns: int = WINDOW_NS) -> None:
        self._window_ns = window_ns
        self._least: deque[tuple[int, int]] = deque()  # arrivals and differences; both increase
        self._round_trips: deque[tuple[int, int]] = deque()

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """Take a message that the other clock stamped and that arrived by this one."""
        _keep_least(self._least, arrival_ns, arrival_ns - stamp_ns, self._window_ns)

    def add_round_trip(self, duration_ns: int, arrival_ns: int) -> None:
        """Take how long a request and its answer took together."""
        _keep_least(self._round_trips, arrival_ns, duration_ns, self._window_ns)

    @property
    def offset_ns(self) -> int:
        """This clock's time less the other's; 0 while it is not known."""
        round_trip_ns = self._round_trips[0][1] if self._round_trips else 0
        return self._least[0][1] - round_trip_ns // 2 if self._least else 0

    @property
    def ahead_ms(self) -> float | None:
        """The other clock's time less this one's; None while it is not known."""
        return -self.offset_ns / 1e6 if self._least else None

    @property
    def round_trip_ms(self) -> float | None:
        """The shortest round trip of the window; None if none was measured."""
        return self._round_trips[0][1] / 1e6 if self._round_trips else None

    def taken_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """Take a stamped message that arrives now; return when it was made, by this clock."""
        self.add(stamp_ns, arrival_ns)
        return min(arrival_ns, self.to_local(stamp_ns))

    def to_local(self, stamp_ns: int) -> int:
        """Return this clock's time at a time of the other."""
        return stamp_ns + self.offset_ns

    def to_remote(self, local_ns: int) -> int:
        """Return the other clock's time at a time of this one."""
        return local_ns - self.offset_ns


def _keep_least(kept: deque[tuple[int, int]], now_ns: int, value: int, window_ns: int) -> None:
    """Add a value to a queue whose first entry is the least within a window."""
    while kept and kept[-1][1] >= value:
        kept.pop()
    kept.append((now_ns, value))
    while now_ns - kept[0][0] > window_ns:
        kept.popleft()
