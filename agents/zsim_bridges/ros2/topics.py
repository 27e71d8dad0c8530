"""What a run looks like in ROS: every topic with its type, quality of service, source keys, and conversion."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zsim.contract import keys
from zsim.contract.messages import ClusterState, Estimate, Status
from zsim.scenario.scenario import Sensors
from zsim_bridges.ros2 import conversions as convert
from zsim_bridges.ros2 import rmw_zenoh, sensor_frames
from zsim_bridges.ros2.navdata import NavdataSummary
from zsim_bridges.ros2.rmw_zenoh import Qos
from zsim_bridges.ros2.ros_types import RosTypes
from zsim_bridges.ros2.sensor_frames import FramePose

SLOW_NS = 1_000_000_000  # of battery, which changes within minutes
Conversion = Callable[[str, Any], Any | None]
"""Returns the ROS message for (key, message); None where there is none to send."""


class Topic(NamedTuple):
    """A topic that we publish."""

    name: str
    kind: str
    qos: Qos
    sources: tuple[str, ...]
    convert: Conversion


class RosNames(NamedTuple):
    """ROS names of drones and clusters by their own."""

    drones: dict[str, str]
    clusters: dict[str, str]


def run_topics(names: RosNames) -> Iterator[Topic]:
    """Yield the topics that stand for the run as a whole."""
    yield Topic("/clock", "rosgraph_msgs/msg/Clock", rmw_zenoh.CLOCK, (keys.CLOCK,), lambda _, m: convert.clock(m))
    moving = (*map(keys.estimate, names.drones), *map(keys.cluster_state, names.clusters))
    yield Topic("/tf", "tf2_msgs/msg/TFMessage", rmw_zenoh.TF, moving, partial(_moving_frame, names))


def _moving_frame(names: RosNames, key: str, message: Estimate | ClusterState) -> Any:
    """Return where a drone, or a cluster frame, is."""
    if isinstance(message, ClusterState):
        placed = convert.cluster_pose(message, sensor_frames.MAP, names.clusters[keys.thing(key)])
    else:
        drone = names.drones[keys.thing(key)]
        placed = FramePose(
            sensor_frames.odom(drone), sensor_frames.base(drone), message.position_m, message.orientation_wxyz
        )
    return convert.transforms(message.t_ns, [placed])


def drone_topics(drone: str, ros: str, sensors: Sensors, types: RosTypes) -> Iterator[Topic]:
    """Yield a drone's topics.

    Args:
        drone: its name.
        ros: its name in ROS, which is its namespace.
        sensors: for their limits and errors.
        types: for messages of our own.
    """
    yield from _sensor_topics(drone, ros, sensors)
    estimate, status, base = keys.estimate(drone), keys.status(drone), sensor_frames.base(ros)
    odometry = OdometryTopic(sensor_frames.odom(ros), base)
    truth = keys.truth(drone)
    yield Topic(f"/{ros}/odometry", "nav_msgs/msg/Odometry", rmw_zenoh.DEFAULT, (estimate,), odometry.take)
    yield Topic(
        f"/{ros}/ground_truth", "nav_msgs/msg/Odometry", rmw_zenoh.DEFAULT, (truth,),
        lambda _, m: convert.true_odometry(m, sensor_frames.MAP, base),
    )  # fmt: skip
    level = EverySecond(partial(convert.battery, frame=base))
    yield Topic(f"/{ros}/battery", "sensor_msgs/msg/BatteryState", rmw_zenoh.DEFAULT, (status,), level.take)
    yield Topic(f"/{ros}/state", "std_msgs/msg/String", rmw_zenoh.DEFAULT, (status,), OnChange(convert.state).take)
    summary = NavdataSummary(types.message_class("zsim_msgs/msg/Navdata"), base)
    told = (*(keys.sensor(drone, kind) for kind in keys.SENSORS if kind != "gps"), estimate, status)
    yield Topic(f"/{ros}/navdata", "zsim_msgs/msg/Navdata", rmw_zenoh.SENSOR, told, summary.update)


def _sensor_topics(drone: str, ros: str, sensors: Sensors) -> Iterator[Topic]:
    """Yield the topics that are a sensor each; stamped with the time for which a sample holds."""
    imu, mag, sonar = sensors.imu, sensors.mag, sensors.sonar
    gyro = convert.diagonal(np.radians(1.0) ** 2 * convert.variance(imu.gyro_deg_s, imu.rate_hz))
    accel = convert.diagonal(convert.variance(imu.accel_m_s2, imu.rate_hz))
    field = convert.diagonal(convert.TESLA_PER_UT**2 * convert.variance(mag.field_ut, mag.rate_hz))
    spread = convert.variance(sonar.range_m, sonar.rate_hz)

    def of(name: str, kind: str, sensor: str, make: Callable[[Any, str], Any], frame: str = "") -> Topic:
        frame = frame or sensor_frames.sensor(ros, sensor)
        key = keys.sensor(drone, sensor)
        return Topic(f"/{ros}/{name}", kind, rmw_zenoh.SENSOR, (key,), lambda _, m: make(m, frame))

    yield of("imu", "sensor_msgs/msg/Imu", "imu", lambda m, frame: convert.imu(m, frame, gyro, accel))
    yield of("fix", "sensor_msgs/msg/NavSatFix", "gps", convert.fix)
    yield of("fix_velocity", "geometry_msgs/msg/TwistStamped", "gps", convert.fix_velocity, sensor_frames.MAP)
    yield of("mag", "sensor_msgs/msg/MagneticField", "mag", lambda m, frame: convert.mag(m, frame, field))
    yield of("pressure", "sensor_msgs/msg/FluidPressure", "baro", convert.pressure)
    yield of("range", "sensor_msgs/msg/Range", "sonar", lambda m, f: convert.sonar_range(m, f, sonar, spread))


def cluster_topics(cluster: str, ros: str, types: RosTypes) -> Iterator[Topic]:
    """Yield a cluster's topics."""
    source = (keys.cluster_state(cluster),)
    kind = types.message_class("zsim_msgs/msg/ClusterState")
    yield Topic(
        f"/cluster/{ros}/state", "zsim_msgs/msg/ClusterState", rmw_zenoh.DEFAULT, source,
        lambda _, m: convert.cluster_state(kind, m, sensor_frames.MAP),
    )  # fmt: skip
    yield Topic(
        f"/cluster/{ros}/pose", "geometry_msgs/msg/PoseStamped", rmw_zenoh.DEFAULT, source,
        lambda _, m: convert.pose_stamped(m.t_ns, convert.cluster_pose(m, sensor_frames.MAP, ros)),
    )  # fmt: skip


class OdometryTopic:
    """Makes an Odometry of each estimate; its rates are the mean ones since the estimate before."""

    def __init__(self, frame: str, child: str) -> None:
        self._frame = frame
        self._child = child
        self._before: Estimate | None = None

    def take(self, _: str, message: Estimate) -> Any:
        before, self._before = self._before, message
        dt_ns = message.t_ns - before.t_ns if before else 0
        if before is None or dt_ns <= 0:
            rate = (0.0, 0.0, 0.0)
        else:
            rate = sensor_frames.mean_rate(before.orientation_wxyz, message.orientation_wxyz, dt_ns / convert.SECOND_NS)
        return convert.odometry(message, self._frame, self._child, rate)


class EverySecond:
    """Passes one message of a simulated second."""

    def __init__(self, make: Callable[[Status], Any]) -> None:
        self._make = make
        self._second = -1

    def take(self, _: str, message: Status) -> Any | None:
        second = message.t_ns // SLOW_NS
        if second == self._second:
            return None
        self._second = second
        return self._make(message)


class OnChange:
    """Passes a message when the drone's state has changed, and one of a simulated second."""

    def __init__(self, make: Callable[[Status], Any]) -> None:
        self._make = make
        self._last: tuple[str, int] | None = None

    def take(self, _: str, message: Status) -> Any | None:
        last = message.state, message.t_ns // SLOW_NS
        if last == self._last:
            return None
        self._last = last
        return self._make(message)
