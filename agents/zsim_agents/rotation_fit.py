"""The rotation that turns one set of points best onto another.

Horn, Closed-form solution of absolute orientation using unit quaternions, J. Opt. Soc. Am. A 4 (1987), section 4;
the same rotation as Kabsch's (1976), and never a reflection.
"""

from __future__ import annotations

import math

import numpy as np

from zsim_agents.cluster_space import Array


def fitted_rotation(H: Array) -> tuple[float, Array]:
    """Return how well the rotation is defined, and the rotation R (3, 3) that maximises the sum of b_i . R t_i.

    Args:
        H: (3, 3), the sum of t_i b_i^T.

    Returns:
        The gap, half of the difference of the two greatest eigenvalues of Horn's matrix [unit of H]: the smallest
        eigenvalue of tr(S) I - S, S = sum of R^T b_i t_i^T. It is zero where several rotations fit equally well, or
        H is not finite.
    """
    if not math.isfinite(H.sum()):
        return 0.0, np.eye(3)
    values, vectors = np.linalg.eigh(horn_matrix(H))
    return float(values[3] - values[2]) / 2.0, rotation_of(*vectors[:, 3].tolist())


def horn_matrix(H: Array) -> Array:
    """Return the symmetric (4, 4) whose greatest eigenvector is the quaternion, w first."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = H.tolist()
    return np.array(
        [
            (xx + yy + zz, yz - zy, zx - xz, xy - yx),
            (yz - zy, xx - yy - zz, xy + yx, zx + xz),
            (zx - xz, xy + yx, -xx + yy - zz, yz + zy),
            (xy - yx, zx + xz, yz + zy, -xx - yy + zz),
        ]
    )


def rotation_of(w: float, x: float, y: float, z: float) -> Array:
    """Return R (3, 3) of a unit quaternion."""
    return np.array(
        [
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
            (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
            (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
        ]
    )
