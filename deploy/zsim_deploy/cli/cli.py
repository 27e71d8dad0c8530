"""The command line: thin commands that read options, call one function, and print one line for a fault."""

import errno
import os
import sys
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.main import get_command

from zsim import __version__, extras
from zsim.errors import (
    BehindError,
    RequestRefusedError,
    RunFailedError,
    SupersededError,
    UserCodeError,
    ZsimError,
    printable,
)
from zsim_deploy import INTERRUPTED, USER_FAULT
from zsim_deploy.arguments import (
    CONSOLE_NEEDS,
    FLIGHT_NEEDS,
    HOSTS,
    REPORT_NEEDS,
    RUN,
    FlightOptions,
    Force,
    Insecure,
    ScenarioPath,
    Set,
    Trust,
    endpoint_origin,
    flight_options,
    load_scenario,
    require,
)
from zsim_deploy.cli import (
    ardrone_commands,
    bridge_commands,
    camera_commands,
    driver_commands,
    federation_commands,
    hosts_commands,
    inventory_commands,
    mavlink_commands,
    record_commands,
    role_commands,
)
from zsim_deploy.roles.closed_output import STREAMS, is_unread
from zsim_deploy.roles.stop_channel import interruptible

app = typer.Typer(
    name="zsim",
    help="Co-simulate drone formations: one world, estimators and controllers as processes on Zenoh, in lockstep.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

UsageError: Any = typer.BadParameter.__bases__[0]  # click's, or that of the click inside of newer typers
UNREAD = 128 + 13  # exit code of a command whose output nobody reads any more: that of SIGPIPE
FILE_FAULTS = {  # of a path that a person gave, or of its disk, wherever it is looked at first
    *(errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.ELOOP, errno.EROFS, errno.EIO, errno.ESTALE),
}
PATH_SHOWN = 200  # characters
EXIT_CODES = {  # of what is no wrong input
    SupersededError: 3,
    BehindError: 1,
    RequestRefusedError: 1,
    RunFailedError: 1,
    UserCodeError: 1,
}


@app.command(rich_help_panel=RUN)
@flight_options
def run(
    flight: FlightOptions,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the run (default runs/NAME-TIME).", show_default=False)
    ] = None,
    in_process: Annotated[bool, typer.Option("--in-process", help="Everything in this process, no Zenoh.")] = False,
    listen: Annotated[
        str | None, typer.Option(help="Endpoint of the world (default tcp/127.0.0.1:7447, or a free port).")
    ] = None,
    insecure: Insecure = False,
    hosted: Annotated[
        bool, typer.Option("--hosted", help="Estimators and controllers in one process: faster, the same bits.")
    ] = False,
    console: Annotated[bool, typer.Option("--console", help="Show it in the browser, and steer it there.")] = False,
    cameras: Annotated[
        bool,
        typer.Option("--cameras", help="Draw what cameras see; front and bottom where no drone has any."),
    ] = False,
    detect: Annotated[bool, typer.Option("--detect", help="Find hats in the cameras' pictures.")] = False,
    report: Annotated[bool, typer.Option(help="Make the report at the end.")] = True,
    continue_: Annotated[
        bool, typer.Option("--continue", help="SCENARIO is the folder of a run that was interrupted: it goes on.")
    ] = False,
    force: Force = False,
    order: Annotated[str, typer.Option(hidden=True)] = "",
) -> None:
    """Fly a scenario: start every process, show progress, record, report."""
    require("run", FLIGHT_NEEDS | (REPORT_NEEDS if report else {}))
    from zsim_agents.hosting import check_plans
    from zsim_deploy.launch.camera_children import with_cameras
    from zsim_deploy.launch.console_process import RunConsole
    from zsim_deploy.launch.run import (
        RunOptions,
        check_endpoint,
        check_open_files,
        fly,
        options_of,
    )
    from zsim_deploy.launch.run_folder import make_directory

    if in_process:
        _refuse_with_others(flight, listen, hosted, console, cameras, detect)
    if console:
        require("console", CONSOLE_NEEDS)
    shown = RunConsole() if console else None
    if continue_:
        _refuse_to_change(flight, out, in_process, listen, insecure, hosted)
        options, in_process = options_of(flight.path)
        options.console = shown
        options.cameras, options.detect = cameras, detect
    else:
        check_endpoint(listen, insecure)
        first = [name for name in order.split(",") if name]
        pace = flight.mode_and_rate()
        scenario = with_cameras(flight.scenario()) if cameras else flight.scenario()
        if in_process:
            check_plans(scenario, flight.path.name)  # as processes, controllers refuse them
        options = RunOptions(scenario, Path(), *pace, listen, insecure, hosted, first, shown, cameras, detect)
        options.changed = flight.changed()
    if not in_process:
        if options.camera_children():
            require("run", camera_commands.CAMERA_NEEDS)
        check_open_files(options)
    if not continue_:
        options.out = make_directory(out, options.scenario, force)
    with shown or nullcontext(), interruptible():
        with hosts_commands.seen_by_ps(options.scenario.federation, options.status):
            outcome = fly(options, in_process)
        if shown:
            shown.outcome = outcome
        record_commands.conclude(outcome, options.out, report)


def _refuse_with_others(
    flight: FlightOptions, listen: str | None, hosted: bool, console: bool, cameras: bool, detect: bool
) -> None:
    """Refuse options that have no meaning for a run in one process."""
    options = {
        "--realtime": flight.realtime,
        "--rate": flight.rate is not None,
        "--listen": listen is not None,
        "--hosted": hosted,
        "--console": console,
        "--cameras": cameras,
        "--detect": detect,
    }
    useless = " and ".join(name for name, is_given in options.items() if is_given)
    if useless:
        raise typer.BadParameter(f"--in-process is lockstep, unpaced, without Zenoh; leave out {useless}, or it")


def _refuse_to_change(
    flight: FlightOptions, out: Path | None, in_process: bool, listen: str | None, insecure: bool, hosted: bool
) -> None:
    """Refuse options that would make another run of one that goes on."""
    given = {
        "--seed": flight.seed,
        "--duration": flight.duration,
        "--realtime": flight.realtime or None,
        "--rate": flight.rate,
        "--set": flight.overrides or None,
        "--out": out,
        "--in-process": in_process or None,
        "--listen": listen,
        "--insecure": insecure or None,
        "--hosted": hosted or None,
    }
    useless = " and ".join(name for name, value in given.items() if value is not None)
    if useless:
        raise typer.BadParameter(f"--continue goes on as the run was launched; leave out {useless}")


@app.command(rich_help_panel=RUN)
def validate(scenario: ScenarioPath, set_: Set = None, trust: Trust = False) -> None:
    """Check a scenario and print what it resolves to; every fault is a line. Code that it names is not run."""
    from zsim.scenario import scenario_file
    from zsim.scenario.consistency import unflown_plans
    from zsim.schema import plugin
    from zsim_agents.hosting import check_plans

    with plugin.names_only(not trust) as skipped:
        loaded = load_scenario(scenario, set_)
        check_plans(loaded, scenario.name)
    if modules := [name for name in skipped if ":" not in name]:  # of vehicles and sensors: their numbers are in there
        lacking = f"what it resolves to is not printed, since that has numbers of {', '.join(modules)}"
        print(printable(f"{scenario.name}: all else is sound; {lacking}"), file=sys.stderr)
    else:
        print(printable(scenario_file.to_text(loaded)), end="", flush=True)
    for line in unflown_plans(loaded):
        print(printable(f"{scenario.name}: {line}"), file=sys.stderr)
    record_commands.note_skipped(skipped)


def _version(wanted: bool) -> None:
    if wanted:
        print(printable(f"zsim {__version__}"))
        raise typer.Exit


for family in (
    record_commands,
    role_commands,
    camera_commands,
    hosts_commands,
    federation_commands,
    bridge_commands,
):
    app.add_typer(family.app)
mavlink_commands.app.command("drive")(driver_commands.drive_mavlink)
ardrone_commands.ardrone.command("drive")(driver_commands.drive_ardrone)
app.add_typer(federation_commands.faults, rich_help_panel=federation_commands.PANEL)
app.add_typer(ardrone_commands.ardrone, rich_help_panel=bridge_commands.TRANSLATE)
app.add_typer(mavlink_commands.app, rich_help_panel=bridge_commands.TRANSLATE)
for group in (inventory_commands.certs, inventory_commands.rendering):
    app.add_typer(group, rich_help_panel=HOSTS)


@app.callback()
def options(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")] = False,
) -> None:
    """Co-simulate drone formations: one world, estimators and controllers as processes on Zenoh, in lockstep."""


@cache
def command() -> Any:
    """Return the command line, made once: a process that is forked has it already."""
    return get_command(app)


def main() -> None:
    """Run the command line; a user's fault is a line, not a traceback."""
    code = _exit_code()
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        code = code or UNREAD
        _drop_output()
    sys.exit(code)


def _exit_code() -> int | str | None:
    """Run the command line; return its exit code, UNREAD where nobody reads the output: click has 1, without a word."""
    try:
        _run()
    except BrokenPipeError:
        if not any(map(is_unread, STREAMS)):
            raise  # of a connection
        return UNREAD
    except SystemExit as ended:
        return UNREAD if isinstance(ended.__context__, BrokenPipeError) else ended.code


def _run() -> NoReturn:
    try:
        code = command()(standalone_mode=False, prog_name="zsim")
    except ZsimError as error:
        print(printable(endpoint_origin(str(error), sys.argv, os.environ)), file=sys.stderr)
        sys.exit(EXIT_CODES.get(type(error), USER_FAULT))
    except UsageError as error:
        _show_usage(error)
        sys.exit(2)
    except ModuleNotFoundError as error:
        if (lacking := extras.missing(error)) is None:
            raise
        print(printable(f"{' '.join(sys.argv[1:2])}: {lacking}"), file=sys.stderr)
        sys.exit(USER_FAULT)
    except OSError as error:
        if error.errno not in FILE_FAULTS or error.filename is None:
            raise
        path = os.fsdecode(error.filename)
        shown = path if len(path) <= PATH_SHOWN else f"{path[: PATH_SHOWN // 2]}…{path[-PATH_SHOWN // 2 :]}"
        print(printable(f"{shown}: cannot be used ({error.strerror}); give another path"), file=sys.stderr)
        sys.exit(USER_FAULT)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    if code == INTERRUPTED:
        print("interrupted", file=sys.stderr)
    sys.exit(code)


def _drop_output() -> None:
    """Let what nobody reads any more go nowhere, as behind `| head`."""
    into = os.open(os.devnull, os.O_WRONLY)
    for stream in filter(is_unread, STREAMS):
        os.dup2(into, stream)


def _show_usage(error: Any) -> None:
    """Print what was wrong with a command line in one line; after a bare `zsim` the help has been printed."""
    if isinstance(error, typer.BadParameter) and error.param is None:
        text = error.message
    else:
        text = " ".join(error.format_message().split()).replace("Value error, ", "")  # newer typers ask pydantic
    command = error.ctx.command_path if error.ctx else "zsim"
    if text:
        line = f"{command}: {text[0].lower()}{text[1:].rstrip('.')}; see `{command} --help`"
        print(printable(line), file=sys.stderr)


if __name__ == "__main__":
    main()
