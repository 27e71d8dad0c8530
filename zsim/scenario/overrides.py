"""Overrides of a scenario document: texts `a.b.c=value`, entries of lists by place or by name."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, get_args

from msgspec import Struct, structs

from zsim.scenario.scenario import Document
from zsim.schema.checker import show, suggestion

SYNTAX = "a.b.c=value, e.g. drones.drone2.mass_kg=0.5 or environment.wind.gust_m_s=0.5"
PATH_MAX = 1000  # characters; the longest of a scenario has a tenth of that
NOTHING: Mapping[str, Any] = {}
_STEP = re.compile(r"([^.\[\]]+)|\[([^\[\]]+)\]")  # one step of a path: a word, or anything between brackets
_FIRST = re.compile(r"[^.\[\]]+")
_PATH = re.compile(r"([^.\[\]]+|\[[^\[\]]+\])(\.[^.\[\]]+|\[[^\[\]]+\])*")


def apply_override(document: dict[str, Any], text: str, parse: Callable[[str], Any]) -> str | None:
    """Apply one override to a raw document; return the fault if there is one, and then nothing has changed.

    Args:
        document: changed in place.
        text: as given, e.g. "drones[2].yaw_deg=90".
        parse: turns the text of a value into the value; its ValueError says what is wrong.
    """
    path, equals, value_text = text.partition("=")
    if len(path) > PATH_MAX:
        return f"{_shown_override(text)}: is a path of {len(path)} characters; must have at most {PATH_MAX}"
    if not equals or not _PATH.fullmatch(path):
        return f"{_shown_override(text)}: is no assignment; must be {SYNTAX}"
    try:
        _assign(document, steps_of(path, document), parse(value_text))
    except ValueError as error:
        return f"{_shown_override(text)}: {error}"
    return None


def steps_of(path: str, document: Mapping[str, Any] = NOTHING) -> list[str]:
    """Return the steps of a path from the top of a scenario: fields, and entries by place or by name.

    Arguments and errors as `whole_path`.
    """
    return [word or bracket for word, bracket in _STEP.findall(whole_path(path, document))]


def whole_path(path: str, document: Mapping[str, Any] = NOTHING) -> str:
    """Return the path of a field from the top of a scenario.

    The name of a section may be left out where only one section has such a field: wind.gust_m_s stands for
    environment.wind.gust_m_s. Of a list of sections it may be left out where the list has one entry:
    gains.proportional_1_s stands for clusters.main.gains.proportional_1_s.

    Args:
        path: as given.
        document: the scenario that is meant, raw.

    Raises:
        ValueError: the field is one of a list of sections, of which the document has several.
    """
    first = _FIRST.match(path)
    sections = {field.name: field for field in _fields(Document)}
    if first is None or first[0] in sections:
        return path
    owners = [name for name, field in sections.items() if first[0] in _field_names(field.type)]
    if owners:
        return f"{owners[0]}.{path}" if len(owners) == 1 else path
    lists = [name for name, field in sections.items() if any(first[0] in _field_names(each) for each in get_args(field.type))]
    return _in_entry(path, lists[0], document.get(lists[0])) if len(lists) == 1 else path


def _in_entry(path: str, section: str, entries: Any) -> str:
    """Return the path of a field of the one entry of a list, by its name if it has one."""
    if not isinstance(entries, list) or not entries:
        return path
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in entries]
    places = [f"{section}.{name}" if _is_step(name) else f"{section}[{place}]" for place, name in enumerate(names)]
    if len(places) > 1:
        raise ValueError(f"is a field of each of {len(places)} {section}; give the whole path, e.g. {places[0]}.{path}")
    return f"{places[0]}.{path}"


def _is_step(name: Any) -> bool:
    return isinstance(name, str) and _FIRST.fullmatch(name) is not None


def _field_names(kind: Any) -> list[str]:
    return [field.name for field in _fields(kind)]


@cache
def _fields(kind: Any) -> Sequence[Any]:
    """Return the fields of a section, none of any other type; a section may be one that need not be given."""
    sections = [each for each in (kind, *get_args(kind)) if isinstance(each, type) and issubclass(each, Struct)]
    return structs.fields(sections[0]) if sections else ()


def _assign(document: dict[str, Any], steps: list[str], value: Any) -> None:
    place: Any = document
    for depth, step in enumerate(steps[:-1]):
        place = _inside(place, step, steps[:depth])
    if isinstance(place, list):
        place[_index(place, steps[-1], steps[:-1])] = value
    elif isinstance(place, dict):
        place[steps[-1]] = value
    else:
        raise ValueError(f"{'.'.join(steps[:-1])} is {show(place)}; must be a map or a list")


def _inside(place: Any, step: str, path: list[str]) -> Any:
    """Return what stands at one step; a section that is not there, or empty, begins here."""
    if isinstance(place, list):
        return place[_index(place, step, path)]
    if not isinstance(place, dict):
        raise ValueError(f"{'.'.join(path)} is {show(place)}; must be a map or a list")
    if place.get(step) is None:
        place[step] = {}
    return place[step]


def _index(place: list[Any], step: str, path: list[str]) -> int:
    names = [item.get("name") if isinstance(item, dict) else None for item in place]
    if step in names:
        return names.index(step)
    if re.fullmatch(r"[0-9]{1,9}", step) and int(step) < len(place):
        return int(step)
    texts = [name for name in names if isinstance(name, str)]
    known = ", ".join(texts)
    allowed = f"0 to {len(place) - 1}{' or ' if known else ''}{known}" if place else "nothing, it is empty"
    raise ValueError(f"{step[:40]} is not in {'.'.join(path)}; {suggestion(step, texts)}allowed: {allowed}")


def _shown_override(text: str) -> str:
    return f"--set {text if len(text) <= 80 and text.isprintable() else show(text)}"
