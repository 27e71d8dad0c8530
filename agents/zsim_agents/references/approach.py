"""How near paths of drones come to each other. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.trajectory import Reference
from zsim_agents.references.path import peaks_of

TOLERANCE_M = 1e-3  # of the least distance of two paths
STEP_S = 0.05  # between the instants at which all paths are looked at
LEAST_STEP_S = 1e-4  # to which the time between two instants is halved


class Approach(NamedTuple):
    """Two of some paths that come too near to each other: their places in the list, how near, and when."""

    first: int
    second: int
    distance_m: float
    t_s: float


def first_approach(paths: Sequence[Reference], least_m: Array, until_s: float) -> Approach | None:
    """Return the first pair of paths, in time, that comes nearer than allowed, to a millimetre; None if none does.

    Between two instants a distance falls by at most the sum of both greatest speeds times half of the time between;
    where that is not enough, the time is halved.

    Args:
        least_m: (n,) half of the least distance of a drone to another one like it; of a pair, their sum is allowed.
    """
    from scipy.spatial import KDTree

    if len(paths) < 2:
        return None
    peaks = [peaks_of(path) for path in paths]
    speed = np.array([math.hypot(each.speed_m_s, each.climb_m_s) for each in peaks])
    steps = max(2, math.ceil(until_s / STEP_S) + 1)
    times = np.linspace(0.0, until_s, steps).tolist()
    places = np.array([[path.value(t)[0][:3] for path in paths] for t in times])
    step_s = times[1] - times[0]
    reach = 2.0 * float(least_m.max() + speed.max() * step_s)
    for k, t in enumerate(times[:-1]):
        for i, j in sorted(KDTree(places[k]).query_pairs(reach)):
            near = (paths[i], paths[j], float(speed[i] + speed[j]), float(least_m[i] + least_m[j]))
            found = _nearer(*near, t, times[k + 1])
            if found is not None:
                return Approach(i, j, *found)
    return None


def _nearer(
    a: Reference, b: Reference, speed: float, least_m: float, from_s: float, to_s: float
) -> tuple[float, float] | None:
    """Return the first distance below least_m that is found between two instants, and when; None: there is none."""

    def apart(t_s: float) -> float:
        return float(np.linalg.norm(a.value(t_s)[0][:3] - b.value(t_s)[0][:3]))

    open_ = [(from_s, apart(from_s), to_s, apart(to_s))]
    while open_:
        low, at_low, high, at_high = open_.pop()
        for distance, t_s in ((at_low, low), (at_high, high)):
            if distance < least_m - TOLERANCE_M:
                return distance, t_s
        if (at_low + at_high - speed * (high - low)) / 2.0 < least_m - TOLERANCE_M and high - low > LEAST_STEP_S:
            middle = (low + high) / 2.0
            at_middle = apart(middle)
            open_ += [(middle, at_middle, high, at_high), (low, at_low, middle, at_middle)]
    return None
