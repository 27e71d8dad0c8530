"""The newest views of a run, kept until the next picture is drawn."""

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import msgspec
from msgspec import UNSET

from zsim.contract import keys, messages, run_messages
from zsim.contract.flight_messages import LinkState
from zsim.contract.messages import Info
from zsim.contract.run_messages import Event, Fault, Health
from zsim.contract.views import EstimateView, ViewCluster, ViewDrones, ViewEstimates
from zsim.errors import DecodeError
from zsim.runtime.participant import Participant
from zsim.transport.session import RawSample, Session
from zsim_bridges.console.monitoring.alarms import Losses
from zsim_bridges.console.monitoring.event_log import EventLog

FRESH_S = 1.0  # simulated, and wall; views come 20 times a wall second: of an older one the estimator is dead, or stuck

FAULTS_KEPT = 8  # that have begun


class ReceivedEstimate(NamedTuple):
    """A drone's estimate, as last received.

    Attributes:
        process: the estimator.
        t_ns: simulated.
        fresh: whether it is of the same time as the drones' view.
    """

    process: str
    t_ns: int
    estimate: EstimateView
    fresh: bool

    @property
    def yaw_sigma_deg(self) -> float:
        return math.degrees(self.estimate.yaw_sigma_rad)

    @property
    def sigma_m(self) -> float:
        """Root of the mean variance of the position over its axes; 0 where that is negative, so none."""
        xx, _, _, yy, _, zz = self.estimate.covariance_m2
        return math.sqrt(max(0.0, xx + yy + zz) / 3)


class ReceivedLink(NamedTuple):
    """The state of a driver's link to its drone, as last received, and how long ago that is [s; wall]."""

    state: LinkState
    age_s: float


class ViewBuffer:
    """Keeps the newest message of each key until the next update; those in between are never decoded.

    Args:
        link: an open session.
        info: of the run.
        observer: of the console in it.
        variables: names of each formation's variables; views of other formations or variables are refused.
        refused: called, in a thread of Zenoh's, with the event of a command of the console's that the world refused.
        wall_s: monotonic.
        asked: called, in a thread of Zenoh's, with a formation and what somebody else has asked it for, in words.

    Attributes:
        drones: the newest view of the drones.
        clusters: the newest view of each formation.
        estimators: the newest view of each estimator, by its process.
        healths: the newest of each process.
        external: names of the drones whose bodies are external.
        faults: injected ones, planned and active.
        log: events as they are shown; events: newest first.
        losses: processes and drones that are lost.
        begun: the last injected faults that have begun.
        failsafes: the event of a landing or stop of the rotors of each drone, until it is commanded another mode.
        end: why the run ended, by its last event; empty while it goes on.
        on_own_event: called, in a thread of Zenoh's, with each event that a command of this console has caused.
    """

    def __init__(
        self,
        link: Session,
        info: Info,
        observer: Participant,
        variables: Mapping[str, tuple[str, ...]],
        refused: Callable[[Event], None],
        wall_s: Callable[[], float] = time.monotonic,
        asked: Callable[[str, str], None] = lambda *_: None,
    ) -> None:
        self._link = link
        self._names = frozenset(drone.name for drone in info.drones)
        self._observer = observer
        self._variables = variables
        self._refused = refused
        self._asked = asked
        self._wall_s = wall_s
        self._received_s: dict[str, float] = {}  # wall time by key, of views of drones and estimators
        self._new: dict[str, bytes] = {}
        self._arrived = threading.Condition()
        self._answers: Counter[str] = Counter()
        self.drones: ViewDrones | None = None
        self.clusters: dict[str, ViewCluster] = {}
        self.estimators: dict[str, ViewEstimates] = {}
        self.healths: dict[str, Health] = {}
        self.external = frozenset(drone.name for drone in info.drones if drone.body is not UNSET)
        self._links: dict[str, LinkState] = {}
        self.faults: tuple[Fault, ...] = ()
        self.log = EventLog(observer.name)
        self.events = self.log.newest
        self.losses = Losses()
        self.failsafes: dict[str, Event] = {}
        self.begun: deque[Fault] = deque(maxlen=FAULTS_KEPT)
        self.end = ""
        self.on_own_event: Callable[[Event], None] = lambda _: None

    def open(self) -> None:
        """Subscribe, and read the last values of before."""
        of_drivers = map(keys.link, sorted(self.external))
        for expression in ("view/**", keys.FAULTS, "process/*/health", *of_drivers):
            self._link.declare_subscriber(expression, self._on_publication)
        for cluster in self._variables:
            self._link.declare_subscriber(keys.cluster_request(cluster), self._on_request)
        self._link.declare_subscriber(keys.EVENT, self._on_event)
        samples = self._link.get(keys.FAULTS)
        with self._arrived:
            for sample in samples:
                self._new.setdefault(sample.key, sample.payload)  # what has arrived meanwhile is newer

    def update(self) -> bool:
        """Decode what has come since the last update; return whether there is a new view of the drones."""
        with self._arrived:
            new, self._new = self._new, {}
        for key, payload in new.items():
            try:
                self._store(key, messages.decode(key, payload))
            except DecodeError:
                self._observer.health.refused += 1
        return keys.VIEW_DRONES in new

    def estimates(self) -> dict[str, ReceivedEstimate]:
        """Return the newest estimate of each drone by name: of two estimators, one of them dead, that of the other.

        Estimates of the future are from before a replay went back.
        """
        now_ns = self.drones.t_ns if self.drones else 0
        newest: dict[str, ReceivedEstimate] = {}
        for process, view in sorted(self.estimators.items(), key=lambda each: each[1].t_ns):
            fresh = self._is_fresh(process, view.t_ns - now_ns)
            if fresh or view.t_ns <= now_ns:
                names = (estimate for estimate in view.estimates if estimate.name in self._names)
                newest |= {each.name: ReceivedEstimate(process, view.t_ns, each, fresh) for each in names}
        return newest

    def link_of(self, drone: str) -> ReceivedLink | None:
        """Return the newest state of the link to an external drone, None before the first."""
        key = keys.link(drone)
        return ReceivedLink(self._links[key], self._wall_s() - self._received_s[key]) if key in self._links else None

    def active_faults(self) -> list[Fault]:
        """Return the injected faults that act at the time of the newest view."""
        now_ns = self.drones.t_ns if self.drones else 0
        return [f for f in self.faults if f.from_ns <= now_ns and (f.until_ns is None or f.until_ns > now_ns)]

    def lag_ms(self, received: ReceivedEstimate) -> float:
        """Return how far an estimator is behind: by its health, or by its view where that is old."""
        health = self.healths.get(received.process)
        if health is not None and received.fresh:
            return health.lag_ns / 1e6
        return max(0, (self.drones.t_ns if self.drones else 0) - received.t_ns) / 1e6

    def _is_fresh(self, process: str, ahead_ns: int) -> bool:
        """Return whether an estimator's view is of the time of the drones' view; both skip gates."""
        seen_s = self._received_s.get(keys.VIEW_DRONES, 0.0) - self._received_s[keys.estimates_view(process)]
        return abs(ahead_ns) <= FRESH_S * 1e9 or abs(seen_s) <= FRESH_S

    def answered_commands(self, drone: str) -> int:
        """Return how many commands to a drone the world has accepted or refused."""
        return self._answers[drone]

    def await_answer(self, drone: str, beyond: int, within_s: float) -> None:
        """Wait, but not for ever, until more commands to a drone than that have been answered."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._answers[drone] > beyond, within_s)

    def _on_publication(self, sample: RawSample) -> None:
        self._observer.health.received += 1
        with self._arrived:
            self._new[sample.key] = sample.payload

    def _store(self, key: str, message: Any) -> None:
        if isinstance(message, ViewDrones):
            self.drones, self._received_s[key] = message, self._wall_s()
        elif isinstance(message, ViewCluster):
            self._store_cluster(key.rpartition("/")[2], message)
        elif isinstance(message, ViewEstimates):
            self._received_s[key] = self._wall_s()
            self.estimators[key.rpartition("/")[2]] = message
        elif isinstance(message, LinkState):
            self._links[key], self._received_s[key] = message, self._wall_s()
        elif isinstance(message, Health):
            self.healths[keys.thing(key)] = message
            self.losses.note_health(keys.thing(key), message)
        elif isinstance(message, run_messages.Faults):
            self.faults = message.faults

    def _store_cluster(self, cluster: str, view: ViewCluster) -> None:
        """Store a view, unless it is from a controller of another scenario."""
        if self._variables.get(cluster) == view.names and len(view.value) == len(view.desired) == len(view.names):
            self.clusters[cluster] = view
        else:
            self._observer.health.refused += 1

    def _on_request(self, sample: RawSample) -> None:
        """Note what somebody else has asked a formation for, such as another console."""
        try:
            request: run_messages.ClusterRequest = messages.decode(sample.key, sample.payload)
        except DecodeError:
            return
        if request.ok and request.source != self._observer.name:
            cluster = keys.thing(sample.key)
            text = f"{cluster}: {request.op} by {request.source or 'somebody'} {arguments_text(request.args)}".strip()
            self.log.add(Event(request.t_ns, 0, "accepted", request.source, cluster, text))
            self._asked(cluster, text)

    def _on_event(self, sample: RawSample) -> None:
        try:
            event = messages.decode(keys.EVENT, sample.payload)
        except DecodeError:
            return  # not an event of the world
        if event.kind in ("command", "refused"):
            with self._arrived:
                self._answers[_drone(event)] += 1
                self._arrived.notify_all()
        self.losses.note(event)
        if event.kind in ("landing", "emergency"):
            self.failsafes = {**self.failsafes, event.subject: event}
        elif event.kind == "mode" and event.data.get("mode") != "emergency":
            self.failsafes = {name: each for name, each in self.failsafes.items() if name != event.subject}
        elif event.kind == "fault":
            with suppress(msgspec.ValidationError):  # an event as anybody may publish it
                self.begun.append(msgspec.convert(event.data, Fault))
        elif event.kind == "end":
            self.end = event.text
        if event.kind != "command":  # an event of a mode or of a refusal follows, with more in it
            self.log.add(event)
        if event.source == self._observer.name:
            self.on_own_event(event)
            if event.kind == "refused":
                self._refused(event)


def arguments_text(args: Mapping[str, Any]) -> str:
    """Return the arguments of a request in words."""
    return ", ".join(f"{name} {_value_text(value)}" for name, value in args.items())


def _value_text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, dict):
        return " ".join(f"{name}={_value_text(item)}" for name, item in value.items())[:120]
    if isinstance(value, list):
        of_figures = all(isinstance(item, int | float) for item in value)
        return " ".join(map(_value_text, value))[:120] if of_figures else f"({len(value)})"
    return str(value)[:120]


def _drone(event: Event) -> str:
    """Return the drone that a command was for: of a refused one, the subject is the key."""
    return keys.thing(event.subject) if event.kind == "refused" and "/" in event.subject else event.subject
