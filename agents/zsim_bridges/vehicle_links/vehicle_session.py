"""The parts of a driver common to all wires: demands on an aircraft, its pose, readings and clock, the session. Pure.

Poses and readings are stamped by the clock of this process.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

from zsim.contract.flight_messages import DroneState
from zsim.math.frames import geodetic_to_enu
from zsim.math.rotation import LEVEL, Quaternion, Vector

WINDOW_NS = 5_000_000_000  # chosen: long against queues, short against the drift of two clocks (50 ppm: 0.25 ms)
SIGMA_UNKNOWN_M = 2.0  # m, of a GPS receiver that does not report it (paper, section VI)
P0_PA = 101_325.0  # Pa, at sea level (ISO 2533)
SCALE_M = 44_330.77  # m, T0 / lapse rate = 288.15 K / 6.5 K/km (ISO 2533)
EXPONENT = 0.190263  # R lapse / g (ISO 2533)
PRESSURES = 250  # chosen: 10 s at 25 Hz average 0.1 m of noise to less than 1 cm
STILL: Vector = (0.0, 0.0, 0.0)


class AircraftPose(NamedTuple):
    """Position and velocity [W] of an aircraft's centre of mass, its attitude and rate, at `taken_ns` by our clock."""

    taken_ns: int
    position_m: Vector
    velocity_m_s: Vector = STILL
    q_WB: Quaternion = LEVEL
    w_WB_B: Vector = STILL


class Reading(NamedTuple):
    """A measurement, at `taken_ns` by this process's clock; `values` follow `t_sample_ns` in its message."""

    sensor: str
    taken_ns: int
    values: tuple


class AircraftReadings:
    """The measurements of one aircraft; `origin` of W is latitude, longitude [deg], height [m].

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
        # the height above the sea at which the standard atmosphere has this pressure, below 11 km
        altitude_m = SCALE_M * (1.0 - (max(pressure_pa, 0.0) / P0_PA) ** EXPONENT)
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


class ClockOffset:
    """The offset of another clock from this one, by the messages that arrive.

    The least difference between arrival and stamp within a window counts, since the delay by a link or a busy process
    is never negative. The delay of the fastest way is half of the shortest round trip, if round trips are measured.
    """

    def __init__(self) -> None:
        self._least: deque[tuple[int, int]] = deque()  # arrivals and differences; both increase
        self._round_trips: deque[tuple[int, int]] = deque()

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """Record a message stamped by the other clock, and its arrival by this one."""
        _keep_least(self._least, arrival_ns, arrival_ns - stamp_ns)

    def add_round_trip(self, duration_ns: int, arrival_ns: int) -> None:
        """Record the round trip of a request and its answer."""
        _keep_least(self._round_trips, arrival_ns, duration_ns)

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
        """Record a stamped message that arrives now; return when it was created, by this clock."""
        self.add(stamp_ns, arrival_ns)
        return min(arrival_ns, self.to_local(stamp_ns))

    def to_local(self, stamp_ns: int) -> int:
        """Return this clock's time at a time of the other."""
        return stamp_ns + self.offset_ns

    def to_remote(self, local_ns: int) -> int:
        """Return the other clock's time at a time of this one."""
        return local_ns - self.offset_ns


def _keep_least(kept: deque[tuple[int, int]], now_ns: int, value: int) -> None:
    """Add a value to a queue whose first entry is the least within a window."""
    while kept and kept[-1][1] >= value:
        kept.pop()
    kept.append((now_ns, value))
    while now_ns - kept[0][0] > WINDOW_NS:
        kept.popleft()


AIRBORNE: tuple[DroneState, ...] = ("hovering", "flying")
STANDING: tuple[DroneState, ...] = ("landed", "emergency")  # states in which no rotor turns
LOSS_WINDOW = 1000  # numbers that count for the loss, a few seconds of telemetry
Action = Literal["none", "take_off", "hold", "fly", "land", "kill", "reset"]


class Demand(NamedTuple):
    """The present demand on an aircraft: velocities in W, turns counter-clockwise.

    Attributes:
        action: `none`: send nothing that starts or steers a motor.
    """

    action: Action
    velocity_m_s: Vector = STILL
    yaw_rate_rad_s: float = 0.0


class AircraftState(NamedTuple):
    """The state of an aircraft; `received_ns`: time of the last reception from it; None for never."""

    state: DroneState = "landed"
    battery_percent: float = 0.0
    pose: AircraftPose | None = None
    received_ns: int | None = None


class UdpChannel(NamedTuple):
    """A UDP port of an aircraft, and the port here; 0 for any."""

    host: str
    port: int
    local_port: int = 0


class LinkFigures(NamedTuple):
    """The quality of the link; None for what is not known.

    Attributes:
        loss_percent: of what the aircraft has sent within some seconds.
        clock_offset_ms: its clock less that of this process.
        refused: datagrams, or messages in them, that were not accepted.
    """

    loss_percent: float | None = None
    round_trip_ms: float | None = None
    clock_offset_ms: float | None = None
    refused: int = 0


class VehicleSession(ABC):
    """The state machine of one aircraft at the other end of a wire. Pure: time comes from the process.

    Args:
        channels: its ports, in the order in which they are numbered.
        readings: converted from its telemetry.
        modulus: at which the sequence numbers of its telemetry wrap around.

    Attributes:
        texts: lines for the terminal, taken by the process.
    """

    def __init__(self, channels: tuple[UdpChannel, ...], readings: AircraftReadings, modulus: int) -> None:
        self.channels = channels
        self.texts: list[str] = []
        self.readings = readings
        self._loss = StreamLoss(modulus)
        self._received_ns: int | None = None
        self._refused = 0

    @property
    @abstractmethod
    def state(self) -> AircraftState:
        """The state of the aircraft."""

    @abstractmethod
    def receive(self, channel: int, datagram: bytes, now_ns: int) -> None:
        """Process a datagram from one of its ports."""

    @abstractmethod
    def advance(self, now_ns: int, demand: Demand) -> Iterable[tuple[int, bytes]]:
        """Return the datagrams that are due, with the channel of each; called at least every 20 ms."""

    def figures(self, now_ns: int) -> LinkFigures:
        clock = self.readings.clock
        return LinkFigures(self._loss.percent, clock.round_trip_ms, clock.ahead_ms, self._refused)


class StreamLoss:
    """Counts gaps in numbers that go up by one, modulo some power of two."""

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._last: int | None = None
        self._steps: deque[int] = deque(maxlen=LOSS_WINDOW)

    def add(self, number: int) -> bool:
        """Process the number of a message; return whether it is newer than the previous ones."""
        step = 1 if self._last is None else (number - self._last) % self._modulus
        if step == 0 or step > self._modulus // 2:
            return False  # repeated, or overtaken
        self._last = number
        self._steps.append(step)
        return True

    def restart(self) -> None:
        """Accept any number next: the sender has restarted its count."""
        self._last = None

    @property
    def percent(self) -> float | None:
        """The share of what was sent that has not arrived; None before the first message."""
        sent = sum(self._steps)
        return 100.0 * (1.0 - len(self._steps) / sent) if sent else None
