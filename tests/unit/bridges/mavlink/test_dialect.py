"""MAVLink frames: whole, truncated, damaged, foreign and signed; the codec against the reference, pymavlink's dialect."""

import os
import random
import struct
from typing import Any

import pytest

os.environ["MAVLINK20"] = "1"  # pymavlink reads it on import
from mavlink_values import random_message
from pymavlink.dialects.v10 import ardupilotmega as dialect_1
from pymavlink.dialects.v20 import ardupilotmega as dialect_2

from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import (
    BY_ID,
    EPOCH_S,
    TIMESTAMP_LAG_MAX,
    Link,
    MessageLayout,
    Parser,
    Signing,
    Version,
    WireMessage,
    checksum,
)

HEARTBEAT_EXTRA = bytes([50])  # its CRC_EXTRA
KEY, OTHER = b"k" * 32, b"o" * 32
HEARTBEAT = dialect.Heartbeat(type=2)
MESSAGES = [HEARTBEAT, dialect.Statustext(6, "hello"), dialect.Attitude(1, 0.5), dialect.Ping()]
SEED = 17
COMMAND_CANCEL = 80  # in common.xml, but not in the release of the reference
COMMAND_CANCEL_CRC_EXTRA = 14  # from the table of the C library
LAYOUTS = [BY_ID[id_] for id_ in sorted(BY_ID) if id_ != COMMAND_CANCEL]
LAYOUTS_1 = [layout for layout in LAYOUTS if layout.id <= dialect.ID_MAX_1]


def test_the_checksum_is_crc_16_mcrf4xx() -> None:
    assert checksum(b"123456789") == 0x6F91  # the check value of CRC-16/MCRF4XX


def test_all_frames_of_a_datagram_are_read() -> None:
    link, parser = Link(1, 1), Parser()
    data = b"".join(link.pack(message) for message in MESSAGES) + Link(1, 1, version=1).pack(MESSAGES[0])
    assert [each.message for each in parser.feed(data)] == [*MESSAGES, MESSAGES[0]]
    assert not +parser.refused


def test_sequence_numbers_wrap_after_255() -> None:
    link, parser = Link(1, 1), Parser()
    seqs = [received.seq for _ in range(257) for received in parser.feed(link.pack(MESSAGES[0]))]
    assert seqs == [*range(256), 0]


def framed(body: bytes, crc_extra: bytes = b"") -> bytes:
    return b"\xfd" + body + checksum(body + crc_extra).to_bytes(2, "little")


def damaged(version: Version) -> bytes:
    frame = Link(1, 1, version=version).pack(MESSAGES[2])
    return frame[:-3] + bytes([frame[-3] ^ 1]) + frame[-2:]


@pytest.mark.parametrize(
    ("data", "reason", "count"),
    [
        (damaged(1), "bad_crc", 1),
        (damaged(2), "bad_crc", 1),
        (framed(bytes((1, 0, 0, 0, 1, 1)) + (50_000).to_bytes(3, "little") + b"\x07"), "unknown", 1),
        (framed(bytes((1, 0x02, 0, 0, 1, 1, 0, 0, 0, 7)), HEARTBEAT_EXTRA), "incompatible", 1),
        (b"hello", "noise", 8),
    ],
)
def test_an_invalid_frame_is_counted_and_the_next_one_read(data: bytes, reason: str, count: int) -> None:
    parser = Parser()
    datagram = data + Link(1, 1).pack(MESSAGES[0]) + b"bye"
    assert [received.message for received in parser.feed(datagram)] == [MESSAGES[0]]
    assert parser.refused[reason] == count


def test_a_truncated_datagram_is_counted_and_does_not_affect_the_next() -> None:
    link, parser = Link(1, 1), Parser()
    assert parser.feed(link.pack(MESSAGES[1])[:-1]) == []
    assert parser.refused["truncated"] >= 1
    assert [received.message for received in parser.feed(link.pack(MESSAGES[0]))] == [MESSAGES[0]]


def test_unknown_extension_fields_are_ignored() -> None:
    payload = bytes(9) + b"extension to come"
    body = bytes((len(payload), 0, 0, 0, 1, 1, 0, 0, 0)) + payload
    (received,) = Parser().feed(framed(body, HEARTBEAT_EXTRA))
    assert received.message == dialect.Heartbeat()


def test_a_value_out_of_range_is_refused() -> None:
    with pytest.raises(struct.error):
        Link(1, 1).pack(dialect.Heartbeat(type=256))
    with pytest.raises(ValueError, match="SETUP_SIGNING has the id 256"):
        Link(1, 1, version=1).pack(dialect.SetupSigning())


def test_garbage_yields_no_messages() -> None:
    rng = random.Random(5)
    parser = Parser()
    for _ in range(2000):
        assert parser.feed(rng.randbytes(rng.randint(0, 300))) == []
    assert sum(parser.refused.values()) > 0


def test_a_signing_key_must_have_32_bytes() -> None:
    with pytest.raises(ValueError, match=r"5.*32"):
        Signing(b"short")


def test_only_a_correctly_signed_frame_is_accepted_and_only_once() -> None:
    parser, signed = Parser(Signing(KEY)), Link(1, 1, Signing(KEY)).pack(HEARTBEAT)
    assert [(each.message, each.signed) for each in parser.feed(signed)] == [(HEARTBEAT, True)]
    changed = signed[:-1] + bytes([signed[-1] ^ 1])
    for frame in (signed, Link(1, 1, Signing(OTHER)).pack(HEARTBEAT), changed, Link(1, 1).pack(HEARTBEAT)):
        assert parser.feed(frame) == []
    assert dict(+parser.refused) == {"replayed": 1, "bad_signature": 2, "unsigned": 1}


def test_a_stream_with_a_time_stamp_over_a_minute_old_is_refused() -> None:
    receiver, sender = Signing(KEY), Signing(KEY)
    receiver.advance(EPOCH_S + 3600.0)
    sender.timestamp = receiver.timestamp - TIMESTAMP_LAG_MAX - 2
    parser, link = Parser(receiver), Link(1, 1, sender)
    assert parser.feed(link.pack(HEARTBEAT)) == []
    assert len(parser.feed(link.pack(HEARTBEAT))) == 1
    assert parser.refused["replayed"] == 1


def test_signing_time_stamps_never_decrease() -> None:
    signing = Signing(KEY)
    signing.advance(EPOCH_S + 1.0)
    assert signing.timestamp == 100_000
    signing.advance(EPOCH_S + 0.5)
    assert signing.timestamp == 100_000
    ahead = Signing(KEY)
    ahead.timestamp = 500_000
    assert Parser(signing).feed(Link(2, 1, ahead).pack(HEARTBEAT))
    assert signing.timestamp == 500_001


def test_without_a_key_signatures_are_not_checked() -> None:
    (received,) = Parser().feed(Link(1, 1, Signing(KEY)).pack(HEARTBEAT))
    assert received.signed


def their_message(module: Any, layout: MessageLayout, ours: WireMessage) -> Any:
    """Return the reference's message with the same values."""
    kind = module.mavlink_map[layout.id]
    return kind(**{name: their_value(getattr(ours, name)) for name in kind.fieldnames})


def their_value(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode()
    return list(value) if isinstance(value, bytes | tuple) else value


def their_link(module: Any) -> Any:
    link = module.MAVLink(None, srcSystem=7, srcComponent=1)
    link.robust_parsing = True
    return link


def test_definitions_equal_those_of_the_reference() -> None:
    for layout in LAYOUTS:
        theirs = dialect_2.mavlink_map[layout.id]
        assert (layout.name, layout.crc_extra, layout.size) == (theirs.msgname, theirs.crc_extra, theirs.unpacker.size)
        assert list(layout.kind.__struct_fields__) == theirs.fieldnames, layout.name
        assert layout.wire_order == tuple(theirs.ordered_fieldnames), layout.name


def test_the_crc_extra_of_command_cancel_is_the_known_one() -> None:
    assert BY_ID[COMMAND_CANCEL].crc_extra == COMMAND_CANCEL_CRC_EXTRA


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_mavlink_2_frames_equal_those_of_the_reference(layout: MessageLayout) -> None:
    rng = random.Random(SEED + layout.id)
    ours, theirs = Link(7, 1), their_link(dialect_2)
    parser, reader = Parser(), their_link(dialect_2)
    for message in [layout.unpack(b""), *(random_message(layout, rng) for _ in range(20))]:
        packed = ours.pack(message)
        assert packed == theirs_packed(theirs, their_message(dialect_2, layout, message))
        (received,) = parser.feed(packed)
        assert layout.pack(received.message) == layout.pack(message)
        (read,) = reader.parse_buffer(packed)
        assert (read.get_type(), read.get_srcSystem()) == (layout.name, 7)


@pytest.mark.parametrize("layout", LAYOUTS_1, ids=lambda layout: layout.name)
def test_mavlink_1_frames_equal_those_of_the_reference(layout: MessageLayout) -> None:
    rng = random.Random(SEED + layout.id)
    ours, theirs, parser = Link(7, 1, version=1), their_link(dialect_1), Parser()
    for _ in range(5):
        message = random_message(layout, rng)
        packed = ours.pack(message)
        assert packed == theirs_packed(theirs, their_message(dialect_1, layout, message))
        (received,) = parser.feed(packed)
        assert layout.pack(received.message)[: layout.base_size] == layout.pack(message)[: layout.base_size]


def theirs_packed(link: Any, message: Any) -> bytes:
    packed = message.pack(link)
    link.seq = link.seq + 1 & 0xFF
    return bytes(packed)


def test_frames_of_the_reference_are_read_correctly() -> None:
    link = their_link(dialect_2)
    sent = link.statustext_encode(4, b"low battery")
    (received,) = Parser().feed(bytes(sent.pack(link)))
    assert received == dialect.Received(dialect.Statustext(4, "low battery"), 7, 1, 0, False)


def test_signatures_equal_those_of_the_reference() -> None:
    key = bytes(range(32))
    link = their_link(dialect_2)
    link.signing.secret_key, link.signing.sign_outgoing, link.signing.timestamp = key, True, 1000
    signing = Signing(key)
    signing.timestamp = 999
    ours = Link(7, 1, signing).pack(dialect.Heartbeat(type=2, custom_mode=5))
    theirs = bytes(link.heartbeat_encode(2, 0, 0, 5, 0, mavlink_version=0).pack(link))
    assert ours == theirs
    (received,) = Parser(Signing(key)).feed(theirs)
    assert received.signed


def read_by_the_authority(count: int) -> None:
    """Check that the reference reads each message of a random stream once and in order, wherever the stream is split."""
    rng, ours, theirs = random.Random(SEED), Link(7, 1), their_link(dialect_2)
    while count > 0:
        layouts = rng.choices(LAYOUTS, k=min(count, 500))
        data = b"".join(ours.pack(random_message(layout, rng)) for layout in layouts)
        cut = rng.randrange(len(data))
        read = [message for part in (data[:cut], data[cut:]) for message in theirs.parse_buffer(part) or []]
        assert [message.get_msgId() for message in read] == [layout.id for layout in layouts]
        count -= len(layouts)


def test_the_reference_reads_ten_thousand_messages() -> None:
    read_by_the_authority(10_000)


@pytest.mark.soak
def test_the_reference_reads_a_million_messages() -> None:
    read_by_the_authority(1_000_000)
