"""JPEG of strangers: its size is read from its header before anything is decoded, so that memory is bounded. Pure."""

import cv2
import numpy as np
from numpy.typing import NDArray

PIXELS_MAX = 1920 * 1080 * 2  # of a picture that is decoded; twice what a camera of a scenario may have
START, SCAN, END = 0xD8, 0xDA, 0xD9  # markers, ITU-T T.81, table B.1
FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 to SOF15 but DHT, JPG and DAC
ALONE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a length: TEM, RST0 to RST7


class PictureError(ValueError):
    """Bytes that are no picture of the size that was announced; one line."""


def decoded(data: bytes, width: int, height: int) -> NDArray[np.uint8]:
    """Return a JPEG as B, G, R, (height, width, 3).

    Raises:
        PictureError: it is none, or has another size, or an absurd one.
    """
    size = size_of(data)
    if size is None:
        raise PictureError(f"data ({len(data)} bytes) is no JPEG; must be one")
    if size != (width, height):
        raise PictureError(f"data is a JPEG of {size[0]} x {size[1]}; must be {width} x {height}, as the camera's info")
    if width * height > PIXELS_MAX:
        raise PictureError(f"picture has {width * height} pixels; must have at most {PIXELS_MAX}")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise PictureError(f"data ({len(data)} bytes) is a JPEG that cannot be decoded ({error.code})") from error
    if picture is None or picture.shape != (height, width, 3):
        raise PictureError(f"data ({len(data)} bytes) is a JPEG that cannot be decoded; must be whole")
    return picture  # type: ignore[return-value]


def size_of(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the header of a JPEG; None if it has no sound one."""
    if data[:2] != bytes([0xFF, START]):
        return None
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == 0xFF:  # padding
            at += 1
        elif marker in ALONE:
            at += 2
        elif marker in (SCAN, END):
            return None
        elif marker in FRAMES:
            height, width = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            return (width, height) if at + 9 <= len(data) and width and height else None
        else:
            at += 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))
    return None
