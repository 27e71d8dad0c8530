"""Debian's unmodified ROS 1 tools and rospy observe and fly a drone through `zsim ros1`."""

import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import ros1_graph
from federation import ONE, Federation, Role
from picture_pump import calibration, pumping
from ros1_graph import RosGraph, numbers

CLIMB = Path(__file__).parent / "ros1_climb.py"
PACE = ("--rate", "2", "--duration", "3600")
TRUTH = "/drone1/ground_truth/state/pose/pose/position"
NAVDATA = """
Header header
float32 batteryPercent
uint32 state
int32 magX
int32 magY
int32 magZ
int32 pressure
int32 temp
float32 wind_speed
float32 wind_angle
float32 wind_comp_angle
float32 rotX
float32 rotY
float32 rotZ
int32 altd
float32 vx
float32 vy
float32 vz
float32 ax
float32 ay
float32 az
uint8 motor1
uint8 motor2
uint8 motor3
uint8 motor4
uint32 tags_count
uint32[] tags_type
uint32[] tags_xc
uint32[] tags_yc
uint32[] tags_width
uint32[] tags_height
float32[] tags_orientation
float32[] tags_distance
float32 tm
"""  # ardrone_autonomy/msg/Navdata.msg, which the driver's package would build
IMAGE, CAMERA_INFO = "sensor_msgs/CompressedImage", "sensor_msgs/CameraInfo"
OFFERED = {
    **{f"/drone1/ardrone/{camera}image_raw/compressed": IMAGE for camera in ("", "front/", "bottom/")},
    **{f"/drone1/ardrone/{camera}camera_info": CAMERA_INFO for camera in ("", "front/", "bottom/")},
    "/clock": "rosgraph_msgs/Clock",
    "/tf": "tf2_msgs/TFMessage",
    "/drone1/ardrone/imu": "sensor_msgs/Imu",
    "/drone1/ardrone/land": "std_msgs/Empty",
    "/drone1/ardrone/mag": "geometry_msgs/Vector3Stamped",
    "/drone1/ardrone/navdata": "ardrone_autonomy/Navdata",
    "/drone1/ardrone/odometry": "nav_msgs/Odometry",
    "/drone1/ardrone/reset": "std_msgs/Empty",
    "/drone1/ardrone/takeoff": "std_msgs/Empty",
    "/drone1/cmd_vel": "geometry_msgs/Twist",
    "/drone1/fix": "sensor_msgs/NavSatFix",
    "/drone1/ground_truth/state": "nav_msgs/Odometry",
}


@pytest.fixture(scope="module", autouse=True)
def installed() -> None:
    """Skip this file, with the reason, if ROS 1 is not installed."""
    if reason := ros1_graph.missing():
        pytest.skip(reason)


class Flight:
    """A world with an estimator, and the bridge with its ROS graph."""

    def __init__(self, federation: Federation, graph: RosGraph) -> None:
        self.graph = graph
        self.federation = federation
        self.world = federation.world(ONE, *PACE)
        self.estimator = federation.role("estimator", "drone1")
        self.bridge = bridge(federation, graph)
        self.bridge.line("registered with the ROS master")


def bridge(federation: Federation, graph: RosGraph) -> Role:
    return federation.role("ros1", "--master", graph.uri, "--ros-host", "127.0.0.1")


@pytest.fixture(scope="module")
def flight(installed: None, tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Iterator[Flight]:
    """A flight shared by the tests of this file, each of which leaves the drone on the ground."""
    folder = tmp_path_factory.mktemp("ros1")
    graph = RosGraph(folder)
    with Federation(folder) as federation:
        try:
            graph.start_master()
            graph.generate("ardrone_autonomy", "Navdata", NAVDATA)
            yield Flight(federation, graph)
        finally:
            graph.close()


@pytest.fixture
def graph(flight: Flight) -> RosGraph:
    return flight.graph


@pytest.mark.soak
def test_pictures_arrive_as_the_camera_published_them(flight: Flight, graph: RosGraph):
    """The ROS tools receive the pictures of an external camera and its calibration."""
    camera = flight.federation.client()
    camera.put("drone/drone1/camera/front/info", **calibration())
    with pumping(camera, "drone/drone1/camera/front"):
        for base in ("/drone1/ardrone/front", "/drone1/ardrone"):
            echoed = graph.run("rostopic", "echo", "-n", "1", f"{base}/image_raw/compressed")
            assert 'frame_id: "drone1/ardrone_base_frontcam"' in echoed
            assert 'format: "jpeg"' in echoed
            assert "data: [255, 216, 255," in echoed
            seen = graph.run("rostopic", "echo", "-n", "1", f"{base}/camera_info")
            assert 'distortion_model: "plumb_bob"' in seen
            assert "K: [50.0, 0.0, 31.5, 0.0, 51.0, 17.5, 0.0, 0.0, 1.0]" in seen
        graph.run("rosservice", "call", "/drone1/ardrone/togglecam")
        other = graph.start("rostopic", "echo", "/drone1/ardrone/image_raw/compressed/header/frame_id")
        with pumping(camera, "drone/drone1/camera/bottom"):
            assert "bottomcam" in other.until(lambda line: "cam" in line)
        graph.run("rosservice", "call", "/drone1/ardrone/togglecam")


def test_the_tools_list_what_the_driver_offers(graph: RosGraph):
    listed = graph.run("rostopic", "list", "-v")
    found = dict(re.findall(r"^ \* (\S+) \[(\S+)\]", listed, re.MULTILINE))
    assert {topic: found[topic] for topic in OFFERED} == OFFERED
    assert re.search(r"/drone1/cmd_vel \[geometry_msgs/Twist\] 1 subscriber", listed)
    assert graph.run("rosservice", "type", "/drone1/ardrone/flattrim").strip() == "std_srvs/Empty"


@pytest.mark.soak
def test_rostopic_measures_the_sensor_rates_in_simulated_time(graph: RosGraph):
    rates_hz = {"ardrone/imu": 200.0, "ardrone/navdata": 50.0, "fix": 5.0}
    watched = {topic: graph.start("rostopic", "hz", "-w", "200", f"/drone1/{topic}") for topic in rates_hz}
    for topic, hz in watched.items():
        hz.until(lambda line, topic=topic: "average rate" in line and _is_near(line, rates_hz[topic]))
        hz.end()


def _is_near(line: str, rate_hz: float) -> bool:
    return abs(float(line.split()[-1]) - rate_hz) < 0.1 * rate_hz


def test_rostopic_echoes_navdata_with_the_generated_type(graph: RosGraph):
    output = graph.run("rostopic", "echo", "-n", "1", "/drone1/ardrone/navdata")
    values = dict(re.findall(r"^(\w+): (\S+)$", output, re.MULTILINE))
    assert values["state"] == "2"
    assert 50.0 < float(values["batteryPercent"]) <= 100.0
    assert abs(float(values["rotZ"]) - 90.0) < 20.0  # the scenario's yaw_deg, as estimated with the magnetometer
    assert abs(float(values["az"]) - 1.0) < 0.2
    assert int(values["altd"]) < 200


def test_rostopic_and_roscpp_fly_and_track_a_drone(graph: RosGraph):
    truth = graph.watch(TRUTH)
    truth.until(numbers)
    asked = graph.run("rosnode", "info", "/zsim")  # answered by the node itself
    assert re.search(r"topic: /drone1/ground_truth/state\n    \* to: /rostopic\S+\n    \* direction: outbound", asked)
    graph.run("rosservice", "call", "/drone1/ardrone/flattrim")
    with graph.published("/drone1/ardrone/takeoff", "std_msgs/Empty"):
        truth.until(lambda line: (at := numbers(line)) and at[3] > 0.9)
    assert "landed" in graph.refused("rosservice", "call", "/drone1/ardrone/flattrim")
    _, x, y, _ = numbers(truth.until(numbers))
    north = graph.start("rostopic", "pub", "-r", "10", "/drone1/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 0.15}}")
    truth.until(lambda line: (at := numbers(line)) and at[2] > y + 1.5)  # forward is north: yaw_deg 90
    north.end()
    graph.start(ros1_graph.RELAY, "/pilot", "/drone1/cmd_vel")  # relays through roscpp
    graph.start(ros1_graph.RELAY, "/drone1/ground_truth/state", "/copy")
    west = graph.start("rostopic", "pub", "-r", "10", "/pilot", "geometry_msgs/Twist", "{linear: {y: 0.15}}")
    copy = graph.watch("/copy/pose/pose/position")
    copy.until(lambda line: (at := numbers(line)) and at[1] < x - 1.5)  # left of north
    copy.end()
    west.end()
    with graph.published("/drone1/ardrone/land", "std_msgs/Empty"):
        truth.until(lambda line: (at := numbers(line)) and at[3] < 0.1)
    truth.end()


def test_a_rospy_node_for_ardrone_autonomy_flies_unchanged(graph: RosGraph):
    node = graph.start(ros1_graph.PYTHON, str(CLIMB), ROS_NAMESPACE="drone1")
    output = json.loads(node.until(lambda line: line.startswith("{")))
    assert output["states"][:3] == [2, 6, 4]
    assert 3 in output["states"]
    assert output["states"][-2:] == [8, 2]
    assert output["altd"] > 1500  # the excess depends on how soon the node reads
    assert abs(output["ground_truth"] - output["altd"] / 1000) < 0.5
    assert abs(output["rotZ"] - 90.0) < 20.0
    assert output["odometry"] == "drone1/ardrone_base_link"
    assert output["fix"] == pytest.approx(4.0)  # m²: the preset paper has a standard deviation of 2 m
    assert abs(output["mag"]) < 1.0


def test_a_velocity_that_is_not_a_number_is_refused_and_reported(flight: Flight):
    with flight.graph.published("/drone1/cmd_vel", "geometry_msgs/Twist", "{linear: {x: .nan}}"):
        flight.bridge.line("/drone1/cmd_vel: .*/rostopic_.*finite")


def test_a_refusal_of_the_world_is_reported(flight: Flight):
    with flight.graph.published("/drone1/ardrone/land", "std_msgs/Empty"):
        flight.bridge.line("ros1.main: drone/drone1/cmd/mode: drone1 is landed")


@pytest.mark.soak  # test_node.py covers this without ROS's own master
def test_the_bridge_survives_a_late_and_restarted_master_and_unregisters(federation: Federation, tmp_path: Path):
    graph, master = RosGraph(tmp_path), ("rosmaster", "--core")
    federation.world(ONE, *PACE)
    try:
        alone = bridge(federation, graph)
        alone.line("waiting for a ROS master on")
        graph.start_master(*master)
        alone.line("registered with the ROS master")
        graph.stop_master()
        graph.start_master(*master)
        alone.line("registered again with the ROS master")
        assert "/drone1/cmd_vel" in graph.run("rostopic", "list")
        alone.signal(signal.SIGINT)
        alone.ends(with_code=0)
        assert "/zsim" not in graph.run("rosnode", "list")
    finally:
        graph.close()


@pytest.mark.soak
def test_nodes_survive_the_world_and_can_stop_the_bridge(federation: Federation, tmp_path: Path):
    graph = RosGraph(tmp_path)
    try:
        graph.start_master("rosmaster", "--core")
        world, alone = federation.world(ONE, *PACE), bridge(federation, graph)
        alone.line("registered with the ROS master")
        truth = graph.watch(TRUTH)
        truth.until(numbers)
        world.signal(signal.SIGKILL)
        federation.world(ONE, *PACE)
        alone.line("left, the world has begun another run")
        truth.until(numbers)
        graph.run("rosnode", "kill", "/zsim")
        alone.line("requests a shutdown")
        alone.ends(with_code=0)
    finally:
        graph.close()
