"""Where a body is between two instants at which it is known: what a camera exposes between two gates."""

import math

from zsim.math.compiled import inlined, portable
from zsim.math.rotation import Quaternion, Vector, normalised

PARALLEL = 0.9999995  # cosine of half the turn; nearer than 2e-3 rad a straight line errs by less than 1e-9


@portable
def pose_between(
    t: float, t0: float, p0: Vector, v0: Vector, q0: Quaternion, t1: float, p1: Vector, v1: Vector, q1: Quaternion
) -> tuple[Vector, Vector, Quaternion]:
    """Return position [m], velocity [m/s] and attitude at t in [t0, t1] from those at t0 and t1 > t0 [s].

    Position and velocity by the cubic of Hermite, which has both at both ends; attitude by the shortest turn at a
    constant rate (slerp: Shoemake, SIGGRAPH 1985, 245-254). At the ends they are what was given, to rounding.
    """
    span = t1 - t0
    s = (t - t0) / span
    x, vx = _hermite(s, span, p0[0], v0[0], p1[0], v1[0])
    y, vy = _hermite(s, span, p0[1], v0[1], p1[1], v1[1])
    z, vz = _hermite(s, span, p0[2], v0[2], p1[2], v1[2])
    return (x, y, z), (vx, vy, vz), _slerp(s, q0, q1)


@inlined
def _hermite(s: float, span: float, p0: float, v0: float, p1: float, v1: float) -> tuple[float, float]:
    """Return value and derivative of the cubic at s in [0, 1] of a span of time."""
    gap = p1 - p0
    a = span * (v0 + v1) - 2.0 * gap
    b = 3.0 * gap - span * (2.0 * v0 + v1)
    value = p0 + s * (span * v0 + s * (b + s * a))
    return value, v0 + s * (2.0 * b + 3.0 * s * a) / span


@inlined
def _slerp(s: float, q0: Quaternion, q1: Quaternion) -> Quaternion:
    cosine = q0[0] * q1[0] + q0[1] * q1[1] + q0[2] * q1[2] + q0[3] * q1[3]
    sign = -1.0 if cosine < 0.0 else 1.0  # q and -q are one attitude
    cosine = min(abs(cosine), 1.0)
    a, b = 1.0 - s, s
    if cosine < PARALLEL:
        half = math.acos(cosine)
        a, b = math.sin(a * half) / math.sin(half), math.sin(b * half) / math.sin(half)
    b *= sign
    return normalised((a * q0[0] + b * q1[0], a * q0[1] + b * q1[1], a * q0[2] + b * q1[2], a * q0[3] + b * q1[3]))
