"""`zsim sweep`: one scenario flown many times, over all cores or a Dask cluster."""

import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsim_deploy.options.arguments import Duration, ScenarioPath, Seed, Set
from zsim_deploy.terminal.interrupts import INTERRUPTED

if TYPE_CHECKING:
    from zsim_analysis.sweep.design import SweepPlan

PANEL = "Run"

app = typer.Typer()


@app.command(rich_help_panel=PANEL)
def sweep(
    scenario: ScenarioPath,
    runs: Annotated[
        int | None, typer.Option(min=1, help="How many runs (default: one per combination).", show_default=False)
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="seed, a.b.c=v1,v2,… or a.b.c=uniform(low,high) or a.b.c=normal(mean,std). Repeatable."),
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
) -> None:
    """Fly a scenario many times, with other seeds and values of its fields: one table, one report."""
    from zsim_analysis.sweep.sweep import SweepRequest, check_installed
    from zsim_analysis.sweep.sweep import sweep as fly

    if dask is not None and (keep_records or workers is not None):
        useless = "--keep-records" if keep_records else "--workers"
        raise typer.BadParameter(f"{useless} is for processes of this host; leave it out, or --dask")
    check_installed(dask is not None)
    plan = _plan(scenario, vary or [], set_ or [], seed, duration, runs, keep_records)
    folder = out or Path("runs") / f"{plan.document['name']}-sweep-{time.strftime('%Y%m%d-%H%M%S')}"
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        rows = fly(SweepRequest(plan, folder, workers, dask))
    except KeyboardInterrupt:
        print(f"interrupted; the same command with --out {folder} goes on, the table so far is in it", file=sys.stderr)
        sys.exit(INTERRUPTED)
    _conclude(folder, [row["failure"] for row in rows if row["failure"]], len(rows), report)


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
        )


def _conclude(folder: Path, failures: list[str], runs: int, report: bool) -> None:
    """Say what did not end well, make the report, and fail if no run ended well."""
    for failure in sorted(set(failures), key=failures.count, reverse=True)[:5]:
        print(f"{failures.count(failure)} of {runs} runs failed: {failure}", file=sys.stderr)
    if report:
        make_report(folder)
    print(f"table: {folder / 'sweep.parquet'}")
    if len(failures) == runs:
        raise typer.Exit(1)


def make_report(folder: Path) -> None:
    """Make the report of a sweep, and show its table."""
    from zsim_analysis.sweep.make_sweep_report import make_sweep_report, table
    from zsim_deploy.terminal import report_terminal

    report_terminal.show(folder, "reading the table …", make_sweep_report, table)
