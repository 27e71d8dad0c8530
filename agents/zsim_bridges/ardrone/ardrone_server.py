"""`zsim ardrone serve`: presents the drones of a run as AR.Drones, each with all of its ports on its own address.

The FTP servers offer only what SDK programs use: anonymous login, passive mode, and the file `version.txt`.
Source: RFC 959; ARDroneLib, ardrone_ftp.c and its check of the firmware's version.
"""

import asyncio
import contextlib
import errno
import ipaddress
import socket
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from typing import Any, NamedTuple

from zsim.contract import keys
from zsim.contract.flight_messages import CameraImage
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.errors import RunError, install_command
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Drone
from zsim.transport.session import Session
from zsim_bridges.ardrone import at_commands, navdata, video
from zsim_bridges.ardrone.aircraft import Aircraft, AircraftOutputs
from zsim_bridges.ardrone.video import VideoEncoder, VideoFrame, pave_header
from zsim_bridges.vehicle_links import drone_link
from zsim_bridges.vehicle_links.server import PictureServer, Say

AUTHENTICATION_PORT = 5552  # UDP, on which programs look for drones (ARDroneLib, config.h)
AUTH_REQUEST, AUTH_REPLY = b"PARROT AUTH", b"PARROT AUTH OK"  # ARDroneLib, ardrone_auth.c
BACKLOG_MAX = 500_000  # unsent bytes, a few seconds of video, beyond which a connection skips to the next IDR frame
NOT_PERMITTED = (errno.EACCES, errno.EPERM)  # errors on opening a port below 1024 without the privilege to do so
CONNECTIONS_MAX = 8  # maximum simultaneous connections per port; design choice: a pilot's program needs only one
LINE_MAX = 512  # maximum length of a line [bytes]
CONNECTION_ERRORS = (OSError, EOFError, TimeoutError, ValueError)  # broken or idle connection, or overlong line
Address = tuple[str, int]
Refuse = Callable[[str], None]
Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
VERSION_PORT, FILES_PORT = 5551, 21  # TCP ports of the FTP servers: version file, videos (ARDroneLib, config.h)
VERSION_FILES = {"version.txt": b"2.4.8\r\n"}  # the newest firmware of an AR.Drone 2.0
DATA_TIMEOUT_S = 10.0  # maximum wall time that a data connection waits for its command, or a command for its transfer
IDLE_TIMEOUT_S = 300.0  # wall time without a command after which a connection is closed
_FIXED_REPLIES = {
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


class ArdroneOptions(NamedTuple):
    """How the drones are presented.

    Attributes:
        addresses: the text that `drone_addresses` reads.
        peers: hosts that are obeyed on addresses other than loopback.
        rate: rate to request for the run [× real time]; None to leave it unchanged.
    """

    addresses: str
    peers: frozenset[str]
    rate: float | None


class ArdroneServer(PictureServer):
    """Presents the drones of one run as AR.Drones.

    Raises:
        RunError: an address is invalid, or could be reached by hosts that are not named as peers.
    """

    options: ArdroneOptions

    def __init__(self, link: Session, info: Info, observer: Participant, say: Say, options: ArdroneOptions) -> None:
        super().__init__(link, info, observer, say, options)
        addresses = drone_addresses(options.addresses, [drone.name for drone in info.drones])
        drones = {drone.name: drone for drone in scenario_file.from_text(info.scenario).drones}
        self._drones = {
            name: DroneServer(drones[name], address, AllowedHosts(address, options.peers), self)
            for name, address in addresses.items()
        }
        self._has_encoder = find_spec("av") is not None

    async def open(self, stack: contextlib.AsyncExitStack) -> None:
        drone_link.warm_up()
        await super().open(stack)
        for name, drone in self._drones.items():
            stack.push_async_callback(drone.close)
            for line in await drone.open():
                self.say(line)
            self.say(f"{name} is an AR.Drone 2.0 at {drone.address}")

    def watched_cameras(self) -> Iterator[str]:
        for name, drone in self._drones.items():
            if drone.video.is_watched:
                if self._has_encoder:
                    yield keys.camera(name, drone.aircraft.camera)
                else:
                    advice = install_command(["video"])
                    self.say_once(f"video: av is not installed, so no pictures are streamed; {advice}")

    def forward(self, key: str, payload: bytes) -> None:
        kind, thing, leaf = keys.parts(key)
        # what an aircraft's electronics know: the sensor data, the estimate, and the rotor speeds in the truth
        is_onboard = leaf.startswith("sensor/") or leaf in ("estimate", "truth")
        if not (kind == "drone" and thing in self._drones and is_onboard):
            self.on_run(key, payload)
            return
        message = self.try_decode(key, payload)
        if message is not None:
            try:
                self._drones[thing].aircraft.update(message)
            except (ValueError, ArithmeticError) as error:  # finite, but out of range for a field of navdata
                self.refuse(f"{key}: {error}")

    def on_picture(self, key: str, payload: bytes) -> None:
        image = self.try_decode(key, payload)
        drone = self._drones.get(keys.thing(key))
        if image is not None and drone is not None and keys.leaf(key) == drone.aircraft.camera:
            drone.video.on_picture(image)

    def on_event(self, event: Event) -> None:
        """Count and print the commands from pilots' programs that the world refuses."""
        if (event.kind, event.source) != ("refused", self.observer.name):
            return
        _, thing, leaf = keys.parts(event.subject)
        drone = self._drones.get(thing)
        is_overtaken = leaf != "cmd/mode" and drone is not None and drone.aircraft.pilot.setpoint is None
        if not is_overtaken:  # at the gate in which a landing begins, a setpoint is expected to be refused
            self.refuse(f"{event.subject}: {event.data.get('reason', event.text)}")


class DroneServer:
    """The ports of one drone on its address, and the aircraft behind them."""

    def __init__(self, drone: Drone, address: str, peers: "AllowedHosts", server: ArdroneServer) -> None:
        self.address = address
        self._name = drone.name
        self._refuse: Callable[[str], None] = lambda reason: server.refuse(f"{drone.name}: {reason}")
        self._navdata = DatagramPort(peers, lambda *request: self.aircraft.on_navdata_request(*request), self._refuse)
        commands = DatagramPort(peers, lambda datagram, _: self.aircraft.on_at(datagram), self._refuse)
        self._authentication = DatagramPort(peers, self._on_auth_request, self._refuse)
        self._control = StreamPort(peers, read_until_end, self._refuse)
        outputs = AircraftOutputs(server.link.put, self._navdata.send, self._control.broadcast, server.refuse)
        self.aircraft = Aircraft(drone, server.observer.name, server.info.gate_ns, outputs)
        self.video = VideoServer(peers, self._refuse)
        version = FileServer(address, peers, VERSION_FILES, self._refuse)
        self._files = FileServer(address, peers, {}, self._refuse).port
        self._ports: tuple[tuple[DatagramPort | StreamPort, str, int], ...] = (
            (self._navdata, "UDP", navdata.PORT),
            (commands, "UDP", at_commands.PORT),
            (self._authentication, "UDP", AUTHENTICATION_PORT),
            (self._control, "TCP", at_commands.CONTROL_PORT),
            (self.video.port, "TCP", video.PORT),
            (version.port, "TCP", VERSION_PORT),
        )

    async def open(self) -> list[str]:
        """Open all ports; return a line for each optional port that could not be opened.

        Raises:
            RunError: a port is taken, or the address is not this host's.
        """
        for endpoint, kind, port in self._ports:
            try:
                await endpoint.open(self.address, port)
            except OSError as error:
                reason = {
                    errno.EADDRINUSE: "another program uses it; end that program, or give other --addresses",
                    errno.EADDRNOTAVAIL: "the address is not this host's; give one of this host's as --addresses",
                }.get(error.errno or 0, error.strerror or str(error))
                raise RunError(
                    f"{self._name}: {kind} port {port} of {self.address} cannot be opened: {reason}"
                ) from error
        try:  # optional, since few programs use this port and opening it needs a privilege
            await self._files.open(self.address, FILES_PORT)
        except OSError as error:
            reason = "needs a privilege" if error.errno in NOT_PERMITTED else error.strerror
            return [f"{self._name}: TCP port {FILES_PORT} is not served ({reason}); ps_drone uses it"]
        return []

    async def close(self) -> None:
        self.video.close()
        for endpoint, _, _ in self._ports:
            await endpoint.close()
        await self._files.close()

    def _on_auth_request(self, datagram: bytes, address: Address) -> None:
        if datagram.startswith(AUTH_REQUEST):
            self._authentication.send(AUTH_REPLY, address)
        else:
            self._refuse("a datagram on the authentication port is not a PARROT AUTH request")


class VideoServer:
    """Streams the images of one drone on its `port`, which the caller opens."""

    def __init__(self, peers: "AllowedHosts", refuse: Refuse) -> None:
        self._refuse = refuse
        self.port = StreamPort(peers, self._serve, refuse)
        self._in_sync: set[asyncio.StreamWriter] = set()  # connections that were sent an IDR frame and all since
        self._next_image: CameraImage | None = None
        self._stream_task: asyncio.Task[None] | None = None
        self._encoder: VideoEncoder | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="video")
        self._frame_count = self._sent_bytes = 0

    @property
    def is_watched(self) -> bool:
        return bool(self.port.writers)

    def close(self) -> None:
        if self._stream_task is not None:
            self._stream_task.cancel()
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await read_until_end(reader, writer)
        finally:
            self._in_sync.discard(writer)

    def on_picture(self, image: CameraImage) -> None:
        """Stream an image; while another is being encoded, only the newest waits."""
        self._next_image = image
        if self.is_watched and self._stream_task is None:
            self._stream_task = asyncio.get_running_loop().create_task(self._stream())

    async def _stream(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            while self._next_image is not None and self.is_watched:
                image, self._next_image = self._next_image, None
                needs_idr = any(writer not in self._in_sync for writer in self.port.writers)
                try:
                    frame = await loop.run_in_executor(self._thread, self._encode, image, needs_idr)
                except ValueError as error:
                    self._refuse(f"a picture cannot be streamed: {error}")
                    continue
                if frame is not None:
                    self._send(image, frame)
        finally:
            self._stream_task = None

    def _encode(self, image: CameraImage, needs_idr: bool) -> VideoFrame | None:
        self._encoder = self._encoder or VideoEncoder()
        return self._encoder.encode(image.data, needs_idr)

    def _send(self, image: CameraImage, frame: VideoFrame) -> None:
        """Send a frame to every connection that can decode it and keeps up."""
        packet = pave_header(frame, self._frame_count, image.t_sample_ns // 1_000_000, self._sent_bytes) + frame.data
        self._frame_count, self._sent_bytes = self._frame_count + 1, self._sent_bytes + len(frame.data)
        for writer in tuple(self.port.writers):
            if writer.transport.get_write_buffer_size() > BACKLOG_MAX:
                self._in_sync.discard(writer)
            elif frame.is_idr or writer in self._in_sync:
                self._in_sync.add(writer)
                writer.write(packet)


class FileServer:
    """An FTP server that offers `files`, given as contents by name."""

    def __init__(self, address: str, peers: "AllowedHosts", files: dict[str, bytes], refuse: Refuse) -> None:
        self._address = address
        self._peers = peers
        self._files = files
        self._refuse = refuse
        self.port = StreamPort(peers, self._serve, refuse)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        data_port: StreamPort | None = None
        content_queue: asyncio.Queue[bytes | None] = asyncio.Queue(1)
        _reply(writer, "220 AR.Drone")
        try:
            while line := await _read_line(reader):
                verb, _, argument = line.decode("ascii", "replace").strip().partition(" ")
                verb = verb.upper()
                if verb == "QUIT":
                    _reply(writer, "221 bye")
                    return
                if verb in ("PASV", "EPSV"):
                    if data_port is not None:
                        await data_port.close()
                    data_port, content_queue = await self._open_data(writer, verb)
                elif verb in ("RETR", "LIST", "NLST"):
                    await self._transfer(writer, data_port, content_queue, verb, argument)
                    data_port = None
                elif verb == "SIZE":
                    content = self._files.get(argument.lstrip("/"))
                    _reply(writer, "550 no such file" if content is None else f"213 {len(content)}")
                else:
                    _reply(writer, _FIXED_REPLIES.get(verb, "502 not implemented"))
                await writer.drain()
        finally:
            if data_port is not None:
                await data_port.close()

    async def _open_data(self, writer: asyncio.StreamWriter, verb: str) -> "tuple[StreamPort, asyncio.Queue]":
        """Listen for a data connection, and reply with its address."""
        content_queue: asyncio.Queue[bytes | None] = asyncio.Queue(1)

        async def send(_: asyncio.StreamReader, data_writer: asyncio.StreamWriter) -> None:
            async with asyncio.timeout(DATA_TIMEOUT_S):
                content = await content_queue.get()
            data_writer.write(content or b"")
            await data_writer.drain()
            content_queue.task_done()

        data_port = StreamPort(self._peers, send, self._refuse)
        port = await data_port.open(self._address, 0)
        endpoint = ",".join([*self._address.split("."), str(port >> 8), str(port & 0xFF)])
        _reply(writer, f"227 passive ({endpoint})" if verb == "PASV" else f"229 passive (|||{port}|)")
        return data_port, content_queue

    async def _transfer(
        self,
        writer: asyncio.StreamWriter,
        data_port: "StreamPort | None",
        content_queue: asyncio.Queue,
        verb: str,
        argument: str,
    ) -> None:
        name = argument.lstrip("/")
        if data_port is None:
            _reply(writer, "425 use PASV first")
        elif verb == "RETR" and name not in self._files:
            _reply(writer, "550 no such file")
        else:
            listing = "".join(f"{each}\r\n" for each in self._files).encode("ascii")
            _reply(writer, "150 sending data")
            content_queue.put_nowait(self._files[name] if verb == "RETR" else listing)
            async with asyncio.timeout(DATA_TIMEOUT_S):
                await content_queue.join()
            _reply(writer, "226 done")
        if data_port is not None:
            await data_port.close()


async def _read_line(reader: asyncio.StreamReader) -> bytes:
    async with asyncio.timeout(IDLE_TIMEOUT_S):
        return await reader.readline()


def _reply(writer: asyncio.StreamWriter, text: str) -> None:
    writer.write(f"{text}\r\n".encode("ascii"))


class DatagramPort(asyncio.DatagramProtocol):
    """A UDP port: passes datagrams from peers to `on_datagram`, with their source addresses; refuses all others."""

    def __init__(self, peers: "AllowedHosts", on_datagram: Callable[[bytes, Address], None], refuse: Refuse) -> None:
        self._peers = peers
        self._on_datagram = on_datagram
        self._refuse = refuse
        self._transport: asyncio.DatagramTransport | None = None

    async def open(self, address: str, port: int) -> int:
        """Bind the port; return its number, which the system chooses if `port` is 0.

        Raises:
            OSError: the port is taken, or the address is not this host's.
        """
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=(address, port))
        return self._transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self._peers.allow(addr[0]):
            self._on_datagram(data, addr[:2])
        else:
            self._refuse(f"{addr[0]} sends datagrams and is not a --peer")

    def send(self, datagram: bytes, address: Any) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(datagram, address)

    async def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


class StreamPort:
    """A TCP port: `serve` handles one connection of a peer until it ends; `writers` belong to open connections."""

    def __init__(self, peers: "AllowedHosts", serve: Serve, refuse: Refuse) -> None:
        self._peers = peers
        self._serve = serve
        self._refuse = refuse
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.writers: set[asyncio.StreamWriter] = set()

    async def open(self, address: str, port: int) -> int:
        """Listen on the port; return its number, which the system chooses if `port` is 0.

        Raises:
            OSError: the port is taken or needs a privilege, or the address is not this host's.
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
            with contextlib.suppress(*CONNECTION_ERRORS):
                await self._serve(reader, writer)
        finally:
            self.writers.discard(writer)
            writer.close()


async def read_until_end(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
    """Keep open a connection on which the peer should only listen; received data are dropped."""
    while await reader.read(LINE_MAX):
        pass


class AllowedHosts:
    """The hosts obeyed on an address: on a loopback address every program on this host, otherwise the named hosts.

    Raises:
        RunError: the address is not a loopback address, and no host is named.
    """

    def __init__(self, address: str, allowed_hosts: frozenset[str]) -> None:
        self._is_loopback = ipaddress.IPv4Address(address).is_loopback
        self._allowed_hosts = allowed_hosts
        if not self._is_loopback and not allowed_hosts:
            raise RunError(
                f"{address} can be reached by every host on its network, and an AR.Drone has no password; "
                "give --peer HOST, the host to obey, or an address 127.x.y.z"
            )

    def allow(self, host: str) -> bool:
        return self._is_loopback or host in self._allowed_hosts


def drone_addresses(text: str, drones: Sequence[str]) -> dict[str, str]:
    """Return the address of each drone that has one.

    Args:
        text: the first drone's address, incremented for each further one; or DRONE=ADDRESS pairs, separated by commas.
        drones: names of the run's drones, in the run's order.

    Raises:
        RunError: `text` has neither form, names a drone that is not in the run, gives an address twice, or leaves too
            few addresses.
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
            raise RunError(f"--addresses begins with {first}; there are not enough addresses after it") from None
    if len(set(addresses.values())) < len(addresses):
        raise RunError(f"--addresses is {text!r}; must give each drone an address of its own")
    return addresses


def _address(text: str) -> ipaddress.IPv4Address:
    try:
        return ipaddress.IPv4Address(text.strip())
    except ipaddress.AddressValueError:
        raise RunError(f"--addresses has {text!r}; must be an IPv4 address, or DRONE=ADDRESS,DRONE=ADDRESS") from None


def peer_addresses(hosts: Iterable[str]) -> frozenset[str]:
    """Return the IPv4 addresses of hosts given by name or address.

    Raises:
        RunError: a name has no address.
    """
    addresses: set[str] = set()
    for host in hosts:
        try:
            addresses.update(str(info[4][0]) for info in socket.getaddrinfo(host, None, socket.AF_INET))
        except OSError as error:
            raise RunError(f"--peer {host}: has no IPv4 address here ({error.strerror})") from None
    return frozenset(addresses)
