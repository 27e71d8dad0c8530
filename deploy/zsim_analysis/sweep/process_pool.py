"""The worker processes of a sweep on this host; a worker that dies is replaced, and its run is repeated.

Each worker flies many runs, so that modules and kernels are loaded only once. `ProcessPoolExecutor` is not used: when a
worker dies, it fails as a whole, without showing which run was fatal.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import TYPE_CHECKING

from zsim.errors import RunError
from zsim.transport.zenoh_settings import SESSION_FILES, WORKER_FILES, require_files

if TYPE_CHECKING:
    from zsim_analysis.sweep.sweep_run import Row, Task

READY, _END = "ready", "end"
SAFE_PATH = "PYTHONSAFEPATH"  # environment variable that keeps the working folder off Python's module search path
DEATHS_MAX = 3  # maximum number of worker deaths in the same run, or in succession before any worker is ready
EXIT_S = 5.0  # wall time granted to an idle worker to exit on its own


def work(link: Connection) -> None:
    """Fly the tasks received on a link and send back their rows, until `None` is received or the launcher dies.

    A RuntimeError is sent instead of a row if every further run would fail as well.
    """

    def exit_with_launcher() -> None:
        if (launcher := parent_process()) is not None:
            wait([launcher.sentinel])
            os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the launcher receives and handles it
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=exit_with_launcher, name="launcher-monitor", daemon=True).start()
    warnings.simplefilter("ignore", RuntimeWarning)  # a state that overflows is reported in the run's row
    from zsim_analysis.sweep.sweep_run import fly  # after the signal handlers are set, since the import takes seconds

    link.send(READY)
    try:
        while (task := link.recv()) is not None:
            try:
                result = fly(task)
            except Exception as error:
                result = RuntimeError(str(error))
            link.send(result)
    except (EOFError, BrokenPipeError):
        return


def cores() -> int:
    """Return the number of cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def _bare_start() -> Iterator[None]:
    """Keep processes started in this context from importing the working folder's modules or the main module.

    `spawn` imports the main module again, which would rerun a script without `if __name__ == "__main__"`. Workers do
    not need it, since classes defined in a script are written to a module of their own.
    """
    main, previous = sys.modules["__main__"], os.environ.get(SAFE_PATH)
    sys.modules["__main__"] = ModuleType("__main__")
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        del os.environ[SAFE_PATH]
        if previous is not None:
            os.environ[SAFE_PATH] = previous


class WorkerProcess:
    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.link, worker_end = context.Pipe()
        self.process = context.Process(target=work, args=(worker_end,), name="zsim-sweep", daemon=True)
        with _bare_start():
            self.process.start()
        worker_end.close()  # so that `recv` fails once the process is dead
        self.ready = False
        self.task: Task | None = None

    def send(self, task: Task) -> None:
        """Send a task to the worker; if it is dead, `receive` reports that."""
        self.task = task
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.link.send(task)

    def receive(self) -> Row | str | RuntimeError | None:
        """Return the worker's next message; None if it is dead."""
        try:
            return self.link.recv()
        except (EOFError, OSError):
            self.process.join()
            return None

    def stop(self) -> None:
        """End the process, at once if it is flying a task."""
        if self.task is None:
            with contextlib.suppress(OSError):
                self.link.send(None)
            self.process.join(EXIT_S)
        self.process.kill()
        self.process.join()
        self.link.close()

    def cause(self) -> str:
        code = self.process.exitcode or 0
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


class ProcessPool:
    def __init__(self, count: int, say: Callable[[str], None]) -> None:
        self._count = count
        self._say = say
        self._workers: dict[Connection, WorkerProcess] = {}
        self._retries: deque[Task] = deque()
        self._deaths: Counter[int] = Counter()
        self._deaths_at_start = 0

    def rows(self, tasks: Iterator[Task | None]) -> Generator[Row]:
        """Yield the row of each task as it finishes; once the generator is exhausted or closed, all workers have ended.

        `tasks` yields None while its next task depends on unfinished rows, and is resumed after the next row.

        Raises:
            RunError: workers cannot start, or rows cannot be recorded.
        """
        require_files(SESSION_FILES + WORKER_FILES * self._count, f"{self._count} workers")
        try:
            for _ in range(self._count):
                self._start()
            while self._workers:
                for link in wait(list(self._workers)):
                    if worker := self._workers.get(link):  # type: ignore[call-overload]
                        yield from self._on_message(worker)
                        self._hand_out(tasks)
        finally:
            for worker in self._workers.values():
                worker.stop()
            self._workers.clear()

    def _start(self) -> None:
        worker = WorkerProcess()
        self._workers[worker.link] = worker

    def _hand_out(self, tasks: Iterator[Task | None]) -> None:
        """Give each idle worker a task, or stop it if no task is left."""
        for worker in [each for each in self._workers.values() if each.ready and each.task is None]:
            task = self._retries.popleft() if self._retries else next(tasks, _END)
            if isinstance(task, str):
                del self._workers[worker.link]
                worker.stop()
            elif task is not None:
                worker.send(task)

    def _on_message(self, worker: WorkerProcess) -> Iterator[Row]:
        message = worker.receive()
        if isinstance(message, RuntimeError):
            raise RunError(str(message))
        if message is None:
            yield from self._on_death(worker)
            return
        if message == READY:
            worker.ready, self._deaths_at_start = True, 0
        else:
            worker.task = None
            yield message  # type: ignore[misc]

    def _on_death(self, worker: WorkerProcess) -> Iterator[Row]:
        """Replace a dead worker and repeat its run; after DEATHS_MAX deaths in the same run, yield a failed row."""
        del self._workers[worker.link]
        worker.link.close()
        self._deaths_at_start += not worker.ready
        if self._deaths_at_start >= DEATHS_MAX:
            raise RunError(
                f"the sweep's workers die before they are ready ({worker.cause()}); see their messages above"
            )
        self._start()
        if worker.task is None:
            return
        run = worker.task.run
        self._deaths[run] += 1
        if self._deaths[run] < DEATHS_MAX:
            self._say(f"the worker of run {run} died ({worker.cause()}); another worker repeats it")
            self._retries.append(worker.task)
        else:
            from zsim_analysis.sweep.sweep_run import failed_row

            yield failed_row(worker.task, f"{DEATHS_MAX} workers died while flying it (the last one: {worker.cause()})")
