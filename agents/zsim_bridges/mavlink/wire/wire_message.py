"""What messages are made of: typed fields, and how a message of each kind lies in a payload.

A message is a class with its fields in the order of their definition:

    @message(73, extensions=1)
    class MissionItemInt(WireMessage):
        ...

Source of order, sizes and CRC_EXTRA: https://mavlink.io/en/guide/serialization.html.
"""

import re
from collections.abc import Callable
from operator import attrgetter, itemgetter
from struct import Struct
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

import msgspec

from zsim_bridges.mavlink.wire.checksum import checksum

UInt8 = Annotated[int, "uint8_t"]
Int8 = Annotated[int, "int8_t"]
UInt16 = Annotated[int, "uint16_t"]
Int16 = Annotated[int, "int16_t"]
UInt32 = Annotated[int, "uint32_t"]
Int32 = Annotated[int, "int32_t"]
UInt64 = Annotated[int, "uint64_t"]
Int64 = Annotated[int, "int64_t"]
Float = Annotated[float, "float"]
Double = Annotated[float, "double"]

PAYLOAD_MAX = 255  # bytes; the length is one byte
_CODES = {  # of the struct module
    "char": "s",
    "uint8_t": "B",
    "int8_t": "b",
    "uint16_t": "H",
    "int16_t": "h",
    "uint32_t": "I",
    "int32_t": "i",
    "uint64_t": "Q",
    "int64_t": "q",
    "float": "f",
    "double": "d",
}
_WORD = re.compile(r"(?<!^)(?=[A-Z])")


class WireMessage(msgspec.Struct, gc=False):
    """Base of all messages."""


class WireField(NamedTuple):
    """A field: its name, the C type of an element, and how many there are; None where it is no array."""

    name: str
    c_type: str
    length: int | None

    @property
    def size(self) -> int:
        """The size of an element [bytes], by which fields are ordered."""
        return Struct(f"<{_CODES[self.c_type]}").size

    @property
    def is_bytes(self) -> bool:
        """Whether it is one value for the struct module however long: texts and arrays of bytes."""
        return self.length is not None and self.c_type in ("char", "uint8_t")

    @property
    def code(self) -> str:
        """The format of the struct module."""
        if self.is_bytes:
            return f"{self.length}s"
        return f"{self.length or ''}{_CODES[self.c_type]}"

    @property
    def values(self) -> int:
        """How many values the struct module has for it."""
        return 1 if self.is_bytes else self.length or 1


class MessageLayout:
    """How messages of one kind lie in a payload.

    Attributes:
        kind: class of the messages.
        id, name: of the definition.
        crc_extra: sums up the definition, so that sides with different ones do not understand each other.
        size: with the extensions [bytes].
        base_size: without them, as in MAVLink 1.
        wire_order: names of the fields as they lie in a payload.
    """

    def __init__(self, kind: type[WireMessage], id_: int, extensions: int) -> None:
        self.kind = kind
        self.id = id_
        self.name = _WORD.sub("_", kind.__name__).upper()
        fields = _fields(kind)
        base = sorted(fields[: len(fields) - extensions], key=lambda field: -field.size)
        wire = base + fields[len(base) :]
        self._struct = Struct("<" + "".join(field.code for field in wire))
        self.size = self._struct.size
        self.base_size = Struct("<" + "".join(field.code for field in base)).size
        self.crc_extra = _crc_extra(self.name, base)
        self.crc_extra_byte = bytes([self.crc_extra])
        self.wire_order = tuple(field.name for field in wire)
        self._wire_values = _attributes(self.wire_order)
        self._parts = tuple(_writer(field) for field in wire) if any(field.length for field in wire) else ()
        self._pick = _elements(_places(fields, wire))
        self._texts = tuple(place for place, field in enumerate(fields) if field.c_type == "char")

    def pack(self, message: WireMessage) -> bytes:
        """Return the payload, with its extensions, and with the zeros at its end.

        Raises:
            struct.error, OverflowError: a value is out of the range of its type, or an array has another length.
        """
        values = self._wire_values(message)
        if self._parts:
            values = [each for write, value in zip(self._parts, values, strict=True) for each in write(value)]
        return self._struct.pack(*values)

    def unpack(self, payload: bytes) -> WireMessage:
        """Return the message of a payload; what is missing at its end is 0, what it has beyond is left out."""
        if len(payload) != self.size:
            payload = payload[: self.size].ljust(self.size, b"\0")
        values = self._pick(self._struct.unpack(payload))
        if self._texts:
            values = list(values)
            for place in self._texts:
                values[place] = values[place].partition(b"\0")[0].decode(errors="replace")
        return self.kind(*values)


LAYOUTS: dict[type[WireMessage], MessageLayout] = {}
BY_ID: dict[int, MessageLayout] = {}
Kind = TypeVar("Kind", bound=type[WireMessage])


def message(id_: int, extensions: int = 0) -> Callable[[Kind], Kind]:
    """Return a decorator that makes a class a message of the dialect.

    Args:
        id_: of the message.
        extensions: how many of its last fields are extensions, which MAVLink 1 does not have.
    """

    def register(kind: Kind) -> Kind:
        LAYOUTS[kind] = BY_ID[id_] = MessageLayout(kind, id_, extensions)
        return kind

    return register


def _fields(kind: type[WireMessage]) -> list[WireField]:
    hints = get_type_hints(kind, include_extras=True)
    return [_field(name, hints[name].__metadata__[0]) for name in kind.__struct_fields__]


def _field(name: str, c_type: str) -> WireField:
    element, _, length = c_type.rstrip("]").partition("[")
    return WireField(name, element, int(length) if length else None)


def _crc_extra(name: str, base: list[WireField]) -> int:
    text = f"{name} ".encode()
    for field in base:
        text += f"{field.c_type} {field.name} ".encode() + bytes([field.length] if field.length else [])
    crc = checksum(text)
    return crc & 0xFF ^ crc >> 8


def _attributes(names: tuple[str, ...]) -> Callable[[WireMessage], tuple[Any, ...]]:
    get = attrgetter(*names)
    return get if len(names) > 1 else lambda message: (get(message),)


def _elements(places: list[int | slice]) -> Callable[[tuple[Any, ...]], tuple[Any, ...]]:
    get = itemgetter(*places)
    return get if len(places) > 1 else lambda values: (get(values),)


def _places(fields: list[WireField], wire: list[WireField]) -> list[int | slice]:
    """Return where the values of each field are among those that the struct module returns."""
    starts: dict[str, int] = {}
    start = 0
    for field in wire:
        starts[field.name] = start
        start += field.values
    return [_place(field, starts[field.name]) for field in fields]


def _place(field: WireField, start: int) -> int | slice:
    return start if field.length is None or field.is_bytes else slice(start, start + field.values)


def _writer(field: WireField) -> Callable[[Any], Any]:
    """Return what makes of a field's value the values for the struct module."""
    if field.c_type == "char":
        return _text
    return _single if field.length is None or field.is_bytes else tuple


def _text(text: str) -> tuple[bytes]:
    return (text.encode(),)


def _single(value: Any) -> tuple[Any]:
    return (value,)
