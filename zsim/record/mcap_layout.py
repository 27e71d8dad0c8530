"""The layout of a record as an MCAP file: https://mcap.dev/spec.

    magic  header  { schemas and channels new in the next chunk   chunk   its message indexes }*
    data end  summary  footer  magic                             (absent if the writer was killed)

Elsewhere in this package, a record is the file of a run; MCAP's records are the parts of that file. The mcap library
packs and unpacks all parts except messages and chunks, for which it is too slow.
"""

import struct
import threading
import zlib
from collections import defaultdict
from collections.abc import Iterator
from io import BytesIO, FileIO
from mmap import mmap
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, McapRecord, Schema
from mcap.writer import MCAP0_MAGIC as MAGIC
from numpy.typing import NDArray

from zsim import __version__
from zsim.errors import RecordError

HEAD = struct.Struct("<BQ")  # opcode, length of the body
MESSAGE = struct.Struct("<BQHIQQ")  # head, channel, sequence, log time, publish time; then the payload
MESSAGE_HEAD = np.dtype(  # MESSAGE as a numpy type
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last log time, uncompressed size and CRC, length of compression's name
SIZE = struct.Struct("<Q")  # size of a chunk's compressed content, after the compression's name
ZSTD = b"zstd"  # name of the compression that zsim uses
SIZE_UNSTATED = -1  # zstandard's value for a frame that does not state its size
LIBRARY = len(MAGIC) + HEAD.size + 8  # offset of the writer's name, after an empty profile and the name's length
OURS = b"zsim "
CUT_HEAD = CHUNK_HEAD.size + len(ZSTD) + SIZE.size  # bytes of a chunk before its content
INDEX_HEAD = struct.Struct("<HI")  # channel, size of its entries in bytes
INDEX_ENTRY = 16  # bytes: log time, offset in the chunk
FOOTER_SIZE = HEAD.size + 20
CHUNK_MAX = 1 << 27  # maximum bytes of a chunk's content; zsim's has up to 1 MB and one message of at most 16 MB
# Maximum bytes of a schema, a channel or a part of the summary; statistics of 65 535 channels take 0.7 MB
SMALL_MAX = 1 << 20
# Minimum length of a body
SIZES_MIN = {Opcode.CHUNK: CHUNK_HEAD.size + SIZE.size, Opcode.MESSAGE_INDEX: INDEX_HEAD.size}

PIECE_BYTES = 1 << 24  # maximum bytes mapped while reading a whole file; mapped pages count as memory in use
Source = bytes | mmap
Known = TypeVar("Known", Schema, Channel)

_STANDARD = frozenset(range(Opcode.HEADER, Opcode.DATA_END + 1))
_ANY_SIZE = frozenset({Opcode.MESSAGE, Opcode.ATTACHMENT})  # written outside chunks by other tools


class _Zstd(threading.local):
    """A compressor and a decompressor per thread: zstandard's objects crash if two threads use them at once."""

    def __init__(self) -> None:
        self.compress = zstandard.ZstdCompressor(level=-1).compress
        self.decompress = zstandard.ZstdDecompressor().decompress


_zstd = _Zstd()


class RecordSpan(NamedTuple):
    """The position of a complete record in the file, including its head."""

    opcode: int
    start: int
    end: int

    @property
    def body(self) -> int:
        return self.start + HEAD.size


class ChunkHead(NamedTuple):
    """The fields of a chunk before its content; `size` and `crc` are of the uncompressed content."""

    first_ns: int
    last_ns: int
    size: int
    crc: int
    compression: str
    content: int  # offset of the compressed content in the file; beyond the chunk's end if the head is damaged


class Index(NamedTuple):
    """The message index of one channel in a chunk."""

    channel: int
    messages: int  # count of its messages in the chunk
    start: int  # offset of the message index record in the file


class RecordGroup(NamedTuple):
    """A schema, channel or chunk of the data section; a chunk comes with its message indexes."""

    place: RecordSpan
    indexes: tuple[Index, ...]
    end: int


def opening() -> bytes:
    return MAGIC + packed(Header(profile="", library=f"{OURS.decode()}{__version__}"))


def packed(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def unpacked(kind: type[Known], source: Source, span: RecordSpan) -> Known:
    """Return the schema or channel at a position; raise RecordError if it is damaged."""
    try:
        return kind.read(ReadDataStream(BytesIO(source[span.body : span.end])))
    except (struct.error, McapError, UnicodeDecodeError) as error:
        reason = f"the {kind.__name__.lower()} at byte {span.start} is damaged ({type(error).__name__})"
        raise RecordError(f"{reason}; the record cannot be read") from error


def record_spans(source: Source) -> Iterator[RecordSpan]:
    """Yield the complete records of a file up to its footer, a truncated record, or an invalid opcode or length."""
    at, size = len(MAGIC), len(source)
    while at + HEAD.size <= size:
        opcode, length = HEAD.unpack_from(source, at)
        end = at + HEAD.size + length
        if end > size or opcode not in _STANDARD or length < SIZES_MIN.get(opcode, 0):
            return
        yield RecordSpan(opcode, at, end)
        if opcode == Opcode.FOOTER:
            return
        at = end


def is_cut(source: Source, at: int) -> bool:
    """Return whether the bytes after the last complete record are the beginning of another.

    Otherwise they are damaged: a wrong length makes everything after it unreadable.
    """
    remaining = len(source) - at - HEAD.size
    if remaining < 0:
        return True
    opcode, length = HEAD.unpack_from(source, at)
    if opcode not in _STANDARD or length < SIZES_MIN.get(opcode, 0):
        return False
    if opcode not in SIZES_MIN:
        return opcode in _ANY_SIZE or length <= SMALL_MAX
    if remaining < CUT_HEAD:
        return True
    span = RecordSpan(opcode, at, len(source))  # a chunk or message index, whose length follows from its fields
    if opcode == Opcode.MESSAGE_INDEX:
        return length == INDEX_HEAD.size + INDEX_HEAD.unpack_from(source, span.body)[1]
    content = chunk_head(source, span).content
    return content <= len(source) and length == content - span.body + SIZE.unpack_from(source, content - SIZE.size)[0]


def groups(source: Source, spans: Iterator[RecordSpan] | None = None) -> Iterator[RecordGroup]:
    """Yield schemas, channels and chunks of the data section in order.

    Args:
        spans: positions of the records, if already known.
    """
    last: RecordSpan | None = None  # the record whose message indexes may follow
    indexes: list[Index] = []
    end = 0
    for span in spans or record_spans(source):
        if span.opcode == Opcode.DATA_END:
            break
        if span.opcode == Opcode.MESSAGE_INDEX:
            channel, size = INDEX_HEAD.unpack_from(source, span.body)
            indexes.append(Index(channel, size // INDEX_ENTRY, span.start))
        else:
            if last is not None:
                yield RecordGroup(last, tuple(indexes), end)
            last, indexes = span if span.opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK) else None, []
        end = span.end
    if last is not None:
        yield RecordGroup(last, tuple(indexes), end)


def is_complete(source: Source) -> bool:
    """Return whether a file has its footer."""
    foot = len(source) - len(MAGIC) - FOOTER_SIZE
    return foot >= len(MAGIC) and source[foot] == Opcode.FOOTER and source[-len(MAGIC) :] == MAGIC


def chunk(content: bytes | memoryview, first_ns: int, last_ns: int) -> list[bytes]:
    """Return the parts of a chunk record with message records as its content, given their first and last log times."""
    data = _zstd.compress(content)
    head = CHUNK_HEAD.pack(first_ns, last_ns, len(content), zlib.crc32(content), len(ZSTD))
    length = len(head) + len(ZSTD) + SIZE.size + len(data)
    return [HEAD.pack(Opcode.CHUNK, length), head, ZSTD, SIZE.pack(len(data)), data]


def chunk_head(source: Source, span: RecordSpan) -> ChunkHead:
    first, last, size, crc, name = CHUNK_HEAD.unpack_from(source, span.body)
    at = span.body + CHUNK_HEAD.size
    return ChunkHead(first, last, size, crc, source[at : at + name].decode("utf-8", "replace"), at + name + SIZE.size)


def content_of(source: Source, span: RecordSpan) -> bytes | None:
    """Return the message records of the chunk at a position; None if it is damaged or larger than CHUNK_MAX.

    Raises:
        RecordError: its compression is not supported.
    """
    head = chunk_head(source, span)
    if head.content > span.end or head.size > CHUNK_MAX:
        return None
    if head.compression not in ("zstd", ""):
        raise RecordError(f"a chunk is compressed with {head.compression[:20]!r}; allowed: zstd or none")
    content = source[head.content : span.end]
    if head.compression:
        try:
            if zstandard.frame_content_size(content) not in (SIZE_UNSTATED, head.size):
                return None  # zstandard would allocate the size that the frame states, whatever the limit
            content = _zstd.decompress(content, max_output_size=head.size)
        except (zstandard.ZstdError, MemoryError, OverflowError):  # the latter two if the size is damaged
            return None
    unchecked = head.crc == 0 and not is_ours(source)  # 0 in MCAP: no CRC was computed
    return content if unchecked or head.crc == zlib.crc32(content) else None


def write_all(file: FileIO, data: bytes) -> None:
    """Write all data; an unbuffered file may write only part of it at a time when the disk is nearly full."""
    view = memoryview(data)
    while view:
        view = view[file.write(view) or 0 :]


def crc_until(source: Source, end: int) -> int:
    crc = 0
    for start in range(0, end, PIECE_BYTES):
        with memoryview(source) as view, view[start : min(end, start + PIECE_BYTES)] as piece:
            crc = zlib.crc32(piece, crc)
        unmap(source)
    return crc


def unmap(source: Source) -> None:
    """Release the pages of a mapped file that have been read; they are reloaded when needed."""
    if isinstance(source, mmap) and hasattr(source, "madvise"):  # absent on Windows
        from mmap import MADV_DONTNEED

        source.madvise(MADV_DONTNEED)


def is_ours(source: Source) -> bool:
    """Return whether zsim wrote a record, given its first bytes; if so, every chunk has a checksum."""
    return source[LIBRARY : LIBRARY + len(OURS)] == OURS


def indexes_of(content: bytes) -> dict[int, list[int]]:
    """Return, by channel, the log times and positions of its messages in a chunk's content, alternating."""
    indexes: dict[int, list[int]] = defaultdict(list)
    at, end, unpack = 0, len(content) - MESSAGE.size, MESSAGE.unpack_from
    while at <= end:
        opcode, length, channel, _, log_time, _ = unpack(content, at)
        if opcode == Opcode.MESSAGE:
            indexes[channel] += (log_time, at)
        at += HEAD.size + length
    return indexes


def heads_at(content: bytes, offsets: NDArray[np.int64]) -> NDArray:
    """Return the heads, of type MESSAGE_HEAD, of the messages at some positions in a chunk's content."""
    return np.ndarray(max(0, len(content) - MESSAGE.size + 1), MESSAGE_HEAD, content, strides=(1,))[offsets]


def index_record(channel: int, entries: bytes) -> bytes:
    """Return a message index record of packed entries: log times and positions."""
    size = len(entries)
    return HEAD.pack(Opcode.MESSAGE_INDEX, INDEX_HEAD.size + size) + INDEX_HEAD.pack(channel, size) + entries


def check_magic(source: Source, path: Path) -> None:
    """Raise RecordError if bytes are not the beginning of an MCAP file."""
    beginning = source[: len(MAGIC)]
    if not MAGIC.startswith(beginning):
        raise RecordError(f"{path}: begins with {beginning!r}; is not an MCAP record")
