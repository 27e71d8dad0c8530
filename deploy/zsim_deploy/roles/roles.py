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
from zsim.runtime.runner import Runner
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.transport import session, tls
from zsim.transport.connection import find_world
from zsim.transport.identity import Identity
from zsim_agents.hosting import chosen, hosted
from zsim_deploy.options.arguments import WorldAccess
from zsim_deploy.roles.stop_channel import StopChannel, key_lease

TICK_S = 0.1  # how often a router looks for a stop
PROBE_S = 1.0  # how often a router that reaches nobody upstream asks why


def agent(build: Callable[[messages.Info, Scenario], Agent], reach: WorldAccess) -> None:
    """Run one agent against a world."""
    launched, who = reach.launched, reach.who
    leash = StopChannel(launched is not None, key_lease(who, launched))
    say = log_printer(launched is not None)
    found = find_world(reach.endpoint, reach.federation, reach.wait_s, say, leash.stopped, run_id=launched, identity=who)
    with found as (link, info):
        made = build(info, scenario_file.from_text(info.scenario))
        check_certificate(made, who)
        say(f"{made.name}: in run {info.run_id}{_also(made)}")
        gc.collect()
        gc.freeze()
        runner = Runner(link, info, made, leash.stopped, say, leash.orphaned)
        reason = runner.run()
    say(f"{made.name}: left, {reason}")
    if runner.killed:
        _die()
    leash.exit_if_terminated()


def _die() -> None:
    """End as by kill -9, so that who launched this process sees it die."""
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))  # Windows has no SIGKILL; there this is as hard


def estimator(drones: Sequence[str]) -> Callable[[messages.Info, Scenario], Agent]:
    """Return what builds the estimator of some drones, named or by patterns such as `drone*`."""
    from zsim_agents.estimation.estimator import Estimator

    def build(info: messages.Info, scenario: Scenario) -> Agent:
        known = [drone.name for drone in scenario.drones]
        return Estimator(info, scenario, chosen("estimator: drone", drones, known))

    return build


def host(names: Sequence[str]) -> Callable[[messages.Info, Scenario], Agent]:
    """Return what builds several estimators and controllers as one agent, named or by patterns."""
    return lambda info, scenario: hosted(info, scenario, names)


def check_certificate(made: Agent, identity: Identity) -> None:
    """Refuse to speak for other processes where access control would drop it without a word."""
    if made.serves and identity.tls:
        others = ", ".join(made.serves)
        raise RunError(
            f"{made.name}: a certificate is for one process, and this one stands for {others} too; "
            "run each by itself, or without TLS"
        )


def _also(made: Agent) -> str:
    return f", and stands for {', '.join(made.serves)}" if made.serves else ""


def controller(cluster: str) -> Callable[[messages.Info, Scenario], Agent]:
    from zsim_agents.formation.controller import Controller

    return lambda info, scenario: Controller(info, scenario, cluster)


def recorder(path: Path, reach: WorldAccess) -> None:
    """Record the run of a world into a file."""
    from zsim_agents.recorder import record

    launched, who = reach.launched, reach.who
    leash = StopChannel(launched is not None, key_lease(who, launched))
    say = log_printer(launched is not None)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{path.parent}: cannot be made ({error.strerror}); give --out another folder") from error
    found = find_world(reach.endpoint, reach.federation, reach.wait_s, say, leash.stopped, True, launched, who)
    with found as (link, info):
        say(f"recorder: run {info.run_id} into {path}")
        reason = record(link, info, path, stopped=leash.stopped, say=say)
    say(f"recorder: {path} is complete, {reason}")
    leash.exit_if_terminated()


def router(
    name: str,
    endpoint: str,
    upstream: str,
    federation: str,
    mode: session.Mode,
    launched: str | None,
    identity: Identity,
) -> None:
    """Run a router on an endpoint until it is told to stop.

    Raises:
        SessionError: the port is taken, or a certificate, here or upstream, is refused.
    """
    leash = StopChannel(launched is not None, key_lease(identity, launched))
    say = log_printer(launched is not None)
    with session.route(endpoint, upstream, federation, mode, identity) as link:
        say(f"router.{name}: {endpoint} leads to {upstream}")
        probe_s = 0.0
        while not leash.stopped():
            if time.monotonic() >= probe_s and not link.links():
                _refuse(tls.peer_fault(identity, upstream), upstream)
                probe_s = time.monotonic() + PROBE_S
            time.sleep(TICK_S)
    say(f"router.{name}: left, {leash.reason()}")
    leash.exit_if_terminated()


def _refuse(fault: str | None, upstream: str) -> None:
    if fault:
        raise SessionError(f"cannot connect to {upstream}: {fault}")


def log_printer(launched: bool) -> Callable[[str], None]:
    """Return how a role speaks to a person: plain lines on standard error, which a launcher keeps as its log."""

    def say(text: str) -> None:
        if launched:
            text = f"{time.strftime('%H:%M:%S')} {text}"
        print(text, file=sys.stderr, flush=True)

    return say
