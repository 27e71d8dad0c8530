"""From zsim's messages to those of ROS 2: SI units and ENU/FLU frames on both sides, so mostly names change. Pure.

Frames as REP-103 and REP-105 have them: map is W (east, north, up); of each drone `NAME/odom`, the frame of its
estimate (it lies on map, since the estimate is of W), `NAME/base_link` (forward, left, up), and a frame for each
sensor. Quaternions are w first. Covariances are row-major; unknown ones are zero, unless the message's definition has
a sign for it.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_jazzy as ros

from zsim.contract import flight_messages, messages, run_messages
from zsim.contract.flight_messages import Quaternion
from zsim.math.frames import (
    quaternion_conjugate,
    quaternion_from_matrix,
    quaternion_from_rpy,
    quaternion_multiply,
    rotate,
    rotation_matrix,
)
from zsim.math.rotation import LEVEL
from zsim.schema.message import Vector3
from zsim.sensors.camera_model import camera_pose
from zsim.sensors.sensor import ErrorModel, Mount, noise_sigma
from zsim.sensors.sensor_catalogue import Sensors
from zsim.sensors.stock_sensors import SonarConfig
from zsim_bridges.ros_frames import xyzw

MAP = "map"
# A sonar looks along -z of its sensor frame; the x axis of a ROS range finder is its beam: turned by 90 deg about y.
_ALONG_BEAM = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)


class FramePose(NamedTuple):
    """The pose of a frame in another one."""

    parent: str
    child: str
    position_m: Vector3
    orientation_wxyz: Quaternion


def odom(drone: str) -> str:
    return f"{drone}/odom"


def base(drone: str) -> str:
    return f"{drone}/base_link"


def sensor(drone: str, kind: str) -> str:
    return f"{drone}/{kind}_link"


def camera_frame(drone: str, camera: str) -> str:
    """Return the frame of a camera: x to the right of the picture, y down, z ahead (REP 103)."""
    return f"{drone}/{camera}_camera_optical_frame"


def cluster(name: str) -> str:
    return f"cluster/{name}"


def static_frames(drone: str, sensors: Sensors) -> Iterator[FramePose]:
    """Yield the frames of a drone that never move: its odom in map, its sensors in its body."""
    yield FramePose(MAP, odom(drone), (0.0, 0.0, 0.0), LEVEL)
    for kind in ("imu", "gps", "mag", "baro"):
        mount: Mount = getattr(sensors, kind).mount
        yield FramePose(base(drone), sensor(drone, kind), mount.position_m, _mount_rotation(mount))
    beam = quaternion_multiply(_mount_rotation(sensors.sonar.mount), _ALONG_BEAM)
    yield FramePose(base(drone), sensor(drone, "sonar"), sensors.sonar.mount.position_m, _quaternion(beam))
    for name, camera in sensors.cameras().items():
        p_BK, R_BK = camera_pose(camera)
        x, y, z = p_BK.tolist()
        yield FramePose(base(drone), camera_frame(drone, name), (x, y, z), _quaternion(quaternion_from_matrix(R_BK)))


def _mount_rotation(mount: Mount) -> Quaternion:
    """Return q_BS."""
    return _quaternion(quaternion_from_rpy(np.radians(mount.rpy_deg)))


def _quaternion(q: np.ndarray) -> Quaternion:
    w, x, y, z = q.tolist()
    return w, x, y, z


Array = NDArray[np.float64]
Time, Header = ros.builtin_interfaces__msg__Time, ros.std_msgs__msg__Header
RosVector3, Point, RosQuaternion = (
    ros.geometry_msgs__msg__Vector3,
    ros.geometry_msgs__msg__Point,
    ros.geometry_msgs__msg__Quaternion,
)

TESLA_PER_UT = 1e-6
UNKNOWN = np.array([-1.0, *[0.0] * 8])  # of sensor_msgs/Imu without an attitude
GPS_SERVICE = 1  # sensor_msgs/NavSatStatus.SERVICE_GPS
KNOWN_DIAGONAL = 2  # sensor_msgs/NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
ULTRASOUND = 0  # sensor_msgs/Range
BEAM_RAD = 0.0  # the model's beam is a line
DISCHARGING, GOOD, LIPO = 2, 1, 3  # sensor_msgs/BatteryState
NO_CELLS = np.empty(0, dtype=np.float32)
NAN = math.nan
NS_PER_S = 1_000_000_000


def stamp(t_ns: int) -> Any:
    """Return simulated time as ROS writes it."""
    return Time(*divmod(t_ns, NS_PER_S))


def header(t_ns: int, frame: str) -> Any:
    return Header(stamp(t_ns), frame)


def clock(message: run_messages.Clock) -> Any:
    return ros.rosgraph_msgs__msg__Clock(stamp(message.t_ns))


def imu(message: messages.Imu, frame: str, gyro: Array, accel: Array) -> Any:
    """Return specific force and rates, without an attitude. `gyro` and `accel` are covariances (9,)."""
    return ros.sensor_msgs__msg__Imu(
        header(message.t_sample_ns, frame),
        RosQuaternion(0.0, 0.0, 0.0, 1.0),
        UNKNOWN,
        RosVector3(*message.gyro_rad_s),
        gyro,
        RosVector3(*message.accel_m_s2),
        accel,
    )


def fix(message: messages.Gps, frame: str) -> Any:
    """Return a fix: altitude over the ellipsoid, covariance in ENU."""
    status: Any = ros.sensor_msgs__msg__NavSatStatus(0 if message.fix else -1, GPS_SERVICE)
    return ros.sensor_msgs__msg__NavSatFix(
        header(message.t_sample_ns, frame),
        status,
        message.latitude_deg,
        message.longitude_deg,
        message.altitude_m,
        diagonal(message.sigma_m**2),
        KNOWN_DIAGONAL,
    )


def fix_velocity(message: messages.Gps, frame: str) -> Any:
    """Return the receiver's velocity in `frame`, which is ENU."""
    twist = ros.geometry_msgs__msg__Twist(RosVector3(*message.velocity_m_s), RosVector3(0.0, 0.0, 0.0))
    return ros.geometry_msgs__msg__TwistStamped(header(message.t_sample_ns, frame), twist)


def mag(message: messages.Mag, frame: str, covariance: Array) -> Any:
    """Return the field [T]."""
    field = RosVector3(*(TESLA_PER_UT * each for each in message.field_ut))
    return ros.sensor_msgs__msg__MagneticField(header(message.t_sample_ns, frame), field, covariance)


def pressure(message: messages.Baro, frame: str) -> Any:
    return ros.sensor_msgs__msg__FluidPressure(header(message.t_sample_ns, frame), message.pressure_pa, 0.0)


def sonar_range(message: messages.Sonar, frame: str, sonar: SonarConfig, variance: float) -> Any:
    """Return a distance; without an echo it is +Inf (REP-117)."""
    return ros.sensor_msgs__msg__Range(
        header(message.t_sample_ns, frame),
        ULTRASOUND,
        BEAM_RAD,
        sonar.min_m,
        sonar.max_m,
        message.range_m if message.valid else math.inf,
        variance,
    )


def battery(message: flight_messages.Status, frame: str) -> Any:
    return ros.sensor_msgs__msg__BatteryState(
        header(message.t_ns, frame),
        NAN, NAN, NAN, NAN, NAN, NAN,
        message.battery_percent / 100.0,
        DISCHARGING, GOOD, LIPO,
        True, NO_CELLS, NO_CELLS, "", "",
    )  # fmt: skip


def state(message: flight_messages.Status) -> Any:
    return ros.std_msgs__msg__String(message.state)


def true_odometry(message: flight_messages.Truth, frame: str, child: str) -> Any:
    """Return the true state; twist in the body, without any uncertainty."""
    q = message.orientation_wxyz
    nothing = np.zeros(36)
    return ros.nav_msgs__msg__Odometry(
        header(message.t_ns, frame),
        child,
        ros.geometry_msgs__msg__PoseWithCovariance(ros_pose(message.position_m, q), nothing),
        _twist(into_body(q, message.velocity_m_s), message.angular_velocity_rad_s, nothing),
    )


def odometry(message: flight_messages.Estimate, frame: str, child: str, w_WB_B: Vector3) -> Any:
    """Return an estimate; twist in the body. Of the attitude only the heading has an uncertainty."""
    P = np.array(message.covariance).reshape(6, 6)
    R = rotation_matrix(message.orientation_wxyz)
    of_pose, of_twist = np.zeros((6, 6)), np.zeros((6, 6))
    of_pose[:3, :3], of_pose[5, 5] = P[:3, :3], message.yaw_sigma_rad**2
    of_twist[:3, :3] = R.T @ P[3:, 3:] @ R
    q = message.orientation_wxyz
    return ros.nav_msgs__msg__Odometry(
        header(message.t_ns, frame),
        child,
        ros.geometry_msgs__msg__PoseWithCovariance(ros_pose(message.position_m, q), of_pose.ravel()),
        _twist(into_body(q, message.velocity_m_s), w_WB_B, of_twist.ravel()),
    )


def into_body(q_WB: Quaternion, v_W: Vector3) -> list[float]:
    """Return v_B = R_WB^T v_W."""
    return rotate(quaternion_conjugate(q_WB), v_W).tolist()


def _twist(linear: Sequence[float], angular: Vector3, covariance: Array) -> Any:
    twist = ros.geometry_msgs__msg__Twist(RosVector3(*linear), RosVector3(*angular))
    return ros.geometry_msgs__msg__TwistWithCovariance(twist, covariance)


def ros_pose(position_m: Vector3, q: Quaternion) -> Any:
    return ros.geometry_msgs__msg__Pose(Point(*position_m), ros_quaternion(q))


def ros_quaternion(q: Quaternion) -> Any:
    """Return a quaternion in ROS's order: w last."""
    return RosQuaternion(*xyzw(q))


def transform(t_ns: int, pose: FramePose) -> Any:
    moved = ros.geometry_msgs__msg__Transform(RosVector3(*pose.position_m), ros_quaternion(pose.orientation_wxyz))
    return ros.geometry_msgs__msg__TransformStamped(header(t_ns, pose.parent), pose.child, moved)


def transforms(t_ns: int, poses: list[FramePose]) -> Any:
    return ros.tf2_msgs__msg__TFMessage([transform(t_ns, each) for each in poses])


def cluster_pose(message: flight_messages.ClusterState, parent: str, name: str) -> FramePose:
    """Return the pose of the cluster frame C by the estimates; a pair has no roll."""
    values = dict(zip(message.names, message.value, strict=True))
    x, y, z, roll, pitch, yaw = (values.get(each, 0.0) for each in ("x_c", "y_c", "z_c", "roll", "pitch", "yaw"))
    q = LEVEL if not roll and not pitch and not yaw else tuple(quaternion_from_rpy((roll, pitch, yaw)).tolist())
    return FramePose(parent, cluster(name), (x, y, z), q)


def pose_stamped(t_ns: int, pose: FramePose) -> Any:
    """Return a pose as a message."""
    message = ros_pose(pose.position_m, pose.orientation_wxyz)
    return ros.geometry_msgs__msg__PoseStamped(header(t_ns, pose.parent), message)


def cluster_state(kind: Any, message: flight_messages.ClusterState, frame: str) -> Any:
    """Return a zsim_msgs/ClusterState; `kind` is its class."""
    return kind(
        header=header(message.t_ns, frame),
        phase=message.phase,
        drones=list(message.drones),
        names=list(message.names),
        value=np.array(message.value),
        desired=np.array(message.desired),
        desired_rate=np.array(message.desired_rate),
        trajectory_time=NAN if message.trajectory_t_s is None else message.trajectory_t_s,
        margin=message.margin,
        reason=message.reason,
    )


def variance(error: ErrorModel, rate_hz: float) -> float:
    """Return the variance of one sample about its bias, in the unit of the error squared."""
    return noise_sigma(error, rate_hz) ** 2 + error.quantum**2 / 12.0  # a step's rounding is uniform


def diagonal(each: float) -> Array:
    """Return a covariance (9,) of three independent axes."""
    return np.diag([each] * 3).ravel()
