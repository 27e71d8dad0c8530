"""Handles output that is no longer read or cannot be written: a closed terminal, a broken pipe, a full disk.

This module imports nothing that opens files, because `renew_streams` must be called before any file is opened.
"""

import contextlib
import io
import os
import select
import stat
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

STREAMS = 1, 2  # file descriptors of standard output and error
CLOSED = "the terminal was closed"


class _Output(io.FileIO):
    """A standard stream that drops output it cannot write; it raises only BrokenPipeError."""

    _lost = False

    def write(self, data: Any, /) -> int | None:
        try:
            return super().write(data)
        except BrokenPipeError:
            raise
        except OSError as error:  # such as a full disk or a closed terminal
            if not self._lost and self.fileno() != STREAMS[-1]:
                write_error(f"cannot write to standard output ({error.strerror}); output is lost")
            self._lost = True
            return len(data)


def write_error(text: str) -> None:
    """Write a line to standard error, bypassing Python's stream, as signal handlers must; the line may be lost."""
    with contextlib.suppress(OSError):
        os.write(STREAMS[-1], f"{text}\n".encode(errors="replace"))


def renew_streams() -> None:
    """Reopen Python's standard streams, so that nothing fails because one is closed or its disk is full.

    Must be called before any file is opened: that file would otherwise get the descriptor of a closed stream, and with
    it the stream's output.
    """
    for number in (0, *STREAMS):
        try:
            os.fstat(number)
        except OSError:
            empty = os.open(os.devnull, os.O_RDWR)
            if empty != number:
                os.dup2(empty, number)
                os.close(empty)
    encodings = [getattr(stream, "encoding", None) for stream in (sys.stdin, sys.stdout, sys.stderr)]
    sys.stdin = os.fdopen(0, encoding=encodings[0], errors=getattr(sys.stdin, "errors", None), closefd=False)
    out, error = (io.BufferedWriter(_Output(number, "w", closefd=False)) for number in STREAMS)
    # Characters that the terminal's encoding lacks become question marks instead of raising errors.
    sys.stdout = io.TextIOWrapper(out, encodings[1], "replace", line_buffering=os.isatty(STREAMS[0]))
    sys.stderr = io.TextIOWrapper(error, encodings[2], "replace", line_buffering=True)


def is_unread(stream: int) -> bool:
    with contextlib.suppress(OSError):
        if stat.S_ISFIFO(os.fstat(stream).st_mode) and hasattr(select, "poll"):  # not on Windows
            poller = select.poll()
            poller.register(stream, 0)
            return bool(poller.poll(0))  # poll always reports errors
    return False


def redirect_output(log: Path, streams: Sequence[int] = STREAMS, why: str = CLOSED) -> None:
    """Redirect further output, except that of streams writing to a file, to the file `log`; drop it if that fails."""
    try:
        into, where = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644), f"goes to {log}"
    except OSError as error:
        into, where = os.open(os.devnull, os.O_WRONLY), f"is lost, because {log} cannot be written ({error.strerror})"
    lost = []
    for stream in streams:
        with contextlib.suppress(OSError):  # the stream is not open at all
            lost += [] if stat.S_ISREG(os.fstat(stream).st_mode) else [stream]
    if lost:
        write_error(f"{why}; further output {where}")
    for stream in lost:
        os.dup2(into, stream)
    os.close(into)
