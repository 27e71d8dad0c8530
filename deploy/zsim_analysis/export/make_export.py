"""Makes an export: a record in, files for other tools out, which appear only once all of them are complete.

Tables are a folder of CSV or Parquet files, or one file for MATLAB. After Ctrl-C or on a full disk, no partial export
remains.
"""

import json
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from msgspec import Struct

from zsim import __version__
from zsim.errors import ReportError
from zsim.output_folder import record_at
from zsim.record import RecordReader
from zsim.record.record_reader import record_notes
from zsim_analysis.export import Format
from zsim_analysis.export.columns import (
    DecodedMessages,
    MessageSelection,
    RowBatch,
    TableSurvey,
    as_array,
    batches,
    column_values,
    table_name,
)

DEFAULTS = {  # file names beside the record
    Format.CSV: "csv",
    Format.PARQUET: "parquet",
    Format.MAT: "run.mat",
    Format.FOXGLOVE: "foxglove.mcap",
}
MANIFEST = "export.json"  # marks a folder of tables
MATLAB = b"MATLAB 5.0 MAT-file Platform: "  # first bytes of SciPy's files; MATLAB's own have a comma before Platform
MCAP, MCAP_LIBRARY = b"\x89MCAP", b"foxglove-sdk"  # a Foxglove export names its library, a record names zsim
HEAD_MAX = 200  # an MCAP file names its library within this many first bytes
LAYOUT = "-layout.json"  # suffix of the layout file beside a Foxglove export
BLUEPRINT = ".rbl"  # suffix of the blueprint beside a Rerun export
RERUN = b"RRF2"  # first bytes of a Rerun file
RUN_FILES = ("run.mcap", "scenario.yaml", "summary.json", "report.html")  # files that no export may replace

Progress = Callable[[int, int], None]  # number of messages read so far, and the total


class ExportResult(NamedTuple):
    """The result of an export."""

    paths: tuple[Path, ...]  # files and folders that were written
    tables: dict[str, int]  # number of rows by table, or of messages by topic
    notes: list[str]  # remarks: whether the record was cut off or damaged, and what was left out


def export(
    run: Path,
    form: Format,
    out: Path | None = None,
    selection: MessageSelection | None = None,
    force: bool = False,
    progress: Progress = lambda done, total: None,
    by_name: bool = False,
) -> ExportResult:
    """Write the record of a run in the format of another tool, completely or not at all.

    Args:
        run: folder of the run, or its record.
        form: format of the output.
        out: path of the output; None: the default path beside the record.
        selection: messages to export; None: all.
        force: whether to replace an earlier export.
        progress: called repeatedly.
        by_name: whether each drone, cluster and process gets its own tables in CSV and Parquet.

    Raises:
        RunError, RecordError: there is no record.
        ReportError: the selection is empty, or the output cannot be written.
        KeyboardInterrupt: Ctrl-C; nothing was written.
    """
    record, chosen = record_at(run), selection or MessageSelection()
    target = out or record.parent / DEFAULTS[form]
    with RecordReader(record) as reader:
        if form is Format.FOXGLOVE:
            return _foxglove(reader, chosen, target, force, progress)
        check_free(target, force, record)
        return _tables(reader, form, chosen, target, progress, by_name)


def _tables(
    reader: RecordReader, form: Format, selection: MessageSelection, target: Path, progress: Progress, by_name: bool
) -> ExportResult:
    survey = TableSurvey(reader, selection)
    total = sum(survey.rows.values())
    messages = selection.messages(reader, survey.table_keys)
    decoded = DecodedMessages(messages, survey.decode, lambda done: progress(done, total))
    with staged_outputs(target) as (new,):
        if form is not Format.MAT:
            new.mkdir()
        with MatFile(new, survey) if form is Format.MAT else TableFolder(new, form.value, survey) as sink:
            for batch in batches(decoded, survey.width, by_name):
                sink.write(batch)
            written = sink.finish()
        if not written:
            raise ReportError(f"{reader.path}: {_nothing(reader, selection)}")
        notes = [*record_notes(reader), *_refused(decoded.refused)]
        if survey.pictures:
            notes.append(f"{survey.pictures} pictures are left out: tables cannot hold them; use --format foxglove")
        if form is not Format.MAT:
            content = {
                "record": str(reader.path.resolve()),
                "zsim": __version__,
                "keys": selection.expressions or ("**",),
                "from_s": selection.from_s,
                "to_s": selection.to_s,
                "complete": reader.complete,
                "notes": notes,
                "tables": {table.file: {"rows": table.rows, "columns": table.columns} for table in written},
            }
            # json rather than msgspec: a path may contain bytes that are not UTF-8
            (new / MANIFEST).write_bytes(f"{json.dumps(content, indent=2)}\n".encode())
    return ExportResult((target,), {table.file: table.rows for table in written}, notes)


def _foxglove(
    reader: RecordReader, selection: MessageSelection, target: Path, force: bool, progress: Progress
) -> ExportResult:
    from zsim_analysis.export import viewers
    from zsim_analysis.export.foxglove_file import convert

    companions = (target.with_name(f"{target.stem}{LAYOUT}"), target.with_suffix(BLUEPRINT))
    targets = (target, *(companions if viewers.has_rerun() else companions[:1]))
    for path in targets:
        check_free(path, force, reader.path)
    with staged_outputs(*targets) as (new, new_layout, *new_blueprint):
        run = convert(reader, selection, new, progress)
        if not run.topics:
            raise ReportError(f"{reader.path}: {_nothing(reader, selection)}")
        new_layout.write_text(viewers.layout(run) + "\n", encoding="utf-8")
        for path in new_blueprint:
            viewers.write_blueprint(path, target.stem, run)
    return ExportResult(targets, run.topics, [*record_notes(reader), *_refused(run.refused)])


def _refused(count: int) -> list[str]:
    return [f"{count} messages in the record do not match the type of their key and were left out"] if count else []


def _nothing(reader: RecordReader, selection: MessageSelection) -> str:
    """Return why there is nothing to export."""
    count = sum(reader.topics().values())
    if not count:
        return "contains no messages; there is nothing to export"
    criteria = [f"on {' '.join(selection.expressions)}"] if selection.expressions else []
    criteria += [f"from {selection.from_s:g} s"] if selection.from_s is not None else []
    criteria += [f"to {selection.to_s:g} s"] if selection.to_s is not None else []
    return " ".join(["has no message", *criteria, f"that can be exported; it holds {count} messages"])


def check_free(target: Path, force: bool, record: Path) -> None:
    """Refuse a target that must not be replaced.

    Raises:
        ReportError: the target exists, but `force` is not set, or it is the record, or it is not an export.
    """
    if not target.exists():
        return
    if target.resolve() == record.resolve():
        raise ReportError(f"{target}: is the record itself; give --out another path")
    if not force:
        raise ReportError(f"{target}: exists; give --out another path, or --force to replace it")
    if target.is_dir():
        try:
            tables = json.loads((target / MANIFEST).read_bytes())["tables"].keys()
            unexpected = {path.name for path in target.iterdir()} - {MANIFEST, *tables}
            other = f"it contains {min(unexpected)}" if unexpected else ""
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
            other = f"it has no {MANIFEST}"
        if other:
            what = f"is a folder but not an export ({other})"
            raise ReportError(f"{target}: {what}; give --out another path")
    elif target.is_file():
        with target.open("rb") as file:
            head = file.read(HEAD_MAX)
        if target.name.endswith(LAYOUT):
            is_export = head.startswith(b"{")
        elif target.name.endswith(BLUEPRINT):
            is_export = head.startswith(RERUN)
        else:
            is_mcap = head.startswith(MCAP) and MCAP_LIBRARY in head
            is_export = target.name not in RUN_FILES and (head.startswith(MATLAB) or is_mcap)
        if not is_export:
            raise ReportError(f"{target}: is a file but not an export; give --out another path")


@contextmanager
def staged_outputs(*targets: Path) -> Iterator[tuple[Path, ...]]:
    """Yield a temporary path for each file or folder to be written; at the end, move them to their targets together.

    Existing targets are replaced: call `check_free` first.

    Raises:
        ReportError: the outputs cannot be written.
    """
    # beside the target, to allow renaming; a TemporaryDirectory would remain after Ctrl-C during its creation
    folder, new_parents = targets[0].parent / f".export-{secrets.token_hex(4)}", list[Path]()
    try:
        new_parents += [parent for parent in targets[0].parents if not parent.exists()]
        folder.mkdir(parents=True)
        written = tuple(folder / target.name for target in targets)
        yield written
        moves = [(new, target, new.with_name(f"{new.name}.old")) for new, target in zip(written, targets, strict=True)]
        try:
            for new, target, old in moves:
                if target.exists():
                    target.replace(old)
                new.replace(target)
        except BaseException:  # restore the old files after a failure or Ctrl-C
            for new, target, old in moves:
                if not new.exists() and target.exists():
                    target.replace(new)
                if old.exists():
                    old.replace(target)
            raise
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else error  # without text that libraries add
        raise ReportError(f"{targets[0]}: cannot be written ({reason}); give --out another path") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # a folder that is not empty stays, and so do its parents
            for parent in new_parents:
                parent.rmdir()


# Tables

ROW_GROUP = 65_536  # rows per Parquet row group; one row group is held in memory per table
_TYPES = {"whole": pa.int64(), "number": pa.float64(), "flag": pa.bool_(), "text": pa.string()}


class WrittenTable(NamedTuple):
    """A table that was written."""

    file: str
    rows: int
    columns: list[str]


class TableFolder:
    """A folder of tables, one per message type, or per type and name; each file is opened with its first rows."""

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
            # an open file, since Arrow takes a path with a colon for a URI, and refuses names that are not UTF-8
            opened = self._stack.enter_context((self._folder / file).open("wb"))
            self._sinks[file] = _Csv(opened, schema) if self._suffix == "csv" else _Parquet(opened, schema)
            self._stack.callback(self._sinks[file].close)
        # messages never contain NaN, so NaN marks a missing value
        rows = [pa.array(values, _TYPES[kind], from_pandas=True) for _, kind, values in column_values(table, batch)]
        self._sinks[file].write(pa.RecordBatch.from_arrays(rows, schema=schema))
        rows_before = self._written[file].rows if file in self._written else 0
        self._written[file] = WrittenTable(file, rows_before + len(batch.names), schema.names)

    def finish(self) -> list[WrittenTable]:
        self._stack.close()
        return sorted(self._written.values())

    def __enter__(self) -> "TableFolder":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


class _Csv:
    """A CSV file: names in the first line, booleans as 0 and 1, empty cells for missing values."""

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
        self._buffered: list[pa.RecordBatch] = []

    def write(self, batch: pa.RecordBatch) -> None:
        self._buffered.append(batch)
        if sum(each.num_rows for each in self._buffered) >= ROW_GROUP:
            self._flush()

    def close(self) -> None:
        if self._buffered:
            self._flush()
        self._writer.close()

    def _flush(self) -> None:
        self._writer.write_table(pa.Table.from_batches(self._buffered, self._schema))
        self._buffered = []


# MAT-file Level 5, https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf, which MATLAB and Octave load
# without a toolbox. The size of a variable is stored in 32 bits, of which MATLAB uses 31.
VARIABLE_MAX = 2**31 - 1  # largest size of a variable that MATLAB loads [bytes]
NAME_MAX = 63  # longest MATLAB name [characters]
CHARS_MAX = 64  # longest text in a character matrix; longer texts are in a cell array
KEYWORDS = frozenset({"break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function",
                      "global", "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try",
                      "while"})  # fmt: skip


class MatFile:
    """A MATLAB file: by message type, then by drone, cluster or process, a struct of arrays with a row per message.

    All rows are held in memory until the end, since the format stores each variable in one piece.

    Raises:
        ReportError: a variable would be larger than MATLAB can load.
    """

    def __init__(self, path: Path, survey: TableSurvey) -> None:
        self._path = path
        self._survey = survey
        self._blocks: dict[type[Struct], dict[str, list[dict[str, Any]]]] = {}  # arrays by field, per batch
        for kind, rows in survey.rows.items():
            row = 8 * (survey.width(kind) - 1) if kind else 0  # size of a row without the name [bytes]
            if kind and rows * row > VARIABLE_MAX:  # the selected times may exclude some rows
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
                if each.kind == "text":  # kept as a list until all texts are known
                    block[each.name] = ["" if value is None else value for value in values]
                else:
                    block[each.name] = as_array(each.kind, values)
            subjects.setdefault(name, []).append(block)

    def finish(self) -> list[WrittenTable]:
        """Write the file and return its variables; raise ReportError if one is larger than MATLAB can load."""
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
                is_known = ~np.isnan(values).all(axis=0)
                struct["names"] = np.array(each.names, object)[is_known].reshape(-1, 1)
                values = values[:, is_known]
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
        return sum(64 + 2 * len(text) for text in value.flat)  # a header per cell, and two bytes per character
    return value.nbytes if isinstance(value, np.ndarray) else 2 * len(value)


def _check_size(variable: str, size: int) -> None:
    if size > VARIABLE_MAX:
        raise ReportError(
            f"{variable}: would be {size / 2**30:.1f} GiB; must be < 2 GiB for MATLAB to load it from a Level 5 "
            "MAT-file; select less by --keys, --from and --to, or use --format parquet (parquetread in MATLAB)"
        )
