"""The UDP ports of one vehicle, as PX4's simulation has them: one for ground stations, one for programs."""

import asyncio
import errno
import socket
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress

from zsim.errors import RunError
from zsim_bridges.mavlink.serve.peers import Address, Peers
from zsim_bridges.mavlink.wire.frame import Link, Parser, Received
from zsim_bridges.mavlink.wire.signing import Signing
from zsim_bridges.mavlink.wire.wire_message import WireMessage

DATAGRAM_MAX = 1400  # bytes; fits into a frame of Ethernet
READ_MAX = 65_536  # bytes
READS_MAX = 64  # datagrams at once, then others have their turn
TAKEN = (errno.EADDRINUSE, errno.EACCES)  # another process has the port, or only the system may
OnReceived = Callable[[Received], None]


class VehiclePort:
    """One UDP port.

    Args:
        local: on which it is opened.
        peer: to which it sends from the start.
        signing: of what is sent and read.
        on_received: called with each message of a peer.

    Raises:
        RunError: the port cannot be opened.
    """

    def __init__(self, local: Address, peer: Address, signing: Signing | None, on_received: OnReceived) -> None:
        self._socket = _bound(local)
        self._on_received = on_received
        self.peers = Peers(peer)
        self.parser = Parser(signing)

    def open(self, loop: asyncio.AbstractEventLoop, wall_s: Callable[[], float]) -> None:
        """Read from now on."""
        self._wall_s = wall_s
        loop.add_reader(self._socket.fileno(), self._read)

    def close(self, loop: asyncio.AbstractEventLoop) -> None:
        """Read and send no more."""
        loop.remove_reader(self._socket.fileno())
        self._socket.close()

    def send(self, datagrams: Sequence[bytes]) -> None:
        """Send to all peers; what a full buffer does not take is lost, as on any radio."""
        for address in self.peers.addresses(self._wall_s()):
            for datagram in datagrams:
                with suppress(OSError):  # nobody there, no route, no room
                    self._socket.sendto(datagram, address)

    def _read(self) -> None:
        for _ in range(READS_MAX):
            try:
                data, address = self._socket.recvfrom(READ_MAX)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                continue  # what was sent before could not be delivered
            if self.peers.accepts(address, self._wall_s()):
                for received in self.parser.feed(data):
                    self._on_received(received)


class VehiclePorts:
    """Both ports of a vehicle, with one numbering of what is sent.

    Args:
        ports: that it has.
        link: packs the messages.
    """

    def __init__(self, ports: Sequence[VehiclePort], link: Link) -> None:
        self._ports = ports
        self._link = link
        self._unsent = 0

    def open(self, loop: asyncio.AbstractEventLoop, wall_s: Callable[[], float]) -> None:
        """Read from now on."""
        for port in self._ports:
            port.open(loop, wall_s)

    def close(self, loop: asyncio.AbstractEventLoop) -> None:
        """Close both."""
        for port in self._ports:
            port.close(loop)

    def send(self, messages: Sequence[WireMessage]) -> None:
        """Send messages to all peers, many in a datagram."""
        frames = [frame for message in messages if (frame := self._packed(message))]
        if not frames:
            return
        datagrams = _batches(frames)
        for port in self._ports:
            port.send(datagrams)

    def _packed(self, message: WireMessage) -> bytes:
        """Return a frame; empty, and counted, where a value does not fit into its field."""
        try:
            return self._link.pack(message)
        except (struct.error, OverflowError, ValueError):
            self._unsent += 1
            return b""

    def refused(self) -> Counter[str]:
        """Return how much was refused so far, by reason."""
        counts = Counter({"unsent": self._unsent})
        for port in self._ports:
            counts += port.parser.refused
            counts["stranger"] += port.peers.refused
        return counts


def _batches(frames: Sequence[bytes]) -> list[bytes]:
    """Return frames together in datagrams."""
    batches, batch, size = [], [], 0
    for frame in frames:
        if size + len(frame) > DATAGRAM_MAX and batch:
            batches.append(b"".join(batch))
            batch, size = [], 0
        batch.append(frame)
        size += len(frame)
    return [*batches, b"".join(batch)]


def _bound(local: Address) -> socket.socket:
    family = socket.AF_INET6 if ":" in local[0] else socket.AF_INET
    opened = socket.socket(family, socket.SOCK_DGRAM)
    opened.setblocking(False)
    try:
        opened.bind(local)
    except OSError as error:
        opened.close()
        taken = error.errno in TAKEN
        advice = "other ports with --gcs-local and --api-local" if taken else "an address of this host with --listen"
        raise RunError(f"UDP {local[0]}:{local[1]} cannot be opened ({error.strerror}); give {advice}") from error
    return opened
