"""One drone in the ROS graph, as ardrone_autonomy's driver in the namespace of that name: topics and commands.

Source of the rules of cmd_vel: ardrone_autonomy 1.4.1, src/teleop_twist.cpp. The driver repeats the last cmd_vel until
there is another; so do the commands here, until the drone comes down.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from zsim.contract import flight_messages, messages
from zsim.scenario.scenario import Drone
from zsim_bridges.ros1 import driver_messages
from zsim_bridges.ros1.camera_topics import CameraTopics
from zsim_bridges.ros1.connections import PublishedTopic
from zsim_bridges.ros1.driver_messages import DriverFrames
from zsim_bridges.ros1.node import Ros1Node
from zsim_bridges.vehicle_links.drone_link import CommandSender, ModeName, OnboardState

NEARLY_ZERO = 1e-6  # of a component of cmd_vel, _EPS of the driver
REPEAT_NS = 100_000_000  # ns; a commander that is silent for 0.5 s counts as dead, scenario `silence.hover_s`
AIRBORNE = ("hovering", "flying")
COMMANDABLE = ("taking_off", *AIRBORNE)


class TiltCommand(NamedTuple):
    """A cmd_vel within its limits: shares of the largest tilt, climb and yaw rate."""

    forward: float
    left: float
    up: float
    yaw_left: float
    hover: bool


class DriverCommands:
    """Commands of ROS nodes to one drone, by the driver's rules. Pure.

    Args:
        drone: its name.
        source: process name under which commands are sent.
        put: publishes a message on a key.
    """

    def __init__(self, drone: str, source: str, put: Callable[[str, Any], None]) -> None:
        self._sender = CommandSender(drone, source, put)
        self._tilt: TiltCommand | None = None
        self._sent_ns: int | None = None
        self._status: flight_messages.Status | None = None

    def on_cmd_vel(self, twist: Any) -> None:
        """Fly a geometry_msgs/Twist from the next gate on.

        Raises:
            ValueError: it is not finite.
        """
        tilt = tilt_of(twist)
        if self._status is not None and self._status.state in COMMANDABLE:
            self._tilt, self._sent_ns = tilt, None

    def take_off(self) -> None:
        """Take off."""
        self._send_mode("takeoff")

    def land(self) -> None:
        """Land."""
        self._send_mode("land")

    def reset(self) -> None:
        """Stop the rotors at once; in the emergency that this is, leave it: the driver's toggle."""
        self._send_mode("reset" if self._status is not None and self._status.state == "emergency" else "emergency")

    def trim_refusal(self) -> str | None:
        """Return why the drone cannot be trimmed now; a landed one stands level, and nothing more is to be done."""
        state = self._status.state if self._status else "not there yet"
        return None if state == "landed" else f"the drone is {state}; must be landed"

    def on_status(self, status: flight_messages.Status) -> None:
        """Send the command that is due at a gate."""
        self._status = status
        if status.state not in COMMANDABLE:
            self._tilt = None
        late = self._sent_ns is None or status.t_ns - self._sent_ns >= REPEAT_NS
        if self._tilt is not None and late and status.state in AIRBORNE:
            self._sent_ns = status.t_ns
            self._sender.tilt(status.t_ns, *self._tilt)

    def _send_mode(self, mode: ModeName) -> None:
        self._sender.mode(self._status.t_ns if self._status else 0, mode)


def ros1_name(name: str) -> str:
    """Return a name of the contract as a name of ROS, which has letters, digits and _ alone."""
    return name.replace(".", "_").replace("-", "_")


def tilt_of(twist: Any) -> TiltCommand:
    """Return the AR.Drone's command for a geometry_msgs/Twist.

    linear.x and linear.y are shares of the largest tilt, forward and to the left; linear.z of the largest climb;
    angular.z of the largest yaw rate, counter-clockwise. All six zero is hovering in place.

    Raises:
        ValueError: it is not finite.
    """
    linear, angular = twist.linear, twist.angular
    values = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    if not all(map(math.isfinite, values)):
        raise ValueError(f"cmd_vel is {values}; must be finite")
    shares = (min(1.0, max(-1.0, share)) for share in (linear.x, linear.y, linear.z, angular.z))
    return TiltCommand(*shares, hover=all(abs(value) < NEARLY_ZERO for value in values))


DRIVER_QUEUE = 200  # messages, of the driver's publishers
QUEUE = 100  # messages


class DroneTopics:
    """Topics and services of a drone.

    Args:
        node: in which they are.
        drone: its name, and where its sensors sit.
        source: process name under which commands are sent.
        put: publishes a message on a key.
        tf: the topic that all drones share.

    Attributes:
        cameras: of the drone.
    """

    def __init__(
        self, node: Ros1Node, drone: Drone, source: str, put: Callable[[str, Any], None], tf: PublishedTopic
    ) -> None:
        self._tf = tf
        name = ros1_name(drone.name)
        self._state, self._frames = OnboardState(drone.sensors.imu.mount, drone.sensors.mag.mount), DriverFrames(name)
        self._commands = DriverCommands(drone.name, source, put)
        self.cameras = CameraTopics(node, name)
        self._advertise(node, f"/{name}")
        self._subscribe(node, f"/{name}")

    def _advertise(self, node: Ros1Node, namespace: str) -> None:
        self._navdata = node.publish(f"{namespace}/ardrone/navdata", "ardrone_autonomy/Navdata", DRIVER_QUEUE)
        self._imu = node.publish(f"{namespace}/ardrone/imu", "sensor_msgs/Imu", DRIVER_QUEUE)
        self._mag = node.publish(f"{namespace}/ardrone/mag", "geometry_msgs/Vector3Stamped", DRIVER_QUEUE)
        self._odometry = node.publish(f"{namespace}/ardrone/odometry", "nav_msgs/Odometry", DRIVER_QUEUE)
        self._fix = node.publish(f"{namespace}/fix", "sensor_msgs/NavSatFix", QUEUE)
        self._truth = node.publish(f"{namespace}/ground_truth/state", "nav_msgs/Odometry", QUEUE)

    def _subscribe(self, node: Ros1Node, namespace: str) -> None:
        pilot = self._commands
        node.subscribe(f"{namespace}/cmd_vel", "geometry_msgs/Twist", pilot.on_cmd_vel)
        node.subscribe(f"{namespace}/ardrone/takeoff", "std_msgs/Empty", lambda _: pilot.take_off())
        node.subscribe(f"{namespace}/ardrone/land", "std_msgs/Empty", lambda _: pilot.land())
        node.subscribe(f"{namespace}/ardrone/reset", "std_msgs/Empty", lambda _: pilot.reset())
        node.serve(f"{namespace}/ardrone/flattrim", pilot.trim_refusal)

    def publish(self, message: Any) -> None:
        """Publish what follows from a message of the drone or of its estimator."""
        state, frames = self._state, self._frames
        message = state.update(message)
        match message:
            case messages.Imu():
                self._imu.publish(partial(driver_messages.imu, sample=message, attitude=state.attitude, frames=frames))
            case messages.Mag():
                self._mag.publish(partial(driver_messages.mag, sample=message, frames=frames))
            case messages.Gps():
                self._fix.publish(partial(driver_messages.fix, sample=message, frames=frames))
            case flight_messages.Truth():
                self._truth.publish(partial(driver_messages.ground_truth, truth=message, frames=frames))
            case flight_messages.Status():
                self._publish_status(message)

    def _publish_status(self, status: flight_messages.Status) -> None:
        state, frames = self._state, self._frames
        self._commands.on_status(status)
        self._navdata.publish(partial(driver_messages.navdata, state=state, frames=frames))
        self._odometry.publish(partial(driver_messages.odometry, state=state, frames=frames))
        self._tf.publish(partial(driver_messages.transforms, state=state, frames=frames, parts=self.cameras.poses()))
