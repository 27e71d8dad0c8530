"""Who gets a certificate and whom each listening process lets in, by inventory and scenario."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from zsim import scenario_file
from zsim.errors import InventoryError
from zsim_deploy import inventory
from zsim_deploy.cli import app
from zsim_deploy.enrolment import Enrolment, Wanted

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


def test_fixed_roles_have_one_certificate_and_those_that_move_one_for_each_host_of_their_entry(folder: Path) -> None:
    wanted = enrolment(folder, "main", "anna@hut").certificates()
    assert Wanted("lab", "world", ("10.0.0.1",)) in wanted
    assert [each for each in wanted if each.process == "recorder"] == [Wanted("lab", "recorder", ("10.0.0.1",))]
    assert Wanted("hut", "router.hill", ("hut.local",)) in wanted
    assert {each.host for each in wanted if each.process == "estimator.drone2"} == {"onboard1", "onboard2"}
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
    assert lets_in(field) == {"estimator.drone1", "estimator.drone2", "router.hill", "world"}
    assert lets_in(hill) == {"controller.main", "operator.anna", "router.field"}
    assert publishes(field, "estimator.drone1") == {"drone1"}
    assert publishes(field, "router.hill") == {"drone1", "drone2", "main", "*"}
    assert publishes(world, "router.field") == {"drone1", "drone2", "main", "*"}
    assert publishes(hill, "router.field") == set()


def test_an_operator_at_no_host_is_a_line(folder: Path) -> None:
    with pytest.raises(InventoryError) as caught:
        enrolment(folder, "anna@moon")
    assert str(caught.value) == (
        "hosts.yaml: operator 'anna' is at 'moon'; must be one of hosts: lab, onboard1, onboard2, hut"
    )


def test_init_makes_everything_once_and_show_lists_it(folder: Path) -> None:
    arguments = ["certs", "init", str(folder / "hosts.yaml"), "--scenario", str(folder / "scenario.yaml")]
    runner = CliRunner()
    assert "10 certificates made, 0 kept" in runner.invoke(app, arguments, catch_exceptions=False).stdout
    made = {path: path.read_bytes() for path in (folder / "certs").rglob("*.pem")}
    assert "0 certificates made, 10 kept" in runner.invoke(app, arguments, catch_exceptions=False).stdout
    assert {path: path.read_bytes() for path in (folder / "certs").rglob("*.pem")} == made
    assert (folder / "certs" / "hut" / "router.hill.access.json").is_file()
    shown = runner.invoke(app, ["certs", "show", str(folder / "hosts.yaml")], catch_exceptions=False).stdout
    assert len(shown.splitlines()) == 10
    renewed = runner.invoke(app, [*arguments, "--renew"], catch_exceptions=False).stdout
    assert "10 certificates made, 0 kept" in renewed
    assert (folder / "certs" / "ca.pem").read_bytes() == made[folder / "certs" / "ca.pem"]
