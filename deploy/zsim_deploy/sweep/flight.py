"""Flies one run of a sweep in this process and judges it as `zsim report` would, without a record on disk."""

import gc
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import rmtree
from typing import Any

import msgspec

from zsim import keys, scenario_file
from zsim.bundle import Bundle
from zsim.errors import RecordError, ZsimError
from zsim.fingerprint import fingerprint
from zsim.in_process import Bus
from zsim.record import RecordWriter
from zsim.scenario import Scenario
from zsim_deploy.in_process import agents
from zsim_deploy.report.flight import Flight
from zsim_deploy.report.make import formations_of
from zsim_deploy.report.reading import Reading
from zsim_deploy.report.summary import Summary, summarise
from zsim_deploy.sweep.row import Result, Row, failed, row
from zsim_deploy.sweep.task import Task
from zsim_world.world import World

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
        summary = _summary(flight)
    except (RecordError, OSError):
        raise
    except Exception as error:  # of any kind: the scenario brought it about
        return failed(task, reason_of(error), **where)
    finally:
        gc.collect()
    return _row(task, flight, summary, diverged, where)


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

    def whole(bundle: Bundle) -> None:
        reading.keep_bundle(bundle)
        if writer:
            writer.add_bundle(bundle, time.time_ns())

    bus = Bus(world, agents(world), time.monotonic_ns, sink, whole)
    sink(keys.INFO, world.info())
    bus.join()
    while bus.turn():
        pass
    bus.end()
    return reading.flight(), world.diverged


@contextmanager
def _record(task: Task) -> Iterator[RecordWriter | None]:
    """Yield what writes the record, None where none is kept; a run cut short leaves a folder named .part."""
    if task.record is None:
        yield None
        return
    folder, part = Path(task.record), Path(f"{task.record}.part")
    for former in (folder, part):
        rmtree(former, ignore_errors=True)
    part.mkdir(parents=True)
    (part / "scenario.yaml").write_text(scenario_file.to_text(task.scenario))
    writer = RecordWriter(part / "run.mcap")
    try:
        yield writer
    finally:
        writer.close()
        part.rename(folder)


def _summary(flight: Flight) -> Summary:
    return summarise(flight, formations_of(flight), Path())  # the world lived to say all that else needs the record


def _row(task: Task, flight: Flight, summary: Summary, diverged: Exception | None, where: dict[str, str]) -> Row:
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
        **where,
    )
    return row(result, task.varied, {} if diverged else _errors(summary))


def _errors(summary: Summary) -> dict[str, Any]:
    """Return the errors of the formations by their paths in summary.json; `errors` is the first cluster."""
    found = {}
    for i, (name, cluster) in enumerate(summary.clusters.items()):
        prefix = "errors" if i == 0 else f"clusters.{name}.errors"
        for parameter, errors in cluster.errors.items():
            for statistic, value in msgspec.structs.asdict(errors).items():
                found[f"{prefix}.{parameter}.{statistic}"] = value
    return found
