"""The port on which a run listens: the one that users expect, or another where that is taken."""

import socket

from zsim.runtime.progress import Screen

DEFAULT_PORT = 7447  # Zenoh's own


def is_free(port: int) -> bool:
    """Return whether nobody listens on a port of this machine."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def _any_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def free_port(screen: Screen) -> int:
    """Return Zenoh's port, or another free one, shown on the screen, where that is taken."""
    if is_free(DEFAULT_PORT):
        return DEFAULT_PORT
    port = _any_port()
    screen.say(f"port {DEFAULT_PORT} is in use; this run is on tcp/127.0.0.1:{port} (--connect for other commands)")
    return port
