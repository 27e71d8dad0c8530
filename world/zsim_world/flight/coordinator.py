"""The hub of a run: who takes part, who is waited for, what is told. Of a flight (World) and of a replay (Playback).

No session, no clock: a runner hands it what arrives (`handle`, `died`, `control`), asks whether it may go on
(`may_advance`), lets it go on (`advance`), and publishes what it puts into the outbox. Wall times are passed in.
"""

import math
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

from zsim.contract import keys, messages
from zsim.errors import RunError
from zsim.runtime.agent import Output
from zsim.scenario.on_death import on_death
from zsim.scenario.scenario import Scenario
from zsim_world.flight.admission import data_of, warnings
from zsim_world.flight.barrier import Barrier, Participant
from zsim_world.flight.control_requests import TimeRequests, brief
from zsim_world.flight.refusal_log import Refusals
from zsim_world.flight.run_statistics import Measurements

Said = tuple[str, Any]  # key and message; or keys.GATE and GateMessages


class Hub(ABC):
    """What a flight and a replay have in common.

    Args:
        scenario: resolved.
        mode: "lockstep" or "realtime".
        rate: simulated per wall seconds to pace at; 0 = as fast as possible.
        wall_ns: monotonic wall time.
        run_id: given by a launcher, and by tests that compare records.
        expected: names of the processes without which the run does not start.

    Attributes:
        names: of the drones, in scenario order.
        also_asked: keys beside `world/control` on which requests are answered, all with a refusal.
        leaps: how often time was moved otherwise than gate by gate.
        ended: why the run is over, None while it goes on.
        diverged: what is to be raised once everybody has been told the end, None for a run that ended well.
    """

    also_asked: tuple[str, ...] = ()

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
        self.mode = mode
        self.rate = rate
        self.run_id = run_id or uuid.uuid4().hex[:12]
        self.names = [drone.name for drone in scenario.drones]
        self.gate_ns = round(scenario.time.gate_ms * 1e6)
        self.delay_ns = scenario.time.command_delay_gates * self.gate_ns
        self.last_ns = round(scenario.duration_s * 1e9) // self.gate_ns * self.gate_ns
        self.outbox: list[Said] = []
        self.state = "waiting"
        self.ended: str | None = None
        self.diverged: RunError | None = None
        self._wall_ns = wall_ns
        self._start_wall_ns = wall_ns()
        self.barrier = Barrier(self.run_id, self.gate_ns, expected)
        self._expected = expected
        self.leaps = self.steps_allowed = 0
        self._requests = TimeRequests(self)
        self._measured = Measurements(math.inf)
        self._refusals = Refusals()
        self._seq: dict[str, int] = {}

    @property
    @abstractmethod
    def now_ns(self) -> int:
        """Return the newest gate; 0 before the start too."""

    @abstractmethod
    def info(self) -> messages.Info:
        """Return the message of `world/info`."""

    @abstractmethod
    def advance(self, wall_ns: int) -> None:
        """Go to the next gate (or publish gate 0) and put all its messages into the outbox."""

    @abstractmethod
    def views(self, seq: int) -> Sequence[Output]:
        """Return what eyes are shown as of this gate."""

    @abstractmethod
    def result(self) -> dict[str, Any]:
        """Return what the run measured of itself."""

    @abstractmethod
    def _command(self, drone: str, kind: str, message: Any) -> bool:
        """Take a command to a drone; return False for one that has come before."""

    def _leave_drones(self, name: str) -> None:  # noqa: B027 - where nobody flies, nobody leaves
        """Take the drones from a process that flew them and is gone."""

    @property
    def refused(self) -> int:
        """Return how many messages were refused."""
        return self._refusals.count

    @property
    def next_ns(self) -> int:
        """Return the gate that a newcomer is first waited for."""
        return 0 if self.state == "waiting" else self.now_ns + self.gate_ns

    # What arrives

    def handle(self, key: str, message: Any, wall_ns: int) -> None:
        """Take one message that a participant or anyone else published."""
        kind, name, what = keys.parts(key)
        if kind == "process" and what == "done":
            self._on_done(name, message, wall_ns)
        elif kind == "drone" and what.startswith("cmd/"):
            self.barrier.received(message.source)
            if self._command(name, what[4:], message):
                self._measured.ages.arrived(message.t_ns, wall_ns)
        elif kind == "process" and what == "join":
            self._on_join(name, message, wall_ns)
        elif kind == "process" and what == "bye":
            self._on_bye(name, message)

    def output_of(self, source: str) -> None:
        """Count an output (estimate, cluster state) of a participant."""
        self.barrier.received(source)

    def _on_done(self, name: str, message: messages.Done, wall_ns: int) -> None:
        reason = self.barrier.done(name, message, self.now_ns, wall_ns)
        if reason:
            self.refuse(name, f"process/{name}/done", reason)

    def _on_join(self, name: str, message: messages.Join, wall_ns: int) -> None:
        former, replaced = self.barrier.participants.get(name), self.barrier.replaced(name, message)
        reason = self.barrier.join(name, message, self.next_ns, wall_ns)
        if reason:
            self.refuse(name, f"process/{name}/join", reason)
            return
        again = former is not None and former.incarnation != message.incarnation
        kind = ("superseded" if former.alive else "restart") if former and again else "join"
        joined = self.barrier.participants[name]
        data = data_of(joined, message)
        if former is not None and again:
            data["former_pid"] = former.pid
        self.event(kind, name, f"{name} on {message.host} (pid {message.pid})", source=name, **data)
        for dead in replaced:
            self._leave_drones(dead.name)
        for warned, text, about in warnings(self.barrier, name, message):
            self.event(warned, name, text, **about)

    def _on_bye(self, name: str, message: messages.Bye) -> None:
        participant = self.barrier.remove(name)
        if participant is not None:
            self.event("leave", name, f"{name} left: {message.reason}", source=name, reason=message.reason)
            self._leave_drones(name)
            if self.state == "waiting":
                self._expect_again(name, *participant.serves)
            self._after_leaving(participant, message.reason)

    def _after_leaving(self, participant: Participant, reason: str) -> None:
        """Do what the leave of a process means for the run."""
        if participant.role == "recorder" and not self.ended:
            self.stop(f"the recorder left: {reason}")

    def _fate(self, participant: Participant) -> str:
        """Return what is to be done when a process has died."""
        return on_death(self.scenario.processes.on_death, participant.name, participant.role)

    def _expect_again(self, *names: str) -> None:
        for name in names:
            if name in self._expected:
                self.barrier.expect(name)

    def died(self, name: str, wall_ns: int) -> None:
        """Take the death of a process: its token is gone without a bye."""
        participant = self.barrier.died(name, wall_ns)
        if participant is None:
            return
        stand_in = self.barrier.stand_in(name)
        what = "drop" if stand_in else self._fate(participant)
        then = f"{stand_in.name} does its work" if stand_in else f"on_death: {what}"
        text = f"{name} on {participant.host} (pid {participant.pid}) died; {then}"
        self.event("death", name, text, host=participant.host, pid=participant.pid, on_death=what)
        if self.mode == "realtime" or what == "drop":
            self._leave_drones(name)
        if what == "drop":
            self.barrier.remove(name)
        if what == "drop" and stand_in is None:
            self.event("drop", name, f"{name} is waited for no longer", from_ns=self.now_ns)
        if what == "end":
            self.stop(f"{name} died")

    def refuse(self, source: str, subject: str, reason: str) -> None:
        """Count a refusal, and tell it while it is not told too often."""
        text = self._refusals.text(source, subject, reason)
        if text is not None:
            self.event("refused", subject, text, source=source, reason=reason)

    # Requests

    def control(self, request: messages.ControlRequest) -> messages.ControlAnswer:
        """Answer a request on `world/control`; every one is an event."""
        answer = self._requests.answer(request)
        op, source = request.op[:40], request.source if keys.PROCESS_NAME.fullmatch(request.source) else ""
        text = f"{source or 'somebody'} asks {op}: {'done' if answer.ok else answer.error}"
        self.event("control", op, text, source=source, args=brief(request.args), ok=answer.ok)
        return answer

    def refusal_at(self, key: str) -> str | None:
        """Return why what is asked on one of `also_asked` is refused; None where somebody else answers there."""
        return f"{key}: is not answered here"

    def stop(self, reason: str) -> None:
        """End the run after the present gate; of several reasons the first is told."""
        if self.ended is None:
            self.ended = reason

    # Time

    def may_advance(self) -> bool:
        """Tell whether nothing but pacing keeps the world from the next gate."""
        if self.ended is not None:
            return False
        if self.state == "waiting":
            return not self.barrier.absent()
        if self.state == "paused" and self.steps_allowed == 0:
            return False
        return self.mode == "realtime" or not self.barrier.blocking(self.now_ns - self.delay_ns)

    def owing(self, ahead_ns: int = 0) -> list[Participant]:
        """Return who owes a done without which the world cannot go on, or could not after so much more time."""
        return self.barrier.blocking(self.now_ns - self.delay_ns + ahead_ns)

    def waiting_for(self, wall_ns: int) -> tuple[messages.Waiting, ...]:
        """Return whom the world waits for now."""
        if self.mode == "realtime" and self.state != "waiting":
            return tuple(
                messages.Waiting(p.name, p.host, (wall_ns - p.since_wall_ns) / 1e9)
                for p in self.barrier.participants.values()
                if not p.alive
            )
        return self.barrier.waiting_for(self.now_ns - self.delay_ns, wall_ns, self._start_wall_ns)

    def missed_own_deadline(self) -> None:
        """Count a gate that the world itself published more than a gate late."""
        self._measured.own_misses += 1

    # What is told

    def tell_clock(self, waiting_for: tuple[messages.Waiting, ...] = ()) -> None:
        """Put a `clock` into the outbox."""
        clock = messages.Clock(
            t_ns=self.now_ns,
            seq=self._next_seq(keys.CLOCK),
            run_id=self.run_id,
            step=self.now_ns // self.gate_ns,
            state=self.state,  # type: ignore[arg-type]
            rate=round(self._measured.rate.now(), 3),
            waiting_for=waiting_for,
        )
        self.outbox.append((keys.CLOCK, clock))

    def tell_end(self, wall_ns: int) -> None:
        """Put the last words of the run into the outbox: event `end`, clock `stopped`."""
        self.ended = self.ended or "ended"
        self.event("end", "world", self.ended, **self.result())
        self.state = "stopped"
        self.tell_clock()

    def event(self, kind: str, subject: str, text: str, source: str = "world", **data: Any) -> None:
        """Put an event into the outbox."""
        self.tell(kind, subject, text, source, data)

    def tell(self, kind: str, subject: str, text: str, source: str, data: dict[str, Any]) -> None:
        """Put an event with any data into the outbox."""
        message = messages.Event(self.now_ns, self._next_seq(keys.EVENT), kind, source, subject, text, data)
        self.outbox.append((keys.EVENT, message))

    def take_outbox(self) -> list[Said]:
        """Return what is to be published, in order, and forget it."""
        outbox, self.outbox = self.outbox, []
        return outbox

    def _next_seq(self, key: str) -> int:
        count = self._seq.get(key, 0)
        self._seq[key] = count + 1
        return count
