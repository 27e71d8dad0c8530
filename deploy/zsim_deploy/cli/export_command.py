"""`zsim export`: the record of a run for pandas, MATLAB, Foxglove and Rerun."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsim_analysis.export.output import Format
from zsim_deploy.options.arguments import not_negative
from zsim_deploy.terminal.interrupts import interruptible

if TYPE_CHECKING:
    from zsim_analysis.export.make_export import ExportResult

PANEL = "Run"

app = typer.Typer()


@app.command(rich_help_panel=PANEL)
def export(
    run: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run, or its record.", show_default=False)],
    form: Annotated[
        Format, typer.Option("--format", help="Tables (csv, parquet), a MATLAB file, or an MCAP file for Foxglove.")
    ],
    keys: Annotated[
        list[str] | None, typer.Option(help="Only these keys, e.g. 'drone/*/truth'. Repeatable.", show_default=False)
    ] = None,
    from_: Annotated[
        float | None, typer.Option("--from", callback=not_negative, help="Simulated seconds of the first message.")
    ] = None,
    to: Annotated[
        float | None, typer.Option("--to", callback=not_negative, help="Simulated seconds of the last message.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Where (default DIR/csv, DIR/parquet, DIR/run.mat, DIR/foxglove.mcap).", show_default=False),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export.")] = False,
) -> None:
    """Write the record of a run as tables, for MATLAB, or for Foxglove and Rerun."""
    from rich.console import Console
    from rich.progress import Progress

    from zsim.record.run_folder import record_at
    from zsim_analysis.export.output import check_installed

    if from_ is not None and to is not None and to < from_:
        raise typer.BadParameter(f"--to is {to:g}, before --from {from_:g}; must be at or after it")
    record_at(run)
    check_installed(form)
    from zsim_analysis.export.make_export import export as write
    from zsim_analysis.export.selection import MessageSelection

    console = Console(stderr=True)
    with interruptible(), Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("looking through the record", total=None)
        done = write(
            run,
            form,
            out,
            MessageSelection(tuple(keys or ()), from_, to),
            force,
            lambda count, of: bar.update(task, description="reading messages", completed=count, total=of),
        )
    _show(done)


def _show(done: "ExportResult") -> None:
    for note in done.notes:
        print(f"note: {note}", file=sys.stderr)
    for name, rows in done.tables.items():
        print(f"{name:<40} {rows:>10}")
    print("written: " + " ".join(map(str, done.paths)))
