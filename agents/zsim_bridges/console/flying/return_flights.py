"""Return to launch: a drone flies back over its start, a formation over the middle of its starts; there they land.

A drone flies as one that is sent to a place on the map, a formation by its controller. A later request ends a return.
"""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zsim.contract.flight_messages import ViewCluster
from zsim.scenario.scenario import Scenario
from zsim_bridges.console.command_client import CommandClient
from zsim_bridges.console.flying.flight_conditions import DroneSight
from zsim_bridges.console.flying.manual_flight import ManualFlight

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
