"""All that the world says at a gate in one buffer: written, sent, read, recorded as the messages one by one."""

import msgspec
import numpy as np
import pytest
from refused import refused

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages, key_table
from zsim.errors import DecodeError
from zsim.record import RecordReader, RecordWriter
from zsim.scenario import scenario_file
from zsim_world.fleet.fleet import Fleet
from zsim_world.fleet.publication import GatePublication

DRONES = ["d1", "d2", "d3"]


@pytest.fixture(scope="module")
def flown() -> list[GateMessages]:
    """Two seconds of three drones, one of which is flown by somebody."""
    places = [{"name": name, "position_m": [3 * i, 0, 0]} for i, name in enumerate(DRONES)]
    latency = {"gps": {"latency_ms": 35.0}, "baro": {"latency_ms": 12.5}}
    fleet = Fleet(scenario_file.resolve({"name": "gate", "duration_s": 5, "drones": places, "sensors": latency}))
    publication, gates = GatePublication(fleet), []
    for gate in range(100):
        fleet.advance()
        gates.append(publication.gate([None, "pilot.one" if gate > 50 else None, *[None] * (fleet.count - 2)]))
    return gates


def test_every_message_is_of_the_contract_and_to_the_byte_what_its_encoder_gives(flown: list[GateMessages]) -> None:
    received = set()
    for gate in flown:
        for key, payload in gate.pairs:
            assert messages.encode(messages.decode(key, payload)) == payload
            received.add(key)
    assert received == set(key_table(DRONES))


def test_numbers_count_on_per_key_and_status_counts_what_came(flown: list[GateMessages]) -> None:
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


def test_a_commander_is_named(flown: list[GateMessages]) -> None:
    statuses = [message for key, message in flown[-1].decoded() if keys.is_status(key)]
    assert [status.commander for status in statuses] == [None, "pilot.one", None]
    assert {status.state for status in statuses} == {"landed"}


def test_samples_of_a_drone_come_in_the_order_of_their_stamps_and_none_is_lost(flown: list[GateMessages]) -> None:
    for drone in DRONES:
        samples = [m for gate in flown for key, m in gate.decoded() if key == keys.sensor(drone, "gps")]
        assert [m.t_ns - m.t_sample_ns for m in samples] == [35_000_000] * len(samples)
        assert np.all(np.diff([m.t_sample_ns for m in samples]) > 0)
        stamps = [[m.t_ns for key, m in b.decoded() if keys.is_sensor(key) and keys.thing(key) == drone] for b in flown]
        assert all(stamp == sorted(stamp) for stamp in stamps)


def test_a_part_travels_and_comes_out_the_same(flown: list[GateMessages]) -> None:
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
def test_what_is_no_gate_message_is_refused(payload: bytes) -> None:
    with refused(DecodeError, "@gate", "messages", "gate"):
        GateMessages.unpack(payload, key_table(DRONES))


@pytest.mark.parametrize("place", [-1000, 24, 2**62])
def test_keys_that_are_not_there_are_refused(flown: list[GateMessages], place: int) -> None:
    b = flown[0]
    bad = GateMessages(b.t_ns, b.seq, b.table, np.full(len(b), place), b.stamps, b.ends, b.buffer)
    with pytest.raises(DecodeError, match="@gate: "):
        GateMessages.unpack(bad.pack(), b.table).check()


def test_a_record_of_gates_is_that_of_their_messages(flown: list[GateMessages], tmp_path) -> None:
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


def test_a_record_that_has_no_number_left_for_a_key_takes_the_others(
    flown: list[GateMessages], tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("zsim.record.record_writer.CHANNELS_MAX", 2)
    with RecordWriter(tmp_path / "run.mcap") as writer:
        writer.add_gate(flown[0], 5)
    assert writer.refused == len(flown[0]) - len(list(RecordReader(tmp_path / "run.mcap")))
    assert len({message.key for message in RecordReader(tmp_path / "run.mcap")}) == 2
