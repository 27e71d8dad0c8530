"""Zenoh's access control out of the rights of roles. Pure.

Zenoh judges at the process that listens (the world, a router), by the common name in the certificate of the other
side, both ways: what comes in from it and what goes out to it. An expression is allowed if a rule's includes it.
docs.rs/zenoh-config, AclConfig.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from zsim.scenario import rights
from zsim.scenario.rights import Rights
from zsim.scenario.scenario import Scenario

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
# That somebody listens or answers is told to all: without it nothing is sent. What is said is not in it.
_TOLD = ("declare_subscriber", "declare_queryable", "liveliness_query", "declare_liveliness_subscriber")
_MESSAGES = (*_TOLD, "put", "delete", "query", "reply", "liveliness_token")


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
        the map of Zenoh's configuration; everything is denied that is not in it.
    """
    granted = {name: rights.of(name, scenario) for name in clients}
    for name, behind in routers.items():
        granted[name] = rights.union(rights.of(process, scenario) for process in behind)
    granted |= dict.fromkeys(above, rights.ALL)
    entries = [(name, list(_rules(name, right, scenario.federation))) for name, right in granted.items()]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for _, rules in entries for rule in rules],
        "subjects": [{"id": name, "cert_common_names": [name]} for name, _ in entries],
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
    yield _rule(name, ("egress",), _TOLD, rights.EVERYTHING, federation)


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
