"""Child programs that never outlive this process: `zsim run`, and a user's own.

Each is run by a keeper (keeper.py) in a session of its own. So Ctrl-C in a terminal reaches a program only through this
process, and nothing is left running when this process is killed.
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
GRACE_S = 10.0  # wall time for a program to end after SIGTERM; `zsim run` ends within 3 s
KEEPER = (sys.executable, "-I", "-S", keeper.__file__)


class Program:
    """A running program.

    Args:
        words: its command line.
        environment: variables in addition to those of this process.
        output: file for its output; None: that of this process; PIPE for `lines`.
        folder: its working folder; None: the current one.
    """

    def __init__(
        self,
        words: Sequence[str],
        environment: Mapping[str, str] | None = None,
        output: Path | int | None = None,
        folder: Path | None = None,
    ) -> None:
        self.words = tuple(words)
        self.asked = False  # whether this process has asked it to end
        self._lock = threading.Lock()
        environment = {**os.environ, **(environment or {})}
        if output is not None:
            environment.pop("FORCE_COLOR", None)  # set by notebook kernels; the output is not a terminal
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
        """Its exit code, None while it runs; 128 + N for a signal, 127 if it could not be started."""
        return self._keeper.poll()

    def lines(self) -> Iterator[str]:
        """Yield the lines of its output to the end; may be called again after an interrupt."""
        assert self._keeper.stdout is not None
        for line in self._keeper.stdout:
            yield line.decode(errors="replace")

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait until it and its descendants have ended; return its exit code, None if it is still running."""
        with suppress(subprocess.TimeoutExpired):
            return self._keeper.wait(timeout_s)
        return None

    def interrupt(self) -> None:
        """Send it SIGINT, as Ctrl-C does."""
        self._keeper.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """Kill it and its descendants at once."""
        self._keeper.send_signal(signal.SIGUSR1)

    @property
    def pid(self) -> int:
        """Process id of the keeper, which lives as long as the program."""
        return self._keeper.pid

    def close(self) -> int:
        """Ask it to end, kill it if it has not within GRACE_S, and return its exit code."""
        with self._lock:
            self.asked = self.asked or self.code is None
            assert self._keeper.stdin is not None
            with suppress(OSError):
                self._keeper.stdin.close()
            return self._keeper.wait()


def filled(words: Sequence[str], values: Mapping[str, str]) -> list[str]:
    """Replace `{endpoint}` and so on in a command line by their values."""
    for name, value in values.items():
        words = [word.replace(f"{{{name}}}", value) for word in words]
    return [*words]


def environment_of(endpoint: str, federation: str) -> dict[str, str]:
    """Return the environment variables for programs of a run; `python` and `zsim` are those of this process."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    return {"ZSIM_CONNECT": endpoint, "ZSIM_FEDERATION": federation, "PATH": path}


def search_path(folders: Sequence[str | Path]) -> str:
    """Return PYTHONPATH with further folders in front."""
    former = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    return os.pathsep.join(dict.fromkeys([*map(str, folders), *filter(None, former)]))
