"""The recorder writes all messages once, without gaps, even those sent before it joined, and garbage as received."""

import errno
import os
from io import FileIO
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from fake_link import BAD_UTF8, NESTED, UNANSWERED, FakeLink
from mcap.opcode import Opcode
from msgspec import Struct
from msgspec.structs import replace
from refused import has_terms, refused
from synthetic_pictures import NO_JPEG, image, info

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages, encode_batch, key_table
from zsim.contract.messages import DroneInfo, Imu, Info, Origin
from zsim.contract.run_messages import RUN_ENDED, Clock, ControlAnswer, Event, Faults
from zsim.errors import RecordError
from zsim.record import Completeness, RecordReader, RecordWriter, completeness, mcap_layout
from zsim.record.completeness import GateGap
from zsim.record.mcap_layout import record_spans
from zsim_agents import recorder
from zsim_agents.recorder import Recorder

GATE_NS = 20_000_000
INFO = Info(
    0, 0, 1, "r", "zsim", "lockstep", 0.0, GATE_NS, 1, GATE_NS, 1, Origin(0.0, 0.0, 0.0), (DroneInfo("d1", "any"),), (),
    "", "", "", "",
)  # fmt: skip
TABLE = key_table(["d1"])
IMU = keys.sensor("d1", "imu")
JOIN = keys.process("recorder", "join")
Pair = tuple[str, bytes]


def record(link: Any, path: Path, info: Info = INFO, say: Any = lambda text: None) -> None:
    """Record a run until the link reports its end."""
    assert Recorder(link, info, path, say=say).run() == RUN_ENDED


def on_record(path: Path, *wanted: str) -> list[Pair]:
    """Return all messages in order of time, or those on some keys in the order in which they were written."""
    with RecordReader(path) as reader:
        return [(each.key, each.payload) for each in reader.messages(wanted or None, by_time=not wanted)]


def pair(key: str, message: Struct) -> Pair:
    return key, messages.encode(message)


LAST = dict([pair(keys.INFO, INFO)])


def clock(gate: int, state: str = "running", seq: int | None = None) -> Pair:
    number = gate if seq is None else seq
    return pair(keys.CLOCK, Clock(gate * GATE_NS, number, "r", gate, state, 1.0))  # type: ignore[arg-type]


def imu(gate: int) -> Pair:
    return pair(IMU, Imu(gate * GATE_NS, gate, gate * GATE_NS, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))


def whole(gate: int) -> list[Pair]:
    """Return a gate as the world passes it on: all samples in one message."""
    return [(keys.GATE, GateMessages.of(gate * GATE_NS, gate, TABLE, [imu(gate)]).pack()), clock(gate)]


def gates(*numbers: int) -> list[Pair]:
    return [each for gate in numbers for each in (imu(gate), clock(gate))]


def page(passed: list[Pair], more: int | None = None) -> ControlAnswer:
    return ControlAnswer(True, result=[list(each) for each in passed], more=more)


def linked(answers: list[ControlAnswer], *batches: list[Pair], last: dict[str, bytes] = LAST) -> FakeLink:
    """Return a link to a world that answers replay requests, retains last values and has sent batches."""
    link, left = FakeLink(), iter(answers)
    link.last = last
    link.on_request = lambda key, args: next(left, page([]))  # then there is nothing left to replay
    for passed in batches:
        link.deliver(keys.BATCH, encode_batch(passed))
    return link


def recorded(
    path: Path, answers: list[ControlAnswer], *batches: list[Pair], last: dict[str, bytes] = LAST
) -> list[Pair]:
    """Record a run, assert that all answers were requested, and return the messages in the record."""
    link = linked(answers, *batches, [clock(99, "stopped")], last=last)
    record(link, path)
    assert len(link.requests) >= len(answers)
    return on_record(path)


def cut_at_first_join(link: FakeLink) -> None:
    """Lose and restore the link as soon as the recorder has joined."""

    def cut(key: str, payload: bytes) -> None:
        if key == JOIN and len(link.published_on(key)) == 1:
            link.cut(False)
            link.cut(True)

    link.on_publish = cut


def stamps(found: list[Pair], key: str) -> list[int]:
    return [messages.decode(key, payload).t_ns // GATE_NS for name, payload in found if name == key]


def test_a_late_recorder_writes_duplicate_messages_once(tmp_path: Path):
    """The replay reaches gate 6; the batches received since the subscription begin with gate 4."""
    replayed = [page(gates(0, 1, 2, 3, 4, 5, 6))]
    found = recorded(tmp_path / "run.mcap", replayed, gates(4), gates(5, 6), gates(7), gates(8))
    assert stamps(found, IMU) == list(range(9))
    assert stamps(found, keys.CLOCK) == [*range(9), 99]


@pytest.mark.parametrize("last", [LAST, {}], ids=["answered", "not answered"])
def test_the_run_info_is_recorded_once_however_late_the_recorder_joins(tmp_path: Path, last: dict[str, bytes]):
    """The replay lacks the world's first messages; the value retained by the hub is recorded unchanged, once."""
    found = recorded(tmp_path / "run.mcap", [page(gates(7))], gates(8), last=last)
    assert found[0] == pair(keys.INFO, INFO)
    assert [key for key, _ in found].count(keys.INFO) == 1


def test_the_latest_faults_are_recorded_once(tmp_path: Path):
    first, second, third = (pair(keys.FAULTS, Faults(gate * GATE_NS, gate, ())) for gate in (1, 5, 8))
    for number, passed in enumerate(([*gates(7)], [first, *gates(2), second, *gates(7)])):
        found = recorded(tmp_path / f"{number}.mcap", [page(passed)], [third, *gates(8)], last=LAST | dict([second]))
        assert stamps(found, keys.FAULTS) == ([5, 8], [1, 5, 8])[number]


def test_combined_gates_are_recorded_message_by_message_and_once(tmp_path: Path):
    replayed = [page(gates(0, 1, 2, 3))]
    found = recorded(tmp_path / "run.mcap", replayed, whole(2), whole(3), whole(4), whole(5))
    assert stamps(found, IMU) == list(range(6))
    assert [payload for key, payload in found if key == IMU] == [imu(gate)[1] for gate in range(6)]


def test_a_gate_with_out_of_range_columns_is_refused(tmp_path: Path):
    """Any process that may publish can send such a gate; the record stays intact."""
    good = GateMessages.of(GATE_NS, 1, TABLE, [imu(1), imu(2)])
    bad = [b"", b"\xc1"]
    for which, stamps_, ends in (
        (np.array([0, 8]), good.stamps, good.ends),
        (np.array([0, -1]), good.stamps, good.ends),
        (good.which, -good.stamps, good.ends),
        (good.which, good.stamps, good.ends + 1),
        (good.which, good.stamps, good.ends[::-1].copy()),
        (good.which, good.stamps, np.array([5, good.ends[1]])),
        (good.which[:0], good.stamps[:0], good.ends[:0]),
    ):
        columns = [column.astype("<i8").tobytes() for column in (which, stamps_, ends)]
        bad.append(msgspec.msgpack.encode([GATE_NS, 1, *columns, bytes(good.buffer)]))
    batches = [[(keys.GATE, payload)] for payload in bad]
    found = recorded(tmp_path / "run.mcap", [page(gates(0))], gates(1), *batches, gates(2), whole(3))
    assert stamps(found, IMU) == [0, 1, 2, 3]


def test_duplicates_of_the_end_of_a_long_replay_are_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recorder, "KNOWN_MAX", 6)
    found = recorded(tmp_path / "run.mcap", [page(gates(*range(10)))], gates(8, 9, 10))
    assert stamps(found, IMU) == list(range(11))


@pytest.mark.parametrize(
    "answers",
    [
        [page(gates(0), more=4), page(gates(1), more=8), page(gates(2))],
        [UNANSWERED, UNANSWERED, page(gates(0, 1, 2))],
        [page(gates(0), more=2), UNANSWERED, page(gates(0, 1, 2))],
    ],
    ids=["in pages", "not at once", "a page at first"],
)
def test_all_pages_of_a_replay_are_written_and_missing_answers_retried(tmp_path: Path, answers: list[ControlAnswer]):
    assert stamps(recorded(tmp_path / "run.mcap", answers, gates(3)), IMU) == [0, 1, 2, 3]


@pytest.mark.parametrize("key", [keys.CLOCK, keys.EVENT, IMU, "process/x.y/join", "of/somebody"])
@pytest.mark.parametrize("payload", [BAD_UTF8, NESTED, b"\xc1", b"\x91" * 5000], ids=["utf8", "nested", "no", "deep"])
def test_garbage_is_recorded_as_received(tmp_path: Path, key: str, payload: bytes):
    passed = [(key, payload), clock(0), (key, payload), clock(1)]
    found = recorded(tmp_path / "run.mcap", [page([(key, payload)])], passed)
    assert [each for each in found if each[1] == payload] == [(key, payload)] * 2


def test_messages_on_too_many_keys_are_counted_and_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zsim.record.record_writer.CHANNELS_MAX", 2)
    link, lines = linked([], [imu(0), clock(0), imu(1), clock(1, "stopped")], last={}), []
    link.deliver("view/drones", b"\x81\xa4t_ns\x01")
    made = Recorder(cast("Any", link), INFO, tmp_path / "run.mcap", say=lines.append)
    assert made.run() == RUN_ENDED
    assert made.health.refused == 3
    (line,) = lines
    assert has_terms(line, "recorder", "3", "65535", "keys")


def test_untimed_messages_get_the_world_s_time_despite_foreign_stamps(tmp_path: Path):
    path = tmp_path / "run.mcap"
    strange = ("my/thing", msgspec.msgpack.encode({"t_ns": 2**61, "seq": 0}))
    recorded(path, [page(gates(0, 1, 2, 3))], [*gates(3), *gates(4), strange, ("my/raw", b"as it is")], gates(5))
    with RecordReader(path) as reader:
        times = {message.key: message.t_ns for message in reader.messages() if message.key.startswith("my/")}
    assert times == {"my/thing": 2**61, "my/raw": 4 * GATE_NS}


def completed(path: Path) -> Completeness:
    with RecordReader(path) as reader:
        return completeness(reader)


# Gaps


def died(path: Path, passed: list[Pair], cut: int = 0) -> None:
    """Write a record as a killed recorder leaves it: without an end, and truncated by `cut` bytes."""
    with RecordWriter(path) as writer:
        for key, payload in passed:
            writer.add(key, payload, messages.encoding(key), messages.decode(key, payload).t_ns, 1)
    data = path.read_bytes()
    end = next(place.start for place in record_spans(data) if place.opcode == Opcode.DATA_END)
    path.write_bytes(data[: end - cut])


def test_a_restarted_recorder_continues_the_record(tmp_path: Path):
    """The record has the gates up to 4; the world replays the last of these and those that passed in the meantime."""
    path = tmp_path / "run.mcap"
    died(path, [pair(keys.INFO, INFO), *gates(0, 1, 2, 3, 4)])
    found = recorded(path, [page(gates(2, 3, 4, 5, 6, 7))], gates(7), gates(8), whole(9))
    assert stamps(found, IMU) == list(range(10))
    assert stamps(found, keys.CLOCK) == [*range(10), 99]
    assert [key for key, _ in found].count(keys.INFO) == 1


@pytest.mark.parametrize("cut", [1, 40])
def test_messages_missing_from_the_last_chunk_are_requested(tmp_path: Path, cut: int):
    path = tmp_path / "run.mcap"
    died(path, [pair(keys.INFO, INFO), *gates(0, 1, 2)], cut)
    found = recorded(path, [page(gates(0, 1, 2, 3))], gates(4))
    assert stamps(found, IMU) == list(range(5))


def test_an_unknown_join_of_its_own_process_is_answered_by_a_newer_one(tmp_path: Path):
    link = linked([], last={})

    def entry(number: int, incarnation: int) -> Pair:
        news = {"incarnation": incarnation, "host": link.host, "pid": os.getpid(), "from_ns": 0}
        return pair(keys.EVENT, Event(0, number, "superseded", "recorder", "recorder", "", news))

    def admit(key: str, payload: bytes) -> None:
        joins = link.published_on(JOIN)
        if key == JOIN and len(joins) == 1:
            admitted = [entry(0, joins[0].incarnation), entry(1, 7)]
            link.deliver(keys.BATCH, encode_batch([*admitted, clock(1), clock(2, "stopped")]))

    link.on_publish = admit
    record(link, tmp_path / "run.mcap")
    assert len({join.incarnation for join in link.published_on(JOIN)} - {7}) == 2


def test_the_record_of_another_run_is_left_alone(tmp_path: Path):
    path = tmp_path / "run.mcap"
    died(path, [pair(keys.INFO, replace(INFO, run_id="other")), *gates(0)])
    before = path.read_bytes()
    with refused(RecordError, "run.mcap", "exists"):
        recorded(path, [])
    assert path.read_bytes() == before


def test_a_recorder_whose_disk_fills_while_it_joins_sends_a_bye(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The world already has its join: without a bye, it would wait for the recorder to be restarted."""
    link, write_all = linked([page(gates(0))]), mcap_layout.write_all

    def write(file: FileIO, data: bytes) -> None:
        if file.tell():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write_all(file, data)

    monkeypatch.setattr(mcap_layout, "write_all", write)
    with refused(RecordError, "run.mcap", os.strerror(errno.ENOSPC)) as full:
        record(link, tmp_path / "run.mcap")
    (join,) = link.published_on(JOIN)
    (bye,) = link.published_on("process/recorder/bye")
    assert (bye.reason, bye.incarnation) == (str(full.value), join.incarnation)


def test_messages_missed_while_the_link_was_lost_are_requested(tmp_path: Path):
    """The link is lost after gate 1 and restored before gate 4."""
    path, link = tmp_path / "run.mcap", FakeLink()
    replays = iter([page(gates(0)), page(gates(0, 1, 2, 3))])

    def answer(key: str, args: dict[str, Any]) -> ControlAnswer:
        answered = next(replays)
        if joins := link.published_on(JOIN):
            link.deliver(keys.BATCH, encode_batch([*gates(3, 4), clock(5, "stopped")]))
            assert len(joins) == 1
        return answered

    def cut(key: str, payload: bytes) -> None:
        if key == JOIN and len(link.published_on(key)) == 1:
            link.deliver(keys.BATCH, encode_batch(gates(1)))
            link.cut(False)
            link.cut(True)

    link.last = LAST
    link.on_request, link.on_publish = answer, cut
    record(link, path)
    found = on_record(path)
    assert stamps(found, IMU) == list(range(5))
    assert stamps(found, keys.CLOCK) == [*range(6)]
    first, second = link.published_on(JOIN)
    assert first.incarnation != second.incarnation


def test_missing_gates_are_requested_and_recorded_before_later_ones(tmp_path: Path):
    """No loss of the link is noticed: only the batch of gate 3 is missing."""
    path, strange = tmp_path / "run.mcap", ("drone/d1/cmd/velocity", b"of gate 5")
    answers = [page(gates(0, 1)), page([*gates(1, 2, 3), strange, *gates(4)])]
    found = recorded(path, answers, gates(2), [strange, *whole(4)], whole(5), [clock(6)])
    assert stamps(found, IMU) == list(range(6))
    written = [key for key, _ in on_record(path, keys.CLOCK, strange[0])]
    assert written == [*[keys.CLOCK] * 4, strange[0], *[keys.CLOCK] * 4]


def test_a_missing_clock_of_halted_time_is_detected_by_its_number(tmp_path: Path):
    """The world died just after it had published that clock, which its successor knows of."""
    path, stood = tmp_path / "run.mcap", clock(1, seq=2)
    after = [clock(1, seq=3), clock(2, seq=4)]
    recorded(path, [page(gates(0)), page([*gates(0, 1), stood, *after])], gates(1), after)
    clocks = [messages.decode(*each) for each in on_record(path, keys.CLOCK)]
    assert [(each.step, each.seq) for each in clocks[:-1]] == [(0, 0), (1, 1), (1, 2), (1, 3), (2, 4)]


def test_gates_that_the_world_no_longer_has_are_reported_missing(tmp_path: Path):
    """They are reported in one line during the run, and found from the record afterwards."""
    path, lines = tmp_path / "run.mcap", []
    answers = [page(gates(0)), page(gates(8, 9))]
    record(linked(answers, gates(1), gates(2), whole(9), whole(10), [clock(11, "stopped")]), path, say=lines.append)
    (line,) = lines
    assert has_terms(line, "recorder", "5", "0.06", "0.14")
    found = completed(path)
    assert found.gaps == (GateGap(5, 3 * GATE_NS, 7 * GATE_NS),)
    assert (found.complete, found.gates, found.gates_missing, found.messages_missing) == (False, 7, 5, 5)


def test_a_replay_far_ahead_causes_no_reordering_and_no_duplicates(tmp_path: Path):
    """It holds gates that are still in transit, beyond the missing ones."""
    path = tmp_path / "run.mcap"
    on_their_way = [each for gate in range(5, 30) for each in whole(gate)]
    found = recorded(path, [page(gates(0)), page(gates(20, 21, 22, 23))], on_their_way, [clock(30)])
    assert stamps(on_record(path, IMU), IMU) == [0, *range(5, 30)] == stamps(found, IMU)
    assert completed(path).gaps[0] == GateGap(4, GATE_NS, 4 * GATE_NS)


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_the_end_of_a_run_missed_while_the_link_was_lost_is_requested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
):
    monkeypatch.setattr(recorder, "QUIET_S", 0.0)
    path, info = tmp_path / "run.mcap", replace(INFO, mode=mode)
    answers = [page(gates(0)), page([*gates(0, 1, 2), clock(3, "stopped")])]
    link = linked(answers, last=dict([pair(keys.INFO, info)]))
    cut_at_first_join(link)
    record(link, path, info)
    assert completed(path).complete


def test_missed_realtime_messages_are_requested_without_a_missing_clock(tmp_path: Path):
    """A restarted world has published events, and the recorder reconnects when only clocks follow."""
    path, info = tmp_path / "run.mcap", replace(INFO, mode="realtime")
    missed = [pair(keys.EVENT, Event(0, number, "superseded", "x.y", "x.y", "")) for number in (0, 1)]
    answers = [page(gates(0)), page([*gates(0), *missed, *gates(1)])]
    link = linked(answers, last=dict([pair(keys.INFO, info)]))

    def cut(key: str, payload: bytes) -> None:
        joins = link.published_on(JOIN)
        if key == JOIN and len(joins) == 1:
            link.cut(False)
            link.cut(True)
        elif key == JOIN:
            data = {"incarnation": joins[-1].incarnation, "host": link.host, "pid": os.getpid(), "from_ns": 0}
            back = pair(keys.EVENT, Event(0, 2, "superseded", "recorder", "recorder", "", data))
            link.deliver(keys.BATCH, encode_batch([back]))
            link.deliver(keys.BATCH, encode_batch([*gates(1, 2), clock(3, "stopped")]))

    link.on_publish = cut
    record(link, path, info)
    written = on_record(path, keys.EVENT, keys.CLOCK)
    assert [messages.decode(*each).seq for each in written if each[0] == keys.EVENT] == [0, 1, 2]
    assert [messages.decode(*each).seq for each in written if each[0] == keys.CLOCK] == [0, 1, 2, 3]


def test_missing_gates_are_not_requested_from_another_run(tmp_path: Path):
    path, other = tmp_path / "run.mcap", dict([pair(keys.INFO, replace(INFO, run_id="other"))])
    link = linked([page(gates(0))], [*gates(1), *gates(4), clock(5, "stopped")], last=other)
    record(link, path)
    assert completed(path).gates_missing == 2
    assert len(link.requests) == 1


def test_gates_missing_from_a_continued_record_count_from_its_end(tmp_path: Path):
    path, lines = tmp_path / "run.mcap", []
    died(path, [pair(keys.INFO, INFO), *gates(0, 1, 2)])
    record(linked([page(gates(5))] * 2, [*gates(5, 6), clock(7, "stopped")], last={}), path, say=lines.append)
    assert [has_terms(line, "2", "0.06", "0.08") for line in lines] == [False, True]
    assert completed(path).gaps == (GateGap(2, 3 * GATE_NS, 4 * GATE_NS),)


def test_a_recorder_that_continues_a_finished_run_ends(tmp_path: Path):
    path, before = tmp_path / "run.mcap", [pair(keys.INFO, INFO), *gates(0, 1, 2), clock(3, "stopped")]
    died(path, before)
    record(linked([page(before)], last={}), path)
    assert completed(path).complete


def test_the_recorder_publishes_how_far_the_record_is_on_disk(tmp_path: Path):
    path, on_disk = tmp_path / "run.mcap", list[tuple[int, int]]()
    link = linked([page(gates(*range(60)))], [*gates(*range(59, 130)), clock(130, "stopped")], last={})

    def look(key: str, payload: bytes) -> None:
        if key == "process/recorder/done":
            with RecordReader(path) as reader:
                last = reader.last(keys.CLOCK)
            on_disk.append((messages.decode(key, payload).done_ns, last.t_ns if last else 0))

    link.on_publish = look
    record(link, path)
    assert on_disk[0] == (59 * GATE_NS, 59 * GATE_NS)
    assert all(done_ns == last_ns for done_ns, last_ns in on_disk)
    (join,) = link.published_on(JOIN)
    assert join.period_ns == 0 < join.slack_ns


@pytest.mark.parametrize("garbage", [b"\x91\x92\xa1\xff\xc4\x00", b"\x91" * 5000 + b"\xc0", b"\xc1"])
def test_a_garbage_batch_is_refused_without_ending_the_recording(tmp_path: Path, garbage: bytes):
    link = linked([], last={})
    for payload in (garbage, encode_batch([clock(0, "stopped")])):
        link.deliver(keys.BATCH, payload)
    made = Recorder(cast("Any", link), INFO, tmp_path / "run.mcap")
    assert made.run() == RUN_ENDED
    assert made.health.refused == 1


# Cameras

FRONT, FRONT_INFO = keys.camera("d1", "front"), keys.camera_info("d1", "front")


def filmed(path: Path, pictures: list[Struct | bytes], last: dict[str, bytes]) -> list[Pair]:
    """Record a run in which pictures bypass the world, and return the messages in the record."""
    link = linked([], gates(0), [clock(99, "stopped")], last=LAST | last)
    for picture in pictures:
        link.deliver(FRONT, picture)
    record(link, path)
    return on_record(path)


def test_pictures_and_camera_information_are_recorded_as_published(tmp_path: Path):
    pictures: list[Struct | bytes] = [image(number * GATE_NS, number) for number in range(3)]
    found = filmed(tmp_path / "run.mcap", pictures, dict([pair(FRONT_INFO, info())]))
    assert [payload for key, payload in found if key == FRONT] == [
        messages.encode(image(number * GATE_NS, number)) for number in range(3)
    ]
    assert [payload for key, payload in found if key == FRONT_INFO] == [messages.encode(info())]


def test_garbage_on_a_camera_s_key_is_recorded_and_does_no_harm(tmp_path: Path):
    found = filmed(tmp_path / "run.mcap", [b"\xc1", image(0, 0, NO_JPEG), image(GATE_NS, 1)], {})
    assert [key for key, _ in found].count(FRONT) == 3
    assert stamps(found, IMU) == [0]


def test_a_record_of_pictures_is_hardly_larger_than_the_pictures(tmp_path: Path):
    """JPEG is already compressed; the container and the other fields of the messages add less than 2 %."""
    rng = np.random.default_rng(1)
    jpegs = [b"\xff\xd8\xff" + rng.bytes(18_000) for _ in range(200)]
    filmed(tmp_path / "run.mcap", [image(n * GATE_NS, n, data) for n, data in enumerate(jpegs)], {})
    size = (tmp_path / "run.mcap").stat().st_size
    assert size < 1.02 * sum(map(len, jpegs)) + 10_000
