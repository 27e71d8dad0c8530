"""The roles of a run as processes: agents, recorder, router, and those that serve one run after the other.

The latter (`serve_runs`) are console, gateway, bridges, drivers, cameras and detectors. The world has a file of its
own.
"""

import gc
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path

from msgspec import UNSET

from zsim.contract import keys, messages
from zsim.contract.messages import Info
from zsim.contract.run_messages import Join
from zsim.errors import (
    DecodeError,
    NoWorldError,
    RecordError,
    RunError,
    SessionError,
    SupersededError,
    UserCodeError,
    ZsimError,
    printable,
)
from zsim.output_folder import no_locks
from zsim.runtime.agent import Agent, AgentGroup
from zsim.runtime.inbox import output_hold_ns
from zsim.runtime.participant import Participant
from zsim.runtime.runner import Runner
from zsim.scenario import scenario_file
from zsim.scenario.roles import AGENTS, RECORDER, ROUTER, things, watched_drones
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import Hats
from zsim.transport import tls
from zsim.transport.connection import find_world, route
from zsim.transport.link_watch import Awaited, ClosedLink, LinkWatch, SessionTokens
from zsim.transport.session import RawSample, Session
from zsim.transport.tls import Identity
from zsim.transport.zenoh_settings import Mode
from zsim_agents.hosting import agent_class, chosen, hosted, make_agents
from zsim_deploy import USER_FAULT
from zsim_deploy.arguments import RUN_ID, WorldAccess
from zsim_deploy.roles.stop_channel import StopChannel

RUN_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")  # an id of a run that is part of a folder's name
PATTERN = "*?["  # signs of a pattern; fnmatch
ANY = "*"  # in a process name, for a number
TICK_S = 0.1  # how often a router looks for a stop
PROBE_S = 1.0  # how often a router that reaches nobody upstream looks for the reason
PAUSE_S = 0.2  # between two looks at a world whose run has ended and that waits for byes
JOINS_MAX = 10_000  # remembered by a router; anybody can make up names
SLACK_GATES = 3  # a picture between two gates needs the second; one more, and the world and the cameras work at once

Stopped = Callable[[], bool]
Say = Callable[[str], None]
Build = Callable[[Info, Scenario], Agent]
Serve = Callable[[Session, Info, Participant, Stopped, Say], None]
"""Serves one run with (session, info, participant, stopped, say), until the run is over or the process stopped."""
StandsFor = Callable[[Info], tuple[str, ...]]  # names of processes whose work a process does in a run
SlackNs = Callable[[Info], int]  # how far the world of a run may be ahead of a process; 0 for one that never gates
Remain = Callable[[Callable[[], str | None], Callable[[], bool]], None]
"""Does with (reason, deserted) what is left to do after a run, until there is a reason to stop; deserted, at once."""
Drones = Callable[[Info, Sequence[str]], list[str]]


def log_printer(launched: str | None) -> Say:
    """Return a function that prints a line on standard error, with the time in a launched process, whose log it is."""

    def say(text: str) -> None:
        if launched is not None:
            text = f"{time.strftime('%H:%M:%S')} {text}"
        print(printable(text), file=sys.stderr, flush=True)

    return say


# Agents


def agent(build: Build, reach: WorldAccess, name: str = "") -> None:
    """Run one agent against a world.

    Args:
        build: makes it.
        reach: of the world.
        name: of the process, where that is known before the world is.

    Raises:
        UserCodeError: a user's class raised, or returned what cannot be used.
    """
    try:
        _agent(build, reach, name)
    except UserCodeError as error:
        if not reach.launched:
            raise
        print(printable(str(error)), file=sys.stderr)
        sys.exit(USER_FAULT)  # its launcher is not to start it again


def _agent(build: Build, reach: WorldAccess, name: str) -> None:
    launched, who = reach.launched, reach.who._replace(process=name)
    stop = StopChannel(launched, who)
    say = log_printer(launched)
    connection = find_world(
        reach.endpoint, reach.federation, reach.wait_s, say, stop.stopped, run_id=launched, identity=who
    )
    with connection as (link, info):
        scenario = scenario_file.from_text(info.scenario)
        member = build(info, scenario)
        check_certificate(member, who)
        also = f", and stands for {', '.join(member.serves)}" if member.serves else ""
        say(f"{member.name}: in run {info.run_id}{also}")
        gc.collect()
        gc.freeze()
        snapshot_ns = round(scenario.processes.snapshot_s * 1e9)
        runner = Runner(link, info, member, stop.stopped, say, stop.orphaned, snapshot_ns)
        reason = runner.run()
    say(f"{member.name}: left, {reason}")
    if runner.killed:  # end as by kill -9, so that the launcher sees it die; Windows has no SIGKILL
        os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))
    stop.exit_if_terminated()


def agent_of(role: str, names: Sequence[str]) -> Build:
    """Return a function that makes the agent of a role for drones or clusters, by name or by patterns like `drone*`."""
    agent_class(role)  # loaded while the world is not there yet

    def build(info: Info, scenario: Scenario) -> Agent:
        wanted = chosen(f"{role}: {AGENTS[role].about}", names, things(role, scenario))
        agents = make_agents(role, info, scenario, wanted)
        return agents[0] if len(agents) == 1 else AgentGroup(agents, output_hold_ns(info))

    return build


def host(names: Sequence[str]) -> Build:
    """Return a function that makes several estimators and controllers as one agent, by name or by patterns."""
    return lambda info, scenario: hosted(info, scenario, names)


# The recorder


def recorder(out: Path, reach: WorldAccess) -> None:
    """Record the run of a world into a folder, whose name may contain RUN_ID.

    Raises:
        RecordError: the folder cannot be made, or the file cannot be written.
    """
    from zsim.output_folder import RECORD
    from zsim.record.completeness import record_completeness
    from zsim_agents.recorder import Recorder

    launched, who = reach.launched, reach.who._replace(process=RECORDER)
    stop = StopChannel(launched, who)
    say = log_printer(launched)
    make_folder(out.parent if RUN_ID in out.name else out)
    connection = find_world(reach.endpoint, reach.federation, reach.wait_s, say, stop.stopped, True, launched, who)
    with connection as (link, info):
        folder = record_folder(out, info.run_id)
        make_folder(folder)
        if not launched and (warning := no_locks(folder)):
            say(f"recorder: {warning}")
        path = folder / RECORD
        say(f"recorder: run {info.run_id} into {path}")
        reason = Recorder(link, info, path, stopped=stop.stopped, say=say, deserted=stop.orphaned).run()
    say(f"recorder: {path}: {'closed' if launched else record_completeness(path)}, {reason}")
    stop.exit_if_terminated()


def record_folder(out: Path, run_id: str) -> Path:
    """Return the folder of a run's record.

    Raises:
        RecordError: the id, which the world gives, would lead to another folder.
    """
    if RUN_ID not in out.name:
        return out
    if not RUN_NAME.fullmatch(run_id):
        allowed = f"must be 1 to 64 of A-Z a-z 0-9 _ -; give --out without {RUN_ID}"
        raise RecordError(f"{out}: run is {run_id[:40]!r}; {allowed}")
    return out.with_name(out.name.replace(RUN_ID, run_id))


def make_folder(folder: Path) -> None:
    """Make the folder of a record.

    Raises:
        RecordError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{folder}: cannot be made ({error.strerror}); give --out another folder") from error


# Routers


def router(
    name: str,
    endpoint: str,
    upstream: str,
    federation: str,
    mode: Mode,
    launched: str | None,
    identity: Identity,
) -> None:
    """Run a router on an endpoint until it is stopped.

    Raises:
        SessionError: the port is taken, or a certificate, here or upstream, is refused.
    """
    identity = identity._replace(process=f"{ROUTER}.{name}")
    stop = StopChannel(launched, identity)
    say = log_printer(launched)
    with route(endpoint, upstream, federation, mode, identity) as link:
        say(f"router.{name}: {endpoint} leads to {upstream}")
        links, probe_s = RouterLinks(link, lambda text: say(f"router.{name}: {text}")), 0.0
        with links.watch:
            while not stop.stopped():
                if time.monotonic() >= probe_s and not link.links():
                    if fault := tls.peer_fault(identity, upstream):
                        raise SessionError(f"cannot connect to {upstream}: {fault}")
                    probe_s = time.monotonic() + PROBE_S
                links.report()
                time.sleep(TICK_S)
    say(f"router.{name}: left, {stop.reason()}")
    stop.exit_if_terminated()


class RouterLinks:
    """Watches the links of a router: readers that take nothing would hold up the world through it.

    A router does not know the run. A process that nobody waits for has said so in its join, or shows no token of its
    session.

    Args:
        link: its session.
        say: takes a line for each link that was closed.

    Attributes:
        watch: closes the links.
    """

    def __init__(self, link: Session, say: Say) -> None:
        self._say = say
        self._tokens = SessionTokens(link)
        self._joins: dict[str, Join] = {}
        self._tokens.watch()
        link.declare_subscriber(keys.process("*", "join"), self._on_join)
        self.watch = LinkWatch(link, self._tokens, self.awaited)

    def _on_join(self, sample: RawSample) -> None:
        with suppress(DecodeError):
            join = messages.decode_as(Join, sample.payload, sample.key)
            if len(self._joins) >= JOINS_MAX:
                self._joins.clear()
            self._joins[keys.thing(sample.key)] = join

    def awaited(self) -> list[Awaited]:
        """Return the processes that must lose nothing; callable from any thread."""
        joins = self._joins.copy()
        awaited = [Awaited((name,), 0) for name in self._tokens.shown() if name not in joins]
        for name, join in joins.items():
            if (join.period_ns > 0 or join.slack_ns > 0) and self._tokens.is_alive(name):
                awaited.append(Awaited((name, *join.serves), join.pid))
        return awaited

    def report(self) -> None:
        """Show the links that were closed since the last time."""
        while self.watch.closed:
            self._say(_text(self.watch.closed.popleft()))


def _text(closed: ClosedLink) -> str:
    who = f"{closed.process or 'somebody'} at {closed.address} ({', '.join(closed.names) or 'no process of the run'})"
    return f"{who} took nothing of {closed.held_bytes / 1e6:.1f} MB; its link is closed ({closed.times} so far)"


# Processes that serve one run after the other


def serve_runs(
    name: str,
    serve: Serve,
    reach: WorldAccess,
    stands_for: StandsFor = lambda info: (),
    slack_ns: SlackNs = lambda info: 0,
    remain: Remain | None = None,
) -> None:
    """Serve one run after the other of the world on an endpoint, until stopped; a launched process serves only one.

    Args:
        name: of the process; `role.*` for the first free number, kept until another process takes it.
        serve: what it does in a run.
        reach: of the world.
        stands_for: whose work it does in a run, beside its own.
        slack_ns: how far the world of a run may be ahead of it; 0 for a process that never gates.
        remain: what it does after the run of its launcher, until that asks it to stop.

    Raises:
        NoWorldError: there was no first world within `wait_s`.
        SupersededError: another process of the name that was given has taken over.
        SystemExit: it is launched, and was not ended by its launcher.
    """
    launched, wait_s = reach.launched, reach.wait_s
    who = reach.who._replace(process="" if name.endswith(ANY) else name)
    stop = StopChannel(launched, who)
    say = log_printer(launched)
    own_name, served = name, ""
    try:
        while not stop.stopped():
            with find_world(reach.endpoint, reach.federation, wait_s, say, stop.stopped, True, launched, who) as (
                link,
                info,
            ):
                if info.run_id != served:
                    own_name = _free(link, own_name)
                    participant = Participant(link, info, own_name, stands_for(info), slack_ns(info))
                    try:
                        _serve(serve, link, participant, info, stop, say)
                        served = info.run_id
                    except NoWorldError as error:  # it went as this process came
                        if launched:
                            raise
                        say(str(error))
                    if participant.superseded:
                        own_name, served = _next(name, participant), ""
                else:
                    time.sleep(PAUSE_S)
            if launched:
                break
            wait_s = None
    except NoWorldError:
        if not stop.stopped():
            raise
    if launched and remain is not None:
        remain(stop.reason, stop.orphaned)
    stop.exit_if_terminated()


def _free(link: Session, name: str) -> str:
    """Return a name; for `role.*` the first of role.1, role.2, ... that no process has."""
    role, _, thing = name.partition(".")
    if thing != ANY:
        return name
    taken = link.tokens(keys.token(f"{role}.$*"))
    return next(free for i in count(1) if keys.token(free := f"{role}.{i}") not in taken)


def _next(name: str, participant: Participant) -> str:
    """Return the name under which to join again; two processes may have chosen the same free number.

    Raises:
        SupersededError: the name was given.
    """
    role, _, thing = name.partition(".")
    if thing != ANY:
        raise SupersededError(f"{name}: {participant.end_reason}; this one ends")
    return f"{role}.{int(participant.name.rpartition('.')[2]) + 1}"


def _serve(serve: Serve, link: Session, participant: Participant, info: Info, stop: StopChannel, say: Say) -> None:
    name = participant.name
    if not participant.gates:
        participant.announce()
    say(f"{name}: in run {info.run_id}")
    try:
        serve(link, info, participant, stop.stopped, say)
    except ZsimError as error:
        participant.leave(str(error).removeprefix(f"{name}: "))  # otherwise the world would take it for dead
        raise
    reason = participant.end_reason or stop.reason() or "stopped"
    participant.leave(reason)
    say(f"{name}: left, {reason}")


# Cameras and detectors, for drones that are known once the run is


def camera(
    link: Session, info: Info, participant: Participant, stopped: Stopped, say: Say, names: Sequence[str]
) -> None:
    """Serve a run with pictures of the cameras of some drones, by name or by patterns.

    Raises:
        RunError: no drone with a camera has such a name.
    """
    from zsim_agents.cameras.camera_process import CameraProcess

    drones = of_camera(info, names)
    say(f"{participant.name}: draws for {', '.join(drones)}")
    CameraProcess(link, info, participant, scenario_file.from_text(info.scenario), drones).run(stopped)


def of_camera(info: Info, names: Sequence[str]) -> list[str]:
    """Return the drones of a camera process.

    Raises:
        RunError: no drone with a camera has such a name.
    """
    scenario = scenario_file.from_text(info.scenario)
    with_cameras = [drone.name for drone in scenario.drones if drone.sensors.cameras()]
    return chosen("camera: drone with a camera", names or ["*"], with_cameras)


def detector(
    link: Session,
    info: Info,
    participant: Participant,
    stopped: Stopped,
    say: Say,
    names: Sequence[str],
    diameter_m: float | None,
) -> None:
    """Serve a run with what is seen in the pictures of some drones; their cameras need not be zsim's.

    Args:
        diameter_m: of a hat; None for the scenario's.

    Raises:
        RunError: no drone has such a name.
    """
    from zsim_agents.cameras.detector_process import DetectorProcess

    drones = of_detector(info, names)
    say(f"{participant.name}: looks at the pictures of {', '.join(drones)}")
    hats = scenario_file.from_text(info.scenario).environment.hats
    diameter_m = diameter_m or (Hats() if hats is UNSET else hats).diameter_m
    DetectorProcess(link, participant, say, drones, diameter_m).run(stopped)


def of_detector(info: Info, names: Sequence[str]) -> list[str]:
    """Return the drones of a detector process; their cameras need not be zsim's.

    Raises:
        RunError: no drone has such a name.
    """
    scenario = scenario_file.from_text(info.scenario)
    everybody = [drone.name for drone in scenario.drones]
    return chosen("detect: drone", names, everybody) if names else watched_drones("", scenario) or everybody


def stands_for(role: str, drones: Drones, names: Sequence[str], info: Info) -> tuple[str, ...]:
    """Return the names of the processes, one for each drone, whose work a process for several drones does."""
    return tuple(f"{role}.{drone}" for drone in drones(info, names))


def slack_ns(role: str, info: Info) -> int:
    """Return how far the world may be ahead of a role; 0 where nothing waits for it, as in a replay."""
    gates = not info.replay_of and scenario_file.from_text(info.scenario).gates(role)
    return SLACK_GATES * info.gate_ns if gates else 0


# Names and certificates: access control knows processes by nothing else


def process_of(role: str, names: Sequence[str]) -> str:
    """Return the process name of the agent of one drone or cluster; empty for patterns, and for several."""
    return f"{role}.{names[0]}" if len(names) == 1 and not set(names[0]) & set(PATTERN) else ""


def process_name(role: str, name: str, who: Identity, thing: str = "main") -> str:
    """Return a process's name: as given, or its certificate's, or the role's first.

    Raises:
        SessionError: the certificate cannot be used.
    """
    if name or who.tls is None:
        return name or f"{role}.{thing}"
    if fault := tls.own_fault(who):
        raise SessionError(fault)
    return tls.own_name(who)


def check_certificate(member: Agent, identity: Identity) -> None:
    """Refuse to publish for other processes where access control would drop it silently.

    Raises:
        RunError: the agent stands for other processes, or the certificate is not its own.
    """
    if not identity.tls:
        return
    if member.serves:
        others = ", ".join(member.serves)
        raise RunError(
            f"{member.name}: a certificate is for one process, and this one stands for {others} too; "
            "run each by itself, or without TLS"
        )
    if fault := tls.own_fault(identity._replace(process=member.name)):
        raise RunError(fault)
