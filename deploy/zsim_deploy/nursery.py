"""Where the roles of a run come from: forked from one process that has everything imported, which is far cheaper.

Roles are children of this process either way. Only Linux can do it; elsewhere, and if that process is gone, a role is
started as any other program.
"""

import ctypes
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import IO, Protocol

SINGLE_THREADED = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}  # matrices of a dozen rows: threads only cost, and would compete with the other roles
ROOM = " " * 4096  # behind the cradle's command line: each role writes its own there
PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
SAID_MAX = 32  # bytes, of what a cradle says: that it is ready, and then process numbers
POLL_S = 0.01  # how often one looks whether a process has ended
PATIENCE_S = 3.0  # what is compiled is loaded within two, unless the machine is busy
PATIENCE = "loading what is compiled, or compiling it: once on a machine, that takes a minute"
COMMAND = [sys.executable, "-m", "zsim_deploy.cli"]


class Process(Protocol):
    """A role that was started, as of `subprocess.Popen`."""

    pid: int
    stdin: IO[str] | None
    stdout: IO[str] | None

    def poll(self) -> int | None: ...
    def wait(self, timeout: float | None = None) -> int: ...
    def kill(self) -> None: ...


class Nursery:
    """Starts roles.

    Args:
        say: told what takes long.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._cradle: subprocess.Popen[bytes] | None = None
        self._line: socket.socket | None = None
        self._lock = threading.Lock()

    def __enter__(self) -> "Nursery":
        if _inherits(True):
            self._line, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with other:
                self._cradle = _cradle(other.fileno())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._give_up()
        if self._cradle is not None:
            self._cradle.kill()  # it may still be importing
            self._cradle.wait()
        _inherits(False)

    def await_ready(self) -> None:
        """Wait until roles can be started at once."""
        if self._line is None:
            return
        timer = threading.Timer(PATIENCE_S, self._say, args=(PATIENCE,))
        timer.start()
        try:
            self._heard()
        finally:
            timer.cancel()

    def start(self, arguments: Sequence[str], log: IO[str], listened: bool) -> Process:
        """Start a `zsim` command, its standard input a pipe.

        Args:
            arguments: of the command.
            log: for what it prints on standard error.
            listened: whether its standard output is a pipe too; else that goes to the log.
        """
        with self._lock:
            return self._forked(arguments, log, listened) or _started(arguments, log, listened)

    def _forked(self, arguments: Sequence[str], log: IO[str], listened: bool) -> "Forked | None":
        """Return None where there is no cradle."""
        if self._line is None:
            return None
        theirs, stdin = os.pipe()
        stdout, output = os.pipe() if listened else (None, os.dup(log.fileno()))
        with open(theirs), open(output, "w"), ExitStack() as ours:
            pipes = ours.enter_context(open(stdin, "w")), ours.enter_context(open(stdout)) if stdout else None
            with suppress(OSError):
                socket.send_fds(self._line, [json.dumps(list(arguments)).encode()], [theirs, output, log.fileno()])
            pid = self._heard()
            if pid:
                ours.pop_all()
            return Forked(int(pid), *pipes) if pid else None

    def _heard(self) -> bytes:
        """Return what the cradle says; nothing where it is gone, and then it is asked no more."""
        heard = b""
        if self._line is not None:
            with suppress(OSError):
                heard = self._line.recv(SAID_MAX)
        if not heard:
            self._give_up()
        return heard

    def _give_up(self) -> None:
        if self._line is not None:
            self._line.close()
            self._line = None


class Forked:
    """A role that a cradle has forked for this process.

    Attributes:
        pid: its process number.
        stdin, stdout: the other ends of its pipes.
    """

    def __init__(self, pid: int, stdin: IO[str], stdout: IO[str] | None) -> None:
        self.pid = pid
        self.stdin: IO[str] | None = stdin
        self.stdout = stdout
        self._code: int | None = None
        self._lock = threading.Lock()

    def poll(self) -> int | None:
        """Return its exit code, negative for a signal; None while it lives."""
        with self._lock:
            if self._code is None:
                found, status = os.waitpid(self.pid, os.WNOHANG)
                if found:
                    self._code = os.waitstatus_to_exitcode(status)
            return self._code

    def wait(self, timeout: float | None = None) -> int:
        """Return its exit code when it has ended.

        Raises:
            subprocess.TimeoutExpired: it has not, within so many seconds.
        """
        until_s = math.inf if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() >= until_s:
                raise subprocess.TimeoutExpired(COMMAND, timeout or 0.0)
            time.sleep(POLL_S)
        return code

    def kill(self) -> None:
        """Send SIGKILL; harmless when it is gone."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)


def _inherits(wanted: bool) -> bool:
    """Become, or be no more, the parent of what descendants leave behind; return whether that is so."""
    return sys.platform == "linux" and ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, int(wanted), 0, 0, 0) == 0


def _cradle(line: int) -> "subprocess.Popen[bytes]":
    quiet = subprocess.DEVNULL
    environment = {**SINGLE_THREADED, **os.environ}
    command = [sys.executable, "-m", "zsim_deploy.cradle", ROOM]
    return subprocess.Popen(command, stdin=line, stdout=quiet, stderr=quiet, env=environment, start_new_session=True)


def _started(arguments: Sequence[str], log: IO[str], listened: bool) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [*COMMAND, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE if listened else log,
        stderr=log,
        text=True,
        env={**SINGLE_THREADED, **os.environ},
        start_new_session=True,
    )
