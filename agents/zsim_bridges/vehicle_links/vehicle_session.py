"""What all wires have in common for a driver: what is demanded of an aircraft, what is known of it, and the session."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable
from typing import Literal, NamedTuple

from zsim.contract.flight_messages import DroneState
from zsim.math.rotation import Vector
from zsim_bridges.vehicle_links.aircraft_readings import STILL, AircraftPose, AircraftReadings, Reading

AIRBORNE: tuple[DroneState, ...] = ("hovering", "flying")
STANDING: tuple[DroneState, ...] = ("landed", "emergency")  # states in which no rotor turns
LOSS_WINDOW = 1000  # numbers that count for the loss, a few seconds of telemetry
Action = Literal["none", "take_off", "hold", "fly", "land", "kill", "reset"]


class Demand(NamedTuple):
    """What an aircraft is to do now.

    Attributes:
        action: `none`: send nothing that starts or steers a motor.
        velocity_m_s: to be flown [W].
        yaw_rate_rad_s: to be turned at, counter-clockwise.
    """

    action: Action
    velocity_m_s: Vector = STILL
    yaw_rate_rad_s: float = 0.0


class AircraftState(NamedTuple):
    """What is known of an aircraft.

    Attributes:
        state: as the contract names it.
        battery_percent: of its charge.
        pose: newest; None before the first.
        received_ns: when something of it arrived last, by the clock of this process; None for never.
    """

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
        round_trip_ms: of a question to it and its answer.
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
        readings: what its telemetry is turned into.
        modulus: at which the numbers of its telemetry begin again.

    Attributes:
        texts: lines for people, taken by the process.
    """

    def __init__(self, channels: tuple[UdpChannel, ...], readings: AircraftReadings, modulus: int) -> None:
        self.channels = channels
        self.texts: list[str] = []
        self._readings = readings
        self._loss = StreamLoss(modulus)
        self._received_ns: int | None = None
        self._refused = 0

    @property
    @abstractmethod
    def state(self) -> AircraftState:
        """What is known of the aircraft."""

    @abstractmethod
    def receive(self, channel: int, datagram: bytes, now_ns: int) -> None:
        """Take a datagram from one of its ports."""

    @abstractmethod
    def advance(self, now_ns: int, demand: Demand) -> Iterable[tuple[int, bytes]]:
        """Return the datagrams that are due, with the channel of each; called at least every 20 ms."""

    def take_readings(self) -> list[Reading]:
        """Return what has been measured since the last call."""
        return self._readings.take()

    def figures(self, now_ns: int) -> LinkFigures:
        """Return the quality of the link."""
        clock = self._readings.clock
        return LinkFigures(self._loss.percent, clock.round_trip_ms, clock.ahead_ms, self._refused)


class StreamLoss:
    """Counts gaps in numbers that go up by one, modulo some power of two.

    Args:
        modulus: at which they begin again.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._last: int | None = None
        self._steps: deque[int] = deque(maxlen=LOSS_WINDOW)

    def add(self, number: int) -> bool:
        """Take the number of a message; return whether it is newer than those before."""
        step = 1 if self._last is None else (number - self._last) % self._modulus
        if step == 0 or step > self._modulus // 2:
            return False  # repeated, or overtaken
        self._last = number
        self._steps.append(step)
        return True

    def restart(self) -> None:
        """Accept any number next: the sender has begun to count again."""
        self._last = None

    @property
    def percent(self) -> float | None:
        """The share of what was sent that has not arrived; None before the first message."""
        sent = sum(self._steps)
        return 100.0 * (1.0 - len(self._steps) / sent) if sent else None
