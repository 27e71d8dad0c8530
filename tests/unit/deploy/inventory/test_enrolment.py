"""Who needs a certificate, and what each process may do."""

import errno
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import zenoh
from refused import has_terms, refused
from rights_table import KEYS, ROLES, keys_of
from rights_table import SCENARIO as RIGHTS_SCENARIO
from typer.testing import CliRunner

from zsim.errors import BadNameError, InventoryError, RunError
from zsim.scenario import roles as rights
from zsim.scenario import scenario_file
from zsim_deploy.cli.cli import app
from zsim_deploy.inventory import inventory
from zsim_deploy.inventory.certificates import CertificateRequest
from zsim_deploy.inventory.enrolment import Enrolment, access_control

SCENARIO = """
name: enrolled
duration_s: 4
drones:
  - {name: drone1, position_m: [0, 0, 0]}
  - {name: drone2, position_m: [2, 0, 0]}
clusters:
  - {name: main, drones: [drone1, drone2]}
"""
HOSTS = """
hosts:
  lab: {address: 10.0.0.1}
  onboard1: {address: 10.1.0.1, router: field}
  onboard2: {address: 10.1.0.2, router: field}
  hut: {address: hut.local, router: hill}
routers:
  field: {host: lab}
  hill: {host: hut, upstream: field}
roles:
  world: lab
  controller.main: hut
  "estimator.*": [onboard1, onboard2]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "hosts.yaml").write_text(HOSTS)
    (tmp_path / "scenario.yaml").write_text(SCENARIO)
    return tmp_path


def enrolment(folder: Path, *operators: str) -> Enrolment:
    return Enrolment(inventory.load(folder / "hosts.yaml"), scenario_file.load(folder / "scenario.yaml"), operators)


def test_world_and_routers_have_one_certificate_and_who_may_move_has_one_for_every_host(folder: Path) -> None:
    wanted = enrolment(folder, "main", "anna@hut").certificates()
    assert [each for each in wanted if each.process == "world"] == [CertificateRequest("lab", "world", ("10.0.0.1",))]
    assert [each for each in wanted if each.process == "router.hill"] == [
        CertificateRequest("hut", "router.hill", ("hut.local",))
    ]
    for process in ("recorder", "estimator.drone1", "estimator.drone2", "controller.main"):
        assert [each for each in wanted if each.process == process] == [
            CertificateRequest("lab", process, ("10.0.0.1",)),
            CertificateRequest("onboard1", process, ("10.1.0.1",)),
            CertificateRequest("onboard2", process, ("10.1.0.2",)),
            CertificateRequest("hut", process, ("hut.local",)),
        ]
    assert [each for each in wanted if each.process.startswith("operator.")] == [
        CertificateRequest("operators", "operator.main"),
        CertificateRequest("hut", "operator.anna", ("hut.local",)),
    ]


def test_the_driver_of_an_external_drone_has_a_certificate_and_is_let_in(folder: Path) -> None:
    """It runs wherever its aircraft can be reached, and the scenario need not expect it."""
    external = SCENARIO.replace("position_m: [2, 0, 0]", "position_m: [2, 0, 0], body: external")
    (folder / "scenario.yaml").write_text(external)
    wanted = [each for each in enrolment(folder).certificates() if each.process.startswith("driver.")]
    assert [(each.host, each.process) for each in wanted] == [
        (host, "driver.drone2") for host in ("lab", "onboard1", "onboard2", "hut")
    ]
    assert all("driver.drone2" in lets_in(rules) for _, _, rules in enrolment(folder).access())
    (folder / "scenario.yaml").write_text(SCENARIO)
    assert not any("driver.drone2" in lets_in(rules) for _, _, rules in enrolment(folder).access())


def lets_in(rules: dict[str, Any]) -> set[str]:
    return {name for subject in rules["subjects"] for name in subject.get("cert_common_names", ())}


def publishes(rules: dict[str, Any], name: str) -> set[str]:
    """Return the drones and clusters about which a common name may publish."""
    found = [rule for rule in rules["rules"] if rule["id"] == f"{name} ingress put"]
    keys = [key.split("/") for rule in found for key in rule["key_exprs"]]
    return {parts[2] for parts in keys if parts[1] in ("drone", "cluster")}


def test_each_listening_process_lets_in_who_comes_to_it(folder: Path) -> None:
    access = {(host, process): rules for host, process, rules in enrolment(folder, "main", "anna@hut").access()}
    world, field, hill = access["lab", "world"], access["lab", "router.field"], access["hut", "router.hill"]
    roles = {"recorder", "estimator.drone1", "estimator.drone2", "controller.main"}
    assert lets_in(world) == {*roles, "operator.main", "router.field"}
    assert lets_in(field) == {*roles, "router.hill", "world"}
    assert lets_in(hill) == {*roles, "operator.anna", "router.field"}
    assert publishes(field, "estimator.drone1") == publishes(hill, "estimator.drone1") == {"drone1"}
    assert publishes(hill, "controller.main") == {"drone1", "drone2", "main"}
    assert publishes(field, "router.hill") == {"drone1", "drone2", "main", "*"}
    assert publishes(world, "router.field") == {"drone1", "drone2", "main", "*"}
    assert publishes(hill, "router.field") == set()


def test_a_router_of_no_host_lets_in_who_comes_from_below_alone(folder: Path) -> None:
    (folder / "hosts.yaml").write_text(HOSTS.replace(", router: field", ""))
    access = {process: rules for _, process, rules in enrolment(folder).access()}
    assert lets_in(access["router.field"]) == {"router.hill", "world"}


def test_an_operator_may_be_at_several_places(folder: Path) -> None:
    found = enrolment(folder, "anna", "anna@hut", "anna")
    places = [each.host for each in found.certificates() if each.process == "operator.anna"]
    assert places == ["operators", "hut"]
    access = {process: rules for _, process, rules in found.access()}
    assert all("operator.anna" in lets_in(access[process]) for process in ("world", "router.hill"))
    assert "operator.anna" not in lets_in(access["router.field"])


@pytest.mark.parametrize("host", ["moon", ""])
def test_an_operator_at_no_host_is_a_line(folder: Path, host: str) -> None:
    with pytest.raises(InventoryError) as caught:
        enrolment(folder, f"anna@{host}")
    assert has_terms(str(caught.value), "hosts.yaml", "'anna'", f"'{host}'", "hosts", "onboard1", "onboard2")


@pytest.mark.parametrize("name", ["../../../oops", "a" * 33, "Anna", "", "operator.", "operator.a/b"])
def test_an_operator_whose_name_is_none_is_a_line(folder: Path, name: str) -> None:
    with refused(BadNameError, "operator", "1", "32", "0-9"):
        enrolment(folder, name)


def test_an_operator_s_longest_name_is_one_of_the_contract_and_of_a_certificate(folder: Path) -> None:
    init(folder, "--operator", "a" * 32)
    assert (folder / "certs/operators" / f"operator.{'a' * 32}" / "certificate.pem").is_file()


def init(folder: Path, *options: str) -> str:
    """Return what `zsim certs init` says."""
    where = [str(folder / "hosts.yaml"), "--scenario", str(folder / "scenario.yaml")]
    return CliRunner().invoke(app, ["certs", "init", *where, *options], catch_exceptions=False).stdout


def operators_of(folder: Path, host: str, process: str) -> set[str]:
    """Return the operators whom the access control of a process that listens lets in."""
    rules = json.loads((folder / "certs" / host / f"{process}.access.json").read_text())
    return {name for name in lets_in(rules) if name.startswith("operator.")}


def test_operators_who_are_there_stay(folder: Path) -> None:
    init(folder)
    assert operators_of(folder, "lab", "world") == {"operator.main"}
    init(folder, "--operator", "anna@hut")
    assert operators_of(folder, "lab", "world") == {"operator.main"}
    assert operators_of(folder, "hut", "router.hill") == {"operator.anna"}
    assert has_terms(init(folder, "--operator", "ben"), "1", "certificates", "21")
    assert operators_of(folder, "lab", "world") == {"operator.main", "operator.ben"}
    assert operators_of(folder, "hut", "router.hill") == {"operator.anna"}


def test_an_operator_whose_folder_is_gone_is_let_in_no_more(folder: Path) -> None:
    init(folder, "--operator", "anna", "--operator", "ben")
    assert operators_of(folder, "lab", "world") == {"operator.anna", "operator.ben"}
    shutil.rmtree(folder / "certs/operators/operator.anna")
    init(folder)
    assert operators_of(folder, "lab", "world") == {"operator.ben"}


def test_access_control_that_cannot_be_written_is_a_line_and_the_former_stays(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    init(folder)
    former = (folder / "certs/lab/world.access.json").read_bytes()
    replace = Path.replace

    def full(self: Path, target: Path) -> Path:
        if target.name == "world.access.json":
            raise OSError(errno.ENOSPC, "No space left on device")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", full)
    with refused(RunError, "world.access.json", "written", os.strerror(errno.ENOSPC)):
        init(folder, "--operator", "anna")
    assert (folder / "certs/lab/world.access.json").read_bytes() == former


def test_init_makes_everything_once_and_show_lists_it(folder: Path) -> None:
    assert has_terms(init(folder), "20", "certificates", "0")
    made = {path: path.read_bytes() for path in (folder / "certs").rglob("*.pem")}
    assert has_terms(init(folder), "0", "certificates", "20")
    assert {path: path.read_bytes() for path in (folder / "certs").rglob("*.pem")} == made
    assert (folder / "certs" / "hut" / "router.hill.access.json").is_file()
    shown = CliRunner().invoke(app, ["certs", "show", str(folder / "hosts.yaml")], catch_exceptions=False).stdout
    assert len(shown.splitlines()) == 20
    assert has_terms(init(folder, "--renew"), "20", "certificates", "0")
    assert (folder / "certs" / "ca.pem").read_bytes() == made[folder / "certs" / "ca.pem"]


ACTS = {"r": "reads", "p": "writes", "g": "asks", "a": "answers", "t": "tokens", "w": "watches"}
# What each act is on the wire at the process that listens: (flow, message); all of them are needed.
WIRE = {
    "r": (("ingress", "declare_subscriber"), ("egress", "put")),
    "p": (("ingress", "put"), ("egress", "declare_subscriber")),
    "g": (("ingress", "query"), ("egress", "reply")),
    "a": (("ingress", "declare_queryable"), ("egress", "query"), ("ingress", "reply")),
    "t": (("ingress", "liveliness_token"),),
    "w": (
        ("ingress", "liveliness_query"),
        ("ingress", "declare_liveliness_subscriber"),
        ("egress", "liveliness_token"),
    ),
}
TOKENS = tuple(key for key in KEYS if key.startswith("process/") and key.count("/") == 1)


@pytest.fixture(scope="module")
def scenario() -> Any:
    return scenario_file.from_text(RIGHTS_SCENARIO)


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("act", ACTS)
def test_the_rights_of_a_role_are_those_of_the_table(scenario: Any, role: str, act: str) -> None:
    expressions = getattr(rights.rights_for(role, scenario), ACTS[act])
    asked = TOKENS if act in "tw" else KEYS
    assert {key for key in asked if rights.permits(expressions, key)} == keys_of(role, act)


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("act", ACTS)
def test_zenoh_is_told_what_the_table_says(scenario: Any, role: str, act: str) -> None:
    rules = access_control(scenario, ROLES, {})
    asked = TOKENS if act in "tw" else KEYS
    assert {key for key in asked if allows(rules, role, WIRE[act], key)} == keys_of(role, act)


def allows(rules: dict[str, Any], name: str, needed: tuple[tuple[str, str], ...], key: str) -> bool:
    """Tell whether all that is needed is allowed to a common name on a key, as Zenoh decides it."""
    subjects = {subject["id"] for subject in rules["subjects"] if name in subject.get("cert_common_names", (name,))}
    ids = {rule for policy in rules["policies"] if subjects & set(policy["subjects"]) for rule in policy["rules"]}
    mine = [rule for rule in rules["rules"] if rule["id"] in ids]
    return all(
        any(
            flow in rule["flows"] and message in rule["messages"] and includes(rule["key_exprs"], f"zsim/{key}")
            for rule in mine
        )
        for flow, message in needed
    )


def includes(expressions: list[str], key: str) -> bool:
    return any(zenoh.KeyExpr(expression).includes(zenoh.KeyExpr(key)) for expression in expressions)


def test_what_is_not_granted_is_denied_and_zenoh_takes_the_whole(scenario: Any) -> None:
    rules = access_control(scenario, ROLES, {"router.site": ["estimator.drone2"]}, ["world"])
    assert rules["default_permission"] == "deny"
    assert {rule["permission"] for rule in rules["rules"]} == {"allow"}
    config = zenoh.Config()
    config.insert_json5("access_control", json.dumps(rules))


def test_a_router_may_do_what_those_behind_it_may_and_no_more(scenario: Any) -> None:
    rules = access_control(scenario, (), {"router.site": ["estimator.drone1", "controller.main"]})
    for act in ACTS:
        asked = TOKENS if act in "tw" else KEYS
        allowed = {key for key in asked if allows(rules, "router.site", WIRE[act], key)}
        assert allowed == keys_of("estimator.drone1", act) | keys_of("controller.main", act)


def test_who_is_not_named_gets_nothing(scenario: Any) -> None:
    rules = access_control(scenario, ["estimator.drone1"], {})
    assert not any(allows(rules, "estimator.drone2", WIRE[act], key) for act in ACTS for key in KEYS)


@pytest.mark.parametrize(
    ("process", "like"),
    [("my.drone1", "estimator.drone1"), ("fence.main", "controller.main")],
)
def test_a_process_that_takes_the_place_of_ours_has_its_rights(scenario: Any, process: str, like: str) -> None:
    own = {f"{of}/{name}" for of in ("process", "view/estimates") for name in (like, process)}

    def of_others(name: str, act: str) -> set[str]:
        expressions = getattr(rights.rights_for(name, scenario), ACTS[act])
        return {expression for expression in expressions if not any(expression.startswith(key) for key in own)}

    assert all(of_others(process, act) == of_others(like, act) for act in ACTS)


@pytest.mark.parametrize(
    "process", ["world.spare", "recorder.spare", "fence.round", "console", "estimator.drone9", "controller.drone1"]
)
def test_a_process_about_nothing_known_hears_what_all_are_told(scenario: Any, process: str) -> None:
    found = rights.rights_for(process, scenario)
    assert set(found.reads) == {"world/info", "clock", "world/event", "world/faults"}
    assert all(key.startswith(f"process/{process}/") for key in found.writes)


def test_the_federation_s_name_stands_before_every_key(scenario: Any) -> None:
    rules = access_control(scenario_file.from_text(RIGHTS_SCENARIO + "federation: lab2\n"), ROLES, {})
    assert all(key.startswith("lab2/") for rule in rules["rules"] for key in rule["key_exprs"])
