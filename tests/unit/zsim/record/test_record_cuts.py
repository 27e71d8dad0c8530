"""A record of a real run, cut at any byte or with any bits flipped: every tool reads what precedes the cut."""

import random
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import IO

import pytest
import recorded_run
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader
from refused import has_terms, refused
from typer.testing import CliRunner

from zsim.contract import messages
from zsim.errors import RecordError, ZsimError
from zsim.record import Recorded, RecordReader, RecordWriter, mcap_layout, repair
from zsim.record.mcap_layout import (
    CHUNK_HEAD,
    CHUNK_MAX,
    HEAD,
    MAGIC,
    SIZE,
    ZSTD,
    RecordSpan,
    content_of,
    opening,
    record_spans,
)
from zsim_analysis.export import Format
from zsim_analysis.export.columns import MessageSelection
from zsim_analysis.export.make_export import export
from zsim_analysis.report.summary import judge

CUTS = 8  # at random bytes, in addition to the critical ones
FLIPS = 15

Content = tuple[bytes, int, int]  # payload, simulated and wall time [ns] of a message
Made = tuple[int, list[str]]  # number of rows made from a record, and the notes on it


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a record with a message of every kind."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    recorded_run.write(path)
    return path


@pytest.fixture(scope="module")
def whole(run: Path) -> dict[str, list[Recorded]]:
    """Return all messages of the record by key."""
    return by_key(run)


def by_key(path: Path) -> dict[str, list[Recorded]]:
    found: dict[str, list[Recorded]] = defaultdict(list)
    with RecordReader(path) as reader:
        for message in reader.messages(by_time=False):
            found[message.key].append(message)
        assert reader.topics() == {key: len(messages) for key, messages in found.items()}
    return dict(found)


def test_the_record_has_every_kind_of_message(run: Path) -> None:
    with RecordReader(run) as reader:
        kinds = {messages.type_of(key) for key in reader.topics()}
    assert kinds == {*messages.types_by_shape().values(), None}


def chunks(data: bytes) -> list[RecordSpan]:
    return [place for place in record_spans(data) if place.opcode == Opcode.CHUNK]


def nasty(data: bytes) -> list[int]:
    """Return the critical places for a cut: in and around the magic, heads, chunks, indexes, summary and footer."""
    found = chunks(data)
    middle, last = found[len(found) // 2], found[-1]
    indexes = [place for place in record_spans(data) if place.opcode == Opcode.MESSAGE_INDEX]
    ends = {place.opcode: place for place in record_spans(data)}
    at = [0, 1, len(MAGIC) - 1, len(MAGIC), len(MAGIC) + 1, len(MAGIC) + HEAD.size, found[0].start]
    for chunk in (found[0], middle, last):
        at += [chunk.start, chunk.start + 1, chunk.body, chunk.body + CHUNK_HEAD.size - 2, chunk.body + CHUNK_HEAD.size]
        at += [(chunk.start + chunk.end) // 2, chunk.end - 1, chunk.end, chunk.end + 1]
    at += [indexes[-1].start + 3, indexes[-1].end - 1, indexes[-1].end]
    for opcode in (Opcode.DATA_END, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.FOOTER):
        place = ends[opcode]
        at += [place.start, place.start + 1, place.body, place.end - 1, place.end]
    return [*at, len(data) - len(MAGIC) // 2, len(data) - 1]


def cuts(data: bytes) -> list[int]:
    rng = random.Random(11)
    return [*(rng.randrange(len(data)) for _ in range(CUTS)), *nasty(data)]


def test_a_record_truncated_anywhere_is_read_up_to_the_cut(
    run: Path, whole: dict[str, list[Recorded]], tmp_path: Path
) -> None:
    """For each key, all messages recorded before the cut are read, except those of the chunk that was cut."""
    data, cut = run.read_bytes(), tmp_path / "cut.mcap"
    ends = {place.end: number for number, place in enumerate(chunks(data), start=1)}
    per_chunk = chunk_sizes(run)
    for at in cuts(data):
        cut.write_bytes(data[:at])
        with RecordReader(cut) as reader:
            assert not reader.damaged, f"cut at {at}"
        found = by_key(cut)
        for key, recorded in found.items():
            assert recorded == whole[key][: len(recorded)], f"cut at {at}: {key}"
        before = max((number for end, number in ends.items() if end <= at), default=0)
        assert sum(map(len, found.values())) == sum(per_chunk[:before]), f"cut at {at}"


def chunk_sizes(path: Path) -> list[int]:
    """Return how many messages each chunk holds."""
    counts: list[int] = []
    with open(path, "rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                counts.append(0)
            elif isinstance(record, MessageIndex):
                counts[-1] += len(record.records)
    return counts


def test_a_writer_continues_after_a_truncated_file(run: Path, whole: dict[str, list[Recorded]], tmp_path: Path) -> None:
    """This includes a whole record; messages are appended, on keys that it has and on new ones."""
    data, cut = run.read_bytes(), tmp_path / "cut.mcap"
    added = [each._replace(wall_ns=7) for key in whole for each in whole[key][:2]]
    added += [each._replace(key=f"{each.key}/again") for each in added]
    for number, at in enumerate([len(data), *nasty(data)]):
        cut.write_bytes(data[:at])
        before = by_key(cut) if at else {}
        with RecordWriter(cut, goes_on=True) as writer:
            assert writer.has_former == any(before.values())
            for each in added:
                writer.add(each.key, each.payload, messages.encoding(each.key), each.t_ns, each.wall_ns)
        after = by_key(cut)
        for key in {each.key for each in added}:
            assert after[key] == [*before.get(key, []), *(each for each in added if each.key == key)], f"cut at {at}"
        with RecordReader(cut) as reader:
            assert reader.complete
        if number % 3:  # the other reader is slow
            continue
        with open(cut, "rb") as file:
            numbers = by_channel(file)
        assert all(seen == list(range(len(seen))) for seen in numbers.values()), f"cut at {at}"


def by_channel(file: IO[bytes]) -> dict[int, list[int]]:
    """Return the sequence numbers of the messages of each channel, as another reader finds them."""
    numbers: dict[int, list[int]] = defaultdict(list)
    for record in StreamReader(file).records:
        if isinstance(record, Message):
            numbers[record.channel_id].append(record.sequence)
    return numbers


@pytest.mark.parametrize("content", [b"something else", b"x"])
def test_a_writer_does_not_continue_a_file_that_is_not_a_record(tmp_path: Path, content: bytes) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(content)
    with refused(RecordError, "other.mcap", "MCAP"):
        RecordWriter(other, goes_on=True)
    assert other.read_bytes() == content


@pytest.mark.parametrize("stated", [1000, CHUNK_MAX + 1])
def test_a_chunk_that_would_decompress_without_bound_counts_as_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stated: int
) -> None:
    """Its head states another size than its compressed frame, or both exceed what any writer produces."""
    path, data = tmp_path / "bomb.mcap", zstandard.compress(bytes(CHUNK_MAX + 1))
    head = CHUNK_HEAD.pack(0, 1, stated, 0, len(ZSTD)) + ZSTD + SIZE.pack(len(data))
    path.write_bytes(opening() + HEAD.pack(Opcode.CHUNK, len(head) + len(data)) + head + data)
    monkeypatch.setattr(mcap_layout._zstd, "decompress", lambda *_: pytest.fail("it is decompressed"))
    with RecordReader(path) as reader:
        assert list(reader.messages()) == []
        (place,) = chunks(path.read_bytes())
        assert content_of(path.read_bytes(), place) is None


def turned(data: bytes, rng: random.Random) -> bytes:
    """Return data with one to eight bits flipped."""
    changed = bytearray(data)
    for _ in range(rng.randrange(1, 9)):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def read_all(path: Path) -> set[Content]:
    with RecordReader(path) as reader:
        found = {content(message) for message in reader}
        return found | {content(last) for key in reader.topics() if (last := reader.last(key))}


def content(message: Recorded) -> Content:
    """Return the parts of a message that a checksum protects."""
    return message.payload, message.t_ns, message.wall_ns


def exported(path: Path, form: Format, selection: MessageSelection) -> Made:
    done = export(path.parent, form, selection=selection, force=True)
    return sum(done.tables.values()), done.notes


def to_csv(path: Path) -> Made:
    return exported(path, Format.CSV, MessageSelection(("world/**", "cluster/**", "process/**")))


def to_foxglove(path: Path) -> Made:
    return exported(path, Format.FOXGLOVE, MessageSelection(to_s=1.0))


def to_mat(path: Path) -> Made:
    return exported(path, Format.MAT, MessageSelection(("world/**", "drone/*/sensor/gps")))


def to_summary(path: Path) -> Made:
    summary = judge(path)[-1]
    return summary.record.truth_instants, summary.notes


WORKS: tuple[tuple[Callable[[Path], object], int], ...] = (
    (repair, FLIPS),
    (to_summary, 8),
    (to_csv, 8),
    (to_foxglove, 5),
    (to_mat, 5),
)


def test_with_any_bits_flipped_only_recorded_messages_are_read(
    run: Path, whole: dict[str, list[Recorded]], tmp_path: Path
) -> None:
    data, rng, path = run.read_bytes(), random.Random(12), tmp_path / "run.mcap"
    recorded = {content(message) for messages in whole.values() for message in messages}
    read = 0
    for _ in range(FLIPS):
        path.write_bytes(turned(data, rng))
        try:
            found = read_all(path)
        except RecordError:
            continue
        assert found <= recorded
        read += len(found)
    assert read > FLIPS * len(recorded) / 4


@pytest.mark.parametrize(("work", "times"), WORKS, ids=[work.__name__ for work, _ in WORKS])
def test_with_any_bits_flipped_a_record_is_read_or_refused_in_one_line(
    work: Callable[[Path], object], times: int, run: Path, tmp_path: Path
) -> None:
    data, rng, path = run.read_bytes(), random.Random(12), tmp_path / "run.mcap"
    for _ in range(times):
        path.write_bytes(turned(data, rng))
        error_line = ""
        try:
            work(path)
        except ZsimError as error:
            error_line = str(error)
        assert "\n" not in error_line


@pytest.mark.parametrize("work", [to_summary, to_csv, to_foxglove, to_mat])
def test_every_tool_reads_a_record_up_to_the_cut(work: Callable[[Path], Made], run: Path, tmp_path: Path) -> None:
    data, path, read = run.read_bytes(), tmp_path / "run.mcap", []
    for at in (len(data) // 3, 2 * len(data) // 3, len(data) - 9):
        path.write_bytes(data[:at])
        rows, notes = work(path)
        assert any(has_terms(note.lower(), "cut") for note in notes), notes
        read.append(rows)
    assert 0 < read[0] <= read[1] <= read[2]


def test_a_command_reports_that_a_record_was_cut(run: Path, tmp_path: Path) -> None:
    from zsim_deploy.cli.cli import app

    data = run.read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[: len(data) // 2])
    done = CliRunner().invoke(app, ["export", str(tmp_path), "--format", "parquet", "--keys", "drone/*/truth"])
    assert done.exit_code == 0, done.output
    assert has_terms(done.output, "cut")
    assert "truth.parquet" in done.output
