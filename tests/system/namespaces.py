"""Network namespaces by iproute2: make, enter, list who runs in them, take away with everybody in them."""

import ctypes
import os
import re
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from federation import wait_gone

FOLDER = Path("/run/netns")  # where iproute2 keeps them
CLONE_NEWNET = 0x40000000  # linux/sched.h
GONE_S = 120.0  # wall time for a killed process to vanish, on a machine that does other things too
SBIN = "/usr/sbin:/sbin"  # often missing in a PATH


def environment() -> dict[str, str]:
    """Return the environment with the folders in which a system keeps the tools of its administrator."""
    return {**os.environ, "PATH": f"{os.environ.get('PATH', '/usr/bin:/bin')}:{SBIN}"}


def checked(command: Sequence[str], stdin: str = "") -> str:
    """Run a command that must succeed and return what it prints."""
    done = subprocess.run(command, input=stdin, text=True, capture_output=True, timeout=GONE_S, env=environment())
    if done.returncode:
        raise OSError(f"{' '.join(command)} failed: {done.stderr.strip()}")
    return done.stdout


def ip(*lines: str, within: str | None = None) -> None:
    """Run lines of `ip` in one go, in a namespace or outside of all."""
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
    """Yield id and command line of the processes in a namespace."""
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
            continue  # it has just ended


def remove(namespace: str) -> None:
    """Kill every process in a namespace, those too that are started meanwhile, and take it away."""
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
    """Take away the namespaces PREFIX-PID-… of processes that were killed before they could do it."""
    for entry in FOLDER.iterdir() if FOLDER.is_dir() else ():
        owner = re.match(rf"{prefix}-(\d+)-", entry.name)
        if owner and not Path("/proc", owner[1]).exists():
            remove(entry.name)
