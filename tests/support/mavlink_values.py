"""Random values for the fields of MAVLink's messages."""

import random
from collections.abc import Callable
from typing import Any

from zsim_bridges.mavlink.dialect import MessageLayout, WireMessage
from zsim_bridges.vehicle_links.wire_table import WireField

INTEGER_BITS = {
    "B": (8, 0),
    "H": (16, 0),
    "I": (32, 0),
    "Q": (64, 0),
    "b": (8, 1),
    "h": (16, 1),
    "i": (32, 1),
    "q": (64, 1),
}


def random_message(layout: MessageLayout, rng: random.Random) -> WireMessage:
    """Return a message with random values; numbers are exact in float32, and texts have any length."""

    def element(code: str) -> float:
        if code in "fd":
            return rng.randrange(-(2**20), 2**20) / 64
        bits, signed = INTEGER_BITS[code]
        return rng.getrandbits(bits) - (2 ** (bits - 1) if signed else 0)

    def text(length: int) -> str:
        return "".join(rng.choices("ABCxyz_19", k=rng.randint(0, length)))

    return layout.kind(*(field_value(field, element, text, rng) for field in layout.fields))


def field_value(field: WireField, element: Callable[[str], Any], text: Callable[[int], str], rng: random.Random) -> Any:
    """Return a value of a field, composed of elements."""
    if field.length is None:
        return element(field.code)
    if field.code in "cs":
        return text(field.length) if field.code == "c" else rng.randbytes(field.length)
    return tuple(element(field.code) for _ in range(field.length))
