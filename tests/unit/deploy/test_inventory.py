"""Inventories: which process runs where, which connects to which, and every fault reported at once, a line each."""

import errno
import os
import re
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from refused import has_terms

from zsim.contract.fingerprint import PACKAGES
from zsim.errors import InventoryError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_deploy import inventory
from zsim_deploy.inventory import Host, Inventory, InventoryFile, Router, needed_extras

ROOT = Path(__file__).parents[3]
HOSTS = {"lab": {"address": "192.168.1.10"}, "one": {"address": "192.168.1.21"}, "two": {"address": "192.168.1.22"}}
ROLES: dict[str, Any] = {"world": "lab", "controller.*": "lab", "estimator.*": ["one", "two"]}


@pytest.fixture
def step() -> Scenario:
    """Return a scenario of three drones in one cluster."""
    return scenario_file.load(ROOT / "scenarios/step.yaml")


def load(folder: Path, document: Any) -> InventoryFile:
    path = folder / "hosts.yaml"
    path.write_text(document if isinstance(document, str) else yaml.safe_dump(document, sort_keys=False))
    return inventory.load(path)


def placed(folder: Path, **fields: Any) -> InventoryFile:
    return load(folder, {"hosts": HOSTS, "roles": ROLES, **fields})


def faults(folder: Path, document: Any) -> list[str]:
    with pytest.raises(InventoryError) as caught:
        load(folder, document)
    return caught.value.faults


def places(folder: Path, scenario: Scenario, roles: dict[str, Any]) -> dict[str, str]:
    return inventory.placement(placed(folder, roles=roles), scenario)


def test_the_example_is_secure_and_places_every_process_of_the_step_scenario(step: Scenario) -> None:
    example = inventory.load(ROOT / "examples/hosts.yaml")
    assert not example.inventory.security.insecure
    assert example.folder == ROOT / "examples"
    estimators = {f"estimator.drone{i}": f"onboard{i}" for i in (1, 2, 3)}
    fixed = dict.fromkeys(("world", "recorder", "controller.main"), "lab-pc")
    assert inventory.placement(example, step) == {**fixed, **estimators}


@pytest.mark.parametrize(
    ("roles", "estimators", "recorder"),
    [
        (ROLES, "one two one", "lab"),  # processes take the hosts of a list in turn
        (dict(reversed(ROLES.items())), "one two one", "lab"),
        (
            {**ROLES, "estimator.drone1": "lab"},
            "lab one two",
            "lab",
        ),  # a full name takes precedence, and does not advance the list
        (
            {"*": "lab", "estimator.*": "one", "estimator.*3": "two"},
            "one one two",
            "lab",
        ),  # a longer pattern takes precedence, too
        ({**ROLES, "recorder": "two"}, "one two one", "two"),
        ({**ROLES, "world": ["one", "two"]}, "one two one", "one"),  # by default, the recorder runs on the world's host
        ({**ROLES, "*": ["one", "two"]}, "one two one", "one"),  # the recorder takes the first host of its own pattern
        ({**ROLES, "world": "*", "*": ["one", "two"]}, "one two one", "two"),
    ],
)
def test_processes_are_placed_by_the_most_specific_pattern(
    tmp_path: Path, step: Scenario, roles: dict[str, Any], estimators: str, recorder: str
) -> None:
    roles = {name: hosts for name, hosts in roles.items() if hosts != "*"}
    found = places(tmp_path, step, roles)
    assert [found[f"estimator.drone{i}"] for i in (1, 2, 3)] == estimators.split()
    assert (found["recorder"], found["controller.main"]) == (recorder, "lab")


def test_unplaced_processes_and_unused_patterns_are_reported_at_once(tmp_path: Path, step: Scenario) -> None:
    """The user's own programs are placed, too."""
    with pytest.raises(InventoryError) as caught:
        places(tmp_path, step, {"world": "lab", "estimator.drone1": "one", "estimater.*": "two"})
    *lines, last = caught.value.faults
    for name, line in zip(("estimator.drone2", "estimator.drone3", "controller.main"), lines, strict=True):
        assert has_terms(line, "hosts.yaml", "roles", "no host", name, repr(name))
    assert has_terms(last, "hosts.yaml", "roles.estimater.*", "'step'", "world", "recorder")
    own = scenario_file.load(ROOT / "scenarios/step.yaml", ["processes.expect=[my.drone1, recorder, controller.main]"])
    found = places(tmp_path, own, {"world": "lab", "my.*": "one", "controller.main": "two"})
    assert found == {"world": "lab", "recorder": "lab", "my.drone1": "one", "controller.main": "two"}


SITES = {"site": {"host": "one", "port": 7448}, "yard": {"host": "two", "port": 7449, "upstream": "site"}}


@pytest.fixture
def sites(tmp_path: Path) -> InventoryFile:
    """Return an inventory in which host two is behind its own router, which is behind that of host one."""
    return placed(tmp_path, routers=SITES, hosts={**HOSTS, "two": {"address": "192.168.1.22", "router": "yard"}})


def test_processes_connect_through_the_routers_of_their_hosts(sites: InventoryFile, step: Scenario) -> None:
    """Host one connects to the world; host two to its own router, that to the router on one, and that to the world."""
    found = inventory.placement(sites, step)
    assert inventory.endpoint(sites, found, "one") == "tls/192.168.1.10:7447"
    assert inventory.endpoint(sites, found, "two") == "tls/192.168.1.22:7449"
    routers = [process for process in inventory.processes(sites, step) if process.role == "router"]
    upstream = {process.name: process.words[process.words.index("--connect") + 1] for process in routers}
    assert upstream == {"router.site": "tls/192.168.1.10:7447", "router.yard": "tls/192.168.1.21:7448"}
    assert inventory.connections(sites, found) == {("lab", 7447): {"one"}, ("one", 7448): {"two"}}


def test_routers_are_listed_after_their_upstream_routers(tmp_path: Path, step: Scenario) -> None:
    chain = {f"r{i}": {"host": "lab", "port": 8000 + i, "upstream": f"r{i + 1}"} for i in range(4)}
    found = placed(tmp_path, routers={**chain, "r4": {"host": "one"}, "a": {"host": "two"}})
    routers = [process.thing for process in inventory.processes(found, step) if process.role == "router"]
    assert routers == ["a", "r4", "r3", "r2", "r1", "r0"]


def test_a_host_with_only_a_router_connects_but_the_world_does_not(tmp_path: Path, step: Scenario) -> None:
    hosts = {**HOSTS, "one": {"address": "192.168.1.21", "router": "gate"}, "gate": {"address": "192.168.1.30"}}
    found = placed(tmp_path, hosts=hosts, routers={"gate": {"host": "gate"}}, roles={**ROLES, "estimator.*": "one"})
    ways = inventory.connections(found, inventory.placement(found, step))
    assert ways == {("gate", 7448): {"one"}, ("lab", 7447): {"gate"}}
    hosts = {**HOSTS, "lab": {"address": "192.168.1.10", "router": "gate"}}
    found = placed(tmp_path, hosts=hosts, routers={"gate": {"host": "two"}}, roles={"world": "lab", "*": "one"})
    ways = inventory.connections(found, inventory.placement(found, step))
    assert ways == {("lab", 7447): {"one", "two"}}


@pytest.mark.parametrize(
    ("address", "insecure", "endpoint"),
    [
        ("192.168.1.10", False, "tls/192.168.1.10:7000"),
        ("192.168.1.10", True, "tcp/192.168.1.10:7000"),
        ("lab.example.org", False, "tls/lab.example.org:7000"),
        ("fe80::1%eth0", False, "tls/[fe80::1%eth0]:7000"),
    ],
)
def test_endpoints_have_protocol_address_and_port(
    tmp_path: Path, step: Scenario, address: str, insecure: bool, endpoint: str
) -> None:
    hosts = {**HOSTS, "lab": {"address": address}}
    found = placed(tmp_path, hosts=hosts, port=7000, security={"insecure": insecure})
    assert inventory.listening(found, "lab", 7000) == endpoint
    assert inventory.endpoint(found, inventory.placement(found, step), "one") == endpoint


def test_all_faults_are_reported_at_once(tmp_path: Path) -> None:
    document = {
        "hosts": {"lab": {"address": "192.168.1.10", "router": "yrad", "prot": 22}, "one": {"port": 0, "address": "x"}},
        "roles": {"world": "lba", "estimator.*": ["one", "three"], "recorder": []},
        "routers": {"yard": {"host": "tow", "upstream": "site"}},
        "port": "7447",
        "security": {"insecure": "yes please"},
    }
    found = faults(tmp_path, document)
    assert all(line.startswith("hosts.yaml: ") and line.isprintable() for line in found)
    assert [line.split()[1] for line in found] == [
        "hosts.lab.prot",
        "hosts.one.port",
        "port",
        "security.insecure",
        "roles.world",
        "roles.estimator.*",
        "roles.recorder",
        "routers.yard.host",
        "routers.yard.upstream",
        "hosts.lab.router",
    ]


@pytest.mark.parametrize("circle", [["a"], ["a", "b"], ["a", "b", "c"]])
def test_each_router_in_a_cycle_is_reported(tmp_path: Path, circle: list[str]) -> None:
    after = dict(zip(circle, circle[1:] + circle[:1], strict=True))
    routers = {name: {"host": "lab", "upstream": above} for name, above in {**after, "tail": "a"}.items()}
    lines = faults(tmp_path, {"hosts": HOSTS, "roles": ROLES, "routers": routers})
    for name, line in zip(circle, lines, strict=True):
        assert has_terms(line, "hosts.yaml", f"routers.{name}.upstream", "itself", "world")


@pytest.mark.parametrize(
    ("text", "terms_of_each"),
    [
        ("hosts: {}\nroles: {}", [("hosts", "0", "1")]),
        ("roles: {}", [("hosts", "missing", "map")]),
        ("hosts: 5\nroles: {}", [("hosts", "5", "map")]),
        ("hosts: true\nroles: {}\nrouters: 4.5", [("hosts", "true", "map"), ("routers", "4.5", "map")]),
        ("hosts: [a]\nroles: [b]\nrouters: [c]", [("hosts", "['a']", "map"), ("roles", "['b']", "map"), ("routers", "['c']", "map")]),
        ("hosts: {a: {address: x}}\nroles: {world: a}\nrouters: {r: {host: a, upstream: [r]}}", [("routers.r.upstream", "['r']", "text")]),
        ("hosts: {a: {address: x}}\nroles: {world: a}\nrouters: {r: {host: a, upstream: {}}}", [("routers.r.upstream", "{}", "text")]),
        ("hosts: {a: {address: x}}\nroles: {world: a}\nrouters: {r: null}", [("routers.r", "null", "map")]),
        ("hosts: {a: {address: 'x y'}}\nroles: {world: a}", [("hosts.a.address", "'x y'", "[A-Za-z0-9_.:%-]{1,253}")]),
        ("hosts: {A: {address: x}}\nroles: {}", [("hosts.A", "key", "'A'", "[a-z0-9_.-]{1,32}")]),
        ("hosts: {.: {address: x}}\nroles: {world: .}", [("hosts..", "folder")]),  # a host's folder bears its name
        ("hosts: {..: {address: x}}\nroles: {world: ..}", [("hosts...", "folder")]),
        ("hosts: {a: {address: x}, b: {address: y}}\nroles: {world: c}", [("roles.world", "'c'", "hosts", "a", "b")]),
        ("hosts: {a: {address: x, router: r}}\nroles: {world: a}", [("hosts.a.router", "'r'", "routers", "none")]),
    ],
)  # fmt: skip
def test_each_fault_is_named_with_its_path(tmp_path: Path, text: str, terms_of_each: list[tuple[str, ...]]) -> None:
    for line, terms in zip(faults(tmp_path, text), terms_of_each, strict=True):
        assert has_terms(line, "hosts.yaml", *terms)


def test_two_processes_cannot_listen_on_one_port(tmp_path: Path, step: Scenario) -> None:
    routers = {"a": {"host": "lab", "port": 7447}, "b": {"host": "one"}, "c": {"host": "one"}, "d": {"host": "two"}}
    with pytest.raises(InventoryError) as caught:
        inventory.placement(placed(tmp_path, routers=routers), step)
    first, second = caught.value.faults
    assert has_terms(first, "hosts.yaml", "routers.a.port", "7447", "world", "lab")
    assert has_terms(second, "hosts.yaml", "routers.c.port", "7448", "router.b", "one")


@pytest.mark.parametrize(
    ("content", "terms"),
    [
        (None, ("read", os.strerror(errno.ENOENT), "path", "YAML")),
        ("", ("empty", "map", "examples/hosts.yaml")),
        ("hosts: {a: {address: x}", ("YAML",)),
        ("hosts: {a: {address: x}, a: {address: y}}\nroles: {}", ("given", "twice")),
    ],
)
def test_a_file_that_is_not_an_inventory_is_reported_in_one_line(
    tmp_path: Path, content: str | None, terms: tuple[str, ...]
) -> None:
    path = tmp_path / "own.yaml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InventoryError) as caught:
        inventory.load(path)
    (line,) = caught.value.faults
    assert has_terms(line, *terms)


HOST = "hosts: {h: {address: a}}\nroles: {world: h}\n"
LONG = {
    "hosts": (
        "hosts: {" + "".join(f"h{i}: {{address: a}}," for i in range(40_000)) + "}\nroles: {world: h0}\n",
        "hosts",
    ),
    "roles": ("hosts: {h: {address: a}}\nroles: {" + "".join(f"r{i}: g," for i in range(80_000)) + "}\n", "roles"),
    "routers": (
        HOST + "routers: {" + "".join(f"r{i}: {{host: h, upstream: r{i + 1}}}," for i in range(25_000)) + "}\n",
        "routers",
    ),
    "hosts of a role": ("hosts: {h: {address: a}}\nroles: {world: [" + "h," * 190_000 + "]}\n", "roles.world"),
}


@pytest.mark.parametrize("name", LONG)
def test_a_megabyte_that_is_not_an_inventory_is_refused_quickly(tmp_path: Path, name: str) -> None:
    text, where = LONG[name]
    start_s = time.process_time()
    lines = faults(tmp_path, text)
    assert time.process_time() - start_s < 2.0  # the promised limit; comparing all pairs of routers would take minutes
    assert has_terms(lines[0], where)


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


def test_a_router_needs_no_extras_and_extras_can_be_added() -> None:
    hosts = {"a": Host(address="192.0.2.1"), "gate": Host(address="192.0.2.2")}
    inventory = Inventory(hosts=hosts, roles={"world": "a"}, routers={"north": Router(host="gate")})
    assert needed_extras(inventory)["gate"] == set()
    assert needed_extras(inventory, ["report"]) == {"a": {WORLD, RECORD, "report"}, "gate": {"report"}}


@pytest.mark.parametrize("extra", [AGENTS, WORLD])
def test_computing_roles_require_every_package_of_the_fingerprint(extra: str) -> None:
    """Otherwise a host installed by `zsim push` could not compute, or would be slower."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

    def distributions(lines: list[str]) -> set[str]:
        matches = [re.match(r"([A-Za-z0-9_.-]+)(?:\[(.*?)\])?", line) for line in lines]
        ours = [part for match in matches if match and match[1] == "zsim" for part in match[2].split(",")]
        others = {match[1].lower() for match in matches if match and match[1] != "zsim"}
        return others.union(*(distributions(project["optional-dependencies"][part]) for part in ours))

    brought_along = {"llvmlite": "numba"}
    wanted = {brought_along.get(package, package) for package in PACKAGES}
    assert wanted <= distributions([*project["dependencies"], f"{project['name']}[{extra}]"])
