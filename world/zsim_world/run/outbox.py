"""The messages and events that a run publishes, in order, and the limits on events, refusals and changes.

Limits apply per simulated time, so that a rerun from a record and a continuation from the journal apply the same ones.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

from zsim.contract import keys, run_messages
from zsim.contract.run_messages import FURTHER_COUNTED
from zsim.contract.snapshot import PART, Saved
from zsim.runtime.rate_limit import SUBJECTS_MAX, RateLimit
from zsim.scenario.roles import WORLD

KeyedMessage = tuple[str, Any]  # key and message; or keys.GATE and GateMessages at a gate
CHANGES_MAX = 1000  # changes of a source at once, as many as there may be faults; then one per gate
UNJOINED = 10  # all sources that have not joined may together do as much as this number of joined sources
STRANGERS_MAX = 100  # newcomers, and reports about unknown processes, at once; then one per simulated second
SECOND_NS = 1_000_000_000
EVENTS_MAX = 20  # refusal events per source, subject and reason; further refusals are only counted
REASONS_MAX = 10  # distinct reasons per source and subject; all further ones count as one
REFUSED_MAX = 1000  # refusal events of all sources at once, since names can be invented; then one per simulated second

_NUMBER = re.compile(r"\d[\d.e+-]*")


class RunOutbox:
    """Messages of the world waiting to be published.

    Args:
        now_ns: returns the newest gate, the stamp of events.

    Attributes:
        pending: keys and messages in order.
        numbers: `seq` of the next message by key.
        refusals, refused_requests: all refused messages, and all refused requests on `world/control`.
        left_out: number of events that exceeded the limit of their kind and were not published.
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
        self.pending = []  # published by the former world

    def put(self, key: str, message: Any) -> None:
        self.pending.append((key, message))

    def next_seq(self, key: str) -> int:
        """Return the sequence number of the next message on a key, and advance it."""
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
        """Add an event that is for information only, within the limit of its kind, subject and source."""
        if self._notices.spend(f"{kind} {subject} {source}"):
            self.event(kind, subject, text, data, source)
        else:
            self.left_out += 1

    def refuse(self, source: str, subject: str, reason: "Refusal | str") -> None:
        """Count a refusal, and add its event within the limits."""
        text = self.refusals.add(source, subject, str(reason))
        if text is not None:
            self.event("refused", subject, text, {"reason": str(reason)}, source)


class Refusal(NamedTuple):
    """Why something is refused, in one line: the field or object at fault, its value or state, what is allowed."""

    where: str
    actual: str
    allowed: str

    def __str__(self) -> str:
        return f"{self.where} is {self.actual}; {self.allowed}"


def too_many(source: str) -> Refusal:
    """Return the refusal of a source that exceeds its budget."""
    where = f"the number of changes of {source}" if source else "the number of changes"
    return Refusal(where, f"above {CHANGES_MAX}", f"must be <= {CHANGES_MAX} at once, then one each gate")


class RefusalLog:
    """Counts refusals, and limits how many become events, per source and in total."""

    SAVED: ClassVar[Saved] = {"count": int, "_counts": dict[tuple[str, str], dict[str, int]], "_total": PART}

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self.count = 0
        self._total = ChangeBudget(now_ns, SECOND_NS, REFUSED_MAX)
        self._counts: dict[tuple[str, str], dict[str, int]] = {}

    def add(self, source: str, subject: str, reason: str) -> str | None:
        """Count a refusal; return the text of its event; None beyond the limits.

        Reasons that differ only in numbers, such as an age, count as one.
        """
        self.count += 1
        if len(self._counts) > SUBJECTS_MAX:
            self._counts.clear()
        by_reason = self._counts.setdefault((source, subject), {})
        pattern = _NUMBER.sub("#", reason)
        if pattern not in by_reason and len(by_reason) >= REASONS_MAX:
            pattern = ""
        former = by_reason.get(pattern, 0)
        by_reason[pattern] = former + 1
        if former >= EVENTS_MAX or not self._total.spend(""):
            return None
        last = FURTHER_COUNTED if former == EVENTS_MAX - 1 else ""
        return f"{subject}: {reason}{last}"


class ChangeBudget(RateLimit):
    """Limits the changes of each source: `burst` at once, then one per period of simulated time."""

    SAVED: ClassVar[Saved] = {"_spent": dict[str, tuple[float, int]]}

    def __init__(self, now_ns: Callable[[], int], period_ns: float, burst: int = CHANGES_MAX) -> None:
        super().__init__(period_ns, burst, now_ns)


class Budgets:
    """The change budgets of a run.

    Attributes:
        changes: budget of each source.
        unjoined: shared budget of the sources that have not joined, by kind of change.
        strangers: budget of reports about unexpected processes, by kind of report.
    """

    SAVED: ClassVar[Saved] = {"changes": PART, "unjoined": PART, "strangers": PART}

    def __init__(self, now_ns: Callable[[], int], gate_ns: int) -> None:
        self.changes = ChangeBudget(now_ns, gate_ns)
        self.unjoined = ChangeBudget(now_ns, gate_ns / UNJOINED, UNJOINED * CHANGES_MAX)
        self.strangers = ChangeBudget(now_ns, SECOND_NS, STRANGERS_MAX)

    def allows(self, source: str, kind: str, has_joined: bool) -> bool:
        """Return whether a source may make one more change."""
        return self.changes.allows(f"{kind}{source}") and (has_joined or self.unjoined.allows(kind))

    def spend(self, source: str, kind: str, has_joined: bool) -> bool:
        """Count a change of a source; return False if its budget is exhausted."""
        if not self.allows(source, kind, has_joined):
            return False
        return self.changes.spend(f"{kind}{source}") and (has_joined or self.unjoined.spend(kind))
