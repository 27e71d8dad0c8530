"""The process: one run's drones as MAVLink vehicles; it commands, and never gates."""

import asyncio
import contextlib
import hashlib
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.errors import DecodeError, RunError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Drone
from zsim.transport.session import Session
from zsim_bridges.intake import TrafficIntake
from zsim_bridges.mavlink.autopilot.enums import COMPONENT_AUTOPILOT
from zsim_bridges.mavlink.autopilot.personality import PERSONALITIES
from zsim_bridges.mavlink.serve.peers import Address
from zsim_bridges.mavlink.serve.vehicle_ports import VehiclePort, VehiclePorts
from zsim_bridges.mavlink.telemetry.telemetry import Level
from zsim_bridges.mavlink.vehicle.mavlink_vehicle import MavlinkVehicle, Options
from zsim_bridges.mavlink.wire.frame import Link, Received, Version
from zsim_bridges.mavlink.wire.signing import Signing
from zsim_bridges.vehicle_links.command_sender import CommandSender
from zsim_bridges.vehicle_links.run_pace import set_pace

POLL_S = 0.1  # how often a stop is looked for
ANSWER_S = 1.0  # wall time for which an answer of the world is waited for, aside from the traffic
TICK_S = 0.1  # wall time between two looks at what wall time brings
SWITCH_S = 5e-4  # s after which the thread that takes in a gate lets a setpoint pass; Python's own is 5 ms
SYSTEM_IDS = 254  # 255 is the ground station's by custom
Say = Callable[[str], None]


class MavlinkOptions(NamedTuple):
    """How the drones are offered.

    Attributes:
        autopilot: whose modes and parameters they have.
        level: of the rates of telemetry.
        listen: address on which the ports are opened.
        gcs, gcs_local: the ground station, and the first port that talks with it.
        api, api_local: the first of the programs' ports, and the first port that talks with them.
        key: of signatures; None for none.
        version: of MAVLink in what is sent.
        rate: pace that is asked of a run as fast as possible; None for none.
        first_system_id: of the first drone; +1 each.
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


def serve(
    link: Session,
    info: Info,
    observer: Participant,
    stopped: Callable[[], bool],
    say: Say,
    options: MavlinkOptions,
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
        RunError: the run keeps no pace, has too many drones, or a port cannot be opened.
    """
    set_pace(link, info, observer.name, options.rate)
    sys.setswitchinterval(SWITCH_S)
    server = MavlinkServer(link, info, observer, say, options)
    asyncio.run(server.run(stopped))


class Served(NamedTuple):
    """A vehicle and its ports."""

    vehicle: MavlinkVehicle
    ports: VehiclePorts


class MavlinkServer:
    """One run on UDP."""

    def __init__(self, link: Session, info: Info, observer: Participant, say: Say, options: MavlinkOptions) -> None:
        self._link = link
        self._info = info
        self._observer = observer
        self._say = say
        self._options = options
        self._signing = Signing(options.key) if options.key else None
        self._counted: dict[str, int] = {}
        self._requests = ThreadPoolExecutor(1)  # one after the other
        drones = scenario_file.from_text(info.scenario).drones
        first = options.first_system_id
        if first + len(drones) - 1 > SYSTEM_IDS:
            allowed = f"MAVLink has {SYSTEM_IDS} system ids, of which --first-system-id is {first}"
            raise RunError(f"{observer.name}: the run has {len(drones)} drones; {allowed}")
        self._served = {drone.name: self._offer(i, drone) for i, drone in enumerate(drones)}
        self._routes = {key: route for drone in self._served for key, route in _routes(drone)}

    def _offer(self, index: int, drone: Drone) -> Served:
        options, system_id = self._options, self._options.first_system_id + index
        sender = CommandSender(drone.name, self._observer.name, self._link.put)
        shown = Options(
            system_id, PERSONALITIES[options.autopilot], options.level, self._observer.name, self._unique_id(drone)
        )
        vehicle = MavlinkVehicle(drone, self._info.origin, sender, shown)

        def on_received(received: Received) -> None:
            vehicle.on_message(received, time.monotonic_ns())
            self._flush(served)

        ports = [
            VehiclePort((options.listen, port), peer, self._signing, on_received)
            for port, peer in (
                (options.gcs_local + index, options.gcs),
                (options.api_local + index, (options.api[0], options.api[1] + index)),
            )
        ]
        packer = Link(system_id, COMPONENT_AUTOPILOT, self._signing, options.version)
        served = Served(vehicle, VehiclePorts(ports, packer))
        return served

    def _unique_id(self, drone: Drone) -> int:
        """Return the 64 bits by which programs know a vehicle again: those of no other run are equal."""
        return int.from_bytes(hashlib.sha256(f"{self._info.run_id}/{drone.name}".encode()).digest()[:8])

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Serve until the run is over or a stop is requested."""
        loop = asyncio.get_running_loop()
        intake = TrafficIntake(self._link, self._info, self._observer.health, loop)
        for served in self._served.values():
            served.ports.open(loop, time.monotonic)
        self._announce()
        ticking = loop.create_task(self._tick_always())
        try:
            while not (stopped() or self._observer.end_reason):
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(intake.news.wait(), POLL_S)
                await self._take_in(intake)
                self._observer.tick()
        finally:
            ticking.cancel()
            self._requests.shutdown(wait=False, cancel_futures=True)
            intake.close()
            for served in self._served.values():
                served.ports.close(loop)

    def _announce(self) -> None:
        options, last = self._options, len(self._served) - 1
        for what, (host, port), local, step in (
            ("ground station", options.gcs, options.gcs_local, 0),
            ("programs", options.api, options.api_local, last),
        ):
            to = f"{port}" if not step else f"{port} to {port + step}"
            own = f"{local}" if not last else f"{local} to {local + last}"
            self._say(f"{self._observer.name}: {what}: UDP {host}:{to}, from {options.listen}:{own}")

    async def _take_in(self, intake: TrafficIntake) -> None:
        """Take in what has come; of a drone's messages the newest of each."""
        newest: dict[str, bytes] = {}
        for arrived in intake.arrivals():
            for key, payload in arrived:
                if key in self._routes:
                    newest[key] = payload
                elif key == keys.CLOCK:
                    self._observer.update_clock(payload)
                elif key == keys.EVENT:
                    self._on_event(payload)
        for served in self._updated(newest):
            served.vehicle.step()
            self._report_mission(served)
            self._flush(served)
            await asyncio.sleep(0)  # setpoints that have come meanwhile go first

    def _report_mission(self, served: Served) -> None:
        """Let the world know how far a mission was flown, so that the record has it; no gate waits for it."""
        vehicle = served.vehicle
        for report in vehicle.flight.mission.reports:
            args = {"drone": vehicle.name, **report._asdict()}
            self._requests.submit(self._link.request, keys.CONTROL, "mission", self._observer.name, args, ANSWER_S)
        vehicle.flight.mission.reports.clear()

    def _updated(self, newest: dict[str, bytes]) -> list[Served]:
        """Bring the states of the drones up to date; return those that have reached a gate."""
        stepping: dict[str, Served] = {}
        for key, payload in newest.items():
            message = self._decoded(key, payload)
            if message is None:
                continue
            drone, name = self._routes[key]
            served = self._served[drone]
            served.vehicle.state.update(name, message)
            if name == "status":
                stepping[drone] = served
        return list(stepping.values())

    def _decoded(self, key: str, payload: bytes) -> Any:
        try:
            return messages.decode(key, payload)
        except DecodeError:
            self._observer.health.refused += 1
            return None

    def _on_event(self, payload: bytes) -> None:
        event = self._decoded(keys.EVENT, payload)
        if isinstance(event, Event):
            for served in self._served.values():
                served.vehicle.on_event(event)

    async def _tick_always(self) -> None:
        while True:
            if self._signing:
                self._signing.advance(time.time())
            for served in self._served.values():
                served.vehicle.tick(time.monotonic_ns())
                self._flush(served)
            self._count_refused()
            await asyncio.sleep(TICK_S)

    def _flush(self, served: Served) -> None:
        served.ports.send(served.vehicle.take())

    def _count_refused(self) -> None:
        """Count what clients sent and was refused; print each reason once."""
        for drone, served in self._served.items():
            for reason, count in served.ports.refused().items():
                mark = f"{drone} {reason}"
                before = self._counted.get(mark, 0)
                if count and not before:
                    self._say(f"{self._observer.name}: {drone}: {REASONS[reason]}; counted from now on")
                self._counted[mark] = count
                self._observer.health.refused += count - before


REASONS = {
    "bad_crc": "a frame with a wrong checksum",
    "unknown": "a message that is not in the dialect",
    "incompatible": "a frame with flags that are not known",
    "truncated": "a frame that is cut",
    "unsigned": "a frame without a signature",
    "bad_signature": "a frame with a wrong signature",
    "replayed": "a signed frame that was sent before",
    "noise": "bytes that are no frame",
    "unsent": "a message of its own whose values do not fit into their fields",
    "stranger": "a datagram of who is not the configured peer",
}


def _routes(drone: str) -> list[tuple[str, tuple[str, str]]]:
    """Return the keys of a drone that are read, each with the drone and the name of the message."""
    sensors = [(keys.sensor(drone, name), (drone, name)) for name in keys.SENSORS]
    own = (keys.truth(drone), "truth"), (keys.estimate(drone), "estimate"), (keys.status(drone), "status")
    return [*sensors, *((key, (drone, name)) for key, name in own)]
