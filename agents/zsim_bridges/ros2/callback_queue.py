"""What threads of Zenoh hand to the bridge's own: acts, none of which is lost, and samples, the newest of them."""

import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

Act = Callable[[], object]


class Taken(NamedTuple):
    """What has come since the last time: acts, and samples as (key, payload)."""

    acts: list[Act]
    samples: list[tuple[str, bytes]]


class Inbox:
    """A queue that never holds up who fills it: beyond `limit` samples the oldest go.

    Attributes:
        dropped: how many went.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._acts: list[Act] = []
        self._samples: deque[tuple[str, bytes]] = deque()
        self._news = threading.Condition()
        self.dropped = 0

    def act(self, act: Act) -> None:
        """Have something done in the bridge's thread."""
        with self._news:
            self._acts.append(act)
            self._news.notify()

    def sample(self, key: str, payload: bytes) -> None:
        """Have a sample passed on."""
        with self._news:
            if len(self._samples) >= self._limit:
                self._samples.popleft()
                self.dropped += 1
            self._samples.append((key, payload))
            self._news.notify()

    def take(self, within_s: float) -> Taken:
        """Return what there is, waiting for something."""
        with self._news:
            if not self._acts and not self._samples:
                self._news.wait(within_s)
            taken = Taken(self._acts, list(self._samples))
            self._acts = []
            self._samples.clear()
        return taken
