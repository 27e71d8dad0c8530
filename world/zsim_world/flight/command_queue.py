"""Which command takes effect when, and who is the commander of each drone.

The first source that sends a setpoint to a drone without a commander is its commander, until it releases it,
leaves or dies. Commands of one instant are ordered by (priority of the source, source, seq): the last wins.
"""

from collections.abc import Callable
from operator import itemgetter
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.contract.snapshot import State
from zsim_world.flight.run_outbox import Refusal

PROGRAM = 0  # priority of a program, contract
RECENT_PER_DRONE = 32  # commands remembered to recognise duplicates; a rejoin repeats those of two gates


class QueuedCommand(NamedTuple):
    """A command that takes effect at `apply_ns`."""

    apply_ns: int
    priority: int
    source: str
    seq: int
    drone: int
    kind: str
    message: Any


class Commander(NamedTuple):
    """Who flies a drone."""

    source: str
    priority: int


class CommandQueue:
    """Commands that are to take effect, and the commander of each drone.

    Args:
        drones: names in scenario order.
    """

    def __init__(self, drones: list[str]) -> None:
        self._names = drones
        self._commanders: list[Commander | None] = [None] * len(drones)
        self._priorities: dict[tuple[int, str], int] = {}
        self._queued: dict[int, list[QueuedCommand]] = {}  # by the instant at which they take effect
        self._recent: dict[tuple[int, str, int, str, int], Any] = {}  # messages by those fields that compare quickly

    def commanders(self) -> list[str | None]:
        """Return the name of each drone's commander."""
        return [commander.source if commander else None for commander in self._commanders]

    def snapshot(self) -> State:
        """Return what is queued, and who flies what."""
        queued = [command for each in self._queued.values() for command in each]
        recent = [[*mark, messages.encode(message)] for mark, message in self._recent.items()]
        return {
            "commanders": [commander and list(commander) for commander in self._commanders],
            "priorities": [[*about, priority] for about, priority in self._priorities.items()],
            "queued": [[*command[:-1], messages.encode(command.message)] for command in queued],
            "recent": recent,
        }

    def restore(self, state: State) -> None:
        """Take over what `snapshot` returned."""
        self._commanders = [commander and Commander(*commander) for commander in state["commanders"]]
        self._priorities = {(drone, source): priority for drone, source, priority in state["priorities"]}
        self._queued = {}
        for *fields, payload in state["queued"]:
            command = QueuedCommand(*fields, message=None)
            message = self._decoded(command.drone, command.kind, payload)
            self._queued.setdefault(command.apply_ns, []).append(command._replace(message=message))
        recent = ((tuple(mark), self._decoded(mark[0], mark[1], payload)) for *mark, payload in state["recent"])
        self._recent = dict(recent)

    def _decoded(self, drone: int, kind: str, payload: bytes) -> Any:
        return messages.decode(keys.command(self._names[drone], kind), payload)

    def push(self, drone: int, kind: str, message: Any, apply_ns: int) -> bool:
        """Queue a command for its instant; return False for a duplicate."""
        mark = (drone, kind, apply_ns, message.source, message.seq)
        if self._recent.get(mark) == message:
            return False
        self._recent[mark] = message
        if len(self._recent) > RECENT_PER_DRONE * len(self._names):
            del self._recent[next(iter(self._recent))]
        priority = self._priorities.get((drone, message.source), PROGRAM)
        command = QueuedCommand(apply_ns, priority, message.source, message.seq, drone, kind, message)
        self._queued.setdefault(apply_ns, []).append(command)
        return True

    def pop(self, t_ns: int, wanted: Callable[[int], bool] | None = None) -> list[QueuedCommand]:
        """Return the commands that take effect up to t_ns, in the order in which they do.

        Drone and kind stand last in the order only to make it independent of arrival.

        Args:
            wanted: tells of which drones; None: of all.
        """
        instants = sorted([instant for instant in self._queued if instant <= t_ns])
        due = [command for instant in instants for command in sorted(self._queued.pop(instant), key=_order)]
        if wanted is None:
            return due
        for command in due:
            if not wanted(command.drone):
                self._queued.setdefault(command.apply_ns, []).append(command)
        return [command for command in due if wanted(command.drone)]

    def refusal(self, command: QueuedCommand) -> Refusal | None:
        """Return why the source may not command the drone now, None if it may."""
        commander = self._commanders[command.drone]
        if commander is None or commander.source == command.source:
            return None
        if command.kind == "mode" and command.priority >= commander.priority:
            return None
        state = f"flown by {commander.source!r} (priority {commander.priority})"
        return Refusal(self._names[command.drone], state, "acquire it with a higher priority through world/control")

    def claim(self, drone: int, source: str) -> bool:
        """Make the source the commander if there is none; return whether it is new."""
        if self._commanders[drone] is not None:
            return False
        self._commanders[drone] = Commander(source, self._priorities.get((drone, source), PROGRAM))
        return True

    def acquire(self, drone: int, source: str, priority: int) -> Refusal | None:
        """Make the source the commander; return the refusal if another one has no lower priority."""
        commander = self._commanders[drone]
        if commander is not None and commander.source != source and priority <= commander.priority:
            state = f"flown by {commander.source!r} with priority {commander.priority}"
            return Refusal(self._names[drone], state, "acquire it with a higher priority")
        self._priorities[drone, source] = priority
        self._commanders[drone] = Commander(source, priority)
        return None

    def release(self, drone: int, source: str) -> Refusal | None:
        """Take the drone from its commander; return the refusal if the source is not the commander."""
        commander = self._commanders[drone]
        if commander is None or commander.source != source:
            who = f"{commander.source!r}" if commander else "nobody"
            state = f"flown by {who}, not by {source!r}"
            return Refusal(self._names[drone], state, "only its commander can release it")
        self._commanders[drone] = None
        self._priorities.pop((drone, source), None)
        # A setpoint that is still queued would make the source the commander again.
        self._drop_setpoints(lambda command: (command.drone, command.source) == (drone, source))
        return None

    def remove_source(self, source: str) -> list[int]:
        """Take all drones and priorities from a source that left; return the drones of which it was the commander."""
        drones = [i for i, commander in enumerate(self._commanders) if commander and commander.source == source]
        for drone in drones:
            self._commanders[drone] = None
        for drone in range(len(self._names)):
            self._priorities.pop((drone, source), None)
        self._drop_setpoints(lambda command: command.source == source)
        return drones

    def _drop_setpoints(self, unwanted: Callable[[QueuedCommand], bool]) -> None:
        """Remove queued setpoints; a mode that was requested is still entered."""
        for instant, queued in self._queued.items():
            self._queued[instant] = [each for each in queued if each.kind == "mode" or not unwanted(each)]


_order = itemgetter(slice(6))  # all of a QueuedCommand but the message
