"""A table per message type, or of each name too, as CSV or Parquet: pandas, MATLAB and PlotJuggler read it."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from msgspec import Struct

from zsim_analysis.export.message_columns import FieldColumns, table_name
from zsim_analysis.export.selection import RowBatch

ROW_GROUP = 65_536  # rows of a Parquet row group, of which one per table is held in memory
_TYPES: dict[str, pa.DataType] = {
    "whole": pa.int64(),
    "number": pa.float64(),
    "flag": pa.bool_(),
    "text": pa.string(),
}
_BEFORE = (("name", pa.string()), ("t_s", pa.float64()), ("t_ns", pa.int64()))
_AFTER = ("wall_ns", pa.int64())
_SEQ = ("seq", pa.int64())
_Table = tuple[type[Struct], str]  # a message type, and the name of all its rows, empty where they have several


class WrittenTable(NamedTuple):
    """A table that was written."""

    file: str
    rows: int
    columns: list[str]


class _Sink(Protocol):
    def write(self, batch: pa.RecordBatch) -> None: ...

    def close(self) -> None: ...


class TableFolder:
    """A folder of tables; a table's file is opened with its first rows.

    Args:
        folder: made already.
        suffix: `csv` or `parquet`.
        fields: of a message type.
    """

    def __init__(self, folder: Path, suffix: str, fields: Callable[[type[Struct]], tuple[FieldColumns, ...]]) -> None:
        self._folder = folder
        self._suffix = suffix
        self._fields = fields
        self._layouts: dict[type[Struct], _Layout] = {}
        self._sinks: dict[_Table, _Sink] = {}
        self._rows: dict[_Table, int] = {}
        self._stack = ExitStack()

    def columns(self, kind: type[Struct]) -> int:
        """Return the number of columns of a type's table."""
        return len(self._layout(kind).schema)

    def write(self, batch: RowBatch) -> None:
        """Add rows to their table."""
        table = batch.kind, batch.only
        if table not in self._sinks:
            self._sinks[table] = self._open(table)
        self._sinks[table].write(self._layout(batch.kind).arrow(batch))
        self._rows[table] = self._rows.get(table, 0) + len(batch.names)

    def finish(self) -> list[WrittenTable]:
        """End all files; return the tables that were written."""
        self._stack.close()
        written = [
            WrittenTable(self._file(table), rows, self._layout(table[0]).schema.names)
            for table, rows in self._rows.items()
        ]
        return sorted(written, key=lambda each: each.file)

    def _layout(self, kind: type[Struct]) -> "_Layout":
        if kind not in self._layouts:
            self._layouts[kind] = _Layout(kind, self._fields(kind))
        return self._layouts[kind]

    def _file(self, table: "_Table") -> str:
        kind, only = table
        return ".".join([table_name(kind), *([only] if only else []), self._suffix])

    def _open(self, table: "_Table") -> _Sink:
        schema = self._layout(table[0]).schema
        # an open file: Arrow takes a path with a colon for an address, and knows no names that are not UTF-8
        file = self._stack.enter_context((self._folder / self._file(table)).open("wb"))
        sink = _Csv(file, schema) if self._suffix == "csv" else _Parquet(file, schema)
        self._stack.callback(sink.close)
        return sink

    def __enter__(self) -> "TableFolder":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


class _Layout:
    """The Arrow schema of a table, and how a batch becomes its columns."""

    def __init__(self, kind: type[Struct], fields: Sequence[FieldColumns]) -> None:
        self._has_seq = "seq" in kind.__struct_fields__
        self._fields = fields
        own = [(column, _TYPES[field.kind]) for field in fields for column in field.columns]
        self.schema = pa.schema([*_BEFORE, *([_SEQ] if self._has_seq else []), *own, _AFTER])

    def arrow(self, batch: RowBatch) -> pa.RecordBatch:
        t_ns = [message.t_ns for message in batch.messages]
        head = [batch.names, [each / 1e9 for each in t_ns], t_ns]
        head += [[message.seq for message in batch.messages]] if self._has_seq else []
        own = [column for field in self._fields for column in _columns(field, batch.messages)]
        wall_ns = np.array(batch.wall_ns, np.uint64).astype(np.int64)
        arrays = [  # no message holds NaN: it stands for a missing value
            pa.array(column, entry.type, from_pandas=True)
            for column, entry in zip([*head, *own, wall_ns], self.schema, strict=True)
        ]
        return pa.RecordBatch.from_arrays(arrays, schema=self.schema)


def _columns(field: FieldColumns, messages: Sequence[Any]) -> Iterator[Any]:
    values = field.values(messages)
    if isinstance(values, np.ndarray):
        yield from values.T
    else:
        yield values


class _Csv:
    """A CSV file: names in the first line, flags as 0 and 1, empty where there is no value."""

    def __init__(self, file: BinaryIO, schema: pa.Schema) -> None:
        plain = [pa.field(each.name, pa.int8() if each.type == pa.bool_() else each.type) for each in schema]
        self._schema = pa.schema(plain)
        options = pacsv.WriteOptions(include_header=True, quoting_style="needed")
        self._writer = pacsv.CSVWriter(file, self._schema, write_options=options)

    def write(self, batch: pa.RecordBatch) -> None:
        self._writer.write(batch.cast(self._schema))

    def close(self) -> None:
        self._writer.close()


class _Parquet:
    """A Parquet file; rows are held until there are enough for a row group."""

    def __init__(self, file: BinaryIO, schema: pa.Schema) -> None:
        self._schema = schema
        self._writer = pq.ParquetWriter(file, schema, compression="zstd")
        self._held: list[pa.RecordBatch] = []

    def write(self, batch: pa.RecordBatch) -> None:
        self._held.append(batch)
        if sum(each.num_rows for each in self._held) >= ROW_GROUP:
            self._flush()

    def close(self) -> None:
        if self._held:
            self._flush()
        self._writer.close()

    def _flush(self) -> None:
        self._writer.write_table(pa.Table.from_batches(self._held, self._schema))
        self._held = []
