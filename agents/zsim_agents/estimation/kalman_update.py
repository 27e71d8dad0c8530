"""Prediction of a covariance, and its update with a stack of independent measurements, compiled.

The equations are those of filterpy's ExtendedKalmanFilter (Joseph form), which tests hold them against.
"""

import math

import numpy as np

from zsim.math.compiled import portable

ROWS_MAX = 32  # of one stacked update; more measurements of a gate go into a second one
DOF_MAX = 6  # rows of the largest block, GPS with position and velocity


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
def gain(S: np.ndarray, PHt: np.ndarray) -> np.ndarray:
    """Return K = P H^T S^-1, (n, m), by the Cholesky factor of S."""
    n, m = PHt.shape
    L = np.zeros((m, m))
    for i in range(m):
        for j in range(i + 1):
            rest = S[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(rest) if i == j else rest / L[j, j]
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
def within_gates(S: np.ndarray, y: np.ndarray, blocks: np.ndarray, limits: np.ndarray, distances: np.ndarray) -> bool:
    """Write y^T S^-1 y of every block of innovations by itself, and say whether all are within their limits.

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
    return True, x, joseph(P, H, variance, K), S
