"""Dead reckoning of one drone: Madgwick's attitude filter, strapdown integration, and the growth of small errors.

In plain floats, compiled. S. O. H. Madgwick, "An efficient orientation filter for inertial and inertial/magnetic sensor
arrays", University of Bristol, 2010: quaternion rate (12), objective of gravity (25), its Jacobian (26), fusion (33).
Quaternions are Hamilton, w first, body to world; the world is z up, so a body at rest feels +g along world z.

Errors are additive for position and velocity; the attitude's is a small rotation in the world frame,
R_true = (I + [theta_W]x) R_WB, so that a past attitude has the error of the present one.
J. Solà, "Quaternion kinematics for the error-state Kalman filter", 2017, section 7 (globally defined errors).
"""

import math

import numpy as np

from zsim.math.compiled import inlined
from zsim.math.rotation import (
    Matrix,
    Quaternion,
    Vector,
    add,
    axpy,
    column,
    cross,
    dot,
    heading,
    matrix,
    multiply,
    norm,
    normalised,
    product,
    scaled,
    subtract,
)

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCEL_BIAS = 0, 3, 6, 9, 12  # first index of each in the error state
HORIZONTAL_MIN = 1e-6  # of a squared unit vector; nearer to the zenith a heading is not defined
# Mean of a unit vector in the plane along a small offset e under noise s per axis: slope * e/s.
UNIT_VECTOR_SLOPE = math.sqrt(math.pi / 8)

Reckoning = tuple[Vector, Vector, Quaternion, Vector, Vector, Vector]
"""p_WB [m], v_WB [m/s], q_WB, a_WB [m/s^2; W]; rate [rad/s] and specific force [m/s^2] in B, bias-free."""


@inlined
def reckon(
    state: Reckoning,
    accel: Vector,
    gyro: Vector,
    accel_bias: Vector,
    gyro_bias: Vector,
    beta: float,
    gravity: float,
    dt: float,
) -> Reckoning:
    """Return the state after one IMU sample: Madgwick's step, then velocity and position by trapezoids.

    Args:
        state: at the previous sample.
        accel: specific force of the centre of mass as measured [m/s^2; B].
        gyro: body rate as measured [rad/s; B].
        accel_bias, gyro_bias: subtracted.
        beta: Madgwick's gain [rad/s].
        gravity: length of g_W [m/s^2], along -z.
        dt: length of the step [s].
    """
    p, v, q, a_before, w_before, _ = state
    w = subtract(gyro, gyro_bias)
    f_B = subtract(accel, accel_bias)
    q = madgwick_step(q, scaled(add(w_before, w), 0.5), f_B, beta, dt)
    a = acceleration(q, f_B, gravity)
    half = 0.5 * dt
    v_new = axpy(axpy(v, half, a_before), half, a)
    p_new = axpy(axpy(p, half, v), half, v_new)
    return p_new, v_new, q, a, w, f_B


@inlined
def acceleration(q: Quaternion, f_B: Vector, gravity: float) -> Vector:
    """Return R_WB f_B + g_W [m/s^2; W]."""
    f_W = product(matrix(q), f_B)
    return f_W[0], f_W[1], f_W[2] - gravity


@inlined
def madgwick_step(q: Quaternion, w_WB_B: Vector, f_B: Vector, beta: float, dt: float) -> Quaternion:
    """Return the attitude after one IMU sample [Madgwick (33), the gyroscope's part integrated exactly].

    Args:
        q: attitude at the previous sample, B to W.
        w_WB_B: bias-free body rate over the step [rad/s].
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


@inlined
def gravity_gradient(q: Quaternion, f_B: Vector) -> Quaternion:
    """Return J^T f, the gradient of |R_BW z_W - f_B/|f_B||^2 / 2 over q [Madgwick (25), (26), (34)]."""
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
def rotation_vector_quaternion(v: Vector) -> Quaternion:
    """Return the quaternion of a rotation vector [rad], by series: exact to 1e-9 up to 0.6 rad, without libm.

    Gyroscope steps and filter corrections are far below that; the result is always normalised.
    """
    s = dot(v, v)
    cosine = 1.0 - s / 8.0 + s * s / 384.0 - s * s * s / 46080.0
    sine = 0.5 - s / 48.0 + s * s / 3840.0 - s * s * s / 645120.0
    return normalised((cosine, *scaled(v, sine)))


def levelling_time_s(beta: float, direction_sigma_rad: float) -> float:
    """Return the time constant with which the filter pulls its tilt to the measured one [s]; infinite for beta = 0.

    The step has a fixed length 2 beta dt. Under noise of the measured direction, per axis [rad], its mean along a small
    offset e is 2 beta dt * sqrt(pi/8) * e/sigma, hence a first-order pull.
    """
    if beta == 0.0:
        return math.inf
    return direction_sigma_rad / (2.0 * UNIT_VECTOR_SLOPE * beta)


def beta_for(levelling_s: float, direction_sigma_rad: float) -> float:
    """Return the gain [rad/s] for a levelling time [s]; inverse of `levelling_time_s`."""
    return direction_sigma_rad / (2.0 * UNIT_VECTOR_SLOPE * levelling_s)


@inlined
def corrected(state: Reckoning, error: np.ndarray, with_accel_bias: bool, gravity: float) -> Reckoning:
    """Return the state corrected by an error of the filter, (n,), ordered as in `write_transition`."""
    p, v, q, _, w, f_B = state
    p, v = add(p, vector(error, POSITION)), add(v, vector(error, VELOCITY))
    q = normalised(multiply(rotation_vector_quaternion(vector(error, ATTITUDE)), q))
    w = subtract(w, vector(error, GYRO_BIAS))
    if with_accel_bias:
        f_B = subtract(f_B, vector(error, ACCEL_BIAS))
    return p, v, q, acceleration(q, f_B, gravity), w, f_B


@inlined
def arm_acceleration(w: Vector, w_before: Vector, arm: Vector, dt: float) -> Vector:
    """Return alpha x r + w x (w x r) [m/s^2; B], the additional acceleration at p_BS = `arm`."""
    alpha = ((w[0] - w_before[0]) / dt, (w[1] - w_before[1]) / dt, (w[2] - w_before[2]) / dt)
    return add(cross(alpha, arm), cross(w, cross(w, arm)))


@inlined
def write_prediction(
    F: np.ndarray,
    Q: np.ndarray,
    walk: np.ndarray,
    state: Reckoning,
    v_before: Vector,
    gravity: float,
    levelling_s: float,
    with_accel_bias: bool,
    variances: Vector,
    dt: float,
) -> None:
    """Write transition and process noise of an interval of dead reckoning from `v_before` [m/s] to `state`.

    Arguments as of `write_transition` and `write_process_noise`.
    """
    v = state[1]
    f_W = (
        (v[0] - v_before[0]) / dt,
        (v[1] - v_before[1]) / dt,
        (v[2] - v_before[2]) / dt + gravity,
    )
    write_transition(F, f_W, matrix(state[2]), levelling_s, with_accel_bias, dt)
    write_process_noise(Q, walk, variances, dt)


@inlined
def write_transition(
    F: np.ndarray, f_W: Vector, R_WB: Matrix, levelling_s: float, with_accel_bias: bool, dt: float
) -> None:
    """Write the transition of the error state over `dt` into F, which starts as the identity.

    p' = v; v' = -[f_W]x theta - R b_a; theta' = -R b_g - (theta_x, theta_y, 0)/levelling_s.

    Args:
        F: (n, n) with n >= 12, or 15 with an accelerometer bias.
        f_W: mean specific force over the interval [m/s^2].
        R_WB: attitude.
        levelling_s: time constant of Madgwick's pull [s]; may be infinite.
        dt: length of the interval [s].
    """
    for i in range(3):
        F[POSITION + i, VELOCITY + i] = dt
    write_minus_cross(F, POSITION, ATTITUDE, f_W, 0.5 * dt * dt)
    write_minus_cross(F, VELOCITY, ATTITUDE, f_W, dt)
    write_minus_rotation(F, ATTITUDE, GYRO_BIAS, R_WB, dt)
    F[ATTITUDE, ATTITUDE] = F[ATTITUDE + 1, ATTITUDE + 1] = 1.0 / (1.0 + dt / levelling_s)
    if with_accel_bias:
        write_minus_rotation(F, POSITION, ACCEL_BIAS, R_WB, 0.5 * dt * dt)
        write_minus_rotation(F, VELOCITY, ACCEL_BIAS, R_WB, dt)


@inlined
def write_minus_cross(M: np.ndarray, row: int, column: int, a: Vector, scale: float) -> None:
    """Write -scale [a]x into a 3 x 3 block whose diagonal is already zero."""
    M[row, column + 1] = scale * a[2]
    M[row, column + 2] = -scale * a[1]
    M[row + 1, column] = -scale * a[2]
    M[row + 1, column + 2] = scale * a[0]
    M[row + 2, column] = scale * a[1]
    M[row + 2, column + 1] = -scale * a[0]


@inlined
def write_minus_rotation(M: np.ndarray, row: int, column: int, R: Matrix, scale: float) -> None:
    """Write -scale R into a 3 x 3 block."""
    for i in range(3):
        for j in range(3):
            M[row + i, column + j] = -scale * R[i][j]


@inlined
def write_process_noise(Q: np.ndarray, walk: np.ndarray, variances: Vector, dt: float) -> None:
    """Write the process noise of an interval `dt` [s] into Q, (n, n), which starts as zero.

    Args:
        walk: (n,), density of each bias' random walk [unit^2/s], zero elsewhere.
        variances: gained over the interval per axis by velocity [m^2/s^2], tilt and yaw [rad^2].
    """
    velocity_variance, tilt_variance, yaw_variance = variances
    for i in range(3):
        Q[POSITION + i, POSITION + i] = velocity_variance * dt * dt / 3.0
        Q[POSITION + i, VELOCITY + i] = Q[VELOCITY + i, POSITION + i] = velocity_variance * dt / 2.0
        Q[VELOCITY + i, VELOCITY + i] = velocity_variance
    Q[ATTITUDE, ATTITUDE] = Q[ATTITUDE + 1, ATTITUDE + 1] = tilt_variance
    Q[ATTITUDE + 2, ATTITUDE + 2] = yaw_variance
    for i in range(GYRO_BIAS, walk.shape[0]):
        Q[i, i] = walk[i] * dt


@inlined
def heading_and_sigma(q: Quaternion, P: np.ndarray) -> tuple[float, float]:
    """Return the heading [rad] and its standard deviation [rad] under the covariance P of the error state."""
    gradient = heading_gradient(matrix(q))
    variance = 0.0
    for i in range(3):
        for j in range(3):
            variance += gradient[i] * P[ATTITUDE + i, ATTITUDE + j] * gradient[j]
    return heading(q), math.sqrt(max(variance, 0.0))


@inlined
def heading_gradient(R: Matrix) -> Vector:
    """Return the derivative of the heading by a small world rotation; (0, 0, 1) when the nose is level."""
    x = column(R, 0)
    squared = max(x[0] * x[0] + x[1] * x[1], HORIZONTAL_MIN)
    return -x[2] * x[0] / squared, -x[2] * x[1] / squared, 1.0


@inlined
def vector(row: np.ndarray, at: int) -> Vector:
    return float(row[at]), float(row[at + 1]), float(row[at + 2])
