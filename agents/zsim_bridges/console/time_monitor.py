"""The run's clock, polled now and then."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from zsim.contract import keys, run_messages
from zsim.errors import ZsimError
from zsim.transport.session import Session
from zsim_bridges.console.command_client import CommandClient, PastInstant
from zsim_bridges.console.histories import INTERVAL_S, SPAN_S
from zsim_bridges.console.run_condition import RunCondition, run_refusals
from zsim_bridges.observer_process import ObserverProcess

POLL_S = 0.25  # wall; rarely, since a message of each gate costs the world time
ANSWER_TIMEOUT_S = 1.0  # wall; the world answers within milliseconds
BEAT_S = 0.1  # wall; between two beats of this process
BEAT_MAX_S = 0.5  # wall; that count between two beats: a busy machine delays a thread by less
STALL_S = 2.0  # wall; without a beat for so long this process stood still, and says so
SILENT_S = 1.7  # wall; without an answer for so long what is shown may be long past: a stop is shown within 2 s


class Stall(NamedTuple):
    """A time for which this process itself stood still.

    Attributes:
        lasted_s: its length [s; wall].
        ended_s: when it was over [s; monotonic].
    """

    lasted_s: float
    ended_s: float


class AwakeClock:
    """Wall time while this process runs: of a time for which it was stopped, or starved, a beat is counted at most.

    Who was stopped has not heard the others: that is no silence of theirs.

    Args:
        wall_s: monotonic.

    Attributes:
        stall: the last one; None before the first.
    """

    def __init__(self, wall_s: Callable[[], float]) -> None:
        self._wall_s = wall_s
        self._lock = threading.Lock()
        self._beat_s, self._awake_s = wall_s(), 0.0
        self.stall: Stall | None = None

    def beat(self) -> None:
        """Note that this process runs; to be called every `BEAT_S`."""
        with self._lock:
            wall_s = self._wall_s()
            gap_s = wall_s - self._beat_s
            self._awake_s += min(gap_s, BEAT_MAX_S)
            self._beat_s = wall_s
            if gap_s >= STALL_S:
                self.stall = Stall(gap_s, wall_s)

    def now_s(self) -> float:
        """Return the time awake since this was made [s]."""
        with self._lock:
            return self._awake_s + min(self._wall_s() - self._beat_s, BEAT_MAX_S)


class TimeMonitor:
    """Polls the run's clock, in a thread of its own: drawing waits for no answer.

    Args:
        link: an open session.
        observer: of the console in the run; it follows the run's clock.
        stamp_age_s: simulated; how old the time of a stamp may be.
        wall_s: monotonic.

    Attributes:
        clock: the newest answer.
    """

    def __init__(
        self,
        link: Session,
        observer: ObserverProcess,
        stamp_age_s: float = math.inf,
        wall_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._observer = observer
        self._stamp_age_s = stamp_age_s
        self._wall_s = wall_s
        self._one = threading.RLock()
        self._is_polling = False
        self._awake = AwakeClock(wall_s)
        self._answered_s = self._awake.now_s()
        self._known_s = -math.inf
        self.clock: run_messages.Clock | None = None

    @contextmanager
    def polling(self) -> Iterator[None]:
        """Poll again and again meanwhile."""
        over = threading.Event()
        tasks = {"watch": self._poll_repeatedly, "heartbeat": self._beat_repeatedly}
        threads = [threading.Thread(target=act, args=(over,), name=name, daemon=True) for name, act in tasks.items()]
        self._awake.beat()
        self._answered_s, self._is_polling = self._awake.now_s(), True
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            self._is_polling = False
            over.set()
            for thread in threads:
                thread.join(ANSWER_TIMEOUT_S)

    def poll(self) -> None:
        """Poll once; one poll runs at a time."""
        with self._one:
            start_s = self._wall_s()
            try:
                samples = self._link.get(keys.CLOCK, timeout_s=ANSWER_TIMEOUT_S)
            except ZsimError:
                return  # the link is lost, and comes back
            for sample in samples:
                clock = self._observer.update_clock(sample.payload)
                if clock is not None:
                    self.clock, self._known_s, self._answered_s = clock, start_s, self._awake.now_s()

    def now_ns(self) -> int:
        """Return simulated time for a stamp, polling where it may be too old; within 2 ANSWER_TIMEOUT_S."""
        if self._is_old():
            with self._one:
                if self._is_old():  # no other thread has polled meanwhile
                    self.poll()
        return self._observer.now_ns

    @property
    def silent_s(self) -> float:
        """For how long the world has not answered; 0 where that is not long [s, wall]."""
        return self.heard_s if self.heard_s >= SILENT_S else 0.0

    @property
    def heard_s(self) -> float:
        """How long ago the world has answered last, of the time for which this process ran; 0 while nobody polls."""
        return self._awake.now_s() - self._answered_s if self._is_polling else 0.0

    @property
    def stall(self) -> Stall | None:
        """The last time for which this process itself stood still; None where it never did."""
        return self._awake.stall

    def _beat_repeatedly(self, over: threading.Event) -> None:
        while not over.wait(BEAT_S):
            self._awake.beat()

    def _poll_repeatedly(self, over: threading.Event) -> None:
        while not over.is_set():
            self.poll()
            over.wait(POLL_S)

    def _is_old(self) -> bool:
        rate = max(1.0, self.clock.rate) if self.clock else 1.0  # as measured: of a run that has just begun, 0
        return (self._wall_s() - self._known_s) * rate > self._stamp_age_s


PIECE_S = 10.0  # simulated; of what is read at once: the replay stands meanwhile, 0.15 s with thirty drones
INSTANT_DRONES_MAX = 9_000  # in a piece; a replay answers fewer than 10 000
BEHIND_S, AHEAD_S = SPAN_S, SPAN_S / 2.0  # simulated; about the shown instant, as far as trails and curves reach
KEPT_S = 2.0 * SPAN_S  # simulated; of what was read, on both sides of the shown instant


class RecordPlayer:
    """Steers a replay.

    Args:
        client: sends requests.
        time_monitor: of the run's clock.
        is_replay: whether the run is one; a flight has no timeline, and is not steered from here.
        drones: how many there are.

    Attributes:
        timeline: from_s, to_s [s] and marks (t_s, kind, text); empty of a flight, and before `load`.
    """

    def __init__(self, client: CommandClient, time_monitor: TimeMonitor, is_replay: bool, drones: int = 1) -> None:
        self._client = client
        self._time_monitor = time_monitor
        self._is_replay = is_replay
        self.timeline: dict[str, Any] = {}
        self._every_s = max(INTERVAL_S, PIECE_S * drones / INSTANT_DRONES_MAX)
        self._lock = threading.Lock()
        self._shown_s = 0.0
        self._known: set[int] = set()  # numbers of the pieces that were read
        self._is_reading = False
        self._arrived: deque[list[PastInstant]] = deque()

    def load(self) -> None:
        """Request the timeline; where the replay stands, what it played last too, before anybody subscribed to it."""
        if not self._is_replay:
            return
        self.timeline = self._client.timeline()
        self._time_monitor.poll()
        clock = self._time_monitor.clock
        if clock is not None and clock.state == "paused":
            self.play("seek", clock.t_ns / 1e9)

    def state(self, run: RunCondition) -> dict[str, Any]:
        """Return the timeline, with why each operation of `play` would be refused; empty of a flight."""
        return {**self.timeline, "refusals": run_refusals(run)} if self.timeline else {}

    def play(self, op: str, value: float) -> None:
        """Seek [s], pause, resume, step [gates] or set the rate; do nothing in a flight."""
        if not self.timeline:
            return
        clock = self._time_monitor.clock
        if op == "seek":
            self._client.seek(value, step=clock is not None and clock.state == "paused")
        else:
            args = {"step": {"gates": int(value)}, "rate": {"value": value}}
            self._client.request_world(op, **args.get(op, {}))

    def fill(self, t_s: float) -> None:
        """Let the record around the shown instant be read where it was not, in another thread, the nearest first."""
        if "to_s" not in self.timeline:
            return
        with self._lock:
            self._shown_s = t_s
            self._known = {k for k in self._known if abs(self._middle_s(k) - t_s) < KEPT_S - PIECE_S}
            if self._is_reading or self._missing() is None:
                return
            self._is_reading = self._client.read(self._read_missing)

    def take(self) -> list[PastInstant]:
        """Return the instants of a piece that has been read, each piece once; empty where there is none."""
        return self._arrived.popleft() if self._arrived else []

    def _middle_s(self, piece: int) -> float:
        return self.timeline["from_s"] + (piece + 0.5) * PIECE_S

    def _missing(self) -> int | None:
        """Return the piece nearest to the shown instant that was not read, None where all were."""
        from_s, to_s = self.timeline["from_s"], self.timeline["to_s"]
        first_s, last_s = max(from_s, self._shown_s - BEHIND_S), min(to_s, self._shown_s + AHEAD_S)
        pieces = range(math.floor((first_s - from_s) / PIECE_S), math.floor((last_s - from_s) / PIECE_S) + 1)
        unread = [k for k in pieces if k not in self._known]
        return min(unread, key=lambda k: abs(self._middle_s(k) - self._shown_s), default=None)

    def _read_missing(self) -> None:
        """Read piece by piece until none is missing; what cannot be read is not tried again."""
        while True:
            with self._lock:
                piece = self._missing()
                if piece is None:
                    self._is_reading = False
                    return
                self._known.add(piece)
            begin_s = self.timeline["from_s"] + piece * PIECE_S
            end_s = min(begin_s + PIECE_S - self._every_s / 2.0, self.timeline["to_s"])
            instants = self._client.past_views(begin_s, end_s, self._every_s)
            if instants:
                self._arrived.append(instants)
