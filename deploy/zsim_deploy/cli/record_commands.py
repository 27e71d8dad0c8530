"""What is done with the records of runs: `zsim report`, `sweep`, `export` and `rerun`; how a run ends."""

import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from zsim.errors import ZsimError, printable
from zsim_analysis.export import Format
from zsim_analysis.report import FORMATS
from zsim_deploy import INTERRUPTED
from zsim_deploy.arguments import (
    FLIGHT_NEEDS,
    REPORT_NEEDS,
    RUN,
    Duration,
    From,
    Keys,
    ScenarioPath,
    Seed,
    Set,
    To,
    Trust,
    changed_fields,
    check_range,
    require,
)
from zsim_deploy.roles.stop_channel import interruptible

if TYPE_CHECKING:
    from zsim_analysis.export.make_export import ExportResult
    from zsim_analysis.reading.shortfall import Shortfall
    from zsim_analysis.sweep.design import SweepPlan

SWEEP_NEEDS = {"sweep": ("pyarrow", "numba", "filterpy", "mcap", "matplotlib", "jinja2")}
DASK_NEEDS = {**SWEEP_NEEDS, "dask": ("distributed",)}
WRITERS = {Format.CSV: "pyarrow", Format.PARQUET: "pyarrow", Format.MAT: "scipy", Format.FOXGLOVE: "foxglove"}

GATE = "a gate: an instant at which the processes meet"
app = typer.Typer()
Place = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run, or its run.mcap.", show_default=False)]


def conclude(outcome: Any, out: Path, report: bool) -> None:
    """Print how a run ended, make its report, and end with the exit code for it."""
    record = out / "run.mcap"
    if outcome.interrupted:
        print(printable(f"ended: {outcome.reason}"), file=sys.stderr)
        if record.exists():
            print(printable(f"the record so far is {record}; `zsim report {out}` makes its report"), file=sys.stderr)
        sys.exit(INTERRUPTED)
    record_fault = _judged_at_the_end(out, report, outcome.failed) if record.exists() else "nothing was recorded"
    if record.exists():
        print(printable(f"ended: {outcome.reason}; the record is {record}"))
    if fault := outcome.reason if outcome.failed else record_fault:
        if (out / "logs").exists():
            print(printable(f"logs are in {out / 'logs'}"), file=sys.stderr)
        raise _failed(f"ended: {fault}")


def note_skipped(names: Sequence[str]) -> None:
    """Print which code that a document names was found, and not imported."""
    for name in names:
        print(printable(f"note: {name} is there, and not imported: --trust runs it"), file=sys.stderr)


def _failed(cause: str) -> typer.Exit:
    """Print why a command ends with exit code 1, in its last line; return the exception to raise."""
    print(printable(cause), file=sys.stderr)
    return typer.Exit(1)


def _judged_at_the_end(out: Path, report: bool, failed: bool) -> str:
    """Make the report of a run if that is wanted; return what the run did not do or lacks, empty if nothing."""
    try:
        return _report(out) if report else _judge(out / "run.mcap")
    except ZsimError as error:
        if not failed:
            raise
        print(printable(str(error)), file=sys.stderr)
        return str(error)
    except KeyboardInterrupt:
        print(printable(f"interrupted; the record is kept, `zsim report {out}` makes its report"), file=sys.stderr)
        sys.exit(INTERRUPTED)


def _judge(record: Path) -> str:
    """Print what a flight did not do of its plan; return what `_report` returns of it."""
    from zsim_analysis.reading.shortfall import marks_of, verdict

    judged = verdict(record)
    for mark, _ in marks_of(judged.shortfalls):
        print(printable(mark))
    return _fault_of(judged.completeness.complete, str(judged.completeness), judged.shortfalls)


def _fault_of(complete: bool, state: str, shortfalls: "Sequence[Shortfall]") -> str:
    """Print whether the record is complete; return what it lacks, or what the flight did not do, empty if nothing."""
    print(printable(f"record: {state}{f' ({GATE})' if 'gates' in state else ''}"))
    lacking = "" if complete else f"the record is {state}"
    return lacking or next((each.text for each in shortfalls if each.fails), "")


@app.command(rich_help_panel=RUN)
def report(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folder of a run or a sweep; of several runs, to compare.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Page that compares (default compare-NAMES.html beside the first).")
    ] = None,
    formats: Annotated[
        str | None,
        typer.Option("--format", help="pdf, svg or pdf,svg: figures are written so too.", show_default=False),
    ] = None,
    trust: Trust = False,
) -> None:
    """Make summary.json, figures and report.html of a run from its record, or of a sweep; or compare several runs."""
    require("report", REPORT_NEEDS)
    from zsim.schema import plugin

    with plugin.names_only(not trust) as skipped:
        _report_on(directories, out, formats)
    note_skipped(skipped)


def _report_on(directories: list[Path], out: Path | None, formats: str | None) -> None:
    from zsim.record.record_reader import record_in
    from zsim_analysis.sweep.design import is_sweep

    wanted = _formats(formats)
    if len(directories) > 1:
        _compare(directories, out, wanted)
        return
    directory = directories[0]
    if out is not None:
        raise typer.BadParameter("--out is for the page that compares several runs; leave it out")
    if not is_sweep(directory):
        record_in(directory)
    _report(directory, wanted)


def _formats(text: str | None) -> tuple[str, ...]:
    """Return the formats of figures in a text, with commas between them."""
    wanted = tuple(text.split(",")) if text else ()
    if not set(wanted) <= set(FORMATS):
        raise typer.BadParameter(f"--format is {text!r}; must be {' or '.join(FORMATS)}, or both with a comma between")
    return wanted


def _report(folder: Path, formats: Sequence[str] = ()) -> str:
    """Make the report of a run or of a sweep, and print its table; return what the run did not do, or lacks.

    Args:
        folder: of the run or the sweep.
        formats: of figures, beside PNG.
    """
    from rich.console import Console

    from zsim.runtime.progress import PipedConsole, cell
    from zsim_analysis.sweep.design import is_sweep

    if is_sweep(folder):
        from zsim_analysis.sweep.sweep_report import make_sweep_report as make
        from zsim_analysis.sweep.sweep_report import terminal_text
    else:
        from zsim_analysis.report.make_report import make_report as make
        from zsim_analysis.report.summary import terminal_text
    with Console(stderr=True).status("reading …") as status:
        summary: Any = make(folder, lambda text: status.update(cell(text)), formats)
    PipedConsole().print(terminal_text(summary))
    fault = "" if is_sweep(folder) else _fault_of(summary.record.complete, summary.record.state, summary.shortfalls)
    print(printable(f"report: {folder / 'report.html'}"))
    return fault


def _compare(directories: list[Path], out: Path | None, formats: Sequence[str]) -> None:
    from rich.console import Console

    from zsim.record.record_reader import record_in
    from zsim.runtime.progress import cell
    from zsim_analysis.report.comparison import compare, comparison_path
    from zsim_analysis.sweep.design import is_sweep

    for directory in directories:
        if is_sweep(directory):
            raise typer.BadParameter(f"{directory} is a sweep; runs can be compared, a sweep has a report of its own")
        record_in(directory)
    page = out or comparison_path(directories)
    with Console(stderr=True).status("reading the records …") as status:
        compare(directories, page, lambda text: status.update(cell(text)), formats)
    print(printable(f"report: {page}"))


@app.command(rich_help_panel=RUN)
def sweep(
    scenario: ScenarioPath,
    runs: Annotated[
        int | None, typer.Option(min=1, help="How many runs (default: one per combination).", show_default=False)
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            help="seed, seed=paired, a.b.c=v1,v2,… or a.b.c=uniform(low,high) or a.b.c=normal(mean,std). Repeatable."
        ),
    ] = None,
    set_: Set = None,
    seed: Seed = None,
    duration: Duration = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder (default runs/NAME-sweep-TIME); one that is not finished is gone on with."),
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, max=1024, help="Processes (default: one per core).")] = None,
    dask: Annotated[str | None, typer.Option(help="Scheduler of a Dask cluster that flies the runs instead.")] = None,
    keep_records: Annotated[bool, typer.Option("--keep-records", help="Keep the record of every run.")] = False,
    report: Annotated[bool, typer.Option(help="Make the report at the end.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Sweep into a folder that holds other files, too.")] = False,
) -> None:
    """Fly a scenario many times, with other seeds and values of its fields: one table, one report."""
    if dask is not None and (keep_records or workers is not None):
        useless = "--keep-records" if keep_records else "--workers"
        raise typer.BadParameter(f"{useless} is for processes of this host; leave it out, or --dask")
    require("sweep", SWEEP_NEEDS if dask is None else DASK_NEEDS)
    from zsim_analysis.sweep.sweep import SweepRequest
    from zsim_analysis.sweep.sweep import sweep as fly

    plan = _plan(scenario, vary or [], set_ or [], seed, duration, runs, keep_records)
    folder = out or Path("runs") / f"{plan.document['name']}-sweep-{time.strftime('%Y%m%d-%H%M%S')}"
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        rows = fly(SweepRequest(plan, folder, workers, dask, force))
    except KeyboardInterrupt:
        print(
            printable(f"interrupted; the same command with --out {folder} goes on, the table so far is in it"),
            file=sys.stderr,
        )
        sys.exit(INTERRUPTED)
    failures = [row["failure"] for row in rows if row["failure"]]
    short = [row["shortfall"] for row in rows if row.get("shortfall") and not row["failure"]]
    _conclude(folder, failures, len(rows), report, short)


def _plan(
    path: Path,
    vary: list[str],
    overrides: list[str],
    seed: int | None,
    duration: float | None,
    runs: int | None,
    records: bool,
) -> "SweepPlan":
    from rich.console import Console

    from zsim_analysis.sweep.design import make_plan, read_document

    document, faults = read_document(path, overrides, seed=seed, duration_s=duration)
    with Console(stderr=True).status("checking every combination …") as status:
        return make_plan(
            path.name,
            document,
            vary,
            runs,
            records,
            lambda run, of: status.update(f"checking combination {run + 1} of {of}"),
            faults,
            changed_fields(overrides, seed, duration),
        )


def _conclude(folder: Path, failures: list[str], runs: int, report: bool, short: Sequence[str] = ()) -> None:
    """Print what did not end well, make the report, and fail if a run did not end well, or none flew its plan."""
    for failure in sorted(set(failures), key=failures.count, reverse=True)[:5]:
        print(printable(f"{failures.count(failure)} of {runs} runs failed: {failure}"), file=sys.stderr)
    if report:
        _report(folder)
    print(printable(f"table: {folder / 'sweep.parquet'}"))
    if len(failures) == runs:
        raise _failed(f"none of {runs} runs ended well: {failures[0]}")
    if failures:
        raise _failed(f"{len(failures)} of {runs} runs failed: {failures[0]}")
    if len(failures) + len(short) == runs:
        raise _failed(f"none of {runs} runs was flown as planned: {short[0]}")


@app.command(rich_help_panel=RUN)
def export(
    run: Place,
    form: Annotated[
        Format, typer.Option("--format", help="Tables (csv, parquet), a MATLAB file, or an MCAP file for Foxglove.")
    ],
    keys: Keys = None,
    from_: From = None,
    to: To = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Where (default DIR/csv, DIR/parquet, DIR/run.mat, DIR/foxglove.mcap).", show_default=False),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export.")] = False,
    by_name: Annotated[
        bool,
        typer.Option("--by-name", help="A table of each drone, cluster and process: time in it only increases."),
    ] = False,
    trust: Trust = False,
) -> None:
    """Write the record of a run as tables, for MATLAB, or for Foxglove and Rerun."""
    if by_name and form not in (Format.CSV, Format.PARQUET):
        raise typer.BadParameter("--by-name is for tables; leave it out, or say --format csv or parquet")
    require("export", {"export": ("mcap", "zstandard", WRITERS[form])})
    from rich.console import Console
    from rich.progress import Progress

    from zsim.record.record_reader import record_at
    from zsim.schema import plugin

    check_range(from_, to)
    record_at(run)
    from zsim_analysis.export.columns import MessageSelection
    from zsim_analysis.export.make_export import export as write

    console = Console(stderr=True)
    hidden = not console.is_terminal
    with (
        interruptible(),
        plugin.names_only(not trust) as skipped,
        Progress(console=console, transient=True, disable=hidden) as bar,
    ):
        task = bar.add_task("looking through the record", total=None)
        done = write(
            run,
            form,
            out,
            MessageSelection(tuple(keys or ()), from_, to),
            force,
            lambda count, of: bar.update(task, description="reading messages", completed=count, total=of),
            by_name,
        )
    _show(done)
    note_skipped(skipped)


def _show(done: "ExportResult") -> None:
    for note in done.notes:
        print(printable(f"note: {note}"), file=sys.stderr)
    for name, rows in done.tables.items():
        print(printable(f"{name:<40} {rows:>10}"))
    print(printable("written: " + " ".join(map(str, done.paths))))


@app.command(rich_help_panel=RUN)
def rerun(
    directory: Place,
    commands_only: Annotated[
        bool, typer.Option("--commands-only", help="Feed the world all recorded commands; run no agents.")
    ] = False,
    trust: Trust = False,
) -> None:
    """Fly the run of a record again, from its own inputs, and print whether truth is the same; exit code 0 or 1."""
    require("rerun", FLIGHT_NEEDS)
    from zsim.schema import plugin
    from zsim_analysis.rerun import rerun_record

    def show(text: str) -> None:
        print(printable(text))

    def warn(text: str) -> None:
        print(printable(text), file=sys.stderr)

    with plugin.names_only(not trust):
        fault = rerun_record(directory, commands_only, show, warn)
    if fault:
        raise _failed(fault)
