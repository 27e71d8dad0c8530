"""The topics of a run in ROS 2: name, type, quality of service, source keys and conversion of each. No I/O.

Frames follow REP-103 and REP-105: map is W (east, north, up); each drone has `NAME/odom`, the frame of its estimate
(identical to map, since estimates are in W), `NAME/base_link` (forward, left, up), and a frame for each sensor.
Quaternions begin with w. Samples are stamped with the time at which they are valid.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.stores import ros2_jazzy

from zsim.contract import keys
from zsim.contract.flight_messages import CameraImage, CameraInfo, ClusterState, Estimate, Quaternion, Status, Truth
from zsim.math.frames import (
    quaternion_conjugate,
    quaternion_from_matrix,
    quaternion_from_rpy,
    quaternion_multiply,
    rotate,
    rotation_matrix,
    rpy_from_quaternion,
)
from zsim.math.rotation import LEVEL
from zsim.schema.message import Vector3
from zsim.schema.quantities import G_M_S2
from zsim.sensors.camera import CAMERAS
from zsim.sensors.camera_model import camera_pose
from zsim.sensors.sensor import ErrorModel, Mount, noise_sigma
from zsim.sensors.sensor_catalogue import Sensors
from zsim_bridges import ros_messages as ros
from zsim_bridges.ros2 import rmw_zenoh
from zsim_bridges.ros2.rmw_zenoh import CLOCK, DEFAULT, SENSOR, TF, Qos
from zsim_bridges.ros_messages import NS_PER_S
from zsim_bridges.vehicle_links.drone_link import BodyAxes

MAP = "map"
DRIVER = "ardrone"  # namespace of ardrone_autonomy's topics and services
# A sonar looks along -z of its sensor frame, a ROS range finder along x: rotation by 90 deg about y.
_BEAM_ROTATION = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
TESLA_PER_UT = 1e-6
NO_ATTITUDE = np.array([-1.0, *[0.0] * 8])  # covariance that marks a sensor_msgs/Imu without an attitude
ULTRASOUND = 0  # sensor_msgs/Range
BEAM_RAD = 0.0  # the model's beam is a line
DISCHARGING, GOOD, LIPO = 2, 1, 3  # sensor_msgs/BatteryState
NO_CELLS = np.empty(0, dtype=np.float32)
NAN = math.nan
ZERO = (0.0, 0.0, 0.0)


class Topic(NamedTuple):
    """A topic that the bridge publishes; `convert` returns the ROS message for a key's message, None if none is due."""

    name: str
    kind: str
    qos: Qos
    sources: tuple[str, ...]
    convert: Callable[[str, Any], Any | None]


class RosNames(NamedTuple):
    """ROS names, by name in the contract."""

    drones: dict[str, str]
    clusters: dict[str, str]


def stamp(t_ns: int) -> Any:
    """Convert simulated time [ns] to ROS time."""
    return ros.Time(*divmod(t_ns, NS_PER_S))


def header(t_ns: int, frame: str) -> Any:
    return ros2_jazzy.std_msgs__msg__Header(stamp(t_ns), frame)


def odom(drone: str) -> str:
    return f"{drone}/odom"


def base(drone: str) -> str:
    return f"{drone}/base_link"


def camera_frame(drone: str, camera: str) -> str:
    """Return the name of a camera's frame: x to the right of the image, y down, z forward (REP 103)."""
    return f"{drone}/{camera}_camera_optical_frame"


def run_topics(names: RosNames) -> Iterator[Topic]:
    def moving_frame(key: str, message: Estimate | ClusterState) -> Any:
        if isinstance(message, ClusterState):
            position, q = cluster_pose(message)
            head, child = header(message.t_ns, MAP), f"cluster/{names.clusters[keys.thing(key)]}"
        else:
            drone, position, q = names.drones[keys.thing(key)], message.position_m, message.orientation_wxyz
            head, child = header(message.t_ns, odom(drone)), base(drone)
        return ros.TFMessage([ros.transform(head, child, position, q)])

    yield Topic("/clock", "rosgraph_msgs/msg/Clock", CLOCK, (keys.CLOCK,), lambda _, m: ros.Clock(stamp(m.t_ns)))
    moving_sources = (*map(keys.estimate, names.drones), *map(keys.cluster_state, names.clusters))
    yield Topic("/tf", "tf2_msgs/msg/TFMessage", TF, moving_sources, moving_frame)


def static_transforms(drone: str, sensors: Sensors) -> Iterator[Any]:
    """Yield a drone's fixed frames as TransformStamped: its odom in map, its sensors in its body."""

    def body_transform(frame: str, position_m: Vector3, q: np.ndarray) -> Any:
        return ros.transform(header(0, base(drone)), frame, position_m, _quaternion(q))

    def rotation(mount: Mount) -> np.ndarray:
        """Return q_BS."""
        return quaternion_from_rpy(np.radians(mount.rpy_deg))

    yield ros.transform(header(0, MAP), odom(drone), ZERO, LEVEL)
    for kind in ("imu", "gps", "mag", "baro"):
        mount: Mount = getattr(sensors, kind).mount
        yield body_transform(f"{drone}/{kind}_link", mount.position_m, rotation(mount))
    beam = quaternion_multiply(rotation(sensors.sonar.mount), _BEAM_ROTATION)
    yield body_transform(f"{drone}/sonar_link", sensors.sonar.mount.position_m, beam)
    for name, camera in sensors.cameras().items():
        p_BK, R_BK = camera_pose(camera)
        x, y, z = p_BK.tolist()
        yield body_transform(camera_frame(drone, name), (x, y, z), quaternion_from_matrix(R_BK))


def _quaternion(q: np.ndarray) -> Quaternion:
    w, x, y, z = q.tolist()
    return w, x, y, z


def drone_topics(drone: str, name: str, sensors: Sensors) -> Iterator[Topic]:
    """Yield a drone's topics; `name` is its name in ROS, `sensors` give the limits and errors of its sensors."""
    imu, mag, sonar = sensors.imu, sensors.mag, sensors.sonar
    rate_covariance = ros.diagonal(np.radians(1.0) ** 2 * variance(imu.gyro_deg_s, imu.rate_hz))
    force_covariance = ros.diagonal(variance(imu.accel_m_s2, imu.rate_hz))
    field_covariance = ros.diagonal(TESLA_PER_UT**2 * variance(mag.field_ut, mag.rate_hz))
    range_variance = variance(sonar.range_m, sonar.rate_hz)

    def sensor_topic(
        leaf: str, kind: str, sensor: str, convert: Callable[[Any, Any], Any], frame: str | None = None
    ) -> Topic:
        """Return the topic of one sensor; `convert` takes a header and a sample."""
        frame = frame or f"{name}/{sensor}_link"
        source = (keys.sensor(drone, sensor),)
        return Topic(f"/{name}/{leaf}", kind, SENSOR, source, lambda _, m: convert(header(m.t_sample_ns, frame), m))

    yield sensor_topic(
        "imu", "sensor_msgs/msg/Imu", "imu",
        lambda head, m: ros.imu(head, m, LEVEL, (NO_ATTITUDE, rate_covariance, force_covariance)),
    )  # fmt: skip
    yield sensor_topic("fix", "sensor_msgs/msg/NavSatFix", "gps", lambda head, m: ros.fix(head, m, bool(m.fix)))
    yield sensor_topic(
        "fix_velocity", "geometry_msgs/msg/TwistStamped", "gps",  # velocity in ENU
        lambda head, m: ros2_jazzy.geometry_msgs__msg__TwistStamped(head, ros.twist(m.velocity_m_s, ZERO)), MAP,
    )  # fmt: skip
    yield sensor_topic(
        "mag", "sensor_msgs/msg/MagneticField", "mag",
        lambda head, m: ros2_jazzy.sensor_msgs__msg__MagneticField(
            head, ros.Vector3(*(TESLA_PER_UT * each for each in m.field_ut)), field_covariance
        ),
    )  # fmt: skip
    yield sensor_topic(
        "pressure", "sensor_msgs/msg/FluidPressure", "baro",
        lambda head, m: ros2_jazzy.sensor_msgs__msg__FluidPressure(head, m.pressure_pa, 0.0),
    )  # fmt: skip
    yield sensor_topic(
        "range", "sensor_msgs/msg/Range", "sonar",  # +Inf without an echo (REP-117)
        lambda head, m: ros2_jazzy.sensor_msgs__msg__Range(
            head, ULTRASOUND, BEAM_RAD, sonar.min_m, sonar.max_m, m.range_m if m.valid else math.inf, range_variance
        ),
    )  # fmt: skip

    estimate, status = keys.estimate(drone), keys.status(drone)
    odometry = OdometryTopic(odom(name), base(name))
    yield Topic(f"/{name}/odometry", "nav_msgs/msg/Odometry", DEFAULT, (estimate,), odometry.update)
    yield Topic(
        f"/{name}/ground_truth", "nav_msgs/msg/Odometry", DEFAULT, (keys.truth(drone),),
        lambda _, m: true_odometry(m, base(name)),
    )  # fmt: skip
    battery_on_change = OnChange(lambda status: battery(status, base(name)))
    state_on_change = OnChange(
        lambda status: ros2_jazzy.std_msgs__msg__String(status.state), lambda status: status.state
    )
    yield Topic(f"/{name}/battery", "sensor_msgs/msg/BatteryState", DEFAULT, (status,), battery_on_change.update)
    yield Topic(f"/{name}/state", "std_msgs/msg/String", DEFAULT, (status,), state_on_change.update)
    summary = NavdataSummary(base(name), BodyAxes(imu.mount, mag.mount))
    sources = (*(keys.sensor(drone, kind) for kind in keys.SENSORS if kind != "gps"), estimate, status)
    yield Topic(f"/{name}/navdata", "zsim_msgs/msg/Navdata", SENSOR, sources, summary.update)


def variance(error: ErrorModel, rate_hz: float) -> float:
    """Return the variance of one sample about its bias, in the unit of the error squared."""
    return noise_sigma(error, rate_hz) ** 2 + error.quantum**2 / 12.0  # the rounding error is uniform


def battery(message: Status, frame: str) -> Any:
    return ros2_jazzy.sensor_msgs__msg__BatteryState(
        header(message.t_ns, frame),
        NAN, NAN, NAN, NAN, NAN, NAN,
        message.battery_percent / 100.0,
        DISCHARGING, GOOD, LIPO,
        True, NO_CELLS, NO_CELLS, "", "",
    )  # fmt: skip


def true_odometry(message: Truth, child: str) -> Any:
    """Return the true state in map, with the twist in the body and zero covariances."""
    q = message.orientation_wxyz
    twist = ros.twist(into_body(q, message.velocity_m_s), message.angular_velocity_rad_s)
    return ros.odometry(header(message.t_ns, MAP), child, ros.pose(message.position_m, q), twist)


def into_body(q_WB: Quaternion, v_W: Vector3) -> list[float]:
    """Return v_B = R_WB^T v_W."""
    return rotate(quaternion_conjugate(q_WB), v_W).tolist()


class OdometryTopic:
    """Converts estimates to Odometry, with the mean angular rate since the previous estimate."""

    def __init__(self, frame: str, child: str) -> None:
        self._frame = frame
        self._child = child
        self._previous: Estimate | None = None

    def update(self, _: str, message: Estimate) -> Any:
        """Return the ROS message, with the twist in the body; the heading is the only angle with a variance."""
        previous, self._previous = self._previous, message
        q = message.orientation_wxyz
        dt_ns = message.t_ns - previous.t_ns if previous else 0
        rate = ros.mean_rate(previous.orientation_wxyz, q, dt_ns / NS_PER_S) if previous and dt_ns > 0 else ZERO
        P = np.array(message.covariance).reshape(6, 6)
        R = rotation_matrix(q)
        pose_covariance, twist_covariance = np.zeros((6, 6)), np.zeros((6, 6))
        pose_covariance[:3, :3], pose_covariance[5, 5] = P[:3, :3], message.yaw_sigma_rad**2
        twist_covariance[:3, :3] = R.T @ P[3:, 3:] @ R
        head, pose = header(message.t_ns, self._frame), ros.pose(message.position_m, q)
        twist = ros.twist(into_body(q, message.velocity_m_s), rate)
        return ros.odometry(head, self._child, pose, twist, pose_covariance.ravel(), twist_covariance.ravel())


class OnChange:
    """Converts a status once per simulated second, and whenever a value derived from it has changed."""

    def __init__(self, convert: Callable[[Status], Any], value: Callable[[Status], object] = lambda _: None) -> None:
        self._convert = convert
        self._value = value
        self._last: tuple[object, int] | None = None

    def update(self, _: str, message: Status) -> Any | None:
        last = self._value(message), message.t_ns // NS_PER_S
        if last == self._last:
            return None
        self._last = last
        return self._convert(message)


class NavdataSummary:
    """Summarises a drone's newest samples as ardrone_autonomy's navdata, in its units, whenever a status arrives."""

    def __init__(self, frame: str, axes: BodyAxes) -> None:
        self._axes = axes
        self._kind = rmw_zenoh.message_class("zsim_msgs/msg/Navdata")
        self._frame = frame
        self._last: dict[str, Any] = {}

    def update(self, key: str, message: Any) -> Any | None:
        """Store a message of the drone; return the summary if the message is its status."""
        leaf = keys.leaf(key)
        if leaf != "status":
            self._last[leaf] = self._axes.converted(message)
            return None

        def scaled(sensor: str, field: str, factor: float) -> list[float]:
            return [factor * value for value in getattr(self._last.get(sensor), field, (NAN, NAN, NAN))]

        def rounded(sensor: str, field: str, factor: float) -> int:
            return round(factor * getattr(self._last.get(sensor), field, 0.0))

        estimate = self._last.get("estimate")
        rpy_deg = np.degrees(rpy_from_quaternion(estimate.orientation_wxyz)) if estimate else (NAN, NAN, NAN)
        return self._kind(
            header=header(message.t_ns, self._frame),
            battery_percent=message.battery_percent,
            state=ros.NAVDATA_STATES[message.state],
            **ros.by_axis("mag_{}", "xyz", scaled("mag", "field_ut", 1.0)),
            pressure=rounded("baro", "pressure_pa", 1.0),
            **ros.by_axis("rot_{}", "xyz", tuple(rpy_deg)),
            altd=rounded("sonar", "range_m", 1000.0),
            **ros.by_axis("v{}", "xyz", scaled("flow", "velocity_m_s", 1000.0)),
            **ros.by_axis("a{}", "xyz", scaled("imu", "accel_m_s2", 1.0 / G_M_S2)),
            tm=message.t_ns / 1000.0,
        )


class DroneCameras:
    """The cameras of one drone: topics for each, and for the active camera, as in ardrone_autonomy.

    Each image is accompanied by its camera's calibration with the same stamp, the time of exposure.
    """

    def __init__(self, drone: str, name: str) -> None:
        self._drone = drone
        self._name = name
        self._infos: dict[str, CameraInfo] = {}
        self.active = CAMERAS[0]

    def toggle(self, _: Any) -> Any:
        """Make the next camera the active one; return the response of a std_srvs/Trigger."""
        self.active = CAMERAS[(CAMERAS.index(self.active) + 1) % len(CAMERAS)]
        return rmw_zenoh.message_class("std_srvs/srv/Trigger_Response")(True, f"the active camera is {self.active}")

    def topics(self) -> Iterator[Topic]:
        for camera in CAMERAS:
            yield from self._topics(f"/{self._name}/{DRIVER}/{camera}", (camera,))
        yield from self._topics(f"/{self._name}/{DRIVER}", CAMERAS)

    def _topics(self, topic: str, cameras: tuple[str, ...]) -> Iterator[Topic]:
        """Yield the topics of one camera, or those of the active one of several."""

        def header_of(camera: str, message: CameraImage) -> Any | None:
            """Return the header of an image; None if its camera is not the active one."""
            if len(cameras) > 1 and camera != self.active:
                return None
            return header(message.t_sample_ns, camera_frame(self._name, camera))

        def picture(key: str, message: CameraImage) -> Any | None:
            head = header_of(keys.leaf(key), message)
            return None if head is None else ros.compressed_image(head, message)

        def info(key: str, message: CameraImage | CameraInfo) -> Any | None:
            """Store a camera's calibration; return it whenever an image arrives."""
            camera = keys.parts(key)[2].split("/")[1]
            if isinstance(message, CameraInfo):
                self._infos[camera] = message
                return None
            head = header_of(camera, message)
            if head is None or camera not in self._infos:
                return None
            return ros.camera_info(ros2_jazzy.sensor_msgs__msg__CameraInfo, head, self._infos[camera])

        images = tuple(keys.camera(self._drone, camera) for camera in cameras)
        infos = tuple(keys.camera_info(self._drone, camera) for camera in cameras)
        yield Topic(f"{topic}/image_raw/compressed", "sensor_msgs/msg/CompressedImage", SENSOR, images, picture)
        yield Topic(f"{topic}/camera_info", "sensor_msgs/msg/CameraInfo", SENSOR, (*images, *infos), info)


def cluster_topics(cluster: str, name: str) -> Iterator[Topic]:
    source = (keys.cluster_state(cluster),)
    kind = rmw_zenoh.message_class("zsim_msgs/msg/ClusterState")

    def state(_: str, message: ClusterState) -> Any:
        return kind(
            header=header(message.t_ns, MAP),
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

    def pose(_: str, message: ClusterState) -> Any:
        frame_pose = ros.pose(*cluster_pose(message))
        return ros2_jazzy.geometry_msgs__msg__PoseStamped(header(message.t_ns, MAP), frame_pose)

    yield Topic(f"/cluster/{name}/state", "zsim_msgs/msg/ClusterState", DEFAULT, source, state)
    yield Topic(f"/cluster/{name}/pose", "geometry_msgs/msg/PoseStamped", DEFAULT, source, pose)


def cluster_pose(message: ClusterState) -> tuple[Vector3, Quaternion]:
    """Return the estimated position and orientation of the cluster frame C in W; the roll of a pair of drones is 0."""
    values = dict(zip(message.names, message.value, strict=True))
    x, y, z, roll, pitch, yaw = (values.get(each, 0.0) for each in ("x_c", "y_c", "z_c", "roll", "pitch", "yaw"))
    rpy = (roll, pitch, yaw)
    return (x, y, z), _quaternion(quaternion_from_rpy(rpy)) if any(rpy) else LEVEL
