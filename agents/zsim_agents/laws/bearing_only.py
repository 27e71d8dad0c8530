"""Bearing-only control: drones measure the directions to their neighbours, not the distances.

    u_i = -k sum_{j in N_i} P(g_ij) g_ij*,    g_ij = z_ij / |z_ij|,    P(g) = I - g g^T       (1)

Zhao, Zelazo, Bearing rigidity and almost global bearing-only formation stabilization, IEEE Trans. Automatic Control 61
(2016), arXiv:1408.6552. The centroid and the scale s = sqrt(mean |p_i - centroid|^2) are constant, so that the
formation attains its shape and attitude at its initial size; V = 1/2 |p - p*|^2 decreases. The shape must be
infinitesimally bearing rigid: the rank of the bearing rigidity matrix is d n - d - 1. All drones need the same heading
reference.
The point-reflected shape is an unstable equilibrium.
"""

from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike

from zsim.math import elementary as el
from zsim.scenario.scenario import Scenario
from zsim_agents.laws.pilot import Array, Sight, added, total, unit
from zsim_agents.laws.shape import ShapeParameters, ShapePilot


def bearing_only(relative: list[tuple[Array, Array]], k: float) -> Array:
    """Return u_i of (1) [m/s].

    Args:
        relative: bearing g_ij and desired bearing g_ij* of each neighbour, (d,) each.
        k: gain [m/s].
    """
    size = len(relative[0][0]) if relative else 2
    return k * added([g * total(g * desired) - desired for g, desired in relative], size)


def bearing_rigidity_matrix(p: ArrayLike, edges: list[tuple[int, int]]) -> Array:
    """Return R_B (m d, n d) for positions (n, d) and m edges (i, j): the derivative of the bearings."""
    positions = np.asarray(p, float)
    n, d = positions.shape
    R = np.zeros((len(edges), d, n, d))
    for row, (i, j) in enumerate(edges):
        z = positions[j] - positions[i]
        size = el.length(z.tolist())
        P = (np.eye(d) - np.outer(z, z) / (size * size)) / size
        R[row, :, j], R[row, :, i] = P, -P
    return R.reshape(len(edges) * d, n * d)


class BearingOnly(ShapePilot):
    """By default, the first two drones are informed: their pinned positions determine the scale."""

    class Parameters(ShapeParameters):
        gain_m_s: Annotated[float, Meta(gt=0, le=20)] = 2.0

    invariances = ("translation", "scale")

    def begin(self, scenario: Scenario) -> None:
        super().begin(scenario)
        if self.parameters.informed is None:
            self._informed = self._drone in [drone.name for drone in scenario.drones[:2]]

    def velocity(self, now: Sight) -> Array:
        bearings = [(unit(z), unit(c)) for z, c in self.relative(now)]
        return bearing_only(bearings, self.parameters.gain_m_s) + self.tied(now)
