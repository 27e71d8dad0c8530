"""The nominal state of one of many drones, moved by its IMU: what `strapdown.Strapdown` does, on a row.

Both are held together bit by bit by a test.
"""

import math

import numpy as np

from zsim.math.compiled import portable
from zsim_agents.estimation import estimator_rows as er
from zsim_agents.estimation.dead_reckoning import acceleration, arm_acceleration, corrected, plus, reckon
from zsim_agents.estimation.madgwick import Vector, normalised, product, rotation_vector_quaternion, turn
from zsim_agents.estimation.strapdown import (
    ACCEL_MAX_M_S2,
    COAST_TURN_DENSITY,
    COAST_VELOCITY_DENSITY,
    GYRO_MAX_RAD_S,
    LOST_TURN_RAD_S,
    MANOEUVRE_M_S2,
    ZERO,
)


@portable
def possible(accel: Vector, gyro: Vector) -> bool:
    """Whether an IMU can read that; NaN fails each comparison."""
    good = True
    for k in range(3):
        good = good and abs(accel[k]) < ACCEL_MAX_M_S2 and abs(gyro[k]) < GYRO_MAX_RAD_S
    return good


@portable
def begin_interval(row: np.ndarray, t_s: float) -> None:
    """Let the interval between two gates begin."""
    row[er.FROM] = t_s
    er.put(row, er.V_BEFORE, er.vector(row, er.V))
    row[er.SQUARE] = row[er.LOST_VELOCITY] = row[er.LOST_TURN] = 0.0


@portable
def begin(row: np.ndarray, tally: np.ndarray, t_s: float) -> None:
    """Begin at an instant."""
    row[er.T] = t_s
    tally[er.RUNNING] = 1
    begin_interval(row, t_s)


@portable
def move(
    row: np.ndarray, tally: np.ndarray, setting: np.ndarray, fixed: np.ndarray, t_s: float, accel: Vector, gyro: Vector
) -> None:
    """Move to an IMU sample's instant; ignore a duplicate, refuse and count a late or impossible sample.

    Args:
        row, tally, setting, fixed: of the drone.
        t_s: instant of the sample [s].
        accel: specific force [m/s^2; S].
        gyro: body rate [rad/s; S].
    """
    if not possible(accel, gyro):
        tally[er.REFUSED + er.IMU] += 1
        return
    period = setting[er.PERIOD]
    if not tally[er.RUNNING]:
        begin(row, tally, t_s - period)
    dt = t_s - row[er.T]
    if dt <= 0.0:
        tally[er.REFUSED + er.IMU] += 1 if dt < 0.0 else 0
        return
    if dt > 1.5 * period:
        _lose(row, dt - period)
    if fixed[er.ASIDE]:
        accel, gyro = _of_body(row, setting, accel, gyro, dt)
    state = er.reckoning(row)
    biases = er.vector(row, er.ACCEL_OFF), er.vector(row, er.GYRO_OFF)
    moved = reckon(state, accel, gyro, biases[0], biases[1], setting[er.BETA], setting[er.GRAVITY], dt)
    er.put_reckoning(row, moved)
    before, after = state[5], moved[5]
    jolt = abs(after[0] - before[0]) + abs(after[1] - before[1]) + abs(after[2] - before[2])
    if jolt > setting[er.JOLT]:
        hidden = 0.5 * jolt * dt  # what a step anywhere between two samples hides
        row[er.LOST_VELOCITY] += hidden * hidden
    row[er.T] = t_s
    row[er.SQUARE] += dt * dt
    tally[er.USED + er.IMU] += 1


@portable
def _lose(row: np.ndarray, missing_s: float) -> None:
    velocity, turned = MANOEUVRE_M_S2 * missing_s, LOST_TURN_RAD_S * missing_s
    row[er.LOST_VELOCITY] += velocity * velocity
    row[er.LOST_TURN] += turned * turned


@portable
def _of_body(row: np.ndarray, setting: np.ndarray, accel: Vector, gyro: Vector, dt: float) -> tuple[Vector, Vector]:
    """Return a sample of a turned or displaced IMU as one of the centre of mass, in body axes."""
    R_BS = er.matrix(setting, er.IMU_TURN)
    accel, gyro = turn(R_BS, accel), turn(R_BS, gyro)
    w = plus(gyro, er.vector(row, er.GYRO_OFF), -1.0)
    swing = arm_acceleration(w, er.vector(row, er.W), er.vector(setting, er.IMU_ARM), dt)
    return plus(accel, swing, -1.0), gyro


@portable
def coast(row: np.ndarray, setting: np.ndarray, t_s: float) -> None:
    """Go on without an IMU if none came for long: velocity and attitude held, their certainty fading."""
    dt = t_s - row[er.T]
    if dt <= setting[er.COAST_AFTER]:
        return
    p, v, q, _, _, f_B = er.reckoning(row)
    er.put_reckoning(row, (plus(p, v, dt), v, q, ZERO, ZERO, f_B))
    row[er.T] = t_s
    row[er.LOST_VELOCITY] += COAST_VELOCITY_DENSITY * dt
    row[er.LOST_TURN] += COAST_TURN_DENSITY * dt


@portable
def correct(row: np.ndarray, fixed: np.ndarray, gravity: float, error: np.ndarray) -> None:
    """Put an error of the filter into the state and the biases."""
    with_accel_bias = fixed[er.WITH_ACCEL_BIAS] != 0
    er.put_reckoning(row, corrected(er.reckoning(row), error, with_accel_bias, gravity))
    er.put(row, er.V_BEFORE, er.vector(row, er.V))
    er.add(row, er.P_CORRECTED, error, 0)
    er.add(row, er.V_CORRECTED, error, 3)
    er.add(row, er.GYRO_OFF, error, 9)
    if with_accel_bias:
        er.add(row, er.ACCEL_OFF, error, 12)


@portable
def turn_heading(row: np.ndarray, gravity: float, angle: float) -> None:
    """Turn the attitude about the world's z axis."""
    q = product((math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle)), er.quaternion(row, er.Q))
    er.put_quaternion(row, er.Q, q)
    er.put(row, er.A, acceleration(q, er.vector(row, er.F), gravity))
    er.put(row, er.V_BEFORE, er.vector(row, er.V))


@portable
def remember(tally: np.ndarray, history: np.ndarray, longest: int, now: er.Moment) -> None:
    """Keep one more instant, not before any other."""
    newest = tally[er.NEWEST] + 1 if tally[er.KEPT] else 0
    if newest == longest:
        newest = 0
    er.put_moment(history[newest], now)
    tally[er.NEWEST] = newest
    tally[er.KEPT] = min(tally[er.KEPT] + 1, longest)


@portable
def recall(tally: np.ndarray, history: np.ndarray, longest: int, t_s: float, now: er.Moment) -> er.Moment:
    """Return the state at `t_s` as `now` sees it; see `state_history.StateHistory.at`."""
    if t_s == now[0]:
        return now
    if t_s > now[0]:
        return _ahead(now, t_s - now[0])
    later = now
    for back in range(tally[er.KEPT]):
        past = er.moment_at(history[(tally[er.NEWEST] - back + longest) % longest])
        if past[0] <= t_s:
            earlier = _as_seen(past, now)
            return earlier if past[0] == t_s else _between(earlier, _as_seen(later, now), t_s)
        later = past
    return _as_seen(later, now)


@portable
def _as_seen(past: er.Moment, now: er.Moment) -> er.Moment:
    """Return a past state with the corrections since then."""
    p = plus(plus(past[1], now[5], 1.0), past[5], -1.0)
    v = plus(plus(past[2], now[6], 1.0), past[6], -1.0)
    return past[0], p, v, past[3], past[4], now[5], now[6]


@portable
def _ahead(now: er.Moment, dt: float) -> er.Moment:
    t_s, p, v, q, w, p_corrected, v_corrected = now
    turned = rotation_vector_quaternion((dt * w[0], dt * w[1], dt * w[2]))
    return t_s + dt, plus(p, v, dt), v, product(q, turned), w, p_corrected, v_corrected


@portable
def _between(a: er.Moment, b: er.Moment, t_s: float) -> er.Moment:
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


@portable
def _mix(a: Vector, b: Vector, part: float) -> Vector:
    return a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), a[2] + part * (b[2] - a[2])
