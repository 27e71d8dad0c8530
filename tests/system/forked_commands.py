"""`zsim` commands that tests start, forked from one process that has everything imported, as `zsim run` forks its roles.

It saves a third of a second of processor time for each, a second for one that flies, two for `zsim run`. What a test has changed of its
own process, a command would have inherited: then it is started as a user would start it.

A command that starts no process and changes nothing of its own is run in the process of the test (`run_here`), which
costs no more than what it does. What `zsim.Federation` and `zsim.run` start is forked, too, with the fixture `forked`.
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
USER_FAULT = 2  # exit code of what a person has to put right
PROGRESS = ("waiting for a world of", "loading", "compiling")  # begin the lines of a command that takes long
FORKSERVER = Path(__file__).with_name("warm_forkserver.py")
COLUMNS = {"COLUMNS": "200"}  # of the terminal
COLD = ("sweep", "up", "push", "doctor", "restart", "move", "down", "ps", "logs", "fetch", "certs")
STARTING = ("world", "record", "camera", "detect", "console", "gateway", "ros1", "ros2")  # they change this process
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LIMITS = (resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE, resource.RLIMIT_AS)


class Completed(NamedTuple):
    """A command that has ended."""

    code: int
    stdout: str
    stderr: str


def start(arguments: list[str], environment: dict[str, str]) -> tuple[RoleProcess, IO[str]]:
    """Start a command; return it and what it prints.

    Args:
        arguments: of `zsim`.
        environment: variables that differ from those of the tests.
    """
    environment = {**COLUMNS, **environment}
    if not _can_fork(arguments):
        return start_program([*ZSIM, *arguments], environment)
    read, write = os.pipe()
    with os.fdopen(write, "w") as log:
        process = _forked(arguments, log, environment)
    return process, os.fdopen(read)


def start_in(folder: Path, arguments: list[str], log: IO[str]) -> RoleProcess | None:
    """Start a command in a folder, with its output to a file; None where it cannot be forked."""
    return _forked([f"PWD={folder}", *arguments], log) if _can_fork(arguments) else None


def _forked(arguments: Sequence[str], log: IO[str], environment: Mapping[str, str] = COLUMNS) -> RoleProcess:
    process = _launcher(tuple(environment.items())).start(arguments, log, listened=False)
    assert process.stdin is not None
    process.stdin.close()
    return process


def start_program(command: list[str], environment: dict[str, str]) -> tuple[RoleProcess, IO[str]]:
    """Start any program as `start` does a command."""
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
    """Start a program for `zsim.Federation` and `zsim.run`; arguments as of `Program`."""
    is_run = tuple(words[: len(COMMAND)]) == COMMAND
    arguments = words[len(COMMAND) :] if is_run else words[1:] if words[0] == "zsim" else ()
    if not arguments or not isinstance(output, Path) or not _can_fork([*arguments]):
        return Program(words, environment, output)
    return ForkedProgram(words, [*(f"{name}={value}" for name, value in environment.items()), *arguments], output)


class ForkedProgram(Program):
    """A `zsim` command as a program beside the test; without a keeper, since it ends with the test anyhow."""

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
    """Run a command to its end; it is killed when it hangs for so long."""
    return run_forked(*arguments, hangs_s=hangs_s) if _can_fork(arguments) else run_cold(*arguments)


def run_forked(*arguments: str, hangs_s: float = PATIENCE_S) -> Completed:
    """Run a command to its end that is refused before it would start another process in a way of its own."""
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
    """Run a command to its end in this process, its signal handlers, variables and places of modules restored."""
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
    """Run a command that must be refused; return its one line."""
    done = run(*arguments) if arguments[0] in STARTING else run_here(*arguments)
    assert done.code == USER_FAULT, done
    assert _without_progress(done.stdout) == []
    (line,) = _without_progress(done.stderr)
    return line


def _without_progress(output: str) -> list[str]:
    """Return the lines of a command but for those that it prints on a slow machine alone."""
    return [line for line in output.splitlines() if not line.startswith(PROGRESS)]


def _can_fork(arguments: list[str] | tuple[str, ...]) -> bool:
    return arguments[0] not in COLD and inherited() == FIRST and Path.cwd() == ROOT


def inherited() -> Any:
    """Return what a process hands on to those that it starts."""
    variables = {name: value for name, value in os.environ.items() if name not in ("PYTEST_CURRENT_TEST", FOLDERS)}
    return variables, [resource.getrlimit(limit) for limit in LIMITS], os.sched_getaffinity(0)


FIRST = inherited()  # conftest.py takes it anew when all tests are collected: their modules set variables, too


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
