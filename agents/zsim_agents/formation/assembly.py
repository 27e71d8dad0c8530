"""Assembly of robots at arbitrary positions into a formation: all fly simultaneously to assigned positions.

CAPT (concurrent assignment and planning of trajectories): Turpin, Michael and Kumar, Int. J. Robotics Research 33
(2014) 98-112. All fly straight from start to goal with a common function of time u, p_i = s_i + u (g_i - s_i). The
assignment with the minimum sum of squared distances has (s_i - s_j).(g_i - g_j) >= 0 for every pair; with starts at
least a apart and goals at least b apart, no pair then comes closer than a b / sqrt(a^2 + b^2), which is at least
min(a, b) / sqrt 2. The minimum sum of distances gives no such bound.

The common time stops while a robot is far from its reference position.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from zsim.contract.snapshot import State
from zsim.math import elementary as el
from zsim_agents.formation.control_law import FormationGains
from zsim_agents.formation.flight_check import ROUNDING_M, SHAPE, formation_fault
from zsim_agents.formation.flight_plan import RefusalError
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace
from zsim_agents.formation.trajectory import named_values, variable_of

PEAK_RATE = 1.875  # peak rate of the minimum-jerk function of time over its mean rate
DURATION_MIN_S = 2.0  # minimum duration, as for a ramp of the reference
LAG_M = 0.7  # distance of a robot from its reference above which all wait; design choice: 1/3 of the minimum separation
ARRIVAL_TOLERANCE_M = 0.5  # maximum distance from the goal on arrival; design choice: two sigma of a side's estimate
POSE_NAMES = ("x_c", "y_c", "z_c", "yaw")  # variables that are defined for robots in any arrangement


class Assembly:
    """Robots that fly straight from start_W (n, 3) [m] to goal_W, their positions in formation c (4n,), in over_s."""

    def __init__(self, start_W: Array, goal_W: Array, c: Array, over_s: float, gains: FormationGains) -> None:
        self.c, self.over_s = c, over_s
        self._start_W, self._goal_W, self._gains = start_W, goal_W, gains
        self._elapsed_s = 0.0

    @property
    def remaining_s(self) -> float:
        return self.over_s - self._elapsed_s

    def advance(self, p_W: Array, dt_s: float) -> None:
        """Advance the common time by dt_s, unless one of the robots, at p_W (n, 3) [m], is far behind."""
        if float(np.linalg.norm(self._reference()[0] - p_W, axis=1).max()) <= LAG_M:
            self._elapsed_s = min(self._elapsed_s + dt_s, self.over_s)

    def velocities(self, p_W: Array) -> Array:
        """Return the velocities (n, 3) [m/s, W] of robots at p_W (n, 3) [m], before `guard` limits them."""
        position_W, rate_W = self._reference()
        v_W = rate_W + self._gains.k_1_s * (position_W - p_W)
        speed = np.sqrt(v_W[:, 0] ** 2 + v_W[:, 1] ** 2)
        v_W[:, :2] *= np.minimum(1.0, self._gains.speed_max_m_s / np.maximum(speed, 1e-9))[:, None]
        v_W[:, 2] = np.clip(v_W[:, 2], -self._gains.climb_max_m_s, self._gains.climb_max_m_s)
        return v_W

    def farthest(self, p_W: Array) -> tuple[int, float]:
        """Return the index of the robot farthest from its goal, and the distance [m]."""
        distances_m = np.linalg.norm(self._goal_W - p_W, axis=1)
        return int(np.argmax(distances_m)), float(distances_m.max())

    def arrived(self, p_W: Array) -> bool:
        return self.remaining_s <= 0.0 and self.farthest(p_W)[1] <= ARRIVAL_TOLERANCE_M

    def _reference(self) -> tuple[Array, Array]:
        """Return the reference positions and velocities of the robots, each (n, 3)."""
        s = self._elapsed_s / self.over_s
        displacements_W = self._goal_W - self._start_W
        fraction, rate = s * s * s * (10.0 - s * (15.0 - 6.0 * s)), 30.0 * s * s * (1.0 - s) * (1.0 - s) / self.over_s
        return self._start_W + fraction * displacements_W, rate * displacements_W

    def snapshot(self) -> State:
        positions = {"start_W": self._start_W, "goal_W": self._goal_W, "c": self.c}
        return {**positions, "over_s": self.over_s, "flown_s": self._elapsed_s}

    @classmethod
    def restored(cls, state: State, gains: FormationGains) -> Assembly:
        assembly = cls(state["start_W"], state["goal_W"], state["c"], state["over_s"], gains)
        assembly._elapsed_s = state["flown_s"]
        return assembly


def assembly_goal(
    space: ClusterSpace, values: Mapping[str, str | float], base: Array | None, p_W: Array, yaw: Array
) -> Array:
    """Return the formation (4n,) to fly to: the base with the named values replaced.

    Args:
        base: formation (4n,) to start from; None for the robots' centre and mean heading, with all neutral variables
            zero. All other variables must then be named.
        p_W, yaw: positions (n, 3) [m] and headings (n,) [rad] of the robots.

    Raises:
        RefusalError: without a base, a variable that must be named is missing.
        TrajectoryError, ExpressionError: a value is not allowed.
    """
    if base is None:
        base = np.zeros(space.size)
        heading = el.atan2(math.fsum(map(el.sin, yaw.tolist())), math.fsum(map(el.cos, yaw.tolist())))
        for name, value in zip(POSE_NAMES, (*p_W.mean(axis=0).tolist(), heading), strict=True):
            if name in space.names:
                base[space.index(name)] = value
        given = {variable_of(space, name, "assemble", ".values").entry for name in values}
        are_known = (name in POSE_NAMES or space.neutral[i] or i in given for i, name in enumerate(space.names))
        if missing := [name for name, is_known in zip(space.names, are_known, strict=True) if not is_known]:
            raise RefusalError(f"the drones are not in a formation yet; values must name {', '.join(missing)} as well")
    return named_values(space, values, "assemble", base, ".values")


def planned_assembly(
    space: ClusterSpace, c: Array, p_W: Array, gains: FormationGains, separation_share: float = 1.0
) -> tuple[Assembly, NDArray[np.intp]]:
    """Return the paths of robots at p_W (n, 3) [m] to their positions in c (4n,), and the new order of the robots.

    Entry k of the order is the previous index of the robot that becomes robot k.

    Args:
        separation_share: share of the minimum separation that the paths must keep.

    Raises:
        RefusalError: c cannot be engaged, or two robots would come too close to each other.
    """
    if fault := formation_fault(space, c, gains, SHAPE):
        raise RefusalError(fault)
    goal_W = space.inverse(c)[0]
    order = np.argsort(assign(p_W, goal_W))
    start_W = p_W[order]
    min_m, distance = separation_share * gains.separation_min_m, straight_separation(start_W, goal_W)
    if distance < min_m - ROUNDING_M:
        finding = f"on the paths to their positions two drones come within {distance:.2f} m of each other"
        remedy = f"guaranteed if starts and goals are each {math.sqrt(2.0) * gains.separation_min_m:.2f} m apart"
        raise RefusalError(f"{finding}; allowed: {min_m:g} m or more, {remedy}")
    return Assembly(start_W, goal_W, c, _min_duration_s(start_W, goal_W, gains), gains), order


def assign(starts_m: Array, goals_m: Array) -> NDArray[np.intp]:
    """Return the index of the goal assigned to each start, (n,), for the minimum sum of squared distances.

    Raises:
        ValueError: the numbers of goals and starts differ, or a position is not finite.
    """
    from scipy.optimize import linear_sum_assignment  # imported here because SciPy loads slowly

    starts, goals = np.asarray(starts_m, float), np.asarray(goals_m, float)
    if starts.ndim != 2 or starts.shape != goals.shape or starts.shape[1] not in (2, 3):
        raise ValueError(f"found starts {starts.shape} and goals {goals.shape}; must both be (n, 2) or (n, 3)")
    if not (np.isfinite(starts).all() and np.isfinite(goals).all()):
        raise ValueError("a position is not finite; all must be")
    return linear_sum_assignment(((starts[:, None] - goals[None]) ** 2).sum(axis=2))[1]


def straight_separation(starts_m: Array, goals_m: Array) -> float:
    """Return the minimum distance [m] between drones that fly straight, in unison, from starts to goals (n, 3)."""
    i, j = np.triu_indices(len(starts_m), 1)
    if not len(i):
        return math.inf
    from_, to = starts_m[i] - starts_m[j], goals_m[i] - goals_m[j]
    change = to - from_
    squared = np.maximum((change**2).sum(axis=1), 1e-300)
    b = np.clip(-(from_ * change).sum(axis=1) / squared, 0.0, 1.0)
    return float(np.sqrt(((from_ + b[:, None] * change) ** 2).sum(axis=1)).min())


def _min_duration_s(start_W: Array, goal_W: Array, gains: FormationGains) -> float:
    """Return the duration [s] of the longest path at the share of the robots' limits that a reference may use."""
    deltas = np.abs(goal_W - start_W)
    horizontal_m, vertical_m = float(np.sqrt(deltas[:, 0] ** 2 + deltas[:, 1] ** 2).max()), float(deltas[:, 2].max())
    time_at_limits_s = max(horizontal_m / gains.speed_max_m_s, vertical_m / gains.climb_max_m_s)
    return max(DURATION_MIN_S, PEAK_RATE * time_at_limits_s / SHAPE.share)
