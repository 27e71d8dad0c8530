"""Locks of the folders that commands write into, file systems without locks, and temporary folders."""

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from zsim.output_folder import no_locks, take_lock
from zsim.record import RecordWriter
from zsim.record.record_writer import is_being_written
from zsim_deploy.hosts import control_socket, on_host
from zsim_world.server.run_journal import RunJournal

LOCKLESS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # errors of Lustre, FUSE and some NFS file systems


@pytest.fixture(params=LOCKLESS)
def reason(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Make locking fail; return the reason."""

    def flock(*_: Any) -> None:
        raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr(fcntl, "flock", flock)
    return os.strerror(request.param)


def test_a_lock_excludes_others_where_locks_are_supported(tmp_path: Path) -> None:
    with open(tmp_path / "file", "w") as one, open(tmp_path / "file") as other:
        assert take_lock(one)
        assert not take_lock(other)
        assert not take_lock(other, shared=True)
    with open(tmp_path / "file") as other:
        assert take_lock(other)
    assert no_locks(tmp_path) is None
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_without_locks_everything_works_with_a_warning(
    tmp_path: Path, reason: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    warning = f"{tmp_path}: cannot be locked ({reason}); do not let two commands write there at the same time"
    assert no_locks(tmp_path) == warning
    journal = RunJournal(tmp_path / "journal", "run", "sha", print)
    assert journal.open() is None
    journal.close()
    RecordWriter(tmp_path / "run.mcap").close()
    assert not is_being_written(tmp_path / "run.mcap")
    with on_host.locked(tmp_path, "somebody") as fault:
        assert fault == reason
    monkeypatch.setattr(control_socket, "place", lambda federation: tmp_path / f"{federation}.sock")
    tmp_path.chmod(0o700)
    for federation in ("one", "one@1"):
        control_socket.ControlSocket(federation, {}).close()
    assert capfd.readouterr().err.splitlines() == [warning]  # the warning about a run's own folder is given by the run


HOLDER = """
import multiprocessing
import sys
from zsim.output_folder import temporary_folder

if __name__ == "__main__":
    print(temporary_folder("one-"), flush=True)
    child = multiprocessing.get_context("spawn").Process(target=temporary_folder, args=("two-",))
    child.start()
    child.join()
    print(child.exitcode, flush=True)
    sys.stdin.read()
"""
LOCKLESS_HOLDER = f"""
import errno
import fcntl

def flock(*_):
    raise OSError(errno.ENOLCK, "")

fcntl.flock = flock
{HOLDER}"""


def holding(folder: Path, script: str = HOLDER) -> tuple[subprocess.Popen[str], Path]:
    """Start a process that holds a temporary folder and had a child with one; return the process and its folder."""
    (folder / "holder.py").write_text(script)
    environment = {**os.environ, "TMPDIR": str(folder / "tmp")}
    words, pipe = [sys.executable, "holder.py"], subprocess.PIPE
    process = subprocess.Popen(words, cwd=folder, env=environment, stdin=pipe, stdout=pipe, text=True)
    assert process.stdout is not None
    made = Path(process.stdout.readline().strip())
    assert made.is_relative_to(folder / "tmp")
    assert process.stdout.readline() == "0\n"
    return process, made


@pytest.mark.parametrize("script", [HOLDER, LOCKLESS_HOLDER], ids=["locks", "no locks"])
def test_a_temporary_folder_is_removed_with_its_process_or_by_the_next_one(tmp_path: Path, script: str) -> None:
    (tmp_path / "tmp").mkdir()
    (killed, left), (alive, held) = holding(tmp_path), holding(tmp_path)
    killed.kill()
    killed.communicate()
    assert left.is_dir()
    another, _ = holding(tmp_path, script)
    assert held.is_dir()
    assert left.exists() == (script == LOCKLESS_HOLDER)  # without locks, the next one cannot tell whether it is in use
    for process in (another, alive):
        process.communicate()
        assert process.returncode == 0
    rest = [left.parent] if script == LOCKLESS_HOLDER else []
    assert [*(tmp_path / "tmp").iterdir()] == rest
