"""A custom control law: each robot is attracted to its position in the formation and repelled by nearby robots.

    PYTHONPATH=examples zsim run scenarios/step.yaml --set clusters.main.law=potential_field:PotentialField

O. Khatib, Real-time obstacle avoidance for manipulators and mobile robots, Int. J. Robotics Research 5 (1986).
"""

import numpy as np

from zsim_agents.formation.control_law import ControlLaw
from zsim_agents.formation.spaces.cluster_space import Array

RANGE_M = 3.0  # distance beyond which robots do not repel each other
PUSH_M3_S = 2.0  # two robots 2 m apart repel each other at 2 (1/2 - 1/3) / 2^2 = 0.08 m/s


class PotentialField(ControlLaw):
    """Stateless; separately for each robot: v_i = v_des,i + k (p_des,i - p_i) + repulsion by its neighbours."""

    def rates(self, c: Array, p_W: Array, v_W: Array, c_des: Array, c_dot_des: Array) -> Array:
        space, k_1_s = self.space, self.gains.k_1_s
        place_W, heading = space.inverse(c_des)
        turn = heading - space.inverse(c)[1]
        r_dot = space.motion(c_des, c_dot_des).reshape(space.n, 4)
        r_dot[:, :3] += k_1_s * (place_W - p_W) + push(p_W)
        r_dot[:, 3] += k_1_s * (turn - 2 * np.pi * np.rint(turn / (2 * np.pi)))
        return r_dot.ravel()


def push(p_W: Array) -> Array:
    """Return the repulsion (n, 3) [m/s] of robots at (n, 3) [m], down the gradient of PUSH (1/d - 1/RANGE)^2 / 2."""
    apart_W = p_W[:, None] - p_W
    distance = np.linalg.norm(apart_W, axis=2)
    near = (distance > 0.0) & (distance < RANGE_M)
    d = np.where(near, distance, RANGE_M)
    speed = PUSH_M3_S * (1.0 / d - 1.0 / RANGE_M) / d**2
    return ((speed / d)[:, :, None] * apart_W).sum(axis=1)
