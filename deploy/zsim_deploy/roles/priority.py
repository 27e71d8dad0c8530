"""The priority of processes for which no gate waits: the world goes first."""

import os
import sys
import time
from contextlib import suppress
from pathlib import Path

NICE = 5  # of processes for which no gate waits
NICE_FOR_VIEWS = 10  # of those that only people look at: a picture may come later, a gate may not
AUTOGROUP = Path("/proc/self/autogroup")  # sched(7)
TRIES = 5
AGAIN_S = 0.12  # the kernel lets ordinary users write there ten times a second, all of them together


def lower_priority(only_viewed: bool = False) -> None:
    """Let the world go first. Threads to come, too.

    Args:
        only_viewed: only a person waits for it; then it does not interrupt others when it wakes up (SCHED_BATCH).
    """
    lower(NICE_FOR_VIEWS if only_viewed else NICE)
    if only_viewed and sys.platform == "linux":
        with suppress(OSError):  # it may be in a class from which one does not come back
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


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
