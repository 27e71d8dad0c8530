"""The bridge between keys and ROS 1 topics: what it publishes, which pictures it reads, and what it drops."""

import asyncio
import threading
from typing import Any

import numpy as np
import pytest
from fake_link import FakeLink
from ros1_drone import GATE_NS, Drone, Subscriber, scenario, status
from synthetic_pictures import AHEAD, FRONT_P_BK, NO_JPEG, image, info, jpeg

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.framing import GateMessages, encode_batch, key_table
from zsim.errors import RunError, SessionError
from zsim.runtime.membership import HealthMeter
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import RawSample, ReceivedSample
from zsim_bridges.ros1 import node as wire
from zsim_bridges.ros1.node import Ros1Node
from zsim_bridges.ros1.ros1_bridge import Ros1Bridge
from zsim_bridges.vehicle_links.server import IMAGES_QUEUED_MAX, PictureIntake, TrafficIntake

ZERO, STILL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)
OWN, ACTIVE = "/quad_1/ardrone/{}/{}", "/quad_1/ardrone/{}"
IMAGE, INFO = "image_raw/compressed", "camera_info"
FRONT = keys.camera("quad-1", "front")


class Bench:
    """A bridge without a ROS graph."""

    def __init__(self, *drones: str) -> None:
        drone_infos = tuple(messages.DroneInfo(name, "ardrone2") for name in drones or ("quad-1",))
        about = messages.Info(
            0, 0, 1, "run", "zsim", "lockstep", 0.0, GATE_NS, 5_000_000, GATE_NS, 1, messages.Origin(0.0, 0.0, 0.0),
            drone_infos, (), scenario_file.to_text(scenario()), "", "", "",
        )  # fmt: skip
        link: Any = FakeLink()
        self.lines: list[str] = []
        self.observer = Participant(link, about, "ros1.main")
        self.node = Ros1Node("/zsim", "http://127.0.0.1:1", "127.0.0.1", self.lines.append)
        self.bridge = Ros1Bridge(link, about, self.observer, self.node, self.lines.append)


def test_the_namespace_is_the_name_of_the_drone_made_valid_for_ros():
    node = Drone().node
    assert "/quad_1/ardrone/navdata" in node.published
    assert set(node.subscribed) == {
        f"/quad_1/{topic}" for topic in ("cmd_vel", "ardrone/takeoff", "ardrone/land", "ardrone/reset")
    }
    assert set(node.services) == {"/quad_1/ardrone/flattrim", "/quad_1/ardrone/togglecam"}


def test_each_gate_publishes_navdata_odometry_and_transforms():
    drone = Drone()
    subscribers = [drone.subscriber(topic) for topic in ("/quad_1/ardrone/navdata", "/quad_1/ardrone/odometry", "/tf")]
    for gate in range(3):
        drone.deliver(status(gate * GATE_NS))
    assert [len(subscriber.ros_messages) for subscriber in subscribers] == [3, 3, 3]
    assert [message.header.seq for message in subscribers[0].ros_messages] == [0, 1, 2]


def test_the_truth_appears_only_on_the_ground_truth_topic():
    """Nothing else that is published depends on the truth."""
    topics = [
        f"/quad_1/{topic}" for topic in ("ardrone/navdata", "ardrone/odometry", "ardrone/imu", "ardrone/mag", "fix")
    ]
    published: list[list[str]] = []
    for with_truth in (False, True):
        drone = Drone()
        subscribers = [drone.subscriber(topic) for topic in ("/tf", *topics)]
        ground_truth = drone.subscriber("/quad_1/ground_truth/state")
        for gate in range(1, 5):
            t_ns = gate * GATE_NS
            drone.deliver(messages.Imu(t_ns, gate, t_ns, (0.0, 0.0, 9.8), (0.1, 0.0, 0.0)))
            drone.deliver(messages.Mag(t_ns, gate, t_ns, (1.0, 2.0, 3.0)))
            drone.deliver(messages.Flow(t_ns, gate, t_ns, (1.0, 0.0, 0.0), 1.0))
            if with_truth:
                position, velocity, rate = (1e3, 2e3, 3e3), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0)
                drone.deliver(
                    flight_messages.Truth(t_ns, 0, position, velocity, (0.0, 1.0, 0.0, 0.0), rate, ZERO, STILL)
                )
            drone.deliver(status(t_ns))
        assert len(ground_truth.ros_messages) == (4 if with_truth else 0)
        published.append([repr(subscriber.ros_messages) for subscriber in subscribers])
    assert published[0] == published[1]


def test_a_published_take_off_is_sent_to_the_drone():
    drone = Drone()
    drone.deliver(status(GATE_NS))
    drone.node.subscribed["/quad_1/ardrone/takeoff"].callback(wire.message_class("std_msgs/Empty")())
    ((key, command),) = drone.sent
    assert key == "drone/quad-1/cmd/mode"
    assert (command.mode, command.source, command.t_ns) == ("takeoff", "ros1.main", GATE_NS)
    messages.decode(key, messages.encode(command))


def test_drones_with_the_same_name_in_ros_are_refused():
    with pytest.raises(RunError, match=r"'quad-1'.*'quad\.1'.*'quad_1'"):
        Bench("drone1", "quad-1", "quad.1")


def test_the_clock_topic_carries_simulated_time():
    bench = Bench()
    clock = Subscriber(bench.node, "/clock")
    t_ns = 61_040_000_000
    bench.bridge.forward(keys.CLOCK, messages.encode(run_messages.Clock(t_ns, 0, "run", 3052, "running", 1.0)))
    (message,) = clock.ros_messages
    assert (message.clock.sec, message.clock.nanosec) == (61, 40_000_000)


def test_values_out_of_range_for_ros_fields_are_refused_and_reported_once():
    bench = Bench()
    navdata = Subscriber(bench.node, "/quad_1/ardrone/navdata")
    bench.bridge.forward(keys.status("quad-1"), b"garbage")
    for gate, range_m in ((1, 1e30), (2, 1e30), (3, 1.5)):
        t_ns = gate * GATE_NS
        sonar = messages.Sonar(t_ns, gate, t_ns, range_m, True)
        bench.bridge.forward(keys.sensor("quad-1", "sonar"), messages.encode(sonar))
        bench.bridge.forward(keys.status("quad-1"), messages.encode(status(t_ns)))
    assert [message.altd for message in navdata.ros_messages] == [1500]
    assert bench.observer.health.refused == 3
    (line,) = bench.lines
    assert "drone/quad-1/sensor/status" in line


class Link:
    """A session whose only subscription returns the given payloads and then blocks until it is closed."""

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
        self._closed.wait(120.0)
        raise SessionError("closed")

    def undeclare(self) -> None:
        self._closed.set()


def test_a_slow_consumer_continues_with_the_newest_gates(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zsim_bridges.vehicle_links.server.BACKLOG", 3)
    about: Any = type("Info", (), {"drones": [messages.DroneInfo("drone1", "ardrone2")], "sensors_beside": ()})()
    table = key_table(["drone1"])

    def payload(gate: int) -> bytes:
        samples = [(keys.status("drone1"), messages.encode(status(gate * GATE_NS)))]
        bundle = GateMessages.of(gate * GATE_NS, gate, table, samples)
        return encode_batch([(keys.GATE, bundle.pack()), (keys.CLOCK, b"clock %d" % gate)])

    link: Any = Link([payload(gate) for gate in range(5)] + [b"no batch"])

    async def run() -> tuple[list[Any], HealthMeter]:
        health = HealthMeter("ros1")
        intake = TrafficIntake(link, about, health, asyncio.get_running_loop())
        await asyncio.to_thread(link.emptied.wait, 120.0)
        await asyncio.wait_for(intake.arrival_event.wait(), 120.0)
        found = list(intake.arrivals())
        intake.close()
        return found, health

    found, health = asyncio.run(run())
    assert [[key for key, _ in samples] for samples in found] == [[keys.status("drone1"), keys.CLOCK]] * 2
    assert [samples[1][1] for samples in found] == [b"clock 3", b"clock 4"]
    assert (health.dropped, health.refused, health.received) == (3, 1, 5)


# Cameras


def picture_subscribers(drone: Drone) -> dict[str, Subscriber]:
    """Return a subscriber for every camera topic."""
    topics = [OWN.format(camera, leaf) for camera in ("front", "bottom") for leaf in (IMAGE, INFO)]
    return {topic: drone.subscriber(topic) for topic in [*topics, ACTIVE.format(IMAGE), ACTIVE.format(INFO)]}


def test_a_picture_is_published_on_its_camera_s_and_on_the_active_topic() -> None:
    drone = Drone()
    subscribers = picture_subscribers(drone)
    drone.topics.cameras.publish("front", image(GATE_NS))
    counts = {topic: len(s.ros_messages) for topic, s in subscribers.items() if s.ros_messages}
    assert counts == {OWN.format("front", IMAGE): 1, ACTIVE.format(IMAGE): 1}
    (got,) = subscribers[OWN.format("front", IMAGE)].ros_messages
    assert (got.header.stamp.sec, got.header.stamp.nanosec) == (0, 16_000_000)  # the time of exposure
    assert (got.header.frame_id, got.format) == ("quad_1/ardrone_base_frontcam", "jpeg")
    assert bytes(got.data) == jpeg()


def test_togglecam_switches_the_active_camera_back_and_forth() -> None:
    drone = Drone()
    subscribers = picture_subscribers(drone)
    for _ in range(2):
        assert drone.node.services["/quad_1/ardrone/togglecam"].action() is None
        for camera in ("front", "bottom"):
            drone.topics.cameras.publish(camera, image(0))
    frames = [message.header.frame_id for message in subscribers[ACTIVE.format(IMAGE)].ros_messages]
    assert frames == ["quad_1/ardrone_base_bottomcam", "quad_1/ardrone_base_frontcam"]


def test_camera_info_comes_with_each_picture_and_its_stamp() -> None:
    drone = Drone()
    subscribers = picture_subscribers(drone)
    drone.topics.cameras.store_info("front", info())
    for number in (1, 2):
        drone.topics.cameras.publish("front", image(number * GATE_NS))
    got = subscribers[OWN.format("front", INFO)].ros_messages
    images = subscribers[OWN.format("front", IMAGE)].ros_messages
    assert [m.header.stamp for m in got] == [m.header.stamp for m in images]
    assert (got[0].width, got[0].height, got[0].distortion_model) == (info().width, info().height, "plumb_bob")
    assert (tuple(got[0].K), tuple(got[0].D)) == (info().K, info().D)
    np.testing.assert_array_equal(got[0].P.reshape(3, 4)[:, :3], np.reshape(info().K, (3, 3)))
    np.testing.assert_array_equal(got[0].P.reshape(3, 4)[:, 3], np.zeros(3))


def test_the_cameras_are_in_the_frame_tree() -> None:
    drone = Drone()
    tf = drone.subscriber("/tf")
    drone.topics.cameras.store_info("front", info())
    drone.deliver(status(0))
    (found,) = [t for t in tf.ros_messages[0].transforms if t.child_frame_id == "quad_1/ardrone_base_frontcam"]
    assert found.header.frame_id == "quad_1/ardrone_base_link"
    moved, turned = found.transform.translation, found.transform.rotation
    assert (moved.x, moved.y, moved.z) == FRONT_P_BK
    assert (turned.w, turned.x, turned.y, turned.z) == AHEAD


@pytest.mark.parametrize(
    ("topic", "wanted"),
    [
        (OWN.format("front", IMAGE), ["front"]),
        (OWN.format("bottom", INFO), ["bottom"]),
        (ACTIVE.format(IMAGE), ["front"]),
        ("/quad_1/ardrone/imu", []),
    ],
)
def test_a_camera_is_read_only_while_one_of_its_topics_is_subscribed_to(topic: str, wanted: list[str]) -> None:
    bench = Bench()
    assert bench.bridge.watched_cameras() == []
    Subscriber(bench.node, topic)
    assert bench.bridge.watched_cameras() == [keys.camera("quad-1", camera) for camera in wanted]


def test_pictures_are_received_only_while_wanted() -> None:
    link: Any = FakeLink()
    received: list[tuple[str, bytes]] = []

    async def look() -> None:
        intake = PictureIntake(link, asyncio.get_running_loop(), lambda key, payload: received.append((key, payload)))
        for number, wanted in enumerate(([], [FRONT], [])):
            intake.follow(wanted)
            intake.follow(wanted)
            link.deliver(FRONT, image(number, number))
            await asyncio.sleep(0)

    asyncio.run(look())
    assert received == [(FRONT, messages.encode(image(1, 1)))]


def test_a_busy_event_loop_gets_the_newest_pictures() -> None:
    link: Any = FakeLink()
    received: list[int] = []

    async def look() -> None:
        loop = asyncio.get_running_loop()
        intake = PictureIntake(link, loop, lambda key, payload: received.append(messages.decode(key, payload).seq))
        for number in range(3 * IMAGES_QUEUED_MAX):
            intake._on_picture(RawSample("PUT", FRONT, messages.encode(image(0, number)), "", None))
        await asyncio.sleep(0)

    asyncio.run(look())
    assert received == list(range(2 * IMAGES_QUEUED_MAX, 3 * IMAGES_QUEUED_MAX))


@pytest.mark.parametrize("payload", [b"\xc1", messages.encode(image(0, 0, NO_JPEG))])
def test_an_invalid_picture_is_counted_and_not_published(payload: bytes) -> None:
    bench = Bench()
    subscriber = Subscriber(bench.node, OWN.format("front", IMAGE))
    bench.bridge.forward(FRONT, payload)
    bench.bridge.forward("drone/quad-1/camera/side", messages.encode(image(0)))
    assert bench.observer.health.refused == 2
    bench.bridge.forward(FRONT, messages.encode(image(0)))
    assert len(subscriber.ros_messages) == 1
