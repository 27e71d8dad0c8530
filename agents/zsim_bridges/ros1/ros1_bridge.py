"""The bridge as a process: one run's drones in the graph of a ROS 1 master; it commands, and never gates."""

import asyncio
import contextlib
from collections.abc import Callable

from zsim.contract import keys
from zsim.contract.flight_messages import CameraImage, CameraInfo
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.errors import RunError
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import Session
from zsim_bridges import ros_messages as ros
from zsim_bridges.ros1.drone_topics import QUEUE, DroneTopics, ros1_name, ros_time
from zsim_bridges.ros1.node import Ros1Node
from zsim_bridges.vehicle_links import drone_link
from zsim_bridges.vehicle_links.server import PictureIntake, Say, TrafficIntake, VehicleServer


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
    """Serve one run until it is over, or `stopped` returns True.

    Args:
        master_uri: of the ROS master.
        host: name or address under which ROS nodes reach this host.

    Raises:
        NodeShutdownError: ROS asked this node to stop.
        RunError: two drones have the same name in ROS.
    """
    drone_link.warm_up()
    node = Ros1Node(f"/{ros1_name(info.federation)}", master_uri, host, say)
    bridge = Ros1Bridge(link, info, observer, node, say)
    asyncio.run(bridge.run(lambda: stopped() or bool(node.shutdown_reason)))
    if node.shutdown_reason:
        observer.leave(node.shutdown_reason)
        raise NodeShutdownError(f"{observer.name}: {node.shutdown_reason}")


class Ros1Bridge(VehicleServer):
    """One run in one ROS graph.

    Raises:
        RunError: two drones have the same name in ROS.
    """

    def __init__(self, link: Session, info: Info, observer: Participant, node: Ros1Node, say: Say) -> None:
        super().__init__(link, info, observer, say, options=None)
        self._node = node
        drone_of: dict[str, str] = {}
        for drone in info.drones:
            name = ros1_name(drone.name)
            if name in drone_of:
                raise RunError(f"drones {drone_of[name]!r} and {drone.name!r} are both {name!r} in ROS; rename one")
            drone_of[name] = drone.name
        self._clock = node.publish("/clock", "rosgraph_msgs/Clock", QUEUE)
        tf = node.publish("/tf", "tf2_msgs/TFMessage", QUEUE * len(info.drones))
        drones = scenario_file.from_text(info.scenario).drones
        self._drones = {drone.name: DroneTopics(node, drone, observer.name, link.put, tf) for drone in drones}

    async def open(self, stack: contextlib.AsyncExitStack) -> None:
        for sample in self.link.get(keys.camera_info("*", "*")):
            self.forward(sample.key, sample.payload)
        self._pictures = PictureIntake(self.link, asyncio.get_running_loop(), self.forward)
        stack.callback(self._pictures.follow, ())
        await stack.enter_async_context(self._node.running())

    async def on_arrivals(self, intake: TrafficIntake) -> None:
        for arrived in intake.arrivals():
            for key, payload in arrived:
                self.forward(key, payload)
            await asyncio.sleep(0)  # other tasks run
        self._pictures.follow(self.wanted_pictures())

    def wanted_pictures(self) -> list[str]:
        """Return the keys of the cameras that some node subscribes to."""
        return [keys.camera(name, camera) for name, drone in self._drones.items() for camera in drone.cameras.wanted()]

    def forward(self, key: str, payload: bytes) -> None:
        """Convert and publish a message that has passed the world."""
        kind, thing, leaf = keys.parts(key)
        if key == keys.CLOCK:
            clock = self.observer.update_clock(payload)
            if clock is not None:
                self._clock.publish(lambda _: ros.Clock(ros_time(clock.t_ns)))
        elif not (kind == "drone" and thing in self._drones):
            self.on_run(key, payload)
        elif not leaf.startswith("cmd/"):
            message, drone = self.decoded(key, payload), self._drones[thing]
            if isinstance(message, CameraImage):
                drone.cameras.publish(keys.leaf(key), message)
            elif isinstance(message, CameraInfo):
                drone.cameras.learn(leaf.split("/")[1], message)
            elif message is not None:
                try:
                    drone.publish(message)
                except (ValueError, ArithmeticError) as error:  # finite, but beyond what a field of ROS can hold
                    self.refuse(f"{key}: {error}")

    def on_event(self, event: Event) -> None:
        """Print which commands of ROS nodes the world refuses."""
        if (event.kind, event.source) == ("refused", self.observer.name):
            self.say_once(f"{event.subject}: {event.data.get('reason', event.text)}")
