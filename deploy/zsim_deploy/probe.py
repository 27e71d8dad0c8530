"""What a host says of itself, and how well it reaches another: run there by `zsim doctor`, a JSON line each.

python -m zsim_deploy.probe about
python -m zsim_deploy.probe serve PORT
python -m zsim_deploy.probe reach ADDRESS PORT
"""

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
from typing import Any

from zsim import __version__
from zsim.fingerprint import fingerprint

GOVERNORS = "/sys/devices/system/cpu"  # Linux, cpufreq
PINGS = 20
PING = b"p"
BULK_BYTES = 4_000_000  # takes 0.3 s on a link of 100 Mbit/s
CHUNK_BYTES = 65_536
PATIENCE_S = 5.0
SERVE_S = 60.0  # a server that nobody needs any more ends by itself


def about() -> dict[str, Any]:
    """Return what matters for a run about this host."""
    return {
        "python": platform.python_version(),
        "zsim": __version__,
        "fingerprint": fingerprint(),
        "cores": os.cpu_count() or 1,
        "load": os.getloadavg()[0],
        "governors": governors(Path(GOVERNORS)),
        "free_bytes": shutil.disk_usage(Path.home()).free,
        "time_ns": time.time_ns(),
    }


def governors(folder: Path) -> list[str]:
    """Return the CPU governors in use; none where the system does not tell."""
    found = set()
    for path in folder.glob("cpu[0-9]*/cpufreq/scaling_governor"):
        try:
            found.add(path.read_text().strip())
        except OSError:
            continue
    return sorted(found)


def serve(port: int) -> None:
    """Answer pings and swallow bulk on a port until standard input ends; say "ready" once it listens."""
    with socket.create_server(("", port)) as server:
        print(json.dumps({"ready": port}), flush=True)
        while server in (ready := select.select([server, sys.stdin], [], [], SERVE_S)[0]) and sys.stdin not in ready:
            connection, _ = server.accept()
            with connection:
                _answer(connection)


def _answer(connection: socket.socket) -> None:
    """Echo every ping; after the pings count the bulk, and say so."""
    connection.settimeout(PATIENCE_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    try:
        for _ in range(PINGS):
            connection.sendall(connection.recv(1) or PING)
        left = BULK_BYTES
        while left > 0 and (data := connection.recv(CHUNK_BYTES)):
            left -= len(data)
        connection.sendall(PING)
    except OSError:
        return


def reach(address: str, port: int) -> dict[str, Any]:
    """Return the round trip [s] and the bandwidth [bit/s] to a host that serves, or why there is none."""
    try:
        with socket.create_connection((address, port), PATIENCE_S) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            round_trip_s = statistics.median(_ping_s(link) for _ in range(PINGS))
            start_s = time.monotonic()
            link.sendall(bytes(BULK_BYTES))
            link.recv(1)
            bulk_s = time.monotonic() - start_s
    except OSError as error:
        return {"error": error.strerror or str(error)}
    return {"round_trip_s": round_trip_s, "bits_per_s": 8 * BULK_BYTES / bulk_s}


def _ping_s(link: socket.socket) -> float:
    start_s = time.monotonic()
    link.sendall(PING)
    link.recv(1)
    return time.monotonic() - start_s


def main() -> None:
    """Do what the command line says."""
    match sys.argv[1:]:
        case ["about"]:
            print(json.dumps(about()))
        case ["serve", port]:
            serve(int(port))
        case ["reach", address, port]:
            print(json.dumps(reach(address, int(port))))
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    main()
