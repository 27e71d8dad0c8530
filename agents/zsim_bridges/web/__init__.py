"""Parts shared by the web servers: event loop thread, listening, access, bounded connections.

The console and the gateway use them for HTTP. This module does not import aiohttp, since other bridges use it too.
"""

from ipaddress import ip_address
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Return whether a host name or address refers to this machine's loopback."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def is_loopback_authority(authority: str) -> bool:
    """Return whether a Host header, or the host and port of an origin, refers to this machine's loopback.

    Raises:
        ValueError: the text cannot be parsed.
    """
    return is_loopback(urlsplit(f"//{authority}").hostname or "")
