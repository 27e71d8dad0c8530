"""Frames that are whole, cut, damaged or foreign, in datagrams and in streams; signatures: who is let in."""

import random
import struct

import pytest

from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import BEHIND_MAX, EPOCH_S, Link, Parser, Signing, Version, checksum

HEARTBEAT_EXTRA = bytes([50])  # its CRC_EXTRA
MESSAGES = [dialect.Heartbeat(type=2), dialect.Statustext(6, "hello"), dialect.Attitude(1, 0.5), dialect.Ping()]


def test_the_checksum_is_mcrf4xx() -> None:
    assert checksum(b"123456789") == 0x6F91  # check value of CRC-16/MCRF4XX


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
def test_what_is_no_frame_of_ours_is_counted_and_the_next_one_is_read(data: bytes, reason: str, count: int) -> None:
    parser = Parser()
    datagram = data + Link(1, 1).pack(MESSAGES[0]) + b"bye"
    assert [received.message for received in parser.feed(datagram)] == [MESSAGES[0]]
    assert parser.refused[reason] == count


def test_a_cut_datagram_is_counted_and_does_not_reach_into_the_next() -> None:
    link, parser = Link(1, 1), Parser()
    assert parser.feed(link.pack(MESSAGES[1])[:-1]) == []
    assert parser.refused["truncated"] >= 1
    assert [received.message for received in parser.feed(link.pack(MESSAGES[0]))] == [MESSAGES[0]]


def test_a_payload_longer_than_known_is_read_as_far_as_known() -> None:
    payload = bytes(9) + b"extension to come"
    body = bytes((len(payload), 0, 0, 0, 1, 1, 0, 0, 0)) + payload
    (received,) = Parser().feed(framed(body, HEARTBEAT_EXTRA))
    assert received.message == dialect.Heartbeat()


def test_a_value_out_of_range_is_refused() -> None:
    with pytest.raises(struct.error):
        Link(1, 1).pack(dialect.Heartbeat(type=256))
    with pytest.raises(ValueError, match="SETUP_SIGNING has the id 256"):
        Link(1, 1, version=1).pack(dialect.SetupSigning())


def test_garbage_yields_nothing_but_what_is_in_it() -> None:
    rng = random.Random(5)
    parser = Parser()
    for _ in range(2000):
        assert parser.feed(rng.randbytes(rng.randint(0, 300))) == []
    assert sum(parser.refused.values()) > 0


KEY, OTHER = b"k" * 32, b"o" * 32
HEARTBEAT = dialect.Heartbeat(type=2)


def test_a_key_has_32_bytes() -> None:
    with pytest.raises(ValueError, match=r"5.*32"):
        Signing(b"short")


def test_a_frame_is_accepted_once() -> None:
    parser, signed = Parser(Signing(KEY)), Link(1, 1, Signing(KEY)).pack(HEARTBEAT)
    assert [(each.message, each.signed) for each in parser.feed(signed)] == [(HEARTBEAT, True)]
    assert parser.feed(signed) == []
    assert parser.refused["replayed"] == 1


def test_a_frame_of_another_key_or_with_a_changed_signature_is_refused() -> None:
    parser = Parser(Signing(KEY))
    assert parser.feed(Link(1, 1, Signing(OTHER)).pack(HEARTBEAT)) == []
    changed = Link(1, 1, Signing(KEY)).pack(HEARTBEAT)
    assert parser.feed(changed[:-1] + bytes([changed[-1] ^ 1])) == []
    assert parser.refused["bad_signature"] == 2


def test_an_unsigned_frame_is_refused() -> None:
    parser = Parser(Signing(KEY))
    assert parser.feed(Link(1, 1).pack(HEARTBEAT)) == []
    assert parser.refused["unsigned"] == 1


def test_a_stream_that_begins_more_than_a_minute_ago_is_refused() -> None:
    receiver, sender = Signing(KEY), Signing(KEY)
    receiver.advance(EPOCH_S + 3600.0)
    sender.timestamp = receiver.timestamp - BEHIND_MAX - 2
    parser, link = Parser(receiver), Link(1, 1, sender)
    assert parser.feed(link.pack(HEARTBEAT)) == []
    assert len(parser.feed(link.pack(HEARTBEAT))) == 1
    assert parser.refused["replayed"] == 1


def test_timestamps_follow_the_clock_and_the_newest_frame_and_never_go_back() -> None:
    signing = Signing(KEY)
    signing.advance(EPOCH_S + 1.0)
    assert signing.timestamp == 100_000
    signing.advance(EPOCH_S + 0.5)
    assert signing.timestamp == 100_000
    ahead = Signing(KEY)
    ahead.timestamp = 500_000
    assert Parser(signing).feed(Link(2, 1, ahead).pack(HEARTBEAT))
    assert signing.timestamp == 500_001


def test_without_a_key_signed_frames_are_read_unchecked() -> None:
    (received,) = Parser().feed(Link(1, 1, Signing(KEY)).pack(HEARTBEAT))
    assert received.signed
