"""Runs roles as processes: agents, the recorder, routers, and roles that serve one run after another.

The last (`serve_runs`) are the console, gateway, bridges, drivers, cameras and detectors. The world is in `world_role`.
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
from traceback import format_exception

from msgspec import UNSET

from zsim.contract import keys, messages
from zsim.contract.messages import Info
from zsim.contract.run_messages import Join
from zsim.errors import (
    OTHER_OUT,
    DecodeError,
    NoWorldError,
    RecordError,
    RunError,
    SessionError,
    SupersededError,
    UserCodeError,
    ZsimError,
    file_fault,
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
from zsim.schema import plugin
from zsim.sensors.camera import Hats
from zsim.transport import tls
from zsim.transport.connection import find_world, route
from zsim.transport.link_watch import Awaited, LinkWatch, SessionTokens
from zsim.transport.session import RawSample, Session
from zsim.transport.tls import Identity
from zsim.transport.zenoh_settings import Mode
from zsim_agents.hosting import agent_class, chosen, hosted, make_agents
from zsim_deploy import USER_FAULT
from zsim_deploy.arguments import RUN_ID, WorldAccess
from zsim_deploy.roles.stop_channel import StopChannel, lower_priority

RUN_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")  # run ids that may be part of a folder's name
PATTERN = "*?["  # special characters of patterns; fnmatch
ANY = "*"  # stands for a number in a process name
TICK_S = 0.1  # interval at which a router checks whether it must stop, wall time
PROBE_S = 1.0  # interval at which a router that cannot connect upstream looks for the reason, wall time
PAUSE_S = 0.2  # polling interval while a world whose run has ended waits for bye messages, wall time
JOINS_MAX = 10_000  # maximum number of joins that a router remembers; limited because clients can invent names
SLACK_GATES = 3  # an image between two gates needs the second; one more gate lets world and cameras work in parallel

Stopped = Callable[[], bool]
Say = Callable[[str], None]
Build = Callable[[Info, Scenario], Agent]
Serve = Callable[[Session, Info, Participant, Stopped, Say], None]
"""Serves one run with (session, info, participant, stopped, say), until the run is over or the process is stopped."""
StandsFor = Callable[[Info], tuple[str, ...]]  # names of the processes that a process replaces in a run
SlackNs = Callable[[Info], int]  # how far the world of a run may be ahead of a process; 0: it does not wait
Remain = Callable[[Callable[[], str | None], Callable[[], bool]], None]
"""Called after a run with (reason, deserted); returns when there is a reason to stop, at once if deserted."""


def log_printer(launched: str | None) -> Say:
    """Return a function that prints a line to standard error; in a launched process, which has a log, with the time."""

    def say(text: str) -> None:
        if launched is not None:
            text = f"{time.strftime('%H:%M:%S')} {text}"
        print(printable(text), file=sys.stderr, flush=True)

    return say


def agent(build: Build, reach: WorldAccess, name: str = "") -> None:
    """Run one agent in a world's run; `name`: the name of the process, if known in advance.

    Raises UserCodeError if a user's class raises an exception or returns something unusable; a launched process prints
    the error and exits instead.
    """
    launched, identity = reach.launched, reach.who._replace(process=name)
    stop = StopChannel(launched, identity)
    say = log_printer(launched)
    try:
        with find_world(
            reach.endpoint, reach.federation, reach.wait_s, say, stop.stopped, run_id=launched, identity=identity
        ) as (link, info):
            scenario = scenario_file.from_text(info.scenario)
            member = build(info, scenario)
            check_certificate(member, identity)
            replaces = f", and replaces {', '.join(member.serves)}" if member.serves else ""
            say(f"{member.name}: in run {info.run_id}{replaces}")
            gc.collect()
            gc.freeze()
            snapshot_ns = round(scenario.processes.snapshot_s * 1e9)
            runner = Runner(link, info, member, stop.stopped, say, stop.orphaned, snapshot_ns)
            reason = runner.run()
    except UserCodeError as error:
        if not launched:
            raise
        print(printable(str(error)), file=sys.stderr)
        if (raised := plugin.raised_by_user(error)) is not None:
            print(printable("".join(format_exception(raised, chain=False))), end="", file=sys.stderr)
        sys.exit(USER_FAULT)  # so that the launcher does not restart it
    say(f"{member.name}: left, {reason}")
    if runner.killed:  # end as if by kill -9, so that the launcher sees a death; Windows has no SIGKILL
        os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))
    stop.exit_if_terminated()


def agent_of(role: str, names: Sequence[str]) -> Build:
    """Return a function that makes a role's agent for drones or clusters; `names` may contain patterns (`drone*`)."""
    agent_class(role)  # imports the role's modules before connecting to the world

    def build(info: Info, scenario: Scenario) -> Agent:
        selected = chosen(f"{role}: {AGENTS[role].about}", names, things(role, scenario))
        agents = make_agents(role, info, scenario, selected)
        return agents[0] if len(agents) == 1 else AgentGroup(agents, output_hold_ns(info))

    return build


def host(names: Sequence[str]) -> Build:
    return lambda info, scenario: hosted(info, scenario, names)


def recorder(out: Path, reach: WorldAccess) -> None:
    """Record a world's run into a folder, whose name may contain RUN_ID; raise RecordError if that fails."""
    from zsim.output_folder import RECORD
    from zsim.record.completeness import record_completeness
    from zsim_agents.recorder import Recorder

    launched, identity = reach.launched, reach.who._replace(process=RECORDER)
    stop = StopChannel(launched, identity)
    say = log_printer(launched)
    make_folder(out.parent if RUN_ID in out.name else out)
    connection = find_world(reach.endpoint, reach.federation, reach.wait_s, say, stop.stopped, True, launched, identity)
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
    """Return the folder of a run's record; raise RecordError if the run id cannot be part of its name."""
    if RUN_ID not in out.name:
        return out
    if not RUN_NAME.fullmatch(run_id):
        allowed = f"must be 1 to 64 of A-Z a-z 0-9 _ -; give --out without {RUN_ID}"
        raise RecordError(f"{out}: run is {run_id[:40]!r}; {allowed}")
    return out.with_name(out.name.replace(RUN_ID, run_id))


def make_folder(folder: Path) -> None:
    with file_fault(folder, "cannot be created", OTHER_OUT, RecordError):
        folder.mkdir(parents=True, exist_ok=True)


def router(
    name: str, endpoint: str, upstream: str, federation: str, mode: Mode, launched: str | None, identity: Identity
) -> None:
    """Run a router on an endpoint until stopped; raise SessionError if the port or a certificate cannot be used."""
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
    """Watches the links of a router, because a client that stops reading would block the world through the router.

    A router does not know the run. It recognizes the processes that the run does not wait for by their join message, or
    by the absence of a token for their session.
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
        """Return the processes that must not lose messages; callable from any thread."""
        joins = self._joins.copy()
        awaited = [Awaited((name,), 0) for name in self._tokens.shown() if name not in joins]
        for name, join in joins.items():
            if (join.period_ns > 0 or join.slack_ns > 0) and self._tokens.is_alive(name):
                awaited.append(Awaited((name, *join.serves), join.pid))
        return awaited

    def report(self) -> None:
        while self.watch.closed:
            closed = self.watch.closed.popleft()
            names = ", ".join(closed.names) or "no process of the run"
            backlog = f"read none of {closed.held_bytes / 1e6:.1f} MB; its link is closed ({closed.times} times so far)"
            self._say(f"{closed.process or 'an unnamed client'} at {closed.address} ({names}) {backlog}")


def serve_runs(
    name: str,
    serve: Serve,
    reach: WorldAccess,
    stands_for: StandsFor = lambda info: (),
    slack_ns: SlackNs = lambda info: 0,
    remain: Remain | None = None,
) -> None:
    """Serve the runs of the world on an endpoint, one after another, until stopped; a launched process serves only one.

    Args:
        name: name of the process; `role.*`: the role with the first free number, or the next if that is taken over.
        stands_for: returns the names of the processes that this one replaces in a run.
        slack_ns: returns how far the world of a run may be ahead of this process; 0 if the world does not wait for it.
        remain: called after the run, if the process was launched.

    Raises:
        NoWorldError: no world was found within `wait_s` of the start.
        SupersededError: another process has taken over the given name.
        SystemExit: the process was launched, and was ended by a SIGTERM that did not come from its launcher.
    """
    launched, wait_s = reach.launched, reach.wait_s
    identity = reach.who._replace(process="" if name.endswith(ANY) else name)
    stop = StopChannel(launched, identity)
    say = log_printer(launched)
    role, _, thing = name.partition(".")
    own_name, served_run_id = name, ""
    try:
        while not stop.stopped():
            with find_world(reach.endpoint, reach.federation, wait_s, say, stop.stopped, True, launched, identity) as (
                link,
                info,
            ):
                if info.run_id != served_run_id:
                    if own_name == f"{role}.{ANY}":
                        taken_tokens = link.tokens(keys.token(f"{role}.$*"))
                        own_name = next(
                            candidate for i in count(1) if keys.token(candidate := f"{role}.{i}") not in taken_tokens
                        )
                    participant = Participant(link, info, own_name, stands_for(info), slack_ns(info))
                    try:
                        _serve(serve, link, participant, info, stop, say)
                        served_run_id = info.run_id
                    except NoWorldError as error:  # the world ended while this process was joining
                        if launched:
                            raise
                        say(str(error))
                    if participant.superseded and thing != ANY:
                        raise SupersededError(f"{name}: {participant.end_reason}; this process ends")
                    if participant.superseded:  # two processes may have chosen the same free number
                        own_name, served_run_id = f"{role}.{int(participant.name.rpartition('.')[2]) + 1}", ""
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


def _serve(serve: Serve, link: Session, participant: Participant, info: Info, stop: StopChannel, say: Say) -> None:
    name = participant.name
    if not participant.gates:
        participant.announce()
    say(f"{name}: in run {info.run_id}")
    try:
        serve(link, info, participant, stop.stopped, say)
    except ZsimError as error:
        participant.leave(str(error).removeprefix(f"{name}: "))  # otherwise the world would report this process dead
        raise
    reason = participant.end_reason or stop.reason() or "stopped"
    participant.leave(reason)
    say(f"{name}: left, {reason}")


def serve_pictures(
    role: str, drones: Sequence[str], name: str, reach: WorldAccess, diameter_m: float | None = None
) -> None:
    """Serve one run after another as the camera or detector of drones, given by name or pattern.

    `diameter_m`: diameter of the hats that a detector looks for; None: the scenario's. A detector's images may come
    from outside zsim. Raises RunError if a run has no such drone.
    """

    def drones_of(scenario: Scenario) -> list[str]:
        with_cameras = [drone.name for drone in scenario.drones if drone.sensors.cameras()]
        if role == "camera":
            return chosen("camera: drone with a camera", drones or ["*"], with_cameras)
        all_drones = [drone.name for drone in scenario.drones]
        return chosen("detect: drone", drones, all_drones) if drones else watched_drones("", scenario) or all_drones

    def serve(link: Session, info: Info, participant: Participant, stopped: Stopped, say: Say) -> None:
        from zsim_agents.cameras.camera_process import CameraProcess, DetectorProcess

        scenario = scenario_file.from_text(info.scenario)
        drones_served = drones_of(scenario)
        if role == "camera":
            say(f"{participant.name}: renders the cameras of {', '.join(drones_served)}")
            CameraProcess(link, info, participant, scenario, drones_served).run(stopped)
        else:
            say(f"{participant.name}: looks for hats in the images of {', '.join(drones_served)}")
            hats = scenario.environment.hats
            diameter = diameter_m or (Hats() if hats is UNSET else hats).diameter_m
            DetectorProcess(link, participant, say, drones_served, diameter).run(stopped)

    def stands_for(info: Info) -> tuple[str, ...]:
        return tuple(f"{role}.{drone}" for drone in drones_of(scenario_file.from_text(info.scenario)))

    def slack_ns(info: Info) -> int:
        """Return how far the world may be ahead; 0 if it does not wait for this process, as in a replay."""
        gates = not info.replay_of and scenario_file.from_text(info.scenario).gates(role)
        return SLACK_GATES * info.gate_ns if gates else 0

    lower_priority()
    thing = process_of(role, drones).partition(".")[2] or "main"
    serve_runs(process_name(role, name, reach.who, thing), serve, reach, stands_for, slack_ns)


def process_of(role: str, names: Sequence[str]) -> str:
    """Return the process name of a role for one drone or cluster; empty for several, or for a pattern."""
    return f"{role}.{names[0]}" if len(names) == 1 and not set(names[0]) & set(PATTERN) else ""


def process_name(role: str, name: str, identity: Identity, thing: str = "main") -> str:
    """Return the name of a process: `name` if given, else the one in its certificate, else ROLE.THING.

    Raises SessionError if the certificate cannot be used.
    """
    if name or identity.tls is None:
        return name or f"{role}.{thing}"
    if fault := tls.own_fault(identity):
        raise SessionError(fault)
    return tls.own_name(identity)


def check_certificate(member: Agent, identity: Identity) -> None:
    """Raise RunError if the certificate does not cover all messages of an agent; the rest would be lost silently."""
    if not identity.tls:
        return
    if member.serves:
        replaced = ", ".join(member.serves)
        raise RunError(
            f"{member.name}: a certificate is for one process, but this one also replaces {replaced}; "
            "run each of them separately, or without TLS"
        )
    if fault := tls.own_fault(identity._replace(process=member.name)):
        raise RunError(fault)
