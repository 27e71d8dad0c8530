"""What the header of a JPEG says, without decoding it: nothing of a stranger's is decoded before it is looked at."""

from typing import NamedTuple

BEGINS = b"\xff\xd8"  # start of an image; this and the other markers: ITU-T T.81, table B.1
FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # starts of a frame, SOF0 to SOF15 but DHT, JPG and DAC
SCAN, END = 0xDA, 0xD9  # the header is over
STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a length: TEM, RST0 to RST7
FILL = 0xFF  # any number of these may stand before a marker
FRAME_BYTES = 9  # marker, length, precision, height, width


class PictureError(ValueError):
    """Bytes that are no picture of the kind and size that is allowed; one line."""


class Frame(NamedTuple):
    """How a JPEG is coded, by the marker of its frame, and its size [px]."""

    marker: int
    width: int
    height: int


def frame_of(data: bytes) -> Frame:
    """Return what the frame's header of a JPEG says.

    Raises:
        PictureError: it has no sound one.
    """
    at = len(BEGINS) if data.startswith(BEGINS) else len(data)
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in FRAMES:
            frame = Frame(marker, *(int.from_bytes(data[at + k : at + k + 2], "big") for k in (7, 5)))
            if at + FRAME_BYTES <= len(data) and frame.width and frame.height:
                return frame
            break
        if marker in (SCAN, END):
            break
        at += _advance(marker, length)
    raise PictureError(f"data ({len(data)} bytes, {data[:4].hex(' ') or 'none'} …) has no frame of a JPEG; must be one")


def _advance(marker: int, length: int) -> int:
    """Return how many bytes the header goes on after a marker; at least one, so that reading ends."""
    if marker == FILL:
        return 1
    return 2 if marker in STANDALONE else 2 + max(2, length)
