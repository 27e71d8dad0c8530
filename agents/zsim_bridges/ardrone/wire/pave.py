"""PaVE, Parrot's video encapsulation: the header before each picture on TCP port 5555.

Source: ARDroneLib (SDK 2.0.1), video_encapsulation.h.
"""

import struct
from enum import IntEnum
from typing import NamedTuple

PORT = 5555  # TCP (ARDroneLib, config.h)
SIGNATURE = b"PaVE"
VERSION = 2
CODEC_H264 = 4
HEADER_SIZE = 64  # bytes that have a meaning; later firmware puts four more behind them
HEADER_SIZE_MAX = 256  # bytes, chosen: beyond it is no header
PAYLOAD_MAX = 4_000_000  # bytes, chosen: no H.264 picture of 1280 x 720 is as large
_HEADER = struct.Struct("<4sBBHIHHHHIIBBBBIIHBBBB2xI12x")


class FrameType(IntEnum):
    """What a frame is; an IDR frame has SPS and PPS before it."""

    UNKNOWN = 0
    IDR = 1
    I = 2  # noqa: E741  the header's own name
    P = 3
    HEADERS = 4


_KINDS = frozenset(FrameType)


class PaveError(ValueError):
    """Bytes are no PaVE header; the text says why."""


class PaveHeader(NamedTuple):
    """The header of a frame."""

    payload_size: int
    frame_number: int
    timestamp_ms: int
    frame_type: FrameType
    encoded_width: int = 640
    encoded_height: int = 368
    display_width: int = 640
    display_height: int = 360
    stream_byte_position: int = 0
    stream_id: int = 1
    sps_size: int = 0
    pps_size: int = 0
    header_size: int = HEADER_SIZE
    codec: int = CODEC_H264
    control: int = 0

    def pack(self) -> bytes:
        """Return the header as it goes on the wire, 64 bytes."""
        low, high = self.stream_byte_position & 0xFFFF_FFFF, self.stream_byte_position >> 32 & 0xFFFF_FFFF
        return _HEADER.pack(
            SIGNATURE,
            VERSION,
            self.codec,
            HEADER_SIZE,
            self.payload_size,
            self.encoded_width,
            self.encoded_height,
            self.display_width,
            self.display_height,
            self.frame_number & 0xFFFF_FFFF,
            self.timestamp_ms & 0xFFFF_FFFF,
            1,
            0,
            self.frame_type,
            self.control,
            low,
            high,
            self.stream_id,
            1,
            0,
            self.sps_size,
            self.pps_size,
            0,
        )


def unpack(data: bytes) -> PaveHeader:
    """Return the header at the start of some bytes, at least 64; skip `header_size` of them to the payload.

    Raises:
        PaveError: they are none.
    """
    if len(data) < HEADER_SIZE:
        raise PaveError(f"has {len(data)} bytes; must have {HEADER_SIZE}")
    signature, _, codec, header_size, payload_size, *rest = _HEADER.unpack_from(data)
    encoded_width, encoded_height, display_width, display_height, frame_number, timestamp_ms, _, _, *rest = rest
    kind, control, low, high, stream_id, _, _, sps_size, pps_size, _ = rest
    if signature != SIGNATURE:
        raise PaveError(f"begins with {signature!r}; must be {SIGNATURE!r}")
    if not HEADER_SIZE <= header_size <= HEADER_SIZE_MAX or payload_size > PAYLOAD_MAX:
        raise PaveError(f"has a header of {header_size} and a payload of {payload_size} bytes; cannot be")
    return PaveHeader(
        payload_size,
        frame_number,
        timestamp_ms,
        FrameType(kind) if kind in _KINDS else FrameType.UNKNOWN,
        encoded_width,
        encoded_height,
        display_width,
        display_height,
        low | high << 32,
        stream_id,
        sps_size,
        pps_size,
        header_size,
        codec,
        control,
    )
