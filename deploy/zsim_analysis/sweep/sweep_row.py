"""One run of a sweep: the task of flying it, and the row of the table with its results."""

from collections.abc import Mapping
from typing import Any

import msgspec
from msgspec import Struct

from zsim.scenario.scenario import Scenario

Row = dict[str, Any]
"""Values by column; the columns are `FIXED`, the varied paths, when each cluster was engaged (`engaged_column`), and
the errors by their paths in summary.json."""


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
        failure: why it did not end well, None if it did.
        ended: the reason that the world gave.
        wall_s: wall time of the flight.
        collisions: contacts between drones.
        engaged: whether every cluster was engaged at some instant of the judged window, None without a cluster.
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
    engaged: bool | None = None
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
