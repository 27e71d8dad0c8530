"""A custom cluster space: the paper's triangle, with the position of robot 1 instead of the centroid.

    python examples/leader_cluster.py
    PYTHONPATH=examples zsim run scenarios/step.yaml --set clusters.main.space=leader_cluster:LeaderCluster

The first command checks the Jacobian against finite differences; the second flies with this space.
"""

import numpy as np

from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace
from zsim_agents.formation.spaces.triad_cluster import TriadCluster

STEP = 1e-6  # m or rad; step of the finite differences


class LeaderCluster(TriadCluster):
    """c as in the paper, but (x_c, y_c, z_c) is robot 1's position, so that the others do not affect its command."""

    def forward(self, p_W: Array, yaw: Array) -> Array:
        c = super().forward(p_W, yaw)
        c[:3] = p_W[0]
        return c

    def inverse(self, c: Array) -> tuple[Array, Array]:
        p_W, yaw = super().inverse(c)
        return p_W - p_W[0] + c[:3], yaw

    def jacobian(self, p_W: Array, yaw: Array) -> Array:
        J = super().jacobian(p_W, yaw)
        J[:3] = 0.0
        J[:3, :3] = np.eye(3)
        return J

    def inverse_jacobian(self, c: Array) -> Array:
        J = super().inverse_jacobian(c).reshape(self.n, 4, self.size)
        J[:, :3, 3:] -= J[0, :3, 3:].copy()
        return J.reshape(self.size, self.size)


def jacobian_error(space: ClusterSpace, p_W: Array, yaw: Array) -> float:
    """Return the largest entry of |J - central differences of `forward`| and |J J^-1 - identity|.

    Args:
        p_W, yaw: positions (n, 3) [m] and headings (n,) [rad] of the robots.
    """
    J, c = space.jacobian(p_W, yaw), space.forward(p_W, yaw)
    columns = []
    for k in range(space.size):
        step = np.zeros((space.n, 4))
        step.flat[k] = STEP
        ahead = space.forward(p_W + step[:, :3], yaw + step[:, 3])
        behind = space.forward(p_W - step[:, :3], yaw - step[:, 3])
        columns.append(space.difference(ahead, behind) / (2 * STEP))
    off = np.abs(J - np.array(columns).T).max()
    return float(max(off, np.abs(J @ space.inverse_jacobian(c) - np.eye(space.size)).max()))


if __name__ == "__main__":
    places_m = np.array([(0.0, 1.5, 3.0), (-1.5, -1.5, 2.8), (1.7, -1.4, 3.1)])
    error = jacobian_error(LeaderCluster(3), places_m, np.array([0.1, -0.2, 0.3]))
    print(f"Jacobian: off by at most {error:.1e}")
    if error > 1e-6:
        raise SystemExit("the Jacobian does not match the kinematics")
