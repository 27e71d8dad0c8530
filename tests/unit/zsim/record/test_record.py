"""The record: what is written is read back even from a truncated file, and other MCAP tools agree."""

import errno
import os
import random
import subprocess
import sys
import textwrap
import tracemalloc
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from refused import has_terms, refused

from zsim.contract import keys, messages
from zsim.contract.messages import Imu
from zsim.contract.run_messages import Clock
from zsim.errors import RecordError
from zsim.record import Recorded, RecordReader, RecordWriter, repair
from zsim.record.mcap_layout import CHUNK_HEAD, HEAD, chunk_head, is_cut, record_spans
from zsim.record.record_reader import record_notes
from zsim.record.record_writer import CHUNK_BYTES

GATE_NS = 20_000_000
CHUNK_MESSAGES = 40  # messages per chunk of the records below


def imu(t_ns: int, seq: int, rng: random.Random) -> bytes:
    a, b, c, d, e, f = (rng.gauss(0, 1) for _ in range(6))
    return messages.encode(Imu(t_ns, seq, t_ns, (a, b, c), (d, e, f)))


def flight(count: int) -> list[Recorded]:
    rng = random.Random(1)
    drones = [keys.sensor(f"drone{n}", "imu") for n in (1, 2, 3)]
    recorded = []
    for i in range(count):
        key, t_ns = drones[i % 3], i // 3 * GATE_NS
        recorded.append(Recorded(key, imu(t_ns, i // 3, rng), t_ns, 7 * i))
    return recorded


def write(path: Path, recorded: list[Recorded]) -> list[int]:
    """Write a record with a chunk every CHUNK_MESSAGES; return the size of the file after each message."""
    sizes = []
    with RecordWriter(path) as writer:
        for i, message in enumerate(recorded, start=1):
            writer.add(message.key, message.payload, messages.encoding(message.key), message.t_ns, message.wall_ns)
            if i % CHUNK_MESSAGES == 0:
                writer.flush()
            sizes.append(path.stat().st_size)
    return sizes


def read(path: Path, **options) -> list[Recorded]:
    with RecordReader(path) as reader:
        return list(reader.messages(**options))


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["clock", "drone/a/truth", "world/event", "user/own"]),
            st.binary(max_size=2000),
            st.integers(0, 2**64 - 1),
            st.booleans(),
        )
    )
)
@settings(max_examples=60, deadline=None)
def test_messages_are_read_back_as_written(tmp_path_factory, script):
    path = tmp_path_factory.mktemp("record") / "run.mcap"
    written = [Recorded(key, payload, t_ns, i) for i, (key, payload, t_ns, _) in enumerate(script)]
    with RecordWriter(path) as writer:
        for message, (_, _, _, flush) in zip(written, script, strict=True):
            writer.add(message.key, message.payload, "application/msgpack", message.t_ns, message.wall_ns)
            if flush:
                writer.flush()
    assert read(path, by_time=False) == written
    assert read(path) == sorted(written, key=lambda message: (message.t_ns, message.wall_ns))
    with RecordReader(path) as reader:
        assert reader.complete
        assert sum(reader.topics().values()) == len(written)
        for key in {message.key for message in written}:
            assert reader.last(key) == [message for message in written if message.key == key][-1]
        assert reader.last("never/seen") is None
    with open(path, "rb") as file:
        foreign = [(c.topic, m.data, m.log_time, m.publish_time) for _, c, m in make_reader(file).iter_messages()]
    assert foreign == read(path)


def test_messages_can_be_read_by_key(tmp_path):
    recorded = flight(500)
    write(tmp_path / "run.mcap", recorded)
    wanted = {recorded[1].key}
    assert read(tmp_path / "run.mcap", keys=wanted) == [m for m in recorded if m.key in wanted]
    assert read(tmp_path / "run.mcap", keys=()) == []


def test_message_numbers_continue_from_chunk_to_chunk(tmp_path):
    path, rng = tmp_path / "run.mcap", random.Random(8)
    keys = ["a/x", "b/x", "c/x"]
    with RecordWriter(path) as writer:
        for i in range(90):
            writer.add(rng.choice(keys[: 1 + i // 30]), rng.randbytes(rng.randrange(50)), "", i, i)
            if i % 7 == 0:
                writer.flush()
    counts = dict.fromkeys(keys, 0)
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert message.sequence == counts[channel.topic]
            counts[channel.topic] += 1
    assert sum(counts.values()) == 90
    assert min(counts.values()) > 0


def test_other_tools_find_encoding_schema_and_sequence(tmp_path):
    path = tmp_path / "run.mcap"
    with RecordWriter(path) as writer:
        for i in range(3):
            writer.add("clock", messages.encode(Clock(i, i, "r", i, "running", 1.0)), messages.encoding("clock"), i, i)
        writer.add("own/pose", b"\x80", "application/msgpack;Pose", 3, 3)
        writer.add("own/text", b"{}", "application/json", 4, 4)
    with open(path, "rb") as file:
        found = list(make_reader(file).iter_messages())
    assert [message.sequence for _, _, message in found[:3]] == [0, 1, 2]
    assert [(schema.name if schema else None, channel.message_encoding) for schema, channel, _ in found[2:]] == [
        ("Clock", "msgpack"),
        ("Pose", "msgpack"),
        (None, "json"),
    ]
    schema = found[0][0]
    assert schema is not None
    assert schema.encoding == "jsonschema"
    assert b"waiting_for" in schema.data


def test_repair_makes_a_truncated_record_seekable_by_other_tools(tmp_path):
    path, cut_path = tmp_path / "run.mcap", tmp_path / "cut.mcap"
    write(path, flight(400))
    data, rng = path.read_bytes(), random.Random(3)
    for cut in [0, 6, 8, 30, *(rng.randrange(len(data)) for _ in range(60)), len(data) - 1]:
        cut_path.write_bytes(data[:cut])
        before = read(cut_path)
        assert repair(cut_path)
        assert not repair(cut_path)
        assert read(cut_path) == before
        with open(cut_path, "rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            assert summary.statistics.message_count == len(before)
            foreign = list(reader.iter_messages(topics=[keys.sensor("drone2", "imu")]))
        assert len(foreign) == sum("drone2" in message.key for message in before)
        with open(cut_path, "rb") as file:
            assert sum(1 for _ in StreamReader(file, validate_crcs=True).records) > len(before)


class Damaged:
    """A record whose bytes may be changed before it is read."""

    def __init__(self, folder: Path, messages: int = 200) -> None:
        self.path, self.recorded = folder / "run.mcap", flight(messages)
        self.sizes = write(self.path, self.recorded)
        self.data = bytearray(self.path.read_bytes())
        self.chunks = [place for place in record_spans(bytes(self.data)) if place.opcode == Opcode.CHUNK]
        self.third = self.sizes[2 * CHUNK_MESSAGES - 1]  # where the third chunk begins

    def read(self) -> tuple[list[Recorded], tuple[str, ...], bool]:
        """Return the messages in file order, the damage, and whether the record is complete."""
        self.path.write_bytes(self.data)
        with RecordReader(self.path) as reader:
            return list(reader.messages(by_time=False)), reader.damaged, reader.complete


def test_a_damaged_chunk_is_skipped_and_reported(tmp_path):
    record = Damaged(tmp_path)
    record.data[record.sizes[CHUNK_MESSAGES - 1] - 3000] ^= 0xFF  # inside the first chunk's compressed content
    found, (damage,), _ = record.read()
    assert found == record.recorded[CHUNK_MESSAGES:]
    assert has_terms(damage, "byte", str(record.chunks[0].start))
    with RecordReader(record.path) as reader:
        assert list(reader)
        assert has_terms(record_notes(reader)[0], "damaged", str(record.chunks[0].start))


def test_a_chunk_with_a_changed_checksum_is_reported(tmp_path):
    """Its content is intact, so only the checksum reveals the damage."""
    record = Damaged(tmp_path)
    second, recorded = record.chunks[1], record.recorded
    crc = second.body + CHUNK_HEAD.size - 8
    assert int.from_bytes(record.data[crc : crc + 4], "little") == chunk_head(bytes(record.data), second).crc
    for changed in (b"\x01\x02\x03\x04", b"\0\0\0\0"):  # in MCAP, 0 means no checksum, but our records always have one
        record.data[crc : crc + 4] = changed
        found, (damage,), _ = record.read()
        assert found == recorded[:CHUNK_MESSAGES] + recorded[2 * CHUNK_MESSAGES :]
        assert has_terms(damage, "byte", str(second.start))


def test_a_damaged_last_chunk_of_a_truncated_record_is_reported_on_opening(tmp_path):
    record = Damaged(tmp_path, 2 * CHUNK_MESSAGES)
    del record.data[-1:]
    record.data[record.chunks[-1].end - 20] ^= 4
    found, damage, _ = record.read()
    assert (found, len(damage)) == (record.recorded[:CHUNK_MESSAGES], 1)
    with RecordReader(record.path) as reader:
        assert reader.damaged == damage


def test_an_impossible_length_hides_what_follows_and_is_reported(tmp_path):
    record = Damaged(tmp_path)
    assert record.data[record.third] == Opcode.CHUNK
    for length in (0, 3, 2**63):
        record.data[record.third + 1 : record.third + 9] = length.to_bytes(8, "little")
        found, damage, complete = record.read()
        assert (found, len(damage), complete) == (record.recorded[: 2 * CHUNK_MESSAGES], 1, True)


@pytest.mark.parametrize("bit", [4, 14, 20, 62])
def test_a_length_beyond_the_end_of_a_truncated_file_counts_as_damage(tmp_path, bit):
    record = Damaged(tmp_path, 600)
    del record.data[-1000:]
    after = next(place.start for place in record_spans(bytes(record.data)) if place.start > record.third)
    for place in (record.third, after):
        record.data[place + 1 + bit // 8] ^= 1 << bit % 8
        found, damage, complete = record.read()
        assert found == record.recorded[: len(found)]
        assert (complete, len(found) <= 3 * CHUNK_MESSAGES, len(damage) >= 1) == (False, True, True)
        record.data[place + 1 + bit // 8] ^= 1 << bit % 8


@pytest.mark.parametrize(
    ("rest", "cut"),
    [
        (HEAD.pack(Opcode.MESSAGE, 5)[:-1], True),
        (HEAD.pack(Opcode.MESSAGE, 5), True),
        (HEAD.pack(0x7F, 5), False),
        (HEAD.pack(Opcode.CHUNK, 3) + b"ab", False),
    ],
    ids=["part of a head", "head of a message", "unknown opcode", "chunk too short for its head"],
)
def test_bytes_after_the_last_record_are_a_truncated_one_or_damage(rest: bytes, cut: bool):
    assert is_cut(b"before" + rest, len(b"before")) is cut


def test_only_a_closed_record_is_compared_with_its_checksum(tmp_path):
    record = Damaged(tmp_path)
    (end,) = [place for place in record_spans(bytes(record.data)) if place.opcode == Opcode.DATA_END]
    record.data[next(record_spans(bytes(record.data))).end - 1] ^= 1  # the last letter of the writer's name
    for data, differs in ((record.data, True), (record.data[: end.end], False)):
        record.path.write_bytes(data)
        with RecordReader(record.path) as reader:
            assert (reader.complete, reader.differs()) == (differs, differs)


def test_a_chunk_with_a_damaged_header_is_skipped_and_not_summarised(tmp_path):
    record = Damaged(tmp_path)
    name = record.third + HEAD.size + CHUNK_HEAD.size - 4  # length of the name of the chunk's compression
    assert record.data[name : name + 8] == b"\x04\x00\x00\x00zstd"
    record.data[name : name + 4] = b"\x00\xff\xff\x00"
    record.path.write_bytes(record.data[:-1])  # truncated, so that there is something to repair
    assert repair(record.path)
    record.data = bytearray(record.path.read_bytes())
    found, damage, _ = record.read()
    sound = record.recorded[: 2 * CHUNK_MESSAGES] + record.recorded[3 * CHUNK_MESSAGES :]
    assert (found, len(damage)) == (sound, 1)
    with open(record.path, "rb") as file:
        assert sum(1 for _ in make_reader(file).iter_messages()) == len(sound)


@pytest.mark.parametrize("opcode", [Opcode.SCHEMA, Opcode.CHANNEL])
def test_a_damaged_schema_or_channel_is_reported_in_one_line(tmp_path, opcode):
    record = Damaged(tmp_path, 100)
    place = next(place for place in record_spans(bytes(record.data)) if place.opcode == opcode)
    at = place.body + (2 if opcode == Opcode.SCHEMA else 4)  # the length of its name
    record.data[at : at + 4] = b"\xff\xff\xff\x7f"
    record.path.write_bytes(record.data[:-1])  # truncated, so that there is something to repair
    with refused(RecordError, str(opcode.name).lower(), f"byte {place.start}", "damaged"):
        repair(record.path)


@given(st.integers(0, 2**32))
@example(29148)  # the name of a chunk's compression is longer than the chunk
@settings(max_examples=150, deadline=None)
def test_a_record_overwritten_anywhere_is_read_or_refused(tmp_path_factory, seed):
    path, rng = tmp_path_factory.mktemp("record") / "run.mcap", random.Random(seed)
    write(path, flight(100))
    data = bytearray(path.read_bytes())
    for at in [rng.randrange(8, len(data)) for _ in range(rng.randrange(1, 20))]:
        data[at] = rng.choice((0, 0xFF, rng.randrange(256)))
    path.write_bytes(data)
    for work in (read, repair):
        with suppress(RecordError):
            work(path)


def test_a_file_that_is_not_a_record_is_refused_in_one_line(tmp_path):
    path = tmp_path / "run.mcap"
    for read_or_repair in (RecordReader, repair):
        with refused(RecordError, "run.mcap", os.strerror(errno.ENOENT)):
            read_or_repair(path)
    path.write_text("name: step\n")
    for read_or_repair in (RecordReader, repair):
        with refused(RecordError, "run.mcap", "b'name: st'", "MCAP"):
            read_or_repair(path)


def test_a_record_is_never_overwritten(tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"precious")
    with refused(RecordError, "run.mcap", "exists"):
        RecordWriter(tmp_path / "run.mcap")
    with refused(RecordError, "nowhere/run.mcap", "written"):
        RecordWriter(tmp_path / "nowhere" / "run.mcap")


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_record_that_another_process_writes_is_not_touched(tmp_path: Path, goes_on: bool):
    path = tmp_path / "run.mcap"
    with RecordWriter(path) as writer:
        writer.add("clock", b"\x80", "", 0, 0)
        writer.flush()
        before = path.read_bytes()
        with refused(RecordError, "run.mcap"):
            RecordWriter(path, goes_on=goes_on)
        assert path.read_bytes() == before
    with RecordWriter(path, goes_on=True) as writer:
        writer.add("clock", b"\x81", "", 1, 1)
    assert [message.t_ns for message in read(path)] == [0, 1]


def test_messages_reach_the_disk_within_half_a_second(tmp_path):
    path, tick_ns = tmp_path / "run.mcap", 100_000_000
    with RecordWriter(path) as writer:
        for i, start_ns in enumerate([0, 10**9], start=1):  # a second time after a silence
            for wall_ns in range(start_ns, start_ns + 10**9, tick_ns):
                if wall_ns == start_ns + 2 * tick_ns:
                    writer.add("clock", b"\x80", "", 0, 1_700_000_000_000_000_000 + wall_ns)
                writer.tick(wall_ns)
                assert len(read(path)) == i - (wall_ns < start_ns + 5 * tick_ns)


def test_a_steady_trickle_reaches_the_disk_without_ticks(tmp_path):
    path = tmp_path / "run.mcap"
    with RecordWriter(path) as writer:
        for i in range(20):
            writer.add("clock", b"\x80", "", i, i * 50_000_000)
            assert len(read(path)) >= i - 5


def test_closing_twice_is_harmless(tmp_path):
    writer = RecordWriter(tmp_path / "run.mcap")
    writer.close()
    writer.close()
    assert read(tmp_path / "run.mcap") == []


def test_at_most_one_chunk_is_held_back(tmp_path):
    path, payload = tmp_path / "run.mcap", random.Random(4).randbytes(1000)
    with RecordWriter(path) as writer:
        for i in range(3000):
            writer.add("clock", payload, "", i, 0)
            if i % 250 == 0:
                assert (i - len(read(path))) * len(payload) <= CHUNK_BYTES
    assert len(read(path)) == 3000


def test_times_are_clamped_and_excess_keys_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("zsim.record.record_writer.CHANNELS_MAX", 2)
    path = tmp_path / "run.mcap"
    with RecordWriter(path) as writer:
        writer.add("a", b"1", "", -5, 1)
        writer.add("b", b"2", "", 2**70, 2)
        writer.add("c", b"3", "", 3, 3)
        writer.add("a", b"4", "", 4, 4)
    assert [(message.key, message.t_ns) for message in read(path)] == [("a", 0), ("a", 4), ("b", 2**64 - 1)]
    assert writer.refused == 1


@pytest.mark.parametrize("wanted", [None, {"clock"}])
def test_stray_times_in_every_chunk_do_not_keep_all_chunks_in_memory(tmp_path, wanted):
    """Of 60 chunks of 50 kB and 1 s each, reading by time holds only a few."""
    path, rng = tmp_path / "run.mcap", random.Random(9)
    with RecordWriter(path) as writer:
        for i in range(3000):
            writer.add("clock", rng.randbytes(1000), "", i * GATE_NS, 0)
            if i % 50 == 49:
                writer.add("own/command", b"%d" % i, "", 0 if i % 100 == 49 else 10**15, 0)
                writer.flush()
    with RecordReader(path) as reader:
        tracemalloc.start()
        times = [message.t_ns for message in reader.messages(wanted)]
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    strays = [0] * 30, [10**15] * 30
    clocks = [i * GATE_NS for i in range(3000)]
    assert times == (clocks if wanted else [*strays[0], *clocks, *strays[1]])
    assert peak < 600_000  # bytes; the whole record is 3 MB


def test_the_writer_keeps_nothing_that_is_on_disk(tmp_path):
    payload, held = random.Random(5).randbytes(150), []
    with RecordWriter(tmp_path / "run.mcap") as writer:
        tracemalloc.start()
        for i in range(60_000):
            writer.add(f"drone/drone{i % 40}/sensor/imu", payload, "", i, 0)
            if i % 20_000 == 19_999:
                writer.flush()
                held.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert held[2] - held[0] < 10_000  # bytes; what was written between them is 7 MB in 28 chunks


FILL = """
    import random, resource, sys
    from zsim.errors import RecordError
    from zsim.record import RecordWriter
    path, limit = sys.argv[1], int(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    rng = random.Random(6)
    try:
        writer = RecordWriter(path)
        for i in range(100_000):
            writer.add("clock", rng.randbytes(100), "application/msgpack;Clock", i, i)
        writer.close()
    except RecordError as error:
        print(error)
        sys.exit(3)
"""


@pytest.mark.parametrize("limit", [10, 100, 1_000, 2_900_000, 3_000_000, 3_234_567])
def test_a_full_disk_is_reported_and_leaves_a_readable_record(tmp_path, limit):
    path = tmp_path / "run.mcap"
    command = [sys.executable, "-c", textwrap.dedent(FILL), str(path), str(limit)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 3, done.stderr
    assert done.stdout.count("\n") == 1
    assert has_terms(done.stdout, "run.mcap", "written", os.strerror(errno.EFBIG))
    assert path.stat().st_size <= limit
    with RecordReader(path) as reader:
        found = [message.t_ns for message in reader]
        assert reader.complete or limit < 1_000
    assert found == list(range(len(found)))
    assert len(found) * 145 > limit - 1.3 * CHUNK_BYTES  # all but the chunk that did not fit, 145 bytes a message
    if limit > 100_000:
        with open(path, "rb") as file:
            assert sum(1 for _ in make_reader(file).iter_messages()) == len(found) > 0
