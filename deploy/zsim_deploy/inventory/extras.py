"""Which extras of the distribution a host needs for the roles that an inventory gives it."""

import importlib.metadata
from collections.abc import Iterable

from zsim.scenario.rights import RECORDER, WORLD
from zsim.scenario.role_table import AGENTS, ROLES
from zsim_deploy.inventory.inventory import Inventory, hosts_of, spread

PROJECT = "zsim"
NAMED = {name: ROLES[name].extra for name in (WORLD, RECORDER)}  # there is one of each; in the order of placement
KINDS = {f"{name}.": role.extra for name, role in AGENTS.items()}  # by the beginning of the process name
MODULES = {  # what proves that an extra is whole, the installation without extras first
    "": "zsim.transport.session",
    "agents": "zsim_agents.estimation.estimator",
    "record": "zsim_agents.recorder",
    "world": "zsim_world.server.world_process",
}


def known() -> list[str]:
    """Return the extras of what is installed here."""
    return sorted(importlib.metadata.metadata(PROJECT).get_all("Provides-Extra") or [])


def needed(inventory: Inventory, more: Iterable[str] = ()) -> dict[str, frozenset[str]]:
    """Return the extras of every host.

    A pattern counts for whatever it can match, since the scenario is not known here. A router, and a process of one's
    own, needs no extra.

    Args:
        more: extras for every host, beside those of its roles.
    """
    given = inventory.roles
    found: dict[str, set[str]] = {name: set(more) for name in inventory.hosts}
    for process, host in spread(given, NAMED).items():
        found[host].add(NAMED[process])
    for entry in given:
        for host in hosts_of(given, entry):
            found[host].update(extra for kind, extra in KINDS.items() if _can_match(entry, kind))
    return {name: frozenset(extras) for name, extras in found.items()}


def _can_match(entry: str, kind: str) -> bool:
    """Tell whether a pattern can match a name that begins so."""
    literal = entry[: min((entry.find(sign) for sign in "*?[" if sign in entry), default=len(entry))]
    wild = literal != entry
    return literal.startswith(kind) or (wild and kind.startswith(literal))
