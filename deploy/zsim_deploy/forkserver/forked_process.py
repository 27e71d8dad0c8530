"""A role that a cradle has forked for this process, with the face of a `subprocess.Popen`."""

import os
import signal
import subprocess
import threading
import time
from contextlib import suppress
from typing import IO

POLL_S = 0.01  # how often one looks whether it has ended
UNKNOWN = 0  # exit code, as of Popen, where somebody else has taken it


class Forked:
    """A child of this process.

    Args:
        pid: its process number.
        stdin, stdout: our ends of its pipes.
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
            return self._poll()

    def _poll(self) -> int | None:
        if self._code is None:
            try:
                found, status = os.waitpid(self.pid, os.WNOHANG)
            except ChildProcessError:
                self._code = UNKNOWN
            else:
                self._code = os.waitstatus_to_exitcode(status) if found else None
        return self._code

    def wait(self, timeout: float | None = None) -> int:
        """Return its exit code when it has ended.

        Raises:
            subprocess.TimeoutExpired: it has not, within so many seconds.
        """
        until_s = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if until_s is not None and time.monotonic() >= until_s:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
            time.sleep(POLL_S)
        return code

    def kill(self) -> None:
        """Send SIGKILL; harmless when it is gone."""
        with self._lock, suppress(ProcessLookupError):
            if self._poll() is None:
                os.kill(self.pid, signal.SIGKILL)
