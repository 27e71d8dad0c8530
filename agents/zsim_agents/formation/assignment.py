"""Simultaneous assignment of goals to interchangeable drones. Pure.

CAPT: Turpin, Michael and Kumar, Int. J. Robotics Research 33 (2014) 98-112. Drones fly straight from start to goal with
a common function of time b, p_i = s_i + b (g_i - s_i). The assignment with the least sum of squared distances has
(s_i - s_j).(g_i - g_j) >= 0 for every pair; with starts a and goals b apart, no pair then comes nearer than
a b / sqrt(a^2 + b^2), which is at least the smaller of them over sqrt 2. A sum of distances has no such bound.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zsim_agents.formation.spaces.cluster_space import Array


def assign(starts_m: Array, goals_m: Array) -> NDArray[np.intp]:
    """Return the goal (n,) of each of n starts (n, 3), for the least sum of squared distances.

    Raises:
        ValueError: the numbers of goals and starts differ, or they are not finite places.
    """
    from scipy.optimize import linear_sum_assignment  # here, because scipy takes longer to load than all else

    starts, goals = np.asarray(starts_m, float), np.asarray(goals_m, float)
    if starts.ndim != 2 or starts.shape != goals.shape or starts.shape[1] not in (2, 3):
        raise ValueError(f"found starts {starts.shape} and goals {goals.shape}; must both be (n, 3)")
    if not (np.isfinite(starts).all() and np.isfinite(goals).all()):
        raise ValueError("a place is not finite; must be")
    return linear_sum_assignment(((starts[:, None] - goals[None]) ** 2).sum(axis=2))[1]


def straight_separation(starts_m: Array, goals_m: Array) -> float:
    """Return the least distance [m] of drones that fly straight from starts to goals (n, 3) with a common b."""
    i, j = np.triu_indices(len(starts_m), 1)
    if not len(i):
        return math.inf
    from_, to = starts_m[i] - starts_m[j], goals_m[i] - goals_m[j]
    change = to - from_
    squared = np.maximum((change**2).sum(axis=1), 1e-300)
    b = np.clip(-(from_ * change).sum(axis=1) / squared, 0.0, 1.0)
    return float(np.sqrt(((from_ + b[:, None] * change) ** 2).sum(axis=1)).min())
