"""How many files a process may have open (RLIMIT_NOFILE, `ulimit -n`): checked before one more would fail somewhere.

Zenoh panics, or waits without end, where a socket or a thread's event queue cannot be opened.
"""

import sys

from zsim.errors import SessionError

SESSION_FILES = 32  # of a process with a session; 22 measured, and room for what is read while it loads
CLIENT_FILES = 3  # of a hub, for each process that connects; 2.2 measured, more while many connect at once
ROLE_FILES = 2  # of a launcher, for each process that it starts: its standard input and its log
HOST_FILES = 2  # of a launcher, for each host: its ssh connection, and a file that is copied there
WORKER_FILES = 4  # of a sweep, for each worker: both ends of its pipe and what ends with it
SERVER_FILES = 256  # of a gateway or console: a session, and 100 connections each of HTTP and lines that make room
SPARE_CLIENTS = 4  # of a hub, for who comes beside the processes of the run: a console, `zsim echo`


def hub_files(clients: int) -> int:
    """Return how many files a hub needs for so many processes that connect to it."""
    return SESSION_FILES + CLIENT_FILES * (clients + SPARE_CLIENTS)


def launcher_files(roles: int, names: int) -> int:
    """Return how many files a run needs, in the process that needs most.

    Args:
        roles: processes that are started, the world among them.
        names: of processes that the world waits for: more than are started, where one does the work of many.
    """
    return max(hub_files(max(roles - 1, names)), SESSION_FILES + ROLE_FILES * roles)


def host_launcher_files(roles: int, hosts: int) -> int:
    """Return how many files the launcher of a run on several hosts needs."""
    return SESSION_FILES + ROLE_FILES * roles + HOST_FILES * hosts


def require_files(needed: int, what: str) -> None:
    """Raise the soft limit to what is needed, where it is lower.

    Args:
        needed: number of files open at once.
        what: needs them, for the error: "12 processes".

    Raises:
        SessionError: the hard limit does not allow it.
    """
    allowed = allow_files(needed)
    if allowed is not None and allowed < needed:
        raise SessionError(f"open files are {allowed} at most; must be {needed} for {what}: `ulimit -n {needed}`")


def allow_files(wanted: int) -> int | None:
    """Raise the soft limit to what is wanted, as far as the hard one allows; return it, None where there is none."""
    if sys.platform == "win32":
        return None
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return None if soft == resource.RLIM_INFINITY else soft
    soft = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return soft
