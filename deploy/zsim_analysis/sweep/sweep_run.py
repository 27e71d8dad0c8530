"""One run of a sweep: its task, its flight in this process, and its row in the table.

The run is judged as by `zsim report`, but needs no record on disk. `report.metrics` names the user's functions that
compute further numbers from the flight:

    def metrics(flight: RecordedFlight) -> float | Mapping[str, float]
    def metrics(run: zsim.Run) -> float | Mapping[str, float]

The name of the parameter decides what is passed: for `flight`, the arrays of a RecordedFlight; for any other name, the
recorded run.

A returned number becomes the column `metrics.FUNCTION`; a mapping, one column `metrics.NAME` for each of its names. A
unit at the end of a name, as in scenarios (`overshoot_m`), is shown in tables and figures. NaN, infinity and None
become empty cells. An exception raised by a function becomes the run's `metrics_failure`; its other columns are kept.
"""

import math
import re
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from inspect import signature
from numbers import Real
from pathlib import Path
from shutil import copy, rmtree
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from zsim.contract.fingerprint import fingerprint
from zsim.contract.framing import GateMessages
from zsim.errors import DocumentError, RecordError, ReportError, reason_of
from zsim.output_folder import RECORD, temporary_folder
from zsim.record import RecordWriter
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim.schema.checker import show
from zsim_analysis.in_process import InProcessFlight
from zsim_analysis.reading.formation import Formation, formations_of
from zsim_analysis.reading.recorded_flight import FlightReader, RecordedFlight, read_flight
from zsim_analysis.reading.shortfall import CRASHES
from zsim_analysis.report.summary import RunSummary, summarise
from zsim_analysis.sweep.design import METRICS

METRIC = "metrics."  # prefix of the columns of the user's metrics
FLIGHT = "flight"  # name of a parameter that takes a RecordedFlight
METRICS_MAX = 100  # maximum number of metrics that one function may return
_NAME = re.compile(r"[A-Za-z]\w{0,63}", re.ASCII)

Row = dict[str, Any]
"""Values by column: `FIXED`, the varied paths, the time of each cluster's engagement (`engaged_column`), errors and
tracking by their paths in summary.json, and the user's `metrics.NAME`."""


class Task(Struct, frozen=True):
    """A run to be flown."""

    run: int  # number of the run
    point: int  # point of the grid
    varied: dict[str, Any]  # values of the varied fields by path, without the seed
    scenario: Scenario  # resolved, with the run's seed
    record: str | None = None  # folder for the record; None to keep none
    open_run: Callable[[Path], Any] | None = None  # opens a record as a `zsim.Run`, for metrics
    more: Callable[[RecordedFlight], Mapping[str, Any]] | None = None  # returns further columns, with JSON values
    processes: Callable[[Scenario, Path], None] | None = None  # flies the run as processes into a folder; None: here
    judge: Callable[[RunSummary, Row], Mapping[str, Any]] | None = None  # returns further columns


class RunResult(Struct, frozen=True, kw_only=True):
    """The columns that every run has, in order; None where a failed run has no value."""

    run: int
    point: int
    seed: int
    failure: str | None = None  # why the run did not end well
    ended: str | None = None  # why the flight ended, according to the world
    truth_sha256: str | None = None
    sim_s: float | None = None
    wall_s: float | None = None  # wall time of the flight
    real_time_factor: float | None = None
    min_separation_m: float | None = None
    collisions: int | None = None  # number of contacts of drones with each other and with obstacles
    min_obstacle_distance_m: float | None = None  # of the closest drone's centre; None without obstacles and surfaces
    # whether a drone had its rotors stopped in the air, flipped, hit something hard, or touched the ground in flight
    crashed: bool | None = None
    # whether every cluster was engaged at some time within the judged window; None without a cluster
    engaged: bool | None = None
    # whether every cluster was engaged throughout the judged window; None without a cluster
    engaged_throughout: bool | None = None
    as_planned: bool | None = None  # whether the flight followed its plan
    shortfall: str | None = None  # first deviation of the flight from its plan
    metrics_failure: str | None = None  # why the run lacks metrics that the user requested
    # window_from_s, window_to_s: start and end of the judged window
    window_from_s: float | None = None
    window_to_s: float | None = None
    window_note: str | None = None  # why the judged window is not the scenario's; empty if it is
    date: str | None = None  # when the run was flown (ISO 8601, UTC)
    host: str = ""  # host that flew the run
    fingerprint: str = ""  # hosts with equal fingerprints give identical bits


# columns that are fields of the run's summary
SUMMARY_FIELDS = ("ended", "truth_sha256", "sim_s", "wall_s", "real_time_factor", "min_separation_m", "as_planned",
              "window_note", "date")  # fmt: skip
FIXED = {field.name: field.type for field in msgspec.structs.fields(RunResult)}


def engaged_column(cluster: str) -> str:
    """Return the name of the column with the first time within the judged window at which a cluster was engaged [s]."""
    return f"clusters.{cluster}.engaged_s"


def make_row(result: RunResult, varied: Mapping[str, Any], errors: Mapping[str, Any]) -> Row:
    """Return the row of a run: its number, point, seed and varied values, then its results."""
    columns: Row = msgspec.structs.asdict(result)
    inputs = {name: columns.pop(name) for name in ("run", "point", "seed")}
    return {**inputs, **varied, **columns, **errors}


def failed_row(task: Task, reason: str, **known: Any) -> Row:
    result = RunResult(run=task.run, point=task.point, seed=task.scenario.seed, failure=reason, **known)
    return make_row(result, task.varied, {})


def fly(task: Task) -> Row:
    """Fly a run and return its row; an error of the run is reported in the row, so that the sweep goes on.

    Raises:
        RecordError, OSError: the record cannot be written; other runs would fail as well.
    """
    needs_run = task.open_run and any(map(_takes_run, task.scenario.report.metric_names))
    if task.record is None and (needs_run or task.processes):
        folder = temporary_folder("run-")
        try:
            return fly(replace(task, record=str(folder / "run")))
        finally:
            rmtree(folder, ignore_errors=True)
    origin: Row = {"host": socket.gethostname(), "fingerprint": fingerprint()}
    try:
        if task.processes:
            folder = Path(task.record or "")
            rmtree(folder, ignore_errors=True)
            task.processes(task.scenario, folder)
            answers = task.more is not None or bool(task.scenario.report.metric_names)
            flight, diverged = read_flight(folder / RECORD, answers), None
        else:
            with _record(task) as writer:
                flight, diverged = fly_scenario(task.scenario, writer, answers=task.more is not None)
        formations = formations_of(flight)
        summary = summarise(flight, formations, Path(task.record or "") / RECORD)
    except (RecordError, OSError):
        raise
    except Exception as error:  # any type, since the scenario caused it
        return failed_row(task, reason_of(error), **origin)
    engaged = engaged_s(formations, summary.window_s)
    clusters = [cluster.name for cluster in task.scenario.clusters]
    shares = {name: each.engaged_share for name, each in summary.clusters.items()}
    metrics, metrics_failure = ({}, None) if diverged else metrics_of(task, flight)
    result = RunResult(
        run=task.run,
        point=task.point,
        seed=task.scenario.seed,
        failure=reason_of(diverged) if diverged else None,
        collisions=sum(event.kind == "collision" for event in flight.events),
        min_obstacle_distance_m=min(summary.obstacle_distance_m.values(), default=None),
        crashed=any(event.kind in CRASHES for event in flight.events),
        engaged=all(engaged.get(name) is not None for name in clusters) if clusters else None,
        engaged_throughout=all(shares.get(name) == 1.0 for name in clusters) if clusters else None,
        shortfall=next((each.text for each in summary.shortfalls if each.fails), None),
        metrics_failure=metrics_failure,
        window_from_s=summary.window_s[0],
        window_to_s=summary.window_s[1],
        **{name: getattr(summary, name) for name in SUMMARY_FIELDS},
        **origin,
    )
    columns: dict[str, float | None] = {engaged_column(name): engaged.get(name) for name in clusters}
    for i, (name, cluster) in enumerate([] if diverged else summary.clusters.items()):
        # Errors by their paths in summary.json: None for a cluster that was not engaged, and for a flight that was
        # not as planned, since errors of drones that stay on the ground, hover or fall are not comparable.
        prefix = "errors" if i == 0 else f"clusters.{name}.errors"
        is_comparable = summary.as_planned and engaged[name] is not None
        for parameter, errors in cluster.errors.items():
            for statistic, value in msgspec.structs.asdict(errors).items():
                columns[f"{prefix}.{parameter}.{statistic}"] = value if is_comparable else None
    for name, tracking in [] if diverged else summary.tracking.items():
        for statistic, value in msgspec.structs.asdict(tracking).items():
            columns[f"tracking.{name}.{statistic}"] = value if summary.as_planned else None
    extra_columns = task.more(flight) if task.more and not diverged else {}
    row = make_row(result, task.varied, {**columns, **metrics, **extra_columns})
    return {**row, **task.judge(summary, row)} if task.judge and not diverged else row


def fly_scenario(
    scenario: Scenario, writer: RecordWriter | None = None, answers: bool = False
) -> tuple[RecordedFlight, Exception | None]:
    """Fly a resolved scenario; return the flight, and the exception if it diverged.

    With `answers`, and for the user's metrics, the flight includes the drones' estimates and commands.
    """
    flight, cpu = InProcessFlight(scenario), _CpuTime()
    reader = FlightReader(answers or bool(scenario.report.metric_names))
    flight.run([reader, cpu, writer] if writer else [reader, cpu])
    recorded = reader.flight()
    recorded.cpu_s = cpu.spent_s
    return recorded, flight.world.failure


class _CpuTime:
    """Observer of a flight that measures the CPU time of this process from the first gate to the last."""

    def __init__(self) -> None:
        self._gates_s: list[float] = []

    @property
    def spent_s(self) -> float | None:
        return self._gates_s[-1] - self._gates_s[0] if self._gates_s else None

    def add_message(self, key: str, message: Any, wall_ns: int) -> None:
        """Do nothing: the time is read at gates."""

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
        self._gates_s[1:] = [time.process_time()]


@contextmanager
def _record(task: Task) -> Iterator[RecordWriter | None]:
    """Yield the writer of the record, or None if none is kept; an incomplete record keeps the suffix .part."""
    if task.record is None:
        yield None
        return
    folder = Path(task.record)
    part = folder.with_name(f"{folder.name}.part")
    for leftover in (folder, part):  # left by an earlier attempt
        rmtree(leftover, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        (part / "scenario.yaml").write_text(scenario_file.to_text(task.scenario), encoding="utf-8")
        for module in generated_modules(task.scenario.own_code(), plugin.folders()):
            copy(module, part)
    except OSError as error:
        reason = f"cannot be written ({error.strerror}); remove the cause; the same command then continues"
        raise RecordError(f"{part}: {reason}") from error
    writer = RecordWriter(part / "run.mcap")
    try:
        yield writer
    except (RecordError, OSError):
        with suppress(RecordError):
            writer.close()
        raise
    except Exception:
        writer.close()
        part.rename(folder)
        raise
    writer.close()
    part.rename(folder)


def generated_modules(names: Iterable[str], folders: Iterable[Path]) -> list[Path]:
    """Return the files of those modules in `names` that were generated from definitions in a notebook or script."""
    module_names = dict.fromkeys(name.partition(":")[0] for name in names if name.startswith(plugin.MADE))
    files = [folder / f"{module}.py" for module in module_names for folder in folders]
    return [file for file in files if file.is_file()]


def engaged_s(formations: list[Formation], window_s: tuple[float, float]) -> dict[str, float | None]:
    """Return the first time within a window at which each cluster was engaged [s]; None if it never was."""
    rows = {each.name: np.flatnonzero(each.judged(window_s)) for each in formations}
    return {each.name: float(each.t_s[rows[each.name][0]]) if len(rows[each.name]) else None for each in formations}


def metrics_of(task: Task, flight: RecordedFlight) -> tuple[dict[str, float | None], str | None]:
    """Return the metrics of the user's functions by column, and why some are missing, or None."""
    metrics: dict[str, float | None] = {}
    failures: list[str] = []

    @cache
    def run() -> Any:
        assert task.open_run is not None
        return task.open_run(Path(task.record or ""))

    for name in task.scenario.report.metric_names:
        results, failure = _metrics_of(name, run if task.open_run and _takes_run(name) else lambda: flight)
        if repeated := results.keys() & metrics.keys():
            returned = min(repeated).removeprefix(METRIC)
            failures.append(f"{METRICS} {name}: returned {returned}, which another function also returns")
        elif failure:
            failures.append(failure)
        else:
            metrics.update(results)
    return metrics, "; ".join(failures) or None


def _takes_run(name: str) -> bool:
    """Return whether a user's function takes the recorded run, that is, its parameter is not named `flight`."""
    try:
        arguments = signature(plugin.load_function(name, METRICS)).parameters
    except (DocumentError, TypeError, ValueError):  # reported when the function is called
        return False
    return next(iter(arguments), FLIGHT) != FLIGHT


def _metrics_of(name: str, argument: Callable[[], Any]) -> tuple[dict[str, float | None], str | None]:
    try:
        returned = plugin.load_function(name, METRICS)(argument())
        results = returned if isinstance(returned, Mapping) else {name.partition(":")[2]: returned}
        if len(results) > METRICS_MAX:
            raise ReportError(f"returned {len(results)} numbers; must be at most {METRICS_MAX}")
        metrics: dict[str, float | None] = {}
        for key, value in results.items():
            if not (isinstance(key, str) and _NAME.fullmatch(key)):
                rule = "must be a letter and up to 63 letters, digits and _"
                raise ReportError(f"returned the name {show(key)}; {rule}")
            if value is not None and not isinstance(value, Real):
                kind = show(str(type(value).__name__))
                raise ReportError(f"returned {kind} for {key}; must be a number or None")
            number = math.nan if value is None else float(value)
            metrics[f"{METRIC}{key}"] = number if math.isfinite(number) else None
        return metrics, None
    except DocumentError as error:
        return {}, error.faults[0]
    except (Exception, SystemExit) as error:  # any type, since the user's function raised it
        return {}, f"{METRICS} {name}: {reason_of(error)}"
