"""The roles as processes: what `zsim world`, `estimator`, `controller`, `record` and `router` do."""

import gc
import os
import signal
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from zsim.contract import messages
from zsim.errors import RecordError, RunError, SessionError
from zsim.runtime.agent import Agent
from zsim.runtime.progress import QUIET, HoldReasons, JsonProgress, ProgressSink, Screen, Throttle
from zsim.runtime.runner import Runner
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.transport import session, tls
from zsim.transport.connection import find_world
from zsim.transport.tls import Identity
from zsim_agents.hosting import chosen, hosted
from zsim_deploy.options.reach import Reach
from zsim_deploy.roles.priority import give_way
from zsim_deploy.roles.stop_channel import Leash
from zsim_deploy.security.key_lease import lent

TICK_S = 0.1  # how often a router looks for a stop
PROBE_S = 1.0  # how often a router that reaches nobody upstream asks why
PATIENCE_S = 2.0  # a compiled kernel is loaded within a second, unless the machine is busy
SHOWN_EVENTS = 2000  # events told per run besides those below; all of them are in the record
HEALTH_PERIOD_S = 0.5  # of one process; contract: 1 Hz, but anybody can publish more
VITAL = frozenset({"death", "doubled", "end"})  # how a run ends, and why; and what is wrong with who takes part


def world(
    scenario: Scenario,
    mode: str,
    rate: float,
    endpoints: list[str],
    launched: str | None,
    expect: list[str] | None,
    identity: Identity,
) -> None:
    """Run the world of a scenario on the endpoints until the scenario ends or somebody stops it."""
    from zsim_world.flight.world import World
    from zsim_world.server.world_process import run

    leash = Leash(launched is not None, lent(identity, launched))
    with _patience(JsonProgress() if launched else None):
        run_world = World(scenario, mode, rate, time.monotonic_ns, launched)
    for name in expect or ():
        run_world.barrier.expect(name)
    gc.collect()
    gc.freeze()
    if launched:
        run(run_world, endpoints, leash.reason, told(JsonProgress()), identity=identity)
        leash.account()
        return
    with Screen(scenario.duration_s) as screen:
        listening = f"world of {scenario.federation!r} on {', '.join(endpoints)}; Ctrl-C ends the run"
        run(run_world, endpoints, leash.reason, told(screen), lambda: screen.say(listening), identity)
        screen.say(f"ended: {run_world.ended}")


@contextmanager
def _patience(teller: JsonProgress | None) -> Iterator[None]:
    """Say what takes so long the first time that a machine runs the world."""
    from zsim.math.compiled import is_kept
    from zsim_world.fleet.kernel import advance

    text = "compiling the world's kernel; later runs on this machine find it compiled"
    if is_kept(advance):
        text = "loading the world's kernel; this machine is busy"
    timer = threading.Timer(PATIENCE_S, teller.say if teller else print, args=(text,))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def told(show: ProgressSink) -> Callable[[str, Any, str], None]:
    """Return what the world calls with its clocks, its events, and what passes it."""
    throttle, reasons = Throttle(), HoldReasons()
    told = [0]
    healths: defaultdict[str, Throttle] = defaultdict(lambda: Throttle(HEALTH_PERIOD_S))

    def tell(kind: str, message: Any, about: str) -> None:
        if kind == "clock" and (throttle.passes() or message.state == "stopped"):
            show.clock(_clock_line(message, about))
        elif kind == "state" and (line := reasons.line(about, message)):
            show.say(line)
        elif kind == "health" and healths[about].passes():
            show.health({"name": about, "lag_ns": message.lag_ns, "received": message.received})
        elif kind == "event" and (message.kind in VITAL or told[0] < SHOWN_EVENTS):
            told[0] += message.kind not in QUIET
            show.event(_event_line(message))

    return tell


def _clock_line(clock: messages.Clock, phase: str) -> dict[str, Any]:
    waiting = [{"name": w.name, "host": w.host, "since_wall_s": round(w.since_wall_s, 1)} for w in clock.waiting_for]
    return {
        "t_s": clock.t_ns / 1e9,
        "rate": clock.rate,
        "state": clock.state,
        "phase": phase,
        "waiting_for": waiting,
    }


def _event_line(event: messages.Event) -> dict[str, Any]:
    data = event.data if event.kind in ("end", "death") else {}
    return {
        "t_s": event.t_ns / 1e9,
        "kind": event.kind,
        "subject": event.subject,
        "text": event.text,
        "data": data,
    }


def agent(build: Callable[[messages.Info, Scenario], Agent], reach: Reach) -> None:
    """Run one agent against a world."""
    launched, who = reach.launched, reach.who
    leash = Leash(launched is not None, lent(who, launched))
    say = speaker(launched is not None)
    found = find_world(reach.endpoint, reach.federation, reach.wait_s, say, leash.pulled, run_id=launched, identity=who)
    with found as (link, info):
        made = build(info, scenario_file.from_text(info.scenario))
        check_certificate(made, who)
        say(f"{made.name}: in run {info.run_id}{_also(made)}")
        gc.collect()
        gc.freeze()
        runner = Runner(link, info, made, leash.pulled, say, leash.deserted)
        reason = runner.run()
    say(f"{made.name}: left, {reason}")
    if runner.killed:
        _die()
    leash.account()


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


def recorder(path: Path, reach: Reach) -> None:
    """Record the run of a world into a file."""
    from zsim_agents.recorder import record

    give_way()
    launched, who = reach.launched, reach.who
    leash = Leash(launched is not None, lent(who, launched))
    say = speaker(launched is not None)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{path.parent}: cannot be made ({error.strerror}); give --out another folder") from error
    found = find_world(reach.endpoint, reach.federation, reach.wait_s, say, leash.pulled, True, launched, who)
    with found as (link, info):
        say(f"recorder: run {info.run_id} into {path}")
        reason = record(link, info, path, stopped=leash.pulled, say=say)
    say(f"recorder: {path} is complete, {reason}")
    leash.account()


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
    leash = Leash(launched is not None, lent(identity, launched))
    say = speaker(launched is not None)
    with session.route(endpoint, upstream, federation, mode, identity) as link:
        say(f"router.{name}: {endpoint} leads to {upstream}")
        probe_s = 0.0
        while not leash.pulled():
            if time.monotonic() >= probe_s and not link.links():
                _refuse(tls.peer_fault(identity, upstream), upstream)
                probe_s = time.monotonic() + PROBE_S
            time.sleep(TICK_S)
    say(f"router.{name}: left, {leash.reason()}")
    leash.account()


def _refuse(fault: str | None, upstream: str) -> None:
    if fault:
        raise SessionError(f"cannot connect to {upstream}: {fault}")


def speaker(launched: bool) -> Callable[[str], None]:
    """Return how a role speaks to a person: plain lines on standard error, which a launcher keeps as its log."""

    def say(text: str) -> None:
        if launched:
            text = f"{time.strftime('%H:%M:%S')} {text}"
        print(text, file=sys.stderr, flush=True)

    return say
