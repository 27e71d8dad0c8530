"""What has been said: last values for who asks, and the last seconds for who must catch up.

The world is the hub, so everything passes here, its own messages and those of the participants; it answers
for dead publishers too.
"""

from collections import deque
from collections.abc import Callable, Container
from itertools import islice
from typing import NamedTuple

from zsim import keys

KEEP_NS = 5_000_000_000  # simulated time that a replay reaches back
KEEP_BYTES = 500_000_000  # payloads kept at most: 1000 drones say about 300 MB in KEEP_NS
LAST_MAX = 200_000  # keys of which the last value is kept: 1000 drones have about 12 000
PAGE_BYTES = 8_000_000  # payloads of one answer; who lacks more asks for the next page


class Page(NamedTuple):
    """A part of what has been said.

    Attributes:
        passed: (key, payload) in order of arrival.
        more: where the next page begins, None after the last one.
    """

    passed: list[tuple[str, bytes]]
    more: int | None


class History:
    """Payloads as on the wire, by key.

    Args:
        keep_bytes: of the payloads that a replay may bring again.
        page_bytes: of the payloads that one page brings.
    """

    def __init__(self, keep_bytes: int = KEEP_BYTES, page_bytes: int = PAGE_BYTES) -> None:
        self._last: dict[str, bytes] = {}
        self._recent: deque[tuple[int, int, str, bytes]] = deque()
        self._now_ns = 0
        self._bytes = 0
        self._keep_bytes = keep_bytes
        self._page_bytes = page_bytes
        self._forgotten = 0

    def add(self, key: str, payload: bytes, t_ns: int) -> None:
        """Remember a message; t_ns is its stamp.

        How old it is follows from the world's clock at its arrival: a sender's stamp may be anything.
        """
        if key == keys.CLOCK:
            self._now_ns = t_ns
        if key in self._last or len(self._last) < LAST_MAX:
            self._last[key] = payload
        self._recent.append((self._now_ns, t_ns, key, payload))
        self._bytes += len(payload)
        while self._bytes > self._keep_bytes or self._recent[0][0] < self._now_ns - KEEP_NS:
            self._bytes -= len(self._recent.popleft()[3])
            self._forgotten += 1

    def last(self, expression: str) -> list[tuple[str, bytes]]:
        """Return the last value of every key that an expression takes."""
        if expression in self._last:
            return [(expression, self._last[expression])]
        return [(key, payload) for key, payload in list(self._last.items()) if keys.matches(expression, key)]

    def page(self, from_ns: int, wanted: Callable[[str], bool], start: int = 0) -> Page:
        """Return what is stamped after from_ns and on a key that is wanted, oldest first, as far as a page holds it.

        Args:
            from_ns: simulated time [ns].
            wanted: tells of a key whether it is.
            start: 0, or `more` of the page before.
        """
        passed: list[tuple[str, bytes]] = []
        known: dict[str, bool] = {}
        size = 0
        first = max(0, start - self._forgotten)
        for number, (_, t_ns, key, payload) in enumerate(islice(self._recent, first, None), self._forgotten + first):
            if key not in known:
                known[key] = wanted(key)
            if t_ns <= from_ns or not known[key]:
                continue
            size += len(payload)
            if passed and size > self._page_bytes:
                return Page(passed, number)
            passed.append((key, payload))
        return Page(passed, None)

    def said(self, marks: Container[tuple[str, int]]) -> list[tuple[str, bytes]]:
        """Return (key, payload) of what was said on any of some (key, t_ns), as far as a replay reaches back."""
        return [(key, payload) for _, t_ns, key, payload in self._recent if (key, t_ns) in marks]
