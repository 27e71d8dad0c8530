"""Several agents as one: they share a process, its name, its join and its done.

    AgentGroup([estimators, controller], output_hold_ns(info))     sensors in, estimates and commands out

A process costs more than the agents in it; three estimators and a controller in one are about twice as fast.
"""

from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter
from typing import Any

from zsim.contract import keys
from zsim.contract.framing import GateMessages
from zsim.contract.messages import Info, decode, encode
from zsim.contract.run_messages import ControlAnswer, ControlRequest, Faults
from zsim.contract.snapshot import State
from zsim.errors import RunError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.inbox import GateRouter, Input, RoutingTable, canonical, is_held


class AgentGroup(Agent):
    """Steps its members at each gate, one after the other.

    A member receives each message at the gate at which a process of its own would: outputs of others on keys that
    close its gate (`writes` of theirs, `gate_keys` of its own) at once, all others as the transport brings them back to
    the group, `hold_ns` after their stamp. It goes by the name of its last member, and all that its members publish has
    that source.

    Args:
        members: in any order, all of one period.
        hold_ns: `output_hold_ns` of the run.

    Raises:
        RunError: there are none, their periods differ, or they wait for each other's outputs.
    """

    def __init__(self, members: Sequence[Agent], hold_ns: int) -> None:
        super().__init__()
        _check(members)
        self._members = _in_order(members)
        self._hold_ns = hold_ns
        last = members[-1]
        self.name, self.period_ns = last.name, last.period_ns
        served = [name for member in members for name in (member.name, *member.serves)]
        self.serves = tuple(name for name in served if name != self.name)
        self.writes = _joined(member.writes for member in members)
        self._inner = inner = frozenset(self.writes)
        self._closing = [frozenset(member.gate_keys) for member in self._members]
        relayed = [inner & closing for closing in self._closing]
        reads = zip(self._members, relayed, strict=True)
        self.reads = _joined([key for key in member.reads if key not in own] for member, own in reads)
        self.gate_keys = tuple(key for key in _joined(member.gate_keys for member in members) if key not in inner)
        self.counted = _joined(member.counted for member in members)
        self.uncounted = _joined(member.uncounted for member in members)
        self.repeats = _joined(member.repeats for member in members)
        self._waiting: list[list[Input]] = [[] for _ in members]
        self._held: list[tuple[int, int, Input]] = []  # until when [ns], and for which member
        self._routes = RoutingTable([member.reads for member in self._members])
        self._places: dict[str, list[tuple[int, int]]] = {}  # of those who receive a key, and after how long [ns]
        self._relays = {key: [i for i, closing in enumerate(self._closing) if key in closing] for key in inner}
        self._whole = [place for place, member in enumerate(self._members) if member.takes_gates]
        of_single = [() if member.takes_gates else member.reads for member in self._members]
        self._gates = GateRouter(RoutingTable(of_single))
        self.takes_gates = True  # and takes them apart for those of its members who do not
        for member in members:
            member.share_process(self.name)

    def update_faults(self, info: Info, faults: Faults) -> None:
        for member in self._members:  # each has links of its own
            member.update_faults(info, faults)

    def receive(self, key: str, message: Any) -> None:
        places = self._places.get(key)
        for place, hold_ns in self._find_places(key) if places is None else places:
            if hold_ns:
                self._held.append((message.t_ns + hold_ns, place, (key, message)))
            else:
                self._waiting[place].append((key, message))

    def _find_places(self, key: str) -> list[tuple[int, int]]:
        """Return who receives a key from the transport, and how long after its stamp.

        A key that closes the gate of one member may be one that another only reads.
        """
        found = []
        for place in self._routes.readers(key):
            closing = self._closing[place]
            if key not in self._inner & closing:  # else it has been relayed
                held = is_held(key, closing, self._members[place].uncounted)
                found.append((place, self._hold_ns if held else 0))
        self._places[key] = found
        return found

    def receive_gate(self, gate: GateMessages) -> None:
        for place in self._whole:
            self._waiting[place].append((keys.GATE, gate))
        for readers, key, message in self._gates.split(gate):
            for place in readers:
                self._waiting[place].append((key, message))

    def step(self, t_ns: int) -> list[Output]:
        if self._held:
            self._release(t_ns)
        outputs: list[Output] = []
        for place, member in enumerate(self._members):
            own = member.answer(t_ns, self._take(place)) or ()
            for output in own:
                for reader in self._relays.get(output.key, ()):
                    self._waiting[reader].append(output)
            outputs += own
        return outputs

    def _release(self, t_ns: int) -> None:
        """Let members have what was held for them until this gate."""
        for until_ns, place, entry in self._held:
            if until_ns <= t_ns:
                self._waiting[place].append(entry)
        self._held = [held for held in self._held if held[0] > t_ns]

    def views(self, t_ns: int) -> list[Output]:
        return [output for member in self._members for output in member.views(t_ns)]

    def _take(self, place: int) -> list[Input]:
        """Return what a member is to receive, in the order in which a runner would hand it over."""
        inputs, self._waiting[place] = self._waiting[place], []
        if len(inputs) > 1:
            inputs.sort(key=canonical)
        return inputs

    def rehearse(self) -> None:
        for member in self._members:
            member.rehearse()

    def control_keys(self) -> tuple[str, ...]:
        return _joined(member.control_keys() for member in self._members)

    def control(self, key: str, request: ControlRequest) -> ControlAnswer:
        return next(m for m in self._members if key in m.control_keys()).control(key, request)

    def warm_start_keys(self) -> tuple[str, ...]:
        return _joined(member.warm_start_keys() for member in self._members)

    def warm_start(self, key: str, message: Any) -> None:
        self._owner(key).warm_start(key, message)

    def resume_seq(self, key: str, last: int) -> None:
        self._owner(key).resume_seq(key, last)

    def snapshot(self) -> State | None:
        members = [member.checkpoint() for member in self._members]
        if None in members:
            return None
        waiting = [[[key, encode(message)] for key, message in inputs] for inputs in self._waiting]
        held = [[until_ns, place, key, encode(message)] for until_ns, place, (key, message) in self._held]
        return {"members": members, "waiting": waiting, "held": held}

    def resume(self, info: Info, checkpoint: State) -> None:
        super().resume(info, checkpoint)
        own = checkpoint["own"]
        for member, its_own in zip(self._members, own["members"], strict=True):
            member.resume(info, its_own)
        self._waiting = [[(key, decode(key, payload)) for key, payload in inputs] for inputs in own["waiting"]]
        self._held = [(until_ns, place, (key, decode(key, payload))) for until_ns, place, key, payload in own["held"]]

    def repeat(self, key: str, message: Any) -> None:
        next(member for member in self._members if key in member.repeats).repeat(key, message)

    def _owner(self, key: str) -> Agent:
        """Return who takes over the last value of a key."""
        return next(member for member in self._members if key in member.warm_start_keys())


def _joined(parts: Any) -> tuple[str, ...]:
    """Return all that is in any of them, once, in order."""
    return tuple(dict.fromkeys(each for part in parts for each in part))


def _in_order(members: Sequence[Agent]) -> tuple[Agent, ...]:
    """Return the members so that each comes after those whose outputs close its gate.

    Raises:
        RunError: some wait for each other.
    """
    writers = {key: place for place, member in enumerate(members) for key in member.writes}
    waits_for = {i: [writers[key] for key in m.gate_keys if writers.get(key, i) != i] for i, m in enumerate(members)}
    try:
        return tuple(members[place] for place in TopologicalSorter(waits_for).static_order())
    except CycleError as error:
        names = ", ".join(members[place].name for place in sorted(set(error.args[1])))
        found = f"gate_keys of a group's members {names} are outputs of each other"
        raise RunError(f"{found}; must not wait for each other: leave one of them to `reads` alone") from None


def _check(members: Sequence[Agent]) -> None:
    if not members:
        raise RunError("a group has no members; must have one at least")
    periods = {member.name: member.period_ns for member in members}
    if len(set(periods.values())) > 1:
        listed = ", ".join(f"{name} {period_ns}" for name, period_ns in periods.items())
        raise RunError(f"period_ns of a group's members is {listed}; must be the same")
