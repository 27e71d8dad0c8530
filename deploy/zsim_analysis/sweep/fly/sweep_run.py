"""Flies one run of a sweep in this process and judges it as `zsim report` would, without a record on disk."""

import gc
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import rmtree
from typing import Any

import msgspec
import numpy as np

from zsim.contract import keys
from zsim.contract.fingerprint import fingerprint
from zsim.contract.framing import GateMessages
from zsim.errors import RecordError, ZsimError
from zsim.record import RecordWriter
from zsim.runtime.bus import Bus
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_analysis.in_process import agents
from zsim_analysis.reading.flight import Flight
from zsim_analysis.reading.flight_reader import Reading
from zsim_analysis.reading.formation_variables import Formation
from zsim_analysis.report.make_report import formations_of
from zsim_analysis.report.summary import Summary, summarise
from zsim_analysis.sweep.fly.task import Task
from zsim_analysis.sweep.results.row import Result, Row, engaged_column, failed, row
from zsim_world.flight.world import World

REASON_MAX = 300  # characters


def fly(task: Task) -> Row:
    """Return the row of a run; whatever goes wrong in it is told there, and is not the end of the sweep.

    Raises:
        RecordError, OSError: its record cannot be written, nor could that of any other run.
    """
    where = {"host": socket.gethostname(), "fingerprint": fingerprint()}
    try:
        with _record(task) as writer:
            flight, diverged = flown(task.scenario, writer)
        formations = formations_of(flight)
        summary = summarise(flight, formations, Path())  # the world lived to say all that else needs the record
    except (RecordError, OSError):
        raise
    except Exception as error:  # of any kind: the scenario brought it about
        return failed(task, reason_of(error), **where)
    finally:
        gc.collect()
    engaged = engaged_s(formations, summary.window_s)
    return _row(task, flight, summary, engaged, diverged, where)


def reason_of(error: BaseException) -> str:
    """Return what an exception says, in a line."""
    text = " ".join(str(error).split())[:REASON_MAX]
    return text if isinstance(error, ZsimError) and text else f"{type(error).__name__}: {text}"


def flown(scenario: Scenario, writer: RecordWriter | None = None) -> tuple[Flight, Exception | None]:
    """Fly a scenario; return the flight, and how it diverged if it did.

    Args:
        scenario: resolved.
        writer: takes every message as well.
    """
    world, reading = World(scenario, "lockstep", 0.0, time.monotonic_ns), Reading()

    def sink(key: str, message: Any) -> None:
        reading.keep(key, message)
        if writer:
            writer.add_message(key, message, time.time_ns())

    def gate_sink(gate: GateMessages) -> None:
        reading.keep_gate(gate)
        if writer:
            writer.add_gate(gate, time.time_ns())

    bus = Bus(world, agents(world), time.monotonic_ns, sink, gate_sink)
    sink(keys.INFO, world.info())
    bus.join()
    while bus.turn():
        pass
    bus.end()
    return reading.flight(), world.diverged


@contextmanager
def _record(task: Task) -> Iterator[RecordWriter | None]:
    """Yield what writes the record, None where none is kept; one that could not be written whole stays named .part."""
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
    """Return the writer of a new record, in the place of what a former flight left there."""
    part = _part(folder)
    for former in (folder, part):
        rmtree(former, ignore_errors=True)
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
    flight: Flight,
    summary: Summary,
    engaged: dict[str, float | None],
    diverged: Exception | None,
    where: dict[str, str],
) -> Row:
    clusters = [cluster.name for cluster in task.scenario.clusters]
    result = Result(
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
        engaged=all(engaged.get(name) is not None for name in clusters) if clusters else None,
        **where,
    )
    begun = {engaged_column(name): engaged.get(name) for name in clusters}
    return row(result, task.varied, begun if diverged else {**begun, **_errors(summary, engaged)})


def _errors(summary: Summary, engaged: dict[str, float | None]) -> dict[str, float | None]:
    """Return the errors of the formations by their paths in summary.json; `errors` is the first cluster.

    Those of a cluster that was not engaged are None: who stands on the ground holds no formation.
    """
    found = {}
    for i, (name, cluster) in enumerate(summary.clusters.items()):
        prefix = "errors" if i == 0 else f"clusters.{name}.errors"
        for parameter, errors in cluster.errors.items():
            for statistic, value in msgspec.structs.asdict(errors).items():
                found[f"{prefix}.{parameter}.{statistic}"] = None if engaged[name] is None else value
    return found
