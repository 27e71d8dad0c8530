"""Single drones and the plan view for the pages of one run: choose a drone, fly it, view all from above, return.

A return to launch flies a drone back above its start, as if sent to a place on the map, and a formation, by its
controller, above the middle of its starts; there they land. A later request ends a return.
"""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zsim.contract.flight_messages import ViewCluster
from zsim.math import frames
from zsim.presentation import drone_colours
from zsim.scenario.scenario import Piloted, Scenario
from zsim.scenario.surroundings import outline_of
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.references.flight import limits_of
from zsim_agents.references.tracking import Course
from zsim_bridges.console.command_client import CommandClient
from zsim_bridges.console.console_page import PageForms
from zsim_bridges.console.histories import CanvasTrails
from zsim_bridges.console.manual_flight import (
    DronePose,
    DroneSight,
    Geofence,
    ManualFlight,
    RunSight,
    geofence_of,
)
from zsim_bridges.console.picture import DronePoses, ghosts, short_names
from zsim_bridges.console.run_monitor import RunMonitor
from zsim_bridges.console.scene import LARGE_MAX, RunScene

DIGITS = 2  # of a metre: finer than a pixel
HEADING_DIGITS = 3  # of a radian
ABOVE_START_M = 0.5  # horizontal distance from a start, near enough to land; chosen: the size of a hull
OVER_STARTS_M = 0.5  # of a formation from the middle of its starts
OVERRULED_M = 1.0  # increase of the goal's distance that shows that it was sent elsewhere
MIDDLE = ("x_c", "y_c")  # variables of a formation that a return sets

Place = tuple[float, float]


class PageFlying:
    """Single drones for the pages of one run; pages are identified by viser's number.

    `note` is called with each drone or formation whose return is over, and the reason.
    """

    def __init__(
        self,
        monitor: RunMonitor,
        client: CommandClient,
        name: str,
        scene: RunScene,
        pages: PageForms,
        note: Callable[[str, str], None] = lambda subject, why: None,
    ) -> None:
        self._run = run = monitor.run
        self._views = views = monitor.views
        self._monitor = monitor
        self._scene = scene
        self.pages = pages
        self._members = {name: [run.names.index(each) for each in drones] for name, drones in run.members.items()}
        fence = geofence_of(run.scenario)
        self._surroundings = surroundings(run.scenario, fence)
        limits = {drone.name: drone.limits for drone in run.scenario.drones}
        gravity_m_s2, gate_s = run.scenario.environment.gravity_m_s2, run.info.gate_ns / 1e9
        courses = {
            drone.name: Course(limits_of(drone, gravity_m_s2), drone.reference or Piloted())
            for drone in run.scenario.drones
        }
        self.control = ManualFlight(client, name, limits, courses, fence, gate_s, self._sight, self._run_sight)
        self.returns = ReturnFlights(run.scenario, client, self.control, self._sight, lambda: views.clusters, note)

    def plan(self, client_id: int | None, whole: bool) -> dict[str, Any]:
        """Return the plan view as plain data; `whole`: including what does not change, and the past trails."""
        drones, chosen = self._scene.drones, self.pages.chosen(client_id)
        if drones is None:
            return {"t_s": None, "chosen": chosen}
        states = {each.name: each.state for each in self._views.drones.drones} if self._views.drones else {}
        previews = list(self._scene.previews.values())
        shown = {
            "t_s": drones.t_ns / 1e9,
            "chosen": chosen,
            "drones": positions(drones, states),
            "formations": formations(self._run.spaces, self._members, dict(self._views.clusters)),
            "previews": [np.round(way[:, :, :2], DIGITS).tolist() for way in previews],
            "trail_s": self._scene.trails.length_s,
            "trails_number": self._scene.trails.number,
        }
        if not whole:
            return shown
        return {**shown, **self._surroundings, "trails": trail_lines(self._scene.trails, drones)}

    def _sight(self, drone: str) -> DroneSight:
        view = self._views.drones
        seen = next((each for each in view.drones if each.name == drone), None) if view else None
        if seen is None:
            return DroneSight()
        received = self._views.estimates().get(drone)
        pose = None
        if received is not None and received.fresh:
            estimate = received.estimate
            t_s = received.t_ns * 1e-9
            pose = DronePose(estimate.position_m, estimate.yaw_rad, estimate.velocity_m_s, t_s)
        return DroneSight(seen.state, seen.commander, pose)

    def _run_sight(self) -> RunSight:
        clock, run = self._monitor.time_monitor.clock, self._monitor.now()
        silence, off = run.off() if run.silent_s else "", run._replace(silent_s=0.0).grounded()
        stands = clock is not None and clock.state != "running"
        return RunSight(off, clock.rate if clock else 1.0, stands, "" if off else silence)


# The plan view


def surroundings(scenario: Scenario, fence: Geofence) -> dict[str, Any]:
    """Return what does not change: names, labels and colours of drones, the fence, outlines of obstacles."""
    names = [drone.name for drone in scenario.drones]
    return {
        "names": names,
        "labels": names if len(names) <= LARGE_MAX else short_names(names),
        "colours": list(drone_colours(len(names))),
        "fence": {"low_m": fence.low_m, "high_m": fence.high_m},
        "obstacles": [
            {
                "name": each.name,
                "x_m": each.position_m[0],
                "y_m": each.position_m[1],
                "yaw_deg": each.yaw_deg,
                "radius_m": each.radius_m,  # of a disc; None for a box
                "size_m": list(each.size_m[:2]) if each.size_m is not None else None,
            }
            for each in scenario.environment.obstacles
        ],
        "surfaces": [
            {"name": each.name, "outline_m": outline_of(each)} for each in scenario.environment.surfaces or ()
        ],
    }


def positions(drones: DronePoses, states: Mapping[str, str]) -> list[list[Any] | None]:
    """Return x, y, z [m; W], heading [rad] and state of each drone; None for one that is not in the view."""
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
    """Return phase, indices of drones, and desired places [m; W] of each formation."""
    shown = []
    for name, view in views.items():
        desired = ghosts(spaces[name], view)
        places = [] if desired is None else np.round(desired[0][:, :2], DIGITS).tolist()
        shown.append({"name": name, "phase": view.phase, "drones": members[name], "places": places})
    return shown


def trail_lines(trails: CanvasTrails, drones: DronePoses) -> list[list[list[float]]]:
    """Return the trail of each drone: x and y [m; W], and time [s]."""
    segments, owners, times = trails.segments(drones.t_ns / 1e9, drones.p_W)
    points = np.round(np.column_stack((segments[:, 0, :2], times)), DIGITS)
    return [points[owners == i].tolist() for i in range(len(drones.names))]


# Returns


class ReturningDrone(NamedTuple):
    """Identifies a returning drone to ManualFlight, as a page does."""

    drone: str


@dataclass
class _ReturningFormation:
    requests: int  # number of requests to it up to its return
    nearest_m: float = math.inf  # least distance so far of its goal from the middle


class ReturnFlights:
    """Returns of the drones and formations of a run; thread-safe. `control` flies drones to places."""

    def __init__(
        self,
        scenario: Scenario,
        client: CommandClient,
        control: ManualFlight,
        sight_of: Callable[[str], DroneSight],
        clusters: Callable[[], Mapping[str, ViewCluster]],
        note: Callable[[str, str], None] = lambda subject, why: None,
    ) -> None:
        self._client = client
        self._control = control
        self._sight_of = sight_of
        self._clusters = clusters
        self._note = note
        self._lock = threading.Lock()
        self.starts: dict[str, Place] = {each.name: each.position_m[:2] for each in scenario.drones}
        self.middles: dict[str, Place] = {}
        for cluster in scenario.clusters:
            x_m, y_m = np.mean([self.starts[name] for name in cluster.drones], axis=0).tolist()
            self.middles[cluster.name] = (round(x_m, 2), round(y_m, 2))
        self._drones: set[str] = set()
        self._formations: dict[str, _ReturningFormation] = {}

    def request_drones(self, drones: Sequence[str]) -> None:
        """Take over each drone, fly it above its start at its present height, and land it."""
        for drone in drones:
            answer = self._control.take(ReturningDrone(drone), drone, over=True)
            if answer.state == "none":
                self._note(drone, answer.text)
                continue
            with self._lock:
                self._drones.add(drone)

    def request_formation(self, cluster: str) -> None:
        """Move a formation above the middle of its starts in its present shape, and land it."""
        values = dict(zip(MIDDLE, self.middles[cluster], strict=True))
        self._client.request_cluster(cluster, "target", values=values)
        with self._lock:
            self._formations[cluster] = _ReturningFormation(self._client.cluster_requests[cluster])

    def refused(self, cluster: str) -> None:
        """Record that a request to a formation was refused: its return is over."""
        with self._lock:
            self._formations.pop(cluster, None)

    def tick(self) -> None:
        """Continue all returns; to be called several times a second."""
        with self._lock:
            drones, formations = list(self._drones), list(self._formations.items())
        for drone in drones:
            if not self._continue_drone(drone):
                with self._lock:
                    self._drones.discard(drone)
        for name, returning in formations:
            if not self._continue_formation(name, returning):
                with self._lock:
                    self._formations.pop(name, None)

    def _continue_drone(self, drone: str) -> bool:
        """Send a drone on its way, or land it at the end; return whether it is still returning."""
        key, pose = ReturningDrone(drone), self._sight_of(drone).pose
        answer = self._control.steer(key, None)  # like a page that is still open
        if answer.state == "none":
            self._note(drone, f"return of {drone} is over: {answer.text or 'it was released'}")
            return False
        if answer.state == "taking" or pose is None:
            return True
        x_m, y_m = self.starts[drone]
        if math.hypot(pose.p_W[0] - x_m, pose.p_W[1] - y_m) <= ABOVE_START_M:
            self._control.leave(key)
            self._client.send_mode([drone], "land")
            return False
        if not self._control.is_on_way(key):
            self._control.go(key, x_m, y_m)
        return True

    def _continue_formation(self, name: str, returning: _ReturningFormation) -> bool:
        """Land a formation that has arrived above its starts; return whether it is still returning."""
        view = self._clusters().get(name)
        if self._client.cluster_requests[name] != returning.requests or view is None:
            return False  # another request was made
        if view.phase != "engaged":
            self._note(name, f"return of {name} is over: it is {view.phase}")
            return False
        desired, value = (dict(zip(view.names, c, strict=True)) for c in (view.desired, view.value))
        goal_m, away_m = (math.dist([c[each] for each in MIDDLE], self.middles[name]) for c in (desired, value))
        returning.nearest_m = min(returning.nearest_m, goal_m)
        if goal_m > returning.nearest_m + OVERRULED_M:
            self._note(name, f"return of {name} is over: it was sent elsewhere")
            return False
        if max(goal_m, away_m) > OVER_STARTS_M:
            return True
        self._client.request_cluster(name, "land")
        return False
