"""Minimum distances between paths of drones, and to formations as far as known before the flight. Pure.

The time of engagement of a formation and its paths depend on its estimates. Its position is known from the time at
which it has certainly reached its target or trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from zsim.errors import DocumentError, NotTrustedError, RunError, UserCodeError
from zsim.math import elementary as el
from zsim.scenario.scenario import Scenario
from zsim.vehicles.vehicle import vehicle_of
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.trajectory import Reference
from zsim_agents.references.path import peaks_of

if TYPE_CHECKING:
    from zsim_agents.formation.engagement_setup import PlannedMotion

TOLERANCE_M = 1e-3  # of the least distance of two paths
STEP_S = 0.05  # between the instants at which all paths are looked at
LEAST_STEP_S = 1e-4  # to which the time between two instants is halved
LATE_S = 15.0  # chosen: a take-off takes up to 12 s, of which READY_S are planned, and engagement waits for estimates
LOOK_S, FINE_S = 0.1, 0.01  # between the instants that are looked at; of those near to each other
NEARER_M = 0.5  # chosen: by which a drone and a robot come nearer within LOOK_S at most


class Approach(NamedTuple):
    """Two paths that come too close: their indices in the list, the distance [m], and when [s]."""

    first: int
    second: int
    distance_m: float
    t_s: float


def first_approach(paths: Sequence[Reference], least_m: Array, until_s: float) -> Approach | None:
    """Return the first pair of paths, in time, that comes closer than allowed, to a millimetre; None if none does.

    Between two instants a distance falls by at most the sum of both greatest speeds times half of the time between;
    where that is not enough, the time is halved.

    Args:
        least_m: (n,) half of the least distance of a drone to another one like it; of a pair, their sum is allowed.
    """
    from scipy.spatial import KDTree

    if len(paths) < 2:
        return None
    peaks = [peaks_of(path) for path in paths]
    speed = np.array([el.hypot(each.speed_m_s, each.climb_m_s) for each in peaks])
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
    """Return the first distance below least_m found between two instants, and when; None if there is none."""

    def apart(t_s: float) -> float:
        return el.distance(a.value(t_s)[0][:3].tolist(), b.value(t_s)[0][:3].tolist())

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


def meetings(
    scenario: Scenario, flights: Mapping[str, Reference], until_s: Mapping[str, float]
) -> Iterator[tuple[str, str]]:
    """Yield path and text of each formation's first meeting with a drone that has a reference.

    Args:
        flights: of the drones by name, places (4,) at simulated time; until_s: when each of them lands.
    """
    from zsim_agents.formation.engagement_setup import planned_motion  # here, because few scenarios have both

    for index, cluster in enumerate(scenario.clusters if flights else ()):
        try:
            planned = planned_motion(scenario, cluster)
            clearance = {name: _clearance_m(scenario, name) for name in (*flights, *cluster.drones)}
        except (NotTrustedError, DocumentError, RunError, UserCodeError):
            continue  # told by who checks its plan, or not read here
        if planned is None:
            continue
        own_m = max(clearance[name] for name in cluster.drones)
        found = [_meeting(planned, flights[name], until_s[name], own_m + clearance[name]) for name in flights]
        met = [(each, name) for each, name in zip(found, flights, strict=True) if each is not None]
        if met:
            (t_s, distance_m, robot), name = min(met)
            near = f"leads robot {robot + 1} within {distance_m:.2f} m of {name}, by its reference, at {t_s:.1f} s"
            least = own_m + clearance[name]
            yield f"clusters[{index}].{planned.path}", f"{near}; must be >= {least:g} m (cluster {cluster.name!r})"


def _meeting(
    planned: PlannedMotion, flight: Reference, until_s: float, least_m: float
) -> tuple[float, float, int] | None:
    """Return when a drone is first too close to a robot of a formation, the distance, and the robot; None if never."""
    from_s, to_s = planned.from_s + LATE_S, min(planned.until_s, until_s)
    for t_s in np.arange(from_s, to_s, LOOK_S).tolist():
        if float(_distances(planned, flight, t_s).min()) >= least_m + NEARER_M:
            continue
        for fine_s in np.arange(t_s, min(t_s + LOOK_S, to_s), FINE_S).tolist():
            distances = _distances(planned, flight, fine_s)
            robot = int(distances.argmin())
            if distances[robot] < least_m:
                return fine_s, float(distances[robot]), robot
    return None


def _distances(planned: PlannedMotion, flight: Reference, t_s: float) -> Array:
    apart_W = planned.places(t_s) - flight.value(t_s)[0][:3]
    return np.sqrt((apart_W**2).sum(axis=1))


def _clearance_m(scenario: Scenario, drone: str) -> float:
    return vehicle_of(scenario.drone(drone).model).airframe.clearance_m
