"""Completeness of a record, judged by the numbers of its gates and messages and by its end."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader
from msgspec.msgpack import decode, encode
from msgspec.structs import replace
from plain_messages import GATE_NS, imu, run_info
from refused import has_terms

from zsim.contract import keys
from zsim.contract.messages import DroneInfo, Info
from zsim.contract.run_messages import Clock
from zsim.record import Completeness, RecordReader, RecordWriter, completeness
from zsim.record.completeness import UNREAD, GateGap, sequence_numbers
from zsim.record.mcap_layout import record_spans
from zsim.record.record_reader import MessageSpans

INFO = run_info(["d1"])
IMU = keys.sensor("d1", "imu")


def clocks(*steps: int, first_seq: int = 0) -> list[Clock]:
    """Return a clock for each step, numbered in order."""
    return [Clock(step * GATE_NS, first_seq + i, "r", step, "running", 1.0) for i, step in enumerate(steps)]


def stopped(clock: Clock) -> Clock:
    return replace(clock, seq=clock.seq + 1, state="stopped")


def whole(gates: int) -> list[Clock]:
    found = clocks(*range(gates))
    return [*found, stopped(found[-1])]


def judged(
    path: Path, on_clock: Sequence[Clock], imus: Iterable[int] = (), info: Info = INFO, strange: Sequence[bytes] = ()
) -> Completeness:
    with RecordWriter(path) as writer:
        writer.add_message(keys.INFO, info, 1)
        for payload in strange:
            writer.add(keys.CLOCK, payload, "", 0, 1)
        for clock in on_clock:
            writer.add_message(keys.CLOCK, clock, 1)
        for seq in imus:
            writer.add_message(IMU, imu(0, seq), 1)
    with RecordReader(path) as reader:
        return completeness(reader)


def test_a_record_without_gaps_is_complete(tmp_path: Path) -> None:
    found = judged(tmp_path / "run.mcap", whole(10), range(40), strange=[b"\xc1", b"\x91" * 5000])
    assert (found.complete, found.gates, found.gaps, found.messages_missing) == (True, 10, (), 0)
    assert str(found) == "complete: 10 gates"


def test_messages_of_drivers_are_not_counted(tmp_path: Path) -> None:
    """A driver restarts its numbers after a death, and its messages may be dropped on the way."""
    external = replace(INFO, drones=(DroneInfo("d1", "any", body="external"),))
    assert judged(tmp_path / "external.mcap", whole(5), (0, 1, 7, 0, 1), external).messages_missing == 0
    assert judged(tmp_path / "simulated.mcap", whole(5), (0, 1, 7)).messages_missing == 5


def test_missing_gates_are_reported(tmp_path: Path) -> None:
    on_clock = [clock for clock in whole(20) if clock.step not in (0, 1, 7, 12, 13, 14)]
    found = judged(tmp_path / "run.mcap", on_clock)
    assert found.gaps == (
        GateGap(2, 0, GATE_NS),
        GateGap(1, 7 * GATE_NS, 7 * GATE_NS),
        GateGap(3, 12 * GATE_NS, 14 * GATE_NS),
    )
    assert (found.complete, found.gates, found.gates_missing) == (False, 14, 6)
    assert has_terms(str(found), "incomplete", "6", "20", "2", "0.00", "0.02", "0.14", "3", "0.24", "0.28")
    every_second = [clock for clock in whole(40) if clock.step % 2 == 0 or clock.state == "stopped"]
    many = judged(tmp_path / "many.mcap", every_second)
    assert (many.gates_missing, len(many.gaps)) == (19, 19)
    assert has_terms(str(many), "19", "40", "0.10", "16")


def test_pauses_and_seeks_are_not_gaps(tmp_path: Path) -> None:
    """While time stands still, the clock is repeated; a replay may begin anywhere and may seek."""
    assert judged(tmp_path / "stood.mcap", [*clocks(0, 1, 1, 1, 2), stopped(clocks(2, first_seq=4)[0])]).complete
    replay = replace(INFO, replay_of="other")
    seeks = clocks(50, 51, 10, 11, 90)
    assert judged(tmp_path / "sought.mcap", [*seeks, stopped(seeks[-1])], (200, 240), replay).complete
    del seeks[3]
    assert judged(tmp_path / "gap.mcap", [*seeks, stopped(seeks[-1])], (), replay).gates_missing == 79


def test_messages_out_of_order_are_not_missing(tmp_path: Path) -> None:
    swapped = whole(10)
    swapped[4:6] = swapped[5], swapped[4]
    assert judged(tmp_path / "run.mcap", swapped, [0, 2, 1, 4, 3]).complete


@pytest.mark.parametrize(("imus", "missing"), [([0, 1, 3, 4], 1), ([5, 6], 5), ([0, 1, 2, 2, 2, 4], 1)])
def test_missing_numbers_of_a_key_are_reported(tmp_path: Path, imus: list[int], missing: int) -> None:
    found = judged(tmp_path / "run.mcap", whole(3), imus)
    assert (found.complete, found.messages_missing, found.gaps) == (False, missing, ())
    assert has_terms(str(found), "incomplete", str(missing), "messages")


@given(st.lists(st.tuples(st.integers(0, 2**64 - 1), st.integers(0, 2**63 - 1), st.integers(0, 20)), min_size=1))
def test_sequence_numbers_are_read_as_the_decoder_reads_them(fields: list[tuple[int, int, int]]) -> None:
    """This holds whatever the length of both integers and of the map that starts with them."""
    payloads = [encode({"t_ns": t_ns, "seq": seq, **{f"f{k}": k for k in range(more)}}) for t_ns, seq, more in fields]
    ends = np.cumsum([len(payload) for payload in payloads])
    starts = np.array([0, *ends[:-1]])
    spans = MessageSpans(b"".join(payloads), np.zeros(len(payloads), np.int64), starts, ends, starts)
    assert sequence_numbers(spans).tolist() == [decode(payload)["seq"] for payload in payloads]


@pytest.mark.parametrize(
    "garbage",
    [
        b"",
        b"\xc1",
        encode({"seq": 1, "t_ns": 2}),
        encode({"t_ns": 1, "seq": -1}),
        encode({"t_ns": 1.5, "seq": 3}),
        encode([1, 2]),
        encode({"t_ns": 1, "seq": 300})[:-1],
    ],
)
def test_payloads_in_another_form_are_left_to_the_decoder(garbage: bytes) -> None:
    none = np.zeros(1, np.int64)
    spans = MessageSpans(garbage, none, none, np.array([len(garbage)]), none)
    assert sequence_numbers(spans).tolist() == [UNREAD]


def test_sequence_numbers_are_found_with_fields_in_another_order(tmp_path: Path) -> None:
    with RecordWriter(tmp_path / "run.mcap") as writer:
        writer.add_message(keys.INFO, INFO, 1)
        for seq in (0, 1, 4):
            writer.add(IMU, encode({"seq": seq, "t_ns": 0}), "", 0, 1)
    with RecordReader(tmp_path / "run.mcap") as reader:
        assert completeness(reader).messages_missing == 2


def test_a_record_without_an_end_is_incomplete(tmp_path: Path) -> None:
    found = judged(tmp_path / "run.mcap", clocks(*range(11)))
    assert (found.complete, found.ended, found.gaps) == (False, False, ())
    assert has_terms(str(found), "incomplete", "end", "0.20")
    assert not judged(tmp_path / "empty.mcap", []).complete


def test_a_damaged_or_truncated_record_is_incomplete(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    assert judged(path, whole(500)).complete
    data = path.read_bytes()
    path.write_bytes(data[:-9])
    with RecordReader(path) as reader:
        assert (completeness(reader).complete, completeness(reader).closed) == (False, False)
    for place in (place for place in record_spans(data) if place.opcode == Opcode.CHUNK):
        at = (place.start + place.end) // 2
        path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
        with RecordReader(path) as reader:
            found = completeness(reader)
        assert not found.complete
        assert has_terms(str(found), "damaged", "byte", str(place.start))


def test_a_changed_key_name_counts_as_damage(tmp_path: Path) -> None:
    """Key names are stored outside the chunks and their checksums."""
    path = tmp_path / "run.mcap"
    assert judged(path, whole(9), range(36)).complete
    data = path.read_bytes()
    with open(path, "rb") as file:
        assert len(list(StreamReader(file, validate_crcs=True).records)) > 0  # checksums as the library's
    path.write_bytes(data.replace(b"drone/d1/sensor/imu", b"drone/d2/sensor/imu"))
    with RecordReader(path) as reader:
        found = completeness(reader)
    assert (found.complete, found.gates, found.messages_missing) == (False, 9, 0)
    assert has_terms(str(found), "incomplete", "damaged", "key")
