"""The reference of a formation over time, and the ramps by which requests change it smoothly."""

from __future__ import annotations

import math

import numpy as np

from zsim.contract.snapshot import State
from zsim_agents.formation.control_law import FormationGains, RobotLimits, load
from zsim_agents.formation.flight_check import SHAPE, SHAPE_IN_FLIGHT, ShapeLimits, formation_fault
from zsim_agents.formation.flight_plan import Follow, MoveTo
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, SingularClusterError, robot_rates
from zsim_agents.formation.trajectory import (
    Hold,
    Ramp,
    Reference,
    Shifted,
    TrajectoryError,
    ramp_onto,
    reference_of,
    state_of,
)

SAMPLE_S = 0.5  # at 2 m/s a robot moves 1 m between two samples
SAMPLES_MIN, SAMPLES_MAX = 41, 301
HORIZON_S = 600.0  # part of a trajectory that is checked in advance; the rest is checked in flight
RAMP_MIN_S, RAMP_MAX_S = 2.0, 3600.0
RAMP_GROWTH = 1.2  # minimum growth factor in the search for a ramp that is slow enough
RAMP_SAMPLES = 33  # odd, so that one falls on the middle of a ramp, where its rate peaks
LOAD_TOLERANCE = 1.02  # factor on the allowed share of the speed limits: ramps are sampled, and may start at the limit
# Horizontal distance from its assigned position within which a robot climbs or descends, and distance at which it has
# rejoined; design choice: half of the minimum separation
VERTICAL_WITHIN_M = 1.0
REJOINED_M = 1.0


class Guidance:
    """The reference of an engaged formation, a function of simulated time.

    The formation's home (its target or trajectory) is kept separately from the reference being flown (a ramp onto it).
    A variable that a request does not name keeps its goal: the value from the last request that named it; initially
    its value at engagement, or zero for the neutral variables (roll, pitch, phi_i, w_k). While the home is a
    trajectory, such a variable keeps its present value there.

    Methods that change the reference raise TrajectoryError, ExpressionError or SingularClusterError, and change
    nothing, if the path is not allowed.
    """

    def __init__(self, space: ClusterSpace, gains: FormationGains) -> None:
        self.space = space
        self.paused = False
        self._gains = gains
        self._planner = RampPlanner(space, gains, SHAPE)
        self._home: Reference = Hold(np.zeros(space.size))
        self._active: Reference = self._home
        self._goal = np.zeros(space.size)
        self._cached: tuple[Reference, float, tuple[Array, Array]] | None = None  # the last result of `value`

    def value(self, t_s: float) -> tuple[Array, Array]:
        """Return c_des and its rate, each (4n,); cached per gate."""
        if self._cached is None or self._cached[0] is not self._active or self._cached[1] != t_s:
            self._cached = (self._active, t_s, self._active.value(t_s))
        return self._cached[2]

    def trajectory_t_s(self, t_s: float) -> float | None:
        """Return the time since the start of the trajectory [s]; None if no trajectory is running."""
        if not isinstance(self._home, Shifted) or self.paused:
            return None
        local_s, end_s = t_s - self._home.start_s, self._home.of.duration_s
        return local_s if local_s >= 0.0 and (end_s is None or local_s <= end_s) else None

    def engage(self, c: Array) -> None:
        """Hold the formation at the estimate c (4n,)."""
        self._goal = c.copy()
        self._goal[self.space.neutral] = 0.0
        self._home = self._active = Hold(c)
        self.paused = False

    def engage_at(self, c: Array, goal: Array, t_s: float) -> None:
        """Start at rest at the estimate c (4n,), and move to the goal (4n,) near it."""
        home = Hold(goal)
        self._active = self._planner.ramp((c, np.zeros_like(c)), home, t_s)
        self._home, self._goal, self.paused = home, goal.copy(), False

    def target(self, request: MoveTo, t_s: float) -> None:
        goal = request.goal(self.space, self.base(t_s))
        home = Hold(goal)
        self._active = self._planner.ramp(self.value(t_s), home, t_s, request.over_s)
        self._home, self._goal, self.paused = home, goal, False

    def follow(self, request: Follow, t_s: float) -> None:
        trajectory = request.trajectory(self.space, self.base(t_s))
        start_s = request.start_s
        if start_s is None:
            begin = Hold(trajectory.value(0.0)[0])
            ramp = self._planner.fastest(self.value(t_s), begin, t_s)
            start_s = t_s + ramp.over_s
        home = Shifted(trajectory, start_s)
        self._active = self._planner.ramp(self.value(t_s), home, t_s)
        self._home, self.paused = home, False

    def pause(self, t_s: float) -> None:
        """Come to rest near the present reference, or immediately if no ramp is allowed."""
        c, c_dot = self.value(t_s)
        try:
            self._active = self._planner.ramp((c, c_dot), Hold(c), t_s)
        except TrajectoryError:
            self._active = Hold(c)
        self.paused = True

    def resume(self, t_s: float) -> None:
        """Continue to the home reference after a pause."""
        self._active = self._planner.ramp(self.value(t_s), self._home, t_s)
        self.paused = False

    def rejoin(self, c: Array, t_s: float) -> None:
        """Continue after a fault from rest at the estimate c (4n,); a paused formation stays there.

        The path back is checked against the limits in flight, so that a formation close to them can return.
        """
        home = Hold(c) if self.paused else self._home
        start = (c, np.zeros_like(c))
        self._active = RampPlanner(self.space, self._gains, SHAPE_IN_FLIGHT).ramp(start, home, t_s)

    def snapshot(self) -> State:
        return {
            "home": state_of(self._home),
            "flown": state_of(self._active),
            "goal": self._goal,
            "paused": self.paused,
        }

    def restore(self, state: State) -> None:
        self._home, self._active = reference_of(self.space, state["home"]), reference_of(self.space, state["flown"])
        self._goal, self.paused = state["goal"], state["paused"]

    def base(self, t_s: float) -> Array:
        """Return the values (4n,) of the variables that a request does not name."""
        return self._home.value(t_s)[0] if isinstance(self._home, Shifted) else self._goal


class RampPlanner:
    """Plans the ramps of a formation within the limits of its shape and robots."""

    def __init__(self, space: ClusterSpace, gains: FormationGains, limits: ShapeLimits) -> None:
        self._space, self._gains, self._limits = space, gains, limits

    def ramp(self, start: tuple[Array, Array], onto: Reference, start_s: float, over_s: float | None = None) -> Ramp:
        """Return the ramp from start (c, c_dot) onto a reference, in over_s or as fast as the limits allow.

        The ramp and up to HORIZON_S of the reference are checked.

        Raises:
            TrajectoryError: the ramp is too fast or too long, or the ramp or the reference contains a forbidden state.
        """
        from_s = max(start_s, onto.start_s) if isinstance(onto, Shifted) else start_s
        end_s = min(math.inf if onto.duration_s is None else onto.duration_s, from_s + HORIZON_S)
        try:
            fault = self.reference_fault(onto, from_s, max(from_s, end_s))
            if fault:
                raise TrajectoryError(f"the reference is not allowed: {fault}")
            ramp = self.fastest(start, onto, start_s)
            if over_s is not None:
                min_s, ramp = ramp.over_s, None
                if 0.0 < over_s <= RAMP_MAX_S:
                    ramp = ramp_onto(self._space, *start, onto, start_s, over_s)
                if ramp is None or self._peak_load(ramp) > self._limits.share * LOAD_TOLERANCE:
                    allowed = f"allowed at the robots' limits: {min_s:.1f} s to {RAMP_MAX_S:g} s"
                    raise TrajectoryError(f"over_s is {over_s:g} s; {allowed}")
            fault = self.reference_fault(ramp, start_s, start_s + ramp.over_s)
        except SingularClusterError as error:
            raise TrajectoryError(f"the path is singular: {error}") from None
        if fault:
            raise TrajectoryError(f"the path is not allowed: {fault}")
        return ramp

    def fastest(self, start: tuple[Array, Array], onto: Reference, start_s: float) -> Ramp:
        """Return a fast ramp within the speed limits, its path unchecked; TrajectoryError: it would take over 1 h."""
        over_s = RAMP_MIN_S
        while over_s <= RAMP_MAX_S:
            ramp = ramp_onto(self._space, *start, onto, start_s, over_s)
            excess = self._peak_load(ramp) / self._limits.share
            if excess <= LOAD_TOLERANCE:
                return ramp
            over_s *= max(min(excess, 10.0), RAMP_GROWTH)
        limit = f"the target is not reached within {RAMP_MAX_S:g} s at the robots' limits"
        raise TrajectoryError(f"{limit}: it is too far away, or moves too fast")

    def _peak_load(self, ramp: Ramp) -> float:
        times = np.linspace(ramp.start_s, ramp.start_s + ramp.over_s, RAMP_SAMPLES).tolist()
        return max(self._load(*ramp.value(t_s)) for t_s in times)

    def _load(self, c: Array, c_dot: Array) -> float:
        return load(*robot_rates(self._space, c, c_dot), self._gains.limits)

    def reference_fault(self, reference: Reference, from_s: float, to_s: float) -> str | None:
        """Return why samples of a reference between from_s and to_s are not allowed, or None."""
        count = min(max(math.ceil((to_s - from_s) / SAMPLE_S) + 1, SAMPLES_MIN), SAMPLES_MAX)
        count = count if to_s > from_s else 1
        for t_s in np.linspace(from_s, to_s, count).tolist():
            c, c_dot = reference.value(t_s)
            fault = formation_fault(self._space, c, self._gains, self._limits)
            if not fault and (share := self._load(c, c_dot)) > self._limits.share * LOAD_TOLERANCE:
                fault = f"a robot moves at {share:.2f} times its limits; allowed: {self._limits.share:g}"
            if fault:
                return f"{t_s - from_s:.1f} s into the part checked, {fault}" if t_s > from_s else fault
        return None


class AssignedPositions:
    """The assigned positions p_W (n, 3) [m] in a held formation, and the motion of each robot to its own.

    A robot far from its position (for example after landing and taking off again) distorts the shape so much that the
    robots cannot be controlled as a formation. Each robot first flies horizontally at its own height, below or above
    the others, then vertically, at `share` of the robots' speed limits at most.
    """

    def __init__(self, p_W: Array, gains: FormationGains, limits: RobotLimits, share: float) -> None:
        self.p_W = p_W
        self._gain_1_s = gains.k_1_s
        self._speed_max_m_s, self._climb_max_m_s = share * limits.speed_max_m_s, share * limits.climb_max_m_s

    def velocities(self, p_W: Array) -> Array:
        """Return the velocities (n, 3) [m/s, W] of robots at p_W (n, 3) [m], before `guard` limits them."""
        v_W = self._gain_1_s * (self.p_W - p_W)
        horizontal_m = np.linalg.norm((self.p_W - p_W)[:, :2], axis=1)
        speed_m_s = self._gain_1_s * horizontal_m
        v_W[:, :2] *= np.minimum(1.0, self._speed_max_m_s / np.maximum(speed_m_s, self._speed_max_m_s))[:, None]
        v_W[:, 2] = np.clip(v_W[:, 2], -self._climb_max_m_s, self._climb_max_m_s) * (horizontal_m <= VERTICAL_WITHIN_M)
        return v_W

    def farthest(self, p_W: Array) -> tuple[int, float]:
        """Return the index of the robot farthest from its assigned position, and the distance [m]."""
        distances_m = np.linalg.norm(self.p_W - p_W, axis=1)
        return int(np.argmax(distances_m)), float(distances_m.max())
