"""A gate of one of many drones: its readings judged and put into dead reckoning, and its estimate.

What `drone_estimator.DroneEstimator`, `fusion.Fusion` and `navigation_filter.NavigationFilter` do, on a row; all are
held together bit by bit by a test. The mathematics is that of kalman_update.py and aiding_models.py.
"""

import math

import numpy as np

from zsim.math.compiled import portable
from zsim_agents.estimation import estimator_motion as motion
from zsim_agents.estimation import estimator_rows as er
from zsim_agents.estimation.aiding import SQUARE_MAX, VALUE_MAX
from zsim_agents.estimation.aiding_models import write_baro, write_flow, write_gps, write_mag, write_sonar
from zsim_agents.estimation.dead_reckoning import (
    ATTITUDE,
    POSITION,
    VELOCITY,
    heading_and_sigma,
    plus,
    write_prediction,
)
from zsim_agents.estimation.estimator_prior import HEADING_SIGMA_RAD, HEADING_WAIT_S, SET_DOWN_SIGMA_RAD
from zsim_agents.estimation.kalman_update import ROWS_MAX, predicted_covariance, stacked_update
from zsim_agents.estimation.madgwick import heading, normalised, product, rotation, rotation_vector_quaternion, turn

YAW_STATE = ATTITUDE + 2


@portable
def accept(row: np.ndarray, tally: np.ndarray, setting: np.ndarray, fixed: np.ndarray, reading: np.ndarray) -> bool:
    """Whether an aiding reading is to wait for the end of the gate; its variance then stands in `reading`'s extras.

    What is not new, out of order, too old or no number is counted as refused, but for duplicates, which are not counted
    at all, and a sonar without an echo, which says nothing.
    """
    kind = int(reading[er.KIND])
    if (kind == er.MAG and not fixed[er.MAGNETOMETER]) or (kind == er.FLOW and not fixed[er.USES_FLOW]):
        return False
    if kind == er.SONAR and reading[er.EXTRA] == 0.0:
        return False
    blind_gps = kind == er.GPS and not (reading[er.EXTRA + 1] != 0.0 and abs(reading[er.EXTRA]) < VALUE_MAX)
    if blind_gps or (kind == er.FLOW and not reading[er.EXTRA] > 0.0):
        tally[er.REFUSED + kind] += 1
        return False
    t_sample_s = reading[er.SAMPLED]
    if t_sample_s == row[er.T_SAMPLE + kind]:
        return False
    age_s, size = reading[er.ARRIVED] - t_sample_s, 0.0
    for k in range(er.SIZES[kind]):
        size += abs(reading[er.VALUE + k])
    if t_sample_s > row[er.T_SAMPLE + kind] and 0.0 <= age_s <= setting[er.AGE_MAX] and size < VALUE_MAX:
        row[er.T_SAMPLE + kind] = t_sample_s
        return True
    tally[er.REFUSED + kind] += 1
    return False


@portable
def set_variance(P: np.ndarray, k: int, variance: float) -> None:
    """Give one state a new variance without any correlation with the others."""
    for j in range(P.shape[0]):
        P[k, j] = P[j, k] = 0.0
    P[k, k] = variance


@portable
def grow(rows: er.Rows, i: int, P: np.ndarray) -> np.ndarray:
    """Return the covariance grown over the interval of dead reckoning that ends now, and begin the next one."""
    row, setting, n = rows.nominal[i], rows.setting[i], P.shape[0]
    dt, square = row[er.T] - row[er.FROM], row[er.SQUARE]
    if dt > 0.0:
        turned = setting[er.GYRO_VARIANCE] * square + row[er.LOST_TURN]
        velocity = setting[er.ACCEL_VARIANCE] * square + row[er.LOST_VELOCITY]
        F, Q = np.eye(n), np.zeros((n, n))
        with_accel_bias, v_before = rows.fixed[i, er.WITH_ACCEL_BIAS] != 0, er.vector(row, er.V_BEFORE)
        variances = (velocity, turned + setting[er.TILT_DENSITY] * dt, turned)
        write_prediction(
            F,
            Q,
            rows.walk[i, :n],
            er.reckoning(row),
            v_before,
            setting[er.GRAVITY],
            setting[er.LEVELLING],
            with_accel_bias,
            variances,
            dt,
        )
        P = predicted_covariance(P, F, Q)
    motion.begin_interval(row, row[er.T])
    return P


@portable
def settle_heading(
    rows: er.Rows, i: int, P: np.ndarray, t_s: float, readings: np.ndarray, first: int, after: np.ndarray
) -> None:
    """Give the attitude its first heading: the magnetometer's, or the scenario's where there is none."""
    row, tally, setting = rows.nominal[i], rows.tally[i], rows.setting[i]
    if math.isnan(row[er.START]):
        row[er.START] = t_s
    at = first
    while at >= 0:
        if int(readings[at, er.KIND]) == er.MAG:
            R_BS = er.matrix(setting, er.AID + er.MAG * er.AID_COLUMNS + er.TURN)
            seen = turn(rotation(er.quaternion(row, er.Q)), turn(R_BS, er.vector(readings[at], er.VALUE)))
            field = er.vector(setting, er.FIELD_W)
            angle = math.atan2(field[1], field[0]) - math.atan2(seen[1], seen[0])
            _turn_heading(row, tally, setting[er.GRAVITY], angle)  # its certainty comes from the update
            return
        at = after[at]
    if not rows.fixed[i, er.MAGNETOMETER] or t_s - row[er.START] > HEADING_WAIT_S:
        angle = setting[er.SET_DOWN_YAW] - heading(er.quaternion(row, er.Q))
        _turn_heading(row, tally, setting[er.GRAVITY], angle)
        set_variance(P, YAW_STATE, SET_DOWN_SIGMA_RAD * SET_DOWN_SIGMA_RAD)


@portable
def _turn_heading(row: np.ndarray, tally: np.ndarray, gravity: float, angle: float) -> None:
    motion.turn_heading(row, gravity, angle)
    tally[er.KEPT] = 0  # a turn makes the past meaningless
    tally[er.HEADING_KNOWN] = 1


@portable
def predict(
    H: np.ndarray, at: int, kind: int, setting: np.ndarray, past: er.Moment, lag: float, out: np.ndarray
) -> None:
    """Write what a sensor should read into out[at:], and its rows of H."""
    aid = er.AID + kind * er.AID_COLUMNS
    _, p, v, q, w, _, _ = past
    R, arm = rotation(q), er.vector(setting, aid + er.ARM)
    if kind == er.GPS:
        expected = write_gps(H, at, p, v, R, w, arm, lag)
        for k in range(6):
            out[at + k] = expected[k]
    elif kind == er.MAG:
        field = write_mag(H, at, R, er.matrix(setting, aid + er.TURN), er.vector(setting, er.FIELD_W))
        er.put(out, at, field)
    elif kind == er.BARO:
        out[at] = write_baro(H, at, p, R, arm, lag)
    elif kind == er.SONAR:
        out[at] = write_sonar(H, at, p, R, arm, er.vector(setting, aid + er.DOWN), lag)
    else:
        er.put(out, at, write_flow(H, at, v, R, w, arm))


@portable
def with_biases(rows: er.Rows, i: int, kind: int, H: np.ndarray, at: int, out: np.ndarray) -> None:
    """Put the sensor's biases on the prediction, their columns of H written."""
    for channel in range(2):
        place = er.BIAS + kind * er.BIAS_COLUMNS + 3 * channel
        first, offset, size = rows.fixed[i, place], rows.fixed[i, place + 1], rows.fixed[i, place + 2]
        for k in range(size if first >= 0 else 0):
            H[at + offset + k, first + k] = 1.0
            out[at + offset + k] += rows.bias[i, first + k]


@portable
def believe_again(row: np.ndarray, P: np.ndarray, kind: int, z: np.ndarray, expected: np.ndarray, at: int) -> None:
    """Make the states that a long refused sensor sees as uncertain as its innovation."""
    squares, total = np.zeros(6), 0.0
    for k in range(er.SIZES[kind]):
        y = z[at + k] - expected[at + k]
        squares[k] = min(y * y, SQUARE_MAX)
        total += squares[k]
    if kind == er.GPS:
        for k in range(6):
            P[POSITION + k, POSITION + k] += squares[k]
    elif kind == er.FLOW:
        for k in range(3):
            P[VELOCITY + k, VELOCITY + k] += total
    elif kind == er.BARO:
        P[POSITION + 2, POSITION + 2] += squares[0]
    elif kind == er.MAG:
        P[YAW_STATE, YAW_STATE] += HEADING_SIGMA_RAD * HEADING_SIGMA_RAD
    row[er.REFUSED_SINCE + kind] = row[er.T]


@portable
def judge(row: np.ndarray, tally: np.ndarray, kind: int, passed: bool) -> None:
    """Count a reading that went through its gate, or did not."""
    if passed:
        tally[er.USED + kind] += 1
        row[er.REFUSED_SINCE + kind] = math.nan
        return
    tally[er.REFUSED + kind] += 1
    if math.isnan(row[er.REFUSED_SINCE + kind]):
        row[er.REFUSED_SINCE + kind] = row[er.T]


@portable
def correct(
    rows: er.Rows,
    i: int,
    P: np.ndarray,
    H: np.ndarray,
    z: np.ndarray,
    expected: np.ndarray,
    variance: np.ndarray,
    blocks: np.ndarray,
    kinds: np.ndarray,
) -> np.ndarray:
    """Use a stack of measurements, (m,) each, of which the blocks stand in `blocks` (b, 2); return the covariance.

    All are tried together; those whose own innovation lies outside of its gate are then left out.
    """
    row, tally = rows.nominal[i], rows.tally[i]
    y, distances = z - expected, np.zeros(ROWS_MAX)
    used, x, P, _ = stacked_update(P, H, variance, y, blocks, rows.limits, distances)
    kept, m = np.zeros(y.shape[0], dtype=np.int64), 0
    for b in range(blocks.shape[0]):
        first, size = blocks[b, 0], blocks[b, 1]
        good = used or distances[b] <= rows.limits[size]
        judge(row, tally, kinds[b], good)
        for k in range(size if good else 0):
            kept[m] = first + k
            m += 1
    if not used and m:
        kept = kept[:m]
        _, x, P, _ = stacked_update(P, H[kept], variance[kept], y[kept], blocks[:0], rows.limits, distances)
    if m:
        motion.correct(row, rows.fixed[i], rows.setting[i, er.GRAVITY], x)
        if rows.fixed[i, er.AIDING_BIASES]:
            for k in range(P.shape[0]):
                rows.bias[i, k] += x[k]
    return P


@portable
def fuse(rows: er.Rows, i: int, P: np.ndarray, readings: np.ndarray, first: int, after: np.ndarray) -> np.ndarray:
    """Judge and use a gate's readings, in one stacked update unless they are very many; return the covariance."""
    row, tally, setting, n = rows.nominal[i], rows.tally[i], rows.setting[i], P.shape[0]
    longest = rows.fixed[i, er.HISTORY]
    H, z, expected, variance = np.zeros((ROWS_MAX, n)), np.zeros(ROWS_MAX), np.zeros(ROWS_MAX), np.zeros(ROWS_MAX)
    blocks, kinds = np.zeros((ROWS_MAX, 2), dtype=np.int64), np.zeros(ROWS_MAX, dtype=np.int64)
    m, b = 0, 0
    now = past = er.moment(row)
    at = first
    while at >= 0:
        reading = readings[at]
        kind, t_sample_s = int(reading[er.KIND]), reading[er.SAMPLED]
        at = after[at]
        if kind == er.FLOW and not tally[er.HEADING_KNOWN]:
            tally[er.REFUSED + kind] += 1
            continue
        size = er.SIZES[kind]
        if m + size > ROWS_MAX:
            P = correct(rows, i, P, H[:m], z[:m], expected[:m], variance[:m], blocks[:b], kinds)
            H[:m] = 0.0
            m, b = 0, 0
            now = past = er.moment(row)
        if past[0] != t_sample_s:
            past = motion.recall(tally, rows.history[i], longest, t_sample_s, now)
        predict(H, m, kind, setting, past, now[0] - past[0], expected)
        with_biases(rows, i, kind, H, m, expected)
        aid = er.AID + kind * er.AID_COLUMNS
        for k in range(size):
            z[m + k] = reading[er.VALUE + k]
            variance[m + k] = setting[aid + er.VARIANCE + k]
        if kind == er.GPS:
            for k in range(3):
                variance[m + k] = max(reading[er.EXTRA] * reading[er.EXTRA], setting[aid + er.VARIANCE])
        if row[er.T] - row[er.REFUSED_SINCE + kind] > setting[aid + er.PATIENCE]:
            believe_again(row, P, kind, z, expected, m)
        blocks[b, 0], blocks[b, 1], kinds[b] = m, size, kind
        m, b = m + size, b + 1
    if m:
        P = correct(rows, i, P, H[:m], z[:m], expected[:m], variance[:m], blocks[:b], kinds)
    motion.remember(tally, rows.history[i], longest, er.moment(row))
    return P


@portable
def tell(row: np.ndarray, P: np.ndarray, t_s: float, out: np.ndarray) -> None:
    """Write the estimate for an instant that the IMU may not have reached yet into out (ESTIMATE_COLUMNS,)."""
    p, v, q, a_W, w, _ = er.reckoning(row)
    ahead = t_s - row[er.T]
    if ahead > 1e-9:
        p, v = plus(p, v, ahead), plus(v, a_W, ahead)
        q = normalised(product(q, rotation_vector_quaternion((w[0] * ahead, w[1] * ahead, w[2] * ahead))))
        P = P.copy()
        P[:3] += ahead * P[3:6]
        P[:, :3] += ahead * P[:, 3:6]
    yaw, yaw_sigma = heading_and_sigma(q, P)
    er.put(out, 0, p)
    er.put(out, 3, v)
    er.put_quaternion(out, 6, q)
    out[er.YAW], out[er.YAW_SIGMA] = yaw, yaw_sigma
    er.put(out, er.GYRO_BIAS_B, er.vector(row, er.GYRO_OFF))
    for i in range(6):
        for j in range(i, 6):
            out[er.COVARIANCE + 6 * i + j] = out[er.COVARIANCE + 6 * j + i] = P[i, j]


@portable
def close(rows: er.Rows, t_s: float, readings: np.ndarray, out: np.ndarray) -> None:
    """Use the readings of a gate of all drones and write their estimates for `t_s`.

    Args:
        rows: of N drones; changed.
        t_s: instant of the gate [s].
        readings: (M, READING_COLUMNS), each drone's in the order of their arrival.
        out: (N, ESTIMATE_COLUMNS), written.
    """
    count = rows.nominal.shape[0]
    first, last = np.full(count, -1), np.full(count, -1)
    after = np.full(readings.shape[0], -1)
    for m in range(readings.shape[0]):
        reading, i = readings[m], int(readings[m, er.DRONE])
        row, tally, setting, fixed = rows.nominal[i], rows.tally[i], rows.setting[i], rows.fixed[i]
        if int(reading[er.KIND]) == er.IMU:
            accel, gyro = er.vector(reading, er.VALUE), er.vector(reading, er.VALUE + 3)
            motion.move(row, tally, setting, fixed, reading[er.SAMPLED], accel, gyro)
        elif accept(row, tally, setting, fixed, reading):
            if last[i] < 0:
                first[i] = m
            else:
                after[last[i]] = m
            last[i] = m
    for i in range(count):
        _close_one(rows, i, t_s, readings, first[i], after, out[i])


@portable
def _close_one(
    rows: er.Rows, i: int, t_s: float, readings: np.ndarray, first: int, after: np.ndarray, out: np.ndarray
) -> None:
    row, tally, n = rows.nominal[i], rows.tally[i], rows.fixed[i, er.SIZE]
    if not tally[er.RUNNING]:
        motion.begin(row, tally, t_s)
    motion.coast(row, rows.setting[i], t_s)
    P = grow(rows, i, rows.covariance[i, :n, :n].copy())
    if not tally[er.HEADING_KNOWN]:
        settle_heading(rows, i, P, t_s, readings, first, after)
    P = fuse(rows, i, P, readings, first, after)
    rows.covariance[i, :n, :n] = P
    tell(row, P, t_s, out)
