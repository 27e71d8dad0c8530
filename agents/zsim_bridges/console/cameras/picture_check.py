"""What is let through to a browser as a picture: pictures of others are looked at before."""

from zsim.sensors.camera import PictureError, frame_of

PICTURE_BYTES_MAX = 1_000_000  # of a picture that is shown: ten a second of it fill 80 Mbit/s
PIXELS_MAX = 1920 * 1200  # chosen: the largest camera of a scenario; a browser needs 4 bytes for each
ENDS = b"\xff\xd9"  # of an image; ITU-T T.81, table B.1
SHOWN = frozenset({0xC0, 0xC1, 0xC2})  # frames that browsers show: baseline, extended, progressive


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
    frame = frame_of(data)
    if frame.marker not in SHOWN or not data.endswith(ENDS):
        raise PictureError("JPEG is cut off, or not one that browsers show; must be baseline or progressive, and whole")
    if (frame.width, frame.height) != (width, height):
        found = f"{frame.width} × {frame.height}"
        raise PictureError(f"JPEG is {found}, its message says {width} × {height}; must be the same")
    if width * height > PIXELS_MAX:
        raise PictureError(f"picture is {width} × {height}; must have {PIXELS_MAX} pixels at most")
