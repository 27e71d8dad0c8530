"""Network namespaces by iproute2: enter them, list their processes, and remove them with these."""

import ctypes
import os
import re
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from federation import wait_gone

FOLDER = Path("/run/netns")  # where iproute2 keeps the namespaces
CLONE_NEWNET = 0x40000000  # linux/sched.h
GONE_S = 120.0  # wall time for a killed process to vanish on a busy machine
SBIN = "/usr/sbin:/sbin"  # often missing in a PATH


def environment() -> dict[str, str]:
    """Return the environment with the folders of the administrator's tools in PATH."""
    return {**os.environ, "PATH": f"{os.environ.get('PATH', '/usr/bin:/bin')}:{SBIN}"}


def checked(command: Sequence[str], stdin: str = "") -> str:
    """Run a command, which must succeed, and return its output."""
    done = subprocess.run(command, input=stdin, text=True, capture_output=True, timeout=GONE_S, env=environment())
    if done.returncode:
        raise OSError(f"{' '.join(command)} failed: {done.stderr.strip()}")
    return done.stdout


def ip(*lines: str, within: str | None = None) -> None:
    """Run lines of `ip` as one batch, within a namespace or outside all of them."""
    checked(["ip", *(("-n", within) if within else ()), "-batch", "-"], "\n".join(lines) + "\n")


@contextmanager
def entered(namespace: str) -> Iterator[None]:
    """Move the calling thread, and threads that it starts, into a namespace."""
    home = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    try:
        there = os.open(FOLDER / namespace, os.O_RDONLY)
        try:
            _enter(there)
        finally:
            os.close(there)
        yield
    finally:
        _enter(home)
        os.close(home)


def _enter(descriptor: int) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    if library.setns(descriptor, CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "setns")


def members(namespace: str) -> Iterator[tuple[int, str]]:
    """Yield the id and command line of each process in a namespace."""
    try:
        inode = (FOLDER / namespace).stat().st_ino
    except FileNotFoundError:
        return
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and (entry / "ns/net").stat().st_ino == inode:
                line = (entry / "cmdline").read_bytes().rstrip(b"\0").replace(b"\0", b" ")
                yield int(entry.name), line.decode(errors="replace")
        except OSError:
            continue  # the process has just ended


def remove(namespace: str) -> None:
    """Kill every process in a namespace, including those started meanwhile, and remove the namespace."""
    while found := [pid for pid, _ in members(namespace) if pid != os.getpid()]:
        for pid in found:
            _kill(pid)
        for pid in found:
            if not wait_gone(pid, GONE_S):
                raise TimeoutError(f"process {pid} in {namespace} outlives SIGKILL by {GONE_S:g} s")
    if (FOLDER / namespace).exists():
        ip(f"netns del {namespace}")


def _kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def sweep(prefix: str) -> None:
    """Remove the namespaces PREFIX-PID-… of processes that were killed before they could do so."""
    for entry in FOLDER.iterdir() if FOLDER.is_dir() else ():
        owner = re.match(rf"{prefix}-(\d+)-", entry.name)
        if owner and not Path("/proc", owner[1]).exists():
            remove(entry.name)
