"""The folder of a sweep: its plan, the runs that are finished, and the table in which they are collected.

plan.json        what is flown
journal.jsonl    finished runs that are not in the table yet, a line of JSON each
sweep.parquet    finished runs, a row each
runs/000012/     record of run 12, where records are kept
"""

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from zsim.errors import ReportError, RunError, printable
from zsim.output_folder import no_locks, refuse_others, take_lock
from zsim_analysis.sweep.axes import SEED, Axis, Grid
from zsim_analysis.sweep.design import PLAN, SweepDesign, SweepPlan, difference, is_sweep
from zsim_analysis.sweep.sweep_run import FIXED, Row

JOURNAL, TABLE, RUNS, LOCK = "journal.jsonl", "sweep.parquet", "runs", ".lock"
NEW_PLAN = f".{PLAN}.new"
PLAN_METADATA = b"zsim_sweep"  # key of the plan in the table's metadata
_TYPES: dict[Any, pa.DataType] = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}


class SweepFolder:
    """A sweep on disk.

    Args:
        path: its folder.
        plan: of the sweep.
    """

    def __init__(self, path: Path, plan: SweepPlan) -> None:
        self.path = path
        self.plan = plan
        self.design = SweepDesign(plan)

    def record(self, run: int) -> Path:
        """Return the folder of a run's record."""
        return self.path / RUNS / f"{run:06d}"

    def journal(self) -> "Journal":
        """Return the journal, opened to be continued."""
        return Journal(self.path / JOURNAL)

    def rows(self) -> list[Row]:
        """Return the finished runs in their order."""
        rows = {row["run"]: row for row in (*read_table(self.path / TABLE), *read_journal(self.path / JOURNAL))}
        return [rows[run] for run in sorted(rows)]

    def compact(self) -> list[Row]:
        """Put all that is finished into the table, and return it; a crash in between loses nothing.

        Raises:
            ReportError: the table cannot be written.
        """
        rows = self.rows()
        write_table(self.path / TABLE, rows, self.plan, self.design.axes)
        (self.path / JOURNAL).unlink(missing_ok=True)
        return rows


def load(path: Path) -> SweepFolder:
    """Return the sweep in a folder.

    Raises:
        RunError: its plan cannot be read.
    """
    try:
        return SweepFolder(path, msgspec.json.decode((path / PLAN).read_bytes(), type=SweepPlan))
    except (OSError, msgspec.MsgspecError, ValueError) as error:
        raise RunError(f"{path / PLAN}: cannot be read ({error}); it is to be the plan of a sweep") from error


@contextmanager
def locked(path: Path, plan: SweepPlan, force: bool = False) -> Iterator[SweepFolder]:
    """Yield the folder of a sweep, new or continued, locked against other sweeps.

    Args:
        path: of the folder.
        plan: of the sweep.
        force: take one that holds other files, too; a run, or another sweep, is refused always.

    Raises:
        RunError: another sweep is at work there, or it holds something else.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        _refuse_others(path, force)
        lock = (path / LOCK).open("w")
    except OSError as error:
        raise RunError(f"{path}: cannot be made ({error.strerror}); give --out another folder") from error
    with lock:
        if not take_lock(lock):
            raise RunError(f"{path}: another sweep is at work there; give --out another folder")
        if warning := no_locks(path):
            print(printable(warning), file=sys.stderr)
        _write_plan(path, plan)
        yield SweepFolder(path, plan)


def _refuse_others(path: Path, force: bool) -> None:
    """Refuse a folder that is no sweep's and is not empty."""
    if is_sweep(path):
        return
    if (path / "run.mcap").exists() or (path / TABLE).exists():
        raise RunError(f"{path}: holds something else already; give --out another folder")
    refuse_others(path, (LOCK, NEW_PLAN), force, "sweep into")


def _write_plan(path: Path, plan: SweepPlan) -> None:
    """Write the plan, unless the folder holds another sweep; a sweep without a finished run may be replaced."""
    content = _plan_json(path, plan)
    if is_sweep(path):
        present = load(path)
        other = difference(present.plan, msgspec.json.decode(content, type=SweepPlan))  # both as decoded from JSON
        if other and present.rows():
            raise RunError(f"{path}: holds another sweep ({other}); give --out another folder")
    new = path / NEW_PLAN
    try:
        new.write_bytes(content)
        new.replace(path / PLAN)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror}); give --out another folder") from error


def _plan_json(path: Path, plan: SweepPlan) -> bytes:
    try:
        return msgspec.json.format(msgspec.json.encode(plan), indent=2) + b"\n"
    except UnicodeEncodeError as error:
        character = error.object[error.start : error.end][:1]
        raise RunError(
            f"{path / PLAN}: cannot be written ({character!a} is no character); give text in UTF-8"
        ) from error


class Journal:
    """Appends rows, each on the disk before its run counts as finished; a line that a crash has cut is dropped.

    Args:
        path: of the file, made if it is not there.

    Raises:
        RunError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            whole = path.read_bytes().rfind(b"\n") + 1
            os.ftruncate(self._file, whole)
            os.lseek(self._file, whole, os.SEEK_SET)
        except OSError as error:
            raise self._error(error) from error

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def append(self, row: Row) -> None:
        """Add a row; when this returns, the row survives the process and a loss of power.

        Raises:
            RunError: it cannot be written.
        """
        line = msgspec.json.encode(row) + b"\n"
        try:
            while line:
                line = line[os.write(self._file, line) :]
            os.fsync(self._file)
        except OSError as error:
            raise self._error(error) from error

    def _error(self, error: OSError) -> RunError:
        return RunError(f"{self._path}: cannot be written ({error.strerror}); what is finished so far is kept")


def read_journal(path: Path) -> list[Row]:
    """Return the whole lines of a journal, none if there is no such file."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return []
    return msgspec.json.Decoder().decode_lines(content[: content.rfind(b"\n") + 1])


def write_table(path: Path, rows: Iterable[Row], plan: SweepPlan, axes: Sequence[Axis]) -> None:
    """Write the rows in the order of the runs, all or nothing.

    Raises:
        ReportError: it cannot be written.
    """
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
    """Return the rows of a table, none if there is no such file; empty cells are None.

    Raises:
        ReportError: it is no such table.
    """
    if not path.exists():
        return []
    try:
        with path.open("rb") as file:  # Arrow takes a path with a colon for an address
            table = pq.read_table(file)
    except (OSError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())[:200]
        raise ReportError(f"{path}: cannot be read ({reason}); remove it to go on") from error
    json_columns = [field.name for field in table.schema if field.metadata]
    rows = table.to_pylist()
    for row in rows:
        row.update({name: msgspec.json.decode(row[name]) for name in json_columns})
    return rows


def _schema(rows: Sequence[Row], axes: Sequence[Axis]) -> pa.Schema:
    """Return the columns: what was asked, what came of it, then the errors in the order of their first occurrence."""
    fixed = [(name, _fixed_type(kind)) for name, kind in FIXED.items()]
    varied = [(axis.path, _varied_type(axis)) for axis in axes if axis.path != SEED]
    known = {*FIXED, *(path for path, _ in varied)}
    errors = {name: (name, pa.float64()) for row in rows for name in row if name not in known}
    fields = [*fixed[:3], *varied, *fixed[3:], *errors.values()]
    mixed = {b"encoding": b"json"}  # of values that no one type holds
    return pa.schema([pa.field(name, kind or pa.string(), metadata=None if kind else mixed) for name, kind in fields])


def _fixed_type(kind: Any) -> pa.DataType:
    return next(_TYPES[each] for each in (getattr(kind, "__args__", None) or (kind,)) if each in _TYPES)


def _varied_type(axis: Axis) -> pa.DataType | None:
    """Return the type of a column whose values are all of one kind, None for any others."""
    if not isinstance(axis, Grid):
        return pa.float64()
    kinds = {type(value) for value in axis.values}
    if kinds <= {int, float}:
        return _TYPES[float if float in kinds else int]
    return _TYPES.get(kinds.pop()) if len(kinds) == 1 else None
