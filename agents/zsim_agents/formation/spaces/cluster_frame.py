"""The cluster frame C and its Z-Y-X Euler angles, in plain floats and compiled, because a gate has microseconds."""

from __future__ import annotations

import math

import numpy as np

from zsim.math.compiled import portable
from zsim.math.rotation import Matrix, Vector, add, cross, matrix_from_rpy, norm
from zsim_agents.formation.spaces.cluster_space import TAU, Array, SingularClusterError

LENGTH_MIN_M = 1e-9  # a nanometre: below it a direction is rounding noise


@portable
def wrap_angle(angle: float) -> float:
    """Return the angle taken to [-pi, pi]."""
    return angle - TAU * np.rint(angle / TAU)


@portable
def row(table: Array, i: int) -> Vector:
    """Return row i of a table (n, 3)."""
    return float(table[i, 0]), float(table[i, 1]), float(table[i, 2])


@portable
def put(J: Array, first: int, column: int, v: Vector) -> None:
    """Write v into a column of J, from row first on."""
    J[first, column], J[first + 1, column], J[first + 2, column] = v


@portable
def centroid(p_W: Array) -> Vector:
    """Return the mean of positions (n, 3)."""
    n = p_W.shape[0]
    x, y, z = row(p_W, 0)
    for i in range(1, n):
        a = row(p_W, i)
        x, y, z = x + a[0], y + a[1], z + a[2]
    return x / n, y / n, z / n


@portable
def pitch_yaw(x_W: Vector) -> tuple[float, float]:
    """Return pitch and yaw of a frame from its x axis in W."""
    flat = math.sqrt(x_W[0] * x_W[0] + x_W[1] * x_W[1])
    return math.atan2(-x_W[2], flat), math.atan2(x_W[1], x_W[0])


@portable
def euler_axes_C(roll: float, pitch: float) -> Matrix:
    """Return w_WC_C of a unit rate of roll, of pitch and of yaw."""
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    return (1.0, 0.0, 0.0), (0.0, cr, -sr), (-sp, sr * cp, cr * cp)


def euler_rates(roll: float, pitch: float) -> Array:
    """Return T (3, 3) with (roll', pitch', yaw') = T w_WC_C.

    Raises:
        SingularClusterError: pitch is at 90 degrees.
    """
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    if cp < LENGTH_MIN_M:
        raise SingularClusterError("pitch is 90 deg: roll and yaw of the formation are one rotation there")
    return np.array([(1.0, sr * sp / cp, cr * sp / cp), (0.0, cr, -sr), (0.0, sr / cp, cr / cp)])


@portable
def triad_axes(d2: Vector, d3: Vector) -> tuple[Vector, Vector, Vector, float, float]:
    """Return the axes x, y, z of C in W, h = |d2 + d3| [m] and the area |d2 x d3| [m^2].

    x_C points from the middle of robots 2 and 3 to robot 1, z_C along d2 x d3; robot 2 is on the left.
    All is zero where the three robots are in line or in one place.

    Args:
        d2, d3: P2 - P1 and P3 - P1, both in W [m].
    """
    m = add(d2, d3)
    normal = cross(d2, d3)
    h, area = norm(m), norm(normal)
    if not (h > LENGTH_MIN_M and area > LENGTH_MIN_M * h):  # also true for NaN
        none = (0.0, 0.0, 0.0)
        return none, none, none, 0.0, 0.0
    x = (-m[0] / h, -m[1] / h, -m[2] / h)
    z = (normal[0] / area, normal[1] / area, normal[2] / area)
    return x, cross(z, x), z, h, area


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
def array_of(R: Matrix) -> Array:
    """Return a matrix as an array (3, 3)."""
    rows = np.empty((3, 3))
    for i in range(3):
        rows[i, 0], rows[i, 1], rows[i, 2] = R[i]
    return rows


@portable
def rotation_of(c: Array) -> Array:
    """Return R_WC (3, 3) of a cluster (4n,) with roll, pitch and yaw at 3, 4 and 5."""
    return array_of(matrix_from_rpy(c[3], c[4], c[5]))


@portable
def euler_axes_of(c: Array) -> Array:
    """Return w_WC_C of a unit rate of roll, of pitch and of yaw, row by row (3, 3)."""
    return array_of(euler_axes_C(c[3], c[4]))
