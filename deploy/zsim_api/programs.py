"""Programs that this process starts beside itself, and that never outlive it: `zsim run`, and a user's own.

Each has a keeper (keeper.py) in a session of its own between it and this process. So Ctrl-C in a terminal reaches a
program from here alone, and nothing is left running when this process is killed.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from zsim_api import keeper

PIPE = subprocess.PIPE
GRACE_S = 10.0  # wall time that a program has to end, once it is asked to; `zsim run` ends within 3 s
KEEPER = (sys.executable, "-I", "-S", keeper.__file__)


class Program:
    """A program that has been started.

    Args:
        words: its command line.
        environment: variables that differ from those of this process.
        output: file that takes its output; None for this process's own; PIPE for `lines`.
        folder: in which it runs; None: the current one.
    """

    def __init__(
        self,
        words: Sequence[str],
        environment: Mapping[str, str] | None = None,
        output: Path | int | None = None,
        folder: Path | None = None,
    ) -> None:
        self.words = tuple(words)
        self.asked = False  # whether it has been asked to end from here
        self._lock = threading.Lock()
        environment = {**os.environ, **(environment or {})}
        if output is not None:
            environment.pop("FORCE_COLOR", None)  # which a notebook's kernel sets: neither of them is a terminal
        with open(output if isinstance(output, Path) else os.devnull, "ab") as log:
            goes_to = log if isinstance(output, Path) else output
            self._keeper = subprocess.Popen(
                [*KEEPER, str(GRACE_S), *words],
                stdin=subprocess.PIPE,
                stdout=goes_to,
                stderr=subprocess.STDOUT if goes_to == PIPE else goes_to,
                env=environment,
                cwd=folder,
                start_new_session=True,
            )

    @property
    def code(self) -> int | None:
        """Its exit code, None while it runs; 128 + N for a signal, 127 where it could not be started."""
        return self._keeper.poll()

    def lines(self) -> Iterator[str]:
        """Yield the lines of its output until there are no more; may be called again after an interrupt."""
        assert self._keeper.stdout is not None
        for line in self._keeper.stdout:
            yield line.decode(errors="replace")

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for its end, and that of all that it has started; return its exit code, None if it runs still."""
        with suppress(subprocess.TimeoutExpired):
            return self._keeper.wait(timeout_s)
        return None

    def interrupt(self) -> None:
        """Send it what Ctrl-C sends."""
        self._keeper.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """Kill it, and all that it has started, at once."""
        self._keeper.send_signal(signal.SIGUSR1)

    @property
    def pid(self) -> int:
        """Of the keeper, which lives as long as the program."""
        return self._keeper.pid

    def close(self) -> int:
        """Ask it to end if it runs, kill what has not ended within GRACE_S, and return its exit code."""
        with self._lock:
            self.asked = self.asked or self.code is None
            assert self._keeper.stdin is not None
            with suppress(OSError):
                self._keeper.stdin.close()
            return self._keeper.wait()


def filled(words: Sequence[str], values: Mapping[str, str]) -> list[str]:
    """Return a command line with the values in place of their names: `{endpoint}` and so on."""
    for name, value in values.items():
        words = [word.replace(f"{{{name}}}", value) for word in words]
    return [*words]


def environment_of(endpoint: str, federation: str) -> dict[str, str]:
    """Return the variables with which a program finds a run; `python` and `zsim` are those that run this process."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    return {"ZSIM_CONNECT": endpoint, "ZSIM_FEDERATION": federation, "PATH": path}


def search_path(folders: Sequence[str | Path]) -> str:
    """Return a PYTHONPATH of folders, before those that it has."""
    former = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    return os.pathsep.join(dict.fromkeys([*map(str, folders), *filter(None, former)]))
