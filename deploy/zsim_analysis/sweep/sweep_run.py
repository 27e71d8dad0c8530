"""One run of a sweep: its task, the row of the table with its results, and how it is flown in this process.

It is judged as `zsim report` does, without a record on disk.
"""

import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import rmtree
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, Struct

from zsim.contract.fingerprint import fingerprint
from zsim.errors import RecordError, reason_of
from zsim.record import RecordWriter
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_analysis.in_process import InProcessFlight
from zsim_analysis.reading.flight import FlightReader
from zsim_analysis.reading.formation import Formation, formations_of
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.reading.shortfall import CRASHES
from zsim_analysis.report.summary import RunSummary, summarise
from zsim_analysis.sweep.metrics import NO_METRICS, metrics_of

Row = dict[str, Any]
"""Values by column; the columns are `FIXED`, the varied paths, when each cluster was engaged (`engaged_column`),
the errors by their paths in summary.json, and `metrics.NAME` of the user's own."""


class Task(Struct, frozen=True):
    """A run to be flown.

    Attributes:
        run: its number.
        point: of the grid.
        varied: values by path, without the seed.
        scenario: resolved, its seed being the run's.
        record: folder for the record, None to keep none.
    """

    run: int
    point: int
    varied: dict[str, Any]
    scenario: Scenario
    record: str | None = None


class RunResult(Struct, frozen=True, kw_only=True):
    """The columns that every run has, in their order; None where a failed run has no value.

    Attributes:
        date: when it was flown (ISO 8601, UTC).
        failure: why it did not end well, None if it did.
        ended: the reason that the world gave.
        wall_s: wall time of the flight.
        collisions: contacts between drones, and with obstacles.
        crashed: whether a drone was stopped in the air, flipped, hit something hard, or touched the ground in flight.
        engaged: whether every cluster was engaged at some instant of the judged window, None without a cluster.
        engaged_throughout: whether every cluster was engaged at every instant of it, None without a cluster.
        as_planned: whether the flight did what its plan says.
        shortfall: the first thing that it did not do.
        metrics_failure: why it has no figures of the user's own, None if it has, or none are asked for.
        window_from_s, window_to_s: the judged window.
        window_note: why it is not that of the scenario, empty where it is.
        host: where it was flown.
        fingerprint: numeric; equal ones promise equal bits.
    """

    run: int
    point: int
    seed: int
    failure: str | None = None
    ended: str | None = None
    truth_sha256: str | None = None
    sim_s: float | None = None
    wall_s: float | None = None
    real_time_factor: float | None = None
    min_separation_m: float | None = None
    collisions: int | None = None
    crashed: bool | None = None
    engaged: bool | None = None
    engaged_throughout: bool | None = None
    as_planned: bool | None = None
    shortfall: str | None = None
    metrics_failure: str | None = None
    window_from_s: float | None = None
    window_to_s: float | None = None
    window_note: str | None = None
    date: str | None = None
    host: str = ""
    fingerprint: str = ""


FIXED = {field.name: field.type for field in msgspec.structs.fields(RunResult)}


def engaged_column(cluster: str) -> str:
    """Return the column of the first instant [s] of the judged window at which a cluster was engaged."""
    return f"clusters.{cluster}.engaged_s"


def make_row(result: RunResult, varied: Mapping[str, Any], errors: Mapping[str, float | None]) -> Row:
    """Return the row of a run: first its number, point, seed and varied values, then its results."""
    columns: Row = msgspec.structs.asdict(result)
    inputs = {name: columns.pop(name) for name in ("run", "point", "seed")}
    return {**inputs, **varied, **columns, **errors}


def failed_row(task: Task, reason: str, **known: Any) -> Row:
    """Return the row of a run that did not end well."""
    result = RunResult(run=task.run, point=task.point, seed=task.scenario.seed, failure=reason, **known)
    return make_row(result, task.varied, {})


def fly(task: Task) -> Row:
    """Return the row of a run; an error of the run is in its row and does not end the sweep.

    Raises:
        RecordError, OSError: its record cannot be written, so the record of no other run could be.
    """
    where = {"host": socket.gethostname(), "fingerprint": fingerprint()}
    try:
        with _record(task) as writer:
            flight, diverged = fly_scenario(task.scenario, writer)
        formations = formations_of(flight)
        summary = summarise(flight, formations, Path())  # the end event has all that the record would be needed for
    except (RecordError, OSError):
        raise
    except Exception as error:  # of any type: the scenario caused it
        return failed_row(task, reason_of(error), **where)
    engaged = engaged_s(formations, summary.window_s)
    return _row(task, flight, summary, engaged, diverged, where)


def fly_scenario(scenario: Scenario, writer: RecordWriter | None = None) -> tuple[RecordedFlight, Exception | None]:
    """Fly a scenario; return the flight, and the error by which it diverged if it did.

    A flight for a user's metrics has the drones' estimates and commands, too.

    Args:
        scenario: resolved.
        writer: records every message as well.
    """
    flight, reader = InProcessFlight(scenario), FlightReader(answers=scenario.report.metrics is not UNSET)
    flight.run([reader, writer] if writer else [reader])
    return reader.flight(), flight.world.failure


@contextmanager
def _record(task: Task) -> Iterator[RecordWriter | None]:
    """Yield the writer of the record, None where none is kept; an incomplete record keeps the name .part."""
    if task.record is None:
        yield None
        return
    folder = Path(task.record)
    writer = _begun(folder, task.scenario)
    try:
        yield writer
    except (RecordError, OSError):
        with suppress(RecordError):
            writer.close()
        raise
    except Exception:
        _keep(writer, folder)
        raise
    _keep(writer, folder)


def _begun(folder: Path, scenario: Scenario) -> RecordWriter:
    """Return the writer of a new record, replacing what an earlier attempt left there."""
    part = _part(folder)
    for leftover in (folder, part):
        rmtree(leftover, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        (part / "scenario.yaml").write_text(scenario_file.to_text(scenario), encoding="utf-8")
    except OSError as error:
        raise RecordError(
            f"{part}: cannot be written ({error.strerror}); make room, the same command goes on"
        ) from error
    return RecordWriter(part / "run.mcap")


def _keep(writer: RecordWriter, folder: Path) -> None:
    writer.close()
    _part(folder).rename(folder)


def _part(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.part")


def engaged_s(formations: list[Formation], window_s: tuple[float, float]) -> dict[str, float | None]:
    """Return the first instant [s] of a window at which each cluster was engaged, None where it never was."""
    return {each.name: _engaged_s(each, window_s) for each in formations}


def _engaged_s(formation: Formation, window_s: tuple[float, float]) -> float | None:
    rows = np.flatnonzero(formation.within(window_s))
    return next((float(formation.t_s[row]) for row in rows if formation.phases[row] == "engaged"), None)


def _row(
    task: Task,
    flight: RecordedFlight,
    summary: RunSummary,
    engaged: dict[str, float | None],
    diverged: Exception | None,
    where: dict[str, str],
) -> Row:
    clusters = [cluster.name for cluster in task.scenario.clusters]
    metrics = NO_METRICS if diverged else metrics_of(task.scenario, flight)
    result = RunResult(
        run=task.run,
        point=task.point,
        seed=task.scenario.seed,
        failure=reason_of(diverged) if diverged else None,
        ended=summary.ended,
        truth_sha256=summary.truth_sha256,
        sim_s=summary.sim_s,
        wall_s=summary.wall_s,
        real_time_factor=summary.real_time_factor,
        min_separation_m=summary.min_separation_m,
        collisions=sum(event.kind == "collision" for event in flight.events),
        crashed=any(event.kind in CRASHES for event in flight.events),
        engaged=all(engaged.get(name) is not None for name in clusters) if clusters else None,
        engaged_throughout=all(_is_engaged_throughout(summary, name) for name in clusters) if clusters else None,
        as_planned=summary.as_planned,
        shortfall=next((each.text for each in summary.shortfalls if each.fails), None),
        metrics_failure=metrics.failure,
        window_from_s=summary.window_s[0],
        window_to_s=summary.window_s[1],
        window_note=summary.window_note,
        date=summary.date,
        **where,
    )
    columns: dict[str, float | None] = {engaged_column(name): engaged.get(name) for name in clusters}
    if not diverged:
        columns.update(_errors(summary, engaged))
    return make_row(result, task.varied, {**columns, **metrics.columns})


def _is_engaged_throughout(summary: RunSummary, cluster: str) -> bool:
    judged = summary.clusters.get(cluster)
    return judged is not None and judged.engaged_share == 1.0


def _errors(summary: RunSummary, engaged: dict[str, float | None]) -> dict[str, float | None]:
    """Return the errors of the formations by their paths in summary.json; `errors` is the first cluster.

    Those of a cluster that was not engaged are None, and all of a flight that was not as planned: drones on the ground,
    or that hover in place of a trajectory, hold no formation that was asked for, and one that fell errs for less long.
    """
    columns: dict[str, float | None] = {}
    for i, (name, cluster) in enumerate(summary.clusters.items()):
        prefix = "errors" if i == 0 else f"clusters.{name}.errors"
        for parameter, errors in cluster.errors.items():
            for statistic, value in msgspec.structs.asdict(errors).items():
                columns[f"{prefix}.{parameter}.{statistic}"] = (
                    value if engaged[name] is not None and summary.as_planned else None
                )
    return columns
