"""Writes a record while a run goes on."""

from collections import Counter
from collections.abc import Callable
from io import FileIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from zsim.contract import messages
from zsim.contract.framing import GateMessages, PerPattern
from zsim.errors import RecordError
from zsim.output_folder import take_lock
from zsim.record.mcap_layout import chunk, groups, opening, packed, unpacked
from zsim.record.open_chunk import OpenChunk
from zsim.record.record_end import cut_off, finish, finish_bare, write_all

CHUNK_BYTES = 1024 * 1024  # not yet on disk at most, besides the last message
CHUNK_AGE_NS = 250_000_000  # wall time; with a tick every 0.1 s nothing waits longer than 0.5 s
CHANNELS_MAX = 65_535  # MCAP counts channels in 16 bits
_TIME_MAX = 2**64 - 1
_encode = messages.encode


class RecordWriter:
    """Appends messages to a record; for one thread.

    What is in the file is readable at any moment, whatever happens to this process: a chunk and its indexes
    are one write. Memory holds the open chunk and the names of the keys, however long the run.

    Attributes:
        has_former: whether it goes on behind messages of a writer that died.
        refused: messages on keys beyond the 65 535 that a record can hold.
    """

    def __init__(self, path: str | Path, goes_on: bool = False) -> None:
        """Start the file, or go on behind the last whole chunk of one whose writer died; none is overwritten.

        Raises:
            RecordError: the file exists, or is none that can be gone on with, or cannot be written.
        """
        self.path = Path(path)
        self.has_former = False
        self.refused = 0
        self._channels: dict[str, int] = {}  # by key, counted from 1
        self._gate_channels = PerPattern(self._channels_of)
        self._schemas: dict[str, int] = {}
        self._ahead: list[bytes] = []  # schemas and channels that the open chunk is the first to use
        self._open = OpenChunk(CHUNK_BYTES + CHUNK_BYTES // 4)
        self._seen = (0, 0)  # where the file ended at a tick, and when that tick was
        self._end = 0  # of the last whole chunk
        self._error = ""
        self._file = _opened(self.path, "r+" if goes_on else "x+")
        if not goes_on:
            self._append(opening())
            return
        try:
            self._take_up()
        except OSError as error:
            self._file.close()
            raise RecordError(f"{path}: cannot be gone on with ({error.strerror})") from error
        except RecordError:
            self._file.close()
            raise

    def _take_up(self) -> None:
        """Learn the channels and schemas of the file as far as it is whole."""
        cut_off(self._file, self.path)
        counts: Counter[int] = Counter()
        self._end = self._file.seek(0, 2)
        with mmap(self._file.fileno(), 0, access=ACCESS_READ) as source:
            for group in groups(source):
                opcode = group.place.opcode
                if opcode == Opcode.SCHEMA:
                    schema = unpacked(Schema, source, group.place)
                    self._schemas[schema.name] = schema.id
                elif opcode == Opcode.CHANNEL:
                    channel = unpacked(Channel, source, group.place)
                    self._channels[channel.topic] = channel.id
                counts.update({index.channel: index.messages for index in group.indexes})
        self.has_former = counts.total() > 0
        counted = [counts[number] for number in range(len(self._channels) + 1)]
        self._open = OpenChunk(CHUNK_BYTES + CHUNK_BYTES // 4, counted)

    def add(self, key: str, payload: bytes, encoding: str, t_ns: int, wall_ns: int) -> None:
        """Take one message.

        Args:
            key: without the federation's prefix.
            payload: as on the wire.
            encoding: Zenoh's, e.g. `application/msgpack;Truth`; the first one of a key holds for all of it.
            t_ns: simulated time.
            wall_ns: wall clock of the recorder.

        Raises:
            RecordError: the disk is full or gone; the file was closed at its last whole chunk.
        """
        channel = self._channels.get(key) or self._register(key, encoding)
        if not channel:
            self.refused += 1
            return
        self._open.add(channel, payload, _time(t_ns), _time(wall_ns))
        self._end_if_full(wall_ns)

    def add_message(self, key: str, message: Any, wall_ns: int) -> None:
        """Take one message of this process, encoded as for the wire.

        Raises:
            RecordError: as `add`.
        """
        channel = self._channels.get(key) or self._register(key, messages.encoding(key))
        if not channel:
            self.refused += 1
            return
        self._open.add(channel, _encode(message), message.t_ns, wall_ns)
        if self._open.size >= CHUNK_BYTES or wall_ns - self._open.since_ns >= CHUNK_AGE_NS:
            self._end_chunk()

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
        """Take the messages of a gate, whose columns have been checked.

        Raises:
            RecordError: as `add`.
        """
        channels = self._gate_channels.of(gate)
        if channels:
            self._open.add_gate(channels, gate, wall_ns)
            self._end_if_full(wall_ns)
        else:
            self._add_each(gate, wall_ns)

    def _end_if_full(self, wall_ns: int) -> None:
        """End the open chunk if it is large or old."""
        if self._open.size >= CHUNK_BYTES or wall_ns - self._open.since_ns >= CHUNK_AGE_NS:
            self._end_chunk()

    def _channels_of(self, gate: GateMessages) -> bytes:
        """Return the channel of each message, int64; nothing if there is none left for one."""
        names = [gate.table[place] for place in gate.which.tolist()]
        channels = [self._channels.get(key) or self._register(key, messages.encoding(key)) for key in names]
        return np.array(channels, dtype=np.int64).tobytes() if all(channels) else b""

    def _add_each(self, gate: GateMessages, wall_ns: int) -> None:
        for (key, payload), t_ns in zip(gate.pairs, gate.stamps.tolist(), strict=True):
            self.add(key, payload, messages.encoding(key), t_ns, wall_ns)

    def tick(self, wall_ns: int) -> None:
        """Put the open chunk on disk when it is old; call it every 0.1 s, also while nothing arrives.

        Args:
            wall_ns: a monotonic clock; only its own earlier values are compared with it.

        Raises:
            RecordError: as `add`.
        """
        end, since_ns = self._seen
        if not self._open.size or end != self._end:
            self._seen = (self._end if self._open.size else 0, wall_ns)
        elif wall_ns - since_ns >= CHUNK_AGE_NS:
            self._end_chunk()

    def flush(self) -> None:
        """Put everything taken so far on disk.

        Raises:
            RecordError: as `add`.
        """
        if self._open.size:
            self._end_chunk()

    def close(self) -> None:
        """Finish the file; closing twice does nothing.

        Raises:
            RecordError: as `add`.
        """
        if self._file.closed:
            return
        self.flush()
        self._guarded(lambda: finish(self._file))
        self._file.close()

    def __enter__(self) -> "RecordWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _register(self, key: str, encoding: str) -> int:
        """Return the number of a new channel, 0 if there is none left."""
        if len(self._channels) >= CHANNELS_MAX:
            return 0
        self._channels[key] = number = len(self._channels) + 1
        media, _, name = encoding.partition(";")
        record = Channel(number, key, _message_encoding(media), {}, self._schema(key, name))
        self._ahead.append(packed(record))
        return number

    def _schema(self, key: str, name: str) -> int:
        """Return the number of the schema of a key's messages, 0 when nothing names them."""
        kind = messages.type_of(key)
        name = name or (kind.__name__ if kind else "")
        if name and name not in self._schemas:
            self._schemas[name] = number = len(self._schemas) + 1
            known = kind is not None and kind.__name__ == name
            text = msgspec.json.encode(msgspec.json.schema(kind)) if known else b""
            self._ahead.append(packed(Schema(number, text, "jsonschema" if known else "", name)))
        return self._schemas.get(name, 0)

    def _end_chunk(self) -> None:
        content = self._open.take()
        if self._error:
            raise RecordError(self._error)
        record = chunk(content.data, content.first_ns, content.last_ns)
        self._append(b"".join([*self._ahead, *record, *content.indexes()]))
        self._ahead.clear()

    def _append(self, data: bytes) -> None:
        self._guarded(lambda: write_all(self._file, data))
        self._end += len(data)

    def _guarded(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> NoReturn:
        """Close the file at its last whole chunk, with as much of a summary as there is room for."""
        for ending in (finish, finish_bare, None) if self._end else (None,):
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
            f"{self.path}: cannot be written any further ({error.strerror}); "
            f"the record is readable up to byte {self._end}, make room and run again"
        )
        raise RecordError(self._error) from error


def _opened(path: Path, mode: str) -> FileIO:
    """Open a record for this process alone; the lock goes with the process, whatever ends it."""
    try:
        file = FileIO(path, mode)
    except FileExistsError as error:
        raise RecordError(f"{path}: exists; a record is never overwritten, name another place") from error
    except OSError as error:
        raise RecordError(f"{path}: cannot be written ({error.strerror})") from error
    if not take_lock(file):
        file.close()
        raise RecordError(f"{path}: another process writes it; end that one, or name another place")
    return file


def is_being_written(path: Path) -> bool:
    """Tell whether a process is writing the record at a path; there may be none."""
    if not path.exists():
        return False
    with path.open("rb") as file:
        return not take_lock(file, shared=True)


def _message_encoding(media: str) -> str:
    """Return MCAP's name for a Zenoh media type."""
    known = {"": "msgpack", "application/msgpack": "msgpack", "application/json": "json", "text/json": "json"}
    return known.get(media, media)


def _time(value: int) -> int:
    """Return a time that MCAP can hold."""
    return value if type(value) is int and 0 <= value <= _TIME_MAX else min(max(int(value), 0), _TIME_MAX)
