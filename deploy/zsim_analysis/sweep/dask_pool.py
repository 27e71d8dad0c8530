"""The workers of a sweep on several hosts: those of a running Dask cluster.

Dask repeats a run whose worker died, and gives up a run in which several workers died.
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
from zsim.errors import RunError, reason_of
from zsim_analysis.sweep.sweep_run import Row, Task, failed_row, fly

AHEAD = 2  # tasks per thread of the cluster, so that none of them idles
CONNECT_S = 5.0  # wall time within which a scheduler must answer

_alone = threading.Lock()


def fly_alone(task: Task) -> Row:
    """Fly a run, one at a time in each process, whose threads would only wait for each other."""
    with _alone:
        return fly(task)


class DaskPool:
    """Flies tasks on a Dask cluster.

    Raises:
        RunError: no scheduler answers there, or a worker has another zsim than this host.
    """

    def __init__(self, address: str, say: Callable[[str], None]) -> None:
        self._address = address
        self._say = say
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # errors that end the sweep are raised

        async def connect_once() -> None:
            await (await connect(address, timeout=CONNECT_S)).close()

        try:
            asyncio.run(connect_once())  # first, since a client takes long to give up
            self._client: Any = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RunError(f"--dask {address}: no scheduler ({reason}); start `dask scheduler` there") from error

    def rows(self, tasks: Iterator[Task]) -> Generator[Row]:
        """Yield the rows of tasks as they are finished; when closed, the cluster drops the rest.

        Raises:
            RunError: the cluster is gone, or rows cannot be recorded.
        """
        pending: dict[str, Task] = {}
        try:
            with self._client:
                if not self._client.nthreads():
                    at = self._address
                    self._say(f"waiting for workers at {at}; start `dask worker {at}` on every host")
                    self._client.wait_for_workers(1)
                versions = self._client.run(_version, on_error="return")
                for worker, version in versions.items():
                    if version != __version__:
                        present = f"zsim {version}" if isinstance(version, str) else reason_of(version)
                        must = f"must have zsim {__version__}"
                        raise RunError(f"--dask {self._address}: worker {worker} has {present}; {must}")
                self._say(f"{len(versions)} Dask worker{'s'[: len(versions) != 1]} at {self._address}")
                flying: Any = _as_completed(loop=self._client.loop)
                self._fill(flying, pending, tasks)
                for future in flying:
                    task = pending.pop(future.key)
                    try:
                        row = future.result()
                    except KilledWorker:
                        row = failed_row(task, "several workers died of it, see Dask's allowed-failures")
                    except CancelledError:
                        raise
                    except Exception as error:  # raised by `fly`: every further run would fail as well
                        raise RunError(f"--dask {self._address}: {reason_of(error)}") from error
                    yield row
                    self._fill(flying, pending, tasks)
        except (OSError, CancelledError) as error:  # broken links are OSErrors too
            raise RunError(f"--dask {self._address}: the cluster is gone; the same command goes on") from error

    def _fill(self, flying: Any, pending: dict[str, Task], tasks: Iterator[Task]) -> None:
        """Submit tasks up to AHEAD per thread of the cluster; new workers may join at any time."""
        while len(pending) < AHEAD * sum(self._client.nthreads().values()):
            task = next(tasks, None)
            if task is None:
                return
            future = self._client.submit(fly_alone, task, key=f"zsim-{id(self)}-{task.run}", pure=False)
            pending[future.key] = task
            flying.add(future)


def _version() -> str:
    from zsim import __version__ as version

    return version
