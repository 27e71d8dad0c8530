"""The commands for flights on this machine and their records.

run       flies once                                  validate  checks a scenario
sweep     flies with different seeds and values       hunt      searches for a flight that breaks a requirement
board     compares formation laws
report, export, replay, bundle, rerun                 work on the record of a flight
"""

import shlex
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, BadParameter, Option

from zsim.contract.run_messages import RATE_MAX
from zsim.errors import ZsimError, printable
from zsim_analysis.export import Format
from zsim_deploy import INTERRUPTED
from zsim_deploy import arguments as opt
from zsim_deploy.arguments import failed, note, require, say, working
from zsim_deploy.roles.stop_channel import interruptible

if TYPE_CHECKING:
    from zsim.transport.tls import Identity
    from zsim_analysis.reading.shortfall import Shortfall

SWEEP_NEEDS = {"sweep": ("pyarrow", "numba", "scipy", "mcap", "matplotlib", "jinja2")}
DASK_NEEDS = {**SWEEP_NEEDS, "dask": ("distributed",)}
BUNDLE_NEEDS = {**opt.FLIGHT_NEEDS, "report": ("matplotlib", "jinja2", "packaging")}
REPLAY_NEEDS = {"record": ("mcap", "zstandard")}
WRITERS = {Format.CSV: "pyarrow", Format.PARQUET: "pyarrow", Format.MAT: "scipy", Format.FOXGLOVE: "foxglove"}
BUDGET_S = 600.0  # budget of a hunt if neither --budget nor --flights is given, wall time
FAULTS_PER_FLIGHT = 3  # maximum number of faults in one flight of a hunt; software failures seldom need more conditions
GATE = "a gate: a time step at which the processes synchronize"
PROCESS_OPTIONS = ("--realtime", "--rate", "--listen", "--hosted", "--console", "--cameras", "--detect")
NEW_RUN_OPTIONS = (
    *("--seed", "--duration", "--realtime", "--rate", "--set", "--out"),
    *("--in-process", "--listen", "--insecure", "--hosted", "--agent"),
)

app = typer.Typer()


@app.command(rich_help_panel=opt.RUN)
@opt.flight_options
def run(
    context: typer.Context,
    flight: opt.FlightOptions,
    out: Annotated[Path | None, Option(help="Folder of the run (default runs/NAME-TIME).", show_default=False)] = None,
    in_process: Annotated[bool, Option("--in-process", help="Everything in this process, no Zenoh.")] = False,
    listen: Annotated[
        str | None, Option(help=f"Endpoint of the world (default {opt.DEFAULT_ENDPOINT}, or a free port).")
    ] = None,
    insecure: opt.Insecure = False,
    hosted: Annotated[
        bool, Option("--hosted", help="Estimators and controllers in one process: faster, identical to the bit.")
    ] = False,
    console: Annotated[bool, Option("--console", help="Show the run in the browser, and control it there.")] = False,
    cameras: Annotated[
        bool, Option("--cameras", help="Render the cameras; front and bottom if no drone has any.")
    ] = False,
    detect: Annotated[bool, Option("--detect", help="Detect hats in the camera images.")] = False,
    agent: Annotated[
        list[str] | None,
        Option(help="An agent of your own, 'MODULE:CLASS [NAME=VALUE]...', or 'PROCESS=MODULE:CLASS …'. Repeatable."),
    ] = None,
    report: opt.Report = True,
    continue_: Annotated[
        bool, Option("--continue", help="Continue an interrupted run; SCENARIO is its folder.")
    ] = False,
    force: opt.Force = False,
    order: Annotated[str, Option(hidden=True)] = "",
    json_progress: Annotated[bool, Option("--json-progress", hidden=True)] = False,
) -> None:
    """Fly a scenario: start every process, show progress, record, and report."""
    require("run", opt.FLIGHT_NEEDS | (opt.REPORT_NEEDS if report else {}))
    from zsim.schema import plugin
    from zsim_agents.hosting import AgentSpec, check_plans, with_own_agents
    from zsim_api.run_folder import locked, new_launch, run_directory
    from zsim_deploy.hosts.control_socket import seen_by_ps
    from zsim_deploy.launch.role_launcher import RunConsole
    from zsim_deploy.launch.run import RunOptions, check_endpoint, check_open_files, fly, options_of, with_cameras

    if in_process and (useless := _given(context, PROCESS_OPTIONS)):
        raise BadParameter(f"--in-process is lockstep, unpaced and without Zenoh; leave out {useless}, or --in-process")
    if console:
        require("console", opt.CONSOLE_NEEDS)
    run_console = RunConsole() if console else None
    if continue_:
        if useless := _given(context, NEW_RUN_OPTIONS):
            raise BadParameter(f"--continue uses the options of the interrupted run; leave out {useless}")
        options = options_of(flight.path)
    else:
        check_endpoint(listen, insecure)
        mode, pace = flight.mode_and_rate()
        scenario = with_cameras(flight.scenario()) if cameras else flight.scenario()
        if in_process:
            check_plans(scenario, flight.path.name)  # otherwise the controllers check them
        if agent:
            plugin.search(*plugin.folders(), Path.cwd())
        agents = [AgentSpec.parse(shlex.split(each) or [""]) for each in agent or ()]
        if agents:
            scenario = with_own_agents(scenario, [each.name for each in agents])
        agent_arguments = tuple(tuple(each.arguments()) for each in agents)
        launch_options = {
            "in_process": in_process,
            "agents": agent_arguments,
            "hosted": hosted,
            "insecure": insecure,
            "listen": listen,
        }
        launch = new_launch(mode=mode, rate=pace, changed=tuple(flight.changed()), **launch_options)
        options = RunOptions(scenario, Path(), launch, [name for name in order.split(",") if name])
    options.console, options.cameras, options.detect = run_console, cameras, detect
    options.json_progress = json_progress
    if not options.launch.in_process:
        if options.camera_children():
            require("run", opt.CAMERA_NEEDS)
        check_open_files(options)
    folder_context = locked(options.out) if continue_ else run_directory(out, options.scenario, force)
    with folder_context as options.out, run_console or nullcontext(), interruptible():
        with seen_by_ps(options.scenario.federation, options.status):
            outcome = fly(options)
        if run_console:
            run_console.outcome = outcome
        conclude(outcome, options.out, report)


def _given(context: typer.Context, options: Sequence[str]) -> str:
    """Return those of `options` that the command line gives, joined by "and"; empty if it gives none."""
    sources = {each.opts[0]: context.get_parameter_source(each.name or "") for each in context.command.params}
    return " and ".join(option for option in options if (source := sources[option]) and source.name == "COMMANDLINE")


def conclude(outcome: Any, out: Path, report: bool) -> None:
    """Print how a run ended, make its report if `report`, and exit with the matching code."""
    record, fault = out / "run.mcap", "nothing was recorded"
    if outcome.interrupted:
        note(f"ended: {outcome.reason}")
        if record.exists():
            note(f"the record so far is {record}; `zsim report {out}` makes its report")
        sys.exit(INTERRUPTED)
    if record.exists():
        try:
            if report:
                fault = _report(out)
            else:
                from zsim_analysis.reading.shortfall import marks_of, verdict

                assessment = verdict(record)
                for mark, _ in marks_of(assessment.shortfalls):
                    say(mark)
                fault = _fault_of(assessment.completeness.complete, str(assessment.completeness), assessment.shortfalls)
        except ZsimError as error:
            if not outcome.failed:
                raise
            note(str(error))
        except KeyboardInterrupt:
            note(f"interrupted; the record is kept; `zsim report {out}` makes its report")
            sys.exit(INTERRUPTED)
        say(f"ended: {outcome.reason}; the record is {record}")
    if fault := outcome.reason if outcome.failed else fault:
        if (out / "logs").exists():
            note(f"logs are in {out / 'logs'}")
        raise failed(f"ended: {fault}")


def _fault_of(complete: bool, state: str, shortfalls: "Sequence[Shortfall]") -> str:
    """Print whether the record is complete; return its fault, else the first fault of the flight, else ""."""
    say(f"record: {state}{f' ({GATE})' if 'gates' in state else ''}")
    lacking = "" if complete else f"the record is {state}"
    return lacking or next((each.text for each in shortfalls if each.fails), "")


def note_skipped(names: Sequence[str]) -> None:
    """Print the modules that a document names and that were found but not imported."""
    for name in names:
        note(f"note: {name} was found but not imported; --trust imports it and checks its parameters")


@app.command(rich_help_panel=opt.RUN)
def validate(scenario: opt.ScenarioPath, set_: opt.Set = None, trust: opt.Trust = False) -> None:
    """Check a scenario; print it resolved, or one line per fault. The code that it names is run only with --trust."""
    from zsim.scenario import scenario_file
    from zsim.scenario.consistency import unflown_plans
    from zsim.schema import plugin
    from zsim_agents.hosting import check_plans

    with plugin.names_only(not trust) as skipped:
        loaded = opt.load_scenario(scenario, set_)
        check_plans(loaded, scenario.name)
    if modules := [name for name in skipped if ":" not in name]:  # these define parameters of vehicles and sensors
        note(f"{scenario.name}: the resolved scenario is not printed because it depends on {', '.join(modules)}")
    else:
        print(printable(scenario_file.to_text(loaded)), end="", flush=True)
    for line in unflown_plans(loaded):
        note(f"{scenario.name}: {line}")
    note_skipped(skipped)
    note(f"{scenario.name}: no errors found")


@app.command(rich_help_panel=opt.RUN)
def report(
    directories: Annotated[
        list[Path], Argument(metavar="DIR...", help="Folder of a run or a sweep; several runs are compared.")
    ],
    out: Annotated[
        Path | None, Option(help="Page of the comparison (default compare-NAMES.html beside the first run).")
    ] = None,
    formats: opt.Formats = None,
    trust: opt.Trust = False,
) -> None:
    """Make summary.json, figures and report.html of a run or a sweep, or compare several runs."""
    require("report", opt.REPORT_NEEDS)
    from zsim.output_folder import record_in
    from zsim.schema import plugin
    from zsim_analysis.sweep.design import is_sweep

    extra_formats = opt.figure_formats(formats)
    with plugin.names_only(not trust) as skipped:
        if len(directories) > 1:
            from zsim_analysis.report.comparison import compare, comparison_path

            for directory in directories:
                if is_sweep(directory):
                    raise BadParameter(f"{directory} is a sweep; only runs can be compared")
                record_in(directory)
            page = out or comparison_path(directories)
            with working("reading the records …") as progress:
                compare(directories, page, progress, extra_formats)
            say(f"report: {page}")
        elif out is not None:
            raise BadParameter("--out is for the comparison of several runs; leave it out")
        else:
            if not is_sweep(directories[0]):
                record_in(directories[0])
            _report(directories[0], extra_formats)
    note_skipped(skipped)


def _report(folder: Path, formats: Sequence[str] = ()) -> str:
    """Make the report of a run or a sweep, and print its table; return the fault of a run as `_fault_of` does."""
    from zsim.runtime.progress import PipedConsole
    from zsim_analysis.sweep.design import is_sweep

    summary = None
    with working("reading …") as progress:
        if is_sweep(folder):
            from zsim_analysis.sweep.sweep_report import TerminalText, make_sweep_report

            terminal_summary: Any = TerminalText(make_sweep_report(folder, progress, formats))
        else:
            from zsim_analysis.report.make_report import make_report
            from zsim_analysis.report.summary import terminal_text

            summary = make_report(folder, progress, formats)
            terminal_summary = terminal_text(summary)
    PipedConsole().print(terminal_summary)
    fault = _fault_of(summary.record.complete, summary.record.state, summary.shortfalls) if summary else ""
    say(f"report: {folder / 'report.html'}")
    return fault


@app.command(rich_help_panel=opt.RUN)
def sweep(
    scenario: opt.ScenarioPath,
    runs: Annotated[
        int | None, Option(min=1, help="Number of runs (default: one per combination).", show_default=False)
    ] = None,
    vary: Annotated[
        list[str] | None,
        Option(
            help="seed, seed=paired, a.b.c=v1,v2,… or a.b.c=uniform(low,high) or a.b.c=normal(mean,std). Repeatable."
        ),
    ] = None,
    set_: opt.Set = None,
    seed: opt.Seed = None,
    duration: opt.Duration = None,
    out: Annotated[
        Path | None, Option(help="Folder (default runs/NAME-sweep-TIME); an unfinished one is continued.")
    ] = None,
    workers: opt.Workers = None,
    dask: Annotated[str | None, Option(help="Address of a Dask scheduler; its cluster flies the runs.")] = None,
    keep_records: Annotated[bool, Option("--keep-records", help="Keep the record of every run.")] = False,
    report: opt.Report = True,
    force: Annotated[bool, Option("--force", help="Accept a folder with other files.")] = False,
) -> None:
    """Fly a scenario many times with different seeds and field values; make one table and one report."""
    if dask is not None and (keep_records or workers is not None):
        useless = "--keep-records" if keep_records else "--workers"
        raise BadParameter(f"{useless} is for processes on this host; leave it out, or --dask")
    require("sweep", SWEEP_NEEDS if dask is None else DASK_NEEDS)
    from rich.console import Console

    from zsim_analysis.sweep.design import read_document
    from zsim_api.sweeping import checked_plan, fly_plan

    document, faults = read_document(scenario, set_ or [], seed=seed, duration_s=duration)
    changed = opt.changed_fields(set_, seed, duration)
    screen = Console(stderr=True)
    plan = checked_plan(scenario.name, document, vary or [], runs, keep_records, changed, screen, faults)
    folder = out or Path("runs") / f"{plan.document['name']}-sweep-{time.strftime('%Y%m%d-%H%M%S')}"
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        rows = fly_plan(plan, folder, workers, dask, force)
    except KeyboardInterrupt:
        note(
            f"interrupted; the same command with --out {folder} continues the sweep; the table so far is in that folder"
        )
        sys.exit(INTERRUPTED)
    failures = [row["failure"] for row in rows if row["failure"]]
    shortfall_texts = [row["shortfall"] for row in rows if row.get("shortfall") and not row["failure"]]
    _conclude(folder, failures, len(rows), report, shortfall_texts)


def _conclude(folder: Path, failures: list[str], runs: int, report: bool, shortfall_texts: Sequence[str] = ()) -> None:
    """Make the report; exit with code 1 if a run failed, or no run was flown as planned."""
    if report:
        _report(folder)
    say(f"table: {folder / 'sweep.parquet'}")
    if len(failures) == runs:
        raise failed(f"all {runs} runs failed: {failures[0]}")
    if failures:
        raise failed(f"{len(failures)} of {runs} runs failed: {failures[0]}")
    if len(failures) + len(shortfall_texts) == runs:
        raise failed(f"none of the {runs} runs was flown as planned: {shortfall_texts[0]}")


@app.command(rich_help_panel=opt.RUN)
def export(
    run: opt.Recorded,
    form: Annotated[
        Format, Option("--format", help="Tables (csv, parquet), a MATLAB file, or an MCAP file for Foxglove.")
    ],
    keys: opt.Keys = None,
    from_: opt.From = None,
    to: opt.To = None,
    out: Annotated[
        Path | None,
        Option(help="Output (default DIR/csv, DIR/parquet, DIR/run.mat, DIR/foxglove.mcap).", show_default=False),
    ] = None,
    force: Annotated[bool, Option("--force", help="Replace an earlier export.")] = False,
    by_name: Annotated[
        bool, Option("--by-name", help="One table per drone, cluster and process, each in order of time.")
    ] = False,
    trust: opt.Trust = False,
) -> None:
    """Write the record of a run as tables, for MATLAB, or for Foxglove and Rerun."""
    if by_name and form not in (Format.CSV, Format.PARQUET):
        raise BadParameter("--by-name is for tables; leave it out, or give --format csv or parquet")
    require("export", {"export": ("mcap", "zstandard", WRITERS[form])})
    from rich.console import Console
    from rich.progress import Progress

    from zsim.output_folder import record_at
    from zsim.schema import plugin

    opt.check_range(from_, to)
    record_at(run)
    from zsim_analysis.export.columns import MessageSelection
    from zsim_analysis.export.make_export import export as write

    selection = MessageSelection(tuple(keys or ()), from_, to)
    console = Console(stderr=True)

    progress_bar = Progress(console=console, transient=True, disable=not console.is_terminal)
    with interruptible(), plugin.names_only(not trust) as skipped, progress_bar as bar:
        task = bar.add_task("scanning the record", total=None)

        def advance(count: int, total: int) -> None:
            bar.update(task, description="reading messages", completed=count, total=total)

        done = write(run, form, out, selection, force, advance, by_name)
    for text in done.notes:
        note(f"note: {text}")
    for name, rows in done.tables.items():
        say(f"{name:<40} {rows:>10}")
    say("written: " + " ".join(map(str, done.paths)))
    note_skipped(skipped)


@app.command(rich_help_panel=opt.RUN)
@opt.listener_options
def replay(
    who: "Identity",
    directory: opt.Recorded,
    rate: Annotated[
        float,
        Option(callback=opt.between(0, RATE_MAX), help="Simulated seconds per wall second; 0 for as fast as possible."),
    ] = 1.0,
    from_: opt.From = 0.0,
    to: opt.To = None,
    keys: opt.Keys = None,
    expect: Annotated[
        list[str] | None,
        Option(help="Wait for this process to join, e.g. estimator.drone1, console.1. Repeatable."),
    ] = None,
    paused: Annotated[bool, Option("--paused", help="Start paused, until resumed on request.")] = False,
    console: Annotated[
        bool, Option("--console", help="Show the replay in the browser, with a timeline; pause at the end.")
    ] = False,
    listen: opt.Listen = None,
    federation: Annotated[str | None, Option(help="Name of the federation (default: the record's).")] = None,
    trust: opt.Trust = False,
) -> None:
    """Play a record back onto its keys, for a console, an estimator under test or any client; commands are refused."""
    require("replay", REPLAY_NEEDS)
    if console:
        require("console", opt.CONSOLE_NEEDS)
    from zsim.schema import plugin
    from zsim_deploy.launch.role_launcher import running_console
    from zsim_deploy.roles.world_role import ReplayOptions, play
    from zsim_world.run.playback import PlaybackRange

    opt.check_range(from_, to)
    to_ns = None if to is None else round(to * 1e9)
    choice = PlaybackRange(round((from_ or 0.0) * 1e9), to_ns, tuple(keys or ["**"]), paused, holds=console)
    endpoints = tuple(listen or [opt.DEFAULT_ENDPOINT])
    options = ReplayOptions(choice, rate, tuple(expect or ()), endpoints, federation)
    console_context = running_console(endpoints[0], directory, federation, who.tls) if console else nullcontext()
    with plugin.names_only(not trust), console_context:
        play(directory, options, who)


@app.command(rich_help_panel=opt.RUN)
def bundle(
    run: opt.Recorded,
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="File to write (default NAME.zsim, by the scenario's name).", show_default=False),
    ] = None,
    no_record: Annotated[
        bool, Option("--no-record", help="Omit the record: much smaller, but differences are located only to the gate.")
    ] = False,
    force: Annotated[bool, Option("--force", help="Replace the file.")] = False,
    trust: opt.Trust = False,
) -> None:
    """Pack a flight into one file, with everything needed to fly it again on another machine."""
    require("bundle", BUNDLE_NEEDS)
    from zsim.schema import plugin
    from zsim_analysis.bundle.bundle_file import SUFFIX
    from zsim_analysis.bundle.make_bundle import make_bundle

    if out is not None and out.suffix != SUFFIX:
        raise BadParameter(f"--out is {out}; must end in {SUFFIX}")
    with plugin.names_only(not trust) as skipped, working("reading the record …"):
        written = make_bundle(run, out, not no_record, force, note)
    for name in skipped:
        note(f"note: {name} was found but not imported; --trust imports it, so that the bundle's figures show errors")
    say(f"{written.path}: {written.size_bytes / 1e6:.1f} MB, SHA-256 {written.sha256}")


@app.command(rich_help_panel=opt.RUN)
def rerun(
    place: Annotated[
        Path, Argument(metavar="DIR|BUNDLE", help="Folder of a run, its run.mcap, or a bundle.", show_default=False)
    ],
    commands_only: Annotated[
        bool, Option("--commands-only", help="Run no agents; feed all recorded commands to the world.")
    ] = False,
    trust: opt.Trust = False,
    install: Annotated[
        bool, Option("--install", help="For a bundle: fly in a new environment with the bundle's package versions.")
    ] = False,
    python: Annotated[
        Path | None, Option("--python", help="Python for that environment (default: this one).", show_default=False)
    ] = None,
) -> None:
    """Fly a recorded or bundled run again, and print whether it is identical (exit code 0) or not (1)."""
    require("rerun", opt.FLIGHT_NEEDS)
    from zsim.schema import plugin
    from zsim_analysis.bundle.bundle_file import is_bundle

    from_bundle = is_bundle(place)
    if not from_bundle and (
        useless := " and ".join(option for option, given in (("--install", install), ("--python", python)) if given)
    ):
        raise BadParameter(f"only a bundle flies in a new environment, and {place} is not one; leave out {useless}")
    if python and not install:
        raise BadParameter("--python is for the environment that --install makes; leave it out, or give --install")
    with plugin.names_only(not trust):
        if install:
            from zsim_deploy.environment import rerun_in_environment

            raise typer.Exit(rerun_in_environment(place, python, commands_only, trust, note))
        if from_bundle:
            require("rerun", BUNDLE_NEEDS)
            from zsim_analysis.bundle.bundle_rerun import rerun_bundle

            fault = rerun_bundle(place, commands_only, say, note)
        else:
            from zsim_analysis.rerun import rerun_record

            fault = rerun_record(place, commands_only, say, note)
    if fault:
        raise failed(fault)


@app.command(rich_help_panel=opt.RUN)
def hunt(
    scenario: opt.ScenarioPath,
    require_: Annotated[
        list[str] | None,
        Option("--require", help="Requirement: 'min_separation_m > 1.5', or module:function. Repeatable."),
    ] = None,
    budget: Annotated[str | None, Option(help="Wall time of the search, e.g. 90s (default 10min).")] = None,
    flights: Annotated[int | None, Option(min=1, max=10**9, help="Number of flights.", show_default=False)] = None,
    fault: Annotated[
        list[str] | None,
        Option(help="Kind of fault to draw, and its ranges: 'gust velocity_m_s=1..6' (default: all). Repeatable."),
    ] = None,
    without: Annotated[list[str] | None, Option(help="Kind of fault not to draw. Repeatable.")] = None,
    most: Annotated[int, Option(min=0, max=6, help="Maximum number of faults in one flight.")] = FAULTS_PER_FLIGHT,
    vary: Annotated[
        list[str] | None,
        Option(help="a.b.c=uniform(low,high), … as for a sweep (default wind.gust_m_s=uniform(0,2)). Repeatable."),
    ] = None,
    draws: Annotated[int, Option("--draws", min=0, max=2**62, help="Seed for drawing flights.")] = 1,
    set_: opt.Set = None,
    seed: opt.Seed = None,
    duration: opt.Duration = None,
    out: Annotated[Path | None, Option(help="Folder (default runs/NAME-hunt-TIME).", show_default=False)] = None,
    workers: opt.Workers = None,
    force: Annotated[
        bool, Option("--force", help="Replace an earlier hunt; accept a folder with other files.")
    ] = False,
) -> None:
    """Search for faults, wind and delays that break a requirement, and shrink them; exit code 1 if any are found."""
    require("hunt", SWEEP_NEEDS)
    from zsim.errors import ScenarioError
    from zsim.runtime.progress import PipedConsole
    from zsim.scenario.faults import typed_duration_s
    from zsim_analysis.hunt.hunt import HuntRequest, hunt
    from zsim_analysis.hunt.hunt_report import make_hunt_report, terminal_text
    from zsim_analysis.hunt.space import WIND
    from zsim_analysis.sweep.design import read_document
    from zsim_api.flight import fly_as_processes
    from zsim_api.recorded import load

    try:
        budget_s = None if budget is None else typed_duration_s(budget)
    except ValueError as error:
        raise BadParameter(f"--budget {error}") from None
    document, faults = read_document(scenario, set_ or [], seed=seed, duration_s=duration)
    if faults:
        raise ScenarioError(faults)
    name = str(document.get("name", scenario.stem))
    request = HuntRequest(
        document=document,
        source=str(scenario),
        requirements=tuple(require_ or ()),
        out=out or Path("runs") / f"{name}-hunt-{time.strftime('%Y%m%d-%H%M%S')}",
        seed=draws,
        flights=flights,
        budget_s=BUDGET_S if budget_s is None and flights is None else budget_s,
        faults=tuple(fault or ()),
        without=tuple(without or ()),
        vary=tuple(vary or (WIND,)),
        changed=tuple(opt.changed_fields(set_, seed, duration)),
        most=most,
        workers=workers,
        force=force,
        open_run=partial(load, trust=True),
        processes=fly_as_processes,
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    hunted = hunt(request)
    summary = hunted.summary
    with working("drawing …") as progress:
        notes = make_hunt_report(hunted, progress)
    for text in notes:
        note(f"note: {text}")
    PipedConsole().print(terminal_text(hunted))
    say(f"report: {request.out / 'report.html'}")
    if summary.interrupted:
        note(f"interrupted; what was found so far is in {request.out}")
        sys.exit(INTERRUPTED)
    if summary.violation:
        raise failed(f"{summary.violation.requirement}: broken; the flight is in {request.out / 'violation'}")


@app.command(rich_help_panel=opt.RUN)
def board(
    laws: Annotated[
        str | None,
        Option(
            help="Names separated by commas, or package.module:Class of your own (default all).", show_default=False
        ),
    ] = None,
    scenarios: Annotated[
        str | None, Option(help="Names separated by commas (default all).", show_default=False)
    ] = None,
    seeds: Annotated[int, Option(min=1, max=1000, help="Number of flights of each law in each scenario.")] = 3,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder (default runs/board-TIME); an unfinished one is continued.")
    ] = None,
    workers: opt.Workers = None,
    formats: opt.Formats = None,
    force: Annotated[bool, Option("--force", help="Accept a folder with other files.")] = False,
    papers: Annotated[
        bool, Option("--papers", help="Fly nothing; reproduce figures of the laws' papers and compare the numbers.")
    ] = False,
) -> None:
    """Fly formation laws in the same scenarios with the same seeds and sensors; make a table and figures."""
    require("sweep", SWEEP_NEEDS)
    from zsim.runtime.progress import PipedConsole

    if papers:
        given = {"--laws": laws, "--scenarios": scenarios, "--format": formats}
        if useless := " and ".join(name for name, value in given.items() if value):
            raise BadParameter(f"--papers flies no scenario; leave out {useless}")
        from zsim_analysis.board.papers import terminal_table, write_papers

        papers_folder = out or Path("runs") / "papers"
        with working("computing …") as progress:
            results = write_papers(papers_folder, progress)
        PipedConsole().print(terminal_table(results))
        say(f"figures: {papers_folder}")
        return
    from zsim_analysis.board.board import LAW_NAMES, BoardRequest, fly_board, scenario_names, select_names
    from zsim_analysis.board.board_report import make_board_report, terminal_text

    extra_formats = opt.figure_formats(formats)
    folder = out or Path("runs") / f"board-{time.strftime('%Y%m%d-%H%M%S')}"
    request = BoardRequest(
        select_names(laws, LAW_NAMES, "--laws", open_to_classes=True),
        select_names(scenarios, scenario_names(), "--scenarios"),
        seeds,
        folder,
        workers,
        force,
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        rows = fly_board(request)
    except KeyboardInterrupt:
        note(f"interrupted; the same command with --out {folder} continues")
        sys.exit(INTERRUPTED)
    with working("drawing …") as progress:
        finished_board = make_board_report(request, rows, progress, extra_formats)
    PipedConsole().print(terminal_text(finished_board))
    say(f"report: {folder / 'report.html'}")
    say(f"table: {folder / 'board.csv'}")
    failures = [row["failure"] for row in rows if row["failure"]]
    if failures:
        raise failed(f"{len(failures)} of {len(rows)} flights failed: {failures[0]}")
