"""Child programs and their keepers."""

import signal
import subprocess
import sys
from pathlib import Path

from zsim_api import programs

# the keeper as it runs where the children of a process are not known
ELSEWHERE = """
import sys
import programs
sys.platform, programs._kill_children = "darwin", lambda: None
sys.exit(programs.keep(0.2, sys.argv[1:]))
"""
STUBBORN = """
import signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("ready", flush=True)
time.sleep(600.0)
"""


def test_a_program_that_ignores_sigterm_is_killed_outside_linux_too() -> None:
    command = [sys.executable, "-c", ELSEWHERE, sys.executable, "-c", STUBBORN]
    folder = Path(programs.__file__).parent
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, cwd=folder, **pipes) as keeper:  # type: ignore[call-overload]
        assert keeper.stdin
        assert keeper.stdout
        assert keeper.stdout.readline() == b"ready\n"
        keeper.stdin.close()
        try:
            assert keeper.wait(120.0) == 128 + signal.SIGKILL
        finally:
            keeper.kill()
            keeper.stdout.close()
