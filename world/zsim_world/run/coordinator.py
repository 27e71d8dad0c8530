"""The part common to a flight (World) and a replay (Playback): participants, requests and the advance of time.

It handles processes that join, report, leave or die, without a session or wall clock: the caller passes in every input
with its monotonic wall time, asks whether time may advance (`may_advance`), advances (`advance`) and publishes the
outbox.
"""

import math
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
from msgspec import UNSET

from zsim.contract import keys, messages, run_messages
from zsim.contract.fingerprint import fingerprint
from zsim.contract.run_messages import Bye, ControlAnswer, ControlRequest, Join, Waiting
from zsim.errors import RunError, RunFailedError
from zsim.runtime.agent import Output
from zsim.scenario import roles
from zsim.scenario.roles import ROLES, WORLD, OnDeath, agent_names, lets_drop
from zsim.scenario.scenario import Scenario
from zsim_world.run.barrier import Barrier, Participant
from zsim_world.run.outbox import STRANGERS_MAX, Budgets, KeyedMessage, Refusal, RunOutbox, too_many
from zsim_world.run.run_clock import Operation, RunClock, RunStatistics, number

RECORDER = "recorder"  # name and role
START_TIMEOUT_S = 60.0  # wall time within which expected processes that the launcher does not start must join
START_TIMEOUT_OWN_S = 600.0  # the same for processes that the launcher starts; compiling may take minutes
FLIGHT_REQUESTS = frozenset({"acquire", "release", "fault_add", "fault_clear"})  # operations that change a flight
ARGS_BYTES_MAX = 4000  # maximum size of arguments that an event repeats in full; all operations need far less


class Coordinator(ABC):
    """A run from its participants' point of view.

    Args:
        rate: real-time factor, simulated seconds per wall second; 0: as fast as possible.
        run_id: set by a launcher, and by tests that compare records; None: random.
        expected: names of the processes required at the start.

    Attributes:
        needs_participants: whether the loss of a participant affects the run; False for a replay.
        refused_queries: keys other than `world/control` on which requests are received, but refused.
        external: names of the drones whose drivers publish sensors, truth and status.
        unpaced: names of the processes that step when a driver publishes, not at every gate.
        is_launched: whether a launcher started the run; otherwise users start each process.
        failure: the error to raise once the end is published; None while the run has not failed.
        left_early: a line for each process that left before the end although the run needed it.
        requests: number of requests on `world/control`.
    """

    needs_participants = True
    refused_queries: tuple[str, ...] = ()
    external: frozenset[str] = frozenset()
    unpaced: frozenset[str] = frozenset()
    is_launched = False

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
        self.statistics = RunStatistics()
        self.failure: RunError | None = None
        self.left_early: list[str] = []
        self.start_wall_ns = wall_ns()
        self.names = [drone.name for drone in scenario.drones]
        self.requests = 0
        self._operations: dict[str, Operation] = self.clock.operations()
        self._data_flow = DataFlow(scenario)
        self._expected = expected
        self._agent_names = agent_names(scenario)

    @abstractmethod
    def info(self) -> messages.Info:
        """Return the message of `world/info`."""

    @abstractmethod
    def advance(self, wall_ns: int) -> None:
        """Advance to the next gate, or publish gate 0, and put all its messages into the outbox."""

    @abstractmethod
    def views(self, seq: int) -> Sequence[Output]:
        """Return the messages of `view/**` at the newest gate."""

    @abstractmethod
    def result(self) -> dict[str, Any]:
        """Return the statistics of the run so far."""

    @abstractmethod
    def _handle_command(self, drone: str, kind: str, message: Any) -> bool:
        """Handle a command to a drone; return False for a duplicate."""

    def accept_from_driver(self, drone: str, message: Any) -> str | None:
        """Handle a message of an external drone's driver; return why it is refused, or None."""
        return None

    def release_drones(self, name: str) -> None:  # noqa: B027 - a replay has no commanders
        """Release the drones commanded by a process that has left or died."""

    def refusal_at(self, key: str) -> str | None:
        """Return why requests on one of `refused_queries` are refused, or None if another process answers them."""
        return f"{key}: is not answered here"

    @property
    def now_ns(self) -> int:
        """The newest gate [ns]; also 0 before the start."""
        return self.clock.now_ns

    @property
    def ended(self) -> str | None:
        """Why the run has ended; None while it continues."""
        return self.clock.ended

    def fail(self, reason: str) -> None:
        """End the run with a failure."""
        if self.clock.ended is None:
            self.failure = RunFailedError(reason)
        self.clock.stop(reason)

    # What participants publish

    def handle(self, key: str, message: Any, wall_ns: int) -> None:
        """Handle a message of a participant or any other process."""
        kind, name, topic = keys.parts(key)
        if kind == "drone" and topic.startswith("cmd/"):
            self.barrier.count_output(message.source)
            if self._handle_command(name, topic[4:], message):
                self.statistics.ages.command(message.t_ns, wall_ns)
        elif kind == "process" and topic == "done":
            if refusal := self.barrier.done(name, message, self.clock.now_ns, wall_ns):
                self.outbox.refuse(name, key, refusal)
            elif refusal := self.barrier.retract_bye(name):
                self.outbox.refuse(name, keys.process(name, "bye"), refusal)
        elif kind == "process" and topic == "join":
            self.join(name, message, wall_ns)
        elif kind == "process" and topic == "bye":
            self._handle_bye(name, message, wall_ns)

    def count_output(self, source: str) -> None:
        """Count an output (estimate, cluster state) of a participant."""
        self.barrier.count_output(source)

    def give_up_outputs(self, name: str) -> None:
        """Stop waiting for a participant's lost outputs."""
        missing = self.barrier.participants[name].reset_counts()
        if missing:
            text = f"{name}: {missing} of its outputs did not arrive"
            self.outbox.notice("outputs_missing", name, text, {"missing": missing})

    def join(self, name: str, message: Join, wall_ns: int) -> None:
        """Admit or refuse a process; its joins are not limited while it blocks the clock."""
        barrier, outbox, counted = self.barrier, self.outbox, f"process/{name}"
        changes, strangers = self.budgets.changes, self.budgets.strangers
        former, replaced = barrier.participants.get(name), barrier.replaced(name, message)
        is_known = former is not None or changes.knows(counted)
        is_known = is_known or name in (RECORDER, *self._expected, *self._agent_names)
        if former is None:
            blocks = self.clock.state == "waiting" and name in self._expected
        else:
            blocks = former.is_waited_for and former.is_missed
        if not is_known and not strangers.allows("join"):
            allowed = f"must be <= {STRANGERS_MAX} at once, then one each second"
            refusal = Refusal("the number of new processes", f"above {STRANGERS_MAX}", allowed)
        elif not blocks and not changes.allows(counted):
            refusal = too_many(name)
        else:
            refusal = barrier.join(name, message, self.clock.next_ns, wall_ns)
        if refusal:
            outbox.refuse(name, keys.process(name, "join"), refusal)
            return
        changes.spend(counted)
        if not is_known:
            strangers.spend("join")
        joined, kind = barrier.participants[name], "join"
        data = {"incarnation": joined.join.incarnation, **joined.location}
        data |= {"from_ns": joined.from_ns, "done_ns": joined.done_ns}
        if joined.join.serves:
            data["serves"] = joined.join.serves
        if former is not None and former.join.incarnation != message.incarnation:
            kind, data["former_pid"] = "superseded" if former.alive else "restart", former.join.pid
        outbox.event(kind, name, str(joined), data, name)
        for dead in replaced:
            self.release_drones(dead.name)
        actual, expected = joined.join.fingerprint, fingerprint()
        if actual and actual != expected:
            process = f"{name} on {joined.join.host}"
            text = f"{process} runs different code (fingerprint); the same bits are not guaranteed"
            outbox.event("fingerprint", name, text, {"found": actual, "expected": expected})
        for other, shared in barrier.duplicates(name).items():
            text = f"{name} and {other} both do the work of {', '.join(sorted(shared))}; end one of them"
            outbox.event("doubled", name, text, {"other": other})

    def _handle_bye(self, name: str, message: Bye, wall_ns: int) -> None:
        """Remove a participant that says bye; a bye without run id or incarnation waits for the loss of the token."""
        participant = self.barrier.participants.get(name)
        if participant is None:
            return
        if refusal := self.barrier.bye_refusal(participant, message):
            self.outbox.refuse(name, keys.process(name, "bye"), refusal)
            return
        is_named = UNSET not in (message.run_id, message.incarnation)
        if is_named or not participant.alive or self.clock.ended is not None:
            self._leave(participant, message, wall_ns)
        else:  # a bye of contract 1.0, or from another process
            participant.farewell = message

    def _leave(self, participant: Participant, bye: Bye, wall_ns: int) -> None:
        """Handle the bye of a participant that has left or cannot continue.

        The run continues but counts as failed if the scenario needs the participant and no other process does its work.
        A user's own program may leave when it has finished; a recorder that leaves ends the run.
        """
        name, role, barrier = participant.name, participant.join.role, self.barrier
        if bye.failed is True and self.clock.ended is None:
            self._cannot_continue(participant, bye.reason, wall_ns)
            return
        fails = (
            self.needs_participants
            and self.clock.ended is None
            and self.clock.state != "waiting"
            and role != RECORDER
            and not participant.served_names.isdisjoint(self._agent_names)
            and not lets_drop(self.scenario.processes.on_death, name)
            and barrier.substitute(name) is None
        )
        text = f"{name} left: {bye.reason}"
        data = {"reason": bye.reason, "run_id": self.run_id, "incarnation": participant.join.incarnation}
        if fails:
            text += "; a run that goes on without it fails, unless processes.on_death has drop for it"
            self.left_early.append(f"{name} left at {self.clock.now_ns / 1e9:.2f} s, before the end: {bye.reason}")
        self.outbox.event("leave", name, text, {**data, "fails": True} if fails else data, name)
        barrier.remove(name)
        self.release_drones(name)
        self._expect_again(participant)
        if role == RECORDER and self.needs_participants:
            self.clock.stop(f"the recorder left: {bye.reason}")

    def _cannot_continue(self, participant: Participant, reason: str, wall_ns: int) -> None:
        """Handle the bye of a process that failed, which is not restarted because it would fail again."""
        name, action = participant.name, self._on_death(participant)
        action = "end" if action == "restart" else action
        self.outbox.event("failure", name, reason, {**participant.location, "on_death": action}, name)
        if action == "drop":
            self._drop(name)
            return
        self.release_drones(name)
        if action == "wait":
            self.barrier.mark_dead(name, wall_ns)
        else:
            self.barrier.remove(name)
            self.fail(reason)

    def _expect_again(self, participant: Participant) -> None:
        """Before the start, expect again the processes whose work a lost participant would have done."""
        if self.clock.state == "waiting":
            for each in self._expected:
                if each in participant.served_names:
                    self.barrier.expect(each)

    # Losses

    def died(self, name: str, wall_ns: int) -> None:
        """Handle the loss of a token: the process has died, or has left if it said bye."""
        if self._has_left(name, wall_ns):
            return
        participant = self.barrier.mark_dead(name, wall_ns)
        if participant is None:
            return
        substitute = self.barrier.substitute(name)
        action = "drop" if substitute else self._on_death(participant)
        then = f"{substitute.name} does its work" if substitute else f"on_death: {action}"
        self.outbox.event("death", name, f"{participant} died; {then}", {**participant.location, "on_death": action})
        if action == "drop":
            self._drop(name, is_news=substitute is None)
        elif self.clock.mode == "realtime":
            self.release_drones(name)
        if action == "end":
            self.fail(f"{name} died")

    def _has_left(self, name: str, wall_ns: int) -> bool:
        """Remove a process whose bye awaited the loss of its token; return whether there was such a bye."""
        participant = self.barrier.participants.get(name)
        if participant is None or participant.farewell is None:
            return False
        self._leave(participant, participant.farewell, wall_ns)
        return True

    def _on_death(self, participant: Participant) -> OnDeath:
        """Return what happens when a participant dies."""
        if not self.needs_participants:
            return "drop"
        return roles.on_death(self.scenario.processes.on_death, participant.name, participant.join.role)

    def _may_return(self, participant: Participant) -> bool:
        """Return whether the run waits for a dead process to return."""
        return self._on_death(participant) in ("restart", "wait")

    def _drop(self, name: str, is_news: bool = True) -> None:
        """Continue without a process."""
        self.release_drones(name)
        self.barrier.remove(name)
        if is_news:
            data = {"from_ns": self.clock.now_ns}
            self.outbox.event("drop", name, f"{name} is waited for no longer", data)

    def overdue(self, wall_ns: int) -> str | None:
        """Return a process that has not joined, or not returned after death or silence, in time, if any."""
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
                since_ns = participant.since_wall_ns if self._may_return(participant) else None
            if since_ns and wall_ns - since_ns > return_s * 1e9:
                return participant.name
        return None

    def _start_timeout_s(self, name: str) -> float:
        """Return how long a run waits at its start for an expected process [s, wall time]."""
        program = self.scenario.own_programs.get(name)
        for section in (program, self.scenario.processes):
            if section is not None and section.start_timeout_s is not UNSET:
                return section.start_timeout_s
        if not self.is_launched:
            return math.inf
        is_started = name in self._agent_names or name.partition(".")[0] in ROLES
        return START_TIMEOUT_OWN_S if is_started else START_TIMEOUT_S

    def expired(self, name: str) -> None:
        """End the run, or continue without the process, if a process has not joined or returned in time."""
        processes = self.scenario.processes
        participant = self.barrier.participants.get(name)
        if participant is not None:
            location, action = participant.location, self._on_death(participant)
            if action not in ("drop", "end"):  # on_death applies to silent processes as well
                role, gating = participant.join.role, processes.gating or ()
                action = roles.on_overdue(processes.on_overdue or {}, name, role, gating)
            text = f"{name} has not come back within {processes.return_s:g} s"
        elif name in self.barrier.absent():
            location, action = {"host": "", "pid": 0}, "drop" if lets_drop(processes.on_overdue or {}, name) else "end"
            text = f"{name} has not joined within {self._start_timeout_s(name):g} s; see processes.start_timeout_s"
        else:
            return
        self.outbox.event("overdue", name, text, {**location, "on_overdue": action})
        if action == "drop":
            self._drop(name)
        else:
            self.fail(text)

    def silence_changed(self, name: str, since_wall_ns: int | None) -> None:
        """Note that a process has been silent since its last health message at `since_wall_ns`; None: it is back."""
        participant = self.barrier.participants.get(name)
        if participant is None or not participant.alive:
            return
        participant.silent_wall_ns = since_wall_ns
        if since_wall_ns is None:
            self.outbox.event("silent_end", name, f"{participant} is back", participant.location)
        else:
            text = f"{participant} shows no sign of life; it is stopped, or its host is gone"
            self.outbox.event("silent", name, text, participant.location)

    def reader_closed(self, text: str, data: dict[str, Any]) -> None:
        """Report a reader whose link was closed because it stopped reading; the run does not wait for it."""
        if self.budgets.strangers.spend("slow_reader"):
            self.outbox.event("slow_reader", data["address"], text, data)

    def falsely_joined(self, name: str, join: Join, fault: str) -> None:
        """Report a withheld join without a process behind it; an existing participant of that name stays.

        Within the budget, it is published as an event; beyond, it is only counted as a refusal.
        """
        if not self.budgets.strangers.spend("no_show"):
            self.outbox.refusals.count += 1
            return
        data = {"host": join.host, "pid": join.pid, "incarnation": join.incarnation}
        effect = "replaces no process" if name in self.barrier.participants else "is not waited for"
        text = f"{name} on {join.host} (pid {join.pid}) {fault}; its join {effect}"
        self.outbox.event("no_show", name, text, data)

    def not_shown(self, name: str, fault: str, wall_ns: int) -> None:
        """Undo the join of a participant that has not proved its existence; one that had rejoined counts as dead."""
        participant = self.barrier.participants.get(name)
        if participant is None or not participant.alive or self._has_left(name, wall_ns):
            return
        self.outbox.event("no_show", name, f"{participant} {fault}", participant.location)
        if participant.rejoined:
            self.died(name, wall_ns)
            return
        self._drop(name)
        self._expect_again(participant)

    def await_return(self, wall_ns: int, all_died: bool) -> None:
        """In a restarted world, stop time until each participant has rejoined or died.

        Args:
            all_died: whether all participants died with the world and must be restarted.
        """
        self.statistics.rate.stand_still(wall_ns)
        self.barrier.await_return(wall_ns, all_died)

    # Requests

    def control(self, request: ControlRequest) -> ControlAnswer:
        """Answer a request on `world/control` and publish it as an event, within the budget of its source.

        Beyond the budget, a request that changes the flight is refused, since a rerun must be able to repeat it from
        its event. The event has the arguments, shortened if too long.
        """
        self.requests += 1
        op, source = request.op[:40], request.source if keys.PROCESS_NAME.fullmatch(request.source) else ""
        has_joined = source in self.barrier.participants
        may_change = op not in FLIGHT_REQUESTS or self.budgets.allows(source, "", has_joined)
        answer = self._answer(request) if may_change else ControlAnswer(False, str(too_many(source)))
        if answer.ok:
            is_event = self.budgets.spend(source, "", has_joined)
        else:
            is_event = self.outbox.refused_requests.add(source, op, answer.error) is not None
        if is_event:
            text = f"{source or 'somebody'} asks {op}: {'done' if answer.ok else answer.error}"
            args = request.args
            if len(msgspec.msgpack.encode(args)) > ARGS_BYTES_MAX:
                items = list(args.items())[:8]
                args = {str(k)[:40]: value if number(value) is not None else str(value)[:80] for k, value in items}
            self.outbox.event("control", op, text, {"args": args, "ok": answer.ok}, source)
        return answer

    def _answer(self, request: ControlRequest) -> ControlAnswer:
        """Carry out a request, or refuse it, and return the answer."""
        operation = self._operations.get(request.op)
        result: Refusal | ControlAnswer | None
        if request.source and not keys.PROCESS_NAME.fullmatch(request.source):
            result = Refusal("source", repr(request.source[:48]), "must be 1 to 48 of a-z 0-9 _ . -")
        elif operation is None:
            allowed = f"must be one of {', '.join([*self._operations, 'replay'])}"
            result = Refusal("op", repr(request.op[:40]), allowed)
        else:
            result = operation(request)
        if isinstance(result, ControlAnswer):
            return result
        return ControlAnswer(True) if result is None else ControlAnswer(False, str(result))

    # Time

    def may_advance(self) -> bool:
        """Return whether the world may advance to the next gate, apart from pacing."""
        clock = self.clock
        if clock.is_halted or self.barrier.away():
            return False
        if clock.state == "waiting":
            return not self.barrier.absent()
        return clock.mode == "realtime" or not self.barrier.blocking(clock.required_ns)

    def blocking(self, ahead_ns: int = 0) -> list[Participant]:
        """Return the participants whose dones are missing for the next gate, or for the gate `ahead_ns` after it."""
        return self.barrier.blocking(self.clock.required_ns + ahead_ns)

    def blocking_clock(self) -> list[Participant]:
        """Return the participants that block the clock if nothing else does; none outside lockstep."""
        clock = self.clock
        waits = clock.mode == "lockstep" and clock.state == "running" and not clock.is_halted
        return self.blocking() if waits else []

    def must_wait_for(self, participant: Participant) -> bool:
        """Return whether a participant's first step may take any length of time.

        It may if the process is unpaced, or if the scenario needs it and it replaced no living process.
        """
        if participant.served_names <= self.unpaced:
            return True
        return not participant.successor and not participant.served_names.isdisjoint(self._expected)

    def waiting_for(self, wall_ns: int) -> tuple[Waiting, ...]:
        """Return the processes that the world is waiting for."""
        if self.clock.mode == "realtime" and self.clock.state != "waiting":
            return self.missed(wall_ns)
        return self.barrier.waiting_for(self.clock.required_ns, wall_ns, self.start_wall_ns, self._data_flow.feeds)

    def missed(self, wall_ns: int) -> tuple[Waiting, ...]:
        """Return, in realtime, the participants that are dead, silent or away; the world waits only for those away."""
        if self.clock.mode != "realtime":
            return ()
        missed = (p for p in self.barrier.participants.values() if p.is_missed)
        return tuple(p.waiting(wall_ns, since_ns=p.silent_wall_ns if p.alive else None) for p in missed)

    def waiting_to_leave(self, since_end_ns: int = 0) -> tuple[Waiting, ...]:
        """Return the participants that have not left, and a dead recorder expected back to finish the record."""
        participants = self.barrier.participants.values()
        waited = [p for p in participants if p.alive or (p.join.slack_ns > 0 and self._may_return(p))]
        return tuple(Waiting(p.name, p.join.host, since_end_ns / 1e9) for p in waited)

    # Publication

    def clock_message(self, waiting_for: tuple[Waiting, ...] = ()) -> run_messages.Clock:
        """Return the next message of `clock`."""
        clock, now_ns = self.clock, self.clock.now_ns
        return run_messages.Clock(
            t_ns=now_ns,
            seq=self.outbox.next_seq(keys.CLOCK),
            run_id=self.run_id,
            step=now_ns // clock.gate_ns,
            state=clock.state,  # type: ignore[arg-type]
            rate=round(self.statistics.rate.now(), 3),
            waiting_for=waiting_for,
        )

    def publish_end(self) -> None:
        """Put the end of the run into the outbox: event `end`, clock `stopped`."""
        self.clock.stop("ended")
        for participant in list(self.barrier.participants.values()):
            if participant.farewell is not None:
                self._leave(participant, participant.farewell, 0)
        self.outbox.event("end", WORLD, self.ended or "", self.result())
        self.clock.state = "stopped"
        self.outbox.put(keys.CLOCK, self.clock_message())

    def take_outbox(self) -> list[KeyedMessage]:
        """Return the messages to publish, in order, and clear the outbox."""
        pending, self.outbox.pending = self.outbox.pending, []
        return pending


class DataFlow:
    """Which processes read which processes' outputs, by the rights of their roles; unknown roles read nothing."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._rights: dict[str, roles.Rights] = {}
        self._known: dict[tuple[str, str], bool] = {}

    def feeds(self, writer: str, reader: str) -> bool:
        """Return whether `reader` reads outputs of `writer`, but not vice versa."""
        return self._writes_for(writer, reader) and not self._writes_for(reader, writer)

    def _writes_for(self, writer: str, reader: str) -> bool:
        pair = writer, reader
        if pair not in self._known:
            for name in pair:
                if name not in self._rights:
                    self._rights[name] = roles.rights_for(name, self._scenario)
            reads, writes = self._rights[reader], self._rights[writer]
            read = {*reads.reads} - {*reads.writes}  # keys that the reader also writes are read for last values only
            self._known[pair] = any(roles.permits(read, key) for key in writes.writes if "*" not in key)
        return self._known[pair]
