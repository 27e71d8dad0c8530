"""Ends a record: data end, summary and footer, all of it read off the file itself.

The same code closes a record at the end of a run and mends one whose writer died, so the writer keeps no
index in memory, however long the run.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator
from io import FileIO
from mmap import ACCESS_READ, mmap
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Schema, Statistics, SummaryOffset

from zsim.errors import RecordError
from zsim.record.mcap_layout import (
    MAGIC,
    RecordGroup,
    RecordSpan,
    Source,
    chunk_head,
    content_of,
    crc_until,
    groups,
    indexes_of,
    is_complete,
    opening,
    packed,
    packed_indexes,
    places,
    unpacked,
)

_FOOTER_CRC = struct.Struct("<BQQQ")  # the part of the footer that its check sum covers
_FOOTER_LENGTH = 20


class RecordSummary:
    """The summary at the end of a record, collected one chunk at a time."""

    def __init__(self) -> None:
        self.schemas = RecordBuilder()
        self.channels = RecordBuilder()
        self.chunks = RecordBuilder()
        self.schema_count = self.channel_count = self.chunk_count = 0
        self.counts: defaultdict[int, int] = defaultdict(int)
        self.first_ns, self.last_ns = 2**64 - 1, 0

    def take(self, source: Source) -> None:
        """Take in the data section of a file."""
        takers = {Opcode.SCHEMA: self._schema, Opcode.CHANNEL: self._channel, Opcode.CHUNK: self._chunk}
        for group in groups(source):
            takers[Opcode(group.place.opcode)](source, group)

    def _schema(self, source: Source, group: RecordGroup) -> None:
        unpacked(Schema, source, group.place).write(self.schemas)
        self.schema_count += 1

    def _channel(self, source: Source, group: RecordGroup) -> None:
        unpacked(Channel, source, group.place).write(self.channels)
        self.channel_count += 1

    def _chunk(self, source: Source, group: RecordGroup) -> None:
        place, head = group.place, chunk_head(source, group.place)
        if head.content > place.end:
            return  # readers of the summary would be sent to what they cannot read
        for index in group.indexes:
            self.counts[index.channel] += index.messages
        self.chunk_count += 1
        self.first_ns = min(self.first_ns, head.first_ns)
        self.last_ns = max(self.last_ns, head.last_ns)
        ChunkIndex(
            chunk_length=place.end - place.start,
            chunk_start_offset=place.start,
            compression=head.compression,
            compressed_size=place.end - head.content,
            message_end_time=head.last_ns,
            message_index_length=group.end - place.end,
            message_index_offsets={index.channel: index.start for index in group.indexes},
            message_start_time=head.first_ns,
            uncompressed_size=head.size,
        ).write(self.chunks)

    def statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=self.channel_count,
            channel_message_counts=dict(self.counts),
            chunk_count=self.chunk_count,
            message_count=sum(self.counts.values()),
            message_end_time=self.last_ns,
            message_start_time=min(self.first_ns, self.last_ns),
            metadata_count=0,
            schema_count=self.schema_count,
        )


def finish(file: FileIO) -> None:
    """Write summary and footer at the end of a file opened for reading and writing, unbuffered.

    Raises:
        OSError: no room.
    """
    summary = RecordSummary()
    with mmap(file.fileno(), 0, access=ACCESS_READ) as source:
        summary.take(source)
        data_end = packed(DataEnd(crc_until(source, len(source))))
    start = file.seek(0, 2) + len(data_end)
    write_all(file, data_end + b"".join(_ending(summary, start)))


def finish_bare(file: FileIO) -> None:
    """Write the shortest end that MCAP allows, 50 bytes without a summary.

    Raises:
        OSError: no room.
    """
    file.seek(0, 2)
    write_all(file, packed(DataEnd(0)) + packed(Footer(0, 0, 0)) + MAGIC)


def write_all(file: FileIO, data: bytes) -> None:
    """Write all of it; an unbuffered file may take it in parts when the disk is nearly full."""
    view = memoryview(data)
    while view:
        view = view[file.write(view) or 0 :]


def _ending(summary: RecordSummary, start: int) -> Iterator[bytes]:
    """Yield summary, summary offsets, footer and magic; `start` is where the first of it will stand."""
    groups = {
        Opcode.SCHEMA: summary.schemas.end(),
        Opcode.CHANNEL: summary.channels.end(),
        Opcode.STATISTICS: packed(summary.statistics()),
        Opcode.CHUNK_INDEX: summary.chunks.end(),
    }
    at, offsets = start, b""
    for opcode, group in groups.items():
        if group:
            offsets += packed(SummaryOffset(opcode, at, len(group)))
        at += len(group)
    body = b"".join(groups.values()) + offsets
    covered = _FOOTER_CRC.pack(Opcode.FOOTER, _FOOTER_LENGTH, start, at)
    yield body
    yield packed(Footer(start, at, zlib.crc32(covered, zlib.crc32(body))))
    yield MAGIC


def repair(path: str | Path) -> bool:
    """Finish a record whose writer died, in place; return whether there was anything to do.

    The record is kept up to its last whole chunk. Nobody may be writing it. Being interrupted does no harm:
    the file is then an unfinished record as before.

    Raises:
        RecordError: no record, or it cannot be written.
    """
    path = Path(path)
    try:
        with open(path, "r+b", buffering=0) as file:
            return _repair(file, path)
    except OSError as error:
        raise RecordError(f"{path}: cannot be repaired ({error.strerror})") from error


def _repair(file: FileIO, path: Path) -> bool:
    if file.seek(0, 2):
        with mmap(file.fileno(), 0, access=ACCESS_READ) as source:
            if is_complete(source):
                return False
    cut_off(file, path)
    finish(file)
    return True


def cut_off(file: FileIO, path: Path) -> None:
    """Take off what stands behind the last whole chunk of a record, so that it can be written on from there.

    Raises:
        RecordError: no record.
        OSError: it cannot be written.
    """
    end, indexes = 0, b""
    if file.seek(0, 2):
        with mmap(file.fileno(), 0, access=ACCESS_READ) as source:
            check_magic(source, path)
            end, indexes = _last_whole(source)
    file.truncate(end)
    file.seek(end)
    write_all(file, indexes if end else opening())


def _last_whole(source: Source) -> tuple[int, bytes]:
    """Return where the last whole chunk ends, and its message indexes, which the cut may have taken.

    A file cut before its first chunk ends after its header, and at 0 when even that is not whole.
    """
    last: RecordSpan | None = None
    for place in places(source):
        if place.opcode == Opcode.DATA_END:
            break
        if last is None or place.opcode == Opcode.CHUNK:
            last = place
    if last is None:
        return 0, b""
    content = content_of(source, last) if last.opcode == Opcode.CHUNK else None
    return last.end, b"".join(packed_indexes(indexes_of(content or b"")))


def check_magic(source: Source, path: Path) -> None:
    """Refuse what is not the beginning of an MCAP file.

    Raises:
        RecordError: with what was found.
    """
    beginning = source[: len(MAGIC)]
    if not MAGIC.startswith(beginning):
        raise RecordError(f"{path}: begins with {beginning!r}; is no MCAP record")
