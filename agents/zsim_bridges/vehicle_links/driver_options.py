"""What a driver is given on the command line, whichever wire its aircraft speaks, and whether a run allows it."""

import math
import re
import socket
from typing import NamedTuple
from urllib.parse import urlsplit

from zsim.contract.messages import Info
from zsim.errors import RunError
from zsim.math.rotation import Vector
from zsim.scenario.roles import DRIVER
from zsim_bridges.vehicle_links.flight_limits import FlightLimits
from zsim_bridges.vehicle_links.vehicle_session import UdpChannel

_POSITION = re.compile(r"\s*,\s*")
_HOST = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9.-]*[A-Za-z0-9])?")  # a name, or an IPv4 address


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
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise RunError(f"--origin is {text!r}; must be X,Y,Z in metres, such as 0,0,0")
    return x, y, z


def aircraft_host(text: str) -> str:
    """Return the host of an aircraft whose ports are fixed.

    Raises:
        RunError: it is more than a host.
    """
    if not _HOST.fullmatch(text):
        raise RunError(f"the address is {text!r}; must be that of a host, such as 192.168.1.12: the ports are fixed")
    return text


def check_host(host: str) -> None:
    """Refuse a host without an address, before the driver takes the place of one that flies.

    Raises:
        RunError: that is so.
    """
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        raise RunError(f"the address is that of {host!r}, which is no host that is known here") from error


def check_run(info: Info, process: str, drone: str) -> None:
    """Refuse a drone that has no driver, one of another name, and a run at another pace than the wall clock's.

    Args:
        process: name of the driver.

    Raises:
        RunError: with the reason.
    """
    bodies = {each.name: each.body for each in info.drones}
    if drone not in bodies:
        raise RunError(f"{process}: drone is {drone!r}; must be one of {', '.join(bodies)}")
    if bodies[drone] != "external":
        raise RunError(f"{process}: {drone} is simulated; a driver needs `body: external` of it in the scenario")
    if info.mode != "realtime":
        raise RunError(f"{process}: the run is in lockstep; a driver needs one that is started with --realtime")
    if process != f"{DRIVER}.{drone}":
        needed = f"must be {DRIVER}.{drone}; give the certificate of that process"
        raise RunError(f"{process}: the name of the driver of {drone} {needed}")
