"""`zsim bundle` and `zsim rerun`: a flight in one file, and a flight flown again."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, BadParameter, Option

from zsim_deploy import arguments as opt
from zsim_deploy.arguments import failed, note, require, say

app = typer.Typer()

BUNDLE_NEEDS = {**opt.FLIGHT_NEEDS, "report": ("matplotlib", "jinja2", "packaging")}


@app.command(rich_help_panel=opt.RUN)
def bundle(
    run: opt.Recorded,
    out: Annotated[
        Path | None, Option("--out", "-o", help="File (default NAME.zsim of the scenario).", show_default=False)
    ] = None,
    no_record: Annotated[
        bool, Option("--no-record", help="Leave the record out: much smaller; what differs is then known by gate only.")
    ] = False,
    force: Annotated[bool, Option("--force", help="Replace the file.")] = False,
    trust: opt.Trust = False,
) -> None:
    """Put a flight into one file, with all that flying it again on another machine needs."""
    require("bundle", BUNDLE_NEEDS)
    from rich.console import Console

    from zsim.schema import plugin
    from zsim_analysis.bundle.bundle_file import SUFFIX
    from zsim_analysis.bundle.make_bundle import make_bundle

    if out is not None and out.suffix != SUFFIX:
        raise BadParameter(f"--out is {out}; must end in {SUFFIX}")
    with plugin.names_only(not trust) as skipped, Console(stderr=True).status("reading the record …"):
        written = make_bundle(run, out, not no_record, force, note)
    for name in skipped:
        note(f"note: {name} was found and not imported; --trust imports it, for the errors in its figures")
    say(f"{written.path}: {written.size_bytes / 1e6:.1f} MB, SHA-256 {written.sha256}")


@app.command(rich_help_panel=opt.RUN)
def rerun(
    place: Annotated[
        Path, Argument(metavar="DIR|BUNDLE", help="Folder of a run, its run.mcap, or a bundle.", show_default=False)
    ],
    commands_only: Annotated[
        bool, Option("--commands-only", help="Feed the world all recorded commands; run no agents.")
    ] = False,
    trust: opt.Trust = False,
    install: Annotated[
        bool, Option("--install", help="Of a bundle: in an environment with its versions of packages, made for it.")
    ] = False,
    python: Annotated[
        Path | None, Option("--python", help="Python of that environment (default: this one).", show_default=False)
    ] = None,
) -> None:
    """Fly a run again, of a record or a bundle, and print whether all is the same; exit code 0 or 1."""
    require("rerun", opt.FLIGHT_NEEDS)
    from zsim.schema import plugin
    from zsim_analysis.bundle.bundle_file import is_bundle

    is_one = is_bundle(place)
    if (install or python) and not is_one:
        raise BadParameter(f"--install is for a bundle, and {place} is none; leave it out")
    if python and not install:
        raise BadParameter("--python is for the environment that --install makes; leave it out, or say --install")
    with plugin.names_only(not trust):
        if install:
            from zsim_deploy.environment import rerun_in_environment

            raise typer.Exit(rerun_in_environment(place, python, commands_only, trust, note))
        if is_one:
            require("rerun", BUNDLE_NEEDS)
            from zsim_analysis.bundle.bundle_rerun import rerun_bundle

            fault = rerun_bundle(place, commands_only, say, note)
        else:
            from zsim_analysis.rerun import rerun_record

            fault = rerun_record(place, commands_only, say, note)
    if fault:
        raise failed(fault)
