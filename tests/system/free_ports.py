"""Ports that nobody listens on, of which workers that run side by side have some each."""

import os
import socket
from collections.abc import Iterator

PORTS = range(20_000, 30_000)  # below the range from which systems take ports for outgoing connections
WORKERS_MAX = 8  # that start processes side by side
PORTS_EACH = len(PORTS) // WORKERS_MAX
LAPS = 100  # through the ports, in one session of tests


def free_port(host: str = "127.0.0.1") -> int:
    """Return a port that nobody listens on, and that this process has not returned before.

    Workers that run side by side have a part of the ports each, in a row: no other one takes the port after it.
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
    """Yield the ports of this worker again and again, from a place that differs from process to process."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    own = PORTS[worker % WORKERS_MAX * PORTS_EACH :][:PORTS_EACH]
    start = os.getpid() * 37 % len(own)
    yield from [*own[start:], *own[:start]] * LAPS


_ports = _own_ports()
