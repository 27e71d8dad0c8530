"""The end of a record: data end, summary and footer, all derived from the file.

The same code closes a record at the end of a run and repairs one whose writer died, so the writer needs no index in
memory.
"""

import struct
import zlib
from collections import Counter
from io import FileIO
from mmap import ACCESS_READ, mmap
from pathlib import Path

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Schema, Statistics, SummaryOffset

from zsim.errors import RecordError
from zsim.record import mcap_layout as layout

_FOOTER_CRC = struct.Struct("<BQQQ")  # the part of the footer that its check sum covers
_FOOTER_LENGTH = 20


def finish(file: FileIO) -> None:
    """Write summary and footer at the end of a file opened for unbuffered reading and writing; OSError without room."""
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
    """Return the records of the summary of a data section, by kind, in the order of the file."""
    schemas, channels, chunks = RecordBuilder(), RecordBuilder(), RecordBuilder()
    numbers: Counter[Opcode] = Counter()
    messages: Counter[int] = Counter()
    first_ns, last_ns = 2**64 - 1, 0
    for group in layout.groups(source):
        place, opcode = group.place, Opcode(group.place.opcode)
        if opcode == Opcode.SCHEMA:
            layout.unpacked(Schema, source, place).write(schemas)
        elif opcode == Opcode.CHANNEL:
            layout.unpacked(Channel, source, place).write(channels)
        else:
            head = layout.chunk_head(source, place)
            if head.content > place.end:
                continue  # readers of the summary would be sent to what they cannot read
            for index in group.indexes:
                messages[index.channel] += index.messages
            first_ns, last_ns = min(first_ns, head.first_ns), max(last_ns, head.last_ns)
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


def finish_bare(file: FileIO) -> None:
    """Write the shortest end that MCAP allows, 50 bytes without a summary; OSError without room."""
    file.seek(0, 2)
    layout.write_all(file, layout.packed(DataEnd(0)) + layout.packed(Footer(0, 0, 0)) + layout.MAGIC)


def repair(path: str | Path) -> bool:
    """Finish a record whose writer died, in place; return whether it was unfinished.

    The record is kept up to its last whole chunk. No process may be writing it. An interruption does no harm: the file
    is then an unfinished record as before.

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
            cut_off(file, path)
            finish(file)
            return True
    except OSError as error:
        raise RecordError(f"{path}: cannot be repaired ({error.strerror})") from error


def cut_off(file: FileIO, path: Path) -> None:
    """Truncate a record after its last whole chunk, or else its header, so that it can be continued from there.

    RecordError if the file is not a record; OSError if it cannot be written.
    """
    end, tail = 0, layout.opening()
    if file.seek(0, 2):
        with mmap(file.fileno(), 0, access=ACCESS_READ) as source:
            layout.check_magic(source, path)
            last: layout.RecordSpan | None = None
            for place in layout.places(source):
                if place.opcode == Opcode.DATA_END:
                    break
                if last is None or place.opcode == Opcode.CHUNK:
                    last = place
            if last is not None:  # the cut may have taken the indexes of its chunk
                content = layout.content_of(source, last) if last.opcode == Opcode.CHUNK else None
                found = layout.indexes_of(content or b"").items()
                end = last.end
                tail = b"".join(layout.index_record(channel, np.array(own, "<u8").tobytes()) for channel, own in found)
    file.truncate(end)
    file.seek(end)
    layout.write_all(file, tail)
