"""Sweeps whose runs fly in the process of the test, because a worker process takes a second for its imports."""

import sys

import pytest

from zsim.schema import plugin
from zsim_analysis.sweep import process_pool
from zsim_analysis.sweep.process_pool import READY
from zsim_analysis.sweep.sweep_run import Row, Task, fly


class NearWorker:
    """A worker that flies runs in this process."""

    def __init__(self) -> None:
        self.link, self._far = process_pool.multiprocessing.Pipe()
        self.ready = False
        self.task: Task | None = None
        self._far.send(READY)

    def send(self, task: Task) -> None:
        self.task = task
        self._far.send(fly(task))

    def receive(self) -> Row:
        return self.link.recv()

    def stop(self) -> None:
        self._far.close()
        self.link.close()


def sweep_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fly the runs of sweeps in this process."""
    monkeypatch.setattr(process_pool, "WorkerProcess", NearWorker)
    monkeypatch.setenv(plugin.FOLDERS, "")
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.fixture
def near(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep_here(monkeypatch)
