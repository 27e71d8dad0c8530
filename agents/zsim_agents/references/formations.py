"""Whether drones with references come too near to formations, as far as these are known before the flight. Pure.

When a formation is engaged depends on its estimates, and so do its ways. From when it has certainly come to its target
or onto its trajectory, it is where its plan has it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from zsim.errors import DocumentError, NotTrustedError, RunError, UserCodeError
from zsim.scenario.scenario import Scenario
from zsim.vehicles.vehicle_catalogue import vehicle_of
from zsim_agents.formation.engagement_setup import PlannedMotion, planned_motion
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.trajectory import Reference

LATE_S = 15.0  # chosen: a take-off takes up to 12 s, of which READY_S are planned, and engagement waits for estimates
STEP_S, FINE_S = 0.1, 0.01  # between the instants that are looked at; of those near to each other
NEARER_M = 0.5  # chosen: by which a drone and a robot come nearer within STEP_S at most


def meetings(
    scenario: Scenario, flights: Mapping[str, Reference], until_s: Mapping[str, float]
) -> Iterator[tuple[str, str]]:
    """Yield path and text of each formation's first meeting with a drone that has a reference.

    Args:
        flights: of the drones by name, places (4,) at simulated time; until_s: when each of them lands.
    """
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
    """Return when a drone first is too near to a robot of a formation, how near, and to which; None if never."""
    from_s, to_s = planned.from_s + LATE_S, min(planned.until_s, until_s)
    for t_s in np.arange(from_s, to_s, STEP_S).tolist():
        if float(_distances(planned, flight, t_s).min()) >= least_m + NEARER_M:
            continue
        for fine_s in np.arange(t_s, min(t_s + STEP_S, to_s), FINE_S).tolist():
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
