"""The plan of a sweep, and its design: the runs, the values that each of them has, and the scenarios of them."""

import copy
import math
import re
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from zsim import __version__
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.roles import check_pace
from zsim.scenario.scenario import Scenario
from zsim.scenario.scenario_file import EXAMPLE, whole_path
from zsim.schema import plugin, yaml_file
from zsim.schema.checker import first_lines
from zsim_agents.hosting import check_classes
from zsim_analysis.sweep.axes import SEED, Axis, Draw, FieldPath, Grid, Seeds, field_path, is_inside, parse, text_of
from zsim_analysis.sweep.metrics import check_metrics

PLAN = "plan.json"
RUNS_MAX = 1_000_000
_VALUE = re.compile(r" is [^;]*")  # in a fault: what differs from run to run where values are drawn
_DEFAULT_SEED: int = next(f.default for f in msgspec.structs.fields(Scenario) if f.name == SEED)


class SweepPlan(Struct, frozen=True, kw_only=True):
    """One scenario and its variations: the same plan gives the same runs, on any host and in any order.

    Attributes:
        source: name of the scenario's file, for messages.
        document: the file with the overrides of the command line, presets not yet expanded.
        vary: texts of `--vary`, in their order.
        runs: how many; a plan of more runs begins with the same ones.
        records: whether every run keeps its record.
        changed: texts `a.b.c=value` that the command line has changed of the file; None: not known.
        version: of zsim; another one need not give the same numbers.
    """

    source: str
    document: dict[str, Any]
    vary: tuple[str, ...]
    runs: int
    records: bool = False
    changed: tuple[str, ...] | None = None
    version: str = __version__


def difference(old: SweepPlan, new: SweepPlan) -> str | None:
    """Return in which way two plans are not the same sweep, None if `new` continues `old`."""
    if old.version != new.version:
        return f"it was begun by zsim {old.version}, this is {new.version}"
    if old.document != new.document:
        keys = sorted(old.document.keys() | new.document.keys())
        other = next(key for key in keys if old.document.get(key) != new.document.get(key))
        return f"{other} of its scenario is another one"
    if _whole(old) != _whole(new):
        return f"it varies {' '.join(old.vary) or 'nothing'}, not {' '.join(new.vary) or 'nothing'}"
    if old.records != new.records:
        return f"it {'keeps' if old.records else 'does not keep'} records"
    if new.runs < old.runs:
        return f"it has {old.runs} runs, more than {new.runs}"
    return None


def _whole(plan: SweepPlan) -> list[str]:
    """Return texts of `--vary` with their paths from the top of the scenario."""
    parts = [text.partition("=") for text in plan.vary]
    return [f"{whole_path(path.strip(), plan.document)}{equals}{values}" for path, equals, values in parts]


def is_sweep(folder: Path) -> bool:
    """Return whether a folder holds a sweep."""
    return (folder / PLAN).is_file()


class SweepDesign:
    """Everything that follows from a plan; runs and points count from 0.

    Attributes:
        axes: what varies.
        points: how many combinations of the grid's values there are; run i flies the i-th, then the first again.
        seeds: how they vary, None where all runs have the scenario's own.
        paired: the n-th runs of all combinations have the same seed.
    """

    def __init__(self, plan: SweepPlan) -> None:
        self.plan = plan
        self.axes: list[Axis] = [parse(text, plan.document) for text in plan.vary]
        self._grids = [axis for axis in self.axes if isinstance(axis, Grid)]
        self.points = math.prod(len(grid.values) for grid in self._grids)
        self.seeds = next((axis for axis in self.axes if isinstance(axis, Seeds)), None)
        self.paired = self.seeds is not None and self.seeds.paired

    @property
    def seed(self) -> int:
        """Return the scenario's own seed, from which seeds and values are drawn; a faulty one is not flown."""
        seed = self.plan.document.get(SEED)
        return seed if isinstance(seed, int) and seed >= 0 else _DEFAULT_SEED

    @property
    def varied(self) -> list[str]:
        """Return the paths that vary, without the seed's."""
        return [axis.path for axis in self.axes if axis.path != SEED]

    def point(self, run: int) -> int:
        """Return the point of the grid that a run flies."""
        return run % self.points

    def at(self, point: int) -> dict[str, Any]:
        """Return the values of a point by path; those of the last axis change fastest."""
        return {grid.path: grid.values[place] for grid, place in self._places(point)}

    def names(self, point: int) -> dict[str, str]:
        """Return the values of a point in short by path, no two values of a field alike."""
        return {grid.path: self._names[grid.path][place] for grid, place in self._places(point)}

    def _places(self, point: int) -> list[tuple[Grid, int]]:
        """Return the axes of the grid, each with the place of a point's value in it."""
        places = []
        for grid in reversed(self._grids):
            point, place = divmod(point, len(grid.values))
            places.append((grid, place))
        return places[::-1]

    @cached_property
    def _names(self) -> dict[str, list[str]]:
        return {grid.path: grid.names for grid in self._grids}

    def values(self, run: int) -> dict[str, Any]:
        """Return what a run sets, by path, in the order of the axes."""
        at, draw = self.at(self.point(run)), run // self.points if self.paired else run
        return {axis.path: at[axis.path] if axis.path in at else self._drawn[axis.path][draw] for axis in self.axes}

    @cached_property
    def _drawn(self) -> dict[str, list[Any]]:
        drawn = [axis for axis in self.axes if not isinstance(axis, Grid)]
        count = -(-self.plan.runs // self.points) if self.paired else self.plan.runs
        return {axis.path: axis.draw(self.seed, count) for axis in drawn}

    def scenario(self, run: int) -> Scenario:
        """Return the resolved scenario of a run, which is flown in lockstep.

        Raises:
            ScenarioError: with every fault, a line each.
        """
        document = copy.deepcopy(self.plan.document)
        assigned = [_assign(document, path, value) for path, value in self.values(run).items()]
        faults = [fault for fault in assigned if fault]
        try:
            scenario = scenario_file.resolve(document, self.plan.source)
        except ScenarioError as error:
            raise ScenarioError([*faults, *error.faults]) from error
        if faults:
            raise ScenarioError(faults)
        check_classes(scenario, self.plan.source)
        check_metrics(scenario, self.plan.source)
        check_pace(scenario, "lockstep")
        return scenario

    def faults(self, progress: Callable[[int, int], None] = lambda run, of: None) -> list[str]:
        """Return the faults of every combination: each point of the grid, each run where values are drawn.

        Args:
            progress: called with the number of the combination that is checked, and how many there are.
        """
        drawn = any(isinstance(axis, Draw) for axis in self.axes)
        checked = self.plan.runs if drawn else min(self.plan.runs, self.points)
        runs_of: dict[str, tuple[str, list[int]]] = {}
        for run in range(checked):
            progress(run, checked)
            for fault in _faults(self.scenario, run):
                runs_of.setdefault(_VALUE.sub(" is …", fault), (fault, []))[1].append(run)
        return [self._with_runs(fault, runs, checked) for fault, runs in runs_of.values()]

    def _with_runs(self, fault: str, runs: list[int], checked: int) -> str:
        """Return a fault with the combinations that have it, unless all of them do."""
        if len(runs) == checked:
            return fault
        values = {path: value for path, value in self.values(runs[0]).items() if path != SEED}
        first = ", ".join(f"{path}={text_of(value)}" for path, value in values.items())
        return f"{fault} (in {len(runs)} of {checked} combinations, first {first})"


def make_plan(
    source: str,
    document: dict[str, Any],
    vary: list[str],
    runs: int | None,
    records: bool = False,
    progress: Callable[[int, int], None] = lambda run, of: None,
    earlier_faults: Sequence[str] = (),
    changed: Sequence[str] | None = None,
) -> SweepPlan:
    """Return the plan of a sweep, all its combinations checked.

    Args:
        source: name of the scenario's file, for messages.
        document: raw; see `read_document`.
        vary: texts of `--vary`.
        runs: how many, None: as many as the grid has combinations, of each seed that is given.
        records: whether every run keeps its record.
        progress: called with the number of the combination that is checked, and how many there are.
        earlier_faults: of the overrides, reported with the others.
        changed: as of the plan.

    Raises:
        ScenarioError: with every fault of the variations and of the scenarios that result, a line each.
    """
    texts, vary_faults = _parsed(vary, document)
    faults = [*earlier_faults, *vary_faults]
    source = source.encode(errors="surrogateescape").decode(errors="replace")  # a file's name may be any bytes
    sets = None if changed is None else tuple(changed)
    plan = SweepPlan(source=source, document=document, vary=tuple(texts), runs=runs or 1, records=records, changed=sets)
    design = SweepDesign(plan)
    given = len(design.seeds.values) if design.seeds else 0
    plan = msgspec.structs.replace(plan, runs=runs or design.points * max(given, 1))
    design = SweepDesign(plan)
    faults += _count_faults(design, all_known=not vary_faults)
    if plan.runs <= RUNS_MAX:
        faults += _faults(lambda _: scenario_file.resolve(copy.deepcopy(document), source), 0)
        faults += [fault for fault in design.faults(progress) if fault not in faults]
    if faults:
        raise ScenarioError(first_lines(faults))
    return plan


def _parsed(vary: list[str], document: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Return the texts of `--vary` that are valid, and a fault for each of the others."""
    fields: dict[FieldPath, str] = {}
    faults = []
    for text in vary:
        shown = _shown(text)
        try:
            path = parse(text, document).path
        except ValueError as error:
            faults.append(f"--vary {shown}: {error}")
            continue
        steps = field_path(document, path)
        fault = _overlap(path, steps, fields)
        if fault:
            faults.append(f"--vary {shown}: {fault}")
        else:
            fields[steps] = text
    return list(fields.values()), faults


def _shown(text: str) -> str:
    return text[:80] if text.isprintable() else repr(text)[:80]


def _overlap(path: str, steps: FieldPath, fields: dict[FieldPath, str]) -> str | None:
    """Return the fault of a path of which a part, or the whole, varies already."""
    for other, text in fields.items():
        if steps == other:
            return f"{path} varies already by {_shown(text)}; give it once"
        if is_inside(steps, other):
            return f"{path} is part of what varies already by {_shown(text)}; vary one of the two"
        if is_inside(other, steps):
            return f"{path} holds what varies already by {_shown(text)}; vary one of the two"
    return None


def _count_faults(design: SweepDesign, all_known: bool) -> list[str]:
    """Return the faults of the number of runs; `all_known`: no axis was refused, which might have been a drawn one."""
    runs, points = design.plan.runs, design.points
    if runs > RUNS_MAX:
        return [f"--runs is {runs}; must be at most {RUNS_MAX}"]
    if runs < points:
        return [f"--runs is {runs}; must be at least {points}, the combinations of the grid"]
    seeds = len(design.seeds.values) if design.seeds else 0
    if seeds and runs > points * seeds:
        return [f"--runs is {runs}; must be at most {points * seeds}, each seed that is given for every combination"]
    if all_known and runs > points and all(isinstance(axis, Grid) for axis in design.axes):
        return [f"--runs is {runs}; must be {points}, for further ones would have the same bits, or add --vary seed"]
    return []


def _faults(make: Callable[[int], Scenario], run: int) -> list[str]:
    try:
        make(run)
    except ScenarioError as error:
        return error.faults
    return []


def _assign(document: dict[str, Any], path: str, value: Any) -> str | None:
    """Set a field of a document to a copy of a value; return the fault if there is one."""
    fault = scenario_file.apply_override(document, f"{path}={text_of(value)}", lambda _: copy.deepcopy(value))
    return f"--vary {fault.removeprefix('--set ')}" if fault else None


def read_document(path: Path, set_texts: list[str], **values: Any) -> tuple[dict[str, Any], list[str]]:
    """Return the raw document, as `scenario_file.load` takes it, and the faults of the overrides.

    Args:
        path: the file.
        set_texts: texts `a.b.c=value` as given to `--set`, applied in order.
        values: top-level fields that replace the file's, None being ignored.

    Raises:
        ScenarioError: the file holds no map.
    """
    plugin.search(path.parent)
    document = yaml_file.read(path, EXAMPLE, ScenarioError)
    document.update({key: value for key, value in values.items() if value is not None})
    applied = [scenario_file.apply_override(document, text, yaml_file.value) for text in set_texts]
    return document, [fault for fault in applied if fault]
