"""The processes of a run on the hosts of an inventory: where each runs, its command line, the extras that it needs."""

import importlib.metadata
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from zsim.scenario.roles import AGENTS, RECORDER, ROLES, ROUTER, WORLD, agent_names, on_death
from zsim.scenario.scenario import OnDeath, Scenario
from zsim_deploy import SAFE_PATH
from zsim_deploy.arguments import REALTIME
from zsim_deploy.inventory import inventory as inv
from zsim_deploy.inventory.inventory import Inventory, InventoryFile, hosts_of, spread

MODULE = (SAFE_PATH, "-m", "zsim_deploy.cli")  # after the interpreter
STOP_S = 15  # a world that is stopped waits 5 s for byes, and a recorder may have a disk to wait for

Rendered = dict[str, str]
"""Path inside the output folder to text."""
PROJECT = "zsim"
NAMED = {name: ROLES[name].extra for name in (WORLD, RECORDER)}  # there is one of each; in the order of placement
OF_CAMERAS = ("camera", "detector")  # roles that nobody waits for, unless the scenario names them
COMMANDS = {RECORDER: "record", "detector": "detect"}  # of roles whose command has another name
KINDS = {f"{name}.": ROLES[name].extra for name in (*AGENTS, *OF_CAMERAS)}  # by the beginning of the process name
MODULES = {  # what proves that an extra is whole, the installation without extras first
    "": "zsim.transport.session",
    "agents": "zsim_agents.estimation.estimator",
    "record": "zsim_agents.recorder",
    "cameras": "zsim_agents.cameras.detector",
    "world": "zsim_world.server.world_process",
}


class PlannedProcess(NamedTuple):
    """One process of a run.

    Attributes:
        name: `role.thing`.
        host: its host in the inventory.
        words: of the command, without what depends on where its files are, and without the name that it is given.
        thing: that name, of a drone, a cluster or a router; None where the command takes none.
        port: on which it listens, None if it does not.
        secure: whether it has a certificate.
        on_death: of the scenario.
    """

    name: str
    host: str
    words: tuple[str, ...]
    thing: str | None
    port: int | None
    secure: bool
    on_death: OnDeath

    @property
    def is_restarted(self) -> bool:
        """Tell whether its service is to start it again: not a world, which has no journal there."""
        return self.on_death == "restart" and self.name != WORLD

    @property
    def role(self) -> str:
        return self.name.partition(".")[0]


class ProcessFiles(NamedTuple):
    """Where a process finds its files, as its command line has them.

    Attributes:
        scenario: the scenario's file.
        identity: folder with ca.pem, certificate.pem and key.pem.
        access: Zenoh's access control.
        out: folder of the record.
    """

    scenario: str
    identity: str
    access: str
    out: str


def processes(placed: InventoryFile, scenario: Scenario, pace: Sequence[str] = ()) -> list[PlannedProcess]:
    """Return the processes that zsim can start: the world, the recorder, agents, cameras, then routers.

    Args:
        placed: the inventory.
        scenario: what to fly.
        pace: options of the world: `--realtime`, `--rate R`.

    Raises:
        InventoryError: a process has no place, or nothing matches a pattern.
    """
    places = inv.placement(placed, scenario)
    ours = {name: host for name, host in places.items() if _known(name, scenario)}
    return [
        *(_role(placed, scenario, places, name, host, pace) for name, host in ours.items()),
        *(_router(placed, scenario, places, name, pace) for name in inv.routers_in_order(placed.inventory)),
    ]


def own_programs(placed: InventoryFile, scenario: Scenario, host: str | None = None) -> list[str]:
    """Return a remark on each expected process that is a program of the user's own, on one host or on all."""
    places = inv.placement(placed, scenario)
    return [
        f"{name} on {at} is a program of your own: start it yourself, it connects to {inv.endpoint(placed, places, at)}"
        for name, at in places.items()
        if not _known(name, scenario) and host in (None, at)
    ]


def command(process: PlannedProcess, files: ProcessFiles) -> list[str]:
    """Return the arguments of the interpreter that run a process."""
    words = [*MODULE, *process.words, "--host", process.host]
    if process.name == RECORDER:
        words += ["--out", files.out]
    words += ["--tls", files.identity] if process.secure else ["--insecure"]
    if process.secure and process.port is not None:
        words += ["--access", files.access]
    argument = files.scenario if process.name == WORLD else process.thing
    return [*words, "--", argument] if argument is not None else words  # a name may begin with a dash


def access_file(process: PlannedProcess) -> str:
    """Return the file with a listening process's access control, in the certificates folder of its host."""
    return f"{process.name}.access.json"


def extras(names: Sequence[str]) -> list[str]:
    """Return the extras of the distribution that the processes of these names need."""
    named = {NAMED[name] for name in names if name in NAMED}
    return sorted(named | {extra for name in names for kind, extra in KINDS.items() if name.startswith(kind)})


def on_host(planned: Sequence[PlannedProcess], host: str) -> list[PlannedProcess]:
    return [process for process in planned if process.host == host]


def used_hosts(planned: Sequence[PlannedProcess]) -> list[str]:
    """Return the hosts on which something runs, in the order of the processes."""
    return list(dict.fromkeys(process.host for process in planned))


def _known(name: str, scenario: Scenario) -> bool:
    """Return whether zsim has a command for a process."""
    return name in (WORLD, RECORDER, *agent_names(scenario)) or name.partition(".")[0] in OF_CAMERAS


def _role(
    placed: InventoryFile, scenario: Scenario, places: dict[str, str], name: str, host: str, pace: Sequence[str]
) -> PlannedProcess:
    inventory = placed.inventory
    role, _, thing = name.partition(".")
    port = inventory.port if name == WORLD else None
    if name == WORLD:
        listen = inv.listening(placed, host, inventory.port)
        words = (WORLD, "--listen", listen, "--expect", RECORDER, *pace)
    else:
        start = COMMANDS.get(role, role)
        words = (start, "--connect", inv.endpoint(placed, places, host), "--federation", scenario.federation)
    if role in OF_CAMERAS:
        words = (*words, "--name", name)
        thing = thing if thing in {drone.name for drone in scenario.drones} else ""  # none: of all drones with cameras
    secure = not inventory.security.insecure
    return PlannedProcess(name, host, words, thing or None, port, secure, on_death(scenario.processes.on_death, name))


def _router(
    placed: InventoryFile, scenario: Scenario, places: dict[str, str], name: str, pace: Sequence[str]
) -> PlannedProcess:
    inventory = placed.inventory
    router = inventory.routers[name]
    listen = inv.listening(placed, router.host, router.port)
    reach = ("--connect", inv.upstream(placed, places, name), "--federation", scenario.federation)
    realtime = (REALTIME,) if REALTIME in pace else ()
    words = (ROUTER, "--listen", listen, *reach, *realtime)
    called, secure = f"{ROUTER}.{name}", not inventory.security.insecure
    return PlannedProcess(
        called, router.host, words, name, router.port, secure, on_death(scenario.processes.on_death, called)
    )


def known_extras() -> list[str]:
    """Return the extras of what is installed here."""
    return sorted(importlib.metadata.metadata(PROJECT).get_all("Provides-Extra") or [])


def needed_extras(inventory: Inventory, more: Iterable[str] = ()) -> dict[str, frozenset[str]]:
    """Return the extras of every host.

    A pattern counts for whatever it can match, since the scenario is not known here. A router, and a process of one's
    own, needs no extra.

    Args:
        more: extras for every host, beside those of its roles.
    """
    roles = inventory.roles
    extras_by_host: dict[str, set[str]] = {name: set(more) for name in inventory.hosts}
    for process, host in spread(roles, NAMED).items():
        extras_by_host[host].add(NAMED[process])
    for entry in roles:
        for host in hosts_of(roles, entry):
            extras_by_host[host].update(extra for kind, extra in KINDS.items() if _can_match(entry, kind))
    return {name: frozenset(extras) for name, extras in extras_by_host.items()}


def _can_match(entry: str, kind: str) -> bool:
    """Return whether a pattern can match a name that begins so."""
    if kind.removesuffix(".") in OF_CAMERAS:
        return entry.startswith(kind)  # nobody has them unless they are named
    literal = entry[: min((entry.find(sign) for sign in "*?[" if sign in entry), default=len(entry))]
    wild = literal != entry
    return literal.startswith(kind) or (wild and kind.startswith(literal))
