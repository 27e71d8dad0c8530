"""Where a formation is to be at every instant: the reference, and how requests change it without a bump."""

from __future__ import annotations

import numpy as np

from zsim_agents.formation.flight_request import Follow, Target
from zsim_agents.formation.formation_law import FormationGains
from zsim_agents.formation.reference_check import ShapeLimits, fastest_ramp, plan_ramp
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace
from zsim_agents.formation.trajectory import Hold, Ramp, Reference, Shifted, TrajectoryError


class Guidance:
    """The reference of an engaged formation, a function of simulated time.

    What the formation is about (a target or a trajectory, its home) is kept apart from what is flown now
    (a ramp onto it). A variable that a request does not name keeps its goal: the last value that a request
    gave it; before any, its value at engagement, and zero for the neutral ones (roll, pitch, phi_i, w_k).

    Methods that change the reference raise TrajectoryError, ExpressionError or SingularClusterError where
    the way is not allowed, and change nothing then.

    Attributes:
        paused: the formation was asked to stand still.
    """

    def __init__(self, space: ClusterSpace, gains: FormationGains, shape: ShapeLimits) -> None:
        self.space = space
        self.paused = False
        self._gains = gains
        self._shape = shape
        self._home: Reference = Hold(np.zeros(space.size))
        self._flown: Reference = self._home
        self._goal = np.zeros(space.size)
        self._known: tuple[Reference, float, tuple[Array, Array]] | None = None  # the last answer of value

    def value(self, t_s: float) -> tuple[Array, Array]:
        """Return c_des and its rate, each (4n,); asked twice in a gate, computed once."""
        if self._known is None or self._known[0] is not self._flown or self._known[1] != t_s:
            self._known = (self._flown, t_s, self._flown.value(t_s))
        return self._known[2]

    def trajectory_t_s(self, t_s: float) -> float | None:
        """Return the trajectory's own time, or None where none runs."""
        if not isinstance(self._home, Shifted) or self.paused:
            return None
        own_s, end_s = t_s - self._home.start_s, self._home.reference.duration_s
        return own_s if own_s >= 0.0 and (end_s is None or own_s <= end_s) else None

    def engage(self, c: Array) -> None:
        """Start at the estimate c (4n,) and stay there."""
        self._goal = c.copy()
        self._goal[self.space.neutral] = 0.0
        self._home = self._flown = Hold(c)
        self.paused = False

    def target(self, request: Target, t_s: float) -> None:
        """Lead to a target."""
        goal = request.goal(self.space, self._base(t_s))
        home = Hold(goal)
        self._flown = self._ramp(self.value(t_s), home, t_s, request.over_s)
        self._home, self._goal, self.paused = home, goal, False

    def follow(self, request: Follow, t_s: float) -> None:
        """Lead onto a trajectory."""
        trajectory = request.trajectory(self.space, self._base(t_s))
        start_s = request.start_s
        if start_s is None:
            begin = Hold(trajectory.value(0.0)[0])
            ramp = fastest_ramp(self.space, self.value(t_s), begin, t_s, self._gains, self._shape)
            start_s = t_s + ramp.over_s
        home = Shifted(trajectory, start_s)
        self._flown = self._ramp(self.value(t_s), home, t_s)
        self._home, self.paused = home, False

    def pause(self, t_s: float) -> None:
        """Come to rest at the present reference; at once where there is no room to do so smoothly."""
        c, c_dot = self.value(t_s)
        try:
            self._flown = self._ramp((c, c_dot), Hold(c), t_s)
        except TrajectoryError:
            self._flown = Hold(c)
        self.paused = True

    def resume(self, t_s: float) -> None:
        """Go on after a pause with what the formation was about."""
        self._flown = self._ramp(self.value(t_s), self._home, t_s)
        self.paused = False

    def rejoin(self, c: Array, t_s: float, shape: ShapeLimits) -> None:
        """Go on after a fault from the estimate c (4n,), at rest; a paused formation stays there.

        The way back keeps the limits of shape: a formation recovers from where it may just be flown.
        """
        home = Hold(c) if self.paused else self._home
        start = (c, np.zeros_like(c))
        self._flown = plan_ramp(self.space, start, home, t_s, self._gains, shape)

    def _base(self, t_s: float) -> Array:
        return self._home.value(t_s)[0] if isinstance(self._home, Shifted) else self._goal

    def _ramp(self, start: tuple[Array, Array], onto: Reference, t_s: float, over_s: float | None = None) -> Ramp:
        return plan_ramp(self.space, start, onto, t_s, self._gains, self._shape, over_s)
