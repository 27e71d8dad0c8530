"""Processes that serve one run after the other, such as the console and the gateway, and their priority."""

import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.errors import NoWorldError, SupersededError
from zsim.transport.connection import find_world
from zsim.transport.session import Session
from zsim_bridges.observer_process import ObserverProcess
from zsim_deploy.arguments import WorldAccess
from zsim_deploy.roles.roles import log_printer
from zsim_deploy.roles.stop_channel import StopChannel

ANY = "*"  # in a name, for a number
PAUSE_S = 0.2  # between two looks at a world whose run has ended and that waits for byes

Stopped = Callable[[], bool]
Say = Callable[[str], None]
Serve = Callable[[Session, Info, ObserverProcess, Stopped, Say], None]
"""Serves one run with (session, info, presence, stopped, say), until its presence is over or it is stopped."""
NICE = 5  # of processes for which no gate waits
NICE_FOR_EYES = 10  # of those that only people look at: a picture may come later, a gate may not
AUTOGROUP = Path("/proc/self/autogroup")  # sched(7)
TRIES = 5
AGAIN_S = 0.12  # the kernel lets ordinary users write there ten times a second, all of them together


def serve_runs(name: str, serve: Serve, reach: WorldAccess) -> None:
    """Serve one run after the other of the world on an endpoint, until it is stopped; launched, only one.

    Args:
        name: of the process; `role.*` for the first number that nobody has, kept until somebody takes it.
        serve: what it does in a run.
        reach: of the world.

    Raises:
        NoWorldError: there was no first world within `wait_s`.
        SupersededError: another process of the name that was given has taken over.
    """
    launched, wait_s, who = reach.launched, reach.wait_s, reach.who
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
                    presence = ObserverProcess(link, info, own_name)
                    _serve(serve, link, presence, info, stop, say)
                    served = info.run_id
                    if presence.superseded:
                        own_name, served = _next(name, presence), ""
                else:
                    time.sleep(PAUSE_S)
            if launched:
                stop.exit_if_terminated()
                return
            wait_s = None
    except NoWorldError:
        if not stop.stopped():
            raise


def process_name(role: str, name: str, tls: Path | None, thing: str = "main") -> str:
    """Return a process's name: as given, or its certificate's, or the role's first."""
    return name or (tls.name if tls else f"{role}.{thing}")


def _free(link: Session, name: str) -> str:
    """Return a name; for `role.*` the first of role.1, role.2, ... that nobody has."""
    role, _, thing = name.partition(".")
    if thing != ANY:
        return name
    taken = link.tokens(keys.token(f"{role}.$*"))
    return next(free for i in count(1) if keys.token(free := f"{role}.{i}") not in taken)


def _next(name: str, presence: ObserverProcess) -> str:
    """Return the name under which to come in again; two that were to choose a number may have chosen the same one.

    Raises:
        SupersededError: the name was given.
    """
    role, _, thing = name.partition(".")
    if thing != ANY:
        raise SupersededError(f"{name}: {presence.end_reason}; this one ends")
    return f"{role}.{int(presence.name.rpartition('.')[2]) + 1}"


def _serve(serve: Serve, link: Session, presence: ObserverProcess, info: Info, stop: StopChannel, say: Say) -> None:
    presence.announce()
    say(f"{presence.name}: in run {info.run_id}")
    serve(link, info, presence, stop.stopped, say)
    reason = presence.end_reason or stop.reason() or "stopped"
    presence.leave(reason)
    say(f"{presence.name}: left, {reason}")


def give_way(for_eyes: bool = False) -> None:
    """Let the world go first. Threads to come, too.

    Args:
        for_eyes: a person alone waits; then it does not interrupt others when it wakes up either (SCHED_BATCH).
    """
    lower(NICE_FOR_EYES if for_eyes else NICE)
    if for_eyes and sys.platform == "linux":
        with suppress(OSError):  # it may be in a class from which one does not come back
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def lower(niceness: int) -> None:
    """Make this process nicer, and with it the session that it leads, if it does.

    Where Linux shares processors between sessions, niceness counts within each of them only.
    """
    if hasattr(os, "nice"):
        os.nice(niceness)
    if sys.platform == "linux" and os.getsid(0) == os.getpid():
        _lower_session(niceness)


def _lower_session(niceness: int) -> None:
    for _ in range(TRIES):
        try:
            AUTOGROUP.write_text(str(niceness))
        except BlockingIOError:
            time.sleep(AGAIN_S)
        except OSError:
            return  # not shared that way here, or not for us to say
        else:
            return
