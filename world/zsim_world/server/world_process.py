"""The world as a process on Zenoh: a loop that paces and gates simulated time.

This file defines, in order: `run`; `WorldProcess` (continuation of a run, the loop, queries, calls by other threads);
its inputs and outputs; pacing; detection of a stuck loop.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Any

from zsim.contract import keys, messages, run_messages
from zsim.contract.framing import BATCH_MAX, GateMessages, Pairs, encode_batch
from zsim.contract.run_messages import ControlAnswer
from zsim.contract.snapshot import restore
from zsim.errors import DecodeError, RunError, SessionError
from zsim.runtime.agent import Output
from zsim.runtime.membership import HealthMeter, rare_collections
from zsim.scenario import roles
from zsim.scenario.roles import WORLD
from zsim.transport import connection
from zsim.transport.link_watch import SessionTokens
from zsim.transport.session import Query, ReceivedSample, Session, Subscription
from zsim.transport.tls import Identity
from zsim.transport.zenoh_settings import Mode
from zsim_world.run.barrier import Participant
from zsim_world.run.coordinator import Coordinator
from zsim_world.run.inputs import Advanced, ProgressCallback, Published, Run, Taken
from zsim_world.run.run_clock import RunClock
from zsim_world.run.world import World
from zsim_world.server.liveliness import Admission, LivelinessMonitor, SlowReaders
from zsim_world.server.run_journal import RunJournal

TICK_S = 0.1  # interval at which a waiting world checks the wall clock
IDLE_CLOCK_PERIOD_NS = 1_000_000_000  # contract: `clock` is published once per wall second while time stands still
VIEW_PERIOD_NS = 33_333_333  # contract: at most 30 views per wall second
HEALTH, OWN = keys.process(WORLD, "health"), keys.process(WORLD, "")
BYE_S = 5.0  # contract: the world waits at most 5 s for byes
SERVE_NS = 5_000_000  # wall time after which a world that never waits handles requests and losses again
RECOVERY_S = 1.0  # timeout of a request for outputs, which a living publisher answers within milliseconds
REJOINED_NS = 10_000_000_000  # wall time after a rejoin within which a process may be unable to answer requests
PROCESSES, VIEWS = "process/", "view/"  # the world does not read views
LAG_GATES = 2  # maximum number of gates by which the slowest agent lags when a series of gates begins
GATES_SENT = 3  # number of gates sent together; more would leave agents idle
DELAY_MAX_NS = 50_000_000  # maximum wall-time delay of a gate; by then even a slow agent has every gate it may receive
STANDSTILL_MIN_NS = 1_000_000_000  # lateness of a gate in wall time that indicates a standstill, not just a slow world
STUCK_NS = 2_000_000_000  # wall time after which a turn of the loop is reported as stuck; a turn takes milliseconds
STOPPED_NS = 1_000_000_000  # wall time between checks that indicates a stopped process; ten times the usual interval


def run(
    world: Coordinator,
    endpoints: Sequence[str],
    stopped: Callable[[], str | None] = lambda: None,
    progress: ProgressCallback = lambda kind, message, about: None,
    ready: Callable[[], None] = lambda: None,
    identity: Identity | None = None,
    journal: RunJournal | None = None,
) -> None:
    """Listen on the endpoints, call `ready`, and run the world to its end, continuing from its journal if it has one.

    Raises:
        SessionError: an endpoint is in use, or the identity is unusable.
        RunError: as for `WorldProcess.run`.
    """
    mode: Mode = "lockstep" if world.clock.mode == "lockstep" else "realtime"
    with connection.listen(endpoints, world.scenario.federation, mode, identity) as link:
        ready()
        WorldProcess(link, world, stopped, progress, journal).run()


class WorldProcess:
    """One world on one session.

    Args:
        link: a listening session.
        stopped: called at every gate and every TICK_S; ends the run by returning the reason.
        journal: journal of the run; if a former world process left one, this process continues its run.
        health: meter of this process's health.
    """

    def __init__(
        self,
        link: Session,
        world: Coordinator,
        stopped: Callable[[], str | None] = lambda: None,
        progress: ProgressCallback = lambda kind, message, about: None,
        journal: RunJournal | None = None,
        health: HealthMeter | None = None,
    ) -> None:
        self._link = link
        self._world = world
        self._clock = world.clock
        self._stopped = stopped
        self._progress = progress
        self._journal = journal or RunJournal(None)
        self.health = health or HealthMeter(WORLD, host=link.host)
        self._run = Run(world, self.health, self._journal.note)
        self._history = self._run.history
        self._pacer = Pacer(world.clock)
        self._pipelining = Pipelining(world)
        self._outputs = WorldOutputs(link, self._run, self._on_message, self._journal)
        self._liveliness = LivelinessMonitor(link, self._run, self._take_in)
        self._tokens = SessionTokens(link)
        self._admission = Admission(self._tokens, self._run, link.guarded)
        self._readers = SlowReaders(link, self._tokens, self._run)
        self._queries: deque[Query] = deque()
        self._over = threading.Event()
        self._clock_wall_ns = 0
        self._turn_wall_ns = 0  # when the current turn began; 0 outside a turn
        self._served_wall_ns = 0  # when requests and losses were last handled; 0 once the world has waited
        self._view_wall_ns = 0
        self._view_seq = 0

    def run(self) -> None:
        """Run to the end: wait for the participants, integrate, publish the end.

        Raises:
            RunError: a failure ended the run (its end was still published), or the journal cannot be continued.
        """
        self._inputs = open_inputs(self._link, self._clock.mode == "realtime")
        self._continue()
        if not self._history.last(keys.INFO):
            self._outputs.publish(Output(keys.INFO, self._world.info()))
        answered = [*roles.LAST_VALUES, keys.CONTROL, keys.replay("*"), *self._world.refused_queries]
        answered.append(answered.pop(answered.index(keys.INFO)))  # last: an answer there implies that all are declared
        for expression in answered:
            self._link.declare_queryable(expression, self._on_query)
        self._tokens.watch()
        self._link.on_token(keys.token("*"), self._on_token)
        self._link.declare_process(WORLD)
        ticker = threading.Thread(target=self._tick, name="tick", daemon=True)
        ticker.start()
        try:
            with self._readers.watch, rare_collections():
                while self._world.ended is None:
                    self._turn()
                self._end()
        finally:
            self._over.set()
            ticker.join()
            self._inputs.close()
            self._journal.close()
        if self._clock.is_complete:
            self._journal.remove()
        if self._world.failure:
            raise self._world.failure

    def _continue(self) -> None:
        """Apply the journal without republishing anything, and have the run await its former participants.

        Raises:
            RunError: the journal belongs to another run, or its checkpoint does not fit this version of zsim.
        """
        checkpoint, world = self._journal.open(), self._world
        is_continued = isinstance(world, World) and checkpoint is not None
        if isinstance(world, World):
            truth = self._journal.truth(checkpoint.truth_bytes) if checkpoint else ()
            world.keep_truth(self._journal.keep_truth, truth)
        if checkpoint is not None and checkpoint.state is not None:
            try:
                restore(world, checkpoint.state["world"])
                self._history.last_values = checkpoint.state["last"]
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                text = f"the checkpoint does not fit this version of zsim ({type(error).__name__}: {error})"
                raise RunError(f"{text}; fly the run again") from error
        if is_continued:
            for entry in self._journal.entries():
                entry.apply(self._run)
                self._outputs.gather()
            self._outputs.forget()
        self._run.progress = self._progress
        self._run.on_done, self._run.on_health = self._admission.done_received, self._liveliness.health_received
        if is_continued:
            self._run.call("await_return", time.monotonic_ns(), self._journal.all_died)
            self._liveliness.check_all()
            self._progress("resumed", world.now_ns, WORLD)

    # The loop

    def _turn(self) -> None:
        former_wall_ns, self._turn_wall_ns = self._turn_wall_ns, time.monotonic_ns()
        if former_wall_ns and self._turn_wall_ns - former_wall_ns > STANDSTILL_MIN_NS:  # TICK_S at most if all is well
            self._report_standstill(self._turn_wall_ns - former_wall_ns)
        self._take_in()
        if reason := self._stopped():
            self._clock.stop(reason)
        if self._turn_wall_ns - self._served_wall_ns >= SERVE_NS:
            self._serve_others()
            self._served_wall_ns = self._turn_wall_ns
        recover_lost(self._link, self._run)
        wall_ns = time.monotonic_ns()
        if self._world.ended is None and self._world.may_advance() and not self._pipelining.delays(wall_ns):
            left_ns = self._pacer.due_ns(wall_ns) - wall_ns
            if left_ns <= 0:
                self._advance(wall_ns, -left_ns)
            else:
                self._outputs.flush()
                self._inputs.wait(left_ns / 1e9)
                self._served_wall_ns = 0
        else:
            self._stand_still(wall_ns)

    def _report_standstill(self, standstill_ns: int) -> None:
        """In realtime, restart the pacing after a standstill rather than catch up with the wall clock in a burst."""
        if self._clock.mode == "realtime" and self._clock.state == "running":
            self._pacer.restart()
            cause = "this process or its machine was stopped, or nothing could be published"
            text = f"time stood still for {standstill_ns / 1e9:.1f} s of wall time: {cause}"
            seq, data = self._world.outbox.next_seq(keys.EVENT), {"wall_s": standstill_ns / 1e9}
            event = run_messages.Event(self._world.now_ns, seq, "standstill", WORLD, WORLD, text, data)
            self._outputs.publish(Output(keys.EVENT, event))

    def _take_in(self) -> None:
        """Enter newly arrived messages into the run, and submit joins for admission."""
        for wall_ns, sample in self._inputs.drain():
            key = sample.key
            if key.startswith(OWN):  # the world's own health was entered when it was published
                continue
            self._run.enter(Taken(wall_ns, sample))
            if key.endswith("/join"):
                with suppress(DecodeError):  # it was refused when entered
                    join = messages.decode(key, sample.payload)
                    if isinstance(join, run_messages.Join):
                        self._liveliness.before_join(keys.thing(key), join)
                        self._admission.take(keys.thing(key), join, wall_ns)

    def _advance(self, wall_ns: int, late_ns: int) -> None:
        """Advance to the next gate, publish it and due views, and add a checkpoint to the journal if one is due."""
        world = self._world
        is_late = self._clock.mode == "realtime" and late_ns > self._clock.gate_ns / self._clock.rate
        self._run.enter(Advanced(wall_ns, is_late))
        self._outputs.gather()
        if isinstance(world, World) and self._journal.is_due(world.now_ns, wall_ns):  # the outbox is empty now
            state = {"world": world.checkpoint(), "last": self._history.last_values}
            self._journal.add_checkpoint(state, world.now_ns, wall_ns)
        if not self._pipelining.continues():
            self._outputs.send()
        if world.failure is None and wall_ns - self._view_wall_ns >= VIEW_PERIOD_NS:
            self._view_wall_ns = wall_ns
            for key, message in world.views(self._view_seq):
                self._link.put(key, message)
            self._view_seq += 1
        self.health.step(time.monotonic_ns() - wall_ns)

    def _stand_still(self, wall_ns: int) -> None:
        """While time stands still, publish the clock once a second and wait for input."""
        self._outputs.flush()
        self._pipelining.pause(wall_ns)
        self._publish_clock(wall_ns, self._world.waiting_for)
        required: set[str] = set()
        if self._clock.state == "running" and self._clock.mode != "realtime":
            required = {keys.process(p.name, "done") for p in self._pipelining.blocking()}
        self._inputs.wait_for(required)
        self._served_wall_ns = 0

    def _publish_clock(self, wall_ns: int, waiting_for: Callable[[int], tuple[run_messages.Waiting, ...]]) -> None:
        """Publish `clock` with the processes that the world waits for, at most once a second."""
        if wall_ns - self._clock_wall_ns >= IDLE_CLOCK_PERIOD_NS:
            self._outputs.publish(Output(keys.CLOCK, self._world.clock_message(waiting_for(wall_ns))))

    def _on_message(self, key: str, message: Any) -> None:
        if key == keys.CLOCK:
            self._clock_wall_ns = time.monotonic_ns()
            self._run.progress("clock", message, self._run.phase)
        elif key == keys.EVENT:
            self._run.progress("event", message, self._run.phase)

    def _end(self) -> None:
        """Publish the end, then wait up to BYE_S for all participants to leave.

        A world that was restarted after the end of its run first waits until the former participants have rejoined.
        """
        world, away = self._world, self._world.barrier.away
        while away() and self._stopped() is None:
            self._wait_at_end()
            self._outputs.flush()
            self._publish_clock(self._turn_wall_ns, lambda wall_ns: tuple(p.waiting(wall_ns) for p in away()))
        world.publish_end()
        self._outputs.flush()
        end_ns = self._clock_wall_ns = time.monotonic_ns()
        while time.monotonic_ns() - end_ns < BYE_S * 1e9 and world.waiting_to_leave():
            self._wait_at_end()
            self._outputs.put_batch()
            self._publish_clock(self._turn_wall_ns, lambda wall_ns: world.waiting_to_leave(wall_ns - end_ns))
        self._outputs.flush()
        self._turn_wall_ns = 0

    def _wait_at_end(self) -> None:
        """Take in messages and serve requests after the last gate."""
        self._inputs.wait(TICK_S)
        self._turn_wall_ns = time.monotonic_ns()
        self._take_in()
        self._serve_others()

    # Queries, losses, health

    def _serve_others(self) -> None:
        while self._queries:
            self._serve(self._queries.popleft())
            self._outputs.flush()
        self._liveliness.check_due()
        if self._world.ended is None and (name := self._world.overdue(time.monotonic_ns())):
            self._run.call("expired", name)
        self._readers.report()
        self._admission.check_due(time.monotonic_ns())
        if self.health.due():
            health = self.health.message(self._world.now_ns, self._world.outbox.next_seq(HEALTH))
            self._outputs.publish(Output(HEALTH, health))
            self._run.progress("health", health, WORLD)

    def _serve(self, query: Query) -> None:
        """Answer a query with last values, a page of the history, or the answer to a request.

        Requests arrive on `world/control`; replay requests also on the requesting process's own key, which access
        control can restrict.
        """
        expression = query.expression
        process = keys.thing(expression) if keys.matches(keys.replay("*"), expression) else None
        if expression in self._world.refused_queries:
            reason = self._world.refusal_at(expression)
            if reason is None:  # another process answers the query
                query.end()
            else:
                query.answer(ControlAnswer(ok=False, error=reason))
        elif expression == keys.CONTROL or process is not None:
            try:
                request = query.request()
                if request.op == "replay":
                    readable = ("**",)
                    if process is not None and self._link.guarded:
                        readable = roles.rights_for(process, self._world.scenario).reads
                    answer = self._history.replay(request.args, readable)
                elif process is not None:
                    answer = ControlAnswer(ok=False, error=f"op is {request.op[:40]!r}; must be replay")
                else:
                    answer = self._run.call("control", request)
            except DecodeError as error:
                answer = ControlAnswer(ok=False, error=str(error))
            self._journal.commit()
            query.answer(answer)
        else:
            for key, payload in self._history.last(expression):
                query.reply(key, payload)
            query.end()

    # Called by other threads

    def _on_query(self, query: Query) -> None:
        self._queries.append(query)
        self._inputs.wake()

    def _on_token(self, key: str, alive: bool) -> None:
        if not alive:
            self._liveliness.token_lost(keys.thing(key))
            self._inputs.wake()

    def _tick(self) -> None:
        """Wake the loop regularly; show a stuck put only in the terminal, since no message could be published."""
        watch = TurnWatch(time.monotonic_ns())
        while not self._over.wait(TICK_S):
            self._inputs.wake()
            stuck_s = watch.stuck_s(time.monotonic_ns(), self._turn_wall_ns)
            if stuck_s is not None:
                text = f"nothing could be published for {stuck_s:.1f} s: {self._readers.stuck()}"
                event = run_messages.Event(self._world.now_ns, 0, "stuck", WORLD, WORLD, text)
                self._run.progress("event", event, self._run.phase)


class DirectInputs:
    """Reads on the loop's own thread and waits on the last subscription, which is fastest for an unpaced run."""

    def __init__(self, subscriptions: Sequence[Subscription]) -> None:
        self._subscriptions = subscriptions
        self._received: list[ReceivedSample] = []

    def wait(self, timeout_s: float | None) -> None:
        """Wait for a message or the next `wake`, or sleep through a timeout shorter than TICK_S."""
        if timeout_s is not None and timeout_s < TICK_S:
            time.sleep(timeout_s)
            return
        sample = self._subscriptions[-1].receive()
        if sample is not None:
            self._received.append(sample)

    def wait_for(self, wanted: set[str]) -> None:
        """Wait for a message on each of the wanted keys, or for any message other than a done."""
        while True:
            sample = self._subscriptions[-1].receive()
            if sample is None:
                return
            self._received.append(sample)
            wanted.discard(sample.key)
            if not wanted or not sample.key.endswith("/done"):
                return

    def drain(self) -> Iterator[tuple[int, ReceivedSample]]:
        """Yield the received samples, each with the monotonic wall time [ns] at which it was read."""
        last, self._received = [*self._received, *self._subscriptions[-1].drain()], []
        wall_ns = time.monotonic_ns()
        for subscription in self._subscriptions[:-1]:
            for sample in subscription.drain():
                yield wall_ns, sample
        for sample in last:
            yield wall_ns, sample

    def wake(self) -> None:
        self._subscriptions[-1].wake()

    def close(self) -> None:
        """Stop reading."""


class TimedInputs:
    """Reads on separate threads, so that messages are stamped on arrival while the loop waits for its next gate."""

    def __init__(self, subscriptions: Sequence[Subscription]) -> None:
        self._has_input = threading.Event()
        self._arrived: list[tuple[Subscription, deque[tuple[int, ReceivedSample]]]] = [
            (s, deque()) for s in subscriptions
        ]
        self._threads = [threading.Thread(target=self._pump, args=each, daemon=True) for each in self._arrived]
        for thread in self._threads:
            thread.start()

    def _pump(self, subscription: Subscription, arrived: deque[tuple[int, ReceivedSample]]) -> None:
        while True:
            try:
                sample = subscription.receive()
            except SessionError:
                return
            if sample is not None:
                arrived.append((time.monotonic_ns(), sample))
                self._has_input.set()

    def wait(self, timeout_s: float | None) -> None:
        self._has_input.wait(TICK_S if timeout_s is None else timeout_s)
        self._has_input.clear()

    def wait_for(self, wanted: set[str]) -> None:
        self.wait(None)

    def drain(self) -> Iterator[tuple[int, ReceivedSample]]:
        for _, arrived in self._arrived:
            while arrived:
                yield arrived.popleft()

    def wake(self) -> None:
        self._has_input.set()

    def close(self) -> None:
        for (subscription, _), thread in zip(self._arrived, self._threads, strict=True):
            subscription.undeclare()
            thread.join(timeout=2.0)


def open_inputs(link: Session, realtime: bool) -> DirectInputs | TimedInputs:
    """Subscribe to the messages of other processes.

    Dones are drained after outputs: a process publishes its outputs before its done, on the same link.
    """
    subscriptions = [link.subscribe_remote((PROCESSES, VIEWS)), link.subscribe(f"{PROCESSES}**")]
    return TimedInputs(subscriptions) if realtime else DirectInputs(subscriptions)


def recover_lost(link: Session, run: Run) -> None:
    """In lockstep, request outputs that participants have counted but that have not arrived, e.g. after a cut link."""
    world = run.world
    for participant in world.barrier.incomplete():
        if participant.away:
            continue
        if world.clock.mode == "realtime":
            participant.lost_done = False
            continue
        lost: Pairs | None = None
        key = keys.process(participant.name, "outputs")
        try:
            answer = link.request(key, "outputs", WORLD, timeout_s=RECOVERY_S)
            if answer.ok:
                lost = run.history.lost_outputs(answer.result, participant.done_ns)
        except DecodeError as error:
            run.refuse(participant.name, key, error)
            lost = []
        age_ns = time.monotonic_ns() - participant.joined_wall_ns
        if lost is None and participant.rejoined and age_ns < REJOINED_NS:
            continue  # the participant may be unable to answer requests yet
        for sample in lost or ():
            run.enter(Taken(time.monotonic_ns(), sample))
        run.call("give_up_outputs", participant.name)


class WorldOutputs:
    """Publishes the outbox of a world.

    Args:
        on_message: called with each key and message, except the messages of a gate.
        journal: journal of the run, committed before anything is published.
    """

    def __init__(self, link: Session, run: Run, on_message: Callable[[str, Any], None], journal: RunJournal) -> None:
        self._link = link
        self._run = run
        self._on_message = on_message
        self._journal = journal
        self._unsent: Pairs = []
        self._gate_keys = [keys.gate(name) for name in run.world.names]

    def gather(self) -> None:
        """Encode the outbox for `send`: single messages and, for their subscribers, whole gates and gates by drone."""
        outbox = self._run.world.take_outbox()
        if not outbox:
            return
        encoded: Pairs = []
        passed, has_subscribers = self._run.history.passed, self._link.has_subscribers
        for key, message in outbox:
            if type(message) is GateMessages:
                full_gate = (keys.GATE, message.pack())
                passed.append(full_gate)
                if has_subscribers(keys.GATE):
                    self._unsent.append(full_gate)
                for gate_key, (first, last) in zip(self._gate_keys, pairwise(message.first), strict=True):
                    if last > first and has_subscribers(gate_key):
                        self._unsent.append((gate_key, message.pack(first, last)))
                encoded += message.pairs
            else:
                pair = (key, messages.encode(message))
                if keys.is_picture(key):  # published by a replay; not kept or batched, since pictures are large
                    self._unsent.append(pair)
                    continue
                encoded.append(pair)
                passed.append(pair)
        self._unsent += encoded
        self._run.history.add_all(encoded, self._run.world.now_ns)
        for key, message in outbox:
            if type(message) is not GateMessages:
                self._on_message(key, message)

    def send(self) -> None:
        """Publish the gathered messages together, so that readers wake once and the transport sends few packets."""
        self._journal.commit()
        unsent, self._unsent = self._unsent, []
        self._link.put_all(unsent)
        self.put_batch()

    def flush(self) -> None:
        self.gather()
        self.send()

    def publish(self, output: Output) -> None:
        """Publish one message, bypassing the outbox."""
        message: Any = output.message
        payload = messages.encode(message)
        self._run.enter(Published(output.key, message.seq, payload))
        self._journal.commit()
        self._link.put_raw(output.key, payload)
        self.put_batch()
        self._on_message(output.key, message)

    def put_batch(self) -> None:
        """Send the recorders, if there are any, all messages published since the last call."""
        history = self._run.history
        passed, history.passed = history.passed, []
        if self._link.has_subscribers(keys.BATCH):
            for first in range(0, len(passed), BATCH_MAX):
                self._link.put_raw(keys.BATCH, encode_batch(passed[first : first + BATCH_MAX]))

    def forget(self) -> None:
        """Drop the gathered messages, which the former world process has already published."""
        self._unsent, self._run.history.passed = [], []


class Pacer:
    """Computes when gates are due on the wall clock, at the rate of the run's clock."""

    def __init__(self, clock: RunClock) -> None:
        self._clock = clock
        self._pace = (0.0, 0)  # rate and number of time jumps for which the two start times below are valid
        self._start_wall_ns = 0
        self._start_sim_ns = 0

    def due_ns(self, wall_ns: int) -> int:
        """Return the wall time at which the next gate is due [ns].

        The pace restarts after a change of rate, a pause, a time jump or, in lockstep, a standstill.
        """
        clock = self._clock
        if clock.rate <= 0 or clock.state != "running":
            self._pace = (0.0, 0)
            return wall_ns
        if self._pace != (clock.rate, clock.jumps):
            self._pace = (clock.rate, clock.jumps)
            self._start_wall_ns, self._start_sim_ns = wall_ns, clock.next_ns
        due_ns = self._start_wall_ns + round((clock.next_ns - self._start_sim_ns) / clock.rate)
        if clock.mode == "lockstep" and wall_ns - due_ns > STANDSTILL_MIN_NS:
            self.restart()
        return due_ns

    def restart(self) -> None:
        """Restart the pace at the next gate, which is due immediately."""
        self._pace = (0.0, 0)


class Pipelining:
    """Delays gates so that several are sent together and processes wake up less often.

    If agents may lag several gates behind, the next gate is delayed until the slowest agent has nearly caught up; then
    gates follow one another until its done is required again. No agent idles meanwhile, since the first of these gates
    arrives while agents still work on earlier ones. Only an unpaced world in lockstep is delayed.
    """

    def __init__(self, world: Coordinator) -> None:
        self._world = world
        self._clock = world.clock
        self._continues = True
        self._delayed_wall_ns = 0
        self._gates = 0
        self._ahead_ns = max(0, self._clock.ahead_ns - LAG_GATES * self._clock.gate_ns)

    @property
    def _enabled(self) -> bool:
        """Whether agents may lag and gates are not paced."""
        return self._ahead_ns > 0 and self._clock.mode == "lockstep" and self._clock.rate <= 0

    def delays(self, wall_ns: int) -> bool:
        """Return whether to delay the next gate although the world may advance."""
        if self._continues or not self._enabled:
            return False
        is_overdue = wall_ns - self._delayed_wall_ns > DELAY_MAX_NS
        self._continues = is_overdue or not self._world.blocking(self._ahead_ns)
        return not self._continues

    def continues(self) -> bool:
        """Return, after a gate, whether the next one follows immediately and can be sent with it."""
        self._gates = (self._gates + 1) % GATES_SENT
        return self._gates > 0 and self._continues and self._enabled and self._world.may_advance()

    def pause(self, wall_ns: int) -> None:
        """Note that the world must not advance to the next gate yet."""
        if self._continues:
            self._continues, self._delayed_wall_ns = False, wall_ns

    def blocking(self) -> list[Participant]:
        """Return the participants that block the clock; if there are none, those that delay it."""
        return self._world.blocking() or self._world.blocking(self._ahead_ns)


class TurnWatch:
    """Distinguishes a stuck turn of the loop (a put that does not return) from a stopped process.

    It runs on a separate thread, which a stuck put does not block. Times are monotonic wall times.
    """

    def __init__(self, now_ns: int) -> None:
        self._looked_ns = now_ns
        self._stopped_until_ns = 0
        self._reported_ns = 0

    def stuck_s(self, now_ns: int, turn_ns: int) -> float | None:
        """Return how long a turn has been stuck [s], at most once every STUCK_NS; None if there is nothing to report.

        Args:
            turn_ns: when the current turn began; 0 outside a turn.
        """
        if now_ns - self._looked_ns > STOPPED_NS:
            self._stopped_until_ns = now_ns
        self._looked_ns = now_ns
        since_ns = max(turn_ns, self._stopped_until_ns)
        if not turn_ns or now_ns - max(since_ns, self._reported_ns) <= STUCK_NS:
            return None
        self._reported_ns = now_ns
        return (now_ns - since_ns) / 1e9
