"""Messages: field types, the fields common to all messages, and users' declarations.

Declarations name types independently of any programming language: number, number[3], number[], whole, flag, text.

    field_types(State, Message)  →  {"position_m": "number[3]", "leader": "flag"}
    declared_type("State", {"position_m": "number[3]", "leader": "flag"}, Message)

A process with the user's module uses its class; others create one with the same name and fields from `world/info`.
"""

import sys
from collections.abc import Collection, Mapping
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct
from msgspec import inspect as types

# Limits satisfied by every finite number but not by NaN and infinities, so that msgspec refuses these on decoding.
Number = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Whole = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Vector3 = tuple[Number, Number, Number]
COUNT_MAX = 16  # maximum length of a fixed-length field of numbers, such as a 4 x 4 matrix
TEXT_MAX = 10_000  # maximum number of characters in a text, or of numbers in a `number[]`
if TYPE_CHECKING:
    FieldType = str
else:
    SEVERAL = [f"number[{count}]" for count in range(1, COUNT_MAX + 1)]
    FieldType = Literal["number", "whole", "flag", "text", "number[]", *SEVERAL]
"""Type of a field: a finite number, a whole number, a flag, text, or a list of numbers of any or a fixed length."""
FieldName = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,31}\Z")]
MessageName = Annotated[str, Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,31}\Z")]
_TYPE_NAMES = {types.FloatType: "number", types.IntType: "whole", types.BoolType: "flag", types.StrType: "text"}
_TYPES: dict[str, Any] = {
    "number": Number,
    "whole": Whole,
    "flag": bool,
    "text": Annotated[str, Meta(max_length=TEXT_MAX)],
    "number[]": Annotated[tuple[Number, ...], Meta(max_length=TEXT_MAX)],
}


class Message(Struct, frozen=True, gc=False):
    """Base of all messages: the simulated time of publication, and a sequence number per key, from 0.

    A class may define a method `fault`, which returns a fault that types cannot express, or None.
    """

    t_ns: Count
    seq: Count


def field_types(message: type[Struct], base: type[Struct], but: Collection[str] = ()) -> dict[FieldName, FieldType]:
    """Return the types of a message's fields, except those of its base.

    Args:
        but: names of types that are not allowed.

    Raises:
        TypeError: a field has a type not allowed in users' messages.
    """
    info: Any = types.type_info(message)
    type_names: dict[str, Any] = {}
    for field in info.fields:
        if field.name in base.__struct_fields__:
            continue
        type_name = _type_name(field.type)
        if type_name is None or type_name in but:
            words_allowed = ("number", "tuple or list of numbers", "whole number", "bool", "text")
            allowed = ", ".join(each for each in words_allowed if each not in but)
            annotation = getattr(message, "__annotations__", {}).get(field.name, "another type")
            raise TypeError(f"{message.__name__}.{field.name} is {annotation!s:.60}; must be one of {allowed}")
        type_names[field.name] = type_name
    return type_names


def _type_name(kind: Any) -> FieldType | None:
    if isinstance(kind, types.Metadata):
        kind = kind.type
    if isinstance(kind, types.TupleType):
        numbers = all(isinstance(item, types.FloatType) for item in kind.item_types)
        return f"number[{len(kind.item_types)}]" if numbers and 1 <= len(kind.item_types) <= COUNT_MAX else None
    if isinstance(kind, types.VarTupleType | types.ListType):
        return "number[]" if isinstance(kind.item_type, types.FloatType) else None
    return _TYPE_NAMES.get(type(kind))


def declared_type(
    name: str, fields: Mapping[str, str], base: type[Struct], namespace: tuple[tuple[str, Any], ...] = ()
) -> Any:
    """Return a message class with these fields after those of its base; the same class for the same arguments.

    `namespace` gives further attributes of the class.
    """
    return _declared_type(name, tuple(fields.items()), base, namespace)


@cache
def _declared_type(
    name: str, fields: tuple[tuple[str, str], ...], base: type[Struct], namespace: tuple[tuple[str, Any], ...]
) -> Any:
    own: Any = [(field, _TYPES.get(kind) or tuple[(Number,) * int(kind[7:-1])]) for field, kind in fields]  # type: ignore[misc]
    return msgspec.defstruct(name, own, bases=(base,), namespace=dict(namespace), frozen=True, gc=False)
