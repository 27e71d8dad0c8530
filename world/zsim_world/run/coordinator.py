"""What a flight (World) and a replay (Playback) have in common: what arrives, what is asked for, what time waits for.

No session, no clock: a runner passes on what arrives, asks whether it may go on (`may_advance`), lets it go on
(`advance`), and publishes its outbox. Wall times are passed in.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import msgspec

from zsim.contract import keys, messages, run_messages
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.runtime.agent import Output
from zsim.scenario.rights import WORLD
from zsim_world.run.barrier import Participant
from zsim_world.run.outbox import KeyedMessage, Refusal, too_many
from zsim_world.run.participants import Participants
from zsim_world.run.run_clock import number

FLIGHT_REQUESTS = frozenset({"acquire", "release", "fault_add", "fault_clear"})  # that change a flight
ARGS_BYTES_MAX = 4000  # of arguments that an event repeats as they are; any operation needs far fewer


class Coordinator(Participants, ABC):
    """One run, as its participants see it.

    Attributes:
        refused_queries: keys beside `world/control` on which requests are answered, all with a refusal.
        external: names of the drones of which drivers publish sensors, truth and status.
    """

    refused_queries: tuple[str, ...] = ()
    external: frozenset[str] = frozenset()

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

    def take_of_driver(self, drone: str, message: Any) -> str | None:
        """Take a message of an external drone's driver; return why it is refused. A replay has no drivers."""

    @property
    def now_ns(self) -> int:
        """Return the newest gate; 0 before the start too."""
        return self.clock.now_ns

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
            self.handle_done(name, message, wall_ns)
        elif kind == "process" and what == "join":
            self.handle_join(name, message, wall_ns)
        elif kind == "process" and what == "bye":
            self.handle_bye(name, message, wall_ns)

    def count_output(self, source: str) -> None:
        """Count an output (estimate, cluster state) of a participant."""
        self.barrier.count_output(source)

    def await_return(self, wall_ns: int, all_died: bool) -> None:
        """Let time stand, in a world that was started again, until the participants are back or dead.

        Args:
            all_died: whether they have to be started again, too.
        """
        self.statistics.rate.stand_still(wall_ns)
        self.barrier.await_return(wall_ns, all_died)

    # Requests

    def control(self, request: ControlRequest) -> ControlAnswer:
        """Answer a request on `world/control`; it is an event, unless its source has made too many of its kind.

        A request that changes the flight is always an event, since a rerun repeats it: beyond the budget it is refused.
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
        """Tell whether the next gate may come, but for pacing."""
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
        """Tell whether the scenario needs a participant, so that it is waited for however long its first step takes."""
        if participant.served_names <= self.unpaced:
            return True
        return not participant.successor and not participant.served_names.isdisjoint(self._expected)

    def waiting_for(self, wall_ns: int) -> tuple[run_messages.Waiting, ...]:
        """Return whom the world waits for now."""
        if self.clock.mode == "realtime" and self.clock.state != "waiting":
            return self.missed(wall_ns)
        return self.barrier.waiting_for(self.clock.required_ns, wall_ns, self.start_wall_ns, self._data_flow.feeds)

    def missed(self, wall_ns: int) -> tuple[run_messages.Waiting, ...]:
        """Return the participants that are dead, silent or not back yet in realtime, where nobody is waited for."""
        if self.clock.mode != "realtime":
            return ()
        all_of_them = self.barrier.participants.values()
        return tuple(p.missed(wall_ns) for p in all_of_them if p.is_missed)

    def waiting_to_leave(self, since_end_ns: int = 0) -> tuple[run_messages.Waiting, ...]:
        """Return the participants that have yet to leave, and a dead recorder that is to write the rest."""
        participants = self.barrier.participants.values()
        waited = [p for p in participants if p.alive or (p.join.slack_ns > 0 and self.may_return(p))]
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
