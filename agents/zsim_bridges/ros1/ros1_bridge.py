"""The bridge process: presents one run's drones in a ROS 1 graph; it sends commands, but no gate waits for it.

Each drone appears like ardrone_autonomy's driver in a namespace with the drone's name: messages, commands, cameras.
Units, signs and frames are the driver's; frames are named as if the driver's tf_prefix were the drone's name. Sources:
ardrone_autonomy 1.4.1, src/ardrone_driver.cpp (PublishNavdata, PublishOdometry), src/teleop_twist.cpp; REP 103 and 105.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.stores import ros1_noetic as ros1

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import AIRBORNE, CameraImage, CameraInfo
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
from zsim.errors import RunError
from zsim.math import frames as rotations
from zsim.math.rotation import LEVEL, Quaternion, Vector
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Drone
from zsim.schema.quantities import G_M_S2
from zsim.sensors.camera import CAMERAS
from zsim.transport.session import Session
from zsim_bridges import ros_messages as ros
from zsim_bridges.ros1.node import PublishedTopic, Ros1Node, message_class
from zsim_bridges.vehicle_links import drone_link
from zsim_bridges.vehicle_links.drone_link import REPEAT_NS, CommandSender, ModeName, OnboardState
from zsim_bridges.vehicle_links.server import PictureServer, Say

WORLD = "world"
MAG_LSB_PER_UT = 1 / 0.3  # the AR.Drone 2.0's AK8975 has 0.3 uT per LSB (datasheet)
FIX_3D = 3  # fix type with a height, as in NMEA
NOT_SIMULATED = {  # fields of navdata: numbers, and lists of the tags recognised by a camera
    **dict.fromkeys(("temp", "wind_speed", "wind_angle", "wind_comp_angle", "tags_count"), 0),
    **dict.fromkeys(("motor1", "motor2", "motor3", "motor4"), 0),
    **{f"tags_{field}": np.zeros(0, np.uint32) for field in ("type", "xc", "yc", "width", "height")},
    **{f"tags_{field}": np.zeros(0, np.float32) for field in ("orientation", "distance")},
}
UNKNOWN_COVARIANCE = np.zeros(9)
DRIVER_QUEUE = 200  # messages, as in the driver's publishers
CAMERA_QUEUE = 10  # images, as in the driver's image publishers
DEFAULT_QUEUE = 100  # messages, in all other publishers
NEARLY_ZERO = 1e-6  # magnitude below which a component of cmd_vel is taken as zero; the driver's _EPS
COMMANDABLE_STATES = ("taking_off", *AIRBORNE)
FramePose = tuple[str, Vector, Quaternion]  # name of a part's frame, and the frame's position and orientation in B
Navdata = message_class("ardrone_autonomy/Navdata")


class NodeShutdownError(RunError):
    """A ROS node or the master has asked this node to stop, or another node has taken its name."""


def serve(
    link: Session,
    info: Info,
    observer: Participant,
    stopped: Callable[[], bool],
    say: Say,
    master_uri: str,
    host: str,
) -> None:
    """Serve one run until it is over, or `stopped` returns True.

    Args:
        master_uri: URI of the ROS master.
        host: name or address at which ROS nodes reach this host.

    Raises:
        NodeShutdownError: ROS asked this node to stop, or another node took its name.
        RunError: two drones have the same name in ROS.
    """
    drone_link.warm_up()
    node = Ros1Node(f"/{ros1_name(info.federation)}", master_uri, host, say)
    bridge = Ros1Bridge(link, info, observer, node, say)
    asyncio.run(bridge.run(lambda: stopped() or bool(node.shutdown_reason)))
    if node.shutdown_reason:
        observer.leave(node.shutdown_reason)
        raise NodeShutdownError(f"{observer.name}: {node.shutdown_reason}")


class Ros1Bridge(PictureServer):
    """One run in one ROS graph.

    Raises:
        RunError: two drones have the same name in ROS.
    """

    def __init__(self, link: Session, info: Info, observer: Participant, node: Ros1Node, say: Say) -> None:
        super().__init__(link, info, observer, say, options=None)
        self._node = node
        drone_by_name: dict[str, str] = {}
        for drone in info.drones:
            name = ros1_name(drone.name)
            if name in drone_by_name:
                raise RunError(
                    f"drones {drone_by_name[name]!r} and {drone.name!r} are both {name!r} in ROS; rename one"
                )
            drone_by_name[name] = drone.name
        self._clock = node.publish("/clock", "rosgraph_msgs/Clock", DEFAULT_QUEUE)
        tf = node.publish("/tf", "tf2_msgs/TFMessage", DEFAULT_QUEUE * len(info.drones))
        drones = scenario_file.from_text(info.scenario).drones
        self._drones = {drone.name: DroneTopics(node, drone, observer.name, link.put, tf) for drone in drones}

    async def open(self, stack: contextlib.AsyncExitStack) -> None:
        for sample in self.link.get(keys.camera_info("*", "*")):
            self.forward(sample.key, sample.payload)
        await super().open(stack)
        await stack.enter_async_context(self._node.running())

    def watched_cameras(self) -> list[str]:
        return [
            keys.camera(name, camera) for name, drone in self._drones.items() for camera in drone.cameras.subscribed()
        ]

    def on_picture(self, key: str, payload: bytes) -> None:
        self.forward(key, payload)

    def forward(self, key: str, payload: bytes) -> None:
        kind, thing, leaf = keys.parts(key)
        if key == keys.CLOCK:
            clock = self.observer.update_clock(payload)
            if clock is not None:
                self._clock.publish(lambda _: ros.Clock(ros_time(clock.t_ns)))
        elif not (kind == "drone" and thing in self._drones):
            self.on_run(key, payload)
        elif not leaf.startswith("cmd/"):
            message, drone = self.try_decode(key, payload), self._drones[thing]
            if isinstance(message, CameraImage):
                drone.cameras.publish(keys.leaf(key), message)
            elif isinstance(message, CameraInfo):
                drone.cameras.store_info(leaf.split("/")[1], message)
            elif message is not None:
                try:
                    drone.publish(message)
                except (ValueError, ArithmeticError) as error:  # finite, but out of range for a ROS field
                    self.refuse(f"{key}: {error}")

    def on_event(self, event: Event) -> None:
        """Print why the world refuses commands from ROS nodes, each reason once."""
        if (event.kind, event.source) == ("refused", self.observer.name):
            self.say_once(f"{event.subject}: {event.data.get('reason', event.text)}")


class DriverFrames:
    """The names of a drone's frames."""

    def __init__(self, drone: str) -> None:
        self.base = f"{drone}/ardrone_base_link"
        self.gps = f"{drone}/ardrone_base_gps"
        self.odom = f"{drone}/odom"


def ros1_name(name: str) -> str:
    """Convert a name of the contract to a ROS name, which has only letters, digits and underscores."""
    return name.replace(".", "_").replace("-", "_")


def camera_frame(name: str, camera: str) -> str:
    """Return the driver's name for a camera's frame: x to the right of the image, y down, z forward."""
    return f"{name}/ardrone_base_{camera}cam"


class DroneTopics:
    """Topics and services of a drone; commands are sent in the name of `source`; `tf` is shared by all drones."""

    def __init__(
        self, node: Ros1Node, drone: Drone, source: str, put: Callable[[str, Any], None], tf: PublishedTopic
    ) -> None:
        name = ros1_name(drone.name)
        self._state, self._frames = OnboardState(drone.sensors.imu.mount, drone.sensors.mag.mount), DriverFrames(name)
        self._commands = commands = DriverCommands(drone.name, source, put)
        self.cameras = CameraTopics(node, name)

        self._navdata = node.publish(f"/{name}/ardrone/navdata", "ardrone_autonomy/Navdata", DRIVER_QUEUE)
        self._imu = node.publish(f"/{name}/ardrone/imu", "sensor_msgs/Imu", DRIVER_QUEUE)
        self._mag = node.publish(f"/{name}/ardrone/mag", "geometry_msgs/Vector3Stamped", DRIVER_QUEUE)
        self._odometry = node.publish(f"/{name}/ardrone/odometry", "nav_msgs/Odometry", DRIVER_QUEUE)
        self._fix = node.publish(f"/{name}/fix", "sensor_msgs/NavSatFix", DEFAULT_QUEUE)
        self._truth = node.publish(f"/{name}/ground_truth/state", "nav_msgs/Odometry", DEFAULT_QUEUE)
        self._tf = tf
        node.subscribe(f"/{name}/cmd_vel", "geometry_msgs/Twist", commands.on_cmd_vel)
        node.subscribe(f"/{name}/ardrone/takeoff", "std_msgs/Empty", lambda _: commands.send_mode("takeoff"))
        node.subscribe(f"/{name}/ardrone/land", "std_msgs/Empty", lambda _: commands.send_mode("land"))
        node.subscribe(f"/{name}/ardrone/reset", "std_msgs/Empty", lambda _: commands.reset())
        node.serve(f"/{name}/ardrone/flattrim", commands.trim_refusal)

    def publish(self, message: Any) -> None:
        """Publish the ROS messages that result from a message of the drone or of its estimator."""
        state, frames = self._state, self._frames
        message = state.update(message)
        match message:
            case messages.Imu():
                self._imu.publish(partial(imu, sample=message, attitude=state.attitude, frames=frames))
            case messages.Mag():
                self._mag.publish(partial(mag, sample=message, frames=frames))
            case messages.Gps():
                self._fix.publish(partial(fix, sample=message, frames=frames))
            case flight_messages.Truth():
                self._truth.publish(partial(ground_truth, truth=message, frames=frames))
            case flight_messages.Status():
                self._commands.on_status(message)
                self._navdata.publish(partial(navdata, state=state, frames=frames))
                self._odometry.publish(partial(odometry, state=state, frames=frames))
                self._tf.publish(partial(transforms, state=state, frames=frames, parts=self.cameras.poses()))


class TiltCommand(NamedTuple):
    """A cmd_vel within its limits: fractions of the maximum tilt, climb rate and yaw rate."""

    forward: float
    left: float
    up: float
    yaw_left: float
    hover: bool


class DriverCommands:
    """Passes commands from ROS nodes to one drone, following the driver's rules.

    Like the driver, it repeats the last cmd_vel until another arrives, or until the drone no longer flies.
    """

    def __init__(self, drone: str, source: str, put: Callable[[str, Any], None]) -> None:
        self._sender = CommandSender(drone, source, put)
        self._tilt: TiltCommand | None = None
        self._sent_ns: int | None = None
        self._status: flight_messages.Status | None = None

    def on_cmd_vel(self, twist: Any) -> None:
        """Follow a geometry_msgs/Twist from the next gate on, if the drone is in the air.

        Raises:
            ValueError: a component is not finite.
        """
        tilt = tilt_of(twist)
        if self._status is not None and self._status.state in COMMANDABLE_STATES:
            self._tilt, self._sent_ns = tilt, None

    def reset(self) -> None:
        """Stop the rotors at once, or leave the emergency that this causes, like the driver's toggle."""
        self.send_mode("reset" if self._status is not None and self._status.state == "emergency" else "emergency")

    def trim_refusal(self) -> str | None:
        """Return why the drone cannot be trimmed now; a landed drone is level, so trimming has no effect."""
        state = self._status.state if self._status else "not there yet"
        return None if state == "landed" else f"the drone is {state}; must be landed"

    def on_status(self, status: flight_messages.Status) -> None:
        self._status = status
        if status.state not in COMMANDABLE_STATES:
            self._tilt = None
        is_due = self._sent_ns is None or status.t_ns - self._sent_ns >= REPEAT_NS
        if self._tilt is not None and is_due and status.state in AIRBORNE:
            self._sent_ns = status.t_ns
            self._sender.send_tilt(status.t_ns, *self._tilt)

    def send_mode(self, mode: ModeName) -> None:
        self._sender.send_mode(self._status.t_ns if self._status else 0, mode)


def tilt_of(twist: Any) -> TiltCommand:
    """Return the AR.Drone's command for a geometry_msgs/Twist.

    linear.x and linear.y are fractions of the maximum tilt, forward and to the left; linear.z of the maximum climb
    rate; angular.z of the maximum yaw rate, counter-clockwise. If all six are zero, the drone hovers in place.

    Raises:
        ValueError: a component is not finite.
    """
    linear, angular = twist.linear, twist.angular
    values = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    if not all(map(math.isfinite, values)):
        raise ValueError(f"cmd_vel is {values}; must be finite")
    fractions = (min(1.0, max(-1.0, fraction)) for fraction in (linear.x, linear.y, linear.z, angular.z))
    return TiltCommand(*fractions, hover=all(abs(value) < NEARLY_ZERO for value in values))


class CameraTopics:
    """Topics of a drone's cameras, as the driver publishes them with image_transport, and the service togglecam.

    Each camera has topics of its own; a further set carries the active camera, which the service changes. Since
    images are large, those of a camera are read only while a node subscribes to them.
    """

    def __init__(self, node: Ros1Node, name: str) -> None:
        def publishers(base: str) -> tuple[PublishedTopic, PublishedTopic]:
            """Return the topics of the images and of their calibration."""
            return (
                node.publish(f"{base}/image_raw/compressed", "sensor_msgs/CompressedImage", CAMERA_QUEUE),
                node.publish(f"{base}/camera_info", "sensor_msgs/CameraInfo", CAMERA_QUEUE),
            )

        self._name = name
        self._camera_topics = {camera: publishers(f"/{name}/ardrone/{camera}") for camera in CAMERAS}
        self._active_topics = publishers(f"/{name}/ardrone")
        self._infos: dict[str, CameraInfo] = {}
        self.active = CAMERAS[0]
        node.serve(f"/{name}/ardrone/togglecam", self._toggle)

    def _toggle(self) -> None:
        self.active = CAMERAS[(CAMERAS.index(self.active) + 1) % len(CAMERAS)]

    def _topics(self, camera: str) -> list[tuple[PublishedTopic, PublishedTopic]]:
        return (
            [self._camera_topics[camera], self._active_topics]
            if camera == self.active
            else [self._camera_topics[camera]]
        )

    def subscribed(self) -> Iterator[str]:
        for camera in CAMERAS:
            if any(image.links or info.links for image, info in self._topics(camera)):
                yield camera

    def store_info(self, camera: str, info: CameraInfo) -> None:
        self._infos[camera] = info

    def publish(self, camera: str, image: CameraImage) -> None:
        frame, info = camera_frame(self._name, camera), self._infos.get(camera)
        for image_topic, info_topic in self._topics(camera):
            image_topic.publish(lambda seq: ros.compressed_image(header(seq, image.t_sample_ns, frame), image))
            if info is not None:
                info_topic.publish(partial(camera_info, info=info, t_ns=image.t_sample_ns, frame=frame))

    def poses(self) -> list[FramePose]:
        """Return frame, position and orientation in the body of each camera whose calibration is known."""
        return [
            (camera_frame(self._name, camera), info.position_m, info.orientation_wxyz)
            for camera, info in self._infos.items()
        ]


def ros_time(t_ns: int) -> Any:
    """Convert simulated time [ns] to ROS time; ROS 1 has no negative times, so these become 0."""
    return ros.Time(*divmod(max(t_ns, 0), ros.NS_PER_S))


def header(seq: int, t_ns: int, frame: str) -> Any:
    return ros1.std_msgs__msg__Header(seq, ros_time(t_ns), frame)


def navdata(seq: int, state: OnboardState, frames: DriverFrames) -> Any:
    """Return ardrone/navdata as the driver publishes it, at the time of the newest status.

    rotX is positive to the right, rotY nose down, rotZ counter-clockwise [deg]; velocities x forward, y left,
    z up [mm/s]; accelerations [g], az 1 at rest; altd [mm]; tm since the start [us].
    """
    assert state.status is not None
    rpy_deg = np.degrees(rotations.rpy_from_quaternion(state.attitude)).tolist()
    mag = [round(field * MAG_LSB_PER_UT) for field in state.mag.field_ut] if state.mag else [0, 0, 0]
    v = [1e3 * speed for speed in state.flow.velocity_m_s] if state.flow else [0.0, 0.0, 0.0]
    f = [accel / G_M_S2 for accel in state.imu.accel_m_s2] if state.imu else [0.0, 0.0, 0.0]
    return Navdata(
        header=header(seq, state.status.t_ns, frames.base),
        batteryPercent=state.status.battery_percent,
        state=ros.NAVDATA_STATES[state.status.state],
        **ros.by_axis("mag{}", "XYZ", mag),
        pressure=round(state.baro.pressure_pa) if state.baro else 0,
        **ros.by_axis("rot{}", "XYZ", rpy_deg),
        altd=round(1e3 * state.altitude_m),
        **ros.by_axis("v{}", "xyz", v),
        **ros.by_axis("a{}", "xyz", f),
        **NOT_SIMULATED,
        tm=state.status.t_ns / 1e3,
    )


def imu(seq: int, sample: messages.Imu, attitude: Quaternion, frames: DriverFrames) -> Any:
    """Return ardrone/imu: attitude, and in B the angular rate and the specific force, (0, 0, 9.8) m/s^2 at rest."""
    return ros.imu(
        header(seq, sample.t_sample_ns, frames.base),
        sample,
        attitude,
        (UNKNOWN_COVARIANCE, UNKNOWN_COVARIANCE, UNKNOWN_COVARIANCE),
    )


def mag(seq: int, sample: messages.Mag, frames: DriverFrames) -> Any:
    """Return ardrone/mag: the direction of the Earth's magnetic field in B, a unit vector."""
    length = math.hypot(*sample.field_ut) or 1.0
    direction: Any = ros.Vector3(*(field / length for field in sample.field_ut))
    return ros1.geometry_msgs__msg__Vector3Stamped(header(seq, sample.t_sample_ns, frames.base), direction)


def fix(seq: int, sample: messages.Gps, frames: DriverFrames) -> Any:
    return ros.fix(header(seq, sample.t_sample_ns, frames.gps), sample, sample.fix >= FIX_3D)


def odometry(seq: int, state: OnboardState, frames: DriverFrames) -> Any:
    """Return ardrone/odometry, whose position is integrated from the aircraft's own velocity since the start.

    The velocity is navdata's, in level axes: x forward, y left, z up.
    """
    assert state.status is not None
    velocity = state.flow.velocity_m_s if state.flow else (0.0, 0.0, 0.0)
    rate = state.imu.gyro_rad_s if state.imu else (0.0, 0.0, 0.0)
    stamped_header = header(seq, state.status.t_ns, frames.odom)
    return ros.odometry(
        stamped_header, frames.base, ros.pose(state.position_m, state.attitude), ros.twist(velocity, rate)
    )


def ground_truth(seq: int, truth: flight_messages.Truth, frames: DriverFrames) -> Any:
    """Return the true state like Gazebo's p3d plugin, used by hector_quadrotor and tum_simulator: all of it in W."""
    q = truth.orientation_wxyz
    rate = rotations.rotate(q, truth.angular_velocity_rad_s).tolist()
    stamped_header = header(seq, truth.t_ns, WORLD)
    return ros.odometry(stamped_header, frames.base, ros.pose(truth.position_m, q), ros.twist(truth.velocity_m_s, rate))


def transforms(seq: int, state: OnboardState, frames: DriverFrames, parts: Sequence[FramePose] = ()) -> Any:
    """Return a drone's `/tf`: odom to base as integrated, world to odom if there is an estimate, and base to parts."""
    assert state.status is not None
    t_ns = state.status.t_ns
    poses = [ros.transform(header(seq, t_ns, frames.odom), frames.base, state.position_m, state.attitude)]
    if state.origin_m is not None:
        poses.append(ros.transform(header(seq, t_ns, WORLD), frames.odom, state.origin_m, LEVEL))
    poses += [ros.transform(header(seq, t_ns, frames.base), *part) for part in parts]
    return ros.TFMessage(poses)


def camera_info(seq: int, info: CameraInfo, t_ns: int, frame: str) -> Any:
    return ros.camera_info(ros1.sensor_msgs__msg__CameraInfo, header(seq, t_ns, frame), info)
