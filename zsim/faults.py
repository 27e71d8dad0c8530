"""Every fault of a document against a typed description, not only the first one.

msgspec stops at the first fault; a user who mends a scenario wants them all at once.
"""

import math
import re
from collections.abc import Iterator
from typing import Any

import msgspec
from msgspec import inspect as types


def faults(value: Any, description: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield (path, "is …; must be …") for every place where `value` does not fit the type `description`."""
    yield from _check(value, types.type_info(description), path)


def _check(value: Any, info: types.Type, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(info, types.Metadata):
        yield from _check(value, info.type, path)
    elif isinstance(info, types.UnionType):
        yield from _check_union(value, info, path)
    elif isinstance(info, types.StructType):
        yield from _check_struct(value, info, path)
    elif isinstance(info, types.ListType):
        yield from _check_list(value, info, path)
    elif isinstance(info, types.TupleType):
        yield from _check_tuple(value, info, path)
    elif isinstance(info, types.DictType):
        yield from _check_dict(value, info, path)
    else:
        fault = _scalar_fault(value, info)
        if fault:
            yield path, fault


def _check_union(value: Any, info: types.UnionType, path: str) -> Iterator[tuple[str, str]]:
    if value is None:
        if not info.includes_none:
            yield path, "is empty; must be given"
        return
    others = [option for option in info.types if not isinstance(option, types.NoneType)]
    found = [list(_check(value, option, path)) for option in others]
    if all(found):
        yield from min(found, key=len)


def _check_struct(value: Any, info: types.StructType, path: str) -> Iterator[tuple[str, str]]:
    if not isinstance(value, dict):
        yield path or "the document", f"is {_show(value)}; must be a map"
        return
    names = {entry.encode_name: entry for entry in info.fields}
    for key in value:
        if key not in names:
            yield _join(path, str(key)), f"is not known; allowed: {', '.join(sorted(names))}"
    for name, entry in names.items():
        if name in value:
            yield from _check(value[name], entry.type, _join(path, name))
        elif entry.required:
            yield _join(path, name), f"is missing; must be {_expected(entry.type)}"


def _check_list(value: Any, info: types.ListType, path: str) -> Iterator[tuple[str, str]]:
    if not isinstance(value, list | tuple):
        yield path, f"is {_show(value)}; must be a list"
        return
    if info.min_length and len(value) < info.min_length:
        yield path, f"has {len(value)} entries; must have at least {info.min_length}"
    if info.max_length and len(value) > info.max_length:
        yield path, f"has {len(value)} entries; must have at most {info.max_length}"
        return
    for index, item in enumerate(value):
        yield from _check(item, info.item_type, f"{path}[{index}]")


def _check_tuple(value: Any, info: types.TupleType, path: str) -> Iterator[tuple[str, str]]:
    if not isinstance(value, list | tuple) or len(value) != len(info.item_types):
        yield path, f"is {_show(value)}; must be a list of {len(info.item_types)} entries"
        return
    for index, (item, item_type) in enumerate(zip(value, info.item_types, strict=True)):
        yield from _check(item, item_type, f"{path}[{index}]")


def _check_dict(value: Any, info: types.DictType, path: str) -> Iterator[tuple[str, str]]:
    if not isinstance(value, dict):
        yield path, f"is {_show(value)}; must be a map"
        return
    for key, item in value.items():
        if not isinstance(key, str):
            yield _join(path, str(key)), "is a key that is not text; must be text"
        yield from _check(item, info.value_type, _join(path, str(key)))


def _scalar_fault(value: Any, info: types.Type) -> str | None:
    if isinstance(info, types.FloatType | types.IntType):
        return _number_fault(value, info)
    if isinstance(info, types.BoolType):
        return None if isinstance(value, bool) else f"is {_show(value)}; must be true or false"
    if isinstance(info, types.LiteralType):
        allowed = ", ".join(str(option) for option in info.values)
        return None if value in info.values else f"is {_show(value)}; must be one of {allowed}"
    if isinstance(info, types.StrType):
        return _text_fault(value, info)
    return None


def _number_fault(value: Any, info: types.FloatType | types.IntType) -> str | None:
    whole = isinstance(info, types.IntType)
    wanted = _expected(info)
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
        return f"is {_show(value)}; must be {wanted}"
    if not math.isfinite(value) or not _within(value, info):
        return f"is {_show(value)}; must be {wanted}"
    return None


def _within(value: float, info: types.FloatType | types.IntType) -> bool:
    return not (
        (info.gt is not None and value <= info.gt)
        or (info.ge is not None and value < info.ge)
        or (info.lt is not None and value >= info.lt)
        or (info.le is not None and value > info.le)
    )


def _text_fault(value: Any, info: types.StrType) -> str | None:
    if not isinstance(value, str):
        return f"is {_show(value)}; must be text"
    if info.pattern and not re.search(info.pattern, value):
        return f"is {_show(value)}; must match {info.pattern.strip('^$')}"
    return None


def _expected(info: types.Type) -> str:
    """Say in words what is allowed."""
    if isinstance(info, types.Metadata):
        return _expected(info.type)
    if not isinstance(info, types.FloatType | types.IntType):
        return {types.StrType: "text", types.ListType: "a list", types.StructType: "a map"}.get(
            type(info), "given"
        )
    signs = (("> ", info.gt), (">= ", info.ge), ("< ", info.lt), ("<= ", info.le))
    limits = [f"{sign}{limit:g}" for sign, limit in signs if limit is not None]
    kind = "a whole number" if isinstance(info, types.IntType) else "a finite number"
    return " and ".join(limits) if limits else kind


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _show(value: Any) -> str:
    """Show what was found, short enough for one line."""
    text = value if isinstance(value, str) else msgspec.json.encode(value, enc_hook=repr).decode()
    if isinstance(value, float):
        text = repr(value)
    text = repr(text) if isinstance(value, str) else text
    return text if len(text) <= 60 else text[:57] + "..."
