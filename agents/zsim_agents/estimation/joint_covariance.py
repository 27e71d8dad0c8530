"""The covariance of several drones' errors together: its prediction, and updates that correct all of them.

Compiled. D = N n: the error states of N drones one behind the other, n each (filter_setup); J is (D, D). Where there is
none, J is (0, 0), and every drone's covariance stands for itself.
"""

import numpy as np

from zsim.math.compiled import portable
from zsim_agents.estimation import strapdown
from zsim_agents.estimation.filter_state import LAYOUT, SETTING, Rows
from zsim_agents.estimation.kalman_update import gain, innovation_covariance, within_gates


@portable
def put_block(J: np.ndarray, i: int, P: np.ndarray) -> None:
    """Write a drone's own covariance into that of all."""
    n = P.shape[0]
    J[i * n : i * n + n, i * n : i * n + n] = P


@portable
def block(J: np.ndarray, i: int, n: int) -> np.ndarray:
    """Return a drone's own covariance, (n, n)."""
    return J[i * n : i * n + n, i * n : i * n + n].copy()


@portable
def predict_jointly(J: np.ndarray, i: int, F: np.ndarray, Q: np.ndarray) -> None:
    """Let a drone's errors grow by F and Q, (n, n), those with others along with them."""
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
    for d in range(size):  # the rows of others stand in the columns as well
        if d < first or d >= first + n:
            for r in range(n):
                J[d, first + r] = J[first + r, d]
    own = J[first : first + n, first : first + n].copy()
    for r in range(n):
        for c in range(n):
            total = Q[r, c]
            for k in range(n):
                f = F[c, k]
                if f != 0.0:
                    total += own[r, k] * f
            J[first + r, first + c] = total


@portable
def correct_all(rows: Rows, J: np.ndarray, PHt: np.ndarray, S: np.ndarray, y: np.ndarray) -> None:
    """Use innovations y (m,) of covariance S: correct every drone, and the covariance.

    Args:
        rows: of N drones.
        J: of all; changed.
        PHt: J H^T, (D, m).
    """
    K = gain(S, PHt)
    size, m, n = J.shape[0], y.shape[0], rows.covariance.shape[1]
    x = np.zeros(size)
    for d in range(size):
        for k in range(m):
            x[d] += K[d, k] * y[k]
    for r in range(size):
        for k in range(m):
            weight = K[r, k]
            if weight != 0.0:
                for c in range(r, size):
                    J[r, c] -= weight * PHt[c, k]
    for r in range(size):
        for c in range(r + 1, size):
            J[c, r] = J[r, c]
    for i in range(rows.nominal.shape[0]):
        error = x[i * n : i * n + n]
        strapdown.correct(rows.nominal[i], rows.layout[i], rows.setting[i, SETTING.gravity], error)
        if rows.layout[i, LAYOUT.aiding_biases]:
            for k in range(n):
                rows.bias[i, k] += error[k]


@portable
def use_own(
    rows: Rows, i: int, H: np.ndarray, variance: np.ndarray, y: np.ndarray, blocks: np.ndarray, distances: np.ndarray
) -> bool:
    """Judge measurements of a drone's own sensors together and, if all are within their gates, use them.

    Args:
        rows: of all drones; `rows.joint` is changed.
        i: the drone.
        H: Jacobian by its own errors, (m, n).
        variance: of the rows' white noise, (m,).
        y: innovations, (m,).
        blocks, distances: see `kalman_update.within_gates`.
    """
    J, m, n = rows.joint, H.shape[0], H.shape[1]
    wide = np.zeros((m, J.shape[0]))
    wide[:, i * n : i * n + n] = H
    PHt = np.zeros((J.shape[0], m))
    S = innovation_covariance(J, wide, variance, PHt)
    if not within_gates(S, y, blocks, rows.limits, distances):
        return False
    correct_all(rows, J, PHt, S, y)
    return True
