"""Runs an agent as a process on Zenoh: joins the run, feeds the agent gate by gate, says done, leaves.

Lockstep and realtime are one loop: in lockstep an incomplete gate is waited for, in realtime it is given up when
the next one is there.
"""

import threading
import time
from collections import deque
from collections.abc import Callable

from zsim.contract import keys, messages, world_events
from zsim.contract.framing import GateMessages, run_key_table
from zsim.contract.messages import ControlAnswer
from zsim.contract.world_events import ProcessEntry, RunEnd, WorldEvent
from zsim.errors import DecodeError, SessionError
from zsim.runtime.agent import Agent
from zsim.runtime.health import HealthMeter
from zsim.runtime.inbox import Inbox
from zsim.runtime.membership import Membership
from zsim.runtime.routing import RoutingTable
from zsim.scenario.fault_kinds import PROCESS_KILL
from zsim.transport.session import Mailbox, Query, Sample, Session

TICK_S = 0.1  # how often a stop, and what the world has not answered, is looked for while nothing arrives
DRAIN_S = 1.0  # how long the last gates are waited for once the run has ended
VIEW_PERIOD_S = 1 / 20  # contract: at most 30 Hz wall; a console draws 20 pictures a second


class Runner:
    """One agent on one session.

    Args:
        link: an open session.
        info: of the run.
        agent: what to run.
        stopped: asked every TICK_S; True ends the process with a bye.
        say: told what a person should know.
        deserted: asked at the end; True leaves without a bye, as one that dies, so that the world waits for a new one.

    Attributes:
        killed: whether a fault has ended it, without a bye; its process is to die as well.
    """

    def __init__(
        self,
        link: Session,
        info: messages.Info,
        agent: Agent,
        stopped: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda text: None,
        deserted: Callable[[], bool] = lambda: False,
    ) -> None:
        self._link = link
        self._info = info
        self._agent = agent
        self._stopped = stopped
        self._say = say
        self._deserted = deserted
        self._inbox = Inbox(agent.gate_keys, agent.counted, keep_late=info.mode == "realtime")
        self._member = Membership(link, info, agent, self._take_in, say)
        estimates = (key for key in agent.gate_keys if key.endswith("/estimate"))
        self._stock = {key: f"estimator.{keys.thing(key)}" for key in estimates}
        self._estimated_by: dict[str, str] = {}
        self._boxes: dict[str, Mailbox] = {}
        self._expressions = RoutingTable([[expression] for expression in agent.reads])
        self._table = run_key_table(info)
        self._gate_key = _gate_key(agent)
        self._notices: deque[WorldEvent] = deque()
        self._queries: deque[Query] = deque()
        self._links: deque[bool] = deque()
        self._fault_lists: deque[messages.Faults] = deque()
        self._list_seq = -1
        self._kills: dict[int, messages.Fault] = {}  # by id
        self._lives_after_ns: int | None = None  # what was to die up to this gate was an earlier one of its name
        self._lacks = False
        self._view_wall_s = 0.0
        self._end_ns: int | None = None
        self._end_wall_s = 0.0
        self._leave: str | None = None
        self._over = threading.Event()
        self.killed = False
        self.health = HealthMeter(agent.role, host=link.host)

    def run(self) -> str:
        """Take part until the run ends; return why it left.

        Raises:
            SupersededError: another process of the same name has taken over.
            RunError: the world has begun another run.
            BehindError: it lacks what the world does not keep any more.
        """
        self._agent.rehearse()
        self._subscribe()
        self._member.ask_faults()
        last_ns = self._member.warm_start()
        if last_ns is not None:
            self._inbox.start_after(last_ns)
            self._lives_after_ns = last_ns
        self._member.enter()
        ticker = threading.Thread(target=self._tick, name="tick", daemon=True)
        ticker.start()
        try:
            while self._leave is None:
                self._turn()
        finally:
            self._over.set()
            ticker.join()
        if self._member.failure:
            raise self._member.failure
        if not self._deserted() and not self.killed:
            self._member.leave(self._leave)
        return self._leave

    # One turn

    def _turn(self) -> None:
        """Take in what has arrived, step through every gate that is complete, and wait if there was none."""
        self._serve_rare()
        self._take_in_all()
        stepped = False
        while self._leave is None and (t_ns := self._ready_gate()) is not None:
            self._step(t_ns)
            stepped = True
        self._member.send()
        if self._leave is None:
            self._look_for_end()
        if self._leave is None and not stepped:
            self._wait()

    def _wait(self) -> None:
        box = self._boxes[self._blocking_expression()]
        try:
            sample = box.receive()
        except SessionError:
            self._leave = self._leave or "session closed"
            return
        if sample is not None:
            self._open(sample)

    def _take_in_all(self) -> None:
        """Take in what has arrived: first what closes a gate, so that what came before it is found too."""
        for box in self._boxes.values():
            for sample in box.drain():
                self._open(sample)

    def _open(self, sample: Sample) -> None:
        """Take in a message, or the messages of a gate."""
        if sample.key != self._gate_key:
            self._take_in(sample)
            return
        try:
            gate = GateMessages.unpack(sample.payload, self._table)
            if not self._agent.takes_gates:
                gate.check()
        except DecodeError as error:
            self._refuse(error)
            return
        self.health.received += len(gate)
        self._inbox.put(keys.GATE, gate)

    def _take_in(self, sample: Sample) -> None:
        if sample.key == keys.FAULTS:
            self._on_faults(sample)
            return
        self.health.received += 1
        try:
            message = messages.decode(sample.key, sample.payload)
        except DecodeError as error:
            self._refuse(error)
            return
        if type(message) is messages.Estimate:
            self._estimated_by[sample.key] = message.source
        self._inbox.put(sample.key, message)

    def _refuse(self, error: DecodeError) -> None:
        self.health.refused += 1
        if self.health.refused == 1:
            self._say(str(error))

    def _blocking_expression(self) -> str:
        """Return the subscription from which the next missing message comes."""
        t_ns = self._inbox.next_gate_ns()
        missing = self._inbox.missing_last(t_ns) if t_ns is not None else None
        wanted = missing or self._agent.gate_keys[-1]
        expression = self._agent.reads[self._expressions.readers(wanted)[0]]
        return expression if expression in self._boxes else self._gate_key

    def _ready_gate(self) -> int | None:
        """Return the gate to step now, None if it must be waited for."""
        t_ns = self._inbox.next_gate_ns()
        self._lacks = False
        if t_ns is None:
            return None
        if self._inbox.missing(t_ns) is None:
            return t_ns
        if self._info.mode == "realtime":
            return self._give_up(t_ns)
        return self._find_lost(t_ns)

    def _find_lost(self, t_ns: int) -> int | None:
        """Ask again for what will not come any more; return the gate if it is complete now."""
        lost = self._inbox.lost(t_ns)
        if lost is None or self.health.link_lost:
            return None
        self._member.ask_again(t_ns, lost)
        self._lacks = self._inbox.missing(t_ns) is not None
        return None if self._lacks else t_ns

    def _give_up(self, t_ns: int) -> int | None:
        """In realtime an incomplete gate is stepped with what there is once the next one is there."""
        if self._inbox.latest_gate_ns() == t_ns:
            return None
        self.health.dropped += 1
        return t_ns

    def _step(self, t_ns: int) -> None:
        start_ns = time.perf_counter_ns()
        self._update_faults()
        self._agent.deliver(t_ns, self._inbox.take(t_ns))
        if t_ns % self._agent.period_ns:
            return
        outputs = self._agent.step(t_ns)
        self._member.publish(t_ns, outputs)
        self._show(t_ns)
        self._die(t_ns)
        self.health.step(time.perf_counter_ns() - start_ns)
        newest_ns = self._inbox.latest_gate_ns()
        self.health.lag_ns = newest_ns - t_ns if newest_ns is not None else 0

    def _show(self, t_ns: int) -> None:
        """Publish what is to be displayed, as often as people can follow."""
        now_s = time.monotonic()
        if now_s - self._view_wall_s >= VIEW_PERIOD_S:
            self._view_wall_s = now_s
            for key, message in self._agent.views(t_ns):
                self._link.put(key, message)

    def _update_faults(self) -> None:
        """Take the lists of faults that have come: those that the world published before a gate come before it."""
        while self._fault_lists:
            faults = self._fault_lists.popleft()
            self._agent.update_faults(self._info, faults)
            if faults.seq > self._list_seq:
                self._list_seq = faults.seq
                self._update_kills(faults)

    def _update_kills(self, faults: messages.Faults) -> None:
        """Note which kills are its own: a list may have forgotten one that a late process has still to die of.

        One that has not begun when a list is published, and is not on it, is cleared.
        """
        names, t_ns = (self._agent.name, *self._agent.serves), faults.t_ns
        begun = {n: kill for n, kill in self._kills.items() if kill.until_ns is not None and kill.until_ns <= t_ns}
        self._kills = begun | {f.id: f for f in faults.faults if f.kind == PROCESS_KILL and f.target in names}

    def _die(self, t_ns: int) -> None:
        """End, if a fault wants it in the gates that it has lived; their outputs still go out."""
        if self._lives_after_ns is None:
            self._lives_after_ns = t_ns - self._agent.period_ns
        for fault in self._kills.values():
            if self._lives_after_ns < fault.from_ns + self._info.gate_ns <= t_ns:
                self._leave, self.killed = f"killed by fault {fault.id}", True

    # Beginning and end

    def _subscribe(self) -> None:
        closing = [self._agent.reads[place] for place in self._expressions.readers_of_any(self._agent.gate_keys)]
        for expression in dict.fromkeys([*closing, *self._agent.reads]):
            box = self._gate_key if self._gate_key and keys.is_sensor(expression) else expression
            if box not in self._boxes:
                self._boxes[box] = self._link.subscribe(box)
        self._link.on_message(keys.EVENT, self._on_event)
        self._link.on_message(keys.FAULTS, self._on_faults)
        self._link.on_link(self._on_link)
        for key in self._agent.control_keys():
            self._link.answer(key, self._on_query)
        self._link.answer(keys.process(self._agent.name, "outputs"), self._on_query)
        self._link.declare_token(keys.token(self._agent.name))

    def _look_for_end(self) -> None:
        if self._stopped():
            self._leave = "stopped"
        elif self._end_ns is not None:
            late = time.monotonic() - self._end_wall_s > DRAIN_S
            if self._member.done_ns >= self._end_ns // self._agent.period_ns * self._agent.period_ns or late:
                self._leave = "the run ended"

    # What arrives rarely, from other threads

    def _on_event(self, sample: Sample) -> None:
        try:
            read = world_events.read(sample.payload)
        except DecodeError:
            self.health.refused += 1  # somebody else's; the world's own events can be read
            return
        if read is not None:
            self._notices.append(read)
            self._wake()

    def _on_faults(self, sample: Sample) -> None:
        try:
            self._fault_lists.append(messages.decode(keys.FAULTS, sample.payload))
        except DecodeError:
            self.health.refused += 1

    def _on_link(self, up: bool) -> None:
        self._links.append(up)
        self._wake()

    def _on_query(self, query: Query) -> None:
        self._queries.append(query)
        self._wake()

    def _tick(self) -> None:
        while not self._over.wait(TICK_S):
            if self._stopped() or self._end_ns is not None or self._lacks or self._member.owes:
                self._wake()
            if self.health.due():
                seq = self._agent.next_seq("health")
                health = self.health.message(max(0, self._member.done_ns), seq)
                self._link.put(keys.process(self._agent.name, "health"), health)

    def _wake(self) -> None:
        for box in list(self._boxes.values()):
            box.wake()

    def _serve_rare(self) -> None:
        while self._notices:
            self._serve_notice(self._notices.popleft())
        while self._links:
            self._serve_link(self._links.popleft())
        while self._queries:
            self._serve_query(self._queries.popleft())
        if not self.health.link_lost:
            self._member.settle()
        if self._member.failure:
            self._leave = str(self._member.failure)

    def _serve_notice(self, read: WorldEvent) -> None:
        if isinstance(read.data, RunEnd):
            self._end_ns = read.data.last_ns
            self._end_wall_s = time.monotonic()
        elif read.kind in ("drop", "leave"):
            self._ignore_estimates(read.subject)
        elif isinstance(read.data, ProcessEntry) and read.kind == "join":
            self._expect_estimates(read.subject, read.data.from_ns)
        elif isinstance(read.data, ProcessEntry) and read.subject == self._agent.name:
            self._member.taken_in(read.data)

    def _ignore_estimates(self, process: str) -> None:
        """Wait no longer for the estimates of a process: those that it published last, or has the name for."""
        for key, stock in self._stock.items():
            if process == (self._estimated_by.get(key) or stock):
                self._inbox.ignore(key)

    def _expect_estimates(self, process: str, from_ns: int) -> None:
        for key, stock in self._stock.items():
            if process in (self._estimated_by.get(key), stock):
                self._inbox.expect(key, from_ns)

    def _serve_link(self, up: bool) -> None:
        if up and self.health.link_lost:
            self.health.link_lost = False
            self._say(f"{self._agent.name}: the link is back")
            self._member.come_back()
        elif not up:
            self.health.link_lost = True
            self._say(f"{self._agent.name}: lost the link to the world; waiting for it to come back")

    def _serve_query(self, query: Query) -> None:
        if query.expression == keys.process(self._agent.name, "outputs"):
            query.answer(ControlAnswer(ok=True, result=self._member.outputs()))
            return
        try:
            answer = self._agent.control(query.expression, query.request())
        except DecodeError as error:
            answer = ControlAnswer(ok=False, error=str(error))
        query.answer(answer)


def _gate_key(agent: Agent) -> str:
    """Return on which key an agent takes the sensors of a gate as GateMessages; none for one that does not."""
    if len(agent.counted) > 1:
        return keys.GATE
    return keys.gate(agent.counted[0]) if agent.counted and agent.takes_gates else ""
