"""Flocking by Vasarhelyi et al.: repulsion, and friction above the speed difference that allows braking in time.

    v_i = v_flock v_i / |v_i| + sum v_rep_ij + sum v_frict_ij + sum v_wall_is          limited to v_max
    v_rep_ij   = p_rep (r0_rep - r_ij) away from j,                 r_ij < r0_rep       (1)
    v_frict_ij = C (|v_ij| - v_ij_max) along v_j - v_i,             |v_ij| > v_ij_max   (2)
    v_ij_max   = max(v_frict, D(r_ij - r0_frict, a_frict, p_frict))                     (3)
    D(r, a, p) = 0 for r <= 0;  r p for r p < a / p;  sqrt(2 a r - a^2 / p^2) beyond    (4)

Vasarhelyi, Viragh, Somorjai, Nepusz, Eiben, Vicsek, Optimized flocking of autonomous drones in confined environments,
Science Robotics 3 (2018). D is the speed from which a drone can stop within r, first with deceleration a and finally
exponentially at the rate p. A wall or obstacle acts as a shill agent: a virtual drone at its nearest point, which moves
towards the free side at v_shill and to which (2) applies with C = 1 and v_frict = 0.

The arena of the paper, a square that contains the flock, is here centred on the reference and moves with it; the
reference's velocity is added to all velocities. The law forms no lattice: it ensures separation and velocity alignment.
"""

import math
from typing import Annotated

import numpy as np
from msgspec import Meta

from zsim.schema.quantities import NonNegative, Positive
from zsim_agents.laws.pilot import Array, Pilot, PilotParameters, Sight, length, unit


def braking(r: float, a: float, p: float) -> float:
    """Return D(r, a, p) of (4) [m/s] for r [m], a [m/s^2] and p [1/s]."""
    if r <= 0.0:
        return 0.0
    return r * p if r * p < a / p else math.sqrt(2.0 * a * r - a * a / (p * p))


def repelled(z: Array, r0: float, p: float) -> Array:
    """Return (1) for z = p_j - p_i [m]: a velocity away from j [m/s]."""
    r = length(z)
    return -p * (r0 - r) * unit(z) if r < r0 else np.zeros(len(z))


def friction(difference: Array, allowed: float, gain: float) -> Array:
    """Return (2) for the difference v_j - v_i [m/s]: a velocity along it, which reduces |v_j - v_i|."""
    excess = length(difference) - allowed
    return gain * excess * unit(difference) if excess > 0.0 else np.zeros(len(difference))


class Vasarhelyi(Pilot):
    class Parameters(PilotParameters):
        v_flock_m_s: NonNegative = 0.0
        """Speed that each drone keeps along its velocity; 0: only the reference's velocity is used."""
        p_rep_1_s: NonNegative = 0.4
        r0_rep_m: NonNegative = 3.5
        c_frict: Annotated[float, Meta(ge=0, le=1)] = 0.3
        v_frict_m_s: NonNegative = 0.2
        p_frict_1_s: Positive = 1.0
        a_frict_m_s2: Positive = 1.0
        r0_frict_m: NonNegative = 3.5
        v_shill_m_s: NonNegative = 1.5
        p_shill_1_s: Positive = 1.0
        a_shill_m_s2: Positive = 1.0
        r0_shill_m: NonNegative = 0.0
        arena_m: NonNegative = 8.0
        """Side of the square around the reference; 0: no arena."""
        avoid_m: NonNegative = 0.0
        """Drones, obstacles and surfaces closer than this repel the drone, in addition to the law; 0: no repulsion."""

    def velocity(self, now: Sight) -> Array:
        parameters = self.parameters
        velocity = now.reference.v_W.copy()
        if parameters.v_flock_m_s:
            velocity += parameters.v_flock_m_s * unit(now.v_W)
        for each in now.heard:
            z, r = each.p_W - now.p_W, length(each.p_W - now.p_W)
            velocity += repelled(z, parameters.r0_rep_m, parameters.p_rep_1_s)
            allowed = braking(r - parameters.r0_frict_m, parameters.a_frict_m_s2, parameters.p_frict_1_s)
            velocity += friction(each.v_W - now.v_W, max(parameters.v_frict_m_s, allowed), parameters.c_frict)
        for distance, away, v_wall in self._walls(now):
            allowed = braking(distance - parameters.r0_shill_m, parameters.a_shill_m_s2, parameters.p_shill_1_s)
            velocity += friction(v_wall + parameters.v_shill_m_s * away - now.v_W, allowed, 1.0)
        return velocity

    def _walls(self, now: Sight) -> list[tuple[float, Array, Array]]:
        """Return the distance [m], the direction away and the velocity [m/s] of each wall and obstacle."""
        parameters, walls = self.parameters, []
        speed_max, final_speed = (
            parameters.v_shill_m_s + parameters.speed_max_m_s,
            parameters.a_shill_m_s2 / parameters.p_shill_1_s,
        )
        reach = parameters.r0_shill_m + (speed_max * speed_max + final_speed * final_speed) / (
            2.0 * parameters.a_shill_m_s2
        )  # beyond this distance, (4) allows any speed
        walls += [(distance, away, np.zeros(2)) for distance, away in self.obstacles_near(now.p_W, reach)]
        for axis in (0, 1) if parameters.arena_m else ():
            for side in (-1.0, 1.0):
                away = np.zeros(2)
                away[axis] = -side
                distance = 0.5 * parameters.arena_m - side * float(now.p_W[axis] - now.reference.p_W[axis])
                walls.append((distance, away, now.reference.v_W))
        return walls
