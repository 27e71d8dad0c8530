"""The conversion from zsim's messages to ROS 2: stamps, frames, signs, units and covariances."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from federation import ONE

from zsim.contract import flight_messages, messages
from zsim.contract.flight_messages import Quaternion
from zsim.math.frames import quaternion_from_rpy, quaternion_multiply, rotate
from zsim.scenario import scenario_file
from zsim.schema.message import Vector3
from zsim.sensors.sensor import ErrorModel, Mount
from zsim.sensors.sensor_catalogue import Sensors
from zsim_bridges.ros2 import rmw_zenoh, topics
from zsim_bridges.ros2.topics import DroneCameras, NavdataSummary
from zsim_bridges.vehicle_links.drone_link import BodyAxes

SENSORS = scenario_file.from_text(ONE).drones[0].sensors
T_NS = 3_020_000_000
NORTH: Quaternion = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # the body's x axis points north


def quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    w, x, y, z = quaternion_from_rpy((roll, pitch, yaw)).tolist()
    return w, x, y, z


def estimate(t_ns: int, q: Quaternion, **others: Any) -> flight_messages.Estimate:
    fields: dict[str, Any] = {
        "position_m": (1.0, 2.0, 3.0),
        "velocity_m_s": (0.0, 2.0, 0.5),
        "yaw_rad": 0.0,
        "covariance": tuple(float(k) for k in np.diag([1, 2, 3, 4, 5, 6]).ravel()),
        "yaw_sigma_rad": 0.1,
        "gyro_bias_rad_s": (0.0, 0.0, 0.0),
        "sensors": {},
    }
    return flight_messages.Estimate(t_ns, 0, orientation_wxyz=q, **{**fields, **others})


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def all_topics() -> dict[str, topics.Topic]:
    drone = topics.drone_topics("drone1", "drone1", SENSORS)
    cluster = topics.cluster_topics("main", "main")
    run = topics.run_topics(topics.RosNames({"drone1": "drone1"}, {"main": "main"}))
    cameras = DroneCameras("drone1", "drone1").topics()
    return {topic.name: topic for topic in (*run, *drone, *cameras, *cluster)}


def convert(topic: str, message: Any) -> Any:
    """Return the ROS message into which a topic converts a message of its first source, after a CDR round trip."""
    found = all_topics()[topic]
    converted = found.convert(found.sources[0], message)
    return rmw_zenoh.decode(rmw_zenoh.encode(converted, found.kind), found.kind)


def test_samples_are_stamped_with_their_sampling_time() -> None:
    imu = convert("/drone1/imu", messages.Imu(T_NS, 0, T_NS - 15_000_000, (0.0, 0.0, 9.81), (0.1, 0.2, 0.3)))
    assert (imu.header.stamp.sec, imu.header.stamp.nanosec) == (3, 5_000_000)
    assert (imu.header.frame_id, xyz(imu.angular_velocity)) == ("drone1/imu_link", [0.1, 0.2, 0.3])
    assert xyz(imu.linear_acceleration) == [0.0, 0.0, 9.81]
    assert imu.orientation_covariance[0] == -1.0


def test_times_before_the_start_are_encoded_as_in_ros() -> None:
    """A sample may precede the start: the seconds are then negative and the nanoseconds stay positive."""
    stamp = topics.stamp(-20_000_000)
    assert (stamp.sec, stamp.nanosec) == (-1, 980_000_000)


def test_covariances_follow_the_error_models_of_the_scenario() -> None:
    error = ErrorModel(noise=0.3, density=0.02, quantum=0.1)
    assert topics.variance(error, 100.0) == pytest.approx(0.09 + 0.04 + 0.01 / 12)
    imu = convert("/drone1/imu", messages.Imu(T_NS, 0, T_NS, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)))
    gyro = math.radians(math.sqrt(topics.variance(SENSORS.imu.gyro_deg_s, SENSORS.imu.rate_hz)))
    assert imu.angular_velocity_covariance.reshape(3, 3) == pytest.approx(np.eye(3) * gyro**2)


def test_a_fix_has_ellipsoidal_height_and_variance() -> None:
    gps = messages.Gps(T_NS, 0, T_NS, -34.6, -58.4, 27.5, (0.0, 0.0, 2.5), (1.0, -2.0, 0.5), 1.5, 3, 9)
    fix = convert("/drone1/fix", gps)
    assert (fix.latitude, fix.longitude, fix.altitude, fix.status.status) == (-34.6, -58.4, 27.5, 0)
    assert fix.position_covariance.reshape(3, 3) == pytest.approx(np.eye(3) * 2.25)
    assert xyz(convert("/drone1/fix_velocity", gps).twist.linear) == [1.0, -2.0, 0.5]


def test_the_field_is_in_tesla_and_a_range_without_echo_is_infinite() -> None:
    mag = convert("/drone1/mag", messages.Mag(T_NS, 0, T_NS, (20.0, -3.0, 14.0)))
    assert xyz(mag.magnetic_field) == pytest.approx([20e-6, -3e-6, 14e-6])
    assert convert("/drone1/range", messages.Sonar(T_NS, 0, T_NS, 1.25, True)).range == 1.25
    assert convert("/drone1/range", messages.Sonar(T_NS, 0, T_NS, 6.0, False)).range == math.inf


def test_the_true_twist_is_in_the_body_frame() -> None:
    """A drone that heads north and flies north and up moves forward and up."""
    still, rotors = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)
    truth = flight_messages.Truth(T_NS, 0, (1.0, 2.0, 3.0), (0.0, 2.0, 0.5), NORTH, (0.1, 0.2, 0.3), still, rotors)
    odometry = convert("/drone1/ground_truth", truth)
    assert xyz(odometry.twist.twist.linear) == pytest.approx([2.0, 0.0, 0.5])
    assert xyz(odometry.twist.twist.angular) == [0.1, 0.2, 0.3]
    assert xyz(odometry.pose.pose.position) == [1.0, 2.0, 3.0]
    q = odometry.pose.pose.orientation
    assert (q.w, q.x, q.y, q.z) == NORTH
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "drone1/base_link")


def test_odometry_has_the_covariance_of_the_estimate_in_its_frames() -> None:
    """East and north are swapped in the body frame of a drone that heads north; only the yaw angle has a sigma."""
    odometry = convert("/drone1/odometry", estimate(T_NS, NORTH))
    assert odometry.pose.covariance.reshape(6, 6) == pytest.approx(np.diag([1, 2, 3, 0, 0, 0.01]))
    assert odometry.twist.covariance.reshape(6, 6) == pytest.approx(np.diag([5, 4, 6, 0, 0, 0]))
    assert xyz(odometry.twist.twist.linear) == pytest.approx([2.0, 0.0, 0.5])
    assert odometry.header.frame_id == "drone1/odom"


@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.5), (0.0, 0.0, -0.5), (2.0, -1.0, 0.3), (0.0, 0.0, 0.0)])
def test_the_angular_rate_of_odometry_follows_from_its_attitudes(rate: Vector3) -> None:
    """Two attitudes 20 ms apart differ by the body rate; the sign of the quaternion does not matter."""
    maker = topics.OdometryTopic("odom", "base")
    half = [0.01 * each for each in rate]
    angle = math.hypot(*half)
    first = quaternion(0.1, -0.2, 3.0)
    turn = [math.cos(angle), *(math.sin(angle) / angle * each if angle else 0.0 for each in half)]
    second = quaternion_multiply(first, turn)
    maker.update("", estimate(T_NS, first))
    for q in (second, -second):
        maker.update("", estimate(T_NS, first))
        odometry = maker.update("", estimate(T_NS + 20_000_000, tuple(q.tolist())))
        assert xyz(odometry.twist.twist.angular) == pytest.approx(rate, abs=1e-9)


def test_into_body_is_the_inverse_of_rotate() -> None:
    q = quaternion(0.3, -0.4, 2.0)
    assert rotate(q, topics.into_body(q, (1.0, 2.0, 3.0))) == pytest.approx([1.0, 2.0, 3.0])


def test_the_sonar_frame_points_along_the_beam_of_a_tilted_mount() -> None:
    """Range finders of ROS look along x. The sonar is tilted by -30 deg about y, which turns its beam forward."""
    mount = Mount(position_m=(0.1, 0.0, -0.02), rpy_deg=(0.0, -30.0, 0.0))
    spec = _with_sonar(mount)
    placed = {frame.child_frame_id: frame for frame in topics.static_transforms("drone1", spec)}
    sonar = placed["drone1/sonar_link"].transform
    assert xyz(sonar.translation) == [0.1, 0.0, -0.02]
    q = sonar.rotation
    beam = rotate((q.w, q.x, q.y, q.z), (1.0, 0.0, 0.0))
    assert beam == pytest.approx([math.sin(math.radians(30)), 0.0, -math.cos(math.radians(30))])
    assert placed["drone1/odom"].header.frame_id == "map"


def _with_sonar(mount: Mount) -> Sensors:
    position, turn = list(mount.position_m), list(mount.rpy_deg)
    mounted = f"sensors: {{preset: paper, sonar: {{mount: {{position_m: {position}, rpy_deg: {turn}}}}}}}"
    return scenario_file.from_text(ONE.replace("sensors: {preset: paper}", mounted)).drones[0].sensors


def test_tf_links_odom_to_base_and_map_to_the_cluster() -> None:
    tf: Any = all_topics()["/tf"]
    (moved,) = tf.convert("drone/drone1/estimate", estimate(T_NS, NORTH)).transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("drone1/odom", "drone1/base_link")
    assert xyz(moved.transform.translation) == [1.0, 2.0, 3.0]
    (placed,) = tf.convert("cluster/main/state", cluster_state()).transforms
    assert (placed.header.frame_id, placed.child_frame_id) == ("map", "cluster/main")


def cluster_state(**others: Any) -> flight_messages.ClusterState:
    names = ("x_c", "y_c", "z_c", "pitch", "yaw", "phi_1", "phi_2", "p")
    fields: dict[str, Any] = {"trajectory_t_s": None, "margin": 4.0, "reason": ""}
    value = (1.0, 2.0, 3.0, 0.0, math.pi / 2, 0.0, 0.0, 4.0)
    return flight_messages.ClusterState(
        T_NS, 0, "engaged", ("a", "b"), names, value, value, (0.0,) * 8, **{**fields, **others}
    )


def test_a_cluster_has_a_pose_and_a_state() -> None:
    pose = convert("/cluster/main/pose", cluster_state())
    assert xyz(pose.pose.position) == [1.0, 2.0, 3.0]
    assert (pose.pose.orientation.w, pose.pose.orientation.z) == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))
    state = convert("/cluster/main/state", cluster_state())
    assert (state.phase, state.drones, state.names[0]) == ("engaged", ["a", "b"], "x_c")
    assert math.isnan(state.trajectory_time)
    assert convert("/cluster/main/state", cluster_state(trajectory_t_s=1.5)).trajectory_time == 1.5


def status(t_ns: int, state: flight_messages.DroneState = "flying") -> flight_messages.Status:
    return flight_messages.Status(t_ns, 0, state, 62.5, False, None, 1)


def test_the_battery_is_published_every_second_and_the_state_on_change_too() -> None:
    found = all_topics()
    battery, state = found["/drone1/battery"].convert, found["/drone1/state"].convert
    times = range(0, 2_000_000_000, 20_000_000)
    assert [t for t in times if battery("", status(t))] == [0, 1_000_000_000]
    states = [
        (t, made.data) for t in times if (made := state("", status(t, "landed" if t < 500_000_000 else "flying")))
    ]
    assert states == [(0, "landed"), (500_000_000, "flying"), (1_000_000_000, "flying")]
    assert convert("/drone1/battery", status(0)).percentage == pytest.approx(0.625)


def test_navdata_has_the_units_and_signs_of_the_driver() -> None:
    """Right side down, nose down and counter-clockwise are positive; the units are g, mm, mm/s, deg, Pa and us."""
    navdata = NavdataSummary("base", BodyAxes())
    converted: dict[str, Any] = {
        "imu": messages.Imu(T_NS, 0, T_NS, (0.0, -4.903325, 9.80665), (0.0, 0.0, 0.0)),
        "baro": messages.Baro(T_NS, 0, T_NS, 101_325.4, 0.0),
        "sonar": messages.Sonar(T_NS, 0, T_NS, 1.2346, True),
        "flow": messages.Flow(T_NS, 0, T_NS, (1.5, -0.5, 0.0), 1.0),
        "mag": messages.Mag(T_NS, 0, T_NS, (1.0, 2.0, 3.0)),
    }
    for kind, message in converted.items():
        assert navdata.update(f"drone/drone1/sensor/{kind}", message) is None
    navdata.update("drone/drone1/estimate", estimate(T_NS, quaternion(0.1, 0.2, 0.3)))
    made: Any = navdata.update("drone/drone1/sensor/status", status(T_NS))
    assert (made.state, made.battery_percent, made.pressure, made.altd) == (3, 62.5, 101_325, 1235)
    assert (made.rot_x, made.rot_y, made.rot_z) == pytest.approx(tuple(np.degrees([0.1, 0.2, 0.3])))
    assert (made.ax, made.ay, made.az) == pytest.approx((0.0, -0.5, 1.0))
    assert (made.vx, made.vy, made.tm) == (1500.0, -500.0, 3_020_000.0)
    assert rmw_zenoh.encode(made, "zsim_msgs/msg/Navdata")


def test_navdata_of_rotated_sensors_is_in_the_axes_of_the_body() -> None:
    axes = BodyAxes(imu=Mount(rpy_deg=(0.0, 0.0, 90.0)), mag=Mount(rpy_deg=(180.0, 0.0, 0.0)))
    navdata = NavdataSummary("base", axes)
    navdata.update("drone/drone1/sensor/imu", messages.Imu(T_NS, 0, T_NS, (4.903325, 0.0, 9.80665), (0.0, 0.0, 0.0)))
    navdata.update("drone/drone1/sensor/mag", messages.Mag(T_NS, 0, T_NS, (1.0, 2.0, 3.0)))
    made: Any = navdata.update("drone/drone1/sensor/status", status(T_NS))
    assert (made.ax, made.ay, made.az) == pytest.approx((0.0, 0.5, 1.0))
    assert (made.mag_x, made.mag_y, made.mag_z) == pytest.approx((1.0, -2.0, -3.0))


def test_navdata_without_samples_is_zero_or_nan() -> None:
    navdata = NavdataSummary("base", BodyAxes())
    made: Any = navdata.update("drone/drone1/sensor/status", status(0, "emergency"))
    assert (made.state, made.pressure, made.altd) == (0, 0, 0)
    assert math.isnan(made.rot_x)
    assert math.isnan(made.az)


def test_the_table_in_the_documentation_has_every_topic() -> None:
    """The table in docs/ros2.md has topic, type, frame and QoS; NAME stands for the drone or the cluster."""
    page = (Path(__file__).parents[4] / "docs" / "ros2.md").read_text()
    qos = {rmw_zenoh.SENSOR: "sensor", rmw_zenoh.DEFAULT: "default", rmw_zenoh.CLOCK: "clock", rmw_zenoh.TF: "tf"}
    rows = [[cell.strip().strip("`") for cell in line.split("|")[1:-1]] for line in page.splitlines() if "|" in line]
    converted = {row[0]: (row[1], row[3]) for row in rows if len(row) == 6 and row[0].startswith("/")}
    assert converted.pop("/tf_static") == ("tf2_msgs/msg/TFMessage", "static")
    found = {name.replace("drone1", "NAME").replace("main", "NAME"): topic for name, topic in all_topics().items()}
    assert converted == {name: (topic.kind, qos[topic.qos]) for name, topic in found.items()}
