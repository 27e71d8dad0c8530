"""Runs an agent as a process on Zenoh: joins the run, feeds the agent gate by gate, publishes its outputs, and leaves.

Lockstep and realtime share one loop: lockstep waits for an incomplete gate; realtime stops waiting when the next one
arrives.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from operator import itemgetter
from typing import Any

from msgspec import UNSET

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.framing import GateMessages, run_key_table
from zsim.contract.messages import ProcessEntry, RunEnd, WorldEvent
from zsim.contract.run_messages import ControlAnswer
from zsim.errors import DecodeError, SessionError
from zsim.runtime.agent import Agent
from zsim.runtime.inbox import NEVER_NS, Inbox, RoutingTable, output_hold_ns
from zsim.runtime.membership import HealthMeter, rare_collections
from zsim.runtime.participant import AgentParticipant
from zsim.scenario.faults import PROCESS_KILL
from zsim.schema import plugin
from zsim.transport.session import Query, RawSample, ReceivedSample, Session, Subscription

TICK_S = 0.1  # interval between checks for a stop and unanswered requests while nothing arrives
DRAIN_S = 1.0  # wall time to wait for the last gates once the run has ended
VIEW_PERIOD_S = 1 / 20  # wall time between views; the contract allows 30 Hz, and a console draws 20 frames per second


class Runner:
    """Runs one agent on one session."""

    def __init__(
        self,
        link: Session,
        info: messages.Info,
        agent: Agent,
        stopped: Callable[[], bool] = lambda: False,  # called every TICK_S; True ends the process with a bye
        say: Callable[[str], None] = lambda text: None,
        # called at the end; if True, the agent leaves without a bye, as if dead, and the world waits for a successor
        deserted: Callable[[], bool] = lambda: False,
        snapshot_ns: int = 0,  # simulated time between snapshots of the agent; 0: none
    ) -> None:
        self._link = link
        self._info = info
        self._agent = agent
        self._stopped = stopped
        self._say = say
        self._deserted = deserted
        self._member = AgentParticipant(
            link, info, agent, lambda sample: self._inputs.take_in(sample), say, stopped=stopped
        )
        self.health = self._member.health
        self._inputs = RunnerInputs(link, info, agent, self.health, say)
        self._inbox = self._inputs.inbox
        self._snapshot_ns = snapshot_ns
        self._snapshot_due_ns = 0
        self._resumed_ns: int | None = None
        self._list_seq = -1
        self._kills: dict[int, run_messages.Fault] = {}  # by fault id
        self._lives_after_ns: int | None = None  # kills up to this gate concerned a predecessor
        self._lacks = False
        self._view_wall_s = 0.0
        self._end_ns: int | None = None
        self._end_wall_s = 0.0
        self._leave: str | None = None
        self._end_event = threading.Event()
        self.killed = False  # whether a fault ended it without a bye; its process must then die too

    def run(self) -> str:
        """Take part until the run ends; return the reason for leaving.

        Raises:
            SupersededError: another process of the same name has taken over.
            RunError: the world has begun another run.
            BehindError: it needs messages that the world no longer keeps.
            UserCodeError: a user's class raised an exception or returned an invalid value; the world has been informed.
        """
        self._agent.rehearse()
        self._inputs.subscribe()
        self._member.ask_faults()
        self._resumed_ns = self._member.resume()
        last_ns = self._member.warm_start() if self._resumed_ns is None else self._resumed_ns
        if last_ns is not None:
            self._inbox.start_after(last_ns)
            self._lives_after_ns = last_ns
        self._member.enter()
        ticker = threading.Thread(target=self._tick, name="tick", daemon=True)
        ticker.start()
        try:
            with rare_collections():
                while self._leave is None:
                    self._turn()
        except plugin.RAISED as error:
            failure = self._agent.failure(error, max(0, self._inbox.taken_ns))
            if failure is None:
                raise
            self._member.send()
            self._member.leave(str(failure), failed=True)
            raise failure from error
        finally:
            self._end_event.set()
            ticker.join()
        if self._member.failure:
            raise self._member.failure
        if not self._deserted() and not self.killed:
            self._member.leave(self._leave)
        return self._leave

    def _turn(self) -> None:
        """Take in messages and step through every complete gate; if none is complete, wait."""
        self._serve_rare()
        self._inputs.take_in_all()
        stepped = False
        while self._leave is None and (t_ns := self._ready_gate()) is not None:
            self._step(t_ns)
            stepped = True
        self._member.send()
        if self._leave is None and self._stopped():
            self._leave = "stopped"
        elif self._leave is None and self._end_ns is not None:
            is_overdue = time.monotonic() - self._end_wall_s > DRAIN_S
            if self._member.done_ns >= self._end_ns // self._agent.period_ns * self._agent.period_ns or is_overdue:
                self._leave = run_messages.RUN_ENDED
        if self._leave is None and not stepped:
            try:
                self._inputs.wait()
            except SessionError:
                self._leave = self._leave or "session closed"

    def _ready_gate(self) -> int | None:
        """Return the gate to step now; None if the agent must wait."""
        inbox, member = self._inbox, self._member
        t_ns = inbox.next_gate_ns()
        self._lacks = False
        if t_ns is None or member.awaited:
            return None
        if self._resumed_ns is not None:  # the world must have replayed the gate after the snapshot
            if member.is_fetching:
                return None
            if not inbox.may_skip:
                member.check_reach(t_ns, self._resumed_ns)
            self._resumed_ns = None
            if member.failure:
                self._leave = str(member.failure)
                return None
        if inbox.missing(t_ns) is None:
            return t_ns
        if self._info.mode == "lockstep":
            lost = inbox.lost(t_ns)
            if lost is None or self.health.link_lost:
                return None
            member.ask_again(t_ns, lost)  # the missing messages will not arrive without a request
            self._lacks = inbox.missing(t_ns) is not None
            return None if self._lacks else t_ns
        if inbox.latest_gate_ns() == t_ns:
            return None
        self.health.dropped += 1  # the next gate has arrived: step this one with what was received
        return t_ns

    def _step(self, t_ns: int) -> None:
        start_ns = time.perf_counter_ns()
        for faults in self._inputs.fault_lists_before(t_ns):
            self._agent.update_faults(self._info, faults)
            self._update_kills(faults)
        for key, request in self._inputs.repeated(t_ns):
            self._agent.repeat(key, request)
        outputs = self._agent.answer(t_ns, self._inbox.take(t_ns))
        if outputs is None:
            return
        self._member.publish_gate(t_ns, outputs)
        if self._snapshot_ns and t_ns >= self._snapshot_due_ns and t_ns > self._member.published_ns:
            self._snapshot_due_ns = t_ns + self._snapshot_ns
            self._member.publish_snapshot(t_ns)
        now_s = time.monotonic()
        if now_s - self._view_wall_s >= VIEW_PERIOD_S:
            self._view_wall_s = now_s
            for key, message in self._agent.views(t_ns):
                self._link.put(key, message)
        if self._lives_after_ns is None:
            self._lives_after_ns = t_ns - self._agent.period_ns
        for fault in self._kills.values():  # only at gates that this process stepped; their outputs are still sent
            lives_after_ns = max(self._lives_after_ns, self._member.published_ns)
            if lives_after_ns < fault.from_ns + self._info.gate_ns <= t_ns:
                self._leave, self.killed = f"killed by fault {fault.id}", True
        self.health.step(time.perf_counter_ns() - start_ns)
        newest_ns = self._inbox.latest_gate_ns()
        self.health.lag_ns = newest_ns - t_ns if newest_ns is not None else 0

    def _update_kills(self, faults: run_messages.Faults) -> None:
        """Update the faults that kill this process from a published list.

        A kill that has begun remains even if newer lists omit it, since a process that lags behind has yet to reach it;
        a kill that has not begun and is not on the list was cleared.
        """
        if faults.seq > self._list_seq:
            self._list_seq = faults.seq
            kills = self._kills.values()
            started = {f.id: f for f in kills if f.until_ns is not None and f.until_ns <= faults.t_ns}
            names = self._agent.name, *self._agent.serves
            listed = {f.id: f for f in faults.faults if f.kind == PROCESS_KILL and f.target in names}
            self._kills = started | listed

    # Rare inputs

    def _tick(self) -> None:
        while not self._end_event.wait(TICK_S):
            if self._stopped() or self._end_ns is not None or self._lacks or self._member.owes:
                self._inputs.wake()
            self._member.publish_health()

    def _serve_rare(self) -> None:
        while self._inputs.rare:
            arrived = self._inputs.rare.popleft()
            if isinstance(arrived, WorldEvent):
                self._serve_event(arrived)
            elif not isinstance(arrived, bool):
                self._serve_query(arrived)
            elif not arrived:
                self.health.link_lost = True
                self._say(f"{self._agent.name}: lost the link to the world; waiting for it to come back")
            elif self.health.link_lost:
                self.health.link_lost = False
                self._say(f"{self._agent.name}: the link is back")
                self._member.come_back()
        if not self.health.link_lost:
            self._member.settle()
        if self._member.failure:
            self._leave = str(self._member.failure)

    def _serve_event(self, event: WorldEvent) -> None:
        if isinstance(event.data, RunEnd):
            self._end_ns = event.data.last_ns
            self._end_wall_s = time.monotonic()
        elif event.kind in ("drop", "leave"):
            self._inputs.ignore_estimates(event.subject)
        elif isinstance(event.data, ProcessEntry) and event.subject == self._agent.name:
            self._member.take_entry(event.data)
        elif isinstance(event.data, ProcessEntry) and event.kind == "join":
            self._inputs.expect_estimates(event.subject, event.data.from_ns)

    def _serve_query(self, query: Query) -> None:
        try:
            if query.expression == keys.process(self._agent.name, "outputs"):
                answer = ControlAnswer(ok=True, result=self._member.outputs())
            else:
                answer = self._agent.control(query.expression, query.request())
        except DecodeError as error:
            answer = ControlAnswer(ok=False, error=str(error))
        query.answer(answer)


class RunnerInputs:
    """Receives one agent's messages into its inbox, and queues its rare inputs from Zenoh's threads."""

    def __init__(
        self, link: Session, info: messages.Info, agent: Agent, health: HealthMeter, say: Callable[[str], None]
    ) -> None:
        self._link = link
        self._agent = agent
        self._health = health
        self._say = say
        self._is_realtime, self._gate_ns = info.mode == "realtime", info.gate_ns
        self._blocking: Subscription | None = None  # subscription on which `wait` blocks
        self._external = frozenset(drone.name for drone in info.drones if drone.body is not UNSET)
        driver_keys = [key for key in agent.gate_keys if keys.parts(key)[1] in self._external]
        self.inbox = Inbox(
            agent.gate_keys, agent.counted, self._is_realtime, agent.uncounted, driver_keys, output_hold_ns(info)
        )
        estimates = (key for key in agent.gate_keys if key.endswith("/estimate"))
        self._stock = {key: f"estimator.{keys.thing(key)}" for key in estimates}
        self._estimated_by: dict[str, str] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._expressions = RoutingTable([[expression] for expression in agent.reads])
        self._table = run_key_table(info)
        # key of a gate's sensor messages as `GateMessages`; drivers publish those of external drones singly
        world_drones = [drone for drone in agent.counted if drone not in self._external]
        self._gate_key = ""
        if world_drones and len(agent.counted) > 1:
            self._gate_key = keys.GATE
        elif world_drones and agent.takes_gates:
            self._gate_key = keys.gate(world_drones[0])
        self.rare: deque[WorldEvent | Query | bool] = deque()  # in order of arrival; a bool says whether the link is up
        self._fault_lists: deque[run_messages.Faults] = deque()
        self._repeated: dict[int, dict[tuple[str, int], Any]] = {}  # by gate, then by key and seq

    def subscribe(self) -> None:
        """Subscribe to the agent's keys; declare its request keys and liveliness token."""
        closing = [self._agent.reads[index] for index in self._expressions.readers_of_any(self._agent.gate_keys)]
        for expression in dict.fromkeys([*closing, *self._agent.reads]):
            is_world_sensor = keys.is_sensor(expression) and keys.thing(expression) not in self._external
            subscribed = self._gate_key if self._gate_key and is_world_sensor else expression
            if subscribed not in self._subscriptions:
                self._subscriptions[subscribed] = self._link.subscribe(subscribed)
        self._link.declare_subscriber(keys.EVENT, self._on_event)
        self._link.declare_subscriber(keys.FAULTS, lambda sample: self._on_faults(sample.payload))
        if self._is_realtime:
            self._link.declare_subscriber(keys.CLOCK, self._on_clock)
        self._link.on_link(self._on_rare)
        for key in (*self._agent.control_keys(), keys.process(self._agent.name, "outputs")):
            self._link.declare_queryable(key, self._on_rare)
        self._link.declare_process(self._agent.name)

    def wait(self) -> None:
        """Wait for a message that may complete the gate, or for `wake`; raise SessionError if the session is closed."""
        awaited_key = self.inbox.last_missing() or self._agent.gate_keys[-1]
        expression = self._agent.reads[self._expressions.readers(awaited_key)[0]]
        self._blocking = self._subscriptions[expression if expression in self._subscriptions else self._gate_key]
        sample = self._blocking.receive()
        self._blocking = None
        if sample is not None:
            self._open(sample)

    def wake(self) -> None:
        for subscription in list(self._subscriptions.values()):
            subscription.wake()

    def take_in_all(self) -> None:
        """Receive messages, closing keys first, so that no message that arrived before a closing one is missed."""
        for subscription in self._subscriptions.values():
            for sample in subscription.drain():
                self._open(sample)

    def _open(self, sample: ReceivedSample) -> None:
        """Put a message, or the messages of a gate, into the inbox."""
        if sample.key != self._gate_key:
            self.take_in(sample)
            return
        try:
            gate = GateMessages.unpack(sample.payload, self._table)
            if not self._agent.takes_gates:
                gate.check()
        except DecodeError as error:
            self._refuse(error)
            return
        self._health.received += len(gate)
        self.inbox.put(keys.GATE, gate)

    def take_in(self, sample: ReceivedSample) -> None:
        if sample.key == keys.FAULTS:
            self._on_faults(sample.payload)
            return
        self._health.received += 1
        try:
            message = messages.decode(sample.key, sample.payload)
        except DecodeError as error:
            self._refuse(error)
            return
        if sample.key in self._agent.repeats:
            self._repeated.setdefault(message.t_ns, {})[sample.key, message.seq] = message
            return
        if type(message) is flight_messages.Estimate:
            self._estimated_by[sample.key] = message.source
        self.inbox.put(sample.key, message)

    def _refuse(self, error: DecodeError) -> None:
        self._health.refused += 1
        if self._health.refused == 1:
            self._say(str(error))

    def fault_lists_before(self, t_ns: int) -> list[run_messages.Faults]:
        """Remove and return the lists of faults published before a gate."""
        if not self._fault_lists:
            return []
        lists = [self._fault_lists.popleft() for _ in range(len(self._fault_lists))]
        self._fault_lists.extend(faults for faults in lists if faults.t_ns >= t_ns)
        return sorted((faults for faults in lists if faults.t_ns < t_ns), key=lambda faults: faults.seq)

    def repeated(self, t_ns: int) -> Iterator[tuple[str, Any]]:
        """Remove and yield the requests accepted by the predecessor that are to be repeated before a gate."""
        if self._repeated:
            for (key, _), request in sorted(self._repeated.pop(t_ns, {}).items(), key=itemgetter(0)):
                yield key, request

    def ignore_estimates(self, process: str) -> None:
        """Stop waiting for the estimates last published by a process or, if none arrived, those its name implies."""
        for key, stock in self._stock.items():
            if process == (self._estimated_by.get(key) or stock):
                self.inbox.expect(key, NEVER_NS)

    def expect_estimates(self, process: str, from_ns: int) -> None:
        """Wait again for the estimates of a process, from the gate `from_ns` on."""
        for key, stock in self._stock.items():
            if process in (self._estimated_by.get(key), stock):
                self.inbox.expect(key, from_ns)

    # On Zenoh's threads

    def _on_event(self, sample: RawSample) -> None:
        try:
            read = messages.read_event(sample.payload)
        except DecodeError:
            self._health.refused += 1  # from another program; the world's own events are valid
            return
        if read is not None:
            self._on_rare(read)

    def _on_clock(self, sample: RawSample) -> None:
        """In realtime, stop waiting for a gate that the world has passed: its missing messages may never arrive."""
        blocking = self._blocking
        if blocking is None:
            return
        with contextlib.suppress(DecodeError):
            clock: run_messages.Clock = messages.decode(keys.CLOCK, sample.payload)
            if clock.t_ns >= self.inbox.taken_ns + 2 * self._gate_ns:
                blocking.wake()

    def _on_faults(self, payload: bytes) -> None:
        try:
            self._fault_lists.append(messages.decode(keys.FAULTS, payload))
        except DecodeError:
            self._health.refused += 1

    def _on_rare(self, arrived: WorldEvent | Query | bool) -> None:
        self.rare.append(arrived)
        self.wake()
