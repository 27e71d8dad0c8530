"""Messages bundled in one payload or written from rows of numbers have the same bytes as when encoded one by one."""

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import refused

from zsim.contract import flight_messages, keys, messages
from zsim.contract.framing import BOOL, FLOATS, INT, TEXT, GateMessages, Layouts, key_table, read, text_table, write
from zsim.errors import DecodeError
from zsim.record import RecordReader, RecordWriter
from zsim.scenario import scenario_file
from zsim_world.fleet.fleet import Fleet
from zsim_world.fleet.publication import GatePublication

DRONES = ["d1", "d2", "d3"]


@pytest.fixture(scope="module")
def flown() -> list[GateMessages]:
    """Two seconds of three drones, one of which has a commander."""
    places = [{"name": name, "position_m": [3 * i, 0, 0]} for i, name in enumerate(DRONES)]
    latency = {"gps": {"latency_ms": 35.0}, "baro": {"latency_ms": 12.5}}
    fleet = Fleet(scenario_file.resolve({"name": "gate", "duration_s": 5, "drones": places, "sensors": latency}))
    publication, gates = GatePublication(fleet), []
    for gate in range(100):
        fleet.advance()
        gates.append(publication.gate([None, "pilot.one" if gate > 50 else None, *[None] * (fleet.count - 2)]))
    return gates


def test_every_message_matches_the_contract_and_its_encoder_to_the_byte(flown: list[GateMessages]) -> None:
    received = set()
    for gate in flown:
        for key, payload in gate.pairs:
            assert messages.encode(messages.decode(key, payload)) == payload
            received.add(key)
    assert received == set(key_table(DRONES))


def test_sequence_numbers_continue_per_key_and_the_status_counts_messages(flown: list[GateMessages]) -> None:
    seq = dict.fromkeys(key_table(DRONES), 0)
    for gate in flown:
        of_drone = dict.fromkeys(DRONES, 0)
        for key, message in gate.decoded():
            assert message.seq == seq[key]
            seq[key] += 1
            of_drone[keys.thing(key)] += keys.is_sensor(key)
            if keys.is_status(key):
                assert (message.t_ns, message.seq) == (gate.t_ns, gate.seq)
                assert message.count == of_drone[keys.thing(key)]
            assert gate.t_ns - 20_000_000 < message.t_ns <= gate.t_ns


def test_the_status_names_the_commander(flown: list[GateMessages]) -> None:
    statuses = [message for key, message in flown[-1].decoded() if keys.is_status(key)]
    assert [status.commander for status in statuses] == [None, "pilot.one", None]
    assert {status.state for status in statuses} == {"landed"}


def test_samples_of_a_drone_are_in_time_order_and_none_is_lost(flown: list[GateMessages]) -> None:
    for drone in DRONES:
        samples = [m for gate in flown for key, m in gate.decoded() if key == keys.sensor(drone, "gps")]
        assert [m.t_ns - m.t_sample_ns for m in samples] == [35_000_000] * len(samples)
        assert np.all(np.diff([m.t_sample_ns for m in samples]) > 0)
        stamps = [[m.t_ns for key, m in b.decoded() if keys.is_sensor(key) and keys.thing(key) == drone] for b in flown]
        assert all(stamp == sorted(stamp) for stamp in stamps)


def test_a_gate_and_a_part_of_it_survive_packing(flown: list[GateMessages]) -> None:
    for gate in flown[::10]:
        whole = GateMessages.unpack(gate.pack(), gate.table)
        assert (whole.t_ns, whole.seq, whole.pairs) == (gate.t_ns, gate.seq, gate.pairs)
        first, last = gate.first[1], gate.first[2]
        part = GateMessages.unpack(gate.pack(first, last), gate.table)
        assert part.pairs == gate.pairs[first:last]
        assert {keys.thing(key) for key, _ in part.pairs} == {"d2"}


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        msgspec.msgpack.encode([1, 2, b"", b"", b"12345678", b""]),
        msgspec.msgpack.encode([1, 2, b"123", b"123", b"123", b""]),
        msgspec.msgpack.encode([-1, 2, b"", b"", b"", b""]),
        msgspec.msgpack.encode({"t_ns": 1}),
    ],
)
def test_an_invalid_gate_payload_is_refused(payload: bytes) -> None:
    with refused(DecodeError, "@gate", "messages", "gate"):
        GateMessages.unpack(payload, key_table(DRONES))


@pytest.mark.parametrize("place", [-1000, 24, 2**62])
def test_key_indices_outside_the_table_are_refused(flown: list[GateMessages], place: int) -> None:
    b = flown[0]
    bad = GateMessages(b.t_ns, b.seq, b.table, np.full(len(b), place), b.stamps, b.ends, b.buffer)
    with pytest.raises(DecodeError, match="@gate: "):
        GateMessages.unpack(bad.pack(), b.table).check()


def test_a_record_of_gates_equals_that_of_their_messages(flown: list[GateMessages], tmp_path) -> None:
    with RecordWriter(tmp_path / "whole.mcap") as writer:
        for gate in flown:
            copy = GateMessages(gate.t_ns, gate.seq, gate.table, gate.which, gate.stamps, gate.ends,
                          bytearray(gate.buffer))  # fmt: skip
            writer.add_gate(copy, 5)
    with RecordWriter(tmp_path / "each.mcap") as writer:
        for gate in flown:
            for (key, payload), t_ns in zip(gate.pairs, gate.stamps.tolist(), strict=True):
                writer.add(key, payload, messages.encoding(key), t_ns, 5)
    whole, each = (list(RecordReader(tmp_path / f"{name}.mcap")) for name in ("whole", "each"))
    assert whole == each
    assert len(whole) == sum(map(len, flown))


def test_a_record_without_free_channels_still_takes_messages_of_known_keys(
    flown: list[GateMessages], tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("zsim.record.record_writer.CHANNELS_MAX", 2)
    with RecordWriter(tmp_path / "run.mcap") as writer:
        writer.add_gate(flown[0], 5)
    assert writer.refused == len(flown[0]) - len(list(RecordReader(tmp_path / "run.mcap")))
    assert len({message.key for message in RecordReader(tmp_path / "run.mcap")}) == 2


EDGES = (0, 127, 128, 255, 256, 65535, 65536, 2**32 - 1, 2**32, 2**63 - 1, -1, -32, -33, -128, -129, -32768, -32769)
EDGES += (-(2**31), -(2**31) - 1, -(2**62) - 1, -(2**63))
WHOLE = st.integers(-(2**63), 2**63 - 1) | st.sampled_from(EDGES)
COUNT = WHOLE.map(lambda value: value if value >= 0 else -(value + 1))
NUMBER = st.floats(allow_nan=False, allow_infinity=False)
TEXTS = ["landed", "flying", "", "controller.main", "ö" * 15, None]


def written(kinds: list[Any], rows: list[tuple[int, list[int], list[float]]]) -> list[bytes]:
    """Return the payloads written from (kind, whole numbers, floats), after checking that they can be read again."""
    layouts, texts = Layouts(kinds), text_table(TEXTS)
    found = []
    for kind, whole, real in rows:
        ints, floats = padded(whole, layouts.ints, np.int64), padded(real, layouts.floats, np.float64)
        out = np.zeros(layouts.room(texts), dtype=np.uint8)
        size = write(layouts.program, texts, kind, ints, floats.view(np.uint64), out, 0)
        found.append(out[:size].tobytes())
        check_reading(layouts, kind, found[-1], ints, floats)
    return found


def padded(values: Any, size: int, dtype: type) -> np.ndarray:
    return np.array([*values, *[0] * size][:size], dtype=dtype)


def check_reading(layouts: Layouts, kind: int, payload: bytes, ints: np.ndarray, floats: np.ndarray) -> None:
    """Check that all but texts and negative integers is read again, and a truncated or longer payload is not."""
    data, program = np.frombuffer(payload, dtype=np.uint8), layouts.program
    again, bits = ints.copy(), np.zeros(len(floats), dtype=np.uint64)
    for end in range(0, len(data), 41):
        assert not read(program, kind, data, 0, end, again, bits)
    assert not read(program, kind, np.append(data, np.uint8(0)), 0, len(data) + 1, again, bits)
    again, bits = ints.copy(), floats.view(np.uint64).copy()
    places, readable = program.ops[program.first[kind] : program.first[kind + 1]], True
    for op, place, size in places.tolist():
        readable = readable and op != TEXT and not (op == INT and ints[place] < 0)
        if op in (INT, BOOL):
            again[place] = 99
        elif op == FLOATS:
            bits[place : place + size] = 0
    assert read(program, kind, data, 0, len(data), again, bits) == readable
    if readable:
        assert again.tolist() == ints.tolist()
        assert bits.tolist() == floats.view(np.uint64).tolist()


@pytest.mark.parametrize("whole", EDGES)
def test_integers_at_the_limits_match_the_encoder(whole: int) -> None:
    message: Any = messages.Imu(0, 0, whole, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert written([messages.Imu], [(0, [0, 0, whole], [])]) == [messages.encode(message)]


@given(st.data())
@settings(max_examples=10, deadline=None)
def test_any_values_match_the_encoder(data: st.DataObject) -> None:
    t_ns, seq, count, sample_ns = data.draw(COUNT), data.draw(COUNT), data.draw(COUNT), data.draw(WHOLE)
    real: Any = tuple(data.draw(st.lists(NUMBER, min_size=20, max_size=20)))
    flag, text, name = data.draw(st.booleans()), data.draw(st.integers(0, 1)), data.draw(st.integers(0, len(TEXTS) - 1))
    state: Any = TEXTS[text]
    cases: list[tuple[Any, list[int]]] = [
        (messages.Imu(t_ns, seq, sample_ns, real[:3], real[3:6]), [t_ns, seq, sample_ns]),
        (
            messages.Gps(t_ns, seq, sample_ns, real[0], real[1], real[2], real[3:6], real[6:9], real[9], count, 9),
            [t_ns, seq, sample_ns, count, 9],
        ),
        (messages.Sonar(t_ns, seq, sample_ns, real[0], flag), [t_ns, seq, sample_ns, flag]),
        (
            flight_messages.Status(t_ns, seq, state, real[0], flag, TEXTS[name], count),
            [t_ns, seq, text, flag, name, count],
        ),
    ]
    rows = [(k, whole, real) for k, (_, whole) in enumerate(cases)]
    found = written([type(message) for message, _ in cases], rows)
    assert found == [messages.encode(message) for message, _ in cases]


@pytest.mark.parametrize("kind", [messages.Mag, messages.Baro, messages.Flow, flight_messages.Truth])
def test_every_message_type_of_the_world_has_a_layout(kind: type) -> None:
    values = [0.5 * k for k in range(20)]
    whole = [7, 300] if kind is flight_messages.Truth else [7, 300, -5]
    laid_out = (kind, 4) if kind is flight_messages.Truth else kind
    (payload,) = written([laid_out], [(0, whole, values)])
    message: Any = messages.decode_as(kind, payload, "here")
    assert (message.t_ns, message.seq) == (7, 300)
    assert messages.encode(message) == payload


def test_a_message_type_with_a_list_of_any_length_has_no_layout() -> None:
    class Several(msgspec.Struct):
        values: list[float]

    with pytest.raises(TypeError, match="Several: values"):
        Layouts([Several])


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_values_that_are_not_finite_are_not_read(bad: float) -> None:
    layouts = Layouts([messages.Mag])
    payload = messages.encode(messages.Mag(1, 2, 3, (0.0, bad, 1.0)))
    ints, bits = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.uint64)
    assert not read(layouts.program, 0, np.frombuffer(payload, dtype=np.uint8), 0, len(payload), ints, bits)


def test_fields_of_another_order_or_type_are_not_read() -> None:
    layouts = Layouts([messages.Mag])
    ints, bits = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.uint64)
    for message in ({"seq": 1, "t_ns": 2, "t_sample_ns": 3, "field_ut": [1.0, 2.0, 3.0]},
                    {"t_ns": 1.0, "seq": 2, "t_sample_ns": 3, "field_ut": [1.0, 2.0, 3.0]},
                    {"t_ns": 1, "seq": 2, "t_sample_ns": 3, "field_ut": [1, 2.0, 3.0]},
                    {"t_ns": 2**64 - 1, "seq": 2, "t_sample_ns": 3, "field_ut": [1.0, 2.0, 3.0]}):  # fmt: skip
        data = np.frombuffer(msgspec.msgpack.encode(message), dtype=np.uint8)
        assert not read(layouts.program, 0, data, 0, len(data), ints, bits)
