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


def owner(inode: str) -> str:
    """Return pid and command of the process that has a socket open; empty if we may not know."""
    pid = _owner(inode) if inode else ""
    with suppress(OSError):
        command = (Path("/proc") / pid / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        return f"pid {pid} ({' '.join(command.split())[:COMMAND_MAX]})" if pid else ""
    return f"pid {pid}"


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


def _owner(inode: str) -> str:
    for pid in filter(str.isdigit, os.listdir("/proc")):
        with suppress(OSError):
            for file in os.scandir(f"/proc/{pid}/fd"):
                if os.readlink(file.path) == f"socket:[{inode}]":
                    return pid
    return ""
