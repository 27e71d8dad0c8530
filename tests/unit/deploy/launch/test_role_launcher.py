"""Forked roles behave towards the launcher like programs that it starts; the console of a run outlives the run."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from refused import has_terms

from zsim import __version__
from zsim.runtime import progress
from zsim_bridges.console.console_server import OFFER_S
from zsim_deploy.inventory import MODULE
from zsim_deploy.launch import role_launcher as module
from zsim_deploy.launch.role_launcher import (
    COPIED_S,
    INTERRUPTED_S,
    SLOW_S,
    ForkedProcess,
    RoleLauncher,
    RoleProcess,
    RunConsole,
)
from zsim_deploy.launch.supervisor import Outcome

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="roles are forked on Linux alone")
WAITING = [
    "record",
    "--connect",
    "tcp/127.0.0.1:1",
    "--launched",
    "0",
    "--wait",
    "100",
]  # for a world that never starts
VERSION = f"zsim {__version__}\n"
LIGHT = (
    *(sys.executable, "-P", "-c"),
    "from zsim_deploy.cli import forkserver as it; it._prepare = lambda: None; it.main()",
)  # a fork server that imports nothing in advance, which leaves it to each role
END_S = 120.0
LOOK_S = 0.02


def quiet(_: str) -> None:
    """Discard a line."""


@pytest.fixture(scope="module")
def role_launcher() -> Iterator[RoleLauncher]:
    with RoleLauncher(quiet, "a run") as made:
        yield made


@pytest.fixture
def light(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FORKSERVER", LIGHT)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "role.log"


def start(role_launcher: RoleLauncher, log: Path, *arguments: str, listened: bool = False) -> RoleProcess:
    with log.open("a") as file:
        return role_launcher.start([*arguments], file, listened)


def end(*roles: RoleProcess) -> None:
    for role in roles:
        role.kill()
        role.wait(END_S)
        for pipe in (role.stdin, role.stdout):
            if pipe is not None:
                pipe.close()


@pytest.mark.parametrize(
    ("arguments", "listened", "output", "code", "logged"),
    [
        (["--version"], True, VERSION, 0, ""),
        (["--version"], False, None, 0, VERSION),
        (["estimator"], False, None, 2, "missing argument"),
    ],
)
def test_the_output_and_the_exit_code_of_a_role_are_returned(
    role_launcher: RoleLauncher,
    log: Path,
    arguments: list[str],
    listened: bool,
    output: str | None,
    code: int,
    logged: str,
) -> None:
    role = start(role_launcher, log, *arguments, listened=listened)
    assert (role.stdout.read() if role.stdout else None) == output
    assert role.wait(END_S) == role.poll() == code
    assert logged in log.read_text()
    assert bool(logged) is bool(log.read_text())
    end(role)


def test_a_killed_role_has_the_exit_code_of_its_signal(role_launcher: RoleLauncher, log: Path) -> None:
    role = start(role_launcher, log, *WAITING)
    assert role.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        role.wait(0.0)
    role.kill()
    assert role.wait(END_S) == -9
    role.kill()
    end(role)


def test_a_role_is_a_child_with_its_own_command_line_and_stops_on_request(
    role_launcher: RoleLauncher, log: Path
) -> None:
    role = start(role_launcher, log, *WAITING)
    until_s = time.monotonic() + END_S
    while not log.read_text() and time.monotonic() < until_s:  # until it has begun its work
        time.sleep(LOOK_S)
    seen = psutil.Process(role.pid)
    assert seen.ppid() == psutil.Process().pid
    assert [word for word in seen.cmdline() if word] == [sys.executable, "-P", "-m", "zsim_deploy.cli", *WAITING]
    assert role.stdin is not None
    role.stdin.write("stop it is enough\n")
    role.stdin.flush()
    role.wait(END_S)
    assert has_terms(log.read_text(), "stopped", "waiting", "world")
    end(role)


def test_no_role_holds_the_pipes_of_another(role_launcher: RoleLauncher, log: Path) -> None:
    first, second = (start(role_launcher, log, *WAITING, listened=True) for _ in range(2))
    assert first.stdin is not None
    assert first.stdout is not None
    first.stdin.close()
    first.wait(END_S)
    assert first.stdout.read() == ""  # end of file, so no other role holds the writing end
    assert second.poll() is None
    end(first, second)


def test_without_a_fork_server_a_role_is_started_as_a_program(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    monkeypatch.setattr(progress, "SLOW_S", 0.0)
    monkeypatch.setattr(module, "FORKSERVER", (sys.executable, "-c", "pass"))
    with RoleLauncher(shown.append) as role_launcher:
        assert shown == [progress.SLOW_NOTICE] or sys.platform != "linux"
        roles = [start(role_launcher, log, "--version") for _ in range(2)]
        assert all(isinstance(role, subprocess.Popen) for role in roles)
        assert [role.wait(END_S) for role in roles] == [0, 0]
        end(*roles)
    assert log.read_text() == 2 * VERSION


@LINUX
@pytest.mark.usefixtures("light")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_dead_or_stopped_fork_server_is_bypassed(number: int, log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ANSWER_S", 0.2)
    with RoleLauncher(quiet) as role_launcher:
        assert role_launcher._forkserver is not None
        os.kill(role_launcher._forkserver.pid, number)
        role = start(role_launcher, log, "--version", listened=True)
        assert isinstance(role, subprocess.Popen)
        assert role.wait(END_S) == 0
        assert role_launcher._forkserver.poll() is not None
        end(role)


@LINUX
@pytest.mark.usefixtures("light")
def test_a_fork_that_the_launcher_has_lost_never_begins(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A launcher within another leaves the outer one its children."""
    with RoleLauncher(quiet) as outer:
        with RoleLauncher(quiet) as inner:
            monkeypatch.setattr(inner, "_receive", lambda: b"")
            role = start(inner, log, "--version")
            assert role.wait(END_S) == 0
            end(role)
        assert inner._forkserver is not None
        assert inner._forkserver.poll() is not None
        assert log.read_text() == VERSION  # once: the lost fork has printed nothing
        role = start(outer, log, "estimator")
        assert isinstance(role, ForkedProcess)
        assert role.wait(END_S) == 2
        end(role)


@LINUX
@pytest.mark.usefixtures("light")
def test_a_command_too_long_for_a_packet_is_started_as_a_program(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RoleLauncher(quiet) as role_launcher:
        monkeypatch.setattr(module, "PACKET_MAX", 5)
        role = start(role_launcher, log, "--version")
        monkeypatch.undo()
        again = start(role_launcher, log, "--version")
        assert [isinstance(each, ForkedProcess) for each in (role, again)] == [False, True]
        assert [each.wait(END_S) for each in (role, again)] == [0, 0]
        end(role, again)


@LINUX
def test_the_fork_server_ends_with_its_launcher() -> None:
    code = f"import time\nfrom zsim_deploy.launch import role_launcher as it\nit.FORKSERVER = {LIGHT!r}\n"
    code += "with it.RoleLauncher(lambda _: None) as roles: print(roles._forkserver.pid, flush=True); time.sleep(100)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as launcher:
        assert launcher.stdout is not None
        forkserver = psutil.Process(int(launcher.stdout.readline()))
        launcher.kill()
    forkserver.wait(END_S)


@LINUX
def test_ctrl_c_while_loading_leaves_no_fork_server(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: RoleLauncher) -> bytes:
        raise KeyboardInterrupt

    monkeypatch.setattr(RoleLauncher, "_receive", interrupt)
    role_launcher = RoleLauncher(quiet)
    with pytest.raises(KeyboardInterrupt), role_launcher:
        pass
    assert role_launcher._forkserver is not None
    assert role_launcher._forkserver.poll() is not None


def test_an_exit_code_collected_elsewhere_is_not_an_error() -> None:
    with subprocess.Popen([sys.executable, "-c", "pass"], stdin=subprocess.PIPE, text=True) as child:
        child.wait()
        assert child.stdin is not None
        gone = ForkedProcess(child.pid, child.stdin, None)
        assert gone.poll() == 0
        gone.kill()


STARTS = {
    "fork server": module.FORKSERVER,
    "role": module.COMMAND,
    "console": module.ZSIM,
    "service and remote role": (sys.executable, *MODULE),
}


@pytest.mark.parametrize("command", STARTS.values(), ids=STARTS)
def test_no_started_program_imports_from_the_working_folder_first(command: tuple[str, ...], tmp_path: Path) -> None:
    """`python -m` alone would import a file there that has the name of a standard module."""
    for name in ("argparse", "typing_extensions", "typer", "json", "socket"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w').close()\n")
    subprocess.run([*command, "--version"], cwd=tmp_path, stdin=subprocess.DEVNULL, capture_output=True, timeout=END_S)
    assert sorted(place.suffix for place in tmp_path.iterdir()) == [".py"] * 5


REASON = "over"


class LateConsole:
    """A console that ends some time after a request to stop; a signal may arrive meanwhile."""

    name = "console.run"

    def __init__(self, ends_after_s: float, signal_number: int = 0) -> None:
        self.left_s = ends_after_s
        self.waited_s = 0.0
        self.stopped_for = ""
        self.closed = False
        self._signal_number = signal_number

    def request_stop(self, reason: str) -> None:
        self.stopped_for = reason

    def wait(self, timeout_s: float) -> bool:
        assert self.stopped_for
        if self._signal_number:
            signal.raise_signal(self._signal_number)
        waited_s = min(timeout_s, self.left_s)
        self.waited_s += waited_s
        self.left_s -= waited_s
        return self.left_s <= 0.0

    def close(self) -> None:
        self.closed = True


def end_with(console: LateConsole, interrupted: bool = False, error: BaseException | None = None) -> None:
    """End a run that has a console, or interrupt its report."""
    process: Any = console
    with RunConsole() as run_console:
        run_console.own(process)
        run_console.outcome = Outcome(REASON, interrupted=interrupted)
        if error:
            raise error
        assert not console.stopped_for


@pytest.mark.parametrize(
    ("ends_after_s", "interrupted", "waited_s", "named"),
    [
        (0.5, False, 0.5, False),
        (SLOW_S + 3.0, False, SLOW_S + 3.0, True),
        (1000.0, False, COPIED_S, True),
        (1000.0, True, INTERRUPTED_S, False),
    ],
)
def test_a_console_is_stopped_after_the_report_with_limited_patience(
    capfd: pytest.CaptureFixture[str], ends_after_s: float, interrupted: bool, waited_s: float, named: bool
) -> None:
    console = LateConsole(ends_after_s)
    end_with(console, interrupted=interrupted)
    assert (console.name in capfd.readouterr().err) is named
    assert (console.stopped_for, console.waited_s, console.closed) == (REASON, waited_s, True)
    assert COPIED_S > OFFER_S


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(130)])
def test_interrupting_the_report_shortens_the_wait_for_the_console(error: BaseException) -> None:
    console = LateConsole(1000.0)
    with pytest.raises(type(error)):
        end_with(console, error=error)
    assert (console.waited_s, console.closed) == (INTERRUPTED_S, True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_wait_and_keeps_the_outcome_of_the_run(number: int) -> None:
    console = LateConsole(1000.0, number)
    end_with(console)
    assert (console.waited_s, console.closed) == (0.0, True)
    failed = LateConsole(1000.0, number)
    with pytest.raises(ValueError, match="the run failed"):
        end_with(failed, error=ValueError("the run failed"))


def test_an_interrupt_before_the_outcome_closes_the_console() -> None:
    console = LateConsole(1000.0)
    process: Any = console

    def run() -> None:
        with RunConsole() as run_console:
            run_console.own(process)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert (console.waited_s, console.closed) == (INTERRUPTED_S, True)


def test_a_second_console_replaces_the_first() -> None:
    first, second = LateConsole(0.5), LateConsole(0.5)
    processes: Any = [first, second]
    with RunConsole() as run_console:
        assert run_console.process is None
        for process in processes:
            run_console.own(process)
        assert (first.closed, second.closed) == (True, False)
    assert second.closed
