"""Users' classes in a scenario: their parameters and messages, filled in when the scenario is read.

Readers of `world/info` thus have all parameters and messages without importing the classes.
"""

import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import msgspec
from msgspec import UNSET

from zsim.contract.messages import AgentMessage, about, message_info
from zsim.errors import DocumentError, NotTrustedError
from zsim.scenario.scenario import LAWS, OwnAgent
from zsim.schema import parameters, plugin
from zsim.schema.checker import Fault, faults, faults_in, listed
from zsim.sensors.sensor_catalogue import sensor_names

OF_THE_RUN = ("info", "scenario", "drone", "cluster")  # arguments of an agent's constructor that are not parameters


class AgentMethods:
    """Methods required of an agent's class: those of zsim.Agent, which is not imported here."""

    def receive(self, key: str, message: Any) -> None: ...

    def step(self, t_ns: int) -> Any: ...


def with_agents(section: Any, imports: bool) -> tuple[Any, list[Fault]]:
    """Return a scenario's `agents:` section, completed with its classes' parameters and messages, and its faults.

    Args:
        imports: whether classes may be imported; if not, the section must already be complete.
    """
    if not isinstance(section, dict):
        return section, []
    filled, wrong = dict(section), list[Fault]()
    for role, entry in section.items():
        if any(faults(entry, OwnAgent)) or "declared" in entry:
            continue
        where = f"agents.{role}"
        if not imports:
            wrong.append((f"{where}.declared", "is missing; must be present in a resolved scenario"))
            continue
        try:
            filled[role] = {**entry, **_declared(entry, where)}
        except NotTrustedError:
            continue
        except DocumentError as error:
            wrong += faults_in(error)
    return filled, wrong


def _declared(entry: dict[str, Any], where: str) -> dict[str, Any]:
    name: str = LAWS.get(entry["class"]) or entry["class"]
    kind: Any = plugin.load(name, f"{where}.class", AgentMethods)
    values = parameters.resolved(kind, entry.get("parameters", {}), f"{where}.parameters", OF_THE_RUN)
    published, per = messages_of(kind, f"{where}.class"), entry.get("per", "drone")
    for each in published:
        if about(each) != per:
            raise DocumentError([f"{where}.per is {per!r}, and the key of {each.__name__} is {each.key}; must agree"])
    return {
        "class": name,
        "parameters": values,
        "declared": [msgspec.to_builtins(message_info(each)) for each in published],
    }


def with_parameters(document: dict[str, Any]) -> list[Fault]:
    """Fill in the parameters of users' spaces, laws and estimators in a raw document; return the faults found.

    Classes that cannot be imported here are skipped: the processes that need them report the fault.
    """
    wrong: list[Fault] = []
    clusters = document.get("clusters")
    sections = [(f"clusters[{i}]", each) for i, each in enumerate(clusters if isinstance(clusters, list) else [])]
    references = [(where, each, part, f"{part}_parameters") for where, each in sections for part in ("space", "law")]
    references.append(("estimation", document.get("estimation"), "algorithm", "parameters"))
    for where, section, part, field in references:
        name = section.get(part) if isinstance(section, dict) else None
        if not (isinstance(name, str) and re.fullmatch(plugin.CLASS_NAME, name)):
            continue
        try:
            kind = plugin.load(name, f"{where}.{part}", object)
        except DocumentError:
            continue
        values = section.get(field, {})
        try:
            if parameters.has_parameters(kind):
                section[field] = parameters.resolved(kind, values, f"{where}.{field}")
            else:
                parameters.bound(kind, values, f"{where}.{field}")
        except DocumentError as error:
            wrong += faults_in(error)
    return wrong


def law_faults(cluster: Any, drones: Mapping[str, Any], unread: Collection[str]) -> Iterator[Fault]:
    """Yield the faults of a cluster's grants to its law: grants to a stock law, duplicates, sensors that no drone has.

    Args:
        drones: valid parts of the drones by name.
        unread: names of sensors absent from these because their modules could not be read.
    """
    grants = [name for name in ("law_sensors", "law_map") if getattr(cluster, name)]
    if grants and cluster.law in (UNSET, "proportional"):
        yield from ((name, "is given, but the stock law uses none; must be left out") for name in grants)
        return
    has = [drones[name].sensors for name in cluster.drones or () if name in drones]
    if not has or None in has:
        return
    names = list(dict.fromkeys(name for sensors in has for name in sensor_names(sensors)))
    first: dict[str, int] = {}
    for k, name in enumerate(cluster.law_sensors or ()):
        where = f"law_sensors[{k}]"
        if name is not None and first.setdefault(name, k) != k:
            yield where, f"is {name!r}, as law_sensors[{first[name]}]; must be unique"
        elif name is not None and name not in (*names, *unread):
            yield where, f"is {name!r}, which none of its drones has; must be one of {listed(names)}"


def messages_of(kind: Any, where: str) -> tuple[type[AgentMessage], ...]:
    """Return the message classes that an agent's class publishes.

    Raises:
        DocumentError: one of them is invalid.
    """
    classes = getattr(kind, "messages", ())
    try:
        for each in classes:
            if not (isinstance(each, type) and issubclass(each, AgentMessage)):
                raise TypeError(f"{each!r:.60} is not a subclass of zsim.AgentMessage")
            message_info(each)
    except (TypeError, ValueError) as error:
        raise DocumentError([f"{where} is {kind.__name__}, whose messages cannot be used: {error}"]) from error
    return tuple(classes)


def agent_faults(agents: Any, roles: Any, clusters: bool) -> Iterator[Fault]:
    """Yield conflicts between the agents of a scenario.

    Args:
        agents: valid parts of the agents by role.
        roles: zsim's own roles, which users must not use.
        clusters: whether the scenario has clusters.
    """
    writers: dict[str, str] = {}
    for role, agent in (agents or {}).items():
        if role in roles:
            yield f"agents.{role}", f"is a role of zsim; must be a name other than {', '.join(roles)}"
        if agent.per == "cluster" and not clusters:
            yield f"agents.{role}.per", "is 'cluster', and the scenario has none; must be drone or run"
        for info in agent.declared or ():
            first = writers.setdefault(info.key, role)
            if first != role:
                conflict = f"publishes {info.key} as agents.{first} does"
                yield f"agents.{role}.class", f"{conflict}; each key must have one writer"
