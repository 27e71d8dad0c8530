"""What has passed the world, for a bridge whose work is done in an event loop."""

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Iterator, Sequence

from zsim.contract import keys
from zsim.contract.framing import run_key_table
from zsim.contract.messages import Info
from zsim.errors import SessionError
from zsim.runtime.health import HealthMeter
from zsim.transport.session import ReceivedSample, Session
from zsim.transport.traffic import Passed, Traffic, samples

BACKLOG = 100  # times that something arrived, a second or two of realtime


class TrafficIntake:
    """Messages in the order in which they passed the world; a reader that is too slow goes on with the newest.

    What it has not read is left out then: what flies by old messages flies worse than what misses some.

    Args:
        link: an open session.
        info: of the run.
        health: counts what is lost or refused.
        loop: of the reader.

    Attributes:
        news: set when there is something to read.
    """

    def __init__(self, link: Session, info: Info, health: HealthMeter, loop: asyncio.AbstractEventLoop) -> None:
        self._traffic = Traffic(link, run_key_table(info), self._count_refused)
        self._health = health
        self._loop = loop
        self._backlog: deque[Sequence[Passed]] = deque()
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)
        self.news = asyncio.Event()
        for sample in link.get(keys.CLOCK):  # a world that stands, or has ended, publishes it no more
            self._backlog.append([sample])
        self.news.set()
        self._thread.start()

    def close(self) -> None:
        """Take in no more."""
        self._traffic.close()
        self._thread.join(1.0)

    def arrivals(self) -> Iterator[list[ReceivedSample]]:
        """Yield what has come until now, in the parts in which it came."""
        self.news.clear()
        for _ in range(len(self._backlog)):
            try:
                passed = self._backlog.popleft()
            except IndexError:  # left out meanwhile
                return
            yield list(samples(passed))

    def _run(self) -> None:
        while True:
            try:
                passed = self._traffic.receive()
            except SessionError:
                return
            if passed:
                if len(self._backlog) >= BACKLOG:
                    self._health.dropped += len(self._backlog)
                    self._backlog.clear()
                self._health.received += 1
                self._backlog.append(passed)
                with contextlib.suppress(RuntimeError):  # the reader is gone
                    self._loop.call_soon_threadsafe(self.news.set)

    def _count_refused(self) -> None:
        self._health.refused += 1
