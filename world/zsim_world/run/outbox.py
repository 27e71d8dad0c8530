"""What a run publishes, in order: messages, events and refusals, which are events too; and limits of these.

Limits count in simulated time, so that a run that is flown again from its record, or continues from its journal, allows
the same.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

from zsim.contract import keys, run_messages
from zsim.runtime.rate_limit import SUBJECTS_MAX, RateLimit
from zsim.scenario.roles import WORLD
from zsim_world.run_state import PART, Saved

KeyedMessage = tuple[str, Any]  # key and message; or keys.GATE and GateMessages at a gate
CHANGES_MAX = 1000  # of a source at once, as many as there may be faults; then 50 a simulated second at gates of 20 ms
UNJOINED = 10  # sources that have not joined may together do as much as so many that have: anybody can invent names
STRANGERS_MAX = 100  # newcomers of all names, and other reports about strangers, at once; then one a simulated second
SECOND_NS = 1_000_000_000
EVENTS_MAX = 20  # events per source, subject and reason; further refusals are counted only
REASONS_MAX = 10  # of a source and subject that are kept apart; all further ones count as one
REFUSED_MAX = 1000  # events of all sources at once, whose names can be invented; then one a simulated second

_FIGURE = re.compile(r"\d[\d.e+-]*")


class RunOutbox:
    """Messages of the world that are to be published.

    Args:
        now_ns: returns the newest gate, with which events are stamped.

    Attributes:
        pending: keys and messages in order.
        numbers: the `seq` of the next message on each key.
        refusals, refused_requests: of messages, and of requests on `world/control`; all of them, not only the events.
        left_out: number of events that were not published because there had been enough like them.
    """

    SAVED: ClassVar[Saved] = {
        "numbers": dict[str, int],
        "refusals": PART,
        "refused_requests": PART,
        "_notices": PART,
        "left_out": int,
    }

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self.numbers: dict[str, int] = {}
        self.pending: list[KeyedMessage] = []
        self.refusals = RefusalLog(now_ns)
        self.refused_requests = RefusalLog(now_ns)
        self.left_out = 0
        self._notices = ChangeBudget(now_ns, SECOND_NS)

    def restored(self) -> None:
        self.pending = []  # the former world has published it

    def put(self, key: str, message: Any) -> None:
        self.pending.append((key, message))

    def next_seq(self, key: str) -> int:
        """Return the number of the next message on a key, and count it."""
        seq = self.numbers.get(key, 0)
        self.numbers[key] = seq + 1
        return seq

    def event(
        self, kind: str, subject: str, text: str, data: Mapping[str, Any] | None = None, source: str = WORLD
    ) -> None:
        seq = self.next_seq(keys.EVENT)
        self.put(keys.EVENT, run_messages.Event(self._now_ns(), seq, kind, source, subject, text, dict(data or {})))

    def notice(
        self, kind: str, subject: str, text: str, data: Mapping[str, Any] | None = None, source: str = WORLD
    ) -> None:
        """Add an event on which nobody acts, unless there have been too many of this kind, subject and source."""
        if self._notices.spend(f"{kind} {subject} {source}"):
            self.event(kind, subject, text, data, source)
        else:
            self.left_out += 1

    def refuse(self, source: str, subject: str, reason: "Refusal | str") -> None:
        """Count a refusal, and add an event of it unless there have been too many like it."""
        text = self.refusals.add(source, subject, str(reason))
        if text is not None:
            self.event("refused", subject, text, {"reason": str(reason)}, source)


class Refusal(NamedTuple):
    """Why something is refused, in one line: the field or thing at fault, its value or state, what is allowed."""

    where: str
    actual: str
    allowed: str

    def __str__(self) -> str:
        return f"{self.where} is {self.actual}; {self.allowed}"


def too_many(source: str) -> Refusal:
    """Return the refusal of what a source does too often."""
    return Refusal(source or "source", f"beyond {CHANGES_MAX} changes at once", "must wait: one is allowed each gate")


class RefusalLog:
    """Counts refusals, and limits how many of them become events: of each source, and of all together."""

    SAVED: ClassVar[Saved] = {"count": int, "_counts": dict[tuple[str, str], dict[str, int]], "_total": PART}

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self.count = 0
        self._total = ChangeBudget(now_ns, SECOND_NS, REFUSED_MAX)
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


class ChangeBudget(RateLimit):
    """Limits what each source may change: so much at once, and one more with every period of simulated time."""

    SAVED: ClassVar[Saved] = {"_spent": dict[str, tuple[float, int]]}

    def __init__(self, now_ns: Callable[[], int], period_ns: float, most: int = CHANGES_MAX) -> None:
        super().__init__(period_ns, most, now_ns)


class Budgets:
    """The change budgets of a run.

    Attributes:
        changes: of each source.
        unjoined: of all sources together that have not joined, by what they do.
        strangers: of reports about processes that nobody expects, by kind.
    """

    SAVED: ClassVar[Saved] = {"changes": PART, "unjoined": PART, "strangers": PART}

    def __init__(self, now_ns: Callable[[], int], gate_ns: int) -> None:
        self.changes = ChangeBudget(now_ns, gate_ns)
        self.unjoined = ChangeBudget(now_ns, gate_ns / UNJOINED, UNJOINED * CHANGES_MAX)
        self.strangers = ChangeBudget(now_ns, SECOND_NS, STRANGERS_MAX)

    def allows(self, source: str, what: str, has_joined: bool) -> bool:
        """Return whether a source may do something once more."""
        return self.changes.allows(f"{what}{source}") and (has_joined or self.unjoined.allows(what))

    def spend(self, source: str, what: str, has_joined: bool) -> bool:
        """Count what a source does; return False where there was nothing left."""
        if not self.allows(source, what, has_joined):
            return False
        return self.changes.spend(f"{what}{source}") and (has_joined or self.unjoined.spend(what))
