"""Sightings used by a joint filter: whose hat was seen is found out, then drones that see and are seen are corrected.

Compiled. A sighting is compared with the states of both drones at the instant of its picture. Errors: R_true =
(I + [theta]x) R_WB, as in dead_reckoning.
"""

import math

import numpy as np

from zsim.math.compiled import Field, columns, portable
from zsim.math.rotation import Vector, add, cross, dot, matrix, norm, product, scaled, subtract, transposed
from zsim_agents.estimation.dead_reckoning import ATTITUDE, POSITION, VELOCITY
from zsim_agents.estimation.filter_state import COUNT, SETTING, Moment, Rows, moment, vector
from zsim_agents.estimation.joint_covariance import add_innovation_covariance, add_projection, correct_all
from zsim_agents.estimation.kalman_update import within_gates
from zsim_agents.estimation.strapdown import move_columns, recall_known

SIGHTING = columns(  # one hat that was seen
    "SightingColumns",
    (
        Field("drone", "1"),  # who saw it
        Field("t_arrival", "s"),
        Field("t_sample", "s"),
        Field("p_BK", "m", 3),  # of the camera
        Field("direction_B", "1", 3),
        Field("range", "m"),
        Field("sigma_direction", "rad"),
        Field("sigma_range", "m"),
    ),
)
# by which y^T S^-1 y of the second best must be more than that of the best: chosen, a likelihood ratio of 150
AMBIGUITY = 10.0
# Standard deviations by which the places of two hats must be apart: before the filter knows them so well, as while GPS
# is averaged on the ground, one hat is taken for another once in some starts, and stays so.
APART = 6.0
NEAREST_M = 0.1  # nearer, a direction is not defined
RANGE_MAX_M = 1e4  # no hat is seen farther away
SIGMA_MIN_RAD, SIGMA_MIN_M = 1e-4, 1e-3  # what interpolation of past states loses
NOBODY = -1


@portable
def expected(a: Moment, b: Moment, hat_B: Vector, p_BK: Vector) -> Vector:
    """Return where drone a's camera should see the hat of drone b [m; axes of a's body]."""
    away = subtract(add(b[1], product(matrix(b[3]), hat_B)), a[1])
    return subtract(product(transposed(matrix(a[3])), away), p_BK)


@portable
def write_rows(
    H_i: np.ndarray,
    H_j: np.ndarray,
    a: Moment,
    b: Moment,
    hat_B: Vector,
    axes: tuple[Vector, Vector, Vector],
    lags: tuple[float, float],
) -> None:
    """Write the Jacobians of a sighting along three axes of the observer's body, (3, n), which come in as zero.

    Args:
        H_i, H_j: by the errors of who sees and of who is seen.
    """
    R_a, hat_W = matrix(a[3]), product(matrix(b[3]), hat_B)
    away = subtract(add(b[1], hat_W), a[1])
    for r in range(3):
        w = product(R_a, axes[r])
        by_own, by_other = cross(w, away), cross(hat_W, w)
        for k in range(3):
            H_j[r, POSITION + k] = w[k]
            H_i[r, POSITION + k] = -w[k]
            H_j[r, VELOCITY + k] = -lags[1] * w[k]
            H_i[r, VELOCITY + k] = lags[0] * w[k]
            H_i[r, ATTITUDE + k] = by_own[k]
            H_j[r, ATTITUDE + k] = by_other[k]


@portable
def across(d: Vector) -> tuple[Vector, Vector, Vector]:
    """Return a unit vector and two across it."""
    side = (0.0, 0.0, 1.0) if abs(d[2]) < 0.9 else (1.0, 0.0, 0.0)
    e = cross(d, side)
    e = scaled(e, 1.0 / norm(e))
    return d, e, cross(d, e)


@portable
def predict_sighting(
    rows: Rows, sighting: np.ndarray, j: int, hat_B: Vector, HJ: np.ndarray, S: np.ndarray
) -> tuple[Vector, tuple[Vector, Vector, Vector]]:
    """Return where the hat of drone j should be seen, and axes along and across; write H J and S along these.

    Args:
        rows: of all drones; `rows.joint` is J.
        sighting: (SIGHTING.size,).
        j: whose hat it is taken for.
        hat_B: centre of a hat in the body of its drone [m].
        HJ: (3, D), written.
        S: covariance of the innovation, (3, 3), written.
    """
    i, n = int(sighting[SIGHTING.drone]), rows.covariance.shape[1]
    t_s = sighting[SIGHTING.t_sample]
    a, lag_a, state_a = recall_known(rows, i, t_s, moment(rows.nominal[i]))
    b, lag_b, state_b = recall_known(rows, j, t_s, moment(rows.nominal[j]))
    r = expected(a, b, hat_B, vector(sighting, SIGHTING.p_BK))
    away = max(norm(r), NEAREST_M)
    axes = across(scaled(r, 1.0 / away))
    H_i, H_j = np.zeros((3, n)), np.zeros((3, n))
    write_rows(H_i, H_j, a, b, hat_B, axes, (lag_a, lag_b))
    move_columns(H_i, 0, 3, state_a)
    move_columns(H_j, 0, 3, state_b)
    sideways = away * max(sighting[SIGHTING.sigma_direction], SIGMA_MIN_RAD)
    along = max(sighting[SIGHTING.sigma_range], SIGMA_MIN_M)
    HJ[:], S[:] = 0.0, 0.0
    S[0, 0], S[1, 1], S[2, 2] = along * along, sideways * sideways, sideways * sideways
    add_projection(rows.joint, H_i, i * n, HJ)
    add_projection(rows.joint, H_j, j * n, HJ)
    add_innovation_covariance(HJ, H_i, i * n, S)
    add_innovation_covariance(HJ, H_j, j * n, S)
    return r, axes


@portable
def innovation(axes: tuple[Vector, Vector, Vector], seen: Vector, r: Vector) -> np.ndarray:
    """Return by how much what was seen misses what was expected, along and across, (3,) [m]."""
    miss = subtract(seen, r)
    return np.array([dot(axes[0], miss), dot(axes[1], miss), dot(axes[2], miss)])


@portable
def distance_squared(rows: Rows, S: np.ndarray, y: np.ndarray) -> float:
    """Return y^T S^-1 y."""
    blocks, distances = np.array([[0, 3]]), np.zeros(1)
    within_gates(S, y, blocks, rows.limits, distances)
    return distances[0]


@portable
def place_of(sighting: np.ndarray) -> Vector:
    """Return where a hat was seen, from the camera in axes of the body [m]."""
    return scaled(vector(sighting, SIGHTING.direction_B), sighting[SIGHTING.range])


@portable
def owner(
    rows: Rows, sighting: np.ndarray, hat_B: Vector, taken: np.ndarray, HJ: np.ndarray, S: np.ndarray, y: np.ndarray
) -> int:
    """Return whose hat was seen, NOBODY where none fits, two do, or the filter could not tell two from each other.

    HJ, S and the innovation y, (3,), are those of the hat that is returned.

    Args:
        rows: of all drones.
        sighting: (SIGHTING.size,).
        hat_B: centre of a hat in the body of its drone [m].
        taken: whose hats were seen already in the same picture, (N,).
    """
    count, i = rows.nominal.shape[0], int(sighting[SIGHTING.drone])
    places, seen = np.zeros((count, 3)), place_of(sighting)
    best, second, found = math.inf, math.inf, NOBODY
    trial_HJ, trial_S = np.zeros_like(HJ), np.zeros_like(S)
    toward = across((1.0, 0.0, 0.0))
    for j in range(count):
        if j == i:
            continue
        if not rows.counts[j, COUNT.heading_known]:
            return NOBODY  # it could be anywhere
        r, axes = predict_sighting(rows, sighting, j, hat_B, trial_HJ, trial_S)
        places[j, 0], places[j, 1], places[j, 2] = r[0], r[1], r[2]
        trial_y = innovation(axes, seen, r)
        distance = distance_squared(rows, trial_S, trial_y)
        if distance < best:
            best, second, found, toward = distance, best, j, axes
            HJ[:], S[:], y[:] = trial_HJ, trial_S, trial_y
        elif distance < second:
            second = distance
    if found == NOBODY or best > rows.limits[3] or second - best < AMBIGUITY or taken[found]:
        return NOBODY
    r = (places[found, 0], places[found, 1], places[found, 2])
    for j in range(count):
        if j not in (i, found):
            other = (places[j, 0], places[j, 1], places[j, 2])
            if distance_squared(rows, S, innovation(toward, other, r)) < APART * APART:
                return NOBODY
    return found


@portable
def is_possible(rows: Rows, sighting: np.ndarray) -> bool:
    """Tell whether a sighting can be used at all: its time, and what it says."""
    i = int(sighting[SIGHTING.drone])
    age_s = sighting[SIGHTING.t_arrival] - sighting[SIGHTING.t_sample]
    good = 0.0 <= age_s <= rows.setting[i, SETTING.age_max] and rows.counts[i, COUNT.heading_known] != 0
    good = good and 0.0 < sighting[SIGHTING.range] < RANGE_MAX_M
    length = norm(vector(sighting, SIGHTING.direction_B))
    return good and 0.99 < length < 1.01 and sighting[SIGHTING.sigma_range] > 0.0


@portable
def use_sightings(rows: Rows, sightings: np.ndarray, hat_B: Vector) -> None:
    """Use the sightings of a gate, one after the other; those that nobody's hat explains are counted as refused.

    Args:
        rows: of all drones; changed.
        sightings: (M, SIGHTING.size), those of one picture one behind the other.
        hat_B: centre of a hat in the body of its drone [m].
    """
    taken = np.zeros(rows.nominal.shape[0], dtype=np.bool_)
    HJ, S, y = np.zeros((3, rows.joint.shape[0])), np.zeros((3, 3)), np.zeros(3)
    for m in range(sightings.shape[0]):
        sighting, i = sightings[m], int(sightings[m, SIGHTING.drone])
        if m == 0 or sighting[0] != sightings[m - 1, 0] or sighting[2] != sightings[m - 1, 2]:
            taken[:] = False
        j = owner(rows, sighting, hat_B, taken, HJ, S, y) if is_possible(rows, sighting) else NOBODY
        if j == NOBODY:
            rows.counts[i, COUNT.sightings_refused] += 1
            continue
        taken[j] = True
        rows.counts[i, COUNT.sightings_used] += 1
        rows.sighted[i, j] = sighting[SIGHTING.t_sample]
        correct_all(rows, HJ, S, y)
