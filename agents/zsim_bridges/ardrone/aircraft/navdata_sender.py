"""Navdata of one aircraft: which packets are due, with which options, to which programs."""

import struct
from collections.abc import Callable, Hashable

from zsim_bridges.ardrone.aircraft.configuration import Configuration
from zsim_bridges.ardrone.aircraft.navdata_content import NavdataContent
from zsim_bridges.ardrone.wire import navdata
from zsim_bridges.ardrone.wire.navdata import NavdataTemplate
from zsim_bridges.ardrone.wire.navdata_options import FULL_TAGS, GPS_TAG

CLIENTS_MAX = 8  # programs that are sent navdata, chosen; the one that asked first goes
REQUESTS = (b"\x01", b"Init")  # how a datagram begins that asks for navdata (ARDroneLib; its Windows client)
SECOND_NS = 1_000_000_000

Send = Callable[[bytes, Hashable], None]
"""Sends a datagram to an address."""


class PacketClock:
    """Tells when a packet is due: so many in each simulated second, without drift."""

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None  # rate [Hz], and number of the packet

    def is_due(self, t_ns: int, rate_hz: int) -> bool:
        """Tell whether a packet is due at an instant, and count it."""
        number = rate_hz, t_ns * rate_hz // SECOND_NS
        is_due = number != self._last
        self._last = number
        return is_due


class NavdataSender:
    """Sends an aircraft's navdata.

    Args:
        content: what stands in the packets.
        configuration: of the aircraft.
        send: sends a datagram.
        state_bits: returns the state word without the bits of the mode of navdata.
        ctrl_state: returns the state of the flight.
        refuse: counts what cannot be sent, with the reason.
    """

    def __init__(
        self,
        content: NavdataContent,
        configuration: Configuration,
        send: Send,
        state_bits: Callable[[], int],
        ctrl_state: Callable[[], int],
        refuse: Callable[[str], None],
    ) -> None:
        self._content = content
        self._configuration = configuration
        self._send = send
        self._state_bits = state_bits
        self._ctrl_state = ctrl_state
        self._refuse = refuse
        self._clock = PacketClock()
        self._clients: dict[Hashable, None] = {}
        self._sequence = 0
        self._prepare(())
        self.is_bootstrap = True

    def on_request(self, datagram: bytes, address: Hashable, t_ns: int) -> bool:
        """Send navdata to an address from now on; return False for a datagram that does not ask for it."""
        if not datagram.startswith(REQUESTS):
            return False
        if address not in self._clients:
            while len(self._clients) >= CLIENTS_MAX:
                del self._clients[next(iter(self._clients))]
            self._clients[address] = None
            self._send(self._packet(t_ns), address)
        return True

    def drop_clients(self) -> None:
        """Send no more until it is asked for again."""
        self._clients.clear()

    def drop_client(self, address: Hashable) -> None:
        """Send no more to an address where nobody listens."""
        self._clients.pop(address, None)

    def on_instant(self, t_ns: int) -> None:
        """Send the packet that is due."""
        is_full = not (self.is_bootstrap or self._configuration.flag("general:navdata_demo"))
        rate_hz = navdata.FULL_RATE_HZ if is_full else navdata.DEMO_RATE_HZ
        if self._clients and self._clock.is_due(t_ns, rate_hz):
            packet = self._packet(t_ns)
            for address in tuple(self._clients):
                self._send(packet, address)

    def on_gate(self) -> None:
        """Renew what changes at gates."""
        self._is_gate_new = True

    def _packet(self, t_ns: int) -> bytes:
        tags = self._tags()
        if tags != self._template.tags:
            self._prepare(tags)
        try:
            self._fill(t_ns)
        except (struct.error, ArithmeticError, ValueError) as error:
            self._refuse(f"navdata has a value beyond what its field can hold ({error})")
        self._sequence += 1
        return self._template.packet(self._state_bits() + self._mode_bits(), self._sequence & 0xFFFF_FFFF, 0)

    def _fill(self, t_ns: int) -> None:
        if self._is_gate_new:
            self._is_gate_new = False
            self._fill_gate()
        self._fill_packet(self._ctrl_state(), t_ns)

    def _prepare(self, tags: tuple[int, ...]) -> None:
        self._template = NavdataTemplate(tags)
        self._fill_packet, self._fill_gate = self._content.fillers(self._template)
        self._is_gate_new = True

    def _mode_bits(self) -> int:
        if self.is_bootstrap:
            return navdata.StateBit.NAVDATA_BOOTSTRAP + navdata.StateBit.NAVDATA_DEMO
        return navdata.StateBit.NAVDATA_DEMO if self._configuration.flag("general:navdata_demo") else 0

    def _tags(self) -> tuple[int, ...]:
        """Return the options of a packet; the GPS is in none that did not ask for it by its bit."""
        if self.is_bootstrap:
            return ()
        options = int(self._configuration.number("general:navdata_options"))
        gps = (GPS_TAG,) if options >> GPS_TAG & 1 else ()
        if not self._configuration.flag("general:navdata_demo"):
            return (*FULL_TAGS, *gps)
        return (*(tag for tag in FULL_TAGS if tag == 0 or options >> tag & 1), *gps)
