"""Machines that lack what others have: locks, shared memory, a home, streams, room for odd paths."""

import errno
import os
import subprocess
from pathlib import Path

import pytest
from federation import ONE, PAIR, compiled
from forked_commands import COLUMNS, ROOT, ZSIM
from wire import PATIENCE_S

__all__ = ["compiled"]
SHORT = ("--duration", "1", "--no-report")
LOCKLESS = """
import errno, fcntl, os
def flock(*_):
    raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))
fcntl.flock = flock
"""


def zsim(*arguments: str, prefix: tuple[str, ...] = (), **variables: str) -> "subprocess.CompletedProcess[str]":
    """Run a command to its end as a user would start it, with these variables of the environment."""
    environment = {**os.environ, **COLUMNS, **variables}
    command = [*prefix, *ZSIM, *arguments]
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


@pytest.fixture
def lockless(tmp_path: Path) -> dict[str, str]:
    """Variables by which every Python finds a file system without locks, as some of NFS and Lustre are."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(LOCKLESS)
    return {"PYTHONPATH": str(tmp_path / "site")}


@pytest.mark.usefixtures("compiled")
def test_a_run_and_a_sweep_go_on_without_locks(tmp_path: Path, lockless: dict[str, str]) -> None:
    scenario = tmp_path / "pair.yaml"
    scenario.write_text(PAIR)
    reason = os.strerror(errno.EOPNOTSUPP)
    for command, *options in (("run", *SHORT), ("run", *SHORT, "--force"), ("sweep", "--runs", "1", *SHORT)):
        out = tmp_path / f"{command}s"
        done = zsim(command, str(scenario), *options, "--out", str(out), **lockless)
        assert done.returncode == 0, done.stderr
        assert [line for line in done.stderr.splitlines() if reason in line] == [
            f"{out}: cannot be locked ({reason}); do not let two commands write there at a time"
        ]
    record = (tmp_path / "runs" / "run.mcap").read_bytes()
    assert record
