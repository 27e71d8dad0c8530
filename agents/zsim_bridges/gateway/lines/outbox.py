"""What waits to be sent to one client: bounded, so that a client that does not read costs nobody anything."""

import asyncio
from collections import deque
from collections.abc import Callable

BYTES_MAX = 4_000_000  # about 20 s of a drone's sensors as JSON


class Outbox:
    """Lines for one client. When it is full the oldest values go; an answer that would have to go ends it.

    Args:
        cut: ends the connection at once.
        lost_line: makes the line that tells how many values went.
        bytes_max: of the lines that wait.
    """

    def __init__(self, cut: Callable[[], None], lost_line: Callable[[int], bytes], bytes_max: int = BYTES_MAX) -> None:
        self._cut = cut
        self._lost_line = lost_line
        self._lines: deque[tuple[bytes, bool]] = deque()
        self._bytes = 0
        self._bytes_max = bytes_max
        self._filled = asyncio.Event()
        self._lost = 0
        self._closed = False

    def put(self, line: bytes, may_go: bool = False) -> None:
        """Add a line; to be called on the loop.

        Args:
            line: with its end.
            may_go: whether it may be lost: a newer one of its kind makes up for it.
        """
        if self._closed:
            return
        self._lines.append((line, may_go))
        self._bytes += len(line)
        while self._bytes > self._bytes_max and len(self._lines) > 1:
            gone, might = self._lines.popleft()
            self._bytes -= len(gone)
            self._lost += 1
            if not might:
                self._closed = True
                self._cut()
        self._filled.set()

    def close(self) -> None:
        """Let `take` end once nothing waits any more."""
        self._closed = True
        self._filled.set()

    async def take(self) -> list[bytes]:
        """Return all that waits, as soon as anything does; nothing once it is closed and empty."""
        while not self._lines and not self._closed:
            await self._filled.wait()
            self._filled.clear()
        taken = [self._lost_line(self._lost)] if self._lost else []
        taken += [line for line, _ in self._lines]
        self._lost = 0
        self._lines.clear()
        self._bytes = 0
        return taken
