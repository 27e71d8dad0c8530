"""Vectors, quaternions and matrices as tuples of floats, for compiled code: no allocation, fixed order of operations.

A vector is (x, y, z). A quaternion, (w, x, y, z), follows Hamilton's convention and maps body components to world
components, as does a rotation matrix, which is a tuple of rows.
"""

import math

from zsim.math import elementary as el
from zsim.math.compiled import inlined, portable

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]
LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)  # the identity rotation
_SMALL_ANGLE = 1e-8  # rad; below it, sin(x)/x is 1 to the last bit
COSINE_MAX = 0.9995  # cosine of half the angle between attitudes; above it, linear interpolation errs by <= 1e-7 rad


@inlined
def add(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inlined
def subtract(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@inlined
def scaled(a: Vector, s: float) -> Vector:
    """Return s a."""
    return (s * a[0], s * a[1], s * a[2])


@inlined
def axpy(a: Vector, s: float, b: Vector) -> Vector:
    """Return a + s b."""
    return (a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2])


@inlined
def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inlined
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def norm(a: Vector) -> float:
    return math.sqrt(dot(a, a))


@inlined
def rotate(q: Quaternion, a: Vector) -> Vector:
    """Return R(q) a: body components to world components."""
    w, x, y, z = q
    t0 = 2.0 * (y * a[2] - z * a[1])
    t1 = 2.0 * (z * a[0] - x * a[2])
    t2 = 2.0 * (x * a[1] - y * a[0])
    return (
        a[0] + w * t0 + y * t2 - z * t1,
        a[1] + w * t1 + z * t0 - x * t2,
        a[2] + w * t2 + x * t1 - y * t0,
    )


@inlined
def rotate_back(q: Quaternion, a: Vector) -> Vector:
    """Return R(q)^T a: world components to body components."""
    return rotate((q[0], -q[1], -q[2], -q[3]), a)


@inlined
def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the Hamilton product p q: rotation by q, then by p."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@inlined
def normalised(q: Quaternion) -> Quaternion:
    s = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] * s, q[1] * s, q[2] * s, q[3] * s)


@inlined
def from_rotation_vector(r: Vector) -> Quaternion:
    """Return the quaternion of a rotation by |r| radians about r."""
    angle = norm(r)
    half = 0.5 * angle
    return turn_about(r, angle, el.sin(half), el.cos(half))


@inlined
def turn_about(r: Vector, angle: float, sine: float, cosine: float) -> Quaternion:
    """Return the quaternion of a rotation by |r| = angle about r, given the sine and cosine of half the angle."""
    s = 0.5 if angle < _SMALL_ANGLE else sine / angle
    return (cosine, s * r[0], s * r[1], s * r[2])


@inlined
def rate(q: Quaternion, w_WB_B: Vector) -> Quaternion:
    """Return dq/dt = q (0, w) / 2 for the body rate w [rad/s]."""
    w, x, y, z = q
    a, b, c = 0.5 * w_WB_B[0], 0.5 * w_WB_B[1], 0.5 * w_WB_B[2]
    return (-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a)


@inlined
def heading(q: Quaternion) -> float:
    """Return the heading [rad]: the angle of the body's x axis from east, counter-clockwise seen from above."""
    north, east = forwards(q)
    return el.atan2(north, east)


@inlined
def forwards(q: Quaternion) -> tuple[float, float]:
    """Return the north and east components of the body's x axis."""
    w, x, y, z = q
    return 2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)


@inlined
def about_z(angle: float) -> Quaternion:
    return (el.cos(0.5 * angle), 0.0, 0.0, el.sin(0.5 * angle))


@inlined
def level(own: Quaternion, q_WB: Quaternion) -> Quaternion:
    """Return q_HB, the attitude relative to the heading frame (the tilt), given own = about_z(heading(q_WB))."""
    return multiply((own[0], 0.0, 0.0, -own[3]), q_WB)


@inlined
def z_axis(q: Quaternion) -> Vector:
    """Return the body's z axis in world components."""
    w, x, y, z = q
    return (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))


@inlined
def wrapped(angle: float) -> float:
    """Return the angle in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@inlined
def matrix(q: Quaternion) -> Matrix:
    w, x, y, z = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@portable
def matrix_from_rpy(roll: float, pitch: float, yaw: float) -> Matrix:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll)."""
    sr, cr = el.sin(roll), el.cos(roll)
    sp, cp = el.sin(pitch), el.cos(pitch)
    sy, cy = el.sin(yaw), el.cos(yaw)
    return (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )


@inlined
def product(R: Matrix, a: Vector) -> Vector:
    return (dot(R[0], a), dot(R[1], a), dot(R[2], a))


@inlined
def column(R: Matrix, k: int) -> Vector:
    """Return column k of R: the body's k-th axis in world components."""
    return (R[0][k], R[1][k], R[2][k])


@inlined
def transposed(R: Matrix) -> Matrix:
    return (column(R, 0), column(R, 1), column(R, 2))


@inlined
def composed(A: Matrix, B: Matrix) -> Matrix:
    """Return A B: rotation by B, then by A."""
    x, y, z = transposed(B)
    return (
        (dot(A[0], x), dot(A[0], y), dot(A[0], z)),
        (dot(A[1], x), dot(A[1], y), dot(A[1], z)),
        (dot(A[2], x), dot(A[2], y), dot(A[2], z)),
    )


@portable
def position_between(s: float, dt: float, p0: Vector, v0: Vector, p1: Vector, v1: Vector) -> tuple[float, float, float]:
    """Return the position at fraction s of an interval dt [s], on the Hermite cubic with these end points."""
    a, b = s * s * (3.0 - 2.0 * s), dt * s * (1.0 - s) * (1.0 - s)
    c = dt * s * s * (s - 1.0)
    x = p0[0] + a * (p1[0] - p0[0]) + b * v0[0] + c * v1[0]
    y = p0[1] + a * (p1[1] - p0[1]) + b * v0[1] + c * v1[1]
    z = p0[2] + a * (p1[2] - p0[2]) + b * v0[2] + c * v1[2]
    return x, y, z


@portable
def velocity_between(s: float, dt: float, p0: Vector, v0: Vector, p1: Vector, v1: Vector) -> tuple[float, float, float]:
    """Return the velocity at fraction s along the cubic of `position_between`."""
    if dt <= 0.0:
        return v1[0], v1[1], v1[2]
    a, b, c = 6.0 * s * (1.0 - s) / dt, (1.0 - s) * (1.0 - 3.0 * s), s * (3.0 * s - 2.0)
    x = a * (p1[0] - p0[0]) + b * v0[0] + c * v1[0]
    y = a * (p1[1] - p0[1]) + b * v0[1] + c * v1[1]
    z = a * (p1[2] - p0[2]) + b * v0[2] + c * v1[2]
    return x, y, z


@portable
def attitude_between(s: float, q0: Quaternion, q1: Quaternion) -> Quaternion:
    """Return the attitude at fraction s from q0 to q1, turning about a fixed axis at a constant rate (slerp)."""
    cosine = q0[0] * q1[0] + q0[1] * q1[1] + q0[2] * q1[2] + q0[3] * q1[3]
    sign = 1.0 if cosine >= 0.0 else -1.0
    cosine *= sign
    a, b = 1.0 - s, s * sign
    if cosine < COSINE_MAX:
        angle = el.acos(cosine)
        a, b = el.sin((1.0 - s) * angle) / el.sin(angle), sign * el.sin(s * angle) / el.sin(angle)
    return normalised((a * q0[0] + b * q1[0], a * q0[1] + b * q1[1], a * q0[2] + b * q1[2], a * q0[3] + b * q1[3]))


@portable
def pose_between(
    t: float, t0: float, p0: Vector, v0: Vector, q0: Quaternion, t1: float, p1: Vector, v1: Vector, q1: Quaternion
) -> tuple[Vector, Vector, Quaternion]:
    """Return position, velocity and attitude at a time t [s] in [t0, t1]."""
    s = (t - t0) / (t1 - t0) if t1 > t0 else 1.0
    v = velocity_between(s, t1 - t0, p0, v0, p1, v1)
    return position_between(s, t1 - t0, p0, v0, p1, v1), v, attitude_between(s, q0, q1)
