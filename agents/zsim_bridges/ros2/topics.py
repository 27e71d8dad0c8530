"""The topics of a run in ROS 2: name, type, quality of service, source keys and conversion of each."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zsim.contract import keys
from zsim.contract.flight_messages import ClusterState, Estimate, Status
from zsim.math.frames import rpy_from_quaternion
from zsim.schema.quantities import G_M_S2
from zsim.sensors.sensor_catalogue import Sensors
from zsim_bridges.ros2 import conversions, rmw_zenoh
from zsim_bridges.ros2.conversions import NS_PER_S, FramePose, header
from zsim_bridges.ros2.rmw_zenoh import Qos
from zsim_bridges.ros2.ros_types import RosTypes
from zsim_bridges.ros_frames import NAVDATA_STATES, by_axis, mean_rate

UNKNOWN_VECTOR = (math.nan, math.nan, math.nan)


class NavdataSummary:
    """The navdata of ardrone_autonomy: a drone's newest samples in that driver's units, at each status, last of a gate.

    Args:
        kind: class of zsim_msgs/Navdata.
        frame: of the message.
    """

    def __init__(self, kind: Any, frame: str) -> None:
        self._kind = kind
        self._frame = frame
        self._last: dict[str, Any] = {}

    def update(self, key: str, message: Any) -> Any | None:
        """Store a message of the drone; return the summary if it is the status."""
        leaf = keys.leaf(key)
        if leaf != "status":
            self._last[leaf] = message
            return None
        return self._kind(
            header=header(message.t_ns, self._frame),
            battery_percent=message.battery_percent,
            state=NAVDATA_STATES[message.state],
            **by_axis("mag_{}", "xyz", self._scaled("mag", "field_ut", 1.0)),
            pressure=self._rounded("baro", "pressure_pa", 1.0),
            **by_axis("rot_{}", "xyz", self._attitude()),
            altd=self._rounded("sonar", "range_m", 1000.0),
            **by_axis("v{}", "xyz", self._scaled("flow", "velocity_m_s", 1000.0)),
            **by_axis("a{}", "xyz", self._scaled("imu", "accel_m_s2", 1.0 / G_M_S2)),
            tm=message.t_ns / 1000.0,
        )

    def _scaled(self, sensor: str, field: str, factor: float) -> tuple[float, ...]:
        values = getattr(self._last.get(sensor), field, UNKNOWN_VECTOR)
        return tuple(factor * value for value in values)

    def _rounded(self, sensor: str, field: str, factor: float) -> int:
        return round(factor * getattr(self._last.get(sensor), field, 0.0))

    def _attitude(self) -> tuple[float, ...]:
        estimate = self._last.get("estimate")
        return tuple(np.degrees(rpy_from_quaternion(estimate.orientation_wxyz))) if estimate else UNKNOWN_VECTOR


Conversion = Callable[[str, Any], Any | None]
"""Returns the ROS message for (key, message); None where there is none to send."""


class Topic(NamedTuple):
    """A topic that the bridge publishes."""

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
    """Yield the topics of the run as a whole."""
    yield Topic("/clock", "rosgraph_msgs/msg/Clock", rmw_zenoh.CLOCK, (keys.CLOCK,), lambda _, m: conversions.clock(m))
    moving = (*map(keys.estimate, names.drones), *map(keys.cluster_state, names.clusters))
    yield Topic("/tf", "tf2_msgs/msg/TFMessage", rmw_zenoh.TF, moving, partial(_moving_frame, names))


def _moving_frame(names: RosNames, key: str, message: Estimate | ClusterState) -> Any:
    """Return the transform of a drone or of a cluster frame."""
    if isinstance(message, ClusterState):
        pose = conversions.cluster_pose(message, conversions.MAP, names.clusters[keys.thing(key)])
    else:
        drone = names.drones[keys.thing(key)]
        pose = FramePose(conversions.odom(drone), conversions.base(drone), message.position_m, message.orientation_wxyz)
    return conversions.transforms(message.t_ns, [pose])


def drone_topics(drone: str, ros: str, sensors: Sensors, types: RosTypes) -> Iterator[Topic]:
    """Yield a drone's topics.

    Args:
        drone: its name.
        ros: its name in ROS, which is its namespace.
        sensors: for their limits and errors.
        types: of zsim's own messages.
    """
    yield from _sensor_topics(drone, ros, sensors)
    estimate, status, base = keys.estimate(drone), keys.status(drone), conversions.base(ros)
    odometry = OdometryTopic(conversions.odom(ros), base)
    truth = keys.truth(drone)
    yield Topic(f"/{ros}/odometry", "nav_msgs/msg/Odometry", rmw_zenoh.DEFAULT, (estimate,), odometry.update)
    yield Topic(
        f"/{ros}/ground_truth", "nav_msgs/msg/Odometry", rmw_zenoh.DEFAULT, (truth,),
        lambda _, m: conversions.true_odometry(m, conversions.MAP, base),
    )  # fmt: skip
    battery = OnChange(partial(conversions.battery, frame=base))
    state = OnChange(conversions.state, lambda status: status.state)
    yield Topic(f"/{ros}/battery", "sensor_msgs/msg/BatteryState", rmw_zenoh.DEFAULT, (status,), battery.update)
    yield Topic(f"/{ros}/state", "std_msgs/msg/String", rmw_zenoh.DEFAULT, (status,), state.update)
    summary = NavdataSummary(types.message_class("zsim_msgs/msg/Navdata"), base)
    sources = (*(keys.sensor(drone, kind) for kind in keys.SENSORS if kind != "gps"), estimate, status)
    yield Topic(f"/{ros}/navdata", "zsim_msgs/msg/Navdata", rmw_zenoh.SENSOR, sources, summary.update)


def _sensor_topics(drone: str, ros: str, sensors: Sensors) -> Iterator[Topic]:
    """Yield the topics of one sensor each; stamped with the time of the sample."""
    imu, mag, sonar = sensors.imu, sensors.mag, sensors.sonar
    gyro = conversions.diagonal(np.radians(1.0) ** 2 * conversions.variance(imu.gyro_deg_s, imu.rate_hz))
    accel = conversions.diagonal(conversions.variance(imu.accel_m_s2, imu.rate_hz))
    field = conversions.diagonal(conversions.TESLA_PER_UT**2 * conversions.variance(mag.field_ut, mag.rate_hz))
    spread = conversions.variance(sonar.range_m, sonar.rate_hz)

    def of(name: str, kind: str, sensor: str, make: Callable[[Any, str], Any], frame: str = "") -> Topic:
        frame = frame or conversions.sensor(ros, sensor)
        key = keys.sensor(drone, sensor)
        return Topic(f"/{ros}/{name}", kind, rmw_zenoh.SENSOR, (key,), lambda _, m: make(m, frame))

    yield of("imu", "sensor_msgs/msg/Imu", "imu", lambda m, frame: conversions.imu(m, frame, gyro, accel))
    yield of("fix", "sensor_msgs/msg/NavSatFix", "gps", conversions.fix)
    yield of("fix_velocity", "geometry_msgs/msg/TwistStamped", "gps", conversions.fix_velocity, conversions.MAP)
    yield of("mag", "sensor_msgs/msg/MagneticField", "mag", lambda m, frame: conversions.mag(m, frame, field))
    yield of("pressure", "sensor_msgs/msg/FluidPressure", "baro", conversions.pressure)
    yield of("range", "sensor_msgs/msg/Range", "sonar", lambda m, f: conversions.sonar_range(m, f, sonar, spread))


def cluster_topics(cluster: str, ros: str, types: RosTypes) -> Iterator[Topic]:
    """Yield a cluster's topics."""
    source = (keys.cluster_state(cluster),)
    kind = types.message_class("zsim_msgs/msg/ClusterState")
    yield Topic(
        f"/cluster/{ros}/state", "zsim_msgs/msg/ClusterState", rmw_zenoh.DEFAULT, source,
        lambda _, m: conversions.cluster_state(kind, m, conversions.MAP),
    )  # fmt: skip
    yield Topic(
        f"/cluster/{ros}/pose", "geometry_msgs/msg/PoseStamped", rmw_zenoh.DEFAULT, source,
        lambda _, m: conversions.pose_stamped(m.t_ns, conversions.cluster_pose(m, conversions.MAP, ros)),
    )  # fmt: skip


class OdometryTopic:
    """Converts estimates to Odometry; the rates are the mean ones since the estimate before."""

    def __init__(self, frame: str, child: str) -> None:
        self._frame = frame
        self._child = child
        self._before: Estimate | None = None

    def update(self, _: str, message: Estimate) -> Any:
        """Return the ROS message for an estimate."""
        before, self._before = self._before, message
        dt_ns = message.t_ns - before.t_ns if before else 0
        if before is None or dt_ns <= 0:
            rate = (0.0, 0.0, 0.0)
        else:
            rate = mean_rate(before.orientation_wxyz, message.orientation_wxyz, dt_ns / NS_PER_S)
        return conversions.odometry(message, self._frame, self._child, rate)


class OnChange:
    """Converts a status in each simulated second, and whenever a value of it has changed.

    Args:
        convert: makes the ROS message.
        value: of a status; without it, one message a second.
    """

    def __init__(self, convert: Callable[[Status], Any], value: Callable[[Status], object] = lambda _: None) -> None:
        self._convert = convert
        self._value = value
        self._last: tuple[object, int] | None = None

    def update(self, _: str, message: Status) -> Any | None:
        """Return the ROS message for a status, None where it is not due."""
        last = self._value(message), message.t_ns // NS_PER_S
        if last == self._last:
            return None
        self._last = last
        return self._convert(message)
