"""What the bridges to ROS 1 and ROS 2 share: rotations and cameras as ROS writes them, ardrone_autonomy's states. Pure.

ROS has the same W (east, north, up) and B (forward, left, up) as zsim (REP 103, REP 105); its quaternions end with w.
"""

import math
from collections.abc import Sequence

import numpy as np

from zsim.math.frames import quaternion_conjugate, quaternion_multiply
from zsim.math.rotation import Quaternion, Vector

NAVDATA_STATES = {"landed": 2, "taking_off": 6, "hovering": 4, "flying": 3, "landing": 8, "emergency": 0}
"""States in ardrone_autonomy's Navdata (ctrl_state >> 16 of the aircraft), which shows an emergency as unknown."""

DISTORTION_MODEL = "plumb_bob"  # k1, k2, p1, p2, k3: sensor_msgs/distortion_models.h


def projection(K: Sequence[float]) -> np.ndarray:
    """Return P of sensor_msgs/CameraInfo, (12,), of a camera that is no part of a stereo pair: K, and a column of 0."""
    return np.column_stack([np.reshape(K, (3, 3)), np.zeros(3)]).ravel()


def xyzw(q_WB: Quaternion) -> Quaternion:
    """Return a quaternion in the order of geometry_msgs/Quaternion."""
    return q_WB[1], q_WB[2], q_WB[3], q_WB[0]


def by_axis(pattern: str, axes: str, values: Sequence[float]) -> dict[str, float]:
    """Return a vector as the fields of a message, one for each axis."""
    return {pattern.format(axis): value for axis, value in zip(axes, values, strict=True)}


def mean_rate(q_WB1: Quaternion, q_WB2: Quaternion, dt_s: float) -> Vector:
    """Return the constant w_WB_B [rad/s] that turns one attitude into the next within dt_s."""
    w, x, y, z = quaternion_multiply(quaternion_conjugate(q_WB1), q_WB2).tolist()
    sine = math.sqrt(x * x + y * y + z * z)
    if sine == 0.0:
        return 0.0, 0.0, 0.0
    gain = math.copysign(2.0, w) * math.atan2(sine, abs(w)) / (sine * dt_s)
    return gain * x, gain * y, gain * z
