"""The bridge's parts between the keys and the topics: what is published from what, and what is let go."""

import asyncio
import threading
from typing import Any, cast

import pytest
from fake_link import FakeLink
from ros1_drone import GATE_NS, Drone, Subscriber, scenario, status

from zsim.contract import flight_messages, keys, messages
from zsim.contract.framing import GateMessages, encode_batch, key_table
from zsim.errors import RunError, SessionError
from zsim.runtime.health import HealthMeter
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import ReceivedSample
from zsim_bridges.intake import TrafficIntake
from zsim_bridges.ros1 import tcpros
from zsim_bridges.ros1.node import Ros1Node
from zsim_bridges.ros1.ros1_bridge import Ros1Bridge, check_names

LEVEL, ZERO, STILL = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)


def truth(t_ns: int) -> flight_messages.Truth:
    return flight_messages.Truth(
        t_ns, 0, (1e3, 2e3, 3e3), (4.0, 5.0, 6.0), (0.0, 1.0, 0.0, 0.0), (7.0, 8.0, 9.0), ZERO, STILL
    )


def test_the_namespace_is_the_drone_s_name_as_ros_can_write_it():
    assert "/quad_1/ardrone/navdata" in Drone().node._published
    assert set(Drone().node._subscribed) == {
        f"/quad_1/{topic}" for topic in ("cmd_vel", "ardrone/takeoff", "ardrone/land", "ardrone/reset")
    }
    assert set(Drone().node._services) == {"/quad_1/ardrone/flattrim", "/quad_1/ardrone/togglecam"}


def test_a_gate_is_navdata_odometry_and_transforms():
    drone = Drone()
    subscribers = [drone.subscriber(topic) for topic in ("/quad_1/ardrone/navdata", "/quad_1/ardrone/odometry", "/tf")]
    for gate in range(3):
        drone.deliver(status(gate * GATE_NS))
    assert [len(subscriber.ros_messages) for subscriber in subscribers] == [3, 3, 3]
    assert [message.header.seq for message in subscribers[0].ros_messages] == [0, 1, 2]


def test_truth_is_on_ground_truth_alone():
    """Whatever the truth says, nothing else that is published changes with it."""
    topics = ["navdata", "odometry", "imu", "mag"]
    ros_messages: list[list[Any]] = []
    for whole in (False, True):
        drone = Drone()
        subscribers = [
            *(drone.subscriber(f"/quad_1/ardrone/{topic}") for topic in topics),
            drone.subscriber("/tf"),
            drone.subscriber("/quad_1/fix"),
        ]
        ground_truth = drone.subscriber("/quad_1/ground_truth/state")
        for gate in range(1, 5):
            t_ns = gate * GATE_NS
            drone.deliver(messages.Imu(t_ns, gate, t_ns, (0.0, 0.0, 9.8), (0.1, 0.0, 0.0)))
            drone.deliver(messages.Mag(t_ns, gate, t_ns, (1.0, 2.0, 3.0)))
            drone.deliver(messages.Flow(t_ns, gate, t_ns, (1.0, 0.0, 0.0), 1.0))
            if whole:
                drone.deliver(truth(t_ns))
            drone.deliver(status(t_ns))
        assert len(ground_truth.ros_messages) == (4 if whole else 0)
        ros_messages.append([repr(subscriber.ros_messages) for subscriber in subscribers])
    assert ros_messages[0] == ros_messages[1]


def test_a_take_off_that_a_node_publishes_is_sent_to_the_drone():
    drone = Drone()
    drone.deliver(status(GATE_NS))
    drone.node._subscribed["/quad_1/ardrone/takeoff"]._callback(tcpros.message_class("std_msgs/Empty")())
    ((key, command),) = drone.sent
    assert key == "drone/quad-1/cmd/mode"
    assert (command.mode, command.source, command.t_ns) == ("takeoff", "ros1.main", GATE_NS)
    messages.decode(key, messages.encode(command))


def test_drones_that_ros_cannot_tell_from_each_other_are_refused():
    check_names(["drone1", "drone2"])
    with pytest.raises(RunError, match=r"'quad-1'.*'quad\.1'.*'quad_1'"):
        check_names(["drone1", "quad-1", "quad.1"])


def test_numbers_beyond_the_fields_of_ros_are_refused_and_told_once_and_the_next_are_passed_on():
    command: list[str] = []
    info: Any = messages.Info(
        0, 0, 1, "run", "zsim", "lockstep", 0.0, GATE_NS, 5_000_000, GATE_NS, 1, messages.Origin(0.0, 0.0, 0.0),
        (messages.DroneInfo("quad-1", "ardrone2"),), (), scenario_file.to_text(scenario()), "", "", "",
    )  # fmt: skip
    observer = Participant(cast(Any, FakeLink()), info, "ros1.main")
    node = Ros1Node("/zsim", "http://127.0.0.1:1", "127.0.0.1", command.append)
    bridge = Ros1Bridge(cast(Any, FakeLink()), info, observer, node, command.append)
    navdata = Subscriber(node, "/quad_1/ardrone/navdata")

    def gate(n: int, range_m: float) -> None:
        t_ns = n * GATE_NS
        sonar = messages.Sonar(t_ns, n, t_ns, range_m, True)
        bridge.forward(keys.sensor("quad-1", "sonar"), messages.encode(sonar))
        bridge.forward(keys.status("quad-1"), messages.encode(status(t_ns)))

    gate(1, 1e30)
    gate(2, 1e30)
    bridge.forward(keys.status("quad-1"), b"garbage")
    gate(3, 1.5)
    assert [message.altd for message in navdata.ros_messages] == [1500]
    assert observer.health.refused == 3
    assert len(command) == 1
    assert "drone/quad-1/sensor/status" in command[0]


class Link:
    """A session whose only subscription holds some payloads, and then waits to be closed."""

    def __init__(self, payloads: list[bytes]) -> None:
        self._payloads = iter(payloads)
        self._closed = threading.Event()
        self.emptied = threading.Event()

    def get(self, key: str) -> list[Any]:
        return []

    def subscribe(self, expression: str) -> "Link":
        assert expression == keys.BATCH
        return self

    def receive(self) -> ReceivedSample:
        for payload in self._payloads:
            return ReceivedSample(keys.BATCH, payload)
        self.emptied.set()
        self._closed.wait(10.0)
        raise SessionError("closed")

    def undeclare(self) -> None:
        self._closed.set()


def test_who_is_too_slow_goes_on_with_the_newest_gates(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zsim_bridges.intake.BACKLOG", 3)
    info: Any = type(
        "Info", (), {"drones": [messages.DroneInfo("drone1", "ardrone2")], "own_sensors": (), "sightings": False}
    )()
    table = key_table(["drone1"])

    def payload(gate: int) -> bytes:
        command = [(keys.status("drone1"), messages.encode(status(gate * GATE_NS)))]
        bundle = GateMessages.of(gate * GATE_NS, gate, table, command)
        return encode_batch([(keys.GATE, bundle.pack()), (keys.CLOCK, b"clock %d" % gate)])

    link: Any = Link([payload(gate) for gate in range(5)] + [b"no batch"])

    async def run() -> tuple[list[Any], HealthMeter]:
        health = HealthMeter("ros1")
        intake = TrafficIntake(link, info, health, asyncio.get_running_loop())
        await asyncio.to_thread(link.emptied.wait, 10.0)
        await asyncio.wait_for(intake.news.wait(), 10.0)
        found = list(intake.arrivals())
        intake.close()
        return found, health

    found, health = asyncio.run(run())
    assert [[key for key, _ in command] for command in found] == [[keys.status("drone1"), keys.CLOCK]] * 2
    assert [command[1][1] for command in found] == [b"clock 3", b"clock 4"]
    assert (health.dropped, health.refused, health.received) == (3, 1, 5)
