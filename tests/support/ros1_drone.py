"""A drone's ROS 1 topics without a ROS graph, and subscribers that keep the messages published."""

from typing import Any, cast

import msgspec

from zsim.contract import flight_messages
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_bridges.ros1 import node as wire
from zsim_bridges.ros1.node import Ros1Node
from zsim_bridges.ros1.ros1_bridge import DroneTopics

GATE_NS = 20_000_000
SCENARIO = """
name: one
duration_s: 10
sensors: {preset: paper}
drones: [{name: quad-1, position_m: [0, 0, 0]}]
"""


def scenario() -> Scenario:
    return scenario_file.resolve(msgspec.yaml.decode(SCENARIO.encode()))


class Subscriber:
    """A subscriber that keeps the messages published on a topic."""

    def __init__(self, node: Ros1Node, topic: str) -> None:
        published = node.published[topic]
        self._kind = published.topic_type.type
        self.ros_messages: list[Any] = []
        published.links.append(cast(Any, self))

    def put(self, framed: bytes) -> None:
        self.ros_messages.append(wire.deserialize(self._kind, framed[4:]))


class Drone:
    """A drone's topics without a ROS graph; its commands are kept in `sent`."""

    def __init__(self) -> None:
        self.node = Ros1Node("/zsim", "http://127.0.0.1:1", "127.0.0.1", print)
        self.sent: list[tuple[str, Any]] = []
        (drone,) = scenario().drones
        tf = self.node.publish("/tf", "tf2_msgs/TFMessage", 10)
        self.topics = DroneTopics(
            self.node, drone, "ros1.main", lambda key, command: self.sent.append((key, command)), tf
        )

    def subscriber(self, topic: str) -> Subscriber:
        return Subscriber(self.node, topic)

    def deliver(self, *command: Any) -> None:
        for message in command:
            self.topics.publish(message)


def status(t_ns: int) -> flight_messages.Status:
    return flight_messages.Status(t_ns, 0, "hovering", 90.0, False, None, 1)
