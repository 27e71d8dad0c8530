"""Navdata: a packet of a real aircraft, sizes of the SDK's structures, and parsing by other programs."""

import random
import struct

import pytest
from ardrone_readers import pyardrone_reads

from zsim_bridges.ardrone import navdata
from zsim_bridges.ardrone.navdata import FULL_TAGS, GPS_TAG, LAYOUTS, NavdataError, NavdataTemplate, StateBit

BOOTSTRAP = bytes.fromhex("88776655100c804f0100000000000000ffff0800a6020000")  # captured from a real aircraft
_SIZES = "148 8 52 46 16 12 88 16 24 76 56 16 44 92 108 364 328 8 40 65 12 18 75 56 72 32 8 216 6 32"
SIZES = {tag: int(size) for tag, size in enumerate(_SIZES.split())} | {navdata.CHECKSUM_TAG: 8}
"""Sizes of the structures of the SDK by tag, bytes."""
OPTIONS = tuple(tag for tag in LAYOUTS if tag != navdata.CHECKSUM_TAG)


def counted(tag: int):
    """Return an option with mostly different numbers, each of which fits in a byte."""
    layout = LAYOUTS[tag]
    return layout.option(tuple((7 * tag + k) % 100 for k in range(len(layout.codec.unpack(bytes(layout.codec.size))))))


def test_the_packet_of_a_real_aircraft_is_packed_and_unpacked():
    assert navdata.pack(0x4F800C10, 1, 0) == BOOTSTRAP
    packet = navdata.unpack(BOOTSTRAP)
    assert packet.bootstrap
    assert packet.sequence == 1
    assert packet.options == {}
    modes = StateBit.ALTITUDE_CONTROL | StateBit.NAVDATA_DEMO | StateBit.NAVDATA_BOOTSTRAP | StateBit.COM_WATCHDOG
    threads = StateBit.AT_THREAD | StateBit.NAVDATA_THREAD | StateBit.VIDEO_THREAD | StateBit.ACQUISITION_THREAD
    assert packet.state == modes | threads | StateBit.PIC_VERSION_OK


def test_structures_and_packets_have_the_sizes_of_the_sdk():
    assert {tag: layout.size for tag, layout in LAYOUTS.items()} == SIZES
    assert len(NavdataTemplate((0, 16)).packet(0, 1, 0)) == 500
    assert len(NavdataTemplate(FULL_TAGS).packet(0, 1, 0)) == 1904
    assert len(NavdataTemplate((*FULL_TAGS, GPS_TAG)).packet(0, 1, 0)) == 2120


@pytest.mark.parametrize("tag", OPTIONS)
def test_a_packed_option_is_unpacked_unchanged(tag: int):
    option = counted(tag)
    packet = navdata.unpack(navdata.pack(3, 9, 1, [(tag, option)]))
    assert packet == (StateBit.FLYING | StateBit.VIDEO, 9, 1, {tag: option}, {})


def test_a_template_gives_the_same_packet_as_packing():
    template = NavdataTemplate(FULL_TAGS)
    for tag in FULL_TAGS:
        template.option_writer(tag)(*LAYOUTS[tag].flat(counted(tag)))
    template.option_writer(26)(77)
    template.option_writer(GPS_TAG)(1, 2, 3)  # GPS is not in the template
    expected = [(tag, counted(tag) if tag != 26 else (77,)) for tag in FULL_TAGS]
    assert template.packet(5, 6, 0) == navdata.pack(5, 6, 0, expected)


@pytest.mark.parametrize("magic", navdata.MAGICS)
def test_both_magic_numbers_are_accepted(magic: int):
    packet = bytearray(BOOTSTRAP)
    packet[:4] = struct.pack("<I", magic)
    packet[-4:] = struct.pack("<I", sum(packet[:-8]))
    assert navdata.unpack(bytes(packet)).sequence == 1


def test_an_option_of_unexpected_size_is_kept_unparsed():
    body = struct.pack("<IIII", navdata.MAGIC, 0, 1, 0) + struct.pack("<HHif", GPS_TAG, 12, 5, 0.5)
    packet = navdata.unpack(body + struct.pack("<HHI", 0xFFFF, 8, sum(body)))
    assert packet.options == {}
    assert packet.unknown == {GPS_TAG: struct.pack("<if", 5, 0.5)}


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (BOOTSTRAP[:-1], "has 23 bytes"),
        (b"\0" + BOOTSTRAP[1:], "begins with 0x55667700"),
        (BOOTSTRAP[:-1] + b"\1", "the checksum is"),
        (BOOTSTRAP[:16] + b"\0\0\0\0" + BOOTSTRAP[16:], "option 0 at byte 16 has 0 bytes; must have at least 4$"),
        (BOOTSTRAP[:16] + b"\0\0\xff\0" + BOOTSTRAP[16:], "option 0 at byte 16 has 255 bytes; must have at most 12$"),
        (BOOTSTRAP[:16] + struct.pack("<HHI", 26, 8, 0), "has no checksum"),
    ],
)
def test_an_invalid_packet_is_refused_with_a_reason(datagram: bytes, reason: str):
    with pytest.raises(NavdataError, match=reason):
        navdata.unpack(datagram)


def test_corrupt_packets_raise_no_error_but_navdata_error():
    chance = random.Random(2)
    good = NavdataTemplate(FULL_TAGS).packet(0, 1, 0)
    refused = 0
    for _ in range(1000):
        datagram = bytearray(good)
        for _ in range(chance.randrange(1, 20)):
            datagram[chance.randrange(len(datagram))] = chance.randrange(256)
        try:
            navdata.unpack(bytes(datagram[: chance.randrange(len(datagram) + 1)]))
        except NavdataError:
            refused += 1
    assert refused > 900


def test_pyardrone_reads_every_number_of_every_option():
    template = NavdataTemplate(FULL_TAGS)
    for tag in FULL_TAGS:
        template.option_writer(tag)(*LAYOUTS[tag].flat(counted(tag)))
    read = pyardrone_reads("navdata", template.packet(int(StateBit.FLYING), 12, 1))
    assert read.pop("metadata") == [navdata.MAGIC, 1, 12, 1]
    assert len(read.pop("cks")) == 1
    names = {"euler_angles": "eular_angles"}  # as misspelt there
    expected = {LAYOUTS[tag].name: list(LAYOUTS[tag].flat(counted(tag))) for tag in FULL_TAGS}
    assert read == {names.get(name, name): values for name, values in expected.items()}


class TestArdroneSdk:
    """Parsing of zsim's packets by the unmodified parser of ardrone-sdk."""

    def test_ardrone_sdk_reads_a_demo_packet(self):
        parser = pytest.importorskip("ardrone.navdata")
        demo = LAYOUTS[0].zeros()._replace(ctrl_state=4 << 16, battery_percent=77, theta_mdeg=2500.0, altitude_mm=1000)
        read = parser.decode(navdata.pack(StateBit.FLYING | StateBit.COMMAND_ACK, 3, 0, [(0, demo)]))
        assert read["state"]["fly"] == read["state"]["command"] == 1
        assert read["state"]["emergency"] == 0
        assert (read["demo"]["ctrl_state"], read["demo"]["battery"], read["demo"]["altitude"]) == (4 << 16, 77, 1000)
        assert read["demo"]["theta"] == 2
