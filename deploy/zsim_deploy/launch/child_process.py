"""One process of a run on this host: started, watched, stopped, its output kept in a log."""

import subprocess
import threading
from collections.abc import Callable
from pathlib import Path

from zsim_deploy.launch.role_launcher import RoleLauncher, RoleProcess


class ChildProcess:
    """A role as a child process.

    Args:
        name: process name `role.thing`.
        arguments: of the `zsim` command.
        logs: folder for its standard error.
        launcher: where it is started.
        on_line: takes every line of its standard output; None sends that to the log too.
    """

    def __init__(
        self,
        name: str,
        arguments: list[str],
        logs: Path,
        launcher: RoleLauncher,
        on_line: Callable[[str], None] | None = None,
    ) -> None:
        self.name = name
        self.role = name.split(".", 1)[0]
        self.restarts = 0
        self._arguments = arguments
        self._log = logs / f"{name}.log"
        self._launcher = launcher
        self._on_line = on_line
        self._reader: threading.Thread | None = None
        self._process: RoleProcess | None = None

    def start(self) -> None:
        """Start it, or start it again."""
        with self._log.open("a") as log:
            self._process = self._launcher.start(self._arguments, log, listened=self._on_line is not None)
        if self._on_line:
            self._reader = threading.Thread(target=self._read, args=(self._process, self._on_line), daemon=True)
            self._reader.start()

    @staticmethod
    def _read(process: RoleProcess, on_line: Callable[[str], None]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            on_line(line)

    @property
    def pid(self) -> int:
        return self._process.pid if self._process else 0

    @property
    def code(self) -> int | None:
        """Return its exit code, None while it lives; negative for a signal."""
        return self._process.poll() if self._process else None

    def outcome(self) -> str:
        """Return how it ended, as text."""
        code = self.code
        if code is not None and code < 0:
            return f"killed by signal {-code}"
        last = self.last_log_line()
        return f"exit code {code}" + (f": {last}" if last else "")

    def last_log_line(self) -> str:
        """Return the last line that it wrote to its log."""
        try:
            lines = self._log.read_text(errors="replace").strip().splitlines()
        except OSError:
            return ""
        return lines[-1] if lines else ""

    def request_stop(self, reason: str) -> None:
        """Ask it to leave; harmless when it is gone."""
        if self._process is None or self._process.stdin is None or self._process.stdin.closed:
            return
        try:
            self._process.stdin.write(f"stop {reason}\n")
            self._process.stdin.flush()
        except OSError:
            return  # it is gone already

    def wait(self, timeout_s: float) -> bool:
        """Wait until it has ended; return whether it has."""
        if self._process is None:
            return True
        try:
            self._process.wait(timeout=max(0.0, timeout_s))
        except subprocess.TimeoutExpired:
            return False
        if self._reader is not None:
            self._reader.join(timeout=1.0)
        return True

    def kill(self) -> None:
        """Send SIGKILL, as to one that hangs."""
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """End it whatever it does, and give its pipes back."""
        if self._process is None:
            return
        self.kill()
        self._process.wait()
        if self._reader is not None:
            self._reader.join(timeout=1.0)
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:
                    continue
