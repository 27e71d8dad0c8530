"""The run's clock, polled now and then."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from zsim.contract import keys, run_messages
from zsim.errors import ZsimError
from zsim.runtime.participant import Participant
from zsim.transport.session import Session

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
