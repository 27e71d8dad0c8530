"""The bridge as a process: one run's drones in the graph of a ROS 1 master; it commands, and never gates."""

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, CameraInfo
from zsim.contract.messages import Info
from zsim.errors import DecodeError, RunError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import Session
from zsim_bridges.intake import PictureIntake, TrafficIntake
from zsim_bridges.ros1 import driver_messages
from zsim_bridges.ros1.drone_topics import QUEUE, DroneTopics, ros1_name
from zsim_bridges.ros1.node import Ros1Node
from zsim_bridges.vehicle_links import drone_link

POLL_S = 0.1  # how often a stop is looked for
REPORTED_MAX = 1000  # texts remembered, so that each is printed once
Say = Callable[[str], None]


class NodeShutdownError(RunError):
    """A ROS node, or the master, has asked this node to stop."""


def serve(
    link: Session,
    info: Info,
    observer: Participant,
    stopped: Callable[[], bool],
    say: Say,
    master_uri: str,
    host: str,
) -> None:
    """Serve one run until it is over.

    Args:
        link: an open session.
        info: of the run.
        observer: of this process in it.
        stopped: called now and then; True ends the run.
        say: prints a line.
        master_uri: of the ROS master.
        host: name or address under which ROS nodes reach this host.

    Raises:
        NodeShutdownError: ROS asked this node to stop.
        RunError: two drones have the same name in ROS.
    """
    drone_link.warm_up()
    node = Ros1Node(f"/{ros1_name(info.federation)}", master_uri, host, say)
    asyncio.run(Ros1Bridge(link, info, observer, node, say).run(stopped))
    if node.shutdown_reason:
        observer.leave(node.shutdown_reason)
        raise NodeShutdownError(f"{observer.name}: {node.shutdown_reason}")


class Ros1Bridge:
    """One run in one ROS graph."""

    def __init__(self, link: Session, info: Info, observer: Participant, node: Ros1Node, say: Say) -> None:
        self._link = link
        self._info = info
        self._observer = observer
        self._node = node
        self._say = say
        self._reported: set[str] = set()
        self._clock = node.publish("/clock", "rosgraph_msgs/Clock", QUEUE)
        tf = node.publish("/tf", "tf2_msgs/TFMessage", QUEUE * len(info.drones))
        check_names(drone.name for drone in info.drones)
        drones = scenario_file.from_text(info.scenario).drones
        self._drones = {drone.name: DroneTopics(node, drone, observer.name, link.put, tf) for drone in drones}

    async def run(self, stopped: Callable[[], bool]) -> None:
        """Forward messages both ways until the run is over or a stop is requested."""
        for sample in self._link.get(keys.camera_info("*", "*")):
            self.forward(sample.key, sample.payload)
        pictures = PictureIntake(self._link, asyncio.get_running_loop(), self.forward)
        intake = TrafficIntake(self._link, self._info, self._observer.health, asyncio.get_running_loop())
        try:
            async with self._node.running():
                while not (stopped() or self._observer.end_reason or self._node.shutdown_reason):
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(intake.news.wait(), POLL_S)
                    await self._forward_all(intake)
                    pictures.follow(self._wanted_pictures())
                    self._observer.tick()
        finally:
            pictures.follow(())
            intake.close()

    def _wanted_pictures(self) -> Iterator[str]:
        """Yield the keys of the cameras that some node subscribes to."""
        for name, drone in self._drones.items():
            yield from (keys.camera(name, camera) for camera in drone.cameras.wanted())

    async def _forward_all(self, intake: TrafficIntake) -> None:
        for arrived in intake.arrivals():
            for key, payload in arrived:
                self.forward(key, payload)
            await asyncio.sleep(0)  # other tasks run

    def forward(self, key: str, payload: bytes) -> None:
        """Convert and publish a message that has passed the world."""
        kind, thing, leaf = keys.parts(key)
        if key == keys.CLOCK:
            self._on_clock(payload)
        elif key == keys.EVENT:
            self._on_event(payload)
        elif kind == "drone" and thing in self._drones and leaf.startswith("camera/"):
            self._forward_camera(thing, key, payload)
        elif kind == "drone" and thing in self._drones and not leaf.startswith("cmd/"):
            self._publish(thing, key, payload)

    def _forward_camera(self, drone: str, key: str, payload: bytes) -> None:
        """Publish a picture, or keep how a camera sees."""
        message = self._decoded(key, payload)
        cameras = self._drones[drone].cameras
        if isinstance(message, CameraImage):
            cameras.publish(keys.leaf(key), message)
        elif isinstance(message, CameraInfo):
            cameras.learn(keys.parts(key)[2].split("/")[1], message)

    def _publish(self, drone: str, key: str, payload: bytes) -> None:
        message = self._decoded(key, payload)
        if message is None:
            return
        try:
            self._drones[drone].publish(message)
        except (ValueError, ArithmeticError) as error:  # finite, but beyond what a field of ROS can hold
            self._observer.health.refused += 1
            self._report_once(f"{key}: {error}")

    def _decoded(self, key: str, payload: bytes) -> Any:
        try:
            return messages.decode(key, payload)
        except DecodeError:
            self._observer.health.refused += 1
            return None

    def _on_clock(self, payload: bytes) -> None:
        clock = self._observer.update_clock(payload)
        if clock is not None:
            self._clock.publish(lambda _: driver_messages.clock(clock))

    def _on_event(self, payload: bytes) -> None:
        """Print which commands of ROS nodes the world refuses."""
        event = self._decoded(keys.EVENT, payload)
        if event is None or (event.kind, event.source) != ("refused", self._observer.name):
            return
        self._report_once(f"{event.subject}: {event.data.get('reason', event.text)}")

    def _report_once(self, reason: str) -> None:
        """Print a reason, once."""
        if reason not in self._reported and len(self._reported) < REPORTED_MAX:
            self._reported.add(reason)
            self._say(f"{self._observer.name}: {reason}")


def check_names(drones: Iterable[str]) -> None:
    """Refuse drones that would have the same name in ROS.

    Raises:
        RunError: two have the same name in ROS.
    """
    drone_of: dict[str, str] = {}
    for drone in drones:
        name = ros1_name(drone)
        if name in drone_of:
            raise RunError(f"drones {drone_of[name]!r} and {drone!r} are both {name!r} in ROS; rename one")
        drone_of[name] = drone
