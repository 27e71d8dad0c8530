"""The injected faults of a run: planned by scenario or request, begun and ended at gates, published."""

from collections import Counter
from collections.abc import Mapping
from typing import Any, ClassVar

import msgspec

from zsim.contract import keys
from zsim.contract.run_messages import ControlAnswer, ControlRequest, Fault, Faults
from zsim.contract.snapshot import PART, Saved
from zsim.runtime.links import KINDS as LINK_KINDS
from zsim.scenario import faults as fault_kinds
from zsim.scenario.faults import PROCESS_KILL, Known, flaws
from zsim.scenario.roles import WORLD, expected_processes
from zsim.scenario.scenario import FAULTS_MAX
from zsim.schema.checker import show
from zsim.sensors.sensor_catalogue import declarations, sensor_names
from zsim_world.fleet.fault_effects import Impairment
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.outbox import Refusal
from zsim_world.run.run_clock import Operation

NEVER_NS = 2**63 - 1  # time of a gate that is never reached
SELECTORS = ("id", "target", "kind")


class FaultInjector:
    """The faults of a run, which `effects` applies to the fleet.

    A fault that is requested without a time begins with the next gate to be integrated, on which no process can have
    worked yet, so that a run with the same faults at the same times gives the same bits.
    """

    SAVED: ClassVar[Saved] = {
        "_faults": dict[int, Fault],
        "_begun": set[int],
        "_over": set[int],
        "_count": int,
        "_seq": int,
        "_next_ns": int,
        "_effects": PART,
    }

    def __init__(self, run: Coordinator, effects: Impairment) -> None:
        self._scenario, self._clock, self._barrier, self._outbox = run.scenario, run.clock, run.barrier, run.outbox
        self._effects = effects
        self._kinds = fault_kinds.kinds_of(declarations(run.scenario.drones))
        self._faults: dict[int, Fault] = {}
        self._begun: set[int] = set()
        self._over: set[int] = set()  # ended or cleared, kept for processes still working on earlier gates
        self._count = self._seq = 0
        self._of_links: tuple[Fault, ...] = ()
        self._of_links_at: dict[int, tuple[Fault, ...]] = {}  # cache by gate, emptied at every change and gate
        for planned in run.scenario.faults:
            self._plan(planned, "scenario")
        self._next_ns = self._next_change_ns()
        self._publish()

    @property
    def all(self) -> tuple[Fault, ...]:
        """The planned, acting and recently ended faults, in order of their ids."""
        return tuple(self._faults[number] for number in sorted(self._faults))

    def of_links(self, gate_ns: int) -> tuple[Fault, ...]:
        """Return the link and radio faults that act at a gate; called for every command."""
        if not self._of_links:
            return ()
        acting = self._of_links_at.get(gate_ns)
        if acting is None:
            acting = tuple(fault for fault in self._of_links if fault_kinds.acts(fault, gate_ns))
            self._of_links_at[gate_ns] = acting
        return acting

    # Time

    def apply(self, now_ns: int) -> None:
        """Begin and end the faults that are due at now_ns, before the next gate is integrated."""
        next_ns = now_ns + self._clock.gate_ns
        self._of_links_at.clear()
        if now_ns >= self._next_ns:
            self._begin_and_end(now_ns)
            self._effects.strike([fault for fault in self.all if fault_kinds.acts(fault, next_ns)])
        self._effects.blow(now_ns, next_ns)

    def _begin_and_end(self, now_ns: int) -> None:
        """Begin and end faults, and remove those that ended before any gate that is still worked on."""
        for fault in self.all:
            kind = fault_kinds.KINDS.get(fault.kind)
            is_instant = kind is not None and kind.lasts == "once"  # begins and ends at the same gate
            if fault.id not in self._begun and fault.from_ns <= now_ns:
                self._begun.add(fault.id)
                text = "begins"
                if is_instant:
                    immune = self._immunity(fault.target)
                    text = f"has no effect: the process {immune}" if immune else ""
                self._event("fault", fault, text)
            if fault.id not in self._over and _end_ns(fault) <= now_ns:
                self._over.add(fault.id)
                if not is_instant:
                    self._event("fault_end", fault, "is over")
        late_ns = self._late_ns()
        past = [fault.id for fault in self.all if _end_ns(fault) + late_ns <= now_ns]
        for number in past:
            del self._faults[number]
        self._begun.difference_update(past)
        self._over.difference_update(past)
        if past:
            self._publish()
        self._next_ns = self._next_change_ns()

    def _immunity(self, process: str) -> str | None:
        """Return why a fault cannot kill a process; None if it can."""
        participant = self._barrier.participants.get(process)
        if participant is None:
            return None  # the process has not joined yet, or another process does its work
        if not participant.gating:
            return "takes no part in the lockstep"
        return None if participant.join.fingerprint else "does not run on zsim.runtime.runner"

    def _late_ns(self) -> int:
        """Return how far a process may be behind the newest gate: the command delay plus one period [ns]."""
        periods = (p.join.period_ns for p in self._barrier.participants.values())
        return self._clock.delay_ns + max(periods, default=0)

    def _next_change_ns(self) -> int:
        changes, late_ns = [NEVER_NS], self._late_ns()
        for fault in self._faults.values():
            if fault.id not in self._begun:
                changes.append(fault.from_ns)
            changes.append(_end_ns(fault) + (late_ns if fault.id in self._over else 0))
        return min(changes)

    # Requests

    def operations(self) -> dict[str, Operation]:
        """Return the handlers of the `op` values on `world/control` that concern faults."""
        return {"fault_add": self._add, "fault_clear": self._clear}

    def _add(self, request: ControlRequest) -> ControlAnswer:
        args = {name: value for name, value in request.args.items() if value is not None}
        if refusal := self._refusal(args):
            return ControlAnswer(False, str(refusal))
        fault = self._plan(args, request.source)
        self._publish()
        self._next_ns = self._next_change_ns()
        return ControlAnswer(True, result={"id": fault.id, "from_ns": fault.from_ns, "until_ns": fault.until_ns})

    def _refusal(self, args: Mapping[str, Any]) -> Refusal | str | None:
        """Return why a requested fault is refused; None if it is accepted."""
        scenario = self._scenario
        drones = tuple(drone.name for drone in scenario.drones)
        clusters = tuple(cluster.name for cluster in scenario.clusters)
        gating = (p.name for p in self._barrier.participants.values() if p.gating)
        processes = (*expected_processes(scenario), *gating)
        external = tuple(scenario.external())
        sensors = {drone.name: sensor_names(drone.sensors) for drone in scenario.drones}
        known = Known(drones, clusters, processes, self._kinds, self._effects.rotors, external, sensors)
        for path, text in flaws(args, known):
            return f"{path or 'args'} {text}"
        if args["kind"] == PROCESS_KILL and (immune := self._immunity(args["target"])):
            allowed = f"must be a process that {PROCESS_KILL} can end"
            return Refusal("target", f"{show(args['target'])}, which {immune}", allowed)
        if args["kind"] == "radio" and scenario.own_messages() and scenario.radio_of_agents is None:
            return Refusal(
                "kind", "radio", "must be another: the scenario's agents exchange messages without a `radio`"
            )
        at_s, now_s, end_s = args.get("at_s"), self._clock.now_ns / 1e9, scenario.duration_s
        if at_s is not None and at_s < now_s:
            return Refusal("at_s", f"{at_s:g}", f"must be >= {now_s:g}, the present, or left out")
        if at_s is not None and at_s >= end_s:
            return Refusal("at_s", f"{at_s:g}", f"must be < {end_s:g}, the end of the run")
        if len(self._faults) >= FAULTS_MAX:
            allowed = f"must be < {FAULTS_MAX} before one is added; clear some"
            return Refusal("the number of faults that are planned or acting", str(len(self._faults)), allowed)
        return None

    def _plan(self, args: Mapping[str, Any], source: str) -> Fault:
        self._count += 1
        fault = fault_kinds.planned(args, self._count, source, self._clock.now_ns, self._clock.gate_ns, self._kinds)
        self._faults[fault.id] = fault
        return fault

    def _clear(self, request: ControlRequest) -> ControlAnswer | Refusal:
        """End the faults with a given id, target or kind, or all faults."""
        args = {name: value for name, value in request.args.items() if value is not None}
        if unknown := [name for name in args if name not in SELECTORS]:
            return Refusal(unknown[0][:40], "not known", f"allowed: {', '.join(SELECTORS)}, or nothing")
        selected = [fault for fault in self.all if fault.id not in self._over]
        for name, value in args.items():
            matching = [fault for fault in selected if getattr(fault, name) == value]
            if not matching:
                values = dict.fromkeys(str(getattr(fault, name)) for fault in selected)
                allowed = f"one of {', '.join(values)}" if values else "left out: there is none"
                return Refusal(name, show(value), f"must be {allowed}")
            selected = matching
        for fault in selected:
            cleared = self._faults.pop(fault.id)
            if fault.id in self._begun:
                cleared = msgspec.structs.replace(fault, until_ns=self._clock.now_ns)
                self._faults[fault.id] = cleared
                self._over.add(fault.id)
            self._event("fault_clear", cleared, "is cleared", request.source)
        if selected:
            self._publish()
            self._next_ns = 0  # so that the change takes effect before the next gate
        return ControlAnswer(True, result={"cleared": [fault.id for fault in selected]})

    # Publication

    def _publish(self) -> None:
        """Publish the list of faults before the next gate.

        Faults that have not begun and have the same kind, target and start are numbered by `rank`.
        """
        equal: Counter[tuple[str, str, int]] = Counter()
        for fault in self.all:
            if fault.id in self._begun:
                continue
            start = (fault.kind, fault.target, fault.from_ns)
            if fault.rank != equal[start]:
                self._faults[fault.id] = msgspec.structs.replace(fault, rank=equal[start])
            equal[start] += 1
        self.restored()
        self._outbox.put(keys.FAULTS, Faults(self._clock.now_ns, self._seq, self.all))
        self._seq += 1

    def restored(self) -> None:
        """Derive the link faults, which are not saved, from the list of faults."""
        self._of_links = tuple(fault for fault in self.all if fault.kind in LINK_KINDS)
        self._of_links_at.clear()

    def _event(self, kind: str, fault: Fault, state: str, source: str = WORLD) -> None:
        text = f"{fault.kind} of {fault.target} {state}".rstrip()
        self._outbox.event(kind, fault.target, text, msgspec.structs.asdict(fault), source)


def _end_ns(fault: Fault) -> int:
    return NEVER_NS if fault.until_ns is None else fault.until_ns
