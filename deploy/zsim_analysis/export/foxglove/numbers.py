"""Typed messages of numbers, as protobuf: what Foxglove plots and Rerun keeps as scalars.

The encoding is protobuf's own: https://protobuf.dev/programming-guides/encoding, the schema a `FileDescriptorSet` of
google/protobuf/descriptor.proto. Two kinds of fields are needed, so the library is not.
"""

import struct
from collections.abc import Iterable, Sequence
from typing import Final

PACKAGE: Final = "zsim"
_BYTES, _EIGHT = 2, 1  # wire types: bytes after their length, eight bytes
_DOUBLE, _STRING = 1, 9  # FieldDescriptorProto.Type
_OPTIONAL = 1  # FieldDescriptorProto.Label
_FLOAT = struct.Struct("<d")


class Numbers:
    """A message of float64 fields, then of text fields; a number that is not known is NaN.

    Args:
        name: of the message, a protobuf identifier.
        numbers: names of the numeric fields, protobuf identifiers.
        texts: names of the text fields.
    """

    def __init__(self, name: str, numbers: Sequence[str], texts: Sequence[str] = ()) -> None:
        self.name = f"{PACKAGE}.{name}"
        self.numbers = tuple(numbers)
        self.texts = tuple(texts)
        places = range(1, len(self.numbers) + 1)
        self._heads = [_key(place, _EIGHT) for place in places]
        self._text_keys = [_key(len(self.numbers) + place, _BYTES) for place in range(1, len(self.texts) + 1)]
        self.schema = _file(name, [*((n, _DOUBLE) for n in self.numbers), *((t, _STRING) for t in self.texts)])

    def encode(self, numbers: Iterable[float], texts: Iterable[str] = ()) -> bytes:
        """Return a message of values in the order of the fields."""
        parts = [head + _FLOAT.pack(value) for head, value in zip(self._heads, numbers, strict=True)]
        encoded = [text.encode() for text in texts]
        parts += [key + _varint(len(text)) + text for key, text in zip(self._text_keys, encoded, strict=True)]
        return b"".join(parts)


def _file(name: str, fields: Iterable[tuple[str, int]]) -> bytes:
    """Return a FileDescriptorSet of one message with fields of these names and types, counted from 1."""
    described = b"".join(_bytes(2, _field(*field, place)) for place, field in enumerate(fields, start=1))
    message = _bytes(1, name.encode()) + described
    file = (
        _bytes(1, f"{PACKAGE}/{name}.proto".encode())
        + _bytes(2, PACKAGE.encode())
        + _bytes(4, message)
        + _bytes(12, b"proto3")
    )
    return _bytes(1, file)


def _field(name: str, kind: int, number: int) -> bytes:
    """Return a FieldDescriptorProto."""
    counted = ((3, number), (4, _OPTIONAL), (5, kind))
    return _bytes(1, name.encode()) + b"".join(_key(field, 0) + _varint(value) for field, value in counted)


def _bytes(field: int, content: bytes) -> bytes:
    return _key(field, _BYTES) + _varint(len(content)) + content


def _key(field: int, wire_type: int) -> bytes:
    return _varint(field << 3 | wire_type)


def _varint(value: int) -> bytes:
    """Return seven bits a byte, the lowest first, the eighth bit set where more follow."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)
