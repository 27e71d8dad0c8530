"""The inputs of an agent, sorted by gate: what has come, what is missing, what came twice.

Arrival order is never trusted: a gate is complete when each of its closing keys has a message stamped with it
and every counted sensor message is there.
"""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from zsim import keys


class Inbox:
    """Collects messages until the gate that they belong to is complete.

    Args:
        gate_keys: keys of which one message with t_ns == t closes the gate t. For a drone's sensor/status its
            `count` is checked too, when `counted` says that all of that drone's sensors are read.
        counted: drones of which all `sensor/*` keys are read.
    """

    def __init__(self, gate_keys: Sequence[str], counted: Sequence[str] = ()) -> None:
        self._gate_keys = frozenset(gate_keys)
        self._counted = {keys.status(drone): f"drone/{drone}/sensor/" for drone in counted}
        self._waiting: list[tuple[int, str, int, Any]] = []
        self._closed: dict[str, dict[int, int | None]] = {key: {} for key in gate_keys}
        self._seen: defaultdict[str, set[tuple[int, int]]] = defaultdict(set)
        self._taken_ns = -1
        self._ignored: set[str] = set()
        self._partial: set[str] = set(self._counted)
        self.duplicates = 0
        self.late = 0

    def put(self, key: str, message: Any) -> bool:
        """Keep one message; return False for a duplicate or one of a gate that has been taken."""
        mark = (message.t_ns, message.seq)
        if mark in self._seen[key]:
            self.duplicates += 1
            return False
        if message.t_ns <= self._taken_ns:
            self.late += 1
            return False
        self._seen[key].add(mark)
        self._waiting.append((message.t_ns, key, message.seq, message))
        if key in self._gate_keys:
            self._closed[key][message.t_ns] = message.count if key in self._counted else None
        return True

    def next_gate_ns(self) -> int | None:
        """Return the earliest gate for which a closing message has come."""
        gates = [t_ns for closed in self._closed.values() for t_ns in closed if t_ns > self._taken_ns]
        return min(gates, default=None)

    def latest_gate_ns(self) -> int | None:
        """Return the latest gate for which a closing message has come."""
        gates = [t_ns for closed in self._closed.values() for t_ns in closed if t_ns > self._taken_ns]
        return max(gates, default=None)

    def missing(self, t_ns: int) -> str | None:
        """Return a key that the gate still lacks, None when it is complete."""
        for key, closed in self._closed.items():
            if key in self._ignored:
                continue
            if t_ns not in closed:
                return key
            if key in self._counted and key not in self._partial and self._short(key, t_ns):
                return key
        return None

    def lost(self, t_ns: int) -> str | None:
        """Return a missing key whose message will not come any more: its publisher has gone on without it."""
        key = self.missing(t_ns)
        if key is None:
            return None
        closed = self._closed[key]
        return key if t_ns in closed or any(at > t_ns for at in closed) else None

    def _short(self, key: str, t_ns: int) -> bool:
        prefix = self._counted[key]
        have = sum(1 for at, name, _, _ in self._waiting if at <= t_ns and name.startswith(prefix))
        return have < sum(count or 0 for at, count in self._closed[key].items() if at <= t_ns)

    def take(self, t_ns: int) -> list[tuple[str, Any]]:
        """Return all inputs stamped up to t_ns in order of (t_ns, key, seq), and forget them."""
        ready = sorted((entry for entry in self._waiting if entry[0] <= t_ns), key=lambda entry: entry[:3])
        self._waiting = [entry for entry in self._waiting if entry[0] > t_ns]
        self._taken_ns = t_ns
        self._partial.clear()
        for closed in self._closed.values():
            for old in [at for at in closed if at <= t_ns]:
                del closed[old]
        for seen in self._seen.values():
            seen.difference_update([mark for mark in seen if mark[0] <= t_ns])
        return [(key, message) for _, key, _, message in ready]

    def ignore(self, key: str) -> None:
        """Wait for a key no longer: its publisher is dropped from the run."""
        self._ignored.add(key)

    def expect(self, key: str) -> None:
        """Wait for a key again."""
        self._ignored.discard(key)

    def start_after(self, t_ns: int) -> None:
        """Ignore everything up to and including t_ns; the next gate is counted in full."""
        self.take(t_ns)
