"""The signals that end a launcher, and where its output goes when its terminal is closed."""

import contextlib
import os
import signal
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

STREAMS = 1, 2  # standard output and error
CLOSED = "the terminal was closed"


class EndSignals:
    """Takes SIGTERM and SIGHUP for as long as it is entered; SIGHUP stays ignored under nohup.

    Nothing is raised for a closed terminal, as shells send that signal more than once: `hung_up` is called, and output
    goes to a file from then on.

    Args:
        log: that file; it is made when there is something to write.
        hung_up: called in a signal handler when the terminal is closed.

    Attributes:
        closed: whether it was.
    """

    def __init__(self, log: Path, hung_up: Callable[[], None]) -> None:
        self._log = log
        self._hung_up = hung_up
        self.closed = False

    def __enter__(self) -> "EndSignals":
        wanted: dict[int, Any] = {signal.SIGTERM: signal.default_int_handler}
        if hasattr(signal, "SIGHUP"):  # not on Windows
            wanted[signal.SIGHUP] = self._on_hangup
        self._former = {number: signal.getsignal(number) for number in wanted}
        for number, handler in wanted.items():
            if self._former[number] is not signal.SIG_IGN:
                signal.signal(number, handler)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)

    def _on_hangup(self, *_: object) -> None:
        self.closed = True
        redirect_output(self._log)
        self._hung_up()


def redirect_output(log: Path) -> None:
    """Send to a file what is written from now on to a terminal or a pipe, which may take nothing any more."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
    try:
        into = os.open(log, flags, 0o644)
    except OSError:
        into = os.open(os.devnull, os.O_WRONLY)
    for stream in STREAMS:
        with contextlib.suppress(OSError):
            if not stat.S_ISREG(os.fstat(stream).st_mode):
                _announce(stream, log)
                os.dup2(into, stream)
    os.close(into)


def _announce(stream: int, log: Path) -> None:
    if stream == STREAMS[-1]:
        with contextlib.suppress(OSError):
            os.write(stream, f"{CLOSED}; what there is still to say is in {log}\n".encode())
