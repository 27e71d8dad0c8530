"""How much may be done, and published, of what repeats without end.

All of it counts in simulated time, so that a run that is flown again from its record, or goes on from its journal,
allows the same.
"""

from collections.abc import Callable

from zsim.contract.snapshot import State
from zsim.runtime.rate_limit import RateLimit

CHANGES_MAX = 1000  # of a source at once, as many as there may be faults; then 50 a simulated second at gates of 20 ms
UNJOINED = 10  # sources that have not joined may together do what so many may that have: names cost nothing
STRANGERS_MAX = 100  # newcomers of all names, and other news of strangers, at once; then one a simulated second
SECOND_NS = 1_000_000_000


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
        self.changes = RateLimit(gate_ns, CHANGES_MAX, now_ns)
        self.unjoined = RateLimit(gate_ns / UNJOINED, UNJOINED * CHANGES_MAX, now_ns)
        self.strangers = RateLimit(SECOND_NS, STRANGERS_MAX, now_ns)

    def snapshot(self) -> State:
        """Return what was spent."""
        return {name: part.snapshot() for name, part in self._parts().items()}

    def restore(self, state: State) -> None:
        """Take over what `snapshot` returned."""
        for name, part in self._parts().items():
            part.restore(state[name])

    def _parts(self) -> dict[str, RateLimit]:
        return {"changes": self.changes, "unjoined": self.unjoined, "strangers": self.strangers}

    def allows(self, source: str, what: str, has_joined: bool) -> bool:
        """Return whether a source may do something once more."""
        return self.changes.allows(f"{what}{source}") and (has_joined or self.unjoined.allows(what))

    def spend(self, source: str, what: str, has_joined: bool) -> bool:
        """Count what a source does; return False where there was nothing left."""
        if not self.allows(source, what, has_joined):
            return False
        return self.changes.spend(f"{what}{source}") and (has_joined or self.unjoined.spend(what))
