"""The geometry of a template: small matrices of rotation, the rotation that fits points best, and modes of shape.

The fit: Horn, Closed-form solution of absolute orientation using unit quaternions, J. Opt. Soc. Am. A 4 (1987),
section 4; the same rotation as Kabsch's (1976), and never a reflection.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from zsim.math.compiled import portable
from zsim_agents.formation.spaces.cluster_frame import euler_axes_C, pitch_yaw, rotation_WC, row
from zsim_agents.formation.spaces.cluster_space import Array

INDEPENDENT_MIN = 1e-6  # share of a direction that must be new; rounding leaves 1e-15
PLANES = ((0, 1), (0, 2), (1, 2))


@portable
def inertia(S: Array) -> Array:
    """Return tr(S) I - S (3, 3)."""
    M = np.empty((3, 3))
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    for i in range(3):
        for j in range(3):
            M[i, j] = (trace if i == j else 0.0) - S[i, j]
    return M


@portable
def skew(a: Array) -> Array:
    """Return the matrix (3, 3) of a x ."""
    A = np.zeros((3, 3))
    A[0, 1], A[0, 2] = -a[2], a[1]
    A[1, 0], A[1, 2] = a[2], -a[0]
    A[2, 0], A[2, 1] = -a[1], a[0]
    return A


def euler_angles(R_WC: Array) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of R_WC = Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch, yaw = pitch_yaw((R_WC[0, 0], R_WC[1, 0], R_WC[2, 0]))
    return math.atan2(R_WC[2, 1], R_WC[2, 2]), pitch, yaw


@portable
def rotation_of(c: Array) -> Array:
    """Return R_WC (3, 3) of a cluster (4n,) with roll, pitch and yaw at 3, 4 and 5."""
    R_WC = np.empty((3, 3))
    rows = rotation_WC(c[3], c[4], c[5])
    for i in range(3):
        R_WC[i, 0], R_WC[i, 1], R_WC[i, 2] = rows[i]
    return R_WC


@portable
def euler_axes_of(c: Array) -> Array:
    """Return w_WC_C of a unit rate of roll, of pitch and of yaw, row by row (3, 3)."""
    axes_C = np.empty((3, 3))
    rows = euler_axes_C(c[3], c[4])
    for i in range(3):
        axes_C[i, 0], axes_C[i, 1], axes_C[i, 2] = rows[i]
    return axes_C


def fitted_rotation(H: Array) -> tuple[float, Array]:
    """Return how well the rotation is defined, and the rotation R (3, 3) that maximises the sum of b_i . R t_i.

    Args:
        H: (3, 3), the sum of t_i b_i^T.

    Returns:
        The gap, half of the difference of the two greatest eigenvalues of Horn's matrix [unit of H]: the smallest
        eigenvalue of tr(S) I - S, S = sum of R^T b_i t_i^T. It is zero where several rotations fit equally well, or
        H is not finite.
    """
    K = np.empty((4, 4))
    if not put_horn_matrix(H, K):
        return 0.0, np.eye(3)
    values, vectors = np.linalg.eigh(K)
    return float(values[3] - values[2]) / 2.0, rotation_of_quaternion(vectors[:, 3])


@portable
def put_horn_matrix(H: Array, K: Array) -> bool:
    """Write the symmetric (4, 4) whose greatest eigenvector is the quaternion, w first; return whether it is finite."""
    xx, xy, xz = row(H, 0)
    yx, yy, yz = row(H, 1)
    zx, zy, zz = row(H, 2)
    K[0, 0], K[0, 1], K[0, 2], K[0, 3] = xx + yy + zz, yz - zy, zx - xz, xy - yx
    K[1, 0], K[1, 1], K[1, 2], K[1, 3] = yz - zy, xx - yy - zz, xy + yx, zx + xz
    K[2, 0], K[2, 1], K[2, 2], K[2, 3] = zx - xz, xy + yx, -xx + yy - zz, yz + zy
    K[3, 0], K[3, 1], K[3, 2], K[3, 3] = xy - yx, zx + xz, yz + zy, -xx - yy + zz
    return math.isfinite(xx + xy + xz + yx + yy + yz + zx + zy + zz)


@portable
def rotation_of_quaternion(q: Array) -> Array:
    """Return R (3, 3) of a unit quaternion (4,), w first."""
    R = np.empty((3, 3))
    w, x, y, z = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    return R


def centred(places: ArrayLike) -> Array:
    """Return places (n, 3) about their mean."""
    p = np.array(places, dtype=float).reshape(-1, 3)
    return p - p.mean(axis=0)


def turns(t: Array) -> Array:
    """Return the motions e_k x t_i of centred points under a unit turn about each axis: (3, n, 3)."""
    return np.array([np.cross(axis, t) for axis in np.eye(3)])


def shape_modes(t: Array) -> Array:
    """Return a basis (n, 3, 3n - 6) of the displacements that neither move nor turn centred points t (n, 3).

    Each mode moves the points by 1 m in the root mean square, and all are orthogonal to each other: N^T N = n I. The
    first are the homogeneous ones: growth, stretches along the axes and shears in their planes, as far as the points
    have room for them; the others follow from moving single points, in their order.

    Raises:
        ValueError: the points are in one line, or in one place.
    """
    n = len(t)
    rigid = _orthonormal([*np.repeat(np.eye(3)[:, None], n, axis=1), *turns(t)], [])
    if len(rigid) < 6:
        raise ValueError("template: all places are in one line; allowed: places that span a plane or space")
    single = np.eye(3 * n).reshape(3 * n, n, 3)
    basis = _orthonormal([t, *_stretches(t), *_shears(t), *single], rigid)
    return np.sqrt(n) * np.array(basis).T.reshape(n, 3, 3 * n - 6)


def _stretches(t: Array) -> list[Array]:
    return [t * axis for axis in np.eye(3)]


def _shears(t: Array) -> list[Array]:
    shears = []
    for a, b in PLANES:
        d = np.zeros_like(t)
        d[:, a], d[:, b] = t[:, b], t[:, a]
        shears.append(d)
    return shears


def _orthonormal(directions: list[Array], done: list[Array]) -> list[Array]:
    """Return unit vectors (3n,) along what is new in each direction (n, 3), in their order, beside those done."""
    basis: list[Array] = []
    for direction in directions:
        v = direction.ravel()
        size = np.linalg.norm(v)
        for _ in range(2):  # the second pass takes out what rounding left of the first
            earlier = np.array([*done, *basis])
            v = v - earlier.T @ (earlier @ v) if len(earlier) else v
        if size > 0.0 and np.linalg.norm(v) > INDEPENDENT_MIN * size:
            basis.append(v / np.linalg.norm(v))
    return basis
