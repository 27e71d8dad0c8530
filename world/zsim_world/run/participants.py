"""The processes that take part in a run: how they join, report, leave and get lost, and what each means for the run.

No session, no clock: wall times are passed in. `zsim_world.run.barrier` has the bookkeeping.
"""

import math
import uuid
from collections.abc import Callable
from typing import Any

from msgspec import UNSET

from zsim.contract.fingerprint import fingerprint
from zsim.contract.run_messages import Bye, Done, Join
from zsim.errors import RunError, RunFailedError
from zsim.scenario import rights
from zsim.scenario.role_table import ROLES, OnDeath, agent_names, lets_drop, on_death, on_overdue
from zsim.scenario.scenario import Scenario
from zsim_world.run.barrier import Barrier, Participant
from zsim_world.run.outbox import STRANGERS_MAX, Budgets, Refusal, RunOutbox, too_many
from zsim_world.run.run_clock import Operation, RunClock
from zsim_world.run.run_statistics import RunStatistics

RECORDER = "recorder"  # name and role
START_TIMEOUT_S = 60.0  # wall; chosen, for processes that a launched run expects and does not start itself
START_TIMEOUT_OWN_S = 600.0  # wall; chosen, for those that its launcher starts: the first start may compile for minutes
_JOIN = "process/"  # before a name: what is counted of its joins


class Participants:
    """The participants of a run, and what they share: its time, its outbox, its limits.

    Args:
        scenario: resolved.
        mode: "lockstep" or "realtime".
        rate: simulated per wall seconds to pace at; 0 = as fast as possible.
        wall_ns: monotonic wall time.
        run_id: given by a launcher, and by tests that compare records.
        expected: names of the processes without which the run does not start.

    Attributes:
        names: of the drones, in scenario order.
        clock: simulated time.
        barrier: who takes part, how far each has come, and whom the world waits for.
        outbox: what is to be published.
        budgets: of what sources may still do.
        requests: on `world/control`, all of them counted.
        statistics: of the run so far.
        is_launched: whether a launcher has started it and its processes, and not people one after the other.
        unpaced: names of the processes that step when a driver publishes, and not at every gate.
        failure: what is to be raised once the end is published, None for a run that ended well.
        left_early: a line for each process that the run needed and that left it before the end.
    """

    is_launched: bool = False
    unpaced: frozenset[str] = frozenset()

    def __init__(
        self,
        scenario: Scenario,
        mode: str,
        rate: float,
        wall_ns: Callable[[], int],
        run_id: str | None,
        expected: list[str],
    ) -> None:
        self.scenario = scenario
        self.run_id = run_id or uuid.uuid4().hex[:12]
        self.clock = RunClock(scenario.time, mode, rate)
        self.outbox = RunOutbox(lambda: self.clock.now_ns)
        self.budgets = Budgets(lambda: self.clock.now_ns, self.clock.gate_ns)
        self.barrier = Barrier(self.run_id, self.clock.gate_ns, expected)
        self.failure: RunError | None = None
        self.left_early: list[str] = []
        self.start_wall_ns = wall_ns()
        self.names = [drone.name for drone in scenario.drones]
        self.requests = 0
        self.statistics = RunStatistics()
        self._operations: dict[str, Operation] = self.clock.operations()
        self._data_flow = DataFlow(scenario)
        self._expected = expected
        self._agent_names = agent_names(scenario)
        self._own_names = {RECORDER, *expected, *self._agent_names}

    def release_drones(self, name: str) -> None:
        """Release the drones commanded by a process that is gone."""

    def on_death(self, participant: Participant) -> OnDeath:
        """Return what the death of a participant means."""
        return on_death(self.scenario.processes.on_death, participant.name, participant.join.role)

    def fail(self, reason: str) -> None:
        """End the run before its time."""
        if self.clock.ended is None:
            self.failure = RunFailedError(reason)
        self.clock.stop(reason)

    # Who joins and goes on

    def handle_join(self, name: str, message: Join, wall_ns: int) -> None:
        """Take a process in, or refuse it."""
        former, replaced = self.barrier.participants.get(name), self.barrier.replaced(name, message)
        is_known = name in self._own_names or former is not None or self.budgets.changes.knows(_JOIN + name)
        refusal = self._join_refusal(name, is_known)
        refusal = refusal or self.barrier.join(name, message, self.clock.next_ns, wall_ns)
        if refusal:
            self.outbox.refuse(name, f"process/{name}/join", refusal)
            return
        self.budgets.changes.spend(_JOIN + name)
        if not is_known:
            self.budgets.strangers.spend("join")
        joined = self.barrier.participants[name]
        kind, data = "join", joined.entry()
        if former is not None and former.join.incarnation != message.incarnation:
            kind, data["former_pid"] = "superseded" if former.alive else "restart", former.join.pid
        self.outbox.event(kind, name, f"{name} on {message.host} (pid {message.pid})", data, name)
        for dead in replaced:
            self.release_drones(dead.name)
        self._warn_of(joined)

    def _join_refusal(self, name: str, is_known: bool) -> Refusal | None:
        """Return why there have been too many joins; a process that blocks the clock may always join."""
        if not is_known and not self.budgets.strangers.allows("join"):
            return Refusal("newcomers", f"beyond {STRANGERS_MAX} at once", "must wait: one may join each second")
        former = self.barrier.participants.get(name)
        if former is None:
            blocks = self.clock.state == "waiting" and name in self._expected
        else:
            blocks = former.is_waited_for and former.is_missed
        return None if blocks or self.budgets.changes.allows(_JOIN + name) else too_many(name)

    def _warn_of(self, joined: Participant) -> None:
        """Publish that a newcomer computes with other bits, or does the work of others too."""
        name, join, own = joined.name, joined.join, fingerprint()
        if join.fingerprint and join.fingerprint != own:
            text = f"{name} on {join.host} computes with another numeric fingerprint; the same bits are not promised"
            self.outbox.event("fingerprint", name, text, {"found": join.fingerprint, "expected": own})
        for other, both in self.barrier.duplicates(name).items():
            text = f"{name} and {other} both do the work of {', '.join(sorted(both))}; end one of them"
            self.outbox.event("doubled", name, text, {"other": other})

    def handle_done(self, name: str, message: Done, wall_ns: int) -> None:
        """Note how far a participant has come."""
        refusal = self.barrier.done(name, message, self.clock.now_ns, wall_ns)
        if refusal:
            self.outbox.refuse(name, f"process/{name}/done", refusal)
        elif refusal := self.barrier.take_back_bye(name):
            self.outbox.refuse(name, f"process/{name}/bye", refusal)

    def give_up_outputs(self, name: str) -> None:
        """Stop waiting for the outputs of a participant that are lost."""
        missing = self.barrier.participants[name].reset_counts()
        if missing:
            text = f"{name}: {missing} of its outputs did not come"
            self.outbox.notice("outputs_missing", name, text, {"missing": missing})

    # Who leaves

    def handle_bye(self, name: str, message: Bye, wall_ns: int) -> None:
        """Let a participant go; a bye without incarnation counts once its token is lost as well."""
        participant = self.barrier.participants.get(name)
        if participant is None:
            return
        if refusal := self.barrier.bye_refusal(participant, message):
            self.outbox.refuse(name, f"process/{name}/bye", refusal)
            return
        is_named = UNSET not in (message.run_id, message.incarnation)
        if is_named or not participant.alive or self.clock.ended is not None:
            self.leave(participant, message, wall_ns)
        else:  # of contract 1.0, or somebody else's
            participant.farewell = message

    def leave(self, participant: Participant, bye: Bye, wall_ns: int) -> None:
        """Remove a participant that has said bye."""
        name = participant.name
        if bye.failed is True and self.clock.ended is None:
            self.failed(name, bye.reason, wall_ns)
            return
        fails = self._is_missed_from_now(participant)
        text = f"{name} left: {bye.reason}"
        data = {"reason": bye.reason, "run_id": self.run_id, "incarnation": participant.join.incarnation}
        if fails:
            text += "; a run that goes on without it fails, unless processes.on_death has drop for it"
            self.left_early.append(f"{name} left at {self.clock.now_ns / 1e9:.2f} s, before the end: {bye.reason}")
        self.outbox.event("leave", name, text, {**data, "fails": True} if fails else data, name)
        self.barrier.remove(name)
        self.release_drones(name)
        self._expect_again(participant)
        self._after_bye(participant, bye.reason)

    def _is_missed_from_now(self, participant: Participant) -> bool:
        """Tell whether the leave of a process fails the run: the scenario needs it, and nobody else does its work.

        A program of somebody's own leaves when it is through; the leave of a recorder ends the run.
        """
        if self.clock.ended is not None or self.clock.state == "waiting" or participant.join.role == RECORDER:
            return False
        is_allowed = lets_drop(self.scenario.processes.on_death, participant.name)
        is_needed = not participant.served_names.isdisjoint(self._agent_names)
        return is_needed and not is_allowed and self.barrier.substitute(participant.name) is None

    def _expect_again(self, participant: Participant) -> None:
        """Wait at the start again for the processes whose work a lost one was to do."""
        if self.clock.state == "waiting":
            for each in self._expected:
                if each in participant.served_names:
                    self.barrier.expect(each)

    def _after_bye(self, participant: Participant, reason: str) -> None:
        """Do what the leave of a process means for the run."""
        if participant.join.role == RECORDER:
            self.clock.stop(f"the recorder left: {reason}")

    # Who is lost

    def died(self, name: str, wall_ns: int) -> None:
        """Handle the loss of a token: its process has died, or left where it has said bye."""
        if self._has_left(name, wall_ns):
            return
        participant = self.barrier.mark_dead(name, wall_ns)
        if participant is None:
            return
        substitute = self.barrier.substitute(name)
        action = "drop" if substitute else self.on_death(participant)
        then = f"{substitute.name} does its work" if substitute else f"on_death: {action}"
        host, pid = participant.join.host, participant.join.pid
        data = {"host": host, "pid": pid, "on_death": action}
        self.outbox.event("death", name, f"{name} on {host} (pid {pid}) died; {then}", data)
        if action == "drop":
            self._drop(name, is_news=substitute is None)
        elif self.clock.mode == "realtime":
            self.release_drones(name)
        if action == "end":
            self.fail(f"{name} died")

    def _has_left(self, name: str, wall_ns: int) -> bool:
        """Let a process go whose bye waits for the loss of its token; return whether there is such a bye."""
        participant = self.barrier.participants.get(name)
        if participant is None or participant.farewell is None:
            return False
        self.leave(participant, participant.farewell, wall_ns)
        return True

    def failed(self, name: str, reason: str, wall_ns: int) -> None:
        """Handle the leave of a process that cannot continue; started again, it would fail again."""
        participant = self.barrier.participants.get(name)
        if participant is None:
            return
        action = self.on_death(participant)
        action = "end" if action == "restart" else action
        data = {"host": participant.join.host, "pid": participant.join.pid, "on_death": action}
        self.outbox.event("failure", name, reason, data, name)
        if action == "drop":
            self._drop(name)
            return
        self.release_drones(name)
        if action == "wait":
            self.barrier.mark_dead(name, wall_ns)
        else:
            self.barrier.remove(name)
            self.fail(reason)

    def _drop(self, name: str, is_news: bool = True) -> None:
        """Continue without a process."""
        self.release_drones(name)
        self.barrier.remove(name)
        if is_news:
            data = {"from_ns": self.clock.now_ns}
            self.outbox.event("drop", name, f"{name} is waited for no longer", data)

    def may_return(self, participant: Participant) -> bool:
        """Tell whether the run waits for a process that died."""
        return self.on_death(participant) in ("restart", "wait")

    def overdue(self, wall_ns: int) -> str | None:
        """Return a process that has had its time to join, or to come back since it is dead or silent; None if none."""
        if self.clock.state == "waiting":
            waited_s = (wall_ns - self.start_wall_ns) / 1e9
            for name in self.barrier.absent():
                if waited_s > self._start_timeout_s(name):
                    return name
        return_s = self.scenario.processes.return_s
        if return_s is None:
            return None
        for participant in self.barrier.participants.values():
            since_ns = participant.silent_wall_ns if participant.is_waited_for else None
            if not participant.alive:
                since_ns = participant.since_wall_ns if self.may_return(participant) else None
            if since_ns and wall_ns - since_ns > return_s * 1e9:
                return participant.name
        return None

    def _start_timeout_s(self, name: str) -> float:
        """Return how long a run waits at its start for a process that is expected [s, wall]."""
        asked_s = self.scenario.processes.start_timeout_s
        if asked_s is not UNSET:
            return asked_s
        if not self.is_launched:
            return math.inf
        is_started = name in self._agent_names or name.partition(".")[0] in ROLES
        return START_TIMEOUT_OWN_S if is_started else START_TIMEOUT_S

    def expired(self, name: str) -> None:
        """End the run for a process that has not come, or not come back, in its time, or continue without it."""
        processes = self.scenario.processes
        participant = self.barrier.participants.get(name)
        if participant is not None:
            host, pid, role = participant.join.host, participant.join.pid, participant.join.role
            action = self.on_death(participant)
            if action not in ("drop", "end"):  # these hold for one that is silent as for one that is dead
                action = on_overdue(processes.on_overdue or {}, name, role, processes.gating or ())
            text = f"{name} has not come back within {processes.return_s:g} s"
        elif name in self.barrier.absent():
            action, host, pid = "drop" if lets_drop(processes.on_overdue or {}, name) else "end", "", 0
            text = f"{name} has not joined within {self._start_timeout_s(name):g} s; see processes.start_timeout_s"
        else:
            return
        self.outbox.event("overdue", name, text, {"host": host, "pid": pid, "on_overdue": action})
        if action == "drop":
            self._drop(name)
        else:
            self.fail(text)

    def silence_changed(self, name: str, since_wall_ns: int | None) -> None:
        """Note that a process publishes its health no longer, since its last; or does again (None)."""
        participant = self.barrier.participants.get(name)
        if participant is None or not participant.alive:
            return
        participant.silent_wall_ns = since_wall_ns
        who = f"{name} on {participant.join.host} (pid {participant.join.pid})"
        data = {"host": participant.join.host, "pid": participant.join.pid}
        if since_wall_ns is None:
            self.outbox.event("silent_end", name, f"{who} is back", data)
        else:
            self.outbox.event("silent", name, f"{who} shows no sign of life; it is stopped, or its host is gone", data)

    def reader_closed(self, text: str, data: dict[str, Any]) -> None:
        """Report a reader that took nothing, so that its link was closed; nobody waits for it."""
        if self.budgets.strangers.spend("slow_reader"):
            self.outbox.event("slow_reader", data["address"], text, data)

    def falsely_joined(self, name: str, join: Join, fault: str) -> None:
        """Report a withheld join without a process behind it: whoever has that place keeps it.

        It is counted like a refusal, and is an event as long as there have not been too many.
        """
        if not self.budgets.strangers.spend("no_show"):
            self.outbox.refusals.count += 1
            return
        data = {"host": join.host, "pid": join.pid, "incarnation": join.incarnation}
        what = "takes nobody's place" if name in self.barrier.participants else "is not waited for"
        text = f"{name} on {join.host} (pid {join.pid}) {fault}; its join {what}"
        self.outbox.event("no_show", name, text, data)

    def not_shown(self, name: str, fault: str, wall_ns: int) -> None:
        """Undo an absent process's join."""
        participant = self.barrier.participants.get(name)
        if participant is None or not participant.alive or self._has_left(name, wall_ns):
            return
        host, pid = participant.join.host, participant.join.pid
        self.outbox.event("no_show", name, f"{name} on {host} (pid {pid}) {fault}", {"host": host, "pid": pid})
        if participant.rejoined:
            self.died(name, wall_ns)
            return
        self._drop(name)
        self._expect_again(participant)


class DataFlow:
    """Which processes read whose outputs, by the rights of their roles; nothing is known of an unknown role.

    Args:
        scenario: with the drones and clusters that processes are about.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._rights: dict[str, rights.Rights] = {}
        self._known: dict[tuple[str, str], bool] = {}

    def feeds(self, writer: str, reader: str) -> bool:
        """Tell whether one process publishes what another one reads, and not the other way round as well."""
        return self._writes_for(writer, reader) and not self._writes_for(reader, writer)

    def _writes_for(self, writer: str, reader: str) -> bool:
        pair = writer, reader
        if pair not in self._known:
            read = {*self._of(reader).reads} - {*self._of(reader).writes}  # but for its own last value
            written = [key for key in self._of(writer).writes if "*" not in key]
            self._known[pair] = any(rights.permits(read, key) for key in written)
        return self._known[pair]

    def _of(self, name: str) -> rights.Rights:
        if name not in self._rights:
            self._rights[name] = rights.of(name, self._scenario)
        return self._rights[name]
