"""Child programs that never outlive this process: `zsim run`, and the user's own.

Each is run by a keeper in a session of its own. The keeper ends the program and its descendants once this process is
gone, even by kill -9. Because of the session, Ctrl-C in a terminal reaches a program only through this process. The
keeper is this file, run by path:

    python -I -S programs.py GRACE_S WORD...

The keeper's standard input is a pipe from its caller, which closes when the caller ends: the program then receives
SIGTERM, and is killed if it has not ended within the grace period. The keeper forwards SIGINT, SIGTERM and SIGHUP to
the program's process group; SIGUSR1 kills the program and its descendants. Descendants that outlive the program are
killed after the same grace period. (Outside Linux, only its process group is killed.) The exit code is the program's,
128 + N for a signal, as in shells, or 127 if the program cannot be started.

Only the standard library is imported here, so that a keeper starts within milliseconds.
"""

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

PIPE = subprocess.PIPE
GRACE_S = 10.0  # wall time for a program to end after SIGTERM; `zsim run` ends within 3 s
KEEPER = (sys.executable, "-I", "-S", __file__)
PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
NOT_STARTED = 127
RETRY_S = 0.02  # interval between rounds of killing


class Program:
    """A running program.

    Args:
        words: command line.
        environment: variables in addition to those of this process.
        output: file for the output; None: the output of this process; PIPE for `lines`.
        folder: working folder; None: the current one.
    """

    def __init__(
        self,
        words: Sequence[str],
        environment: Mapping[str, str] | None = None,
        output: Path | int | None = None,
        folder: Path | None = None,
    ) -> None:
        self.words = tuple(words)
        self.end_requested = False  # whether this process has requested the program's end
        self._lock = threading.Lock()
        environment = {**os.environ, **(environment or {})}
        if output is not None:
            environment.pop("FORCE_COLOR", None)  # set by notebook kernels; the output is not a terminal
        with open(output if isinstance(output, Path) else os.devnull, "ab") as log:
            target = log if isinstance(output, Path) else output
            self._keeper = subprocess.Popen(
                [*KEEPER, str(GRACE_S), *words],
                stdin=subprocess.PIPE,
                stdout=target,
                stderr=subprocess.STDOUT if target == PIPE else target,
                env=environment,
                cwd=folder,
                start_new_session=True,
            )

    @property
    def code(self) -> int | None:
        """The exit code; 128 + N for a signal, 127 if the program could not be started; None while it runs."""
        return self._keeper.poll()

    def lines(self) -> Iterator[str]:
        """Yield the lines of the program's output to the end; may be called again after an interrupt."""
        assert self._keeper.stdout is not None
        for line in self._keeper.stdout:
            yield line.decode(errors="replace")

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait until the program and its descendants have ended; return its exit code, None if it is still running."""
        with suppress(subprocess.TimeoutExpired):
            return self._keeper.wait(timeout_s)
        return None

    def interrupt(self) -> None:
        """Send SIGINT, as Ctrl-C does."""
        self._keeper.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """Kill the program and its descendants at once."""
        self._keeper.send_signal(signal.SIGUSR1)

    @property
    def pid(self) -> int:
        """The process id of the keeper, which lives as long as the program."""
        return self._keeper.pid

    def close(self) -> int:
        """Send SIGTERM, kill the program if it has not ended within GRACE_S, and return its exit code."""
        with self._lock:
            self.end_requested = self.end_requested or self.code is None
            assert self._keeper.stdin is not None
            with suppress(OSError):
                self._keeper.stdin.close()
            return self._keeper.wait()


def fill_placeholders(arguments: Sequence[str], values: Mapping[str, str]) -> list[str]:
    """Replace `{endpoint}` and the like in a command line by their values."""
    for name, value in values.items():
        arguments = [argument.replace(f"{{{name}}}", value) for argument in arguments]
    return [*arguments]


def environment_of(endpoint: str, federation: str) -> dict[str, str]:
    """Return environment variables for programs of a run; their `python` and `zsim` are those of this process."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    return {"ZSIM_CONNECT": endpoint, "ZSIM_FEDERATION": federation, "PATH": path}


def search_path(folders: Sequence[str | Path]) -> str:
    """Return PYTHONPATH with further folders in front."""
    previous = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    return os.pathsep.join(dict.fromkeys([*map(str, folders), *filter(None, previous)]))


# The keeper


def keep(grace_s: float, command: list[str]) -> int:
    """Run a program to its end as its keeper; return the exit code."""
    pending: list[int] = []
    program: subprocess.Popen[bytes] | None = None

    def forward(number: int, _: object = None) -> None:
        if program is None:
            pending.append(number)
        else:
            with suppress(ProcessLookupError):
                os.killpg(program.pid, number)

    def kill() -> None:
        if sys.platform == "linux":
            _kill_children()
        else:
            forward(signal.SIGKILL)

    def await_caller() -> None:
        while os.read(sys.stdin.fileno(), 1):
            continue
        forward(signal.SIGTERM)
        time.sleep(grace_s)
        kill()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, forward)
    signal.signal(signal.SIGUSR1, lambda *_: threading.Thread(target=kill, daemon=True).start())
    if sys.platform == "linux":  # detached descendants become children of this process
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        program = subprocess.Popen(command, stdin=subprocess.DEVNULL, process_group=0)
    except OSError as error:
        sys.stderr.write(f"{command[0]!a}: cannot be started ({error.strerror})\n")
        return NOT_STARTED
    for number in pending:
        forward(number)
    threading.Thread(target=await_caller, daemon=True).start()
    code = program.wait()
    forward(signal.SIGTERM)
    killer = threading.Timer(grace_s, kill)
    killer.daemon = True
    killer.start()
    with suppress(ChildProcessError):  # no child is left
        while True:
            os.waitpid(-1, 0)
    return code if code >= 0 else 128 - code


def _kill_children() -> None:
    """Kill all children, then theirs, which in turn become children of this process; only Linux lists children."""
    while children := [pid for path in Path("/proc/self/task").glob("*/children") for pid in path.read_text().split()]:
        for pid in children:
            with suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)
        time.sleep(RETRY_S)


if __name__ == "__main__":
    sys.exit(keep(float(sys.argv[1]), sys.argv[2:]))
