"""Linear algebra for small matrices, bit-identical on every machine: every sum runs in index order.

BLAS and LAPACK, on which numpy and scipy rely, order and fuse sums differently from processor to processor. Whatever
affects the flight of a drone or the output of an agent uses these functions instead; for up to tens of rows, they are
as fast. Matrices are arrays of float64; a singular system gives results that are not finite.

    product     A B for A (m, k) and B (k, n) or (k,)
    solve       A^-1 B by elimination with partial pivoting
    solve_banded        the same, for a matrix with few diagonals
    eigen       eigenvalues, ascending, and eigenvectors of a symmetric matrix (Jacobi)
    singular_values     descending, by rotations of columns (Hestenes, J. SIAM 6 (1958) 51-90)
    pseudo_inverse      for a matrix with independent rows
    exponential         e^A by Taylor's series, with scaling and squaring
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zsim.math.compiled import deferred

Array = NDArray[np.float64]

SWEEPS_MAX = 60  # maximum number of sweeps of rotations over all pairs; ten suffice for the largest matrices here
TERMS = 20  # terms of the series of e^A for |A| <= 1/2; the next is below 1e-25
ORTHOGONAL = 1e-16  # size of an off-diagonal element, relative to the diagonal ones, up to which it needs no rotation


def product(A: ArrayLike, B: ArrayLike) -> Array:
    a, b = _own(A), _own(B)
    return product_with(a, b) if b.ndim == 2 else product_with(a, b.reshape(-1, 1)).ravel()


def solve(A: ArrayLike, B: ArrayLike) -> Array:
    """Return A^-1 B for A (n, n) and B (n, m) or (n,)."""
    a, b = _own(A), _own(B)
    return _solved(a.copy(), b.reshape(len(a), -1).copy()).reshape(b.shape)


def solve_banded(diagonals: Array, below: int, B: Array) -> Array:
    """Return A^-1 B, (n, m), for a banded matrix A.

    Args:
        diagonals: A as (n, below + 1 + above); element j - i + below of row i is A[i, j].
        below: number of diagonals below the main one.
    """
    room = np.zeros((len(diagonals), below))  # filled when rows are exchanged
    return _banded_solved(_own(np.hstack([diagonals, room])), below, _own(B).copy())


def eigen(A: ArrayLike) -> tuple[Array, Array]:
    """Return the eigenvalues, (n,), ascending, and unit eigenvectors as columns, (n, n), of a symmetric matrix."""
    values, vectors = _diagonalised(_own(A).copy())
    order = np.argsort(values, kind="stable")
    return values[order], vectors[:, order]


def singular_values(A: ArrayLike) -> Array:
    a = _own(A)
    return -np.sort(-_column_lengths((a if a.shape[0] >= a.shape[1] else _own(a.T)).copy()))


def pseudo_inverse(A: ArrayLike) -> Array:
    """Return A^T (A A^T)^-1, (n, m), for A (m, n) with independent rows."""
    a = _own(A)
    return solve(product(a, a.T), a).T


def exponential(A: ArrayLike) -> Array:
    a = _own(A)
    size = float(np.abs(a).sum(axis=1).max())
    halvings = max(0, math.frexp(size)[1] + 1)
    a = a * 2.0**-halvings
    term = total = np.eye(len(a))
    for k in range(1, TERMS + 1):
        term = product(term, a) / k
        total = total + term
    for _ in range(halvings):
        total = product(total, total)
    return total


def _own(A: ArrayLike) -> Array:
    return np.ascontiguousarray(A, dtype=np.float64)


@deferred()
def product_with(A: Array, B: Array) -> Array:
    """Return A B for contiguous arrays (m, k) and (k, n); for compiled code."""
    m, n = A.shape[0], B.shape[1]
    C = np.zeros((m, n))
    for i in range(m):
        for k in range(A.shape[1]):
            a = A[i, k]
            for j in range(n):
                C[i, j] += a * B[k, j]
    return C


@deferred()
def _solved(A: Array, B: Array) -> Array:
    """Return A^-1 B; A and B are overwritten."""
    n, m = B.shape
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[best, k]):
                best = i
        if best != k:
            for j in range(n):
                A[k, j], A[best, j] = A[best, j], A[k, j]
            for j in range(m):
                B[k, j], B[best, j] = B[best, j], B[k, j]
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            if factor != 0.0:
                for j in range(k + 1, n):
                    A[i, j] -= factor * A[k, j]
                for j in range(m):
                    B[i, j] -= factor * B[k, j]
    for k in range(n - 1, -1, -1):
        for j in range(m):
            remainder = B[k, j]
            for i in range(k + 1, n):
                remainder -= A[k, i] * B[i, j]
            B[k, j] = remainder / A[k, k]
    return B


@deferred()
def _banded_solved(A: Array, below: int, B: Array) -> Array:
    """Return A^-1 B; A and B are overwritten."""
    n, m = B.shape
    right = A.shape[1] - below  # columns of a row from the diagonal on
    for k in range(n):
        best = k
        for i in range(k + 1, min(n, k + below + 1)):
            if abs(A[i, k - i + below]) > abs(A[best, k - best + below]):
                best = i
        if best != k:
            for j in range(k, min(n, k + right)):
                a, b = A[k, j - k + below], A[best, j - best + below]
                A[k, j - k + below], A[best, j - best + below] = b, a
            for j in range(m):
                B[k, j], B[best, j] = B[best, j], B[k, j]
        for i in range(k + 1, min(n, k + below + 1)):
            factor = A[i, k - i + below] / A[k, below]
            if factor != 0.0:
                for j in range(k + 1, min(n, k + right)):
                    A[i, j - i + below] -= factor * A[k, j - k + below]
                for j in range(m):
                    B[i, j] -= factor * B[k, j]
    for k in range(n - 1, -1, -1):
        for j in range(m):
            remainder = B[k, j]
            for i in range(k + 1, min(n, k + right)):
                remainder -= A[k, i - k + below] * B[i, j]
            B[k, j] = remainder / A[k, below]
    return B


@deferred(makes_arrays=False)
def _rotation(pp: float, qq: float, pq: float) -> tuple[float, float]:
    """Return the cosine and sine of the Jacobi rotation that diagonalises ((pp, pq), (pq, qq))."""
    theta = 0.5 * (qq - pp) / pq
    t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
    c = 1.0 / math.sqrt(t * t + 1.0)
    return c, t * c


@deferred()
def _diagonalised(A: Array) -> tuple[Array, Array]:
    """Return the diagonal and the accumulated rotations of a diagonalised symmetric matrix, which is overwritten."""
    n = A.shape[0]
    V = np.eye(n)
    for _ in range(SWEEPS_MAX):
        largest = 0.0
        for p in range(n - 1):
            for q in range(p + 1, n):
                apq = A[p, q]
                if abs(apq) <= ORTHOGONAL * math.sqrt(abs(A[p, p] * A[q, q])) or apq == 0.0:
                    continue
                largest = max(largest, abs(apq))
                c, s = _rotation(A[p, p], A[q, q], apq)
                for k in range(n):
                    a, b = A[k, p], A[k, q]
                    A[k, p], A[k, q] = c * a - s * b, s * a + c * b
                for k in range(n):
                    a, b = A[p, k], A[q, k]
                    A[p, k], A[q, k] = c * a - s * b, s * a + c * b
                A[p, q] = A[q, p] = 0.0
                for k in range(n):
                    a, b = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * a - s * b, s * a + c * b
        if largest == 0.0:
            break
    values = np.empty(n)
    for i in range(n):
        values[i] = A[i, i]
    return values, V


@deferred()
def _column_lengths(A: Array) -> Array:
    """Return the lengths of the columns after rotating them to be orthogonal; A (m, n), m >= n, is overwritten."""
    m, n = A.shape
    for _ in range(SWEEPS_MAX):
        rotated = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                pp, qq, pq = 0.0, 0.0, 0.0
                for k in range(m):
                    pp += A[k, p] * A[k, p]
                    qq += A[k, q] * A[k, q]
                    pq += A[k, p] * A[k, q]
                if not abs(pq) > 1e-15 * math.sqrt(pp * qq):
                    continue
                rotated = True
                c, s = _rotation(pp, qq, pq)
                for k in range(m):
                    a, b = A[k, p], A[k, q]
                    A[k, p], A[k, q] = c * a - s * b, s * a + c * b
        if not rotated:
            break
    lengths = np.empty(n)
    for j in range(n):
        total = 0.0
        for k in range(m):
            total += A[k, j] * A[k, j]
        lengths[j] = math.sqrt(total)
    return lengths
