"""The messages of a run: the newest views, kept undecoded until the next update, and the log of its events."""

import math
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import msgspec
from msgspec import UNSET

from zsim.contract import keys, messages, run_messages
from zsim.contract.flight_messages import EstimateView, LinkState, ViewCluster, ViewDrones, ViewEstimates
from zsim.contract.messages import Info
from zsim.contract.run_messages import INCIDENTS, Event, Fault, Health
from zsim.errors import DecodeError
from zsim.runtime.participant import Participant
from zsim.transport.session import RawSample, Session
from zsim_bridges.console.run_condition import LOSS_NAMES, RETURN_KINDS, DroneCondition, Losses

FRESH_S = 1.0  # simulated or wall; views arrive at 20 Hz (wall); an older one indicates a dead or stuck estimator
FAULTS_KEPT = 8  # number of most recently begun faults that are kept
EVENTS_KEPT = 200  # number of newest single events that are kept
ROWS_KEPT, OWN_ROWS_KEPT = 200, 100  # numbers of rows kept: of distinct events; of the console's own requests
OWN_KINDS = frozenset({"accepted", "done", "control", "refused"})  # kinds of events that answer an operator's request
ALL, OWN = "all", "own actions"
KINDS: dict[str, frozenset[str]] = {
    ALL: frozenset(),
    OWN: frozenset(),
    "refused": frozenset({"refused"}),
    "faults": frozenset({"fault", "fault_end", "fault_clear", "collision", "diverged", *INCIDENTS}),
    "flight": frozenset({"mode", "state", "commander", "release", "collision", "landing", "mission", *INCIDENTS}),
    "processes": frozenset({*LOSS_NAMES, *RETURN_KINDS, "drop"} - {"diverged"}),
}
"""Filters, and the kinds of events that they pass; empty: all kinds."""
_NUMBER = re.compile(r"\d[\d.e+-]*")


class ReceivedEstimate(NamedTuple):
    """A drone's newest estimate, from `process`; fresh if it is within FRESH_S of the drones' view."""

    process: str
    t_ns: int
    estimate: EstimateView
    is_fresh: bool

    @property
    def yaw_sigma_deg(self) -> float:
        return math.degrees(self.estimate.yaw_sigma_rad)

    @property
    def sigma_m(self) -> float:
        """Root of the position variance averaged over the axes; 0 if the average is negative, hence invalid."""
        xx, _, _, yy, _, zz = self.estimate.covariance_m2
        return math.sqrt(max(0.0, xx + yy + zz) / 3)


class ReceivedLink(NamedTuple):
    """The last state of a driver's link to its drone, and its age since reception [s; wall]."""

    state: LinkState
    age_s: float


class ViewBuffer:
    """Keeps the newest message on each key until the next update, so that superseded ones are never decoded.

    Callbacks run in Zenoh's threads.

    Args:
        variables: names of each formation's variables; views of other formations or variables are refused.
        on_refused_command: called with the event of each command from the console that the world refuses.
        on_foreign_request: called with a formation and a description of the request whenever another client makes one
            to it.
    """

    def __init__(
        self,
        link: Session,
        info: Info,
        observer: Participant,
        variables: Mapping[str, tuple[str, ...]],
        on_refused_command: Callable[[Event], None],
        wall_s: Callable[[], float] = time.monotonic,
        on_foreign_request: Callable[[str, str], None] = lambda *_: None,
    ) -> None:
        self._link = link
        self._names = frozenset(drone.name for drone in info.drones)
        self._observer = observer
        self._variables = variables
        self._on_refused_command = on_refused_command
        self._on_foreign_request = on_foreign_request
        self._wall_s = wall_s
        self._received_s: dict[str, float] = {}  # wall times of views and link states, by key
        self._undecoded: dict[str, bytes] = {}
        self._arrived = threading.Condition()
        self._answers: Counter[str] = Counter()
        self.drones: ViewDrones | None = None
        self.clusters: dict[str, ViewCluster] = {}
        self.estimators: dict[str, ViewEstimates] = {}  # by process
        self.healths: dict[str, Health] = {}
        # names of drones whose bodies are external
        self.external = frozenset(drone.name for drone in info.drones if drone.body is not UNSET)
        self.radio: run_messages.RadioLinks | None = None  # which drones hear each other, if the scenario has a radio
        self._links: dict[str, LinkState] = {}
        self.faults: tuple[Fault, ...] = ()  # injected faults, planned and active
        self.log = EventLog(observer.name)
        self.losses = Losses()
        self.failsafes: dict[str, Event] = {}  # by drone: last automatic landing or emergency, until another mode
        self.recent_faults: deque[Fault] = deque(maxlen=FAULTS_KEPT)  # the most recently begun faults
        self.end = ""  # why the run ended, according to its last event; empty while it continues
        self.on_own_event: Callable[[Event], None] = lambda _: None  # called with events that the console causes

    def open(self) -> None:
        """Subscribe, and read the last list of faults."""
        links = map(keys.link, sorted(self.external))
        for expression in ("view/**", keys.FAULTS, keys.RADIO, "process/*/health", *links):
            self._link.declare_subscriber(expression, self._on_publication)
        for cluster in self._variables:
            self._link.declare_subscriber(keys.cluster_request(cluster), self._on_request)
        self._link.declare_subscriber(keys.EVENT, self._on_event)
        samples = self._link.get(keys.FAULTS)
        with self._arrived:
            for sample in samples:
                self._undecoded.setdefault(sample.key, sample.payload)  # a message that arrived meanwhile is newer

    def update(self) -> bool:
        """Decode what was received since the last update; return whether there is a new view of the drones."""
        with self._arrived:
            undecoded, self._undecoded = self._undecoded, {}
        for key, payload in undecoded.items():
            try:
                self._store(key, messages.decode(key, payload))
            except DecodeError:
                self._observer.health.refused += 1
        return keys.VIEW_DRONES in undecoded

    def estimates(self) -> dict[str, ReceivedEstimate]:
        """Return each drone's newest estimate by name, from any estimator; after a rewind, later ones are ignored."""
        now_ns = self.drones.t_ns if self.drones else 0
        newest: dict[str, ReceivedEstimate] = {}
        for process, view in sorted(self.estimators.items(), key=lambda each: each[1].t_ns):
            age_s = self._received_s.get(keys.VIEW_DRONES, 0.0) - self._received_s[keys.estimates_view(process)]
            # Neither view is published at every gate, so the two rarely carry the same time.
            is_fresh = abs(view.t_ns - now_ns) <= FRESH_S * 1e9 or abs(age_s) <= FRESH_S
            if is_fresh or view.t_ns <= now_ns:
                known = (estimate for estimate in view.estimates if estimate.name in self._names)
                newest |= {each.name: ReceivedEstimate(process, view.t_ns, each, is_fresh) for each in known}
        return newest

    def conditions(self) -> dict[str, DroneCondition]:
        estimates, conditions = self.estimates(), {}
        for drone in self.drones.drones if self.drones else ():
            _, x, y, _ = drone.orientation_wxyz
            failsafe, link = self.failsafes.get(drone.name), self.link_of(drone.name)
            received = estimates.get(drone.name)
            fresh_estimate = received if received is not None and received.is_fresh else None
            conditions[drone.name] = DroneCondition(
                drone.name,
                drone.state,
                drone.battery_percent,
                lag_ms=self.lag_ms(received) if received else None,
                sigma_m=fresh_estimate.sigma_m if fresh_estimate else None,
                yaw_sigma_deg=fresh_estimate.yaw_sigma_deg if fresh_estimate else None,
                estimate_lost=received is not None and fresh_estimate is None,
                tilt_deg=math.degrees(math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))),
                failsafe=failsafe.text if failsafe else "",
                commander=drone.commander,
                is_external=drone.name in self.external,
                link_age_s=link.age_s if link else None,
                link_state=link.state.state if link else None,
                link_age_ms=link.state.age_ms if link else None,
                link_loss_percent=link.state.loss_percent if link else None,
            )
        return conditions

    def link_of(self, drone: str) -> ReceivedLink | None:
        key = keys.link(drone)
        return ReceivedLink(self._links[key], self._wall_s() - self._received_s[key]) if key in self._links else None

    def active_faults(self) -> list[Fault]:
        now_ns = self.drones.t_ns if self.drones else 0
        return [f for f in self.faults if f.from_ns <= now_ns and (f.until_ns is None or f.until_ns > now_ns)]

    def lag_ms(self, received: ReceivedEstimate) -> float:
        """Return an estimator's lag [ms]: from its health or, without it or a fresh view, from its view's age."""
        health = self.healths.get(received.process)
        if health is not None and received.is_fresh:
            return health.lag_ns / 1e6
        return max(0, (self.drones.t_ns if self.drones else 0) - received.t_ns) / 1e6

    def answered_commands(self, drone: str) -> int:
        return self._answers[drone]

    def await_answer(self, drone: str, count_before: int, within_s: float) -> None:
        """Wait, for at most `within_s`, until more than `count_before` commands to a drone have been answered."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._answers[drone] > count_before, within_s)

    def _on_publication(self, sample: RawSample) -> None:
        self._observer.health.received += 1
        with self._arrived:
            self._undecoded[sample.key] = sample.payload

    def _store(self, key: str, message: Any) -> None:
        if isinstance(message, ViewDrones):
            self.drones, self._received_s[key] = message, self._wall_s()
        elif isinstance(message, ViewCluster):
            cluster, size = key.rpartition("/")[2], len(message.names)
            if self._variables.get(cluster) == message.names and len(message.value) == len(message.desired) == size:
                self.clusters[cluster] = message
            else:
                self._observer.health.refused += 1  # from a controller of another scenario
        elif isinstance(message, ViewEstimates):
            self._received_s[key] = self._wall_s()
            self.estimators[key.rpartition("/")[2]] = message
        elif isinstance(message, LinkState):
            self._links[key], self._received_s[key] = message, self._wall_s()
        elif isinstance(message, Health):
            self.healths[keys.thing(key)] = message
            self.losses.note_health(keys.thing(key), message)
        elif isinstance(message, run_messages.RadioLinks):
            self.radio = message
        elif isinstance(message, run_messages.Faults):
            self.faults = message.faults

    def _on_request(self, sample: RawSample) -> None:
        """Log a request to a formation by another client, such as another console."""
        try:
            request: run_messages.ClusterRequest = messages.decode(sample.key, sample.payload)
        except DecodeError:
            return
        if request.ok and request.source != self._observer.name:
            cluster = keys.thing(sample.key)
            source = request.source or "an unnamed client"
            text = f"{cluster}: {request.op} by {source} {arguments_text(request.args)}".strip()
            self.log.add(Event(request.t_ns, 0, "accepted", request.source, cluster, text))
            self._on_foreign_request(cluster, text)

    def _on_event(self, sample: RawSample) -> None:
        try:
            event = messages.decode(keys.EVENT, sample.payload)
        except DecodeError:
            return  # not an event of the world
        if event.kind in ("command", "refused"):
            with self._arrived:
                self._answers[commanded_drone(event)] += 1
                self._arrived.notify_all()
        self.losses.note(event)
        if event.kind in ("landing", "emergency"):
            self.failsafes = {**self.failsafes, event.subject: event}
        elif event.kind == "mode" and event.data.get("mode") != "emergency":
            self.failsafes = {name: each for name, each in self.failsafes.items() if name != event.subject}
        elif event.kind == "fault":
            with suppress(msgspec.ValidationError):  # any process may publish an event
                self.recent_faults.append(msgspec.convert(event.data, Fault))
        elif event.kind == "end":
            self.end = event.text
        if event.kind != "command":  # mode changes and refusals have events of their own; setpoints are not logged
            self.log.add(event)
        if event.source == self._observer.name:
            self.on_own_event(event)
            if event.kind == "refused":
                self._on_refused_command(event)


def arguments_text(args: Mapping[str, Any]) -> str:
    """Return the names and values of a request's arguments as text."""
    return ", ".join(f"{name} {_value_text(value)}" for name, value in args.items())


def _value_text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, dict):
        return " ".join(f"{name}={_value_text(item)}" for name, item in value.items())[:120]
    if isinstance(value, list):
        are_numbers = all(isinstance(item, int | float) for item in value)
        return " ".join(map(_value_text, value))[:120] if are_numbers else f"({len(value)})"
    return str(value)[:120]


def commanded_drone(event: Event) -> str:
    """Return the drone that an event about a command concerns; a refusal's subject is the command's key."""
    return keys.thing(event.subject) if event.kind == "refused" and "/" in event.subject else event.subject


class EventRow(NamedTuple):
    """The newest of the events that differ only in the numbers in their texts, and how many there were."""

    event: Event
    times: int
    is_own: bool


class EventLog:
    """Keeps the newest events, with one row for all that differ only in numbers; thread-safe.

    The rows of requests by the console's own process, `name`, are limited in number separately.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._rows: dict[tuple[str, ...], EventRow] = {}
        self.newest: deque[Event] = deque(maxlen=EVENTS_KEPT)  # single events, newest first

    def add(self, event: Event) -> None:
        key = (event.kind, event.source, event.subject, _NUMBER.sub("#", event.text))
        is_own = event.source == self._name and event.kind in OWN_KINDS
        with self._lock:
            self.newest.appendleft(event)
            before = self._rows.pop(key, None)
            self._rows[key] = EventRow(event, before.times + 1 if before else 1, is_own)
            same_origin = [key for key, row in self._rows.items() if row.is_own == is_own]
            if len(same_origin) > (OWN_ROWS_KEPT if is_own else ROWS_KEPT):
                del self._rows[same_origin[0]]

    def rows(self) -> list[EventRow]:
        with self._lock:
            return list(reversed(self._rows.values()))


def chosen_rows(rows: Iterable[EventRow], drone: str = ALL, kind: str = ALL) -> list[EventRow]:
    """Return the rows that concern a drone (`ALL`: any drone or none) and pass a filter of `KINDS`."""
    kinds, name = KINDS[kind], re.compile(rf"(?<![\w-]){re.escape(drone)}(?![\w-])")
    return [
        row
        for row in rows
        if (drone == ALL or name.search(f"{row.event.subject} {row.event.text}"))
        and (row.is_own or kind != OWN)
        and (not kinds or row.event.kind in kinds)
    ]
