"""The cameras of a drone in the ROS graph: which topics have which pictures, and when a camera is read at all."""

import asyncio
from typing import Any

import numpy as np
import pytest
from fake_link import FakeLink
from ros1_drone import GATE_NS, Drone, Subscriber, scenario, status
from synthetic_pictures import AHEAD, FRONT_P_BK, NO_JPEG, image, info, jpeg

from zsim.contract import keys, messages
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import RawSample
from zsim_bridges.intake import WAITING_MAX, PictureIntake
from zsim_bridges.ros1.node import Ros1Node
from zsim_bridges.ros1.ros1_bridge import Ros1Bridge

OWN, ACTIVE = "/quad_1/ardrone/{}/{}", "/quad_1/ardrone/{}"
IMAGE, INFO = "image_raw/compressed", "camera_info"
FRONT = keys.camera("quad-1", "front")


def pictures(drone: Drone) -> dict[str, Subscriber]:
    """Return a subscriber to every topic of the cameras."""
    topics = [OWN.format(camera, leaf) for camera in ("front", "bottom") for leaf in (IMAGE, INFO)]
    return {topic: drone.subscriber(topic) for topic in [*topics, ACTIVE.format(IMAGE), ACTIVE.format(INFO)]}


def counts(subscribers: dict[str, Subscriber]) -> dict[str, int]:
    return {topic: len(s.ros_messages) for topic, s in subscribers.items() if s.ros_messages}


def test_a_picture_is_on_its_camera_s_topic_and_on_the_active_one() -> None:
    drone = Drone()
    subscribers = pictures(drone)
    drone.topics.cameras.publish("front", image(GATE_NS))
    assert counts(subscribers) == {OWN.format("front", IMAGE): 1, ACTIVE.format(IMAGE): 1}
    (got,) = subscribers[OWN.format("front", IMAGE)].ros_messages
    assert (got.header.stamp.sec, got.header.stamp.nanosec) == (0, 16_000_000)  # of the exposure
    assert (got.header.frame_id, got.format) == ("quad_1/ardrone_base_frontcam", "jpeg")
    assert bytes(got.data) == jpeg()


def test_togglecam_makes_the_other_camera_the_active_one_and_again_the_first() -> None:
    drone = Drone()
    subscribers = pictures(drone)
    toggle = drone.node._services["/quad_1/ardrone/togglecam"]._act
    for _ in range(2):
        assert toggle() is None
        for camera in ("front", "bottom"):
            drone.topics.cameras.publish(camera, image(0))
    frames = [message.header.frame_id for message in subscribers[ACTIVE.format(IMAGE)].ros_messages]
    assert frames == ["quad_1/ardrone_base_bottomcam", "quad_1/ardrone_base_frontcam"]


def test_how_a_camera_sees_comes_with_each_picture_and_its_stamp() -> None:
    drone = Drone()
    subscribers = pictures(drone)
    drone.topics.cameras.learn("front", info())
    for number in (1, 2):
        drone.topics.cameras.publish("front", image(number * GATE_NS))
    got = subscribers[OWN.format("front", INFO)].ros_messages
    images = subscribers[OWN.format("front", IMAGE)].ros_messages
    assert [m.header.stamp for m in got] == [m.header.stamp for m in images]
    assert (got[0].width, got[0].height, got[0].distortion_model) == (info().width, info().height, "plumb_bob")
    assert (tuple(got[0].K), tuple(got[0].D)) == (info().K, info().D)
    np.testing.assert_array_equal(got[0].P.reshape(3, 4)[:, :3], np.reshape(info().K, (3, 3)))
    np.testing.assert_array_equal(got[0].P.reshape(3, 4)[:, 3], np.zeros(3))


def test_the_cameras_are_in_the_tree_of_frames() -> None:
    drone = Drone()
    tf = drone.subscriber("/tf")
    drone.topics.cameras.learn("front", info())
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
def test_a_camera_is_read_while_somebody_subscribes(topic: str, wanted: list[str]) -> None:
    drone = Drone()
    drone.subscriber(topic)
    assert list(drone.topics.cameras.wanted()) == wanted


# From the keys


@pytest.fixture
def bridged() -> tuple[Ros1Bridge, Participant]:
    """A bridge without a graph, and its process."""
    text = scenario_file.to_text(scenario())
    about: Any = messages.Info(
        0, 0, 1, "run", "zsim", "lockstep", 0.0, GATE_NS, 5_000_000, GATE_NS, 1, messages.Origin(0.0, 0.0, 0.0),
        (messages.DroneInfo("quad-1", "ardrone2"),), (), text, "", "", "",
    )  # fmt: skip
    link: Any = FakeLink()
    observer = Participant(link, about, "ros1.main")
    node = Ros1Node("/zsim", "http://127.0.0.1:1", "127.0.0.1", print)
    return Ros1Bridge(link, about, observer, node, print), observer


def test_subscriptions_come_and_go_with_those_who_look() -> None:
    link = FakeLink()
    taken: list[tuple[str, bytes]] = []

    async def look() -> None:
        loop = asyncio.get_running_loop()
        intake = PictureIntake(link, loop, lambda key, payload: taken.append((key, payload)))  # type: ignore[arg-type]
        link.deliver(FRONT, image(0))
        intake.follow([FRONT])
        intake.follow([FRONT])
        link.deliver(FRONT, image(1, 1))
        await asyncio.sleep(0)
        intake.follow([])
        link.deliver(FRONT, image(2, 2))
        await asyncio.sleep(0)

    asyncio.run(look())
    assert taken == [(FRONT, messages.encode(image(1, 1)))]


def test_a_loop_that_is_busy_gets_the_newest() -> None:
    taken: list[Any] = []

    async def look() -> None:
        intake = PictureIntake(
            FakeLink(),  # type: ignore[arg-type]
            asyncio.get_running_loop(),
            lambda key, payload: taken.append(messages.decode(key, payload).seq),
        )
        for number in range(3 * WAITING_MAX):
            intake._on_picture(RawSample("PUT", FRONT, messages.encode(image(0, number)), "", None))
        await asyncio.sleep(0)

    asyncio.run(look())
    assert taken == list(range(2 * WAITING_MAX, 3 * WAITING_MAX))


@pytest.mark.parametrize("payload", [b"\xc1", messages.encode(image(0, 0, NO_JPEG))])
def test_what_is_no_picture_is_counted_and_not_published(
    bridged: tuple[Ros1Bridge, Participant], payload: bytes
) -> None:
    bridge, observer = bridged
    subscriber = Subscriber(bridge._node, OWN.format("front", IMAGE))
    bridge.forward(FRONT, payload)
    bridge.forward("drone/quad-1/camera/side", messages.encode(image(0)))
    assert observer.health.refused == 2
    bridge.forward(FRONT, messages.encode(image(0)))
    assert len(subscriber.ros_messages) == 1


def test_the_bridge_reads_what_nodes_subscribe_to(bridged: tuple[Ros1Bridge, Participant]) -> None:
    bridge, _ = bridged
    assert list(bridge._wanted_pictures()) == []
    Subscriber(bridge._node, OWN.format("bottom", INFO))
    assert list(bridge._wanted_pictures()) == [keys.camera("quad-1", "bottom")]
