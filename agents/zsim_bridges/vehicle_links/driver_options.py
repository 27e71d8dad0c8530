"""What a driver is given on the command line, whichever wire its aircraft speaks."""

import re
from typing import NamedTuple
from urllib.parse import urlsplit

from zsim.errors import RunError
from zsim.math.rotation import Vector
from zsim_bridges.vehicle_links.flight_limits import FlightLimits
from zsim_bridges.vehicle_links.vehicle_session import UdpChannel

_POSITION = re.compile(r"\s*,\s*")


class DriverOptions(NamedTuple):
    """Of one driver.

    Attributes:
        drone: which drone of the run the aircraft is.
        limits: that hold whatever is commanded.
        armed: whether it begins armed.
        origin_m: where the aircraft's own frame begins, or it stands [m; W]; None: as it says, or the scenario has it.
        yaw_deg: its heading at the start, counter-clockwise from east; None: by its own compass.
    """

    drone: str
    limits: FlightLimits = FlightLimits()
    armed: bool = False
    origin_m: Vector | None = None
    yaw_deg: float | None = None


def udp_channel(address: str, local_port: int = 0) -> UdpChannel:
    """Return the channel of `udp://HOST:PORT`.

    Raises:
        RunError: it is written otherwise.
    """
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    if parts.scheme != "udp" or not parts.hostname or not port:
        raise RunError(f"the address is {address!r}; must be udp://HOST:PORT, such as udp://192.168.1.20:14580")
    return UdpChannel(parts.hostname, port, local_port)


def position(text: str) -> Vector:
    """Return the position of `X,Y,Z`.

    Raises:
        RunError: it is written otherwise.
    """
    try:
        x, y, z = map(float, _POSITION.split(text.strip()))
    except ValueError as error:
        raise RunError(f"the origin is {text!r}; must be X,Y,Z in metres, such as 0,0,0") from error
    return x, y, z
