"""What a run leaves on a terminal, tested with a pseudo-terminal."""

import fcntl
import os
import pty
import struct
import subprocess
import termios
from pathlib import Path

import pytest
from federation import ONE
from forked_commands import ROOT, ZSIM
from wire import PATIENCE_S

CLEARED = "\x1b[2K"  # erases a line; what follows the last one stays visible


def shown(command: list[str], columns: int) -> str:
    """Run a command on a terminal with `columns` columns; return everything that it writes there."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
    environment["TERM"] = "xterm"
    with subprocess.Popen(command, cwd=ROOT, stdout=follower, stderr=follower, env=environment) as process:
        os.close(follower)
        pieces = []
        try:
            while piece := os.read(leader, 65_536):
                pieces.append(piece)
        except OSError:
            pass  # on Linux, a terminal that no process has open raises this
        process.wait(PATIENCE_S)
    os.close(leader)
    return b"".join(pieces).decode()


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("columns", [80, pytest.param(120, marks=pytest.mark.soak)])
def test_a_finished_run_leaves_its_outcome_and_folder_on_the_terminal(tmp_path: Path, columns: int) -> None:
    scenario, out = tmp_path / "one.yaml", tmp_path / "run"
    scenario.write_text(ONE)
    options = ("--in-process", "--no-report", "--duration", "1", "--out", str(out))
    text = shown([*ZSIM, "run", str(scenario), *options], columns)
    assert CLEARED in text  # the live line of progress
    left = text.rpartition(CLEARED)[2]
    assert "ended: " in left
    assert str(out / "run.mcap") in left
    assert f"into {out}" in text
