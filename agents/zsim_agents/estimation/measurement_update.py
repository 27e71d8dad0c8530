"""The aiding readings of a drone in a gate: checked in order of arrival, compared with dead reckoning, fused.

A reading is compared with the state at the time of its sample and tested by an innovation gate; readings that pass
correct the nominal state, the biases and the covariance.

A measurement model takes the state at the time of the sample (p, v in the world, R_WB, w_WB_B), writes its rows of the
Jacobian H, which are zero on entry, and returns the predicted reading. `lag` is the age of the sample [s]: to first
order, the error of the past position is that of the present position minus lag times that of the velocity. The effect
of the body rate's error over a lever arm is neglected: it is below 1 mm/s.
"""

import math

import numpy as np

from zsim.math import elementary as el
from zsim.math.compiled import inlined, portable
from zsim.math.rotation import Matrix, Vector, add, column, composed, cross, heading, matrix, product, transposed
from zsim_agents.estimation import strapdown
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
    Array,
    Moment,
    Rows,
    matrix_at,
    moment,
    put,
    quaternion,
    vector,
)
from zsim_agents.estimation.kalman_update import (
    add_innovation_covariance,
    add_projection,
    block,
    put_block,
    stacked_update,
    whiten,
    within_gates,
)
from zsim_agents.estimation.strapdown import (
    ATTITUDE,
    HORIZONTAL_MIN,
    POSITION,
    VELOCITY,
    heading_gradient,
    write_minus_cross,
)

ROWS_MAX = 32  # maximum number of rows of a stacked update; further measurements of a gate go into a second one
YAW = ATTITUDE + 2  # index in the error state
VALUE_MAX = 1e7  # m, m/s or uT: no sensor reads more, and larger squares would impair the precision of all other states
SQUARE_MAX = 1e8  # maximum squared innovation, in squared units; more would impair the covariance's precision
HEADING_SIGMA_RAD = 0.5  # rad: before the first magnetometer reading, which sets the heading
SET_DOWN_SIGMA_RAD = 0.05  # rad: accuracy of setting a drone down by eye, used without a magnetometer
MOVING_SIGMAS = 2.0  # of the velocity; design choice: the estimate of a drone at rest exceeds it in 2 % of samples
SIGHTING_AGE_MAX_S = 2.0  # s since the last sighting between two drones; design choice: errors grow little meanwhile
HEADING_WAIT_S = 1.0  # s without a magnetometer reading, after which the scenario's heading is used
COSINE_MIN = 0.1  # minimum cosine between the sonar's ray and the vertical; beyond 84 deg it misses the ground below


@inlined
def accept(rows: Rows, i: int, reading: Array) -> bool:
    """Return whether to use an aiding reading at the end of the gate.

    A reading that is out of order, too old, not finite, or without a GPS fix or optical flow is counted as refused;
    duplicates, sonar readings without an echo and readings of unused sensors are not counted.
    """
    row, counts, setting, layout = rows.nominal[i], rows.counts[i], rows.setting[i], rows.layout[i]
    kind = int(reading[READING.sensor])
    if (kind == MAG and not layout[LAYOUT.magnetometer]) or (kind == FLOW and not layout[LAYOUT.flow]):
        return False
    if kind == SONAR and reading[READING.extra] == 0.0:
        return False
    is_invalid_fix = kind == GPS and not (reading[READING.extra + 1] != 0.0 and abs(reading[READING.extra]) < VALUE_MAX)
    if is_invalid_fix or (kind == FLOW and not reading[READING.extra] > 0.0):
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
def start_heading(rows: Rows, i: int, P: Array, t_s: float, readings: Array, first: int, after: Array) -> None:
    """Initialise the heading from a compass; without a compass, or after HEADING_WAIT_S, from the scenario."""
    row, counts, setting = rows.nominal[i], rows.counts[i], rows.setting[i]
    if math.isnan(row[NOMINAL.t_first_gate]):
        row[NOMINAL.t_first_gate] = t_s
    at = first
    while at >= 0:
        if rows.layout[i, LAYOUT.compass] and int(readings[at, READING.sensor]) == MAG:
            R_BS = matrix_at(setting, SETTING.sensors + MAG * SENSOR.size + SENSOR.R_BS)
            measured_W = product(
                matrix(quaternion(row, NOMINAL.q_WB)), product(R_BS, vector(readings[at], READING.values))
            )
            field = vector(setting, SETTING.field_W)
            angle = el.atan2(field[1], field[0]) - el.atan2(measured_W[1], measured_W[0])
            _turn_heading(row, counts, setting[SETTING.gravity], angle)  # the update gives the heading's variance
            return
        at = after[at]
    if not rows.layout[i, LAYOUT.compass] or t_s - row[NOMINAL.t_first_gate] > HEADING_WAIT_S:
        angle = setting[SETTING.set_down_yaw] - heading(quaternion(row, NOMINAL.q_WB))
        _turn_heading(row, counts, setting[SETTING.gravity], angle)
        set_variance(P, YAW, SET_DOWN_SIGMA_RAD * SET_DOWN_SIGMA_RAD)


@inlined
def _turn_heading(row: Array, counts: Array, gravity: float, angle: float) -> None:
    strapdown.turn_heading(row, gravity, angle)
    counts[COUNT.kept] = 0  # a turn invalidates the history
    counts[COUNT.heading_known] = 1


@inlined
def set_variance(P: Array, k: int, variance: float) -> None:
    """Set the variance of state `k`, and remove the state's correlations."""
    for j in range(P.shape[0]):
        P[k, j] = P[j, k] = 0.0
    P[k, k] = variance


@portable
def fuse(rows: Rows, i: int, P: Array, readings: Array, first: int, after: Array) -> Array:
    """Test and use a drone's readings of a gate, in one stacked update unless they are many; return the covariance.

    Args:
        P: covariance of drone i, (n, n).
        readings: readings of all drones in the gate, (M, READING.size).
        first: index of the drone's first aiding reading; -1 for none.
        after: index of the same drone's next aiding reading, for each reading, (M,); -1 after the last.
    """
    row, counts, setting, n = rows.nominal[i], rows.counts[i], rows.setting[i], P.shape[0]
    H, z, expected, variance = np.zeros((ROWS_MAX, n)), np.zeros(ROWS_MAX), np.zeros(ROWS_MAX), np.zeros(ROWS_MAX)
    blocks, kinds = np.zeros((ROWS_MAX, 2), dtype=np.int64), np.zeros(ROWS_MAX, dtype=np.int64)
    m, b = 0, 0
    now = moment(row)
    recalled = now, 0.0, 0
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
            recalled = now, 0.0, 0
        if recalled[0][0] != t_sample_s:
            recalled = strapdown.recall_known(rows, i, t_sample_s, now)
        stack(rows, i, reading, H, z, expected, m, recalled)
        if kind == FLOW and not rows.layout[i, LAYOUT.compass]:
            limit_heading_effect(P, H, expected, m)
        write_variance(reading, setting, variance, m)
        patience_s = setting[SETTING.sensors + kind * SENSOR.size + SENSOR.patience]
        if row[NOMINAL.t] - row[NOMINAL.refused_since + kind] > patience_s and not is_refuted(rows, i, kind):
            inflate(rows, i, P, kind, z, expected, m)
        blocks[b, 0], blocks[b, 1], kinds[b] = m, size, kind
        m, b = m + size, b + 1
    if m:
        P = correct(rows, i, P, H[:m], z[:m], expected[:m], variance[:m], blocks[:b], kinds)
    strapdown.remember(counts, rows.history[i], rows.layout[i, LAYOUT.history], moment(row))
    return P


@inlined
def stack(
    rows: Rows,
    i: int,
    reading: Array,
    H: Array,
    z: Array,
    expected: Array,
    at: int,
    recalled: tuple[Moment, float, int],
) -> None:
    """Add a reading to a stack from row `at` on; `recalled` is the result of `strapdown.recall_known`."""
    kind, setting = int(reading[READING.sensor]), rows.setting[i]
    past, lag, state = recalled
    predict(H, at, kind, setting, past, lag, expected)
    strapdown.move_columns(H, at, SIZES[kind], state)
    add_biases(rows, i, kind, H, at, expected)
    for k in range(SIZES[kind]):
        z[at + k] = reading[READING.values + k]


@inlined
def predict(H: Array, at: int, kind: int, setting: Array, past: Moment, lag: float, out: Array) -> None:
    """Write the expected reading of a sensor into out[at:], and its Jacobian into H[at:]."""
    base = SETTING.sensors + kind * SENSOR.size
    _, p, v, q, w, _, _ = past
    R, arm = matrix(q), vector(setting, base + SENSOR.p_BS)
    if kind == GPS:
        expected = write_gps(H, at, p, v, R, w, arm, lag)
        for k in range(6):
            out[at + k] = expected[k]
    elif kind == MAG:
        field = write_mag(H, at, R, matrix_at(setting, base + SENSOR.R_BS), vector(setting, SETTING.field_W))
        put(out, at, field)
    elif kind == BARO:
        out[at] = write_baro(H, at, p, R, arm, lag)
    elif kind == SONAR:
        out[at] = write_sonar(H, at, p, R, arm, vector(setting, base + SENSOR.down_B), setting[SETTING.floor], lag)
    else:
        put(out, at, write_flow(H, at, v, R, w, arm))


@inlined
def add_biases(rows: Rows, i: int, kind: int, H: Array, at: int, out: Array) -> None:
    for channel in range(CHANNELS):
        base = LAYOUT.biases + (kind * CHANNELS + channel) * BIAS.size
        state, row = rows.layout[i, base + BIAS.state], at + rows.layout[i, base + BIAS.row]
        for k in range(rows.layout[i, base + BIAS.axes] if state >= 0 else 0):
            H[row + k, state + k] = 1.0
            out[row + k] += rows.bias[i, state + k]


@inlined
def limit_heading_effect(P: Array, H: Array, expected: Array, at: int) -> None:
    """Limit the effect of flow on the attitude, in two rows from `at` on, to the part of the motion that is certain.

    A heading error rotates the velocity. At rest the velocity error would thereby yield spurious heading information
    (G. P. Huang, A. I. Mourikis, S. I. Roumeliotis, "Observability-based rules for designing consistent EKF SLAM
    estimators", International Journal of Robotics Research 29, 2010).
    """
    squared = expected[at] * expected[at] + expected[at + 1] * expected[at + 1]
    noise = MOVING_SIGMAS * MOVING_SIGMAS * (P[VELOCITY, VELOCITY] + P[VELOCITY + 1, VELOCITY + 1])
    share = 1.0 - noise / squared if squared > noise else 0.0
    for r in range(at, at + 2):
        for k in range(3):
            H[r, ATTITUDE + k] *= share


@inlined
def write_variance(reading: Array, setting: Array, variance: Array, at: int) -> None:
    """Write the variances of a reading's rows: those of the scenario, or a larger one that a GPS receiver states."""
    kind = int(reading[READING.sensor])
    base = SETTING.sensors + kind * SENSOR.size
    for k in range(SIZES[kind]):
        variance[at + k] = setting[base + SENSOR.variance + k]
    if kind == GPS:
        stated = reading[READING.extra] * reading[READING.extra] - setting[base + SENSOR.correlated]
        for k in range(3):
            variance[at + k] = max(stated, setting[base + SENSOR.variance])


@inlined
def is_refuted(rows: Rows, i: int, kind: int) -> bool:
    """Return whether a drone that recently saw drone i, or was seen by it, trusts its own sensor: then i's errs."""
    for j in range(rows.sighted.shape[0]):
        last_s = max(rows.sighted[i, j], rows.sighted[j, i])
        is_trusted = math.isnan(rows.nominal[j, NOMINAL.refused_since + kind]) and rows.counts[j, COUNT.used + kind] > 0
        if j != i and is_trusted and rows.nominal[i, NOMINAL.t] - last_s < SIGHTING_AGE_MAX_S:
            return True
    return False


@portable
def inflate(rows: Rows, i: int, P: Array, kind: int, z: Array, expected: Array, at: int) -> None:
    """Increase the variances of the states observed by a long-refused sensor, so that it is used again."""
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
def widen(P: Array, k: int, variance: float, layout: Array) -> None:
    """Add a variance to a state of position or velocity, and to its clones, as an error that all of them share."""
    first = layout[LAYOUT.first_clone] + k
    end = first + CLONED * layout[LAYOUT.clones]  # further states belong to drones with larger error states
    P[k, k] += variance
    for a in range(first, end, CLONED):
        P[a, k] += variance
        P[k, a] += variance
        for b in range(first, end, CLONED):
            P[a, b] += variance


@portable
def correct(
    rows: Rows, i: int, P: Array, H: Array, z: Array, expected: Array, variance: Array, blocks: Array, kinds: Array
) -> Array:
    """Use a stack of measurements, (m,) each, in blocks, (b, 2); return the covariance.

    Measurements are used together if all blocks are within their innovation gates; otherwise, those outside are left
    out.
    """
    y, distances = z - expected, np.zeros(ROWS_MAX)
    if rows.joint.shape[0]:
        return _correct_jointly(rows, i, P, H, y, variance, blocks, kinds)
    used, x, P, _ = stacked_update(P, H, variance, y, blocks, rows.limits, distances)
    selected = select_rows(rows, i, used, distances, blocks, kinds)
    if not used and selected.shape[0]:
        _, x, P, _ = stacked_update(P, H[selected], variance[selected], y[selected], blocks[:0], rows.limits, distances)
    if selected.shape[0]:
        strapdown.correct(rows.nominal[i], rows.layout[i], rows.setting[i, SETTING.gravity], x)
        if rows.layout[i, LAYOUT.aiding_biases]:
            for k in range(P.shape[0]):
                rows.bias[i, k] += x[k]
    return P


@portable
def _correct_jointly(
    rows: Rows, i: int, P: Array, H: Array, y: Array, variance: Array, blocks: Array, kinds: Array
) -> Array:
    """Do the work of `correct` with the joint covariance, which corrects the states of all drones."""
    distances = np.zeros(ROWS_MAX)
    put_block(rows.joint, i, P)  # P may have been inflated
    used = use_own(rows, i, H, variance, y, blocks, distances)
    selected = select_rows(rows, i, used, distances, blocks, kinds)
    if not used and selected.shape[0]:
        use_own(rows, i, H[selected], variance[selected], y[selected], blocks[:0], distances)
    return block(rows.joint, i, P.shape[0])


@portable
def use_own(rows: Rows, i: int, H: Array, variance: Array, y: Array, blocks: Array, distances: Array) -> bool:
    """Test measurements of a drone's own sensors and, if all are within their gates, use them; return whether they are.

    H is the Jacobian with respect to the drone's own errors, (m, n); for `blocks` and `distances` see
    `kalman_update.within_gates`. `rows` is modified in place.
    """
    first, HJ = i * H.shape[1], np.zeros((H.shape[0], rows.joint.shape[0]))
    add_projection(rows.joint, H, first, HJ)
    S = np.diag(variance)
    add_innovation_covariance(HJ, H, first, S)
    if not within_gates(S, y, blocks, rows.limits, distances):
        return False
    correct_all(rows, HJ, S, y.copy())
    return True


@portable
def correct_all(rows: Rows, HJ: Array, S: Array, y: Array) -> None:
    """Correct all drones and the joint covariance by innovations y, (m,), of covariance S; overwrite y and HJ = H J."""
    whiten(S, HJ, y)
    J, x = rows.joint, np.zeros(HJ.shape[1])
    for k in range(y.shape[0]):
        for d in range(x.shape[0]):
            x[d] += y[k] * HJ[k, d]
    for r in range(x.shape[0]):
        for k in range(y.shape[0]):
            weight = HJ[k, r]
            if weight != 0.0:
                for c in range(x.shape[0]):
                    J[r, c] -= weight * HJ[k, c]
    n = rows.covariance.shape[1]
    for i in range(rows.nominal.shape[0]):
        error = x[i * n : i * n + n]
        strapdown.correct(rows.nominal[i], rows.layout[i], rows.setting[i, SETTING.gravity], error)
        if rows.layout[i, LAYOUT.aiding_biases]:
            for k in range(n):
                rows.bias[i, k] += error[k]


@portable
def select_rows(rows: Rows, i: int, used: bool, distances: Array, blocks: Array, kinds: Array) -> Array:
    """Count the outcome of each block; return the indices of the rows to use: all, or those within their gates."""
    selected, m = np.zeros(ROWS_MAX, dtype=np.int64), 0
    for b in range(blocks.shape[0]):
        first, size = blocks[b, 0], blocks[b, 1]
        is_within = used or distances[b] <= rows.limits[size]
        count_outcome(rows.nominal[i], rows.counts[i], kinds[b], is_within)
        for k in range(size if is_within else 0):
            selected[m] = first + k
            m += 1
    return selected[:m]


@inlined
def count_outcome(row: Array, counts: Array, kind: int, passed: bool) -> None:
    """Count a reading as used or refused, and note since when its sensor has been refused."""
    if passed:
        counts[COUNT.used + kind] += 1
        row[NOMINAL.refused_since + kind] = math.nan
        return
    counts[COUNT.refused + kind] += 1
    if math.isnan(row[NOMINAL.refused_since + kind]):
        row[NOMINAL.refused_since + kind] = row[NOMINAL.t]


SixFloats = tuple[float, float, float, float, float, float]


@inlined
def write_gps(H: Array, i: int, p: Vector, v: Vector, R: Matrix, w: Vector, arm: Vector, lag: float) -> SixFloats:
    """Predict a GPS fix, p + R r [m] and v + R (w x r) [m/s], of an antenna at r = `arm` in B; write six rows of H."""
    offset = product(R, arm)
    swing = product(R, cross(w, arm))
    for k in range(3):
        H[i + k, POSITION + k] = 1.0
        H[i + k, VELOCITY + k] = -lag
        H[i + 3 + k, VELOCITY + k] = 1.0
    write_minus_cross(H, i, ATTITUDE, offset, 1.0)
    write_minus_cross(H, i + 3, ATTITUDE, swing, 1.0)
    return *add(p, offset), *add(v, swing)


@inlined
def write_mag(H: Array, i: int, R: Matrix, R_BS: Matrix, field_W: Vector) -> Vector:
    """Predict the reading (R R_BS)^T m [uT] of a magnetometer in the field m = `field_W`; write three rows of H."""
    R_WS = composed(R, R_BS)
    for k in range(3):
        row = cross(column(R_WS, k), field_W)
        H[i + k, ATTITUDE] = row[0]
        H[i + k, ATTITUDE + 1] = row[1]
        H[i + k, ATTITUDE + 2] = row[2]
    return product(transposed(R_WS), field_W)


@inlined
def write_baro(H: Array, i: int, p: Vector, R: Matrix, arm: Vector, lag: float) -> float:
    """Predict the height [m] of a barometer at `arm` in B; write one row of H."""
    offset = product(R, arm)
    H[i, POSITION + 2] = 1.0
    H[i, VELOCITY + 2] = -lag
    H[i, ATTITUDE] = offset[1]
    H[i, ATTITUDE + 1] = -offset[0]
    return p[2] + offset[2]


@inlined
def write_sonar(H: Array, i: int, p: Vector, R: Matrix, arm: Vector, down_B: Vector, floor: float, lag: float) -> float:
    """Predict the range [m], height / cosine, of a sonar at `arm` in B to the ground z_W = `floor`; write one row of H.

    The sonar looks along `down_B`; if this does not point down, return 0 and leave the row empty.
    """
    offset = product(R, arm)
    ray = product(R, down_B)
    cosine = -ray[2]
    if cosine < COSINE_MIN:
        return 0.0
    height = p[2] + offset[2] - floor
    per_cosine = height / (cosine * cosine)
    H[i, POSITION + 2] = 1.0 / cosine
    H[i, VELOCITY + 2] = -lag / cosine
    H[i, ATTITUDE] = offset[1] / cosine + per_cosine * ray[1]
    H[i, ATTITUDE + 1] = -offset[0] / cosine - per_cosine * ray[0]
    return height / cosine


@inlined
def write_flow(H: Array, i: int, v: Vector, R: Matrix, w: Vector, arm: Vector) -> Vector:
    """Predict the flow camera's velocity [m/s; heading frame], Rz(yaw)^T (v + R (w x r)); write three rows of H.

    The camera is at r = `arm` in B.
    """
    swing = product(R, cross(w, arm))
    x, y, _ = column(R, 0)
    length = math.sqrt(max(x * x + y * y, HORIZONTAL_MIN))
    c, s = x / length, y / length
    u_W = add(v, swing)
    u = (c * u_W[0] + s * u_W[1], c * u_W[1] - s * u_W[0], u_W[2])
    H[i, VELOCITY] = c
    H[i, VELOCITY + 1] = s
    H[i + 1, VELOCITY] = -s
    H[i + 1, VELOCITY + 1] = c
    H[i + 2, VELOCITY + 2] = 1.0
    by_heading = heading_gradient(R)
    for k in range(3):
        turned = cross((1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0), swing)
        H[i, ATTITUDE + k] = by_heading[k] * u[1] + c * turned[0] + s * turned[1]
        H[i + 1, ATTITUDE + k] = -by_heading[k] * u[0] + c * turned[1] - s * turned[0]
        H[i + 2, ATTITUDE + k] = turned[2]
    return u
