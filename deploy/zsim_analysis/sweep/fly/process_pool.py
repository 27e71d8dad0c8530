"""The worker processes of a sweep on this host: one that dies is replaced, and its run is flown again."""

import contextlib
import multiprocessing
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator
from multiprocessing.connection import Connection, wait

from zsim.errors import RunError
from zsim_analysis.sweep.fly.task import Task
from zsim_analysis.sweep.fly.worker import READY, work
from zsim_analysis.sweep.results.row import Row, failed

DEATHS_MAX = 3  # of workers over one run, or one after the other before they are ready; what follows would be the same
LEAVE_S = 5.0  # wall time that an idle worker gets to leave by itself


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Worker:
    """One process and what it is at."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.link, far = context.Pipe()
        self.process = context.Process(target=work, args=(far,), name="zsim-sweep", daemon=True)
        self.process.start()
        far.close()  # so that its death is the end of the link
        self.ready = False
        self.task: Task | None = None

    def give(self, task: Task) -> None:
        """Hand over a task; a worker that died meanwhile is found out when it is heard."""
        self.task = task
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.link.send(task)

    def hear(self) -> Row | str | RuntimeError | None:
        """Return what it says; None when it is dead."""
        try:
            return self.link.recv()
        except (EOFError, OSError):
            self.process.join()
            return None

    def leave(self) -> None:
        """Let it go, at once if it is at work."""
        if self.task is None:
            with contextlib.suppress(OSError):
                self.link.send(None)
            self.process.join(LEAVE_S)
        self.process.kill()
        self.process.join()
        self.link.close()

    def cause(self) -> str:
        """Return how it ended."""
        code = self.process.exitcode or 0
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


class Pool:
    """Flies tasks on worker processes.

    Args:
        count: of workers.
        say: takes a line about a worker that died.
    """

    def __init__(self, count: int, say: Callable[[str], None]) -> None:
        self._count = count
        self._say = say
        self._workers: dict[Connection, Worker] = {}
        self._again: deque[Task] = deque()
        self._deaths: Counter[int] = Counter()
        self._stillborn = 0

    def rows(self, tasks: Iterator[Task]) -> Generator[Row]:
        """Yield the rows of tasks as they are finished; at the end, or when closed, no worker is left.

        Raises:
            RunError: workers cannot start, or no run can be kept.
        """
        try:
            for _ in range(self._count):
                self._start()
            while self._workers:
                for link in wait(list(self._workers)):
                    yield from self._on_word(self._workers[link], tasks)  # type: ignore[index]
        finally:
            for worker in self._workers.values():
                worker.leave()
            self._workers.clear()

    def _start(self) -> None:
        worker = Worker()
        self._workers[worker.link] = worker

    def _on_word(self, worker: Worker, tasks: Iterator[Task]) -> Iterator[Row]:
        word = worker.hear()
        if isinstance(word, RuntimeError):
            raise RunError(str(word))
        if word is None:
            yield from self._on_death(worker)
            return
        if word == READY:
            worker.ready, self._stillborn = True, 0
        else:
            worker.task = None
            yield word  # type: ignore[misc]
        self._give_next(worker, tasks)

    def _give_next(self, worker: Worker, tasks: Iterator[Task]) -> None:
        task = self._again.popleft() if self._again else next(tasks, None)
        if task is not None:
            worker.give(task)
            return
        del self._workers[worker.link]
        worker.leave()

    def _on_death(self, worker: Worker) -> Iterator[Row]:
        """Put another worker in the place of a dead one; a run that was fatal to several gets a row that says so."""
        del self._workers[worker.link]
        worker.link.close()
        self._stillborn += not worker.ready
        if self._stillborn >= DEATHS_MAX:
            raise RunError(
                f"the sweep's workers die before they are ready ({worker.cause()}); see what they said above"
            )
        self._start()
        if worker.task is None:
            return
        run = worker.task.run
        self._deaths[run] += 1
        if self._deaths[run] < DEATHS_MAX:
            self._say(f"the worker of run {run} died ({worker.cause()}); another one flies it again")
            self._again.append(worker.task)
        else:
            yield failed(worker.task, f"{DEATHS_MAX} workers died of it, the last one {worker.cause()}")
