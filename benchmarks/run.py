"""One run of `zsim run`: what the world measured of it, and what its processes spent."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import msgspec
import psutil

from benchmarks.child import RefusedError
from zsim.contract import run_messages
from zsim.record import RecordReader

CLI = (sys.executable, "-m", "zsim_deploy.cli")
TIMEOUT_S = 300.0
LOOK_S = 0.5  # wall time between two looks at what processes have spent; a look takes milliseconds


def fly(scenario: Path, seconds: float, *options: str) -> tuple[dict[str, float], dict[str, float]]:
    """Fly once; return the world's figures (event `end`), and CPU seconds by role, start-up included.

    Raises:
        RefusedError: the run failed.
    """
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary) / "run"
        command = [*CLI, "run", str(scenario), "--no-report", "--duration", str(seconds), "--out", str(out), *options]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        cpu: dict[str, float] = {}
        until_s = time.monotonic() + TIMEOUT_S
        try:
            while process.poll() is None and time.monotonic() < until_s:
                cpu.update(_cpu_by_role(process.pid))
                time.sleep(LOOK_S)
        finally:
            if process.poll() is None:
                process.terminate()
            _, said = process.communicate()
        if process.returncode:
            raise RefusedError(f"zsim run: exit code {process.returncode}: {said.strip()[-160:]}")
        return _end_event(out), cpu


def _end_event(folder: Path) -> dict[str, float]:
    records = RecordReader(folder / "run.mcap").messages(keys=["world/event"])
    events = [msgspec.msgpack.decode(record.payload, type=run_messages.Event) for record in records]
    return next(event.data for event in events if event.kind == "end")


def _cpu_by_role(launcher: int) -> dict[str, float]:
    """Return user + system CPU seconds of the launcher and of each of its children."""
    found = {}
    try:
        parent = psutil.Process(launcher)
        for process in [parent, *parent.children()]:
            words = [word for word in process.cmdline() if word]  # a role that was forked has empty ones behind it
            times = process.cpu_times()
            found["launcher" if process.pid == launcher else _role(words)] = times.user + times.system
    except psutil.NoSuchProcess:
        return found
    return found


def _role(words: list[str]) -> str:
    """Return `role.thing` of a child's command line; that from which roles are forked is the fork server."""
    if words[2:3] != ["zsim_deploy.cli"]:
        return "forkserver"
    words = words[3:]
    thing = words[words.index("--") + 1 :] if "--" in words else []
    return ".".join([*words[:1], *thing])
