"""A message type as the columns of a table, for any message of the contract. Pure.

Vectors become a column per component, variables and sensors one per name, and what has no fixed shape becomes JSON
text. A new message, or a new field of one, has its columns without further code.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, Struct, inspect
from numpy.typing import NDArray

from zsim.contract.messages import REFUSALS
from zsim.scenario.faults import ROTORS
from zsim.sensors.sensor import sensor_of

Kind = Literal["whole", "number", "flag", "text"]
Values = NDArray[Any] | list[Any]

HEAD = ("t_ns", "seq")  # fields of every message; columns of every table
XYZ = ("x", "y", "z")
QUATERNION = "_wxyz"
COUNTS = ("used", "refused")  # what an estimate counts of a sensor
WHOLE_MAX = 2**63 - 1
_NUMERIC = inspect.IntType | inspect.FloatType


class FieldColumns:
    """A field of a message and the columns that it becomes.

    Attributes:
        name: of the field.
        kind: of all its columns.
        columns: their names.
    """

    def __init__(self, name: str, kind: Kind, columns: Sequence[str]) -> None:
        self.name = name
        self.kind: Kind = kind
        self.columns = tuple(columns)

    def values(self, messages: Sequence[Any]) -> Values:
        """Return a value per message, or a table (messages, columns); None or NaN where there is none."""
        found = [getattr(message, self.name) for message in messages]
        return [None if value is UNSET else value for value in found]


class VectorColumns(FieldColumns):
    """The same number of numbers in every message."""

    def values(self, messages: Sequence[Any]) -> Values:
        rows = [getattr(message, self.name)[: len(self.columns)] for message in messages]
        return np.array(rows, np.float64).reshape(len(rows), len(self.columns))


class IntegerColumn(FieldColumns):
    """A whole number; one that 64 bits do not hold is left out."""

    def values(self, messages: Sequence[Any]) -> Values:
        return [_whole(getattr(message, self.name)) for message in messages]


class PartColumn(FieldColumns):
    """A number inside a part of the message that has fields of its own."""

    def __init__(self, name: str, part: str, kind: Kind) -> None:
        super().__init__(name, kind, (f"{name}_{part}",))
        self._part = part

    def values(self, messages: Sequence[Any]) -> Values:
        return [getattr(getattr(message, self.name), self._part) for message in messages]


class NamedColumns(FieldColumns):
    """A number for each of the message's `names`, which may differ from message to message."""

    def __init__(self, name: str, names: Sequence[str]) -> None:
        super().__init__(name, "number", [f"{name}_{_tidy(each)}" for each in names])
        self.names = tuple(names)

    def values(self, messages: Sequence[Any]) -> Values:
        table = np.full((len(messages), len(self.names)), np.nan)
        indices: dict[tuple[str, ...], list[int]] = {}
        for row, message in zip(table, messages, strict=True):
            names = message.names
            if names not in indices:
                indices[names] = [self.names.index(name) for name in names]
            row[indices[names]] = getattr(message, self.name)
        return table


class KeyedColumns(FieldColumns):
    """One or two numbers for each key of a map: columns FIELD_KEY, or FIELD_KEY_used and FIELD_KEY_refused.

    Attributes:
        keys: the columns of each key.
    """

    def __init__(self, name: str, keys: Sequence[str], pairs: bool) -> None:
        ends = [f"_{end}" for end in COUNTS] if pairs else [""]
        super().__init__(name, "number", [f"{name}_{_tidy(key)}{end}" for key in keys for end in ends])
        self.keys = {key: slice(i * len(ends), (i + 1) * len(ends)) for i, key in enumerate(keys)}

    def values(self, messages: Sequence[Any]) -> Values:
        table = np.full((len(messages), len(self.columns)), np.nan)
        for row, message in zip(table, messages, strict=True):
            for key, value in getattr(message, self.name).items():
                row[self.keys[key]] = value
        return table


class JsonColumn(FieldColumns):
    """Anything else, as JSON."""

    def values(self, messages: Sequence[Any]) -> Values:
        return [json_text(getattr(message, self.name)) for message in messages]


class OpenField(NamedTuple):
    """A field whose columns depend on the messages' content: a map, or the names of variables."""

    name: str
    field: Literal["named", "numbers", "pairs"]


def open_fields(kind: type[Struct]) -> tuple[OpenField, ...]:
    """Return the fields of a message whose columns are known only when all messages are."""
    return tuple(OpenField(field.name, open_kind) for field in _fields(kind) if (open_kind := _open_kind(kind, field)))


def fields(kind: type[Struct], names: dict[str, Sequence[str]]) -> tuple[FieldColumns, ...]:
    """Return the fields of a message's table behind `t_ns` and `seq`.

    Args:
        kind: of the message.
        names: the names, or keys, that occur in each open field, in their order.
    """
    open_kinds = {each.name: each.field for each in open_fields(kind)}
    rest = [field for field in _fields(kind) if field.name not in HEAD and not _is_heading(kind, field.name)]
    return tuple(
        columns
        for field in rest
        for columns in _columns_of(field, open_kinds.get(field.name), names.get(field.name, ()))
    )


def table_name(kind: type[Struct]) -> str:
    """Return the name of a message's table: ClusterState is cluster_state, of a user's sensor it is sensor_NAME."""
    if sensor := sensor_of(kind):
        return f"sensor_{sensor}"
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", kind.__name__).lower()


def json_text(value: Any) -> str:
    """Return a value as JSON; a type that JSON does not have is written as its repr."""
    try:
        return msgspec.json.encode(value, enc_hook=repr).decode()
    except REFUSALS:  # keys that are no text, for instance
        return msgspec.json.encode(repr(value)).decode()


def _fields(kind: type[Struct]) -> Iterable[inspect.Field]:
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    return info.fields


def _is_heading(kind: type[Struct], name: str) -> bool:
    """Return whether a field only names the columns of others."""
    return name == "names" and any(each.field == "named" for each in open_fields(kind))


def _open_kind(kind: type[Struct], field: inspect.Field) -> Literal["named", "numbers", "pairs"] | None:
    info = field.type
    if isinstance(info, inspect.VarTupleType) and isinstance(info.item_type, _NUMERIC) and not info.min_length:
        return "named" if "names" in kind.__struct_fields__ else None
    if isinstance(info, inspect.DictType):
        value = info.value_type
        if isinstance(value, _NUMERIC):
            return "numbers"
        if isinstance(value, inspect.TupleType) and len(value.item_types) == len(COUNTS):
            return "pairs"
    return None


def _columns_of(field: inspect.Field, open_kind: str | None, names: Sequence[str]) -> list[FieldColumns]:
    name, info = field.name, _without_none(field.type)
    if open_kind:
        columns = NamedColumns(name, names) if open_kind == "named" else KeyedColumns(name, names, open_kind == "pairs")
        return [columns] if names else []
    if isinstance(info, inspect.IntType):
        return [IntegerColumn(name, "whole", (name,))]
    kinds: dict[type, Kind] = {
        inspect.FloatType: "number",
        inspect.BoolType: "flag",
        inspect.StrType: "text",
        inspect.LiteralType: "text",
    }
    if type(info) in kinds:
        return [FieldColumns(name, kinds[type(info)], (name,))]
    if components := _components(name, info):
        return [VectorColumns(name, "number", components)]
    if isinstance(info, inspect.StructType) and all(isinstance(part.type, _NUMERIC) for part in info.fields):
        return [PartColumn(name, part.name, "number") for part in info.fields]
    return [JsonColumn(name, "text", (name,))]


def _without_none(info: inspect.Type) -> inspect.Type:
    if not isinstance(info, inspect.UnionType):
        return info
    others = [each for each in info.types if not isinstance(each, inspect.NoneType)]
    return others[0] if len(others) == 1 else info


def _components(name: str, info: inspect.Type) -> list[str]:
    """Return the columns of a field with a fixed number of numbers, none for any other field."""
    if isinstance(info, inspect.VarTupleType) and info.min_length == info.max_length == 36:
        return [f"{name}_{i}{j}" for i in range(6) for j in range(6)]
    if isinstance(info, inspect.VarTupleType) and info.min_length == len(ROTORS):  # of more, the first four
        return [f"{name}_{part}" for part in ROTORS]
    if not isinstance(info, inspect.TupleType) or not all(isinstance(each, _NUMERIC) for each in info.item_types):
        return []
    count = len(info.item_types)
    if name.endswith(QUATERNION):
        return [f"{name.removesuffix(QUATERNION)}_{part}" for part in "wxyz"]
    parts = {3: XYZ}.get(count) or [str(i) for i in range(count)]
    return [f"{name}_{part}" for part in parts]


def _whole(value: int | None) -> int | None:
    return value if value is not None and -WHOLE_MAX <= value <= WHOLE_MAX else None


def _tidy(name: str) -> str:
    """Return a name as part of a column's: letters, digits and underscores."""
    return re.sub(r"\W", "_", name)
