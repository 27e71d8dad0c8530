"""A process's place in a run: it joins, publishes what it is done with, catches up, and rejoins after a lost link.

What the world does not answer stays owed, and is asked for again until it does.
"""

import os
import secrets
import time
from collections import deque
from collections.abc import Callable, Sequence

from msgspec import UNSET

from zsim.contract import keys, messages, run_messages
from zsim.contract.fingerprint import join_of
from zsim.contract.framing import Pairs
from zsim.contract.messages import ProcessEntry
from zsim.contract.snapshot import VERSION, pack, unpack
from zsim.errors import BehindError, DecodeError, NoWorldError, RunError, SupersededError
from zsim.runtime.agent import Agent, Output
from zsim.runtime.inbox import output_hold_ns
from zsim.transport.connection import read_info
from zsim.transport.session import ReceivedSample, Session
from zsim.transport.traffic import replay

REPLAY_S = 2.0  # a hub answers a replay within milliseconds; a lost link does not
REJOINS_MAX = 6  # times that a rejoin is published before it counts as received; a router forwards nothing at first
RETRY_S = 0.5  # wall time between two attempts at what is owed
ASKED_MAX = 10  # answers to what is lost that may lack it; the world answers from what it has on the way, too
RESUME_NS = 4_000_000_000  # simulated time that a snapshot may be old: the world keeps 5 s of what has passed
GATES_KEPT = 2  # gates of which the outputs are kept to answer a get, contract; more where the world runs ahead


class Membership:
    """One agent's process in one run.

    Args:
        link: an open session.
        info: of the run.
        agent: whose name and sequence numbers it goes by.
        take_in: takes what a replay brings.
        say: called with lines for the user.
        wall_s: monotonic wall time.
        stopped: tells whether the process is to end.

    Attributes:
        done_ns: newest gate that it is through with, -1 before the first.
        published_ns: gate up to which a former incarnation has published all outputs, which are not published again.
        awaited: whether the world has still to say that this process takes part, and from which gate on.
        failure: why it can take part no longer, None while it can.
    """

    def __init__(
        self,
        link: Session,
        info: messages.Info,
        agent: Agent,
        take_in: Callable[[ReceivedSample], None],
        say: Callable[[str], None],
        wall_s: Callable[[], float] = time.monotonic,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self._stopped = stopped
        self._resumed = False
        self._link = link
        self._info = info
        self._agent = agent
        self._take_in = take_in
        self._say = say
        self._wall_s = wall_s
        self._incarnation = secrets.randbits(62)
        self._incarnations = {self._incarnation}
        self._done_key = keys.process(agent.name, "done")
        ahead = info.command_delay_ns // info.gate_ns
        self._kept: deque[tuple[int, Sequence[Output]]] = deque(maxlen=GATES_KEPT + ahead)
        self._unsent: Pairs = []
        self._must_rejoin = False
        self._unproved = 0
        self._proof_ns = 0
        self._missed_since_ns: int | None = None
        self._asked_ns = -1
        self._asked = 0
        self._retry_s = 0.0
        self.done_ns = self.published_ns = -1
        self.awaited = False
        self._packs = True
        self.failure: RunError | None = None

    # Taking part

    def resume(self) -> int | None:
        """Hand the agent the newest snapshot of a former incarnation; return the time of it, None if none can be used.

        The world's history must reach back to it: what came since is fetched and stepped through again.
        """
        for sample in self._last_values(keys.process(self._agent.name, "snapshot")):
            fresh = self._agent.checkpoint()
            try:
                snapshot: run_messages.Snapshot = messages.decode(sample.key, sample.payload)
                self._restore(snapshot)
            except Exception as error:  # anybody may have written it, and a class of the user's own reads it
                self._say(f"{self._agent.name}: its former snapshot is of no use: {error or type(error).__name__}")
                if fresh is not None:
                    self._agent.resume(self._info, fresh)  # not half of the former state
                continue
            self._say(f"{self._agent.name}: goes on from its snapshot of t = {snapshot.t_ns / 1e9:.2f} s")
            self.done_ns, self._resumed = snapshot.t_ns, True
            return self.done_ns
        return None

    def _restore(self, snapshot: run_messages.Snapshot) -> None:
        age_ns = self._world_ns() - snapshot.t_ns
        if not 0 <= age_ns <= RESUME_NS or snapshot.version != VERSION:
            allowed = f"must be of version {VERSION}, and 0 to {RESUME_NS / 1e9:g} s old"
            raise DecodeError(f"it is of version {snapshot.version}, and {age_ns / 1e9:.2f} s old; {allowed}")
        self._agent.resume(self._info, unpack(snapshot.state))

    def _world_ns(self) -> int:
        """Return the world's newest gate."""
        clocks = [messages.decode(sample.key, sample.payload) for sample in self._last_values(keys.CLOCK)]
        return clocks[0].t_ns if clocks else 0

    def _last_values(self, key: str) -> list[ReceivedSample]:
        """Return what the world has as the last value of a key, once there is a world that answers.

        One that has died is started again; who began without its former state would lose what that had come to know.
        """
        while not self._stopped():
            found = self._link.get_surely(key)
            if not found and self._link.get_surely(keys.INFO):  # there is a world, which may have come just now
                found = self._link.get_surely(key)
                if found is not None:
                    return found
            if found:
                return found
            time.sleep(RETRY_S)
        return []

    def warm_start(self) -> int | None:
        """Hand the agent what a former incarnation published last; return the time of it, None if there was none."""
        for key in self._agent.warm_start_keys():
            for sample in self._last_values(key):
                self._hand_over(key, sample.payload)
        if self.done_ns < 0:
            return None
        self._say(f"{self._agent.name}: warm start from t = {self.done_ns / 1e9:.2f} s")
        return self.done_ns

    def _hand_over(self, key: str, payload: bytes) -> None:
        try:
            message = messages.decode(key, payload)
        except DecodeError as error:
            self._say(f"{self._agent.name}: cold start, the last value is of no use: {error}")
            return
        self._agent.warm_start(key, message)
        self._agent.resume_seq(key, message.seq)
        self.done_ns = max(self.done_ns, message.t_ns)

    def enter(self) -> None:
        """Join; what follows waits for the event of it, and until that comes the join is repeated."""
        self.awaited = True
        self._join()
        self._retry_s = self._wall_s() + RETRY_S

    def _begin(self, entry: ProcessEntry) -> None:
        """Fetch what came since the state that was taken over, or in the time of a former incarnation."""
        self.awaited = False
        if self._resumed:
            self.published_ns = entry.done_ns
        elif self.done_ns >= 0:
            self._link.put(self._done_key, self._done(self.done_ns, 0))
        if self.done_ns >= 0:
            self._catch_up(self.done_ns)
        elif entry.former_pid is not None:
            self._catch_up(max(entry.from_ns - 1, entry.done_ns))

    def publish(self, t_ns: int, outputs: Sequence[Output]) -> None:
        """Encode the outputs of a gate and the done that counts them, for `send`."""
        self._kept.append((t_ns, outputs))
        counted = _counted(outputs)
        if t_ns <= self.published_ns:
            self._done(t_ns, counted)
            return
        encoded = [(key, messages.encode(message)) for key, message in outputs]
        encoded.append((self._done_key, messages.encode(self._done(t_ns, counted))))
        self._unsent += encoded

    def publish_snapshot(self, t_ns: int) -> None:
        """Encode the whole state of the agent after a gate, for `send`, if it offers one of plain values."""
        state, name = self._agent.checkpoint(), self._agent.name
        if state is None or not self._packs:
            return
        try:
            packed = pack(state)
        except TypeError as error:
            self._packs = False
            self._say(f"{name}: {error}; no snapshots are published, and a death costs what it has come to know")
            return
        snapshot = run_messages.Snapshot(t_ns, self._agent.next_seq("snapshot"), name, VERSION, packed)
        self._unsent.append((keys.process(name, "snapshot"), messages.encode(snapshot)))

    def send(self) -> None:
        """Put what was published since the last time, in one go: many messages at once cost fewer wake-ups."""
        if self._unsent:
            unsent, self._unsent = self._unsent, []
            self._link.put_all(unsent)

    def outputs(self) -> list[list[object]]:
        """Return [key, payload] of the outputs of the last gates, for a world that lost them with a link."""
        return [[key, messages.encode(message)] for _, outputs in self._kept for key, message in outputs]

    def leave(self, reason: str, failed: bool = False) -> None:
        """Publish bye; `failed` of one that cannot go on."""
        seq, of = self._agent.next_seq("bye"), (self._info.run_id, self._incarnation)
        bye = run_messages.Bye(max(0, self.done_ns), seq, reason, failed or UNSET, *of)
        self._link.put(keys.process(self._agent.name, "bye"), bye)

    def _join(self) -> None:
        agent, seq, t_ns = self._agent, self._agent.next_seq("join"), max(0, self.done_ns)
        host, run_id = self._link.host, self._info.run_id
        join = join_of(agent.name, host, run_id, self._incarnation, seq, t_ns, agent.period_ns, agent.serves)
        self._link.put(keys.process(agent.name, "join"), join)

    def _done(self, t_ns: int, sent: int) -> run_messages.Done:
        self.done_ns = max(self.done_ns, t_ns)
        seq = self._agent.next_seq("done")
        return run_messages.Done(t_ns, seq, self._info.run_id, self._incarnation, t_ns, sent)

    # Catching up and coming back

    @property
    def owes(self) -> bool:
        """Tell whether something was asked of the world that it has not answered yet."""
        return self._must_rejoin or self._unproved > 0 or self._missed_since_ns is not None or self.awaited

    @property
    def is_fetching(self) -> bool:
        """Tell whether what came since a snapshot is still to be fetched."""
        return self.awaited or self._missed_since_ns is not None

    def check_reach(self, t_ns: int, snapshot_ns: int) -> None:
        """Fail if the first gate that the world brings again is not the one after a snapshot."""
        if t_ns > snapshot_ns + self._info.gate_ns:
            self.failure = BehindError(
                f"{self._agent.name}: the gates after its snapshot of t = {snapshot_ns / 1e9:.2f} s are kept by nobody "
                "any more; this one ends, start it again"
            )

    def taken_in(self, entry: ProcessEntry) -> None:
        """Take the news that this process came after one of its name, or that another came after this one."""
        if entry.incarnation == self._incarnation:
            self._unproved = 0
            if self.awaited:
                self._begin(entry)
        elif entry.former_pid == os.getpid() and entry.pid != os.getpid():
            self.failure = SupersededError(
                f"{self._agent.name}: another process of this name joined from {entry.host} "
                f"(pid {entry.pid}); this one ends. Give each process its own name."
            )
        elif entry.pid == os.getpid() and entry.host == self._link.host and entry.incarnation not in self._incarnations:
            self._say(f"{self._agent.name}: somebody else has joined as this process; it joins again")
            self.come_back()

    def ask_again(self, t_ns: int, missing: str) -> None:
        """Fetch the rest of a gate of which messages did not come, as after a link that was cut."""
        if t_ns != self._asked_ns:
            self._asked_ns, self._asked, self._retry_s = t_ns, 0, 0.0
            self._say(f"{self._agent.name}: {missing} of t = {t_ns / 1e9:.2f} s did not come; asking for it again")
        if self._asked >= ASKED_MAX:
            self.failure = BehindError(
                f"{self._agent.name}: {missing} of t = {t_ns / 1e9:.2f} s is kept by nobody any more; this one ends, "
                "start it again"
            )
            return
        self._missed_since_ns = t_ns - self._info.gate_ns
        self.settle()

    def come_back(self) -> None:
        """Take part again by a new incarnation, now that the link is back."""
        self._incarnation = secrets.randbits(62)
        self._incarnations.add(self._incarnation)
        self._must_rejoin = True
        self._retry_s = 0.0
        self.settle()

    def _catch_up(self, since_ns: int) -> None:
        """Fetch what is stamped after `since_ns`."""
        self._missed_since_ns = since_ns
        self._retry_s = 0.0
        self.settle()

    def settle(self) -> None:
        """Do what is owed, unless it was tried a moment ago; what the world does not answer stays owed."""
        if not self.owes or self._wall_s() < self._retry_s:
            return
        if self._must_rejoin:
            self._rejoin()
        elif self.awaited:
            self._join()
        elif self._unproved:
            self._insist()
        if self._missed_since_ns is not None and not self._must_rejoin:
            self._fetch(self._missed_since_ns)
        self._retry_s = self._wall_s() + RETRY_S

    def _rejoin(self) -> None:
        """Join again, and publish once more what may have been lost."""
        info = read_info(self._link)
        if info is None:
            return
        self._must_rejoin = False
        if info.run_id != self._info.run_id:
            self.failure = RunError(f"{self._agent.name}: the world has begun another run")
            return
        self._unproved, self._proof_ns = REJOINS_MAX, self.done_ns + GATES_KEPT * self._info.command_delay_ns
        self._say_again()

    def _insist(self) -> None:
        """Publish again what may have been lost, unless the world has gone on with what this process published."""
        self._unproved -= 1
        if self.done_ns > self._proof_ns:
            self._unproved = 0
        else:
            self._say_again()

    def _say_again(self) -> None:
        """Join, and repeat what the world may lack."""
        self._join()
        for t_ns, outputs in self._kept:
            for key, message in outputs:
                self._link.put(key, message)
            self._link.put(self._done_key, self._done(t_ns, _counted(outputs)))
        self._missed_since_ns = self.done_ns

    def ask_faults(self) -> None:
        """Take in which faults are injected."""
        for sample in self._link.get(keys.FAULTS):
            self._take_in(sample)

    def _fetch(self, since_ns: int) -> None:
        self.ask_faults()
        try:
            wanted = (*self._agent.reads, *self._agent.repeats, keys.FAULTS)
            held_ns = output_hold_ns(self._info) if self._agent.overhears else 0
            for key, payload in replay(self._link, self._agent.name, max(-1, since_ns - held_ns), wanted, REPLAY_S):
                self._take_in(ReceivedSample(key, payload))
        except NoWorldError:
            return
        self._missed_since_ns = None
        self._asked += 1


def _counted(outputs: Sequence[Output]) -> int:
    """Return how many outputs the world counts."""
    return sum(messages.is_output(key) for key, _ in outputs)
