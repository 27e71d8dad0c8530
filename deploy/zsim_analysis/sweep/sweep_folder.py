"""The folder of a sweep: its plan, the runs that are finished, and the table that they are put together in.

plan.json        what is flown
journal.jsonl    finished runs that are not in the table yet
sweep.parquet    finished runs, a row each
runs/000012/     record of run 12, where records are kept
"""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from zsim.errors import RunError
from zsim_analysis.sweep.design import Design
from zsim_analysis.sweep.results import journal, sweep_table
from zsim_analysis.sweep.results.row import Row
from zsim_analysis.sweep.sweep_plan import FILE as PLAN
from zsim_analysis.sweep.sweep_plan import Plan, difference, is_sweep

JOURNAL, TABLE, RUNS, LOCK = "journal.jsonl", "sweep.parquet", "runs", ".lock"


class Folder:
    """A sweep on disk.

    Args:
        path: its folder.
        plan: of the sweep.
    """

    def __init__(self, path: Path, plan: Plan) -> None:
        self.path = path
        self.plan = plan
        self.design = Design(plan)

    @property
    def table(self) -> Path:
        return self.path / TABLE

    def record(self, run: int) -> Path:
        """Return the folder of a run's record."""
        return self.path / RUNS / f"{run:06d}"

    def journal(self) -> journal.Journal:
        """Return the journal, opened to go on."""
        return journal.Journal(self.path / JOURNAL)

    def rows(self) -> list[Row]:
        """Return the finished runs in their order."""
        found = {row["run"]: row for row in (*sweep_table.read(self.table), *journal.read(self.path / JOURNAL))}
        return [found[run] for run in sorted(found)]

    def compact(self) -> list[Row]:
        """Put all that is finished into the table, and return it; a crash in between loses nothing.

        Raises:
            ReportError: the table cannot be written.
        """
        rows = self.rows()
        sweep_table.write(self.table, rows, self.plan, self.design.axes)
        (self.path / JOURNAL).unlink(missing_ok=True)
        return rows


def load(path: Path) -> Folder:
    """Return the sweep in a folder.

    Raises:
        RunError: its plan cannot be read.
    """
    try:
        return Folder(path, msgspec.json.decode((path / PLAN).read_bytes(), type=Plan))
    except (OSError, msgspec.MsgspecError, ValueError) as error:
        raise RunError(f"{path / PLAN}: cannot be read ({error}); it is to be the plan of a sweep") from error


@contextmanager
def locked(path: Path, plan: Plan) -> Iterator[Folder]:
    """Yield the folder of a sweep, made new or gone on with, while no other sweep is at work there.

    Raises:
        RunError: another sweep is at work there, or it holds something else.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock = (path / LOCK).open("w")
    except OSError as error:
        raise RunError(f"{path}: cannot be made ({error.strerror}); give --out another folder") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(f"{path}: another sweep is at work there; give --out another folder") from error
        _settle(path, plan)
        yield Folder(path, plan)


def _settle(path: Path, plan: Plan) -> None:
    """Write the plan, unless the folder holds something else; a sweep of which nothing is finished may be replaced."""
    text = _text(path, plan)
    if is_sweep(path):
        there = load(path)
        other = difference(there.plan, msgspec.json.decode(text, type=Plan))  # both as they are read again
        if other and there.rows():
            raise RunError(f"{path}: holds another sweep ({other}); give --out another folder")
    elif (path / "run.mcap").exists() or (path / TABLE).exists():
        raise RunError(f"{path}: holds something else already; give --out another folder")
    new = path / f".{PLAN}.new"
    try:
        new.write_bytes(text)
        new.replace(path / PLAN)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror}); give --out another folder") from error


def _text(path: Path, plan: Plan) -> bytes:
    """Return the content of plan.json."""
    try:
        return msgspec.json.format(msgspec.json.encode(plan), indent=2) + b"\n"
    except UnicodeEncodeError as error:
        found = error.object[error.start : error.end][:1]
        raise RunError(f"{path / PLAN}: cannot be written ({found!a} is no character); give text in UTF-8") from error
