"""Several agents as one: they share a process, its name, its join and its done, and hear each other without a wire.

    Group([estimators, controller])     sensors in, estimates and commands out

A process costs more than the agents in it; three estimators and a controller in one are about twice as fast.
"""

from collections.abc import Sequence
from typing import Any

from zsim.contract import batch, keys
from zsim.contract.bundle import Bundle, Selection
from zsim.contract.messages import ControlAnswer, ControlRequest, Faults, Info
from zsim.errors import RunError
from zsim.runtime.agent import Agent, Output


class Group(Agent):
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
        self._waiting: list[list[tuple[str, Any]]] = [[] for _ in members]
        self._readers: dict[str, list[int]] = {}
        self.takes_bundles = any(member.takes_bundles for member in members)
        self._selections = [Selection(member.reads) for member in members]
        for member in members:
            member.speak_as(self.name)

    def heed(self, info: Info, faults: Faults) -> None:
        for member in self._members:
            member.heed(info, faults)

    def hear(self, t_ns: int, inputs: Sequence[tuple[str, Any]]) -> None:
        for key, message in inputs:  # each member has links of its own
            self.receive(key, message)

    def receive(self, key: str, message: Any) -> None:
        if key == batch.GATE:
            self._receive_bundle(message)
            return
        for place in self._readers_of(key):
            self._waiting[place].append((key, message))

    def _receive_bundle(self, bundle: Bundle) -> None:
        for place, member in enumerate(self._members):
            whole = member.takes_bundles
            self._waiting[place] += [(batch.GATE, bundle)] if whole else self._selections[place].of(bundle)

    def step(self, t_ns: int) -> list[Output]:
        outputs: list[Output] = []
        for place, member in enumerate(self._members):
            member.hear(t_ns, self._take(place))
            said = member.step(t_ns)
            for output in said:
                for reader in self._readers_of(output.key):
                    self._waiting[reader].append(output)
            outputs += said
        return outputs

    def views(self, t_ns: int) -> list[Output]:
        return [output for member in self._members for output in member.views(t_ns)]

    def _take(self, place: int) -> list[tuple[str, Any]]:
        """Return what a member is to receive, in the order in which a runner would hand it over."""
        inputs, self._waiting[place] = self._waiting[place], []
        if len(inputs) > 1:
            inputs.sort(key=_canonical)
        return inputs

    def _readers_of(self, key: str) -> list[int]:
        readers = self._readers.get(key)
        if readers is None:
            readers = self._readers[key] = [
                place
                for place, member in enumerate(self._members)
                if any(keys.matches(expression, key) for expression in member.reads)
            ]
        return readers

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

    def _owner(self, key: str) -> Agent:
        """Return who takes over the last value of a key."""
        return next(member for member in self._members if key in member.warm_start_keys())


def _canonical(entry: tuple[str, Any]) -> tuple[int, str, int]:
    key, message = entry
    return message.t_ns, key, message.seq


def _joined(parts: Any) -> tuple[str, ...]:
    """Return all that is in any of them, once, in order."""
    return tuple(dict.fromkeys(each for part in parts for each in part))


def _check(members: Sequence[Agent]) -> None:
    if not members:
        raise RunError("a group has no members; must have one at least")
    periods = {member.name: member.period_ns for member in members}
    if len(set(periods.values())) > 1:
        told = ", ".join(f"{name} {period_ns}" for name, period_ns in periods.items())
        raise RunError(f"period_ns of a group's members is {told}; must be the same")
