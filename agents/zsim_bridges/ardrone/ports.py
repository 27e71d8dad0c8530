"""The addresses and ports of drones: permitted peers, datagrams, connections, and the FTP server.

The FTP server is the drone's as far as programs of the SDK use it: anonymous, passive, one file `version.txt`.
Source: RFC 959; ARDroneLib, ardrone_ftp.c and its check of the firmware's version.
"""

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
VERSION_PORT, FILES_PORT = 5551, 21  # TCP (ARDroneLib, config.h): of the version, and of videos
VERSION_FILES = {"version.txt": b"2.4.8\r\n"}  # the newest firmware of an AR.Drone 2.0
DATA_WITHIN_S = 10.0  # s of wall time within which a client must open the data connection, chosen
IDLE_S = 300.0  # s of wall time without a command, chosen
_FIXED = {
    "USER": "230 logged in",
    "PASS": "230 logged in",
    "SYST": "215 UNIX Type: L8",
    "TYPE": "200 type set",
    "MODE": "200 mode set",
    "STRU": "200 structure set",
    "NOOP": "200 ok",
    "PWD": '257 "/" is the directory',
    "CWD": "250 ok",
    "CDUP": "250 ok",
}


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
    """The peers obeyed on an address: on loopback every program of this host, elsewhere the named hosts.

    Raises:
        RunError: the address is not loopback, and no host is named.
    """

    def __init__(self, address: str, named: frozenset[str]) -> None:
        self._is_loopback = ipaddress.IPv4Address(address).is_loopback
        self._named = named
        if not self._is_loopback and not named:
            raise RunError(
                f"{address} is reached by every host of its network, and an AR.Drone has no password; "
                "give --peer HOST, the host that is obeyed, or an address 127.x.y.z"
            )

    def allow(self, host: str) -> bool:
        return self._is_loopback or host in self._named


class DatagramPort(asyncio.DatagramProtocol):
    """A UDP port: `take` is called with each datagram of a peer, and its address; what others send is refused."""

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
            self._refuse(f"{addr[0]} sends datagrams and is not a --peer")

    def send(self, datagram: bytes, address: Any) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(datagram, address)

    async def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


class StreamPort:
    """A TCP port: `serve` serves one connection of a peer until it is over; `writers` are those of all connections."""

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
        if self._server is not None:
            self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def broadcast(self, data: bytes) -> None:
        for writer in self.writers:
            if not writer.is_closing():
                writer.write(data)

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        host = (writer.get_extra_info("peername") or ("somebody",))[0]
        if not self._peers.allow(host):
            self._refuse(f"{host} connects and is not a --peer")
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


class FileServer:
    """An FTP server with files by name."""

    def __init__(
        self, address: str, peers: AllowedHosts, files: dict[str, bytes], refuse: Callable[[str], None]
    ) -> None:
        self._address = address
        self._peers = peers
        self._files = files
        self._refuse = refuse
        self.port = StreamPort(peers, self._serve, refuse)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        data: StreamPort | None = None
        waiting: asyncio.Queue[bytes | None] = asyncio.Queue(1)
        _reply(writer, "220 AR.Drone")
        try:
            while line := await asyncio.wait_for(reader.readline(), IDLE_S):
                verb, _, argument = line.decode("ascii", "replace").strip().partition(" ")
                verb = verb.upper()
                if verb == "QUIT":
                    _reply(writer, "221 bye")
                    return
                if verb in ("PASV", "EPSV"):
                    if data is not None:
                        await data.close()
                    data, waiting = await self._open_data(writer, verb)
                elif verb in ("RETR", "LIST", "NLST"):
                    await self._transfer(writer, data, waiting, verb, argument)
                    data = None
                elif verb == "SIZE":
                    content = self._files.get(argument.lstrip("/"))
                    _reply(writer, "550 no such file" if content is None else f"213 {len(content)}")
                else:
                    _reply(writer, _FIXED.get(verb, "502 not implemented"))
                await writer.drain()
        finally:
            if data is not None:
                await data.close()

    async def _open_data(self, writer: asyncio.StreamWriter, verb: str) -> tuple[StreamPort, asyncio.Queue]:
        """Listen for a data connection, and reply with its address."""
        waiting: asyncio.Queue[bytes | None] = asyncio.Queue(1)

        async def send(_: asyncio.StreamReader, to: asyncio.StreamWriter) -> None:
            content = await asyncio.wait_for(waiting.get(), DATA_WITHIN_S)
            to.write(content or b"")
            await to.drain()
            waiting.task_done()

        data = StreamPort(self._peers, send, self._refuse)
        port = await data.open(self._address, 0)
        place = ",".join([*self._address.split("."), str(port >> 8), str(port & 0xFF)])
        _reply(writer, f"227 passive ({place})" if verb == "PASV" else f"229 passive (|||{port}|)")
        return data, waiting

    async def _transfer(
        self, writer: asyncio.StreamWriter, data: StreamPort | None, waiting: asyncio.Queue, verb: str, argument: str
    ) -> None:
        name = argument.lstrip("/")
        if data is None:
            _reply(writer, "425 use PASV first")
        elif verb == "RETR" and name not in self._files:
            _reply(writer, "550 no such file")
        else:
            listing = "".join(f"{each}\r\n" for each in self._files).encode("ascii")
            _reply(writer, "150 it comes")
            waiting.put_nowait(self._files[name] if verb == "RETR" else listing)
            await asyncio.wait_for(waiting.join(), DATA_WITHIN_S)
            _reply(writer, "226 done")
        if data is not None:
            await data.close()


def _reply(writer: asyncio.StreamWriter, text: str) -> None:
    writer.write(f"{text}\r\n".encode("ascii"))
