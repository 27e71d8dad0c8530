"""What an operator types into the page, as requests: trajectories, waypoints, parameters of a fault. Pure."""

import re
from collections.abc import Collection
from typing import Any

from zsim.schema import yaml_file


class InputError(ValueError):
    """What was typed cannot be understood; the message says where and what is allowed."""


def parse_expressions(text: str, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the arguments of a trajectory of lines `variable = expression`; other names are constants.

    Raises:
        TypedError: a line is neither.
    """
    found: dict[str, str] = {}
    constants: dict[str, float] = {}
    for number, line in _lines(text):
        name, sign, value = (part.strip() for part in line.partition("="))
        if not sign or not name or not value:
            allowed = "VARIABLE = EXPRESSION, such as x_c = 5*cos(0.1*t)"
            raise InputError(f"line {number} is {line[:40]!r}; must be {allowed}")
        if name in names:
            found[name] = value
        else:
            constants[name] = _number(value, f"line {number}: {name} is no variable, and as a constant")
    if not found:
        raise InputError("trajectory is empty; must have a line VARIABLE = EXPRESSION at least")
    for name in constants:
        if not any(re.search(rf"\b{re.escape(name)}\b", expression) for expression in found.values()):
            raise InputError(f"{name} is no variable, nor used as a constant; variables are {', '.join(names)}")
    return {"expressions": found, "constants": constants}


def parse_waypoints(text: str) -> dict[str, Any]:
    """Return the arguments of a trajectory of lines `seconds: variable = value, …`.

    Raises:
        TypedError: a line is none.
    """
    found = []
    for number, line in _lines(text):
        at, colon, rest = line.partition(":")
        pairs = [pair.partition("=") for pair in rest.split(",")]
        if not colon or not all(name.strip() and sign for name, sign, _ in pairs):
            raise InputError(f"line {number} is {line[:40]!r}; must be SECONDS: VARIABLE = VALUE, VARIABLE = VALUE, …")
        values = {name.strip(): _number(value, f"line {number}: {name.strip()}") for name, _, value in pairs}
        found.append({"at_s": _number(at, f"line {number}: the time"), "values": values})
    if not found:
        raise InputError("waypoints are empty; must have a line SECONDS: VARIABLE = VALUE at least")
    return {"waypoints": found}


def parse_parameters(text: str, names: Collection[str]) -> dict[str, Any]:
    """Return a fault's own parameters, of `name: value, name: value`.

    Raises:
        TypedError: it is no such list, or names something that is not among `names`.
    """
    given, allowed = f"parameters are {text[:40]!r}", "must be NAME: VALUE, NAME: VALUE, …"
    try:
        found = yaml_file.value("{" + text + "}")
    except ValueError as error:
        raise InputError(f"{given}: {error}; {allowed}") from None
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found) or None in found.values():
        raise InputError(f"{given}; {allowed}")
    for name in found:
        if name not in names:
            raise InputError(f"{given}; {name[:40]!r} is not known, allowed: {', '.join(names)}")
    return found


def _lines(text: str) -> list[tuple[int, str]]:
    numbered = enumerate(text.splitlines(), start=1)
    return [(number, line.strip()) for number, line in numbered if line.strip() and not line.lstrip().startswith("#")]


def _number(text: str, what: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{what} is {text.strip()[:40]!r}; must be a number") from None
