"""What the header of a JPEG says, without decoding it: pictures of others are looked at before a browser gets them."""

PICTURE_BYTES_MAX = 1_000_000  # of a picture that is shown: ten a second of it fill 80 Mbit/s
PIXELS_MAX = 1920 * 1200  # chosen: the largest camera of a scenario; a browser needs 4 bytes for each
START, END = b"\xff\xd8", b"\xff\xd9"  # of an image; ITU-T T.81, table B.1
SCAN = 0xDA  # start of a scan: the header ends
FRAMES = frozenset({0xC0, 0xC1, 0xC2})  # start of a frame: baseline, extended, progressive; browsers show no others
STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a length
FRAME_BYTES = 5  # of a frame's header after its length: precision, height, width


class PictureError(ValueError):
    """Data that is no picture to be shown; the message says why."""


def check_picture(data: bytes, width: int, height: int) -> None:
    """Refuse what is no JPEG of a size, or too large.

    Args:
        data: of the picture.
        width, height: that its message gives [px].

    Raises:
        PictureError: in one line.
    """
    if len(data) > PICTURE_BYTES_MAX:
        raise PictureError(f"picture has {len(data)} bytes; must have {PICTURE_BYTES_MAX} at most")
    found = jpeg_size(data)
    if found != (width, height):
        raise PictureError(f"JPEG is {found[0]} × {found[1]}, its message says {width} × {height}; must be the same")
    if width * height > PIXELS_MAX:
        raise PictureError(f"picture is {width} × {height}; must have {PIXELS_MAX} pixels at most")


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Return width and height [px] of a JPEG.

    Raises:
        PictureError: it is none, or it is cut off.
    """
    if not data.startswith(START) or not data.endswith(END):
        raise PictureError(f"picture begins with {data[:2].hex() or 'nothing'}; must be a whole JPEG, ff d8 … ff d9")
    at = len(START)
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in FRAMES and at + 4 + FRAME_BYTES <= len(data):
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        if marker == SCAN:
            break
        at += _advance(marker, length)
    raise PictureError("JPEG has no frame that browsers show; must be baseline or progressive")


def _advance(marker: int, length: int) -> int:
    """Return how many bytes the header goes on after a marker; at least one, so that reading ends."""
    if marker == 0xFF:
        return 1  # a fill byte
    return 2 if marker in STANDALONE else 2 + length
