"""What the bridges to ROS 1 and ROS 2 share: times, rotations and frames as ROS writes them (REP 103, REP 105). Pure.

ROS has the same W (east, north, up) and B (forward, left, up) as zsim; its quaternions end with w, its
times are a pair.
"""

import math

Vector = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]
Xyzw = tuple[float, float, float, float]

NS_PER_S = 1_000_000_000
NAVDATA_STATES = {"landed": 2, "taking_off": 6, "hovering": 4, "flying": 3, "landing": 8, "emergency": 0}
"""States in ardrone_autonomy's Navdata (ctrl_state >> 16 of the aircraft), which shows an emergency as unknown."""


def ros1_stamp(t_ns: int) -> tuple[int, int]:
    """Return a simulated time as seconds and nanoseconds; ROS 1 has none before 0."""
    return divmod(max(t_ns, 0), NS_PER_S)


def xyzw(q_WB: Wxyz) -> Xyzw:
    """Return a quaternion in the order of geometry_msgs/Quaternion."""
    return q_WB[1], q_WB[2], q_WB[3], q_WB[0]


def rotation_rows(q_WB: Wxyz) -> tuple[Vector, Vector, Vector]:
    """Return R_WB row by row, in plain floats: messages come by the thousand, and small arrays cost more."""
    w, x, y, z = q_WB
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def into_body(q_WB: Wxyz, v_W: Vector) -> Vector:
    """Return v_B = R_WB^T v_W."""
    (a, b, c), (d, e, f), (g, h, i) = rotation_rows(q_WB)
    x, y, z = v_W
    return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z


def rotated(q_WB: Wxyz, v_B: Vector) -> Vector:
    """Return v_W = R_WB v_B."""
    (a, b, c), (d, e, f), (g, h, i) = rotation_rows(q_WB)
    x, y, z = v_B
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def mean_rate(q_WB1: Wxyz, q_WB2: Wxyz, dt_s: float) -> Vector:
    """Return the constant w_WB_B [rad/s] that turns one attitude into the next within dt_s."""
    w1, x1, y1, z1 = q_WB1
    w2, x2, y2, z2 = q_WB2
    w = w1 * w2 + x1 * x2 + y1 * y2 + z1 * z2
    x = w1 * x2 - x1 * w2 - y1 * z2 + z1 * y2
    y = w1 * y2 + x1 * z2 - y1 * w2 - z1 * x2
    z = w1 * z2 - x1 * y2 + y1 * x2 - z1 * w2
    sine = math.sqrt(x * x + y * y + z * z)
    if sine == 0.0:
        return 0.0, 0.0, 0.0
    gain = math.copysign(2.0, w) * math.atan2(sine, abs(w)) / (sine * dt_s)
    return gain * x, gain * y, gain * z


def rpy(q_WB: Wxyz) -> Vector:
    """Return roll, pitch (nose down positive), yaw (counter-clockwise) [rad] of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    w, x, y, z = q_WB
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2 * (w * y - x * z))))
    return roll, pitch, yaw(q_WB)


def yaw(q_WB: Wxyz) -> float:
    """Return the heading [rad]: the angle of B's x axis from east, counter-clockwise."""
    w, x, y, z = q_WB
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def tilt_cosine(q_WB: Wxyz) -> float:
    """Return the cosine of the tilt: z of B's z axis in W."""
    return 1 - 2 * (q_WB[1] ** 2 + q_WB[2] ** 2)


def ros1_name(name: str) -> str:
    """Return a name of the contract as a name of ROS, which has letters, digits and _ alone."""
    return name.replace(".", "_").replace("-", "_")
