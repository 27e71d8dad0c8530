"""Measurement models of the aiding sensors, prediction of a covariance, and its update with a stack of measurements.

Compiled. Every model takes the state at the instant of the sample (p, v in the world, R_WB, w_WB_B), writes its rows of
the Jacobian H, which come in as zero, and returns the predicted reading. `lag` is the age of the sample [s]: to first
order an error of the past position is the present one less lag times that of the velocity. The body rate's own error
times a lever arm is left out: below 1 mm/s.

The equations of prediction and update are those of filterpy's ExtendedKalmanFilter (Joseph form), which tests hold them
against.
"""

import math

import numpy as np

from zsim.math.compiled import inlined, portable
from zsim.math.rotation import Matrix, Vector, add, column, composed, cross, product, transposed
from zsim_agents.estimation.dead_reckoning import (
    ATTITUDE,
    HORIZONTAL_MIN,
    POSITION,
    VELOCITY,
    heading_gradient,
    write_minus_cross,
)

ROWS_MAX = 32  # of one stacked update; more measurements of a gate go into a second one
DOF_MAX = 6  # rows of the largest block, GPS with position and velocity
JOSEPH_MAX = 24  # states, chosen: with more, of clones, its products of n^3 would cost more than all else
COSINE_MIN = 0.1  # of the sonar's ray to the vertical; flatter than 84 deg it does not hit the ground below

SIX = tuple[float, float, float, float, float, float]


@inlined
def write_gps(H: np.ndarray, i: int, p: Vector, v: Vector, R: Matrix, w: Vector, arm: Vector, lag: float) -> SIX:
    """Antenna at p_BS = `arm`: position p + R r [m], velocity v + R (w x r) [m/s]; six rows from `i`."""
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
def write_mag(H: np.ndarray, i: int, R: Matrix, R_BS: Matrix, field_W: Vector) -> Vector:
    """Magnetometer turned by R_BS in a known field: (R R_BS)^T m [uT]; three rows from `i`."""
    R_WS = composed(R, R_BS)
    for k in range(3):
        row = cross(column(R_WS, k), field_W)
        H[i + k, ATTITUDE] = row[0]
        H[i + k, ATTITUDE + 1] = row[1]
        H[i + k, ATTITUDE + 2] = row[2]
    return product(transposed(R_WS), field_W)


@inlined
def write_baro(H: np.ndarray, i: int, p: Vector, R: Matrix, arm: Vector, lag: float) -> float:
    """Barometer at p_BS = `arm`: its height [m]; one row."""
    offset = product(R, arm)
    H[i, POSITION + 2] = 1.0
    H[i, VELOCITY + 2] = -lag
    H[i, ATTITUDE] = offset[1]
    H[i, ATTITUDE + 1] = -offset[0]
    return p[2] + offset[2]


@inlined
def write_sonar(H: np.ndarray, i: int, p: Vector, R: Matrix, arm: Vector, down_B: Vector, lag: float) -> float:
    """Sonar at p_BS = `arm` that looks along `down_B` at the ground z_W = 0: height / cosine [m]; one row.

    Returns 0 with an empty row if the sonar does not look down.
    """
    offset = product(R, arm)
    ray = product(R, down_B)
    cosine = -ray[2]
    if cosine < COSINE_MIN:
        return 0.0
    height = p[2] + offset[2]
    per_cosine = height / (cosine * cosine)
    H[i, POSITION + 2] = 1.0 / cosine
    H[i, VELOCITY + 2] = -lag / cosine
    H[i, ATTITUDE] = offset[1] / cosine + per_cosine * ray[1]
    H[i, ATTITUDE + 1] = -offset[0] / cosine - per_cosine * ray[0]
    return height / cosine


@inlined
def write_flow(H: np.ndarray, i: int, v: Vector, R: Matrix, w: Vector, arm: Vector) -> Vector:
    """Velocity of the camera at p_BS = `arm` in the heading frame, Rz(yaw)^T (v + R (w x r)); three rows."""
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


@portable
def predicted_covariance(P: np.ndarray, F: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Return F P F^T + Q, (n, n); F is the unit matrix but for few entries.

    Args:
        P: covariance, (n, n).
        F: transition, (n, n).
        Q: process noise, (n, n).
    """
    n = P.shape[0]
    FP = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                for j in range(n):
                    FP[i, j] += f * P[k, j]
    grown = Q.copy()
    for j in range(n):
        for k in range(n):
            f = F[j, k]
            if f != 0.0:
                for i in range(n):
                    grown[i, j] += FP[i, k] * f
    return grown


@portable
def predict_jointly(J: np.ndarray, i: int, F: np.ndarray, Q: np.ndarray) -> None:
    """Let the i-th n errors of J grow by F and Q, (n, n), and their covariance with all others along with them."""
    n, size = F.shape[0], J.shape[0]
    first = i * n
    former = J[first : first + n].copy()
    for r in range(n):
        for d in range(size):
            J[first + r, d] = F[r, r] * former[r, d]
        for c in range(n):
            f = F[r, c]
            if c != r and f != 0.0:
                for d in range(size):
                    J[first + r, d] += f * former[c, d]
    own = J[first : first + n, first : first + n].copy()
    for r in range(n):
        for c in range(r, n):
            total = Q[r, c]
            for k in range(n):
                f = F[c, k]
                if f != 0.0:
                    total += own[r, k] * f
            J[first + r, first + c] = J[first + c, first + r] = total
    for d in range(size):  # the rows of others stand in the columns as well
        if d < first or d >= first + n:
            for r in range(n):
                J[d, first + r] = J[first + r, d]


@portable
def innovation_covariance(P: np.ndarray, H: np.ndarray, variance: np.ndarray, PHt: np.ndarray) -> np.ndarray:
    """Return S = H P H^T + R for a diagonal R, and write P H^T.

    Args:
        P: covariance, (n, n), symmetric.
        H: Jacobian of the measurements, (m, n); mostly zeros.
        variance: diagonal of R, (m,).
        PHt: the result P H^T, (n, m).
    """
    m, n = H.shape
    S = np.zeros((m, m))
    PHt[:, :] = 0.0
    for j in range(m):
        for k in range(n):
            h = H[j, k]
            if h != 0.0:
                for i in range(n):
                    PHt[i, j] += P[i, k] * h
    for i in range(m):
        for k in range(n):
            h = H[i, k]
            if h != 0.0:
                for j in range(m):
                    S[i, j] += h * PHt[k, j]
        S[i, i] += variance[i]
    return S


@portable
def cholesky(S: np.ndarray) -> np.ndarray:
    """Return the lower triangular L of S = L L^T, (m, m)."""
    m = S.shape[0]
    L = np.zeros((m, m))
    for i in range(m):
        for j in range(i + 1):
            rest = S[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(rest) if i == j else rest / L[j, j]
    return L


@portable
def gain(S: np.ndarray, PHt: np.ndarray) -> np.ndarray:
    """Return K = P H^T S^-1, (n, m), by the Cholesky factor of S."""
    n, m = PHt.shape
    L = cholesky(S)
    K = PHt.copy()
    for row in range(n):
        for i in range(m):
            for k in range(i):
                K[row, i] -= L[i, k] * K[row, k]
            K[row, i] /= L[i, i]
        for i in range(m - 1, -1, -1):
            for k in range(i + 1, m):
                K[row, i] -= L[k, i] * K[row, k]
            K[row, i] /= L[i, i]
    return K


@portable
def joseph(P: np.ndarray, H: np.ndarray, variance: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Return (I - K H) P (I - K H)^T + K R K^T, (n, n)."""
    m, n = H.shape
    A = np.eye(n)
    for j in range(m):
        for k in range(n):
            h = H[j, k]
            if h != 0.0:
                for i in range(n):
                    A[i, k] -= K[i, j] * h
    AP = A @ P
    updated = AP @ A.T
    for i in range(n):
        for j in range(m):
            weighted = K[i, j] * variance[j]
            for k in range(n):
                updated[i, k] += weighted * K[k, j]
    return updated


@portable
def downdated(P: np.ndarray, PHt: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Return P - K H P, (n, n), symmetric, for P H^T and the gain K = P H^T S^-1, (n, m)."""
    n, m = K.shape
    updated = P.copy()
    for i in range(n):
        for k in range(m):
            weight = PHt[i, k]
            for j in range(i, n):
                updated[i, j] -= weight * K[j, k]
        for j in range(i, n):
            updated[j, i] = updated[i, j]
    return updated


@portable
def within_gates(S: np.ndarray, y: np.ndarray, blocks: np.ndarray, limits: np.ndarray, distances: np.ndarray) -> bool:
    """Write y^T S^-1 y of every block of innovations by itself; return whether all are within their limits.

    By the block's Cholesky factor; infinite where it is not positive definite or the innovation not a number.

    Args:
        S: covariance of all innovations, (m, m).
        y: all innovations, (m,).
        blocks: first row and number of rows of each block, (k, 2).
        limits: by number of rows, (DOF_MAX + 1,).
        distances: the result, (k,) or longer.
    """
    L = np.zeros((DOF_MAX, DOF_MAX))
    u = np.zeros(DOF_MAX)
    good = True
    for block in range(blocks.shape[0]):
        first, size = blocks[block]
        total = 0.0
        for i in range(size):
            part = y[first + i]
            for j in range(i + 1):
                rest = S[first + i, first + j]
                for k in range(j):
                    rest -= L[i, k] * L[j, k]
                if i > j:
                    L[i, j] = rest / L[j, j]
                    part -= L[i, j] * u[j]
                elif rest > 0.0:
                    L[i, i] = math.sqrt(rest)
                else:
                    L[i, i] = math.nan
            u[i] = part / L[i, i]
            total += u[i] * u[i]
        distances[block] = total if total == total else math.inf
        good = good and distances[block] <= limits[size]
    return good


@portable
def stacked_update(
    P: np.ndarray,
    H: np.ndarray,
    variance: np.ndarray,
    y: np.ndarray,
    blocks: np.ndarray,
    limits: np.ndarray,
    distances: np.ndarray,
) -> tuple[bool, np.ndarray, np.ndarray, np.ndarray]:
    """Judge the innovations of a stack and, if all are within their gates, use them.

    Args:
        P: covariance, (n, n); it is not changed.
        H: Jacobian, (m, n).
        variance: of each row's white noise, (m,).
        y: innovations, (m,).
        blocks, limits, distances: see `within_gates`.

    Returns:
        Whether they were used; the state's correction K y, (n,); the new covariance; S, (m, m).
    """
    PHt = np.zeros((P.shape[0], H.shape[0]))
    S = innovation_covariance(P, H, variance, PHt)
    if not within_gates(S, y, blocks, limits, distances):
        return False, np.zeros(P.shape[0]), P, S
    K = gain(S, PHt)
    x = np.zeros(P.shape[0])
    for i in range(P.shape[0]):
        for j in range(H.shape[0]):
            x[i] += K[i, j] * y[j]
    return True, x, joseph(P, H, variance, K) if P.shape[0] <= JOSEPH_MAX else downdated(P, PHt, K), S
