"""Pictures from the keys of cameras to an event loop, of those cameras alone that somebody looks at."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Iterable

from zsim.errors import SessionError
from zsim.transport.session import RawSample, Session

WAITING_MAX = 10  # pictures that wait for the loop; then the oldest go


class PictureIntake:
    """Subscriptions that come and go with the readers.

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
