"""Flocking by Olfati-Saber: drones form a lattice of spacing d, align their velocities and split around obstacles.

    u_i = c1 sum phi_alpha(|z_ij|_s) n_ij + c2 sum a_ij (v_j - v_i)                     alpha: flockmates
        + c1b sum phi_beta(|z_ik|_s) n_ik + c2b sum b_ik (v_k - v_i)                    beta: obstacles
        - c1g (p_i - p_r) - c2g (v_i - v_r)                                             gamma: the common objective

Olfati-Saber, Flocking for multi-agent dynamic systems: algorithms and theory, IEEE Trans. Automatic Control 51 (2006),
Algorithms 2 and 3. u is an acceleration, which the pilot integrates into the commanded velocity. Each drone uses the
messages of others within r; the last term uses the drone's own knowledge of the objective. Since several lattices are
possible, the quality of the shape is measured by the deviation from d of the distances within r.
"""

import math
from typing import Annotated

import numpy as np
from msgspec import Meta

from zsim.contract.snapshot import State
from zsim.math import elementary as el
from zsim.scenario.scenario import Scenario
from zsim.schema.quantities import NonNegative, Positive
from zsim_agents.laws.pilot import Array, Heard, Pilot, PilotParameters, Sight, limited, total

EPSILON = 0.1  # parameter of the sigma-norm
A = B = 5.0  # parameters of phi, 0 < a <= b
H_ALPHA, H_BETA = 0.2, 0.9  # parameter h of the bump function, for flockmates and obstacles


def sigma_norm(z: float) -> float:
    """Return |z|_s = (sqrt(1 + epsilon z^2) - 1) / epsilon for a length z; it is differentiable at 0."""
    return (math.sqrt(1.0 + EPSILON * z * z) - 1.0) / EPSILON


def sigma_gradient(z: Array) -> Array:
    """Return n = z / sqrt(1 + epsilon |z|^2), the gradient of the sigma-norm."""
    return z / math.sqrt(1.0 + EPSILON * total(z * z))


def sigma_1(z: float) -> float:
    return z / math.sqrt(1.0 + z * z)


def bump(z: float, h: float) -> float:
    """Return rho_h(z): 1 up to h, falling smoothly to 0 at 1."""
    if not 0.0 <= z <= 1.0:
        return 0.0
    return 1.0 if z < h else 0.5 * (1.0 + el.cos(math.pi * (z - h) / (1.0 - h)))


def phi(z: float) -> float:
    """Return the uneven sigmoid with phi(0) = 0, between -a and b."""
    c = abs(A - B) / math.sqrt(4.0 * A * B)
    return 0.5 * ((A + B) * sigma_1(z + c) + (A - B))


def phi_alpha(z: float, d: float, r: float) -> float:
    """Return the force at sigma-norm z between flockmates of spacing d and range r [m]; repulsion is negative."""
    r_alpha = sigma_norm(r)
    return bump(z / r_alpha, H_ALPHA) * phi(z - sigma_norm(d))


def phi_beta(z: float, d: float) -> float:
    """Return the force at sigma-norm z from an obstacle to be kept at distance d [m], always repulsive (<= 0)."""
    d_beta = sigma_norm(d)
    return bump(z / d_beta, H_BETA) * (sigma_1(z - d_beta) - 1.0)


def alpha_force(p: Array, v: Array, heard: list[Heard], d: float, r: float, c1: float) -> Array:
    """Return the flockmate term of u_i (dim,) [m/s^2]; c2 = 2 sqrt(c1)."""
    u = np.zeros(len(p))
    for each in heard:
        z = each.p_W - p
        size = sigma_norm(math.sqrt(total(z * z)))
        u += c1 * phi_alpha(size, d, r) * sigma_gradient(z)
        u += 2.0 * math.sqrt(c1) * bump(size / sigma_norm(r), H_ALPHA) * (each.v_W - v)
    return u


def beta_force(v: Array, obstacles: list[tuple[float, Array]], d: float, c1: float) -> Array:
    """Return the obstacle term of u_i, given the distance [m] of each obstacle and the direction away from it.

    The repelling virtual agent is at the obstacle's nearest point and moves along the surface with the drone.
    """
    u = np.zeros(len(v))
    for distance, away in obstacles:
        z = -max(distance, 0.0) * away
        size = sigma_norm(max(distance, 0.0))
        v_n = total(v * away) * away
        u += c1 * phi_beta(size, d) * sigma_gradient(z) - 2.0 * math.sqrt(c1) * bump(size / sigma_norm(d), H_BETA) * v_n
    return u


def gamma_force(p: Array, v: Array, p_r: Array, v_r: Array, c1: float) -> Array:
    """Return the objective term of u_i (dim,) [m/s^2]; c2 = 2 sqrt(c1)."""
    return -c1 * (p - p_r) - 2.0 * math.sqrt(c1) * (v - v_r)


def deviation_energy(p: Array, d: float, r: float) -> tuple[float, int]:
    """Return the normalised deviation energy of positions (n, dim) from a lattice [m^2], and the number of edges.

    E = sum of (|z_ij| - d)^2 over the pairs within r, divided by (pairs + 1), where each pair counts twice, once per
    direction; section II of the paper.
    """
    z = p[:, None] - p[None]
    lengths = np.sqrt(np.sum(z * z, axis=2))[np.triu_indices(len(p), 1)]
    edge_lengths = lengths[lengths < r]
    return float(2.0 * np.sum((edge_lengths - d) ** 2) / (2 * len(edge_lengths) + 1)), len(edge_lengths)


class OlfatiSaber(Pilot):
    class Parameters(PilotParameters):
        spacing_m: Positive = 3.5
        """Spacing d of the lattice."""
        range_ratio: Annotated[float, Meta(gt=1, le=10)] = 1.2
        """Range over spacing, r / d."""
        clearance_m: Positive = 1.5
        """Distance to keep from obstacles."""
        alpha_1_s2: NonNegative = 0.2
        beta_1_s2: NonNegative = 1.0
        gamma_1_s2: NonNegative = 0.1
        """c1 of the alpha, beta and gamma terms; each c2 is 2 sqrt(c1)."""
        accel_max_m_s2: Positive = 2.0
        avoid_m: NonNegative = 0.0
        """Drones, obstacles and surfaces closer than this repel the drone, in addition to the law; 0: no repulsion."""

    def begin(self, scenario: Scenario) -> None:
        self._dt = self._gate_ns / 1e9
        self._commanded = np.zeros(2)  # velocity of the double integrator

    def velocity(self, now: Sight) -> Array:
        parameters, v = self.parameters, self._commanded
        reach = parameters.range_ratio * parameters.spacing_m
        u = alpha_force(now.p_W, v, now.heard, parameters.spacing_m, reach, parameters.alpha_1_s2)
        u += beta_force(
            v, self.obstacles_near(now.p_W, parameters.clearance_m), parameters.clearance_m, parameters.beta_1_s2
        )
        u += gamma_force(now.p_W, v, now.reference.p_W, now.reference.v_W, parameters.gamma_1_s2)
        self._commanded = limited(v + self._dt * limited(u, parameters.accel_max_m_s2), parameters.speed_max_m_s)
        return self._commanded

    def snapshot(self) -> State:
        return {**super().snapshot(), "commanded": self._commanded}

    def restore(self, state: State) -> None:
        super().restore(state)
        self._commanded = np.array(state["commanded"])
