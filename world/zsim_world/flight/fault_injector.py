"""The injected faults of a run: planned by the scenario or asked for, begun and ended at their gates, and told."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec

from zsim.contract import keys
from zsim.contract.messages import ControlAnswer, ControlRequest, Fault, Faults
from zsim.runtime.link_faults import KINDS as CARRIED
from zsim.scenario import fault_kinds
from zsim.scenario.fault_check import Known, flaws
from zsim.scenario.fault_kinds import PROCESS_KILL
from zsim.scenario.scenario import FAULTS_MAX
from zsim.schema.checker import show

if TYPE_CHECKING:
    from zsim_world.flight.world import World

NEVER_NS = 2**63 - 1  # a gate that does not come
SELECTORS = ("id", "target", "kind")


class FaultDesk:
    """Keeps the faults, and lets the fleet feel them.

    One that is asked for begins with the gate that is integrated next: nobody can have worked on that yet, so a run
    with the same faults at the same instants gives the same bits.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._faults: dict[int, Fault] = {}
        self._begun: set[int] = set()
        self._over: set[int] = set()  # ended or cleared, kept for those who still work on gates in which it acted
        self._count = self._lists = 0
        self._carried: tuple[Fault, ...] = ()
        self._carried_at: dict[int, tuple[Fault, ...]] = {}  # by gate, since the last change or integrated gate
        for given in world.scenario.faults:
            self._plan(given, "scenario")
        self._next_ns = self._next_change_ns()
        self._tell()

    @property
    def all(self) -> tuple[Fault, ...]:
        """Return the faults that are planned, act, or have just ended, in order of their ids."""
        return tuple(self._faults[number] for number in sorted(self._faults))

    def acting(self, gate_ns: int) -> list[Fault]:
        """Return the faults that act in a gate."""
        return [fault for fault in self.all if fault_kinds.acts(fault, gate_ns)]

    def carried(self, gate_ns: int) -> tuple[Fault, ...]:
        """Return the faults of links and radios that act in a gate; asked for at every command."""
        if not self._carried:
            return ()
        there = self._carried_at.get(gate_ns)
        if there is None:
            there = tuple(fault for fault in self._carried if fault_kinds.acts(fault, gate_ns))
            self._carried_at[gate_ns] = there
        return there

    # Time

    def apply(self, now_ns: int) -> None:
        """Let begin and end what does so at now_ns, before the gate after it is integrated."""
        impairment, next_ns = self._world.fleet.impairment, now_ns + self._world.gate_ns
        self._carried_at.clear()
        if now_ns >= self._next_ns:
            self._turn(now_ns)
            impairment.strike(self.acting(next_ns))
        impairment.blow(now_ns, next_ns)

    def _turn(self, now_ns: int) -> None:
        for fault in self.all:
            if fault.id not in self._begun and fault.from_ns <= now_ns:
                self._begun.add(fault.id)
                self._event("fault", fault, f"{fault.kind} of {fault.target}{self._beginning(fault)}")
            if fault.id not in self._over and _end_ns(fault) <= now_ns:
                self._over.add(fault.id)
                if not _at_once(fault):
                    self._event("fault_end", fault, f"{fault.kind} of {fault.target} is over")
        self._forget(now_ns)
        self._next_ns = self._next_change_ns()

    def _beginning(self, fault: Fault) -> str:
        """Return in words how a fault begins."""
        if not _at_once(fault):
            return " begins"
        deaf = self._deaf(fault.target)
        return f", which goes on: it {deaf}" if deaf else ""

    def _deaf(self, process: str) -> str | None:
        """Return why a process that takes part does not die when a fault wants it; None if it does."""
        participant = self._world.barrier.participants.get(process)
        if participant is None:
            return None  # one that is not here yet, or whose work another does
        if not participant.gating:
            return "takes no part in the lockstep"
        return None if participant.fingerprint else "does not run on zsim.runtime.runner"

    def _late_ns(self) -> int:
        """Return how far behind the newest gate somebody may still work: the commands' delay, and a step of his."""
        periods = (p.period_ns for p in self._world.barrier.participants.values())
        return self._world.delay_ns + max(periods, default=0)

    def _forget(self, now_ns: int) -> None:
        """Leave out what ended before any gate that somebody may still work on."""
        late_ns = self._late_ns()
        past = [fault.id for fault in self.all if _end_ns(fault) + late_ns <= now_ns]
        for number in past:
            del self._faults[number]
        self._begun.difference_update(past)
        self._over.difference_update(past)
        if past:
            self._tell()

    def _next_change_ns(self) -> int:
        changes, late_ns = [NEVER_NS], self._late_ns()
        for fault in self._faults.values():
            if fault.id not in self._begun:
                changes.append(fault.from_ns)
            changes.append(_end_ns(fault) + (late_ns if fault.id in self._over else 0))
        return min(changes)

    # Requests

    def add(self, request: ControlRequest) -> ControlAnswer:
        """Plan a fault, or say why not."""
        given = {name: value for name, value in request.args.items() if value is not None}
        flaw = self._first_flaw(given)
        if flaw:
            return ControlAnswer(False, flaw)
        fault = self._plan(given, request.source)
        self._tell()
        self._next_ns = self._next_change_ns()
        return ControlAnswer(True, result={"id": fault.id, "from_ns": fault.from_ns, "until_ns": fault.until_ns})

    def clear(self, request: ControlRequest) -> ControlAnswer:
        """End the faults of an id, a target or a kind, or all; or say why not."""
        args = {name: value for name, value in request.args.items() if value is not None}
        unknown = [name for name in args if name not in SELECTORS]
        if unknown:
            return ControlAnswer(False, f"{unknown[0][:40]} is not known; allowed: {', '.join(SELECTORS)}, or nothing")
        there = [fault for fault in self.all if fault.id not in self._over]
        for name, value in args.items():
            chosen = [fault for fault in there if getattr(fault, name) == value]
            if not chosen:
                allowed = (
                    ", ".join(dict.fromkeys(str(getattr(fault, name)) for fault in there)) or "left out: there is none"
                )
                return ControlAnswer(False, f"{name} is {show(value)}; must be {'one of ' if there else ''}{allowed}")
            there = chosen
        for fault in there:
            self._clear(fault, request.source)
        if there:
            self._tell()
            self._next_ns = 0  # the fleet feels it before the next gate
        return ControlAnswer(True, result={"cleared": [fault.id for fault in there]})

    def _clear(self, fault: Fault, source: str) -> None:
        now_ns = self._world.now_ns
        if fault.id in self._begun:
            fault = msgspec.structs.replace(fault, until_ns=now_ns)
            self._faults[fault.id] = fault
            self._over.add(fault.id)
        else:
            del self._faults[fault.id]
        self._event("fault_clear", fault, f"{fault.kind} of {fault.target} is cleared", source)

    def _first_flaw(self, given: Mapping[str, Any]) -> str | None:
        world = self._world
        clusters = tuple(cluster.name for cluster in world.scenario.clusters)
        gating = (p.name for p in world.barrier.participants.values() if p.gating)
        known = Known(tuple(world.names), clusters, (*world.scenario.expected(), *gating))
        path, text = next(flaws(given, known), ("", ""))
        if text:
            return f"{path or 'args'} {text}"
        deaf = self._deaf(given["target"]) if given["kind"] == PROCESS_KILL else None
        if deaf:
            return f"target is {show(given['target'])}, which {deaf}; must be one that dies by it ({PROCESS_KILL})"
        at_s, now_s = given.get("at_s"), world.now_ns / 1e9
        if at_s is not None and at_s < now_s:
            return f"at_s is {at_s:g}; must be >= {now_s:g}, the present, or left out"
        if at_s is not None and at_s >= world.scenario.duration_s:
            return f"at_s is {at_s:g}; must be < {world.scenario.duration_s:g}, the end of the run"
        if len(self._faults) >= FAULTS_MAX:
            return f"{len(self._faults)} faults are planned or act; must be at most {FAULTS_MAX}, so clear some"
        return None

    def _plan(self, given: Mapping[str, Any], source: str) -> Fault:
        self._count += 1
        world = self._world
        fault = fault_kinds.planned(given, self._count, source, world.now_ns, world.gate_ns)
        self._faults[fault.id] = fault
        return fault

    # What is said

    def _tell(self) -> None:
        """Put the list into the outbox, before the next gate."""
        self._rank()
        self._carried = tuple(fault for fault in self.all if fault.kind in CARRIED)
        self._carried_at.clear()
        world, seq = self._world, self._lists
        self._lists += 1
        world.outbox.append((keys.FAULTS, Faults(world.now_ns, seq, self.all)))

    def _rank(self) -> None:
        """Number those that are equal but for their end, and have not begun: they begin together."""
        equal: Counter[tuple[str, str, int]] = Counter()
        for fault in self.all:
            if fault.id in self._begun:
                continue
            what = (fault.kind, fault.target, fault.from_ns)
            if fault.rank != equal[what]:
                self._faults[fault.id] = msgspec.structs.replace(fault, rank=equal[what])
            equal[what] += 1

    def _event(self, kind: str, fault: Fault, text: str, source: str = "world") -> None:
        self._world.tell(kind, fault.target, text, source, msgspec.structs.asdict(fault))


def _at_once(fault: Fault) -> bool:
    """Tell whether a fault is over as soon as it has begun."""
    return fault_kinds.KINDS[fault.kind].lasts == "once"


def _end_ns(fault: Fault) -> int:
    return NEVER_NS if fault.until_ns is None else fault.until_ns
