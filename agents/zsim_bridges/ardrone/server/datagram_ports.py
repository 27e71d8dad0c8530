"""The UDP ports of a drone."""

import asyncio
from collections.abc import Callable
from typing import Any

from zsim_bridges.ardrone.server.addresses import AllowedHosts

AUTHENTICATION_PORT = 5552  # UDP, where programs look for drones (ARDroneLib, config.h)
QUESTION, ANSWER = b"PARROT AUTH", b"PARROT AUTH OK"  # ARDroneLib, ardrone_auth.c
Address = tuple[str, int]


class DatagramPort(asyncio.DatagramProtocol):
    """A UDP port.

    Args:
        peers: who is obeyed.
        take: called with each datagram of theirs, and its address.
        refuse: counts what others send, with the reason.
    """

    def __init__(
        self, peers: AllowedHosts, take: Callable[[bytes, Address], None], refuse: Callable[[str], None]
    ) -> None:
        self._peers = peers
        self._take = take
        self._refuse = refuse
        self._transport: asyncio.DatagramTransport | None = None

    def connection_made(self, transport: Any) -> None:
        """Keep the socket."""
        self._transport = transport

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Take a datagram, unless a stranger has sent it."""
        if self._peers.allow(addr[0]):
            self._take(data, addr[:2])
        else:
            self._refuse(f"{addr[0]} sends datagrams, and is no --peer")

    def send(self, datagram: bytes, address: Any) -> None:
        """Send a datagram."""
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(datagram, address)

    def close(self) -> None:
        """Close the socket."""
        if self._transport is not None:
            self._transport.close()


async def open_datagram_port(address: str, port: int, protocol: DatagramPort) -> None:
    """Bind a UDP port.

    Raises:
        OSError: it is taken, or the address is not this host's.
    """
    await asyncio.get_running_loop().create_datagram_endpoint(lambda: protocol, local_addr=(address, port))
