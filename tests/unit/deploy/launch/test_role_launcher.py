"""Roles that are forked: what a launcher sees of them is what it sees of any program that it starts."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from refused import has_terms

from zsim import __version__
from zsim.runtime import progress
from zsim_deploy.inventory import MODULE
from zsim_deploy.launch import console_process
from zsim_deploy.launch import role_launcher as module
from zsim_deploy.launch.role_launcher import ForkedProcess, RoleLauncher, RoleProcess

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="roles are forked on Linux alone")
WAITING = ["record", "--connect", "tcp/127.0.0.1:1", "--launched", "0", "--wait", "100"]  # for a world that never comes
END_S = 30.0
LOOK_S = 0.02


def quiet(_: str) -> None:
    """Say nothing."""


@pytest.fixture(scope="module")
def role_launcher() -> Iterator[RoleLauncher]:
    with RoleLauncher(quiet, "a run") as made:
        yield made


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "role.log"


def start(role_launcher: RoleLauncher, log: Path, *arguments: str, listened: bool = False) -> RoleProcess:
    with log.open("a") as file:
        return role_launcher.start([*arguments], file, listened)


def await_words(log: Path) -> None:
    """Wait until a role has begun to do what it is for."""
    until_s = time.monotonic() + END_S
    while not log.read_text() and time.monotonic() < until_s:
        time.sleep(LOOK_S)


def end(*roles: RoleProcess) -> None:
    for role in roles:
        role.kill()
        role.wait(END_S)
        for pipe in (role.stdin, role.stdout):
            if pipe is not None:
                pipe.close()


def test_what_a_role_prints_and_its_exit_code_come_back(role_launcher: RoleLauncher, log: Path) -> None:
    role = start(role_launcher, log, "--version", listened=True)
    assert role.stdout is not None
    assert role.stdout.read() == f"zsim {__version__}\n"
    assert role.wait(END_S) == role.poll() == 0
    assert log.read_text() == ""
    end(role)


def test_what_is_wrong_is_in_its_log(role_launcher: RoleLauncher, log: Path) -> None:
    role = start(role_launcher, log, "estimator")
    assert role.wait(END_S) == 2
    assert "missing argument" in log.read_text()
    end(role)


def test_without_a_reader_what_it_prints_goes_to_the_log(role_launcher: RoleLauncher, log: Path) -> None:
    role = start(role_launcher, log, "--version")
    role.wait(END_S)
    assert role.stdout is None
    assert log.read_text() == f"zsim {__version__}\n"
    end(role)


def test_a_role_that_is_killed_says_so_by_its_code(role_launcher: RoleLauncher, log: Path) -> None:
    role = start(role_launcher, log, *WAITING)
    assert role.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        role.wait(0.0)
    role.kill()
    assert role.wait(END_S) == -9
    role.kill()
    end(role)


def test_it_is_a_child_of_its_own_session_under_its_own_name(role_launcher: RoleLauncher, log: Path) -> None:
    role = start(role_launcher, log, *WAITING)
    await_words(log)
    seen = psutil.Process(role.pid)
    assert seen.ppid() == psutil.Process().pid
    assert [word for word in seen.cmdline() if word] == [sys.executable, "-P", "-m", "zsim_deploy.cli", *WAITING]
    end(role)


def test_no_role_holds_the_pipes_of_another(role_launcher: RoleLauncher, log: Path) -> None:
    first, second = (start(role_launcher, log, *WAITING, listened=True) for _ in range(2))
    assert first.stdin is not None
    assert first.stdout is not None
    first.stdin.close()
    first.wait(END_S)
    assert first.stdout.read() == ""  # it ends, so nobody can write to it any more
    assert second.poll() is None
    end(first, second)


def test_it_heeds_what_it_is_told(role_launcher: RoleLauncher, log: Path) -> None:
    role = start(role_launcher, log, *WAITING)
    await_words(log)
    assert role.stdin is not None
    role.stdin.write("stop it is enough\n")
    role.stdin.flush()
    role.wait(END_S)
    assert has_terms(log.read_text(), "stopped", "waiting", "world")
    end(role)


def test_where_the_fork_server_fails_a_role_is_started_as_a_program(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FORKSERVER", (sys.executable, "-c", "pass"))
    with RoleLauncher(quiet) as role_launcher:
        roles = [start(role_launcher, log, "--version") for _ in range(2)]
        assert all(isinstance(role, subprocess.Popen) for role in roles)
        assert [role.wait(END_S) for role in roles] == [0, 0]
        end(*roles)
    assert log.read_text() == 2 * f"zsim {__version__}\n"


@LINUX
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_fork_server_that_dies_or_stands_is_done_without(
    number: int, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
def test_a_role_of_which_the_launcher_does_not_know_never_begins(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RoleLauncher(quiet) as role_launcher:
        monkeypatch.setattr(role_launcher, "_receive", lambda: b"")
        role = start(role_launcher, log, "--version")
        assert role.wait(END_S) == 0
        end(role)
    assert log.read_text() == f"zsim {__version__}\n"  # once: the one that was forked has printed nothing


@LINUX
def test_a_command_that_is_too_long_for_a_packet_is_no_matter(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RoleLauncher(quiet) as role_launcher:
        monkeypatch.setattr(module, "PACKET_MAX", 5)
        role = start(role_launcher, log, "--version")
        monkeypatch.undo()
        again = start(role_launcher, log, "--version")
        assert [isinstance(each, ForkedProcess) for each in (role, again)] == [False, True]
        assert [each.wait(END_S) for each in (role, again)] == [0, 0]
        end(role, again)


@LINUX
def test_one_within_another_leaves_it_its_children(log: Path) -> None:
    with RoleLauncher(quiet) as outer:
        with RoleLauncher(quiet) as inner:
            assert inner._forkserver is not None
        assert inner._forkserver.poll() is not None
        role = start(outer, log, "estimator")
        assert role.wait(END_S) == 2
        end(role)


@LINUX
def test_the_fork_server_ends_with_its_launcher() -> None:
    code = "import time\nfrom zsim_deploy.launch.role_launcher import RoleLauncher\n"
    code += "with RoleLauncher(lambda _: None) as roles: print(roles._forkserver.pid, flush=True); time.sleep(100)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as launcher:
        assert launcher.stdout is not None
        forkserver = psutil.Process(int(launcher.stdout.readline()))
        launcher.kill()
    forkserver.wait(END_S)


def test_what_takes_long_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    monkeypatch.setattr(progress, "SLOW_S", 0.0)
    with RoleLauncher(shown.append):
        assert shown == [progress.SLOW_NOTICE] or sys.platform != "linux"


@LINUX
def test_ctrl_c_while_it_loads_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: RoleLauncher) -> bytes:
        raise KeyboardInterrupt

    monkeypatch.setattr(RoleLauncher, "_receive", interrupt)
    role_launcher = RoleLauncher(quiet)
    with pytest.raises(KeyboardInterrupt), role_launcher:
        pass
    assert role_launcher._forkserver is not None
    assert role_launcher._forkserver.poll() is not None


def test_an_exit_code_that_somebody_else_took_is_no_error() -> None:
    with subprocess.Popen([sys.executable, "-c", "pass"], stdin=subprocess.PIPE, text=True) as child:
        child.wait()
        assert child.stdin is not None
        gone = ForkedProcess(child.pid, child.stdin, None)
        assert gone.poll() == 0
        gone.kill()


STARTS = {
    "fork server": module.FORKSERVER,
    "role": module.COMMAND,
    "console": console_process.ZSIM,
    "service and remote role": (sys.executable, *MODULE),
}


@pytest.mark.parametrize("command", STARTS.values(), ids=STARTS)
def test_nothing_that_is_started_imports_from_the_working_folder_first(
    command: tuple[str, ...], tmp_path: Path
) -> None:
    """`python -m` alone imports a file there that is named as a module of the standard library."""
    for name in ("argparse", "typing_extensions", "typer", "json", "socket"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w').close()\n")
    subprocess.run([*command, "--version"], cwd=tmp_path, stdin=subprocess.DEVNULL, capture_output=True, timeout=END_S)
    assert sorted(place.suffix for place in tmp_path.iterdir()) == [".py"] * 5
