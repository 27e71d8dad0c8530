"""The process from which roles are forked: it has imported what they need, and loaded what is compiled.

Standard input is a socket of sequenced packets from the launcher. When all is loaded this process says so in a packet.
From then on each packet from the launcher is the arguments of a `zsim` command as a JSON list, with three open files:
the role's standard input, output and error. The answer is the role's process number. The role is a child of the
launcher, not of this process: that ends as soon as the launcher closes the socket, or dies.
"""

import ctypes
import gc
import json
import os
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

READY = b"ready"
PACKET_MAX = 1 << 17  # bytes, of a command line
FILES = 3  # standard input, output, error
ARG_START, ARG_END = 47, 48  # fields of /proc/self/stat, proc(5), counted from 0
PR_SET_NAME = 15  # linux/prctl.h


def main() -> int | None:
    """Fork roles until the launcher has no more to ask; in a role, run it."""
    _show_as([sys.executable, "-m", "zsim_deploy.cradle"])
    launcher = socket.socket(fileno=os.dup(0))
    _prepare()
    launcher.send(READY)
    while True:
        packet, files, _, _ = socket.recv_fds(launcher, PACKET_MAX, FILES)
        if not packet:
            return None
        pid = _fork()
        if not pid:
            launcher.close()
            return _live(json.loads(packet), files)
        for file in files:
            os.close(file)
        launcher.send(str(pid).encode())


def _prepare() -> None:
    """Import what roles import, and load what they run: who cannot, says why when it is started."""
    with suppress(Exception):
        import zsim_agents.recorder  # noqa: F401
        from zsim_deploy import cli, roles, warm_up  # noqa: F401

        cli.command().commands["record"].make_context("record", [], resilient_parsing=True)
        warm_up.main()
    gc.collect()
    gc.freeze()


def _fork() -> int:
    """Return the number of a new process whose parent is the launcher, and in that process 0.

    The one between ends at once; the launcher has asked to inherit what its descendants leave (PR_SET_CHILD_SUBREAPER).
    """
    ear, mouth = os.pipe()
    between = os.fork()
    if between:
        os.close(mouth)
        os.waitpid(between, 0)
        with open(ear) as told:
            return int(told.read())
    born = os.fork()
    if born:
        os.write(mouth, str(born).encode())
        os._exit(0)
    os.close(ear)
    os.close(mouth)
    return 0


def _live(arguments: list[str], files: list[int]) -> int | None:
    """Be the role."""
    os.setsid()
    for standard, file in enumerate(files):
        os.dup2(file, standard)
        os.close(file)
    _renew_streams()
    _show_as([sys.executable, "-m", "zsim_deploy.cli", *arguments])
    sys.argv = ["zsim", *arguments]
    from zsim_deploy import cli

    return cli.main()


def _renew_streams() -> None:
    """Let Python find out what kind of files its standard streams are now."""
    how: dict[str, Any] = {"encoding": sys.stdout.encoding, "closefd": False}
    sys.stdin = os.fdopen(0, errors=sys.stdin.errors, **how)
    sys.stdout = os.fdopen(1, "w", errors=sys.stdout.errors, **how)
    sys.stderr = os.fdopen(2, "w", buffering=1, errors=sys.stderr.errors, **how)


def _show_as(command: list[str]) -> None:
    """Let `ps` and `pgrep -f` show a command line, as far as there is room for it: that of this process was longer."""
    with suppress(OSError, ValueError, IndexError):
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        start, end = (int(fields[i - 2]) for i in (ARG_START, ARG_END))
        room = end - start
        ctypes.memmove(start, b"\0".join(word.encode() for word in command)[: room - 1].ljust(room, b"\0"), room)
    ctypes.CDLL(None).prctl(PR_SET_NAME, f"zsim {command[-1] if len(command) < 4 else command[3]}".encode()[:15])


if __name__ == "__main__":
    sys.exit(main())
