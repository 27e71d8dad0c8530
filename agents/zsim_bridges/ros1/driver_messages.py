"""Messages of the contract as those of ROS 1, with the units, signs and frames of ardrone_autonomy. Pure.

Sources: ardrone_autonomy 1.4.1, src/ardrone_driver.cpp (PublishNavdata, PublishOdometry); REP 103 and 105.
"""

import math
from typing import Any

import numpy as np

from zsim.contract import messages
from zsim.schema.quantities import G_M_S2
from zsim_bridges import ros_frames
from zsim_bridges.ros1.onboard import OnboardState
from zsim_bridges.ros1.tcpros import message_class
from zsim_bridges.ros_frames import Vector, Wxyz

WORLD = "world"
MAG_LSB_PER_UT = 1 / 0.3  # AK8975 datasheet, 0.3 uT per LSB: the AR.Drone 2.0's
NO_FIX, FIX, GPS_SERVICE = -1, 0, 1  # sensor_msgs/NavSatStatus
DIAGONAL_KNOWN = 2  # sensor_msgs/NavSatFix
FIX_3D = 3  # as in NMEA: with a height

Time = message_class("builtin_interfaces/Time")
Header = message_class("std_msgs/Header")
Vector3 = message_class("geometry_msgs/Vector3")
Vector3Stamped = message_class("geometry_msgs/Vector3Stamped")
Point = message_class("geometry_msgs/Point")
Quaternion = message_class("geometry_msgs/Quaternion")
Pose = message_class("geometry_msgs/Pose")
PoseWithCovariance = message_class("geometry_msgs/PoseWithCovariance")
Twist = message_class("geometry_msgs/Twist")
TwistWithCovariance = message_class("geometry_msgs/TwistWithCovariance")
Transform = message_class("geometry_msgs/Transform")
TransformStamped = message_class("geometry_msgs/TransformStamped")
TFMessage = message_class("tf2_msgs/TFMessage")
Imu = message_class("sensor_msgs/Imu")
NavSatStatus = message_class("sensor_msgs/NavSatStatus")
NavSatFix = message_class("sensor_msgs/NavSatFix")
Odometry = message_class("nav_msgs/Odometry")
Clock = message_class("rosgraph_msgs/Clock")
Navdata = message_class("ardrone_autonomy/Navdata")

UNKNOWN_3X3, UNKNOWN_6X6 = np.zeros(9), np.zeros(36)  # zeros mean in ROS that the covariance is not known


class DriverFrames:
    """Names of a drone's frames, those of a driver whose tf_prefix is the drone's name."""

    def __init__(self, drone: str) -> None:
        self.base = f"{drone}/ardrone_base_link"
        self.gps = f"{drone}/ardrone_base_gps"
        self.odom = f"{drone}/odom"


def ros_time(t_ns: int) -> Any:
    """Return simulated time [ns] as ROS writes it: seconds, and nanoseconds."""
    return Time(*ros_frames.ros1_stamp(t_ns))


def header(seq: int, t_ns: int, frame: str) -> Any:
    """Return the header of a message about an instant of simulated time [ns], in a frame."""
    return Header(seq, ros_time(t_ns), frame)


def clock(message: messages.Clock) -> Any:
    """Return the time of `/clock`."""
    return Clock(clock=ros_time(message.t_ns))


def navdata(seq: int, state: OnboardState, frames: DriverFrames) -> Any:
    """Return what the driver publishes as ardrone/navdata, at the newest status.

    rotX is positive to the right, rotY nose down, rotZ counter-clockwise [deg]; velocities x forward, y left,
    z up [mm/s]; accelerations [g], az 1 at rest; altd [mm]; tm since the start [us].
    """
    assert state.status is not None
    roll, pitch, yaw = (math.degrees(angle) for angle in ros_frames.rpy(state.attitude))
    mag = [round(field * MAG_LSB_PER_UT) for field in state.mag.field_ut] if state.mag else [0, 0, 0]
    v = [1e3 * speed for speed in state.flow.velocity_m_s] if state.flow else [0.0, 0.0, 0.0]
    f = [accel / G_M_S2 for accel in state.imu.accel_m_s2] if state.imu else [0.0, 0.0, 0.0]
    none = np.zeros(0, np.uint32)
    return Navdata(
        header=header(seq, state.status.t_ns, frames.base),
        batteryPercent=state.status.battery_percent,
        state=ros_frames.NAVDATA_STATES[state.status.state],
        magX=mag[0],
        magY=mag[1],
        magZ=mag[2],
        pressure=round(state.baro.pressure_pa) if state.baro else 0,
        temp=0,
        wind_speed=0.0,
        wind_angle=0.0,
        wind_comp_angle=0.0,
        rotX=roll,
        rotY=pitch,
        rotZ=yaw,
        altd=round(1e3 * state.altitude_m),
        vx=v[0],
        vy=v[1],
        vz=v[2],
        ax=f[0],
        ay=f[1],
        az=f[2],
        motor1=0,
        motor2=0,
        motor3=0,
        motor4=0,
        tags_count=0,
        tags_type=none,
        tags_xc=none,
        tags_yc=none,
        tags_width=none,
        tags_height=none,
        tags_orientation=np.zeros(0, np.float32),
        tags_distance=np.zeros(0, np.float32),
        tm=state.status.t_ns / 1e3,
    )


def imu(seq: int, sample: messages.Imu, attitude: Wxyz, frames: DriverFrames) -> Any:
    """Return ardrone/imu: attitude, rate and specific force in B, (0, 0, 9.8) at rest."""
    return Imu(
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
    return Vector3Stamped(header=header(seq, sample.t_sample_ns, frames.base), vector=Vector3(*direction))


def fix(seq: int, sample: messages.Gps, frames: DriverFrames) -> Any:
    """Return the GPS receiver's fix; the covariance is that of a white error, equal on all axes."""
    status = NavSatStatus(status=FIX if sample.fix >= FIX_3D else NO_FIX, service=GPS_SERVICE)
    return NavSatFix(
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


def ground_truth(seq: int, truth: messages.Truth, frames: DriverFrames) -> Any:
    """Return the true state as Gazebo's p3d plugin does, which hector_quadrotor and tum_simulator use: all in W."""
    q, rate = truth.orientation_wxyz, ros_frames.rotated(truth.orientation_wxyz, truth.angular_velocity_rad_s)
    head = header(seq, truth.t_ns, WORLD)
    return _odometry(head, frames.base, truth.position_m, q, truth.velocity_m_s, rate)


def _odometry(head: Any, child: str, position: Vector, attitude: Wxyz, velocity: Vector, rate: Vector) -> Any:
    pose = Pose(position=Point(*position), orientation=quaternion(attitude))
    twist = Twist(linear=Vector3(*velocity), angular=Vector3(*rate))
    return Odometry(
        header=head,
        child_frame_id=child,
        pose=PoseWithCovariance(pose=pose, covariance=UNKNOWN_6X6),
        twist=TwistWithCovariance(twist=twist, covariance=UNKNOWN_6X6),
    )


def transforms(seq: int, state: OnboardState, frames: DriverFrames) -> Any:
    """Return `/tf` of a drone: odom to base as integrated, and world to odom as far as the estimator knows it."""
    assert state.status is not None
    t_ns = state.status.t_ns
    poses = [_transform(seq, t_ns, frames.odom, frames.base, state.position_m, state.attitude)]
    if state.origin_m is not None:
        poses.append(_transform(seq, t_ns, WORLD, frames.odom, state.origin_m, (1.0, 0.0, 0.0, 0.0)))
    return TFMessage(transforms=poses)


def _transform(seq: int, t_ns: int, parent: str, child: str, position: Vector, attitude: Wxyz) -> Any:
    transform = Transform(translation=Vector3(*position), rotation=quaternion(attitude))
    return TransformStamped(header=header(seq, t_ns, parent), child_frame_id=child, transform=transform)


def quaternion(q_WB: Wxyz) -> Any:
    """Return an attitude, w first, as ROS has it: w last."""
    return Quaternion(*ros_frames.xyzw(q_WB))
