"""What a flight (World) and a replay (Playback) have in common: who takes part, who is waited for, what is published.

No session, no clock: a runner hands it what arrives (`handle`, `losses`, `control`), asks whether it may go on
(`may_advance`), lets it go on (`advance`), and publishes its outbox. Wall times are passed in.
"""

import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
from msgspec import UNSET

from zsim.contract import keys, messages, run_messages
from zsim.contract.fingerprint import fingerprint
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.errors import RunError, RunFailedError
from zsim.runtime.agent import Output
from zsim.scenario import rights
from zsim.scenario.rights import WORLD
from zsim.scenario.role_table import OnDeath, agent_names, lets_drop, on_death
from zsim.scenario.scenario import Scenario
from zsim_world.run.barrier import Barrier, Participant
from zsim_world.run.outbox import STRANGERS_MAX, Budgets, KeyedMessage, Refusal, RunOutbox, too_many
from zsim_world.run.process_losses import ProcessLosses
from zsim_world.run.run_clock import Operation, RunClock, number
from zsim_world.run.run_statistics import RunStatistics

FLIGHT_REQUESTS = frozenset({"acquire", "release", "fault_add", "fault_clear"})  # that change a flight
RECORDER = "recorder"  # name and role
_JOIN = "process/"  # before a name: what is counted of its joins
ARGS_BYTES_MAX = 4000  # of arguments that an event repeats as they are; any operation needs far fewer


class Coordinator(ABC):
    """One run, as its participants see it.

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
        barrier: who takes part.
        outbox: what is to be published.
        budgets: of what sources may still do.
        losses: what the loss of a process means.
        requests: on `world/control`, all of them counted.
        statistics: of the run so far.
        refused_queries: keys beside `world/control` on which requests are answered, all with a refusal.
        is_launched: whether a launcher has started it and its processes, and not people one after the other.
        external: names of the drones of which drivers publish sensors, truth and status.
        unpaced: names of the processes that step when a driver publishes, and not at every gate.
        failure: what is to be raised once the end is published, None for a run that ended well.
        left_early: a line for each process that the run needed and that left it before the end.
    """

    refused_queries: tuple[str, ...] = ()
    is_launched: bool = False
    external: frozenset[str] = frozenset()
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
        self.names = [drone.name for drone in scenario.drones]
        self.clock = RunClock(scenario.time, mode, rate)
        self.outbox = RunOutbox(lambda: self.clock.now_ns)
        self.budgets = Budgets(lambda: self.clock.now_ns, self.clock.gate_ns)
        self.requests = 0
        self.barrier = Barrier(self.run_id, self.clock.gate_ns, expected)
        self.statistics = RunStatistics()
        self.failure: RunError | None = None
        self.left_early: list[str] = []
        self._expected = expected
        self._own_names = {RECORDER, *expected, *agent_names(scenario)}
        self._data_flow = DataFlow(scenario)
        self.start_wall_ns = wall_ns()
        self._operations: dict[str, Operation] = self.clock.operations()
        self.losses = ProcessLosses(self)

    @abstractmethod
    def info(self) -> messages.Info:
        """Return the message of `world/info`."""

    @abstractmethod
    def advance(self, wall_ns: int) -> None:
        """Go to the next gate (or publish gate 0) and put all its messages into the outbox."""

    @abstractmethod
    def views(self, seq: int) -> Sequence[Output]:
        """Return the messages of `view/**` as of this gate."""

    @abstractmethod
    def result(self) -> dict[str, Any]:
        """Return the figures of the run so far."""

    @abstractmethod
    def _handle_command(self, drone: str, kind: str, message: Any) -> bool:
        """Take a command to a drone; return False for a duplicate."""

    def take_of_driver(self, drone: str, message: Any) -> str | None:  # noqa: B027 - a replay has no drivers
        """Take what the driver of an external drone has published; return why it is refused."""

    def release_drones(self, name: str) -> None:  # noqa: B027 - a replay has no commanders
        """Take the drones from a process that flew them and is gone."""

    def on_death(self, participant: Participant) -> OnDeath:
        """Return what the death of a participant means."""
        return on_death(self.scenario.processes.on_death, participant.name, participant.join.role)

    @property
    def now_ns(self) -> int:
        """Return the newest gate; 0 before the start too."""
        return self.clock.now_ns

    def fail(self, reason: str) -> None:
        """End the run before its time."""
        if self.ended is None:
            self.failure = RunFailedError(reason)
        self.clock.stop(reason)

    @property
    def ended(self) -> str | None:
        """Return why the run is over, None while it goes on."""
        return self.clock.ended

    # What arrives

    def handle(self, key: str, message: Any, wall_ns: int) -> None:
        """Take one message that a participant or anyone else published."""
        kind, name, what = keys.parts(key)
        if kind == "drone" and what.startswith("cmd/"):
            self.barrier.count_output(message.source)
            if self._handle_command(name, what[4:], message):
                self.statistics.ages.command(message.t_ns, wall_ns)
        elif kind == "process" and what == "done":
            self._handle_done(name, message, wall_ns)
        elif kind == "process" and what == "join":
            self._handle_join(name, message, wall_ns)
        elif kind == "process" and what == "bye":
            self._handle_bye(name, message, wall_ns)

    def count_output(self, source: str) -> None:
        """Count an output (estimate, cluster state) of a participant."""
        self.barrier.count_output(source)

    def give_up_outputs(self, name: str) -> None:
        """Wait no longer for the outputs of a participant that are lost."""
        missing = self.barrier.participants[name].reset_counts()
        if missing:
            text = f"{name}: {missing} of its outputs did not come"
            self.outbox.notice("outputs_missing", name, text, {"missing": missing})

    def _handle_done(self, name: str, message: run_messages.Done, wall_ns: int) -> None:
        refusal = self.barrier.done(name, message, self.now_ns, wall_ns)
        if refusal:
            self.outbox.refuse(name, f"process/{name}/done", refusal)
        elif refusal := self.barrier.take_back_bye(name):
            self.outbox.refuse(name, f"process/{name}/bye", refusal)

    def _handle_join(self, name: str, message: run_messages.Join, wall_ns: int) -> None:
        former, replaced = self.barrier.participants.get(name), self.barrier.replaced(name, message)
        is_new = self._is_new(name)
        refusal = self._join_refusal(name, message, is_new)
        refusal = refusal or self.barrier.join(name, message, self.clock.next_ns, wall_ns)
        if refusal:
            self.outbox.refuse(name, f"process/{name}/join", refusal)
            return
        self.budgets.changes.spend(_JOIN + name)
        if is_new:
            self.budgets.strangers.spend("join")
        joined = self.barrier.participants[name]
        kind, data = "join", joined.entry()
        if former is not None and former.join.incarnation != message.incarnation:
            kind, data["former_pid"] = "superseded" if former.alive else "restart", former.join.pid
        self.outbox.event(kind, name, f"{name} on {message.host} (pid {message.pid})", data, name)
        for dead in replaced:
            self.release_drones(dead.name)
        self._warn_of(joined)

    def _is_new(self, name: str) -> bool:
        """Tell whether the scenario has no process of a name, which never took part either."""
        is_known = name in self._own_names or name in self.barrier.participants
        return not is_known and not self.budgets.changes.knows(_JOIN + name)

    def _join_refusal(self, name: str, message: run_messages.Join, is_new: bool) -> Refusal | None:
        """Return why there have been too many joins; for whom time stands may always come."""
        if is_new and not self.budgets.strangers.allows("join"):
            return Refusal("newcomers", f"beyond {STRANGERS_MAX} at once", "must wait: one may join each second")
        may_join = self._stands_for(name) or self.budgets.changes.allows(_JOIN + name)
        return None if may_join else too_many(name)

    def _stands_for(self, name: str) -> bool:
        """Tell whether time stands until a process comes, or may do so soon."""
        former = self.barrier.participants.get(name)
        if former is None:
            return self.clock.state == "waiting" and name in self._expected
        return former.is_waited_for and former.is_missed

    def _warn_of(self, joined: Participant) -> None:
        """Publish that a newcomer computes with other bits, or does the work of others too."""
        name, join, own = joined.name, joined.join, fingerprint()
        if join.fingerprint and join.fingerprint != own:
            text = f"{name} on {join.host} computes with another numeric fingerprint; the same bits are not promised"
            self.outbox.event("fingerprint", name, text, {"found": join.fingerprint, "expected": own})
        for other, both in self.barrier.duplicates(name).items():
            text = f"{name} and {other} both do the work of {', '.join(sorted(both))}; end one of them"
            self.outbox.event("doubled", name, text, {"other": other})

    def _handle_bye(self, name: str, message: run_messages.Bye, wall_ns: int) -> None:
        participant = self.barrier.participants.get(name)
        if participant is None:
            return
        if refusal := self.barrier.bye_refusal(participant, message):
            self.outbox.refuse(name, f"process/{name}/bye", refusal)
            return
        is_named = UNSET not in (message.run_id, message.incarnation)
        if is_named or not participant.alive or self.ended is not None:
            self.leave(participant, message, wall_ns)
        else:  # of contract 1.0, or somebody else's: the loss of the token decides
            participant.farewell = message

    def leave(self, participant: Participant, bye: run_messages.Bye, wall_ns: int) -> None:
        """Take a participant out that has said bye."""
        name = participant.name
        if bye.failed is True and self.ended is None:
            self.losses.failed(name, bye.reason, wall_ns)
            return
        fails = self._is_missed_from_now(participant)
        text = f"{name} left: {bye.reason}"
        data = {"reason": bye.reason, "run_id": self.run_id, "incarnation": participant.join.incarnation}
        if fails:
            text += "; a run that goes on without it fails, unless processes.on_death has drop for it"
            self.left_early.append(f"{name} left at {self.now_ns / 1e9:.2f} s, before the end: {bye.reason}")
        self.outbox.event("leave", name, text, {**data, "fails": True} if fails else data, name)
        self.barrier.remove(name)
        self.release_drones(name)
        self.expect_again(participant)
        self._after_bye(participant, bye.reason)

    def _is_missed_from_now(self, participant: Participant) -> bool:
        """Tell whether the leave of a process fails the run: it flew by the scenario, and nobody else does its work.

        A program of somebody's own leaves when it is through; the leave of a recorder ends the run.
        """
        if self.ended is not None or self.clock.state == "waiting" or participant.join.role == RECORDER:
            return False
        is_allowed = lets_drop(self.scenario.processes.on_death, participant.name)
        is_needed = not participant.served_names.isdisjoint(agent_names(self.scenario))
        return is_needed and not is_allowed and self.barrier.substitute(participant.name) is None

    def expect_again(self, participant: Participant) -> None:
        """Wait at the start for whom a process that is gone has stood for."""
        if self.clock.state == "waiting":
            for each in self._expected:
                if each in participant.served_names:
                    self.barrier.expect(each)

    def _after_bye(self, participant: Participant, reason: str) -> None:
        """Do what the leave of a process means for the run."""
        if participant.join.role == RECORDER:
            self.clock.stop(f"the recorder left: {reason}")

    def await_return(self, wall_ns: int, all_died: bool) -> None:
        """Let time stand, in a world that was started again, until those who took part are back or dead.

        Args:
            all_died: whether they have to be started again, too.
        """
        self.statistics.rate.stand_still(wall_ns)
        self.barrier.await_return(wall_ns, all_died)

    # Requests

    def control(self, request: ControlRequest) -> ControlAnswer:
        """Answer a request on `world/control`; it is an event, unless its source has had many of its kind.

        One that changes the flight is an event always, as a rerun repeats it: beyond the budget it is refused.
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
            self.outbox.event("control", op, text, {"args": _shortened(request.args), "ok": answer.ok}, source)
        return answer

    def _answer(self, request: ControlRequest) -> ControlAnswer:
        result = self._perform(request)
        if isinstance(result, ControlAnswer):
            return result
        return ControlAnswer(True) if result is None else ControlAnswer(False, str(result))

    def _perform(self, request: ControlRequest) -> Refusal | ControlAnswer | None:
        if request.source and not keys.PROCESS_NAME.fullmatch(request.source):
            return Refusal("source", repr(request.source[:48]), "must be 1 to 48 of a-z 0-9 _ . -")
        operation = self._operations.get(request.op)
        if operation is None:
            return Refusal("op", repr(request.op[:40]), f"must be one of {', '.join([*self._operations, 'replay'])}")
        return operation(request)

    def refusal_at(self, key: str) -> str | None:
        """Return why requests on one of `refused_queries` are refused; None where another process answers there."""
        return f"{key}: is not answered here"

    # Time

    def may_advance(self) -> bool:
        """Tell whether nothing but pacing keeps the world from the next gate."""
        clock = self.clock
        if clock.is_halted or self.barrier.away():
            return False
        if clock.state == "waiting":
            return not self.barrier.absent()
        return clock.mode == "realtime" or not self.barrier.blocking(clock.required_ns)

    def blocking(self, ahead_ns: int = 0) -> list[Participant]:
        """Return the participants whose dones are missing for the next gate, or for one so much later."""
        return self.barrier.blocking(self.clock.required_ns + ahead_ns)

    def blocking_clock(self) -> list[Participant]:
        """Return the participants blocking the clock in lockstep, which would run otherwise."""
        clock = self.clock
        waits = clock.mode == "lockstep" and clock.state == "running" and not clock.is_halted
        return self.blocking() if waits else []

    def must_wait_for(self, participant: Participant) -> bool:
        """Tell whether the scenario has a process that is waited for however long its first step takes."""
        if participant.served_names <= self.unpaced:
            return True
        return not participant.successor and not participant.served_names.isdisjoint(self._expected)

    def waiting_for(self, wall_ns: int) -> tuple[run_messages.Waiting, ...]:
        """Return whom the world waits for now."""
        if self.clock.mode == "realtime" and self.clock.state != "waiting":
            return self.missed(wall_ns)
        return self.barrier.waiting_for(self.clock.required_ns, wall_ns, self.start_wall_ns, self._data_flow.feeds)

    def missed(self, wall_ns: int) -> tuple[run_messages.Waiting, ...]:
        """Return who is dead, silent or not back yet in realtime, where nobody else is waited for."""
        if self.clock.mode != "realtime":
            return ()
        all_of_them = self.barrier.participants.values()
        return tuple(p.missed(wall_ns) for p in all_of_them if p.is_missed)

    def waiting_to_leave(self, since_end_ns: int = 0) -> tuple[run_messages.Waiting, ...]:
        """Return the participants that have yet to leave, and a dead recorder that is to write the rest."""
        participants = self.barrier.participants.values()
        waited = [p for p in participants if p.alive or (p.join.slack_ns > 0 and self.losses.may_return(p))]
        return tuple(run_messages.Waiting(p.name, p.join.host, since_end_ns / 1e9) for p in waited)

    # Publication

    def clock_message(self, waiting_for: tuple[run_messages.Waiting, ...] = ()) -> run_messages.Clock:
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
                self.leave(participant, participant.farewell, 0)
        self.outbox.event("end", WORLD, self.ended or "", self.result())
        self.clock.state = "stopped"
        self.outbox.put(keys.CLOCK, self.clock_message())

    def take_outbox(self) -> list[KeyedMessage]:
        """Return what is to be published, in order, and forget it."""
        return self.outbox.take()


def _shortened(args: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments for an event: as they are, since a rerun repeats them, or shortened if too long."""
    if len(msgspec.msgpack.encode(args)) <= ARGS_BYTES_MAX:
        return args
    pairs = list(args.items())[:8]
    return {str(name)[:40]: value if number(value) is not None else str(value)[:80] for name, value in pairs}


class DataFlow:
    """The flow between the processes of a scenario; of a role that is unknown nothing is known.

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
