"""The world as a process on Zenoh: one loop that paces and gates simulated time.

Order of this file: `run`, a world before this one, the loop, what other threads bring, publication.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from zsim.contract import keys, run_messages
from zsim.runtime.agent import Output
from zsim.runtime.health import HealthMeter, rare_collections
from zsim.scenario.rights import WORLD
from zsim.transport import connection
from zsim.transport.link_watch import SessionTokens
from zsim.transport.session import Query, Session
from zsim.transport.tls import Identity
from zsim.transport.zenoh_settings import Mode
from zsim_world.flight.coordinator import Coordinator
from zsim_world.flight.world import World
from zsim_world.journal.journal_entries import Advanced, Died, Expired, FellSilent, Resumed
from zsim_world.journal.run_journal import RunJournal
from zsim_world.server.admission import Admission
from zsim_world.server.liveliness import LivelinessMonitor
from zsim_world.server.message_history import MessageHistory
from zsim_world.server.pacing import STOOD_STILL_NS, Pacer, Pipelining
from zsim_world.server.query_service import QueryService
from zsim_world.server.resumption import Resumption
from zsim_world.server.slow_readers import SlowReaders
from zsim_world.server.turn_watch import TurnWatch
from zsim_world.server.world_inputs import TICK_S, MessageIntake, ProgressCallback, open_inputs
from zsim_world.server.world_outputs import WorldOutputs

CLOCK_STANDING_NS = 1_000_000_000  # contract: clock once a wall second while time stands still
VIEW_PERIOD_NS = 33_333_333  # contract: at most 30 Hz wall
HEALTH = keys.process(WORLD, "health")
BYE_S = 5.0  # contract: the world waits 5 s at most for byes
SERVE_NS = 5_000_000  # wall time after which a world that never waits looks at requests and losses


class WorldProcess:
    """One world on one session.

    Args:
        link: a listening session.
        world: what to run.
        stopped: asked at every gate, and every TICK_S; a text ends the run with it as the reason.
        progress: shows progress.
        journal: of the run; from the one that a world before has left, this one goes on.
        health: of this process.
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
        self._shown = progress
        self._journal = journal or RunJournal(None)
        self.health = health or HealthMeter(WORLD, host=link.host)
        self._history = MessageHistory()
        self._pacer = Pacer(world.clock)
        self._pipelining = Pipelining(world)
        self._outputs = WorldOutputs(link, world, self._history, self._on_message, self._journal)
        self._liveliness = LivelinessMonitor(
            link, world.barrier, self._handle_death, self._take_in, self._handle_silence
        )
        self._tokens = SessionTokens(link)
        self._admission = Admission(self._tokens, world, link.guarded, self._journal)
        self._intake = MessageIntake(
            link,
            world,
            self._outputs,
            self._history,
            self._liveliness,
            self._admission,
            self.health,
            self._progress,
            self._journal,
        )
        self._readers = SlowReaders(link, self._tokens, world, self._history, self._journal)
        self._service = QueryService(link, world, self._history, self._journal)
        self._queries: deque[Query] = deque()
        self._over = threading.Event()
        self._clock_wall_ns = 0
        self._turn_wall_ns = 0  # when the present turn began; 0 when there is none
        self._served_wall_ns = 0  # when others than participants were served last; 0 once the world has waited
        self._view_wall_ns = 0
        self._view_seq = 0
        self._resumes = False

    def run(self) -> None:
        """Run to the end: wait for the participants, integrate, publish the end.

        Raises:
            RunError: a failure has ended the run; the end has been published before.
        """
        self._inputs = open_inputs(self._link, self._clock.mode == "realtime")
        self._resume()
        self._announce()
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

    def _announce(self) -> None:
        if not self._history.last(keys.INFO):
            self._outputs.publish(Output(keys.INFO, self._world.info()))
        answered = self._service.answered_keys()
        for expression in sorted(answered, key=keys.INFO.__eq__):  # who is answered there is answered everywhere
            self._link.declare_queryable(expression, self._on_query)
        self._tokens.watch()
        self._link.on_token(keys.token("*"), self._on_token)
        self._link.declare_process(WORLD)

    # A world before this one

    def _resume(self) -> None:
        """Go on where the journal ends, once everybody is back."""
        self._resumes = True
        resumed = Resumption(self._world, self._journal, self._history, self._intake, self._outputs).run()
        self._resumes = False
        if resumed:
            wall_ns = time.monotonic_ns()
            self._world.await_return(wall_ns, self._journal.all_died)
            self._journal.note(Resumed(wall_ns, self._journal.all_died))
            self._liveliness.check_all()
            self._shown("resumed", self._world.now_ns, WORLD)

    def _handle_death(self, name: str, wall_ns: int) -> None:
        self._world.losses.died(name, wall_ns)
        if self._world.ended is None:
            self._journal.note(Died(wall_ns, name))

    def _handle_silence(self, name: str, since_wall_ns: int | None) -> None:
        self._world.losses.silence_changed(name, since_wall_ns)
        if self._world.ended is None:
            self._journal.note(FellSilent(name, since_wall_ns))

    def _check_overdue(self) -> None:
        losses = self._world.losses
        if self._world.ended is None and (name := losses.overdue(time.monotonic_ns())):
            losses.expired(name)
            self._journal.note(Expired(name))

    def _add_checkpoint(self, wall_ns: int) -> None:
        """Put the state of the run into the journal, now that nothing is pending."""
        if isinstance(self._world, World) and self._journal.is_due(self._world.now_ns, wall_ns):
            state = {"world": self._world.snapshot(), "last": self._history.last_values()}
            self._journal.add_checkpoint(state, self._world.now_ns, wall_ns)

    # The loop

    def _turn(self) -> None:
        former_wall_ns, self._turn_wall_ns = self._turn_wall_ns, time.monotonic_ns()
        if former_wall_ns and self._turn_wall_ns - former_wall_ns > STOOD_STILL_NS:  # the ticker begins ten a second
            self._go_on_after_standstill(self._turn_wall_ns - former_wall_ns)
        self._take_in()
        if reason := self._stopped():
            self._clock.stop(reason)
        if self._turn_wall_ns - self._served_wall_ns >= SERVE_NS:
            self._serve_others()
            self._served_wall_ns = self._turn_wall_ns
        self._intake.recover_lost()
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

    def _go_on_after_standstill(self, stood_ns: int) -> None:
        """Go on in realtime where time stood still, rather than fly in a burst what the wall clock is ahead by."""
        if self._clock.mode == "realtime" and self._clock.state == "running":
            self._pacer.restart()
            why = "this process or its machine was stopped, or nothing could be published"
            text = f"time stood still for {stood_ns / 1e9:.1f} s of wall time: {why}"
            seq, data = self._world.outbox.next_seq(keys.EVENT), {"wall_s": stood_ns / 1e9}
            event = run_messages.Event(self._world.now_ns, seq, "standstill", WORLD, WORLD, text, data)
            self._outputs.publish(Output(keys.EVENT, event))
            self._on_message(keys.EVENT, event)

    def _take_in(self) -> None:
        for wall_ns, sample in self._inputs.drain():
            self._intake.take(wall_ns, sample)

    def _advance(self, wall_ns: int, late_ns: int) -> None:
        late = self._clock.mode == "realtime" and late_ns > self._clock.gate_ns / self._clock.rate
        self._world.statistics.world_misses += late
        self._world.advance(wall_ns)
        if self._world.failure is None:
            self._journal.note(Advanced(wall_ns, late))
        self._outputs.gather()
        self._add_checkpoint(wall_ns)
        if not self._pipelining.continues():
            self._outputs.send()
        if self._world.failure is None:
            self._publish_view(wall_ns)
        self.health.step(time.monotonic_ns() - wall_ns)

    def _stand_still(self, wall_ns: int) -> None:
        """Publish the clock once a second while time stands still, and wait for whatever comes."""
        self._outputs.flush()
        self._pipelining.pause(wall_ns)
        self._publish_clock(wall_ns, self._world.waiting_for)
        self._inputs.wait_for(self._required_dones())
        self._served_wall_ns = 0

    def _publish_clock(self, wall_ns: int, waiting_for: Callable[[int], tuple[run_messages.Waiting, ...]]) -> None:
        """Publish once a second whom the world waits for."""
        if wall_ns - self._clock_wall_ns >= CLOCK_STANDING_NS:
            clock = self._world.clock_message(waiting_for(wall_ns))
            self._outputs.publish(Output(keys.CLOCK, clock))
            self._on_message(keys.CLOCK, clock)

    def _required_dones(self) -> set[str]:
        """Return the keys of the dones without which the world cannot go on."""
        if self._clock.state != "running" or self._clock.mode == "realtime":
            return set()
        return {keys.process(p.name, "done") for p in self._pipelining.blocking()}

    def _end(self) -> None:
        """Publish the end, then wait until nobody has to be waited for any more, BYE_S at most."""
        self._await_return()
        self._world.publish_end()
        self._outputs.flush()
        end_ns = self._clock_wall_ns = time.monotonic_ns()
        while time.monotonic_ns() - end_ns < BYE_S * 1e9 and self._world.is_waiting_to_leave():
            self._wait_at_end()
            self._outputs.put_batch()
            self._publish_clock(self._turn_wall_ns, lambda wall_ns: self._world.waiting_to_leave(wall_ns - end_ns))
        self._outputs.flush()
        self._turn_wall_ns = 0

    def _await_return(self) -> None:
        """Wait for who has yet to come back to a world that was started again as its run was over."""
        while self._world.barrier.away() and self._stopped() is None:
            self._wait_at_end()
            self._outputs.flush()
            self._publish_clock(self._turn_wall_ns, self._world.barrier.waiting_for_return)

    def _wait_at_end(self) -> None:
        """Take what comes where time passes no more; a put that does not return is named as before."""
        self._inputs.wait(TICK_S)
        self._turn_wall_ns = time.monotonic_ns()
        self._take_in()
        self._serve_others()

    # What other threads bring

    def _on_query(self, query: Query) -> None:
        self._queries.append(query)
        self._inputs.wake()

    def _on_token(self, key: str, alive: bool) -> None:
        if not alive:
            self._liveliness.token_lost(keys.thing(key))
            self._inputs.wake()

    def _tick(self) -> None:
        watch = TurnWatch(time.monotonic_ns())
        while not self._over.wait(TICK_S):
            self._inputs.wake()
            stuck_s = watch.stuck_s(time.monotonic_ns(), self._turn_wall_ns)
            if stuck_s is not None:
                self._show_stuck(stuck_s)

    def _show_stuck(self, since_s: float) -> None:
        """Show that a put does not return; `clock` cannot, since it would have to go the same way."""
        text = f"nothing can be published for {since_s:.1f} s: {self._readers.stuck()}"
        event = run_messages.Event(self._world.now_ns, 0, "stuck", WORLD, WORLD, text)
        self._progress("event", event, self._intake.phase)

    def _serve_others(self) -> None:
        while self._queries:
            self._service.serve(self._queries.popleft())
            self._outputs.flush()
        self._liveliness.check_due()
        self._check_overdue()
        self._readers.report()
        self._admission.check_due(time.monotonic_ns())
        if self.health.due():
            self._liveliness.count_second()
            self._publish_health()

    # Publication

    def _progress(self, kind: str, message: Any, about: str) -> None:
        """Show progress, but not once more what a world before this one has shown."""
        if not self._resumes:
            self._shown(kind, message, about)

    def _on_message(self, key: str, message: Any) -> None:
        if key == keys.CLOCK:
            self._clock_wall_ns = time.monotonic_ns()
            self._progress("clock", message, self._intake.phase)
        elif key == keys.EVENT:
            self._progress("event", message, self._intake.phase)

    def _publish_health(self) -> None:
        health = self.health.message(self._world.now_ns, self._world.outbox.next_seq(HEALTH))
        self._outputs.publish(Output(HEALTH, health))
        self._progress("health", health, WORLD)

    def _publish_view(self, wall_ns: int) -> None:
        if wall_ns - self._view_wall_ns < VIEW_PERIOD_NS:
            return
        self._view_wall_ns = wall_ns
        for key, message in self._world.views(self._view_seq):
            self._link.put(key, message)
        self._view_seq += 1


def run(
    world: Coordinator,
    endpoints: Sequence[str],
    stopped: Callable[[], str | None] = lambda: None,
    progress: ProgressCallback = lambda kind, message, about: None,
    ready: Callable[[], None] = lambda: None,
    identity: Identity | None = None,
    journal: RunJournal | None = None,
) -> None:
    """Listen on the endpoints, call `ready`, and run the world to its end, from where its journal ends.

    Raises:
        SessionError: an endpoint is taken, or the identity is of no use.
    """
    mode: Mode = "lockstep" if world.clock.mode == "lockstep" else "realtime"
    with connection.listen(endpoints, world.scenario.federation, mode, identity) as link:
        ready()
        WorldProcess(link, world, stopped, progress, journal).run()
