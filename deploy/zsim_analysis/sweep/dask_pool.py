"""The workers of a sweep on several hosts: a running Dask cluster.

Dask repeats a run whose worker died, and gives up on a run in which several workers died.
"""

import asyncio
import logging
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from distributed import CancelledError, Client, KilledWorker, WorkerPlugin
from distributed import as_completed as _as_completed
from distributed.comm.core import connect

from zsim import __version__
from zsim.errors import RunError, reason_of
from zsim.schema import plugin
from zsim.schema.checker import show
from zsim_analysis.sweep.sweep_run import Row, Task, failed_row, fly

TASKS_PER_THREAD = 2  # tasks per thread of the cluster, so that no thread idles
CONNECT_S = 5.0  # wall time within which a scheduler must answer

_alone = threading.Lock()


def fly_alone(task: Task) -> Row:
    """Fly a run, one at a time in each process, since more threads would only wait for each other."""
    with _alone:
        return fly(task)


class UserCode(WorkerPlugin):
    """Makes definitions of a notebook or a script importable on all workers, including those that join later.

    Args:
        modules: source texts by file name.
        folders: further folders to search for modules, if a worker's host has them.
    """

    name = "zsim-user-code"

    def __init__(self, modules: Mapping[str, str], folders: Sequence[Path]) -> None:
        self._modules, self._folders = dict(modules), tuple(folders)

    def setup(self, worker: Any) -> None:
        folder = Path(worker.local_directory) / self.name
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in self._modules.items():
            (folder / name).write_text(text, encoding="utf-8")
        plugin.search(folder, *self._folders, *plugin.folders())


class DaskPool:
    """Flies tasks on a Dask cluster.

    Args:
        cluster: a client, which stays open, or the address of a scheduler.
        modules: see `UserCode`.

    Raises:
        RunError: no scheduler answers.
    """

    def __init__(self, cluster: Any, say: Callable[[str], None], modules: Mapping[str, str] = {}) -> None:
        self._say = say
        self._modules = modules
        self._is_lent = not isinstance(cluster, str)
        if self._is_lent:
            self._client = _checked(cluster)
            self._address, self._origin = self._client.scheduler.address, "client"
            return
        self._address, self._origin = cluster, f"--dask {cluster}"
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # errors that end the sweep are raised

        async def connect_once() -> None:
            await (await connect(cluster, timeout=CONNECT_S)).close()

        try:
            asyncio.run(connect_once())  # tried first, because a client takes long to give up
            self._client: Any = Client(cluster, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RunError(f"{self._origin}: no scheduler ({reason}); start `dask scheduler` there") from error

    def rows(self, tasks: Iterator[Task]) -> Generator[Row]:
        """Yield the rows of tasks as they finish; when closed, the cluster drops the rest.

        Raises:
            RunError: the cluster is gone, a worker has another zsim version, or rows cannot be recorded.
        """
        pending: dict[Any, Task] = {}  # tasks by future
        try:
            with nullcontext() if self._is_lent else self._client:
                try:
                    self._prepare()
                    flying: Any = _as_completed(loop=self._client.loop)
                    self._fill(flying, pending, tasks)
                    for future in flying:
                        task = pending.pop(future)
                        try:
                            row = future.result()
                        except KilledWorker:
                            row = failed_row(task, "several workers died while flying it; see Dask's allowed-failures")
                        except CancelledError:
                            raise
                        except Exception as error:  # raised by `fly` if every further run would fail as well
                            raise RunError(f"{self._origin}: {reason_of(error)}") from error
                        yield row
                        self._fill(flying, pending, tasks)
                finally:
                    if self._is_lent and pending:
                        self._client.cancel(list(pending))
        except (OSError, CancelledError) as error:  # broken links are OSErrors, too
            raise RunError(f"{self._origin}: the cluster is gone; the same command continues") from error

    def _prepare(self) -> None:
        """Wait for workers, check that they have this version of zsim, and send them the user's modules."""
        if not self._client.nthreads():
            self._say(f"waiting for workers at {self._address}; start `dask worker {self._address}` on every host")
            self._client.wait_for_workers(1)
        versions = self._client.run(_version, on_error="return")
        for worker, version in versions.items():
            if version != __version__:
                found = f"zsim {version}" if isinstance(version, str) else reason_of(version)
                raise RunError(f"{self._origin}: worker {worker} has {found}; must have zsim {__version__}")
        self._client.register_plugin(UserCode(self._modules, plugin.folders()))
        self._say(f"{len(versions)} Dask worker{'s'[: len(versions) != 1]} at {self._address}")

    def _fill(self, flying: Any, pending: dict[Any, Task], tasks: Iterator[Task]) -> None:
        """Submit tasks up to TASKS_PER_THREAD per thread of the cluster; new workers may join at any time."""
        while len(pending) < TASKS_PER_THREAD * sum(self._client.nthreads().values()):
            task = next(tasks, None)
            if task is None:
                return
            future = self._client.submit(fly_alone, task, key=f"zsim-{id(self)}-{task.run}", pure=False)
            pending[future] = task
            flying.add(future)


def _checked(client: Any) -> Any:
    """Return `client` if it is a connected synchronous Client; raise RunError otherwise."""
    if not isinstance(client, Client) or client.asynchronous or client.status != "running":
        fault = "that is closed" if isinstance(client, Client) and client.status != "running" else "asynchronous"
        description = f"a Client {fault}" if isinstance(client, Client) else show(str(type(client).__name__))
        raise RunError(f"client is {description}; must be a distributed.Client that is connected and not asynchronous")
    return client


def _version() -> str:
    from zsim import __version__ as version

    return version
