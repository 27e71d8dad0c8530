"""A camera of somebody's own: publishes synthetic pictures on a camera's key, as any program may."""

import itertools
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
from wire import Client

PERIOD_S = 0.03  # wall time between two pictures
SIZE = 64, 36  # px
_numbers = itertools.count()  # of all pumps of a test run: a gateway remembers the last one's


def shaded(number: int, size: tuple[int, int] = SIZE) -> bytes:
    """Return a JPEG of one shade of grey, of 16, by which a picture's number is known again."""
    shade = 16 * (number % 16)
    done, data = cv2.imencode(".jpg", np.full((size[1], size[0], 3), shade, np.uint8))
    assert done
    return data.tobytes()


def image(number: int, data: bytes, size: tuple[int, int] = SIZE) -> dict[str, object]:
    """Return the fields of a picture, exposed at as many milliseconds as its number."""
    stamp = {"t_ns": 0, "t_sample_ns": number * 1_000_000}
    return {**stamp, "source": "camera.tester", "width": size[0], "height": size[1], "format": "jpeg", "data": data}


def calibration() -> dict[str, object]:
    """Return the fields of a front camera's info; its camera is turned and not in the body's middle."""
    return {
        "t_ns": 0,
        "source": "camera.tester",
        "width": SIZE[0],
        "height": SIZE[1],
        "K": [50.0, 0.0, 31.5, 0.0, 51.0, 17.5, 0.0, 0.0, 1.0],
        "D": [-0.1, 0.02, 0.001, -0.002, 0.003],
        "position_m": [0.162, 0.0, 0.012],
        "orientation_wxyz": [0.5, -0.5, 0.5, -0.5],
        "rate_hz": 30.0,
    }


@contextmanager
def pumping(client: Client, key: str, size: tuple[int, int] = SIZE, filler: int = 0) -> Iterator[None]:
    """Publish a picture every PERIOD_S meanwhile; `filler` bytes behind each make them as large as real ones."""
    over = threading.Event()

    def pump() -> None:
        for number in _numbers:
            client.put(key, **image(number, shaded(number, size) + b"\0" * filler, size))
            if over.wait(PERIOD_S):
                return

    thread = threading.Thread(target=pump, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
