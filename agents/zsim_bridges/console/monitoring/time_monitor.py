"""The run's clock, polled now and then."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from zsim.contract import keys, run_messages
from zsim.errors import ZsimError
from zsim.transport.session import Session
from zsim_bridges.observer_process import ObserverProcess

POLL_S = 0.25  # wall; rarely, since a message of each gate costs the world time
ANSWER_TIMEOUT_S = 1.0  # wall; the world answers within milliseconds
SILENT_S = 1.7  # wall; without an answer for so long what is shown may be long past: a stop is shown within 2 s


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
        self._answered_s = wall_s()
        self._known_s = -math.inf
        self.clock: run_messages.Clock | None = None

    @contextmanager
    def polling(self) -> Iterator[None]:
        """Poll again and again meanwhile."""
        over = threading.Event()
        thread = threading.Thread(target=self._poll_repeatedly, args=(over,), name="watch", daemon=True)
        self._answered_s, self._is_polling = self._wall_s(), True
        thread.start()
        try:
            yield
        finally:
            self._is_polling = False
            over.set()
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
                    self.clock, self._known_s, self._answered_s = clock, start_s, self._wall_s()

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
        silent_s = self._wall_s() - self._answered_s
        return silent_s if self._is_polling and silent_s >= SILENT_S else 0.0

    def _poll_repeatedly(self, over: threading.Event) -> None:
        while not over.is_set():
            self.poll()
            over.wait(POLL_S)

    def _is_old(self) -> bool:
        rate = max(1.0, self.clock.rate) if self.clock else 1.0  # as measured: of a run that has just begun, 0
        return (self._wall_s() - self._known_s) * rate > self._stamp_age_s
