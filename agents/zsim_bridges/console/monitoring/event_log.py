"""The events of a run as they are shown: equal ones as one with a count, the operator's own kept apart. Pure."""

import re
import threading
from collections import deque
from collections.abc import Collection, Iterable
from typing import NamedTuple

from zsim.contract.run_messages import Event

EVENTS_KEPT = 200  # the newest, each by itself
ROWS_KEPT, OWN_ROWS_KEPT = 200, 100  # of unequal events; of the console's own requests
OWN_KINDS = frozenset({"accepted", "done", "control", "refused"})  # kinds by which an operator's request is answered
ALL, OWN = "all", "own actions"
INCIDENTS = frozenset({"emergency", "flip", "impact", "touchdown", "battery"})  # of drones
KINDS: dict[str, frozenset[str]] = {
    ALL: frozenset(),
    OWN: frozenset(),
    "refused": frozenset({"refused"}),
    "faults": frozenset({"fault", "fault_end", "fault_clear", "collision", "diverged", *INCIDENTS}),
    "flight": frozenset({"mode", "state", "commander", "release", "collision", "landing", "mission", *INCIDENTS}),
    "processes": frozenset(
        {
            "join",
            "leave",
            "restart",
            "superseded",
            "death",
            "drop",
            "failure",
            "overdue",
            "silent",
            "silent_end",
            "no_show",
        }
    ),
}
"""What may be chosen, and the kinds of events in it; empty: of any kind."""

_FIGURE = re.compile(r"\d[\d.e+-]*")


class EventRow(NamedTuple):
    """The newest of equal events, and how many there were; they are equal but for their figures."""

    event: Event
    times: int
    own: bool


class EventLog:
    """Keeps the newest events, and rows of equal ones.

    Args:
        name: of the console's process, whose own events no others push out.

    Attributes:
        newest: each event by itself, newest first.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._rows: dict[tuple[str, ...], EventRow] = {}
        self.newest: deque[Event] = deque(maxlen=EVENTS_KEPT)

    def add(self, event: Event) -> None:
        """Add an event; may be called in any thread."""
        key = (event.kind, event.source, event.subject, _FIGURE.sub("#", event.text))
        own = event.source == self._name and event.kind in OWN_KINDS
        with self._lock:
            self.newest.appendleft(event)
            before = self._rows.pop(key, None)
            self._rows[key] = EventRow(event, before.times + 1 if before else 1, own)
            self._drop_oldest(own)

    def rows(self) -> list[EventRow]:
        """Return the rows, newest first."""
        with self._lock:
            return list(reversed(self._rows.values()))

    def _drop_oldest(self, own: bool) -> None:
        """Drop the oldest row of the operator's own, or of the others, where there are too many of them."""
        keys = [key for key, row in self._rows.items() if row.own == own]
        if len(keys) > (OWN_ROWS_KEPT if own else ROWS_KEPT):
            del self._rows[keys[0]]


def chosen_rows(rows: Iterable[EventRow], drone: str = ALL, kind: str = ALL) -> list[EventRow]:
    """Return the rows about a drone (or `ALL`), of one of `KINDS`."""
    kinds: Collection[str] = KINDS[kind]
    return [
        row
        for row in rows
        if (drone == ALL or is_about(row.event, drone))
        and (row.own or kind != OWN)
        and (not kinds or row.event.kind in kinds)
    ]


def is_about(event: Event, drone: str) -> bool:
    """Return whether an event names a drone: as its subject, or in its text."""
    return re.search(rf"(?<![\w-]){re.escape(drone)}(?![\w-])", f"{event.subject} {event.text}") is not None
