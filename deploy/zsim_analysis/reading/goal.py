"""Errors of a formation against its final goal, as the paper's Figure 5 has them: its climb is in them. Pure."""

from typing import NamedTuple

import numpy as np

from zsim.errors import NotTrustedError
from zsim.scenario.scenario import ClusterPlan, Scenario
from zsim_agents.formation.expression import ExpressionError
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_agents.formation.trajectory import TrajectoryError, named_values
from zsim_analysis.reading.formation import Formation
from zsim_analysis.reading.recorded_flight import Array


class GoalErrors(NamedTuple):
    """Deviations (K, 4n) of a formation from the target of its plan; NaN where it is led elsewhere, or has no target.

    Attributes:
        goal: (4n,) m or rad, NaN for variables that the target does not name.
        est, true: (K, 4n) estimate − goal and truth − goal, angles the short way.
    """

    goal: Array
    est: Array
    true: Array


def goal_errors(formation: Formation, scenario: Scenario | None) -> GoalErrors | None:
    """Return the errors of a formation against its plan's target; None where its plan has none."""
    cluster = next((each for each in scenario.clusters if each.name == formation.name), None) if scenario else None
    if scenario is None or cluster is None or not cluster.plan.target or cluster.plan.takeoff_s is None:
        return None
    try:
        space = scenario_space(scenario, cluster)
        goal = named_values(space, cluster.plan.target, "target", np.full(space.size, np.nan))
    except (TrajectoryError, ExpressionError, ValueError, NotTrustedError):
        return None  # it was refused in flight
    lost = (formation.t_s[:, None] >= _until_s(cluster.plan)) | ~np.isfinite(goal)
    est, true = (_against(space, each, goal, lost) for each in (formation.value, formation.true))
    return GoalErrors(goal, est, true)


def _against(space: ClusterSpace, values: Array, goal: Array, lost: np.ndarray) -> Array:
    return np.where(lost, np.nan, space.wrapped(values - np.nan_to_num(goal)))


def _until_s(plan: ClusterPlan) -> float:
    """Return when a plan leads the formation elsewhere: by its trajectory, or to the ground."""
    later = (plan.trajectory and plan.trajectory.start_s, plan.land_s)
    return min((each for each in later if each is not None), default=np.inf)
