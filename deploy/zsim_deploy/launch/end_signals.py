"""What ends a launcher: signals, and that nobody reads its output; and where that goes then."""

import contextlib
import os
import select
import signal
import stat
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

STREAMS = 1, 2  # standard output and error
CLOSED = "the terminal was closed"
UNREAD = "nobody reads the output any more"  # as of `zsim run … | head`
LOOK_S = 0.1  # between two looks at who reads the output


class EndSignals:
    """Takes SIGTERM and SIGHUP for as long as it is entered; SIGHUP stays ignored under nohup.

    Nothing is raised for a closed terminal, as shells send that signal more than once: `hung_up` is called, and output
    goes to a file from then on.

    Args:
        log: that file; it is made when there is something to write.
        hung_up: called, in a signal handler too, when nothing more can be drawn.

    Attributes:
        reason: why there is nobody any more who would see the run; empty while there is.
    """

    def __init__(self, log: Path, hung_up: Callable[[], None]) -> None:
        self._log = log
        self._hung_up = hung_up
        self.reason = ""
        self._looked_s = 0.0

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
        self.reason = CLOSED
        redirect_output(self._log)
        self._hung_up()

    def look(self) -> None:
        """Notice that the reader of a pipe has gone; to be called again and again: nothing need be written for it."""
        if time.monotonic() - self._looked_s < LOOK_S:
            return
        unread = [stream for stream in STREAMS if is_unread(stream)]
        if unread:
            self.reason = self.reason or UNREAD
            redirect_output(self._log, unread, UNREAD)
        if STREAMS[-1] in unread:
            self._hung_up()
        self._looked_s = time.monotonic()


def is_unread(stream: int) -> bool:
    """Tell whether a stream is a pipe at the end of which nobody is."""
    with contextlib.suppress(OSError):
        if stat.S_ISFIFO(os.fstat(stream).st_mode) and hasattr(select, "poll"):  # not on Windows
            poller = select.poll()
            poller.register(stream, 0)
            return bool(poller.poll(0))  # an error is reported whatever is asked for
    return False


def redirect_output(log: Path, streams: Sequence[int] = STREAMS, why: str = CLOSED) -> None:
    """Send to a file what is written from now on to a terminal or a pipe, which may take nothing any more."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
    try:
        into = os.open(log, flags, 0o644)
    except OSError:
        into = os.open(os.devnull, os.O_WRONLY)
    lost = [stream for stream in streams if not _is_file(stream)]
    if lost:
        with contextlib.suppress(OSError):
            os.write(STREAMS[-1], f"{why}; what there is still to say is in {log}\n".encode())
    for stream in lost:
        os.dup2(into, stream)
    os.close(into)


def _is_file(stream: int) -> bool:
    """Tell whether a stream is a file already, or is not open at all."""
    try:
        return stat.S_ISREG(os.fstat(stream).st_mode)
    except OSError:
        return True
