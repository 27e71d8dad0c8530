"""Which messages of a record are exported."""

from collections.abc import Iterator
from typing import NamedTuple

from zsim.contract import keys
from zsim.record import Recorded, RecordReader


class Selection(NamedTuple):
    """Keys and times.

    Attributes:
        expressions: key expressions as Zenoh's; none: every key.
        from_s: simulated time of the first message [s], None: the start.
        to_s: of the last one.
    """

    expressions: tuple[str, ...] = ()
    from_s: float | None = None
    to_s: float | None = None

    def keys(self, reader: RecordReader) -> list[str]:
        """Return the keys on record that are wanted."""
        every = not self.expressions
        return [key for key in reader.topics() if every or any(keys.matches(each, key) for each in self.expressions)]

    def messages(self, reader: RecordReader, wanted: list[str]) -> Iterator[Recorded]:
        """Yield the messages of some keys that are within the times, in order of simulated time."""
        first = _ns(self.from_s, 0)
        last = _ns(self.to_s, 2**64)
        return (message for message in reader.messages(frozenset(wanted)) if first <= message.t_ns <= last)


def _ns(seconds: float | None, otherwise: int) -> int:
    return otherwise if seconds is None else round(seconds * 1e9)


def thing(key: str) -> str:
    """Return whom a key is about: a drone, cluster or process; the world where it is about all."""
    kind, whose, what = keys.parts(key)
    if kind == "view":
        return what or "world"
    return whose if what else "world"
