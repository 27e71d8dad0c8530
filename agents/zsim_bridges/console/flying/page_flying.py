"""What pages may do with single drones in one run: choose one, see all from above, fly one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from zsim.contract.messages import Info
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_bridges.console.command_client import CommandClient
from zsim_bridges.console.flying import map_view
from zsim_bridges.console.flying.flight_conditions import DroneSight, RunSight
from zsim_bridges.console.flying.flown_velocity import DronePose
from zsim_bridges.console.flying.geofence import geofence_of
from zsim_bridges.console.flying.manual_flight import ManualFlight
from zsim_bridges.console.flying.return_flights import ReturnFlights
from zsim_bridges.console.monitoring.run_monitor import RunMonitor
from zsim_bridges.console.monitoring.time_monitor import TimeMonitor
from zsim_bridges.console.monitoring.view_buffer import ViewBuffer
from zsim_bridges.console.page.page_forms import PageForms
from zsim_bridges.console.scene.run_scene import RunScene


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
        self._surroundings = map_view.surroundings(scenario, fence)
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
            "drones": map_view.positions(drones, states),
            "formations": map_view.formations(self._spaces, self._members, dict(self._views.clusters)),
            "previews": [
                np.round(way[:, :, :2], map_view.DIGITS).tolist() for way in list(self._scene.previews.values())
            ],
            "trail_s": self._scene.trails.length_s,
            "trails_number": self._scene.trails.number,
        }
        if not whole:
            return shown
        return {**shown, **self._surroundings, "trails": map_view.trail_lines(self._scene.trails, drones)}

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
