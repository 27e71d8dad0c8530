"""The state of a run, derived from its views and clock: condition, alarms, flight, effects of faults.

`RunMonitor` derives the condition, `TimeMonitor` polls the clock, and `RecordPlayer` plays the record of a replay.
"""

import math
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from zsim.contract import keys, run_messages
from zsim.contract.flight_messages import DroneView, ViewCluster, ViewDrones
from zsim.contract.run_messages import Fault
from zsim.errors import ZsimError
from zsim.math import frames
from zsim.runtime.participant import Participant
from zsim.scenario.scenario import Environment
from zsim.scenario.surroundings import Surroundings
from zsim.transport.session import Session
from zsim_bridges.console import run_condition
from zsim_bridges.console.histories import INTERVAL_S, SPAN_S
from zsim_bridges.console.orders import CommandClient, PastInstant, PendingRequest, PendingRequests
from zsim_bridges.console.run_condition import (
    AlarmBoard,
    DroneCondition,
    RunCondition,
    ShownRun,
    page_head,
    preflight_checks,
    run_refusals,
)
from zsim_bridges.console.view_buffer import ViewBuffer

ROUNDING_NS = 1_000.0  # rounding error of a time given in seconds
SPEED_S = 0.2  # simulated; span over which a speed is averaged: a shorter one would show the rounding of positions
FAULTS_KEPT = 8  # maximum number of past faults that are still shown
SIGMA_GROWN = 1.2  # minimum ratio to the initial sigma that is shown; smaller changes occur without a fault
LAG_GROWN_MS = 40.0  # minimum increase in lag that is shown: two gates
PROCESS_STATES = ("alive", "dead")  # states of a process
RESTART_STATE_COUNT = 3  # number of states of a restarted process: alive, dead, alive
WIND_GROWN_M_S = 0.3  # minimum increase in wind that is shown; design choice: above the rounding of the display
BATTERY_S = 20.0  # simulated; how long a battery must have been observed before its remaining time is shown
BATTERY_POINTS_MAX = 120
BATTERY_SPACING_S = 1.0  # simulated; minimum time between two points of a battery's history
POLL_S = 0.25  # wall; period of polling the clock; sending it at every gate would slow down the world
ANSWER_TIMEOUT_S = 1.0  # wall; the world answers within milliseconds
BEAT_S = 0.1  # wall; period of this process's heartbeat
BEAT_MAX_S = 0.5  # wall; at most this much time counts between two beats: a busy machine delays a thread by less
STALL_S = 2.0  # wall; a longer time without a beat is a stall
SILENT_S = 1.7  # wall; after this long without an answer the world is considered silent: a stop is shown within 2 s
PIECE_S = 10.0  # simulated; span read in one request, which blocks a replay of thirty drones for 0.15 s
INSTANT_DRONES_MAX = 9_000  # maximum number of drone views in a piece; a replay returns fewer than 10 000
READ_BEFORE_S, READ_AFTER_S = (
    SPAN_S,
    SPAN_S / 2.0,
)  # simulated; spans read before and after the shown time, as far as trails and curves reach
KEPT_S = 2.0 * SPAN_S  # simulated; span of the record that is kept on both sides of the shown time


class RunMonitor:
    """Follows the condition of a run; `world` describes where the run is.

    Attributes:
        condition: condition of the run at the last update.
        record_s: simulated times of the first and the last recorded gate of a replay; None for a flight.
    """

    def __init__(self, views: ViewBuffer, time_monitor: "TimeMonitor", run: ShownRun, world: str = "") -> None:
        self.views = views
        self.time_monitor = time_monitor
        self.run = run
        self._world = world
        self._members, self._single_drones = run.members, run.single
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

    def flight_refusal(self) -> str:
        """Return why nothing can be flown in this run any longer; a silent world does not count."""
        return self.condition._replace(silent_s=0.0, ended=self._ended).flight_refusal()

    def update(self, wall_s: float) -> list[PendingRequest]:
        """Update from the newest views; return the requests completed since the last update."""
        views, clock = self.views, self.time_monitor.clock
        self._forget_future(views.drones.t_ns if views.drones else 0)
        drones = views.conditions()
        commanders = {name: drone.commander for name, drone in drones.items()}
        roles = {name: health.role for name, health in views.healths.items()}
        foreign = {
            name: run_condition.foreign_commanders(f"controller.{name}", members, commanders, roles)
            for name, members in self._members.items()
        }
        phases = {
            name: (view.phase, self._reason(name, view, drones, foreign.get(name, {})))
            for name, view in views.clusters.items()
        }
        foreign_by_drone = {drone: commander for each in foreign.values() for drone, commander in each.items()}
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
                name: preflight_checks(drone, name not in self._single_drones, foreign_by_drone.get(name, ""))
                for name, drone in drones.items()
            },
        )
        active, states = views.active_faults(), {name: phase for name, (phase, _) in phases.items()}
        wind_m_s = max((math.hypot(*each) for each in views.drones.wind_m_s), default=0.0) if views.drones else 0.0
        self.fault_watch.update(list(views.recent_faults), active, drones, states, views.losses.current, wind_m_s)
        alarms: list[run_condition.Alarm] = []
        if views.drones is not None and not self._ended:
            alarms = [alarm for drone in drones.values() for alarm in run_condition.drone_alarms(drone)]
            alarms += run_condition.formation_alarms(phases, foreign, dict(views.clusters))
            alarms += run_condition.run_alarms(views.losses.current, active, self.condition.silent_s)
        self.board.update(alarms, wall_s)
        return self.pending.pop_done(views.clusters, self.condition.drones)

    def head(self, wall_s: float) -> dict[str, Any]:
        """Return the head of the page as plain data; called from a thread other than that of `update`."""
        t_ns = self.views.drones.t_ns if self.views.drones else 0
        name, clock, rows = self.run.scenario.name, self.time_monitor.clock, self.board.rows(wall_s)
        return page_head(name, self.now(), clock, t_ns, rows, self._single_drones, self._world, self.record_s)

    def now(self) -> RunCondition:
        """Return the condition with the present silence of the world."""
        return self.condition._replace(silent_s=self.time_monitor.silent_s)

    def _forget_future(self, t_ns: int) -> None:
        """Remove alarms and losses of later times if a replay was rewound."""
        if t_ns < self._t_ns:
            self.board.clear()
            self.fault_watch.clear()
            self.views.recent_faults.clear()
            self.views.losses.current, self.views.failsafes = {}, {}
        self._t_ns = t_ns

    def _reason(
        self, name: str, view: ViewCluster, drones: Mapping[str, DroneCondition], foreign: dict[str, str]
    ) -> str:
        """Return the reason for a formation's phase: that of its controller, other commanders, and failsafes."""
        notes = [run_condition.foreign_text(foreign)] if foreign and view.phase in run_condition.FLOWN_PHASES else []
        members = (drones[drone] for drone in self._members[name] if drone in drones)
        notes += [d.failsafe for d in members if d.failsafe and d.state in ("landing", "emergency", "landed")]
        return "; ".join(filter(None, (view.reason, *notes)))


class FlightMetrics(NamedTuple):
    """Figures of one drone; position and velocity in W, heading counter-clockwise from east."""

    position_m: tuple[float, float, float]
    speed_m_s: float
    climb_m_s: float
    roll_deg: float
    pitch_deg: float
    heading_deg: float  # 0 to 360
    battery_remaining_s: float | None  # time left at the present drain; None while unknown
    obstacle_m: float | None = None  # distance from the drone's centre to the nearest obstacle or surface, if any


class FlightMeter:
    """Derives figures of each drone's flight from views of the true states, and from the surroundings."""

    def __init__(self, environment: Environment) -> None:
        self._surroundings = Surroundings(environment)
        # positions [m; W] and charges [%] of each drone, with their simulated times [s]
        self._positions: defaultdict[str, deque[tuple[float, tuple[float, float, float]]]]
        self._charges: defaultdict[str, deque[tuple[float, float]]]
        self._positions = defaultdict(lambda: deque(maxlen=64))
        self._charges = defaultdict(lambda: deque(maxlen=BATTERY_POINTS_MAX))
        self._t_s = -math.inf
        self._drones: tuple[DroneView, ...] = ()

    def update(self, view: ViewDrones) -> None:
        """Process a view; one that is earlier than the last, as in a replay, restarts the history."""
        t_s = view.t_ns / 1e9
        if t_s < self._t_s:
            self._positions.clear()
            self._charges.clear()
        self._t_s, self._drones = t_s, view.drones
        for drone in self._drones:
            positions, charges = self._positions[drone.name], self._charges[drone.name]
            if not positions or t_s > positions[-1][0]:
                positions.append((t_s, drone.position_m))
            while len(positions) > 2 and t_s - positions[1][0] >= SPEED_S:
                positions.popleft()
            if not charges or t_s - charges[-1][0] >= BATTERY_SPACING_S:
                charges.append((t_s, drone.battery_percent))

    @property
    def metrics(self) -> dict[str, FlightMetrics]:
        metrics = {}
        distances_m = self._surroundings.distances_m([drone.position_m for drone in self._drones]).tolist()
        for drone, obstacle_m in zip(self._drones, distances_m, strict=True):
            (first_s, first), (last_s, last) = self._positions[drone.name][0], self._positions[drone.name][-1]
            span_s = max(last_s - first_s, 1e-9)  # after a single view, the drone appears at rest
            velocity_m_s = [(b - a) / span_s for a, b in zip(first, last, strict=True)]  # the mean over SPEED_S
            roll, pitch, yaw = np.degrees(frames.rpy_from_quaternion(np.array([drone.orientation_wxyz]))[0]).tolist()
            since_s, charge = self._charges[drone.name][0]
            lasted_s, used = self._t_s - since_s, charge - drone.battery_percent
            metrics[drone.name] = FlightMetrics(
                drone.position_m,
                math.hypot(*velocity_m_s),
                velocity_m_s[2],
                roll,
                pitch,
                yaw % 360.0,
                drone.battery_percent * lasted_s / used if lasted_s >= BATTERY_S and used > 0.0 else None,
                None if self._surroundings.is_empty else obstacle_m,
            )
        return metrics


class FaultWatch:
    """Tracks what has changed at the targets of injected faults since the faults began."""

    def __init__(self) -> None:
        self._watched: dict[int, _WatchedFault] = {}

    def clear(self) -> None:
        self._watched.clear()

    def update(
        self,
        recent: Iterable[Fault],
        active: Iterable[Fault],
        drones: Mapping[str, DroneCondition],
        phases: Mapping[str, str],
        lost: Collection[str],
        wind_m_s: float,
    ) -> None:
        """Update from the present condition; `recent` are recent faults, `lost` names dead or silent processes."""
        active_by_id = {fault.id: fault for fault in active}
        known = {fault.id: fault for fault in recent} | active_by_id
        for number in self._watched.keys() - known.keys():
            self._watched[number].is_over = True
        for number, fault in known.items():
            watched = self._watched.setdefault(number, _WatchedFault(fault))
            watched.fault, watched.is_over = active_by_id.get(number, watched.fault), number not in active_by_id
            watched.update(drones, phases, lost, wind_m_s)
        ended = [number for number, each in self._watched.items() if each.is_over]
        for number in ended[:-FAULTS_KEPT]:
            del self._watched[number]

    def lines(self, is_over: bool = False) -> list[str]:
        return [each.line() for each in self._watched.values() if each.is_over == is_over]


@dataclass
class _WatchedFault:
    """A fault, and the quantities that it may change at its target: drones, or processes named after them."""

    fault: Fault
    initial: tuple[float, ...] = ()  # sigma [m], lag [ms] and wind [m/s] at the target when the fault began
    worst: tuple[float, ...] = ()  # the worst of these while the fault is active
    states: dict[str, list[str]] = field(default_factory=dict)  # successive states of drones, formations and processes
    is_over: bool = False

    def update(
        self,
        drones: Mapping[str, DroneCondition],
        phases: Mapping[str, str],
        lost: Collection[str],
        wind_m_s: float,
    ) -> None:
        """Record the worst figures and all states while the fault is active, and a killed process's return later."""
        parts = self.fault.target.split("/")
        names = {part.rpartition(".")[2] for part in parts}
        is_world = not names & (set(drones) | set(phases))
        affected = [drone for name, drone in drones.items() if is_world or name in names]
        sigma_m = max((drone.sigma_m or 0.0 for drone in affected), default=0.0)
        lag_ms = max((drone.lag_ms or 0.0 for drone in affected), default=0.0)
        now = (sigma_m, lag_ms, wind_m_s if self.fault.kind == "gust" else 0.0)
        self.initial = self.initial or now
        if not self.is_over:
            self.worst = tuple(map(max, self.worst or now, now))
        states = {drone.name: drone.state for drone in affected}
        states |= phases if is_world or len(phases) == 1 else {name: phases[name] for name in names & set(phases)}
        states |= {part: PROCESS_STATES[part in lost] for part in parts if "." in part}
        for name, state in states.items():
            history = self.states.setdefault(name, [state])
            is_killed = state in PROCESS_STATES and len(history) < RESTART_STATE_COUNT
            if history[-1] != state and (not self.is_over or is_killed):
                history.append(state)

    def line(self) -> str:
        fault, worst = self.fault, self.worst or self.initial
        until = "" if fault.until_ns is None else f" to {fault.until_ns / 1e9:.1f} s"
        label = " ".join(
            filter(None, (f"#{fault.id} {fault.kind} of {fault.target}", run_condition.parameters_text(fault)))
        )
        effects = []
        if worst[0] > SIGMA_GROWN * self.initial[0] > 0.0:
            effects.append(f"σ {self.initial[0]:.2f} → {worst[0]:.2f} m")
        if worst[1] > self.initial[1] + LAG_GROWN_MS:
            effects.append(f"lag {self.initial[1]:.0f} → {worst[1]:.0f} ms")
        if worst[2] > self.initial[2] + WIND_GROWN_M_S:
            effects.append(f"wind {self.initial[2]:.1f} → {worst[2]:.1f} m/s")
        for name, history in self.states.items():
            if len(history) > 1 or history == ["dead"]:
                effects.append(f"{name} {' → '.join(each.replace('_', ' ') for each in history[-4:])}")
        return f"{label}, {fault.from_ns / 1e9:.1f} s{until}: {', '.join(effects) or 'no effect seen'}"


class Stall(NamedTuple):
    """An interval in which this process itself was stopped or starved."""

    lasted_s: float  # wall
    ended_s: float  # monotonic


class AwakeClock:
    """Wall time while this process runs; of an interval in which it was stopped or starved, at most BEAT_MAX_S counts.

    That a stopped process received nothing does not mean that other processes were silent.
    """

    def __init__(self, wall_s: Callable[[], float]) -> None:
        self._wall_s = wall_s
        self._lock = threading.Lock()
        self._beat_s, self._awake_s = wall_s(), 0.0
        self.stall: Stall | None = None  # the last stall

    def beat(self) -> None:
        """Record that this process runs; to be called every BEAT_S."""
        with self._lock:
            wall_s = self._wall_s()
            gap_s = wall_s - self._beat_s
            self._awake_s += min(gap_s, BEAT_MAX_S)
            self._beat_s = wall_s
            if gap_s >= STALL_S:
                self.stall = Stall(gap_s, wall_s)

    def now_s(self) -> float:
        """Return the time awake so far [s]."""
        with self._lock:
            return self._awake_s + min(self._wall_s() - self._beat_s, BEAT_MAX_S)


class TimeMonitor:
    """Polls the run's clock in a separate thread, so that drawing never waits for an answer.

    It also updates the clock of the console's observer. `stamp_age_s` is the maximum age of a stamp [simulated].
    """

    def __init__(
        self,
        link: Session,
        observer: Participant,
        stamp_age_s: float = math.inf,
        wall_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._observer = observer
        self._stamp_age_s = stamp_age_s
        self._wall_s = wall_s
        self._poll_lock = threading.RLock()
        self._is_polling = False
        self._awake = AwakeClock(wall_s)
        self._answered_s = self._awake.now_s()
        self._clock_read_s = -math.inf
        self.clock: run_messages.Clock | None = None  # the newest answer

    @contextmanager
    def polling(self) -> Iterator[None]:
        """Poll the clock while the context is open."""
        stopped = threading.Event()

        def poll() -> None:
            while not stopped.is_set():
                self.poll()
                stopped.wait(POLL_S)

        def beat() -> None:
            while not stopped.wait(BEAT_S):
                self._awake.beat()

        tasks = {"watch": poll, "heartbeat": beat}
        threads = [threading.Thread(target=act, name=name, daemon=True) for name, act in tasks.items()]
        self._awake.beat()
        self._answered_s, self._is_polling = self._awake.now_s(), True
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            self._is_polling = False
            stopped.set()
            for thread in threads:
                thread.join(ANSWER_TIMEOUT_S)

    def poll(self) -> None:
        """Poll once; threads that call this at the same time take turns."""
        with self._poll_lock:
            start_s = self._wall_s()
            try:
                samples = self._link.get(keys.CLOCK, timeout_s=ANSWER_TIMEOUT_S)
            except ZsimError:
                return  # the link is lost, and will be restored
            for sample in samples:
                clock = self._observer.update_clock(sample.payload)
                if clock is not None:
                    self.clock, self._clock_read_s, self._answered_s = clock, start_s, self._awake.now_s()

    def now_ns(self) -> int:
        """Return simulated time for a stamp; if it may be too old, poll first, for ANSWER_TIMEOUT_S at most."""

        def is_old() -> bool:
            rate = max(1.0, self.clock.rate) if self.clock else 1.0  # the measured rate is 0 at the beginning of a run
            return (self._wall_s() - self._clock_read_s) * rate > self._stamp_age_s

        if is_old():
            with self._poll_lock:
                if is_old():  # unless another thread has polled meanwhile
                    self.poll()
        return self._observer.now_ns

    @property
    def silent_s(self) -> float:
        """Time since the world last answered [s; wall]; 0 below SILENT_S."""
        return self.answer_age_s if self.answer_age_s >= SILENT_S else 0.0

    @property
    def answer_age_s(self) -> float:
        """Time awake since the world's last answer [s; wall]; 0 while the clock is not polled."""
        return self._awake.now_s() - self._answered_s if self._is_polling else 0.0

    @property
    def stall(self) -> Stall | None:
        return self._awake.stall


class RecordPlayer:
    """Controls the time of a replay, and reads its record around the shown time in pieces.

    Args:
        is_replay: whether the run is a replay; otherwise all methods do nothing.

    Attributes:
        timeline: `from_s`, `to_s` [s] and `marks` (t_s, kind, text); empty before `load`.
    """

    def __init__(self, client: CommandClient, time_monitor: TimeMonitor, is_replay: bool, drones: int = 1) -> None:
        self._client = client
        self._time_monitor = time_monitor
        self._is_replay = is_replay
        self.timeline: dict[str, Any] = {}
        self._every_s = max(INTERVAL_S, PIECE_S * drones / INSTANT_DRONES_MAX)
        self._lock = threading.Lock()
        self._shown_s = 0.0
        self._pieces_read: set[int] = set()  # numbers of the pieces that were read
        self._is_reading = False
        self._arrived: deque[list[PastInstant]] = deque()

    def load(self) -> None:
        """Read the timeline; let a paused replay publish its views again for later subscribers."""
        if not self._is_replay:
            return
        self.timeline = self._client.timeline()
        self._time_monitor.poll()
        clock = self._time_monitor.clock
        if clock is not None and clock.state == "paused":
            self.play("seek", clock.t_ns / 1e9)

    def state(self, run: RunCondition) -> dict[str, Any]:
        """Return the timeline, with the reasons why operations of `play` would be refused; empty without a timeline."""
        return {**self.timeline, "refusals": run_refusals(run)} if self.timeline else {}

    def play(self, op: str, value: float) -> None:
        """Seek [s], pause, resume, step [gates] or set the rate."""
        if not self.timeline:
            return
        clock = self._time_monitor.clock
        if op == "seek":
            self._client.seek(value, step=clock is not None and clock.state == "paused")
        else:
            args = {"step": {"gates": int(value)}, "rate": {"value": value}}
            self._client.request_world(op, **args.get(op, {}))

    def fill(self, t_s: float) -> None:
        """Read the missing pieces of the record around `t_s` in another thread, the nearest first."""
        if "to_s" not in self.timeline:
            return
        with self._lock:
            self._shown_s = t_s
            self._pieces_read = {k for k in self._pieces_read if abs(self._middle_s(k) - t_s) < KEPT_S - PIECE_S}
            if self._is_reading or self._next_missing() is None:
                return
            self._is_reading = self._client.read(self._read_missing)

    def pop_instants(self) -> list[PastInstant]:
        """Return the views of the next piece that has been read, each piece once; empty if there is none."""
        return self._arrived.popleft() if self._arrived else []

    def _middle_s(self, piece: int) -> float:
        return self.timeline["from_s"] + (piece + 0.5) * PIECE_S

    def _next_missing(self) -> int | None:
        """Return the unread piece nearest to the shown time, None if there is none."""
        from_s, to_s = self.timeline["from_s"], self.timeline["to_s"]
        first_s, last_s = max(from_s, self._shown_s - READ_BEFORE_S), min(to_s, self._shown_s + READ_AFTER_S)
        pieces = range(math.floor((first_s - from_s) / PIECE_S), math.floor((last_s - from_s) / PIECE_S) + 1)
        unread = [k for k in pieces if k not in self._pieces_read]
        return min(unread, key=lambda k: abs(self._middle_s(k) - self._shown_s), default=None)

    def _read_missing(self) -> None:
        """Read until no piece is missing; a piece that cannot be read is not retried."""
        while True:
            with self._lock:
                piece = self._next_missing()
                if piece is None:
                    self._is_reading = False
                    return
                self._pieces_read.add(piece)
            piece_start_s = self.timeline["from_s"] + piece * PIECE_S
            end_s = min(piece_start_s + PIECE_S - self._every_s / 2.0, self.timeline["to_s"])
            instants = self._client.past_views(piece_start_s, end_s, self._every_s)
            if instants:
                self._arrived.append(instants)
