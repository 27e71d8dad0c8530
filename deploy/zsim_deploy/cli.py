"""The command line: thin commands that read options, call one function, and print one line for a fault."""

import json
import math
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from zsim import __version__
from zsim.errors import SupersededError, ZsimError

app = typer.Typer(
    name="zsim",
    help="Co-simulate drone formations: one world, estimators and controllers as processes on Zenoh, in lockstep.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

RUN, ROLES, LOOK = "Run", "Roles, started by hand, on any machine, in any order", "Look and poke"
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

ScenarioPath = Annotated[Path, typer.Argument(help="Scenario file (YAML).", show_default=False)]
Set = Annotated[list[str] | None, typer.Option("--set", help="Override a field: a.b.c=value. Repeatable.")]
Seed = Annotated[int | None, typer.Option(help="Seed instead of the scenario's.")]
Duration = Annotated[float | None, typer.Option(help="Simulated seconds instead of the scenario's.")]
Realtime = Annotated[bool, typer.Option("--realtime", help="Pace by the wall clock and wait for nobody.")]
RateOption = Annotated[float | None, typer.Option(help="Simulated per wall second (realtime 1, lockstep unpaced).")]
Connect = Annotated[str, typer.Option(help="Where the world (or a router) listens.")]
Federation = Annotated[str, typer.Option(help="Name of the federation: the prefix of its keys.")]
Wait = Annotated[float | None, typer.Option(help="Seconds to wait for a world; for ever if not given.")]
Launched = Annotated[str | None, typer.Option("--launched", hidden=True)]  # by `zsim run`, for the run of this id


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
    report: Annotated[bool, typer.Option(help="Make the report at the end.")] = True,
    order: Annotated[str, typer.Option(hidden=True)] = "",
) -> None:
    """Fly a scenario: start every process, show progress, record, report."""
    from zsim_deploy.progress import Screen
    from zsim_deploy.run import Options, make_directory, run_in_process, run_processes

    if in_process and realtime:
        raise typer.BadParameter("--in-process runs in lockstep; leave out one of --in-process and --realtime")
    loaded = _load(scenario, set_, seed, duration)
    mode, pace = _mode(realtime, rate)
    options = Options(loaded, make_directory(out, loaded), mode, pace, listen, [n for n in order.split(",") if n])
    with Screen(loaded.duration_s) as screen:
        outcome = run_in_process(options, screen) if in_process else run_processes(options, screen)
    _end(outcome, options.out, report)


def _end(outcome: Any, out: Path, report: bool) -> None:
    if outcome.failed or outcome.interrupted:
        print(f"ended: {outcome.reason}", file=sys.stderr)
    if outcome.interrupted:
        print(f"the record so far is {out / 'run.mcap'}; `zsim report {out}` makes its report", file=sys.stderr)
        raise typer.Exit(130)
    if report and (out / "run.mcap").exists():
        _report(out)
    if outcome.failed:
        print(f"logs are in {out / 'logs'}", file=sys.stderr)
        raise typer.Exit(1)


@app.command(rich_help_panel=RUN)
def validate(scenario: ScenarioPath, set_: Set = None) -> None:
    """Check a scenario and print what it resolves to; every fault is a line."""
    from zsim import scenario_file

    print(scenario_file.to_text(_load(scenario, set_)), end="")


@app.command(rich_help_panel=RUN)
def report(directory: Annotated[Path, typer.Argument(help="Folder of a run.", show_default=False)]) -> None:
    """Make summary.json, figures and report.html of a run from its record."""
    from zsim_deploy.look import report_path

    report_path(directory)
    _report(directory)


def _report(directory: Path) -> None:
    from rich.console import Console

    from zsim_deploy.report import make_report, table

    console = Console(stderr=True)
    with console.status("reading the record …") as status:
        summary = make_report(directory, lambda text: status.update(text))
    Console().print(table(summary))
    print(f"report: {directory / 'report.html'}")


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
) -> None:
    """Run the world: integrates all drones and owns simulated time."""
    from zsim_deploy import roles

    loaded = _load(scenario, set_, seed, duration)
    mode, pace = _mode(realtime, rate)
    roles.world(loaded, mode, pace, listen or [DEFAULT_ENDPOINT], launched, expect)


@app.command(rich_help_panel=ROLES)
def estimator(
    drone: Annotated[str, typer.Argument(help="Name of the drone.", show_default=False)],
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    wait: Wait = None,
    launched: Launched = None,
) -> None:
    """Run the estimator of one drone."""
    from zsim_deploy import roles

    roles.agent(roles.estimator(drone), connect, federation, wait, launched)


@app.command(rich_help_panel=ROLES)
def controller(
    cluster: Annotated[str, typer.Argument(help="Name of the cluster.")] = "main",
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    wait: Wait = None,
    launched: Launched = None,
) -> None:
    """Run the cluster-space controller of one cluster."""
    from zsim_deploy import roles

    roles.agent(roles.controller(cluster), connect, federation, wait, launched)


@app.command(rich_help_panel=ROLES)
def record(
    out: Annotated[Path, typer.Option(help="Folder for run.mcap.")] = Path("."),
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    wait: Wait = None,
    launched: Launched = None,
) -> None:
    """Record every message of a federation into run.mcap."""
    from zsim_deploy import roles

    roles.recorder(out / "run.mcap", connect, federation, wait, launched)


@app.command(rich_help_panel=LOOK)
def keys(connect: Connect = DEFAULT_ENDPOINT, federation: Federation = "zsim", wait: Wait = 5.0) -> None:
    """List the keys that speak, with their message and how many came in a second."""
    from zsim_deploy import look

    with _link(connect, federation, wait) as link:
        for key, kind, count in look.list_keys(link):
            print(f"{key:<36} {kind:<14} {count:>6}")


@app.command(rich_help_panel=LOOK)
def echo(
    key: Annotated[str, typer.Argument(help="Key or expression, e.g. drone/drone1/sensor/imu or 'drone/*/truth'.")],
    count: Annotated[int | None, typer.Option("--count", "-n", help="Stop after so many messages.")] = None,
    raw: Annotated[bool, typer.Option("--raw", help="Payload as hexadecimal digits.")] = False,
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    wait: Wait = 5.0,
) -> None:
    """Print the messages on a key as JSON lines."""
    from zsim_deploy import look

    def emit(name: str, message: Any) -> None:
        print(json.dumps({"key": name, "message": message}), flush=True)

    with _link(connect, federation, wait) as link:
        look.echo(link, key, count, emit, raw)


@app.command(rich_help_panel=LOOK)
def hz(
    key: Annotated[str, typer.Argument(help="Key or expression.")],
    window: Annotated[int, typer.Option(help="Messages that the rate is taken over.", min=2)] = 1000,
    seconds: Annotated[float | None, typer.Option(help="Stop after so many seconds.")] = None,
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    wait: Wait = 5.0,
) -> None:
    """Print how often messages come on a key, in wall and in simulated time."""
    from zsim_deploy import look

    until_s = time.monotonic() + seconds if seconds else math.inf
    with _link(connect, federation, wait) as link:
        look.hz(link, key, window, until_s, lambda line: print(line, flush=True))


@app.command(rich_help_panel=LOOK)
def pub(
    key: Annotated[str, typer.Argument(help="Key, e.g. drone/drone1/cmd/velocity.")],
    message: Annotated[str, typer.Argument(help='JSON, e.g. \'{"velocity_m_s": [1, 0, 0], "yaw_rate_rad_s": 0}\'.')],
    count: Annotated[int, typer.Option("--count", "-n", min=1, help="How many times.")] = 1,
    rate_hz: Annotated[float, typer.Option(min=0.01, max=1000, help="How often per wall second.")] = 10.0,
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    wait: Wait = 5.0,
) -> None:
    """Publish a message on a key; t_ns, seq and source are filled in."""
    from zsim_deploy import look

    with _link(connect, federation, wait) as link:
        sent = look.publish(link, key, message, count, rate_hz)
    print(f"published {sent} on {key}")


@app.command(rich_help_panel=LOOK)
def ask(
    key: Annotated[str, typer.Argument(help="world/control or cluster/NAME/control.")],
    op: Annotated[str, typer.Argument(help="E.g. pause, resume, step, stop; engage, hold, land, target.")],
    args: Annotated[str, typer.Argument(help="JSON map, e.g. '{\"gates\": 50}'.")] = "{}",
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    wait: Wait = 5.0,
) -> None:
    """Send a request to the world or a controller and print the answer."""
    from zsim.errors import RunError

    try:
        values = json.loads(args)
    except ValueError as error:
        raise RunError(f"{op}: args is no JSON ({error}); must be a map") from error
    if not isinstance(values, dict):
        raise RunError(f"{op}: args is {args[:40]!r}; must be a map such as '{{\"gates\": 50}}'")
    with _link(connect, federation, wait) as link:
        answer = link.request(key, op, "zsim.ask", **values)
    if not answer.ok:
        raise RunError(answer.error)
    print("ok" if answer.result is None else json.dumps(answer.result, default=repr))


def _load(path: Path, overrides: list[str] | None, seed: int | None = None, duration: float | None = None) -> Any:
    from zsim import scenario_file

    return scenario_file.load(path, overrides or (), seed=seed, duration_s=duration)


def _mode(realtime: bool, rate: float | None) -> tuple[str, float]:
    if rate is not None and not 0 < rate <= 1000:
        raise typer.BadParameter(f"--rate is {rate:g}; must be > 0 and <= 1000")
    return ("realtime", rate or 1.0) if realtime else ("lockstep", rate or 0.0)


def _link(endpoint: str, federation: str, wait_s: float | None) -> Any:
    """Return a context manager with a session to the federation's hub."""
    from contextlib import contextmanager
    from functools import partial

    from zsim.connection import find_world

    @contextmanager
    def opened() -> Any:
        say = partial(print, file=sys.stderr)
        with find_world(endpoint, federation, wait_s, say, reader=True) as (link, _):
            yield link

    return opened()


def _version(asked: bool) -> None:
    if asked:
        print(f"zsim {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")] = False,
) -> None:
    """Co-simulate drone formations: one world, estimators and controllers as processes on Zenoh, in lockstep."""


def main() -> None:
    """Run the command line; a user's fault is a line, not a traceback."""
    try:
        app()
    except ZsimError as error:
        print(error, file=sys.stderr)
        sys.exit(3 if isinstance(error, SupersededError) else 2)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
