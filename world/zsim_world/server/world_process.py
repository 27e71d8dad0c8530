"""The world as a process: the hub of the federation, one loop with two switches, gating and pacing.

Order of this file: `run`, the loop, what arrives, what rarely arrives, publication.
"""

import contextlib
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.contract.messages import ControlAnswer
from zsim.errors import DecodeError
from zsim.runtime.agent import Output
from zsim.runtime.health import HealthMeter
from zsim.scenario import rights
from zsim.scenario.rights import WORLD
from zsim.transport import session
from zsim.transport.session import Query, Sample, Session
from zsim.transport.tls import Identity
from zsim_world.flight.barrier import Participant
from zsim_world.flight.coordinator import Hub
from zsim_world.server import replay_answer
from zsim_world.server.liveliness import Deaths
from zsim_world.server.lost_outputs import unheard
from zsim_world.server.message_history import History
from zsim_world.server.outgoing import Outgoing
from zsim_world.server.pipelining import Burst
from zsim_world.server.world_inputs import TICK_S, Direct, Inputs, Timed

STUCK_NS = 2_000_000_000  # wall time in one turn from which on a person is told; a turn takes milliseconds
CLOCK_STANDING_NS = 1_000_000_000  # contract: clock once a wall second while time stands still
VIEW_PERIOD_NS = 33_333_333  # contract: at most 30 Hz wall
BYE_S = 5.0  # contract: the world waits 5 s at most for byes
RECOVERY_S = 1.0  # a publisher that lives answers a get for its outputs within milliseconds
RETURN_NS = 10_000_000_000  # wall time after a return to the run in which it may take until it can be asked
PHASE_EVERY = 10  # states of a cluster between two looks at the phase that progress shows
Tell = Callable[[str, Any, str], None]
# Outputs first, dones last: whoever says done has sent its outputs before, on the same link.
PROCESSES, VIEWS = "process/", "view/"  # the first have a mailbox of their own, the last are nobody's business here
OWN = keys.process(WORLD, "")
RELAYED = (messages.Estimate, messages.ClusterState, messages.ClusterRequest)


class _Head(msgspec.Struct):
    """What the hub reads of messages that it only passes on."""

    t_ns: int
    seq: int
    source: str = ""
    controller: str = ""  # of a ClusterRequest, whose source is somebody else


class WorldProcess:
    """One world on one session.

    Args:
        link: a listening session.
        world: what to run.
        stopped: asked every TICK_S; a text ends the run with it as the reason.
        tell: told every ("clock" or "event", message, phase of the clusters), every ("health", message, process) and
            every tenth ("state", message, cluster); shows progress.
    """

    def __init__(
        self,
        link: Session,
        world: Hub,
        stopped: Callable[[], str | None] = lambda: None,
        tell: Tell = lambda kind, message, phase: None,
    ) -> None:
        self._link = link
        self._world = world
        self._stopped = stopped
        self._tell = tell
        self._history = History()
        self._burst = Burst(world)
        self._outgoing = Outgoing(link, world, self._history, self._said)
        self._head = msgspec.msgpack.Decoder(_Head)
        self._queries: deque[Query] = deque()
        self._gone: deque[str] = deque()  # whose token seemed to go
        self._deaths = Deaths(link, world, self._take_in_all)
        self._over = threading.Event()
        self._clock_wall_ns = 0
        self._turn_wall_ns = 0  # when the present turn began; 0 when there is none
        self._view_wall_ns = 0
        self._view_seq = 0
        self._health_seq = 0
        self._states_seen: Counter[str] = Counter()
        self._phase = ""
        self._start_wall_ns = 0
        self._start_sim_ns = 0
        self._pace = (0.0, 0)  # of the clock that runs: rate, leaps of time before it
        self.health = HealthMeter(WORLD, host=link.host)

    def run(self) -> None:
        """Run to the end: wait for the participants, integrate, say goodbye.

        Raises:
            DivergedError: the state of a drone was no longer finite; everybody has been told the end before.
        """
        boxes = [self._link.subscribe_others((PROCESSES, VIEWS)), self._link.subscribe(f"{PROCESSES}**")]
        self._inputs: Inputs = Timed(boxes) if self._world.mode == "realtime" else Direct(boxes)
        self._announce()
        ticker = threading.Thread(target=self._tick, name="tick", daemon=True)
        ticker.start()
        try:
            while self._world.ended is None:
                self._turn()
            self._say_goodbye()
        finally:
            self._over.set()
            ticker.join()
            self._inputs.close()
        if self._world.diverged:
            raise self._world.diverged

    def _announce(self) -> None:
        info = self._world.info()
        self._outgoing.publish(Output(keys.INFO, info))
        for expression in (
            keys.INFO,
            keys.CLOCK,
            keys.FAULTS,
            keys.CONTROL,
            keys.replay("*"),
            "drone/*/sensor/status",
            "drone/*/truth",
            "drone/*/estimate",
            "cluster/*/state",
            *self._world.also_asked,
        ):
            self._link.answer(expression, self._on_query)
        self._link.on_token("process/*", self._on_token)
        self._link.declare_token(keys.token(WORLD))

    # The loop

    def _turn(self) -> None:
        self._turn_wall_ns = time.monotonic_ns()
        self._take_in_all()
        self._serve_rare()
        self._recover_short()
        wall_ns = time.monotonic_ns()
        if self._world.ended is None and self._world.may_advance() and not self._burst.holds_back(wall_ns):
            left_ns = self._due_ns(wall_ns) - wall_ns
            if left_ns <= 0:
                self._advance(wall_ns, -left_ns)
            else:
                self._outgoing.flush()
                self._inputs.wait(left_ns / 1e9)
        else:
            self._stand_still(wall_ns)

    def _advance(self, wall_ns: int, late_ns: int) -> None:
        if self._world.mode == "realtime" and late_ns > self._world.gate_ns / self._world.rate:
            self._world.missed_own_deadline()
        self._world.advance(wall_ns)
        self._outgoing.gather()
        if not self._burst.goes_on():
            self._outgoing.send()
        if self._world.diverged is None:
            self._publish_view(wall_ns)
        self.health.step(time.monotonic_ns() - wall_ns)

    def _due_ns(self, wall_ns: int) -> int:
        """Return the wall time of the next gate; the pace starts anew when the rate changes or time stood still."""
        world = self._world
        if world.rate <= 0 or world.state != "running":
            self._pace = (0.0, 0)
            return wall_ns
        if self._pace != (world.rate, world.leaps):
            self._pace = (world.rate, world.leaps)
            self._start_wall_ns, self._start_sim_ns = wall_ns, world.next_ns
        due_ns = self._start_wall_ns + round((world.next_ns - self._start_sim_ns) / world.rate)
        if world.mode == "lockstep" and wall_ns - due_ns > CLOCK_STANDING_NS:
            self._pace = (0.0, 0)
        return due_ns

    def _stand_still(self, wall_ns: int) -> None:
        """Time stands still: say so once a second, and wait for whatever comes."""
        self._outgoing.flush()
        self._burst.end(wall_ns)
        if wall_ns - self._clock_wall_ns >= CLOCK_STANDING_NS:
            self._world.tell_clock(self._world.waiting_for(wall_ns))
            self._outgoing.flush()
        self._inputs.wait_for(self._owed_dones())

    def _owed_dones(self) -> set[str]:
        """Return the keys of the dones without which the world cannot go on."""
        if self._world.state != "running" or self._world.mode == "realtime":
            return set()
        return {keys.process(p.name, "done") for p in self._burst.owing()}

    def _say_goodbye(self) -> None:
        """Publish the end, then wait until every participant that lives has said bye."""
        self._turn_wall_ns = 0
        self._world.tell_end(time.monotonic_ns())
        self._outgoing.flush()
        until_s = time.monotonic() + BYE_S
        while time.monotonic() < until_s and any(p.alive for p in self._world.barrier.participants.values()):
            self._inputs.wait(TICK_S)
            self._take_in_all()
            self._serve_rare()
            self._outgoing.put_batch()
        self._outgoing.flush()

    # What arrives

    def _take_in_all(self) -> None:
        for wall_ns, sample in self._inputs.drain():
            if not sample.key.startswith(OWN):  # it has noted its own words when it said them
                self._take_in(wall_ns, sample)

    def _take_in(self, wall_ns: int, sample: Sample) -> None:
        key = sample.key
        self.health.received += 1
        kind = messages.type_of(key)
        try:
            if kind in RELAYED:
                self._outgoing.passed(sample)
                self._pass_on(key, sample.payload)
            elif key.startswith(PROCESSES) or (key.startswith("drone/") and "/cmd/" in key):
                self._outgoing.passed(sample)
                message = messages.decode(key, sample.payload)
                self._history.add(key, sample.payload, message.t_ns)
                if type(message) is messages.Join:
                    self._suspect_gone()
                    self._deaths.joins(keys.thing(key), message)
                self._world.handle(key, message, wall_ns)
                if type(message) is messages.Health:
                    self._deaths.heard(keys.thing(key))
                    self._tell("health", message, keys.thing(key))
            elif kind is None:
                self._outgoing.passed(sample)  # a key of somebody's own
            else:
                raise DecodeError(f"{key}: only the world publishes here")
        except DecodeError as error:
            self.health.refused += 1
            self._world.refuse("somebody", key[:80], str(error))
            self._count_unread(sample)

    def _count_unread(self, sample: Sample) -> None:
        """Count an output that was refused, so that its sender's done is not taken to be short of it."""
        with contextlib.suppress(DecodeError):  # nobody can be named
            head = self._head_of(sample.key, sample.payload)
            self._world.output_of(head.controller or head.source)

    def _pass_on(self, key: str, payload: bytes) -> None:
        """Keep an output that the hub only relays, and count it for the done of who sent it."""
        head = self._head_of(key, payload)
        if head.t_ns > self._world.now_ns:
            raise DecodeError(f"{key}: t_ns is {head.t_ns}; must be <= {self._world.now_ns}, the newest gate")
        self._history.add(key, payload, head.t_ns)
        kind = messages.type_of(key)
        if kind is messages.ClusterState:
            self._look_at_phase(key, payload)
        role = "estimator" if kind is messages.Estimate else "controller"
        source = head.controller if kind is messages.ClusterRequest else head.source
        self._world.output_of(source or f"{role}.{keys.thing(key)}")

    def _head_of(self, key: str, payload: bytes) -> _Head:
        try:
            return self._head.decode(payload)
        except messages.REFUSALS as error:
            raise DecodeError(f"{key}: {error}; must be a map with t_ns and seq") from error

    def _look_at_phase(self, key: str, payload: bytes) -> None:
        if self._states_seen[key] % PHASE_EVERY == 0:
            state: messages.ClusterState = messages.decode_as(messages.ClusterState, payload, key)
            self._phase = state.phase
            self._tell("state", state, keys.thing(key))
        self._states_seen[key] += 1

    def _recover_short(self) -> None:
        """Ask a participant again for outputs that it counted and that did not come, as after a cut link."""
        for participant in self._world.barrier.short():
            if self._world.mode == "realtime":
                participant.doubtful = False
                continue
            lost = self._unheard(participant)
            if lost is None and participant.again and time.monotonic_ns() - participant.joined_wall_ns < RETURN_NS:
                continue
            for sample in lost or ():
                self._take_in(time.monotonic_ns(), sample)
            missing = participant.write_off()
            if missing:
                text = f"{participant.name}: {missing} of its outputs did not come"
                self._world.event("outputs_missing", participant.name, text, missing=missing)

    def _unheard(self, participant: Participant) -> list[Sample] | None:
        """Return what a participant has kept of its outputs and that has not come; None if it does not answer."""
        key = keys.process(participant.name, "outputs")
        try:
            answer = self._link.request(key, "outputs", WORLD, timeout_s=RECOVERY_S)
            return unheard(answer.result, participant.done_ns, self._history) if answer.ok else None
        except DecodeError as error:
            self.health.refused += 1
            self._world.refuse(participant.name, key, str(error))
            return []

    # What arrives rarely, from other threads

    def _on_query(self, query: Query) -> None:
        self._queries.append(query)
        self._inputs.wake()

    def _on_token(self, key: str, alive: bool) -> None:
        if not alive:
            self._gone.append(keys.thing(key))
            self._inputs.wake()

    def _tick(self) -> None:
        told_ns = 0
        while not self._over.wait(TICK_S):
            self._inputs.wake()
            now_ns = time.monotonic_ns()
            if self._turn_wall_ns and now_ns - max(self._turn_wall_ns, told_ns) > STUCK_NS:
                told_ns = now_ns
                self._tell_stuck((now_ns - self._turn_wall_ns) / 1e9)

    def _tell_stuck(self, since_s: float) -> None:
        """Say that a put does not come back; `clock` cannot, since it would have to go the same way."""
        readers = [p.name for p in list(self._world.barrier.participants.values()) if not p.gating]
        who = ", ".join([*readers, "a program that only listens"])
        text = f"nothing can be published for {since_s:.1f} s: a reader takes nothing; one of {who}"
        event = messages.Event(self._world.now_ns, 0, "stuck", WORLD, WORLD, text)
        self._tell("event", event, self._phase)

    def _serve_rare(self) -> None:
        reason = self._stopped()
        if reason:
            self._world.stop(reason)
        while self._queries:
            self._serve_query(self._queries.popleft())
        self._suspect_gone()
        self._deaths.judge_due()
        if self.health.due():
            self._deaths.second()
            seq, self._health_seq = self._health_seq, self._health_seq + 1
            health = self.health.message(self._world.now_ns, seq)
            self._outgoing.publish(Output(keys.process(WORLD, "health"), health))
            self._tell("health", health, WORLD)

    def _suspect_gone(self) -> None:
        while self._gone:
            self._deaths.suspect(self._gone.popleft())

    def _serve_query(self, query: Query) -> None:
        if query.expression in self._world.also_asked:
            self._refuse(query)
            return
        asker = keys.thing(query.expression) if keys.matches(keys.replay("*"), query.expression) else None
        if query.expression != keys.CONTROL and asker is None:
            for key, payload in self._history.last(query.expression):
                query.reply(key, payload)
            query.end()
            return
        try:
            answer = self._do(query.request(), asker)
        except DecodeError as error:
            answer = ControlAnswer(ok=False, error=str(error))
        query.answer(answer)
        self._outgoing.flush()

    def _refuse(self, query: Query) -> None:
        """Refuse a request that nobody takes here, unless somebody else answers it."""
        reason = self._world.refusal_at(query.expression)
        if reason is None:
            query.end()
        else:
            query.answer(ControlAnswer(ok=False, error=reason))

    def _do(self, request: messages.ControlRequest, asker: str | None) -> ControlAnswer:
        """Do what is asked on `world/control`, or, by a process of which access control knows the name, on its own."""
        if request.op == "replay":
            return replay_answer.answer(request, self._history, self._readable_by(asker))
        if asker is not None:
            return ControlAnswer(ok=False, error=f"op is {request.op[:40]!r}; must be replay")
        return self._world.control(request)

    def _readable_by(self, asker: str | None) -> tuple[str, ...]:
        if asker is None or not self._link.guarded:
            return ("**",)
        return rights.of(asker, self._world.scenario).reads

    # Publication

    def _said(self, key: str, message: Any) -> None:
        if key == keys.CLOCK:
            self._clock_wall_ns = time.monotonic_ns()
            self._tell("clock", message, self._phase)
        elif key == keys.EVENT:
            self._tell("event", message, self._phase)

    def _publish_view(self, wall_ns: int) -> None:
        if wall_ns - self._view_wall_ns < VIEW_PERIOD_NS:
            return
        self._view_wall_ns = wall_ns
        for key, message in self._world.views(self._view_seq):
            self._link.put(key, message)
        self._view_seq += 1


def run(
    world: Hub,
    endpoints: Sequence[str],
    stopped: Callable[[], str | None] = lambda: None,
    tell: Tell = lambda kind, message, phase: None,
    ready: Callable[[], None] = lambda: None,
    identity: Identity | None = None,
) -> None:
    """Listen on the endpoints, say that it is `ready`, and run the world to its end.

    Raises:
        SessionError: an endpoint is taken, or the identity is of no use.
    """
    mode: session.Mode = "lockstep" if world.mode == "lockstep" else "realtime"
    with session.listen(endpoints, world.scenario.federation, mode, identity) as link:
        ready()
        WorldProcess(link, world, stopped, tell).run()
