"""Checks a document against a typed description and reports all faults, whereas msgspec stops at the first."""

import math
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from difflib import get_close_matches
from functools import lru_cache
from itertools import islice
from types import SimpleNamespace
from typing import Any, cast

import msgspec
from msgspec import inspect as types

from zsim.errors import DocumentError

SHOWN_MAX = 60  # maximum number of characters of a value shown in an error
FAULTS_MAX = 100  # maximum number of faults listed; further ones are only counted
COUNTED_MAX = 10_000  # maximum count of further faults: a document of 1 MB can have many more, and each takes time
NO_LIMITS = (sys.float_info.max, -sys.float_info.max, 2**63 - 1, -(2**63))  # type ranges, omitted from errors

Fault = tuple[str, str]  # (path, "is …; must be …"); the path of the document itself is empty


def faults(value: Any, description: Any, path: str = "") -> Iterator[Fault]:
    """Yield the path and text of every fault in `value`, checked against the type `description`."""
    yield from _check(value, _type_info(description), path)


def faults_in(error: DocumentError) -> list[Fault]:
    """Return the faults stated by the lines of an error."""
    return [(path, text) for path, _, text in (line.partition(" ") for line in error.faults)]


def first_fault(value: Any, description: Any) -> Fault | None:
    return next(faults(value, description), None)


def first_lines(lines: Iterable[str]) -> list[str]:
    """Return the first FAULTS_MAX lines, followed by a line with the number of further ones."""
    remaining = iter(lines)
    first = list(islice(remaining, FAULTS_MAX))
    further = sum(1 for _ in islice(remaining, COUNTED_MAX))
    return [*first, f"… and {'at least ' if further == COUNTED_MAX else ''}{further} more faults"] if further else first


def sound(value: Any, description: Any) -> Any:
    """Return the valid parts of a faulty document.

    Structs become namespaces with the same fields: given values, defaults, or None if missing or faulty. Lists keep
    their length. Valid values are returned unchanged.
    """
    return _sound(value, _type_info(description))


@lru_cache(maxsize=256)
def _type_info(description: Any) -> types.Type:
    return types.type_info(description)


def _check(value: Any, info: types.Type, path: str) -> Iterator[Fault]:
    if isinstance(info, types.Metadata):
        description = (info.extra_json_schema or {}).get("description")  # replaces the text derived from the type
        if description is None:
            yield from _check(value, info.type, path)
        elif any(_check(value, info.type, path)):
            yield path, f"is {show(value)}; must be {description}"
    elif isinstance(info, types.UnionType):
        others = [option for option in info.types if not isinstance(option, types.NoneType)]
        faults_of_each = [list(_check(value, option, path)) for option in others]
        if all(faults_of_each) and not (value is None and info.includes_none):
            yield from min(faults_of_each, key=len)
    elif isinstance(info, types.StructType):
        yield from _check_struct(value, info, path)
    elif isinstance(info, types.ListType | types.VarTupleType | types.DictType):
        yield from _check_many(value, info, path)
    elif isinstance(info, types.TupleType):
        if not isinstance(value, list | tuple) or len(value) != len(info.item_types):
            yield path, f"is {show(value)}; must be a list of {len(info.item_types)} entries"
            return
        for index, (item, item_type) in enumerate(zip(value, info.item_types, strict=True)):
            yield from _check(item, item_type, f"{path}[{index}]")
    elif fault := _scalar_fault(value, info):
        yield path, fault


def _check_struct(value: Any, info: types.StructType, path: str) -> Iterator[Fault]:
    if not isinstance(value, dict):
        yield path, f"is {show(value)}; must be a map"
        return
    names = {entry.encode_name: entry for entry in info.fields}
    for key in value if info.forbid_unknown_fields else ():
        if key not in names:
            allowed = f"{suggestion(key, names)}allowed: {', '.join(sorted(names))}"
            yield field_path(path, key), f"is not known; {allowed}"
    for name, entry in names.items():
        if name in value:
            yield from _check(value[name], entry.type, field_path(path, name))
        elif entry.required:
            yield field_path(path, name), f"is missing; must be {_expected(entry.type)}"


def _check_many(value: Any, info: types.ListType | types.VarTupleType | types.DictType, path: str) -> Iterator[Fault]:
    is_map = isinstance(info, types.DictType)
    if not isinstance(value, dict if is_map else list | tuple):
        yield path, f"is {show(value)}; must be a {'map' if is_map else 'list'}"
        return
    low, high = info.min_length or 0, info.max_length
    if len(value) < low or (high is not None and len(value) > high):
        length = f"at least {low}" if high is None else f"{high}" if low == high else f"{low} to {high}"
        yield path, f"has {len(value)} entries; must have {length}"
    if len(value) > (high or len(value)):
        return
    if isinstance(info, types.DictType):
        for key, item in cast("dict[Any, Any]", value).items():
            where = field_path(path, key)
            yield from ((at, f"as a key {text}") for at, text in _check(key, info.key_type, where))
            yield from _check(item, info.value_type, where)
    else:
        for index, item in enumerate(value):
            yield from _check(item, info.item_type, f"{path}[{index}]")


def _scalar_fault(value: Any, info: types.Type) -> str | None:
    allowed: str | None = None
    if isinstance(info, types.FloatType | types.IntType):
        is_integer = isinstance(info, types.IntType)
        is_number = isinstance(value, int if is_integer else int | float) and not isinstance(value, bool)
        if not is_number or (isinstance(value, float) and not math.isfinite(value)):
            allowed = _expected(info)
        elif not (
            (info.gt is None or value > info.gt)
            and (info.ge is None or value >= info.ge)
            and (info.lt is None or value < info.lt)
            and (info.le is None or value <= info.le)
        ):
            is_too_wide = is_integer and not -(2**63) <= value < 2**63
            allowed = "a signed 64-bit whole number" if is_too_wide else _limits(info)
    elif isinstance(info, types.LiteralType):
        allowed = _expected(info) if value not in info.values else None
    elif isinstance(info, types.BoolType | types.BytesType | types.StrType):
        kind = {types.BoolType: bool, types.BytesType: bytes, types.StrType: str}[type(info)]
        if not isinstance(value, kind):
            allowed = _expected(info)
        elif isinstance(info, types.StrType) and info.pattern and not re.search(info.pattern, value):
            return f"is {show(value)}; must match {info.pattern.strip('^$').removesuffix(chr(92) + 'Z')}"
    return None if allowed is None else f"is {show(value)}; must be {allowed}"


def _expected(info: types.Type) -> str:
    if isinstance(info, types.Metadata):
        return _expected(info.type)
    if isinstance(info, types.FloatType | types.IntType):
        kind = "a whole number" if isinstance(info, types.IntType) else "a finite number"
        return f"{kind} {_limits(info)}".rstrip()
    if isinstance(info, types.TupleType):
        return f"a list of {len(info.item_types)} entries"
    if isinstance(info, types.LiteralType):
        return f"one of {', '.join(str(option) for option in info.values)}"
    phrases = {
        types.StrType: "text",
        types.BytesType: "bytes",
        types.BoolType: "true or false",
        types.ListType: "a list",
        types.VarTupleType: "a list",
        types.StructType: "a map",
        types.DictType: "a map",
    }
    return phrases.get(type(info), "given")


def _limits(info: types.FloatType | types.IntType) -> str:
    signs = ((">", info.gt), (">=", info.ge), ("<", info.lt), ("<=", info.le))
    stated = [(sign, limit) for sign, limit in signs if limit is not None and limit not in NO_LIMITS]
    return " and ".join(f"{sign} {limit if isinstance(limit, int) else f'{limit:g}'}" for sign, limit in stated)


def _sound(value: Any, info: types.Type) -> Any:
    if isinstance(info, types.Metadata):
        return _sound(value, info.type)
    if isinstance(info, types.UnionType) and value is not None:
        others = [option for option in info.types if not isinstance(option, types.NoneType)]
        fitting = (option for option in others if not any(_check(value, option, "")))
        return _sound(value, next(fitting, others[0]))
    if isinstance(info, types.StructType):
        if not isinstance(value, dict):
            return None
        sound_parts = {}
        for entry in info.fields:
            if entry.encode_name in value:
                sound_parts[entry.name] = _sound(value[entry.encode_name], entry.type)
            elif entry.default_factory is not msgspec.NODEFAULT:
                sound_parts[entry.name] = entry.default_factory()
            else:
                sound_parts[entry.name] = None if entry.default is msgspec.NODEFAULT else entry.default
        return SimpleNamespace(**sound_parts)
    if isinstance(info, types.ListType):
        if not isinstance(value, list | tuple) or len(value) > (info.max_length or len(value)):
            return None
        return [_sound(item, info.item_type) for item in value]
    if isinstance(info, types.DictType) and isinstance(info.value_type, types.StructType) and isinstance(value, dict):
        return {key: _sound(item, info.value_type) for key, item in value.items()}
    return None if any(_check(value, info, "")) else value


def suggestion(name: Any, known: Iterable[str]) -> str:
    """Return "did you mean NAME? " with the known name most similar to an unknown one; "" if none is similar."""
    close = get_close_matches(str(name)[:SHOWN_MAX], known, 1)
    return f"did you mean {close[0]}? " if close else ""


def field_path(path: str, name: Any) -> str:
    """Return the path of a field within another, printable and short whatever the name."""
    text = str(name)
    text = text if text.isprintable() and len(text) <= SHOWN_MAX else show(text)
    return f"{path}.{text}" if path else text


def show(value: Any) -> str:
    if isinstance(value, dict | list | tuple | set) and len(value) > SHOWN_MAX:
        return f"{'a map' if isinstance(value, dict) else 'a list'} of {len(value)} entries"
    try:
        text = repr(value) if isinstance(value, str | bytes | float) else _as_json(value)
    except ValueError:
        text = "a number of more than 4300 digits"  # CPython refuses to convert it
    except RecursionError:
        text = f"a {'map' if isinstance(value, dict) else 'list'} nested too deeply"
    return text if len(text) <= SHOWN_MAX else f"{text[: SHOWN_MAX - 3]}..."


def _as_json(value: Any) -> str:
    """Return a value as text in the style of JSON, with NaN and infinities by name."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_as_json(key)}: {_as_json(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_as_json, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return repr(value) if isinstance(value, int | float | str) else " ".join(repr(value).split())


def listed(names: Sequence[str]) -> str:
    return ", ".join(names[:20]) + (f", … ({len(names)})" if len(names) > 20 else "")
