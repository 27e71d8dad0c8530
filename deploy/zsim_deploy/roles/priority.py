"""The priority of processes for which no gate waits: the world goes first."""

import os
import sys
import time
from pathlib import Path

NICE = 5  # of processes for which no gate waits
AUTOGROUP = Path("/proc/self/autogroup")  # sched(7)
TRIES = 5
AGAIN_S = 0.12  # the kernel lets ordinary users write there ten times a second, all of them together


def lower_priority() -> None:
    """Let the world go first. Threads to come, too."""
    lower(NICE)


def lower(niceness: int) -> None:
    """Make this process nicer, and with it the session that it leads, if it does.

    Where Linux shares processors between sessions, niceness counts within each of them only.
    """
    if hasattr(os, "nice"):
        os.nice(niceness)
    if sys.platform == "linux" and os.getsid(0) == os.getpid():
        _lower_session(niceness)


def _lower_session(niceness: int) -> None:
    for _ in range(TRIES):
        try:
            AUTOGROUP.write_text(str(niceness))
        except BlockingIOError:
            time.sleep(AGAIN_S)
        except OSError:
            return  # not shared that way here, or not ours to set
        else:
            return
