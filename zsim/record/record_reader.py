"""Reads a record, complete or truncated at any byte."""

import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from mmap import ACCESS_READ, mmap
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel
from numpy.typing import NDArray

from zsim.errors import RecordError
from zsim.record import mcap_layout as layout

SHOWN = 3  # maximum number of gaps or damaged chunks listed in one line; others are counted
CRC = struct.Struct("<I")  # checksum of everything before the data end; 0 in MCAP if not computed
OVERLAP_NS = 1_000_000_000  # simulated time; a chunk usually begins less than this before the previous one's end


class Recorded(NamedTuple):
    """A message in a record, not decoded."""

    key: str
    payload: bytes
    t_ns: int
    wall_ns: int


class MessageSpans(NamedTuple):
    """Messages of a chunk, by channel, each in the order written."""

    content: bytes  # of the chunk
    channel: NDArray[np.int64]  # channel number of each message, (M,)
    start: NDArray[np.int64]  # start of its payload in the content, (M,)
    end: NDArray[np.int64]  # end of its payload, (M,)
    t_ns: NDArray[np.int64]  # its stamp [ns], (M,)


class _Chunk(NamedTuple):
    place: layout.RecordSpan
    first_ns: int
    last_ns: int
    channels: frozenset[int]
    indexes: tuple[layout.Index, ...]


_Straggler = tuple[int, int, Recorded]  # simulated time, number of the message's chunk, message


class RecordReader:
    """A record as it was on disk when opened; a writer may be appending to it.

    Reading raises RecordError for other tools' chunks with an unsupported compression.

    Attributes:
        damaged: skipped parts with their positions: chunks whose checksum differs, and, as one entry, everything after
            an invalid length.
    """

    def __init__(self, path: str | Path) -> None:
        """Open a record and scan its chunks, without decompressing them.

        Raises RecordError if the file does not exist, is not an MCAP file, or has a damaged channel.
        """
        self.path = Path(path)
        self._counts: Counter[int] = Counter()
        try:
            with open(path, "rb") as file:
                empty = not self.path.stat().st_size
                self._source: layout.Source = b"" if empty else mmap(file.fileno(), 0, access=ACCESS_READ)
        except OSError as error:
            raise RecordError(f"{path}: cannot be read ({error.strerror})") from error
        layout.check_magic(self._source, self.path)
        self.complete = layout.is_complete(self._source)  # whether the record was closed
        self._keys: dict[int, str] = {}
        self._data_end: layout.RecordSpan | None = None
        self._unreadable_from: int | None = None  # start of the unreadable end; None if all is readable
        self._damaged: set[layout.RecordSpan] = set()  # chunks
        self._chunks = list(self._scan())

    def topics(self) -> dict[str, int]:
        """Return the recorded keys with their message counts, in order of their first message."""
        return {key: self._counts[number] for number, key in self._keys.items() if self._counts[number]}

    def messages(
        self, keys: Collection[str] | None = None, by_time: bool = True, from_ns: int = 0
    ) -> Iterator[Recorded]:
        """Yield the messages of some keys, by default of all.

        Args:
            keys: exact keys; chunks without any of them are not decompressed.
            by_time: whether to sort by simulated time, at equal times in the order written; otherwise, all are in the
                order written. Sorting keeps in memory only chunks that overlap in time, and stragglers.
            from_ns: chunks with only older messages are skipped; a chunk spans about 0.25 s of wall time.
        """
        wanted = {number: key for number, key in self._keys.items() if keys is None or key in keys}
        candidates = (chunk for chunk in self._chunks if chunk.last_ns >= from_ns)
        chunks = [chunk for chunk in candidates if not chunk.channels.isdisjoint(wanted)]
        return self._by_time(chunks, wanted) if by_time else self._as_written(chunks, wanted)

    def __iter__(self) -> Iterator[Recorded]:
        return self.messages()

    def channels(self) -> dict[int, str]:
        return dict(self._keys)

    def spans(self, wanted: Collection[int]) -> Iterator[MessageSpans]:
        """Yield the positions of the payloads of some channels, chunk by chunk, to read many messages as arrays."""
        mapped = 0
        for chunk in self._chunks:
            if chunk.channels.isdisjoint(wanted):
                continue
            content = layout.content_of(self._source, chunk.place)
            if content is None:
                self._damaged.add(chunk.place)
                continue
            channel, offsets = self._indexed(chunk, content)
            mapped += chunk.place.end - chunk.place.start
            if mapped > layout.PIECE_BYTES:
                layout.unmap(self._source)
                mapped = 0
            rows = np.isin(channel, list(wanted))
            starts = offsets[rows]
            heads = layout.heads_at(content, starts)
            ends = starts + layout.HEAD.size + heads["length"].astype(np.int64)
            times = heads["log_time"].astype(np.int64)
            yield MessageSpans(content, channel[rows], starts + layout.MESSAGE.size, ends, times)

    def _indexed(self, chunk: _Chunk, content: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the channels and positions of a chunk's messages, from its indexes if they cover all its content."""
        head = layout.HEAD.size + layout.INDEX_HEAD.size
        at = [(index.start + head, layout.INDEX_ENTRY * index.messages) for index in chunk.indexes]
        data = b"".join([self._source[start : start + size] for start, size in at])
        if data and len(data) == sum(size for _, size in at):  # a damaged size may point beyond the end of the file
            offsets = np.frombuffer(data, "<u8")[1::2].astype(np.int64)
            channel = np.repeat([index.channel for index in chunk.indexes], [index.messages for index in chunk.indexes])
            if offsets.min() >= 0 and offsets.max() <= len(content) - layout.MESSAGE.size:
                heads = layout.heads_at(content, offsets)
                is_complete = int(heads["length"].sum()) + layout.HEAD.size * len(offsets) == len(content)
                if is_complete and (heads["opcode"] == Opcode.MESSAGE).all() and (heads["channel"] == channel).all():
                    return channel.astype(np.int64), offsets
        indexes = layout.indexes_of(content)
        channel = np.repeat(list(indexes), [len(each) // 2 for each in indexes.values()])
        offsets = [offset for each in indexes.values() for offset in each[1::2]]
        return channel.astype(np.int64), np.array(offsets, dtype=np.int64)

    @property
    def damaged(self) -> tuple[str, ...]:
        """The damage found so far; everything after unreadable records is one entry."""
        heads = [(place.start, layout.chunk_head(self._source, place)) for place in sorted(self._damaged)]
        span = "the chunk at byte {}, {:.2f} to {:.2f} s"
        chunks = [span.format(at, head.first_ns / 1e9, head.last_ns / 1e9) for at, head in heads]
        return tuple(
            chunks if self._unreadable_from is None else [*chunks, f"everything from byte {self._unreadable_from} on"]
        )

    def differs(self) -> bool:
        """Return whether a record was changed after its writer closed it, by reading the whole file.

        Names of keys and indexes have no checksum of their own.
        """
        if not self.complete or self._data_end is None:
            return False
        stated = CRC.unpack_from(self._source, self._data_end.body)[0]
        return stated not in (0, layout.crc_until(self._source, self._data_end.start))

    def last(self, key: str) -> Recorded | None:
        """Return the last written message of a key; None if there is none."""
        for number in (number for number, name in self._keys.items() if name == key):
            for chunk in reversed(self._chunks):
                if number in chunk.channels and (recorded := list(self._as_written([chunk], {number: key}))):
                    return recorded[-1]
        return None

    def last_chunk(self, key: str, is_it: Callable[[bytes], bool]) -> tuple[int, list[Recorded]] | None:
        """Return the start of the chunk with the last matching message of a key, and the chunk's earlier messages.

        `is_it` returns whether a payload matches.
        """
        channels = {number for number, name in self._keys.items() if name == key}
        for chunk in reversed([chunk for chunk in self._chunks if not chunk.channels.isdisjoint(channels)]):
            written = list(self._as_written([chunk], self._keys))
            matches = [i for i, each in enumerate(written) if each.key == key and is_it(each.payload)]
            if matches:
                return chunk.place.start, written[: matches[-1]]
        return None

    def close(self) -> None:
        if isinstance(self._source, mmap):
            self._source.close()

    def __enter__(self) -> "RecordReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _record_spans(self) -> Iterator[layout.RecordSpan]:
        """Yield all records, noting the channels (possibly only in the summary) and the data end."""
        opcode, end = 0, len(layout.MAGIC)
        for span in layout.record_spans(self._source):
            opcode, end = span.opcode, span.end
            if opcode == Opcode.CHANNEL:
                channel = layout.unpacked(Channel, self._source, span)
                self._keys[channel.id] = channel.topic
            elif opcode == Opcode.DATA_END:
                self._data_end = self._data_end or span
            yield span
        if opcode != Opcode.FOOTER and (self.complete or not layout.is_cut(self._source, end)):
            self._unreadable_from = end

    def _scan(self) -> Iterator[_Chunk]:
        channel_sets: dict[frozenset[int], frozenset[int]] = {}  # most chunks contain the same channels
        spans = self._record_spans()
        chunk_groups = [group for group in layout.groups(self._source, spans) if group.place.opcode == Opcode.CHUNK]
        for _ in spans:  # read the channels in the summary
            continue
        for span, indexes, _ in chunk_groups:
            counts = {index.channel: index.messages for index in indexes}
            if span is chunk_groups[-1].place and not self.complete:  # its indexes may be truncated
                content = layout.content_of(self._source, span)
                if content is None:
                    self._damaged.add(span)
                counts = {channel: len(entries) // 2 for channel, entries in layout.indexes_of(content or b"").items()}
                indexes = ()
            self._counts.update(counts)
            head, channels = layout.chunk_head(self._source, span), frozenset(counts)
            yield _Chunk(span, head.first_ns, head.last_ns, channel_sets.setdefault(channels, channels), indexes)

    def _as_written(self, chunks: list[_Chunk], wanted: dict[int, str]) -> Iterator[Recorded]:
        for chunk in chunks:
            content = layout.content_of(self._source, chunk.place)
            if content is None:
                self._damaged.add(chunk.place)
                continue
            unpack, payload, head = layout.MESSAGE.unpack_from, layout.MESSAGE.size, layout.HEAD.size
            if chunk.channels <= wanted.keys():  # read without the chunk's indexes
                at, end = 0, len(content) - payload
                while at <= end:
                    opcode, length, number, _, t_ns, wall_ns = unpack(content, at)
                    record_end = at + head + length
                    if number in wanted and opcode == Opcode.MESSAGE:
                        yield Recorded(wanted[number], content[at + payload : record_end], t_ns, wall_ns)
                    at = record_end
                continue
            channel, offsets = self._indexed(chunk, content)
            for at in np.sort(offsets[np.isin(channel, list(wanted))]).tolist():
                _, length, number, _, t_ns, wall_ns = unpack(content, at)
                yield Recorded(wanted[number], content[at + payload : at + head + length], t_ns, wall_ns)

    def _by_time(self, chunks: list[_Chunk], wanted: dict[int, str]) -> Iterator[Recorded]:
        """Yield messages by time, keeping in memory only chunks that overlap in time, and stragglers."""
        stragglers, floors = self._stragglers(chunks, wanted)
        starts = [floors.get(number, chunk.first_ns) for number, chunk in enumerate(chunks)]
        for number in sorted(range(len(chunks)), key=starts.__getitem__):
            first_ns, floor_ns = starts[number], floors.get(number, 0)
            stragglers.sort(key=itemgetter(0, 1))
            ready = next((i for i, (t_ns, _, _) in enumerate(stragglers) if t_ns >= first_ns), len(stragglers))
            yield from (message for _, _, message in stragglers[:ready])
            del stragglers[:ready]
            entries = self._as_written([chunks[number]], wanted)
            stragglers += [(m.t_ns, number, m) for m in entries if m.t_ns >= floor_ns]
        stragglers.sort(key=itemgetter(0, 1))
        yield from (message for _, _, message in stragglers)

    def _stragglers(self, chunks: list[_Chunk], wanted: dict[int, str]) -> tuple[list[_Straggler], dict[int, int]]:
        """Return messages stamped long before the rest of their chunk, and by chunk the first time of the rest [ns].

        A program that does not stamp its messages puts one at time 0 into every chunk. If chunks were ordered by their
        oldest messages, all would be read first and kept in memory.
        """
        strays: list[_Straggler] = []
        floors: dict[int, int] = {}
        for number in range(1, len(chunks)):
            chunk = chunks[number]
            if chunk.first_ns >= chunks[number - 1].last_ns - OVERLAP_NS:
                continue
            entries = [(m.t_ns, number, m) for m in self._as_written([chunk], wanted)]
            floor_ns = 0  # below most times of the chunk, robust against a few outliers on either side
            if times := sorted(t_ns for t_ns, _, _ in entries):
                # 2 (third quartile - middle) suffices for uniform times
                middle, third_quartile = times[len(times) // 2], times[3 * len(times) // 4]
                floor_ns = middle - 3 * (third_quartile - middle) - OVERLAP_NS
            strays += (each for each in entries if each[0] < floor_ns)
            floors[number] = min((t_ns for t_ns, _, _ in entries if t_ns >= floor_ns), default=chunk.first_ns)
        return strays, floors


def record_notes(reader: RecordReader) -> list[str]:
    """Return warnings about a truncated or damaged record, one line each."""
    notes = []
    if not reader.complete:
        notes.append("the record was cut off: its writer did not close it; everything before the cut was read")
    if reader.damaged:
        notes.append(f"the record is damaged; skipped: {shown(reader.damaged)}")
    return notes


def shown(texts: Sequence[str]) -> str:
    remainder = len(texts) - SHOWN
    return ", ".join(texts[:SHOWN]) + (f" and {remainder} more" if remainder > 0 else "")
