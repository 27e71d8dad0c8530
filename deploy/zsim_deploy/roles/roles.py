"""The roles as processes: agents, recorder, router; and those that serve one run after the other.

The console and the gateway are of the latter kind.
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
from zsim.scenario.rights import RECORDER, ROUTER, watched
from zsim.scenario.role_table import AGENTS, things
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import Hats
from zsim.transport import tls
from zsim.transport.connection import find_world, route
from zsim.transport.link_watch import Awaited, ClosedLink, LinkWatch, SessionTokens
from zsim.transport.session import RawSample, Session
from zsim.transport.tls import Identity
from zsim.transport.zenoh_settings import Mode
from zsim_agents.cameras import camera_process, detector_process
from zsim_agents.hosting import agent_class, chosen, hosted, made
from zsim_deploy import USER_FAULT
from zsim_deploy.arguments import RUN_ID, WorldAccess
from zsim_deploy.roles.process_control import StopChannel

TICK_S = 0.1  # how often a router looks for a stop
PROBE_S = 1.0  # how often a router that reaches nobody upstream asks why
ANY = "*"  # in a name, for a number
PAUSE_S = 0.2  # between two looks at a world whose run has ended and that waits for byes

Stopped = Callable[[], bool]
Say = Callable[[str], None]
Serve = Callable[[Session, Info, Participant, Stopped, Say], None]
"""Serves one run with (session, info, presence, stopped, say), until its presence is over or it is stopped."""
StandsFor = Callable[[Info], tuple[str, ...]]  # names of processes whose work a process does in a run
SlackNs = Callable[[Info], int]  # by how much the world of a run may be ahead of a process; 0 for any
Remain = Callable[[Callable[[], str | None], Callable[[], bool]], None]
"""Does with (reason, deserted) what is left to do after a run, until there is a reason to stop; deserted, at once."""


def agent(build: Callable[[messages.Info, Scenario], Agent], reach: WorldAccess, name: str = "") -> None:
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


def _agent(build: Callable[[messages.Info, Scenario], Agent], reach: WorldAccess, name: str) -> None:
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
        say(f"{member.name}: in run {info.run_id}{_also(member)}")
        gc.collect()
        gc.freeze()
        snapshot_ns = round(scenario.processes.snapshot_s * 1e9)
        runner = Runner(link, info, member, stop.stopped, say, stop.orphaned, snapshot_ns)
        reason = runner.run()
    say(f"{member.name}: left, {reason}")
    if runner.killed:
        _die()
    stop.exit_if_terminated()


def _die() -> None:
    """End as by kill -9, so that who launched this process sees it die."""
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))  # Windows has no SIGKILL; there this is as hard


def agent_of(role: str, names: Sequence[str]) -> Callable[[messages.Info, Scenario], Agent]:
    """Return what builds the agent of a role for some drones or clusters, named or by patterns such as `drone*`."""
    agent_class(role)  # loaded while the world is not there yet

    def build(info: messages.Info, scenario: Scenario) -> Agent:
        wanted = chosen(f"{role}: {AGENTS[role].about}", names, things(role, scenario))
        agents = made(role, info, scenario, wanted)
        return agents[0] if len(agents) == 1 else AgentGroup(agents, output_hold_ns(info))

    return build


def host(names: Sequence[str]) -> Callable[[messages.Info, Scenario], Agent]:
    """Return what builds several estimators and controllers as one agent, named or by patterns."""
    return lambda info, scenario: hosted(info, scenario, names)


def _also(made: Agent) -> str:
    return f", and stands for {', '.join(made.serves)}" if made.serves else ""


def recorder(out: Path, reach: WorldAccess) -> None:
    """Record the run of a world into a folder, whose name may hold RUN_ID.

    Raises:
        RecordError: the folder cannot be made, or the file not be written.
    """
    from zsim.record.completeness import record_completeness
    from zsim_agents.recorder import record

    launched, who = reach.launched, reach.who._replace(process=RECORDER)
    stop = StopChannel(launched, who)
    say = log_printer(launched)
    make(out.parent if RUN_ID in out.name else out)
    connection = find_world(reach.endpoint, reach.federation, reach.wait_s, say, stop.stopped, True, launched, who)
    with connection as (link, info):
        folder = record_folder(out, info.run_id)
        make(folder)
        if not launched and (warning := no_locks(folder)):
            say(f"recorder: {warning}")
        path = folder / RECORD
        say(f"recorder: run {info.run_id} into {path}")
        reason = record(link, info, path, stopped=stop.stopped, say=say, deserted=stop.orphaned)
    say(f"recorder: {path}: {'closed' if launched else record_completeness(path)}, {reason}")
    stop.exit_if_terminated()


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
        links = RouterLinks(link, lambda text: say(f"router.{name}: {text}"))
        with links.watch:
            _route(link, links, stop, lambda: _refuse(tls.peer_fault(identity, upstream), upstream))
    say(f"router.{name}: left, {stop.reason()}")
    stop.exit_if_terminated()


def _route(link: Session, links: RouterLinks, stop: StopChannel, check_upstream: Callable[[], None]) -> None:
    """Let a router route until it is stopped."""
    probe_s = 0.0
    while not stop.stopped():
        if time.monotonic() >= probe_s and not link.links():
            check_upstream()
            probe_s = time.monotonic() + PROBE_S
        links.report()
        time.sleep(TICK_S)


def _refuse(fault: str | None, upstream: str) -> None:
    if fault:
        raise SessionError(f"cannot connect to {upstream}: {fault}")


def log_printer(launched: str | None) -> Callable[[str], None]:
    """Return what prints a line for people on standard error, which a launcher keeps as the log."""

    def say(text: str) -> None:
        if launched is not None:
            text = f"{time.strftime('%H:%M:%S')} {text}"
        print(printable(text), file=sys.stderr, flush=True)

    return say


def _nobody(_: Info) -> tuple[str, ...]:
    return ()


def _no_slack(_: Info) -> int:
    return 0


def serve_runs(
    name: str,
    serve: Serve,
    reach: WorldAccess,
    stands_for: StandsFor = _nobody,
    slack_ns: SlackNs = _no_slack,
    remain: Remain | None = None,
) -> None:
    """Serve one run after the other of the world on an endpoint, until it is stopped; launched, only one.

    Args:
        name: of the process; `role.*` for the first number that nobody has, kept until somebody takes it.
        serve: what it does in a run.
        reach: of the world.
        stands_for: whose work it does in a run, beside its own.
        slack_ns: by how much the world of a run may be ahead of it; 0 for any.
        remain: what it does after the run of its launcher, until that asks it to stop.

    Raises:
        NoWorldError: there was no first world within `wait_s`.
        SupersededError: another process of the name that was given has taken over.
        SystemExit: it is launched, and somebody else than its launcher has ended it.
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
                    presence = Participant(link, info, own_name, stands_for(info), slack_ns(info))
                    try:
                        _serve(serve, link, presence, info, stop, say)
                        served = info.run_id
                    except NoWorldError as error:  # it went as this process came
                        if launched:
                            raise
                        say(str(error))
                    if presence.superseded:
                        own_name, served = _next(name, presence), ""
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
    """Return a name; for `role.*` the first of role.1, role.2, ... that nobody has."""
    role, _, thing = name.partition(".")
    if thing != ANY:
        return name
    taken = link.tokens(keys.token(f"{role}.$*"))
    return next(free for i in count(1) if keys.token(free := f"{role}.{i}") not in taken)


def _next(name: str, presence: Participant) -> str:
    """Return the name under which to come in again; two that were to choose a number may have chosen the same one.

    Raises:
        SupersededError: the name was given.
    """
    role, _, thing = name.partition(".")
    if thing != ANY:
        raise SupersededError(f"{name}: {presence.end_reason}; this one ends")
    return f"{role}.{int(presence.name.rpartition('.')[2]) + 1}"


def _serve(serve: Serve, link: Session, presence: Participant, info: Info, stop: StopChannel, say: Say) -> None:
    if not presence.gates:
        presence.announce()
    say(f"{presence.name}: in run {info.run_id}")
    try:
        serve(link, info, presence, stop.stopped, say)
    except ZsimError as error:
        presence.leave(str(error).removeprefix(f"{presence.name}: "))  # else the world would take it for dead
        raise
    reason = presence.end_reason or stop.reason() or "stopped"
    presence.leave(reason)
    say(f"{presence.name}: left, {reason}")


RECORD = "run.mcap"
RUN_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")  # an id of a run that is part of a folder's name


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


def make(folder: Path) -> None:
    """Make the folder of a record.

    Raises:
        RecordError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{folder}: cannot be made ({error.strerror}); give --out another folder") from error


PATTERN = "*?["  # signs of a pattern; fnmatch


def process_of(role: str, names: Sequence[str]) -> str:
    """Return the name of the process that is the agent of one drone or cluster; empty for patterns, and for several."""
    return f"{role}.{names[0]}" if len(names) == 1 and not set(names[0]) & set(PATTERN) else ""


def process_name(role: str, name: str, who: Identity, thing: str = "main") -> str:
    """Return a process's name: as given, or its certificate's, or the role's first.

    Raises:
        SessionError: the certificate is of no use.
    """
    if name or who.tls is None:
        return name or f"{role}.{thing}"
    if fault := tls.own_fault(who):
        raise SessionError(fault)
    return tls.own_name(who)


def check_certificate(made: Agent, identity: Identity) -> None:
    """Refuse to publish for other processes where access control would drop it without a word."""
    if not identity.tls:
        return
    if made.serves:
        others = ", ".join(made.serves)
        raise RunError(
            f"{made.name}: a certificate is for one process, and this one stands for {others} too; "
            "run each by itself, or without TLS"
        )
    if fault := tls.own_fault(identity._replace(process=made.name)):
        raise RunError(fault)


JOINS_MAX = 10_000  # remembered; names cost a stranger nothing


class RouterLinks:
    """Watches the links of a router.

    Args:
        link: its session.
        say: takes a line for each link that was closed.

    Attributes:
        watch: closes the links.
    """

    def __init__(self, link: Session, say: Callable[[str], None]) -> None:
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
        """Return who must lose nothing; callable from any thread."""
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


SLACK_GATES = 3  # a picture between two gates needs the second; one more, and the world and the cameras work at once
Drones = Callable[[Info, Sequence[str]], list[str]]


def camera(
    link: Session, info: Info, presence: Participant, stopped: Stopped, say: Say, names: Sequence[str]
) -> None:
    """Serve a run with pictures of the cameras of some drones, named or by patterns.

    Raises:
        RunError: no drone with a camera has such a name.
    """
    drones = of_camera(info, names)
    say(f"{presence.name}: draws for {', '.join(drones)}")
    camera_process.serve(link, info, presence, stopped, scenario_file.from_text(info.scenario), drones)


def detector(
    link: Session,
    info: Info,
    presence: Participant,
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
    drones = of_detector(info, names)
    say(f"{presence.name}: looks at the pictures of {', '.join(drones)}")
    diameter_m = diameter_m or hat_diameter_m(scenario_file.from_text(info.scenario))
    detector_process.serve(link, presence, stopped, say, drones, diameter_m)


def of_camera(info: Info, names: Sequence[str]) -> list[str]:
    """Return the drones of a camera process.

    Raises:
        RunError: no drone with a camera has such a name.
    """
    scenario = scenario_file.from_text(info.scenario)
    with_cameras = [drone.name for drone in scenario.drones if drone.sensors.cameras()]
    return chosen("camera: drone with a camera", names or ["*"], with_cameras)


def of_detector(info: Info, names: Sequence[str]) -> list[str]:
    """Return the drones of a detector process; their cameras need not be zsim's.

    Raises:
        RunError: no drone has such a name.
    """
    scenario = scenario_file.from_text(info.scenario)
    everybody = [drone.name for drone in scenario.drones]
    return chosen("detect: drone", names, everybody) if names else watched("", scenario) or everybody


def stands_for(role: str, drones: Drones, names: Sequence[str], info: Info) -> tuple[str, ...]:
    """Return the names of the processes, one for each drone, whose work a process for several does."""
    return tuple(f"{role}.{drone}" for drone in drones(info, names))


def slack_ns(role: str, info: Info) -> int:
    """Return by how much the world may be ahead of a role; 0 for any, where nothing waits for it, as in a replay."""
    gates = not info.replay_of and scenario_file.from_text(info.scenario).gates(role)
    return SLACK_GATES * info.gate_ns if gates else 0


def hat_diameter_m(scenario: Scenario) -> float:
    """Return the diameter of the hats of a scenario."""
    hats = scenario.environment.hats
    return (Hats() if hats is UNSET else hats).diameter_m
