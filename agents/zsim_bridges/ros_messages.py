"""Messages common to ROS 1 and ROS 2, converted from zsim's; each bridge adds its own headers. No I/O.

ROS has the same W (east, north, up) and B (forward, left, up) as zsim (REP 103, REP 105), and SI units; its quaternions
end with w. Covariances are row-major; unknown ones are zero, unless the message defines another value for them.
The classes are those of ROS 2; they also serve ROS 1, since rosbags serialises a message by the names of its fields.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_jazzy as ros

from zsim.contract import messages
from zsim.contract.flight_messages import CameraImage, CameraInfo
from zsim.math.frames import quaternion_conjugate, quaternion_multiply
from zsim.math.rotation import Quaternion, Vector

NS_PER_S = 1_000_000_000
NAVDATA_STATES = {"landed": 2, "taking_off": 6, "hovering": 4, "flying": 3, "landing": 8, "emergency": 0}
"""States in ardrone_autonomy's Navdata (the aircraft's ctrl_state >> 16), which reports an emergency as unknown (0)."""
FIX, NO_FIX, GPS_SERVICE = 0, -1, 1  # sensor_msgs/NavSatStatus
DIAGONAL_KNOWN = 2  # sensor_msgs/NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
DISTORTION_MODEL = "plumb_bob"  # k1, k2, p1, p2, k3: sensor_msgs/distortion_models.h
Array = NDArray[np.float64]

Time, Clock = ros.builtin_interfaces__msg__Time, ros.rosgraph_msgs__msg__Clock
Vector3, Point = ros.geometry_msgs__msg__Vector3, ros.geometry_msgs__msg__Point
TFMessage = ros.tf2_msgs__msg__TFMessage


def by_axis(pattern: str, axes: str, values: Sequence[float]) -> dict[str, float]:
    """Return a vector as message fields, one per axis."""
    return {pattern.format(axis): value for axis, value in zip(axes, values, strict=True)}


def mean_rate(q_WB1: Quaternion, q_WB2: Quaternion, dt_s: float) -> Vector:
    """Return the constant angular rate w_WB_B [rad/s] that turns one attitude into the next within `dt_s`."""
    w, x, y, z = quaternion_multiply(quaternion_conjugate(q_WB1), q_WB2).tolist()
    sine = math.sqrt(x * x + y * y + z * z)
    if sine == 0.0:
        return 0.0, 0.0, 0.0
    gain = math.copysign(2.0, w) * math.atan2(sine, abs(w)) / (sine * dt_s)
    return gain * x, gain * y, gain * z


def diagonal(variance: float) -> Array:
    """Return the covariance (9,) of three independent axes with equal variances."""
    return np.diag([variance] * 3).ravel()


def quaternion(q: Quaternion) -> Any:
    return ros.geometry_msgs__msg__Quaternion(q[1], q[2], q[3], q[0])


def pose(position_m: Vector, q: Quaternion) -> Any:
    return ros.geometry_msgs__msg__Pose(Point(*position_m), quaternion(q))


def twist(linear: Sequence[float], angular: Sequence[float]) -> Any:
    return ros.geometry_msgs__msg__Twist(Vector3(*linear), Vector3(*angular))


def transform(head: Any, child: str, position_m: Vector, q: Quaternion) -> Any:
    moved = ros.geometry_msgs__msg__Transform(Vector3(*position_m), quaternion(q))
    return ros.geometry_msgs__msg__TransformStamped(head, child, moved)


def odometry(
    head: Any, child: str, pose: Any, twist: Any, of_pose: Array | None = None, of_twist: Array | None = None
) -> Any:
    """Return an Odometry with the covariances (36,) of pose and twist; None for unknown or zero ones."""
    nothing = np.zeros(36)
    return ros.nav_msgs__msg__Odometry(
        head,
        child,
        ros.geometry_msgs__msg__PoseWithCovariance(pose, nothing if of_pose is None else of_pose),
        ros.geometry_msgs__msg__TwistWithCovariance(twist, nothing if of_twist is None else of_twist),
    )


def imu(head: Any, sample: messages.Imu, q: Quaternion, covariances: tuple[Array, Array, Array]) -> Any:
    """Return an Imu: attitude, and rate and specific force in B, with their covariances, each (9,)."""
    of_attitude, of_rate, of_force = covariances
    rate, force = Vector3(*sample.gyro_rad_s), Vector3(*sample.accel_m_s2)
    return ros.sensor_msgs__msg__Imu(head, quaternion(q), of_attitude, rate, of_rate, force, of_force)


def fix(head: Any, sample: messages.Gps, has_fix: bool) -> Any:
    """Return a fix: altitude above the ellipsoid; the covariance is that of independent, equal errors in ENU."""
    status: Any = ros.sensor_msgs__msg__NavSatStatus(FIX if has_fix else NO_FIX, GPS_SERVICE)
    return ros.sensor_msgs__msg__NavSatFix(
        head,
        status,
        sample.latitude_deg,
        sample.longitude_deg,
        sample.altitude_m,
        diagonal(sample.sigma_m**2),
        DIAGONAL_KNOWN,
    )


def compressed_image(head: Any, image: CameraImage) -> Any:
    """Return an image as sent by image_transport's compressed plugin."""
    return ros.sensor_msgs__msg__CompressedImage(head, image.format, np.frombuffer(image.data, np.uint8))


def camera_info(kind: Any, head: Any, info: CameraInfo) -> Any:
    """Return the calibration of a single camera, which is not part of a stereo pair: R = 1, P = [K 0].

    `kind` is the class of sensor_msgs/CameraInfo, whose field names differ between ROS 1 (K) and ROS 2 (k).
    """
    P = np.column_stack([np.reshape(info.K, (3, 3)), np.zeros(3)]).ravel()
    full = ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, False)
    D, K, R = np.array(info.D), np.array(info.K), np.eye(3).ravel()
    return kind(head, info.height, info.width, DISTORTION_MODEL, D, K, R, P, 0, 0, full)
