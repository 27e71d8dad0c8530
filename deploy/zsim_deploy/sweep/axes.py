"""What varies from run to run: a seed for each, values of a field in turn, or values drawn for each run."""

import itertools
import json
import math
import re
from collections.abc import Callable, Sequence
from typing import Any, get_args

import numpy as np
from msgspec import Struct, structs

from zsim import yaml_file
from zsim.faults import show
from zsim.scenario import Document
from zsim.streams import stream

SEED = "seed"
SEEDS = 2**32  # drawn below it: ten digits that a person can type
SYNTAX = "seed, a.b.c=v1,v2,… or a.b.c=uniform(low,high) or a.b.c=normal(mean,std)"
_DRAWN = re.compile(r"\s*([a-z]+)\((.*)\)\s*")
_FIRST = re.compile(r"[^.\[\]]+")


class Seeds(Struct, frozen=True):
    """A distinct seed for every run."""

    path: str = SEED

    def draw(self, seed: int, count: int) -> list[int]:
        """Return the seeds of the first runs of a scenario's seed; more runs leave the earlier ones as they are."""
        rng = stream(seed, "sweep/seed")
        found: dict[int, None] = {}
        while len(found) < count:
            found[int(rng.integers(SEEDS))] = None
        return list(found)


class Grid(Struct, frozen=True):
    """Values of a field, each flown equally often."""

    path: str
    values: tuple[Any, ...]


class Draw(Struct, frozen=True):
    """Values of a field drawn anew for every run: uniform from low to high, or normal of mean and std."""

    path: str
    kind: str
    first: float
    second: float

    def draw(self, seed: int, count: int) -> list[float]:
        """Return the values of the first runs; each field has a stream of its own."""
        rng = stream(seed, f"sweep/{self.path}")
        of_kind: dict[str, Callable[..., np.ndarray]] = {"uniform": rng.uniform, "normal": rng.normal}
        return of_kind[self.kind](self.first, self.second, count).tolist()


Axis = Seeds | Grid | Draw


def parse(text: str) -> Axis:
    """Return the axis that a text of `--vary` says.

    Raises:
        ValueError: what is wrong with it.
    """
    path, equals, given = text.partition("=")
    if text.strip() == SEED:
        return Seeds()
    if not equals or not path.strip():
        raise ValueError(f"is no variation; must be {SYNTAX}")
    path = whole_path(path.strip())
    drawn = _DRAWN.fullmatch(given)
    return _draw(path, drawn[1], drawn[2]) if drawn else Grid(path, _values(given))


def whole_path(path: str) -> str:
    """Return the path of a field from the top of a scenario.

    The name of a section may be left out where only one section has such a field: wind.gust_m_s stands for
    environment.wind.gust_m_s.
    """
    first = _FIRST.match(path)
    sections = {field.name: field for field in _fields(Document)}
    if first is None or first[0] in sections:
        return path
    owners = [name for name, field in sections.items() if any(f.name == first[0] for f in _fields(field.type))]
    return f"{owners[0]}.{path}" if len(owners) == 1 else path


def _fields(kind: Any) -> Sequence[Any]:
    """Return the fields of a section, none of any other type; a section may be one that need not be given."""
    sections = [each for each in (kind, *get_args(kind)) if isinstance(each, type) and issubclass(each, Struct)]
    return structs.fields(sections[0]) if sections else ()


def _values(given: str) -> tuple[Any, ...]:
    try:
        values = yaml_file.value(f"[{given}]")
    except ValueError as error:
        raise ValueError(f"{error}; must be {SYNTAX}") from error
    if not values:
        raise ValueError(f"gives no value; must be {SYNTAX}")
    for a, b in itertools.combinations(values, 2):
        if a == b and isinstance(a, bool) == isinstance(b, bool):
            raise ValueError(f"gives {show(a)} twice; every value once")
    return tuple(values)


def _draw(path: str, kind: str, given: str) -> Draw:
    if kind not in ("uniform", "normal"):
        raise ValueError(f"draws by {kind}; must be uniform(low,high) or normal(mean,std)")
    try:
        first, second = (float(part) for part in given.split(","))
    except ValueError:
        raise ValueError(f"has {kind}({given[:40]}); must hold two numbers") from None
    span = second - first if kind == "uniform" else second
    if not (math.isfinite(first) and math.isfinite(second) and span > 0):
        need = "low < high" if kind == "uniform" else "std > 0"
        raise ValueError(f"has {kind}({given[:40]}); must be finite numbers with {need}")
    return Draw(path, kind, first, second)


def text_of(value: Any) -> str:
    """Return a value as `--set` takes it, in one line."""
    return value if isinstance(value, str) else json.dumps(value, default=str)
