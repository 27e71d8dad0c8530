"""Where a path leads in a scenario's document: the same place under whichever of its names."""

import re
from typing import Any

from zsim.scenario.overrides import steps_of

Place = tuple[str | int, ...]


def place(document: dict[str, Any], path: str) -> Place:
    """Return the steps to a field from the top; entries of lists count from 0, whether by index or by name.

    Args:
        document: raw, not changed; what is not in it is taken as it is written.
        path: as `--set` takes it.
    """
    steps: list[str | int] = []
    there: Any = document
    for text in steps_of(path):
        step = _entry(there, text) if isinstance(there, list) else text
        steps.append(step)
        there = _inside(there, step)
    return tuple(steps)


def inside(one: Place, other: Place) -> bool:
    """Tell whether one place is part of the other."""
    return len(one) > len(other) and one[: len(other)] == other


def _entry(entries: list[Any], text: str) -> str | int:
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in entries]
    if text in names:
        return names.index(text)
    return int(text) if re.fullmatch(r"[0-9]{1,9}", text) else text


def _inside(there: Any, step: str | int) -> Any:
    if isinstance(there, dict):
        return there.get(step)
    return there[step] if isinstance(there, list) and isinstance(step, int) and step < len(there) else None
