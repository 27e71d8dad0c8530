"""One process of a run on another host, over ssh: started, watched, stopped, its output kept in a file here.

The process has our end of the ssh channel as standard input. It ends when that closes, which sshd does when the
launcher dies; and when nothing came on it for ORPHAN_S, as when the launcher's host is gone (roles/stop_channel.py).
"""

import asyncio
import contextlib
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import asyncssh

from zsim.errors import HostsError
from zsim_deploy.hosts.host_link import EventLoopThread, HostLink, shell_line
from zsim_deploy.launch.role_launcher import SINGLE_THREADED
from zsim_deploy.launch.supervisor import end_text

BEAT_S = 1.0  # how often the launcher shows that it lives
ORPHAN_S = 60.0  # without a beat a process ends itself; a link may be cut for shorter than that
LEND_S = 60.0  # how long its files may take to reach the host again; as long as a link may be cut
KILL_S = 5.0  # how long a kill may take to reach the host: a few round trips
LOST = -1000  # code of a process whose end is not known
PID = "zsim-pid "  # begins the line with its process id; a login shell may print something before


class RemoteProcess:
    """A role on another host.

    `on_line` takes every line of its standard output; None sends that to the log too. `files`: what it needs below a
    folder and takes away when it ends; brought again whenever it is started again.
    """

    is_program = False

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        link: HostLink,
        loop: EventLoopThread,
        log: "ProcessLog",
        on_line: Callable[[str], None] | None = None,
        files: tuple[str, Mapping[str, bytes]] = ("", {}),
    ) -> None:
        self.name = name
        self.role = name.split(".", 1)[0]
        self.host = link.name
        self.restarts = 0
        self.pid = 0
        self._command = command
        self._link = link
        self._loop = loop
        self._log = log
        self._on_line = on_line
        self._folder, self._files = files
        self._starts = 0
        self._process: asyncssh.SSHClientProcess[str] | None = None
        self._life: Future[None] | None = None
        self.code: int | None = None  # exit code, None while it lives or is on its way; negative for a signal
        self._fault = ""
        self._ended = threading.Event()
        self._stop: str | None = None

    @property
    def state(self) -> str:
        if self.code is not None:
            return "ended"
        return "running" if self.pid else "starting"

    def start(self) -> None:
        """Start it, or start it again; returns at once."""
        self._starts += 1
        self.pid, self.code, self._process, self._stop, self._fault = 0, None, None, None, ""
        self._ended.clear()
        self._life = self._loop.spawn(self._live())

    async def _live(self) -> None:
        """Run the process to its end, and note how it ended in every case."""
        code = LOST
        try:
            code = await self._run()
        except (asyncssh.Error, OSError, HostsError) as error:
            self._fault = f"the connection to {self.host} broke ({error})"
        except Exception as error:
            self._fault = f"the launcher could not follow it ({error!r})"
        finally:
            if self._fault:
                self._log.write(f"{self._fault}\n")
            self.code = code
            self._ended.set()

    async def _run(self) -> int:
        async def beat(process: "asyncssh.SSHClientProcess[str]") -> None:
            with contextlib.suppress(OSError, asyncssh.Error):
                while True:
                    await asyncio.sleep(BEAT_S)
                    process.stdin.write("beat\n")

        async def read(stream: Any, on_line: Callable[[str], None]) -> None:
            async for line in stream:
                on_line(line)

        if self._starts > 1 and self._files:
            await self._link.put_files(self._folder, self._files, LEND_S, retry=True)
        settings = " ".join(f"{name}={value}" for name, value in SINGLE_THREADED.items())
        command = f"echo {PID}$$; exec env {settings} {shell_line(self._command)}"
        async with (
            self._link.channel(retry=True) as connection,
            connection.create_process(command, encoding="utf-8", errors="replace") as process,
        ):
            async for line in process.stdout:
                if line.startswith(PID):
                    self.pid = int(line.removeprefix(PID))
                    break
            self._process = process
            process.stdin.write(f"orphan-after {ORPHAN_S:g}\n")
            if self._stop is not None:
                self._send(f"stop {self._stop}\n")
            beats = asyncio.create_task(beat(process))
            try:
                log = self._log.write
                await asyncio.gather(read(process.stdout, self._on_line or log), read(process.stderr, log))
                done = await process.wait()
            finally:
                beats.cancel()
            if done.exit_signal:
                return -int(getattr(signal, f"SIG{done.exit_signal[0]}", signal.SIGKILL))
            return done.exit_status if done.exit_status is not None else LOST

    def outcome(self) -> str:
        if self.code == LOST:
            return self._fault or f"the connection to {self.host} broke"
        return end_text(self.code, self.last_log_line())

    def last_log_line(self) -> str:
        return self._log.last

    def request_stop(self, reason: str) -> None:
        """Ask it to leave; harmless when it is gone, remembered when it is still on its way."""
        self._stop = reason
        self._loop.call_soon(self._send, f"stop {reason}\n")

    def _send(self, line: str) -> None:
        if self._process is not None:
            with contextlib.suppress(OSError, asyncssh.Error):
                self._process.stdin.write(line)

    def wait(self, timeout_s: float) -> bool:
        return self._ended.wait(max(0.0, timeout_s))

    def kill(self) -> None:
        """Send SIGKILL, as to one that hangs, or stop trying to start it; returns at once."""
        if self.code is not None or self._life is None:
            return
        if not self.pid:
            self._life.cancel()
            return

        async def kill(command: str) -> None:
            with contextlib.suppress(HostsError):
                await self._link.run(command, timeout_s=KILL_S)

        self._loop.spawn(kill(f"kill -9 {self.pid}"))

    def close(self) -> None:
        """End it in any case; one that cannot be reached ends by itself."""
        if self._life is not None:
            self.kill()
            self._ended.wait(KILL_S)


class ProcessLog:
    """The log file of a process; where it cannot be written, `say` is told once, and only the last line is kept."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self.last = ""  # line that is not empty
        self._path = path
        self._say = say
        self._is_whole = True

    def write(self, line: str) -> None:
        self.last = line.strip() or self.last
        try:
            with self._path.open("a", errors="replace") as file:
                file.write(line)
        except OSError as error:
            if self._is_whole:
                self._is_whole = False
                self._say(f"{self._path}: cannot be written ({error.strerror}); what it would have there is lost")
