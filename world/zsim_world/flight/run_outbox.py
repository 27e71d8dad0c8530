"""What a run publishes, in order: messages, events among them, and refusals, which are events too."""

import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from zsim.contract import keys, run_messages
from zsim.contract.snapshot import State
from zsim.runtime.rate_limit import SUBJECTS_MAX, RateLimit
from zsim.scenario.rights import WORLD
from zsim_world.flight.budgets import CHANGES_MAX, SECOND_NS

KeyedMessage = tuple[str, Any]  # key and message; or keys.GATE and GateMessages at a gate
EVENTS_MAX = 20  # events per source, subject and reason; further refusals are counted only
REASONS_MAX = 10  # of a source and subject that are kept apart; all further ones count as one
REFUSED_MAX = 1000  # events of all sources at once, whose names cost nothing; then one a simulated second

_FIGURE = re.compile(r"\d[\d.e+-]*")


class Refusal(NamedTuple):
    """Why something is refused; its text is one line.

    Attributes:
        where: the field or thing at fault.
        actual: its value or state, as text.
        allowed: what is allowed, or what to do.
    """

    where: str
    actual: str
    allowed: str

    def __str__(self) -> str:
        return f"{self.where} is {self.actual}; {self.allowed}"


def too_many(source: str) -> Refusal:
    """Return the refusal of what a source does too often."""
    return Refusal(source or "source", f"beyond {CHANGES_MAX} changes at once", "must wait: one is allowed each gate")


class RefusalLog:
    """Counts refusals, and limits how many of them become events: of each source, and of all together.

    Args:
        now_ns: returns the newest gate [ns].

    Attributes:
        count: of all of them.
    """

    def __init__(self, now_ns: Callable[[], int] = lambda: 0) -> None:
        self.count = 0
        self._total = RateLimit(SECOND_NS, REFUSED_MAX, now_ns)
        self._counts: dict[tuple[str, str], dict[str, int]] = {}

    def add(self, source: str, subject: str, reason: str) -> str | None:
        """Count a refusal; return the text of its event, None where there have been enough.

        Reasons that differ in figures only, such as an age, are one.
        """
        self.count += 1
        if len(self._counts) > SUBJECTS_MAX:
            self._counts.clear()
        by_reason = self._counts.setdefault((source, subject), {})
        pattern = _FIGURE.sub("#", reason)
        if pattern not in by_reason and len(by_reason) >= REASONS_MAX:
            pattern = ""
        former = by_reason.get(pattern, 0)
        by_reason[pattern] = former + 1
        if former >= EVENTS_MAX or not self._total.spend(""):
            return None
        last = " (further ones are counted only)" if former == EVENTS_MAX - 1 else ""
        return f"{subject}: {reason}{last}"

    def snapshot(self) -> State:
        """Return what was counted."""
        counts = [[*about, counts] for about, counts in self._counts.items()]
        return {"count": self.count, "counts": counts, "total": self._total.snapshot()}

    def restore(self, state: State) -> None:
        """Take over what `snapshot` returned."""
        self.count = state["count"]
        self._counts = {(source, subject): counts for source, subject, counts in state["counts"]}
        self._total.restore(state["total"])


class RunOutbox:
    """Messages of the world that are to be published.

    Args:
        now_ns: returns the newest gate, with which events are stamped [ns].

    Attributes:
        pending: keys and messages in order.
        refusals: counted, also those that are no events any more.
        refused_requests: the same of `world/control`.
        left_out: events that were not published since there had been enough like them.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._next_seq: dict[str, int] = {}
        self.pending: list[KeyedMessage] = []
        self.refusals = RefusalLog(now_ns)
        self.refused_requests = RefusalLog(now_ns)
        self.left_out = 0
        self._notices = RateLimit(SECOND_NS, CHANGES_MAX, now_ns)

    def snapshot(self) -> State:
        """Return the numbers of the keys, and what was refused."""
        return {
            "next_seq": self._next_seq,
            "refusals": self.refusals.snapshot(),
            "refused_requests": self.refused_requests.snapshot(),
            "notices": self._notices.snapshot(),
            "left_out": self.left_out,
        }

    def restore(self, state: State) -> None:
        """Take over what `snapshot` returned; what is pending is forgotten."""
        self._next_seq, self.pending = state["next_seq"], []
        self.refusals.restore(state["refusals"])
        self.refused_requests.restore(state["refused_requests"])
        self._notices.restore(state["notices"])
        self.left_out = state["left_out"]

    def put(self, key: str, message: Any) -> None:
        """Add a message."""
        self.pending.append((key, message))

    def take(self) -> list[KeyedMessage]:
        """Remove and return all messages."""
        pending, self.pending = self.pending, []
        return pending

    def next_seq(self, key: str) -> int:
        """Return the number of the next message on a key."""
        seq = self._next_seq.get(key, 0)
        self._next_seq[key] = seq + 1
        return seq

    def event(
        self, kind: str, subject: str, text: str, data: Mapping[str, Any] | None = None, source: str = WORLD
    ) -> None:
        """Add an event."""
        seq = self.next_seq(keys.EVENT)
        self.put(keys.EVENT, run_messages.Event(self._now_ns(), seq, kind, source, subject, text, dict(data or {})))

    def notice(
        self, kind: str, subject: str, text: str, data: Mapping[str, Any] | None = None, source: str = WORLD
    ) -> None:
        """Add an event on which nobody acts, and which may repeat without end, unless there have been enough of it."""
        if self._notices.spend(f"{kind} {subject} {source}"):
            self.event(kind, subject, text, data, source)
        else:
            self.left_out += 1

    def refuse(self, source: str, subject: str, reason: Refusal | str) -> None:
        """Count a refusal, and add an event of it unless there have been too many like it."""
        text = self.refusals.add(source, subject, str(reason))
        if text is not None:
            self.event("refused", subject, text, {"reason": str(reason)}, source)
