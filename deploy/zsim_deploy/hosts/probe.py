"""The program that `zsim doctor` runs on a host: reports on the host and on network paths, as JSON lines.

python -m zsim_deploy.hosts.probe about FOLDER         facts of the host, then its clock for each line of standard input
python -m zsim_deploy.hosts.probe serve PORT           answers on a port until standard input ends
python -m zsim_deploy.hosts.probe reach ADDRESS PORT   measures the path to such a port

A transfer to a port is its size in 8 bytes, big-endian, and that many bytes; one byte confirms that all have arrived.
"""

import errno
import json
import os
import platform
import select
import shutil
import socket
import statistics
import sys
import time
from pathlib import Path
from typing import Any, TextIO

from zsim import __version__
from zsim.contract.fingerprint import fingerprint, machine, parts

GOVERNORS = "/sys/devices/system/cpu"  # folder of the CPU governors; Linux, cpufreq
PINGS = 9  # number of empty transfers; their median time is the round trip
SIZE_BYTES = 8  # length of the size prefix
BULKS_BYTES = tuple(16_384 << power for power in range(9))  # transfers of up to 4 MB, which take 0.3 s at 100 Mbit/s
BULK_S = 1.0  # wall time of a transfer that is long enough to measure the bandwidth
CHUNK_BYTES = 65_536  # maximum number of bytes read at a time
TIMEOUT_S = 10.0  # wall time for a transfer; the smallest one takes this long at 13 kbit/s
SERVE_S = 60.0  # wall time without a connection after which a server ends by itself
SHORTEST_S = 1e-4  # lower bound on a transfer's time without the round trip; 4 MB in that time are 300 Gbit/s
DONE = b"."  # byte that confirms a transfer


def about(folder: Path) -> dict[str, Any]:
    """Return the facts of this host that matter for a run; `folder`: zsim's folder, which must be writable."""
    return {
        "python": platform.python_version(),
        "zsim": __version__,
        "fingerprint": fingerprint(),
        "parts": parts(),
        "machine": machine(),
        "cores": os.cpu_count() or 1,
        "load": os.getloadavg()[0],
        "governors": governors(Path(GOVERNORS)),
        "free_bytes": shutil.disk_usage(_nearest(folder)).free,
        "unwritable": unwritable(folder),
    }


def unwritable(folder: Path) -> str | None:
    """Return why a folder cannot be created or written; None if it can."""
    nearest = _nearest(folder)
    if not nearest.is_dir():
        return f"{nearest} is not a folder"
    return None if os.access(nearest, os.W_OK | os.X_OK) else f"{nearest} cannot be written"


def _nearest(folder: Path) -> Path:
    """Return the deepest existing part of a path."""
    return next(path for path in (folder, *folder.parents) if os.path.exists(path))


def clock(requests: TextIO) -> None:
    for _ in requests:
        print(json.dumps({"time_ns": time.time_ns()}), flush=True)


def governors(folder: Path) -> list[str]:
    """Return the CPU governors in use; empty if the system does not report them."""
    names = set()
    for path in folder.glob("cpu[0-9]*/cpufreq/scaling_governor"):
        try:
            names.add(path.read_text().strip())
        except OSError:
            continue
    return sorted(names)


def serve(port: int) -> None:
    """Print whether a port is ready; then confirm transfers until standard input ends or none arrives for SERVE_S."""
    try:
        server = listening(port)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        print(json.dumps({"error": reason, "taken": error.errno == errno.EADDRINUSE}))
        return
    with server:
        print(json.dumps({"ready": port}), flush=True)
        while server in (ready := select.select([server, sys.stdin], [], [], SERVE_S)[0]) and sys.stdin not in ready:
            connection, _ = server.accept()
            with connection:
                answer(connection)


def listening(port: int) -> socket.socket:
    """Return a socket that listens on all addresses, including IPv6 where available."""
    if socket.has_dualstack_ipv6():
        return socket.create_server(("", port), family=socket.AF_INET6, dualstack_ipv6=True)
    return socket.create_server(("", port))


def answer(connection: socket.socket) -> None:
    """Read each transfer and confirm it."""
    connection.settimeout(TIMEOUT_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    try:
        with connection.makefile("rb") as stream:
            while size := stream.read(SIZE_BYTES):
                remaining = int.from_bytes(size, "big")
                while remaining > 0 and (data := stream.read(min(remaining, CHUNK_BYTES))):
                    remaining -= len(data)
                connection.sendall(DONE)
    except OSError:
        return


def reach(address: str, port: int) -> dict[str, Any]:
    """Return the round trip [s] and the bandwidth [bit/s] to a host on which `serve` runs, or an error.

    The bandwidth is that of the first transfer that takes BULK_S, so that a slow link is not kept busy for minutes, or
    else that of the largest transfer.
    """
    try:
        with socket.create_connection((address, port), TIMEOUT_S) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            round_trip_s, bits_per_s = statistics.median(_send_s(link, 0) for _ in range(PINGS)), 0.0
            for size in BULKS_BYTES:
                took_s = max(_send_s(link, size) - round_trip_s, SHORTEST_S)
                bits_per_s = 8 * size / took_s
                if took_s >= BULK_S:
                    break
            return {"round_trip_s": round_trip_s, "bits_per_s": bits_per_s}
    except OSError as error:
        return {"error": error.strerror or str(error)}


def _send_s(link: socket.socket, size: int) -> float:
    """Return the time until a transfer is confirmed [s]."""
    start_s = time.monotonic()
    link.sendall(size.to_bytes(SIZE_BYTES, "big") + bytes(size))
    if not link.recv(len(DONE)):
        raise ConnectionError("the other end closed the connection")
    return time.monotonic() - start_s


def main() -> None:
    match sys.argv[1:]:
        case ["about", folder]:
            print(json.dumps(about(Path(folder).expanduser().absolute())), flush=True)
            clock(sys.stdin)
        case ["serve", port]:
            serve(int(port))
        case ["reach", address, port]:
            print(json.dumps(reach(address, int(port))))
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    main()
