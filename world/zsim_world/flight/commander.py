"""Who flies which drone, and which command takes effect when.

The first source that sends a setpoint to a drone that nobody flies is its commander, until it releases it,
says bye or dies. Commands of one instant are ordered by (priority of the source, source, seq): the last wins.
"""

from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple

PROGRAM = 0  # priority of a program, contract
SEEN_PER_DRONE = 32  # commands remembered to know them again; a rejoin repeats those of two gates


class Due(NamedTuple):
    """A command waiting for its instant."""

    apply_ns: int
    priority: int
    source: str
    seq: int
    drone: int
    kind: str
    message: Any


@dataclass
class Holder:
    """Who holds a drone."""

    source: str
    priority: int


class Commanders:
    """Commands on their way and the holder of each drone.

    Args:
        drones: names in scenario order.
    """

    def __init__(self, drones: list[str]) -> None:
        self._names = drones
        self._holders: list[Holder | None] = [None] * len(drones)
        self._priorities: dict[tuple[int, str], int] = {}
        self._due: dict[int, list[Due]] = {}  # by the instant at which they take effect
        self._seen: dict[tuple[int, str, int, str, int], Any] = {}  # messages by what is quickly compared of them

    def holder(self, drone: int) -> str | None:
        """Return the name of the commander."""
        holder = self._holders[drone]
        return holder.source if holder else None

    def holders(self) -> list[str | None]:
        """Return the name of each drone's commander."""
        return [holder.source if holder else None for holder in self._holders]

    def push(self, drone: int, kind: str, message: Any, apply_ns: int) -> bool:
        """Keep a command until its instant; return False for one that has come before."""
        mark = (drone, kind, apply_ns, message.source, message.seq)
        if self._seen.get(mark) == message:
            return False
        self._seen[mark] = message
        if len(self._seen) > SEEN_PER_DRONE * len(self._names):
            del self._seen[next(iter(self._seen))]
        priority = self._priorities.get((drone, message.source), PROGRAM)
        due = Due(apply_ns, priority, message.source, message.seq, drone, kind, message)
        self._due.setdefault(apply_ns, []).append(due)
        return True

    def pop(self, t_ns: int) -> list[Due]:
        """Return the commands that take effect up to t_ns, in the order in which they do.

        Drone and kind stand last in the order only to make it independent of arrival.
        """
        instants = sorted([instant for instant in self._due if instant <= t_ns])
        return [due for instant in instants for due in sorted(self._due.pop(instant), key=_order)]

    def refusal(self, due: Due) -> str | None:
        """Return why the source may not command the drone now, None if it may."""
        holder = self._holders[due.drone]
        if holder is None or holder.source == due.source:
            return None
        if due.kind == "mode" and due.priority >= holder.priority:
            return None
        return (
            f"{self._names[due.drone]} is flown by {holder.source!r} (priority {holder.priority}); "
            f"acquire it with a higher priority through world/control"
        )

    def take(self, drone: int, source: str) -> bool:
        """Make the source the commander if nobody is; return whether it is new."""
        if self._holders[drone] is not None:
            return False
        self._holders[drone] = Holder(source, self._priorities.get((drone, source), PROGRAM))
        return True

    def acquire(self, drone: int, source: str, priority: int) -> str | None:
        """Give the drone to the source; return the reason if somebody of no lower priority has it."""
        holder = self._holders[drone]
        if holder is not None and holder.source != source and priority <= holder.priority:
            return f"{self._names[drone]} is flown by {holder.source!r} with priority {holder.priority}"
        self._priorities[drone, source] = priority
        self._holders[drone] = Holder(source, priority)
        return None

    def release(self, drone: int, source: str) -> str | None:
        """Take the drone from its commander; return the reason if the source is not the commander."""
        holder = self._holders[drone]
        if holder is None or holder.source != source:
            who = f"{holder.source!r}" if holder else "nobody"
            return f"{self._names[drone]} is flown by {who}, not by {source!r}"
        self._holders[drone] = None
        self._priorities.pop((drone, source), None)
        # A setpoint still on its way would make the source the commander again.
        self._forget(lambda due: (due.drone, due.source) == (drone, source))
        return None

    def gone(self, source: str) -> list[int]:
        """Take all drones and priorities from a source that left; return which drones it held."""
        held = [i for i, holder in enumerate(self._holders) if holder and holder.source == source]
        for drone in held:
            self._holders[drone] = None
        for drone in range(len(self._names)):
            self._priorities.pop((drone, source), None)
        self._forget(lambda due: due.source == source)
        return held

    def _forget(self, unwanted: Callable[[Due], bool]) -> None:
        """Drop waiting setpoints; a mode that was asked for is still entered."""
        for instant, dues in self._due.items():
            self._due[instant] = [due for due in dues if due.kind == "mode" or not unwanted(due)]


_order = itemgetter(slice(6))  # all of a Due but the message
