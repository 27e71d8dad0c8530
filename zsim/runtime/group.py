"""Several agents as one: they share a process, its name, its join and its done, and get each other's outputs directly.

    AgentGroup([estimators, controller])     sensors in, estimates and commands out

A process costs more than the agents in it; three estimators and a controller in one are about twice as fast.
"""

from collections.abc import Sequence
from typing import Any

from zsim.contract import keys
from zsim.contract.framing import GateMessages
from zsim.contract.messages import Info, decode, encode
from zsim.contract.run_messages import ControlAnswer, ControlRequest, Faults
from zsim.contract.snapshot import State
from zsim.errors import RunError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.routing import GateRouter, Input, RoutingTable, canonical


class AgentGroup(Agent):
    """Steps its members one after the other at each gate, each with what those before it have just said.

    It goes by the name of its last member, and all that its members publish has that source.

    Args:
        members: whoever reads another's outputs comes after it; all of one period.

    Raises:
        RunError: there are none, or their periods differ.
    """

    def __init__(self, members: Sequence[Agent]) -> None:
        super().__init__()
        _check(members)
        self._members = tuple(members)
        last = members[-1]
        self.name, self.period_ns = last.name, last.period_ns
        served = [name for member in members for name in (member.name, *member.serves)]
        self.serves = tuple(name for name in served if name != self.name)
        self.writes = _joined(member.writes for member in members)
        inner = frozenset(self.writes)
        self.reads = tuple(key for key in _joined(member.reads for member in members) if key not in inner)
        self.gate_keys = tuple(key for key in _joined(member.gate_keys for member in members) if key not in inner)
        self.counted = _joined(member.counted for member in members)
        self.uncounted = _joined(member.uncounted for member in members)
        self.repeats = _joined(member.repeats for member in members)
        self._waiting: list[list[Input]] = [[] for _ in members]
        self._routes = RoutingTable([member.reads for member in members])
        self._whole = [place for place, member in enumerate(members) if member.takes_gates]
        self._gates = GateRouter(RoutingTable([() if member.takes_gates else member.reads for member in members]))
        self.takes_gates = True  # and takes them apart for those of its members who do not
        for member in members:
            member.share_process(self.name)

    def update_faults(self, info: Info, faults: Faults) -> None:
        for member in self._members:  # each has links of its own
            member.update_faults(info, faults)

    def receive(self, key: str, message: Any) -> None:
        for place in self._routes.readers(key):
            self._waiting[place].append((key, message))

    def receive_gate(self, gate: GateMessages) -> None:
        for place in self._whole:
            self._waiting[place].append((keys.GATE, gate))
        for readers, key, message in self._gates.split(gate):
            for place in readers:
                self._waiting[place].append((key, message))

    def step(self, t_ns: int) -> list[Output]:
        outputs: list[Output] = []
        for place, member in enumerate(self._members):
            own = member.answer(t_ns, self._take(place)) or ()
            for output in own:
                for reader in self._routes.readers(output.key):
                    self._waiting[reader].append(output)
            outputs += own
        return outputs

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
        return {"members": members, "waiting": waiting}

    def resume(self, info: Info, checkpoint: State) -> None:
        super().resume(info, checkpoint)
        own = checkpoint["own"]
        for member, its_own in zip(self._members, own["members"], strict=True):
            member.resume(info, its_own)
        self._waiting = [[(key, decode(key, payload)) for key, payload in inputs] for inputs in own["waiting"]]

    def repeat(self, key: str, message: Any) -> None:
        next(member for member in self._members if key in member.repeats).repeat(key, message)

    def _owner(self, key: str) -> Agent:
        """Return who takes over the last value of a key."""
        return next(member for member in self._members if key in member.warm_start_keys())


def _joined(parts: Any) -> tuple[str, ...]:
    """Return all that is in any of them, once, in order."""
    return tuple(dict.fromkeys(each for part in parts for each in part))


def _check(members: Sequence[Agent]) -> None:
    if not members:
        raise RunError("a group has no members; must have one at least")
    periods = {member.name: member.period_ns for member in members}
    if len(set(periods.values())) > 1:
        listed = ", ".join(f"{name} {period_ns}" for name, period_ns in periods.items())
        raise RunError(f"period_ns of a group's members is {listed}; must be the same")
