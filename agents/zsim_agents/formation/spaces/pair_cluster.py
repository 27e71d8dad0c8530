"""The cluster of two robots: a rod with a direction and a length, without roll."""

from __future__ import annotations

import math

import numpy as np

from zsim.math.compiled import portable
from zsim.math.rotation import column, matrix_from_rpy, norm, scaled, subtract
from zsim_agents.formation.spaces.cluster_frame import LENGTH_MIN_M, centroid, pitch_yaw, put, row, wrap_angle
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, SingularClusterError


class PairCluster(ClusterSpace):
    """c = (x_c, y_c, z_c, pitch, yaw, phi_1, phi_2, p): origin in the middle, x_C towards robot 1."""

    def __init__(self) -> None:
        super().__init__(2, ("x_c", "y_c", "z_c", "pitch", "yaw", "phi_1", "phi_2", "p"), "p")

    def forward(self, p_W: Array, yaw: Array) -> Array:
        c = np.empty(8)
        pair_forward(p_W, yaw, c)
        if not c[7] > LENGTH_MIN_M:  # also true for NaN
            raise SingularClusterError("robots 1 and 2 are in one place: the formation has no direction")
        return c

    def inverse(self, c: Array) -> tuple[Array, Array]:
        p_W, yaw = np.empty((2, 3)), np.empty(2)
        pair_inverse(c, p_W, yaw)
        return p_W, yaw

    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        _, _, _, pitch, psi, _, _, p = self.forward(p_W, yaw).tolist()
        if math.cos(pitch) < LENGTH_MIN_M:
            raise SingularClusterError("the two robots are above each other: the formation has no yaw")
        x, y, z = np.array(matrix_from_rpy(0.0, pitch, psi)).T
        J = np.zeros((8, 2, 4))
        J[:3, :, :3] = np.eye(3)[:, None] / 2
        for k, axis in ((3, -z / p), (4, y / (p * math.cos(pitch))), (7, x)):
            J[k, 0, :3], J[k, 1, :3] = axis, -axis
        J[5:7, :, 3] = np.eye(2)
        J[5:7] -= J[4]
        return J.reshape(8, 8)

    def inverse_jacobian(self, c: Array) -> Array:
        J_inv = np.zeros((8, 8))
        pair_inverse_jacobian(c, J_inv)
        return J_inv

    def spread(self, c: Array) -> float:
        return float(c[7])


@portable
def pair_forward(p_W: Array, yaw: Array, c: Array) -> None:
    """Write c (8,); only its length p is right where that is zero."""
    d_W = subtract(row(p_W, 0), row(p_W, 1))
    c[0], c[1], c[2] = centroid(p_W)
    c[3], c[4] = pitch_yaw(d_W)
    c[5], c[6] = wrap_angle(yaw[0] - c[4]), wrap_angle(yaw[1] - c[4])
    c[7] = norm(d_W)


@portable
def pair_inverse(c: Array, p_W: Array, yaw: Array) -> None:
    """Write positions (2, 3) and headings (2,)."""
    half_W = scaled(column(matrix_from_rpy(0.0, c[3], c[4]), 0), c[7] / 2)
    for k in range(3):
        p_W[0, k], p_W[1, k] = c[k] + half_W[k], c[k] - half_W[k]
    yaw[0], yaw[1] = wrap_angle(c[4] + c[5]), wrap_angle(c[4] + c[6])


@portable
def pair_inverse_jacobian(c: Array, J_inv: Array) -> None:
    """Write J^-1 (8, 8) into zeros."""
    R_WC = matrix_from_rpy(0.0, c[3], c[4])
    x, y, z = column(R_WC, 0), column(R_WC, 1), column(R_WC, 2)
    for robot in range(2):
        first, half = 4 * robot, (0.5 - robot) * c[7]  # robot 1 is ahead, robot 2 behind
        for k in range(3):
            J_inv[first + k, k] = 1.0
        put(J_inv, first, 3, scaled(z, -half))
        put(J_inv, first, 4, scaled(y, half * math.cos(c[3])))
        put(J_inv, first, 7, scaled(x, 0.5 - robot))
        J_inv[first + 3, 4] = J_inv[first + 3, 5 + robot] = 1.0
