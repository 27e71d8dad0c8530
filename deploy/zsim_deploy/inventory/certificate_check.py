"""Whether the certificates that a run needs are there and good, before anything is started with them."""

import shlex
import stat
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from zsim.errors import RunError
from zsim.scenario.rights import ROUTER, WORLD
from zsim.transport.tls import AUTHORITY, KEY
from zsim_deploy.inventory import certificates
from zsim_deploy.inventory import inventory as inv
from zsim_deploy.inventory.enrolment import CertificateRequest, folder_of, init_command
from zsim_deploy.inventory.inventory import InventoryFile

SHOWN_MAX = 4  # names in a line; all of them are missing together as a rule
READABLE_BY_OTHERS = stat.S_IRGRP | stat.S_IROTH


def certificate_faults(placed: InventoryFile, places: Mapping[str, str] | None, now: datetime) -> list[str]:
    """Return what of the certificates and access control of a run is missing or of no use, a line for each fault.

    Args:
        placed: the inventory.
        places: host of each process that is to be started; its routers need not be among them. None takes the world.
        now: wall time, with its zone.
    """
    if placed.inventory.security.insecure:
        return []
    folder = folder_of(placed)
    try:
        if not (folder / AUTHORITY).exists():
            return [
                f"{folder}: has no certificates; {_mend(placed)}, or set security.insecure on a network of your own"
            ]
        by_fault = _by_fault(placed, folder, places, now)
    except RunError as error:
        return [str(error)]
    except OSError as error:
        return [f"{folder}: cannot be read ({error.strerror}); it belongs to who made it"]
    return [f"{folder}: {fault}: {_names(who)}; {_mend(placed, fault)}" for fault, who in by_fault.items()]


def exposed_keys(placed: InventoryFile) -> str | None:
    """Return a warning of private keys that others than their owner can read; None if there are none."""
    if placed.inventory.security.insecure:
        return None
    folder = folder_of(placed)
    keys = sorted(path for path in (folder / "ca.key", *folder.glob(f"*/*/{KEY}")) if _readable_by_others(path))
    if not keys:
        return None
    more = f" and {len(keys) - 1} private keys more" if len(keys) > 1 else ""
    return f"{keys[0]}{more} can be read by others on this machine; chmod -R go= {shlex.quote(str(folder))}"


def _by_fault(
    placed: InventoryFile, folder: Path, places: Mapping[str, str] | None, now: datetime
) -> dict[str, list[str]]:
    """Return what is wrong, and with whose certificates, `NAME on HOST`."""
    places_or_world = inv.spread(placed.inventory.roles, [WORLD]) if places is None else places
    routers = {f"{ROUTER}.{name}": router.host for name, router in placed.inventory.routers.items()}
    root = certificates.root(folder)
    names: dict[str, list[str]] = {}
    for name, host in {**places_or_world, **routers}.items():
        wanted = CertificateRequest(host, name, (placed.inventory.hosts[host].address,))
        if fault := _fault(folder, root, wanted, now):
            names.setdefault(fault, []).append(f"{name} on {host}")
    return names


def _fault(folder: Path, root: certificates.Root, wanted: CertificateRequest, now: datetime) -> str | None:
    """Return what is wrong with a certificate, and with the access control beside it; None if nothing is."""
    listens = wanted.process == WORLD or wanted.process.startswith(f"{ROUTER}.")
    why = certificates.renewal_reason(folder, root, wanted, now)
    if why == "new":
        return "certificate missing"
    if why == "other addresses":
        return "certificate for other addresses" if listens else None  # nobody asks a client for its address
    if why:
        return f"certificate {why}"
    there = (folder / wanted.host / f"{wanted.process}.access.json").exists()
    return None if there or not listens else "access control missing"


def _mend(placed: InventoryFile, fault: str = "") -> str:
    return f"make them with `{init_command(placed, renew=certificates.EXPIRED in fault)}`"


def _names(who: list[str]) -> str:
    more = len(who) - SHOWN_MAX
    return ", ".join(who[:SHOWN_MAX]) + (f" and {more} more" if more > 0 else "")


def _readable_by_others(path: Path) -> bool:
    try:
        return bool(path.stat().st_mode & READABLE_BY_OTHERS)
    except OSError:
        return False
