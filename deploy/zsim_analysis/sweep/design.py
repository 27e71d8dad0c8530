"""The runs of a plan: which values each of them has, and the scenario that comes of it."""

import copy
import math
import re
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import msgspec

from zsim.errors import ScenarioError
from zsim.scenario import overrides, scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.hosting import check_classes
from zsim_analysis.sweep.axes import SEED, Axis, Draw, Grid, parse, text_of
from zsim_analysis.sweep.paths import Place, inside, place
from zsim_analysis.sweep.sweep_plan import RUNS_MAX, Plan

FAULTS_MAX = 100  # lines; what follows is counted
_FOUND = re.compile(r" is [^;]*")  # in a fault: what differs from run to run where values are drawn
_DEFAULT_SEED: int = next(f.default for f in msgspec.structs.fields(Scenario) if f.name == SEED)


class Design:
    """Everything that follows from a plan; runs and points count from 0.

    Attributes:
        axes: what varies.
        points: how many combinations of the grid's values there are; run i flies the i-th, then the first again.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.axes: list[Axis] = [parse(text) for text in plan.vary]
        self._grids = [axis for axis in self.axes if isinstance(axis, Grid)]
        self.points = math.prod(len(grid.values) for grid in self._grids)

    @property
    def seed(self) -> int:
        """Return the scenario's own seed, from which all that varies by chance is drawn; a faulty one is not flown."""
        given = self.plan.document.get(SEED)
        return given if isinstance(given, int) and given >= 0 else _DEFAULT_SEED

    @property
    def varied(self) -> list[str]:
        """Return the paths that vary, without the seed's."""
        return [axis.path for axis in self.axes if axis.path != SEED]

    def point(self, run: int) -> int:
        """Return which point of the grid a run flies."""
        return run % self.points

    def at(self, point: int) -> dict[str, Any]:
        """Return the values of a point by path; the last axis turns fastest."""
        found = {}
        for grid in reversed(self._grids):
            point, place = divmod(point, len(grid.values))
            found[grid.path] = grid.values[place]
        return dict(reversed(found.items()))

    def values(self, run: int) -> dict[str, Any]:
        """Return what a run sets, by path, in the order of the axes."""
        at = self.at(self.point(run))
        return {axis.path: at[axis.path] if axis.path in at else self._drawn[axis.path][run] for axis in self.axes}

    @cached_property
    def _drawn(self) -> dict[str, list[Any]]:
        drawn = [axis for axis in self.axes if not isinstance(axis, Grid)]
        return {axis.path: axis.draw(self.seed, self.plan.runs) for axis in drawn}

    def scenario(self, run: int) -> Scenario:
        """Return the resolved scenario of a run.

        Raises:
            ScenarioError: with every fault found, a line each.
        """
        document = copy.deepcopy(self.plan.document)
        assigned = [_assign(document, path, value) for path, value in self.values(run).items()]
        wrong = [fault for fault in assigned if fault]
        try:
            scenario = scenario_file.resolve(document, self.plan.source)
        except ScenarioError as error:
            raise ScenarioError([*wrong, *error.faults]) from error
        if wrong:
            raise ScenarioError(wrong)
        check_classes(scenario, self.plan.source)
        return scenario

    def faults(self, progress: Callable[[int, int], None] = lambda run, of: None) -> list[str]:
        """Return the faults of every combination: each point of the grid, each run where values are drawn.

        Args:
            progress: told the combination that is looked at, and how many there are.
        """
        drawn = any(isinstance(axis, Draw) for axis in self.axes)
        checked = self.plan.runs if drawn else min(self.plan.runs, self.points)
        found: dict[str, tuple[str, list[int]]] = {}
        for run in range(checked):
            progress(run, checked)
            for fault in _faults(self.scenario, run):
                found.setdefault(_FOUND.sub(" is …", fault), (fault, []))[1].append(run)
        return [self._told(fault, runs, checked) for fault, runs in found.values()]

    def _told(self, fault: str, runs: list[int], checked: int) -> str:
        """Return a fault with the combinations that have it, where not all of them do."""
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
    before: Sequence[str] = (),
) -> Plan:
    """Return the plan of a sweep, all its combinations checked; without `runs`, one run for each of them.

    Args:
        source: name of the scenario's file, for messages.
        document: raw; see `document.read`.
        vary: texts of `--vary`.
        runs: how many, None: as many as the grid has combinations.
        records: whether every run keeps its record.
        progress: told the combination that is looked at, and how many there are.
        before: faults found already, to be told with the others.

    Raises:
        ScenarioError: with every fault of the variations and of what comes of them, a line each.
    """
    texts, wrong = _parsed(vary, document)
    faults = [*before, *wrong]
    source = source.encode(errors="surrogateescape").decode(errors="replace")  # a file's name may be any bytes
    plan = Plan(source=source, document=document, vary=tuple(texts), runs=runs or 1, records=records)
    plan = msgspec.structs.replace(plan, runs=runs or Design(plan).points)
    design = Design(plan)
    faults += _count_faults(design, all_known=not wrong)
    if plan.runs <= RUNS_MAX:
        faults += _faults(lambda _: scenario_file.resolve(copy.deepcopy(document), source), 0)
        faults += [fault for fault in design.faults(progress) if fault not in faults]
    if faults:
        more = len(faults) - FAULTS_MAX
        raise ScenarioError([*faults[:FAULTS_MAX], *([f"… and {more} more faults"] if more > 0 else [])])
    return plan


def _parsed(vary: list[str], document: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Return the texts of `--vary` that can be taken, and a line for each of the others."""
    taken: dict[Place, str] = {}
    faults = []
    for text in vary:
        shown = _shown(text)
        try:
            path = parse(text).path
        except ValueError as error:
            faults.append(f"--vary {shown}: {error}")
            continue
        where = place(document, path)
        fault = _overlap(path, where, taken)
        if fault:
            faults.append(f"--vary {shown}: {fault}")
        else:
            taken[where] = text
    return list(taken.values()), faults


def _shown(text: str) -> str:
    return text[:80] if text.isprintable() else repr(text)[:80]


def _overlap(path: str, where: Place, taken: dict[Place, str]) -> str | None:
    """Say what is wrong with a path of which a part, or the whole, varies already."""
    for other, text in taken.items():
        if where == other:
            return f"{path} varies already by {_shown(text)}; give it once"
        if inside(where, other):
            return f"{path} is part of what varies already by {_shown(text)}; vary one of the two"
        if inside(other, where):
            return f"{path} holds what varies already by {_shown(text)}; vary one of the two"
    return None


def _count_faults(design: Design, all_known: bool) -> list[str]:
    """Return what is wrong with the number of runs; `all_known`: no axis was refused, that could be one by chance."""
    runs, points = design.plan.runs, design.points
    if runs > RUNS_MAX:
        return [f"--runs is {runs}; must be at most {RUNS_MAX}"]
    if runs < points:
        return [f"--runs is {runs}; must be at least {points}, the combinations of the grid"]
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
    fault = overrides.apply(document, f"{path}={text_of(value)}", lambda _: copy.deepcopy(value))
    return f"--vary {fault.removeprefix('--set ')}" if fault else None
