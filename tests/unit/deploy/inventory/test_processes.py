"""Which extras a host needs, from the roles that an inventory gives it."""

import re
import tomllib
from pathlib import Path

import pytest

from zsim.contract.fingerprint import PACKAGES
from zsim_deploy.inventory.inventory import Host, Inventory, Router
from zsim_deploy.inventory.processes import needed_extras

AGENTS, RECORD, WORLD = "agents", "record", "world"


@pytest.mark.parametrize(
    ("roles", "a", "b"),
    [
        ({"world": "a", "estimator.*": "b"}, {WORLD, RECORD}, {AGENTS}),
        ({"world": "a", "recorder": "b", "estimator.*": "b"}, {WORLD}, {RECORD, AGENTS}),
        ({"world": "a", "estimator.drone1": "b", "controller.main": "a"}, {WORLD, RECORD, AGENTS}, {AGENTS}),
        ({"world": "a", "estimator.*": ["a", "b"]}, {WORLD, RECORD, AGENTS}, {AGENTS}),
        ({"world": "a", "*.drone1": "b"}, {WORLD, RECORD}, {AGENTS}),
        ({"world": "a", "*": "b"}, {WORLD}, {RECORD, AGENTS}),
        ({"world": "a", "my.drone1": "b"}, {WORLD, RECORD}, set()),
        ({"wor*": "a", "rec*": "b"}, {WORLD}, {RECORD}),
        ({"*": ["a", "b"]}, {WORLD, AGENTS}, {RECORD, AGENTS}),
        ({"world": ["a", "b"]}, {WORLD, RECORD}, set()),
        ({"estimator.*": "a"}, {AGENTS}, set()),
    ],
)
def test_a_host_needs_the_extras_of_its_roles(roles: dict[str, str | list[str]], a: set[str], b: set[str]) -> None:
    inventory = Inventory(hosts={"a": Host(address="192.0.2.1"), "b": Host(address="192.0.2.2")}, roles=roles)
    assert needed_extras(inventory) == {"a": a, "b": b}


def test_a_router_needs_none_and_extras_can_be_added() -> None:
    hosts = {"a": Host(address="192.0.2.1"), "gate": Host(address="192.0.2.2")}
    inventory = Inventory(hosts=hosts, roles={"world": "a"}, routers={"north": Router(host="gate")})
    assert needed_extras(inventory)["gate"] == set()
    assert needed_extras(inventory, ["report"]) == {"a": {WORLD, RECORD, "report"}, "gate": {"report"}}


def distributions(extra: str | None) -> set[str]:
    """Return what is installed with an extra beside that which everybody has; with None, what everybody has."""
    project = tomllib.loads((Path(__file__).parents[4] / "pyproject.toml").read_text())["project"]
    found: set[str] = set()
    for line in project["dependencies"] if extra is None else project["optional-dependencies"][extra]:
        name, more = re.fullmatch(r"([A-Za-z0-9_.-]+)(?:\[(.*?)\])?.*", line).groups()  # type: ignore[union-attr]
        found |= (
            {name.lower()} if name != "zsim" else {each for part in more.split(",") for each in distributions(part)}
        )
    return found


@pytest.mark.parametrize("extra", [AGENTS, WORLD])
def test_who_calculates_has_all_that_its_bits_depend_on(extra: str) -> None:
    """Else a host that `zsim push` has installed on would compute with another fingerprint."""
    brought_along = {"llvmlite": "numba"}
    wanted = {brought_along.get(package, package) for package in PACKAGES}
    assert wanted <= distributions(extra) | distributions(None)
