"""Makes an export: record in, files of other tools out, which appear when all of them are complete.

Ctrl-C and full disks leave nothing that looks finished.
"""

import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from zsim import __version__
from zsim.errors import ReportError
from zsim.output_folder import record_at
from zsim.record import RecordReader
from zsim.record.record_reader import record_notes
from zsim_analysis.export import Format
from zsim_analysis.export.columns import DecodedMessages, MessageSelection, TableSurvey, batches

DEFAULTS = {  # names beside the record
    Format.CSV: "csv",
    Format.PARQUET: "parquet",
    Format.MAT: "run.mat",
    Format.FOXGLOVE: "foxglove.mcap",
}
MANIFEST = "export.json"  # marks a folder of tables
MATLAB = b"MATLAB 5.0 MAT-file Platform: "  # SciPy's first bytes of a file; MATLAB's own have a comma
MCAP, MCAP_LIBRARY = b"\x89MCAP", b"foxglove-sdk"  # a file for Foxglove names its library; a record names zsim
HEAD_MAX = 200  # bytes within which an MCAP file has named its library
LAYOUT = "-layout.json"  # end of the name of the file beside one for Foxglove
BLUEPRINT = ".rbl"  # likewise, for Rerun
RERUN = b"RRF2"  # first bytes of Rerun's files
RUN_FILES = ("run.mcap", "scenario.yaml", "summary.json", "report.html")  # files that no export may replace

Progress = Callable[[int, int], None]  # messages read so far, and their number


class ExportResult(NamedTuple):
    """The result of an export."""

    paths: tuple[Path, ...]  # that were written
    tables: dict[str, int]  # name and rows of each table, or topic and messages
    notes: list[str]  # what a reader should know: whether the record was cut or damaged, and what was left out


def export(
    run: Path,
    form: Format,
    out: Path | None = None,
    selection: MessageSelection | None = None,
    force: bool = False,
    progress: Progress = lambda done, of: None,
    by_name: bool = False,
) -> ExportResult:
    """Write the record of a run in the format of another tool, all of it or nothing.

    Args:
        run: its folder, or its record.
        form: of the output.
        out: where, None for the default place beside the record.
        selection: of messages, None for all.
        force: replace what an earlier export has written.
        progress: called now and then.
        by_name: whether each drone, cluster and process has tables of its own, of CSV and Parquet.

    Raises:
        RunError, RecordError: there is no record.
        ReportError: nothing on record is selected; or it cannot be written there.
        KeyboardInterrupt: nothing was written.
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
    from zsim_analysis.export.table_files import MatFile, TableFolder

    survey = TableSurvey(reader, selection)
    total = sum(survey.rows.values())
    messages = selection.messages(reader, survey.wanted)
    decoded = DecodedMessages(messages, survey.decode, lambda done: progress(done, total))
    with placed(target) as (new,):
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
            notes.append(f"{survey.pictures} pictures are left out: a table holds none; --format foxglove has them")
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
            # by json, not msgspec: a path may hold bytes that are not UTF-8
            (new / MANIFEST).write_bytes(f"{json.dumps(content, indent=2)}\n".encode())
    return ExportResult((target,), {table.file: table.rows for table in written}, notes)


def _foxglove(
    reader: RecordReader, selection: MessageSelection, target: Path, force: bool, progress: Progress
) -> ExportResult:
    from zsim_analysis.export import viewers
    from zsim_analysis.export.foxglove_file import convert

    beside = (target.with_name(f"{target.stem}{LAYOUT}"), target.with_suffix(BLUEPRINT))
    targets = (target, *(beside if viewers.has_rerun() else beside[:1]))
    for path in targets:
        check_free(path, force, reader.path)
    with placed(*targets) as (new, new_layout, *new_blueprint):
        run = convert(reader, selection, new, progress)
        if not run.topics:
            raise ReportError(f"{reader.path}: {_nothing(reader, selection)}")
        new_layout.write_text(viewers.layout(run) + "\n", encoding="utf-8")
        for path in new_blueprint:
            viewers.write_blueprint(path, target.stem, run)
    return ExportResult(targets, run.topics, [*record_notes(reader), *_refused(run.refused)])


def _refused(count: int) -> list[str]:
    return [f"{count} messages on record are not what their key promises and were left out"] if count else []


def _nothing(reader: RecordReader, selection: MessageSelection) -> str:
    """Return why there is nothing to export."""
    count = sum(reader.topics().values())
    if not count:
        return "holds no message; there is nothing to export"
    criteria = [f"on {' '.join(selection.expressions)}"] if selection.expressions else []
    criteria += [f"from {selection.from_s:g} s"] if selection.from_s is not None else []
    criteria += [f"to {selection.to_s:g} s"] if selection.to_s is not None else []
    return " ".join(["has no message", *criteria, f"that can be exported; it holds {count} messages"])


def check_free(target: Path, force: bool, record: Path) -> None:
    """Refuse a target that must not be replaced.

    Raises:
        ReportError: the target exists and `force` is not set; or it is the record, or no export.
    """
    if not target.exists():
        return
    if target.resolve() == record.resolve():
        raise ReportError(f"{target}: is the record itself; give --out another place")
    if not force:
        raise ReportError(f"{target}: exists; give --out another place, or --force to replace it")
    if target.is_dir():
        try:
            tables = json.loads((target / MANIFEST).read_bytes())["tables"].keys()
            others = {path.name for path in target.iterdir()} - {MANIFEST, *tables}
            other = f"it holds {min(others)}" if others else ""
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
            other = f"it has no {MANIFEST} of one"
        if other:
            what = f"is a folder of something else than an export ({other})"
            raise ReportError(f"{target}: {what}; give --out another place")
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
            raise ReportError(f"{target}: is a file of something else than an export; give --out another place")


@contextmanager
def placed(*targets: Path) -> Iterator[tuple[Path, ...]]:
    """Yield a temporary path for each file or folder to be written; move them to their targets together at the end.

    Existing ones are replaced: call `check_free` first.

    Raises:
        ReportError: they cannot be written.
    """
    # beside the target, so that files can be renamed; a TemporaryDirectory stays if Ctrl-C comes while it is made
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
        except BaseException:  # after a failure or Ctrl-C the old ones are back
            for new, target, old in moves:
                if not new.exists() and target.exists():
                    target.replace(new)
                if old.exists():
                    old.replace(target)
            raise
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else error  # without the text that libraries add to it
        raise ReportError(f"{targets[0]}: cannot be written ({reason}); make room and export again") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # one that is not empty stays, and with it those above
            for parent in new_parents:
                parent.rmdir()
