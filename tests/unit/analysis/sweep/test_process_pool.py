"""The pool that flies the runs of a sweep in workers that may die."""

import multiprocessing
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from refused import has_terms, refused
from short_flight import ONE

from zsim.errors import RunError
from zsim.scenario import scenario_file
from zsim_analysis.sweep import process_pool
from zsim_analysis.sweep.process_pool import READY, WorkerProcess
from zsim_analysis.sweep.sweep_run import Row, Task


def task(run: int) -> Task:
    return Task(run, 1, {}, scenario_file.from_text(ONE))


class FakeWorker:
    """A worker without a process, which completes a run at once or dies of it according to `dies_of`."""

    dies_of: dict[int, int]  # by run: number of workers that it will still kill
    stillborn = 0  # number of next workers that will not become ready
    answer: Any = None
    flown: list[int]
    alive: set["FakeWorker"]

    def __init__(self) -> None:
        self.link, self._far = multiprocessing.Pipe()
        self.ready = False
        self.task: Task | None = None
        FakeWorker.alive.add(self)
        if FakeWorker.stillborn:
            FakeWorker.stillborn -= 1
            self._die()
        else:
            self._far.send(READY)

    def send(self, task: Task) -> None:
        self.task = task
        if FakeWorker.dies_of.get(task.run, 0):
            FakeWorker.dies_of[task.run] -= 1
            self._die()
        else:
            FakeWorker.flown.append(task.run)
            self._far.send(FakeWorker.answer or {"run": task.run, "failure": None})

    def receive(self) -> Any:
        try:
            return self.link.recv()
        except EOFError:
            return None

    def stop(self) -> None:
        self._die()
        self.link.close()

    def cause(self) -> str:
        return "killed by SIGKILL"

    def _die(self) -> None:
        FakeWorker.alive.discard(self)
        self._far.close()


@pytest.fixture(autouse=True)
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(process_pool, "WorkerProcess", FakeWorker)
    monkeypatch.setattr(FakeWorker, "stillborn", 0)
    monkeypatch.setattr(FakeWorker, "answer", None)
    FakeWorker.dies_of, FakeWorker.flown, FakeWorker.alive = {}, [], set()
    yield
    assert FakeWorker.alive == set()


def rows(count: int, lines: list[str], workers: int = 2) -> list[Row]:
    return list(process_pool.ProcessPool(workers, lines.append).rows(task(run=run) for run in range(count)))


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_run_is_flown_once(workers: int) -> None:
    lines: list[str] = []
    found = rows(9, lines, workers)
    assert sorted(row["run"] for row in found) == sorted(FakeWorker.flown) == list(range(9))
    assert lines == []


def test_the_run_of_a_dead_worker_is_flown_again() -> None:
    lines: list[str] = []
    FakeWorker.dies_of = {0: 1, 4: 2}
    found = rows(6, lines)
    assert sorted(FakeWorker.flown) == list(range(6))
    assert [row["failure"] for row in found] == [None] * 6
    assert len(lines) == 3
    for run, line in zip((0, 4), sorted(set(lines)), strict=True):
        assert has_terms(line, f"run {run}", "died", "SIGKILL")


def test_a_run_that_kills_every_worker_is_a_row_with_the_failure() -> None:
    lines: list[str] = []
    FakeWorker.dies_of = {2: 99}
    found = {row["run"]: row["failure"] for row in rows(5, lines)}
    assert has_terms(found.pop(2), "3", "died", "killed", "SIGKILL")
    assert found == dict.fromkeys((0, 1, 3, 4))


def test_workers_that_cannot_start_or_fail_fatally_end_the_sweep() -> None:
    FakeWorker.stillborn = 2  # these are replaced
    assert len(rows(5, [])) == 5
    FakeWorker.stillborn = 99
    with refused(RunError, "killed", "SIGKILL"):
        rows(5, [])
    FakeWorker.stillborn, FakeWorker.answer = 0, RuntimeError("no space left")
    with refused(RunError, "no space left"):
        rows(5, [])


def test_a_closed_sweep_leaves_no_worker() -> None:
    flying = process_pool.ProcessPool(2, lambda _: None).rows(task(run=run) for run in range(50))
    next(flying)
    flying.close()
    assert FakeWorker.alive == set()


def test_a_worker_does_not_import_from_the_working_folder_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A spawned interpreter starts with `-c`, which puts that folder before the standard library."""
    (tmp_path / "signal.py").write_text("open('executed', 'w').close()\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    worker = WorkerProcess()
    ready = worker.receive()
    worker.stop()
    assert ready == READY
    assert not (tmp_path / "executed").exists()
    assert "PYTHONSAFEPATH" not in os.environ
