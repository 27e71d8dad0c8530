"""Madgwick's attitude filter for a gyroscope and an accelerometer, in plain floats.

S. O. H. Madgwick, "An efficient orientation filter for inertial and inertial/magnetic sensor arrays",
University of Bristol, 2010: quaternion rate (12), objective of gravity (25), its Jacobian (26), fusion (33).
Quaternions are Hamilton, w first, body to world; the world is z up, so a body at rest feels +g along world z.
"""

import math

from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, dot, multiply, norm, normalised, scaled

# Mean of a unit vector in the plane along a small offset e under noise s per axis: slope * e/s.
UNIT_VECTOR_SLOPE = math.sqrt(math.pi / 8)


@inlined
def rotation_vector_quaternion(v: Vector) -> Quaternion:
    """Return the quaternion of a rotation vector [rad], by series: exact to 1e-9 up to 0.6 rad, without libm.

    Gyroscope steps and filter corrections are far below that; the length is put right in every case.
    """
    s = dot(v, v)
    cosine = 1.0 - s / 8.0 + s * s / 384.0 - s * s * s / 46080.0
    sine = 0.5 - s / 48.0 + s * s / 3840.0 - s * s * s / 645120.0
    return normalised((cosine, *scaled(v, sine)))


@inlined
def gravity_gradient(q: Quaternion, f_B: Vector) -> Quaternion:
    """Return J^T f, the gradient of |R_BW z_W - f_B/|f_B||^2 / 2 over q [Madgwick (25), (26), (34)].

    Args:
        q: attitude, B to W.
        f_B: specific force, any length above zero.
    """
    w, x, y, z = q
    scale = 1.0 / norm(f_B)
    ex = 2.0 * (x * z - w * y) - f_B[0] * scale
    ey = 2.0 * (w * x + y * z) - f_B[1] * scale
    ez = 1.0 - 2.0 * (x * x + y * y) - f_B[2] * scale
    return (
        -2.0 * y * ex + 2.0 * x * ey,
        2.0 * z * ex + 2.0 * w * ey - 4.0 * x * ez,
        -2.0 * w * ex + 2.0 * z * ey - 4.0 * y * ez,
        2.0 * x * ex + 2.0 * y * ey,
    )


@inlined
def madgwick_step(q: Quaternion, w_WB_B: Vector, f_B: Vector, beta: float, dt: float) -> Quaternion:
    """Return the attitude after one IMU sample [Madgwick (33), the gyroscope's part integrated exactly].

    Args:
        q: attitude at the previous sample, B to W.
        w_WB_B: body rate over the step [rad/s], the gyroscope's bias taken off.
        f_B: specific force at the end of the step [m/s^2]; zero gives a step by the gyroscope alone.
        beta: gain [rad/s]; turns the attitude towards gravity by at most 2 beta dt.
        dt: length of the step [s].
    """
    turned = multiply(q, rotation_vector_quaternion(scaled(w_WB_B, dt)))
    if beta == 0.0 or f_B == (0.0, 0.0, 0.0):
        return normalised(turned)
    g = gravity_gradient(turned, f_B)
    length = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2] + g[3] * g[3])
    if length == 0.0:
        return normalised(turned)
    scale = beta * dt / length
    w, x, y, z = turned
    return normalised((w - scale * g[0], x - scale * g[1], y - scale * g[2], z - scale * g[3]))


def levelling_time_s(beta: float, direction_sigma_rad: float) -> float:
    """Return the time constant with which the filter pulls its tilt to the measured one [s].

    The step has a fixed length 2 beta dt. Under noise of the measured direction its mean along a small offset
    e is 2 beta dt * sqrt(pi/8) * e/sigma, hence a first-order pull.

    Args:
        beta: gain [rad/s]; 0 gives infinity.
        direction_sigma_rad: noise of the accelerometer's direction, per axis [rad].
    """
    if beta == 0.0:
        return math.inf
    return direction_sigma_rad / (2.0 * UNIT_VECTOR_SLOPE * beta)


def beta_for(levelling_s: float, direction_sigma_rad: float) -> float:
    """Return the gain [rad/s] for a levelling time [s]; inverse of `levelling_time_s`."""
    return direction_sigma_rad / (2.0 * UNIT_VECTOR_SLOPE * levelling_s)
