"""The roles as processes: what `zsim estimator`, `controller`, `host`, `record` and `router` do."""

import gc
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from zsim.contract import messages
from zsim.errors import RecordError, RunError, SessionError
from zsim.runtime.agent import Agent
from zsim.runtime.group import AgentGroup
from zsim.runtime.runner import Runner
from zsim.scenario import scenario_file
from zsim.scenario.role_table import AGENTS, things
from zsim.scenario.scenario import Scenario
from zsim.transport import session, tls
from zsim.transport.connection import find_world
from zsim.transport.tls import Identity
from zsim_agents.hosting import agent_class, chosen, hosted, made
from zsim_deploy.arguments import WorldAccess
from zsim_deploy.roles.stop_channel import StopChannel

TICK_S = 0.1  # how often a router looks for a stop
PROBE_S = 1.0  # how often a router that reaches nobody upstream asks why


def agent(build: Callable[[messages.Info, Scenario], Agent], reach: WorldAccess) -> None:
    """Run one agent against a world."""
    launched, who = reach.launched, reach.who
    stop = StopChannel(launched, who)
    say = log_printer(launched)
    connection = find_world(
        reach.endpoint, reach.federation, reach.wait_s, say, stop.stopped, run_id=launched, identity=who
    )
    with connection as (link, info):
        member = build(info, scenario_file.from_text(info.scenario))
        check_certificate(member, who)
        say(f"{member.name}: in run {info.run_id}{_also(member)}")
        gc.collect()
        gc.freeze()
        runner = Runner(link, info, member, stop.stopped, say, stop.orphaned)
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
        return agents[0] if len(agents) == 1 else AgentGroup(agents)

    return build


def host(names: Sequence[str]) -> Callable[[messages.Info, Scenario], Agent]:
    """Return what builds several estimators and controllers as one agent, named or by patterns."""
    return lambda info, scenario: hosted(info, scenario, names)


def check_certificate(made: Agent, identity: Identity) -> None:
    """Refuse to publish for other processes where access control would drop it without a word."""
    if made.serves and identity.tls:
        others = ", ".join(made.serves)
        raise RunError(
            f"{made.name}: a certificate is for one process, and this one stands for {others} too; "
            "run each by itself, or without TLS"
        )


def _also(made: Agent) -> str:
    return f", and stands for {', '.join(made.serves)}" if made.serves else ""


def recorder(path: Path, reach: WorldAccess) -> None:
    """Record the run of a world into a file."""
    from zsim_agents.recorder import record

    launched, who = reach.launched, reach.who
    stop = StopChannel(launched, who)
    say = log_printer(launched)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{path.parent}: cannot be made ({error.strerror}); give --out another folder") from error
    connection = find_world(reach.endpoint, reach.federation, reach.wait_s, say, stop.stopped, True, launched, who)
    with connection as (link, info):
        say(f"recorder: run {info.run_id} into {path}")
        reason = record(link, info, path, stopped=stop.stopped, say=say)
    say(f"recorder: {path} is complete, {reason}")
    stop.exit_if_terminated()


def router(
    name: str,
    endpoint: str,
    upstream: str,
    federation: str,
    mode: session.Mode,
    launched: str | None,
    identity: Identity,
) -> None:
    """Run a router on an endpoint until it is stopped.

    Raises:
        SessionError: the port is taken, or a certificate, here or upstream, is refused.
    """
    stop = StopChannel(launched, identity)
    say = log_printer(launched)
    with session.route(endpoint, upstream, federation, mode, identity) as link:
        say(f"router.{name}: {endpoint} leads to {upstream}")
        probe_s = 0.0
        while not stop.stopped():
            if time.monotonic() >= probe_s and not link.links():
                _refuse(tls.peer_fault(identity, upstream), upstream)
                probe_s = time.monotonic() + PROBE_S
            time.sleep(TICK_S)
    say(f"router.{name}: left, {stop.reason()}")
    stop.exit_if_terminated()


def _refuse(fault: str | None, upstream: str) -> None:
    if fault:
        raise SessionError(f"cannot connect to {upstream}: {fault}")


def log_printer(launched: str | None) -> Callable[[str], None]:
    """Return what prints a line for people on standard error, which a launcher keeps as the log."""

    def say(text: str) -> None:
        if launched is not None:
            text = f"{time.strftime('%H:%M:%S')} {text}"
        print(text, file=sys.stderr, flush=True)

    return say
