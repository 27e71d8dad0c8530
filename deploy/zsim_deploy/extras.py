"""Which extras of the distribution a host needs for the roles that an inventory gives it. Pure."""

import fnmatch
from collections.abc import Iterable, Mapping

from zsim_deploy.inventory import RECORDER, WORLD, Inventory

NAMED = {WORLD: "world", RECORDER: "record"}  # processes that there is one of
KINDS = {"estimator.": "agents", "controller.": "agents"}  # by the beginning of the process name
MODULES = {  # what proves that an extra is whole, the installation without extras first
    "": "zsim.session",
    "agents": "zsim_agents.estimator",
    "record": "zsim_agents.recorder",
    "world": "zsim_world.process",
}


def needed(inventory: Inventory, more: Iterable[str] = ()) -> dict[str, frozenset[str]]:
    """Return the extras of every host.

    A pattern counts for whatever it can match, since the scenario is not known here. The recorder runs with the world
    unless it is placed. A router, and a process of one's own, needs no extra.

    Args:
        more: extras for every host, beside those of its roles.
    """
    given = inventory.roles
    found: dict[str, set[str]] = {name: set(more) for name in inventory.hosts}
    for process, extra in NAMED.items():
        for host in _places(given, process):
            found[host].add(extra)
    for entry in given:
        for host in _hosts(given, entry):
            found[host].update(extra for kind, extra in KINDS.items() if _can_match(entry, kind))
    return {name: frozenset(extras) for name, extras in found.items()}


def _places(given: Mapping[str, str | list[str]], process: str) -> list[str]:
    """Return the hosts at which a process of this name may run."""
    entry, world = _entry(given, process), _entry(given, WORLD)
    if process == RECORDER and entry in (None, world):
        return _hosts(given, world)[:2] if world else []  # in turn with the world, or at its host
    return _hosts(given, entry)[:1] if entry else []


def _entry(given: Mapping[str, str | list[str]], process: str) -> str | None:
    """Return the entry that places a process: its name counts more than a pattern, a longer pattern more."""
    matching = [entry for entry in given if fnmatch.fnmatchcase(process, entry)]
    return max(matching, key=lambda entry: (entry == process, len(entry)), default=None)


def _hosts(given: Mapping[str, str | list[str]], entry: str) -> list[str]:
    hosts = given[entry]
    return [hosts] if isinstance(hosts, str) else hosts


def _can_match(entry: str, kind: str) -> bool:
    """Tell whether a pattern can match a name that begins so."""
    literal = entry[: min((entry.find(sign) for sign in "*?[" if sign in entry), default=len(entry))]
    wild = literal != entry
    return literal.startswith(kind) or (wild and kind.startswith(literal))
