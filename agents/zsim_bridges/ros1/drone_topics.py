"""One drone in the ROS graph, as ardrone_autonomy's driver in the namespace of that name."""

from collections.abc import Callable
from functools import partial
from typing import Any

from zsim.contract import messages
from zsim.scenario.scenario import Drone
from zsim_bridges import ros_frames
from zsim_bridges.ros1 import conversions
from zsim_bridges.ros1.conversions import DriverFrames
from zsim_bridges.ros1.onboard import OnboardState
from zsim_bridges.ros1.pilot import DriverCommands
from zsim_bridges.ros1.wire.node import Ros1Node
from zsim_bridges.ros1.wire.publisher import PublishedTopic

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
    """

    def __init__(self, node: Ros1Node, drone: Drone, source: str, put: Callable[[str, Any], None], tf: PublishedTopic) -> None:
        self._tf = tf
        name = ros_frames.ros1_name(drone.name)
        self._state, self._frames = OnboardState(drone.sensors.imu.mount, drone.sensors.mag.mount), DriverFrames(name)
        self._commands = DriverCommands(drone.name, source, put)
        self._advertise(node, f"/{name}")
        self._subscribe(node, f"/{name}")

    def _advertise(self, node: Ros1Node, space: str) -> None:
        self._navdata = node.publish(f"{space}/ardrone/navdata", "ardrone_autonomy/Navdata", DRIVER_QUEUE)
        self._imu = node.publish(f"{space}/ardrone/imu", "sensor_msgs/Imu", DRIVER_QUEUE)
        self._mag = node.publish(f"{space}/ardrone/mag", "geometry_msgs/Vector3Stamped", DRIVER_QUEUE)
        self._odometry = node.publish(f"{space}/ardrone/odometry", "nav_msgs/Odometry", DRIVER_QUEUE)
        self._fix = node.publish(f"{space}/fix", "sensor_msgs/NavSatFix", QUEUE)
        self._truth = node.publish(f"{space}/ground_truth/state", "nav_msgs/Odometry", QUEUE)

    def _subscribe(self, node: Ros1Node, space: str) -> None:
        pilot = self._commands
        node.subscribe(f"{space}/cmd_vel", "geometry_msgs/Twist", pilot.on_cmd_vel)
        node.subscribe(f"{space}/ardrone/takeoff", "std_msgs/Empty", lambda _: pilot.take_off())
        node.subscribe(f"{space}/ardrone/land", "std_msgs/Empty", lambda _: pilot.land())
        node.subscribe(f"{space}/ardrone/reset", "std_msgs/Empty", lambda _: pilot.reset())
        node.serve(f"{space}/ardrone/flattrim", pilot.trim_refusal)

    def publish(self, message: Any) -> None:
        """Take a message of the drone, or of its estimator, and publish what follows from it."""
        own, frames = self._state, self._frames
        message = own.update(message)
        match message:
            case messages.Imu():
                self._imu.publish(partial(conversions.imu, sample=message, attitude=own.attitude, frames=frames))
            case messages.Mag():
                self._mag.publish(partial(conversions.mag, sample=message, frames=frames))
            case messages.Gps():
                self._fix.publish(partial(conversions.fix, sample=message, frames=frames))
            case messages.Truth():
                self._truth.publish(partial(conversions.ground_truth, truth=message, frames=frames))
            case messages.Status():
                self._publish_status(message)

    def _publish_status(self, status: messages.Status) -> None:
        own, frames = self._state, self._frames
        self._commands.on_status(status)
        self._navdata.publish(partial(conversions.navdata, own=own, frames=frames))
        self._odometry.publish(partial(conversions.odometry, own=own, frames=frames))
        self._tf.publish(partial(conversions.transforms, own=own, frames=frames))
