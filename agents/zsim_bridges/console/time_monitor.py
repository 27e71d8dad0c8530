"""The run's time: its clock, which is polled, and the record that a replay plays."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from zsim.contract import keys, run_messages
from zsim.errors import ZsimError
from zsim.runtime.participant import Participant
from zsim.transport.session import Session
from zsim_bridges.console.command_client import CommandClient, PastInstant
from zsim_bridges.console.histories import INTERVAL_S, SPAN_S
from zsim_bridges.console.run_condition import RunCondition, run_refusals

POLL_S = 0.25  # wall; clock messages of every gate would cost the world time
ANSWER_TIMEOUT_S = 1.0  # wall; the world answers within milliseconds
BEAT_S = 0.1  # wall; between two beats of this process
BEAT_MAX_S = 0.5  # wall; counted between two beats at most: a busy machine delays a thread by less
STALL_S = 2.0  # wall; a longer time without a beat is a stall
SILENT_S = 1.7  # wall; after this long without an answer the world counts as silent: a stop is shown within 2 s
PIECE_S = 10.0  # simulated; read in one request, which blocks the replay for 0.15 s with thirty drones
INSTANT_DRONES_MAX = 9_000  # in a piece; a replay answers fewer than 10 000
BEHIND_S, AHEAD_S = SPAN_S, SPAN_S / 2.0  # simulated; around the shown instant, as far as trails and curves reach
KEPT_S = 2.0 * SPAN_S  # simulated; kept of what was read, on both sides of the shown instant


class Stall(NamedTuple):
    """An interval in which this process itself was stopped."""

    lasted_s: float  # wall
    ended_s: float  # monotonic


class AwakeClock:
    """Wall time while this process runs; of an interval in which it was stopped or starved, at most BEAT_MAX_S counts.

    A stopped process receives nothing, which does not mean that the others were silent.
    """

    def __init__(self, wall_s: Callable[[], float]) -> None:
        self._wall_s = wall_s
        self._lock = threading.Lock()
        self._beat_s, self._awake_s = wall_s(), 0.0
        self.stall: Stall | None = None  # the last one

    def beat(self) -> None:
        """Record that this process runs; to be called every BEAT_S."""
        with self._lock:
            wall_s = self._wall_s()
            gap_s = wall_s - self._beat_s
            self._awake_s += min(gap_s, BEAT_MAX_S)
            self._beat_s = wall_s
            if gap_s >= STALL_S:
                self.stall = Stall(gap_s, wall_s)

    def now_s(self) -> float:
        """Return the time awake so far [s]."""
        with self._lock:
            return self._awake_s + min(self._wall_s() - self._beat_s, BEAT_MAX_S)


class TimeMonitor:
    """Polls the run's clock in a separate thread, so that drawing never waits for an answer.

    It also updates the console's observer in the run; `stamp_age_s` is the greatest age of a stamp's time
        [simulated].
    """

    def __init__(
        self,
        link: Session,
        observer: Participant,
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
        self.clock: run_messages.Clock | None = None  # the newest answer

    @contextmanager
    def polling(self) -> Iterator[None]:
        """Poll the clock while the context is open."""
        over = threading.Event()

        def poll() -> None:
            while not over.is_set():
                self.poll()
                over.wait(POLL_S)

        def beat() -> None:
            while not over.wait(BEAT_S):
                self._awake.beat()

        tasks = {"watch": poll, "heartbeat": beat}
        threads = [threading.Thread(target=act, name=name, daemon=True) for name, act in tasks.items()]
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
        """Poll once; one thread at a time."""
        with self._one:
            start_s = self._wall_s()
            try:
                samples = self._link.get(keys.CLOCK, timeout_s=ANSWER_TIMEOUT_S)
            except ZsimError:
                return  # the link is lost and will return
            for sample in samples:
                clock = self._observer.update_clock(sample.payload)
                if clock is not None:
                    self.clock, self._known_s, self._answered_s = clock, start_s, self._awake.now_s()

    def now_ns(self) -> int:
        """Return simulated time for a stamp, after a poll if it may be too old; takes at most 2 ANSWER_TIMEOUT_S."""

        def is_old() -> bool:
            rate = max(1.0, self.clock.rate) if self.clock else 1.0  # as measured: 0 at the beginning of a run
            return (self._wall_s() - self._known_s) * rate > self._stamp_age_s

        if is_old():
            with self._one:
                if is_old():  # unless another thread has polled meanwhile
                    self.poll()
        return self._observer.now_ns

    @property
    def silent_s(self) -> float:
        """How long the world has not answered [s; wall]; 0 below SILENT_S."""
        return self.heard_s if self.heard_s >= SILENT_S else 0.0

    @property
    def heard_s(self) -> float:
        """Time awake since the world's last answer [s; wall]; 0 while the clock is not polled."""
        return self._awake.now_s() - self._answered_s if self._is_polling else 0.0

    @property
    def stall(self) -> Stall | None:
        return self._awake.stall


class RecordPlayer:
    """Controls the time of a replay, and reads its record around the shown instant in pieces.

    Args:
        is_replay: whether the run is a replay; otherwise all methods do nothing.

    Attributes:
        timeline: from_s, to_s [s] and marks (t_s, kind, text); empty before `load`.
    """

    def __init__(self, client: CommandClient, time_monitor: TimeMonitor, is_replay: bool, drones: int = 1) -> None:
        self._client = client
        self._time_monitor = time_monitor
        self._is_replay = is_replay
        self.timeline: dict[str, Any] = {}
        self._every_s = max(INTERVAL_S, PIECE_S * drones / INSTANT_DRONES_MAX)
        self._lock = threading.Lock()
        self._shown_s = 0.0
        self._known: set[int] = set()  # numbers of the pieces read
        self._is_reading = False
        self._arrived: deque[list[PastInstant]] = deque()

    def load(self) -> None:
        """Read the timeline; let a paused replay publish its instant again, for later subscribers."""
        if not self._is_replay:
            return
        self.timeline = self._client.timeline()
        self._time_monitor.poll()
        clock = self._time_monitor.clock
        if clock is not None and clock.state == "paused":
            self.play("seek", clock.t_ns / 1e9)

    def state(self, run: RunCondition) -> dict[str, Any]:
        """Return the timeline, with the reasons why operations of `play` would be refused."""
        return {**self.timeline, "refusals": run_refusals(run)} if self.timeline else {}

    def play(self, op: str, value: float) -> None:
        """Seek [s], pause, resume, step [gates] or set the rate."""
        if not self.timeline:
            return
        clock = self._time_monitor.clock
        if op == "seek":
            self._client.seek(value, step=clock is not None and clock.state == "paused")
        else:
            args = {"step": {"gates": int(value)}, "rate": {"value": value}}
            self._client.request_world(op, **args.get(op, {}))

    def fill(self, t_s: float) -> None:
        """Read the missing pieces of the record around an instant in another thread, nearest first."""
        if "to_s" not in self.timeline:
            return
        with self._lock:
            self._shown_s = t_s
            self._known = {k for k in self._known if abs(self._middle_s(k) - t_s) < KEPT_S - PIECE_S}
            if self._is_reading or self._missing() is None:
                return
            self._is_reading = self._client.read(self._read_missing)

    def take(self) -> list[PastInstant]:
        """Return the instants of the next piece read, each piece once; empty if there is none."""
        return self._arrived.popleft() if self._arrived else []

    def _middle_s(self, piece: int) -> float:
        return self.timeline["from_s"] + (piece + 0.5) * PIECE_S

    def _missing(self) -> int | None:
        """Return the unread piece nearest to the shown instant, None if there is none."""
        from_s, to_s = self.timeline["from_s"], self.timeline["to_s"]
        first_s, last_s = max(from_s, self._shown_s - BEHIND_S), min(to_s, self._shown_s + AHEAD_S)
        pieces = range(math.floor((first_s - from_s) / PIECE_S), math.floor((last_s - from_s) / PIECE_S) + 1)
        unread = [k for k in pieces if k not in self._known]
        return min(unread, key=lambda k: abs(self._middle_s(k) - self._shown_s), default=None)

    def _read_missing(self) -> None:
        """Read until no piece is missing; a piece that cannot be read is not retried."""
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
