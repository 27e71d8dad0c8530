"""The rotation that turns one set of points best onto another.

Horn, Closed-form solution of absolute orientation using unit quaternions, J. Opt. Soc. Am. A 4 (1987), section 4;
the same rotation as Kabsch's (1976), and never a reflection.
"""

from __future__ import annotations

import math

import numpy as np

from zsim.math.compiled import portable
from zsim_agents.formation.spaces.cluster_frame import row
from zsim_agents.formation.spaces.cluster_space import Array


def fitted_rotation(H: Array) -> tuple[float, Array]:
    """Return how well the rotation is defined, and the rotation R (3, 3) that maximises the sum of b_i . R t_i.

    Args:
        H: (3, 3), the sum of t_i b_i^T.

    Returns:
        The gap, half of the difference of the two greatest eigenvalues of Horn's matrix [unit of H]: the smallest
        eigenvalue of tr(S) I - S, S = sum of R^T b_i t_i^T. It is zero where several rotations fit equally well, or
        H is not finite.
    """
    K, R = np.empty((4, 4)), np.empty((3, 3))
    if not put_horn_matrix(H, K):
        return 0.0, np.eye(3)
    values, vectors = np.linalg.eigh(K)
    put_rotation_of(vectors[:, 3], R)
    return float(values[3] - values[2]) / 2.0, R


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
def put_rotation_of(q: Array, R: Array) -> None:
    """Write R (3, 3) of a unit quaternion (4,)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
