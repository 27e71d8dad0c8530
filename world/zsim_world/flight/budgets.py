"""How much may be done, and published, of what repeats without end.

All of it counts in simulated time, so that a run that is flown again from its record, or goes on from its journal,
allows the same.
"""

from collections.abc import Callable

from zsim.contract.snapshot import State

CHANGES_MAX = 1000  # of a source at once, as many as there may be faults; then 50 a simulated second at gates of 20 ms
UNJOINED = 10  # sources that have not joined may together do what so many may that have: names cost nothing
STRANGERS_MAX = 100  # newcomers of all names, and other news of strangers, at once; then one a simulated second
SUBJECTS_MAX = 10_000  # sources and subjects
SECOND_NS = 1_000_000_000


class ChangeBudget:
    """Bounds what each source may change: so much at once, and one more with every period.

    Args:
        now_ns: returns the newest gate [ns].
        period_ns: in which one more is allowed [ns].
        most: at once.
    """

    def __init__(self, now_ns: Callable[[], int], period_ns: float, most: int = CHANGES_MAX) -> None:
        self._now_ns = now_ns
        self._period_ns = period_ns
        self._most = most
        self._spent: dict[str, tuple[float, int]] = {}  # changes that count still, and at which gate they did [ns]

    def snapshot(self) -> State:
        """Return what each source has spent."""
        return {"spent": [[source, *spent] for source, spent in self._spent.items()]}

    def restore(self, state: State) -> None:
        """Take over what `snapshot` returned."""
        self._spent = {source: (count, at_ns) for source, count, at_ns in state["spent"]}

    def knows(self, source: str) -> bool:
        """Return whether a source has made a change."""
        return source in self._spent

    def allows(self, source: str) -> bool:
        """Return whether a source may make one more change."""
        return self._counted(source) <= self._most - 1

    def spend(self, source: str) -> bool:
        """Count a change; return False where there was none left."""
        if not self.allows(source):
            return False
        if len(self._spent) > SUBJECTS_MAX:
            self._spent.clear()
        self._spent[source] = self._counted(source) + 1, self._now_ns()
        return True

    def _counted(self, source: str) -> float:
        spent, at_ns = self._spent.get(source, (0.0, 0))
        return max(0.0, spent - (self._now_ns() - at_ns) / self._period_ns)


class Budgets:
    """All of a run.

    Args:
        now_ns: returns the newest gate [ns].
        gate_ns: between two gates [ns].

    Attributes:
        changes: of each source.
        unjoined: the same of all sources together that have not joined, by what they do.
        strangers: news of processes that nobody expects, by kind.
    """

    def __init__(self, now_ns: Callable[[], int], gate_ns: int) -> None:
        self.changes = ChangeBudget(now_ns, gate_ns)
        self.unjoined = ChangeBudget(now_ns, gate_ns / UNJOINED, UNJOINED * CHANGES_MAX)
        self.strangers = ChangeBudget(now_ns, SECOND_NS, STRANGERS_MAX)

    def snapshot(self) -> State:
        """Return what was spent."""
        return {name: part.snapshot() for name, part in self._parts().items()}

    def restore(self, state: State) -> None:
        """Take over what `snapshot` returned."""
        for name, part in self._parts().items():
            part.restore(state[name])

    def _parts(self) -> dict[str, ChangeBudget]:
        return {"changes": self.changes, "unjoined": self.unjoined, "strangers": self.strangers}

    def allows(self, source: str, what: str, has_joined: bool) -> bool:
        """Return whether a source may do something once more."""
        return self.changes.allows(f"{what}{source}") and (has_joined or self.unjoined.allows(what))

    def spend(self, source: str, what: str, has_joined: bool) -> bool:
        """Count what a source does; return False where there was nothing left."""
        if not self.allows(source, what, has_joined):
            return False
        return self.changes.spend(f"{what}{source}") and (has_joined or self.unjoined.spend(what))
