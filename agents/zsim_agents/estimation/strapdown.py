"""The nominal state of a drone: propagated by every IMU sample, corrected by the filter, and kept in a history.

A late reading measures a past state, free of the process noise since then. Where that matters, the error state contains
clones of past positions and velocities: the reading is compared with the clone nearest in time, whose correlations with
the present state correct that state, too. S. I. Roumeliotis, J. W. Burdick, "Stochastic cloning: a generalized
framework for processing relative state measurements", IEEE Int. Conf. on Robotics and Automation, 2002.

The functions from `reckon` on perform dead reckoning: Madgwick's attitude filter, strapdown integration, and growth of
small errors. S. O. H. Madgwick, "An efficient orientation filter for inertial and inertial/magnetic sensor arrays",
University of Bristol, 2010: quaternion rate (12), objective function of gravity (25), its Jacobian (26), fusion (33).
Quaternions are Hamilton, w first, body to world; the world's z axis points up, so a body at rest feels +g along it.

Errors of position and velocity are additive; the attitude error is a small rotation in the world frame,
R_true = (I + [theta_W]x) R_WB, so that a past attitude has the same error as the present one.
J. Solà, "Quaternion kinematics for the error-state Kalman filter", 2017, section 7 (globally defined errors).
"""

import math

import numpy as np

from zsim.math import elementary as el
from zsim.math.compiled import inlined, portable
from zsim.math.rotation import (
    Matrix,
    Quaternion,
    Vector,
    about_z,
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
from zsim_agents.estimation.filter_state import (
    CLONE,
    CLONED,
    COUNT,
    IMU,
    LAYOUT,
    NOMINAL,
    SENSOR,
    SETTING,
    Array,
    Moment,
    Reckoning,
    Rows,
    increase,
    matrix_at,
    moment,
    put,
    put_moment,
    put_quaternion,
    put_reckoning,
    quaternion,
    reckoning,
    vector,
)
from zsim_agents.estimation.kalman_update import predict_jointly, predicted_covariance

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCEL_BIAS = 0, 3, 6, 9, 12  # first index of each error in the error state
HORIZONTAL_MIN = 1e-6  # minimum squared horizontal part of a unit vector; closer to the zenith, a heading is undefined
# A planar unit vector along a small offset e, with noise s per axis added to e, has the mean slope * e/s.
UNIT_VECTOR_SLOPE = math.sqrt(math.pi / 8)
ZERO: Vector = (0.0, 0.0, 0.0)
ACCEL_MAX_M_S2 = 500.0  # m/s^2, 50 g: no MEMS accelerometer of a drone reads more
GYRO_MAX_RAD_S = 100.0  # rad/s, 5700 deg/s: likewise for gyroscopes
MANOEUVRE_M_S2 = 0.3  # m/s^2, standard deviation of the acceleration in gusts of 0.5 m/s (0.16) and in transit
MANOEUVRE_S = 0.5  # s, its correlation time
LOST_TURN_RAD_S = 0.5  # rad/s, standard deviation of the rate during a missing gyroscope sample
COAST_TURN_DENSITY = el.square(LOST_TURN_RAD_S) * 2.0 * MANOEUVRE_S  # rad^2/s
COAST_VELOCITY_DENSITY = 1.0  # m^2/s^3: 1 m/s after 1 s without an IMU


@inlined
def move(rows: Rows, i: int, t_s: float, accel: Vector, gyro: Vector) -> None:
    """Propagate to the time of an IMU sample; ignore a duplicate, refuse and count a late or impossible sample.

    `accel` is the specific force [m/s^2], `gyro` the body rate [rad/s], both in the sensor frame S.
    """
    row, counts, setting, layout = rows.nominal[i], rows.counts[i], rows.setting[i], rows.layout[i]
    if not is_possible(accel, gyro):
        counts[COUNT.refused + IMU] += 1
        return
    period = setting[SETTING.period]
    if not counts[COUNT.running]:
        begin(row, counts, t_s - period)
    dt = t_s - row[NOMINAL.t]
    if dt <= 0.0:
        counts[COUNT.refused + IMU] += 1 if dt < 0.0 else 0
        return
    if dt > 1.5 * period:
        _add_loss(row, dt - period)
    if layout[LAYOUT.imu_displaced]:
        accel, gyro = _to_body(row, setting, accel, gyro, dt)
    state = reckoning(row)
    biases = vector(row, NOMINAL.accel_bias), vector(row, NOMINAL.gyro_bias)
    propagated = reckon(state, accel, gyro, biases[0], biases[1], setting[SETTING.beta], setting[SETTING.gravity], dt)
    put_reckoning(row, propagated)
    before, after = state[5], propagated[5]
    jolt = abs(after[0] - before[0]) + abs(after[1] - before[1]) + abs(after[2] - before[2])
    if jolt > setting[SETTING.jolt]:
        # maximum velocity error if the acceleration steps at any time between two samples
        velocity_error = 0.5 * jolt * dt
        row[NOMINAL.lost_velocity] += velocity_error * velocity_error
    row[NOMINAL.t] = t_s
    row[NOMINAL.dt_squared] += dt * dt
    counts[COUNT.used + IMU] += 1


@inlined
def is_possible(accel: Vector, gyro: Vector) -> bool:
    """Return whether values are possible for an IMU; NaN fails each comparison."""
    is_valid = True
    for k in range(3):
        is_valid = is_valid and abs(accel[k]) < ACCEL_MAX_M_S2 and abs(gyro[k]) < GYRO_MAX_RAD_S
    return is_valid


@inlined
def _add_loss(row: Array, missing_s: float) -> None:
    lost_velocity, lost_turn = MANOEUVRE_M_S2 * missing_s, LOST_TURN_RAD_S * missing_s
    row[NOMINAL.lost_velocity] += lost_velocity * lost_velocity
    row[NOMINAL.lost_turn] += lost_turn * lost_turn


@inlined
def _to_body(row: Array, setting: Array, accel: Vector, gyro: Vector, dt: float) -> tuple[Vector, Vector]:
    """Convert a sample of a rotated or displaced IMU to the centre of mass, in body axes."""
    imu = SETTING.sensors + IMU * SENSOR.size
    R_BS = matrix_at(setting, imu + SENSOR.R_BS)
    accel, gyro = product(R_BS, accel), product(R_BS, gyro)
    w = subtract(gyro, vector(row, NOMINAL.gyro_bias))
    swing = arm_acceleration(w, vector(row, NOMINAL.w_WB_B), vector(setting, imu + SENSOR.p_BS), dt)
    return subtract(accel, swing), gyro


@inlined
def begin(row: Array, counts: Array, t_s: float) -> None:
    row[NOMINAL.t] = t_s
    counts[COUNT.running] = 1
    begin_interval(row, t_s)


@inlined
def begin_interval(row: Array, t_s: float) -> None:
    row[NOMINAL.t_start] = t_s
    put(row, NOMINAL.v_start, vector(row, NOMINAL.v_WB))
    row[NOMINAL.dt_squared] = row[NOMINAL.lost_velocity] = row[NOMINAL.lost_turn] = 0.0


@inlined
def coast(row: Array, setting: Array, t_s: float) -> None:
    """Propagate without an IMU after a long gap: velocity and attitude are held and become less certain."""
    dt = t_s - row[NOMINAL.t]
    if dt <= setting[SETTING.coast_after]:
        return
    p, v, q, _, _, f_B = reckoning(row)
    put_reckoning(row, (axpy(p, dt, v), v, q, ZERO, ZERO, f_B))
    row[NOMINAL.t] = t_s
    row[NOMINAL.lost_velocity] += COAST_VELOCITY_DENSITY * dt
    row[NOMINAL.lost_turn] += COAST_TURN_DENSITY * dt


@portable
def grow(rows: Rows, i: int, P: Array) -> Array:
    """Return the covariance propagated over the dead-reckoning interval that ends now, and begin the next one."""
    row, n = rows.nominal[i], rows.layout[i, LAYOUT.first_clone]
    if row[NOMINAL.t] > row[NOMINAL.t_start]:
        F, Q = np.eye(n), np.zeros((n, n))
        write_growth(rows, i, F, Q)
        if n < P.shape[0]:
            predict_jointly(P, 0, F, Q)  # the clones, which do not change, take the place of other drones' errors
        else:
            P = predicted_covariance(P, F, Q)
    begin_interval(row, row[NOMINAL.t])
    return P


@inlined
def write_growth(rows: Rows, i: int, F: Array, Q: Array) -> None:
    """Write the growth of the errors over the interval that ends now: the transition into F, the noise into Q.

    On entry, F is the identity and Q is zero. Biases that are Gauss-Markov processes decay.
    """
    row, setting = rows.nominal[i], rows.setting[i]
    dt, dt_squared = row[NOMINAL.t] - row[NOMINAL.t_start], row[NOMINAL.dt_squared]
    turn_variance = setting[SETTING.gyro_variance] * dt_squared + row[NOMINAL.lost_turn]
    velocity_variance = setting[SETTING.accel_variance] * dt_squared + row[NOMINAL.lost_velocity]
    write_prediction(
        F,
        Q,
        rows.walk[i, : F.shape[0]],
        reckoning(row),
        vector(row, NOMINAL.v_start),
        setting[SETTING.gravity],
        setting[SETTING.levelling],
        rows.layout[i, LAYOUT.accel_bias] != 0,
        (velocity_variance, turn_variance + setting[SETTING.tilt_density] * dt, turn_variance),
        dt,
    )
    if rows.layout[i, LAYOUT.correlated]:
        for k in range(F.shape[0]):
            x = 0.5 * dt * rows.decay[i, k]
            if x > 0.0:
                F[k, k] = max(1.0 - x, 0.0) / (1.0 + x)  # exp(-2 x) up to errors of order x^3, without libm
                rows.bias[i, k] *= F[k, k]
                Q[k, k] = 0.5 * rows.walk[i, k] / rows.decay[i, k] * (1.0 - F[k, k] * F[k, k])


@portable
def correct(row: Array, layout: Array, gravity: float, error: Array) -> None:
    """Correct the state and the biases by an estimated error."""
    has_accel_bias = layout[LAYOUT.accel_bias] != 0
    put_reckoning(row, corrected(reckoning(row), error, has_accel_bias, gravity))
    put(row, NOMINAL.v_start, vector(row, NOMINAL.v_WB))
    increase(row, NOMINAL.p_corrected, error, 0)
    increase(row, NOMINAL.v_corrected, error, 3)
    increase(row, NOMINAL.gyro_bias, error, 9)
    if has_accel_bias:
        increase(row, NOMINAL.accel_bias, error, 12)


@inlined
def turn_heading(row: Array, gravity: float, angle: float) -> None:
    """Turn the attitude about the world's z axis by an angle [rad]."""
    q = multiply(about_z(angle), quaternion(row, NOMINAL.q_WB))
    put_quaternion(row, NOMINAL.q_WB, q)
    put(row, NOMINAL.a_WB, acceleration(q, vector(row, NOMINAL.f_B), gravity))
    put(row, NOMINAL.v_start, vector(row, NOMINAL.v_WB))


@portable
def clone(rows: Rows, i: int, J: Array, first: int) -> None:
    """Replace the oldest clone with the present position and velocity, if one is due.

    J is the covariance of the drone's errors or of all drones' errors; `first` is the index of the drone's first state.
    """
    row, layout = rows.nominal[i], rows.layout[i]
    if not layout[LAYOUT.clones] or not rows.counts[i, COUNT.heading_known]:
        return
    every_s = rows.setting[i, SETTING.clone_every]
    # Clones are due at multiples of every_s, as samples are at multiples of their own periods
    count = math.floor(row[NOMINAL.t] / every_s + 1e-6)
    slot = count % layout[LAYOUT.clones]
    former = rows.clones[i, slot]
    if former[CLONE.t] / every_s + 1e-6 >= count:  # also false for an unused clone, whose time is NaN
        return
    former[CLONE.t] = row[NOMINAL.t]
    put(former, CLONE.p_corrected, vector(row, NOMINAL.p_corrected))
    put(former, CLONE.v_corrected, vector(row, NOMINAL.v_corrected))
    state = layout[LAYOUT.first_clone] + CLONED * slot
    rows.bias[i, state : state + CLONED] = 0.0
    J[first + state : first + state + CLONED] = J[first : first + CLONED]
    J[:, first + state : first + state + CLONED] = J[:, first : first + CLONED]


@inlined
def remember(counts: Array, history: Array, capacity: int, now: Moment) -> None:
    """Add the present moment to the history as its newest entry."""
    newest = counts[COUNT.newest] + 1 if counts[COUNT.kept] else 0
    if newest == capacity:
        newest = 0
    put_moment(history[newest], now)
    counts[COUNT.newest] = newest
    counts[COUNT.kept] = min(counts[COUNT.kept] + 1, capacity)


@inlined
def recall_known(rows: Rows, i: int, t_s: float, now: Moment) -> tuple[Moment, float, int]:
    """Return the state at `t_s` as known now, and the errors that it shares.

    Returns:
        The state; how much earlier it is than the position and velocity whose errors it shares [s]; the index of those
        errors in the error state: 0 for the present position and velocity, otherwise a clone's.
    """
    past = recall(rows.counts[i], rows.history[i], rows.layout[i, LAYOUT.history], t_s, now)
    nearest, slot = abs(now[0] - t_s), -1
    for k in range(rows.layout[i, LAYOUT.clones]):
        gap_s = abs(rows.clones[i, k, CLONE.t] - t_s)
        if gap_s < nearest:  # false for an unused clone, whose time is NaN
            nearest, slot = gap_s, k
    if slot < 0:
        return past, now[0] - past[0], 0
    former, state = rows.clones[i, slot], rows.layout[i, LAYOUT.first_clone] + CLONED * slot
    lag = former[CLONE.t] - past[0]
    e_p, e_v = vector(rows.bias[i], state), vector(rows.bias[i], state + 3)
    p = add(subtract(past[1], subtract(now[5], vector(former, CLONE.p_corrected))), axpy(e_p, -lag, e_v))
    v = add(subtract(past[2], subtract(now[6], vector(former, CLONE.v_corrected))), e_v)
    return (past[0], p, v, past[3], past[4], past[5], past[6]), lag, state


@inlined
def recall(counts: Array, history: Array, capacity: int, t_s: float, now: Moment) -> Moment:
    """Return the state at `t_s` as known at `now`, including later corrections.

    The state is interpolated between the history's entries and `now`, constant before the oldest entry, and
    extrapolated after `now` with constant velocity and rate. `capacity` is the number of entries of the drone's ring,
    `history`.
    """
    if t_s == now[0]:
        return now
    if t_s > now[0]:
        return _extrapolated(now, t_s - now[0])
    later = now
    for age in range(counts[COUNT.kept]):
        past = moment(history[(counts[COUNT.newest] - age + capacity) % capacity])
        if past[0] <= t_s:
            earlier = _with_corrections(past, now)
            return earlier if past[0] == t_s else _interpolated(earlier, _with_corrections(later, now), t_s)
        later = past
    return _with_corrections(later, now)


@inlined
def _with_corrections(past: Moment, now: Moment) -> Moment:
    """Return a past state including the corrections since then."""
    p = subtract(add(past[1], now[5]), past[5])
    v = subtract(add(past[2], now[6]), past[6])
    return past[0], p, v, past[3], past[4], now[5], now[6]


@inlined
def _extrapolated(now: Moment, dt: float) -> Moment:
    t_s, p, v, q, w, p_corrected, v_corrected = now
    turned = multiply(q, rotation_vector_quaternion(scaled(w, dt)))
    return t_s + dt, axpy(p, dt, v), v, turned, w, p_corrected, v_corrected


@inlined
def _interpolated(a: Moment, b: Moment, t_s: float) -> Moment:
    """Interpolate linearly; the quaternions of neighbouring moments never differ in sign."""
    fraction = (t_s - a[0]) / (b[0] - a[0])
    q_a, q_b = a[3], b[3]
    q = normalised((
        q_a[0] + fraction * (q_b[0] - q_a[0]),
        q_a[1] + fraction * (q_b[1] - q_a[1]),
        q_a[2] + fraction * (q_b[2] - q_a[2]),
        q_a[3] + fraction * (q_b[3] - q_a[3]),
    ))  # fmt: skip
    return t_s, _lerp(a[1], b[1], fraction), _lerp(a[2], b[2], fraction), q, _lerp(a[4], b[4], fraction), b[5], b[6]


@inlined
def _lerp(a: Vector, b: Vector, fraction: float) -> Vector:
    return axpy(a, fraction, subtract(b, a))


@inlined
def move_columns(H: Array, at: int, size: int, state: int) -> None:
    """Move derivatives with respect to the present position and velocity, in rows of H, to the clone at `state`."""
    for r in range(at, at + size if state > 0 else at):
        for k in range(CLONED):
            H[r, state + k] = H[r, k]
            H[r, k] = 0.0


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
    """Return the state after one IMU sample: Madgwick's step, then velocity and position by the trapezoidal rule.

    Args:
        state: state at the previous sample.
        accel: measured specific force at the centre of mass [m/s^2; B].
        gyro: measured body rate [rad/s; B].
        accel_bias, gyro_bias: biases to be subtracted from these.
        beta: Madgwick's gain [rad/s].
        gravity: magnitude of g_W [m/s^2], which points along -z.
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
    """Return J^T f, the gradient of |R_BW z_W - f_B/|f_B||^2 / 2 with respect to q [Madgwick (25), (26), (34)]."""
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
    """Return the quaternion of a rotation vector [rad], by a series accurate to 1e-9 up to 0.6 rad, without libm.

    Gyroscope steps and filter corrections are far below that; the result is always normalised.
    """
    s = dot(v, v)
    cosine = 1.0 - s / 8.0 + s * s / 384.0 - s * s * s / 46080.0
    sine = 0.5 - s / 48.0 + s * s / 3840.0 - s * s * s / 645120.0
    return normalised((cosine, *scaled(v, sine)))


def levelling_time_s(beta: float, direction_sigma_rad: float) -> float:
    """Return the time constant with which Madgwick's filter follows the measured tilt [s]; infinite for beta = 0.

    The filter's step has a fixed length 2 beta dt. With noise sigma of the measured direction per axis [rad], its mean
    along a small offset e is 2 beta dt * sqrt(pi/8) * e/sigma, so the tilt error decays as a first-order lag.
    """
    if beta == 0.0:
        return math.inf
    return direction_sigma_rad / (2.0 * UNIT_VECTOR_SLOPE * beta)


def beta_for(levelling_s: float, direction_sigma_rad: float) -> float:
    """Return the gain [rad/s] for a levelling time [s]; inverse of `levelling_time_s`."""
    return direction_sigma_rad / (2.0 * UNIT_VECTOR_SLOPE * levelling_s)


@inlined
def corrected(state: Reckoning, error: Array, has_accel_bias: bool, gravity: float) -> Reckoning:
    """Return the state corrected by an estimated error, (n,)."""
    p, v, q, _, w, f_B = state
    p, v = add(p, vector(error, POSITION)), add(v, vector(error, VELOCITY))
    q = normalised(multiply(rotation_vector_quaternion(vector(error, ATTITUDE)), q))
    w = subtract(w, vector(error, GYRO_BIAS))
    if has_accel_bias:
        f_B = subtract(f_B, vector(error, ACCEL_BIAS))
    return p, v, q, acceleration(q, f_B, gravity), w, f_B


@inlined
def arm_acceleration(w: Vector, w_before: Vector, arm: Vector, dt: float) -> Vector:
    """Return alpha x r + w x (w x r) [m/s^2; B], the additional acceleration at p_BS = `arm`."""
    alpha = ((w[0] - w_before[0]) / dt, (w[1] - w_before[1]) / dt, (w[2] - w_before[2]) / dt)
    return add(cross(alpha, arm), cross(w, cross(w, arm)))


@inlined
def write_prediction(
    F: Array,
    Q: Array,
    walk: Array,
    state: Reckoning,
    v_before: Vector,
    gravity: float,
    levelling_s: float,
    has_accel_bias: bool,
    variances: Vector,
    dt: float,
) -> None:
    """Write the transition and the process noise of dead reckoning from the velocity `v_before` [m/s] to `state`."""
    v = state[1]
    f_W = (
        (v[0] - v_before[0]) / dt,
        (v[1] - v_before[1]) / dt,
        (v[2] - v_before[2]) / dt + gravity,
    )
    write_transition(F, f_W, matrix(state[2]), levelling_s, has_accel_bias, dt)
    write_process_noise(Q, walk, variances, dt)


@inlined
def write_transition(F: Array, f_W: Vector, R_WB: Matrix, levelling_s: float, has_accel_bias: bool, dt: float) -> None:
    """Write the transition of the error state over `dt` [s] into F, (n, n), the identity on entry.

    p' = v; v' = -[f_W]x theta - R b_a; theta' = -R b_g - (theta_x, theta_y, 0)/levelling_s.

    f_W is the mean specific force [m/s^2], levelling_s the time constant of levelling [s], possibly infinite.
    """
    for i in range(3):
        F[POSITION + i, VELOCITY + i] = dt
    write_minus_cross(F, POSITION, ATTITUDE, f_W, 0.5 * dt * dt)
    write_minus_cross(F, VELOCITY, ATTITUDE, f_W, dt)
    write_minus_rotation(F, ATTITUDE, GYRO_BIAS, R_WB, dt)
    F[ATTITUDE, ATTITUDE] = F[ATTITUDE + 1, ATTITUDE + 1] = 1.0 / (1.0 + dt / levelling_s)
    if has_accel_bias:
        write_minus_rotation(F, POSITION, ACCEL_BIAS, R_WB, 0.5 * dt * dt)
        write_minus_rotation(F, VELOCITY, ACCEL_BIAS, R_WB, dt)


@inlined
def write_minus_cross(M: Array, row: int, column: int, a: Vector, scale: float) -> None:
    """Write -scale [a]x into a 3 x 3 block whose diagonal is already zero."""
    M[row, column + 1] = scale * a[2]
    M[row, column + 2] = -scale * a[1]
    M[row + 1, column] = -scale * a[2]
    M[row + 1, column + 2] = scale * a[0]
    M[row + 2, column] = scale * a[1]
    M[row + 2, column + 1] = -scale * a[0]


@inlined
def write_minus_rotation(M: Array, row: int, column: int, R: Matrix, scale: float) -> None:
    """Write -scale R into a 3 x 3 block."""
    for i in range(3):
        for j in range(3):
            M[row + i, column + j] = -scale * R[i][j]


@inlined
def write_process_noise(Q: Array, walk: Array, variances: Vector, dt: float) -> None:
    """Write the process noise of an interval `dt` [s] into Q, (n, n), zero on entry.

    `walk`, (n,), is the density of each bias's random walk [unit^2/s], zero elsewhere; `variances` are those that
    velocity [m^2/s^2], tilt and yaw [rad^2] gain per axis.
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
def heading_and_sigma(q: Quaternion, P: Array) -> tuple[float, float]:
    """Return the heading [rad] and its standard deviation [rad], given the covariance P of the error state."""
    gradient = heading_gradient(matrix(q))
    variance = 0.0
    for i in range(3):
        for j in range(3):
            variance += gradient[i] * P[ATTITUDE + i, ATTITUDE + j] * gradient[j]
    return heading(q), math.sqrt(max(variance, 0.0))


@inlined
def heading_gradient(R: Matrix) -> Vector:
    """Return the derivative of the heading with respect to a small rotation in W; (0, 0, 1) if the nose is level."""
    x = column(R, 0)
    squared = max(x[0] * x[0] + x[1] * x[1], HORIZONTAL_MIN)
    return -x[2] * x[0] / squared, -x[2] * x[1] / squared, 1.0
