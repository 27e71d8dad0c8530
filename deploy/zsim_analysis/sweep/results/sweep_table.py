"""sweep.parquet: one row per run."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from zsim.errors import ReportError
from zsim_analysis.sweep.axes import SEED, Axis, Grid
from zsim_analysis.sweep.results.row import FIXED, Row
from zsim_analysis.sweep.sweep_plan import Plan

PLAN = b"zsim_sweep"  # key of the plan in the file's metadata
_TYPES: dict[Any, pa.DataType] = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}


def write(path: Path, rows: Iterable[Row], plan: Plan, axes: Sequence[Axis]) -> None:
    """Write the rows in the order of the runs, all or nothing.

    Raises:
        ReportError: it cannot be written.
    """
    ordered = sorted(rows, key=lambda row: row["run"])
    schema = _schema(ordered, axes).with_metadata({PLAN: msgspec.json.encode(plan)})
    texts = [field.name for field in schema if field.metadata]
    plain = [{**row, **{name: _text(row[name]) for name in texts}} for row in ordered]
    new = path.with_name(f".{path.name}.new")
    try:
        with new.open("wb") as file:
            pq.write_table(pa.Table.from_pylist(plain, schema), file)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written ({error.strerror or error})") from error


def read(path: Path) -> list[Row]:
    """Return the rows of a table, none if there is no such file; empty cells are None.

    Raises:
        ReportError: it is no such table.
    """
    if not path.exists():
        return []
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise ReportError(
            f"{path}: cannot be read ({' '.join(str(error).split())[:200]}); remove it to go on"
        ) from error
    texts = [field.name for field in table.schema if field.metadata]
    rows = table.to_pylist()
    for row in rows:
        row.update({name: msgspec.json.decode(row[name]) for name in texts})
    return rows


def _schema(rows: Sequence[Row], axes: Sequence[Axis]) -> pa.Schema:
    """Return the columns: what was asked, what came of it, then the errors in the order in which they are found."""
    fixed = [(name, _fixed(kind)) for name, kind in FIXED.items()]
    varied = [(axis.path, _varied(axis)) for axis in axes if axis.path != SEED]
    known = {*FIXED, *(path for path, _ in varied)}
    errors = {name: (name, pa.float64()) for row in rows for name in row if name not in known}
    fields = [*fixed[:3], *varied, *fixed[3:], *errors.values()]
    mixed = {b"encoding": b"json"}  # of values that no one type holds
    return pa.schema([pa.field(name, kind or pa.string(), metadata=None if kind else mixed) for name, kind in fields])


def _fixed(kind: Any) -> pa.DataType:
    return next(_TYPES[each] for each in (getattr(kind, "__args__", None) or (kind,)) if each in _TYPES)


def _varied(axis: Axis) -> pa.DataType | None:
    """Return the type of a column whose values are all of one kind, None for any others."""
    if not isinstance(axis, Grid):
        return pa.float64()
    kinds = {type(value) for value in axis.values}
    if kinds <= {int, float}:
        return _TYPES[float if float in kinds else int]
    return _TYPES.get(kinds.pop()) if len(kinds) == 1 else None


def _text(value: Any) -> str:
    return msgspec.json.encode(value).decode()
