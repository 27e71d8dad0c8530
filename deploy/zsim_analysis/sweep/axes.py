"""What varies from run to run: seeds, values of a field in turn, or values drawn for each run."""

import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_type_hints

import numpy as np
from msgspec import Struct

from zsim.math.random_streams import stream
from zsim.scenario.scenario import Scenario
from zsim.scenario.scenario_file import NOTHING, steps_of, whole_path
from zsim.schema import yaml_file
from zsim.schema.checker import first_fault, show

SEED = "seed"
SHOWN_MAX = 24  # characters of a value in a table or figure
SEEDS = 2**32  # drawn below it: ten digits that a person can type
SYNTAX = "seed, seed=paired, a.b.c=v1,v2,… or a.b.c=uniform(low,high) or a.b.c=normal(mean,std)"
PAIRED = "paired"
FieldPath = tuple[str | int, ...]  # steps to a field of a scenario from the top
_SEED_TYPE = get_type_hints(Scenario, include_extras=True)[SEED]
_DRAWN = re.compile(r"\s*([a-z]+)\((.*)\)\s*")


class Seeds(Struct, frozen=True):
    """A distinct seed for every run, or, paired, for every run of a combination: all combinations have the same ones.

    Attributes:
        paired: with the seed, values that are drawn are the same for all combinations, too.
        values: the seeds; none: they are drawn from the scenario's own.
    """

    path: str = SEED
    paired: bool = False
    values: tuple[int, ...] = ()

    def draw(self, seed: int, count: int) -> list[int]:
        """Return the first seeds of a scenario's seed; more of them leave the earlier ones as they are."""
        if self.values:
            return list(self.values[:count])
        rng = stream(seed, "sweep/seed")
        seeds: dict[int, None] = {}
        while len(seeds) < count:
            seeds[int(rng.integers(SEEDS))] = None
        return list(seeds)


class Grid(Struct, frozen=True):
    """Values of a field, each flown equally often."""

    path: str
    values: tuple[Any, ...]

    @property
    def names(self) -> list[str]:
        """Return the values in short, no two of them alike."""
        return _distinct(self.values)


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


def parse(text: str, document: Mapping[str, Any] = NOTHING) -> Axis:
    """Return the axis of a text of `--vary`, for a raw document.

    Raises:
        ValueError: it is not of the form of SYNTAX, or its path has several meanings.
    """
    path, equals, values = text.partition("=")
    if text.strip() == SEED:
        return Seeds()
    if not equals or not path.strip():
        raise ValueError(f"is no variation; must be {SYNTAX}")
    path = whole_path(path.strip(), document)
    if path == SEED:
        return Seeds(paired=True, values=_seeds(values))
    drawn = _DRAWN.fullmatch(values)
    return _draw(path, drawn[1], drawn[2]) if drawn else Grid(path, _grid_values(values))


def _seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of a text, none where they are to be drawn."""
    if text.strip() == PAIRED:
        return ()
    seeds = _grid_values(text)
    for seed in seeds:
        if fault := first_fault(seed, _SEED_TYPE):
            raise ValueError(f"{fault[1]}; or give seed={PAIRED}, which draws them")
    return seeds


def _grid_values(text: str) -> tuple[Any, ...]:
    try:
        values = yaml_file.value(f"[{text}]")
    except ValueError as error:
        raise ValueError(f"{error}; must be {SYNTAX}") from error
    if not values:
        raise ValueError(f"gives no value; must be {SYNTAX}")
    for a, b in itertools.combinations(values, 2):
        if a == b and isinstance(a, bool) == isinstance(b, bool):
            raise ValueError(f"gives {show(a)} twice; every value once")
    return tuple(values)


def _draw(path: str, kind: str, arguments: str) -> Draw:
    if kind not in ("uniform", "normal"):
        raise ValueError(f"draws by {kind}; must be uniform(low,high) or normal(mean,std)")
    try:
        first, second = (float(part) for part in arguments.split(","))
    except ValueError:
        raise ValueError(f"has {kind}({arguments[:40]}); must hold two numbers") from None
    span = second - first if kind == "uniform" else second
    if not (math.isfinite(first) and math.isfinite(second) and 0 < span < math.inf):
        need = "low < high, high - low finite too" if kind == "uniform" else "std > 0"
        raise ValueError(f"has {kind}({arguments[:40]}); must be finite numbers with {need}")
    return Draw(path, kind, first, second)


def text_of(value: Any) -> str:
    """Return a value as `--set` takes it, in one line."""
    return value if isinstance(value, str) else json.dumps(value, default=str)


def shown(value: Any) -> str:
    """Return a value in short, for tables and figures."""
    text = f"{value:g}" if isinstance(value, float) else text_of(value)
    return _cut(text)


def _distinct(values: Sequence[Any]) -> list[str]:
    """Return values in short; of those that are cut to the same text the part that differs, else their place too."""
    names = [shown(value) for value in values]
    for short in [name for name, count in Counter(names).items() if count > 1]:
        alike = [place for place, name in enumerate(names) if name == short]
        parts = _differing([text_of(values[place]) for place in alike])
        others = {name for name in names if name != short}
        is_distinct = len({*parts, *others}) == len(parts) + len(others)
        for place, part in zip(alike, parts, strict=True):
            names[place] = part if is_distinct else f"{short} ({place + 1})"
    return names


def _differing(texts: Sequence[str]) -> list[str]:
    """Return what texts have from the word on that is not the same in all of them, cut; short ones are whole."""
    if all(len(text) <= SHOWN_MAX for text in texts):
        return list(texts)
    letters = enumerate(zip(*texts, strict=False))
    whole = next((place for place, each in letters if len(set(each)) > 1), min(map(len, texts)))
    start = max(texts[0].rfind(mark, 0, whole) for mark in " ,[{:") + 1
    return [_cut(f"…{text[start:]}" if start else text) for text in texts]


def _cut(text: str) -> str:
    return text if len(text) <= SHOWN_MAX else f"{text[: SHOWN_MAX - 1]}…"


def field_path(document: dict[str, Any], path: str) -> FieldPath:
    """Return the steps to a field from the top; entries of lists count from 0, whether by index or by name.

    Args:
        document: raw, not changed; steps to fields that it does not have are kept as text.
        path: as `--set` takes it.
    """
    steps: list[str | int] = []
    value: Any = document
    for text in steps_of(path):
        step = _entry(value, text) if isinstance(value, list) else text
        steps.append(step)
        value = _value_at(value, step)
    return tuple(steps)


def is_inside(one: FieldPath, other: FieldPath) -> bool:
    """Return whether one field is part of the other."""
    return len(one) > len(other) and one[: len(other)] == other


def _entry(entries: list[Any], text: str) -> str | int:
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in entries]
    if text in names:
        return names.index(text)
    return int(text) if re.fullmatch(r"[0-9]{1,9}", text) else text


def _value_at(value: Any, step: str | int) -> Any:
    if isinstance(value, dict):
        return value.get(step)
    return value[step] if isinstance(value, list) and isinstance(step, int) and step < len(value) else None
