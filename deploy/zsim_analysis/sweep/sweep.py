"""Flies a whole sweep: plan in; finished runs in a folder, and their table, out; a live line on the terminal."""

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from pathlib import Path
from typing import Protocol

from msgspec import Struct
from rich.console import Console
from rich.live import Live
from rich.text import Text

from zsim.runtime.progress import cell
from zsim.runtime.rate_limit import RateLimit
from zsim_analysis.sweep.design import SweepPlan
from zsim_analysis.sweep.process_pool import ProcessPool, cores
from zsim_analysis.sweep.sweep_folder import SweepFolder, locked
from zsim_analysis.sweep.sweep_run import Row, Task

PLAIN_S = 10.0  # wall time between two lines where no terminal is
BAR = 20  # characters
UNMEASURED_MAX = 5  # lines about runs without figures of the user's own


class SweepScreen:
    """Shows how far a sweep is, while it is entered.

    Args:
        total: runs of the plan.
        done: of them before this start.
        now_s: monotonic wall time.
    """

    def __init__(
        self, total: int, done: int, console: Console | None = None, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.console = console or Console(stderr=True)
        self._total = total
        self._before = self._done = done
        self._failed = 0
        self._unmeasured = 0
        self._now_s = now_s
        self._start_s = now_s()
        self._throttle = RateLimit(PLAIN_S)
        self._live = Live(console=self.console, get_renderable=self._text, refresh_per_second=5, transient=True)

    def __enter__(self) -> "SweepScreen":
        self._start_s = self._now_s()
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.console.is_terminal:
            self._live.stop()
        elif self._done > self._before:
            self.say(self.line())

    def say(self, text: str) -> None:
        """Show a line that stays."""
        self.console.print(cell(text), soft_wrap=True)

    def finished(self, failed: bool) -> None:
        """Count a run."""
        self._done += 1
        self._failed += failed
        if not self.console.is_terminal and self._done < self._total and self._throttle.spend():
            self.say(self.line())

    def unmeasured(self, run: int, reason: str) -> None:
        """Show a line about a run that has no figures of the user's own, for the first such runs."""
        self._unmeasured += 1
        if self._unmeasured <= UNMEASURED_MAX:
            more = "; further ones are in the table" if self._unmeasured == UNMEASURED_MAX else ""
            self.say(f"run {run}: {reason}{more}")

    def line(self) -> str:
        """Return runs done, runs per hour since the start, and time to go at that rate."""
        filled = int(BAR * self._done / self._total)
        text = f"{'█' * filled}{'░' * (BAR - filled)} {self._done} / {self._total} runs"
        flown, elapsed_s = self._done - self._before, self._now_s() - self._start_s
        if flown and elapsed_s > 0:
            text += f"  {3600 * flown / elapsed_s:,.0f} runs/h"
            if self._done < self._total:
                text += f"  {span((self._total - self._done) * elapsed_s / flown)} to go"
        elif self._done < self._total:
            text += f"  the first ones are flying, {span(elapsed_s)}"
        return text + (f"  {self._failed} failed" if self._failed else "")

    def _text(self) -> Text:
        return cell(self.line())


def span(seconds: float) -> str:
    """Return a time as text, to the second below an hour."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


class SweepRequest(Struct, frozen=True):
    """What to fly, where to, and by which processes.

    Attributes:
        plan: what is flown.
        out: folder of the sweep.
        workers: processes on this host, None: one per core.
        dask: address of a Dask scheduler whose workers are used instead.
        force: whether the folder may hold other files.
    """

    plan: SweepPlan
    out: Path
    workers: int | None = None
    dask: str | None = None
    force: bool = False


class WorkerPool(Protocol):
    """Flies tasks on worker processes, here or on other hosts."""

    def rows(self, tasks: Iterator[Task]) -> Generator[Row]:
        """Yield the rows of tasks as they are finished; when closed, fly no further."""
        ...


def sweep(request: SweepRequest) -> list[Row]:
    """Fly what the folder does not hold yet; return all that it holds then, also after Ctrl-C.

    Raises:
        RunError: the folder holds something else, or cannot be written; workers cannot start.
        KeyboardInterrupt: the finished runs are in the table.
    """
    with locked(request.out, request.plan, request.force) as folder:
        done = {row["run"] for row in folder.compact()}
        missing = [run for run in range(request.plan.runs) if run not in done]
        with SweepScreen(request.plan.runs, len(done)) as screen:
            _say_start(folder, len(done), screen.say)
            try:
                if missing:
                    _fly(folder, _pool(request, len(missing), screen.say), missing, screen)
            finally:
                rows = folder.compact()
    return rows


def _say_start(folder: SweepFolder, done: int, say: Callable[[str], None]) -> None:
    plan, points = folder.plan, folder.design.points
    over = f" over {points} combinations" if points > 1 else ""
    say(f"{plan.source}: {plan.runs} runs{over}, into {folder.path}")
    if done:
        say(f"{done} of them {'is' if done == 1 else 'are'} done already")


def _pool(request: SweepRequest, missing: int, say: Callable[[str], None]) -> WorkerPool:
    if request.dask is None:
        return ProcessPool(min(request.workers or cores(), missing), say)
    from zsim_analysis.sweep.dask_pool import DaskPool

    return DaskPool(request.dask, say)


def _fly(folder: SweepFolder, pool: WorkerPool, missing: list[int], screen: SweepScreen) -> None:
    with folder.journal() as journal, closing(pool.rows(_tasks(folder, missing))) as rows:
        for row in rows:
            journal.append(row)
            screen.finished(row["failure"] is not None)
            if row.get("metrics_failure"):
                screen.unmeasured(row["run"], row["metrics_failure"])


def _tasks(folder: SweepFolder, runs: list[int]) -> Iterator[Task]:
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
