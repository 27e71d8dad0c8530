"""The codec against pymavlink's generated dialect, the authority: definitions, bytes, and both parsers."""

import os
import random
from typing import Any

import pytest

os.environ["MAVLINK20"] = "1"  # pymavlink reads it when it is imported
from mavlink_values import random_message
from pymavlink.dialects.v10 import ardupilotmega as dialect_1
from pymavlink.dialects.v20 import ardupilotmega as dialect_2

from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import BY_ID, MessageLayout, WireMessage

SEED = 17
COMMAND_CANCEL = 80  # in common.xml, not in the authority's release
COMMAND_CANCEL_CRC_EXTRA = 14  # of the C library's table
LAYOUTS = [BY_ID[id_] for id_ in sorted(BY_ID) if id_ != COMMAND_CANCEL]
LAYOUTS_1 = [layout for layout in LAYOUTS if layout.id <= dialect.ID_MAX_1]


def their_message(module: Any, layout: MessageLayout, ours: WireMessage) -> Any:
    """Return the authority's message with the same values."""
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


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_a_definition_is_the_authority_s(layout: MessageLayout) -> None:
    theirs = dialect_2.mavlink_map[layout.id]
    assert (layout.name, layout.crc_extra, layout.size) == (theirs.msgname, theirs.crc_extra, theirs.unpacker.size)
    assert list(layout.kind.__struct_fields__) == theirs.fieldnames
    assert layout.wire_order == tuple(theirs.ordered_fieldnames)


def test_command_cancel_sums_up_to_the_known_crc_extra() -> None:
    assert BY_ID[COMMAND_CANCEL].crc_extra == COMMAND_CANCEL_CRC_EXTRA


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_a_frame_of_mavlink_2_is_the_authority_s_byte_for_byte(layout: MessageLayout) -> None:
    rng = random.Random(SEED + layout.id)
    ours, theirs = dialect.Link(7, 1), their_link(dialect_2)
    parser, reader = dialect.Parser(), their_link(dialect_2)
    for message in [layout.unpack(b""), *(random_message(layout, rng) for _ in range(20))]:
        packed = ours.pack(message)
        assert packed == theirs_packed(theirs, their_message(dialect_2, layout, message))
        (received,) = parser.feed(packed)
        assert layout.pack(received.message) == layout.pack(message)
        (read,) = reader.parse_buffer(packed)
        assert (read.get_type(), read.get_srcSystem()) == (layout.name, 7)


@pytest.mark.parametrize("layout", LAYOUTS_1, ids=lambda layout: layout.name)
def test_a_frame_of_mavlink_1_is_the_authority_s_byte_for_byte(layout: MessageLayout) -> None:
    rng = random.Random(SEED + layout.id)
    ours, theirs, parser = dialect.Link(7, 1, version=1), their_link(dialect_1), dialect.Parser()
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


def test_the_authority_s_frames_are_read_as_they_were_meant() -> None:
    link = their_link(dialect_2)
    sent = link.statustext_encode(4, b"low battery")
    (received,) = dialect.Parser().feed(bytes(sent.pack(link)))
    assert received == dialect.Received(dialect.Statustext(4, "low battery"), 7, 1, 0, False)


def test_signatures_are_the_authority_s() -> None:
    key = bytes(range(32))
    link = their_link(dialect_2)
    link.signing.secret_key, link.signing.sign_outgoing, link.signing.timestamp = key, True, 1000
    signing = dialect.Signing(key)
    signing.timestamp = 999
    ours = dialect.Link(7, 1, signing).pack(dialect.Heartbeat(type=2, custom_mode=5))
    theirs = bytes(link.heartbeat_encode(2, 0, 0, 5, 0, mavlink_version=0).pack(link))
    assert ours == theirs
    (received,) = dialect.Parser(dialect.Signing(key)).feed(theirs)
    assert received.signed


def read_by_the_authority(count: int) -> None:
    """Let the authority's parser read a stream of random messages, cut anywhere; each is there once, in order."""
    rng, ours, theirs = random.Random(SEED), dialect.Link(7, 1), their_link(dialect_2)
    while count > 0:
        layouts = rng.choices(LAYOUTS, k=min(count, 500))
        data = b"".join(ours.pack(random_message(layout, rng)) for layout in layouts)
        cut = rng.randrange(len(data))
        read = [message for part in (data[:cut], data[cut:]) for message in theirs.parse_buffer(part) or []]
        assert [message.get_msgId() for message in read] == [layout.id for layout in layouts]
        count -= len(layouts)


def test_the_authority_reads_ten_thousand_messages() -> None:
    read_by_the_authority(10_000)


@pytest.mark.soak
def test_the_authority_reads_a_million_messages() -> None:
    read_by_the_authority(1_000_000)
