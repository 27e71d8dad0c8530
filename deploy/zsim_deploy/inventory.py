"""Inventories (the hosts, how to reach them, and which role runs where), and the command lines of processes.

No side effects other than reading the inventory file. docs/deployment.md explains the fields.
"""

import fnmatch
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta

from zsim.errors import InventoryError
from zsim.scenario.roles import (
    AGENTS,
    RECORDER,
    ROLES,
    ROUTER,
    WORLD,
    agent_names,
    expected_processes,
    on_death,
    programs,
)
from zsim.scenario.scenario import DRONES_MAX, PROCESSES_MAX, Name, OnDeath, Scenario, Spec
from zsim.schema import yaml_file
from zsim.schema.checker import Fault, faults, first_lines
from zsim_api.programs import fill_placeholders
from zsim_deploy import SAFE_PATH
from zsim_deploy.arguments import REALTIME

EXAMPLE = "examples/hosts.yaml"  # suggested if the inventory file is missing
ZENOH_PORT = 7447  # default port of Zenoh
SSH_PORT = 22  # IANA
HOSTS_MAX = DRONES_MAX  # with more, some hosts would have no drone
ROLES_MAX = PROCESSES_MAX  # each entry matches at least one process
ROUTER_PORT = 7448  # differs from ZENOH_PORT, for a world on the same host
MODULE = (SAFE_PATH, "-m", "zsim_deploy.cli")  # arguments for the Python interpreter
EXTRAS_BY_NAME = {name: ROLES[name].extra for name in (WORLD, RECORDER)}  # extras by process name, in placement order
CAMERA_ROLES = ("camera", "detector")  # roles that a run waits for only if the scenario names them
COMMANDS = {RECORDER: "record", "detector": "detect"}  # commands that are not named after their role
# extras by prefix of the process name
EXTRAS_BY_ROLE = {f"{name}.": ROLES[name].extra for name in (*AGENTS, *CAMERA_ROLES)}
MODULES = {  # module imported to check that an extra is installed; "": the installation without extras
    "": "zsim.transport.session",
    "agents": "zsim_agents.estimation.estimator",
    "record": "zsim_agents.recorder",
    "cameras": "zsim_agents.cameras.detector",
    "world": "zsim_world.server.world_process",
}

Port = Annotated[int, Meta(ge=1, le=65535)]
Address = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.:%-]{1,253}\Z")]
Text = Annotated[str, Meta(min_length=1, max_length=4096)]


class Host(Spec, frozen=True, kw_only=True):
    """A computer on which roles run."""

    address: Address
    """Address at which other hosts reach this one."""
    ssh: Address | None = None
    """Address at which the launcher reaches this host, if different."""
    port: Port = SSH_PORT
    user: Text | None = None
    key: Text | None = None
    """Private key file; None: the keys of the SSH agent and in ~/.ssh."""
    known_hosts: Text | None = None
    """Known-hosts file that lists this host's key; None: ~/.ssh/known_hosts."""
    folder: Text = ".zsim"
    """Folder for zsim's installation and files; a relative path is taken from the home folder."""
    python: Text | None = None
    """Absolute path of a Python interpreter with zsim installed; None: the one that `zsim push` sets up."""
    router: Name | None = None
    """Router through which this host's roles reach the world; None: they connect to the world directly."""


class Router(Spec, frozen=True, kw_only=True):
    """A Zenoh router that zsim runs as one of its processes."""

    host: Name
    port: Port = ROUTER_PORT
    upstream: Name | None = None
    """Router to which this one connects; None: it connects to the world."""


class Security(Spec, frozen=True, kw_only=True):
    """TLS and access-control settings."""

    certificates: Text = "certs"
    """Folder created by `zsim certs init`, relative to the inventory's folder."""
    insecure: bool = False
    """Whether to run without TLS and access control; only for a network of your own."""


class Inventory(Spec, frozen=True, kw_only=True):
    hosts: Annotated[dict[Name, Host], Meta(max_length=HOSTS_MAX)]
    roles: Annotated[dict[Text, Name | Annotated[list[Name], Meta(max_length=HOSTS_MAX)]], Meta(max_length=ROLES_MAX)]
    """Host of each process, by name or pattern; the hosts in a list are assigned in turn to the matching processes."""
    routers: Annotated[dict[Name, Router], Meta(max_length=HOSTS_MAX)] = msgspec.field(default_factory=dict)
    port: Port = ZENOH_PORT
    """Port on which the world listens."""
    security: Security = Security()


class InventoryFile(NamedTuple):
    """An inventory read from disk; its relative paths refer to `folder`."""

    inventory: Inventory
    folder: Path
    source: str

    @property
    def shell_path(self) -> str:
        """Return the path of the file, quoted for a shell."""
        return shlex.quote(str(self.folder / self.source))


def load(path: Path) -> InventoryFile:
    """Read an inventory from a YAML file; raise InventoryError with a line for each fault."""
    document = yaml_file.read(path, EXAMPLE, InventoryError)
    flaws = chain(faults(document, Inventory), _cross_faults(document))
    lines = first_lines(f"{path.name}: {where} {text}" for where, text in flaws)
    if lines:
        raise InventoryError(lines)
    return InventoryFile(msgspec.convert(document, Inventory), path.resolve().parent, path.name)


def insecure(inventory_file: InventoryFile) -> InventoryFile:
    """Return a copy of the inventory with `security: {insecure: true}`."""
    security = msgspec.structs.replace(inventory_file.inventory.security, insecure=True)
    return inventory_file._replace(inventory=msgspec.structs.replace(inventory_file.inventory, security=security))


def _cross_faults(document: dict[str, Any]) -> Iterator[Fault]:
    """Yield the faults that a check of single fields misses, such as unknown hosts and cycles of routers."""

    def entries(name: str) -> list[tuple[Any, Any]]:
        """Return the entries of a field; none if it is not a map, or has too many entries to compare."""
        value = document.get(name)
        return list(value.items()) if isinstance(value, dict) and len(value) <= ROLES_MAX else []

    def unknown(path: str, name: Any, known: list[Any], kind: str) -> Iterator[Fault]:
        if isinstance(name, str) and name not in known:
            yield path, f"is {name!r}; must be one of {kind}: {', '.join(map(str, known)) or 'none defined'}"

    hosts, routers = ([key for key, _ in entries(name)] for name in ("hosts", "routers"))
    for key, targets in entries("roles"):
        for name in targets if isinstance(targets, list) else [targets]:
            yield from unknown(f"roles.{key}", name, hosts, "hosts")
        if targets == []:
            yield f"roles.{key}", "names no host; must name at least one"
    upstream = {}
    for key, router in entries("routers"):
        if isinstance(router, dict):
            yield from unknown(f"routers.{key}.host", router.get("host"), hosts, "hosts")
            yield from unknown(f"routers.{key}.upstream", router.get("upstream"), routers, "routers")
            if isinstance(router.get("upstream"), str):
                upstream[key] = router["upstream"]
    for key, host in entries("hosts"):
        if key in (".", ".."):
            yield f"hosts.{key}", "is not usable as a folder name; must have a letter or a digit"
        if isinstance(host, dict):
            yield from unknown(f"hosts.{key}.router", host.get("router"), routers, "routers")
    if isinstance(document.get("hosts"), dict) and not hosts:
        yield "hosts", "has 0 entries; must have at least 1"
    for start in upstream:
        visited, current = {start}, upstream[start]
        while current in upstream and current not in visited:
            visited.add(current)
            current = upstream[current]
        if current == start:
            yield f"routers.{start}.upstream", "leads back to itself; must lead to the world"


def roles(scenario: Scenario) -> list[str]:
    """Return the names of the processes that a scenario needs, the world first."""
    return [WORLD, RECORDER, *(name for name in expected_processes(scenario) if name != RECORDER)]


def placement(inventory_file: InventoryFile, scenario: Scenario) -> dict[str, str]:
    """Return the host of every process, as assigned by `spread`.

    A program of the scenario may have no host: `zsim up` then starts it on the launcher's machine. Raises
    InventoryError if any other process has no host, an entry matches no process, or two processes listen on the same
    port.
    """
    names, inventory = roles(scenario), inventory_file.inventory
    entries = inventory.roles
    hosts_by_process = spread(entries, names)
    lines = [
        f"roles has no host for {name}; add {name!r}"
        for name in names
        if name not in {**hosts_by_process, **scenario.own_programs}
    ]
    unused = [key for key in entries if not any(fnmatch.fnmatchcase(name, key) for name in names)]
    lines += [f"roles.{key} matches no process of {scenario.name!r}; it has {', '.join(names)}" for key in unused]
    if WORLD in hosts_by_process:
        listeners = {(hosts_by_process[WORLD], inventory.port): WORLD}
        for name, router in inventory.routers.items():
            other = listeners.setdefault((router.host, router.port), f"{ROUTER}.{name}")
            if other != f"{ROUTER}.{name}":
                conflict = f"on which {other} listens on {router.host}"
                lines.append(f"routers.{name}.port is {router.port}, {conflict}; give another port")
    if lines:
        raise InventoryError([f"{inventory_file.source}: {line}" for line in lines])
    return hosts_by_process


def spread(roles: Mapping[str, Name | list[Name]], names: Iterable[str]) -> dict[str, str]:
    """Return the host of each process that has one, by name; the hosts of an entry are assigned in turn.

    A name takes precedence over a pattern, and a longer pattern over a shorter one. By default the recorder runs on the
    world's host.
    """
    hosts_by_process: dict[str, str] = {}
    next_indices: Counter[str] = Counter()
    for name in names:
        matching = [key for key in roles if fnmatch.fnmatchcase(name, key)]
        if matching:
            key = max(matching, key=lambda key: (key == name, len(key)))
            entry = roles[key]
            hosts = [entry] if isinstance(entry, str) else entry
            hosts_by_process[name] = hosts[next_indices[key] % len(hosts)]
            next_indices[key] += 1
        elif name == RECORDER and WORLD in hosts_by_process:
            hosts_by_process[name] = hosts_by_process[WORLD]
    return hosts_by_process


def endpoint(inventory_file: InventoryFile, hosts_by_process: dict[str, str], host: str) -> str:
    """Return the endpoint to which the roles on a host connect: that of their router or of the world."""
    return listening(
        inventory_file,
        *_listener(inventory_file.inventory, hosts_by_process, inventory_file.inventory.hosts[host].router),
    )


def listening(inventory_file: InventoryFile, host: str, port: int) -> str:
    """Return the endpoint of a process that listens on a host, with the address at which other hosts reach it."""
    address = inventory_file.inventory.hosts[host].address
    host_text = f"[{address}]" if ":" in address else address
    return f"{'tcp' if inventory_file.inventory.security.insecure else 'tls'}/{host_text}:{port}"


def connections(inventory_file: InventoryFile, hosts_by_process: dict[str, str]) -> dict[tuple[str, int], set[str]]:
    """Return, by host and port of the listening process, the other hosts whose roles or routers connect to it."""
    inventory = inventory_file.inventory
    links = [(host, inventory.hosts[host].router) for name, host in hosts_by_process.items() if name != WORLD]
    links += [(router.host, router.upstream) for router in inventory.routers.values()]
    sources: dict[tuple[str, int], set[str]] = {}
    for source, upstream in links:
        target = _listener(inventory, hosts_by_process, upstream)
        if target[0] != source:
            sources.setdefault(target, set()).add(source)
    return sources


def _listener(inventory: Inventory, hosts_by_process: dict[str, str], router: str | None) -> tuple[str, int]:
    if router is None:
        return hosts_by_process[WORLD], inventory.port
    return inventory.routers[router].host, inventory.routers[router].port


def below_home(path: str) -> str:
    return path if path.startswith(("/", "~/")) else f"~/{path}"


def python(host: Host) -> str:
    """Return the path of a host's Python interpreter with zsim: the one given, or that of `zsim push`."""
    return host.python or f"{below_home(host.folder)}/venv/bin/python"


# Processes


class PlannedProcess(NamedTuple):
    """One process of a run."""

    name: str  # the role, or `role.thing`
    host: str
    words: tuple[str, ...]  # words of the command, without file paths and `thing`
    thing: str | None  # argument of the command, such as the name of a drone, cluster or router; None: no argument
    port: int | None  # port on which it listens; None: it does not listen
    secure: bool  # whether it uses TLS
    on_death: OnDeath

    @property
    def is_restarted(self) -> bool:
        """Whether its service restarts it; false for the world, because a world run as a service keeps no journal."""
        return self.on_death == "restart" and self.name != WORLD

    @property
    def role(self) -> str:
        return self.name.partition(".")[0]

    @property
    def unit(self) -> str:
        return f"zsim-{self.name}.service"


class ProcessFiles(NamedTuple):
    """Paths of a process's files, as given on its command line."""

    scenario: str
    identity: str  # folder with ca.pem, certificate.pem and key.pem
    access: str  # access-control file of a listening process
    out: str  # folder for the record


def processes(inventory_file: InventoryFile, scenario: Scenario, pace: Sequence[str] = ()) -> list[PlannedProcess]:
    """Return the processes that zsim can start: the world, the recorder, agents, cameras, then routers.

    `pace`: command-line options that set the world's pace. Raises InventoryError as `placement` does.
    """
    inventory, hosts_by_process = inventory_file.inventory, placement(inventory_file, scenario)

    def planned(name: str, host: str, words: Iterable[str], thing: str | None, port: int | None) -> PlannedProcess:
        death = on_death(scenario.processes.on_death, name)
        return PlannedProcess(name, host, tuple(words), thing, port, not inventory.security.insecure, death)

    def role(name: str, host: str) -> PlannedProcess:
        role, _, thing = name.partition(".")
        if name == WORLD:
            listen = listening(inventory_file, host, inventory.port)
            return planned(name, host, (WORLD, "--listen", listen, "--expect", RECORDER, *pace), None, inventory.port)
        reach = ("--connect", endpoint(inventory_file, hosts_by_process, host), "--federation", scenario.federation)
        words = (COMMANDS.get(role, role), *reach)
        if role in scenario.own_agents:
            return planned(name, host, ("agent", *reach), name, None)
        if role in CAMERA_ROLES:
            words = (*words, "--name", name)
            thing = thing if thing in {drone.name for drone in scenario.drones} else ""  # empty: all with a camera
        return planned(name, host, words, thing or None, None)

    def router(name: str) -> PlannedProcess:
        host, port = inventory.routers[name].host, inventory.routers[name].port
        upstream = listening(inventory_file, *_listener(inventory, hosts_by_process, inventory.routers[name].upstream))
        words = (ROUTER, "--listen", listening(inventory_file, host, port), "--connect", upstream)
        options = ("--federation", scenario.federation, *([REALTIME] if REALTIME in pace else []))
        return planned(f"{ROUTER}.{name}", host, (*words, *options), name, port)

    role_processes = [role(name, host) for name, host in hosts_by_process.items() if _is_known(name, scenario)]

    def depth(name: str) -> int:
        parent = inventory.routers[name].upstream
        return 0 if parent is None else 1 + depth(parent)

    return role_processes + [router(name) for name in sorted(inventory.routers, key=lambda name: (depth(name), name))]


def own_programs(inventory_file: InventoryFile, scenario: Scenario, host: str | None = None) -> list[str]:
    """Return a line about each of the user's own programs, with its command if the scenario gives one.

    `host`: only programs placed on that host; None: all, including those without a host.
    """
    hosts_by_process = placement(inventory_file, scenario)
    found = [
        (name, program_host, f" on {program_host}")
        for name, program_host in hosts_by_process.items()
        if not _is_known(name, scenario)
    ]
    found += [
        (name, hosts_by_process[WORLD], "")
        for name in (local_programs(inventory_file, scenario) if host is None else ())
    ]
    remarks = []
    for name, program_host, where in found:
        if host in (None, program_host):
            address = endpoint(inventory_file, hosts_by_process, program_host)
            text = f"{name}{where} is a program of your own: start it yourself; it connects to {address}"
            remarks.append(text + _command_text(name, scenario, address))
    return remarks


def local_programs(inventory_file: InventoryFile, scenario: Scenario) -> list[str]:
    """Return the names of a scenario's programs without a host; `zsim up` starts them on this machine."""
    hosts_by_process = placement(inventory_file, scenario)
    return [name for name in programs(scenario) if name not in hosts_by_process]


def _command_text(name: str, scenario: Scenario, endpoint: str) -> str:
    """Return a scenario program's command line, empty for others; the user replaces `{folder}` with that of the run."""
    if name not in scenario.own_programs:
        return ""
    values = {"endpoint": endpoint, "federation": scenario.federation, "name": name, "folder": "{folder}"}
    return f": {shlex.join(fill_placeholders(scenario.own_programs[name].command, values))}"


def _is_known(name: str, scenario: Scenario) -> bool:
    return name in (WORLD, RECORDER, *agent_names(scenario)) or name.partition(".")[0] in CAMERA_ROLES


def command(process: PlannedProcess, files: ProcessFiles) -> list[str]:
    words = [*MODULE, *process.words, "--host", process.host]
    if process.name == RECORDER:
        words += ["--out", files.out]
    words += ["--tls", files.identity] if process.secure else ["--insecure"]
    if process.secure and process.port is not None:
        words += ["--access", files.access]
    argument = files.scenario if process.name == WORLD else process.thing
    return [*words, "--", argument] if argument is not None else words  # the argument may begin with a dash


def access_file(process: PlannedProcess) -> str:
    """Return the name of a listening process's access-control file, in its host's certificate folder."""
    return f"{process.name}.access.json"


def on_host(planned: Sequence[PlannedProcess], host: str) -> list[PlannedProcess]:
    return [process for process in planned if process.host == host]


def used_hosts(planned: Sequence[PlannedProcess]) -> list[str]:
    return list(dict.fromkeys(process.host for process in planned))


def extras(names: Sequence[str]) -> list[str]:
    named = {EXTRAS_BY_NAME[name] for name in names if name in EXTRAS_BY_NAME}
    return sorted(named | {extra for name in names for kind, extra in EXTRAS_BY_ROLE.items() if name.startswith(kind)})


def needed_extras(inventory: Inventory, additional: Iterable[str] = ()) -> dict[str, frozenset[str]]:
    """Return the extras that each host needs, including `additional`.

    A pattern is assumed to match every role that it can, because the scenario is unknown here. Routers and the user's
    own programs need no extra.
    """
    extras_by_host: dict[str, set[str]] = {name: set(additional) for name in inventory.hosts}
    for process, host in spread(inventory.roles, EXTRAS_BY_NAME).items():
        extras_by_host[host].add(EXTRAS_BY_NAME[process])
    for pattern, entry in inventory.roles.items():
        for host in [entry] if isinstance(entry, str) else entry:
            extras_by_host[host].update(extra for kind, extra in EXTRAS_BY_ROLE.items() if _can_match(pattern, kind))
    return {name: frozenset(extras) for name, extras in extras_by_host.items()}


def _can_match(pattern: str, kind: str) -> bool:
    """Whether a pattern can match a name with the prefix `kind`."""
    if kind.removesuffix(".") in CAMERA_ROLES:
        return pattern.startswith(kind)  # these roles exist only where they are named
    literal = pattern[: min((pattern.find(sign) for sign in "*?[" if sign in pattern), default=len(pattern))]
    return literal.startswith(kind) or (literal != pattern and kind.startswith(literal))
