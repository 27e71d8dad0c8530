"""The covariance of several drones' errors together: updates that correct all of them.

Compiled. D = N n: the error states of N drones one behind the other, n each (filter_setup); J is (D, D). Where there is
none, J is (0, 0), and every drone's covariance stands for itself.
"""

import numpy as np

from zsim.math.compiled import portable
from zsim_agents.estimation import strapdown
from zsim_agents.estimation.filter_state import LAYOUT, SETTING, Rows
from zsim_agents.estimation.kalman_update import cholesky, within_gates


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
def add_projection(J: np.ndarray, H: np.ndarray, first: int, HJ: np.ndarray) -> None:
    """Add H J to HJ, (m, D), for a Jacobian by the errors from `first` on, (m, n), mostly zeros."""
    for j in range(H.shape[0]):
        for k in range(H.shape[1]):
            h = H[j, k]
            if h != 0.0:
                for d in range(J.shape[0]):
                    HJ[j, d] += h * J[first + k, d]


@portable
def add_innovation_covariance(HJ: np.ndarray, H: np.ndarray, first: int, S: np.ndarray) -> None:
    """Add H J H^T to S, (m, m), for a Jacobian as of `add_projection`."""
    for i in range(H.shape[0]):
        for k in range(H.shape[1]):
            h = H[i, k]
            if h != 0.0:
                for j in range(H.shape[0]):
                    S[i, j] += h * HJ[j, first + k]


@portable
def whiten(S: np.ndarray, HJ: np.ndarray, y: np.ndarray) -> None:
    """Replace HJ by W = L^-1 HJ and y by u = L^-1 y, with S = L L^T: then J^+ = J - W^T W, and x = W^T u."""
    L = cholesky(S)
    for i in range(L.shape[0]):
        for k in range(i):
            y[i] -= L[i, k] * y[k]
            for d in range(HJ.shape[1]):
                HJ[i, d] -= L[i, k] * HJ[k, d]
        y[i] /= L[i, i]
        for d in range(HJ.shape[1]):
            HJ[i, d] /= L[i, i]


@portable
def correct_all(rows: Rows, HJ: np.ndarray, S: np.ndarray, y: np.ndarray) -> None:
    """Use innovations y (m,) of covariance S: correct every drone, and the covariance.

    Args:
        rows: of N drones; `rows.joint` is J.
        HJ: H J, (m, D); overwritten, as y is.
    """
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
    first, HJ = i * H.shape[1], np.zeros((H.shape[0], rows.joint.shape[0]))
    add_projection(rows.joint, H, first, HJ)
    S = np.diag(variance)
    add_innovation_covariance(HJ, H, first, S)
    if not within_gates(S, y, blocks, rows.limits, distances):
        return False
    correct_all(rows, HJ, S, y.copy())
    return True
