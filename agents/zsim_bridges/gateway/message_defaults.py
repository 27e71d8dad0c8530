"""What a client may leave out of a message, filled in: time, number, source. Pure."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from zsim.contract import messages


class MessageDefaults:
    """Fills in for one client.

    Args:
        source: in whose name it speaks.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._next: Counter[str] = Counter()

    def fill(self, key: str, value: Any, now_ns: int) -> Any:
        """Return a value with `t_ns`, `seq` and `source` where its message has them and it does not.

        Args:
            key: where it goes.
            value: plain data; what is no map comes back as it is.
            now_ns: simulated time of the newest gate [ns].
        """
        kind = messages.type_of(key)
        if kind is None or not isinstance(value, dict):
            return value
        mine = {"t_ns": now_ns, "seq": self._next[key], "source": self._source}
        if "seq" not in value:
            self._next[key] += 1
        wanted = messages.fields(kind)
        return {**{name: given for name, given in mine.items() if name in wanted}, **value}

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Count what is filled in only if nothing is refused: numbers have no gaps."""
        before = self._next.copy()
        try:
            yield
        except BaseException:
            self._next = before
            raise
