"""`zsim ardrone serve`: the drones of a run as AR.Drones, each on an address of its own."""

import asyncio
import contextlib
import errno
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import NamedTuple

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.errors import RunError, install_command
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Drone
from zsim.transport.session import Session
from zsim_bridges.ardrone import at_commands, configuration, navdata, ports, video
from zsim_bridges.ardrone.aircraft import Aircraft, Outlets
from zsim_bridges.ardrone.ports import (
    Address,
    AllowedHosts,
    DatagramPort,
    FileServer,
    StreamPort,
    drone_addresses,
    read_until_end,
)
from zsim_bridges.ardrone.video import VideoServer
from zsim_bridges.vehicle_links import drone_link
from zsim_bridges.vehicle_links.server import PictureIntake, Say, TrafficIntake, VehicleServer

AUTHENTICATION_PORT = 5552  # UDP, where programs look for drones (ARDroneLib, config.h)
QUESTION, ANSWER = b"PARROT AUTH", b"PARROT AUTH OK"  # ARDroneLib, ardrone_auth.c
NOT_PERMITTED = (errno.EACCES, errno.EPERM)  # a port below 1024 needs a privilege


class ArdroneOptions(NamedTuple):
    """How the drones are offered: see `drone_addresses`; `peers` are obeyed on addresses that are not loopback."""

    addresses: str
    peers: frozenset[str]
    rate: float | None


class ArdroneServer(VehicleServer):
    """One run's drones as AR.Drones.

    Raises:
        RunError: an address is none, or may not be offered.
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
        self._pictures = PictureIntake(self.link, asyncio.get_running_loop(), self._stream)
        for name, drone in self._drones.items():
            stack.push_async_callback(drone.close)
            for line in await drone.open():
                self.say(line)
            self.say(f"{name} is an AR.Drone 2.0 at {drone.address}")
        stack.callback(self._pictures.follow, ())

    async def on_arrivals(self, intake: TrafficIntake) -> None:
        for arrived in intake.arrivals():
            for key, payload in arrived:
                self.forward(key, payload)
                if keys.is_status(key):  # a gate of a fleet takes long: what pilots send meanwhile comes first
                    await asyncio.sleep(0)
            await asyncio.sleep(0)
        self._pictures.follow(self.wanted_pictures())

    def wanted_pictures(self) -> Iterator[str]:
        """Yield the keys of the cameras for whose pictures somebody is connected."""
        for name, drone in self._drones.items():
            if drone.video.is_watched:
                if self._has_encoder:
                    yield keys.camera(name, drone.aircraft.camera)
                else:
                    advice = install_command(["video"])
                    self.say_once(f"video: av is not installed, no pictures are streamed; {advice}")

    def forward(self, key: str, payload: bytes) -> None:
        kind, thing, leaf = keys.parts(key)
        # an aircraft's electronics know sensors, the estimate, and how fast the rotors turn
        is_onboard = leaf.startswith("sensor/") or leaf in ("estimate", "truth")
        if not (kind == "drone" and thing in self._drones and is_onboard):
            self.on_run(key, payload)
            return
        message = self.decoded(key, payload)
        if message is not None:
            try:
                self._drones[thing].aircraft.update(message)
            except (ValueError, ArithmeticError) as error:  # finite, but beyond what a field of navdata can hold
                self.refuse(f"{key}: {error}")

    def _stream(self, key: str, payload: bytes) -> None:
        image = self.decoded(key, payload)
        drone = self._drones.get(keys.thing(key))
        if image is not None and drone is not None and keys.leaf(key) == drone.aircraft.camera:
            drone.video.on_picture(image)

    def on_event(self, event: Event) -> None:
        """Count and print which commands of pilots' programs the world refuses."""
        if (event.kind, event.source) != ("refused", self.observer.name):
            return
        _, thing, what = keys.parts(event.subject)
        drone = self._drones.get(thing)
        is_overtaken = what != "cmd/mode" and drone is not None and drone.aircraft.pilot.setpoint is None
        if not is_overtaken:  # a setpoint of the gate in which the pilot lands the drone says nothing
            self.refuse(f"{event.subject}: {event.data.get('reason', event.text)}")


class DroneServer:
    """The ports of one drone on its address, and the aircraft behind them."""

    def __init__(self, drone: Drone, address: str, peers: AllowedHosts, server: ArdroneServer) -> None:
        self.address = address
        self._name = drone.name
        self._refuse: Callable[[str], None] = lambda reason: server.refuse(f"{drone.name}: {reason}")
        self._navdata = DatagramPort(peers, lambda *asked: self.aircraft.on_navdata_request(*asked), self._refuse)
        commands = DatagramPort(peers, lambda datagram, _: self.aircraft.on_at(datagram), self._refuse)
        self._authentication = DatagramPort(peers, self._on_question, self._refuse)
        self._control = StreamPort(peers, read_until_end, self._refuse)
        outlets = Outlets(server.link.put, self._navdata.send, self._control.broadcast, server.refuse)
        self.aircraft = Aircraft(drone, server.observer.name, server.info.gate_ns, outlets)
        self.video = VideoServer(peers, self._refuse)
        version = FileServer(address, peers, ports.VERSION_FILES, self._refuse)
        self._files = FileServer(address, peers, {}, self._refuse).port
        self._ports: tuple[tuple[DatagramPort | StreamPort, str, int], ...] = (
            (self._navdata, "UDP", navdata.PORT),
            (commands, "UDP", at_commands.PORT),
            (self._authentication, "UDP", AUTHENTICATION_PORT),
            (self._control, "TCP", configuration.PORT),
            (self.video.port, "TCP", video.PORT),
            (version.port, "TCP", ports.VERSION_PORT),
        )

    async def open(self) -> list[str]:
        """Open all ports; return a line for each optional one that is left out.

        Raises:
            RunError: a port is taken, or the address is not this host's.
        """
        for opened, kind, port in self._ports:
            try:
                await opened.open(self.address, port)
            except OSError as error:
                why = {
                    errno.EADDRINUSE: "another program has it; end that, or give other --addresses",
                    errno.EADDRNOTAVAIL: "the address is not this host's; give one that is, as --addresses",
                }.get(error.errno or 0, error.strerror or str(error))
                raise RunError(f"{self._name}: {kind} port {port} of {self.address} cannot be had: {why}") from error
        try:  # few programs use it, and it needs a privilege
            await self._files.open(self.address, ports.FILES_PORT)
        except OSError as error:
            why = "needs a privilege" if error.errno in NOT_PERMITTED else error.strerror
            return [f"{self._name}: TCP port {ports.FILES_PORT} is left out ({why}); ps_drone looks there"]
        return []

    async def close(self) -> None:
        self.video.close()
        for opened, _, _ in self._ports:
            await opened.close()
        await self._files.close()

    def _on_question(self, datagram: bytes, address: Address) -> None:
        if datagram.startswith(QUESTION):
            self._authentication.send(ANSWER, address)
        else:
            self._refuse("a datagram on the authentication port is not a PARROT AUTH")
