"""What pages may do with single drones in one run: choose one, see all from above, fly one."""

import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zsim.contract.messages import Info
from zsim.contract.views import ViewCluster
from zsim.drone_colours import drone_colours
from zsim.math import frames
from zsim.scenario.scenario import Obstacle, Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.command_client import CommandClient
from zsim_bridges.console.console_page import PageForms
from zsim_bridges.console.histories import CanvasTrails
from zsim_bridges.console.manual_flight import DronePose, DroneSight, Geofence, ManualFlight, RunSight, geofence_of
from zsim_bridges.console.picture import DronePoses, ghosts, short_names
from zsim_bridges.console.run_monitor import RunMonitor
from zsim_bridges.console.scene_nodes import LARGE_MAX, RunScene
from zsim_bridges.console.time_monitor import TimeMonitor
from zsim_bridges.console.view_buffer import ViewBuffer


class PageFlying:
    """Single drones, for the pages of one run.

    Args:
        info: of the run.
        scenario: of the run.
        spaces: of its formations.
        client: sends commands.
        name: of the console's process.
        views: the newest of everything.
        time_monitor: of the run's clock.
        monitor: has the run's condition.
        scene: has the drones' poses and trails.
        pages: have the drone that each has chosen.
        note: called with a drone or formation whose return does not go on, and why.

    Attributes:
        control: of the drones that are flown from pages.
        returns: of the drones and formations that fly back to where they started.
    """

    def __init__(
        self,
        info: Info,
        scenario: Scenario,
        spaces: dict[str, ClusterSpace],
        client: CommandClient,
        name: str,
        views: ViewBuffer,
        time_monitor: TimeMonitor,
        monitor: RunMonitor,
        scene: RunScene,
        pages: PageForms,
        note: Callable[[str, str], None] = lambda subject, why: None,
    ) -> None:
        self._views = views
        self._time_monitor = time_monitor
        self._monitor = monitor
        self._scene = scene
        self._pages = pages
        self._spaces = spaces
        fence = geofence_of(scenario)
        self._surroundings = surroundings(scenario, fence)
        names = self._surroundings["names"]
        self._members = {each.name: [names.index(drone) for drone in each.drones] for each in scenario.clusters}
        limits = {drone.name: drone.limits for drone in scenario.drones}
        self.control = ManualFlight(client, name, limits, fence, info.gate_ns / 1e9, self._sight, self._run_sight)
        self.returns = ReturnFlights(scenario, client, self.control, self._sight, lambda: views.clusters, note)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Send commands meanwhile."""
        with self.control.running():
            yield

    def choose(self, client_id: int | None, drone: str) -> None:
        """Choose a drone on one page."""
        if drone in self._surroundings["names"]:
            self._pages.choose(client_id, drone)

    def take_refusal(self, client_id: int | None, drone: str) -> str:
        """Return why a page may not fly a drone: another one is in control of its formation; empty where it may."""
        return self._pages.use(client_id, drone) if client_id is not None else ""

    def select(self, client_id: int | None, drone: str) -> None:
        """Select a drone on one page for one command with others, or no longer."""
        self._pages.toggle(client_id, drone)

    def plan(self, client_id: int | None, whole: bool) -> dict[str, Any]:
        """Return the view from above; `whole`: with what does not change, and the trails of before."""
        drones = self._scene.drones
        if drones is None:
            return {"t_s": None, "chosen": self._pages.chosen(client_id)}
        states = {each.name: each.state for each in self._views.drones.drones} if self._views.drones else {}
        shown = {
            "t_s": drones.t_ns / 1e9,
            "chosen": self._pages.chosen(client_id),
            "drones": positions(drones, states),
            "formations": formations(self._spaces, self._members, dict(self._views.clusters)),
            "previews": [np.round(way[:, :, :2], DIGITS).tolist() for way in list(self._scene.previews.values())],
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
            pose = DronePose(received.estimate.position_m, received.estimate.yaw_rad)
        return DroneSight(seen.state, seen.commander, pose)

    def _run_sight(self) -> RunSight:
        clock = self._time_monitor.clock
        run = self._monitor.condition._replace(silent_s=self._time_monitor.silent_s)
        silence, off = run.off() if run.silent_s else "", run._replace(silent_s=0.0).grounded()
        stands = clock is not None and clock.state != "running"
        return RunSight(off, clock.rate if clock else 1.0, stands, "" if off else silence)


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


ABOVE_START_M = 0.5  # over the ground, from a start: near enough to land; chosen: as large as a hull
OVER_STARTS_M = 0.5  # of a formation from the middle of its starts
OVERRULED_M = 1.0  # by which its goal moves away from there if somebody else sends it elsewhere
MIDDLE = ("x_c", "y_c")  # variables of a formation that a return leads

Place = tuple[float, float]


class ReturningDrone(NamedTuple):
    """Identifies the flight of a drone that returns, as a page does that of one which it flies."""

    drone: str


@dataclass
class _ReturningFormation:
    """A formation on its way: how many requests it was sent by then, and how near its goal has come to the middle."""

    requests: int
    nearest_m: float = math.inf


class ReturnFlights:
    """Returns of the drones and formations of a run.

    Args:
        scenario: has the starts.
        client: sends requests.
        control: flies drones to places.
        sight_of: returns what is known of a drone.
        clusters: returns the newest view of each formation.
        note: called with a drone or formation, and why its return is over.
    """

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
        """Let each drone fly over its start, at the height that it has, and land; it is taken from whoever flies it."""
        for drone in drones:
            answer = self._control.take(ReturningDrone(drone), drone, over=True)
            if answer.state == "none":
                self._note(drone, answer.text)
                continue
            with self._lock:
                self._drones.add(drone)

    def request_formation(self, cluster: str) -> None:
        """Let a formation move over the middle of its starts, as it stands, and land."""
        values = dict(zip(MIDDLE, self.middles[cluster], strict=True))
        self._client.request_cluster(cluster, "target", values=values)
        with self._lock:
            self._formations[cluster] = _ReturningFormation(self._client.requests_to(cluster))

    def refused(self, cluster: str) -> None:
        """Note that a formation was refused a request: it is not on its way."""
        with self._lock:
            self._formations.pop(cluster, None)

    def tick(self) -> None:
        """Go on with all returns; to be called several times a second."""
        with self._lock:
            drones, formations = list(self._drones), list(self._formations.items())
        for drone in drones:
            if not self._is_returning(drone):
                with self._lock:
                    self._drones.discard(drone)
        for name, returning in formations:
            if not self._leads_on(name, returning):
                with self._lock:
                    self._formations.pop(name, None)

    def _is_returning(self, drone: str) -> bool:
        """Send a drone on its way, or land it at its end; return whether it is on its way."""
        key, pose = ReturningDrone(drone), self._sight_of(drone).pose
        answer = self._control.steer(key, None)  # as a page that is still there
        if answer.state == "none":
            self._note(drone, f"return of {drone} is over: {answer.text or 'it was given back'}")
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

    def _leads_on(self, name: str, returning: _ReturningFormation) -> bool:
        """Land a formation that has come over its starts; return whether it is on its way."""
        view = self._clusters().get(name)
        if self._client.requests_to(name) != returning.requests or view is None:
            return False  # somebody has asked it for something else
        if view.phase != "engaged":
            self._note(name, f"return of {name} is over: it is {view.phase}")
            return False
        goal_m, away_m = (self._away_m(name, view.names, c) for c in (view.desired, view.value))
        returning.nearest_m = min(returning.nearest_m, goal_m)
        if goal_m > returning.nearest_m + OVERRULED_M:
            self._note(name, f"return of {name} is over: it was sent elsewhere")
            return False
        if max(goal_m, away_m) > OVER_STARTS_M:
            return True
        self._client.request_cluster(name, "land")
        return False

    def _away_m(self, name: str, variables: Sequence[str], c: Sequence[float]) -> float:
        """Return how far from the middle of its starts a formation of these variables is, over the ground."""
        value = dict(zip(variables, c, strict=True))
        return math.hypot(*(value[each] - there for each, there in zip(MIDDLE, self.middles[name], strict=True)))
