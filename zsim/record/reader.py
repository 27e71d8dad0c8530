"""Reads a record, whole or cut at any byte."""

from collections import Counter
from collections.abc import Collection, Iterator
from mmap import ACCESS_READ, mmap
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel

from zsim.errors import RecordError
from zsim.record.finish import check_magic
from zsim.record.layout import (
    HEAD,
    MESSAGE,
    Group,
    Place,
    Source,
    chunk_head,
    content_of,
    groups,
    indexes_of,
    is_complete,
    places,
    unpacked,
)


class Recorded(NamedTuple):
    """One message of a record, not decoded."""

    key: str
    payload: bytes
    t_ns: int
    wall_ns: int


class _Chunk(NamedTuple):
    place: Place
    first_ns: int
    last_ns: int
    channels: frozenset[int]


class RecordReader:
    """A record as it stands on disk when it is opened; a writer may go on appending to it.

    Attributes:
        complete: the record was closed, not cut.
        damaged: what was met so far and passed over: chunks whose check sum differs, and, as one, everything
            behind a length that cannot be right.
    """

    def __init__(self, path: str | Path) -> None:
        """Open a record and look through its chunks, without decompressing them.

        Raises:
            RecordError: no such file, no MCAP file, or the name of a channel is damaged.
        """
        self.path = Path(path)
        self._counts: Counter[int] = Counter()
        self._source = _mapped(self.path)
        check_magic(self._source, self.path)
        self.complete = is_complete(self._source)
        self._keys: dict[int, str] = {}
        self._rest_damaged = self._channels() != Opcode.FOOTER and self.complete
        self._damaged: set[int] = set()  # where damaged chunks begin
        self._chunks = list(self._scan())

    def topics(self) -> dict[str, int]:
        """Return the keys on record with the number of their messages, in the order of their first one."""
        return {key: self._counts[number] for number, key in self._keys.items() if self._counts[number]}

    def messages(
        self, keys: Collection[str] | None = None, by_time: bool = True, from_ns: int = 0
    ) -> Iterator[Recorded]:
        """Yield the messages of some keys (None: of all).

        Args:
            keys: exact keys; chunks without any of them are not decompressed.
            by_time: in order of simulated time, messages of one time as they were written; otherwise all as
                they were written.
            from_ns: chunks in which everything is older are passed over; a chunk holds a quarter of a wall second.

        Raises:
            RecordError: compressed by another tool in a way that is not ours.
        """
        wanted = {number: key for number, key in self._keys.items() if keys is None or key in keys}
        late = (chunk for chunk in self._chunks if chunk.last_ns >= from_ns)
        chunks = [chunk for chunk in late if not chunk.channels.isdisjoint(wanted)]
        return self._by_time(chunks, wanted) if by_time else self._as_written(chunks, wanted)

    def __iter__(self) -> Iterator[Recorded]:
        return self.messages()

    @property
    def damaged(self) -> int:
        """Return how many damaged chunks were met so far; everything behind unreadable records is one."""
        return len(self._damaged) + self._rest_damaged

    def last(self, key: str) -> Recorded | None:
        """Return the message of a key that was written last, None if there is none."""
        for number in (number for number, name in self._keys.items() if name == key):
            for chunk in reversed(self._chunks):
                if number in chunk.channels and (found := list(self._as_written([chunk], {number: key}))):
                    return found[-1]
        return None

    def close(self) -> None:
        """Let go of the file."""
        if isinstance(self._source, mmap):
            self._source.close()

    def __enter__(self) -> "RecordReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _channels(self) -> int:
        """Note the channels, also those that other tools put into the summary only; return the last opcode met."""
        opcode = 0
        for place in places(self._source):
            opcode = place.opcode
            if opcode == Opcode.CHANNEL:
                channel = unpacked(Channel, self._source, place)
                self._keys[channel.id] = channel.topic
        return opcode

    def _scan(self) -> Iterator[_Chunk]:
        known: dict[frozenset[int], frozenset[int]] = {}  # most chunks hold the same channels
        found = [group for group in groups(self._source) if group.place.opcode == Opcode.CHUNK]
        for group in found:
            cut = group is found[-1] and not self.complete
            counts = self._counted(group) if cut else {index.channel: index.messages for index in group.indexes}
            self._counts.update(counts)
            channels = frozenset(counts)
            head = chunk_head(self._source, group.place)
            yield _Chunk(group.place, head.first_ns, head.last_ns, known.setdefault(channels, channels))

    def _counted(self, group: Group) -> dict[int, int]:
        """Return the messages per channel of a chunk whose message indexes may have been cut."""
        content = content_of(self._source, group.place) or b""
        return {channel: len(entries) // 2 for channel, entries in indexes_of(content).items()}

    def _as_written(self, chunks: list[_Chunk], wanted: dict[int, str]) -> Iterator[Recorded]:
        for chunk in chunks:
            content = content_of(self._source, chunk.place)
            if content is None:
                self._damaged.add(chunk.place.start)
                continue
            yield from _recorded(content, wanted)

    def _by_time(self, chunks: list[_Chunk], wanted: dict[int, str]) -> Iterator[Recorded]:
        """Yield by time, holding no more chunks in memory than overlap in time."""
        held: list[tuple[int, int, Recorded]] = []
        order = sorted(range(len(chunks)), key=lambda number: chunks[number].first_ns)
        for number in order:
            first_ns = chunks[number].first_ns
            held.sort(key=itemgetter(0, 1))
            ready = next((i for i, (t_ns, _, _) in enumerate(held) if t_ns >= first_ns), len(held))
            yield from (message for _, _, message in held[:ready])
            del held[:ready]
            held += [(m.t_ns, number, m) for m in self._as_written([chunks[number]], wanted)]
        held.sort(key=itemgetter(0, 1))
        yield from (message for _, _, message in held)


def _recorded(content: bytes, wanted: dict[int, str]) -> Iterator[Recorded]:
    """Yield the messages of a chunk's content."""
    at, end = 0, len(content) - MESSAGE.size
    unpack, payload, head = MESSAGE.unpack_from, MESSAGE.size, HEAD.size
    while at <= end:
        opcode, length, channel, _, t_ns, wall_ns = unpack(content, at)
        after = at + head + length
        if channel in wanted and opcode == Opcode.MESSAGE:
            yield Recorded(wanted[channel], content[at + payload : after], t_ns, wall_ns)
        at = after


def _mapped(path: Path) -> Source:
    """Return the bytes of a file without reading them yet."""
    try:
        with open(path, "rb") as file:
            return mmap(file.fileno(), 0, access=ACCESS_READ) if path.stat().st_size else b""
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror})") from error
