"""Parts shared by web servers: listening on a separate thread, access, connections, streams of pictures.

Console and gateway use it for HTTP. This file does not import aiohttp, since other bridges use it, too.
"""

from ipaddress import ip_address
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Return whether a host name or address is this machine alone."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def is_loopback_authority(authority: str) -> bool:
    """Return whether a Host header, or the host and port of an origin, name this machine alone.

    Raises:
        ValueError: it cannot be parsed.
    """
    return is_loopback(urlsplit(f"//{authority}").hostname or "")
