"""The addresses and ports of drones: who is obeyed there, datagrams, and connections."""

import asyncio
import contextlib
import ipaddress
import socket
from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import Any

from zsim.errors import RunError

CONNECTIONS_MAX = 8  # at once, chosen: a pilot's program has one
LINE_MAX = 512  # bytes of a line that is read, chosen
BROKEN = (OSError, EOFError, TimeoutError, ValueError)  # of a connection, and of a line that is too long

Address = tuple[str, int]
Refuse = Callable[[str], None]
Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


def drone_addresses(text: str, drones: Sequence[str]) -> dict[str, str]:
    """Return the address of each drone that has one.

    Args:
        text: the first drone's address, which those of the others follow; or DRONE=ADDRESS, separated by commas.
        drones: of the run, in its order.

    Raises:
        RunError: it is neither, names no drone of the run, or gives an address twice.
    """
    addresses: dict[str, str] = {}
    if "=" in text:
        for part in text.split(","):
            drone, _, address = (each.strip() for each in part.partition("="))
            if part.strip() and drone not in drones:
                raise RunError(f"--addresses names {drone!r}; must be one of {', '.join(drones)}")
            if part.strip():
                addresses[drone] = str(_address(address))
    else:
        first = _address(text)
        try:
            addresses = {drone: str(first + i) for i, drone in enumerate(drones)}
        except ipaddress.AddressValueError:
            raise RunError(f"--addresses begins with {first}; there are not enough addresses behind it") from None
    if len(set(addresses.values())) < len(addresses):
        raise RunError(f"--addresses is {text!r}; must give each drone an address of its own")
    return addresses


def _address(text: str) -> ipaddress.IPv4Address:
    try:
        return ipaddress.IPv4Address(text.strip())
    except ipaddress.AddressValueError:
        raise RunError(f"--addresses has {text!r}; must be an IPv4 address, or DRONE=ADDRESS,DRONE=ADDRESS") from None


def peer_addresses(hosts: Iterable[str]) -> frozenset[str]:
    """Return the addresses of the hosts that are obeyed.

    Raises:
        RunError: a name has no address.
    """
    found: set[str] = set()
    for host in hosts:
        try:
            found.update(str(info[4][0]) for info in socket.getaddrinfo(host, None, socket.AF_INET))
        except OSError as error:
            raise RunError(f"--peer {host}: has no IPv4 address here ({error.strerror})") from None
    return frozenset(found)


class AllowedHosts:
    """Who is obeyed on an address: on loopback every program of this host, elsewhere the hosts that were named.

    Args:
        address: of the drone.
        named: addresses of hosts.

    Raises:
        RunError: the address is not loopback, and nobody is named.
    """

    def __init__(self, address: str, named: frozenset[str]) -> None:
        self._is_loopback = ipaddress.IPv4Address(address).is_loopback
        self._named = named
        if not self._is_loopback and not named:
            raise RunError(
                f"{address} is reached by every host of its network, and an AR.Drone asks nobody for a password; "
                "give --peer HOST, the host that is obeyed, or an address 127.x.y.z"
            )

    def allow(self, host: str) -> bool:
        """Return whether a host is obeyed."""
        return self._is_loopback or host in self._named


class DatagramPort(asyncio.DatagramProtocol):
    """A UDP port.

    Args:
        peers: who is obeyed.
        take: called with each of their datagrams, and its address.
        refuse: counts what others send, with the reason.
    """

    def __init__(self, peers: AllowedHosts, take: Callable[[bytes, Address], None], refuse: Refuse) -> None:
        self._peers = peers
        self._take = take
        self._refuse = refuse
        self._transport: asyncio.DatagramTransport | None = None

    async def open(self, address: str, port: int) -> int:
        """Bind it; return the port, where 0 asks for any.

        Raises:
            OSError: it is taken, or the address is not this host's.
        """
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=(address, port))
        return self._transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self._peers.allow(addr[0]):
            self._take(data, addr[:2])
        else:
            self._refuse(f"{addr[0]} sends datagrams, and is no --peer")

    def send(self, datagram: bytes, address: Any) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(datagram, address)

    async def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


class StreamPort:
    """A TCP port.

    Args:
        peers: who may connect.
        serve: serves one connection until it is over.
        refuse: counts what is not served, with the reason.

    Attributes:
        writers: of the connections that are served.
    """

    def __init__(self, peers: AllowedHosts, serve: Serve, refuse: Refuse) -> None:
        self._peers = peers
        self._serve = serve
        self._refuse = refuse
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.writers: set[asyncio.StreamWriter] = set()

    async def open(self, address: str, port: int) -> int:
        """Listen; return the port, where 0 asks for any.

        Raises:
            OSError: it is taken, or needs a privilege.
        """
        self._server = await asyncio.start_server(self._accept, address, port, limit=LINE_MAX)
        return self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """End all connections."""
        if self._server is not None:
            self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def broadcast(self, data: bytes) -> None:
        """Send bytes to everybody connected."""
        for writer in self.writers:
            if not writer.is_closing():
                writer.write(data)

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        host = (writer.get_extra_info("peername") or ("somebody",))[0]
        if not self._peers.allow(host):
            self._refuse(f"{host} connects, and is no --peer")
            writer.transport.abort()
        elif len(self._tasks) >= CONNECTIONS_MAX:
            self._refuse(f"{host} connects, and there are {CONNECTIONS_MAX} connections already")
            writer.transport.abort()
        else:
            task = asyncio.get_running_loop().create_task(self._serve_one(reader, writer))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _serve_one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.add(writer)
        try:
            with contextlib.suppress(*BROKEN):
                await self._serve(reader, writer)
        finally:
            self.writers.discard(writer)
            writer.close()


async def read_until_end(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
    """Serve a connection that only listens: what it sends is dropped."""
    while await reader.read(LINE_MAX):
        pass
