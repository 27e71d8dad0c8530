"""Leader-follower control of displacements.

    leader      u_l = v_l* + b (p_l* - p_l)
    follower    u_i = k sum_{j in N_i} ((p_j - p_i) - (c_j - c_i))    (1)

The leader knows the reference and uses messages only to avoid collisions; followers do not know the reference, and
receive messages from the leader only if it is a neighbour. If L_ff is the followers' block of the Laplacian, their
errors decay at the rate k lambda_min(L_ff). Without feed-forward, they lag behind a leader at velocity v by
L_ff^-1 1 v / k, which grows along a chain. Mesbahi, Egerstedt, Graph theoretic methods in multiagent networks (2010),
ch. 10.
"""

import numpy as np

from zsim_agents.laws.consensus import consensus
from zsim_agents.laws.pilot import Array, Sight
from zsim_agents.laws.shape import ShapeParameters, ShapePilot


class LeaderFollower(ShapePilot):
    """The informed drones, by default the first one, are leaders."""

    class Parameters(ShapeParameters):
        feedforward: bool = False
        """Whether followers know the reference's motion."""

    invariances = ("translation",)

    def velocity(self, now: Sight) -> Array:
        if self._informed:
            return self.tied(now)
        followed = consensus(self.relative(now), self.parameters.gain_1_s)
        return followed + (self.own_place(now)[1] if self.parameters.feedforward else np.zeros(2))
