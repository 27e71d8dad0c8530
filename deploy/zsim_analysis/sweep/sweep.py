"""A whole sweep: plan in, finished runs in a folder, one table of them."""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

from msgspec import Struct

from zsim.errors import RunError
from zsim_analysis.sweep.fly.process_pool import Pool, cores
from zsim_analysis.sweep.fly.task import Task
from zsim_analysis.sweep.results.row import Row
from zsim_analysis.sweep.screen import SweepScreen
from zsim_analysis.sweep.sweep_folder import Folder, locked
from zsim_analysis.sweep.sweep_plan import Plan

NEEDED = {"sweep": ("pyarrow", "numba", "filterpy", "mcap", "matplotlib", "jinja2"), "dask": ("distributed",)}


class Order(Struct, frozen=True):
    """What is to be done.

    Attributes:
        plan: what is flown.
        out: folder of the sweep.
        workers: processes on this host, None: one per core.
        dask: address of a Dask scheduler whose workers fly instead.
    """

    plan: Plan
    out: Path
    workers: int | None = None
    dask: str | None = None


class Flyers(Protocol):
    """Whoever flies tasks."""

    def rows(self, tasks: Iterator[Task]) -> Generator[Row]:
        """Yield the rows of tasks as they are finished; closed, fly no further."""
        ...


def check_installed(dask: bool) -> None:
    """Refuse to begin what this installation cannot do.

    Raises:
        RunError: an extra is missing.
    """
    for extra, modules in NEEDED.items():
        missing = [module for module in modules if find_spec(module) is None]
        if missing and (extra == "sweep" or dask):
            raise RunError(f"zsim sweep: {missing[0]} is not installed; install zsim[{extra}]")


def sweep(order: Order) -> list[Row]:
    """Fly what the folder does not hold yet; return all that it holds then, also after Ctrl-C.

    Raises:
        RunError: the folder holds something else, or cannot be written; workers cannot start.
        KeyboardInterrupt: the finished runs are in the table.
    """
    with locked(order.out, order.plan) as folder:
        done = {row["run"] for row in folder.compact()}
        missing = [run for run in range(order.plan.runs) if run not in done]
        with SweepScreen(order.plan.runs, len(done)) as screen:
            _say_start(folder, len(done), screen.say)
            try:
                if missing:
                    _fly(folder, _flyers(order, len(missing), screen.say), missing, screen)
            finally:
                rows = folder.compact()
    return rows


def _say_start(folder: Folder, done: int, say: Callable[[str], None]) -> None:
    plan, points = folder.plan, folder.design.points
    over = f" over {points} combinations" if points > 1 else ""
    say(f"{plan.source}: {plan.runs} runs{over}, into {folder.path}")
    if done:
        say(f"{done} of them {'is' if done == 1 else 'are'} done already")


def _flyers(order: Order, missing: int, say: Callable[[str], None]) -> Flyers:
    if order.dask is None:
        return Pool(min(order.workers or cores(), missing), say)
    from zsim_analysis.sweep.fly.dask_pool import DaskPool

    return DaskPool(order.dask, say)


def _fly(folder: Folder, flyers: Flyers, missing: list[int], screen: SweepScreen) -> None:
    with folder.journal() as journal, closing(flyers.rows(_tasks(folder, missing))) as rows:
        for row in rows:
            journal.append(row)
            screen.finished(row["failure"] is not None)


def _tasks(folder: Folder, runs: list[int]) -> Iterator[Task]:
    """Yield the tasks of some runs, each made when it is asked for."""
    design = folder.design
    for run in runs:
        values = design.values(run)
        yield Task(
            run=run,
            point=design.point(run),
            varied={path: values[path] for path in design.varied},
            scenario=design.scenario(run),
            record=str(folder.record(run).absolute()) if folder.plan.records else None,
        )
