"""What a bridge that works in an event loop receives: what has passed the world, and pictures."""

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence

from zsim.contract import keys
from zsim.contract.framing import run_key_table
from zsim.contract.messages import Info
from zsim.errors import SessionError
from zsim.runtime.health import HealthMeter
from zsim.transport.session import RawSample, ReceivedSample, Session
from zsim.transport.traffic import Passed, Traffic, samples

BACKLOG = 100  # times that something arrived, a second or two of realtime


class TrafficIntake:
    """Messages in the order in which they passed the world; a reader that is too slow goes on with the newest.

    Messages that it has not read by then are dropped: flying by old messages is worse than missing some.

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
        """Receive nothing more."""
        self._traffic.close()
        self._thread.join(1.0)

    def arrivals(self) -> Iterator[list[ReceivedSample]]:
        """Yield what has arrived so far, in the parts in which it arrived."""
        self.news.clear()
        for _ in range(len(self._backlog)):
            try:
                passed = self._backlog.popleft()
            except IndexError:  # dropped meanwhile
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


WAITING_MAX = 10  # pictures that wait for the loop; then the oldest go


class PictureIntake:
    """Pictures of the cameras that somebody looks at: subscriptions come and go with the readers.

    Args:
        link: an open session.
        loop: on which `take` is called.
        take: called with key and payload of each picture.
    """

    def __init__(self, link: Session, loop: asyncio.AbstractEventLoop, take: Callable[[str, bytes], None]) -> None:
        self._link = link
        self._loop = loop
        self._take = take
        self._waiting: deque[RawSample] = deque(maxlen=WAITING_MAX)
        self._undeclare: dict[str, Callable[[], None]] = {}

    def follow(self, wanted: Iterable[str]) -> None:
        """Subscribe to these keys, and to no others."""
        keys = set(wanted)
        for key in keys - set(self._undeclare):
            self._undeclare[key] = self._declare(key)
        for key in set(self._undeclare) - keys:
            self._undeclare.pop(key)()

    def _declare(self, key: str) -> Callable[[], None]:
        try:
            return self._link.declare_subscriber(key, self._on_picture)
        except SessionError:  # no right to read it: as from a camera that is off, nothing comes
            return lambda: None

    def _on_picture(self, sample: RawSample) -> None:
        """Hand a picture over, in a thread of Zenoh's."""
        self._waiting.append(sample)
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._deliver)

    def _deliver(self) -> None:
        while self._waiting:
            sample = self._waiting.popleft()
            self._take(sample.key, sample.payload)
