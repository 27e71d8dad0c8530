"""What passes the world, taken in by a thread so that nobody waits for us: who is too slow loses the oldest gates."""

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Iterator

from zsim.contract import batch, keys
from zsim.contract.bundle import table_of, unpacked
from zsim.contract.messages import Info
from zsim.errors import DecodeError, SessionError
from zsim.runtime.health import HealthMeter
from zsim.transport.session import Session

BACKLOG = 250  # batches, some seconds of realtime


class Intake:
    """Messages in the order in which they passed.

    Args:
        link: an open session.
        info: of the run.
        health: counts what is lost or refused.
        loop: of the reader.

    Attributes:
        news: set when there is something to read.
    """

    def __init__(self, link: Session, info: Info, health: HealthMeter, loop: asyncio.AbstractEventLoop) -> None:
        self._box = link.subscribe(batch.KEY)
        self._table = table_of([drone.name for drone in info.drones])
        self._health = health
        self._loop = loop
        self._backlog: deque[bytes] = deque(maxlen=BACKLOG)
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)
        self.news = asyncio.Event()
        for sample in link.get(keys.CLOCK):  # of a world that stands, or has ended: it says nothing more
            self._backlog.append(batch.encode([(sample.key, sample.payload)]))
        self.news.set()
        self._thread.start()

    def close(self) -> None:
        """Take in no more."""
        self._box.close()
        self._thread.join(1.0)

    def batches(self) -> Iterator[list[tuple[str, bytes]]]:
        """Yield what has come until now, batch by batch, as keys and payloads."""
        self.news.clear()
        for _ in range(len(self._backlog)):
            yield self._opened(self._backlog.popleft())

    def _run(self) -> None:
        while True:
            try:
                sample = self._box.receive()
            except SessionError:
                return
            if sample is not None:
                self._health.dropped += len(self._backlog) == BACKLOG
                self._health.received += 1
                self._backlog.append(sample.payload)
                with contextlib.suppress(RuntimeError):  # the reader is gone
                    self._loop.call_soon_threadsafe(self.news.set)

    def _opened(self, payload: bytes) -> list[tuple[str, bytes]]:
        """Return keys and payloads; those of our drones are packed in a bundle."""
        found: list[tuple[str, bytes]] = []
        try:
            for key, said in batch.decode(payload):
                if key != batch.GATE:
                    found.append((key, said))
                    continue
                bundle = unpacked(said, self._table)
                if not bundle.is_sound():
                    raise DecodeError(f"{batch.GATE}: its parts do not fit together")
                found += bundle.encoded
        except DecodeError:
            self._health.refused += 1
        return found
