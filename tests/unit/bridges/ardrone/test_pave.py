"""PaVE headers, and another program's structure of them."""

import struct

import pytest
from ardrone_readers import pyardrone_reads

from zsim_bridges.ardrone.wire import pave
from zsim_bridges.ardrone.wire.pave import FrameType, PaveError, PaveHeader

HEADER = PaveHeader(1234, 7, 1500, FrameType.IDR, stream_byte_position=(5 << 32) + 9, sps_size=14, pps_size=6)


def test_what_is_packed_is_unpacked():
    assert len(HEADER.pack()) == 64
    assert pave.unpack(HEADER.pack() + b"payload") == HEADER


def test_offsets_of_the_sdk_s_structure():
    packed = HEADER.pack()
    assert packed[:4] == b"PaVE"
    assert struct.unpack_from("<HI4HII", packed, 6) == (64, 1234, 640, 368, 640, 360, 7, 1500)
    assert (packed[5], packed[30]) == (4, 1)
    assert struct.unpack_from("<II", packed, 32) == (9, 5)
    assert (packed[44], packed[45]) == (14, 6)


def test_longer_headers_are_read():
    longer = HEADER.pack()[:6] + struct.pack("<H", 68) + HEADER.pack()[8:] + bytes(4)
    assert pave.unpack(longer).header_size == 68


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (HEADER.pack()[:63], "has 63 bytes"),
        (b"EVaP" + HEADER.pack()[4:], "begins with"),
        (HEADER.pack()[:6] + b"\0\0" + HEADER.pack()[8:], "a header of 0"),
        (HEADER._replace(payload_size=2**31).pack(), "cannot be"),
    ],
)
def test_what_is_no_header_is_refused_with_a_reason(data: bytes, reason: str):
    with pytest.raises(PaveError, match=reason):
        pave.unpack(data)


def test_pyardrone_reads_it():
    read = pyardrone_reads("video", HEADER.pack())
    assert bytes(map(int, read["signature"])) == b"PaVE"
    expected = {"payload_size": 1234, "frame_number": 7, "frame_type": 1, "stream_byte_position_lw": 9}
    assert {name: read[name][0] for name in expected} == expected
    assert (read["header1_size"], read["header2_size"]) == ([14], [6])
