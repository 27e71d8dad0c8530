"""Times, rotations and frames as ROS writes them (REP 103, REP 105). Pure.

ROS shares W (east, north, up) and B (forward, left, up) with us; its quaternions end with w, its times are a pair.
"""

import math

Vector = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]
Xyzw = tuple[float, float, float, float]

NS_PER_S = 1_000_000_000


def stamp(t_ns: int) -> tuple[int, int]:
    """Return a simulated time as seconds and nanoseconds; ROS has none before 0."""
    return divmod(max(t_ns, 0), NS_PER_S)


def xyzw(q_WB: Wxyz) -> Xyzw:
    """Return a quaternion in the order of geometry_msgs/Quaternion."""
    return q_WB[1], q_WB[2], q_WB[3], q_WB[0]


def rotated(q_WB: Wxyz, v_B: Vector) -> Vector:
    """Return the components in W of a vector of B."""
    w, x, y, z = q_WB
    tx, ty, tz = (2 * (y * v_B[2] - z * v_B[1]), 2 * (z * v_B[0] - x * v_B[2]), 2 * (x * v_B[1] - y * v_B[0]))
    return (
        v_B[0] + w * tx + y * tz - z * ty,
        v_B[1] + w * ty + z * tx - x * tz,
        v_B[2] + w * tz + x * ty - y * tx,
    )


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
