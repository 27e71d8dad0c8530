"""The server as a process: one run's drones as AR.Drones; it commands, and never gates."""

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.contract.messages import Info
from zsim.errors import DecodeError, without_figures
from zsim.extras import install_command
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import Session
from zsim_bridges.ardrone.server.addresses import AllowedHosts, drone_addresses
from zsim_bridges.ardrone.server.drone_server import DroneServer
from zsim_bridges.intake import PictureIntake, TrafficIntake
from zsim_bridges.vehicle_links import onboard_state
from zsim_bridges.vehicle_links.run_pace import set_pace

POLL_S = 0.1  # how often a stop is looked for
REPORTED_MAX = 1000  # texts remembered, so that each is printed once
Say = Callable[[str], None]


class ArdroneOptions(NamedTuple):
    """How the drones are offered.

    Attributes:
        addresses: see `drone_addresses`.
        peers: addresses of hosts that are obeyed on addresses that are not loopback.
        rate: simulated per wall second, to be set; None leaves the run's.
    """

    addresses: str
    peers: frozenset[str]
    rate: float | None


def serve(
    link: Session, info: Info, observer: Participant, stopped: Callable[[], bool], say: Say, options: ArdroneOptions
) -> None:
    """Serve one run until it is over.

    Args:
        link: an open session.
        info: of the run.
        observer: of this process in it.
        stopped: called now and then; True ends the run.
        say: prints a line.
        options: how the drones are offered.

    Raises:
        RunError: the run has no pace, or an address cannot be had.
    """
    set_pace(link, info, observer.name, options.rate)
    onboard_state.warm_up()
    asyncio.run(ArdroneServer(link, info, observer, say, options).run(stopped))


class ArdroneServer:
    """One run's drones."""

    def __init__(self, link: Session, info: Info, observer: Participant, say: Say, options: ArdroneOptions) -> None:
        self._link = link
        self._info = info
        self._observer = observer
        self._say = say
        self._reported: set[str] = set()
        addresses = drone_addresses(options.addresses, [drone.name for drone in info.drones])
        drones = {drone.name: drone for drone in scenario_file.from_text(info.scenario).drones}
        self._drones = {
            name: DroneServer(
                drones[name],
                address,
                AllowedHosts(address, options.peers),
                observer.name,
                info.gate_ns,
                link.put,
                self._refuse,
            )
            for name, address in addresses.items()
        }
        self._has_encoder = find_spec("av") is not None

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Forward messages both ways until the run is over or a stop is requested."""
        loop = asyncio.get_running_loop()
        pictures = PictureIntake(self._link, loop, self._stream)
        async with contextlib.AsyncExitStack() as stack:
            for name, drone in self._drones.items():
                stack.push_async_callback(drone.close)
                for line in await drone.open():
                    self._say(f"{self._observer.name}: {line}")
                self._say(f"{self._observer.name}: {name} is an AR.Drone 2.0 at {drone.address}")
            intake = TrafficIntake(self._link, self._info, self._observer.health, loop)
            stack.callback(intake.close)
            stack.callback(pictures.follow, ())
            while not (stopped() or self._observer.end_reason):
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(intake.news.wait(), POLL_S)
                await self._forward_all(intake)
                pictures.follow(self._wanted_pictures())
                self._observer.tick()

    def _wanted_pictures(self) -> Iterator[str]:
        """Yield the keys of the cameras whose pictures somebody is connected for."""
        for name, drone in self._drones.items():
            if drone.video.is_watched and self._can_stream():
                yield keys.camera(name, drone.aircraft.camera)

    def _can_stream(self) -> bool:
        if not self._has_encoder:
            self._report(f"video: av is not installed, no pictures are streamed; {install_command(['video'])}")
        return self._has_encoder

    async def _forward_all(self, intake: TrafficIntake) -> None:
        for arrived in intake.arrivals():
            for key, payload in arrived:
                self.forward(key, payload)
                if keys.is_status(key):  # a gate of a fleet takes long: what pilots send meanwhile comes first
                    await asyncio.sleep(0)
            await asyncio.sleep(0)

    def forward(self, key: str, payload: bytes) -> None:
        """Hand a message that has passed the world to its aircraft."""
        kind, thing, leaf = keys.parts(key)
        if key == keys.CLOCK:
            self._observer.update_clock(payload)
        elif key == keys.EVENT:
            self._on_event(payload)
        elif kind == "drone" and thing in self._drones and is_onboard(leaf):
            message = self._decoded(key, payload)
            if message is not None:
                self._update(thing, key, message)

    def _update(self, drone: str, key: str, message: Any) -> None:
        try:
            self._drones[drone].aircraft.update(message)
        except (ValueError, ArithmeticError) as error:  # finite, but beyond what a field of navdata can hold
            self._refuse(f"{key}: {error}")

    def _stream(self, key: str, payload: bytes) -> None:
        image = self._decoded(key, payload)
        drone = self._drones.get(keys.thing(key))
        if image is not None and drone is not None and keys.leaf(key) == drone.aircraft.camera:
            drone.video.on_picture(image)

    def _decoded(self, key: str, payload: bytes) -> Any:
        try:
            return messages.decode(key, payload)
        except DecodeError:
            self._observer.health.refused += 1
            return None

    def _on_event(self, payload: bytes) -> None:
        """Count and print which commands of pilots' programs the world refuses."""
        event = self._decoded(keys.EVENT, payload)
        if event is None or (event.kind, event.source) != ("refused", self._observer.name):
            return
        _, thing, what = keys.parts(event.subject)
        drone = self._drones.get(thing)
        is_overtaken = what != "cmd/mode" and drone is not None and not drone.aircraft.is_steered
        if not is_overtaken:  # a setpoint of the gate in which the pilot lands the drone says nothing
            self._refuse(f"{event.subject}: {event.data.get('reason', event.text)}")

    def _refuse(self, reason: str) -> None:
        """Count what is not done, and print the reason, once."""
        self._observer.health.refused += 1
        self._report(reason)

    def _report(self, text: str) -> None:
        """Print a text once, whatever its figures."""
        reason = without_figures(text)
        if reason not in self._reported and len(self._reported) < REPORTED_MAX:
            self._reported.add(reason)
            self._say(f"{self._observer.name}: {text}")


def is_onboard(leaf: str) -> bool:
    """Tell whether an aircraft knows what a drone's key carries: sensors, its estimate, how fast its rotors turn."""
    return leaf.startswith("sensor/") or leaf in ("estimate", "truth")
