"""The options of a driver on the command line, whatever the wire, and the conditions on a run."""

import math
import re
import socket
from typing import NamedTuple
from urllib.parse import urlsplit

from zsim.contract.messages import Info
from zsim.errors import RunError
from zsim.math.rotation import Vector
from zsim.scenario.roles import DRIVER
from zsim_bridges.vehicle_links.failsafe import FlightLimits
from zsim_bridges.vehicle_links.vehicle_session import UdpChannel

_POSITION = re.compile(r"\s*,\s*")
_HOST = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9.-]*[A-Za-z0-9])?")  # a name, or an IPv4 address


class DriverOptions(NamedTuple):
    """Options of one driver.

    Attributes:
        drone: which drone of the run the aircraft is.
        limits: that hold whatever is commanded.
        armed: whether it begins armed.
        origin_m: origin of the aircraft's own frame, or where it stands [m; W]; None for what it or the scenario says.
        yaw_deg: its heading at the start, counter-clockwise from east; None for its own compass.
    """

    drone: str
    limits: FlightLimits = FlightLimits()
    armed: bool = False
    origin_m: Vector | None = None
    yaw_deg: float | None = None


def udp_channel(address: str, local_port: int = 0) -> UdpChannel:
    """Return the channel of `udp://HOST:PORT`.

    Raises:
        RunError: it has another form.
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
        RunError: it has another form.
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
    """Refuse an unknown host, before the driver replaces one that flies.

    Raises:
        RunError: it is unknown.
    """
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        raise RunError(f"the address is that of {host!r}, which is no host that is known here") from error


def check_run(info: Info, process: str, drone: str) -> None:
    """Refuse a drone that takes no driver, a process of another name, and a run without the pace of the wall clock.

    Args:
        process: name of the driver.

    Raises:
        RunError: one of these.
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
