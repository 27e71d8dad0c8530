"""Run a command of zsim once, and measure the processor time and memory of its processes."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import psutil

from benchmarks.child import RefusedError
from zsim.contract import run_messages
from zsim.record import RecordReader
from zsim_deploy.inventory import MODULE

CLI = (sys.executable, "-m", "zsim_deploy.cli")
TIMEOUT_S = 600.0
WAIT_S = 0.05  # polling interval for the end of a command
LOOK_S = 0.5  # polling interval of processor times, each reading of which takes milliseconds


def fly(scenario: Path, seconds: float, *options: str) -> tuple[dict[str, float], dict[str, float]]:
    """Fly once; return the data of the world's event `end`, and CPU seconds by role, including start-up.

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
        return end_event(out), cpu


class Spent(NamedTuple):
    """CPU seconds of a command and its descendants, and the peak resident memory of the largest of them [MB]."""

    cpu_s: float
    peak_mb: float


def spent(command: Sequence[str], folder: Path) -> Spent:
    """Run a command in a folder and measure it; raise RefusedError if it fails or does not end in time."""
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True
        )
        until_s = time.monotonic() + TIMEOUT_S
        ended, status, usage = 0, 0, None
        try:
            while not ended:
                time.sleep(WAIT_S)
                ended, status, usage = os.wait4(process.pid, os.WNOHANG)
                if not ended and time.monotonic() > until_s:
                    raise RefusedError(f"not finished after {TIMEOUT_S:g} s")
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.returncode = os.waitstatus_to_exitcode(status) if ended else process.wait()
        if process.returncode:
            said.seek(0)
            raise RefusedError(f"zsim run: exit code {process.returncode}: {said.read().strip()[-160:]}")
    assert usage is not None
    return Spent(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3)  # ru_maxrss is in kilobytes (getrusage(2))


def end_event(folder: Path) -> dict[str, float]:
    """Return the data of the world's event `end` in a run's record."""
    records = RecordReader(folder / "run.mcap").messages(keys=["world/event"])
    events = [msgspec.msgpack.decode(record.payload, type=run_messages.Event) for record in records]
    return next(event.data for event in events if event.kind == "end")


def _cpu_by_role(launcher: int) -> dict[str, float]:
    """Return user + system CPU seconds of the launcher and of each of its children."""
    found = {}
    try:
        parent = psutil.Process(launcher)
        for process in [parent, *parent.children()]:
            times = process.cpu_times()
            found["launcher" if process.pid == launcher else role_of(process)] = times.user + times.system
    except psutil.NoSuchProcess:
        return found
    return found


def role_of(process: psutil.Process) -> str:
    """Return a run's process as `role` or `role.thing` (estimator.drone1); `forkserver` for the parent of forked roles.

    Raises:
        psutil.NoSuchProcess: the process has ended.
    """
    words = [word for word in process.cmdline() if word]  # a forked role has trailing empty arguments
    if words[1 : 1 + len(MODULE)] != [*MODULE]:
        return "forkserver"
    words = words[1 + len(MODULE) :]
    things = words[words.index("--") + 1 :] if "--" in words else []
    return ".".join([*words[:1], *things])
