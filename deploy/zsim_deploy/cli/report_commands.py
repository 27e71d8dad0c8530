"""The commands that report on runs, and how a run ends for a person."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from zsim.errors import ZsimError
from zsim_deploy.cli import sweep_commands
from zsim_deploy.options.arguments import RUN
from zsim_deploy.terminal.interrupts import INTERRUPTED

app = typer.Typer()


def conclude(outcome: Any, out: Path, report: bool) -> None:
    """Say how a run ended, make its report, and end with the exit code that tells it."""
    if outcome.failed or outcome.interrupted:
        print(f"ended: {outcome.reason}", file=sys.stderr)
    recorded = (out / "run.mcap").exists()
    if outcome.interrupted:
        if recorded:
            print(f"the record so far is {out / 'run.mcap'}; `zsim report {out}` makes its report", file=sys.stderr)
        sys.exit(INTERRUPTED)
    if report and recorded:
        _report_at_the_end(out, outcome.failed)
    if outcome.failed:
        print(f"logs are in {out / 'logs'}", file=sys.stderr)
        raise typer.Exit(1)


@app.command(rich_help_panel=RUN)
def report(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folder of a run or a sweep; of several runs, to compare.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Page that compares (default compare-NAMES.html beside the first).")
    ] = None,
) -> None:
    """Make summary.json, figures and report.html of a run from its record, or of a sweep; or compare several runs."""
    from zsim.record.run_folder import record_in
    from zsim_analysis.sweep.design import is_sweep

    if len(directories) > 1:
        _compare(directories, out)
        return
    directory = directories[0]
    if out is not None:
        raise typer.BadParameter("--out is for the page that compares several runs; leave it out")
    if is_sweep(directory):
        sweep_commands.make_report(directory)
        return
    record_in(directory)
    _report(directory)


def _report_at_the_end(out: Path, failed: bool) -> None:
    try:
        _report(out)
    except ZsimError as error:
        if not failed:
            raise
        print(error, file=sys.stderr)
    except KeyboardInterrupt:
        print(f"interrupted; the record is complete, `zsim report {out}` makes its report", file=sys.stderr)
        sys.exit(INTERRUPTED)


def _report(directory: Path) -> None:
    from zsim_analysis.report.make_report import make_report, table
    from zsim_deploy.terminal import report_terminal

    report_terminal.show(directory, "reading the record …", make_report, table)


def _compare(directories: list[Path], out: Path | None) -> None:
    from rich.console import Console

    from zsim.record.run_folder import record_in
    from zsim_analysis.report.make_comparison import compare, comparison_path
    from zsim_analysis.sweep.design import is_sweep

    for directory in directories:
        if is_sweep(directory):
            raise typer.BadParameter(f"{directory} is a sweep; runs can be compared, a sweep has a report of its own")
        record_in(directory)
    page = out or comparison_path(directories)
    with Console(stderr=True).status("reading the records …") as status:
        compare(directories, page, lambda text: status.update(text))
    print(f"report: {page}")
