"""Poses between two instants at which position, velocity and attitude are known, as a camera needs them."""

import math

from zsim.math.compiled import portable
from zsim.math.rotation import Quaternion, Vector, normalised

COSINE_MAX = 0.9995  # of half the angle between two attitudes; nearer ones are mixed, which errs by 1e-7 rad at most


@portable
def position_between(s: float, dt: float, p0: Vector, v0: Vector, p1: Vector, v1: Vector) -> tuple[float, float, float]:
    """Return the position at share s of an interval of dt seconds: the cubic with these ends and slopes (Hermite)."""
    a, b = s * s * (3.0 - 2.0 * s), dt * s * (1.0 - s) * (1.0 - s)
    c = dt * s * s * (s - 1.0)
    x = p0[0] + a * (p1[0] - p0[0]) + b * v0[0] + c * v1[0]
    y = p0[1] + a * (p1[1] - p0[1]) + b * v0[1] + c * v1[1]
    z = p0[2] + a * (p1[2] - p0[2]) + b * v0[2] + c * v1[2]
    return x, y, z


@portable
def velocity_between(s: float, dt: float, p0: Vector, v0: Vector, p1: Vector, v1: Vector) -> tuple[float, float, float]:
    """Return the velocity along the cubic of `position_between`."""
    if dt <= 0.0:
        return v1[0], v1[1], v1[2]
    a, b, c = 6.0 * s * (1.0 - s) / dt, (1.0 - s) * (1.0 - 3.0 * s), s * (3.0 * s - 2.0)
    x = a * (p1[0] - p0[0]) + b * v0[0] + c * v1[0]
    y = a * (p1[1] - p0[1]) + b * v0[1] + c * v1[1]
    z = a * (p1[2] - p0[2]) + b * v0[2] + c * v1[2]
    return x, y, z


@portable
def attitude_between(s: float, q0: Quaternion, q1: Quaternion) -> Quaternion:
    """Return the attitude at share s of the way from q0 to q1: a turn about a fixed axis at a constant rate (slerp)."""
    cosine = q0[0] * q1[0] + q0[1] * q1[1] + q0[2] * q1[2] + q0[3] * q1[3]
    sign = 1.0 if cosine >= 0.0 else -1.0
    cosine *= sign
    a, b = 1.0 - s, s * sign
    if cosine < COSINE_MAX:
        angle = math.acos(cosine)
        a, b = math.sin((1.0 - s) * angle) / math.sin(angle), sign * math.sin(s * angle) / math.sin(angle)
    return normalised((a * q0[0] + b * q1[0], a * q0[1] + b * q1[1], a * q0[2] + b * q1[2], a * q0[3] + b * q1[3]))


@portable
def pose_between(
    t: float,
    t0: float,
    p0: Vector,
    v0: Vector,
    q0: Quaternion,
    t1: float,
    p1: Vector,
    v1: Vector,
    q1: Quaternion,
) -> tuple[Vector, Vector, Quaternion]:
    """Return position, velocity and attitude at an instant t in [t0, t1] [s]."""
    s = (t - t0) / (t1 - t0) if t1 > t0 else 1.0
    v = velocity_between(s, t1 - t0, p0, v0, p1, v1)
    return position_between(s, t1 - t0, p0, v0, p1, v1), v, attitude_between(s, q0, q1)
