"""Messages of the contract as those of ROS 1, with the units, signs and frames of ardrone_autonomy. Pure.

Sources: ardrone_autonomy 1.4.1, src/ardrone_driver.cpp (PublishNavdata, PublishOdometry); REP 103 and 105.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys.stores import ros1_noetic as ros

from zsim.contract import flight_messages, messages, run_messages
from zsim.math import frames as rotations
from zsim.math.rotation import LEVEL, Quaternion, Vector
from zsim.schema.quantities import G_M_S2
from zsim_bridges.ros1.tcpros import message_class
from zsim_bridges.ros_frames import NAVDATA_STATES, by_axis, xyzw
from zsim_bridges.vehicle_links.drone_link import OnboardState

WORLD = "world"
MAG_LSB_PER_UT = 1 / 0.3  # AK8975 datasheet, 0.3 uT per LSB: the AR.Drone 2.0's
NO_FIX, FIX, GPS_SERVICE = -1, 0, 1  # sensor_msgs/NavSatStatus
DIAGONAL_KNOWN, FIX_3D = 2, 3  # sensor_msgs/NavSatFix; a fix with a height, as in NMEA
NOT_SIMULATED = {  # fields of navdata: numbers, and lists of the tags that its camera recognises
    **dict.fromkeys(("temp", "wind_speed", "wind_angle", "wind_comp_angle", "tags_count"), 0),
    **dict.fromkeys(("motor1", "motor2", "motor3", "motor4"), 0),
    **{f"tags_{what}": np.zeros(0, np.uint32) for what in ("type", "xc", "yc", "width", "height")},
    **{f"tags_{what}": np.zeros(0, np.float32) for what in ("orientation", "distance")},
}
UNKNOWN_3X3, UNKNOWN_6X6 = np.zeros(9), np.zeros(36)  # zeros mean in ROS that the covariance is not known

Part = tuple[str, Vector, Quaternion]  # frame of a part, and its pose in the body
Vector3 = ros.geometry_msgs__msg__Vector3
TFMessage = message_class("tf2_msgs/TFMessage")
Navdata = message_class("ardrone_autonomy/Navdata")


class DriverFrames:
    """Names of a drone's frames, those of a driver whose tf_prefix is the drone's name."""

    def __init__(self, drone: str) -> None:
        self.base = f"{drone}/ardrone_base_link"
        self.gps = f"{drone}/ardrone_base_gps"
        self.odom = f"{drone}/odom"


def ros_time(t_ns: int) -> Any:
    """Return simulated time [ns] as ROS writes it: seconds, and nanoseconds; ROS 1 has none before 0."""
    return ros.builtin_interfaces__msg__Time(*divmod(max(t_ns, 0), 1_000_000_000))


def header(seq: int, t_ns: int, frame: str) -> Any:
    """Return the header of a message about an instant of simulated time [ns], in a frame."""
    return ros.std_msgs__msg__Header(seq, ros_time(t_ns), frame)


def clock(message: run_messages.Clock) -> Any:
    """Return the time of `/clock`."""
    return ros.rosgraph_msgs__msg__Clock(clock=ros_time(message.t_ns))


def navdata(seq: int, state: OnboardState, frames: DriverFrames) -> Any:
    """Return what the driver publishes as ardrone/navdata, at the newest status.

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
        state=NAVDATA_STATES[state.status.state],
        **by_axis("mag{}", "XYZ", mag),
        pressure=round(state.baro.pressure_pa) if state.baro else 0,
        **by_axis("rot{}", "XYZ", rpy_deg),
        altd=round(1e3 * state.altitude_m),
        **by_axis("v{}", "xyz", v),
        **by_axis("a{}", "xyz", f),
        **NOT_SIMULATED,
        tm=state.status.t_ns / 1e3,
    )


def imu(seq: int, sample: messages.Imu, attitude: Quaternion, frames: DriverFrames) -> Any:
    """Return ardrone/imu: attitude, rate and specific force in B, (0, 0, 9.8) at rest."""
    return ros.sensor_msgs__msg__Imu(
        header=header(seq, sample.t_sample_ns, frames.base),
        orientation=quaternion(attitude),
        orientation_covariance=UNKNOWN_3X3,
        angular_velocity=Vector3(*sample.gyro_rad_s),
        angular_velocity_covariance=UNKNOWN_3X3,
        linear_acceleration=Vector3(*sample.accel_m_s2),
        linear_acceleration_covariance=UNKNOWN_3X3,
    )


def mag(seq: int, sample: messages.Mag, frames: DriverFrames) -> Any:
    """Return ardrone/mag: the direction of the Earth's field in B, of length 1."""
    length = math.hypot(*sample.field_ut) or 1.0
    direction = [field / length for field in sample.field_ut]
    return ros.geometry_msgs__msg__Vector3Stamped(
        header=header(seq, sample.t_sample_ns, frames.base), vector=Vector3(*direction)
    )


def fix(seq: int, sample: messages.Gps, frames: DriverFrames) -> Any:
    """Return the GPS receiver's fix; the covariance is that of a white error, equal on all axes."""
    status = ros.sensor_msgs__msg__NavSatStatus(status=FIX if sample.fix >= FIX_3D else NO_FIX, service=GPS_SERVICE)
    return ros.sensor_msgs__msg__NavSatFix(
        header=header(seq, sample.t_sample_ns, frames.gps),
        status=status,
        latitude=sample.latitude_deg,
        longitude=sample.longitude_deg,
        altitude=sample.altitude_m,
        position_covariance=sample.sigma_m**2 * np.eye(3).ravel(),
        position_covariance_type=DIAGONAL_KNOWN,
    )


def odometry(seq: int, state: OnboardState, frames: DriverFrames) -> Any:
    """Return ardrone/odometry: what the aircraft's own velocity integrates to since the start.

    The velocity is that of navdata: along the level axes x forward, y left, z up.
    """
    assert state.status is not None
    velocity = state.flow.velocity_m_s if state.flow else (0.0, 0.0, 0.0)
    rate = state.imu.gyro_rad_s if state.imu else (0.0, 0.0, 0.0)
    head = header(seq, state.status.t_ns, frames.odom)
    return _odometry(head, frames.base, state.position_m, state.attitude, velocity, rate)


def ground_truth(seq: int, truth: flight_messages.Truth, frames: DriverFrames) -> Any:
    """Return the true state as Gazebo's p3d plugin does, which hector_quadrotor and tum_simulator use: all in W."""
    q = truth.orientation_wxyz
    rate = rotations.rotate(q, truth.angular_velocity_rad_s).tolist()
    head = header(seq, truth.t_ns, WORLD)
    return _odometry(head, frames.base, truth.position_m, q, truth.velocity_m_s, rate)


def _odometry(head: Any, child: str, position: Vector, attitude: Quaternion, velocity: Vector, rate: Vector) -> Any:
    pose = ros.geometry_msgs__msg__Pose(
        position=ros.geometry_msgs__msg__Point(*position), orientation=quaternion(attitude)
    )
    twist = ros.geometry_msgs__msg__Twist(Vector3(*velocity), Vector3(*rate))
    return ros.nav_msgs__msg__Odometry(
        header=head,
        child_frame_id=child,
        pose=ros.geometry_msgs__msg__PoseWithCovariance(pose=pose, covariance=UNKNOWN_6X6),
        twist=ros.geometry_msgs__msg__TwistWithCovariance(twist=twist, covariance=UNKNOWN_6X6),
    )


def transforms(seq: int, state: OnboardState, frames: DriverFrames, parts: Sequence[Part] = ()) -> Any:
    """Return `/tf` of a drone: odom to base as integrated, world to odom as far as it is estimated, and its parts."""
    assert state.status is not None
    t_ns = state.status.t_ns
    poses = [_transform(seq, t_ns, frames.odom, frames.base, state.position_m, state.attitude)]
    if state.origin_m is not None:
        poses.append(_transform(seq, t_ns, WORLD, frames.odom, state.origin_m, LEVEL))
    poses += [_transform(seq, t_ns, frames.base, *part) for part in parts]
    return TFMessage(transforms=poses)


def _transform(seq: int, t_ns: int, parent: str, child: str, position: Vector, attitude: Quaternion) -> Any:
    transform = ros.geometry_msgs__msg__Transform(translation=Vector3(*position), rotation=quaternion(attitude))
    return ros.geometry_msgs__msg__TransformStamped(
        header=header(seq, t_ns, parent), child_frame_id=child, transform=transform
    )


def quaternion(q_WB: Quaternion) -> Any:
    """Return an attitude, w first, as ROS has it: w last."""
    return ros.geometry_msgs__msg__Quaternion(*xyzw(q_WB))
