"""The recorder as a process: writes every message on every key to `run.mcap`.

The run does not wait for the recorder gate by gate, but in lockstep the world is never further ahead of the record on
disk than the world's history reaches back. A recorder that rejoins, or replaces a dead one, therefore continues without
a gap.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path

import msgspec
from msgspec import UNSET

from zsim.contract import keys, messages, run_messages
from zsim.contract.flight_messages import Command
from zsim.contract.framing import run_key_table
from zsim.contract.run_messages import Clock
from zsim.errors import DecodeError, NoWorldError, RecordError, RunError, SupersededError
from zsim.record import Recorded, RecordReader, RecordWriter
from zsim.record.completeness import GateCount
from zsim.record.record_writer import CHANNELS_MAX
from zsim.runtime.participant import ANOTHER_RUN, Participant
from zsim.transport.connection import read_info
from zsim.transport.session import ReceivedSample, Session
from zsim.transport.traffic import Passed, Traffic, replay, samples

NAME = "recorder"
PAUSE_S = 0.01  # interval between reads of the queue, since each wake-up is costly
TICK_S = 0.1  # interval between checks of the open chunk's age and for a requested stop
JOIN_S = 1.0  # wall time after which a join is repeated if no event confirms it, since the world may have missed it
LEAD_MAX_NS = 4_000_000_000  # maximum lead of the world over the record on disk; the world's history covers 5 s
DRAIN_S = 1.0  # time to wait for the byes of other processes after the clock has stopped
STOP_DRAIN_S = 0.5  # time to wait for the end of the run after a requested stop, as the world may be stopped, too
QUIET_S = 1.5  # time without a clock after which one must have been missed: even a paused world sends one per second

REPLAY_S = 5.0  # timeout of queries, which a hub answers within milliseconds
FLUSH_NS = 1_000_000_000  # simulated time between writes to disk
REPEATED_NS = 1_000_000_000  # simulated time after catching up within which other processes may repeat messages
OUTPUTS = (Command, *messages.RELAYED)
KNOWN_MAX = 2_000_000  # maximum number of messages to remember: 7 s of 1000 drones
TAIL_NS = 7_000_000_000  # simulated time remembered from the end of a record; the world's history covers 5 s
Message = tuple[str, bytes]  # key and payload


class _Head(msgspec.Struct):
    t_ns: int


class Recorder:
    """Records a run until it ends.

    Args:
        path: path of the record, which may already exist.
        stopped: returns whether the process must end.
        say: called with lines for the user.
        deserted: called at the end; if it returns True, the recorder leaves without a bye, like a process that dies.
    """

    def __init__(
        self,
        link: Session,
        info: messages.Info,
        path: Path,
        stopped: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda text: None,
        deserted: Callable[[], bool] = lambda: False,
    ) -> None:
        self._link = link
        self._info = info
        self._stopped = stopped
        self._print = say
        self._deserted = deserted
        self._participant = Participant(link, info, NAME, slack_ns=LEAD_MAX_NS, calculates=False)
        self.health = self._participant.health
        self._joined_s = 0.0
        self._others: dict[str, int] = {}  # incarnations of the processes that have joined and not left, by name
        self._links: deque[bool] = deque()
        self._is_link_lost = False
        self._must_check_run = False
        self._writer = RecordWriter(path, goes_on=is_of_run(path, info.run_id))
        self._head = msgspec.msgpack.Decoder(_Head)
        self._clock = msgspec.msgpack.Decoder(Clock)
        self._known = KnownMessages()
        self._gates = GateCount()
        self._has_caught_up = False
        self._known_until_ns = 0
        self._stop_event = threading.Event()
        self._ended_s: float | None = None
        self._stopped_s: float | None = None
        self._held: list[Passed] = []  # received messages, to be written after missed ones
        self._must_fetch = False  # in realtime, whether a lost link is restored but missed messages are not yet fetched
        self._silent_since_s: float | None = None  # since when no clock has arrived after a lost link in realtime
        self._flushed_ns = 0  # simulated time of the last write to disk
        self._refused_count = 0

    def run(self) -> str:
        """Record until the run ends; return why it ended.

        Raises:
            RunError: the world has started another run; the record of the former run has no gap.
            RecordError: the disk is full or the file cannot be written; what was written is readable.
            SupersededError: another recorder of this name has taken over.
        """
        self._traffic = Traffic(self._link, run_key_table(self._info), self._on_refused)
        self._extra_subscriptions = [
            self._link.subscribe(expression) for expression in ("view/**", keys.camera("*", "*"))
        ]
        self._link.declare_process(NAME)
        self._link.on_link(self._on_link)
        ticker = threading.Thread(target=self._tick, name="tick", daemon=True)
        try:
            if self._writer.has_former:
                self._resume()
                self._print(f"{NAME}: continues {self._writer.path} after t = {self._participant.now_ns / 1e9:.2f} s")
            else:  # a replay may no longer contain these last values
                lasting = {keys.INFO: messages.encode(self._info)}
                for key in (keys.INFO, keys.FAULTS, keys.camera_info("*", "*")):
                    lasting |= {sample.key: sample.payload for sample in self._link.get(key)}
                self._write_known(lasting.items())
            self._catch_up()
            self._join()
            ticker.start()
            reason = self._loop()
            self._write_held()
            self._writer.close()
        except RecordError as error:  # without a bye, the world would wait for a restart
            self._participant.leave(str(error))
            raise
        finally:
            self._stop_event.set()
            if ticker.is_alive():
                ticker.join()
        if self._refused_count:
            why = f"a record contains at most {CHANNELS_MAX} keys, and these are on other keys"
            self._print(f"{NAME}: {self._refused_count} messages are missing from the record: {why}")
        if self._participant.superseded:
            why = self._participant.end_reason
            raise SupersededError(f"{NAME}: {why}; this recorder ends; its record is {self._writer.path}")
        if reason == ANOTHER_RUN:
            raise RunError(f"{NAME}: {reason}; the record {self._writer.path} is complete up to the end of that run")
        if not self._deserted():
            self._participant.leave(reason)
        return reason

    def _loop(self) -> str:
        while True:
            arrived = self._traffic.receive()
            time.sleep(PAUSE_S)
            arrived += self._traffic.drain()
            if self._is_another_run():  # first, since received messages may be later than missed ones
                return ANOTHER_RUN
            self._write_arrived(arrived)
            if self._silent_since_s is not None and time.monotonic() - self._silent_since_s > QUIET_S:
                # the last messages, such as the end of the run, were published before the link was restored
                self._silent_since_s, self._must_fetch = None, False
                self._fetch_missed()
                self._write_held()
            for sample in chain.from_iterable(subscription.drain() for subscription in self._extra_subscriptions):
                self._write(sample.key, sample.payload)
            self._writer.tick(time.monotonic_ns())
            if self._participant.now_ns - self._flushed_ns >= FLUSH_NS:
                self._flush()
            self.health.refused += self._writer.refused - self._refused_count  # messages refused for lack of channels
            self._refused_count = self._writer.refused
            if not self._participant.admitted and time.monotonic() - self._joined_s > JOIN_S:
                self._join()
            if self._participant.superseded:
                return "superseded"
            if self._ended_s is None and self._stopped():
                self._stopped_s = self._stopped_s or time.monotonic()
                if time.monotonic() - self._stopped_s > STOP_DRAIN_S:  # the run has not ended in the meantime
                    return "stopped"
            if self._ended_s is not None and (not self._others or time.monotonic() - self._ended_s > DRAIN_S):
                return run_messages.RUN_ENDED

    def _flush(self) -> None:
        self._writer.flush()
        self._flushed_ns = t_ns = self._participant.now_ns
        self._participant.done(t_ns)

    def _join(self, again: bool = False) -> None:
        """Join, so that the world is at most LEAD_MAX_NS ahead of the record on disk from now on."""
        self._participant.join(again)
        self._joined_s = time.monotonic()
        self._flush()

    def _tick(self) -> None:
        while not self._stop_event.wait(TICK_S):
            self._traffic.wake()
            self._participant.publish_health()

    def _on_refused(self) -> None:
        self.health.refused += 1

    def _resume(self) -> None:
        """Continue from the end of a predecessor's record, which may be the end of the run."""
        if last := self._known.add_tail(self._writer.path):
            self._participant.now_ns = last.t_ns
            clock = self._clock_in(last.payload)
            self._gates = GateCount(clock)
            if clock is not None and clock.state == "stopped":
                self._ended_s = time.monotonic()

    def _catch_up(self, before: Clock | None = None) -> None:
        """Write the messages published in the absence of this process, from the world's history.

        The request is repeated until the world answers; a message that is received twice is written once.
        """
        self._has_caught_up = False
        while True:
            try:
                self._write_known(self._replayed(before))
            except NoWorldError:
                if self._may_continue():
                    continue
            break
        self._has_caught_up, self._known_until_ns = True, self._participant.now_ns + REPEATED_NS

    def _write_known(self, written: Iterable[Message]) -> None:
        for key, payload in written:
            self._write(key, payload)
            self._known.add(key, payload)

    def _replayed(self, before: Clock | None) -> Iterator[Message]:
        """Yield the world's replay up to a received clock, if given, since later messages are in transit."""
        held: list[Message] = []
        for entry in replay(self._link, NAME, -1, ["**"], REPLAY_S):
            held.append(entry)
            clock = self._clock_in(entry[1]) if before is not None and entry[0] == keys.CLOCK else None
            if before is not None and clock is not None and clock.seq >= before.seq:
                yield from held[:-1] if clock.seq == before.seq else ()
                return
            if before is None or clock is not None:
                yield from held
                held.clear()

    def _fetch_missed(self, before: Clock | None = None) -> None:
        """Write the messages after the newest one in the record that the world still has, up to a clock if given."""
        self._writer.flush()
        self._known.add_tail(self._writer.path)
        self._catch_up(before)

    def _may_continue(self) -> bool:
        """Wait for a tick; return whether the process may continue."""
        self._stop_event.wait(TICK_S)
        return not self._stopped()

    def _world_info(self) -> messages.Info | None:
        """Return `world/info`, waiting up to REPLAY_S for a world that has just been restarted; None if unanswered."""
        until_s = time.monotonic() + REPLAY_S
        while (info := read_info(self._link)) is None and time.monotonic() < until_s and self._may_continue():
            pass
        return info

    def _on_link(self, up: bool) -> None:
        self._links.append(up)
        self._traffic.wake()

    def _is_another_run(self) -> bool:
        """Return whether a restored link leads to another run; if not, fetch the missed messages."""
        while self._links:
            up = self._links.popleft()
            if not up:
                self._print(f"{NAME}: lost the link to the world; waiting for it to come back")
            self._must_check_run = up and self._is_link_lost
            self._is_link_lost = not up
        info = self._world_info() if self._must_check_run else None
        if info is None:
            return False
        self._must_check_run = False
        if info.run_id != self._info.run_id:
            return True
        if self._info.mode == "lockstep":
            self._fetch_missed()
        else:  # the world may be far ahead of the messages in transit
            self._silent_since_s = time.monotonic()
            self._must_fetch = True
        if not self._participant.superseded:  # which a missed message may have revealed
            self._join(again=True)
        return False

    def _write_arrived(self, arrived: Iterable[Passed]) -> None:
        """Write received messages and, before them, if the clocks have a gap, those from the world's history.

        Messages are held until the next clock is checked, since they may be later than missing ones. After a lost link
        in realtime, in which the world does not wait for this process, the missed messages need not include a clock;
        they are then fetched at the first clock after the process's own join.
        """
        for passed in arrived:
            self._held.append(passed)
            if isinstance(passed, ReceivedSample) and passed.key == keys.CLOCK:
                clock = self._clock_in(passed.payload)
                if clock is not None and (self._gates.misses(clock) or (self._must_fetch and self._holds_own_join())):
                    info = self._world_info()
                    if info is not None and info.run_id == self._info.run_id:
                        self._must_fetch = False
                        self._fetch_missed(clock)
                self._write_held()
        if not self._must_fetch:
            self._write_held()

    def _holds_own_join(self) -> bool:
        events = (each for each in self._held if isinstance(each, ReceivedSample) and each.key == keys.EVENT)
        entries = (self._participant.entry_in(event.payload) for event in events)
        return any(entry is not None and self._participant.is_own(entry) for entry in entries)

    def _write_held(self) -> None:
        for passed in self._held:
            if isinstance(passed, ReceivedSample):
                self._write(passed.key, passed.payload)
            elif self._known:
                for key, payload in samples([passed]):
                    self._write(key, payload)
            else:
                self.health.received += len(passed)
                self._participant.now_ns = passed.t_ns
                self._writer.add_gate(passed, time.time_ns())
        self._held.clear()

    def _write(self, key: str, payload: bytes) -> None:
        if self._known and (key, payload) in self._known:
            return
        self.health.received += 1
        try:
            t_ns = max(0, min(self._head.decode(payload).t_ns, 2**62))
        except messages.REFUSALS:
            self.health.refused += 1
            t_ns = self._participant.now_ns  # a message without a time is recorded at the world's time
        self._writer.add(key, payload, messages.encoding(key), t_ns, time.time_ns())
        if key == keys.CLOCK:
            self._participant.now_ns = t_ns
            self._on_clock(payload)
        elif key == keys.EVENT:
            self._participant.take_event(payload)
            if self._participant.must_rejoin:
                self._participant.must_rejoin = False
                self._join(again=True)
        elif key.startswith("process/"):
            self._track_process(key, payload)

    def _track_process(self, key: str, payload: bytes) -> None:
        """Track which other processes have joined and not left."""
        name, kind = keys.thing(key), messages.type_of(key)
        if name == NAME or kind not in (run_messages.Join, run_messages.Bye):
            return
        with contextlib.suppress(DecodeError):  # an invalid message is recorded as received
            passed = messages.decode(key, payload)
            if isinstance(passed, run_messages.Join):
                self._others[name] = passed.incarnation
            elif passed.incarnation in (UNSET, self._others.get(name)):
                self._others.pop(name, None)

    def _clock_in(self, payload: bytes) -> Clock | None:
        """Return the decoded clock of this run; None for any other message."""
        try:
            clock = self._clock.decode(payload)
        except messages.REFUSALS:
            return None
        return clock if clock.run_id == self._info.run_id else None

    def _on_clock(self, payload: bytes) -> None:
        """Count the gate of a clock, and report the gates missing before it."""
        clock = self._clock_in(payload)
        if clock is None:
            return
        if gap := self._gates.add(clock):
            self._print(f"{NAME}: gates are missing from the record, and the world no longer has them: {gap}")
        if self._silent_since_s is not None:
            self._silent_since_s = time.monotonic()
        if clock.state == "stopped" and self._ended_s is None:
            self._ended_s = time.monotonic()
        elif self._has_caught_up and clock.t_ns > self._known_until_ns:
            self._known.clear()
        elif self._has_caught_up:
            self._known.keep_outputs()  # this clock was not replayed, so later messages were not either


class KnownMessages:
    """The KNOWN_MAX messages written last, so that none is written twice."""

    def __init__(self) -> None:
        self._known: dict[Message, None] = {}
        self._outputs_only = False

    def __bool__(self) -> bool:
        return bool(self._known)

    def __contains__(self, entry: Message) -> bool:
        return entry in self._known

    def add(self, key: str, payload: bytes) -> None:
        self._known[key, payload] = None
        self._outputs_only = False
        if len(self._known) > KNOWN_MAX:
            del self._known[next(iter(self._known))]

    def add_tail(self, path: Path) -> Recorded | None:
        """Add the messages at the end of a record; return the newest clock there."""
        with RecordReader(path) as reader:
            last = reader.last(keys.CLOCK)
            last_ns = last.t_ns if last else 0
            for recorded in reader.messages(by_time=False, from_ns=max(0, last_ns - TAIL_NS)):
                self.add(recorded.key, recorded.payload)
        return last

    def keep_outputs(self) -> None:
        """Keep only outputs, which participants repeat after a rejoin; messages of other kinds are not repeated."""
        if not self._outputs_only:
            self._known = {entry: None for entry in self._known if is_output(*entry)}
            self._outputs_only = True

    def clear(self) -> None:
        self._known.clear()


def is_output(key: str, payload: bytes) -> bool:
    kind = messages.type_of(key)
    try:
        return kind is not None and issubclass(kind, OUTPUTS) and messages.decode(key, payload) is not None
    except DecodeError:
        return False


def is_of_run(path: Path, run_id: str) -> bool:
    """Return whether a file is a record of the run, or empty.

    Raises:
        RecordError: the file is not a record.
    """
    if not path.exists() or not path.stat().st_size:
        return path.exists()
    with RecordReader(path) as reader:
        recorded = next(reader.messages([keys.INFO]), None)
        if recorded is None:
            return not reader.topics()
    try:
        return messages.decode(keys.INFO, recorded.payload).run_id == run_id
    except DecodeError:
        return False
