"""The TCP connections of this process, by the address of their far end: what each holds back, and closing one.

Zenoh shows neither, and has its sockets linger for 10 s when it closes them itself, as that of a process that is
stopped in realtime: in these the thread that closes, which passes on what others publish, does nothing else. So none
lingers that was seen once. Only Linux shows connections; elsewhere there are none.
"""

import os
import socket
import stat
import struct
import sys
from contextlib import suppress
from typing import NamedTuple

if sys.platform == "linux":
    import fcntl
    import termios

OWN_FILES = "/proc/self/fd"
TCP_INFO = struct.Struct("68xI48xQ")  # tcpi_rtt [µs] and tcpi_bytes_acked in struct tcp_info, linux/tcp.h
RESET, IN_BACKGROUND = struct.pack("ii", 1, 0), struct.pack("ii", 0, 0)  # struct linger, socket(7)
QUEUED = struct.Struct("i")  # of SIOCOUTQ, linux/sockios.h: bytes that the far end has not acknowledged


class Progress(NamedTuple):
    """How many bytes a far end has acknowledged so far, -1 if it is gone, and how long that takes [s]."""

    acknowledged: int
    round_trip_s: float


class LinkSockets:
    """The connections as they are now; callable from any thread."""

    def __init__(self) -> None:
        self._far: dict[tuple[int, int], str] = {}  # address by file and inode; empty for what is no connection

    def queued(self) -> dict[str, int]:
        """Return how many bytes wait for each far end in the kernel."""
        if sys.platform != "linux":
            return {}
        waiting = {}
        for file, address in self._connections().items():
            with suppress(OSError):
                waiting[address] = QUEUED.unpack(fcntl.ioctl(file, termios.TIOCOUTQ, bytes(QUEUED.size)))[0]
        return waiting

    def progress(self, address: str) -> Progress:
        """Return how far a far end has come."""
        with suppress(OSError), self._open(address) as connection:
            info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO.size)
            round_trip_us, acknowledged = TCP_INFO.unpack(info)
            return Progress(acknowledged, round_trip_us / 1e6)
        return Progress(-1, 0.0)

    def close(self, address: str) -> None:
        """Close a connection and forget what it holds back; for Zenoh it is lost then."""
        with suppress(OSError), self._open(address) as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            connection.shutdown(socket.SHUT_RDWR)

    def _open(self, address: str) -> socket.socket:
        """Return a connection as a socket of our own.

        Raises:
            OSError: it is gone.
        """
        for file, far in self._connections().items():
            if far == address:
                duplicate = socket.socket(fileno=os.dup(file))
                if _far_end(duplicate) == address:
                    return duplicate
                duplicate.close()
        raise OSError(f"{address}: no connection")

    def _connections(self) -> dict[int, str]:
        found = {}
        for name in os.listdir(OWN_FILES):
            with suppress(OSError):
                status = os.fstat(int(name))
                if stat.S_ISSOCK(status.st_mode):
                    found[int(name), status.st_ino] = ""
        self._far = {key: self._far[key] if key in self._far else _first_seen(key[0]) for key in found}
        return {file: address for (file, _), address in self._far.items() if address}


def _first_seen(file: int) -> str:
    """Return the far end of a file, empty where it is no connection; who closes it from now on does not linger."""
    try:
        with socket.socket(fileno=os.dup(file)) as duplicate:
            if address := _far_end(duplicate):
                duplicate.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, IN_BACKGROUND)
            return address
    except OSError:
        return ""


def _far_end(connection: socket.socket) -> str:
    """Return the far end of a TCP connection as Zenoh writes it, empty for any other socket."""
    if connection.family not in (socket.AF_INET, socket.AF_INET6) or connection.type != socket.SOCK_STREAM:
        return ""
    try:
        host, port, *_ = connection.getpeername()
    except OSError:
        return ""  # it listens
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
