"""`zsim replay` and `zsim rerun`: a record played back onto the keys, and its run flown again."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from zsim.contract.messages import RATE_MAX
from zsim.errors import RunError
from zsim_deploy.options.arguments import DEFAULT_ENDPOINT, Access, Host, Insecure, Tls, identity, not_negative

PANEL = "Run"
REPLAY_NEEDS = {"mcap": "record", "zstandard": "record"}  # modules, and the extras that bring them
RERUN_NEEDS = REPLAY_NEEDS | {"numba": "world", "scipy": "agents", "filterpy": "agents"}

app = typer.Typer()
Place = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run, or its run.mcap.", show_default=False)]


def _rate(value: float) -> float:
    """Return a pace that a replay can have."""
    if not 0 <= value <= RATE_MAX:
        raise typer.BadParameter(f"is {value:g}; must be >= 0 and <= {RATE_MAX:g}")
    return value


@app.command(rich_help_panel=PANEL)
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
    from zsim_deploy.launch.replay_run import Wish, play
    from zsim_world.playback.playback import Choice

    if to is not None and to < from_:
        raise typer.BadParameter(f"--to is {to:g}, before --from {from_:g}; must be at or after it")
    to_ns = None if to is None else round(to * 1e9)
    choice = Choice(round(from_ * 1e9), to_ns, tuple(keys or ["**"]), paused)
    wish = Wish(choice, rate, tuple(expect or ()), tuple(listen or [DEFAULT_ENDPOINT]), federation)
    play(directory, wish, identity(host, tls, insecure, access))


@app.command(rich_help_panel=PANEL)
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
        RunError: says what to install.
    """
    missing = {module: extra for module, extra in needs.items() if find_spec(module) is None}
    if missing:
        extras = ",".join(sorted(set(missing.values())))
        raise RunError(f"{command}: {' and '.join(missing)} is not installed; pip install 'zsim[{extras}]'")
