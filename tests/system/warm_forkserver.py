"""The fork server of `zsim run`, for tests: runs forked by it fork their own fork server as well.

python warm_forkserver.py     standard input and arguments as for zsim_deploy.cli.forkserver

It has already imported and loaded what a run's fork server needs, which is half of the processor time of a short run.
A world whose time stands still publishes its clock more often than the contract requires, since tests wait for it.
Processes started by a test end with the process that runs the test, even if that is killed; processes started by a
run under test do not.
"""

import ctypes
import os
import signal
import socket
import sys
import traceback
from contextlib import suppress
from typing import NoReturn

import zsim_bridges.console.console_server
import zsim_bridges.gateway.gateway_server  # noqa: F401  (modules that the bridges import)
from zsim_deploy.cli import forkserver
from zsim_deploy.launch import role_launcher
from zsim_world.server import world_process

STANDING_NS = 100_000_000  # ns, instead of 1 s
FILES_MAX = 256  # more files than a launcher has open before it starts a role
RENEW_STREAMS, RUN_ROLE = forkserver.renew_streams, forkserver._run_role


class ForkedServer:
    """A fork server forked by this process, with the interface of `subprocess.Popen`."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> None:
        with suppress(ChildProcessError):
            os.waitpid(self.pid, 0)


def start(self: role_launcher.RoleLauncher) -> None:
    """Do what `RoleLauncher._start_forkserver` does, by a fork instead of a new program."""
    self._line, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with other:
        pid = os.fork()
        if not pid:
            serve(other.fileno(), self._run)
    self._forkserver = ForkedServer(pid)  # type: ignore[assignment]
    self._receive()


def serve(line: int, run: str) -> NoReturn:
    """Run a fork server, or a role that it has forked, until this process ends."""
    code: object = 1
    try:
        os.setsid()
        os.dup2(line, 0)
        for number in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        os.closerange(3, FILES_MAX)
        sys.argv = ["forkserver", run]
        forkserver._prepare = lambda: None  # it is prepared already
        forkserver.renew_streams = RENEW_STREAMS
        forkserver.main()
        code = None
    except BaseException:
        traceback.print_exc()
    finally:
        forkserver.finish(code)  # without returning to the launcher that was forked


def end_with_parent() -> None:
    """Start a role that is killed when the process that runs the test ends."""
    ctypes.CDLL(None).prctl(forkserver.PR_SET_PDEATHSIG, signal.SIGKILL)
    RENEW_STREAMS()


def run_role(arguments: list[str], files: list[int]) -> NoReturn:
    """Run a role with the variables NAME=VALUE that precede its arguments; PWD is its working folder."""
    while "=" in arguments[0]:
        name, _, value = arguments.pop(0).partition("=")
        os.environ[name] = value
        if name == "PWD":
            os.chdir(value)
        if name == "PYTHONPATH":
            sys.path[:0] = value.split(os.pathsep)
    RUN_ROLE(arguments, files)


if __name__ == "__main__":
    forkserver._run_role = run_role
    forkserver.renew_streams = end_with_parent
    role_launcher.RoleLauncher._start_forkserver = start
    world_process.IDLE_CLOCK_PERIOD_NS = STANDING_NS
    forkserver.main()
