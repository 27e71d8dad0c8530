"""The process of this machine at the other end of a TCP connection; Linux alone shows it."""

import os
import socket
import struct
from contextlib import suppress
from pathlib import Path

TABLES = ("/proc/net/tcp", "/proc/net/tcp6")
COMMAND_MAX = 80  # characters of a command line that are shown


def local_socket(address: str) -> str:
    """Return the inode of the socket whose end has an address; empty if it is not on this machine."""
    host, _, port = address.rpartition(":")
    return _inode(f"{_table_form(host.strip('[]'))}:{int(port):04X}")


def command(pid: str) -> str:
    """Return pid and command of a process; empty without a pid."""
    if not pid:
        return ""
    with suppress(OSError):
        line = (Path("/proc") / pid / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        return f"pid {pid} ({' '.join(line.split())[:COMMAND_MAX]})"
    return f"pid {pid}"


def owner(inode: str) -> str:
    """Return the pid of the process that has a socket open; empty if there is none, or we may not know."""
    for pid in filter(str.isdigit, os.listdir("/proc")) if inode else ():
        with suppress(OSError), os.scandir(f"/proc/{pid}/fd") as files:
            for file in files:
                with suppress(OSError):  # closed meanwhile
                    if os.readlink(file.path) == f"socket:[{inode}]":
                        return pid
    return ""


def _table_form(host: str) -> str:
    """Return an address as those tables have it: 32-bit words in this machine's order, as on all that Linux has."""
    packed = socket.inet_pton(socket.AF_INET6 if ":" in host else socket.AF_INET, host)
    words = struct.unpack(f"={len(packed) // 4}I", packed)
    return "".join(f"{word:08X}" for word in words)


def _inode(end: str) -> str:
    for table in TABLES:
        with suppress(OSError), open(table, encoding="ascii") as lines:
            for line in lines:
                fields = line.split()
                if fields[1] == end and fields[9] != "0":
                    return fields[9]
    return ""
