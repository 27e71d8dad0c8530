"""Messages with the wall time of their arrival, as realtime judges them by it."""

import threading
import time
from collections import deque
from collections.abc import Iterator

from zsim.errors import SessionError
from zsim.transport.session import Mailbox, Sample


class TimedMailbox:
    """A mailbox read by a thread that stamps every message with the wall time of its arrival.

    Args:
        mailbox: what to read.
        fresh: set whenever something has arrived.
    """

    def __init__(self, mailbox: Mailbox, fresh: threading.Event) -> None:
        self._mailbox = mailbox
        self._fresh = fresh
        self._arrived: deque[tuple[int, Sample]] = deque()
        self._thread = threading.Thread(target=self._pump, name="mailbox", daemon=True)
        self._thread.start()

    def _pump(self) -> None:
        while True:
            try:
                sample = self._mailbox.receive()
            except SessionError:
                return
            if sample is not None:
                self._arrived.append((time.monotonic_ns(), sample))
                self._fresh.set()

    def drain(self) -> Iterator[tuple[int, Sample]]:
        """Yield (wall_ns of arrival, sample) of what has arrived."""
        while self._arrived:
            yield self._arrived.popleft()

    def close(self) -> None:
        """Stop the reading thread."""
        self._mailbox.close()
        self._thread.join(timeout=2.0)
