"""Who needs a certificate, and which rights each listening process grants: from an inventory and a scenario.

At the end, whether the certificates that a run needs are there and good, before anything is started with them.

Zenoh judges at the process that listens (the world, a router), by the common name in the certificate of the other
side, both ways: what comes in from it and what goes out to it. An expression is allowed if a rule's includes it.
docs.rs/zenoh-config, AclConfig.
"""

import shlex
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from zsim.contract import keys
from zsim.errors import InventoryError, RunError
from zsim.scenario import rights
from zsim.scenario.external_bodies import drivers_of
from zsim.scenario.rights import OPERATOR, ROUTER, WORLD, Rights
from zsim.scenario.scenario import Scenario
from zsim.transport.tls import AUTHORITY, KEY
from zsim_deploy.inventory import certificates
from zsim_deploy.inventory import inventory as inv
from zsim_deploy.inventory.certificates import OPERATORS, CertificateRequest
from zsim_deploy.inventory.inventory import InventoryFile

# (flow, messages, whose keys): what a right is on the wire, seen from the process that listens
_WIRE: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("ingress", ("declare_subscriber",), "reads"),
    ("egress", ("put",), "reads"),
    ("ingress", ("put",), "writes"),
    ("ingress", ("query",), "asks"),
    ("egress", ("reply",), "asks"),
    ("ingress", ("declare_queryable", "reply"), "answers"),
    ("egress", ("query",), "answers"),
    ("ingress", ("liveliness_token",), "tokens"),
    ("ingress", ("liveliness_query", "declare_liveliness_subscriber"), "watches"),
    ("egress", ("liveliness_token",), "watches"),
)
# Declarations go to all, for without them nothing is sent; they hold no payload.
_DECLARATIONS = ("declare_subscriber", "declare_queryable", "liveliness_query", "declare_liveliness_subscriber")
_MESSAGES = (*_DECLARATIONS, "put", "delete", "query", "reply", "liveliness_token")
ANYONE = "anyone"  # with a certificate of the authority; a subject without conditions is everybody's
# What anyone may do is to ask what it may do: zsim.transport.tls.
_ASKS_ACCESS = (("ingress", "query"), ("egress", "reply"))


def folder_of(placed: InventoryFile) -> Path:
    """Return the folder of an inventory's certificates."""
    return placed.folder / Path(placed.inventory.security.certificates).expanduser()


def init_command(placed: InventoryFile, renew: bool = False) -> str:
    """Return the command that makes an inventory's certificates, as a person types it."""
    return f"zsim certs init {placed.word} --scenario FILE{' --renew' if renew else ''}"


class Enrolment:
    """What an inventory and a scenario ask for.

    Args:
        placed: the inventory.
        scenario: whose processes run.
        operators: people and programs that look and command, each NAME or NAME@HOST; at a host they come in as its
            roles do, through its router if it has one, otherwise at the world. One may be at several places.

    Raises:
        InventoryError: a process has no place, or an operator is at no host of the inventory.
        BadNameError: an operator's name is none of the contract.
    """

    def __init__(self, placed: InventoryFile, scenario: Scenario, operators: Sequence[str] = ()) -> None:
        self._inventory = placed.inventory
        self._scenario = scenario
        self._places = inv.placement(placed, scenario)
        self._operators = list(dict.fromkeys(self._read_operator(text, placed.source) for text in operators))

    def certificates(self) -> list[CertificateRequest]:
        """Return the certificates; a role has one for every host, so that it can be moved there during a run."""
        fixed = [(self._places[WORLD], WORLD)]
        fixed += [(router.host, f"{ROUTER}.{name}") for name, router in self._inventory.routers.items()]
        movable = [(host, name) for name in self._movable() for host in self._inventory.hosts]
        operators = [(host or OPERATORS, name) for name, host in self._operators]
        return [CertificateRequest(host, name, self._addresses(host)) for host, name in [*fixed, *movable, *operators]]

    def access(self) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Yield (host, process, access control) of every process that listens."""
        clients = [*self._movable(), *self._operators_at(None)]
        yield self._places[WORLD], WORLD, access_control(self._scenario, clients, self._below(None))
        for name, router in self._inventory.routers.items():
            above = f"{ROUTER}.{router.upstream}" if router.upstream else WORLD
            rules = access_control(self._scenario, self._at(name), self._below(name), [above])
            yield router.host, f"{ROUTER}.{name}", rules

    def _read_operator(self, text: str, source: str) -> tuple[str, str | None]:
        name, at, host = text.partition("@")
        name = keys.name(name.removeprefix(f"{OPERATOR}."), OPERATOR)
        if at and host not in self._inventory.hosts:
            known = ", ".join(self._inventory.hosts)
            raise InventoryError([f"{source}: operator {name!r} is at {host!r}; must be one of hosts: {known}"])
        return f"{OPERATOR}.{name}", host or None

    def _movable(self) -> list[str]:
        """Return the processes that may run on any host: the scenario's, and drivers, which it need not expect."""
        drivers = [name for name in drivers_of(self._scenario) if name not in self._places]
        return [*(name for name in self._places if name != WORLD), *drivers]

    def _addresses(self, host: str) -> tuple[str, ...]:
        return (self._inventory.hosts[host].address,) if host in self._inventory.hosts else ()

    def _router_of(self, host: str | None) -> str | None:
        return self._inventory.hosts[host].router if host is not None else None

    def _below(self, router: str | None) -> dict[str, list[str]]:
        """Return the routers that connect to a router, or to the world, with all processes behind each."""
        direct = [name for name, below in self._inventory.routers.items() if below.upstream == router]
        return {f"{ROUTER}.{name}": self._behind(name) for name in direct if self._behind(name)}

    def _behind(self, router: str) -> list[str]:
        lower = [name for name, below in self._inventory.routers.items() if below.upstream == router]
        return [*self._at(router), *(process for name in lower for process in self._behind(name))]

    def _at(self, router: str) -> list[str]:
        """Return the processes that may come to a router: every role, as any may be moved to a host of it."""
        has_hosts = any(host.router == router for host in self._inventory.hosts.values())
        return [*(self._movable() if has_hosts else []), *self._operators_at(router)]

    def _operators_at(self, router: str | None) -> list[str]:
        """Return the operators that come in at a router, or at the world."""
        return list(dict.fromkeys(name for name, host in self._operators if self._router_of(host) == router))


def access_control(
    scenario: Scenario, clients: Iterable[str], routers: Mapping[str, Iterable[str]], above: Iterable[str] = ()
) -> dict[str, Any]:
    """Return the `access_control` of a process that listens.

    Args:
        scenario: whose drones and clusters the rights are about.
        clients: names of the processes that connect to it.
        routers: names of the routers that connect to it, with the processes behind each.
        above: what it connects to itself, the world or another router.

    Returns:
        the map of Zenoh's configuration; everything is denied that is not in it. Who is not named may ask that it is
        not, and nothing else.
    """
    granted = {name: rights.of(name, scenario) for name in clients}
    for name, behind in routers.items():
        granted[name] = rights.union(rights.of(process, scenario) for process in behind)
    granted |= dict.fromkeys(above, rights.ALL)
    entries = [(name, list(_rules(name, right, scenario.federation))) for name, right in granted.items()]
    asking = [_rule(ANYONE, (flow,), (act,), (keys.access("*"),), scenario.federation) for flow, act in _ASKS_ACCESS]
    subjects = [{"id": name, "cert_common_names": [name]} for name, _ in entries]
    entries.append((ANYONE, asking))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for _, rules in entries for rule in rules],
        "subjects": [*subjects, {"id": ANYONE}],
        "policies": [{"subjects": [name], "rules": [rule["id"] for rule in rules]} for name, rules in entries],
    }


def _rules(name: str, right: Rights, federation: str) -> Iterator[dict[str, Any]]:
    if right == rights.ALL:
        yield _rule(name, ("ingress", "egress"), _MESSAGES, rights.EVERYTHING, federation)
        return
    for flow, messages, field in _WIRE:
        expressions = getattr(right, field)
        if expressions:
            yield _rule(name, (flow,), messages, expressions, federation)
    yield _rule(name, ("egress",), _DECLARATIONS, rights.EVERYTHING, federation)


def _rule(
    name: str, flows: tuple[str, ...], messages: tuple[str, ...], expressions: Iterable[str], federation: str
) -> dict[str, Any]:
    return {
        "id": f"{name} {' '.join(flows)} {' '.join(messages)}",
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": [f"{federation}/{expression}" for expression in expressions],
    }


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
