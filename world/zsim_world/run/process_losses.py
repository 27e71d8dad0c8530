"""What it means for a run that a process dies, falls silent, takes nothing, or was never there."""

import math
from collections.abc import Callable
from typing import Any, Protocol

from msgspec import UNSET

from zsim.contract.run_messages import Bye, Join
from zsim.scenario.role_table import ROLES, OnDeath, OnOverdue, agent_names, lets_drop, on_overdue
from zsim.scenario.scenario import Scenario
from zsim_world.run.barrier import Barrier, Participant
from zsim_world.run.outbox import Budgets, RunOutbox
from zsim_world.run.run_clock import RunClock

START_TIMEOUT_S = 60.0  # wall; chosen, for processes that a launched run expects and does not start itself
START_TIMEOUT_OWN_S = 600.0  # wall; chosen, for those that its launcher starts: the first start may compile for minutes
RETURNS = ("restart", "wait")  # of on_death: a process that died comes back, or may


class _Run(Protocol):
    """What a loss bears upon."""

    scenario: Scenario
    clock: RunClock
    barrier: Barrier
    outbox: RunOutbox
    budgets: Budgets
    on_death: Callable[[Participant], OnDeath]
    fail: Callable[[str], None]
    is_launched: bool
    start_wall_ns: int
    release_drones: Callable[[str], None]
    expect_again: Callable[[Participant], None]
    leave: Callable[[Participant, Bye, int], None]


class ProcessLosses:
    """Takes the losses of processes, and does what the scenario says of each.

    Args:
        run: in which they take part.
    """

    def __init__(self, run: _Run) -> None:
        self._run = run
        self._barrier = run.barrier
        self._outbox = run.outbox

    def died(self, name: str, wall_ns: int) -> None:
        """Take it that the token of a process is gone: it has died, or left where it has said bye."""
        if self._has_left(name, wall_ns):
            return
        participant = self._barrier.mark_dead(name, wall_ns)
        if participant is None:
            return
        substitute = self._barrier.substitute(name)
        action = "drop" if substitute else self._run.on_death(participant)
        then = f"{substitute.name} does its work" if substitute else f"on_death: {action}"
        host, pid = participant.join.host, participant.join.pid
        data = {"host": host, "pid": pid, "on_death": action}
        self._outbox.event("death", name, f"{name} on {host} (pid {pid}) died; {then}", data)
        if action == "drop":
            self._drop(name, is_news=substitute is None)
        elif self._run.clock.mode == "realtime":
            self._run.release_drones(name)
        if action == "end":
            self._run.fail(f"{name} died")

    def _has_left(self, name: str, wall_ns: int) -> bool:
        """Let a process go of which a bye has come that waits for the loss of its token; return whether one had."""
        participant = self._barrier.participants.get(name)
        if participant is None or participant.farewell is None:
            return False
        self._run.leave(participant, participant.farewell, wall_ns)
        return True

    def failed(self, name: str, reason: str, wall_ns: int) -> None:
        """Take it that a process has left since it cannot go on; started again, it would fail again."""
        participant = self._barrier.participants.get(name)
        if participant is None:
            return
        action = self._run.on_death(participant)
        action = "end" if action == "restart" else action
        data = {"host": participant.join.host, "pid": participant.join.pid, "on_death": action}
        self._outbox.event("failure", name, reason, data, name)
        if action == "drop":
            self._drop(name)
            return
        self._run.release_drones(name)
        if action == "wait":
            self._barrier.mark_dead(name, wall_ns)
        else:
            self._barrier.remove(name)
            self._run.fail(reason)

    def _drop(self, name: str, is_news: bool = True) -> None:
        """Go on without a process."""
        self._run.release_drones(name)
        self._barrier.remove(name)
        if is_news:
            data = {"from_ns": self._run.clock.now_ns}
            self._outbox.event("drop", name, f"{name} is waited for no longer", data)

    def may_return(self, participant: Participant) -> bool:
        """Tell whether the run waits for a process that died."""
        return self._run.on_death(participant) in RETURNS

    def overdue(self, wall_ns: int) -> str | None:
        """Return who has had its time to join, or to come back since it is dead or silent; None if nobody has."""
        if self._run.clock.state == "waiting":
            waited_s = (wall_ns - self._run.start_wall_ns) / 1e9
            absent = self._barrier.absent()
            if late := next((name for name in absent if waited_s > self._start_timeout_s(name)), None):
                return late
        return_s = self._run.scenario.processes.return_s
        if return_s is None:
            return None
        gone = ((p.name, self._gone_since_ns(p)) for p in self._barrier.participants.values())
        return next((name for name, since_ns in gone if since_ns and wall_ns - since_ns > return_s * 1e9), None)

    def _gone_since_ns(self, participant: Participant) -> int | None:
        """Return since when the run has waited for one to come back, None where it does not."""
        if not participant.alive:
            return participant.since_wall_ns if self.may_return(participant) else None
        return participant.silent_wall_ns if participant.is_waited_for else None

    def _start_timeout_s(self, name: str) -> float:
        """Return how long a run waits at its start for a process that is expected [s, wall]."""
        scenario, asked_s = self._run.scenario, self._run.scenario.processes.start_timeout_s
        if asked_s is not UNSET:
            return asked_s
        if not self._run.is_launched:
            return math.inf
        is_started = name in agent_names(scenario) or name.partition(".")[0] in ROLES
        return START_TIMEOUT_OWN_S if is_started else START_TIMEOUT_S

    def _never_came(self, name: str) -> None:
        """End a run for which a process has not come, or begin without it where the scenario says so."""
        processes = self._run.scenario.processes
        action: OnOverdue = "drop" if lets_drop(processes.on_overdue or {}, name) else "end"
        text = f"{name} has not joined within {self._start_timeout_s(name):g} s; see processes.start_timeout_s"
        self._outbox.event("overdue", name, text, {"host": "", "pid": 0, "on_overdue": action})
        if action == "drop":
            self._drop(name)
        else:
            self._run.fail(text)

    def expired(self, name: str) -> None:
        """Take it that a process has not come, or not come back, in its time: the run ends, or goes on without it."""
        participant = self._barrier.participants.get(name)
        if participant is None:
            if name in self._barrier.absent():
                self._never_came(name)
            return
        action, join = self._overdue_action(participant), participant.join
        within_s = self._run.scenario.processes.return_s
        text = f"{name} has not come back within {within_s:g} s"
        data = {"host": join.host, "pid": join.pid, "on_overdue": action}
        self._outbox.event("overdue", name, text, data)
        if action == "drop":
            self._drop(name)
        else:
            self._run.fail(text)

    def _overdue_action(self, participant: Participant) -> OnOverdue:
        action = self._run.on_death(participant)
        if action in ("drop", "end"):  # of one that is silent, as after its death
            return action
        processes, role = self._run.scenario.processes, participant.join.role
        return on_overdue(processes.on_overdue or {}, participant.name, role, processes.gating or ())

    def silence_changed(self, name: str, since_wall_ns: int | None) -> None:
        """Take it that a process publishes its health no longer, since its last; or does again (None)."""
        participant = self._barrier.participants.get(name)
        if participant is None or not participant.alive:
            return
        participant.silent_wall_ns = since_wall_ns
        who = f"{name} on {participant.join.host} (pid {participant.join.pid})"
        data = {"host": participant.join.host, "pid": participant.join.pid}
        if since_wall_ns is None:
            self._outbox.event("silent_end", name, f"{who} is back", data)
        else:
            self._outbox.event("silent", name, f"{who} shows no sign of life; it is stopped, or its host is gone", data)

    def reader_closed(self, text: str, data: dict[str, Any]) -> None:
        """Take it that a reader nobody waits for has lost its link, since it took nothing."""
        if self._run.budgets.strangers.spend("slow_reader"):
            self._outbox.event("slow_reader", data["address"], text, data)

    def falsely_joined(self, name: str, join: Join, fault: str) -> None:
        """Take it that nobody is behind a join which was withheld: who is in that place keeps it.

        It is counted like a refusal, and is an event as long as there have not been too many.
        """
        if not self._run.budgets.strangers.spend("no_show"):
            self._outbox.refusals.count += 1
            return
        data = {"host": join.host, "pid": join.pid, "incarnation": join.incarnation}
        what = "takes nobody's place" if name in self._barrier.participants else "is not waited for"
        text = f"{name} on {join.host} (pid {join.pid}) {fault}; its join {what}"
        self._outbox.event("no_show", name, text, data)

    def not_shown(self, name: str, fault: str, wall_ns: int) -> None:
        """Take it that a process which joined is not there: what it stands for is as if it had not come."""
        participant = self._barrier.participants.get(name)
        if participant is None or not participant.alive or self._has_left(name, wall_ns):
            return
        host, pid = participant.join.host, participant.join.pid
        self._outbox.event("no_show", name, f"{name} on {host} (pid {pid}) {fault}", {"host": host, "pid": pid})
        if participant.rejoined:
            self.died(name, wall_ns)
            return
        self._drop(name)
        self._run.expect_again(participant)
