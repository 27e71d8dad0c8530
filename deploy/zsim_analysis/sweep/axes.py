"""What varies from run to run: a seed for each, values of a field in turn, or values drawn for each run."""

import itertools
import json
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec import Struct

from zsim.math.random_streams import stream
from zsim.scenario.overrides import whole_path
from zsim.schema import yaml_file
from zsim.schema.checker import show

SEED = "seed"
SEEDS = 2**32  # drawn below it: ten digits that a person can type
SYNTAX = "seed, a.b.c=v1,v2,… or a.b.c=uniform(low,high) or a.b.c=normal(mean,std)"
_DRAWN = re.compile(r"\s*([a-z]+)\((.*)\)\s*")


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
    if not (math.isfinite(first) and math.isfinite(second) and 0 < span < math.inf):
        need = "low < high, high - low finite too" if kind == "uniform" else "std > 0"
        raise ValueError(f"has {kind}({given[:40]}); must be finite numbers with {need}")
    return Draw(path, kind, first, second)


def text_of(value: Any) -> str:
    """Return a value as `--set` takes it, in one line."""
    return value if isinstance(value, str) else json.dumps(value, default=str)
