"""What the console hears of a run, kept until the next picture is drawn."""

import threading
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

from zsim import keys, messages
from zsim.errors import DecodeError, ZsimError
from zsim.messages import Clock, EstimateView, Event, Fault, Health, Info, ViewCluster, ViewDrones, ViewEstimates
from zsim.session import Heard, Sample, Session
from zsim_agents.presence import Presence

EVENTS_KEPT = 200
SHOWN_BUT = frozenset({"command"})  # kinds of events that say nothing which the next one does not: a mode, a refusal
CLOCK_WAIT_S = 1.0  # the world answers within milliseconds


class Eyes:
    """Keeps the newest view of everything; a view that nobody draws is never decoded.

    Args:
        link: an open session.
        info: of the run.
        presence: of the console in it; it follows the run's clock.
        variables: names of each formation's variables: of another formation, or with others, no view is taken.

    Attributes:
        drones: the newest view of the drones.
        clusters: the newest view of each formation.
        estimators: the newest view of each estimator, by its process.
        healths: what each process said of itself last.
        clock: the newest that was asked for.
        faults: injected ones, planned and active.
        events: newest first.
    """

    def __init__(self, link: Session, info: Info, presence: Presence, variables: Mapping[str, tuple[str, ...]]) -> None:
        self._link = link
        self._names = frozenset(drone.name for drone in info.drones)
        self._presence = presence
        self._variables = variables
        self._new: dict[str, bytes] = {}
        self._arrived = threading.Condition()
        self._lock = threading.Lock()
        self._answers: Counter[str] = Counter()
        self.drones: ViewDrones | None = None
        self.clusters: dict[str, ViewCluster] = {}
        self.estimators: dict[str, ViewEstimates] = {}
        self.healths: dict[str, Health] = {}
        self.clock: Clock | None = None
        self.faults: tuple[Fault, ...] = ()
        self.events: deque[Event] = deque(maxlen=EVENTS_KEPT)

    def open(self) -> None:
        """Begin to hear, and learn what was said before."""
        for expression in ("view/**", keys.FAULTS, "process/*/health"):
            self._link.hear(expression, self._keep)
        self._link.on_message(keys.EVENT, self._on_event)
        for sample in self._link.get(keys.FAULTS):
            self._new[sample.key] = sample.payload
        self.ask_clock()

    def look(self) -> bool:
        """Take in what has come since the last look; return whether drones have been seen anew."""
        with self._lock:
            new, self._new = self._new, {}
        for key, payload in new.items():
            try:
                self._take(key, messages.decode(key, payload))
            except DecodeError:
                self._presence.health.refused += 1
        return keys.VIEW_DRONES in new

    def estimates(self) -> dict[str, EstimateView]:
        """Return the newest estimate of each drone."""
        views = list(self.estimators.values())
        return {e.name: e for view in views for e in view.estimates if e.name in self._names}

    def ask_clock(self) -> None:
        """Ask how the run's time goes: rarely, since to be told of each gate costs those that make it."""
        try:
            samples = self._link.get(keys.CLOCK, timeout_s=CLOCK_WAIT_S)
        except ZsimError:
            return  # the link is lost, and comes back
        for sample in samples:
            self._presence.heed(sample.payload)
            self.clock = messages.decode(keys.CLOCK, sample.payload)

    def answered(self, drone: str) -> int:
        """Return how many commands to a drone the world has said that it took, or refused."""
        return self._answers[drone]

    def await_answer(self, drone: str, beyond: int, within_s: float) -> None:
        """Wait, but not for ever, until more commands to a drone than that have been answered."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._answers[drone] > beyond, within_s)

    def note(self, event: Event) -> None:
        """Add an event of the console's own."""
        self.events.appendleft(event)

    def _keep(self, heard: Heard) -> None:
        self._presence.health.received += 1
        with self._lock:
            self._new[heard.key] = heard.payload

    def _take(self, key: str, message: Any) -> None:
        if isinstance(message, ViewDrones):
            self.drones = message
        elif isinstance(message, ViewCluster):
            self._take_cluster(key.rpartition("/")[2], message)
        elif isinstance(message, ViewEstimates):
            self.estimators[key.rpartition("/")[2]] = message
        elif isinstance(message, Health):
            self.healths[keys.thing(key)] = message
        elif isinstance(message, messages.Faults):
            self.faults = message.faults

    def _take_cluster(self, cluster: str, view: ViewCluster) -> None:
        """Keep a view, unless a controller of another scenario says it."""
        if self._variables.get(cluster) == view.names and len(view.value) == len(view.desired) == len(view.names):
            self.clusters[cluster] = view
        else:
            self._presence.health.refused += 1

    def _on_event(self, sample: Sample) -> None:
        try:
            event = messages.decode(keys.EVENT, sample.payload)
        except DecodeError:
            return  # somebody else's garbage
        if event.kind in ("command", "refused"):
            with self._arrived:
                self._answers[_drone(event)] += 1
                self._arrived.notify_all()
        if event.kind not in SHOWN_BUT:
            self.events.appendleft(event)


def _drone(event: Event) -> str:
    """Return the drone that a command was for: of a refused one, the subject is the key."""
    return keys.thing(event.subject) if event.kind == "refused" and "/" in event.subject else event.subject
