"""Consensus on displacements.

    u_i = k sum_{j in N_i} ((p_j - p_i) - (c_j - c_i))        (1)

Olfati-Saber, Fax, Murray, Consensus and cooperation in networked multi-agent systems, Proc. IEEE 95 (2007), with the
displacement p_i - c_i as the agreement state. On a connected, undirected graph whose Laplacian has the second-smallest
eigenvalue lambda_2, the errors about their mean decay at least at the rate k lambda_2, and the mean is constant.
"""

from zsim_agents.laws.pilot import Array, Sight, added
from zsim_agents.laws.shape import ShapePilot


def consensus(relative: list[tuple[Array, Array]], k: float) -> Array:
    """Return u_i of (1) [m/s].

    Args:
        relative: p_j - p_i and c_j - c_i of each neighbour, (d,) each [m].
        k: gain [1/s].
    """
    return k * added([z - c for z, c in relative], len(relative[0][0]) if relative else 2)


class Consensus(ShapePilot):
    invariances = ("translation",)

    def velocity(self, now: Sight) -> Array:
        return consensus(self.relative(now), self.parameters.gain_1_s) + self.tied(now)
