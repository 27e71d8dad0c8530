"""What has been said: last values for who asks, and the last seconds for who must catch up.

The world is the hub, so everything passes here, its own messages and those of the participants; it answers
for dead publishers too.
"""

from collections import deque
from collections.abc import Iterator

from zsim import keys

KEEP_NS = 5_000_000_000  # simulated time that a replay reaches back
KEEP_BYTES = 500_000_000  # payloads kept at most: 1000 drones say about 300 MB in KEEP_NS
LAST_MAX = 200_000  # keys of which the last value is kept: 1000 drones have about 12 000


class History:
    """Payloads as on the wire, by key.

    Args:
        keep_bytes: of the payloads that a replay may bring again.
    """

    def __init__(self, keep_bytes: int = KEEP_BYTES) -> None:
        self._last: dict[str, bytes] = {}
        self._recent: deque[tuple[int, int, str, bytes]] = deque()
        self._now_ns = 0
        self._bytes = 0
        self._keep_bytes = keep_bytes

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

    def last(self, expression: str) -> list[tuple[str, bytes]]:
        """Return the last value of every key that an expression takes."""
        if expression in self._last:
            return [(expression, self._last[expression])]
        return [(key, payload) for key, payload in list(self._last.items()) if keys.matches(expression, key)]

    def since(self, from_ns: int, expressions: list[str]) -> Iterator[tuple[str, bytes]]:
        """Yield, in order of arrival, the messages stamped after from_ns on any of the expressions."""
        wanted: dict[str, bool] = {}
        for _, t_ns, key, payload in list(self._recent):
            if t_ns <= from_ns:
                continue
            if key not in wanted:
                wanted[key] = any(keys.matches(expression, key) for expression in expressions)
            if wanted[key]:
                yield key, payload
