"""The state of a run derived from its views: condition, alarms, figures of flight, requests in progress."""

import math
from collections import defaultdict, deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from zsim.contract.flight_messages import DroneView, ViewCluster, ViewDrones
from zsim.math import frames
from zsim.scenario.scenario import Environment
from zsim.scenario.surroundings import Surroundings
from zsim_bridges.console import alarms
from zsim_bridges.console.alarms import AlarmBoard, DroneCondition, FaultWatch
from zsim_bridges.console.orders import PendingRequest, PendingRequests
from zsim_bridges.console.run_condition import RunCondition, ShownRun, page_head, preflight_checks
from zsim_bridges.console.time_monitor import TimeMonitor
from zsim_bridges.console.view_buffer import ViewBuffer

ROUNDING_NS = 1_000.0  # of a time given in seconds
SPEED_S = 0.2  # simulated, over which a speed is averaged; less would show the rounding of positions
BATTERY_S = 20.0  # simulated, for which a battery must have been seen before its remaining time is shown
BATTERY_POINTS_MAX = 120
BATTERY_SPACING_S = 1.0  # simulated


class RunMonitor:
    """Follows the condition of a run; `world` describes where the run is.

    Attributes:
        condition: of the run, at the last update.
        record_s: of a replay, simulated times of the first and the last gate on record.
    """

    def __init__(self, views: ViewBuffer, time_monitor: TimeMonitor, run: ShownRun, world: str = "") -> None:
        self.views = views
        self.time_monitor = time_monitor
        self.run = run
        self._world = world
        self._members, self._single = run.members, run.single
        self._ended = ""
        self._t_ns = 0
        self.condition = RunCondition(replayed=run.is_replay)
        self.board = AlarmBoard()
        self.flight = FlightMeter(run.scenario.environment)
        self.fault_watch = FaultWatch()
        self.pending = PendingRequests()
        self.record_s: tuple[float, float] | None = None

    def end(self, reason: str) -> None:
        self._ended = self.views.end or reason

    def unflyable(self) -> str:
        """Return why nothing can be flown in this run any longer; a silent world does not count."""
        return self.condition._replace(silent_s=0.0, ended=self._ended).grounded()

    def update(self, wall_s: float) -> list[PendingRequest]:
        """Update from the newest views; return the requests completed since the last update."""
        views, clock = self.views, self.time_monitor.clock
        self._forget_future(views.drones.t_ns if views.drones else 0)
        drones = views.conditions()
        commanders = {name: drone.commander for name, drone in drones.items()}
        roles = {name: health.role for name, health in views.healths.items()}
        foreign = {
            name: alarms.foreign_commanders(f"controller.{name}", members, commanders, roles)
            for name, members in self._members.items()
        }
        phases = {
            name: (view.phase, self._reason(name, view, drones, foreign.get(name, {})))
            for name, view in views.clusters.items()
        }
        others = {drone: who for each in foreign.values() for drone, who in each.items()}
        end_s = self.record_s[1] if self.record_s else math.inf
        self.condition = RunCondition(
            clock=clock.state if clock else None,
            silent_s=self.time_monitor.silent_s,
            ended=self._ended,
            replayed=self.run.is_replay,
            at_end=clock is not None and clock.state == "paused" and clock.t_ns >= end_s * 1e9 - ROUNDING_NS,
            drones={name: drone.state for name, drone in drones.items()},
            phases=phases,
            members=self._members,
            checks={
                name: preflight_checks(drone, name not in self._single, others.get(name, ""))
                for name, drone in drones.items()
            },
        )
        active, states = views.active_faults(), {name: phase for name, (phase, _) in phases.items()}
        wind_m_s = max((math.hypot(*each) for each in views.drones.wind_m_s), default=0.0) if views.drones else 0.0
        self.fault_watch.update(list(views.begun), active, drones, states, views.losses.now, wind_m_s)
        found: list[alarms.Alarm] = []
        if views.drones is not None and not self._ended:
            found = [alarm for drone in drones.values() for alarm in alarms.drone_alarms(drone)]
            found += alarms.formation_alarms(phases, foreign, dict(views.clusters))
            found += alarms.run_alarms(views.losses.now, active, self.condition.silent_s)
        self.board.update(found, wall_s)
        return self.pending.pop_done(views.clusters, self.condition.drones)

    def head(self, wall_s: float) -> dict[str, Any]:
        """Return the head of the page as plain data; called from another thread than `update`."""
        t_ns = self.views.drones.t_ns if self.views.drones else 0
        name, clock, rows = self.run.scenario.name, self.time_monitor.clock, self.board.rows(wall_s)
        return page_head(name, self.now(), clock, t_ns, rows, self._single, self._world, self.record_s)

    def now(self) -> RunCondition:
        """Return the condition with the present silence of the world."""
        return self.condition._replace(silent_s=self.time_monitor.silent_s)

    def _forget_future(self, t_ns: int) -> None:
        """Remove alarms and losses of later times, if a replay has gone back."""
        if t_ns < self._t_ns:
            self.board.clear()
            self.fault_watch.clear()
            self.views.begun.clear()
            self.views.losses.now, self.views.failsafes = {}, {}
        self._t_ns = t_ns

    def _reason(
        self, name: str, view: ViewCluster, drones: Mapping[str, DroneCondition], foreign: dict[str, str]
    ) -> str:
        """Return a formation's reason: its controller's, other commanders of its drones, and failsafes."""
        notes = [alarms.foreign_text(foreign)] if foreign and view.phase in alarms.FLOWN_PHASES else []
        members = (drones[drone] for drone in self._members[name] if drone in drones)
        notes += [d.failsafe for d in members if d.failsafe and d.state in ("landing", "emergency", "landed")]
        return "; ".join(filter(None, (view.reason, *notes)))


class FlightFigures(NamedTuple):
    """Figures of one drone; positions and velocities in W, heading from east to north."""

    position_m: tuple[float, float, float]
    speed_m_s: float
    climb_m_s: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float  # 0 to 360
    battery_left_s: float | None  # at the present drain; None while unknown
    obstacle_m: float | None = None  # from its centre to the nearest obstacle or surface; None without any


class FlightMeter:
    """Derives figures of each drone's flight from views of the true states, and from the surroundings."""

    def __init__(self, environment: Environment) -> None:
        self._around = Surroundings(environment)
        # of each drone [m; W] and [%], with their simulated times [s]
        self._places: defaultdict[str, deque[tuple[float, tuple[float, float, float]]]]
        self._charges: defaultdict[str, deque[tuple[float, float]]]
        self._places = defaultdict(lambda: deque(maxlen=64))
        self._charges = defaultdict(lambda: deque(maxlen=BATTERY_POINTS_MAX))
        self._t_s = -math.inf
        self._drones: tuple[DroneView, ...] = ()

    def update(self, view: ViewDrones) -> None:
        """Process a view; an earlier one, as in a replay, restarts the history."""
        t_s = view.t_ns / 1e9
        if t_s < self._t_s:
            self._places.clear()
            self._charges.clear()
        self._t_s, self._drones = t_s, view.drones
        for drone in self._drones:
            places, charges = self._places[drone.name], self._charges[drone.name]
            if not places or t_s > places[-1][0]:
                places.append((t_s, drone.position_m))
            while len(places) > 2 and t_s - places[1][0] >= SPEED_S:
                places.popleft()
            if not charges or t_s - charges[-1][0] >= BATTERY_SPACING_S:
                charges.append((t_s, drone.battery_percent))

    @property
    def figures(self) -> dict[str, FlightFigures]:
        found = {}
        away_m = self._around.distances_m([drone.position_m for drone in self._drones]).tolist()
        for drone, obstacle_m in zip(self._drones, away_m, strict=True):
            (first_s, first), (last_s, last) = self._places[drone.name][0], self._places[drone.name][-1]
            span_s = max(last_s - first_s, 1e-9)  # a single view: at rest
            velocity_m_s = [(b - a) / span_s for a, b in zip(first, last, strict=True)]  # the mean over SPEED_S
            roll, pitch, yaw = np.degrees(frames.rpy_from_quaternion(np.array([drone.orientation_wxyz]))[0]).tolist()
            since_s, charge = self._charges[drone.name][0]
            lasted_s, used = self._t_s - since_s, charge - drone.battery_percent
            found[drone.name] = FlightFigures(
                drone.position_m,
                math.hypot(*velocity_m_s),
                velocity_m_s[2],
                roll,
                pitch,
                yaw % 360.0,
                drone.battery_percent * lasted_s / used if lasted_s >= BATTERY_S and used > 0.0 else None,
                None if self._around.is_empty else obstacle_m,
            )
        return found
