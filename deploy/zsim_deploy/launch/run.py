"""A complete run on this host: starts a scenario's processes, including the recorder, supervises and ends them."""

import contextlib
import os
import re
import signal
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import replace

from zsim.errors import RecordError, RunFailedError, SessionError
from zsim.output_folder import RECORD
from zsim.record import repair
from zsim.runtime.agent import Agent
from zsim.runtime.progress import JsonProgress, Screen
from zsim.scenario.roles import driver_lines, expected_processes, programs, watched_drones
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import BottomCamera, FrontCamera
from zsim.transport.tls import Identity
from zsim.transport.zenoh_settings import launcher_files, require_files
from zsim_agents.hosting import AgentSpec, agents_of
from zsim_api import run_folder
from zsim_api.run_folder import JOURNAL, Launch
from zsim_deploy.arguments import changed_options, load_scenario, pace_options
from zsim_deploy.inventory import COMMANDS
from zsim_deploy.launch.role_launcher import ChildProcess, RoleLauncher, RunConsole, programs_of
from zsim_deploy.launch.supervisor import EndSignals, Outcome, RunProcess, Supervisor, status_row
from zsim_deploy.roles.stop_channel import REASONS, StopChannel, handled_by

RECORDER = "recorder"
CONSOLE = "console.run"  # name of the run's console, which a console started by hand does not take over
DEFAULT_PORT = 7447  # Zenoh's default
PORTS_TRIED = 5  # attempts; another run may take a free port before our world listens on it


Shown = Screen | JsonProgress


@dataclass
class RunOptions:
    """How to run a scenario."""

    scenario: Scenario
    out: Path
    launch: Launch  # stored options, with which the run can be continued
    order: Sequence[str] = ()  # names of the processes to start first, in order
    console: RunConsole | None = None  # owner of the console; None: no console
    cameras: bool = False
    detect: bool = False
    continued: bool = False  # whether this continues an interrupted run
    json_progress: bool = False  # whether to write progress as JSON, for the program that started this one
    supervisor: Supervisor | None = None  # supervisor of the processes, once they are started

    def status(self) -> dict[str, Any]:
        """Return what `zsim ps` shows about the run; callable from any thread."""
        if self.supervisor:
            rows, clock = self.supervisor.rows(), self.supervisor.clock
        else:
            what, state = ("in-process", "running") if self.launch.in_process else ("run", "starting")
            rows, clock = [status_row(what, socket.gethostname(), os.getpid(), state)], None
        return {"rows": rows, "clock": clock, "out": str(self.out.absolute()), "roles": [row["role"] for row in rows]}

    def agents(self) -> list[AgentSpec]:
        return [AgentSpec.parse(arguments) for arguments in self.launch.agents]

    def camera_children(self) -> "list[CameraChild]":
        return camera_children(self.scenario, self.cameras or self.scenario.gates("camera"), self.detect)


def fly(options: RunOptions) -> Outcome:
    run = run_in_process if options.launch.in_process else run_processes
    with (
        contextlib.nullcontext(JsonProgress())
        if options.json_progress
        else Screen(options.scenario.duration_s) as screen
    ):
        try:
            return run(options, screen)
        except KeyboardInterrupt as error:
            return Outcome(str(error) or REASONS[signal.SIGINT], interrupted=True)


def run_processes(options: RunOptions, screen: Shown) -> Outcome:
    """Run a scenario as separate processes, and repair its record if that was left unfinished.

    Raises KeyboardInterrupt, with the reason, if the run is interrupted before the flight, or twice.
    """

    def interrupt(number: int, _: object) -> None:
        raise KeyboardInterrupt(REASONS[number])

    with EndSignals(options.out / "run.log", screen.hang_up) as signals:
        try:
            with handled_by(interrupt):
                outcome = _run(options, screen, signals)
        except KeyboardInterrupt:
            with contextlib.suppress(OSError):
                (options.out / "logs").rmdir()  # fails unless empty; once it is gone, the run's folder can be reused
                run_folder.forget_launch(options.out)
            raise
        with contextlib.suppress(RecordError):
            repair(options.out / RECORD)
        return outcome


def _run(options: RunOptions, screen: Shown, signals: EndSignals) -> Outcome:
    """Prepare the folder and the fork server, and run on a free port; try another one if it was taken meanwhile."""
    run_folder.prepare(options.out, options.scenario, options.launch, screen.say, options.continued)
    if options.camera_children() and not options.launch.rate and not options.scenario.gates("camera"):
        screen.say("an unpaced lockstep run is faster than its cameras; --rate 1 gives them time")
    with RoleLauncher(screen.say, str(options.out)) as launcher:
        if listen := options.launch.listen:
            return _run_on(options, listen, screen, launcher, signals)
        tries = 0
        while True:
            tries, port = tries + 1, free_port(screen)
            endpoint = f"tcp/127.0.0.1:{port}"
            outcome = _run_on(options, endpoint, screen, launcher, signals)
            # Another process may take the port between our check and the start of our world.
            was_lost = outcome.failed and f"cannot listen on {endpoint}" in outcome.reason and not is_free(port)
            if not was_lost or tries == PORTS_TRIED:
                return outcome


def _run_on(options: RunOptions, endpoint: str, screen: Shown, launcher: RoleLauncher, signals: EndSignals) -> Outcome:
    for line in driver_lines(options.scenario, endpoint):
        screen.say(line)
    supervisor = Supervisor(options.scenario.processes, screen)
    supervisor.members = [*_children(options, endpoint, supervisor, launcher)]
    options.supervisor = supervisor
    supervisor.survivor = options.console.process if options.console else None

    def end_with_output() -> None:
        if reason := signals.look():
            supervisor.interrupt(reason)

    return supervisor.run(end_with_output)


def _children(options: RunOptions, endpoint: str, supervisor: Supervisor, launcher: RoleLauncher) -> list[RunProcess]:
    logs, scenario, launch = options.out / "logs", options.scenario, options.launch
    # Another run's world may listen where ours could not; the run id keeps the processes of this run from joining it.
    launched = ["--launched", launch.run_id, *(["--insecure"] if launch.insecure else [])]
    connection_options = ["--connect", endpoint, "--federation", scenario.federation, *launched]
    pace = [*pace_options(launch.mode, launch.rate), *launched, *changed_options(launch.changed)]
    world = ["world", str(options.out / "scenario.yaml"), "--listen", endpoint, "--expect", RECORDER, *pace]
    world += ["--journal", str(options.out / JOURNAL), *(["--all-died"] if options.continued else [])]
    commands = {"world": world, RECORDER: ["record", "--out", str(options.out), *connection_options]}
    expected = scenario.processes.expect
    names = [name for name in agents_of(scenario) if expected is None or name in expected]
    if launch.hosted and names:
        commands[names[-1]] = ["host", *connection_options, "--", *names]
    else:
        for role, _, thing in (name.partition(".") for name in names):
            name = f"{role}.{thing}"  # options end with -- below, because a thing may begin with -
            commands[name] = (
                ["agent", *connection_options, "--", name]
                if role in scenario.own_agents
                else [role, *connection_options, "--", thing]
            )
    for agent in options.agents():
        commands[agent.name] = ["agent", "--name", agent.name, *connection_options, "--", *agent.arguments()]
    if options.console:
        commands[CONSOLE] = ["console", "--name", CONSOLE, "--folder", str(options.out), *connection_options]
    for role, name, drones in options.camera_children():
        commands[name] = [COMMANDS.get(role, role), "--name", name, *connection_options, "--", *drones]
    children: list[RunProcess] = [*programs_of(scenario, programs(scenario), endpoint, options.out, options.launch)]
    for name, command in commands.items():
        on_line = supervisor.handle_line if name in ("world", CONSOLE) else None
        child = ChildProcess(name, command, logs, launcher, on_line)
        children.append(child)
        if options.console and name == CONSOLE:
            options.console.own(child)
    rank = {name: i for i, name in enumerate(options.order)}
    return sorted(children, key=lambda child: rank.get(child.name, len(rank)))


def run_in_process(options: RunOptions, screen: Shown) -> Outcome:
    from zsim_api.flight import fly_here
    from zsim_world.fleet.fleet import DivergedError

    with EndSignals(options.out / "run.log", screen.hang_up) as signals:
        stop = StopChannel(held_by=Agent.held_by)

        def reason() -> str | None:
            return signals.look() or stop.reason()

        try:
            agents, arguments = (
                [each.make for each in options.agents()],
                (options.scenario, options.out, options.launch),
            )
            ended = fly_here(*arguments, agents, screen, reason, options.continued)
        except (DivergedError, RunFailedError) as error:
            return Outcome(str(error), failed=True)
        finally:
            stop.restore_signals()
        return Outcome(ended, interrupted=reason() is not None)


def options_of(folder: Path) -> RunOptions:
    """Return the options that continue an interrupted run; raise RunError if that run is over.

    The record of an in-process run is removed, because such a run is flown again from the start.
    """
    launch = run_folder.launch_of(folder)
    if launch.in_process:
        (folder / RECORD).unlink(missing_ok=True)
    else:
        run_folder.reopen_record(folder)
    scenario = load_scenario(folder / "scenario.yaml", None, modules=map(Path, launch.modules))
    return RunOptions(scenario, folder, launch, continued=True)


def check_endpoint(endpoint: str | None, insecure: bool) -> None:
    """Raise SessionError for an endpoint on which no world can listen: malformed or, unless `insecure`, without TLS."""
    if endpoint is None:
        return
    from zsim.transport.connection import check_listening

    check_listening([endpoint], Identity(insecure=insecure))
    if endpoint.startswith("tcp/") and not re.fullmatch(r"tcp/.+:[0-9]{1,5}", endpoint):
        raise SessionError(f"endpoint is {endpoint!r}; must be tcp/ADDRESS:PORT such as tcp/127.0.0.1:{DEFAULT_PORT}")


def check_open_files(options: RunOptions) -> None:
    """Refuse a run that needs more open files than this machine allows."""
    cameras = {child.name for child in options.camera_children()}
    expected = {*expected_processes(options.scenario), RECORDER}
    agents = 1 + len(options.launch.agents) if options.launch.hosted else len(expected - cameras) - 1
    count = 2 + agents + (options.console is not None) + len(cameras)
    require_files(launcher_files(count, len(expected)), f"{count} processes")


def free_port(screen: Shown) -> int:
    """Return Zenoh's default port; if that is in use, show a notice and return another free port."""
    if is_free(DEFAULT_PORT):
        return DEFAULT_PORT
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    screen.say(f"port {DEFAULT_PORT} is in use; this run is on tcp/127.0.0.1:{port} (other commands need --connect)")
    return port


def is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


# Cameras


class CameraChild(NamedTuple):
    """A camera or detector process of a run. `drones`: the drones it serves; empty: all with cameras."""

    role: str
    name: str
    drones: tuple[str, ...] = ()


def with_cameras(scenario: Scenario) -> Scenario:
    """Return the scenario with cameras: if no drone has any, every drone gets the two cameras of the AR.Drone."""
    if any(drone.sensors.cameras() for drone in scenario.drones):
        return scenario
    default_cameras = {"front_camera": FrontCamera(), "bottom_camera": BottomCamera()}
    drones = [replace(drone, sensors=replace(drone.sensors, **default_cameras)) for drone in scenario.drones]
    return replace(scenario, drones=drones)


def camera_children(scenario: Scenario, cameras: bool, detect: bool) -> list[CameraChild]:
    """Return the camera and detector processes that the scenario expects by name or the user requests.

    Each drone named in `expect` has its own process, and ROLE.main serves all others. `cameras`: whether to render the
    cameras of all drones; `detect`: whether to detect hats in the images of all drones.
    """
    filmed = watched_drones("", scenario)
    all_drones = [drone.name for drone in scenario.drones]  # images may come from cameras outside zsim
    expected = scenario.processes.expect or ()
    children: list[CameraChild] = []
    for role, candidates, drones, is_requested in (
        ("camera", filmed, filmed, cameras),
        ("detector", all_drones, filmed or all_drones, detect),
    ):
        role_children = [
            CameraChild(role, f"{role}.{drone}", (drone,)) for drone in candidates if f"{role}.{drone}" in expected
        ]
        main, names = f"{role}.main", {child.name for child in role_children}
        remaining = tuple(drone for drone in drones if f"{role}.{drone}" not in expected)
        if drones and main not in names and (main in expected or (is_requested and remaining)):
            role_children.append(CameraChild(role, main, remaining if role_children else ()))
        children += role_children
    return children
