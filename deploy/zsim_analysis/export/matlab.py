"""A MATLAB file: a struct per message type with a struct per drone, cluster or process of arrays, a row per message.

MAT-file Level 5, https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf: what MATLAB and Octave load without
a toolbox. It counts the bytes of a variable in 32 bits, of which MATLAB uses 31.
"""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from scipy.io import savemat

from zsim.errors import ReportError
from zsim_analysis.export.message_columns import FieldColumns, KeyedColumns, NamedColumns, VectorColumns, table_name
from zsim_analysis.export.selection import RowBatch, TableSurvey
from zsim_analysis.export.table_folder import WrittenTable

VARIABLE_MAX = 2**31 - 1  # bytes of a variable that MATLAB loads from a Level 5 file
NAME_MAX = 63  # characters of a MATLAB name
CHARS_MAX = 64  # of a text in a matrix of characters; longer ones are in a cell
KEYWORDS = frozenset({"break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function",
                      "global", "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try",
                      "while"})  # fmt: skip


class MatFile:
    """Gathers all rows in memory, since the format needs a variable whole, and writes them at the end.

    Args:
        path: of the file.
        survey: of the record.

    Raises:
        ReportError: a variable would be larger than MATLAB loads.
    """

    def __init__(self, path: Path, survey: TableSurvey) -> None:
        self._path = path
        self._survey = survey
        self._fields: dict[type[Struct], tuple[FieldColumns, ...]] = {}
        self._blocks: dict[type[Struct], dict[str, list[_Block]]] = {}
        for kind, rows in survey.rows.items():
            if kind is not None and 8 * rows * self.columns(kind) > VARIABLE_MAX:  # of the times, only if it matters
                _check_size(table_name(kind), 8 * survey.rows_within(kind) * self.columns(kind))

    def columns(self, kind: type[Struct]) -> int:
        """Return the numbers in a row of a type."""
        return 4 + sum(len(field.columns) for field in self._of(kind))

    def write(self, batch: RowBatch) -> None:
        """Take rows."""
        subjects = self._blocks.setdefault(batch.kind, {})
        names = np.array(batch.names)
        for name in dict.fromkeys(batch.names):
            rows = np.flatnonzero(names == name).tolist()
            chosen = [batch.messages[row] for row in rows]
            block: _Block = {"t_ns": np.array([message.t_ns for message in chosen], np.int64)}
            if "seq" in batch.kind.__struct_fields__:
                block["seq"] = np.array([message.seq for message in chosen], np.int64)
            block |= {_entry_name(field): _plain(field, field.values(chosen)) for field in self._of(batch.kind)}
            block["wall_ns"] = np.array([batch.wall_ns[row] for row in rows], np.uint64).astype(np.int64)
            subjects.setdefault(name, []).append(block)

    def finish(self) -> list[WrittenTable]:
        """Write the file; return the variables that are in it.

        Raises:
            ReportError: a variable is larger than MATLAB loads.
        """
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

    def _struct(self, kind: type[Struct], name: str, blocks: "list[_Block]") -> dict[str, Any]:
        """Return the arrays of one drone, cluster or process."""
        joined = {field: _joined([block[field] for block in blocks]) for field in blocks[0]}
        by_name = {_entry_name(field): field for field in self._of(kind)}
        struct: dict[str, Any] = {"name": name, "t_s": joined["t_ns"] / 1e9}
        for entry, values in joined.items():
            field = by_name.get(entry)
            if isinstance(field, NamedColumns):
                known = ~np.isnan(values).all(axis=0)
                struct["names"] = np.array(field.names, object)[known].reshape(-1, 1)
                struct[entry] = values[:, known]
            elif isinstance(field, KeyedColumns):
                valid = matlab_names(field.keys)
                struct[entry] = {valid[key]: values[:, columns] for key, columns in field.keys.items()}
            else:
                struct[entry] = values
        return struct

    def _of(self, kind: type[Struct]) -> tuple[FieldColumns, ...]:
        if kind not in self._fields:
            self._fields[kind] = self._survey.fields(kind)
        return self._fields[kind]


_Block = dict[str, Any]  # arrays by field, a row per message


def matlab_names(names: Iterable[str]) -> dict[str, str]:
    """Return a valid MATLAB name for each name, no two the same: drone-1.a is drone_1_a."""
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


def _entry_name(field: FieldColumns) -> str:
    """Return the name of a field in its struct: that of the message where it is one array there."""
    return field.name if isinstance(field, VectorColumns | NamedColumns | KeyedColumns) else field.columns[0]


def _plain(field: FieldColumns, values: Any) -> Any:
    """Return values as an array; text stays a list until all of it is known."""
    if field.kind == "text":
        return ["" if value is None else value for value in values]
    if field.kind == "whole" and None not in values:
        return np.array(values, np.int64)
    if field.kind == "flag":
        return np.array(values, bool)
    return np.array(values, np.float64)


def _joined(blocks: Sequence[Any]) -> Any:
    """Return the blocks of a field as one array."""
    if not isinstance(blocks[0], list):
        return np.concatenate(blocks)
    texts = [text for block in blocks for text in block]
    if max(map(len, texts)) <= CHARS_MAX:
        return np.array(texts)
    return np.array(texts, object).reshape(-1, 1)


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
