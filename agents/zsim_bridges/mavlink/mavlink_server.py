"""`zsim mavlink serve`: presents the drones of a run as MAVLink vehicles on UDP.

Each vehicle has two ports, as in PX4's simulation: one for ground stations, one for programs.
"""

import asyncio
import contextlib
import errno
import hashlib
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.errors import RunError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Drone
from zsim.transport.session import Session
from zsim_bridges.mavlink.dialect import COMPONENT_AUTOPILOT, Link, Parser, Received, Signing, Version, WireMessage
from zsim_bridges.mavlink.mavlink_vehicle import MavlinkVehicle, Options
from zsim_bridges.mavlink.personality import PERSONALITIES
from zsim_bridges.mavlink.telemetry import Level
from zsim_bridges.vehicle_links.drone_link import CommandSender
from zsim_bridges.vehicle_links.server import Say, TrafficIntake, VehicleServer
from zsim_bridges.web import is_loopback

REPLY_TIMEOUT_S = 1.0  # wall time to wait for an answer from the world
TICK_S = 0.1  # wall time between checks of what is due by wall time
SWITCH_INTERVAL_S = 5e-4  # thread switch interval, so that setpoints do not wait for a gate; Python's default is 5 ms
SYSTEM_IDS = 254  # 255 is the ground station's by convention
DATAGRAM_MAX = 1400  # bytes; fits into an Ethernet frame
READ_MAX = 65_536  # bytes
READS_MAX = 64  # datagrams read at once, before other tasks run
LEARNT_PEERS_MAX = 8  # programs on this machine that one port remembers at once
PEER_TIMEOUT_S = 30.0  # wall time after which a silent program is forgotten
REASONS = {
    "bad_crc": "a frame with a wrong checksum",
    "unknown": "a message that is not in the dialect",
    "incompatible": "a frame with unknown flags",
    "truncated": "a truncated frame",
    "unsigned": "a frame without a signature",
    "bad_signature": "a frame with a wrong signature",
    "replayed": "a signed frame whose timestamp is too old",
    "noise": "bytes outside frames",
    "unsent": "a message of its own that cannot be encoded",
    "stranger": "a datagram that is not from the configured peer",
}
Address = tuple[str, int]


class MavlinkOptions(NamedTuple):
    """How the drones are presented.

    Attributes:
        level: level of the telemetry rates.
        gcs, gcs_local: address of the ground station, and the first drone's local port for it.
        api, api_local: address of programs for the first drone, and its local port for them; later drones' ports
            count up.
        key: signing key; None for no signatures.
        rate: pace to request from the world; None to request none.
        first_system_id: system id of the first drone; those of the others count up.
    """

    autopilot: str
    level: Level
    listen: str
    gcs: Address
    gcs_local: int
    api: Address
    api_local: int
    key: bytes | None
    version: Version
    rate: float | None
    first_system_id: int


class MavlinkServer(VehicleServer):
    """One run's drones as MAVLink vehicles.

    Raises:
        RunError: the run has too many drones, or a port cannot be opened.
    """

    options: MavlinkOptions

    def __init__(self, link: Session, info: Info, observer: Participant, say: Say, options: MavlinkOptions) -> None:
        super().__init__(link, info, observer, say, options)
        self._signing = Signing(options.key) if options.key else None
        self._refused_counts: Counter[str] = Counter()
        self._requests = ThreadPoolExecutor(1)  # requests are sent one at a time
        drones = scenario_file.from_text(info.scenario).drones
        first = options.first_system_id
        if first + len(drones) - 1 > SYSTEM_IDS:
            allowed = f"MAVLink has {SYSTEM_IDS} system ids, of which --first-system-id is {first}"
            raise RunError(f"{observer.name}: the run has {len(drones)} drones; {allowed}")
        self._served = {drone.name: self._make_vehicle(i, drone) for i, drone in enumerate(drones)}
        self._routes: dict[str, tuple[str, str]] = {}  # drone and message name, by key
        for drone in self._served:
            names = {keys.sensor(drone, name): name for name in keys.SENSORS}
            names |= {keys.truth(drone): "truth", keys.estimate(drone): "estimate", keys.status(drone): "status"}
            self._routes |= {key: (drone, name) for key, name in names.items()}

    def _make_vehicle(self, index: int, drone: Drone) -> "ServedVehicle":
        options, system_id, source = self.options, self.options.first_system_id + index, self.observer.name
        # 64 bits by which programs recognise a vehicle, unique across runs
        unique_id = int.from_bytes(hashlib.sha256(f"{self.info.run_id}/{drone.name}".encode()).digest()[:8])
        vehicle_options = Options(system_id, PERSONALITIES[options.autopilot], options.level, source, unique_id)
        vehicle = MavlinkVehicle(
            drone, self.info.origin, CommandSender(drone.name, source, self.link.put), vehicle_options
        )

        def on_received(received: Received) -> None:
            vehicle.on_message(received, time.monotonic_ns())
            served.flush()

        peers = (
            (options.gcs_local + index, options.gcs),
            (options.api_local + index, (options.api[0], options.api[1] + index)),
        )
        ports = [VehiclePort((options.listen, port), peer, self._signing, on_received) for port, peer in peers]
        served = ServedVehicle(vehicle, ports, Link(system_id, COMPONENT_AUTOPILOT, self._signing, options.version))
        return served

    async def open(self, stack: contextlib.AsyncExitStack) -> None:
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        options, last = self.options, len(self._served) - 1
        for served in self._served.values():
            for port in served.ports:
                stack.callback(port.close)
                port.open()
        stack.callback(self._requests.shutdown, wait=False, cancel_futures=True)
        for purpose, (host, port), local, step in (
            ("ground station", options.gcs, options.gcs_local, 0),
            ("programs", options.api, options.api_local, last),
        ):
            remote_ports = f"{port} to {port + step}" if step else f"{port}"
            local_ports = f"{local} to {local + last}" if last else f"{local}"
            self.say(f"{purpose}: UDP {host}:{remote_ports}, from {options.listen}:{local_ports}")
        stack.callback(asyncio.create_task(self._tick_forever()).cancel)

    async def on_arrivals(self, intake: TrafficIntake) -> None:
        """Process what has arrived, but only the newest message on each of a drone's keys."""
        newest: dict[str, bytes] = {}
        for batch in intake.arrivals():
            for key, payload in batch:
                if key in self._routes:
                    newest[key] = payload
                else:
                    self.on_run(key, payload)
        updated: dict[str, ServedVehicle] = {}
        for key, payload in newest.items():
            message = self.try_decode(key, payload)
            if message is not None:
                drone, name = self._routes[key]
                self._served[drone].vehicle.state.update(name, message)
                if name == "status":
                    updated[drone] = self._served[drone]
        for served in updated.values():
            served.vehicle.step()
            self.report_mission(served.vehicle)
            served.flush()
            await asyncio.sleep(0)  # let setpoints that have arrived meanwhile go first

    def report_mission(self, vehicle: MavlinkVehicle) -> None:
        """Report the progress of a mission to the world, for the run's record; gates do not wait for this."""
        for report in vehicle.flight.mission.reports:
            args = {"drone": vehicle.name, **report._asdict()}
            self._requests.submit(self.link.request, keys.CONTROL, "mission", self.observer.name, args, REPLY_TIMEOUT_S)
        vehicle.flight.mission.reports.clear()

    def on_event(self, event: Event) -> None:
        for served in self._served.values():
            served.vehicle.monitor.on_event(event)

    async def _tick_forever(self) -> None:
        while True:
            if self._signing:
                self._signing.advance(time.time())
            for drone, served in self._served.items():
                served.vehicle.tick(time.monotonic_ns())
                served.flush()
                for reason, count in served.refused().items():
                    counter_key = f"{drone} {reason}"
                    previous = self._refused_counts[counter_key]
                    if count and not previous:
                        self.say(f"{drone}: {REASONS[reason]}; counted from now on")
                    self._refused_counts[counter_key] = count
                    self.observer.health.refused += count - previous
            await asyncio.sleep(TICK_S)


class ServedVehicle:
    """A vehicle and its ports, which share one series of sequence numbers."""

    def __init__(self, vehicle: MavlinkVehicle, ports: "Sequence[VehiclePort]", link: Link) -> None:
        self.vehicle = vehicle
        self.ports = ports
        self.link = link
        self._unsent = 0

    def flush(self) -> None:
        self.send(self.vehicle.take())

    def send(self, messages: Sequence[WireMessage]) -> None:
        """Send messages to all peers, several per datagram; messages that cannot be encoded are only counted."""
        datagrams: list[bytes] = []
        for message in messages:
            try:
                frame = self.link.pack(message)
            except (struct.error, OverflowError, ValueError):
                self._unsent += 1
                continue
            if datagrams and len(datagrams[-1]) + len(frame) <= DATAGRAM_MAX:
                datagrams[-1] += frame
            else:
                datagrams.append(frame)
        for port in self.ports:
            port.send(datagrams)

    def refused(self) -> Counter[str]:
        counts = Counter({"unsent": self._unsent})
        for port in self.ports:
            counts += port.parser.refused
            counts["stranger"] += port.peers.refused
        return counts


class VehiclePort:
    """One UDP port, which sends to `peer` even before `peer` has sent anything.

    Raises:
        RunError: the port cannot be opened.
    """

    def __init__(
        self, local: Address, peer: Address, signing: Signing | None, on_received: Callable[[Received], Any]
    ) -> None:
        family = socket.AF_INET6 if ":" in local[0] else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(local)
        except OSError as error:
            self._socket.close()
            is_unavailable = error.errno in (errno.EADDRINUSE, errno.EACCES)  # in use, or reserved by the system
            advice = (
                "other ports with --gcs-local and --api-local"
                if is_unavailable
                else "an address of this host with --listen"
            )
            raise RunError(f"UDP {local[0]}:{local[1]} cannot be opened ({error.strerror}); give {advice}") from error
        self._on_received = on_received
        self.peers = Peers(peer)
        self.parser = Parser(signing)

    def open(self) -> None:
        asyncio.get_running_loop().add_reader(self._socket.fileno(), self._read)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._socket.fileno())
        self._socket.close()

    def send(self, datagrams: Sequence[bytes]) -> None:
        """Send to all peers; datagrams that do not fit into the buffer are lost, as on a radio link."""
        for address in self.peers.addresses(time.monotonic()) if datagrams else ():
            for datagram in datagrams:
                with contextlib.suppress(OSError):  # nobody listens, no route, or a full buffer
                    self._socket.sendto(datagram, address)

    def _read(self) -> None:
        for _ in range(READS_MAX):
            try:
                data, address = self._socket.recvfrom(READ_MAX)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                continue  # an earlier datagram could not be delivered
            if self.peers.accepts(address, time.monotonic()):
                for received in self.parser.feed(data):
                    self._on_received(received)


class Peers:
    """The peers of one port: the configured one, and programs on this machine that send to the port.

    Attributes:
        refused: number of datagrams from other senders.
    """

    def __init__(self, configured: Address) -> None:
        self._configured = configured
        self._learnt: dict[Address, float] = {}
        self.refused = 0

    def accepts(self, address: Address, wall_s: float) -> bool:
        """Return whether datagrams from an address are accepted; programs on this machine become peers."""
        if address == self._configured:
            return True
        is_known = address in self._learnt
        if not is_loopback(address[0]) or (not is_known and len(self._learnt) >= LEARNT_PEERS_MAX):
            self.refused += 1
            return False
        self._learnt[address] = wall_s
        return True

    def addresses(self, wall_s: float) -> list[Address]:
        self._learnt = {
            address: last_s for address, last_s in self._learnt.items() if wall_s - last_s <= PEER_TIMEOUT_S
        }
        return [self._configured, *self._learnt]
