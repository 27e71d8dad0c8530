"""The fork server: imports the modules of roles, loads the compiled kernels, and forks a role for each request.

Standard input is a sequenced-packet socket to the launcher. When everything is loaded, the fork server sends READY.
From then on, each packet from the launcher contains the arguments of a `zsim` command as a JSON list, with four open
files: the role's standard input, output and error, and one from which it reads a byte before it begins. The reply is
the role's process id. The role is a child of the launcher, not of this process, which ends as soon as the launcher
closes the socket or dies. A role whose process id has not reached the launcher never gets that byte, and ends too.
"""

import atexit
import ctypes
import gc
import json
import os
import signal
import socket
import sys
import threading
import traceback
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from zsim.errors import printable
from zsim_deploy import SAFE_PATH
from zsim_deploy.roles.closed_output import renew_streams

READY = b"ready"
PACKET_MAX = 1 << 17  # maximum size of a packet [bytes]
FILES = 4  # open files with each packet: standard input, output and error, and the one for the starting byte
ARG_START, ARG_END = 47, 48  # indices of fields in /proc/self/stat, from 0; proc(5)
PR_SET_PDEATHSIG, PR_SET_NAME = 1, 15  # linux/prctl.h


def main() -> None:
    """Fork roles until the launcher closes the socket; in a forked process, run the role."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # not inherited by forked processes
    _show_as("forkserver", [sys.executable, SAFE_PATH, "-m", "zsim_deploy.cli.forkserver", *sys.argv[1:2]])
    launcher = socket.socket(fileno=os.dup(0))
    _prepare()
    launcher.send(READY)
    while True:
        packet, files, _, _ = socket.recv_fds(launcher, PACKET_MAX, FILES)
        if not packet:
            return
        pid = _fork()
        if not pid:
            launcher.close()
            _run_role(json.loads(packet), files)
        for file in files:
            os.close(file)
        launcher.send(str(pid).encode())


def _prepare() -> None:
    """Import the modules of roles, and load the kernels; errors are left to the roles, which report them."""
    with suppress(Exception):
        import zsim_agents.recorder  # noqa: F401
        from zsim_deploy.cli import cli
        from zsim_deploy.roles import roles, warm_up  # noqa: F401

        cli.command().commands["record"].make_context("record", [], resilient_parsing=True)
        warm_up.main(warm_up.WITH_WORLD)
    gc.collect()
    gc.freeze()


def _fork() -> int:
    """Fork a process whose parent is the launcher; return its process id, or 0 in the new process.

    An intermediate process ends at once, and the launcher inherits its child (PR_SET_CHILD_SUBREAPER).
    """
    reader, writer = os.pipe()
    intermediate = os.fork()
    if intermediate:
        os.close(writer)
        os.waitpid(intermediate, 0)
        with open(reader) as pid_pipe:
            return int(pid_pipe.read())
    pid = os.fork()
    if pid:
        os.write(writer, str(pid).encode())
        os._exit(0)
    os.close(reader)
    os.close(writer)
    return 0


def _run_role(arguments: list[str], files: list[int]) -> NoReturn:
    """Run the role once the launcher has its process id, and end this process."""
    *standard, go = files
    if not os.read(go, 1):
        os._exit(0)
    os.close(go)
    os.setsid()
    for number, file in enumerate(standard):
        os.dup2(file, number)
        os.close(file)
    renew_streams()
    _show_as(arguments[0], [sys.executable, SAFE_PATH, "-m", "zsim_deploy.cli", *arguments])
    sys.argv = ["zsim", *arguments]
    code: object = 1
    try:
        from zsim_deploy.cli import cli

        cli.main()
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
    finally:
        finish(code)


def finish(code: object) -> NoReturn:
    """End this process as the interpreter does, but without freeing objects.

    A role shares with the fork server the memory pages of all imported modules; freeing objects would copy every page.
    """
    with suppress(BaseException):
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
    with suppress(BaseException):
        if isinstance(code, str):
            print(printable(code), file=sys.stderr)
    for stream in (sys.stdout, sys.stderr):
        with suppress(BaseException):
            stream.flush()
    os._exit(code if isinstance(code, int) else 0 if code is None else 1)


def _show_as(name: str, command: list[str]) -> None:
    """Set the command line that `ps` and `pgrep -f` show, truncated to the length of this process's original one."""
    with suppress(OSError, ValueError, IndexError):
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        start, end = (int(fields[i - 2]) for i in (ARG_START, ARG_END))
        room = end - start
        ctypes.memmove(start, b"\0".join(word.encode() for word in command)[: room - 1].ljust(room, b"\0"), room)
    ctypes.CDLL(None).prctl(PR_SET_NAME, f"zsim {name}".encode()[:15])


if __name__ == "__main__":
    main()
