"""Start of `zsim` commands in tests: forked from a process that has imported everything, as `zsim run` forks its roles.

Forking saves a third of a second of processor time per command, a second for one that flies, and two for `zsim run`.
If a test has changed what a new process inherits from its own, the command is started as a user would start it instead.

A command that starts no process and does not change its own is run in the process of the test (`run_here`), without any
overhead. With the fixture `forked`, the commands that `zsim.Federation` and `zsim.run` start are forked, too.
"""

import atexit
import io
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import cache
from pathlib import Path
from typing import IO, Any, NamedTuple

from wire import PATIENCE_S

from zsim.schema.plugin import FOLDERS
from zsim_api.flight import COMMAND
from zsim_api.programs import GRACE_S, Program
from zsim_deploy.cli import cli
from zsim_deploy.launch import role_launcher
from zsim_deploy.launch.role_launcher import RoleLauncher, RoleProcess

ROOT = Path(__file__).parents[2]
ZSIM = (sys.executable, "-m", "zsim_deploy.cli")
USER_FAULT = 2  # exit code of faults that the user has to correct
PROGRESS = ("waiting for a world of", "loading", "compiling")  # beginnings of lines that only slow commands print
FORKSERVER = Path(__file__).with_name("warm_forkserver.py")
COLUMNS = {"COLUMNS": "200"}  # width of the terminal
COLD = ("sweep", "up", "push", "doctor", "restart", "move", "down", "ps", "logs", "fetch", "certs")
STARTING = ("world", "record", "camera", "detect", "console", "gateway", "ros1", "ros2")  # change their own process
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LIMITS = (resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE, resource.RLIMIT_AS)


class Completed(NamedTuple):
    """A command that has ended."""

    code: int
    stdout: str
    stderr: str


def start(arguments: list[str], environment: dict[str, str]) -> tuple[RoleProcess, IO[str]]:
    """Start a command; return it and its output.

    Args:
        arguments: arguments of `zsim`.
        environment: environment variables that differ from those of the tests.
    """
    environment = {**COLUMNS, **environment}
    if not _can_fork(arguments):
        return start_program([*ZSIM, *arguments], environment)
    read, write = os.pipe()
    with os.fdopen(write, "w") as log:
        process = _forked(arguments, log, environment)
    return process, os.fdopen(read)


def start_in(folder: Path, arguments: list[str], log: IO[str]) -> RoleProcess | None:
    """Start a command in a folder, with its output going to a file; return None if it cannot be forked."""
    return _forked([f"PWD={folder}", *arguments], log) if _can_fork(arguments) else None


def _forked(arguments: Sequence[str], log: IO[str], environment: Mapping[str, str] = COLUMNS) -> RoleProcess:
    process = _launcher(tuple(environment.items())).start(arguments, log, listened=False)
    assert process.stdin is not None
    process.stdin.close()
    return process


def start_program(command: list[str], environment: dict[str, str]) -> tuple[RoleProcess, IO[str]]:
    """Start any program as `start` starts a command."""
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
        env={**os.environ, **environment},
        start_new_session=True,
    )
    assert process.stdout is not None
    return process, process.stdout


def program(words: Sequence[str], environment: Mapping[str, str], output: Path | int | None) -> Program:
    """Start a program for `zsim.Federation` and `zsim.run`; arguments as for `Program`."""
    is_run = tuple(words[: len(COMMAND)]) == COMMAND
    arguments = words[len(COMMAND) :] if is_run else words[1:] if words[0] == "zsim" else ()
    if not arguments or not isinstance(output, Path) or not _can_fork([*arguments]):
        return Program(words, environment, output)
    return ForkedProgram(words, [*(f"{name}={value}" for name, value in environment.items()), *arguments], output)


class ForkedProgram(Program):
    """A forked `zsim` command as a `Program`; it has no keeper, because it ends with the test anyway."""

    def __init__(self, words: Sequence[str], forked: Sequence[str], output: Path) -> None:
        self.words, self.asked = tuple(words), False
        with output.open("a") as log:
            self._process = _forked(forked, log)

    @property
    def code(self) -> int | None:
        code = self._process.poll()
        return code if code is None or code >= 0 else 128 - code

    def wait(self, timeout_s: float | None = None) -> int | None:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        return self.code

    def close(self) -> int:
        if self.code is None:
            self.asked = True
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGTERM)
            self.wait(GRACE_S)
            self._process.kill()
        return self._process.wait()


def run(*arguments: str, hangs_s: float = PATIENCE_S) -> Completed:
    """Run a command to its end; kill it if it takes longer than `hangs_s`."""
    return run_forked(*arguments, hangs_s=hangs_s) if _can_fork(arguments) else run_cold(*arguments)


def run_forked(*arguments: str, hangs_s: float = PATIENCE_S) -> Completed:
    """Run a command to its end, forked; it must be refused before it would start other processes."""
    read, write = os.pipe()
    with os.fdopen(write, "w") as log:
        process = _launcher(tuple(COLUMNS.items())).start(arguments, log, listened=True)
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.close()
    errors: list[str] = []
    with os.fdopen(read) as stderr, process.stdout as stdout:
        reader = threading.Thread(target=lambda: errors.append(stderr.read()), daemon=True)
        reader.start()
        timer = threading.Timer(hangs_s, process.kill)
        timer.start()
        output = stdout.read()
        reader.join()
        timer.cancel()
    return Completed(process.wait(PATIENCE_S), output, errors[0])


def run_cold(*arguments: str) -> Completed:
    """Run a command to its end, started as a user would start it."""
    done = subprocess.run(
        [*ZSIM, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    return Completed(done.returncode, done.stdout, done.stderr)


def run_here(*arguments: str) -> Completed:
    """Run a command to its end in this process; restore signal handlers, environment variables and sys.path."""
    words, places, variables = sys.argv, [*sys.path], dict(os.environ)
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    stdout, stderr, code = io.StringIO(), io.StringIO(), None
    sys.argv = ["zsim", *arguments]
    os.environ.update(COLUMNS)
    try:
        with redirect_stdout(stdout), redirect_stderr(stderr):
            cli.main()
    except SystemExit as ended:
        code = ended.code
    finally:
        sys.argv, sys.path[:] = words, places
        os.environ.clear()
        os.environ.update(variables)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return Completed(code if isinstance(code, int) else int(code is not None), stdout.getvalue(), stderr.getvalue())


def refusal(*arguments: str) -> str:
    """Run a command that must be refused; return its single line of output."""
    done = run(*arguments) if arguments[0] in STARTING else run_here(*arguments)
    assert done.code == USER_FAULT, done
    assert _without_progress(done.stdout) == []
    (line,) = _without_progress(done.stderr)
    return line


def _without_progress(output: str) -> list[str]:
    """Return a command's output lines, except those that it prints only on a slow machine."""
    return [line for line in output.splitlines() if not line.startswith(PROGRESS)]


def _can_fork(arguments: list[str] | tuple[str, ...]) -> bool:
    return arguments[0] not in COLD and inherited() == FIRST and Path.cwd() == ROOT


def inherited() -> Any:
    """Return what this process passes on to its child processes."""
    variables = {name: value for name, value in os.environ.items() if name not in ("PYTEST_CURRENT_TEST", FOLDERS)}
    return variables, [resource.getrlimit(limit) for limit in LIMITS], os.sched_getaffinity(0)


FIRST = inherited()  # conftest.py updates it once all tests are collected, because their modules also set variables


@cache
def _launcher(environment: tuple[tuple[str, str], ...]) -> RoleLauncher:
    former, forkserver = dict(os.environ), role_launcher.FORKSERVER
    os.environ.update(environment)
    role_launcher.FORKSERVER = (sys.executable, str(FORKSERVER))
    try:
        made = RoleLauncher(print, "of tests").__enter__()
    finally:
        role_launcher.FORKSERVER = forkserver
        os.environ.clear()
        os.environ.update(former)
    atexit.register(made.__exit__, None, None, None)
    return made
