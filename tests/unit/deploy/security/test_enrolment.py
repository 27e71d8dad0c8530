"""Who gets a certificate and whom each listening process lets in, by inventory and scenario."""

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from zsim.errors import BadNameError, InventoryError, RunError
from zsim.scenario import scenario_file
from zsim_deploy.cli.cli import app
from zsim_deploy.inventory import inventory
from zsim_deploy.security.enrolment import Enrolment, Wanted

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
    assert [each for each in wanted if each.process == "world"] == [Wanted("lab", "world", ("10.0.0.1",))]
    assert [each for each in wanted if each.process == "router.hill"] == [Wanted("hut", "router.hill", ("hut.local",))]
    for process in ("recorder", "estimator.drone1", "estimator.drone2", "controller.main"):
        assert [each for each in wanted if each.process == process] == [
            Wanted("lab", process, ("10.0.0.1",)),
            Wanted("onboard1", process, ("10.1.0.1",)),
            Wanted("onboard2", process, ("10.1.0.2",)),
            Wanted("hut", process, ("hut.local",)),
        ]
    assert [each for each in wanted if each.process.startswith("operator.")] == [
        Wanted("operators", "operator.main"),
        Wanted("hut", "operator.anna", ("hut.local",)),
    ]


def lets_in(rules: dict[str, Any]) -> set[str]:
    return {name for subject in rules["subjects"] for name in subject["cert_common_names"]}


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
    assert str(caught.value) == (
        f"hosts.yaml: operator 'anna' is at '{host}'; must be one of hosts: lab, onboard1, onboard2, hut"
    )


@pytest.mark.parametrize("name", ["../../../oops", "a" * 33, "Anna", "", "operator.", "operator.a/b"])
def test_an_operator_whose_name_is_none_is_a_line(folder: Path, name: str) -> None:
    with pytest.raises(BadNameError, match=r"operator is '.*'; must be 1 to 32 of a-z 0-9 _ \. -$"):
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
    assert "1 certificates made, 21 kept" in init(folder, "--operator", "ben")
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
    with pytest.raises(RunError, match=r"world\.access\.json: cannot be written \(No space left on device\)"):
        init(folder, "--operator", "anna")
    assert (folder / "certs/lab/world.access.json").read_bytes() == former


def test_init_makes_everything_once_and_show_lists_it(folder: Path) -> None:
    assert "20 certificates made, 0 kept" in init(folder)
    made = {path: path.read_bytes() for path in (folder / "certs").rglob("*.pem")}
    assert "0 certificates made, 20 kept" in init(folder)
    assert {path: path.read_bytes() for path in (folder / "certs").rglob("*.pem")} == made
    assert (folder / "certs" / "hut" / "router.hill.access.json").is_file()
    shown = CliRunner().invoke(app, ["certs", "show", str(folder / "hosts.yaml")], catch_exceptions=False).stdout
    assert len(shown.splitlines()) == 20
    assert "20 certificates made, 0 kept" in init(folder, "--renew")
    assert (folder / "certs" / "ca.pem").read_bytes() == made[folder / "certs" / "ca.pem"]
