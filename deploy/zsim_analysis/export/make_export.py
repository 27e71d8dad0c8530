"""Makes an export: record in, files of other tools out."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from zsim import __version__
from zsim.errors import ReportError
from zsim.record import RecordReader
from zsim.record.record_reader import record_at, record_notes
from zsim_analysis.export.output import DEFAULTS, MANIFEST, Format, check_free, placed
from zsim_analysis.export.selection import DecodedMessages, MessageSelection, TableSurvey, batches

Progress = Callable[[int, int], None]  # messages read so far, of how many


class ExportResult(NamedTuple):
    """The result of an export.

    Attributes:
        paths: that were written.
        tables: name and rows of each table, or topic and messages.
        notes: what a reader has to know: whether the record was cut or damaged, and what was left out.
    """

    paths: tuple[Path, ...]
    tables: dict[str, int]
    notes: list[str]


def export(
    run: Path,
    form: Format,
    out: Path | None = None,
    selection: MessageSelection | None = None,
    force: bool = False,
    progress: Progress = lambda done, of: None,
) -> ExportResult:
    """Write the record of a run in the form of another tool, all of it or nothing.

    Args:
        run: its folder, or its record.
        form: of the output.
        out: where, None for the usual place beside the record.
        selection: which messages, None for all.
        force: replace what an earlier export has written.
        progress: called now and then.

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
        return _tables(reader, form, chosen, target, progress)


def _tables(
    reader: RecordReader, form: Format, selection: MessageSelection, target: Path, progress: Progress
) -> ExportResult:
    survey = TableSurvey(reader, selection)
    total = sum(survey.rows.values())
    messages = selection.messages(reader, survey.wanted)
    decoded = DecodedMessages(messages, survey.decode, lambda done: progress(done, total))
    with placed(target) as (new,):
        sink = _sink(form, new, survey)
        with sink:
            for batch in batches(decoded, sink.columns):
                sink.write(batch)
            written = sink.finish()
        if not written:
            raise ReportError(f"{reader.path}: {_nothing(reader, selection)}")
        notes = [*record_notes(reader.complete, reader.damaged), *_refused(decoded.refused)]
        if form is not Format.MAT:
            (new / MANIFEST).write_bytes(_manifest(reader, selection, written, notes))
    return ExportResult((target,), {table.file: table.rows for table in written}, notes)


def _sink(form: Format, new: Path, survey: TableSurvey) -> Any:
    if form is Format.MAT:
        from zsim_analysis.export.matlab import MatFile

        return MatFile(new, survey)
    from zsim_analysis.export.tables import TableFolder

    new.mkdir()
    return TableFolder(new, form.value, survey.fields)


def _foxglove(
    reader: RecordReader, selection: MessageSelection, target: Path, force: bool, progress: Progress
) -> ExportResult:
    from zsim_analysis.export.foxglove_file import convert

    layout = target.with_name(f"{target.stem}-layout.json")
    for path in (target, layout):
        check_free(path, force, reader.path)
    with placed(target, layout) as (new, new_layout):
        topics, refused = convert(reader, selection, new, new_layout, progress)
        if not topics:
            raise ReportError(f"{reader.path}: {_nothing(reader, selection)}")
    return ExportResult((target, layout), topics, [*record_notes(reader.complete, reader.damaged), *_refused(refused)])


def _refused(count: int) -> list[str]:
    return [f"{count} messages on record are not what their key promises and were left out"] if count else []


def _nothing(reader: RecordReader, selection: MessageSelection) -> str:
    count = sum(reader.topics().values())
    if not count:
        return "holds no message; there is nothing to export"
    criteria = [f"on {' '.join(selection.expressions)}"] if selection.expressions else []
    criteria += [f"from {selection.from_s:g} s"] if selection.from_s is not None else []
    criteria += [f"to {selection.to_s:g} s"] if selection.to_s is not None else []
    return " ".join(["has no message", *criteria, f"that can be exported; it holds {count} messages"])


def _manifest(reader: RecordReader, selection: MessageSelection, written: list[Any], notes: list[str]) -> bytes:
    """Return the content of export.json: what tables were made from, and their columns."""
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
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"
