"""What reaches the world: waited for with a limit or without, drained with the wall time of its arrival."""

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence

from zsim.errors import SessionError
from zsim.transport.session import Mailbox, Sample

TICK_S = 0.1  # how often a standing world looks at the wall clock


class Inputs:
    """What others publish: waited for with a limit or without, drained with the wall time of arrival."""

    def wait(self, timeout_s: float | None) -> None:
        """Return when something has come, or after timeout_s; without a limit, now and then to look at the clock."""
        raise NotImplementedError

    def wait_for(self, wanted: set[str]) -> None:
        """Wait until something has come on each of the wanted keys, or anything that is not a done."""
        self.wait(None)

    def drain(self) -> Iterator[tuple[int, Sample]]:
        """Yield what has come, with the monotonic wall time of its arrival [ns]."""
        raise NotImplementedError

    def wake(self) -> None:
        """Let a `wait` of another thread return."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop reading."""
        return


class Direct(Inputs):
    """Reads on the loop's own thread, waiting for the last box: fastest where nothing hangs on the wall clock."""

    def __init__(self, boxes: Sequence[Mailbox]) -> None:
        self._boxes = boxes
        self._first: list[Sample] = []

    def wait(self, timeout_s: float | None) -> None:
        if timeout_s is not None and timeout_s < TICK_S:
            time.sleep(timeout_s)
            return
        sample = self._boxes[-1].receive()
        if sample is not None:
            self._first.append(sample)

    def wait_for(self, wanted: set[str]) -> None:
        while True:
            sample = self._boxes[-1].receive()
            if sample is None:
                return
            self._first.append(sample)
            wanted.discard(sample.key)
            if not wanted or not sample.key.endswith("/done"):
                return

    def drain(self) -> Iterator[tuple[int, Sample]]:
        last, self._first = [*self._first, *self._boxes[-1].drain()], []
        wall_ns = time.monotonic_ns()
        for box in self._boxes[:-1]:
            for sample in box.drain():
                yield wall_ns, sample
        for sample in last:
            yield wall_ns, sample

    def wake(self) -> None:
        self._boxes[-1].wake()


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


class Timed(Inputs):
    """Reads on threads of their own, so that arrivals are stamped while the loop waits for its next gate."""

    def __init__(self, boxes: Sequence[Mailbox]) -> None:
        self._fresh = threading.Event()
        self._boxes = [TimedMailbox(box, self._fresh) for box in boxes]

    def wait(self, timeout_s: float | None) -> None:
        self._fresh.wait(TICK_S if timeout_s is None else timeout_s)
        self._fresh.clear()

    def drain(self) -> Iterator[tuple[int, Sample]]:
        for box in self._boxes:
            yield from box.drain()

    def wake(self) -> None:
        self._fresh.set()

    def close(self) -> None:
        for box in self._boxes:
            box.close()
