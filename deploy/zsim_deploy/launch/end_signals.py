"""What ends a launcher: signals, and that nobody reads its output; and where that goes then."""

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from zsim_deploy.roles.closed_output import CLOSED, STREAMS, is_unread, redirect_output

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
