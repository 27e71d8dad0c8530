"""`zsim.run`: a complete flight, in this process or as separate processes, recorded and returned as a `Run`."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console

from zsim.errors import RunError, RunFailedError, UserCodeError, printable
from zsim.output_folder import RECORD
from zsim.runtime.progress import JsonProgress, NotebookLine, ProgressSink, Screen, describe
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario as Resolved
from zsim.schema import plugin
from zsim_analysis.in_process import OwnAgent, fly, with_agents
from zsim_analysis.reading.recorded_flight import read_flight
from zsim_analysis.reading.shortfall import verdict
from zsim_api import run_folder
from zsim_api.programs import PIPE, Program, search_path
from zsim_api.scenarios import AnyScenario, Scenario, scenario_of

if TYPE_CHECKING:
    from zsim_api.recorded import Run

Result = TypeVar("Result")
COMMAND = (sys.executable, "-P", "-m", "zsim_deploy")
LAUNCHER = "zsim-run"  # name of the log for launcher output that is not shown
INTERRUPTED = 130  # exit code of `zsim run` after Ctrl-C


def run(
    scenario: AnyScenario,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    set: Mapping[str, Any] | None = None,
    agents: Sequence[OwnAgent] = (),
    law: type | None = None,
    estimator: type | None = None,
    processes: bool = False,
    options: Sequence[str] = (),
    out: str | Path | None = None,
    force: bool = False,
    progress: bool = True,
) -> "Run":
    """Fly a scenario to its end, record it, and return the run, as `zsim.load` does.

    Classes and functions may be defined anywhere, including a notebook cell or a script.

    Args:
        scenario: path of a YAML file, `zsim.Scenario`, or a mapping as in YAML.
        seed, duration_s: replace those of the scenario.
        set: replaces fields of the scenario by path, as in `{"environment.wind.gust_m_s": 1.0}`.
        agents: your own agents, besides the estimators and controllers of the scenario: subclasses of `zsim.Agent`, or
            instances of them, which keep their state after the run unless they fly as processes. The run waits for
            them, and ends if one fails.
        law, estimator: classes that replace those of all clusters and drones; see docs/extending.md.
        processes: fly the scenario as real processes on this machine, as `zsim run` does; bit-identical, but slower.
        options: options of `zsim run`, only with `processes`: `["--hosted"]`, `["--realtime", "--console"]`.
        out: folder of the run; None: `runs/NAME-TIME`.
        force: replace an earlier run in that folder.
        progress: show a progress bar and the events.

    Raises:
        ScenarioError: with one line for every fault in the scenario; nothing was flown.
        RunFailedError: a failure ended the run; its record holds everything up to that point.
        KeyboardInterrupt: the run was interrupted; its record holds everything up to that point. A second Ctrl-C ends
            it at once.
        Exception: raised by one of your classes, with its own traceback, after a line on stderr that says where.
    """
    source = scenario_of(scenario).changed(seed=seed, duration_s=duration_s, set=set, law=law, estimator=estimator)
    if options and not processes:
        raise RunError(f"options is {list(options)}; must be empty without processes=True")
    resolved, own_agents = calling(lambda: with_agents(source.resolved, agents))
    out_folder = Path(out) if out is not None else None
    screen = screen_for(resolved.duration_s) if progress else None
    if processes:
        folder = run_folder.make_directory(out_folder, resolved, force)
        source.keep_modules(folder)
        _fly_as_processes(source, agents, [agent.name for agent in own_agents], options, folder, screen)
    else:
        launch = run_folder.new_launch(in_process=True, changed=source.changes or ())
        with run_folder.run_directory(out_folder, resolved, force) as folder:
            source.keep_modules(folder)
            with screen or nullcontext(), _ctrl_c() as stop_reason:
                calling(lambda: fly_here(resolved, folder, launch, own_agents, screen, stop_reason), folder)
        if reason := stop_reason():
            raise KeyboardInterrupt(f"{reason}; zsim.load({str(folder)!r}) reads the record so far")
    from zsim_api.recorded import load

    return load(folder, trust=True)


def fly_here(
    scenario: Resolved,
    folder: Path,
    launch: run_folder.Launch,
    own: Sequence[OwnAgent],
    screen: ProgressSink | None,
    stop_reason: Callable[[], str | None],
    continued: bool = False,
) -> str:
    """Fly a resolved scenario in this process into a run's folder; return why it ended; errors as in `fly`."""
    with nullcontext() if continued else run_folder.left_only_if_flown(folder):
        run_folder.prepare(folder, scenario, launch, screen.say if screen else lambda _: None, continued)
        ended = fly(scenario, folder / RECORD, stop_reason, screen, None, launch.changed, own)
    if not stop_reason():
        run_folder.forget_launch(folder)
    return ended


# As processes


def _fly_as_processes(
    source: Scenario,
    agents: Sequence[OwnAgent],
    names: Sequence[str],
    options: Sequence[str],
    folder: Path,
    screen: Screen | None,
) -> None:
    """Fly by means of `zsim run`, which shows its own progress on a terminal; in a notebook, show it here."""
    log = folder / run_folder.LOGS / f"{LAUNCHER}.log"
    log.parent.mkdir(exist_ok=True)
    shows_progress = isinstance(screen, NotebookScreen)
    command, environment = command_of(source, agents, names, options, folder)
    command += ["--json-progress"] if shows_progress else []
    program = Program(command, environment, PIPE if shows_progress else None if screen else log)
    try:
        with screen if shows_progress else nullcontext():
            while True:
                try:
                    for line in program.lines() if shows_progress else ():
                        _show(line, screen, log)
                    code = program.wait()
                    break
                except KeyboardInterrupt:
                    program.interrupt()
    finally:
        program.close()
    if code == INTERRUPTED:
        raise KeyboardInterrupt(f"interrupted; zsim.load({str(folder)!r}) reads the record so far")
    if code:
        raise_failure(folder, code)


def _show(line: str, screen: Screen | None, log: Path) -> None:
    """Show a line of progress, or log whatever else `zsim run` prints; the caller reports how the run ended."""
    kind, content = JsonProgress.read(line)
    if kind:
        getattr(screen, kind)(content)
    else:
        with log.open("a", encoding="utf-8") as file:
            file.write(line)


def command_of(
    source: Scenario, agents: Sequence[OwnAgent], names: Sequence[str], options: Sequence[str], folder: Path
) -> tuple[list[str], dict[str, str]]:
    """Return the command line of the `zsim run` that flies a scenario as processes, and its environment.

    The launcher is a separate process, so that it has signals and children of its own.
    """
    command = [*COMMAND, "run", str(_file_of(source, folder)), "--out", str(folder), "--force", "--no-report"]
    command += [argument for change in source.changes or () for argument in ("--set", change)]
    user_folders = [Path(each) for each in sys.path if each and not plugin.is_library(f"{each}{os.sep}")]
    folders = [folder, *source.folders, *(each for each in user_folders if each.is_dir())]
    if agents:
        from zsim_api.own_code import module_folders, name_of

        class_names = [name_of(each, folder) for each in agents]
        folders += module_folders(class_names)
        command += [w for name, each in zip(names, class_names, strict=True) for w in ("--agent", f"{name}={each}")]
    return [*command, *options], {"PYTHONPATH": search_path(folders)}


def _file_of(source: Scenario, folder: Path) -> Path:
    """Return the file of a scenario; one created in Python is written into the run's folder."""
    if source.changes is not None:
        return source.folders[0] / source.source
    file = folder / run_folder.SCENARIO
    source.save(file)
    return file


def raise_failure(folder: Path, code: int) -> None:
    """Raise RunFailedError with the failure that ended a run; return if it flew to its end, even if not as planned."""
    record = folder / RECORD
    if not record.exists():
        raise RunFailedError(f"{folder}: nothing was recorded: {_last_line(folder, code)}")
    failures = [each.text for each in verdict(record).shortfalls if each.kind == "process" and each.fails]
    flight = read_flight(record, motion=False)
    has_flown = any(len(track.t_ns) for track in flight.tracks)
    if not failures and (not has_flown or (folder / run_folder.JOURNAL).exists()):  # an early end leaves the journal
        failures = [str((flight.end or {}).get("reason", _last_line(folder, code)))]
    if failures:
        raise RunFailedError(f"{failures[0]}; the record is {record}, the logs are in {folder / run_folder.LOGS}")


def _last_line(folder: Path, code: int | None) -> str:
    """Return the last line that `zsim run` printed to its log; without one, a text with its exit code."""
    log = folder / run_folder.LOGS / f"{LAUNCHER}.log"
    lines = log.read_text(errors="replace").split("\n") if log.exists() else []
    return next((line for line in reversed(lines) if line.strip()), f"`zsim run` ended with code {code}")


# In this process


def calling(call: Callable[[], Result], folder: Path | None = None) -> Result:
    """Call a function that runs a user's classes; re-raise their exceptions after a line that says where they arose."""
    try:
        return call()
    except UserCodeError as error:
        failure, raised = error, plugin.raised_by_user(error)
    if raised is None:  # the user's code returned something unusable
        raise failure.with_traceback(None) from None
    hint = f"; zsim.load({str(folder)!r}) reads the record so far" if folder and (folder / RECORD).exists() else ""
    print(printable(f"{failure}{hint}"), file=sys.stderr, flush=True)
    raise raised


class _StopRequest:
    """The reason to end a flight; None until Ctrl-C is pressed."""

    reason: str | None = None

    def __call__(self) -> str | None:
        return self.reason


@contextmanager
def _ctrl_c() -> Iterator[_StopRequest]:
    """Let Ctrl-C (in the main thread) end a flight at its next gate, its record complete; a second one acts at once."""
    request = _StopRequest()
    previous = signal.getsignal(signal.SIGINT)
    if previous is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        yield request
        return

    def on_interrupt(*_: object) -> None:
        request.reason = "interrupted"
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield request
    finally:
        signal.signal(signal.SIGINT, previous)


def screen_for(duration_s: float) -> Screen:
    """Return the display of a run's progress: on a terminal, or below a notebook's cell."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return NotebookScreen(duration_s) if type(shell).__name__ == "ZMQInteractiveShell" else Screen(duration_s)


class NotebookScreen(Screen):
    """Shows the live line below a notebook's cell, and events on the cell's standard output."""

    def __init__(self, duration_s: float) -> None:
        # a kernel sets FORCE_COLOR, from which rich infers a terminal
        super().__init__(duration_s, Console(file=sys.stdout, force_jupyter=False, force_terminal=False))
        self._line = NotebookLine()

    def clock(self, line: dict[str, Any]) -> None:
        self._line.update(describe(line, self._duration_s))


def fly_as_processes(scenario: Resolved, folder: Path) -> None:
    """Fly a resolved scenario as processes on this machine, into a new run folder.

    Raises:
        RunError: nothing was recorded; the error includes the last line that `zsim run` printed.
    """
    log = folder / run_folder.LOGS / f"{LAUNCHER}.log"
    log.parent.mkdir(parents=True)
    file = folder / run_folder.SCENARIO
    file.write_text(scenario_file.to_text(scenario), encoding="utf-8")
    command = [*COMMAND, "run", str(file), "--out", str(folder), "--force", "--no-report"]
    program = Program(command, {"PYTHONPATH": search_path(plugin.folders())}, log)
    try:
        code = program.wait()
    finally:
        program.close()
    if not (folder / RECORD).exists():
        raise RunError(f"{folder}: nothing was recorded: {_last_line(folder, code)}")
