"""JPEG of strangers: its size is read from its header before anything is decoded, so that memory is bounded. Pure."""

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.sensors.camera import PictureError, frame_of

PIXELS_MAX = 1920 * 1080 * 2  # of a picture that is decoded; twice what a camera of a scenario may have


def decoded(data: bytes, width: int, height: int) -> NDArray[np.uint8]:
    """Return a JPEG as B, G, R, (height, width, 3).

    Raises:
        PictureError: it is none, or has another size, or an absurd one.
    """
    _, found_width, found_height = frame_of(data)
    if (found_width, found_height) != (width, height):
        found = f"{found_width} x {found_height}"
        raise PictureError(f"data is a JPEG of {found}; must be {width} x {height}, as the camera's info")
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
