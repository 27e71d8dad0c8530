"""A whole run: every process of a scenario started, watched, recorded, ended, and reported."""

import contextlib
import os
import re
import signal
import socket
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from zsim.errors import RecordError, RunError, RunFailedError, SessionError
from zsim.output_folder import no_locks
from zsim.record import repair
from zsim.record.record_reader import RECORD
from zsim.runtime.progress import Screen
from zsim.scenario import scenario_file
from zsim.scenario.consistency import unflown_plans
from zsim.scenario.external_bodies import driver_lines
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim.transport.tls import Identity
from zsim.transport.zenoh_settings import launcher_files, require_files
from zsim_agents.hosting import agents_of
from zsim_deploy.arguments import changed_options, load_scenario, pace_options
from zsim_deploy.inventory.processes import COMMANDS
from zsim_deploy.launch import interrupted_run
from zsim_deploy.launch.camera_children import CameraChild, camera_children
from zsim_deploy.launch.child_process import ChildProcess
from zsim_deploy.launch.console_process import RunConsole
from zsim_deploy.launch.end_signals import EndSignals
from zsim_deploy.launch.free_ports import DEFAULT_PORT, free_port, is_free
from zsim_deploy.launch.interrupted_run import JOURNAL, Launch
from zsim_deploy.launch.role_launcher import RoleLauncher
from zsim_deploy.launch.supervisor import Outcome, Supervisor
from zsim_deploy.roles.stop_channel import REASONS, StopChannel, handled_by

RECORDER = "recorder"
CONSOLE = "console.run"  # the one that a run starts: not to be taken over by the first that is started by hand
PORTS_TRIED = 5  # when other runs that start at this moment take each before our world listens


@dataclass
class RunOptions:
    """How to run a scenario.

    Attributes:
        out: folder of the run.
        order: names of processes in the order in which they are started.
        console: owns the console that is started; None for a run without.
        continued: whether it goes on where an earlier launch of it was interrupted.
        supervisor: over its processes, once they are started.
        changed: texts `a.b.c=value` by which the scenario was changed against its file.
    """

    scenario: Scenario
    out: Path
    mode: str = "lockstep"
    rate: float = 0.0
    listen: str | None = None
    insecure: bool = False
    hosted: bool = False
    order: list[str] = field(default_factory=list)
    console: RunConsole | None = None
    cameras: bool = False
    detect: bool = False
    run_id: str = field(default_factory=lambda: uuid.uuid4().hex[:12])
    continued: bool = False
    supervisor: Supervisor | None = None
    changed: Sequence[str] = ()

    def status(self) -> dict[str, Any]:
        """Return what `zsim ps` shows of the run; callable from any thread."""
        here = {
            "role": "in-process",
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "state": "running",
            "restarts": 0,
        }
        alone = {**here, "lag_ms": None, "messages_per_s": None, "round_trip_ms": None}
        rows = self.supervisor.rows() if self.supervisor else [alone]
        clock = self.supervisor.clock if self.supervisor else None
        return {"rows": rows, "clock": clock, "out": str(self.out.absolute()), "roles": [row["role"] for row in rows]}

    def camera_children(self) -> list[CameraChild]:
        """Return the cameras and detectors that are started."""
        return camera_children(self.scenario, self.cameras or self.scenario.gates("camera"), self.detect)


def _children(options: RunOptions, endpoint: str, supervisor: Supervisor, launcher: RoleLauncher) -> list[ChildProcess]:
    """Return the processes of a run, not started."""
    logs, file = options.out / "logs", options.out / "scenario.yaml"
    scenario, federation = options.scenario, options.scenario.federation
    # Another run's world may listen where ours could not: nobody of this run is to join that one.
    launched = ["--launched", options.run_id, *(["--insecure"] if options.insecure else [])]
    reach = ["--connect", endpoint, "--federation", federation, *launched]
    pace = pace_options(options.mode, options.rate)
    world = [
        "world",
        str(file),
        "--listen",
        endpoint,
        "--expect",
        RECORDER,
        *pace,
        *launched,
        *changed_options(options.changed),
    ]
    world += ["--journal", str(options.out / JOURNAL), *(["--all-died"] if options.continued else [])]
    record = ["record", "--out", str(options.out), *reach]
    children = [
        ChildProcess("world", world, logs, launcher, supervisor.handle_line),
        ChildProcess(RECORDER, record, logs, launcher),
    ]
    wanted = scenario.processes.expect
    names = [name for name in agents_of(scenario) if wanted is None or name in wanted]
    if options.hosted and names:
        children.append(ChildProcess(names[-1], ["host", *reach, "--", *names], logs, launcher))
    else:
        # a name of the contract may begin with -
        split = [name.partition(".") for name in names]
        children += [
            ChildProcess(f"{role}.{thing}", [role, *reach, "--", thing], logs, launcher) for role, _, thing in split
        ]
    if options.console:
        show = ["console", "--name", CONSOLE, "--folder", str(options.out), *reach]
        children.append(ChildProcess(CONSOLE, show, logs, launcher, supervisor.handle_line))
        options.console.own(children[-1])
    for role, name, drones in options.camera_children():
        draw = [COMMANDS.get(role, role), "--name", name, *reach, "--", *drones]
        children.append(ChildProcess(name, draw, logs, launcher))
    rank = {name: i for i, name in enumerate(options.order)}
    return sorted(children, key=lambda child: rank.get(child.name, len(rank)))


def check_endpoint(endpoint: str | None, insecure: bool) -> None:
    """Refuse an endpoint on which no world can listen, before anything is started.

    Raises:
        SessionError: it is malformed, or less secure than was asked for.
    """
    if endpoint is None:
        return
    from zsim.transport.connection import check_listening

    check_listening([endpoint], Identity(insecure=insecure))
    if endpoint.startswith("tcp/") and not re.fullmatch(r"tcp/.+:[0-9]{1,5}", endpoint):
        raise SessionError(f"endpoint is {endpoint!r}; must be tcp/ADDRESS:PORT such as tcp/127.0.0.1:{DEFAULT_PORT}")


def check_open_files(options: RunOptions) -> None:
    """Refuse a run of more processes than this machine allows files for, before anything is started.

    Raises:
        SessionError: with how many files there must be.
    """
    cameras = {child.name for child in options.camera_children()}
    expected = {*options.scenario.expected(), RECORDER}
    agents = 1 if options.hosted else len(expected - cameras) - 1
    count = 2 + agents + (options.console is not None) + len(cameras)
    require_files(launcher_files(count, len(expected)), f"{count} processes")


def options_of(folder: Path) -> tuple[RunOptions, bool]:
    """Return how an interrupted run goes on, and whether in one process: then it is flown once more, as all of it.

    Raises:
        RunError, RecordError: nothing of it is left to fly, or it cannot be gone on with.
    """
    launch = interrupted_run.launch_of(folder)
    if launch.in_process:
        (folder / RECORD).unlink(missing_ok=True)
    else:
        interrupted_run.reopen_record(folder)
    scenario = load_scenario(folder / "scenario.yaml", None, modules=map(Path, launch.modules))
    pace = (launch.mode, launch.rate)
    where = (launch.listen, launch.insecure, launch.hosted)
    how = {"run_id": launch.run_id, "continued": True, "changed": launch.changed}
    return RunOptions(scenario, folder, *pace, *where, **how), launch.in_process


def fly(options: RunOptions, in_process: bool) -> Outcome:
    """Run a scenario, as real processes or in this one, and show its progress; Ctrl-C is an outcome, too."""
    with Screen(options.scenario.duration_s) as screen:
        try:
            return run_in_process(options, screen) if in_process else run_processes(options, screen)
        except KeyboardInterrupt as error:
            return Outcome(str(error) or REASONS[signal.SIGINT], interrupted=True)


def run_processes(options: RunOptions, screen: Screen) -> Outcome:
    """Run a scenario as real processes; the record is finished whatever happens.

    Raises:
        KeyboardInterrupt: with the reason, where nothing flew yet, or Ctrl-C came twice.
    """
    with EndSignals(options.out / "run.log", screen.hang_up) as signals:
        try:
            with handled_by(_interrupt):
                outcome = _run(options, screen, signals)
        except KeyboardInterrupt:
            with contextlib.suppress(OSError):
                (options.out / "logs").rmdir()  # nobody has written there: the folder may be used again
                interrupted_run.forget(options.out)
            raise
        with contextlib.suppress(RecordError):
            repair(options.out / "run.mcap")
        return outcome


def _run(options: RunOptions, screen: Screen, signals: EndSignals) -> Outcome:
    scenario, listen = options.scenario, options.listen
    if not options.continued:
        _write_scenario(options, in_process=False)
    _say_headline(options, screen)
    if options.camera_children() and not options.rate and not scenario.gates("camera"):
        screen.say("as fast as it goes, a lockstep run is faster than its cameras; --rate 1 leaves them time")
    with RoleLauncher(screen.say, str(options.out)) as launcher:
        if listen:
            return _run_on(options, listen, screen, launcher, signals)
        return _run_on_free_port(options, screen, launcher, signals)


def _say_headline(options: RunOptions, screen: Screen) -> None:
    scenario = options.scenario
    screen.say(f"{scenario.name}: {len(scenario.drones)} drones, {scenario.duration_s:g} s, into {options.out}")
    for line in (*unflown_plans(scenario), no_locks(options.out)):
        if line:
            screen.say(line)


def _interrupt(number: int, _: object) -> None:
    raise KeyboardInterrupt(REASONS[number])


def _run_on(options: RunOptions, endpoint: str, screen: Screen, launcher: RoleLauncher, signals: EndSignals) -> Outcome:
    for line in driver_lines(options.scenario, endpoint):
        screen.say(line)
    supervisor = Supervisor(options.scenario.processes, screen)
    supervisor.members = [*_children(options, endpoint, supervisor, launcher)]
    options.supervisor = supervisor
    supervisor.lasting = options.console.process if options.console else None

    def end_with_output() -> None:
        signals.look()
        if signals.reason:
            supervisor.interrupt(signals.reason)

    return supervisor.run(end_with_output)


def _run_on_free_port(
    options: RunOptions, screen: Screen, launcher: RoleLauncher, signals: EndSignals, tries: int = PORTS_TRIED
) -> Outcome:
    port = free_port(screen)
    endpoint = f"tcp/127.0.0.1:{port}"
    outcome = _run_on(options, endpoint, screen, launcher, signals)
    if tries > 1 and _lost_port(outcome, endpoint, port):
        return _run_on_free_port(options, screen, launcher, signals, tries - 1)
    return outcome


def _lost_port(outcome: Outcome, endpoint: str, port: int) -> bool:
    """Return whether another process took the port between our check of it and the start of our world."""
    return outcome.failed and f"cannot listen on {endpoint}" in outcome.reason and not is_free(port)


def _write_scenario(options: RunOptions, in_process: bool) -> None:
    """Put what is to be flown, and how, into the run's folder.

    Raises:
        RunError: it cannot be written.
    """
    pace = (options.mode, options.rate)
    where = (options.listen, tuple(map(str, plugin.folders())), tuple(options.changed))
    launch = Launch(options.run_id, *pace, in_process, options.hosted, options.insecure, *where)
    try:
        if not in_process:
            (options.out / "logs").mkdir(exist_ok=True)
        (options.out / "scenario.yaml").write_text(scenario_file.to_text(options.scenario))
        interrupted_run.keep(options.out, launch)
    except OSError as error:
        raise RunError(f"{options.out}: cannot be written ({error.strerror}); give --out another folder") from error


def run_in_process(options: RunOptions, screen: Screen) -> Outcome:
    """Run a scenario in this process: the same bits, without Zenoh."""
    from zsim_analysis.in_process import fly
    from zsim_world.fleet.fleet import DivergedError

    if not options.continued:
        _write_scenario(options, in_process=True)
    _say_headline(options, screen)
    with EndSignals(options.out / "run.log", screen.hang_up) as signals:
        stop = StopChannel()

        def reason() -> str | None:
            signals.look()
            return signals.reason or stop.reason()

        try:
            ended = fly(options.scenario, options.out / "run.mcap", reason, screen, changed=options.changed)
        except (DivergedError, RunFailedError) as error:
            return Outcome(str(error), failed=True)
        finally:
            stop.restore_signals()
        interrupted = reason() is not None
        if not interrupted:
            interrupted_run.forget(options.out)
        return Outcome(ended, interrupted=interrupted)
