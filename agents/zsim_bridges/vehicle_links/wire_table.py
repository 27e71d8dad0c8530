"""The messages of a wire protocol as a text table, and the byte layout of their fields.

Each entry of a table begins on a new line with its number and name; its fields follow in their order of definition, and
may continue on indented lines:

    77 COMMAND_ACK command:H result:B | progress:B result_param2:i target_system,target_component:B
    148 EXAMPLE voltages:10H[mV]=65535 text:50c uid:18s

`name:code` uses the codes of the struct module, preceded by a count for an array; names separated by commas are fields
of the same type. Two codes have a special meaning: `s` is an array of bytes, `c` a text. A unit may follow in brackets,
and after `=` the default of the field, which is zero otherwise. Fields after `|` are extensions.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from operator import itemgetter
from struct import Struct
from typing import Any, NamedTuple

_ENTRY = re.compile(r"^(\d+) (\w+)(.*(?:\n +\S.*)*)", re.MULTILINE)
_FIELD = re.compile(r"([\w,]+):(\d*)([a-zA-Z])(?:\[[^\]]*\])?(?:=(\S+))?")


class WireField(NamedTuple):
    """A field: `length` is None unless it is an array, `default` is that of each of its numbers."""

    name: str
    code: str
    length: int | None
    default: int

    @property
    def format(self) -> str:
        return f"{self.length or ''}{'s' if self.code == 'c' else self.code}"

    @property
    def is_array(self) -> bool:
        """Whether the struct module takes several values for the field; a text or an array of bytes is one value."""
        return self.length is not None and self.code not in "cs"

    @property
    def default_value(self) -> Any:
        if self.code in "cs":
            return "" if self.code == "c" else b""
        number = float(self.default) if self.code in "fd" else self.default
        return (number,) * self.length if self.length else number


class Entry(NamedTuple):
    """An entry of a table."""

    number: int
    name: str
    fields: list[WireField]
    extensions: list[WireField]


def read_table(text: str) -> Iterator[Entry]:
    for number, name, rest in _ENTRY.findall(text):
        fields, _, extensions = rest.partition("|")
        yield Entry(int(number), name, list(_fields(fields)), list(_fields(extensions)))


def _fields(text: str) -> Iterator[WireField]:
    for names, length, code, default in _FIELD.findall(text):
        for name in names.split(","):
            yield WireField(name, code, int(length) if length else None, int(default or 0))


class WireLayout:
    """The layout of fields in bytes: little-endian and packed.

    Args:
        fields: fields in their order of definition.
        wire: fields in wire order, if that is different.

    Attributes:
        codec: codec of the flat values, in wire order.
        is_flat: whether the flat values are the fields' own values.
    """

    def __init__(self, fields: Sequence[WireField], wire: Sequence[WireField] | None = None) -> None:
        self.fields, self._wire = tuple(fields), tuple(wire or fields)
        self.codec = Struct("<" + "".join(field.format for field in self._wire))
        self.is_flat = not any(field.length for field in fields)
        positions: dict[str, int | slice] = {}
        position = 0
        for field in self._wire:
            length = field.length if field.is_array and field.length else 1
            positions[field.name] = slice(position, position + length) if field.is_array else position
            position += length
        selected = [positions[field.name] for field in fields]
        self._select = itemgetter(*selected) if len(selected) > 1 else lambda flat: (flat[selected[0]],)
        self._text_indices = [index for index, field in enumerate(fields) if field.code == "c"]

    def flat(self, values: Iterable[Any]) -> Iterator[Any]:
        """Yield the codec's flat values for the fields' values, both in wire order."""
        for field, value in zip(self._wire, values, strict=True):
            if field.is_array:
                yield from value
            else:
                yield value.encode() if field.code == "c" else value

    def nested(self, flat: Sequence[Any]) -> Sequence[Any]:
        """Return the fields' values, in their order of definition, for the flat values of the codec."""
        values = self._select(flat)
        if self._text_indices:
            values = list(values)
            for index in self._text_indices:
                values[index] = values[index].partition(b"\0")[0].decode(errors="replace")
        return values
