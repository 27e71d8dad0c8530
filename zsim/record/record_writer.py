"""Writes a record during a run, closes it, and repairs one whose writer died.

Closing and repairing use the same code to derive the end of a record (data end, summary and footer) from the file, so
the writer needs no index in memory.
"""

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from io import FileIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Schema, Statistics, SummaryOffset
from numpy.typing import NDArray

from zsim.contract import messages
from zsim.contract.framing import GateMessages, PerPattern
from zsim.errors import RecordError
from zsim.output_folder import take_lock
from zsim.record import mcap_layout as layout
from zsim.record.mcap_layout import HEAD, INDEX_ENTRY, INDEX_HEAD, MESSAGE, MESSAGE_HEAD
from zsim.record.record_reader import RecordReader

CHUNK_BYTES = 1024 * 1024  # maximum bytes not yet on disk, besides the last message
CHUNK_AGE_NS = 250_000_000  # wall time; with a tick every 0.1 s no message waits longer than 0.5 s
CHANNELS_MAX = 65_535  # MCAP numbers channels in 16 bits
_TIME_MAX = 2**64 - 1
# MCAP's message encoding by media type of the Zenoh encoding
_MEDIA = {"": "msgpack", "application/msgpack": "msgpack", "application/json": "json", "text/json": "json"}
_FOOTER_CRC = struct.Struct("<BQQQ")  # part of the footer covered by its checksum
_FOOTER_LENGTH = 20
_encode = messages.encode


class RecordWriter:
    """Appends messages to a record; for use by one thread.

    The file is readable at any time, even if this process dies: a chunk and its indexes are written at once. Memory
    holds only the open chunk and the names of the keys. If the disk is full or lost, every method raises RecordError;
    the file is closed after its last complete chunk.
    """

    def __init__(self, path: str | Path, goes_on: bool = False) -> None:
        """Create the file or, if `goes_on`, continue it after its last complete chunk; no file is overwritten.

        Raises RecordError if the file exists, cannot be continued, or cannot be written.
        """
        self.path = Path(path)
        self.has_former = False  # whether the file had messages of an earlier writer
        self.refused = 0  # messages on keys beyond the 65 535 that a record can hold
        self._channels: dict[str, int] = {}  # number of each key's channel, from 1
        self._gate_channels = PerPattern(self._channels_of)
        self._schemas: dict[str, int] = {}
        self._ahead: list[bytes] = []  # new schemas and channels of the open chunk, written before it
        self._open = OpenChunk(CHUNK_BYTES + CHUNK_BYTES // 4)
        self._last_tick = (0, 0)  # end of the file at an earlier tick, and wall time of that tick
        self._end = 0  # end of the last complete chunk in the file
        self._error = ""
        self._file = _opened(self.path, "r+" if goes_on else "x+")
        if not goes_on:
            self._append(layout.opening())
            return
        try:
            self._continue_file()
        except OSError as error:
            self._file.close()
            raise RecordError(f"{path}: cannot be continued ({error.strerror})") from error
        except RecordError:
            self._file.close()
            raise

    def _continue_file(self) -> None:
        """Truncate the file after its last complete chunk; read its channels, schemas and message counts."""
        _truncate_file(self._file, self.path)
        counts: Counter[int] = Counter()
        self._end = self._file.seek(0, 2)
        with mmap(self._file.fileno(), 0, access=ACCESS_READ) as source:
            for group in layout.groups(source):
                opcode = group.place.opcode
                if opcode == Opcode.SCHEMA:
                    schema = layout.unpacked(Schema, source, group.place)
                    self._schemas[schema.name] = schema.id
                elif opcode == Opcode.CHANNEL:
                    channel = layout.unpacked(Channel, source, group.place)
                    self._channels[channel.topic] = channel.id
                counts.update({index.channel: index.messages for index in group.indexes})
        self.has_former = counts.total() > 0
        counted = [counts[number] for number in range(len(self._channels) + 1)]
        self._open = OpenChunk(CHUNK_BYTES + CHUNK_BYTES // 4, counted)

    def add(self, key: str, payload: bytes, encoding: str, t_ns: int, wall_ns: int) -> None:
        """Add a message.

        Args:
            key: key without the federation's prefix.
            payload: payload as on the wire.
            encoding: Zenoh encoding, e.g. `application/msgpack;Truth`; a key's first one applies to all its messages.
            t_ns: simulated time.
            wall_ns: wall clock of the recorder.
        """
        channel = self._channels.get(key) or self._register(key, encoding)
        if not channel:
            self.refused += 1
            return
        self._open.add(channel, payload, _time(t_ns), _time(wall_ns))
        self._end_if_full(wall_ns)

    def add_message(self, key: str, message: Any, wall_ns: int) -> None:
        """Add a message of this process, encoded as on the wire."""
        channel = self._channels.get(key) or self._register(key, messages.encoding(key))
        if not channel:
            self.refused += 1
            return
        self._open.add(channel, _encode(message), message.t_ns, wall_ns)
        if self._open.size >= CHUNK_BYTES or wall_ns - self._open.since_ns >= CHUNK_AGE_NS:
            self._end_chunk()

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
        """Add the messages of a gate; its columns must have been checked."""
        channels = self._gate_channels.of(gate)
        if channels:
            self._open.add_gate(channels, gate, wall_ns)
            self._end_if_full(wall_ns)
            return
        for (key, payload), t_ns in zip(gate.pairs, gate.stamps.tolist(), strict=True):
            self.add(key, payload, messages.encoding(key), t_ns, wall_ns)

    def _end_if_full(self, wall_ns: int) -> None:
        if self._open.size >= CHUNK_BYTES or wall_ns - self._open.since_ns >= CHUNK_AGE_NS:
            self._end_chunk()

    def _channels_of(self, gate: GateMessages) -> bytes:
        """Return the channel of each message as int64; empty if channels are exhausted."""
        names = [gate.table[index] for index in gate.which.tolist()]
        channels = [self._channels.get(key) or self._register(key, messages.encoding(key)) for key in names]
        return np.array(channels, dtype=np.int64).tobytes() if all(channels) else b""

    def tick(self, wall_ns: int) -> None:
        """Write the open chunk to disk once it is old; must be called every 0.1 s, even if no message arrives.

        `wall_ns` is from a monotonic clock; it is compared only with its own earlier values.
        """
        end, since_ns = self._last_tick
        if not self._open.size or end != self._end:
            self._last_tick = (self._end if self._open.size else 0, wall_ns)
        elif wall_ns - since_ns >= CHUNK_AGE_NS:
            self._end_chunk()

    def flush(self) -> None:
        if self._open.size:
            self._end_chunk()

    def close(self) -> None:
        """Finish the file; closing again has no effect."""
        if self._file.closed:
            return
        self.flush()
        try:
            _finish(self._file)
        except OSError as error:
            self._give_up(error)
        self._file.close()

    def __enter__(self) -> "RecordWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _register(self, key: str, encoding: str) -> int:
        """Return the number of a new channel, 0 if channels are exhausted."""
        if len(self._channels) >= CHANNELS_MAX:
            return 0
        self._channels[key] = number = len(self._channels) + 1
        media, _, name = encoding.partition(";")
        record = Channel(number, key, _MEDIA.get(media, media), {}, self._schema(key, name))
        self._ahead.append(layout.packed(record))
        return number

    def _schema(self, key: str, name: str) -> int:
        """Return the number of the schema of a key's messages, 0 without a schema."""
        kind = messages.type_of(key)
        name = name or (kind.__name__ if kind else "")
        if name and name not in self._schemas:
            self._schemas[name] = number = len(self._schemas) + 1
            is_known = kind is not None and kind.__name__ == name
            text = msgspec.json.encode(msgspec.json.schema(kind)) if is_known else b""
            self._ahead.append(layout.packed(Schema(number, text, "jsonschema" if is_known else "", name)))
        return self._schemas.get(name, 0)

    def _end_chunk(self) -> None:
        content = self._open.take()
        if self._error:
            raise RecordError(self._error)
        record = layout.chunk(content.data, content.first_ns, content.last_ns)
        self._append(b"".join([*self._ahead, *record, *content.indexes()]))
        self._ahead.clear()

    def _append(self, data: bytes) -> None:
        try:
            layout.write_all(self._file, data)
        except OSError as error:
            self._give_up(error)
        self._end += len(data)

    def _give_up(self, error: OSError) -> NoReturn:
        """Close the file after its last complete chunk, with as much of a summary as fits on the disk."""
        for ending in (_finish, _finish_bare, None) if self._end else (None,):
            try:
                self._file.truncate(self._end)
                self._file.seek(self._end)
                if ending:
                    ending(self._file)
                break
            except OSError:
                continue
        self._file.close()
        self._error = (
            f"{self.path}: cannot be written further ({error.strerror}); "
            f"the record is readable up to byte {self._end}; remove the cause and run again"
        )
        raise RecordError(self._error) from error


def _opened(path: Path, mode: str) -> FileIO:
    """Open a record exclusively; the lock ends with the process."""
    try:
        file = FileIO(path, mode)
    except FileExistsError as error:
        raise RecordError(f"{path}: exists; a record is never overwritten: give another path") from error
    except OSError as error:
        raise RecordError(f"{path}: cannot be written ({error.strerror})") from error
    if not take_lock(file):
        file.close()
        raise RecordError(f"{path}: another process is writing it; end that process, or give another path")
    return file


def is_being_written(path: Path) -> bool:
    """Return whether a process is writing the record at a path; False if there is no record."""
    if not path.exists():
        return False
    with path.open("rb") as file:
        return not take_lock(file, shared=True)


def _time(value: int) -> int:
    """Return a time [ns] clipped to MCAP's range."""
    return value if type(value) is int and 0 <= value <= _TIME_MAX else min(max(int(value), 0), _TIME_MAX)


_SEQUENCE_MASK = 2**32 - 1  # MCAP numbers a channel's messages in 32 bits


class OpenChunk:
    """The messages not yet on disk: payloads in a buffer and heads as columns, written together.

    Channels are numbered from 1. The memory is reused for each chunk: allocating new pages would take longer than
    everything else here.

    Args:
        room: usual size of a chunk with its last message [bytes].
        counted: number of messages of each channel in earlier chunks.

    Attributes:
        size: size of its message records [bytes].
        since_ns: wall clock of its first message.
    """

    def __init__(self, room: int, counted: Sequence[int] = (0,)) -> None:
        self._counted = np.array(counted, dtype=np.int64)
        self._room = room
        self._data = bytearray(room)
        self._begin()

    def _begin(self) -> None:
        if len(self._data) > 2 * self._room:
            self._data = bytearray(self._room)
        self.size, self.since_ns = 0, 0
        self._channels, self._ends = array("q"), array("q")
        self._log, self._published = array("Q"), array("Q")

    def add(self, channel: int, payload: bytes, t_ns: int, wall_ns: int) -> None:
        start = self.size + MESSAGE.size
        if start == MESSAGE.size:
            self.since_ns = wall_ns
        self.size = end = start + len(payload)
        if end > len(self._data):
            self._make_room(end)
        self._data[start:end] = payload
        self._channels.append(channel)
        self._ends.append(end)
        self._log.append(t_ns)
        self._published.append(wall_ns)

    def add_gate(self, channels: bytes, gate: GateMessages, wall_ns: int) -> None:
        """Add the messages of a gate; its buffer has room for a head before each message.

        `channels`: channel number of each message, as bytes of int64.
        """
        if not self.size:
            self.since_ns = wall_ns
        self._channels.frombytes(channels)
        self._ends.frombytes((gate.ends + self.size).tobytes())
        self._log.frombytes(gate.stamps.tobytes())
        self._published.extend([wall_ns] * len(gate))
        start, self.size = self.size, self.size + len(gate.buffer)
        if self.size > len(self._data):
            self._make_room(self.size)
        self._data[start : self.size] = gate.buffer

    def _make_room(self, size: int) -> None:
        self._data = self._data + bytes(max(size - len(self._data), self._room))

    def take(self) -> "Content":
        """Return the messages so far and begin a new chunk; the content is valid until a message is added."""
        columns = map(_column, (self._channels, self._ends, self._log, self._published))
        content = Content(memoryview(self._data)[: self.size], *columns)
        self._counted = content.write_heads(self._counted)
        self._begin()
        return content


class Content:
    """The records of a chunk, as columns of M messages."""

    def __init__(self, data: memoryview, channels: NDArray, ends: NDArray, log: NDArray, published: NDArray) -> None:
        self.data = data
        self.first_ns, self.last_ns = int(log.min()), int(log.max())
        self._channels, self._ends, self._log, self._published = channels, ends, log, published
        self._starts = np.concatenate(([0], ends[:-1]))
        self._order = np.argsort(channels, kind="stable")  # by channel, in the order of arrival

    def write_heads(self, counted: NDArray) -> NDArray:
        """Write the head of each message; return the new number of messages of each channel.

        `counted`: number of messages of each channel in earlier chunks.
        """
        heads = np.empty(len(self._ends), dtype=MESSAGE_HEAD)
        heads["opcode"], heads["channel"] = int(Opcode.MESSAGE), self._channels
        heads["length"] = self._ends - self._starts - HEAD.size
        heads["log_time"], heads["publish_time"] = self._log, self._published
        counts = np.bincount(self._channels, minlength=len(counted))
        previous = np.pad(counted, (0, len(counts) - len(counted)))
        rank = np.arange(len(heads)) - np.repeat(np.cumsum(counts) - counts, counts)
        heads["sequence"][self._order] = (np.repeat(previous, counts) + rank) & _SEQUENCE_MASK
        head_view = np.ndarray(len(self.data) - MESSAGE.size + 1, MESSAGE_HEAD, self.data, strides=(1,))
        head_view[self._starts] = heads
        return previous + counts

    def indexes(self) -> Iterator[bytes]:
        offsets = self._starts[self._order].astype("Q")
        entries = np.column_stack((self._log[self._order], offsets)).astype("<u8").tobytes()
        counts = np.bincount(self._channels)
        at = 0
        for channel in np.flatnonzero(counts).tolist():
            size = INDEX_ENTRY * int(counts[channel])
            yield HEAD.pack(Opcode.MESSAGE_INDEX, INDEX_HEAD.size + size) + INDEX_HEAD.pack(channel, size)
            yield entries[at : at + size]
            at += size


def _column(values: array) -> NDArray:
    return np.frombuffer(values, values.typecode)


def cut_at_last(path: Path, key: str, is_it: Callable[[bytes], bool]) -> bool:
    """Truncate a record before the last matching message of a key, to resume its run; return whether there was one.

    Args:
        is_it: returns whether a payload matches.

    Raises:
        RecordError: the file is not a record, cannot be written, or is being written by another process.
    """
    with RecordReader(path) as reader:
        match = reader.last_chunk(key, is_it)
    if match is None:
        return False
    start, earlier = match
    try:
        with open(path, "r+b") as file:
            file.truncate(start)
    except OSError as error:
        raise RecordError(f"{path}: cannot be cut ({error.strerror})") from error
    with RecordWriter(path, goes_on=True) as writer:
        for each in earlier:
            writer.add(each.key, each.payload, messages.encoding(each.key), each.t_ns, each.wall_ns)
    return True


def repair(path: str | Path) -> bool:
    """Finish a record whose writer died, in place; return whether it was unfinished.

    The record is kept up to its last complete chunk. No process may be writing it. An interruption does no harm: the
    file then remains an unfinished record.

    Raises:
        RecordError: the file is not a record, or cannot be written.
    """
    path = Path(path)
    try:
        with open(path, "r+b", buffering=0) as file:
            if file.seek(0, 2):
                with mmap(file.fileno(), 0, access=ACCESS_READ) as source:
                    if layout.is_complete(source):
                        return False
            _truncate_file(file, path)
            _finish(file)
            return True
    except OSError as error:
        raise RecordError(f"{path}: cannot be repaired ({error.strerror})") from error


def _truncate_file(file: FileIO, path: Path) -> None:
    """Truncate a record after its last complete chunk, or else after its header, so that it can be continued.

    Raises RecordError if the file is not a record, and OSError if it cannot be written.
    """
    end, tail = 0, layout.opening()
    if file.seek(0, 2):
        with mmap(file.fileno(), 0, access=ACCESS_READ) as source:
            layout.check_magic(source, path)
            last: layout.RecordSpan | None = None
            for span in layout.record_spans(source):
                if span.opcode == Opcode.DATA_END:
                    break
                if last is None or span.opcode == Opcode.CHUNK:
                    last = span
            if last is not None:  # the indexes of the last chunk may be cut off
                content = layout.content_of(source, last) if last.opcode == Opcode.CHUNK else None
                indexes = layout.indexes_of(content or b"").items()
                end = last.end
                tail = b"".join(
                    layout.index_record(channel, np.array(own, "<u8").tobytes()) for channel, own in indexes
                )
    file.truncate(end)
    file.seek(end)
    layout.write_all(file, tail)


def _finish(file: FileIO) -> None:
    """Append the data end, summary and footer to a file open for unbuffered I/O; raise OSError if the disk is full."""
    with mmap(file.fileno(), 0, access=ACCESS_READ) as source:
        summary = _summary(source)
        data_end = layout.packed(DataEnd(layout.crc_until(source, len(source))))
    start = file.seek(0, 2) + len(data_end)
    at, offsets = start, b""
    for opcode, records in summary.items():
        if records:
            offsets += layout.packed(SummaryOffset(opcode, at, len(records)))
        at += len(records)
    body = b"".join(summary.values()) + offsets
    covered = _FOOTER_CRC.pack(Opcode.FOOTER, _FOOTER_LENGTH, start, at)
    footer = layout.packed(Footer(start, at, zlib.crc32(covered, zlib.crc32(body))))
    layout.write_all(file, data_end + body + footer + layout.MAGIC)


def _summary(source: layout.Source) -> dict[Opcode, bytes]:
    """Return the records of the summary of a file's data section, by kind, in their order in the file."""
    schemas, channels, chunks = RecordBuilder(), RecordBuilder(), RecordBuilder()
    numbers: Counter[Opcode] = Counter()
    messages: Counter[int] = Counter()
    first_ns, last_ns = 2**64 - 1, 0
    for group in layout.groups(source):
        span, opcode = group.place, Opcode(group.place.opcode)
        if opcode == Opcode.SCHEMA:
            layout.unpacked(Schema, source, span).write(schemas)
        elif opcode == Opcode.CHANNEL:
            layout.unpacked(Channel, source, span).write(channels)
        else:
            head = layout.chunk_head(source, span)
            if head.content > span.end:
                continue  # the summary would refer readers to an unreadable chunk
            for index in group.indexes:
                messages[index.channel] += index.messages
            first_ns, last_ns = min(first_ns, head.first_ns), max(last_ns, head.last_ns)
            ChunkIndex(
                chunk_length=span.end - span.start,
                chunk_start_offset=span.start,
                compression=head.compression,
                compressed_size=span.end - head.content,
                message_end_time=head.last_ns,
                message_index_length=group.end - span.end,
                message_index_offsets={index.channel: index.start for index in group.indexes},
                message_start_time=head.first_ns,
                uncompressed_size=head.size,
            ).write(chunks)
        numbers[opcode] += 1
    statistics = Statistics(
        attachment_count=0,
        channel_count=numbers[Opcode.CHANNEL],
        channel_message_counts=dict(messages),
        chunk_count=numbers[Opcode.CHUNK],
        message_count=messages.total(),
        message_end_time=last_ns,
        message_start_time=min(first_ns, last_ns),
        metadata_count=0,
        schema_count=numbers[Opcode.SCHEMA],
    )
    return {
        Opcode.SCHEMA: schemas.end(),
        Opcode.CHANNEL: channels.end(),
        Opcode.STATISTICS: layout.packed(statistics),
        Opcode.CHUNK_INDEX: chunks.end(),
    }


def _finish_bare(file: FileIO) -> None:
    """Write the shortest end that MCAP allows, 50 bytes without a summary; raise OSError if the disk is full."""
    file.seek(0, 2)
    layout.write_all(file, layout.packed(DataEnd(0)) + layout.packed(Footer(0, 0, 0)) + layout.MAGIC)
