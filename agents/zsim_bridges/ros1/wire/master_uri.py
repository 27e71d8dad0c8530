"""Where a ROS master is, and under which address it and its nodes reach us."""

import os
import socket
from collections.abc import Mapping
from urllib.parse import urlsplit

from zsim.errors import RunError

DEFAULT_MASTER = "http://127.0.0.1:11311"  # ROS's own
DEFAULT_PORT = 11311


def own_address(master_uri: str, environment: Mapping[str, str] = os.environ) -> str:
    """Return the name or address under which nodes of a master's graph reach this host.

    ROS's own variables come first, then the address from which this host reaches the master.

    Raises:
        RunError: the URI is none, or its host is unknown.
    """
    host, port = master_address(master_uri)
    given = environment.get("ROS_HOSTNAME") or environment.get("ROS_IP")
    if given:
        return given
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, port))
            return probe.getsockname()[0]
    except OSError as error:
        raise RunError(
            f"ROS master {master_uri}: no way to {host} ({error}); correct --master or give --ros-host"
        ) from error


def master_address(uri: str) -> tuple[str, int]:
    """Return host and port of a master.

    Raises:
        RunError: it is no URI of a master.
    """
    try:
        parts = urlsplit(uri)
        scheme, host, port = parts.scheme, parts.hostname, parts.port or DEFAULT_PORT
    except ValueError:
        scheme, host, port = "", None, 0
    if host is None or scheme != "http":
        raise RunError(f"ROS master is {uri!r}; must be such as {DEFAULT_MASTER}")
    return host, port
