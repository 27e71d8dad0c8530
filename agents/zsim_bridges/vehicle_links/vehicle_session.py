"""What the two wires have in common for a driver: the session with an aircraft, and where its datagrams go."""

from collections.abc import Iterable
from typing import NamedTuple, Protocol

from zsim_bridges.vehicle_links.aircraft_state import AircraftState, Reading
from zsim_bridges.vehicle_links.failsafe import Demand


class UdpChannel(NamedTuple):
    """A UDP port of an aircraft, and the port here; 0 for any."""

    host: str
    port: int
    local_port: int = 0


class LinkFigures(NamedTuple):
    """How good the link is; None for what is not known.

    Attributes:
        loss_percent: of what the aircraft has sent within some seconds.
        round_trip_ms: of a question to it and its answer.
        clock_offset_ms: its clock less that of this process.
        refused: datagrams, or messages in them, that were not taken.
    """

    loss_percent: float | None = None
    round_trip_ms: float | None = None
    clock_offset_ms: float | None = None
    refused: int = 0


class VehicleSession(Protocol):
    """The state machine of one aircraft at the other end. Pure: it is handed time, by the clock of the process.

    Attributes:
        channels: its ports, in the order in which they are numbered.
        state: what is known of it.
        texts: lines for people, taken by the process.
    """

    channels: tuple[UdpChannel, ...]
    texts: list[str]

    @property
    def state(self) -> AircraftState: ...

    def receive(self, channel: int, datagram: bytes, now_ns: int) -> None:
        """Take a datagram from one of its ports."""
        ...

    def advance(self, now_ns: int, demand: Demand) -> Iterable[tuple[int, bytes]]:
        """Return the datagrams that are due, with the channel of each; called at least every 20 ms."""
        ...

    def take_readings(self) -> list[Reading]:
        """Return what has been measured since the last call."""
        ...

    def figures(self, now_ns: int) -> LinkFigures:
        """Return how good the link is."""
        ...
