"""Limits the backlog of the hub's links: a stalled reader that the run does not wait for loses its link.

On a full link Zenoh either drops messages or blocks the sender, and with it the run; which of the two can be chosen per
key only, not per reader. Participants must lose nothing, so all messages block; a reader that the run does not wait for
is therefore disconnected before its link is full, and kept out for a while if it reconnects and stalls repeatedly.

Order of this file: the watch, the sessions of each process, the TCP connections of this process, and the local
processes at their far ends.
"""

import os
import socket
import stat
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from zsim.contract import keys
from zsim.transport.session import FarEnd, Session

if sys.platform == "linux":
    import fcntl
    import termios

LOOK_S = 0.05  # wall time between checks
# The Zenoh thread that closes links also forwards the participants' messages. Once a full link blocks this thread, the
# link remains open for HUB_CLOSE_AFTER_US; it must therefore be closed earlier, while the kernel still accepts data.
STALL_BYTES = 1 << 16  # unacknowledged bytes at which a link is watched; the kernel accepts 0.4 MB or more (measured)
STALL_S = 0.1  # wall time within which a live far end acknowledges something, in addition to …
ROUND_TRIPS = 3.0  # … this many of its round trips
BACKLOG_MAX_BYTES, BACKLOG_MAX_S = 1 << 20, 1.0  # limits for a reader that keeps reading, but never catches up
REFRESH_PERIOD_S = 0.2  # wall time between updates of the sessions at the far ends
CLOSURES_MAX, CLOSURES_WINDOW_S = 3, 60.0  # a session whose links are closed this often within this time is kept out …
EXCLUSION_S = 30.0  # … for this time
REPORT_PERIOD_S = 10.0  # wall time between reports on one session

OWN_FILES = "/proc/self/fd"
TCP_INFO = struct.Struct("68xI48xQ")  # tcpi_rtt [µs] and tcpi_bytes_acked in struct tcp_info, linux/tcp.h
RESET, IN_BACKGROUND = struct.pack("ii", 1, 0), struct.pack("ii", 0, 0)  # struct linger, socket(7)
QUEUED = struct.Struct("i")  # result of SIOCOUTQ, linux/sockios.h: unacknowledged bytes
TABLES = ("/proc/net/tcp", "/proc/net/tcp6")
COMMAND_MAX = 80  # characters shown of a command line


class Awaited(NamedTuple):
    """A process that the run waits for: its name, those of processes it replaces, and the pid in its join message."""

    names: tuple[str, ...]
    pid: int


class ClosedLink(NamedTuple):
    """A link that was closed."""

    address: str  # address of its far end
    process: str  # pid and command of the process there, if on this machine
    names: tuple[str, ...]  # names of the processes with its session
    held_bytes: int  # bytes in the kernel's send queue
    times: int  # how often links of its session have been closed


@dataclass
class _Backlog:
    """The backlog of a link: bytes acknowledged, and wall times of the last progress and of the last low backlog."""

    acknowledged: int
    moved_s: float
    low_s: float


class LinkWatch:
    """Watches the links of the hub in a separate thread; a context manager."""

    def __init__(
        self,
        link: Session,
        tokens: "SessionTokens",
        awaited: Callable[[], list[Awaited]],  # returns the participants, which must lose nothing
        sockets: "LinkSockets | None" = None,
        wall_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link = link
        self._tokens = tokens
        self._awaited = awaited
        self._sockets = sockets or LinkSockets()
        self._wall_s = wall_s
        self._backlogs: dict[str, _Backlog] = {}
        self._far_ends: dict[str, FarEnd] = {}
        self._refreshed_s = -REFRESH_PERIOD_S
        self._times: dict[str, list[float]] = {}  # wall times at which links were closed, by session
        self._reported_s: dict[str, float] = {}  # wall time of the last report, by session
        self._excluded_until_s: dict[str, float] = {}
        self._stop_event = threading.Event()
        self._thread = threading.Thread(target=self._run, name="links", daemon=True)
        # links closed, oldest first, at most one per session in REPORT_PERIOD_S; consumed by the caller
        self.closed: deque[ClosedLink] = deque()

    def __enter__(self) -> "LinkWatch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_event.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop_event.wait(LOOK_S):
            self.look()

    def look(self) -> None:
        """Check all links once, and close stalled ones that the run does not wait for."""
        now_s, queued = self._wall_s(), self._sockets.queued()
        self._backlogs = {address: self._backlogs[address] for address in queued if address in self._backlogs}
        for address, held_bytes in queued.items():
            if self._holds_up(address, held_bytes, now_s) or self._is_excluded(address, now_s):
                self._judge(address, held_bytes, now_s)

    def stuck(self) -> list[str]:
        """Return the processes at the far ends of stalled links, the fullest link first."""
        queued, before_s = self._sockets.queued(), self._wall_s() - STALL_S
        stalled = [address for address, backlog in self._backlogs.copy().items() if backlog.moved_s <= before_s]
        lines = []
        for address in sorted(stalled, key=lambda address: -queued.get(address, 0)):
            far_end = self._far_ends.get(address)
            names = self._tokens.processes(far_end.session) if far_end else ()
            processes = " ".join(names) or ("a router" if far_end and far_end.is_router else "an unknown process")
            lines.append(f"{processes} at {address}")
        return lines

    def _holds_up(self, address: str, held_bytes: int, now_s: float) -> bool:
        """Return whether the far end of a link acknowledges nothing, or never catches up."""
        if held_bytes < STALL_BYTES:
            self._backlogs.pop(address, None)
            return False
        acknowledged, round_trip_s = self._sockets.progress(address)
        backlog = self._backlogs.setdefault(address, _Backlog(acknowledged, now_s, now_s))
        if acknowledged != backlog.acknowledged:
            backlog.acknowledged, backlog.moved_s = acknowledged, now_s
        if held_bytes < BACKLOG_MAX_BYTES:
            backlog.low_s = now_s
        stall_s = STALL_S + ROUND_TRIPS * round_trip_s
        return now_s - backlog.moved_s >= stall_s or now_s - backlog.low_s >= BACKLOG_MAX_S

    def _is_excluded(self, address: str, now_s: float) -> bool:
        if now_s >= max(self._excluded_until_s.values(), default=now_s):
            return False
        far_end = self._far_end(address, now_s)
        return far_end is not None and now_s < self._excluded_until_s.get(far_end.session, now_s)

    def _far_end(self, address: str, now_s: float) -> FarEnd | None:
        if now_s - self._refreshed_s >= REFRESH_PERIOD_S:
            self._refreshed_s = now_s
            self._far_ends = self._link.far_ends()
        return self._far_ends.get(address)

    def _judge(self, address: str, held_bytes: int, now_s: float) -> None:
        """Close a link unless a participant is, or may be, at its far end."""
        far_end, inode = self._far_end(address, now_s), local_socket(address)
        if far_end is None or far_end.is_router:
            return
        awaited, names = self._awaited(), self._tokens.processes(far_end.session)
        if any(name in each.names for each in awaited for name in names):
            return
        pid = owner(inode)
        if not names:  # without tokens, only its pid may identify it
            unknown = [each.pid for each in awaited if not any(map(self._tokens.sessions, each.names))]
            if int(pid) in unknown if pid else unknown:
                return
        self._sockets.close(address)
        self._backlogs.pop(address, None)
        times = self._times.setdefault(far_end.session, [])
        times.append(now_s)
        if len(times) >= CLOSURES_MAX and now_s - times[-CLOSURES_MAX] < CLOSURES_WINDOW_S:
            self._excluded_until_s[far_end.session] = now_s + EXCLUSION_S
        # a link without a backlog, such as that of a session kept out, is not reported
        if (
            held_bytes >= STALL_BYTES
            and now_s - self._reported_s.get(far_end.session, -REPORT_PERIOD_S) >= REPORT_PERIOD_S
        ):
            self._reported_s[far_end.session] = now_s
            self.closed.append(ClosedLink(address, command(pid), names, held_bytes, len(times)))


Sessions = frozenset[str]  # Zenoh's identifiers, in hexadecimal


class SessionTokens:
    """The sessions of each process, known from liveliness tokens and updated on Zenoh's threads.

    A token `process/{p}` shows that a process is alive, but not its session: Zenoh does not name the holder, and a
    query of its admin space, which does, can block a router forever (eclipse-zenoh/zenoh#2619). So each process also
    declares `process/{p}/session/{session}`.
    """

    def __init__(self, link: Session) -> None:
        self._link = link
        self._sessions: dict[str, Sessions] = {}  # by process
        self._alive: set[str] = set()

    def watch(self) -> None:
        """Follow the tokens from now on, including existing ones."""
        self._link.on_token(keys.token("**"), self._on_token)

    def sessions(self, process: str) -> Sessions:
        """Return the sessions declared by a process."""
        return self._sessions.get(process, Sessions())

    def shown(self) -> list[str]:
        return list(self._sessions)

    def is_alive(self, process: str) -> bool:
        """Return whether any session has declared a token of a process."""
        return process in self._alive or process in self._sessions

    def processes(self, session: str) -> tuple[str, ...]:
        return tuple(process for process, sessions in list(self._sessions.items()) if session in sessions)

    def _on_token(self, key: str, alive: bool) -> None:
        _, process, what = keys.parts(key)
        if not what:
            (self._alive.add if alive else self._alive.discard)(process)
        elif session := keys.session_of(key):
            others = self.sessions(process) - {session}
            present = others | {session} if alive else others
            if present:
                self._sessions[process] = present
            else:
                self._sessions.pop(process, None)


class Progress(NamedTuple):
    """The bytes that a far end has acknowledged (-1 if it is gone), and its round-trip time [s]."""

    acknowledged: int
    round_trip_s: float


class LinkSockets:
    """The TCP connections of this process, by the address of their far end; callable from any thread.

    Zenoh does not expose them, and lets a socket linger for 10 s when it closes the socket itself, such as that of a
    stopped process in realtime; this blocks the thread that also forwards messages. So lingering is disabled on every
    socket found here. Connections are only found on Linux.
    """

    def __init__(self) -> None:
        self._addresses: dict[tuple[int, int], str] = {}  # by file descriptor and inode; empty if not a connection

    def queued(self) -> dict[str, int]:
        """Return the bytes in the kernel's send queue of each far end."""
        if sys.platform != "linux":
            return {}
        waiting = {}
        for file, address in self._connections().items():
            with suppress(OSError):
                waiting[address] = QUEUED.unpack(fcntl.ioctl(file, termios.TIOCOUTQ, bytes(QUEUED.size)))[0]
        return waiting

    def progress(self, address: str) -> Progress:
        with suppress(OSError), self._open(address) as connection:
            info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO.size)
            round_trip_us, acknowledged = TCP_INFO.unpack(info)
            return Progress(acknowledged, round_trip_us / 1e6)
        return Progress(-1, 0.0)

    def close(self, address: str) -> None:
        """Close a connection and drop its backlog; Zenoh treats it as lost."""
        with suppress(OSError), self._open(address) as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            connection.shutdown(socket.SHUT_RDWR)

    def _open(self, address: str) -> socket.socket:
        """Return a duplicate of a connection's socket; OSError if it is gone."""
        for file, far_address in self._connections().items():
            if far_address == address:
                duplicate = socket.socket(fileno=os.dup(file))
                if _far_end(duplicate) == address:
                    return duplicate
                duplicate.close()
        raise OSError(f"{address}: no connection")

    def _connections(self) -> dict[int, str]:
        """Return the addresses of the TCP connections' far ends by file descriptor, and disable lingering on all."""
        addresses: dict[tuple[int, int], str] = {}
        for name in os.listdir(OWN_FILES):
            with suppress(OSError):
                file, status = int(name), os.fstat(int(name))
                if not stat.S_ISSOCK(status.st_mode):
                    continue
                cached = self._addresses.get((file, status.st_ino))
                addresses[file, status.st_ino] = cached or ""
                if cached is None:
                    with socket.socket(fileno=os.dup(file)) as duplicate:
                        if address := _far_end(duplicate):
                            duplicate.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, IN_BACKGROUND)
                            addresses[file, status.st_ino] = address
        self._addresses = addresses
        return {file: address for (file, _), address in addresses.items() if address}


def _far_end(connection: socket.socket) -> str:
    """Return the far end of a TCP connection in Zenoh's notation; empty for any other socket."""
    if connection.family not in (socket.AF_INET, socket.AF_INET6) or connection.type != socket.SOCK_STREAM:
        return ""
    try:
        host, port, *_ = connection.getpeername()
    except OSError:
        return ""  # a listening socket
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def local_socket(address: str) -> str:
    """Return the inode of the local socket bound to an address; empty if it is on another machine, or not on Linux."""
    host, _, port = address.rpartition(":")
    host = host.strip("[]")
    packed = socket.inet_pton(socket.AF_INET6 if ":" in host else socket.AF_INET, host)
    words = struct.unpack(f"={len(packed) // 4}I", packed)  # as in the tables: 32-bit words in the machine's byte order
    end = "".join(f"{word:08X}" for word in words) + f":{int(port):04X}"
    for table in TABLES:
        with suppress(OSError), open(table, encoding="ascii") as lines:
            for line in lines:
                fields = line.split()
                if fields[1] == end and fields[9] != "0":
                    return fields[9]
    return ""


def owner(inode: str) -> str:
    """Return the pid of a process that has a socket open; empty if no accessible process has."""
    for pid in filter(str.isdigit, os.listdir("/proc")) if inode else ():
        with suppress(OSError), os.scandir(f"/proc/{pid}/fd") as files:
            for file in files:
                with suppress(OSError):  # the file may have been closed in the meantime
                    if os.readlink(file.path) == f"socket:[{inode}]":
                        return pid
    return ""


def command(pid: str) -> str:
    """Return the pid and command of a process for reports; empty without a pid."""
    if not pid:
        return ""
    with suppress(OSError):
        line = (Path("/proc") / pid / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        return f"pid {pid} ({' '.join(line.split())[:COMMAND_MAX]})"
    return f"pid {pid}"
