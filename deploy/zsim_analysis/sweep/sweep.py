"""Flies the runs of a plan, records them in the sweep's folder, and shows progress on the terminal.

The folder of a sweep:

    plan.json        the plan
    journal.jsonl    finished runs that are not yet in the table, one JSON line each
    sweep.parquet    finished runs, one row each
    runs/000012/     record of run 12, if records are kept
"""

import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Self

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct
from rich.console import Console
from rich.live import Live

from zsim.errors import OTHER_OUT, ReportError, RunError, file_fault, printable
from zsim.output_folder import RECORD, locked_folder, no_locks
from zsim.runtime.progress import NotebookLine, cell
from zsim.runtime.rate_limit import RateLimit
from zsim.schema import plugin
from zsim_analysis.report import indented_json
from zsim_analysis.sweep.design import PLAN, SEED, Axis, Grid, SweepDesign, SweepPlan, difference, is_sweep
from zsim_analysis.sweep.process_pool import ProcessPool, cores
from zsim_analysis.sweep.sweep_run import FIXED, Row, Task

JOURNAL, TABLE, RUNS, LOCK = "journal.jsonl", "sweep.parquet", "runs", ".lock"
NEW_PLAN = f".{PLAN}.new"
PLAN_METADATA = b"zsim_sweep"  # key of the plan in the table's metadata
PLAIN_S = 10.0  # wall time between progress lines if there is no terminal
BAR = 20  # width of the progress bar [characters]
FAILURES_MAX = 5  # maximum number of failure reasons printed
UNMEASURED_MAX = 5  # maximum number of runs reported as lacking the user's metrics
_TYPES: dict[Any, pa.DataType] = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}


class SweepRequest(Struct, frozen=True):
    """A sweep to fly: its plan, its folder and its workers."""

    plan: SweepPlan
    out: Path  # folder of the sweep
    workers: int | None = None  # number of processes on this host; None: one per core
    dask: Any = None  # Dask client, or address of a Dask scheduler, whose workers fly the runs; None: this host
    force: bool = False  # whether the folder may hold other files
    console: Console | None = None  # where progress is shown; None: stderr
    open_run: Callable[[Path], Any] | None = None  # see Task
    modules: tuple[Path, ...] = ()  # generated from definitions in a notebook or script; copied into the folder


def sweep(request: SweepRequest) -> list[Row]:
    """Fly the runs that are missing from the folder; return the rows of all finished runs.

    Raises:
        RunError: the folder holds something else, is in use or cannot be written, or workers cannot start.
        ReportError: the table cannot be read or written.
        KeyboardInterrupt: on Ctrl-C, with the finished runs in the table.
    """
    plan = request.plan
    with locked(request.out, plan, request.force) as folder:
        for module in request.modules:
            shutil.copy(module, folder.path)
        plugin.search(*plugin.folders(), folder.path)
        done = {row["run"] for row in folder.compact()}
        missing = [run for run in range(plan.runs) if run not in done]
        with SweepScreen(plan.runs, len(done), request.console) as screen:
            points = folder.design.points
            extent = f" over {points} combinations" if points > 1 else ""
            screen.say(f"{plan.source}: {plan.runs} runs{extent}, into {folder.path}")
            if done:
                screen.say(f"{len(done)} of them {'is' if len(done) == 1 else 'are'} already done")
            try:
                if missing:
                    _fly(folder, request, missing, screen)
            finally:
                rows = folder.compact()
        for line in failures(rows):
            screen.say(line)
    return rows


def failures(rows: Sequence[Row]) -> list[str]:
    """Return a line for each of the most frequent failures."""
    counted = Counter(row["failure"] for row in rows if row["failure"])
    return [f"{count} of {len(rows)} runs failed: {text}" for text, count in counted.most_common(FAILURES_MAX)]


def _fly(folder: "SweepFolder", request: SweepRequest, missing: list[int], screen: "SweepScreen") -> None:
    if request.dask is None:
        pool = ProcessPool(min(request.workers or cores(), len(missing)), screen.say)
    else:
        from zsim_analysis.sweep.dask_pool import DaskPool

        modules = {file.name: file.read_text(encoding="utf-8") for file in folder.path.glob(f"{plugin.MADE}*.py")}
        pool = DaskPool(request.dask, screen.say, modules)
    with (
        folder.journal() as journal,
        closing(pool.rows(_tasks(folder, missing, request.open_run))) as rows,
    ):
        for row in rows:
            journal.append(row)
            screen.finished(row["failure"] is not None)
            if row.get("metrics_failure"):
                screen.unmeasured(row["run"], row["metrics_failure"])


def _tasks(folder: "SweepFolder", runs: list[int], open_run: Callable[[Path], Any] | None) -> Iterator[Task]:
    """Yield the task of each run, built only when it is needed."""
    design = folder.design
    for run in runs:
        values = design.values(run)
        yield Task(
            run=run,
            point=design.point(run),
            varied={path: values[path] for path in design.varied},
            scenario=design.scenario(run),
            record=str(folder.record(run).absolute()) if folder.plan.records else None,
            open_run=open_run,
        )


class SweepScreen:
    """Context manager that shows a sweep's progress: a live line on a terminal or in a notebook, else plain lines."""

    def __init__(
        self, total: int, done: int, console: Console | None = None, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.console = console or Console(stderr=True)
        self._total = total
        self._done_at_start = self._done = done
        self._failed = 0
        self._unmeasured = 0
        self._now_s = now_s
        self._start_s = now_s()
        self._throttle = RateLimit(PLAIN_S)
        self._cell: NotebookLine | None = None
        self._live = Live(
            console=self.console, get_renderable=lambda: cell(self.line()), refresh_per_second=5, transient=True
        )

    def __enter__(self) -> Self:
        self._start_s = self._now_s()
        if self.console.is_terminal:
            self._live.start()
        elif self.console.is_jupyter and not self.console.quiet:
            self._cell = NotebookLine()
            self._cell.update(self.line())
        return self

    def __exit__(self, *_: object) -> None:
        if self.console.is_terminal:
            self._live.stop()
        elif self._cell:
            self._cell.update(self.line())
        elif self._done > self._done_at_start:
            self.say(self.line())

    def say(self, text: str) -> None:
        self.console.print(cell(text), soft_wrap=True)

    def finished(self, failed: bool) -> None:
        self._done += 1
        self._failed += failed
        if self._cell:
            self._cell.update(self.line())
        elif not self.console.is_terminal and self._done < self._total and self._throttle.spend():
            self.say(self.line())

    def unmeasured(self, run: int, reason: str) -> None:
        """Report a run without the user's metrics; only the first UNMEASURED_MAX are reported."""
        self._unmeasured += 1
        if self._unmeasured <= UNMEASURED_MAX:
            hint = "; further ones are in the table" if self._unmeasured == UNMEASURED_MAX else ""
            self.say(f"run {run}: {reason}{hint}")

    def line(self) -> str:
        """Return a text on the finished runs, the runs per hour since the start, and the time left at that rate."""
        filled = int(BAR * self._done / self._total)
        text = f"{'█' * filled}{'░' * (BAR - filled)} {self._done} / {self._total} runs"
        finished, elapsed_s = self._done - self._done_at_start, self._now_s() - self._start_s
        if finished and elapsed_s > 0:
            text += f"  {3600 * finished / elapsed_s:,.0f} runs/h"
            if self._done < self._total:
                text += f"  {duration_text((self._total - self._done) * elapsed_s / finished)} to go"
        elif self._done < self._total:
            text += f"  the first runs are flying, {duration_text(elapsed_s)}"
        return text + (f"  {self._failed} failed" if self._failed else "")


def duration_text(seconds: float) -> str:
    """Format a duration: to the second below one hour, otherwise to the minute."""
    minutes, remainder = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {remainder:02d} s" if minutes else f"{remainder} s"


# The folder


class SweepFolder:
    def __init__(self, path: Path, plan: SweepPlan) -> None:
        self.path = path
        self.plan = plan
        self.design = SweepDesign(plan)

    def record(self, run: int) -> Path:
        return self.path / RUNS / f"{run:06d}"

    def journal(self) -> "Journal":
        return Journal(self.path / JOURNAL)

    def rows(self) -> list[Row]:
        rows = {row["run"]: row for row in (*read_table(self.path / TABLE), *read_journal(self.path / JOURNAL))}
        return [rows[run] for run in sorted(rows)]

    def compact(self) -> list[Row]:
        """Move the journal's rows into the table and return all rows; a crash at any time loses none.

        Raises:
            ReportError: the table cannot be written.
        """
        rows = self.rows()
        write_table(self.path / TABLE, rows, self.plan, self.design.axes)
        (self.path / JOURNAL).unlink(missing_ok=True)
        return rows


def load(path: Path) -> SweepFolder:
    """Return the sweep in a folder; raise RunError if its plan cannot be read."""
    try:
        return SweepFolder(path, msgspec.json.decode((path / PLAN).read_bytes(), type=SweepPlan))
    except (OSError, msgspec.MsgspecError, ValueError) as error:
        raise RunError(f"{path / PLAN}: cannot be read ({error}); must be the plan of a sweep") from error


@contextmanager
def locked(path: Path, plan: SweepPlan, force: bool = False) -> Iterator[SweepFolder]:
    """Yield the folder of a new or continued sweep, locked against other sweeps.

    With `force`, the folder may contain other files, but never a run, or another sweep with finished runs.

    Raises:
        RunError: another sweep is running in the folder, or it contains something else.
    """
    with file_fault(path, "cannot be created", OTHER_OUT):
        if not is_sweep(path) and ((path / RECORD).exists() or (path / TABLE).exists()):
            raise RunError(f"{path}: holds another run or sweep; {OTHER_OUT}")
    with locked_folder(path, PLAN, (LOCK, NEW_PLAN), force, "sweep into", "another sweep is running"):
        if warning := no_locks(path):
            print(printable(warning), file=sys.stderr)
        _write_plan(path, plan)
        yield SweepFolder(path, plan)


def _write_plan(path: Path, plan: SweepPlan) -> None:
    """Write the plan; raise RunError if the folder holds another sweep with finished runs."""
    try:
        content = indented_json(plan)
    except UnicodeEncodeError as error:
        character = error.object[error.start : error.end][:1]
        reason = f"cannot be written ({character!a} is not a character); give text in UTF-8"
        raise RunError(f"{path / PLAN}: {reason}") from error
    if is_sweep(path):
        present = load(path)
        other = difference(present.plan, msgspec.json.decode(content, type=SweepPlan))  # both as decoded from JSON
        if other and present.rows():
            raise RunError(f"{path}: holds another sweep ({other}); give --out another folder")
    new = path / NEW_PLAN
    with file_fault(path, "cannot be written", OTHER_OUT):
        new.write_bytes(content)
        new.replace(path / PLAN)


class Journal:
    """Appends rows, each synced to disk before its run counts as finished; a line cut off by a crash is dropped.

    Raises:
        RunError: the journal cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            end = path.read_bytes().rfind(b"\n") + 1
            os.ftruncate(self._file, end)
            os.lseek(self._file, end, os.SEEK_SET)
        except OSError as error:
            raise self._error(error) from error

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def append(self, row: Row) -> None:
        """Append a row so that it survives a crash or a power failure.

        Raises:
            RunError: the row cannot be written.
        """
        line = msgspec.json.encode(row) + b"\n"
        try:
            while line:
                line = line[os.write(self._file, line) :]
            os.fsync(self._file)
        except OSError as error:
            raise self._error(error) from error

    def _error(self, error: OSError) -> RunError:
        return RunError(f"{self._path}: cannot be written ({error.strerror}); the runs finished so far are kept")


def read_journal(path: Path) -> list[Row]:
    """Return the rows of a journal, without an incomplete last line; empty if the file does not exist."""
    content = path.read_bytes() if path.exists() else b""
    return msgspec.json.Decoder().decode_lines(content[: content.rfind(b"\n") + 1])


def write_table(path: Path, rows: Iterable[Row], plan: SweepPlan, axes: Sequence[Axis]) -> None:
    """Write the rows atomically, ordered by run number; raise ReportError if the file cannot be written."""
    ordered = sorted(rows, key=lambda row: row["run"])
    schema = _schema(ordered, axes).with_metadata({PLAN_METADATA: msgspec.json.encode(plan)})
    json_columns = [field.name for field in schema if field.metadata]
    plain = [{**row, **{name: msgspec.json.encode(row[name]).decode() for name in json_columns}} for row in ordered]
    new = path.with_name(f".{path.name}.new")
    try:
        with new.open("wb") as file:
            pq.write_table(pa.Table.from_pylist(plain, schema), file)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written ({error.strerror or error})") from error


def read_table(path: Path) -> list[Row]:
    """Return the rows of a table, with None for empty cells; no rows if the file does not exist.

    Raises:
        ReportError: the file is not a table of a sweep.
    """
    if not path.exists():
        return []
    try:
        with path.open("rb") as file:  # Arrow would parse a path with a colon as a URL
            table = pq.read_table(file)
    except (OSError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())[:200]
        raise ReportError(f"{path}: cannot be read ({reason}); remove it to continue") from error
    json_columns = [field.name for field in table.schema if field.metadata]
    rows = table.to_pylist()
    for row in rows:
        row.update({name: msgspec.json.decode(row[name]) for name in json_columns})
    return rows


def _schema(rows: Sequence[Row], axes: Sequence[Axis]) -> pa.Schema:
    """Return the schema of the table: inputs, results, then all other columns in order of first occurrence."""
    fixed = [
        (name, next(_TYPES[each] for each in (*getattr(kind, "__args__", ()), kind) if each in _TYPES))
        for name, kind in FIXED.items()
    ]
    varied: list[tuple[str, pa.DataType | None]] = []  # type None: values of mixed types, stored as JSON
    for axis in axes:
        kinds = {type(value) for value in axis.values} if isinstance(axis, Grid) else {float}
        if kinds == {int, float}:
            kinds = {float}
        if axis.path != SEED:
            varied.append((axis.path, _TYPES.get(kinds.pop()) if len(kinds) == 1 else None))
    own_columns = {*FIXED, *(path for path, _ in varied)}
    errors = {name: (name, pa.float64()) for row in rows for name in row if name not in own_columns}
    fields = [*fixed[:3], *varied, *fixed[3:], *errors.values()]
    mixed = {b"encoding": b"json"}
    return pa.schema([pa.field(name, kind or pa.string(), metadata=None if kind else mixed) for name, kind in fields])
