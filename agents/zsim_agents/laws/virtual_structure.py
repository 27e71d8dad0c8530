"""Virtual structure: the formation is a rigid body that moves, turns and scales as planned; every drone knows the plan.

    p_i* = p_c + s R(psi) c_i,    u_i = dp_i*/dt + k (p_i* - p_i)      (1)

Lewis, Tan, High precision formation control of mobile robots using virtual structures, Autonomous Robots 4 (1997), in
the form in which each robot has a copy of the structure's state: Ren, Beard, Decentralized scheme for spacecraft
formation flying via the virtual structure approach, J. Guidance 27 (2004). Every error decays at the rate k; drones
are coupled only by collision avoidance.
"""

from zsim_agents.laws.pilot import Array, Sight
from zsim_agents.laws.shape import ShapePilot


def virtual_structure(p: Array, reference: Array, rate: Array, k: float) -> Array:
    """Return u_i of (1) for a position [m], its reference [m], the reference's rate [m/s], (d,) each, and k [1/s]."""
    return rate + k * (reference - p)


class VirtualStructure(ShapePilot):
    def velocity(self, now: Sight) -> Array:
        return virtual_structure(now.p_W, *self.own_place(now), self.parameters.gain_1_s)
