"""The plan of a sweep, and its design: the axes that vary, and the values and scenario of each run.

An axis is seeds, a list of values of a field, or values drawn for each run. The combinations of all listed values are
the points of the grid.
"""

import copy
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any, get_type_hints

import msgspec
from msgspec import Struct

from zsim import __version__
from zsim.errors import DocumentError, ScenarioError
from zsim.math.randomness import stream
from zsim.scenario import scenario_file
from zsim.scenario.roles import check_alone, check_pace
from zsim.scenario.scenario import Scenario
from zsim.scenario.scenario_file import EXAMPLE, NOTHING, full_path, steps_of
from zsim.schema import plugin, yaml_file
from zsim.schema.checker import first_fault, first_lines, show
from zsim_agents.hosting import check_classes

PLAN = "plan.json"
METRICS = "report.metrics"  # field that names the user's functions for metrics of a run
RUNS_MAX = 1_000_000
SEED = "seed"
SHOWN_MAX = 24  # maximum number of characters of a value in a table or figure
SEEDS = 2**32  # drawn seeds are below this: at most ten digits
SYNTAX = "seed, seed=paired, a.b.c=v1,v2,… or a.b.c=uniform(low,high) or a.b.c=normal(mean,std)"
PAIRED = "paired"
FieldPath = tuple[str | int, ...]  # steps to a field of a scenario from the top
_SEED_TYPE = get_type_hints(Scenario, include_extras=True)[SEED]
_DEFAULT_SEED: int = next(f.default for f in msgspec.structs.fields(Scenario) if f.name == SEED)
_DRAWN = re.compile(r"\s*([a-z]+)\((.*)\)\s*")
_VALUE = re.compile(r" is [^;]*")  # the part of a fault that differs from run to run if values are drawn


class SweepPlan(Struct, frozen=True, kw_only=True):
    """A scenario and its variations: the same plan gives the same runs, on any host and in any order."""

    source: str  # name of the scenario's file, for messages
    document: dict[str, Any]  # the file with the overrides of the command line, presets not yet expanded
    vary: tuple[str, ...]  # texts of `--vary`, in their order
    runs: int  # number of runs; a plan with more runs begins with the same ones
    records: bool = False  # whether every run keeps its record
    changed: tuple[str, ...] | None = None  # overrides `a.b.c=value` of the command line; None: not known
    version: str = __version__  # version of zsim; other versions may give different results


def difference(old: SweepPlan, new: SweepPlan) -> str | None:
    """Return how two plans differ; None if `new` continues `old`."""
    if old.version != new.version:
        return f"it was started by zsim {old.version}, this is {new.version}"
    if old.document != new.document:
        keys = sorted(old.document.keys() | new.document.keys())
        other = next(key for key in keys if old.document.get(key) != new.document.get(key))
        return f"its scenario has a different {other}"
    fields = []  # for each plan: values by path from the top of the scenario
    for plan in (old, new):
        parts = [text.partition("=") for text in plan.vary]
        fields.append({full_path(path.strip(), plan.document): values for path, _, values in parts})
    if SEED in fields[0] and fields[1].get(SEED, "").startswith(f"{fields[0][SEED]},"):
        fields[1][SEED] = fields[0][SEED]  # the same seeds, followed by further ones
    if list(fields[0].items()) != list(fields[1].items()):
        return f"it varies {' '.join(old.vary) or 'nothing'}, not {' '.join(new.vary) or 'nothing'}"
    if old.records != new.records:
        return f"it {'keeps' if old.records else 'does not keep'} records"
    if new.runs < old.runs:
        return f"it has {old.runs} runs, more than {new.runs}"
    return None


def is_sweep(folder: Path) -> bool:
    return (folder / PLAN).is_file()


# Axes


class Seeds(Struct, frozen=True):
    """A distinct seed for every run or, if paired, for every run of a combination, the same in every combination."""

    path: str = SEED
    paired: bool = False  # whether all combinations have the same seeds, and the same drawn values
    values: tuple[int, ...] = ()  # empty: drawn with the scenario's seed

    def draw(self, seed: int, count: int) -> list[int]:
        """Return the first `count` seeds, drawn with a scenario's seed; a larger count begins with the same ones."""
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
        """Abbreviated values; those with equal abbreviations are shown by their differing part, or numbered."""
        texts = [f"{value:g}" if isinstance(value, float) else text_of(value) for value in self.values]
        generated = {index: without_made(text) for index, text in enumerate(texts) if text.startswith(plugin.MADE)}
        names = [*map(_cut, distinct(texts, generated))]
        for abbreviated in [name for name, frequency in Counter(names).items() if frequency > 1]:
            indices = [index for index, name in enumerate(names) if name == abbreviated]
            texts = parts = [text_of(self.values[index]) for index in indices]
            if any(len(text) > SHOWN_MAX for text in texts):  # show them from the first word that differs
                letters = enumerate(zip(*texts, strict=False))
                common = next(
                    (index for index, letters_at in letters if len(set(letters_at)) > 1), min(map(len, texts))
                )
                start = max(texts[0].rfind(mark, 0, common) for mark in " ,[{:") + 1
                parts = [_cut(f"…{text[start:]}" if start else text) for text in texts]
            others = {name for name in names if name != abbreviated}
            is_distinct = len({*parts, *others}) == len(parts) + len(others)
            for index, part in zip(indices, parts, strict=True):
                names[index] = part if is_distinct else f"{abbreviated} ({index + 1})"
        return names


class Draw(Struct, frozen=True):
    """Values of a field drawn for every run: uniform in [low, high], or normal with mean and std."""

    path: str
    kind: str
    first: float
    second: float

    def draw(self, seed: int, count: int) -> list[float]:
        """Return the values of the first `count` runs; each field has its own random stream."""
        rng = stream(seed, f"sweep/{self.path}")
        draw = rng.uniform if self.kind == "uniform" else rng.normal
        return draw(self.first, self.second, count).tolist()


Axis = Seeds | Grid | Draw


def parse(text: str, document: Mapping[str, Any] = NOTHING) -> Axis:
    """Parse a text of `--vary`, for a raw document.

    Raises:
        ValueError: it does not match SYNTAX, or its path is ambiguous.
    """
    path, equals, values = text.partition("=")
    if text.strip() == SEED:
        return Seeds()
    if not equals or not path.strip():
        raise ValueError(f"is not a variation; must be {SYNTAX}")
    path = full_path(path.strip(), document)
    if path == SEED and values.strip() == PAIRED:
        return Seeds(paired=True)
    if path == SEED:
        seeds = _grid_values(values)
        for seed in seeds:
            if fault := first_fault(seed, _SEED_TYPE):
                raise ValueError(f"{fault[1]}; or give seed={PAIRED}, which draws them")
        return Seeds(paired=True, values=seeds)
    if (drawn := _DRAWN.fullmatch(values)) is None:
        return Grid(path, _grid_values(values))
    kind, arguments = drawn[1], drawn[2]
    if kind not in ("uniform", "normal"):
        raise ValueError(f"draws from {kind}; must be uniform(low,high) or normal(mean,std)")
    try:
        first, second = (float(part) for part in arguments.split(","))
    except ValueError:
        raise ValueError(f"has {kind}({arguments[:40]}); must hold two numbers") from None
    span = second - first if kind == "uniform" else second
    if not (math.isfinite(first) and math.isfinite(second) and 0 < span < math.inf):
        need = "low < high and a finite difference" if kind == "uniform" else "std > 0"
        raise ValueError(f"has {kind}({arguments[:40]}); must be finite numbers with {need}")
    return Draw(path, kind, first, second)


def _grid_values(text: str) -> tuple[Any, ...]:
    try:
        values = yaml_file.value(f"[{text}]")
    except ValueError as error:
        raise ValueError(f"{error}; must be {SYNTAX}") from error
    if not values:
        raise ValueError(f"gives no value; must be {SYNTAX}")
    known: dict[tuple[bool, Any], Any] = {}
    for value in values:
        each = isinstance(value, bool), json.dumps(value) if isinstance(value, list | dict) else value
        if each in known:
            raise ValueError(f"gives {show(known[each])} twice; give every value once")
        known[each] = value
    return tuple(values)


def text_of(value: Any) -> str:
    """Format a value on one line, as `--set` takes it."""
    return value if isinstance(value, str) else json.dumps(value, default=str)


def without_made(value: Any) -> str:
    """Format a value; the name of a notebook's or script's class is given without its generated module."""
    text = text_of(value)
    return text.partition(":")[2] if text.startswith(plugin.MADE) else text


def distinct(texts: Sequence[str], generated: Mapping[int, str]) -> list[str]:
    """Return `texts` with those of `generated` at their indices, numbered if already in use, as in `Law-2`.

    Classes that one function creates all have the same name.
    """
    result = [*texts]
    used = {text for index, text in enumerate(texts) if index not in generated}
    for index, name in generated.items():
        numbered = (f"{name}-{number}" if number > 1 else name for number in count(1))
        result[index] = next(each for each in numbered if each not in used)
        used.add(result[index])
    return result


def _cut(text: str) -> str:
    return text if len(text) <= SHOWN_MAX else f"{text[: SHOWN_MAX - 1]}…"


def field_path(document: dict[str, Any], path: str) -> FieldPath:
    """Return the steps to a field from the top; entries of lists, given by index or name, become indices from 0.

    Steps to fields that are missing in the raw document are kept as text.
    """
    steps: list[str | int] = []
    value: Any = document
    for text in steps_of(path):
        step: str | int = text
        if isinstance(value, list):
            names = [entry.get("name") if isinstance(entry, dict) else None for entry in value]
            if text in names:
                step = names.index(text)
            elif re.fullmatch(r"[0-9]{1,9}", text):
                step = int(text)
            value = value[step] if isinstance(step, int) and step < len(value) else None
        else:
            value = value.get(step) if isinstance(value, dict) else None
        steps.append(step)
    return tuple(steps)


def is_inside(one: FieldPath, other: FieldPath) -> bool:
    return len(one) > len(other) and one[: len(other)] == other


# Design


class SweepDesign:
    """The runs of a plan; runs and points (combinations of the grid's values) are numbered from 0.

    Run i flies point i modulo the number of points. `seeds` is the axis of seeds; if None, all runs have the scenario's
    seed. If `paired`, the n-th runs of all points have the same seed.
    """

    def __init__(self, plan: SweepPlan) -> None:
        self.plan = plan
        self.axes: list[Axis] = [parse(text, plan.document) for text in plan.vary]
        self._grids = [axis for axis in self.axes if isinstance(axis, Grid)]
        self._names = {grid.path: grid.names for grid in self._grids}
        self.points = math.prod(len(grid.values) for grid in self._grids)
        self.seeds = next((axis for axis in self.axes if isinstance(axis, Seeds)), None)
        self.paired = self.seeds is not None and self.seeds.paired

    @property
    def seed(self) -> int:
        """The scenario's seed, with which seeds and values are drawn; the default seed if it is missing or invalid."""
        seed = self.plan.document.get(SEED)
        return seed if isinstance(seed, int) and seed >= 0 else _DEFAULT_SEED

    @property
    def varied(self) -> list[str]:
        """The varied paths, without the seed."""
        return [axis.path for axis in self.axes if axis.path != SEED]

    def point(self, run: int) -> int:
        return run % self.points

    def point_values(self, point: int) -> dict[str, Any]:
        """Return the values of a point by path; the last axis changes fastest."""
        return {grid.path: grid.values[index] for grid, index in self._indices(point)}

    def names(self, point: int) -> dict[str, str]:
        return {grid.path: self._names[grid.path][index] for grid, index in self._indices(point)}

    def _indices(self, point: int) -> list[tuple[Grid, int]]:
        indices = []
        for grid in reversed(self._grids):
            point, index = divmod(point, len(grid.values))
            indices.append((grid, index))
        return indices[::-1]

    def values(self, run: int) -> dict[str, Any]:
        """Return the values that a run sets, by path, in the order of the axes."""
        point_values, draw_index = self.point_values(self.point(run)), run // self.points if self.paired else run
        return {
            axis.path: point_values[axis.path] if axis.path in point_values else self._drawn[axis.path][draw_index]
            for axis in self.axes
        }

    @cached_property
    def _drawn(self) -> dict[str, list[Any]]:
        drawn_axes = [axis for axis in self.axes if not isinstance(axis, Grid)]
        count = -(-self.plan.runs // self.points) if self.paired else self.plan.runs
        return {axis.path: axis.draw(self.seed, count) for axis in drawn_axes}

    def scenario(self, run: int) -> Scenario:
        """Return the resolved scenario of a run, which flies in lockstep.

        Raises:
            ScenarioError: the scenario is invalid; one line per fault.
        """
        document, faults = copy.deepcopy(self.plan.document), []
        for path, value in self.values(run).items():
            fault = scenario_file.apply_override(
                document, f"{path}={text_of(value)}", lambda _, value=value: copy.deepcopy(value)
            )
            faults += [f"--vary {fault.removeprefix('--set ')}"] if fault else []
        try:
            scenario = scenario_file.resolve(document, self.plan.source)
        except ScenarioError as error:
            raise ScenarioError([*faults, *error.faults]) from error
        if faults:
            raise ScenarioError(faults)
        check_classes(scenario, self.plan.source)
        for name in scenario.report.metric_names:
            try:
                plugin.load_function(name, f"{self.plan.source}: {METRICS}")
            except DocumentError as error:
                raise ScenarioError(error.faults) from error
        check_pace(scenario, "lockstep")
        check_alone(scenario)
        return scenario

    def faults(self, progress: Callable[[int, int], None] = lambda run, total: None) -> list[str]:
        """Return the faults of all combinations: of each point of the grid, or of each run if values are drawn."""
        is_drawn = any(isinstance(axis, Draw) for axis in self.axes)
        checked = self.plan.runs if is_drawn else min(self.plan.runs, self.points)
        runs_of: dict[str, tuple[str, list[int]]] = {}
        for run in range(checked):
            progress(run, checked)
            for fault in _faults(self.scenario, run):
                runs_of.setdefault(_VALUE.sub(" is …", fault), (fault, []))[1].append(run)
        lines = []
        for fault, runs in runs_of.values():
            values = {path: value for path, value in self.values(runs[0]).items() if path != SEED}
            first = ", ".join(f"{path}={text_of(value)}" for path, value in values.items())
            some = f" (in {len(runs)} of {checked} combinations, first {first})"
            lines.append(fault if len(runs) == checked else f"{fault}{some}")
        return lines


def _faults(make: Callable[[int], Scenario], run: int) -> list[str]:
    try:
        make(run)
    except ScenarioError as error:
        return error.faults
    return []


def make_plan(
    source: str,
    document: dict[str, Any],
    vary: list[str],
    runs: int | None,
    records: bool = False,
    progress: Callable[[int, int], None] = lambda run, total: None,
    earlier_faults: Sequence[str] = (),
    changed: Sequence[str] | None = None,
) -> SweepPlan:
    """Return the plan of a sweep after checking all its combinations; arguments are as in SweepPlan, except:

    Args:
        runs: None: one for each combination of the grid and each given seed.
        progress: called with the index of the combination that is being checked, and the number of combinations.
        earlier_faults: faults of the overrides, which are reported with the others.

    Raises:
        ScenarioError: the variations or the resulting scenarios are invalid; one line per fault.
    """
    fields: dict[FieldPath, str] = {}  # the valid texts of `--vary`
    vary_faults = []
    for text in vary:
        try:
            path = parse(text, document).path
            steps = field_path(document, path)
            _refuse_overlap(path, steps, fields)
            fields[steps] = text
        except ValueError as error:
            vary_faults.append(f"--vary {_shown(text)}: {error}")
    faults = [*earlier_faults, *vary_faults]
    source = source.encode(errors="surrogateescape").decode(errors="replace")  # a file's name may contain any bytes
    set_texts = None if changed is None else tuple(changed)
    texts = tuple(fields.values())
    plan = SweepPlan(source=source, document=document, vary=texts, runs=runs or 1, records=records, changed=set_texts)
    if not runs:
        design = SweepDesign(plan)
        seed_count = len(design.seeds.values) if design.seeds else 0
        plan = msgspec.structs.replace(plan, runs=design.points * max(seed_count, 1))
    design = SweepDesign(plan)
    faults += _count_faults(design, all_known=not vary_faults)
    if plan.runs <= RUNS_MAX:
        faults += _faults(lambda _: scenario_file.resolve(copy.deepcopy(document), source), 0)
        faults += [fault for fault in design.faults(progress) if fault not in faults]
    if faults:
        raise ScenarioError(first_lines(faults))
    return plan


def _shown(text: str) -> str:
    return text[:80] if text.isprintable() else repr(text)[:80]


def _refuse_overlap(path: str, steps: FieldPath, fields: dict[FieldPath, str]) -> None:
    """Raise ValueError for a path that overlaps a varied one."""
    for other, text in fields.items():
        if steps == other:
            raise ValueError(f"{path} is already varied by {_shown(text)}; give it once")
        if is_inside(steps, other) or is_inside(other, steps):
            relation = "is part of" if is_inside(steps, other) else "contains"
            raise ValueError(f"{path} {relation} a field that is already varied by {_shown(text)}; vary one of the two")


def _count_faults(design: SweepDesign, all_known: bool) -> list[str]:
    """Return the faults of the number of runs; `all_known`: no variation was refused."""
    runs, points = design.plan.runs, design.points
    if runs > RUNS_MAX:
        return [f"--runs is {runs}; must be at most {RUNS_MAX}"]
    if runs < points:
        return [f"--runs is {runs}; must be at least {points}, the combinations of the grid"]
    seeds = len(design.seeds.values) if design.seeds else 0
    if seeds and runs > points * seeds:
        return [f"--runs is {runs}; must be at most {points * seeds}: every given seed for every combination"]
    if all_known and runs > points and all(isinstance(axis, Grid) for axis in design.axes):
        return [f"--runs is {runs}; must be {points}, because more would repeat the same flights, or add --vary seed"]
    return []


def read_document(path: Path, set_texts: list[str], **values: Any) -> tuple[dict[str, Any], list[str]]:
    """Return the raw document, as `scenario_file.load` takes it, and the faults of the overrides.

    `set_texts` are the texts `a.b.c=value` of `--set`; `values` that are not None replace top-level fields of the file.

    Raises:
        ScenarioError: the file does not contain a map.
    """
    plugin.search(path.parent)
    document = yaml_file.read(path, EXAMPLE, ScenarioError)
    document.update({key: value for key, value in values.items() if value is not None})
    applied = [scenario_file.apply_override(document, text, yaml_file.value) for text in set_texts]
    return document, [fault for fault in applied if fault]
