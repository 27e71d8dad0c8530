"""Distance-based control of a rigid graph: drones need only relative positions, without a common compass.

    u_i = k sum_{j in N_i} (|z_ij|^2 - d_ij^2) z_ij,    z_ij = p_j - p_i       (1)

Krick, Broucke, Francis, Stabilisation of infinitesimally rigid formations of multi-robot networks, Int. J. Control 82
(2009). This is gradient descent on V = 1/4 sum e_ij^2 over the edges, e_ij = |z_ij|^2 - d_ij^2:
dV/dt = -sum |u_i|^2 / k, and the centroid is constant. The shape must be infinitesimally rigid: the rank of its
rigidity matrix R, whose row for edge ij is z_ji at i and z_ij at j, is 2 n - 3 in the plane and 3 n - 6 in space. If
there are exactly that many edges, errors near the shape decay at the rate 2 k lambda_min(R R^T). Convergence is local:
collinear drones stay collinear, and a vertex with only two edges may settle on the wrong side. If the two drones of an
edge have different desired distances, the formation drifts.
"""

from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike

from zsim_agents.laws.pilot import Array, Sight, added, total
from zsim_agents.laws.shape import ShapeParameters, ShapePilot


def distance_based(relative: list[tuple[Array, float]], k: float) -> Array:
    """Return u_i of (1) [m/s].

    Args:
        relative: z_ij (d,) [m] and d_ij^2 [m^2] of each neighbour.
        k: gain [1/(m^2 s)].
    """
    size = len(relative[0][0]) if relative else 2
    return k * added([(total(z * z) - squared) * z for z, squared in relative], size)


def rigidity_matrix(p: ArrayLike, edges: list[tuple[int, int]]) -> Array:
    """Return R (m, n d) for positions (n, d) and m edges (i, j): half the derivative of the squared lengths."""
    positions = np.asarray(p, float)
    n, d = positions.shape
    R = np.zeros((len(edges), n, d))
    for row, (i, j) in enumerate(edges):
        R[row, i] = positions[i] - positions[j]
        R[row, j] = -R[row, i]
    return R.reshape(len(edges), n * d)


class DistanceBased(ShapePilot):
    class Parameters(ShapeParameters):
        gain_1_s: Annotated[float, Meta(gt=0, le=5)] = 0.3
        """Gain normalised by size: k is this gain over the mean squared distance to the neighbours in the shape."""

    invariances = ("translation", "rotation")

    def velocity(self, now: Sight) -> Array:
        relative = [(z, total(c * c)) for z, c in self.relative(now)]
        mean = total(np.array([squared for _, squared in relative])) / max(len(relative), 1)
        return distance_based(relative, self.parameters.gain_1_s / max(mean, 1e-6)) + self.tied(now)
