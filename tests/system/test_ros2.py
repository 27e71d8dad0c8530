"""`zsim ros2` as ROS nodes see it: independent participants discover, read, fly and query the drones."""

import math
import signal
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zenoh
from federation import ONE, PAIR, Federation, Role, free_port

pytest.importorskip("zenoh_ros2_sdk", reason="PyPI zenoh-ros2-sdk is not installed; `pip install -e .[dev]` brings it")

from picture_pump import calibration, pumping, shaded
from ros2_lab import TRIGGER, Peer, Router, write_definitions
from secured import Certificates, tls_endpoint

from zsim.scenario import scenario_file
from zsim_bridges.ros2 import rmw_zenoh
from zsim_deploy.certificates import access_control

TWIST, EMPTY = "geometry_msgs/msg/Twist", "std_msgs/msg/Empty"
IMAGE, CAMERAS = "sensor_msgs/msg/CompressedImage", ("ardrone/", "ardrone/front/", "ardrone/bottom/")
TAKEN = ("cmd_vel", "takeoff", "land", "reset")
NEVER = """
name: never
seed: 3
duration_s: 1000
sensors: {preset: ardrone2}
drones:
  - {name: quad-1.a, position_m: [0, 0, 0], yaw_deg: 90}
processes: {expect: []}
"""
"""A drone whose name is invalid in ROS, in a run that outlasts every test."""

ROS = tuple[Callable[..., Peer], Callable[[int], Router]]


@pytest.fixture(scope="module")
def definitions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_definitions(tmp_path_factory.mktemp("definitions"))


@pytest.fixture
def ros(definitions: Path) -> Iterator[ROS]:
    """Functions that start a participant or a router on a port; both end with the test."""
    with ExitStack() as stack:
        yield (
            lambda port, mode="peer": stack.enter_context(Peer(port, definitions, mode)),
            lambda port: stack.enter_context(Router(port)),
        )


def port_of(endpoint: str) -> int:
    return int(endpoint.rsplit(":", 1)[1])


def bridge(federation: Federation, *arguments: str) -> Role:
    """Start a bridge and return it once it is visible to ROS."""
    started = federation.role("ros2", *arguments)
    started.line("ROS domain 0")
    return started


def expected() -> dict[str, list[str]]:
    """Return the topics of PAIR with their types as in docs/ros2.md."""
    of_run = {
        "/clock": "rosgraph_msgs/msg/Clock",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
    }
    of_cluster = {"state": "zsim_msgs/msg/ClusterState", "pose": "geometry_msgs/msg/PoseStamped"}
    of_drone = {
        "imu": "sensor_msgs/msg/Imu",
        "fix": "sensor_msgs/msg/NavSatFix",
        "fix_velocity": "geometry_msgs/msg/TwistStamped",
        "mag": "sensor_msgs/msg/MagneticField",
        "pressure": "sensor_msgs/msg/FluidPressure",
        "range": "sensor_msgs/msg/Range",
        "odometry": "nav_msgs/msg/Odometry",
        "ground_truth": "nav_msgs/msg/Odometry",
        "battery": "sensor_msgs/msg/BatteryState",
        "state": "std_msgs/msg/String",
        **{f"{camera}image_raw/compressed": IMAGE for camera in CAMERAS},
        **{f"{camera}camera_info": "sensor_msgs/msg/CameraInfo" for camera in CAMERAS},
        "navdata": "zsim_msgs/msg/Navdata",
        "cmd_vel": TWIST,
        "takeoff": EMPTY,
        "land": EMPTY,
        "reset": EMPTY,
    }
    topics = of_run | {f"/cluster/main/{leaf}": kind for leaf, kind in of_cluster.items()}
    topics |= {f"/{drone}/{leaf}": kind for drone in ("drone1", "drone2") for leaf, kind in of_drone.items()}
    return {topic: [kind] for topic, kind in topics.items()}


def seconds(header: dict[str, Any]) -> float:
    return header["stamp"]["sec"] + 1e-9 * header["stamp"]["nanosec"]


def xyz(vector: dict[str, Any]) -> list[float]:
    return [vector["x"], vector["y"], vector["z"]]


def yaw(odometry: dict[str, Any]) -> float:
    q = odometry["pose"]["pose"]["orientation"]
    return math.atan2(2 * (q["w"] * q["z"] + q["x"] * q["y"]), 1 - 2 * (q["y"] ** 2 + q["z"] ** 2))


def test_two_participants_find_and_receive_every_topic_and_request(federation: Federation, ros: ROS) -> None:
    """One starts before the bridge, the other after it; all values are checked against physics."""
    federation.run(PAIR.replace("duration_s: 12", "duration_s: 1000"), "--rate", "2")
    federation.client().subscribe("clock").until(lambda m: m["t_ns"] >= 0)
    peer, _ = ros
    topics = expected()
    without = (*TAKEN, "compressed", "camera_info")  # commands and, as there is no camera here, camera topics
    kinds = {topic: kind for topic, (kind,) in topics.items() if topic.rsplit("/", 1)[1] not in without}
    before = peer(port_of(federation.endpoint))
    for topic, kind in kinds.items():
        before.request("subscribe", topic=topic, kind=kind, kept=topic == "/tf_static")
    bridge(federation)
    assert before.until("topics", lambda found: found == topics) == topics
    received = {topic: before.receive(topic, fresh=False) for topic in kinds}
    check_sensors(received)
    check_frames(received, before)

    after = peer(port_of(federation.endpoint))
    assert after.until("topics", lambda found: found == topics) == topics
    services = after.request("services")
    assert services == {
        f"/cluster/main/{op}": [TRIGGER["kind"]] for op in ("takeoff", "engage", "hold", "rejoin", "land")
    } | {f"/drone{n}/{service}": [TRIGGER["kind"]] for n in (1, 2) for service in ("release", "ardrone/togglecam")}
    after.request("subscribe", topic="/cluster/main/state", kind=kinds["/cluster/main/state"])
    engaged = after.receive("/cluster/main/state", lambda m: m["phase"] == "engaged")
    assert engaged["names"][:3] == ["x_c", "y_c", "z_c"]
    assert math.isnan(engaged["trajectory_time"])
    check_odometry(before)
    answer = after.request("call", service="/cluster/main/hold", **TRIGGER)
    assert answer["success"], answer
    after.receive("/cluster/main/state", lambda m: m["phase"] == "held")
    refused = after.request("call", service="/cluster/main/takeoff", **TRIGGER)
    assert not refused["success"]
    assert "held" in refused["message"]


def test_pictures_arrive_as_the_camera_published_them(federation: Federation, ros: ROS) -> None:
    """An external camera has published its calibration before ROS subscribes; ROS receives pictures and calibration."""
    federation.world(ONE.replace("duration_s: 10", "duration_s: 3600"), "--realtime")
    camera = federation.client()
    camera.subscribe("clock").until(lambda m: m["t_ns"] > 0)
    camera.put("drone/drone1/camera/front/info", **calibration())
    bridge(federation)
    peer = ros[0](port_of(federation.endpoint))
    for leaf, kind in (("image_raw/compressed", IMAGE), ("camera_info", "sensor_msgs/msg/CameraInfo")):
        for base in ("/drone1/ardrone/front", "/drone1/ardrone"):
            peer.request("subscribe", topic=f"{base}/{leaf}", kind=kind)
    with pumping(camera, "drone/drone1/camera/front"), pumping(camera, "drone/drone1/camera/bottom"):
        for base in ("/drone1/ardrone/front", "/drone1/ardrone"):
            image = peer.receive(f"{base}/image_raw/compressed")
            assert image["header"]["frame_id"] == "drone1/front_camera_optical_frame"
            number = round(seconds(image["header"]) * 1e3)
            assert (image["format"], bytes(image["data"])) == ("jpeg", shaded(number))
            info = peer.receive(f"{base}/camera_info")
            assert (info["k"], info["d"]) == (calibration()["K"], calibration()["D"])
        answer = peer.request("call", service="/drone1/ardrone/togglecam", **TRIGGER)
        assert answer["success"], answer
        frame = "drone1/bottom_camera_optical_frame"
        peer.receive("/drone1/ardrone/image_raw/compressed", lambda m: m["header"]["frame_id"] == frame)


def check_sensors(received: dict[str, Any]) -> None:
    """Check the sensors of a drone in Buenos Aires that is on the ground or hovers near (2, 0), heading north."""
    imu = received["/drone1/imu"]
    assert imu["linear_acceleration"]["z"] == pytest.approx(9.81, abs=3.0)  # the preset's noise is 0.35 m/s^2
    assert imu["linear_acceleration_covariance"][0] == pytest.approx(0.35**2)
    assert imu["orientation_covariance"][0] == -1
    assert imu["header"]["frame_id"] == "drone1/imu_link"
    fix = received["/drone1/fix"]
    assert fix["latitude"] == pytest.approx(-34.603, abs=2e-4)
    assert fix["longitude"] == pytest.approx(-58.368, abs=2e-4)
    assert fix["position_covariance"] == pytest.approx([4, 0, 0, 0, 4, 0, 0, 0, 4])
    field = xyz(received["/drone1/mag"]["magnetic_field"])
    assert math.hypot(*field) == pytest.approx(22.8e-6, rel=0.3)  # tesla
    assert received["/drone1/pressure"]["fluid_pressure"] == pytest.approx(101_025, abs=100)
    echo = received["/drone1/range"]
    assert 0 < echo["range"] < 4
    assert (echo["min_range"], echo["max_range"]) == (pytest.approx(0.03), pytest.approx(6.0))
    assert received["/drone1/battery"]["percentage"] == pytest.approx(1.0, abs=0.05)
    navdata = received["/drone1/navdata"]
    assert navdata["state"] in (2, 3, 4, 6)
    assert navdata["battery_percent"] == pytest.approx(100, abs=5)


def check_frames(received: dict[str, Any], peer: Peer) -> None:
    """Check that the frames are connected from map to the sensors and that the sonar's x axis points down."""
    still = {t["child_frame_id"]: t for t in received["/tf_static"]["transforms"]}
    assert still["drone1/odom"]["header"]["frame_id"] == "map"
    assert {"drone1/imu_link", "drone1/gps_link", "drone1/mag_link", "drone1/baro_link"} <= still.keys()
    beam = still["drone1/sonar_link"]["transform"]["rotation"]
    assert [beam["x"], beam["y"], beam["z"], beam["w"]] == pytest.approx([0, math.sqrt(0.5), 0, math.sqrt(0.5)])
    for child, parent in {
        "drone1/base_link": "drone1/odom",
        "drone2/base_link": "drone2/odom",
        "cluster/main": "map",
    }.items():
        moving = peer.receive("/tf", lambda m, child=child: m["transforms"][0]["child_frame_id"] == child)
        assert moving["transforms"][0]["header"]["frame_id"] == parent


def check_odometry(peer: Peer) -> None:
    """Check an estimate against the truth at about the same time, within the covariance that it reports."""
    estimate = peer.receive("/drone1/odometry")
    truth = peer.receive("/drone1/ground_truth", lambda m: seconds(m["header"]) >= seconds(estimate["header"]))
    sigma = [math.sqrt(estimate["pose"]["covariance"][7 * k]) for k in range(3)]
    assert all(0.001 < each < 3 for each in sigma), sigma
    error = math.dist(xyz(estimate["pose"]["pose"]["position"]), xyz(truth["pose"]["pose"]["position"]))
    assert error < 5 * math.hypot(*sigma)
    assert yaw(truth) == pytest.approx(math.pi / 2, abs=0.3)
    assert yaw(estimate) == pytest.approx(math.pi / 2, abs=0.5)
    assert (estimate["header"]["frame_id"], truth["header"]["frame_id"]) == ("drone1/odom", "map")
    assert estimate["child_frame_id"] == truth["child_frame_id"] == "drone1/base_link"
    assert estimate["pose"]["covariance"][35] > 0


def test_a_node_flies_a_drone(federation: Federation, ros: ROS) -> None:
    """Take off, fly ahead and left, turn, land and stop: every command has the sign that REP-103 gives it."""
    patient = ("--set", "silence.hover_s=5", "--set", "silence.land_s=60")  # allow for a slow node on a busy machine
    federation.world(ONE.replace("duration_s: 10", "duration_s: 1000"), "--rate", "4", *patient)
    first = bridge(federation)
    node = ros[0](port_of(federation.endpoint))
    events = federation.client().subscribe("world/event")
    for topic, kind in {"ground_truth": "nav_msgs/msg/Odometry", "state": "std_msgs/msg/String"}.items():
        node.request("subscribe", topic=f"/drone1/{topic}", kind=kind)
    node.receive("/drone1/state", lambda m: m["data"] == "landed")
    node.request("publish", topic="/drone1/takeoff", kind=EMPTY, fields={})
    node.receive("/drone1/state", lambda m: m["data"] == "hovering")

    def fly(until: Callable[[Any], bool], ahead: float = 0.0, left: float = 0.0, turn: float = 0.0) -> Any:
        """Send a velocity at each received truth until one meets a condition; return that truth."""
        fields = {
            "linear": {"type": "geometry_msgs/msg/Vector3", "x": ahead, "y": left, "z": 0.0},
            "angular": {"type": "geometry_msgs/msg/Vector3", "x": 0.0, "y": 0.0, "z": turn},
        }
        while not until(truth := node.receive("/drone1/ground_truth")):
            node.request("publish", topic="/drone1/cmd_vel", kind=TWIST, fields=fields)
        return truth

    def velocity(truth: Any) -> list[float]:
        return xyz(truth["twist"]["twist"]["linear"])

    def position(truth: Any) -> list[float]:
        return xyz(truth["pose"]["pose"]["position"])

    ahead = fly(lambda m: velocity(m)[0] > 0.8, ahead=1.0)
    assert events.until(lambda m: m["kind"] == "commander").message["source"] == "ros2.main"
    far = fly(lambda m: position(m)[1] > position(ahead)[1] + 1.0, ahead=1.0)  # heading north, ahead is y
    assert abs(position(far)[0]) < 1.0
    fly(lambda m: velocity(m)[1] > 0.6, left=1.0)
    west = fly(lambda m: position(m)[0] < position(far)[0] - 0.5, left=1.0)
    turned = fly(lambda m: math.remainder(yaw(m) - yaw(west), math.tau) > 0.5, turn=0.8)
    assert turned["twist"]["twist"]["angular"]["z"] > 0.3
    released = node.request("call", service="/drone1/release", **TRIGGER)
    assert released["success"], released
    events.until(lambda m: m["text"] == "ros2.main asks release: done")

    fly(lambda m: velocity(m)[0] > 0.5, ahead=1.0)
    events.until(lambda m: m["kind"] == "commander")
    first.signal(signal.SIGTERM)
    assert events.until(lambda m: m["kind"] == "release").message["subject"] == "drone1"
    first.ends(with_code=0)
    bridge(federation)
    node.request("publish", topic="/drone1/land", kind=EMPTY, fields={})
    while node.receive("/drone1/state")["data"] != "landed":
        node.request("publish", topic="/drone1/land", kind=EMPTY, fields={})
    node.request("publish", topic="/drone1/reset", kind=EMPTY, fields={})
    node.receive("/drone1/state", lambda m: m["data"] == "emergency")
    node.request("publish", topic="/drone1/reset", kind=EMPTY, fields={})
    node.receive("/drone1/state", lambda m: m["data"] == "landed")


def test_the_bridge_sends_valid_messages_and_refuses_invalid_ones(federation: Federation, ros: ROS) -> None:
    """Messages have the stamps, numbers and identities of rmw_zenoh; invalid ones are refused and counted.

    Once the last subscriber has gone, the bridge reads nothing more.
    """
    federation.world(ONE.replace("duration_s: 10", "duration_s: 1000"), "--rate", "0.5")
    started = bridge(federation)
    node, raw = ros[0](port_of(federation.endpoint)), federation.client()
    node.request("subscribe", topic="/drone1/imu", kind="sensor_msgs/msg/Imu")
    check_attachments(raw.session, node)
    stamps = [seconds(message["header"]) for message in node.received["/drone1/imu"]]
    assert [after - before for before, after in pairwise(stamps)] == pytest.approx([0.005] * (len(stamps) - 1))

    key = rmw_zenoh.data_key(0, "/drone1/cmd_vel", rmw_zenoh.dds_name(TWIST), rmw_zenoh.type_hash(TWIST))
    vector = rmw_zenoh.message_class("geometry_msgs/msg/Vector3")
    good = rmw_zenoh.encode(rmw_zenoh.message_class(TWIST)(vector(1.0, 0.0, 0.0), vector(0.0, 0.0, 0.0)), TWIST)
    bad = rmw_zenoh.encode(rmw_zenoh.message_class(TWIST)(vector(math.nan, 0.0, 0.0), vector(0.0, 0.0, 0.0)), TWIST)
    beside = rmw_zenoh.Attachment(1, 1, bytes(16)).packed()
    for payload, attachment in ((b"\x00\x01\x00\x00garbage", beside), (good, b""), (good, beside[:-1]), (bad, beside)):
        raw.session.put(key, payload, attachment=attachment)
    raw.subscribe("process/ros2.main/health").until(lambda m: m["refused"] >= 4)
    started.line("/drone1/cmd_vel: refused")
    assert started.text().count("/drone1/cmd_vel: refused") == 1
    service = rmw_zenoh.data_key(
        0, "/drone1/release", rmw_zenoh.dds_name(TRIGGER["kind"]), rmw_zenoh.type_hash(TRIGGER["kind"])
    )
    assert list(raw.session.get(service, payload=b"\x00\x01\x00\x00", attachment=beside)) == []
    raw.subscribe("process/ros2.main/health").until(lambda m: m["refused"] >= 5)
    assert raw.get("drone/drone1/sensor/status")["drone/drone1/sensor/status"]["commander"] is None
    assert node.request("call", service="/drone1/release", **TRIGGER)["success"] is False

    node.close()
    received = [0]

    def stands(health: dict[str, Any]) -> bool:
        received.append(health["received"])
        return received[-1] == received[-2]

    raw.subscribe("process/ros2.main/health").until(stands)  # without subscribers nothing is read
    assert received[-1] > 0


def check_attachments(session: zenoh.Session, node: Peer) -> None:
    """Check that messages are numbered without gaps and carry the identity that belongs to their token."""
    tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/0/*/*/*/MP/**") if reply.ok]
    (token,) = (each for each in tokens if "/%drone1%imu/" in each)
    beside: list[bytes] = []
    subscriber = session.declare_subscriber(
        "0/drone1/imu/**", lambda sample: beside.append(sample.attachment.to_bytes() if sample.attachment else b"")
    )
    while len(beside) < 20:
        node.receive("/drone1/imu")
    subscriber.undeclare()
    attachments = [struct.unpack("<qqB16s", each) for each in beside]
    assert [sequence for sequence, *_ in attachments] == list(
        range(attachments[0][0], attachments[0][0] + len(attachments))
    )
    assert {(size, gid) for _, _, size, gid in attachments} == {(16, rmw_zenoh.gid_of(token))}


@pytest.mark.soak
def test_nodes_receive_again_after_any_process_restarts(federation: Federation, ros: ROS) -> None:
    """ROS's router starts late and is restarted, as are the bridge and the world; ROS nodes receive again each time."""
    peer, router = ros
    world = federation.world(NEVER, "--realtime")
    port = free_port()
    ours = federation.role("ros2", "--router", f"tcp/127.0.0.1:{port}")
    ours.line("no ROS router at")
    first = router(port)
    ours.line("ROS domain 0")
    ours.line("quad-1.a is quad_1_a in ROS")
    one, other = peer(port), peer(port)
    one.request("subscribe", topic="/quad_1_a/imu", kind="sensor_msgs/msg/Imu")
    at_rest = one.receive("/quad_1_a/imu")
    assert xyz(at_rest["linear_acceleration"]) == pytest.approx([0, 0, 9.81], abs=0.5)
    other.request("publish", topic="/chatter", kind="std_msgs/msg/String", fields={"data": "hello"})
    one.until("topics", lambda found: "/chatter" in found)  # through ROS's router, ROS nodes find each other

    clock = federation.client().subscribe("clock")

    def now_s() -> float:
        return 1e-9 * clock.now()[-1].message["t_ns"]

    def receives_again() -> None:
        """Wait for a sample taken after this call."""
        start_s = now_s()
        one.receive("/quad_1_a/imu", lambda m: seconds(m["header"]) > start_s)

    first.close()
    second = router(port)
    receives_again()
    other.until("topics", lambda found: "/quad_1_a/imu" in found)

    ours.process.kill()
    one.until("topics", lambda found: found.get("/quad_1_a/fix") is None)
    bridge(federation, "--router", f"tcp/127.0.0.1:{port}")
    receives_again()

    end_s = now_s()
    world.process.kill()
    world.ends(-9)
    federation.world(NEVER, "--realtime")
    again = one.receive("/quad_1_a/imu", lambda m: seconds(m["header"]) < end_s)
    assert again["header"]["frame_id"] == "quad_1_a/imu_link"
    other.until("topics", lambda found: "/quad_1_a/imu" in found)
    second.close()


def test_the_bridge_joins_a_secured_world_as_an_operator(federation: Federation, ros: ROS, tmp_path: Path) -> None:
    """The bridge presents its certificate to the world but none to ROS's router, which is on this machine."""
    made = Certificates(tmp_path / "certs")
    world = made.identity("world", access_control(scenario_file.from_text(NEVER), ["operator.ros"], {}))
    federation.endpoint = tls_endpoint()
    federation.world(NEVER, "--rate", "4", "--tls", str(world.tls), "--access", str(world.access))
    peer, router = ros
    port = free_port()
    router(port)
    ours = bridge(federation, "--tls", str(made.of("operator.ros")), "--router", f"tcp/127.0.0.1:{port}")
    node = peer(port)
    node.request("subscribe", topic="/quad_1_a/state", kind="std_msgs/msg/String")
    node.receive("/quad_1_a/state", lambda m: m["data"] == "landed")
    node.request("publish", topic="/quad_1_a/takeoff", kind=EMPTY, fields={})
    node.receive("/quad_1_a/state", lambda m: m["data"] == "hovering")
    ours.signal(signal.SIGTERM)
    ours.ends(with_code=0)
    assert ours.lines[-1].text.startswith("operator.ros: ")


def test_without_a_ros_router_peers_do_not_find_each_other(federation: Federation, ros: ROS) -> None:
    """As docs/ros2.md states, peers, ROS's default, reach the drones but need rmw_zenohd to find each other."""
    federation.world(NEVER, "--rate", "2")
    bridge(federation)
    peer, _ = ros
    port = port_of(federation.endpoint)
    listeners = {mode: peer(port, mode) for mode in ("peer", "client")}
    for mode in listeners:
        peer(port, mode).request("publish", topic=f"/of_{mode}", kind="std_msgs/msg/String", fields={"data": "hello"})
    found = listeners["client"].until("topics", lambda found: {"/of_peer", "/of_client"} <= found.keys())
    assert "/quad_1_a/imu" in found
    found = listeners["peer"].until("topics", lambda found: {"/quad_1_a/imu", "/of_client"} <= found.keys())
    assert "/of_peer" not in found
