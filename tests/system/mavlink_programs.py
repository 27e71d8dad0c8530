"""Unmodified programs that fly MAVLink vehicles, as separate processes, and ports for them.

The first test that needs MAVProxy or node-mavlink installs it into a cache folder of this machine, since MAVProxy's own
requirements would install a second OpenCV beside that of zsim.
"""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from federation import free_port
from wire import PATIENCE_S

CLIENTS = Path(__file__).parent / "mavlink_clients"
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "zsim-tests"
NODE_MAVLINK = "node-mavlink@2.3.0"
MAVPROXY = ("MAVProxy==1.8.75", "pyserial==3.5")
INSTALL_S = 300.0
TRIES = 200


def free_udp_ports(count: int) -> int:
    """Return the first of `count` consecutive free UDP ports, which are not handed out again."""
    row: list[int] = []
    for _ in range(TRIES):
        port = free_port()
        row = [*(row if row[-1:] == [port - 1] else []), port] if _is_free(port) else []
        if len(row) == count:
            return row[0]
    return pytest.fail(f"no {count} UDP ports in a row are free")


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


class Program:
    """A running program, whose output is read continuously."""

    def __init__(self, command: list[str], **env: str) -> None:
        self._command = command
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            bufsize=1,
            env={**os.environ, "MAVLINK20": "1", **env},
        )
        self._lines: list[str] = []
        self._news = threading.Condition()
        self._is_over = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._news:
                self._lines.append(line.rstrip())
                self._news.notify_all()
        with self._news:
            self._is_over = True
            self._news.notify_all()

    def type(self, line: str) -> None:
        """Write a line to its input."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")

    def line(self, pattern: str) -> str:
        """Wait for a line that contains a pattern, and return the first one."""
        with self._news:
            self._news.wait_for(lambda: self._is_over or self._matching(pattern), PATIENCE_S)
            found = self._matching(pattern)
        return found or pytest.fail(f"{self._command}: no line with {pattern!r}:\n{self.text()}")

    def result(self) -> Any:
        """Wait until the program ends, and return the JSON that it prints."""
        line = self.line(r"^[\[{]")
        assert self.process.wait(PATIENCE_S) == 0, self.text()
        return json.loads(line)

    def text(self) -> str:
        return "\n".join(self._lines)

    def close(self) -> None:
        """End the program."""
        self.process.kill()
        self.process.wait()
        self._reader.join(PATIENCE_S)
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()

    def _matching(self, pattern: str) -> str | None:
        return next((line for line in self._lines if re.search(pattern, line)), None)


def python(script: str, *arguments: str) -> Program:
    """Start a Python client that knows nothing of zsim."""
    return Program([sys.executable, "-u", str(CLIENTS / script), *arguments], PYTHONPATH="")


def node(script: str, *arguments: str) -> Program:
    """Start a JavaScript client."""
    command = ["node", str(CLIENTS / script), *arguments]
    return Program(command, NODE_PATH=str(node_modules()))


def mavproxy(folder: Path, *arguments: str) -> Program:
    """Start MAVProxy without a window."""
    home = mavproxy_home()
    script = str(home / "bin" / "mavproxy.py")
    modules = "--default-modules=cmdlong,mode,arm,param,wp"
    command = [sys.executable, "-u", "-W", "ignore", script, modules, f"--state-basedir={folder}", *arguments]
    return Program(command, PYTHONPATH=str(home), HOME=str(folder))


def node_modules() -> Path:
    """Return the folder with node-mavlink; skip the test if it cannot be installed."""
    folder = CACHE / NODE_MAVLINK
    if shutil.which("node") is None or shutil.which("npm") is None:
        _leave_out("node or npm is not installed")
    _install(folder, ["npm", "install", "--no-audit", "--no-fund", "--prefix", "{}", NODE_MAVLINK])
    return folder / "node_modules"


def mavproxy_home() -> Path:
    """Return the folder with MAVProxy; skip the test if it cannot be installed."""
    folder = CACHE / MAVPROXY[0]
    _install(folder, [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", "{}", *MAVPROXY])
    return folder


def _install(folder: Path, command: list[str]) -> None:
    """Install into a folder, which exists only once complete."""
    if folder.is_dir():
        return
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = folder.with_name(f"{folder.name}.{os.getpid()}")
    ran = subprocess.run(
        [part.format(partial) for part in command], capture_output=True, text=True, timeout=INSTALL_S, check=False
    )
    if ran.returncode:
        shutil.rmtree(partial, ignore_errors=True)
        _leave_out(f"{command[0]} could not install {folder.name}: {ran.stderr[-300:]}")
    try:
        partial.rename(folder)
    except OSError:  # another worker was faster
        shutil.rmtree(partial, ignore_errors=True)


def _leave_out(reason: str) -> None:
    """Skip the test on a developer's machine; fail it in CI."""
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)
