"""The cluster of two robots: a rod with a direction and a length, without roll."""

from __future__ import annotations

import math

import numpy as np

from zsim_agents.cluster_frame import LENGTH_MIN_M, pitch_yaw, rotation_WC, wrap_angle
from zsim_agents.cluster_space import Array, ClusterSpace, SingularClusterError


class PairCluster(ClusterSpace):
    """c = (x_c, y_c, z_c, pitch, yaw, phi_1, phi_2, p): origin in the middle, x_C towards robot 1."""

    def __init__(self) -> None:
        super().__init__(2, ("x_c", "y_c", "z_c", "pitch", "yaw", "phi_1", "phi_2", "p"), "p")

    def forward(self, p_W: Array, yaw: Array) -> Array:
        d_W = p_W[0] - p_W[1]
        p = _length(d_W)
        pitch, psi = pitch_yaw(d_W.tolist())
        phi = [wrap_angle(heading - psi) for heading in yaw.tolist()]
        return np.array([*((p_W[0] + p_W[1]) / 2), pitch, psi, *phi, p])

    def inverse(self, c: Array) -> tuple[Array, Array]:
        half_W = rotation_WC(0.0, c[3], c[4])[:, 0] * (c[7] / 2)
        return np.array([c[:3] + half_W, c[:3] - half_W]), np.array(
            [wrap_angle(c[4] + phi) for phi in c[5:7]]
        )

    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        d_W = p_W[0] - p_W[1]
        p = _length(d_W)
        pitch, psi = pitch_yaw(d_W.tolist())
        if math.cos(pitch) < LENGTH_MIN_M:
            raise SingularClusterError("the two robots are above each other: the formation has no yaw")
        x, y, z = rotation_WC(0.0, pitch, psi).T
        J = np.zeros((8, 2, 4))
        J[:3, :, :3] = np.eye(3)[:, None] / 2
        for row, axis in ((3, -z / p), (4, y / (p * math.cos(pitch))), (7, x)):
            J[row, 0, :3], J[row, 1, :3] = axis, -axis
        J[5:7, :, 3] = np.eye(2)
        J[5:7] -= J[4]
        return J.reshape(8, 8)

    def inverse_jacobian(self, c: Array) -> Array:
        x, y, z = rotation_WC(0.0, c[3], c[4]).T
        half = c[7] / 2
        J_inv = np.zeros((2, 4, 8))
        for robot, side in enumerate((1.0, -1.0)):
            J_inv[robot, :3, :3] = np.eye(3)
            J_inv[robot, :3, 3] = -side * half * z
            J_inv[robot, :3, 4] = side * half * math.cos(c[3]) * y
            J_inv[robot, :3, 7] = side * x / 2
            J_inv[robot, 3, [4, 5 + robot]] = 1.0
        return J_inv.reshape(8, 8)

    def spread(self, c: Array) -> float:
        return float(c[7])


def _length(d_W: Array) -> float:
    p = math.hypot(*d_W.tolist())
    if not p > LENGTH_MIN_M:  # also true for NaN
        raise SingularClusterError("robots 1 and 2 are in one place: the formation has no direction")
    return p
