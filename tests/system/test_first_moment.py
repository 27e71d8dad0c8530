"""Ctrl-C while a command still loads its modules gives one line, as it does later."""

import os
import signal
import subprocess
import sys

import pytest
from federation import free_port

LOADS = (sys.executable, "-X", "importtime", "-m", "zsim_deploy")  # Python reports each loaded module


@pytest.mark.parametrize("loaded", ["zsim.errors", "typer"])
def test_ctrl_c_while_a_command_loads_is_reported_in_one_line(loaded: str) -> None:
    command = [*LOADS, "keys", "--wait", "60", "--connect", f"tcp/127.0.0.1:{free_port()}"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stderr is not None
    output = []
    with process.stderr:
        for line in process.stderr:
            output.append(line)
            if line.endswith(f" {loaded}\n"):
                os.kill(process.pid, signal.SIGINT)
    assert process.wait() == 130, output[-5:]
    lines = [line for line in output if not line.startswith("import time:")]
    assert lines[-1:] == ["interrupted\n"]
    assert "Traceback" not in "".join(lines)
