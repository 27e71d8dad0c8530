"""Signatures: who is let in, and what is refused."""

import pytest

from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.mavlink.wire.frame import Link, Parser
from zsim_bridges.mavlink.wire.signing import BEHIND_MAX, EPOCH_S, Signing

KEY, OTHER = b"k" * 32, b"o" * 32
HEARTBEAT = dialect.Heartbeat(type=2)
RADIO_STATUS = 109


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


def test_unsigned_frames_are_taken_by_policy() -> None:
    plain = Link(1, 1).pack(HEARTBEAT)
    for policy, taken in ((False, 0), (True, 1), ({RADIO_STATUS}, 0), ({0}, 1)):
        parser = Parser(Signing(KEY, accepts_unsigned=policy))
        assert len(parser.feed(plain)) == taken
        assert parser.refused["unsigned"] == 1 - taken


def test_a_stream_that_begins_more_than_a_minute_ago_is_refused() -> None:
    receiver, sender = Signing(KEY), Signing(KEY, link_id=3)
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
