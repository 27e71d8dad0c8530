"""The ROS 2 bridge without Zenoh: what it converts and when, what it forwards, and what it refuses."""

import math
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from federation import PAIR
from refused import has_terms
from synthetic_pictures import NO_JPEG, image, info, jpeg

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.messages import ClusterInfo, DroneInfo, Info, Origin
from zsim.contract.run_messages import ControlAnswer
from zsim.math.frames import rotate
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import RawSample, ReceivedSample
from zsim.transport.zenoh_settings import Mode
from zsim_bridges.ros2 import rmw_zenoh, topics
from zsim_bridges.ros2.rmw_zenoh import Attachment, Endpoint, NodeId, RosContext
from zsim_bridges.ros2.ros2_bridge import SAMPLES_MAX, CallbackQueue, Ros2Bridge

READER = NodeId(0, "abc", 1, "/", "reader")
WALL_NS = 1_700_000_000_000_000_000
BESIDE = Attachment(7, 1, bytes(range(16))).packed()
IMU, TWIST, EMPTY, TRIGGER = (
    "sensor_msgs/msg/Imu",
    "geometry_msgs/msg/Twist",
    "std_msgs/msg/Empty",
    "std_srvs/srv/Trigger",
)


class Link:
    """A session to both sides, on which the test delivers what others publish."""

    host = "laptop"

    def __init__(self) -> None:
        self.published: list[tuple[str, Any]] = []
        self.sent: list[tuple[str, bytes, bytes]] = []
        self.kept: list[tuple[str, bytes, bytes]] = []
        self.hearing: dict[str, list[Callable[[RawSample], None]]] = {}
        self.tokens: list[str] = []
        self.reads: list[str] = []
        self.services: dict[str, Callable[[Any], None]] = {}
        self.asked: list[tuple[str, str, str, dict[str, Any]]] = []
        self.last: dict[str, bytes] = {}
        self.on_token_of: Callable[[str, bool], None] = lambda token, alive: None

    def deliver(self, key: str, payload: bytes, attachment: bytes = b"") -> None:
        for callback in list(self.hearing.get(key, [])):
            callback(RawSample("PUT", key, payload, "", None, attachment))

    def zid(self) -> str:
        return "f00d"

    def subscribe(self, key: str) -> "FakeSubscription":
        return FakeSubscription(self, key)

    def declare_subscriber(self, key: str, callback: Callable[[RawSample], None]) -> Callable[[], None]:
        self.hearing.setdefault(key, []).append(callback)
        return lambda: self.hearing[key].remove(callback)

    def put(self, key: str, message: Any) -> None:
        self.published.append((key, message))

    def declare_publisher(self, key: str, encoding: str) -> Callable[[bytes, bytes], None]:
        return lambda payload, attachment: self.sent.append((key, payload, attachment))

    def put_cached(self, key: str, payload: bytes, encoding: str, attachment: bytes) -> None:
        self.kept.append((key, payload, attachment))

    def declare_token(self, key: str) -> None:
        self.tokens.append(key)

    def on_token(self, expression: str, callback: Callable[[str, bool], None]) -> None:
        self.on_token_of = callback

    def declare_queryable(self, key: str, callback: Callable[[Any], None], complete: bool) -> None:
        assert complete
        self.services[key] = callback

    def request(self, key: str, op: str, source: str, args: dict[str, Any]) -> ControlAnswer:
        self.asked.append((key, op, source, args))
        return ControlAnswer(False, "phase is idle; must be engaged")

    def get(self, key: str, timeout_s: float) -> list[ReceivedSample]:
        return [ReceivedSample(key, self.last[key])] if key in self.last else []


class FakeSubscription:
    """A subscription that the test's session feeds."""

    def __init__(self, link: Link, key: str) -> None:
        self._arrived: list[ReceivedSample] = []
        self.undeclare = link.declare_subscriber(
            key, lambda raw: self._arrived.append(ReceivedSample(raw.key, raw.payload))
        )

    def drain(self) -> list[ReceivedSample]:
        arrived, self._arrived = self._arrived, []
        return arrived


class Query:
    """A service request from ROS."""

    def __init__(self, payload: bytes, attachment: bytes) -> None:
        self.payload, self.attachment = payload, attachment
        self.replies: list[tuple[str, bytes, bytes]] = []
        self.ended = False

    def reply_raw(self, key: str, payload: bytes, attachment: bytes) -> None:
        self.replies.append((key, payload, attachment))

    def end(self) -> None:
        self.ended = True


class Bench:
    """A bridge in a run of two drones, with names that ROS does not allow."""

    def __init__(self, mode: Mode = "lockstep") -> None:
        text = scenario_file.to_text(scenario_file.from_text(PAIR.replace("drone1", "drone-1").replace("main", "m.x")))
        drones = tuple(DroneInfo(name, "ardrone2") for name in ("drone-1", "drone2"))
        clusters = (ClusterInfo("m.x", ("drone-1", "drone2")),)
        self.info = Info(
            0, 0, 1, "run", "zsim", mode, 0.0, 20_000_000, 5_000_000, 20_000_000, 3, Origin(0.0, 0.0, 0.0),
            drones, clusters, text, "", "", "",
        )  # fmt: skip
        self.link: Any = Link()
        self.lines: list[str] = []
        self.observer = Participant(self.link, self.info, "ros2.main")
        self.bridge = Ros2Bridge(self.link, self.info, self.observer, self.lines.append, wall_ns)
        self.bridge.advertise_run(RosContext(self.link, 0, wall_ns, self.bridge.count_refused))

    def turn(self) -> None:
        self.bridge.process(0.0)

    def reader(self, topic: str, kind: str, alive: bool = True) -> None:
        """Announce or withdraw a subscription."""
        endpoint = Endpoint("MS", topic, rmw_zenoh.dds_name(kind), rmw_zenoh.type_hash(kind))
        self.link.on_token_of(rmw_zenoh.endpoint_token(READER, 2, endpoint, rmw_zenoh.DEFAULT), alive)
        self.turn()

    def key(self, topic: str, kind: str) -> str:
        return rmw_zenoh.data_key(0, topic, rmw_zenoh.dds_name(kind), rmw_zenoh.type_hash(kind))

    def publish(self, topic: str, kind: str, message: Any, attachment: bytes = BESIDE) -> None:
        """Publish as a ROS node."""
        payload = message if isinstance(message, bytes) else rmw_zenoh.encode(message, kind)
        self.link.deliver(self.key(topic, kind), payload, attachment)
        self.turn()

    def ask(self, service: str, payload: bytes = b"\x00\x01\x00\x00\x00", attachment: bytes = BESIDE) -> Query:
        query = Query(payload, attachment)
        self.link.services[self.key(service, TRIGGER)](query)
        self.turn()
        return query


def wall_ns() -> int:
    return WALL_NS


def twist(*numbers: float) -> Any:
    vector = rmw_zenoh.message_class("geometry_msgs/msg/Vector3")
    return rmw_zenoh.message_class(TWIST)(vector(*numbers[:3]), vector(*numbers[3:]))


def imu(t_ns: int) -> bytes:
    return messages.encode(messages.Imu(t_ns, 0, t_ns, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)))


def test_a_topic_is_read_and_converted_only_while_subscribed() -> None:
    bench, key = Bench(), keys.sensor("drone-1", "imu")
    assert not bench.link.hearing.get(key)
    bench.reader("/drone_1/imu", IMU)
    assert len(bench.link.hearing[key]) == 1
    for t_ns in (0, 5_000_000):
        bench.link.deliver(key, imu(t_ns))
    bench.turn()
    (first, payload, beside), (_, _, later) = bench.link.sent
    assert first == bench.key("/drone_1/imu", IMU)
    assert rmw_zenoh.decode(payload, IMU).header.frame_id == "drone_1/imu_link"
    (token,) = (each for each in bench.link.tokens if "/%drone_1%imu/" in each)
    sent = rmw_zenoh.attachment_of(beside)
    assert sent == (1, WALL_NS, rmw_zenoh.gid_of(token))
    assert rmw_zenoh.attachment_of(later).sequence == 2
    bench.reader("/drone_1/imu", IMU, alive=False)
    assert not bench.link.hearing[key]


def test_topics_of_one_source_share_its_subscription() -> None:
    bench, key = Bench(), keys.estimate("drone-1")
    bench.reader("/drone_1/odometry", "nav_msgs/msg/Odometry")
    bench.reader("/tf", "tf2_msgs/msg/TFMessage")
    assert len(bench.link.hearing[key]) == 1
    bench.reader("/drone_1/odometry", "nav_msgs/msg/Odometry", alive=False)
    assert len(bench.link.hearing[key]) == 1
    bench.reader("/tf", "tf2_msgs/msg/TFMessage", alive=False)
    assert not bench.link.hearing[key]


def test_a_subscription_with_another_type_is_reported_and_ignored() -> None:
    bench = Bench()
    bench.reader("/drone_1/imu", "std_msgs/msg/String")
    assert not bench.link.hearing.get(keys.sensor("drone-1", "imu"))
    assert any(has_terms(s, "std_msgs::msg::dds_::String_", "sensor_msgs/msg/Imu") for s in bench.lines)


def test_names_changed_for_ros_are_reported() -> None:
    published = "\n".join(Bench().lines)
    assert has_terms(published, "drone-1", "drone_1", "ROS")
    assert has_terms(published, "m.x", "m_x", "ROS")
    assert "drone2 is" not in published


def test_a_twist_becomes_a_velocity_in_the_heading_frame_at_the_newest_gate() -> None:
    bench = Bench()
    clock = run_messages.Clock(4_000_000_000, 0, "run", 200, "running", 1.0)
    bench.link.deliver(keys.CLOCK, messages.encode(clock))
    bench.turn()
    for speed in (1.0, 0.5):
        bench.publish("/drone_1/cmd_vel", TWIST, twist(speed, -0.5, 0.25, 9.0, 9.0, 0.75))
    (key, first), (_, second) = bench.link.published
    assert key == "drone/drone-1/cmd/velocity"
    assert (first.t_ns, first.seq, first.source, first.frame) == (4_000_000_000, 0, "ros2.main", "heading")
    assert (first.velocity_m_s, first.yaw_rate_rad_s) == ((1.0, -0.5, 0.25), 0.75)
    assert (second.seq, second.velocity_m_s[0]) == (1, 0.5)


def test_mode_topics_send_modes_and_reset_toggles_the_emergency() -> None:
    bench, empty = Bench(), rmw_zenoh.message_class(EMPTY)()
    status = keys.status("drone-1")
    bench.publish("/drone_1/takeoff", EMPTY, empty)
    bench.publish("/drone_1/land", EMPTY, empty)
    bench.publish("/drone_1/reset", EMPTY, empty)  # refused, since the state is unknown
    for state in ("flying", "emergency"):
        bench.link.last[status] = messages.encode(flight_messages.Status(0, 0, state, 50.0, False, None, 1))
        bench.publish("/drone_1/reset", EMPTY, empty)
    assert [(m.mode, m.seq) for _, m in bench.link.published] == [
        ("takeoff", 0),
        ("land", 1),
        ("emergency", 2),
        ("reset", 3),
    ]
    assert bench.observer.health.refused == 1


@pytest.mark.parametrize(
    ("message", "attachment", "terms"),
    [
        (b"\x00\x01\x00\x00short", BESIDE, ("CDR", "geometry_msgs/msg/Twist")),
        (twist(0, 0, 0, 0, 0, 0), b"", ("33",)),
        (twist(0, 0, 0, 0, 0, 0), BESIDE[:-1], ("33",)),
        (twist(math.nan, 0, 0, 0, 0, 0), BESIDE, ("finite",)),
        (twist(0, 0, 0, 0, 0, math.inf), BESIDE, ("finite",)),
    ],
)
def test_garbage_is_refused_counted_and_reported_once(message: Any, attachment: bytes, terms: tuple[str, ...]) -> None:
    bench = Bench()
    for _ in range(3):
        bench.publish("/drone_1/cmd_vel", TWIST, message, attachment)
    assert bench.link.published == []
    assert bench.observer.health.refused == 3
    refusals = [line for line in bench.lines if "refused" in line]
    assert len(refusals) == 1
    assert has_terms(refusals[0], *terms)


def test_a_value_that_does_not_fit_its_ros_type_is_refused() -> None:
    bench, key = Bench(), keys.sensor("drone-1", "baro")
    bench.reader("/drone_1/navdata", "zsim_msgs/msg/Navdata")
    bench.link.deliver(key, messages.encode(messages.Baro(0, 0, 0, 1e300, 0.0)))
    bench.link.deliver(
        keys.status("drone-1"), messages.encode(flight_messages.Status(0, 0, "flying", 50.0, False, None, 1))
    )
    bench.link.deliver(key, b"garbage")
    bench.turn()
    assert bench.link.sent == []
    assert bench.observer.health.refused == 2


def test_a_service_calls_the_controller_and_echoes_the_attachment() -> None:
    bench = Bench()
    query = bench.ask("/cluster/m_x/engage")
    assert bench.link.asked == [("cluster/m.x/control", "engage", "ros2.main", {})]
    ((key, payload, beside),) = query.replies
    assert key == bench.key("/cluster/m_x/engage", TRIGGER)
    response = rmw_zenoh.decode(payload, "std_srvs/srv/Trigger_Response")
    assert not response.success
    assert has_terms(response.message, "phase", "idle", "engaged")
    assert rmw_zenoh.attachment_of(beside) == (7, WALL_NS, bytes(range(16)))


def test_an_invalid_request_ends_without_a_reply() -> None:
    bench = Bench()
    for query in (bench.ask("/drone_1/release", b"\x00\x01\x00\x00"), bench.ask("/drone_1/release", attachment=b"")):
        assert query.ended
        assert query.replies == []
    assert bench.link.asked == []
    assert bench.observer.health.refused == 2


def test_a_summary_of_a_gate_uses_data_up_to_that_gate() -> None:
    """This also holds if several gates are waiting and the status was read before the sensors."""
    bench, imu_key, status_key = Bench(), keys.sensor("drone-1", "imu"), keys.status("drone-1")
    bench.reader("/drone_1/state", "std_msgs/msg/String")
    bench.reader("/drone_1/navdata", "zsim_msgs/msg/Navdata")
    for gate in range(3):
        t_ns, accel = gate * 20_000_000, (0.0, 0.0, 9.80665 * gate)
        bench.link.deliver(imu_key, messages.encode(messages.Imu(t_ns, 0, t_ns, accel, (0.0, 0.0, 0.0))))
        status = flight_messages.Status(t_ns, 0, "flying", 50.0, False, None, 1)
        bench.link.deliver(status_key, messages.encode(status))
    bench.turn()
    navdata = [payload for key, payload, _ in bench.link.sent if "Navdata" in key]
    assert [rmw_zenoh.decode(each, "zsim_msgs/msg/Navdata").az for each in navdata] == pytest.approx([0.0, 1.0, 2.0])


def test_static_transforms_are_cached_for_late_subscribers() -> None:
    ((key, payload, _),) = Bench().link.kept
    assert key == rmw_zenoh.data_key(
        0, "/tf_static", "tf2_msgs::msg::dds_::TFMessage_", rmw_zenoh.type_hash("tf2_msgs/msg/TFMessage")
    )
    children = {each.child_frame_id for each in rmw_zenoh.decode(payload, "tf2_msgs/msg/TFMessage").transforms}
    assert {"drone_1/odom", "drone2/odom", "drone_1/sonar_link", "drone2/imu_link"} <= children


def test_a_closed_bridge_has_no_subscriptions() -> None:
    bench = Bench()
    bench.reader("/drone_1/imu", IMU)
    bench.bridge.close()
    assert not any(bench.link.hearing.values())


def test_a_full_queue_drops_the_oldest_samples_but_no_tasks() -> None:
    inbox, done = CallbackQueue(3), []
    for k in range(5):
        inbox.add_sample("key", bytes([k]))
        inbox.add_task(lambda k=k: done.append(k))
    tasks, samples = inbox.pop_all(0.0)
    for act in tasks:
        act()
    assert [payload for _, payload in samples] == [b"\2", b"\3", b"\4"]
    assert (done, inbox.dropped) == ([0, 1, 2, 3, 4], 2)
    assert inbox.pop_all(0.0) == ([], [])


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_dropped_samples_are_counted_in_the_health(mode: Mode) -> None:
    bench, key, estimate = Bench(mode), keys.sensor("drone-1", "imu"), keys.estimate("drone-1")
    bench.reader("/drone_1/imu", IMU)
    bench.reader("/tf", "tf2_msgs/msg/TFMessage")
    for k in range(SAMPLES_MAX + 10):
        bench.link.deliver(key, imu(k))
        bench.link.deliver(estimate, b"estimate")
    bench.turn()
    assert len(bench.link.sent) == SAMPLES_MAX
    assert bench.observer.health.dropped == 20


# Cameras

IMAGE, CAMERA_INFO = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
FRONT, BOTTOM = keys.camera("drone-1", "front"), keys.camera("drone-1", "bottom")
FRONT_INFO = keys.camera_info("drone-1", "front")


def published(bench: Bench, topic: str, kind: str) -> list[Any]:
    """Return the messages published on a topic."""
    key = bench.key(topic, kind)
    return [rmw_zenoh.decode(payload, kind) for at, payload, _ in bench.link.sent if at == key]


def test_a_picture_is_published_unchanged_with_its_exposure_time() -> None:
    bench = Bench()
    bench.reader("/drone_1/ardrone/front/image_raw/compressed", IMAGE)
    assert not bench.link.hearing.get(BOTTOM)
    bench.link.deliver(FRONT, messages.encode(image(20_000_000)))
    bench.turn()
    (got,) = published(bench, "/drone_1/ardrone/front/image_raw/compressed", IMAGE)
    assert (got.header.stamp.sec, got.header.stamp.nanosec) == (0, 16_000_000)
    assert got.header.frame_id == "drone_1/front_camera_optical_frame"
    assert (got.format, bytes(got.data)) == ("jpeg", jpeg())
    bench.reader("/drone_1/ardrone/front/image_raw/compressed", IMAGE, alive=False)
    assert not bench.link.hearing[FRONT]


def test_camera_info_from_before_the_subscription_comes_with_each_picture() -> None:
    bench = Bench()
    bench.link.last[FRONT_INFO] = messages.encode(info())
    bench.reader("/drone_1/ardrone/front/camera_info", CAMERA_INFO)
    bench.turn()
    for number in (1, 2):
        bench.link.deliver(FRONT, messages.encode(image(number * 20_000_000)))
    bench.turn()
    first, second = published(bench, "/drone_1/ardrone/front/camera_info", CAMERA_INFO)
    assert (tuple(first.k), tuple(first.d), first.distortion_model) == (info().K, info().D, "plumb_bob")
    assert (first.width, first.height, tuple(first.p[[0, 5, 10]])) == (info().width, info().height, (50.0, 51.0, 1.0))
    assert [m.header.stamp.nanosec for m in (first, second)] == [16_000_000, 36_000_000]


def test_togglecam_switches_the_active_camera() -> None:
    bench = Bench()
    bench.reader("/drone_1/ardrone/image_raw/compressed", IMAGE)
    for _ in range(2):
        for key in (FRONT, BOTTOM):
            bench.link.deliver(key, messages.encode(image(20_000_000)))
        bench.turn()
        (reply,) = bench.ask("/drone_1/ardrone/togglecam").replies
        assert rmw_zenoh.decode(reply[1], f"{TRIGGER}_Response").success
    frames = [m.header.frame_id for m in published(bench, "/drone_1/ardrone/image_raw/compressed", IMAGE)]
    assert frames == ["drone_1/front_camera_optical_frame", "drone_1/bottom_camera_optical_frame"]


@pytest.mark.parametrize("payload", [b"\xc1", messages.encode(image(0, 0, NO_JPEG)), messages.encode(info())])
def test_an_invalid_picture_is_refused_and_the_next_forwarded(payload: bytes) -> None:
    bench = Bench()
    bench.reader("/drone_1/ardrone/front/image_raw/compressed", IMAGE)
    bench.link.deliver(FRONT, payload)
    bench.link.deliver(FRONT, messages.encode(image(0)))
    bench.turn()
    assert bench.observer.health.refused == 1
    assert len(published(bench, "/drone_1/ardrone/front/image_raw/compressed", IMAGE)) == 1


def test_cameras_of_the_scenario_have_static_transforms() -> None:
    text = PAIR.replace("preset: paper", "preset: paper, front_camera: {}, bottom_camera: {}")
    drone = scenario_file.resolve(msgspec.yaml.decode(text.encode())).drones[0]
    frames = {frame.child_frame_id: frame for frame in topics.static_transforms("d", drone.sensors)}
    for camera, direction in (("front", (1.0, 0.0, 0.0)), ("bottom", (0.0, 0.0, -1.0))):
        frame = frames[f"d/{camera}_camera_optical_frame"]
        p, q = frame.transform.translation, frame.transform.rotation
        assert frame.header.frame_id == "d/base_link"
        assert (p.x, p.y, p.z) == drone.sensors.cameras()[camera].mount.position_m
        assert rotate((q.w, q.x, q.y, q.z), (0.0, 0.0, 1.0)) == pytest.approx(direction, abs=1e-12)
