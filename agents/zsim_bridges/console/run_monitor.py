"""What the page knows of a run beyond the newest views: its condition, figures of flight, alarms, pending requests."""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from zsim.contract.views import DroneView, ViewCluster, ViewDrones
from zsim.math import frames
from zsim.scenario.scenario import Scenario
from zsim_bridges.console import alarms
from zsim_bridges.console.alarms import Alarm, AlarmBoard, DroneCondition, FaultWatch
from zsim_bridges.console.orders import PendingRequest, PendingRequests
from zsim_bridges.console.run_condition import Check, RunCondition, page_head, preflight_checks
from zsim_bridges.console.time_monitor import TimeMonitor
from zsim_bridges.console.view_buffer import ReceivedEstimate, ViewBuffer

SPEED_S = 0.2  # simulated, over which a speed is taken: shorter, and it is that of a rounding
BATTERY_S = 20.0  # simulated, over which a battery must have been seen before its time left is shown
BATTERY_POINTS_MAX = 120
BATTERY_SPACING_S = 1.0  # simulated


class FlightFigures(NamedTuple):
    """Figures of one drone; positions and velocities in W, heading from east to north."""

    position_m: tuple[float, float, float]
    speed_m_s: float
    climb_m_s: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float  # 0 to 360
    battery_left_s: float | None  # at the present drain; None while that is not known


class _Track:
    """Where one drone was, and its battery, lately."""

    def __init__(self) -> None:
        self.places: deque[tuple[float, tuple[float, float, float]]] = deque(maxlen=64)
        self.charges: deque[tuple[float, float]] = deque(maxlen=BATTERY_POINTS_MAX)

    def add(self, t_s: float, drone: DroneView) -> None:
        """Add a view of the drone."""
        if not self.places or t_s > self.places[-1][0]:
            self.places.append((t_s, drone.position_m))
        while len(self.places) > 2 and t_s - self.places[1][0] >= SPEED_S:
            self.places.popleft()
        if not self.charges or t_s - self.charges[-1][0] >= BATTERY_SPACING_S:
            self.charges.append((t_s, drone.battery_percent))


class FlightMeter:
    """Keeps the figures of all drones of a run."""

    def __init__(self) -> None:
        self._tracks: dict[str, _Track] = {}
        self._t_s = -math.inf
        self._drones: tuple[DroneView, ...] = ()

    def update(self, view: ViewDrones) -> None:
        """Take over a view; one of an earlier time, as a replay may go, begins anew."""
        t_s = view.t_ns / 1e9
        if t_s < self._t_s:
            self._tracks.clear()
        self._t_s, self._drones = t_s, view.drones
        for drone in self._drones:
            self._tracks.setdefault(drone.name, _Track()).add(t_s, drone)

    @property
    def figures(self) -> dict[str, FlightFigures]:
        """Figures by drone, at the newest view."""
        return {drone.name: self._figures(drone) for drone in self._drones}

    def _figures(self, drone: DroneView) -> FlightFigures:
        track = self._tracks[drone.name]
        vx, vy, vz = _velocity(track)
        roll, pitch, yaw = np.degrees(frames.rpy_from_quaternion(np.array([drone.orientation_wxyz]))[0]).tolist()
        left_s = _battery_left_s(track, self._t_s, drone.battery_percent)
        return FlightFigures(drone.position_m, math.hypot(vx, vy, vz), vz, roll, pitch, yaw % 360.0, left_s)


def _velocity(track: _Track) -> tuple[float, float, float]:
    """Return the mean velocity [m/s; W] over the last SPEED_S, or the last two views."""
    (first_s, first), (last_s, last) = track.places[0], track.places[-1]
    if last_s <= first_s:
        return 0.0, 0.0, 0.0
    vx, vy, vz = ((b - a) / (last_s - first_s) for a, b in zip(first, last, strict=True))
    return vx, vy, vz


def _battery_left_s(track: _Track, t_s: float, percent: float) -> float | None:
    first_s, first = track.charges[0]
    if t_s - first_s < BATTERY_S or first - percent <= 0.0:
        return None
    return percent * (t_s - first_s) / (first - percent)


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
        fault_watch: what faults strike, and what they did.
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
        self.fault_watch = FaultWatch()
        self._t_ns = 0

    def end(self, reason: str) -> None:
        """Note that the run is over."""
        self._ended = self._views.end or reason

    def unflyable(self) -> str:
        """Return why nobody can be flown, as long as this run is shown; empty where somebody can, or may again."""
        return self.condition._replace(silent_s=0.0, ended=self._ended).grounded()

    def update(self, wall_s: float) -> list[PendingRequest]:
        """Look at the newest views; return the requests that were done meanwhile."""
        views, clock = self._views, self._time_monitor.clock
        seen = views.drones.drones if views.drones else ()
        drones = {drone.name: drone.state for drone in seen}
        self._forget_future(views.drones.t_ns if views.drones else 0)
        estimates = views.estimates()
        conditions = {drone.name: self._drone(drone, estimates.get(drone.name)) for drone in seen}
        foreign = self._foreign_commanders(seen)
        phases = {
            name: (view.phase, self._reason(name, view, conditions, foreign.get(name, {})))
            for name, view in views.clusters.items()
        }
        state, silent_s = clock.state if clock else None, self._time_monitor.silent_s
        end_s = self.record_s[1] if self.record_s else math.inf
        at_end = clock is not None and state == "paused" and clock.t_ns >= end_s * 1e9 - ROUNDING_NS
        self.condition = RunCondition(
            state, silent_s, self._ended, self._replayed, at_end, drones, phases, self._members,
            checks=self._checks(conditions, foreign),
        )  # fmt: skip
        states = {name: phase for name, (phase, _) in phases.items()}
        wind_m_s = max((math.hypot(*each) for each in views.drones.wind_m_s), default=0.0) if views.drones else 0.0
        seen_now = conditions, states, views.losses.now, wind_m_s
        self.fault_watch.update(list(views.begun), views.active_faults(), *seen_now)
        self.board.update(self._alarms(conditions, foreign), wall_s)
        return self.pending.pop_done(views.clusters, drones)

    def head(self, wall_s: float) -> dict[str, Any]:
        """Return the head of the page as plain data; called in another thread than that which draws."""
        t_ns = self._views.drones.t_ns if self._views.drones else 0
        run = self.condition._replace(silent_s=self._time_monitor.silent_s)
        rows, single = self.board.rows(wall_s), self._single
        return page_head(self._name, run, self._time_monitor.clock, t_ns, rows, single, self._world, self.record_s)

    def _forget_future(self, t_ns: int) -> None:
        """Forget alarms and losses of later times, where a replay has gone back."""
        if t_ns < self._t_ns:
            self.board.clear()
            self.fault_watch.clear()
            self._views.begun.clear()
            self._views.losses.now, self._views.failsafes = {}, {}
        self._t_ns = t_ns

    def _alarms(self, conditions: Mapping[str, DroneCondition], foreign: Mapping[str, dict[str, str]]) -> list[Alarm]:
        views = self._views
        if views.drones is None or self._ended:
            return []
        found = [alarm for drone in conditions.values() for alarm in alarms.drone_alarms(drone)]
        found += alarms.formation_alarms(self.condition.phases, foreign, dict(views.clusters))
        found += alarms.process_alarms(views.losses.now)
        silent_s = self.condition.silent_s
        found += [Alarm("red", "world", "silent", f"no answer for {silent_s:.0f} s")] if silent_s else []
        return found + alarms.fault_alarms(views.active_faults())

    def _foreign_commanders(self, seen: Iterable[DroneView]) -> dict[str, dict[str, str]]:
        """Return who flies drones of each formation instead of its controller."""
        commanders = {drone.name: drone.commander for drone in seen}
        roles = {name: health.role for name, health in self._views.healths.items()}
        return {
            name: alarms.foreign_commanders(f"controller.{name}", members, commanders, roles)
            for name, members in self._members.items()
        }

    def _reason(
        self, name: str, view: ViewCluster, conditions: Mapping[str, DroneCondition], foreign: dict[str, str]
    ) -> str:
        """Return why a formation is as it is: what its controller says, who else flies its drones, and failsafes."""
        notes = [alarms.foreign_text(foreign)] if foreign and view.phase in alarms.FLOWN_PHASES else []
        members = (conditions[drone] for drone in self._members[name] if drone in conditions)
        notes += [d.failsafe for d in members if d.failsafe and d.state in ("landing", "emergency", "landed")]
        return "; ".join(filter(None, (view.reason, *notes)))

    def _checks(
        self, conditions: Mapping[str, DroneCondition], foreign: Mapping[str, dict[str, str]]
    ) -> dict[str, tuple[Check, ...]]:
        """Return the check of each drone before a take-off."""
        others = {drone: who for each in foreign.values() for drone, who in each.items()}
        return {
            name: preflight_checks(drone, name not in self._single, others.get(name, ""))
            for name, drone in conditions.items()
        }

    def _drone(self, drone: DroneView, received: ReceivedEstimate | None) -> DroneCondition:
        _, x, y, _ = drone.orientation_wxyz
        tilt_deg = math.degrees(math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y)))))
        failsafe = self._views.failsafes.get(drone.name)
        found = DroneCondition(
            drone.name, drone.state, drone.battery_percent, tilt_deg=tilt_deg, commander=drone.commander,
            failsafe=failsafe.text if failsafe else "", is_external=drone.name in self._views.external,
        )  # fmt: skip
        if received is not None:
            fresh = received.fresh
            lag_ms = self._views.lag_ms(received)
            sigma = (received.sigma_m, received.yaw_sigma_deg) if fresh else (None, None)
            found = found._replace(lag_ms=lag_ms, sigma_m=sigma[0], yaw_sigma_deg=sigma[1], estimate_lost=not fresh)
        link = self._views.link_of(drone.name)
        if link is None:
            return found
        state_of = link.state
        return found._replace(
            link_state=state_of.state,
            link_age_ms=state_of.age_ms,
            link_loss_percent=state_of.loss_percent,
            link_age_s=link.age_s,
        )
