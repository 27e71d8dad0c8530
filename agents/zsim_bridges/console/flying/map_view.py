"""The view from above, as plain data: where drones and formations are, and what stands around them. Axes of W."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from zsim.contract.flight_messages import ViewCluster
from zsim.math import frames
from zsim.presentation import drone_colours
from zsim.scenario.scenario import Obstacle, Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.flying.geofence import Geofence
from zsim_bridges.console.scene.picture import CanvasTrails, DronePoses, ghosts, short_names
from zsim_bridges.console.scene.scene_nodes import LARGE_MAX

DIGITS = 2  # of a metre: finer than a pixel
HEADING_DIGITS = 3  # of a radian


def surroundings(scenario: Scenario, fence: Geofence) -> dict[str, Any]:
    """Return what does not change: names, labels and colours of the drones, the fence, obstacles seen from above."""
    names = [drone.name for drone in scenario.drones]
    return {
        "names": names,
        "labels": names if len(names) <= LARGE_MAX else short_names(names),
        "colours": list(drone_colours(len(names))),
        "fence": {"low_m": fence.low_m, "high_m": fence.high_m},
        "obstacles": [_outline(each) for each in scenario.environment.obstacles],
    }


def _outline(obstacle: Obstacle) -> dict[str, Any]:
    """Return an obstacle from above: a disc, or a box that is turned about up."""
    size_m = list(obstacle.size_m[:2]) if obstacle.size_m is not None else None
    x_m, y_m, _ = obstacle.position_m
    place = {"name": obstacle.name, "x_m": x_m, "y_m": y_m, "yaw_deg": obstacle.yaw_deg}
    return {**place, "radius_m": obstacle.radius_m, "size_m": size_m}


def positions(drones: DronePoses, states: Mapping[str, str]) -> list[list[Any] | None]:
    """Return of each drone x, y, z [m], heading [rad] and state; None of one that is not in the view."""
    yaw = frames.heading(drones.q_WB)
    return [
        [*np.round(p_W, DIGITS).tolist(), round(float(yaw[i]), HEADING_DIGITS), states.get(drones.names[i], "")]
        if drones.present[i]
        else None
        for i, p_W in enumerate(drones.p_W)
    ]


def formations(
    spaces: Mapping[str, ClusterSpace], members: Mapping[str, list[int]], views: Mapping[str, ViewCluster]
) -> list[dict[str, Any]]:
    """Return of each formation its phase, its drones by their place in the order, and where they are to be [m]."""
    shown = []
    for name, view in views.items():
        desired = ghosts(spaces[name], view)
        places = [] if desired is None else np.round(desired[0][:, :2], DIGITS).tolist()
        shown.append({"name": name, "phase": view.phase, "drones": members[name], "places": places})
    return shown


def trail_lines(trails: CanvasTrails, drones: DronePoses) -> list[list[list[float]]]:
    """Return of each drone the last stretch of its path: x and y [m], and when it was there [s]."""
    segments, owners, times = trails.segments(drones.t_ns / 1e9, drones.p_W)
    points = np.round(np.column_stack((segments[:, 0, :2], times)), DIGITS)
    return [points[owners == i].tolist() for i in range(len(drones.names))]
