"""What has been said: last values for who asks, and the last seconds for who must catch up.

The world is the hub, so everything passes here, its own messages and those of the participants; it answers
for dead publishers too.
"""

from collections import deque
from collections.abc import Callable, Container, Iterator
from typing import NamedTuple

from zsim.contract import keys
from zsim.contract.framing import Pairs

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


class _Said(NamedTuple):
    """Messages that passed together: the world's clock then, their stamp, keys and payloads, bytes of the latter."""

    now_ns: int
    t_ns: int
    messages: Pairs
    size: int


class History:
    """Payloads as on the wire, by key.

    Args:
        keep_bytes: of the payloads that a replay may bring again.
        page_bytes: of the payloads that one page brings.
    """

    def __init__(self, keep_bytes: int = KEEP_BYTES, page_bytes: int = PAGE_BYTES) -> None:
        self._last: dict[str, bytes] = {}
        self._recent: deque[_Said] = deque()
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
        self._remember(_Said(self._now_ns, t_ns, [(key, payload)], len(payload)))

    def add_all(self, said: Pairs, t_ns: int) -> None:
        """Remember what the world itself says, all stamped t_ns, its newest gate."""
        self._now_ns = t_ns
        self._last.update(said)
        self._remember(_Said(t_ns, t_ns, said, sum([len(payload) for _, payload in said])))

    def _remember(self, said: "_Said") -> None:
        self._recent.append(said)
        self._bytes += said.size
        while self._bytes > self._keep_bytes or self._recent[0].now_ns < self._now_ns - KEEP_NS:
            oldest = self._recent.popleft()
            self._bytes -= oldest.size
            self._forgotten += len(oldest.messages)

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
        for number, (t_ns, key, payload) in enumerate(self._each(), self._forgotten):
            if number < start or t_ns <= from_ns:
                continue
            if key not in known:
                known[key] = wanted(key)
            if not known[key]:
                continue
            size += len(payload)
            if passed and size > self._page_bytes:
                return Page(passed, number)
            passed.append((key, payload))
        return Page(passed, None)

    def said(self, marks: Container[tuple[str, int]]) -> list[tuple[str, bytes]]:
        """Return (key, payload) of what was said on any of some (key, t_ns), as far as a replay reaches back."""
        return [(key, payload) for t_ns, key, payload in self._each() if (key, t_ns) in marks]

    def _each(self) -> Iterator[tuple[int, str, bytes]]:
        for said in self._recent:
            for key, payload in said.messages:
                yield said.t_ns, key, payload
