"""Participation of a process in a run: join, done, health, bye, supersession, and rejoining after a lost link.

    participant = Participant(link, info, "console.1")
    participant.announce()              join; the world admits the process by an event on `world/event`
    participant.tick()                  health once a second, and a new join after a lost link
    participant.leave("closed")         bye

Of several processes with the same name, the last one admitted by the world takes part. `AgentParticipant`, for a
process that runs an agent, also takes over the state of its predecessor and fetches missed messages.
"""

import os
import secrets
import time
from collections import defaultdict, deque
from collections.abc import Callable, Sequence

from msgspec import Struct

from zsim.contract import keys, messages, run_messages
from zsim.contract.framing import Pairs
from zsim.contract.messages import ProcessEntry
from zsim.contract.snapshot import VERSION, pack, unpack
from zsim.errors import BehindError, DecodeError, NoWorldError, RunError, SupersededError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.inbox import output_hold_ns
from zsim.runtime.membership import HealthMeter, Membership
from zsim.transport.connection import read_info
from zsim.transport.session import ReceivedSample, Session
from zsim.transport.traffic import replay

ANOTHER_RUN = "the world has begun another run"
REPLAY_S = 2.0  # wall-time limit of a replay; a hub answers within milliseconds, or never if the link is lost
REJOINS_MAX = 6  # unanswered joins after which one is assumed to have arrived; a new router forwards nothing at first
RETRY_S = 0.5  # wall time between attempts at an unanswered request to the world
REQUESTS_MAX = 10  # maximum number of replays for a lost message, which may reach the world only after the first
RESUME_NS = 4_000_000_000  # maximum simulated age of a usable snapshot: the world keeps 5 s of history
GATES_KEPT = 2  # gates whose outputs are kept for queries, as the contract demands; more if the world runs ahead


class Participant:
    """A process that takes part in one run.

    Attributes:
        admitted: whether the world has admitted its newest incarnation.
        successor: host and pid of the process that has taken over its name; empty if none has.
        end_reason: why it no longer takes part in this run; empty while it does.
    """

    def __init__(
        self,
        link: Session,
        info: messages.Info,
        name: str,  # process name, role.thing
        serves: tuple[str, ...] = (),  # names of the processes that it replaces
        # how far the world may be ahead of its last done; 0 for an agent, or if the world does not wait for the process
        slack_ns: int = 0,
        *,
        period_ns: int = 0,  # interval at which an agent reports done; 0 for other processes
        # whether results depend on its floating-point arithmetic; if not, its join has no fingerprint
        calculates: bool = True,
        next_seq: Callable[[str], int] | None = None,
    ) -> None:
        self.name = name
        # whether it reports done although not an agent; it must then subscribe to all its inputs before `announce`
        self.gates = slack_ns > 0
        self.now_ns = 0  # simulated time of the newest clock message received
        self.done_ns = -1  # newest gate done; -1 before the first
        self.health = HealthMeter(name.split(".", 1)[0], host=link.host, reads=link.reads)  # its published counters
        self.must_rejoin = False  # whether the world may consider it dead or have mistaken another process for it
        self.successor = self.end_reason = ""
        self.next_seq = next_seq or self._count  # returns the next sequence number for a kind of message, from 0
        self._link, self._info = link, info
        others = tuple(each for each in serves if each != name)
        own = (name, link.host, info.run_id, self.next_seq)
        self._membership = Membership(*own, others, period_ns, slack_ns, calculates)
        self._seq: defaultdict[str, int] = defaultdict(int)
        self._incarnations: list[int] = []  # oldest first
        self._renew_incarnation()
        self._was_link_lost = self._has_left = False

    def _count(self, kind: str) -> int:
        self._seq[kind] += 1
        return self._seq[kind] - 1

    def _renew_incarnation(self) -> None:
        self.admitted = False
        self._membership.incarnation = secrets.randbits(62)
        self._incarnations.append(self._membership.incarnation)

    @property
    def superseded(self) -> bool:
        return bool(self.successor)

    # Publications

    def announce(self) -> None:
        """Join the run, and watch for events and link changes that require another join."""

        def follow_link(up: bool) -> None:
            self.must_rejoin = up and self._was_link_lost
            self._was_link_lost = not up

        self._link.declare_subscriber(keys.EVENT, lambda sample: self.take_event(sample.payload))
        self._link.on_link(follow_link)
        self._link.declare_process(self.name)
        self.join()

    def join(self, is_rejoin: bool = False) -> None:
        if is_rejoin:
            self._renew_incarnation()
        self.publish("join", self._membership.join(self.now_ns))

    def done(self, t_ns: int) -> None:
        """Publish that all gates up to t_ns are done, if this process has `slack_ns`."""
        if self.gates:
            self.done_ns = max(self.done_ns, t_ns)
            self.publish("done", self._membership.done(t_ns, 0))

    def leave(self, reason: str, failed: bool = False) -> None:
        """Publish a bye, once, unless superseded; `failed` means that the process cannot continue."""
        if not self.superseded and not self._has_left:
            self._has_left = True
            self.publish("bye", self._membership.bye(self.now_ns, reason, failed))

    def tick(self) -> None:
        """Rejoin if necessary, and publish health once per second of wall time; must be called more often."""
        if self.must_rejoin:
            self.must_rejoin = False
            self.join(is_rejoin=True)
            if self.done_ns >= 0:  # the last done may have been lost, or belong to the former incarnation
                self.done(self.done_ns)
        self.publish_health()

    def publish_health(self) -> None:
        """Publish health if the last health message is at least a second of wall time old."""
        if self.health.due():
            self.publish("health", self.health.message(self.now_ns, self.next_seq("health")))

    def publish(self, kind: str, message: Struct) -> None:
        self._link.put(keys.process(self.name, kind), message)

    # Inputs

    def update_clock(self, payload: bytes) -> run_messages.Clock | None:
        """Update the state of the run from a message on `clock`; return the message, None if it cannot be decoded."""
        try:
            clock: run_messages.Clock = messages.decode(keys.CLOCK, payload)
        except DecodeError:
            self.health.refused += 1
            return None
        self.now_ns = clock.t_ns
        if clock.run_id != self._info.run_id:
            self.end_reason = ANOTHER_RUN
        elif clock.state == "stopped":
            self.end_reason = run_messages.RUN_ENDED
        return clock

    def take_event(self, payload: bytes) -> None:
        entry = self.entry_in(payload)
        if entry is not None:
            self.take_entry(entry)

    def entry_in(self, payload: bytes) -> ProcessEntry | None:
        """Return the admission of a process of this name from an event; None for any other event."""
        try:
            event = messages.read_event(payload)
        except DecodeError:
            return None  # not an event of the world
        if event is None or event.subject != self.name or not isinstance(event.data, ProcessEntry):
            return None
        return event.data

    def take_entry(self, entry: ProcessEntry) -> None:
        """Handle the admission of a process of this name: this one, or one that replaces it.

        Until this incarnation is admitted, any other admitted one precedes it and will be replaced by it.
        """
        if self.is_own(entry):
            self.admitted = True
        elif not self.admitted or entry.incarnation in self._incarnations:
            return
        elif (entry.host, entry.pid) == (self._link.host, os.getpid()):
            self.must_rejoin = True  # another program has joined under the identity of this process
        else:
            self.successor = f"{entry.host} (pid {entry.pid})"
            self.end_reason = f"another process of this name joined from {self.successor}"

    def is_own(self, entry: ProcessEntry) -> bool:
        return entry.incarnation == self._membership.incarnation


class AgentParticipant(Participant):
    """The process of an agent that takes part in one run.

    `settle` repeats unanswered requests to the world and must be called regularly.
    """

    def __init__(
        self,
        link: Session,
        info: messages.Info,
        agent: Agent,  # provides the name and sequence numbers
        take_in: Callable[[ReceivedSample], None],  # receives the messages of a replay
        say: Callable[[str], None],
        wall_s: Callable[[], float] = time.monotonic,
        stopped: Callable[[], bool] = lambda: False,  # returns whether the process is to end
    ) -> None:
        super().__init__(link, info, agent.name, agent.serves, period_ns=agent.period_ns, next_seq=agent.next_seq)
        self._agent = agent
        self._take_in = take_in
        self._say = say
        self._wall_s = wall_s
        self._stopped = stopped
        self._done_key = keys.process(agent.name, "done")
        ahead = info.command_delay_ns // info.gate_ns
        self._recent_outputs: deque[tuple[int, Sequence[Output]]] = deque(maxlen=GATES_KEPT + ahead)
        self._unsent: Pairs = []
        self._resumed = False
        self._unproved = 0  # joins left to repeat; none once a gate after `_proof_ns` is done
        self._proof_ns = 0  # gates after this one prove that the world continues with this process
        self._missed_since_ns: int | None = None
        self._requested_ns, self._request_count = -1, 0
        self._retry_s = 0.0
        # gate up to which the predecessor published all outputs; they are not published again
        self.published_ns = -1
        self.awaited = False  # whether the world has yet to admit this process
        self.failure: RunError | None = None  # why it can no longer take part; None while it can

    # Taking over from a predecessor

    def resume(self) -> int | None:
        """Restore the agent from its predecessor's newest snapshot; return its time, None if none is usable.

        The world's history must reach back to the snapshot: later messages are fetched and processed again.
        """
        for sample in self._last_values(keys.process(self.name, "snapshot")):
            initial_state = self._agent.checkpoint()
            try:
                snapshot: run_messages.Snapshot = messages.decode(sample.key, sample.payload)
                clocks = [messages.decode(each.key, each.payload) for each in self._last_values(keys.CLOCK)]
                age_ns = (clocks[0].t_ns if clocks else 0) - snapshot.t_ns
                if not 0 <= age_ns <= RESUME_NS or snapshot.version != VERSION:
                    problem = f"it is of version {snapshot.version}, and {age_ns / 1e9:.2f} s old"
                    raise DecodeError(f"{problem}; must be of version {VERSION}, and 0 to {RESUME_NS / 1e9:g} s old")
                self._agent.resume(self._info, unpack(snapshot.state))
            except Exception as error:  # any program may have written it, and a user's class reads it
                self._say(f"{self.name}: its last snapshot is unusable: {error or type(error).__name__}")
                if initial_state is not None:
                    self._agent.resume(self._info, initial_state)  # the unusable state may be half restored
                continue
            self._say(f"{self.name}: continues from its snapshot of t = {snapshot.t_ns / 1e9:.2f} s")
            self.done_ns = self.now_ns = snapshot.t_ns
            self._resumed = True
            return self.done_ns
        return None

    def warm_start(self) -> int | None:
        """Pass the last values of its predecessor to the agent; return the time of the newest, or None."""
        for key in self._agent.warm_start_keys():
            for sample in self._last_values(key):
                try:
                    message = messages.decode(key, sample.payload)
                except DecodeError as error:
                    self._say(f"{self.name}: cold start, the last value is unusable: {error}")
                    continue
                self._agent.warm_start(key, message)
                self._agent.resume_seq(key, message.seq)
                self.done_ns = self.now_ns = max(self.done_ns, message.t_ns)
        if self.done_ns < 0:
            return None
        self._say(f"{self.name}: warm start from t = {self.done_ns / 1e9:.2f} s")
        return self.done_ns

    def _last_values(self, key: str) -> list[ReceivedSample]:
        """Return the world's last values of a key, waiting until a world answers.

        A world that has died is restarted; an agent that did not wait for it would lose its former state.
        """
        while not self._stopped():
            values = self._link.get_surely(key)
            if not values and self._link.get_surely(keys.INFO):  # a world answers, but may have appeared only just now
                values = self._link.get_surely(key)
                if values is not None:
                    return values
            if values:
                return values
            time.sleep(RETRY_S)
        return []

    def check_reach(self, t_ns: int, snapshot_ns: int) -> None:
        """Set `failure` if the first gate replayed by the world, `t_ns`, is not the one after the snapshot."""
        if t_ns > snapshot_ns + self._info.gate_ns:
            self._fail_behind(f"the gates after its snapshot of t = {snapshot_ns / 1e9:.2f} s are")

    def _fail_behind(self, cause: str) -> None:
        self.failure = BehindError(f"{self.name}: {cause} no longer kept; this process ends; start it again")

    # Taking part

    def enter(self) -> None:
        """Join; until the world admits this process, no gate is stepped and `settle` repeats the join."""
        self.awaited = True
        self.join()
        self._retry_s = self._wall_s() + RETRY_S

    def publish_gate(self, t_ns: int, outputs: Sequence[Output]) -> None:
        """Queue the outputs of a gate and the done that counts them for `send`."""
        self._recent_outputs.append((t_ns, outputs))
        self.now_ns = self.done_ns = max(self.done_ns, t_ns)
        done = self._membership.done(t_ns, _counted(outputs))
        if t_ns <= self.published_ns:
            return
        self._unsent += [(key, messages.encode(message)) for key, message in outputs]
        self._unsent.append((self._done_key, messages.encode(done)))

    def publish_snapshot(self, t_ns: int) -> None:
        """Queue a snapshot of the agent after a gate for `send`, if the agent supports snapshots.

        Raises:
            UserCodeError: a user's class returned a state that does not consist of plain values.
        """
        state = self._agent.checkpoint()
        if state is None:
            return
        snapshot = run_messages.Snapshot(t_ns, self.next_seq("snapshot"), self.name, VERSION, pack(state))
        self._unsent.append((keys.process(self.name, "snapshot"), messages.encode(snapshot)))

    def send(self) -> None:
        """Publish everything queued since the last call in one batch, which wakes readers less often."""
        if self._unsent:
            unsent, self._unsent = self._unsent, []
            self._link.put_all(unsent)

    def outputs(self) -> list[list[object]]:
        """Return the outputs of the last gates as [key, payload] pairs, for a world that lost them."""
        return [[key, messages.encode(message)] for _, outputs in self._recent_outputs for key, message in outputs]

    def take_entry(self, entry: ProcessEntry) -> None:
        """Handle an admission; if it is that of this process, fetch the messages since the restored state."""
        is_rejoining = self.must_rejoin
        super().take_entry(entry)
        if self.is_own(entry):
            self._unproved = 0
            if not self.awaited:
                return
            self.awaited = False
            if self._resumed:
                self.published_ns = entry.done_ns
            elif self.done_ns >= 0:
                self._link.put(self._done_key, self._membership.done(self.done_ns, 0))
            if self.done_ns >= 0:
                self._fetch_soon(self.done_ns)
            elif entry.former_pid is not None:
                self._fetch_soon(max(entry.from_ns - 1, entry.done_ns))
        elif self.successor:
            advice = "this one ends. Give each process its own name."
            self.failure = SupersededError(f"{self.name}: {self.end_reason}; {advice}")
        elif self.must_rejoin and not is_rejoining:
            self._say(f"{self.name}: another program has joined as this process; joining again")
            self.come_back()

    # Catching up and coming back

    @property
    def owes(self) -> bool:
        """Whether a request to the world is unanswered."""
        return self.must_rejoin or self._unproved > 0 or self.is_fetching

    @property
    def is_fetching(self) -> bool:
        """Whether it awaits admission or has yet to fetch missed messages."""
        return self.awaited or self._missed_since_ns is not None

    def ask_again(self, t_ns: int, missing: str) -> None:
        """Fetch the missing messages of a gate, for example after the link was cut."""
        if t_ns != self._requested_ns:
            self._requested_ns, self._request_count, self._retry_s = t_ns, 0, 0.0
            self._say(f"{self.name}: {missing} of t = {t_ns / 1e9:.2f} s did not arrive; requesting it again")
        if self._request_count >= REQUESTS_MAX:
            self._fail_behind(f"{missing} of t = {t_ns / 1e9:.2f} s is")
            return
        self._missed_since_ns = t_ns - self._info.gate_ns
        self.settle()

    def come_back(self) -> None:
        """Rejoin as a new incarnation after the link is restored."""
        self._renew_incarnation()
        self.must_rejoin = True
        self._retry_s = 0.0
        self.settle()

    def _fetch_soon(self, since_ns: int) -> None:
        self._missed_since_ns = since_ns
        self._retry_s = 0.0
        self.settle()

    def settle(self) -> None:
        """Repeat unanswered requests to the world, at most every RETRY_S."""
        if not self.owes or self._wall_s() < self._retry_s:
            return
        if self.must_rejoin:
            info = read_info(self._link)
            if info is not None:  # a world answers, perhaps that of another run
                self.must_rejoin = False
                if info.run_id == self._info.run_id:
                    self._unproved = REJOINS_MAX
                    self._proof_ns = self.done_ns + GATES_KEPT * self._info.command_delay_ns
                    self._publish_again()
                else:
                    self.failure = RunError(f"{self.name}: {ANOTHER_RUN}")
        elif self.awaited:
            self.join()
        elif self._unproved:
            self._unproved -= 1
            if self.done_ns > self._proof_ns:
                self._unproved = 0
            else:
                self._publish_again()
        if self._missed_since_ns is not None and not self.must_rejoin:
            self._fetch(self._missed_since_ns)
        self._retry_s = self._wall_s() + RETRY_S

    def _publish_again(self) -> None:
        """Join, and repeat the outputs and done messages that may have been lost."""
        self.join()
        for t_ns, outputs in self._recent_outputs:
            for key, message in outputs:
                self._link.put(key, message)
            self._link.put(self._done_key, self._membership.done(t_ns, _counted(outputs)))
        self._missed_since_ns = self.done_ns

    def ask_faults(self) -> None:
        for sample in self._link.get(keys.FAULTS):
            self._take_in(sample)

    def _fetch(self, since_ns: int) -> None:
        self.ask_faults()
        try:
            expressions = (*self._agent.reads, *self._agent.repeats, keys.FAULTS)
            held_ns = output_hold_ns(self._info) if self._agent.overhears else 0
            for key, payload in replay(self._link, self.name, max(-1, since_ns - held_ns), expressions, REPLAY_S):
                self._take_in(ReceivedSample(key, payload))
        except NoWorldError:
            return
        self._missed_since_ns = None
        self._request_count += 1


def _counted(outputs: Sequence[Output]) -> int:
    return sum(messages.is_output(key) for key, _ in outputs)
