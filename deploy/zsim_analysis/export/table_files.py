"""Files of tables: a folder of CSV or Parquet files, or one file for MATLAB."""

import re
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from msgspec import Struct

from zsim.errors import ReportError
from zsim_analysis.export.columns import RowBatch, TableSurvey, as_array, column_values, table_name

ROW_GROUP = 65_536  # rows of a Parquet row group, of which one per table is held in memory
_TYPES = {"whole": pa.int64(), "number": pa.float64(), "flag": pa.bool_(), "text": pa.string()}


class WrittenTable(NamedTuple):
    """A table that was written."""

    file: str
    rows: int
    columns: list[str]


class TableFolder:
    """A folder of tables, one per message type, or of each name too; a file is opened with its first rows."""

    def __init__(self, folder: Path, suffix: str, survey: TableSurvey) -> None:
        self._folder = folder
        self._suffix = suffix
        self._survey = survey
        self._sinks: dict[str, _Csv | _Parquet] = {}
        self._written: dict[str, WrittenTable] = {}
        self._stack = ExitStack()

    def write(self, batch: RowBatch) -> None:
        file = ".".join([table_name(batch.kind), *([batch.only] if batch.only else []), self._suffix])
        table = self._survey.table(batch.kind)
        schema = pa.schema([(column, _TYPES[each.kind]) for each in table for column in each.columns])
        if file not in self._sinks:
            # an open file: Arrow takes a path with a colon for an address, and refuses names that are not UTF-8
            opened = self._stack.enter_context((self._folder / file).open("wb"))
            self._sinks[file] = _Csv(opened, schema) if self._suffix == "csv" else _Parquet(opened, schema)
            self._stack.callback(self._sinks[file].close)
        # no message holds NaN: it marks a missing value
        rows = [pa.array(values, _TYPES[kind], from_pandas=True) for _, kind, values in column_values(table, batch)]
        self._sinks[file].write(pa.RecordBatch.from_arrays(rows, schema=schema))
        before = self._written[file].rows if file in self._written else 0
        self._written[file] = WrittenTable(file, before + len(batch.names), schema.names)

    def finish(self) -> list[WrittenTable]:
        self._stack.close()
        return sorted(self._written.values())

    def __enter__(self) -> "TableFolder":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


class _Csv:
    """A CSV file: names in the first line, flags as 0 and 1, empty cells for missing values."""

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
    """A Parquet file; rows are held until they fill a row group."""

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


# MAT-file Level 5, https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf, which MATLAB and Octave load
# without a toolbox. It counts the bytes of a variable in 32 bits, of which MATLAB uses 31.
VARIABLE_MAX = 2**31 - 1  # bytes of a variable that MATLAB loads
NAME_MAX = 63  # characters of a MATLAB name
CHARS_MAX = 64  # of a text in a matrix of characters; longer ones are in a cell
KEYWORDS = frozenset({"break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function",
                      "global", "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try",
                      "while"})  # fmt: skip


class MatFile:
    """A MATLAB file: by message type, then by drone, cluster or process, a struct of arrays with a row per message.

    All rows are held in memory until the end, since the format needs a variable whole.

    Raises:
        ReportError: a variable would be larger than MATLAB loads.
    """

    def __init__(self, path: Path, survey: TableSurvey) -> None:
        self._path = path
        self._survey = survey
        self._blocks: dict[type[Struct], dict[str, list[dict[str, Any]]]] = {}  # by subject, arrays by field
        for kind, rows in survey.rows.items():
            row = 8 * (survey.width(kind) - 1) if kind else 0  # bytes, without the name
            if kind and rows * row > VARIABLE_MAX:  # the selected times may still reduce it
                _check_size(table_name(kind), survey.rows_within(kind) * row)

    def write(self, batch: RowBatch) -> None:
        subjects = self._blocks.setdefault(batch.kind, {})
        for name in dict.fromkeys(batch.names):
            rows = [row for row, each in enumerate(batch.names) if each == name]
            messages, wall_ns = [batch.messages[row] for row in rows], [batch.wall_ns[row] for row in rows]
            own = batch._replace(names=[name] * len(rows), messages=messages, wall_ns=wall_ns)
            block: dict[str, Any] = {}
            for each in self._survey.table(batch.kind)[1:]:  # the first column is the name
                values = each.values(own)
                if each.kind == "text":  # a list until all of it is known
                    block[each.name] = ["" if value is None else value for value in values]
                else:
                    block[each.name] = as_array(each.kind, values)
            subjects.setdefault(name, []).append(block)

    def finish(self) -> list[WrittenTable]:
        """Write the file; return its variables. Raises ReportError: a variable is larger than MATLAB loads."""
        from scipy.io import savemat

        variables, written = {}, []
        for kind in sorted(self._blocks, key=table_name):
            subjects = self._blocks.pop(kind)
            valid = matlab_names(subjects)
            structs = {valid[name]: self._struct(kind, name, blocks) for name, blocks in subjects.items()}
            _check_size(table_name(kind), _bytes(structs))
            variables[table_name(kind)] = structs
            rows = sum(len(struct["t_ns"]) for struct in structs.values())
            written.append(WrittenTable(table_name(kind), rows, list(next(iter(structs.values())))))
        savemat(self._path, variables, long_field_names=True, oned_as="column")
        return written

    def __enter__(self) -> "MatFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._blocks.clear()

    def _struct(self, kind: type[Struct], name: str, blocks: Sequence[dict[str, Any]]) -> dict[str, Any]:
        struct: dict[str, Any] = {"name": name}
        for each in self._survey.table(kind)[1:]:
            values: Any = [block[each.name] for block in blocks]
            if each.kind == "text":
                texts = [text for block in values for text in block]
                is_short = max(map(len, texts)) <= CHARS_MAX
                values = np.array(texts) if is_short else np.array(texts, object).reshape(-1, 1)
            else:
                values = np.concatenate(values)
            if each.names:
                known = ~np.isnan(values).all(axis=0)
                struct["names"] = np.array(each.names, object)[known].reshape(-1, 1)
                values = values[:, known]
            elif each.keys:
                valid = matlab_names(each.keys)
                values = {valid[key]: values[:, columns] for key, columns in each.keys.items()}
            struct[each.name] = values
        return struct


def matlab_names(names: Iterable[str]) -> dict[str, str]:
    """Return a valid and unique MATLAB name for each name: drone-1.a is drone_1_a."""
    valid: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^a-zA-Z0-9_]", "_", name)
        plain = plain if re.match("[a-zA-Z]", plain) and plain not in KEYWORDS else f"x{plain}"
        plain = unique = plain[: NAME_MAX - len("_999")]
        count = 1
        while unique in valid.values():
            count += 1
            unique = f"{plain}_{count}"
        valid[name] = unique
    return valid


def _bytes(value: Any) -> int:
    if isinstance(value, dict):
        return sum(map(_bytes, value.values()))
    if isinstance(value, np.ndarray) and value.dtype == object:
        return sum(64 + 2 * len(text) for text in value.flat)  # the head of a cell's matrix, and two bytes a character
    return value.nbytes if isinstance(value, np.ndarray) else 2 * len(value)


def _check_size(variable: str, size: int) -> None:
    if size > VARIABLE_MAX:
        raise ReportError(
            f"{variable}: would have {size / 2**30:.1f} GB, and MATLAB loads 2 GB of a variable from a MAT file of "
            "Level 5; choose --keys, --from and --to, or --format parquet, which MATLAB reads with parquetread"
        )
