"""The command line: thin commands that read options, call one function, and print one line for a fault."""

import sys
from functools import cache
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.main import get_command

from zsim import __version__
from zsim.errors import BehindError, SupersededError, ZsimError
from zsim_deploy import (
    certs_commands,
    console_command,
    export_command,
    fault_commands,
    gateway_command,
    hosts_commands,
    look_commands,
    render_commands,
    replay_command,
    ros1_command,
    ros2_command,
    sweep_commands,
)
from zsim_deploy.arguments import (
    DEFAULT_ENDPOINT,
    Access,
    Connect,
    Duration,
    Federation,
    Host,
    Insecure,
    Launched,
    RateOption,
    Realtime,
    ScenarioPath,
    Seed,
    Set,
    Tls,
    Wait,
    identity,
    load_scenario,
    mode_and_rate,
)
from zsim_deploy.reach import Reach, takes_part

app = typer.Typer(
    name="zsim",
    help="Co-simulate drone formations: one world, estimators and controllers as processes on Zenoh, in lockstep.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

UsageError: Any = typer.BadParameter.__bases__[0]  # click's, or that of the click inside of newer typers
USER_FAULT = 2  # exit code of whatever a person has to put right
EXIT_CODES = {SupersededError: 3, BehindError: 1}  # of the faults after which somebody else goes on; see watch.py
INTERRUPTED = 130  # exit code of a shell for a program that Ctrl-C ended
RUN, ROLES = "Run", "Roles, started by hand, on any machine, in any order"
HOSTS = "On several machines"


@app.command(rich_help_panel=RUN)
def run(
    scenario: ScenarioPath,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the run (default runs/NAME-TIME).", show_default=False)
    ] = None,
    seed: Seed = None,
    duration: Duration = None,
    in_process: Annotated[bool, typer.Option("--in-process", help="Everything in this process, no Zenoh.")] = False,
    realtime: Realtime = False,
    rate: RateOption = None,
    set_: Set = None,
    listen: Annotated[
        str | None, typer.Option(help="Endpoint of the world (default tcp/127.0.0.1:7447, or a free port).")
    ] = None,
    insecure: Insecure = False,
    hosted: Annotated[
        bool, typer.Option("--hosted", help="Estimators and controllers in one process: faster, the same bits.")
    ] = False,
    console: Annotated[bool, typer.Option("--console", help="Show it in the browser, and steer it there.")] = False,
    report: Annotated[bool, typer.Option(help="Make the report at the end.")] = True,
    order: Annotated[str, typer.Option(hidden=True)] = "",
) -> None:
    """Fly a scenario: start every process, show progress, record, report."""
    from zsim_deploy.progress import Screen
    from zsim_deploy.run import Options, check_endpoint, make_directory, run_in_process, run_processes
    from zsim_deploy.watch import Outcome

    given = {
        "--realtime": realtime,
        "--rate": rate is not None,
        "--listen": listen is not None,
        "--hosted": hosted,
        "--console": console,
    }
    if in_process and any(given.values()):
        useless = " and ".join(name for name, is_given in given.items() if is_given)
        raise typer.BadParameter(f"--in-process is lockstep, unpaced, without Zenoh; leave out {useless}, or it")
    if console:
        console_command.check()
    check_endpoint(listen, insecure)
    loaded = load_scenario(scenario, set_, seed, duration)
    mode, pace = mode_and_rate(realtime, rate)
    folder, first = make_directory(out, loaded), [name for name in order.split(",") if name]
    options = Options(loaded, folder, mode, pace, listen, insecure, hosted, first, console)
    with Screen(loaded.duration_s) as screen:
        try:
            outcome = run_in_process(options, screen) if in_process else run_processes(options, screen)
        except KeyboardInterrupt:
            outcome = Outcome("interrupted twice, nobody was waited for", interrupted=True)
    conclude(outcome, options.out, report)


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
def validate(scenario: ScenarioPath, set_: Set = None) -> None:
    """Check a scenario and print what it resolves to; every fault is a line."""
    from zsim import scenario_file

    print(scenario_file.to_text(load_scenario(scenario, set_)), end="")


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
    from zsim_deploy.run_folder import record_in
    from zsim_deploy.sweep.plan import is_sweep

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
    from rich.console import Console

    from zsim_deploy.report import make_report, table

    console = Console(stderr=True)
    with console.status("reading the record …") as status:
        summary = make_report(directory, lambda text: status.update(text))
    Console().print(table(summary))
    print(f"report: {directory / 'report.html'}")


def _compare(directories: list[Path], out: Path | None) -> None:
    from rich.console import Console

    from zsim_deploy.report import compare, comparison_path
    from zsim_deploy.run_folder import record_in
    from zsim_deploy.sweep.plan import is_sweep

    for directory in directories:
        if is_sweep(directory):
            raise typer.BadParameter(f"{directory} is a sweep; runs can be compared, a sweep has a report of its own")
        record_in(directory)
    page = out or comparison_path(directories)
    with Console(stderr=True).status("reading the records …") as status:
        compare(directories, page, lambda text: status.update(text))
    print(f"report: {page}")


@app.command(rich_help_panel=ROLES)
def world(
    scenario: ScenarioPath,
    listen: Annotated[
        list[str] | None, typer.Option(help=f"Endpoint, repeatable (default {DEFAULT_ENDPOINT}).")
    ] = None,
    seed: Seed = None,
    duration: Duration = None,
    realtime: Realtime = False,
    rate: RateOption = None,
    set_: Set = None,
    expect: Annotated[list[str] | None, typer.Option(help="Wait for this process too, e.g. recorder.")] = None,
    launched: Launched = None,
    tls: Tls = None,
    access: Access = None,
    insecure: Insecure = False,
    host: Host = None,
) -> None:
    """Run the world: integrates all drones and owns simulated time."""
    from zsim_deploy import roles

    loaded = load_scenario(scenario, set_, seed, duration)
    mode, pace = mode_and_rate(realtime, rate)
    who = identity(host, tls, insecure, access)
    roles.world(loaded, mode, pace, listen or [DEFAULT_ENDPOINT], launched, expect, who)


@app.command(rich_help_panel=ROLES)
@takes_part
def estimator(
    reach: Reach,
    drones: Annotated[
        list[str],
        typer.Argument(metavar="DRONE...", help="Drones, or patterns: 'drone*'.", show_default=False),
    ],
) -> None:
    """Run the estimator of one drone, or of several in one process."""
    from zsim_deploy import roles

    roles.agent(roles.estimator(drones), reach)


@app.command(rich_help_panel=ROLES)
@takes_part
def controller(
    reach: Reach,
    cluster: Annotated[str, typer.Argument(help="Name of the cluster.")] = "main",
) -> None:
    """Run the cluster-space controller of one cluster."""
    from zsim_deploy import roles

    roles.agent(roles.controller(cluster), reach)


@app.command("host", rich_help_panel=ROLES)
def host_agents(
    names: Annotated[
        list[str],
        typer.Argument(metavar="NAME...", help="Processes, or patterns: 'estimator.*' controller.main."),
    ],
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    wait: Wait = None,
    launched: Launched = None,
    insecure: Insecure = False,
    host: Host = None,
) -> None:
    """Run several estimators and controllers in one process, which is faster."""
    from zsim_deploy import roles

    roles.agent(roles.host(names), Reach(connect, federation, wait, None, insecure, host, launched))


@app.command(rich_help_panel=ROLES)
@takes_part
def record(
    reach: Reach,
    out: Annotated[Path, typer.Option(help="Folder for run.mcap.")] = Path("."),
) -> None:
    """Record every message of a federation into run.mcap."""
    from zsim_deploy import roles

    roles.recorder(out / "run.mcap", reach)


@app.command(rich_help_panel=ROLES)
def router(
    name: Annotated[str, typer.Argument(help="Name of the router.")] = "main",
    listen: Annotated[str, typer.Option(help="Endpoint for its clients.")] = "tcp/127.0.0.1:7448",
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    realtime: Realtime = False,
    launched: Launched = None,
    tls: Tls = None,
    access: Access = None,
    insecure: Insecure = False,
    host: Host = None,
) -> None:
    """Run a router: carries the clients of one network to a world, or a router, in another."""
    from zsim_deploy import roles

    mode = "realtime" if realtime else "lockstep"
    roles.router(name, listen, connect, federation, mode, launched, identity(host, tls, insecure, access))


def _version(asked: bool) -> None:
    if asked:
        print(f"zsim {__version__}")
        raise typer.Exit


app.add_typer(sweep_commands.app)
app.add_typer(export_command.app)
app.add_typer(replay_command.app)
app.add_typer(look_commands.app)
app.add_typer(fault_commands.app, rich_help_panel=look_commands.PANEL)
app.add_typer(console_command.app)
app.add_typer(gateway_command.app)
app.add_typer(ros1_command.app)
app.add_typer(ros2_command.app)
hosts_commands.register(app, HOSTS)
app.add_typer(certs_commands.app, rich_help_panel=HOSTS)
app.add_typer(render_commands.app, rich_help_panel=HOSTS)


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
    _say_anything()
    try:
        code = command()(standalone_mode=False, prog_name="zsim")
    except ZsimError as error:
        print(error, file=sys.stderr)
        sys.exit(EXIT_CODES.get(type(error), USER_FAULT))
    except UsageError as error:
        _show_usage(error)
        sys.exit(2)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    if code == INTERRUPTED:
        print("interrupted", file=sys.stderr)
    sys.exit(code)


def _say_anything() -> None:
    """Let a terminal that knows few letters show a question mark for the others, rather than end the command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def _show_usage(error: Any) -> None:
    """Print what was wrong with a command line in one line; after a bare `zsim` the help has been printed."""
    if isinstance(error, typer.BadParameter) and error.param is None:
        said = error.message
    else:
        said = " ".join(error.format_message().split()).replace("Value error, ", "")  # newer typers ask pydantic
    command = error.ctx.command_path if error.ctx else "zsim"
    if said:
        print(f"{command}: {said[0].lower()}{said[1:].rstrip('.')}; see `{command} --help`", file=sys.stderr)


if __name__ == "__main__":
    main()
