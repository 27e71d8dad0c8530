"""The workers of a sweep on several hosts: those of a Dask cluster that is running already.

Dask flies a run again whose worker died, and keeps a run that was fatal to several of them from being tried for ever.
"""

import asyncio
import logging
import threading
from collections.abc import Callable, Generator, Iterator
from typing import Any

from distributed import CancelledError, Client, KilledWorker
from distributed import as_completed as _as_completed
from distributed.comm.core import connect

from zsim import __version__
from zsim.errors import RunError
from zsim_analysis.sweep.fly.sweep_run import fly, reason_of
from zsim_analysis.sweep.fly.task import Task
from zsim_analysis.sweep.results.row import Row, failed

AHEAD = 2  # tasks per thread of the cluster, so that none of them waits for us
REACH_S = 5.0  # wall time until a scheduler that does not answer is told

_alone = threading.Lock()


def fly_alone(task: Task) -> Row:
    """Fly a run, one at a time in a process: its threads would only take Python from each other."""
    with _alone:
        return fly(task)


class DaskPool:
    """Flies tasks on a Dask cluster.

    Args:
        address: of the scheduler, e.g. tcp://192.0.2.1:8786.
        say: takes a line about the cluster.

    Raises:
        RunError: nobody answers there, or a worker has not the zsim of this host.
    """

    def __init__(self, address: str, say: Callable[[str], None]) -> None:
        self._address = address
        self._say = say
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what ends the sweep is raised here
        try:
            asyncio.run(_reach(address))  # first, for a client that reaches nobody is slow to give up
            self._client: Any = Client(address, timeout=REACH_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RunError(f"--dask {address}: no scheduler ({reason}); start `dask scheduler` there") from error

    def rows(self, tasks: Iterator[Task]) -> Generator[Row]:
        """Yield the rows of tasks as they are finished; when closed, the cluster forgets the rest.

        Raises:
            RunError: the cluster is gone, or no run can be kept.
        """
        try:
            with self._client:
                yield from self._rows(tasks)
        except (OSError, CancelledError) as error:  # links that break are OSErrors too
            raise RunError(f"--dask {self._address}: the cluster is gone; the same command goes on") from error

    def _rows(self, tasks: Iterator[Task]) -> Generator[Row]:
        self._await_workers()
        flying = _as_completed(loop=self._client.loop)
        asked: dict[str, Task] = {}
        self._fill(flying, asked, tasks)
        for future in flying:
            task = asked.pop(future.key)
            yield self._row(future, task)
            self._fill(flying, asked, tasks)

    def _await_workers(self) -> None:
        if not self._client.nthreads():
            self._say(f"waiting for workers at {self._address}; start `dask worker {self._address}` on every host")
            self._client.wait_for_workers(1)
        versions = self._client.run(_version, on_error="return")
        for worker, version in versions.items():
            if version != __version__:
                found = f"zsim {version}" if isinstance(version, str) else reason_of(version)
                raise RunError(f"--dask {self._address}: worker {worker} has {found}; must have zsim {__version__}")
        self._say(f"{len(versions)} Dask worker{'s'[: len(versions) != 1]} at {self._address}")

    def _fill(self, flying: Any, asked: dict[str, Task], tasks: Iterator[Task]) -> None:
        """Keep as many tasks in the cluster as its workers are to have; new workers may come at any time."""
        while len(asked) < AHEAD * sum(self._client.nthreads().values()):
            task = next(tasks, None)
            if task is None:
                return
            future = self._client.submit(fly_alone, task, key=f"zsim-{id(self)}-{task.run}", pure=False)
            asked[future.key] = task
            flying.add(future)

    def _row(self, future: Any, task: Task) -> Row:
        try:
            return future.result()
        except KilledWorker:
            return failed(task, "several workers died of it, see Dask's allowed-failures")
        except CancelledError:
            raise
        except Exception as error:  # what `fly` raises stands for something that no further run would survive
            raise RunError(f"--dask {self._address}: {reason_of(error)}") from error


async def _reach(address: str) -> None:
    link = await connect(address, timeout=REACH_S)
    await link.close()


def _version() -> str:
    from zsim import __version__ as version

    return version
