"""Runs an agent as a process on Zenoh: joins the run, feeds the agent gate by gate, says done, leaves.

Lockstep and realtime are one loop: in lockstep an incomplete gate is waited for, in realtime it is given up when
the next one is there.
"""

import os
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from zsim import __version__, keys, messages
from zsim.agent import Agent, Output
from zsim.connection import read_info
from zsim.errors import DecodeError, RunError, SessionError, SupersededError
from zsim.fingerprint import fingerprint
from zsim.health import HealthMeter
from zsim.inbox import Inbox
from zsim.messages import ControlAnswer
from zsim.session import Mailbox, Query, Sample, Session

TICK_S = 0.1  # how often a stop is looked for while nothing arrives
DRAIN_S = 1.0  # how long the last gates are waited for once the run has ended
REPLAY_S = 2.0  # a hub answers a replay within milliseconds; a lost link does not
VIEW_PERIOD_S = 1 / 30  # contract: at most 30 Hz wall
GATES_KEPT = 2  # gates of which the outputs are kept to answer a get, contract; more where the world runs ahead


class Runner:
    """One agent on one session.

    Args:
        link: an open session.
        info: of the run.
        agent: what to run.
        stopped: asked every TICK_S; True ends the process with a bye.
        say: told what a person should know.
    """

    def __init__(
        self,
        link: Session,
        info: messages.Info,
        agent: Agent,
        stopped: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._link = link
        self._info = info
        self._agent = agent
        self._stopped = stopped
        self._say = say
        self._inbox = Inbox(agent.gate_keys, agent.counted)
        self._incarnation = secrets.randbits(62)
        self._boxes: dict[str, Mailbox] = {}
        self._events: deque[messages.Event] = deque()
        self._queries: deque[Query] = deque()
        self._links: deque[bool] = deque()
        ahead = info.command_delay_ns // info.gate_ns
        self._kept: deque[tuple[int, Sequence[Output]]] = deque(maxlen=GATES_KEPT + ahead)
        self._done_key = keys.process(agent.name, "done")
        self._done_ns = -1
        self._view_wall_s = 0.0
        self._end_ns: int | None = None
        self._end_wall_s = 0.0
        self._leave: str | None = None
        self._failure: str | None = None
        self._over = threading.Event()
        self.health = HealthMeter(agent.role)

    def run(self) -> str:
        """Take part until the run ends; return why it left.

        Raises:
            SupersededError: another process of the same name has taken over.
            RunError: the world has begun another run.
        """
        self._agent.rehearse()
        self._subscribe()
        self._catch_up_with_former()
        self._join()
        ticker = threading.Thread(target=self._tick, name="tick", daemon=True)
        ticker.start()
        try:
            while self._leave is None:
                self._turn()
        finally:
            self._over.set()
            ticker.join()
        if self._failure:
            raise (SupersededError if self._leave == "superseded" else RunError)(self._failure)
        self._put_process("bye", messages.Bye(max(0, self._done_ns), self._agent.next_seq("bye"), self._leave))
        return self._leave

    # One turn

    def _turn(self) -> None:
        """Take in what has arrived, step through every gate that is complete, and wait if there was none."""
        self._serve_rare()
        self._take_in_all()
        stepped = False
        while (t_ns := self._ready_gate()) is not None:
            self._step(t_ns)
            stepped = True
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
            self._take_in(sample)

    def _take_in_all(self) -> None:
        """Take in what has arrived: first what closes a gate, so that what came before it is found too."""
        for box in self._boxes.values():
            for sample in box.drain():
                self._take_in(sample)

    def _take_in(self, sample: Sample) -> None:
        self.health.received += 1
        try:
            message = messages.decode(sample.key, sample.payload)
        except DecodeError as error:
            self.health.refused += 1
            if self.health.refused == 1:
                self._say(str(error))
            return
        self._inbox.put(sample.key, message)

    def _blocking_expression(self) -> str:
        """Return the subscription from which the next missing message comes."""
        t_ns = self._inbox.next_gate_ns()
        missing = self._inbox.missing_last(t_ns) if t_ns is not None else None
        wanted = missing or self._agent.gate_keys[-1]
        return next(e for e in self._agent.reads if keys.matches(e, wanted))

    def _ready_gate(self) -> int | None:
        """Return the gate to step now, None if it must be waited for."""
        t_ns = self._inbox.next_gate_ns()
        if t_ns is None:
            return None
        if self._inbox.missing(t_ns) is None:
            return t_ns
        if self._info.mode == "realtime":
            return self._give_up(t_ns)
        lost = self._inbox.lost(t_ns)
        if lost is not None:
            self._ask_replay(t_ns, lost)
        return None

    def _give_up(self, t_ns: int) -> int | None:
        """In realtime an incomplete gate is stepped with what there is once the next one is there."""
        if self._inbox.latest_gate_ns() == t_ns:
            return None
        self.health.dropped += 1
        return t_ns

    def _step(self, t_ns: int) -> None:
        start_ns = time.perf_counter_ns()
        for key, message in self._inbox.take(t_ns):
            self._agent.receive(key, message)
        if t_ns % self._agent.period_ns:
            return
        outputs = self._agent.step(t_ns)
        self._publish(t_ns, outputs)
        self.health.step(time.perf_counter_ns() - start_ns)
        newest_ns = self._inbox.latest_gate_ns()
        self.health.lag_ns = newest_ns - t_ns if newest_ns is not None else 0

    def _publish(self, t_ns: int, outputs: Sequence[Output]) -> None:
        """Publish the outputs of a gate and the done that counts them, encoded first and put in one go."""
        counted = [output for output in outputs if not output.key.startswith("view/")]
        self._kept.append((t_ns, counted))
        encoded = [(key, messages.encode(message)) for key, message in counted]
        encoded.append((self._done_key, messages.encode(self._done(t_ns, len(counted)))))
        self._link.put_all(encoded)
        if len(counted) < len(outputs):
            self._publish_views(outputs)

    def _publish_views(self, outputs: Sequence[Output]) -> None:
        now_s = time.monotonic()
        if now_s - self._view_wall_s >= VIEW_PERIOD_S:
            self._view_wall_s = now_s
            for key, message in outputs:
                if key.startswith("view/"):
                    self._link.put(key, message)

    def _done(self, t_ns: int, sent: int) -> messages.Done:
        self._done_ns = t_ns
        seq = self._agent.next_seq("done")
        return messages.Done(t_ns, seq, self._info.run_id, self._incarnation, t_ns, sent)

    def _say_done(self, t_ns: int, sent: int) -> None:
        self._link.put(self._done_key, self._done(t_ns, sent))

    # Joining, catching up, leaving

    def _subscribe(self) -> None:
        closing = [e for e in self._agent.reads if any(keys.matches(e, key) for key in self._agent.gate_keys)]
        for expression in dict.fromkeys([*closing, *self._agent.reads]):
            self._boxes[expression] = self._link.subscribe(expression)
        self._link.on_message(keys.EVENT, self._on_event)
        self._link.on_link(self._on_link)
        for key in self._agent.control_keys():
            self._link.answer(key, self._on_query)
        self._link.answer(keys.process(self._agent.name, "outputs"), self._on_query)
        self._link.declare_token(keys.token(self._agent.name))

    def _join(self) -> None:
        join = messages.Join(
            t_ns=max(0, self._done_ns),
            seq=self._agent.next_seq("join"),
            run_id=self._info.run_id,
            incarnation=self._incarnation,
            role=self._agent.role,
            host=socket.gethostname(),
            pid=os.getpid(),
            period_ns=self._agent.period_ns,
            version=__version__,
            fingerprint=fingerprint(),
        )
        self._put_process("join", join)

    def _catch_up_with_former(self) -> None:
        """Warm-start from what a former incarnation published last, and fetch what it missed since."""
        last_ns = -1
        for key in self._agent.warm_start_keys():
            for sample in self._link.get(key):
                try:
                    message = messages.decode(key, sample.payload)
                except DecodeError as error:
                    self._say(f"{self._agent.name}: cold start, the last value is of no use: {error}")
                    continue
                self._agent.warm_start(key, message)
                self._agent.resume_seq(key, message.seq)
                last_ns = max(last_ns, message.t_ns)
        if last_ns < 0:
            return
        self._say(f"{self._agent.name}: warm start from t = {last_ns / 1e9:.2f} s")
        self._inbox.start_after(last_ns)
        self._done_ns = last_ns
        self._join()
        self._say_done(last_ns, 0)
        self._replay(last_ns)

    def _ask_replay(self, t_ns: int, missing: str) -> None:
        """Fetch a gate of which messages did not come, as after a link that was cut."""
        self._say(f"{self._agent.name}: {missing} of t = {t_ns / 1e9:.2f} s did not come; asking for it again")
        self._replay(t_ns - self._info.gate_ns)

    def _replay(self, from_ns: int) -> None:
        answer = self._link.request(
            keys.CONTROL,
            "replay",
            self._agent.name,
            timeout_s=REPLAY_S,
            from_ns=from_ns,
            keys=list(self._agent.reads),
        )
        for key, payload in answer.result or ():
            self._take_in(Sample(key, payload))

    def _rejoin(self) -> None:
        """After a lost link: a new incarnation, what was missed, and once more what may have been lost."""
        info = read_info(self._link)
        if info is None:
            return
        if info.run_id != self._info.run_id:
            self._leave, self._failure = "another run", f"{self._agent.name}: the world has begun another run"
            return
        self._incarnation = secrets.randbits(62)
        self._join()
        self._replay(self._done_ns)
        for t_ns, outputs in self._kept:
            for key, message in outputs:
                self._link.put(key, message)
            self._say_done(t_ns, len(outputs))

    def _look_for_end(self) -> None:
        if self._stopped():
            self._leave = "stopped"
        elif self._end_ns is not None:
            late = time.monotonic() - self._end_wall_s > DRAIN_S
            if self._done_ns >= self._end_ns // self._agent.period_ns * self._agent.period_ns or late:
                self._leave = "the run ended"

    # What arrives rarely, from other threads

    def _on_event(self, sample: Sample) -> None:
        try:
            self._events.append(messages.decode(keys.EVENT, sample.payload))
        except DecodeError:
            return  # somebody else's garbage on world/event; the world's own events decode
        self._wake()

    def _on_link(self, up: bool) -> None:
        self._links.append(up)
        self._wake()

    def _on_query(self, query: Query) -> None:
        self._queries.append(query)
        self._wake()

    def _tick(self) -> None:
        while not self._over.wait(TICK_S):
            if self._stopped() or self._end_ns is not None:
                self._wake()
            if self.health.due():
                seq = self._agent.next_seq("health")
                self._put_process("health", self.health.message(max(0, self._done_ns), seq))

    def _wake(self) -> None:
        for box in list(self._boxes.values()):
            box.wake()

    def _serve_rare(self) -> None:
        while self._events:
            self._serve_event(self._events.popleft())
        while self._links:
            self._serve_link(self._links.popleft())
        while self._queries:
            self._serve_query(self._queries.popleft())

    def _serve_event(self, event: messages.Event) -> None:
        if event.kind == "end":
            self._end_ns = int(event.data.get("last_ns", event.t_ns))
            self._end_wall_s = time.monotonic()
        elif event.kind in ("drop", "leave") and event.subject.startswith("estimator."):
            self._inbox.ignore(keys.estimate(event.subject.split(".", 1)[1]))
        elif event.kind == "join" and event.subject.startswith("estimator."):
            self._inbox.expect(keys.estimate(event.subject.split(".", 1)[1]), int(event.data.get("from_ns", 0)))
        elif event.subject == self._agent.name and event.kind in ("superseded", "restart"):
            self._serve_own_event(event)

    def _serve_own_event(self, event: messages.Event) -> None:
        """This process was taken in for a former one of its name, or is itself the former one."""
        data: dict[str, Any] = event.data
        if data.get("incarnation") == self._incarnation:
            if self._done_ns < 0:
                self._replay(max(int(data["from_ns"]) - 1, int(data["done_ns"])))
        elif data.get("former_pid") == os.getpid() and data.get("pid") != os.getpid():
            self._leave = "superseded"
            self._failure = (
                f"{self._agent.name}: another process of this name joined from {data.get('host')} "
                f"(pid {data.get('pid')}); this one ends. Give each process its own name."
            )

    def _serve_link(self, up: bool) -> None:
        if up and self.health.link_lost:
            self.health.link_lost = False
            self._say(f"{self._agent.name}: the link is back")
            self._rejoin()
        elif not up:
            self.health.link_lost = True
            self._say(f"{self._agent.name}: lost the link to the world; waiting for it to come back")

    def _serve_query(self, query: Query) -> None:
        if query.expression == keys.process(self._agent.name, "outputs"):
            kept = [[key, messages.encode(message)] for _, outputs in self._kept for key, message in outputs]
            query.answer(ControlAnswer(ok=True, result=kept))
            return
        try:
            answer = self._agent.control(query.expression, query.request())
        except DecodeError as error:
            answer = ControlAnswer(ok=False, error=str(error))
        query.answer(answer)

    def _put_process(self, what: str, message: Any) -> None:
        self._link.put(keys.process(self._agent.name, what), message)
