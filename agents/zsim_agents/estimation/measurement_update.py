"""The aiding readings of a drone's gate: accepted as they come, compared with dead reckoning, used in one update.

A reading is compared with the state of its own instant. Every one is judged by an innovation gate; what passes
corrects the nominal state, the biases and the covariance.
"""

import math

import numpy as np

from zsim.math.compiled import inlined, portable
from zsim.math.rotation import heading, matrix, product
from zsim_agents.estimation import strapdown
from zsim_agents.estimation.dead_reckoning import ATTITUDE, POSITION, VELOCITY
from zsim_agents.estimation.filter_state import (
    BARO,
    BIAS,
    CHANNELS,
    CLONED,
    COUNT,
    FLOW,
    GPS,
    LAYOUT,
    MAG,
    NOMINAL,
    READING,
    SENSOR,
    SETTING,
    SIZES,
    SONAR,
    VALUES_MAX,
    Moment,
    Rows,
    matrix_at,
    moment,
    put,
    quaternion,
    vector,
)
from zsim_agents.estimation.joint_covariance import block, put_block, use_own
from zsim_agents.estimation.kalman_update import (
    ROWS_MAX,
    stacked_update,
    write_baro,
    write_flow,
    write_gps,
    write_mag,
    write_sonar,
)

YAW = ATTITUDE + 2  # place in the error state
VALUE_MAX = 1e7  # m, m/s or uT: no sensor reads more, and squares of more would drown the rest
SQUARE_MAX = 1e8  # of an innovation, in its unit; more would cost the covariance its digits
HEADING_SIGMA_RAD = 0.5  # rad: before the first reading of the magnetometer, which turns the attitude to it
SET_DOWN_SIGMA_RAD = 0.05  # rad: how well a drone is set down by eye, where there is no magnetometer
MOVES_SIGMAS = 2.0  # of the velocity, chosen: one that stands still moves so fast at 2 % of the samples
DENIED_S = 2.0  # s since two drones saw each other, chosen: errors grow little meanwhile
HEADING_WAIT_S = 1.0  # s without a magnetometer's reading, after which the heading of the scenario is taken


@inlined
def accept(rows: Rows, i: int, reading: np.ndarray) -> bool:
    """Whether an aiding reading is to be used at the end of the gate.

    One that is out of order, too old or no number is counted as refused; a duplicate is not counted, nor is a sonar
    without an echo, which has no information.
    """
    row, counts, setting, layout = rows.nominal[i], rows.counts[i], rows.setting[i], rows.layout[i]
    kind = int(reading[READING.sensor])
    if (kind == MAG and not layout[LAYOUT.magnetometer]) or (kind == FLOW and not layout[LAYOUT.flow]):
        return False
    if kind == SONAR and reading[READING.extra] == 0.0:
        return False
    blind_gps = kind == GPS and not (reading[READING.extra + 1] != 0.0 and abs(reading[READING.extra]) < VALUE_MAX)
    if blind_gps or (kind == FLOW and not reading[READING.extra] > 0.0):
        counts[COUNT.refused + kind] += 1
        return False
    t_sample_s = reading[READING.t_sample]
    if t_sample_s == row[NOMINAL.t_sample + kind]:
        return False
    age_s, size = reading[READING.t_arrival] - t_sample_s, 0.0
    for k in range(SIZES[kind]):
        size += abs(reading[READING.values + k])
    if t_sample_s > row[NOMINAL.t_sample + kind] and 0.0 <= age_s <= setting[SETTING.age_max] and size < VALUE_MAX:
        row[NOMINAL.t_sample + kind] = t_sample_s
        return True
    counts[COUNT.refused + kind] += 1
    return False


@inlined
def set_variance(P: np.ndarray, k: int, variance: float) -> None:
    """Give one state a new variance without any correlation with the others."""
    for j in range(P.shape[0]):
        P[k, j] = P[j, k] = 0.0
    P[k, k] = variance


@inlined
def start_heading(
    rows: Rows, i: int, P: np.ndarray, t_s: float, readings: np.ndarray, first: int, after: np.ndarray
) -> None:
    """Give the attitude its first heading: the magnetometer's, or where it tells none, the one it was set down with."""
    row, counts, setting = rows.nominal[i], rows.counts[i], rows.setting[i]
    if math.isnan(row[NOMINAL.t_first_gate]):
        row[NOMINAL.t_first_gate] = t_s
    at = first
    while at >= 0:
        if rows.layout[i, LAYOUT.compass] and int(readings[at, READING.sensor]) == MAG:
            R_BS = matrix_at(setting, SETTING.sensors + MAG * SENSOR.size + SENSOR.R_BS)
            seen = product(matrix(quaternion(row, NOMINAL.q_WB)), product(R_BS, vector(readings[at], READING.values)))
            field = vector(setting, SETTING.field_W)
            angle = math.atan2(field[1], field[0]) - math.atan2(seen[1], seen[0])
            _turn_heading(row, counts, setting[SETTING.gravity], angle)  # its certainty comes from the update
            return
        at = after[at]
    if not rows.layout[i, LAYOUT.compass] or t_s - row[NOMINAL.t_first_gate] > HEADING_WAIT_S:
        angle = setting[SETTING.set_down_yaw] - heading(quaternion(row, NOMINAL.q_WB))
        _turn_heading(row, counts, setting[SETTING.gravity], angle)
        set_variance(P, YAW, SET_DOWN_SIGMA_RAD * SET_DOWN_SIGMA_RAD)


@inlined
def _turn_heading(row: np.ndarray, counts: np.ndarray, gravity: float, angle: float) -> None:
    strapdown.turn_heading(row, gravity, angle)
    counts[COUNT.kept] = 0  # a turn makes the past meaningless
    counts[COUNT.heading_known] = 1


@inlined
def predict(H: np.ndarray, at: int, kind: int, setting: np.ndarray, past: Moment, lag: float, out: np.ndarray) -> None:
    """Write what a sensor should read into out[at:], and its rows of H."""
    aid = SETTING.sensors + kind * SENSOR.size
    _, p, v, q, w, _, _ = past
    R, arm = matrix(q), vector(setting, aid + SENSOR.p_BS)
    if kind == GPS:
        expected = write_gps(H, at, p, v, R, w, arm, lag)
        for k in range(6):
            out[at + k] = expected[k]
    elif kind == MAG:
        field = write_mag(H, at, R, matrix_at(setting, aid + SENSOR.R_BS), vector(setting, SETTING.field_W))
        put(out, at, field)
    elif kind == BARO:
        out[at] = write_baro(H, at, p, R, arm, lag)
    elif kind == SONAR:
        out[at] = write_sonar(H, at, p, R, arm, vector(setting, aid + SENSOR.down_B), lag)
    else:
        put(out, at, write_flow(H, at, v, R, w, arm))


@inlined
def with_biases(rows: Rows, i: int, kind: int, H: np.ndarray, at: int, out: np.ndarray) -> None:
    """Put the sensor's biases on the prediction, their columns of H written."""
    for channel in range(CHANNELS):
        place = LAYOUT.biases + (kind * CHANNELS + channel) * BIAS.size
        state, row = rows.layout[i, place + BIAS.state], at + rows.layout[i, place + BIAS.row]
        for k in range(rows.layout[i, place + BIAS.axes] if state >= 0 else 0):
            H[row + k, state + k] = 1.0
            out[row + k] += rows.bias[i, state + k]


@inlined
def is_denied(rows: Rows, i: int, kind: int) -> bool:
    """Tell whether who sees a drone, or is seen by it, trusts its own sensor of a kind, so that this one's is wrong."""
    for j in range(rows.sighted.shape[0]):
        last_s = max(rows.sighted[i, j], rows.sighted[j, i])
        trusted = math.isnan(rows.nominal[j, NOMINAL.refused_since + kind]) and rows.counts[j, COUNT.used + kind] > 0
        if j != i and trusted and rows.nominal[i, NOMINAL.t] - last_s < DENIED_S:
            return True
    return False


@inlined
def widen(P: np.ndarray, k: int, variance: float, layout: np.ndarray) -> None:
    """Add a variance to a state of the position or velocity, and to its clones: it is one error of all of them."""
    first = layout[LAYOUT.first_clone] + k
    end = first + CLONED * layout[LAYOUT.clones]  # beyond, P has room for those of other drones
    P[k, k] += variance
    for a in range(first, end, CLONED):
        P[a, k] += variance
        P[k, a] += variance
        for b in range(first, end, CLONED):
            P[a, b] += variance


@portable
def inflate(rows: Rows, i: int, P: np.ndarray, kind: int, z: np.ndarray, expected: np.ndarray, at: int) -> None:
    """Make the states that a long refused sensor observes as uncertain as its innovation: it is trusted again."""
    row, layout = rows.nominal[i], rows.layout[i]
    squares, total = np.zeros(VALUES_MAX), 0.0
    for k in range(SIZES[kind]):
        y = z[at + k] - expected[at + k]
        squares[k] = min(y * y, SQUARE_MAX)
        total += squares[k]
    if kind == GPS:
        for k in range(6):
            widen(P, POSITION + k, squares[k], layout)
    elif kind == FLOW:
        for k in range(3):
            widen(P, VELOCITY + k, total, layout)
    elif kind == BARO:
        widen(P, POSITION + 2, squares[0], layout)
    elif kind == MAG:
        P[YAW, YAW] += HEADING_SIGMA_RAD * HEADING_SIGMA_RAD
    row[NOMINAL.refused_since + kind] = row[NOMINAL.t]


@inlined
def count_outcome(row: np.ndarray, counts: np.ndarray, kind: int, passed: bool) -> None:
    """Count a reading that went through its gate, or did not."""
    if passed:
        counts[COUNT.used + kind] += 1
        row[NOMINAL.refused_since + kind] = math.nan
        return
    counts[COUNT.refused + kind] += 1
    if math.isnan(row[NOMINAL.refused_since + kind]):
        row[NOMINAL.refused_since + kind] = row[NOMINAL.t]


@portable
def keep(rows: Rows, i: int, used: bool, distances: np.ndarray, blocks: np.ndarray, kinds: np.ndarray) -> np.ndarray:
    """Count the outcome of each block; return the rows (m,) to use: all, or those inside of their own gates."""
    kept, m = np.zeros(ROWS_MAX, dtype=np.int64), 0
    for b in range(blocks.shape[0]):
        first, size = blocks[b, 0], blocks[b, 1]
        good = used or distances[b] <= rows.limits[size]
        count_outcome(rows.nominal[i], rows.counts[i], kinds[b], good)
        for k in range(size if good else 0):
            kept[m] = first + k
            m += 1
    return kept[:m]


@portable
def _correct_jointly(
    rows: Rows,
    i: int,
    P: np.ndarray,
    H: np.ndarray,
    y: np.ndarray,
    variance: np.ndarray,
    blocks: np.ndarray,
    kinds: np.ndarray,
) -> np.ndarray:
    """Do as `correct` does, with the covariance of all drones, whose states it corrects."""
    distances = np.zeros(ROWS_MAX)
    put_block(rows.joint, i, P)  # it may have been inflated
    used = use_own(rows, i, H, variance, y, blocks, distances)
    kept = keep(rows, i, used, distances, blocks, kinds)
    if not used and kept.shape[0]:
        use_own(rows, i, H[kept], variance[kept], y[kept], blocks[:0], distances)
    return block(rows.joint, i, P.shape[0])


@portable
def correct(
    rows: Rows,
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
    y, distances = z - expected, np.zeros(ROWS_MAX)
    if rows.joint.shape[0]:
        return _correct_jointly(rows, i, P, H, y, variance, blocks, kinds)
    used, x, P, _ = stacked_update(P, H, variance, y, blocks, rows.limits, distances)
    kept = keep(rows, i, used, distances, blocks, kinds)
    if not used and kept.shape[0]:
        _, x, P, _ = stacked_update(P, H[kept], variance[kept], y[kept], blocks[:0], rows.limits, distances)
    if kept.shape[0]:
        strapdown.correct(rows.nominal[i], rows.layout[i], rows.setting[i, SETTING.gravity], x)
        if rows.layout[i, LAYOUT.aiding_biases]:
            for k in range(P.shape[0]):
                rows.bias[i, k] += x[k]
    return P


@inlined
def stack(
    rows: Rows,
    i: int,
    reading: np.ndarray,
    H: np.ndarray,
    z: np.ndarray,
    expected: np.ndarray,
    at: int,
    known: tuple[Moment, float, int],
) -> None:
    """Put a reading on a stack of measurements from row `at` on, compared with the state of its own instant.

    Args:
        known: that state, as `strapdown.recall_known` returns it.
    """
    kind, setting = int(reading[READING.sensor]), rows.setting[i]
    past, lag, state = known
    predict(H, at, kind, setting, past, lag, expected)
    strapdown.move_columns(H, at, SIZES[kind], state)
    with_biases(rows, i, kind, H, at, expected)
    for k in range(SIZES[kind]):
        z[at + k] = reading[READING.values + k]


@inlined
def distrust_turn(P: np.ndarray, H: np.ndarray, expected: np.ndarray, at: int) -> None:
    """Let the flow tell a heading, in rows from `at` on, only as far as the drone surely moves.

    A heading's error turns the velocity. Turned by the error of an estimate that should be zero, it would tell a
    heading that nothing measures (G. P. Huang, A. I. Mourikis, S. I. Roumeliotis, "Observability-based rules for
    designing consistent EKF SLAM estimators", International Journal of Robotics Research 29, 2010).
    """
    squared = expected[at] * expected[at] + expected[at + 1] * expected[at + 1]
    noise = MOVES_SIGMAS * MOVES_SIGMAS * (P[VELOCITY, VELOCITY] + P[VELOCITY + 1, VELOCITY + 1])
    share = 1.0 - noise / squared if squared > noise else 0.0
    for r in range(at, at + 2):
        for k in range(3):
            H[r, ATTITUDE + k] *= share


@inlined
def write_variance(reading: np.ndarray, setting: np.ndarray, variance: np.ndarray, at: int) -> None:
    """Write the variances of a reading's rows; a GPS receiver's own figure counts where it is worse."""
    kind = int(reading[READING.sensor])
    known = SETTING.sensors + kind * SENSOR.size
    for k in range(SIZES[kind]):
        variance[at + k] = setting[known + SENSOR.variance + k]
    if kind == GPS:
        claimed = reading[READING.extra] * reading[READING.extra] - setting[known + SENSOR.correlated]
        for k in range(3):
            variance[at + k] = max(claimed, setting[known + SENSOR.variance])


@portable
def fuse(rows: Rows, i: int, P: np.ndarray, readings: np.ndarray, first: int, after: np.ndarray) -> np.ndarray:
    """Judge and use a gate's readings, in one stacked update unless they are very many; return the covariance.

    Args:
        rows: of all drones.
        i: the drone.
        P: its covariance, (n, n).
        readings: of the gate, (M, READING.size).
        first: the drone's first among them; -1 for none.
        after: of each reading, the next one of the same drone, (M,); -1 after the last.
    """
    row, counts, setting, n = rows.nominal[i], rows.counts[i], rows.setting[i], P.shape[0]
    H, z, expected, variance = np.zeros((ROWS_MAX, n)), np.zeros(ROWS_MAX), np.zeros(ROWS_MAX), np.zeros(ROWS_MAX)
    blocks, kinds = np.zeros((ROWS_MAX, 2), dtype=np.int64), np.zeros(ROWS_MAX, dtype=np.int64)
    m, b = 0, 0
    now = moment(row)
    known = now, 0.0, 0
    at = first
    while at >= 0:
        reading = readings[at]
        kind, t_sample_s = int(reading[READING.sensor]), reading[READING.t_sample]
        at = after[at]
        if kind == FLOW and not counts[COUNT.heading_known]:
            counts[COUNT.refused + kind] += 1
            continue
        size = SIZES[kind]
        if m + size > ROWS_MAX:
            P = correct(rows, i, P, H[:m], z[:m], expected[:m], variance[:m], blocks[:b], kinds)
            H[:m] = 0.0
            m, b = 0, 0
            now = moment(row)
            known = now, 0.0, 0
        if known[0][0] != t_sample_s:
            known = strapdown.recall_known(rows, i, t_sample_s, now)
        stack(rows, i, reading, H, z, expected, m, known)
        if kind == FLOW and not rows.layout[i, LAYOUT.compass]:
            distrust_turn(P, H, expected, m)
        write_variance(reading, setting, variance, m)
        patience_s = setting[SETTING.sensors + kind * SENSOR.size + SENSOR.patience]
        if row[NOMINAL.t] - row[NOMINAL.refused_since + kind] > patience_s and not is_denied(rows, i, kind):
            inflate(rows, i, P, kind, z, expected, m)
        blocks[b, 0], blocks[b, 1], kinds[b] = m, size, kind
        m, b = m + size, b + 1
    if m:
        P = correct(rows, i, P, H[:m], z[:m], expected[:m], variance[:m], blocks[:b], kinds)
    strapdown.remember(counts, rows.history[i], rows.layout[i, LAYOUT.history], moment(row))
    return P
