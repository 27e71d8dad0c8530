"""What threads of Zenoh hand to the bridge's own: acts, none of which is lost, and samples, the newest of them."""

import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

QueuedTask = Callable[[], object]


class QueuedWork(NamedTuple):
    """What has come since the last time: acts, and samples as (key, payload)."""

    tasks: list[QueuedTask]
    samples: list[tuple[str, bytes]]


class CallbackQueue:
    """A queue that never holds up who fills it: beyond `limit` samples the oldest go.

    Attributes:
        dropped: how many went.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._tasks: list[QueuedTask] = []
        self._samples: deque[tuple[str, bytes]] = deque()
        self._arrived = threading.Condition()
        self.dropped = 0

    def add_task(self, act: QueuedTask) -> None:
        """Have something done in the bridge's thread."""
        with self._arrived:
            self._tasks.append(act)
            self._arrived.notify()

    def add_sample(self, key: str, payload: bytes) -> None:
        """Have a sample passed on."""
        with self._arrived:
            if len(self._samples) >= self._limit:
                self._samples.popleft()
                self.dropped += 1
            self._samples.append((key, payload))
            self._arrived.notify()

    def pop_all(self, within_s: float) -> QueuedWork:
        """Return what there is, waiting for something."""
        with self._arrived:
            if not self._tasks and not self._samples:
                self._arrived.wait(within_s)
            taken = QueuedWork(self._tasks, list(self._samples))
            self._tasks = []
            self._samples.clear()
        return taken
