"""Free ports, of which each of the test workers that run side by side has a share."""

import os
import socket
from collections.abc import Iterator

PORTS = range(20_000, 30_000)  # below the range from which systems take ports for outgoing connections
WORKERS_MAX = 8  # greatest number of workers that start processes side by side
PORTS_EACH = len(PORTS) // WORKERS_MAX
LAPS = 100  # greatest number of passes through the ports in a test session


def free_port(host: str = "127.0.0.1") -> int:
    """Return a port on which no process listens, each port only after all others of this worker.

    Each of the workers that run side by side has a contiguous range of ports, so no other worker takes the next port.
    """
    for port in _ports:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError:
                continue
            return port
    raise OSError(f"no port free in {PORTS}")


def _own_ports() -> Iterator[int]:
    """Yield the ports of this worker repeatedly, from a starting point that depends on the process id."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    own = PORTS[worker % WORKERS_MAX * PORTS_EACH :][:PORTS_EACH]
    start = os.getpid() * 37 % len(own)
    yield from [*own[start:], *own[:start]] * LAPS


_ports = _own_ports()
