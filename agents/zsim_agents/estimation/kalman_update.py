"""Linear algebra of the filter: prediction of a covariance, innovation gates, and updates with stacked measurements.

All functions are compiled. Prediction and update follow filterpy's ExtendedKalmanFilter (Joseph form), against which
tests compare them. A joint covariance J, (D, D) with D = N n, covers the error states of N drones one after another,
n states each (see filter_setup).
"""

import math

import numpy as np

from zsim.math.compiled import portable
from zsim.math.linear import product_with

Array = np.ndarray
DOF_MAX = 6  # rows of the largest block, a GPS fix with position and velocity
JOSEPH_MAX = 24  # maximum number of states for the Joseph form: with more (clones), its n^3 products would be too slow


@portable
def stacked_update(
    P: Array, H: Array, variance: Array, y: Array, blocks: Array, limits: Array, distances: Array
) -> tuple[bool, Array, Array, Array]:
    """Test the innovations y (m,) of a stack and, if all are within their gates, use them; P (n, n) is not modified.

    H is the Jacobian, (m, n), and `variance` the white-noise variance of each row, (m,); for the other arguments see
    `within_gates`.

    Returns:
        Whether the innovations were used; the correction K y of the state, (n,); the new covariance; and S, (m, m).
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


@portable
def within_gates(S: Array, y: Array, blocks: Array, limits: Array, distances: Array) -> bool:
    """Compute y^T S^-1 y separately for each block of innovations; return whether all are within their limits.

    The Cholesky factor of the block's covariance is used; the result is infinite if that covariance is not positive
    definite, or an innovation is NaN.

    Args:
        S, y: covariance (m, m) of all innovations, and the innovations (m,).
        blocks: first row and number of rows of each block, (k, 2).
        limits: limit of the result by number of rows, (DOF_MAX + 1,).
        distances: filled by this function with the results, (k,) or longer.
    """
    L = np.zeros((DOF_MAX, DOF_MAX))
    u = np.zeros(DOF_MAX)
    is_within = True
    for block in range(blocks.shape[0]):
        first, size = blocks[block]
        total = 0.0
        for i in range(size):
            whitened = y[first + i]
            for j in range(i + 1):
                rest = S[first + i, first + j]
                for k in range(j):
                    rest -= L[i, k] * L[j, k]
                if i > j:
                    L[i, j] = rest / L[j, j]
                    whitened -= L[i, j] * u[j]
                elif rest > 0.0:
                    L[i, i] = math.sqrt(rest)
                else:
                    L[i, i] = math.nan
            u[i] = whitened / L[i, i]
            total += u[i] * u[i]
        distances[block] = total if total == total else math.inf
        is_within = is_within and distances[block] <= limits[size]
    return is_within


@portable
def predicted_covariance(P: Array, F: Array, Q: Array) -> Array:
    """Return F P F^T + Q, (n, n), for a transition matrix F that differs from the identity in few entries."""
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
def predict_jointly(J: Array, i: int, F: Array, Q: Array) -> None:
    """Propagate the errors of drone i in J, and their covariance with all others, by F and Q, (n, n)."""
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
    for d in range(size):  # J is symmetric
        if d < first or d >= first + n:
            for r in range(n):
                J[d, first + r] = J[first + r, d]


@portable
def innovation_covariance(P: Array, H: Array, variance: Array, PHt: Array) -> Array:
    """Return S = H P H^T + R, (m, m), and write P H^T, (n, m); R is diagonal, with the elements of `variance`, (m,)."""
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
def gain(S: Array, PHt: Array) -> Array:
    """Return K = P H^T S^-1, (n, m), computed with the Cholesky factor of S."""
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
def cholesky(S: Array) -> Array:
    """Return the lower triangular matrix L, (m, m), with L L^T = S."""
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
def joseph(P: Array, H: Array, variance: Array, K: Array) -> Array:
    """Return (I - K H) P (I - K H)^T + K R K^T, (n, n)."""
    m, n = H.shape
    A = np.eye(n)
    for j in range(m):
        for k in range(n):
            h = H[j, k]
            if h != 0.0:
                for i in range(n):
                    A[i, k] -= K[i, j] * h
    updated = product_with(product_with(A, P), np.ascontiguousarray(A.T))
    for i in range(n):
        for j in range(m):
            weighted = K[i, j] * variance[j]
            for k in range(n):
                updated[i, k] += weighted * K[k, j]
    return updated


@portable
def downdated(P: Array, PHt: Array, K: Array) -> Array:
    """Return P - K H P, (n, n), exactly symmetric, from P H^T and the gain K = P H^T S^-1, (n, m) each."""
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
def put_block(J: Array, i: int, P: Array) -> None:
    n = P.shape[0]
    J[i * n : i * n + n, i * n : i * n + n] = P


@portable
def block(J: Array, i: int, n: int) -> Array:
    """Return a copy of the covariance of drone i, (n, n)."""
    return J[i * n : i * n + n, i * n : i * n + n].copy()


@portable
def add_projection(J: Array, H: Array, first: int, HJ: Array) -> None:
    """Add H J to HJ, (m, D), for a sparse Jacobian H, (m, n), with respect to the n errors from `first` on."""
    for j in range(H.shape[0]):
        for k in range(H.shape[1]):
            h = H[j, k]
            if h != 0.0:
                for d in range(J.shape[0]):
                    HJ[j, d] += h * J[first + k, d]


@portable
def add_innovation_covariance(HJ: Array, H: Array, first: int, S: Array) -> None:
    """Add H J H^T to S, (m, m), for a Jacobian as in `add_projection`."""
    for i in range(H.shape[0]):
        for k in range(H.shape[1]):
            h = H[i, k]
            if h != 0.0:
                for j in range(H.shape[0]):
                    S[i, j] += h * HJ[j, first + k]


@portable
def whiten(S: Array, HJ: Array, y: Array) -> None:
    """Replace HJ by W = L^-1 HJ and y by u = L^-1 y, with S = L L^T.

    The updated covariance is then J - W^T W, and the correction of the errors W^T u.
    """
    L = cholesky(S)
    for i in range(L.shape[0]):
        for k in range(i):
            y[i] -= L[i, k] * y[k]
            for d in range(HJ.shape[1]):
                HJ[i, d] -= L[i, k] * HJ[k, d]
        y[i] /= L[i, i]
        for d in range(HJ.shape[1]):
            HJ[i, d] /= L[i, i]
