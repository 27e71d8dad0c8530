"""The address of each drone, and who is obeyed there."""

import ipaddress
import socket
from collections.abc import Iterable, Sequence

from zsim.errors import RunError

FIRST_ADDRESS = "127.0.0.2"  # of the first drone; 127.0.0.1 is where programs on this host send from


def drone_addresses(text: str, drones: Sequence[str]) -> dict[str, str]:
    """Return the address of each drone that has one.

    Args:
        text: the first drone's address, the others have those that follow it; or DRONE=ADDRESS, separated by commas.
        drones: of the run, in its order.

    Raises:
        RunError: it is neither, names no drone of the run, or gives an address twice.
    """
    if "=" in text:
        addresses = dict(_named(part, drones) for part in text.split(",") if part.strip())
    else:
        first = _address(text)
        addresses = {drone: str(_following(first, i)) for i, drone in enumerate(drones)}
    if len(set(addresses.values())) < len(addresses):
        raise RunError(f"--addresses is {text!r}; must give each drone an address of its own")
    return addresses


def _named(part: str, drones: Sequence[str]) -> tuple[str, str]:
    drone, _, address = (each.strip() for each in part.partition("="))
    if drone not in drones:
        raise RunError(f"--addresses names {drone!r}; must be one of {', '.join(drones)}")
    return drone, str(_address(address))


def _address(text: str) -> ipaddress.IPv4Address:
    try:
        return ipaddress.IPv4Address(text.strip())
    except ipaddress.AddressValueError:
        raise RunError(f"--addresses has {text!r}; must be an IPv4 address, or DRONE=ADDRESS,DRONE=ADDRESS") from None


def _following(first: ipaddress.IPv4Address, count: int) -> ipaddress.IPv4Address:
    try:
        return first + count
    except ipaddress.AddressValueError:
        raise RunError(f"--addresses begins with {first}; there are not enough addresses behind it") from None


def peer_addresses(hosts: Iterable[str]) -> frozenset[str]:
    """Return the addresses of the hosts that are obeyed.

    Raises:
        RunError: a name has no address.
    """
    found: set[str] = set()
    for host in hosts:
        try:
            found.update(str(info[4][0]) for info in socket.getaddrinfo(host, None, socket.AF_INET))
        except OSError as error:
            raise RunError(f"--peer {host}: has no IPv4 address here ({error.strerror})") from None
    return frozenset(found)


class AllowedHosts:
    """Who is obeyed on an address: on loopback every program of this host, elsewhere the hosts that were named.

    Args:
        address: of the drone.
        named: addresses of hosts.

    Raises:
        RunError: the address is not loopback, and nobody is named.
    """

    def __init__(self, address: str, named: frozenset[str]) -> None:
        self._is_loopback = ipaddress.IPv4Address(address).is_loopback
        self._named = named
        if not self._is_loopback and not named:
            raise RunError(
                f"{address} is reached by every host of its network, and an AR.Drone asks nobody for a password; "
                "give --peer HOST, the host that is obeyed, or an address 127.x.y.z"
            )

    def allow(self, host: str) -> bool:
        """Tell whether a host is obeyed."""
        return self._is_loopback or host in self._named
