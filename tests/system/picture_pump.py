"""A third-party camera: publishes synthetic pictures on a camera's key, as any program may."""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import synthetic_pictures
from meanwhile import meanwhile
from wire import Client

PERIOD_S = 0.03  # wall time between two pictures
SIZE = synthetic_pictures.WIDTH_PX, synthetic_pictures.HEIGHT_PX
_numbers = itertools.count()  # shared by all pumps of a test run, because a gateway remembers the last picture


def shaded(number: int, size: tuple[int, int] = SIZE) -> bytes:
    """Return a JPEG in one of 16 shades of grey, which identifies the picture's number modulo 16."""
    return synthetic_pictures.jpeg(16 * (number % 16), *size)


def image(number: int, data: bytes, size: tuple[int, int] = SIZE) -> dict[str, object]:
    """Return the fields of a picture, exposed at `number` milliseconds."""
    stamp = {"t_ns": 0, "t_sample_ns": number * 1_000_000}
    return {**stamp, "source": "camera.tester", "width": size[0], "height": size[1], "format": "jpeg", "data": data}


def calibration() -> dict[str, Any]:
    """Return the fields of the info of a front camera that is rotated and off the body's centre."""
    fields = msgspec.to_builtins(synthetic_pictures.info(source="camera.tester"))
    return {name: list(value) if isinstance(value, tuple) else value for name, value in fields.items() if name != "seq"}


@contextmanager
def pumping(client: Client, key: str, size: tuple[int, int] = SIZE, filler: int = 0) -> Iterator[None]:
    """Publish a picture every PERIOD_S while the context is open; `filler` bytes pad each to a realistic size."""

    def pump() -> None:
        number = next(_numbers)
        client.put(key, **image(number, shaded(number, size) + b"\0" * filler, size))

    with meanwhile(pump, PERIOD_S):
        yield
