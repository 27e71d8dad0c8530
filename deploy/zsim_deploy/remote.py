"""One process of a run on another host, over ssh: started, watched, told to stop, its last words kept.

The process has our end of the ssh channel as standard input. It ends when that closes, which sshd does when the
launcher dies; and when it has heard nothing on it for ORPHAN_S, as when the launcher's host is gone (leash.py).
"""

import asyncio
import contextlib
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import asyncssh

from zsim.errors import HostsError
from zsim_deploy import shell
from zsim_deploy.child import SINGLE_THREADED
from zsim_deploy.host_link import HostLink, Loop

BEAT_S = 1.0  # how often the launcher shows that it lives
ORPHAN_S = 60.0  # without a beat a process ends itself; a link may be cut for shorter than that
KILL_S = 2.0  # how long a kill may take to reach the host
LOST = -1000  # code of a process of which nobody knows how it ended


class Remote:
    """A role on another host.

    Args:
        name: process name `role.thing`.
        arguments: of the `zsim` command there.
        link: to the host.
        python: interpreter there that has zsim.
        loop: on which the link lives.
        logs: folder here for what it says.
        on_line: told every line of its standard output; None sends that to the log too.
    """

    def __init__(
        self,
        name: str,
        arguments: list[str],
        link: HostLink,
        python: str,
        loop: Loop,
        logs: Path,
        on_line: Callable[[str], None] | None = None,
    ) -> None:
        self.name = name
        self.role = name.split(".", 1)[0]
        self.host = link.name
        self.restarts = 0
        self.started_s = 0.0
        self.pid = 0
        self._arguments = arguments
        self._link = link
        self._python = python
        self._loop = loop
        self._log = logs / f"{name}.log"
        self._on_line = on_line
        self._process: asyncssh.SSHClientProcess[str] | None = None
        self._code: int | None = None
        self._ended = threading.Event()
        self._stop: str | None = None

    @property
    def code(self) -> int | None:
        """Return its exit code, None while it lives or is on its way; negative for a signal."""
        return self._code

    @property
    def state(self) -> str:
        if self._code is not None:
            return "ended"
        return "running" if self.pid else "starting"

    def start(self) -> None:
        """Start it, or start it again; returns at once."""
        self.pid, self._code, self._process, self._stop = 0, None, None, None
        self._ended.clear()
        self.started_s = time.monotonic()
        self._loop.spawn(self._live())

    async def _live(self) -> None:
        """Run the process to its end, whatever becomes of the link."""
        try:
            code = await self._run()
        except (asyncssh.Error, OSError, HostsError) as error:
            self._write(f"the connection to {self.host} broke: {error}\n")
            code = LOST
        except asyncio.CancelledError:
            self._code = LOST
            self._ended.set()
            raise
        self._code = code
        self._ended.set()

    async def _run(self) -> int:
        connection = await self._link.insist()
        async with connection.create_process(self._command(), encoding="utf-8", errors="replace") as process:
            first = await process.stdout.readline()
            self.pid = int(first) if first.strip().isdigit() else 0
            self._process = process
            process.stdin.write(f"orphan-after {ORPHAN_S:g}\n")
            if self._stop is not None:
                self._send(f"stop {self._stop}\n")
            beats = asyncio.create_task(self._beat(process))
            try:
                await asyncio.gather(self._read_lines(process.stdout, self._on_line), self._read_lines(process.stderr))
                done = await process.wait()
            finally:
                beats.cancel()
            return _code(done)

    def _command(self) -> str:
        words = [self._python, "-m", "zsim_deploy.cli", *self._arguments]
        settings = " ".join(f"{name}={value}" for name, value in SINGLE_THREADED.items())
        return f"echo $$; exec env {settings} {shell.line(words)}"

    async def _read_lines(self, stream: Any, on_line: Callable[[str], None] | None = None) -> None:
        async for line in stream:
            if on_line:
                on_line(line)
            else:
                self._write(line)

    def _write(self, line: str) -> None:
        with self._log.open("a", errors="replace") as log:
            log.write(line)

    @staticmethod
    async def _beat(process: "asyncssh.SSHClientProcess[str]") -> None:
        with contextlib.suppress(OSError, asyncssh.Error):
            while True:
                await asyncio.sleep(BEAT_S)
                process.stdin.write("beat\n")

    def outcome(self) -> str:
        """Say in words how it ended."""
        code = self._code
        if code == LOST:
            return f"the connection to {self.host} broke"
        if code is not None and code < 0:
            return f"killed by signal {-code}"
        last = self.last_words()
        return f"exit code {code}" + (f": {last}" if last else "")

    def last_words(self) -> str:
        """Return the last line that it wrote to its log."""
        try:
            lines = self._log.read_text(errors="replace").strip().splitlines()
        except OSError:
            return ""
        return lines[-1] if lines else ""

    def tell_stop(self, reason: str) -> None:
        """Ask it to leave; harmless when it is gone, remembered when it is still on its way."""
        self._stop = reason
        self._loop.tell(self._send, f"stop {reason}\n")

    def _send(self, line: str) -> None:
        if self._process is not None:
            with contextlib.suppress(OSError, asyncssh.Error):
                self._process.stdin.write(line)

    def wait(self, timeout_s: float) -> bool:
        """Wait until it has ended; return whether it has."""
        return self._ended.wait(max(0.0, timeout_s))

    def close(self) -> None:
        """End it whatever it does; one that cannot be reached ends by itself."""
        if self._code is None and self.pid:
            with contextlib.suppress(TimeoutError, HostsError):
                self._loop.call(self._link.run(f"kill -9 {self.pid}", timeout_s=KILL_S), KILL_S + 1.0)
            self._ended.wait(KILL_S)

    def kill(self) -> None:
        """Send SIGKILL, as to one that hangs; what `on_death` says follows."""
        if self.pid:
            self._loop.call(self._link.run(f"kill -9 {self.pid}", timeout_s=KILL_S), KILL_S + 1.0)


def _code(done: asyncssh.SSHCompletedProcess) -> int:
    if done.exit_signal:
        return -int(getattr(signal, f"SIG{done.exit_signal[0]}", signal.SIGKILL))
    return done.exit_status if done.exit_status is not None else LOST
