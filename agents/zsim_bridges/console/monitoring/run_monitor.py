"""What the page knows of a run beyond the newest views: its condition, figures of flight, alarms, pending requests."""

import math
from typing import Any

from zsim.scenario.scenario import Scenario
from zsim_bridges.console.monitoring import alarms
from zsim_bridges.console.monitoring.alarms import Alarm, AlarmBoard, DroneCondition
from zsim_bridges.console.monitoring.flight_figures import FlightMeter
from zsim_bridges.console.monitoring.page_head import page_head
from zsim_bridges.console.monitoring.pending_requests import PendingRequest, PendingRequests
from zsim_bridges.console.monitoring.run_condition import RunCondition
from zsim_bridges.console.monitoring.time_monitor import TimeMonitor
from zsim_bridges.console.monitoring.view_buffer import ReceivedEstimate, ViewBuffer

ROUNDING_NS = 1_000.0  # of a time that is told in seconds


class RunMonitor:
    """Keeps what the page knows of a run.

    Args:
        views: the newest ones.
        time_monitor: of the run's clock.
        scenario: names the drones and formations.
        replayed: whether a record is played back.
        world: where the run is, in words.

    Attributes:
        condition: of the run, at the last update.
        board: its alarms; `severity_of` a drone is for its colour.
        flight: figures of the drones.
        pending: requests that are not done yet.
        record_s: simulated times of the first and the last gate on record, of a replay.
    """

    def __init__(
        self, views: ViewBuffer, time_monitor: TimeMonitor, scenario: Scenario, replayed: bool, world: str = ""
    ) -> None:
        self._views = views
        self._world = world
        self._time_monitor = time_monitor
        self._name = scenario.name
        in_formation = {name for cluster in scenario.clusters for name in cluster.drones}
        self._single = [drone.name for drone in scenario.drones if drone.name not in in_formation]
        self._replayed = replayed
        self._ended = ""
        self._members = {cluster.name: tuple(cluster.drones) for cluster in scenario.clusters}
        self.condition = RunCondition(replayed=replayed)
        self.board = AlarmBoard()
        self.flight = FlightMeter()
        self.pending = PendingRequests()
        self.record_s: tuple[float, float] | None = None

    def end(self, reason: str) -> None:
        """Note that the run is over."""
        self._ended = self._views.end or reason

    def update(self, wall_s: float) -> list[PendingRequest]:
        """Look at the newest views; return the requests that were done meanwhile."""
        views, clock = self._views, self._time_monitor.clock
        drones = {drone.name: drone.state for drone in views.drones.drones} if views.drones else {}
        phases = {name: (view.phase, view.reason) for name, view in views.clusters.items()}
        state, silent_s = clock.state if clock else None, self._time_monitor.silent_s
        end_s = self.record_s[1] if self.record_s else math.inf
        at_end = clock is not None and state == "paused" and clock.t_ns >= end_s * 1e9 - ROUNDING_NS
        self.condition = RunCondition(
            state, silent_s, self._ended, self._replayed, at_end, drones, phases, self._members
        )
        self.board.update(self._alarms(), wall_s)
        return self.pending.pop_done(views.clusters, drones)

    def head(self, wall_s: float) -> dict[str, Any]:
        """Return the head of the page as plain data; called in another thread than that which draws."""
        t_ns = self._views.drones.t_ns if self._views.drones else 0
        run = self.condition._replace(silent_s=self._time_monitor.silent_s)
        rows, single = self.board.rows(wall_s), self._single
        return page_head(self._name, run, self._time_monitor.clock, t_ns, rows, single, self._world, self.record_s)

    def _alarms(self) -> list[Alarm]:
        views = self._views
        if views.drones is None or self._ended:
            return []
        estimates = views.estimates()
        found = [
            alarm
            for drone in views.drones.drones
            for alarm in alarms.drone_alarms(
                self._drone(drone.name, drone.state, drone.battery_percent, estimates.get(drone.name))
            )
        ]
        found += alarms.formation_alarms(self.condition.phases)
        found += alarms.process_alarms(views.losses)
        return found + alarms.fault_alarms(views.active_faults())

    def _drone(self, name: str, state: str, battery: float, received: ReceivedEstimate | None) -> DroneCondition:
        found = DroneCondition(name, state, battery)
        if received is not None:
            fresh = received.fresh
            lag_ms = self._views.lag_ms(received)
            sigma = received.sigma_m if fresh else None
            found = found._replace(lag_ms=lag_ms, sigma_m=sigma, estimate_lost=not fresh)
        link = self._views.link_of(name)
        if link is None:
            return found
        state_of = link.state
        return found._replace(
            link_state=state_of.state, link_age_ms=state_of.age_ms, link_loss_percent=state_of.loss_percent
        )
