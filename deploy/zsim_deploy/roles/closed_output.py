"""Output that nobody reads any more: the terminal was closed, or the end of a pipe is gone."""

import contextlib
import os
import select
import stat
from collections.abc import Sequence
from pathlib import Path

STREAMS = 1, 2  # standard output and error
CLOSED = "the terminal was closed"


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
