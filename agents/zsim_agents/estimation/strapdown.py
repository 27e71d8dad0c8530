"""The nominal state of a drone, a row: moved by every sample of its IMU, corrected by the filter, and remembered.

A late reading measures a state that does not contain the process noise since then. Where that matters, clones of
position and velocity stand in the error state: the reading is compared with the clone nearest to its instant, and the
correlations do the rest. S. I. Roumeliotis, J. W. Burdick, "Stochastic cloning: a generalized framework for processing
relative state measurements", IEEE International Conference on Robotics and Automation, 2002.
"""

import math

import numpy as np

from zsim.math.compiled import inlined, portable
from zsim.math.rotation import Vector, about_z, add, axpy, multiply, normalised, product, scaled, subtract
from zsim_agents.estimation.dead_reckoning import (
    acceleration,
    arm_acceleration,
    corrected,
    reckon,
    rotation_vector_quaternion,
    write_prediction,
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
    Moment,
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

ZERO: Vector = (0.0, 0.0, 0.0)
ACCEL_MAX_M_S2 = 500.0  # m/s^2, 50 g: no MEMS accelerometer of a drone reads more
GYRO_MAX_RAD_S = 100.0  # rad/s, 5700 deg/s: likewise
MANOEUVRE_M_S2 = 0.3  # m/s^2, standard deviation of the acceleration in gusts of 0.5 m/s (0.16) and in transit
MANOEUVRE_S = 0.5  # s, its correlation time
LOST_TURN_RAD_S = 0.5  # rad/s, standard deviation of the rate during a missing gyroscope sample
COAST_TURN_DENSITY = LOST_TURN_RAD_S**2 * 2.0 * MANOEUVRE_S  # rad^2/s
COAST_VELOCITY_DENSITY = 1.0  # m^2/s^3: 1 m/s after 1 s without an IMU


@inlined
def move(rows: Rows, i: int, t_s: float, accel: Vector, gyro: Vector) -> None:
    """Move to the instant of an IMU sample; ignore a duplicate, refuse and count a late or impossible sample.

    Args:
        t_s: instant of the sample [s].
        accel: specific force [m/s^2; S].
        gyro: body rate [rad/s; S].
    """
    row, counts, setting, layout = rows.nominal[i], rows.counts[i], rows.setting[i], rows.layout[i]
    if not possible(accel, gyro):
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
        _lose(row, dt - period)
    if layout[LAYOUT.imu_displaced]:
        accel, gyro = _of_body(row, setting, accel, gyro, dt)
    state = reckoning(row)
    biases = vector(row, NOMINAL.accel_bias), vector(row, NOMINAL.gyro_bias)
    moved = reckon(state, accel, gyro, biases[0], biases[1], setting[SETTING.beta], setting[SETTING.gravity], dt)
    put_reckoning(row, moved)
    before, after = state[5], moved[5]
    jolt = abs(after[0] - before[0]) + abs(after[1] - before[1]) + abs(after[2] - before[2])
    if jolt > setting[SETTING.jolt]:
        hidden = 0.5 * jolt * dt  # error of a step anywhere between two samples
        row[NOMINAL.lost_velocity] += hidden * hidden
    row[NOMINAL.t] = t_s
    row[NOMINAL.dt_squared] += dt * dt
    counts[COUNT.used + IMU] += 1


@inlined
def possible(accel: Vector, gyro: Vector) -> bool:
    """Tell whether an IMU can read such values; NaN fails each comparison."""
    good = True
    for k in range(3):
        good = good and abs(accel[k]) < ACCEL_MAX_M_S2 and abs(gyro[k]) < GYRO_MAX_RAD_S
    return good


@inlined
def _lose(row: np.ndarray, missing_s: float) -> None:
    velocity, turned = MANOEUVRE_M_S2 * missing_s, LOST_TURN_RAD_S * missing_s
    row[NOMINAL.lost_velocity] += velocity * velocity
    row[NOMINAL.lost_turn] += turned * turned


@inlined
def _of_body(row: np.ndarray, setting: np.ndarray, accel: Vector, gyro: Vector, dt: float) -> tuple[Vector, Vector]:
    """Convert a sample of a turned or displaced IMU into one at the centre of mass, in body axes."""
    imu = SETTING.sensors + IMU * SENSOR.size
    R_BS = matrix_at(setting, imu + SENSOR.R_BS)
    accel, gyro = product(R_BS, accel), product(R_BS, gyro)
    w = subtract(gyro, vector(row, NOMINAL.gyro_bias))
    swing = arm_acceleration(w, vector(row, NOMINAL.w_WB_B), vector(setting, imu + SENSOR.p_BS), dt)
    return subtract(accel, swing), gyro


@inlined
def begin(row: np.ndarray, counts: np.ndarray, t_s: float) -> None:
    row[NOMINAL.t] = t_s
    counts[COUNT.running] = 1
    begin_interval(row, t_s)


@inlined
def begin_interval(row: np.ndarray, t_s: float) -> None:
    """Begin the interval between two gates."""
    row[NOMINAL.t_start] = t_s
    put(row, NOMINAL.v_start, vector(row, NOMINAL.v_WB))
    row[NOMINAL.dt_squared] = row[NOMINAL.lost_velocity] = row[NOMINAL.lost_turn] = 0.0


@inlined
def coast(row: np.ndarray, setting: np.ndarray, t_s: float) -> None:
    """Go on without an IMU after a long gap: velocity and attitude are held and become less certain."""
    dt = t_s - row[NOMINAL.t]
    if dt <= setting[SETTING.coast_after]:
        return
    p, v, q, _, _, f_B = reckoning(row)
    put_reckoning(row, (axpy(p, dt, v), v, q, ZERO, ZERO, f_B))
    row[NOMINAL.t] = t_s
    row[NOMINAL.lost_velocity] += COAST_VELOCITY_DENSITY * dt
    row[NOMINAL.lost_turn] += COAST_TURN_DENSITY * dt


@portable
def grow(rows: Rows, i: int, P: np.ndarray) -> np.ndarray:
    """Return the covariance grown over the interval of dead reckoning that ends now, and begin the next one."""
    row, n = rows.nominal[i], rows.layout[i, LAYOUT.first_clone]
    if row[NOMINAL.t] > row[NOMINAL.t_start]:
        F, Q = np.eye(n), np.zeros((n, n))
        write_growth(rows, i, F, Q)
        if n < P.shape[0]:
            predict_jointly(P, 0, F, Q)  # the clones, which do not change, are the other errors
        else:
            P = predicted_covariance(P, F, Q)
    begin_interval(row, row[NOMINAL.t])
    return P


@inlined
def write_growth(rows: Rows, i: int, F: np.ndarray, Q: np.ndarray) -> None:
    """Write the growth of the errors over the interval that ends now: transition into F, which is I, and noise into Q.

    Biases that are Gauss-Markov processes decay.
    """
    row, setting = rows.nominal[i], rows.setting[i]
    dt, dt_squared = row[NOMINAL.t] - row[NOMINAL.t_start], row[NOMINAL.dt_squared]
    turned = setting[SETTING.gyro_variance] * dt_squared + row[NOMINAL.lost_turn]
    velocity = setting[SETTING.accel_variance] * dt_squared + row[NOMINAL.lost_velocity]
    write_prediction(
        F,
        Q,
        rows.walk[i, : F.shape[0]],
        reckoning(row),
        vector(row, NOMINAL.v_start),
        setting[SETTING.gravity],
        setting[SETTING.levelling],
        rows.layout[i, LAYOUT.accel_bias] != 0,
        (velocity, turned + setting[SETTING.tilt_density] * dt, turned),
        dt,
    )
    if rows.layout[i, LAYOUT.correlated]:
        for k in range(F.shape[0]):
            x = 0.5 * dt * rows.decay[i, k]
            if x > 0.0:
                F[k, k] = max(1.0 - x, 0.0) / (1.0 + x)  # exp(-2 x) to x^3, without libm
                rows.bias[i, k] *= F[k, k]
                Q[k, k] = 0.5 * rows.walk[i, k] / rows.decay[i, k] * (1.0 - F[k, k] * F[k, k])


@portable
def correct(row: np.ndarray, layout: np.ndarray, gravity: float, error: np.ndarray) -> None:
    """Correct the state and the biases by an error of the filter."""
    with_accel_bias = layout[LAYOUT.accel_bias] != 0
    put_reckoning(row, corrected(reckoning(row), error, with_accel_bias, gravity))
    put(row, NOMINAL.v_start, vector(row, NOMINAL.v_WB))
    increase(row, NOMINAL.p_corrected, error, 0)
    increase(row, NOMINAL.v_corrected, error, 3)
    increase(row, NOMINAL.gyro_bias, error, 9)
    if with_accel_bias:
        increase(row, NOMINAL.accel_bias, error, 12)


@inlined
def turn_heading(row: np.ndarray, gravity: float, angle: float) -> None:
    """Turn the attitude about the world's z axis."""
    q = multiply(about_z(angle), quaternion(row, NOMINAL.q_WB))
    put_quaternion(row, NOMINAL.q_WB, q)
    put(row, NOMINAL.a_WB, acceleration(q, vector(row, NOMINAL.f_B), gravity))
    put(row, NOMINAL.v_start, vector(row, NOMINAL.v_WB))


@portable
def clone(rows: Rows, i: int, J: np.ndarray, first: int) -> None:
    """Replace the oldest clone by the present position and velocity, if it is time for one.

    J is the covariance of the drone's errors, or of all drones' together, in which `first` is its first state.
    """
    row, layout = rows.nominal[i], rows.layout[i]
    if not layout[LAYOUT.clones] or not rows.counts[i, COUNT.heading_known]:
        return
    every_s = rows.setting[i, SETTING.clone_every]
    count = math.floor(row[NOMINAL.t] / every_s + 1e-6)  # from t = 0 on, as samples are
    slot = count % layout[LAYOUT.clones]
    former = rows.clones[i, slot]
    if former[CLONE.t] / every_s + 1e-6 >= count:  # also false where there is none
        return
    former[CLONE.t] = row[NOMINAL.t]
    put(former, CLONE.p_corrected, vector(row, NOMINAL.p_corrected))
    put(former, CLONE.v_corrected, vector(row, NOMINAL.v_corrected))
    state = layout[LAYOUT.first_clone] + CLONED * slot
    rows.bias[i, state : state + CLONED] = 0.0
    J[first + state : first + state + CLONED] = J[first : first + CLONED]
    J[:, first + state : first + state + CLONED] = J[:, first : first + CLONED]


@inlined
def remember(counts: np.ndarray, history: np.ndarray, longest: int, now: Moment) -> None:
    """Add the present instant, the newest, to the history."""
    newest = counts[COUNT.newest] + 1 if counts[COUNT.kept] else 0
    if newest == longest:
        newest = 0
    put_moment(history[newest], now)
    counts[COUNT.newest] = newest
    counts[COUNT.kept] = min(counts[COUNT.kept] + 1, longest)


@inlined
def recall_known(rows: Rows, i: int, t_s: float, now: Moment) -> tuple[Moment, float, int]:
    """Return the state at `t_s` as it is known now, with the errors that it has.

    Returns:
        the state; how much earlier it is than the position and velocity whose errors it has [s]; the place of these in
        the error state: 0 for the present ones, else those of a clone.
    """
    past = recall(rows.counts[i], rows.history[i], rows.layout[i, LAYOUT.history], t_s, now)
    nearest, slot = abs(now[0] - t_s), -1
    for k in range(rows.layout[i, LAYOUT.clones]):
        away = abs(rows.clones[i, k, CLONE.t] - t_s)
        if away < nearest:  # false where there is none
            nearest, slot = away, k
    if slot < 0:
        return past, now[0] - past[0], 0
    former, state = rows.clones[i, slot], rows.layout[i, LAYOUT.first_clone] + CLONED * slot
    lag = former[CLONE.t] - past[0]
    e_p, e_v = vector(rows.bias[i], state), vector(rows.bias[i], state + 3)
    p = add(subtract(past[1], subtract(now[5], vector(former, CLONE.p_corrected))), axpy(e_p, -lag, e_v))
    v = add(subtract(past[2], subtract(now[6], vector(former, CLONE.v_corrected))), e_v)
    return (past[0], p, v, past[3], past[4], past[5], past[6]), lag, state


@inlined
def recall(counts: np.ndarray, history: np.ndarray, longest: int, t_s: float, now: Moment) -> Moment:
    """Return the state at `t_s` as `now` sees it, later corrections included.

    It is interpolated between the history's entries and `now`, the oldest one before them, and extrapolated with
    constant velocity and rate after `now`. `history` is the drone's ring, of which it uses `longest` entries.
    """
    if t_s == now[0]:
        return now
    if t_s > now[0]:
        return _ahead(now, t_s - now[0])
    later = now
    for back in range(counts[COUNT.kept]):
        past = moment(history[(counts[COUNT.newest] - back + longest) % longest])
        if past[0] <= t_s:
            earlier = _as_seen(past, now)
            return earlier if past[0] == t_s else _between(earlier, _as_seen(later, now), t_s)
        later = past
    return _as_seen(later, now)


@inlined
def _as_seen(past: Moment, now: Moment) -> Moment:
    """Return a past state with the corrections since then."""
    p = subtract(add(past[1], now[5]), past[5])
    v = subtract(add(past[2], now[6]), past[6])
    return past[0], p, v, past[3], past[4], now[5], now[6]


@inlined
def _ahead(now: Moment, dt: float) -> Moment:
    t_s, p, v, q, w, p_corrected, v_corrected = now
    turned = multiply(q, rotation_vector_quaternion(scaled(w, dt)))
    return t_s + dt, axpy(p, dt, v), v, turned, w, p_corrected, v_corrected


@inlined
def _between(a: Moment, b: Moment, t_s: float) -> Moment:
    """Interpolate linearly; quaternions of neighbouring instants are never opposite."""
    part = (t_s - a[0]) / (b[0] - a[0])
    q_a, q_b = a[3], b[3]
    q = normalised((
        q_a[0] + part * (q_b[0] - q_a[0]),
        q_a[1] + part * (q_b[1] - q_a[1]),
        q_a[2] + part * (q_b[2] - q_a[2]),
        q_a[3] + part * (q_b[3] - q_a[3]),
    ))  # fmt: skip
    return t_s, _mix(a[1], b[1], part), _mix(a[2], b[2], part), q, _mix(a[4], b[4], part), b[5], b[6]


@inlined
def _mix(a: Vector, b: Vector, part: float) -> Vector:
    return axpy(a, part, subtract(b, a))


@inlined
def move_columns(H: np.ndarray, at: int, size: int, state: int) -> None:
    """Convert rows of a Jacobian by the present position and velocity into rows by those of a clone at `state`."""
    for r in range(at, at + size if state > 0 else at):
        for k in range(CLONED):
            H[r, state + k] = H[r, k]
            H[r, k] = 0.0
