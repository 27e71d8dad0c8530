"""Signals that end a command, and a terminal that is closed."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from refused import has_terms

from zsim_deploy.launch.supervisor import UNREAD, EndSignals

TALKS = """
import signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whoever runs the tests may be under nohup
from pathlib import Path
from zsim_deploy.launch.supervisor import UNREAD, EndSignals
told = []
with EndSignals(Path(sys.argv[1]), lambda: told.append(1)):
    print("ready", flush=True)
    while not told:
        sys.stdin.readline()
    print("fetching", flush=True)
    print("ended", file=sys.stderr, flush=True)
"""


def test_who_loses_the_terminal_goes_on_and_what_it_says_is_in_a_file(tmp_path: Path) -> None:
    master, slave = os.openpty()
    command = [sys.executable, "-c", TALKS, str(tmp_path / "up.log")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=slave, stderr=slave, start_new_session=True) as talker:
        os.close(slave)
        output = b""
        while not output.endswith(b"\n"):  # it may come in parts
            output += os.read(master, 100)
        assert output.strip() == b"ready"
        os.close(master)
        for _ in range(2):  # as the system and a shell do
            talker.send_signal(signal.SIGHUP)
        talker.communicate(b"\n", timeout=60.0)
    assert talker.returncode == 0
    assert (tmp_path / "up.log").read_text().splitlines() == ["fetching", "ended"]


def test_a_terminal_that_is_there_still_is_told_where_the_rest_is(tmp_path: Path) -> None:
    """A reader of a pipe may be gone a moment later, so nothing but that line is sent there."""
    log = tmp_path / "up.log"
    command = [sys.executable, "-c", TALKS, str(log)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True) as talker:  # type: ignore[call-overload]
        assert talker.stdout
        assert talker.stdout.readline() == "ready\n"
        talker.send_signal(signal.SIGHUP)
        output, complained = talker.communicate("\n", timeout=60.0)
    assert output == ""
    assert has_terms(complained, "terminal", "closed", str(log))
    assert log.read_text().splitlines() == ["fetching", "ended"]


LOOKS = """
import sys
from pathlib import Path
from zsim_deploy.launch.supervisor import UNREAD, EndSignals
told = []
with EndSignals(Path(sys.argv[1]), lambda: told.append(1)) as signals:
    print("ready", flush=True)
    while not signals.reason:
        signals.look()
    print(signals.reason, flush=True)
    print("fetching", len(told), flush=True)
"""


@pytest.mark.parametrize("both", [False, True], ids=["stdout", "both"])
def test_who_is_read_by_nobody_notices_without_writing(tmp_path: Path, both: bool) -> None:
    log = tmp_path / "up.log"
    read, write = os.pipe()
    errors = write if both else subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", LOOKS, str(log)], stdout=write, stderr=errors) as talker:
        os.close(write)
        with os.fdopen(read) as reader:
            assert reader.readline() == "ready\n"
        complained = talker.communicate(timeout=60.0)[1]
    assert talker.returncode == 0
    assert log.read_text().splitlines() == [UNREAD, f"fetching {int(both)}"]  # the screen is on standard error
    assert both or has_terms(complained.decode(), UNREAD, str(log))


def test_a_command_behind_a_head_has_the_exit_code_of_shells(tmp_path: Path) -> None:
    """As Click has it, that would be 1, without a word."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "zsim_deploy.cli", "validate", "scenarios/step.yaml"]
    done = subprocess.run(
        command, stdout=write, stderr=subprocess.PIPE, timeout=60.0, check=False, cwd=Path(__file__).parents[4]
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (141, b"")


def test_under_nohup_nothing_happens(tmp_path: Path) -> None:
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with EndSignals(tmp_path / "up.log", lambda: pytest.fail("hung up")):
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, former)


def test_sigterm_is_as_ctrl_c_wherever_it_comes(tmp_path: Path) -> None:
    former = signal.getsignal(signal.SIGTERM)
    with EndSignals(tmp_path / "up.log", lambda: None), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is former
