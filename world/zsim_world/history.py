"""What has been said: last values for who asks, and the last seconds for who must catch up.

The world is the hub, so everything passes here, its own messages and those of the participants; it answers for
dead publishers too.
"""

from collections import deque
from collections.abc import Iterator

from zsim import keys

KEEP_NS = 5_000_000_000  # simulated time that a replay reaches back


class History:
    """Payloads as on the wire, by key."""

    def __init__(self) -> None:
        self._last: dict[str, bytes] = {}
        self._recent: deque[tuple[int, str, bytes]] = deque()

    def add(self, key: str, payload: bytes, t_ns: int) -> None:
        """Remember a message; t_ns is its stamp."""
        self._last[key] = payload
        self._recent.append((t_ns, key, payload))
        while self._recent[0][0] < t_ns - KEEP_NS:
            self._recent.popleft()

    def last(self, expression: str) -> list[tuple[str, bytes]]:
        """Return the last value of every key that an expression takes."""
        if expression in self._last:
            return [(expression, self._last[expression])]
        return [(key, payload) for key, payload in list(self._last.items()) if keys.matches(expression, key)]

    def since(self, from_ns: int, expressions: list[str]) -> Iterator[tuple[str, bytes]]:
        """Yield, in order of arrival, the messages stamped after from_ns on any of the expressions."""
        for t_ns, key, payload in list(self._recent):
            if t_ns > from_ns and any(keys.matches(expression, key) for expression in expressions):
                yield key, payload
