"""An inventory: which hosts there are, how to reach them, and which role runs where.

Pure: reads a file and answers questions; nothing here opens a connection. docs/deployment.md explains the fields.
"""

import fnmatch
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta

from zsim.errors import InventoryError
from zsim.scenario.roles import RECORDER, ROUTER, WORLD, expected_processes
from zsim.scenario.scenario import DRONES_MAX, PROCESSES_MAX, Name, Scenario, Spec
from zsim.schema import yaml_file
from zsim.schema.checker import Fault, faults, first_lines

EXAMPLE = "examples/hosts.yaml"  # named to whoever gives no inventory
ZENOH_PORT = 7447  # Zenoh's own
SSH_PORT = 22  # IANA
HOSTS_MAX = DRONES_MAX  # with more, some have no drone
ROLES_MAX = PROCESSES_MAX  # each a process at least
ROUTER_PORT = 7448  # beside a world on the same host

Port = Annotated[int, Meta(ge=1, le=65535)]
Address = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.:%-]{1,253}\Z")]
Text = Annotated[str, Meta(min_length=1, max_length=4096)]


class Host(Spec, frozen=True, kw_only=True):
    """A computer."""

    address: Address
    """How the other hosts reach it."""
    ssh: Address | None = None
    """How the launcher reaches it, where that differs."""
    port: Port = SSH_PORT
    user: Text | None = None
    key: Text | None = None
    """Private key file; None takes the agent's or ~/.ssh's."""
    known_hosts: Text | None = None
    """File with its host key; None takes ~/.ssh/known_hosts."""
    folder: Text = ".zsim"
    """Where zsim is installed and keeps what it needs there; relative to the home."""
    python: Text | None = None
    """Absolute path of the interpreter that has zsim; None takes the environment that `zsim push` makes."""
    router: Name | None = None
    """Router through which its roles reach the world; None goes to the world directly."""


class Router(Spec, frozen=True, kw_only=True):
    """A Zenoh router, run in a process of ours."""

    host: Name
    port: Port = ROUTER_PORT
    upstream: Name | None = None
    """Router that it connects to; None is the world."""


class Security(Spec, frozen=True, kw_only=True):
    """Who may come in."""

    certificates: Text = "certs"
    """Folder of `zsim certs init`, relative to the inventory."""
    insecure: bool = False
    """No TLS and no access control, on a network that is nobody else's."""


class Inventory(Spec, frozen=True, kw_only=True):
    hosts: Annotated[dict[Name, Host], Meta(max_length=HOSTS_MAX)]
    roles: Annotated[dict[Text, Name | Annotated[list[Name], Meta(max_length=HOSTS_MAX)]], Meta(max_length=ROLES_MAX)]
    """Process name or pattern to a host, or to several over which what it matches is spread in order."""
    routers: Annotated[dict[Name, Router], Meta(max_length=HOSTS_MAX)] = msgspec.field(default_factory=dict)
    port: Port = ZENOH_PORT
    """On which the world listens."""
    security: Security = Security()


class InventoryFile(NamedTuple):
    """An inventory on disk: relative paths in it count from its folder."""

    inventory: Inventory
    folder: Path
    source: str

    @property
    def word(self) -> str:
        """Return its path as a word of a command."""
        return shlex.quote(str(self.folder / self.source))


def load(path: Path) -> InventoryFile:
    """Return the inventory of a YAML file.

    Raises:
        InventoryError: with every fault, a line each.
    """
    document = yaml_file.read(path, EXAMPLE, InventoryError)
    flaws = chain(faults(document, Inventory), _cross_faults(document))
    lines = first_lines(f"{path.name}: {where} {text}" for where, text in flaws)
    if lines:
        raise InventoryError(lines)
    return InventoryFile(msgspec.convert(document, Inventory), path.resolve().parent, path.name)


def insecure(placed: InventoryFile) -> InventoryFile:
    """Return an inventory with `security: {insecure: true}`."""
    security = msgspec.structs.replace(placed.inventory.security, insecure=True)
    return placed._replace(inventory=msgspec.structs.replace(placed.inventory, security=security))


def _cross_faults(document: dict[str, Any]) -> Iterator[Fault]:
    """Yield the faults between fields: names that must be those of hosts and routers."""
    hosts, routers = ([key for key, _ in _map(document, name)] for name in ("hosts", "routers"))
    for key, wanted in _map(document, "roles"):
        for name in wanted if isinstance(wanted, list) else [wanted]:
            yield from _unknown(f"roles.{key}", name, hosts, "hosts")
        if wanted == []:
            yield f"roles.{key}", "names no host; must name one at least"
    for key, router in _map(document, "routers"):
        if isinstance(router, dict):
            yield from _unknown(f"routers.{key}.host", router.get("host"), hosts, "hosts")
            yield from _unknown(f"routers.{key}.upstream", router.get("upstream"), routers, "routers")
    for key, host in _map(document, "hosts"):
        if key in (".", ".."):
            yield f"hosts.{key}", "names a folder that is another's; must have a letter or a digit"
        if isinstance(host, dict):
            yield from _unknown(f"hosts.{key}.router", host.get("router"), routers, "routers")
    if isinstance(document.get("hosts"), dict) and not hosts:
        yield "hosts", "has 0 entries; must have 1 at least"
    yield from _circles(document)


def _map(document: dict[str, Any], name: str) -> list[tuple[Any, Any]]:
    """Return the entries of a map, none where it is no map or has too many: they are compared with each other."""
    value = document.get(name)
    return list(value.items()) if isinstance(value, dict) and len(value) <= ROLES_MAX else []


def _unknown(path: str, name: Any, known: list[Any], what: str) -> Iterator[Fault]:
    if isinstance(name, str) and name not in known:
        yield path, f"is {name!r}; must be one of {what}: {', '.join(map(str, known)) or 'there are none'}"


def _circles(document: dict[str, Any]) -> Iterator[Fault]:
    """Yield routers whose chain of upstreams is a circle and never reaches the world."""
    above = {key: router.get("upstream") for key, router in _map(document, "routers") if isinstance(router, dict)}
    upstream = {key: above for key, above in above.items() if isinstance(above, str)}
    for start in upstream:
        seen, at = {start}, upstream[start]
        while at in upstream and at not in seen:
            seen.add(at)
            at = upstream[at]
        if at == start:
            yield f"routers.{start}.upstream", "leads back to itself; must lead to the world"


def roles(scenario: Scenario) -> list[str]:
    """Return the names of the processes that a scenario needs, the world first."""
    return [WORLD, RECORDER, *(name for name in expected_processes(scenario) if name != RECORDER)]


def placement(placed: InventoryFile, scenario: Scenario) -> dict[str, str]:
    """Return the host of every process of a scenario, by the rule of `spread`.

    Raises:
        InventoryError: a process has no place, or nothing matches a pattern.
    """
    names = roles(scenario)
    entries = placed.inventory.roles
    places = spread(entries, names)
    lines = [f"roles has no place for {name}; add {name!r}" for name in names if name not in places]
    unused = [key for key in entries if not any(fnmatch.fnmatchcase(name, key) for name in names)]
    lines += [f"roles.{key} matches no process of {scenario.name!r}; it has {', '.join(names)}" for key in unused]
    if WORLD in places:
        lines += _port_faults(placed.inventory, places[WORLD])
    if lines:
        raise InventoryError([f"{placed.source}: {line}" for line in lines])
    return places


def spread(roles: Mapping[str, Name | list[Name]], names: Iterable[str]) -> dict[str, str]:
    """Return the hosts of processes, without those that have no place; an entry's hosts take turns.

    A name counts more than a pattern, a longer pattern more. The recorder is at the world's host unless it is placed.
    """
    hosts_by_name: dict[str, str] = {}
    turns: Counter[str] = Counter()
    for name in names:
        key = entry(roles, name)
        if key is not None:
            hosts = hosts_of(roles, key)
            hosts_by_name[name] = hosts[turns[key] % len(hosts)]
            turns[key] += 1
        elif name == RECORDER and WORLD in hosts_by_name:
            hosts_by_name[name] = hosts_by_name[WORLD]
    return hosts_by_name


def entry(roles: Mapping[str, Name | list[Name]], name: str) -> str | None:
    """Return the entry that places a process; None if there is none."""
    matching = [key for key in roles if fnmatch.fnmatchcase(name, key)]
    return max(matching, key=lambda key: (key == name, len(key)), default=None)


def hosts_of(roles: Mapping[str, Name | list[Name]], key: str) -> list[str]:
    """Return the hosts that an entry names."""
    hosts = roles[key]
    return [hosts] if isinstance(hosts, str) else hosts


def _port_faults(inventory: Inventory, world: str) -> Iterator[str]:
    """Yield a line for each router whose port another process of its host has."""
    first = {(world, inventory.port): WORLD}
    for name, router in inventory.routers.items():
        other = first.setdefault((router.host, router.port), f"{ROUTER}.{name}")
        if other != f"{ROUTER}.{name}":
            yield f"routers.{name}.port is {router.port}, on which {other} listens on {router.host}; give another"


def endpoint(placed: InventoryFile, places: dict[str, str], host: str) -> str:
    """Return where the roles of a host find the federation: their router, or the world."""
    return _at(placed.inventory, *_listener(placed.inventory, places, placed.inventory.hosts[host].router))


def upstream(placed: InventoryFile, places: dict[str, str], router: str) -> str:
    """Return what a router connects to."""
    return _at(placed.inventory, *_listener(placed.inventory, places, placed.inventory.routers[router].upstream))


def connections(placed: InventoryFile, places: dict[str, str]) -> dict[tuple[str, int], set[str]]:
    """Return host and port of what listens, with the other hosts whose roles and routers connect to it."""
    inventory = placed.inventory
    ways = [(host, inventory.hosts[host].router) for name, host in places.items() if name != WORLD]
    ways += [(router.host, router.upstream) for router in inventory.routers.values()]
    sources: dict[tuple[str, int], set[str]] = {}
    for source, above in ways:
        target = _listener(inventory, places, above)
        if target[0] != source:
            sources.setdefault(target, set()).add(source)
    return sources


def _listener(inventory: Inventory, places: dict[str, str], router: str | None) -> tuple[str, int]:
    """Return host and port of a router, or of the world."""
    if router is None:
        return places[WORLD], inventory.port
    return inventory.routers[router].host, inventory.routers[router].port


def listening(placed: InventoryFile, host: str, port: int) -> str:
    """Return the endpoint on which a process of a host listens: its own address, reached from outside."""
    return _at(placed.inventory, host, port)


def _at(inventory: Inventory, host: str, port: int) -> str:
    address = inventory.hosts[host].address
    shown = f"[{address}]" if ":" in address else address
    return f"{'tcp' if inventory.security.insecure else 'tls'}/{shown}:{port}"


def routers_in_order(inventory: Inventory) -> list[str]:
    """Return the routers, each after the one that it connects to."""

    def depth(name: str) -> int:
        above = inventory.routers[name].upstream
        return 0 if above is None else 1 + depth(above)

    return sorted(inventory.routers, key=lambda name: (depth(name), name))


def python(host: Host) -> str:
    """Return the interpreter of a host that has zsim: as given, or the one that `zsim push` installs."""
    home = "" if host.folder.startswith(("/", "~/")) else "~/"
    return host.python or f"{home}{host.folder}/venv/bin/python"
