"""Runs a program, and ends it with its descendants when its caller is gone, even by kill -9.

    python -I -S keeper.py GRACE_S WORD...

Standard input is a pipe from the caller, which closes when the caller ends: then the program receives SIGTERM, and is
killed if it has not ended within the grace period. Signals are forwarded to its process group; SIGUSR1 kills it and its
descendants. Descendants that outlive the program are killed after the same grace period. The exit code is the
program's; 128 + N for a signal, as in shells, and 127 if it cannot be started.

This file is run by its path and imports only the standard library, so that it starts within milliseconds.
"""

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
NOT_STARTED = 127
AGAIN_S = 0.02  # between two rounds of killing


def main(grace_s: float, words: list[str]) -> int:
    early: list[int] = []
    program: subprocess.Popen[bytes] | None = None

    def forward(number: int, _: object = None) -> None:
        if program is None:
            early.append(number)
        else:
            with suppress(ProcessLookupError):
                os.killpg(program.pid, number)

    def await_caller() -> None:
        while os.read(sys.stdin.fileno(), 1):
            continue
        forward(signal.SIGTERM)
        time.sleep(grace_s)
        _kill_children()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, forward)
    signal.signal(signal.SIGUSR1, lambda *_: threading.Thread(target=_kill_children, daemon=True).start())
    if sys.platform == "linux":  # detached descendants become children of this process
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        program = subprocess.Popen(words, stdin=subprocess.DEVNULL, process_group=0)
    except OSError as error:
        sys.stderr.write(f"{words[0]!a}: cannot be started ({error.strerror})\n")
        return NOT_STARTED
    for number in early:
        forward(number)
    threading.Thread(target=await_caller, daemon=True).start()
    code = program.wait()
    forward(signal.SIGTERM)
    killer = threading.Timer(grace_s, _kill_children)
    killer.daemon = True
    killer.start()
    with suppress(ChildProcessError):  # none is left
        while True:
            os.waitpid(-1, 0)
    return code if code >= 0 else 128 - code


def _kill_children() -> None:
    """Kill all children (known on Linux only), and theirs, which become children of this process in turn."""
    while children := [pid for path in Path("/proc/self/task").glob("*/children") for pid in path.read_text().split()]:
        for pid in children:
            with suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)
        time.sleep(AGAIN_S)


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]), sys.argv[2:]))
