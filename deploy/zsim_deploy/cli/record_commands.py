"""`zsim replay`, `zsim rerun` and `zsim export`: a record played back onto the keys, flown again, or converted."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsim.contract.messages import RATE_MAX
from zsim.errors import RunError
from zsim_analysis.export.output import Format
from zsim_deploy.arguments import DEFAULT_ENDPOINT, RUN, Access, Host, Insecure, Tls, identity, not_negative
from zsim_deploy.terminal import interruptible

if TYPE_CHECKING:
    from zsim_analysis.export.make_export import ExportResult

REPLAY_NEEDS = {"mcap": "record", "zstandard": "record"}  # modules, and the extras that bring them
RERUN_NEEDS = REPLAY_NEEDS | {"numba": "world", "scipy": "agents", "filterpy": "agents"}

app = typer.Typer()
Place = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run, or its run.mcap.", show_default=False)]


@app.command(rich_help_panel=RUN)
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


def _rate(value: float) -> float:
    """Return a pace that a replay can have."""
    if not 0 <= value <= RATE_MAX:
        raise typer.BadParameter(f"is {value:g}; must be >= 0 and <= {RATE_MAX:g}")
    return value


@app.command(rich_help_panel=RUN)
def replay(
    directory: Place,
    rate: Annotated[
        float, typer.Option(callback=_rate, help="Simulated per wall second; 0 = as fast as it goes.")
    ] = 1.0,
    from_: Annotated[
        float, typer.Option("--from", callback=not_negative, help="Simulated seconds of the first gate.")
    ] = 0.0,
    to: Annotated[
        float | None, typer.Option("--to", callback=not_negative, help="Simulated seconds of the last gate.")
    ] = None,
    keys: Annotated[
        list[str] | None, typer.Option(help="Only these keys, e.g. 'drone/*/sensor/*'. Repeatable.", show_default=False)
    ] = None,
    expect: Annotated[
        list[str] | None,
        typer.Option(help="Begin when this process has joined, e.g. estimator.drone1, console.1. Repeatable."),
    ] = None,
    paused: Annotated[bool, typer.Option("--paused", help="Stand at the first gate until asked to resume.")] = False,
    listen: Annotated[
        list[str] | None, typer.Option(help=f"Endpoint, repeatable (default {DEFAULT_ENDPOINT}).")
    ] = None,
    federation: Annotated[str | None, typer.Option(help="Name of the federation (default the record's).")] = None,
    tls: Tls = None,
    access: Access = None,
    insecure: Insecure = False,
    host: Host = None,
) -> None:
    """Play a record back onto the keys: for a console, an estimator under test, any client; nobody can be flown."""
    _check("replay", REPLAY_NEEDS)
    from zsim_deploy.roles.world_role import ReplayOptions, play
    from zsim_world.playback.playback import PlaybackRange

    if to is not None and to < from_:
        raise typer.BadParameter(f"--to is {to:g}, before --from {from_:g}; must be at or after it")
    to_ns = None if to is None else round(to * 1e9)
    choice = PlaybackRange(round(from_ * 1e9), to_ns, tuple(keys or ["**"]), paused)
    options = ReplayOptions(choice, rate, tuple(expect or ()), tuple(listen or [DEFAULT_ENDPOINT]), federation)
    play(directory, options, identity(host, tls, insecure, access))


@app.command(rich_help_panel=RUN)
def rerun(
    directory: Place,
    commands_only: Annotated[
        bool, typer.Option("--commands-only", help="Feed the world all recorded commands; run no agents.")
    ] = False,
) -> None:
    """Fly the run of a record again, from its own inputs, and tell whether truth is the same; exit code 0 or 1."""
    _check("rerun", RERUN_NEEDS)
    from zsim_analysis.rerun.rerun import rerun_record

    if not rerun_record(directory, commands_only, print, lambda text: print(text, file=sys.stderr)):
        raise typer.Exit(1)


def _check(command: str, needs: dict[str, str]) -> None:
    """Refuse to begin without what is needed.

    Raises:
        RunError: with what to install.
    """
    missing = {module: extra for module, extra in needs.items() if find_spec(module) is None}
    if missing:
        extras = ",".join(sorted(set(missing.values())))
        raise RunError(f"{command}: {' and '.join(missing)} is not installed; pip install 'zsim[{extras}]'")
