"""Roles that are forked: what a launcher sees of them is what it sees of any program that it starts."""

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from zsim import __version__
from zsim_deploy import nursery as nursery_module
from zsim_deploy.nursery import Nursery, Process

LINUX = sys.platform == "linux"
WAITING = ["record", "--connect", "tcp/127.0.0.1:1", "--launched", "0", "--wait", "100"]  # for a world that never comes
END_S = 30.0
LOOK_S = 0.02


def quiet(_: str) -> None:
    """Say nothing."""


@pytest.fixture(scope="module")
def nursery() -> Iterator[Nursery]:
    with Nursery(quiet) as made:
        made.await_ready()
        yield made


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "role.log"


def start(nursery: Nursery, log: Path, *arguments: str, listened: bool = False) -> Process:
    with log.open("a") as file:
        return nursery.start([*arguments], file, listened)


def await_words(log: Path) -> None:
    """Wait until a role has begun to do what it is for."""
    until_s = time.monotonic() + END_S
    while not log.read_text() and time.monotonic() < until_s:
        time.sleep(LOOK_S)


def end(*roles: Process) -> None:
    for role in roles:
        role.kill()
        role.wait(END_S)
        for pipe in (role.stdin, role.stdout):
            if pipe is not None:
                pipe.close()


def test_what_a_role_prints_and_its_exit_code_come_back(nursery: Nursery, log: Path) -> None:
    role = start(nursery, log, "--version", listened=True)
    assert role.stdout is not None
    assert role.stdout.read() == f"zsim {__version__}\n"
    assert role.wait(END_S) == role.poll() == 0
    assert log.read_text() == ""
    end(role)


def test_what_is_wrong_is_in_its_log(nursery: Nursery, log: Path) -> None:
    role = start(nursery, log, "estimator")
    assert role.wait(END_S) == 2
    assert "missing argument" in log.read_text()
    end(role)


def test_without_a_reader_what_it_prints_goes_to_the_log(nursery: Nursery, log: Path) -> None:
    role = start(nursery, log, "--version")
    role.wait(END_S)
    assert role.stdout is None
    assert log.read_text() == f"zsim {__version__}\n"
    end(role)


def test_a_role_that_is_killed_says_so_by_its_code(nursery: Nursery, log: Path) -> None:
    role = start(nursery, log, *WAITING)
    assert role.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        role.wait(0.0)
    role.kill()
    assert role.wait(END_S) == -9
    role.kill()
    end(role)


def test_it_is_a_child_of_its_own_session_under_its_own_name(nursery: Nursery, log: Path) -> None:
    role = start(nursery, log, *WAITING)
    await_words(log)
    seen = psutil.Process(role.pid)
    assert seen.ppid() == psutil.Process().pid
    assert [word for word in seen.cmdline() if word] == [sys.executable, "-m", "zsim_deploy.cli", *WAITING]
    end(role)


def test_no_role_holds_the_pipe_of_another(nursery: Nursery, log: Path) -> None:
    first, second = (start(nursery, log, *WAITING) for _ in range(2))
    assert first.stdin is not None
    first.stdin.close()
    first.wait(END_S)
    assert second.poll() is None
    end(first, second)


def test_it_heeds_what_it_is_told(nursery: Nursery, log: Path) -> None:
    role = start(nursery, log, *WAITING)
    await_words(log)
    assert role.stdin is not None
    role.stdin.write("stop it is enough\n")
    role.stdin.flush()
    role.wait(END_S)
    assert "stopped while waiting for a world" in log.read_text()
    end(role)


def test_where_its_cradle_is_gone_a_role_is_started_as_a_program(log: Path) -> None:
    with Nursery(quiet) as nursery:
        assert nursery._cradle is not None or not LINUX
        if nursery._cradle is not None:
            nursery._cradle.kill()
        nursery.await_ready()
        roles = [start(nursery, log, "--version") for _ in range(2)]
        assert all(isinstance(role, subprocess.Popen) for role in roles)
        assert [role.wait(END_S) for role in roles] == [0, 0]
        end(*roles)
    assert log.read_text() == 2 * f"zsim {__version__}\n"


def test_a_cradle_that_dies_later_is_not_missed_either(log: Path) -> None:
    with Nursery(quiet) as nursery:
        nursery.await_ready()
        if nursery._cradle is not None:
            nursery._cradle.kill()
            nursery._cradle.wait()
        role = start(nursery, log, "--version", listened=True)
        assert role.wait(END_S) == 0
        end(role)


def test_nothing_is_left_of_it() -> None:
    with Nursery(quiet) as nursery:
        cradle = nursery._cradle
    assert cradle is None or cradle.poll() is not None


def test_what_takes_long_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(nursery_module, "PATIENCE_S", 0.0)
    with Nursery(said.append) as nursery:
        nursery.await_ready()
    assert said == [nursery_module.PATIENCE]
