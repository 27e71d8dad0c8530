"""What a run puts on each host: processes, command lines, files."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from refused import has_terms, refused

from zsim.errors import HostsError, RunError
from zsim.scenario import scenario_file
from zsim_deploy.cli import hosts_commands
from zsim_deploy.hosts.control_socket import ControlSocket
from zsim_deploy.hosts.host_plan import HostPlan
from zsim_deploy.inventory import certificates, inventory
from zsim_deploy.inventory.enrolment import Enrolment

SCENARIO = """
name: pair
duration_s: 1
drones: [{name: drone1, position_m: [0, 0, 0]}, {name: -d2, position_m: [3, 0, 0]}]
processes: {expect: [estimator.drone1, estimator.-d2, my.drone1]}
"""
HOSTS = {
    "hosts": {
        "h1": {"address": "127.0.0.1", "port": 1, "folder": "/z"},
        "h2": {"address": "10.0.0.2"},
        "h3": {"address": "10.0.0.3"},
    },
    "roles": {"world": "h1", "estimator.*": "h1", "my.*": "h2"},
    "routers": {"field": {"host": "h1"}},
}


@pytest.fixture
def paths(tmp_path: Path) -> tuple[Path, Path]:
    scenario, hosts = tmp_path / "pair.yaml", tmp_path / "hosts.yaml"
    scenario.write_text(SCENARIO)
    hosts.write_text(yaml.safe_dump(HOSTS))
    return scenario, hosts


@pytest.fixture
def plan(paths: tuple[Path, Path]) -> HostPlan:
    scenario, hosts = paths
    return HostPlan(inventory.load(hosts), scenario_file.load(scenario), "abc", ["--rate", "4"])


def test_a_program_of_the_users_own_is_left_to_the_user(plan: HostPlan) -> None:
    assert list(plan.processes) == ["router.field", "world", "recorder", "estimator.drone1", "estimator.-d2"]
    assert plan.hosts() == ["h1"]
    (remark,) = plan.remarks
    assert has_terms(remark, "my.drone1", "h2")


def test_the_command_line_of_a_process(plan: HostPlan) -> None:
    reach = ["--connect", "tls/127.0.0.1:7447", "--federation", "zsim", "--host", "h1"]
    tls = ["--tls", "/z/runs/abc/identity/estimator.-d2"]
    assert plan.arguments("estimator.-d2") == ["estimator", "--launched", "abc", *reach, *tls, "--", "-d2"]
    world = plan.arguments("world")
    assert world[-2:] == ["--", "/z/runs/abc/scenario.yaml"]
    assert world[world.index("--access") + 1] == "/z/runs/abc/identity/world/access.json"
    assert world[world.index("--rate") + 1] == "4"


def test_a_move_changes_one_place_and_keeps_the_others(plan: HostPlan) -> None:
    moved = plan.moved("estimator.drone1", "h3").moved("estimator.-d2", "h2")
    assert {name: moved.host(name) for name in moved.processes} == {
        "router.field": "h1",
        "world": "h1",
        "recorder": "h1",
        "estimator.drone1": "h3",
        "estimator.-d2": "h2",
    }
    assert "~/.zsim/runs/abc/identity/estimator.drone1" in moved.arguments("estimator.drone1")
    assert plan.host("estimator.drone1") == "h1"


def test_the_files_of_a_host(plan: HostPlan, tmp_path: Path) -> None:
    for name in plan.processes:
        for file in ("ca.pem", "certificate.pem", "key.pem"):
            path = tmp_path / "certs" / "h1" / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{file} of {name}")
    for name in ("world", "router.field"):
        (tmp_path / "certs" / "h1" / f"{name}.access.json").write_text("{}")
    found = plan.files("h1")
    assert len(found) == 3 * len(plan.processes) + 2 + 1
    assert found["identity/estimator.-d2/key.pem"] == b"key.pem of estimator.-d2"
    assert b"name: pair" in found["scenario.yaml"]
    assert plan.files("h3") == {}


def test_a_certificate_that_is_not_there_is_a_line(plan: HostPlan) -> None:
    certificate = "certs/h3/estimator.drone1/ca.pem"
    with refused(HostsError, certificate, "read", "zsim certs init", "hosts.yaml", "--scenario FILE") as error:
        plan.moved("estimator.drone1", "h3").identity("estimator.drone1")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("given", [None, "out", "there"])
def test_a_start_that_is_refused_leaves_no_folder(
    paths: tuple[Path, Path], given: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody listens on port 1; a folder that was there before stays."""
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    out: Any = Path(given) if given else None
    with refused(HostsError, "h1", "ssh", "127.0.0.1", "port 1", "reached"):
        hosts_commands.up(scenario=paths[0], hosts=paths[1], out=out, insecure=True)
    left = {path.name for path in (*tmp_path.glob("runs/*"), *tmp_path.glob("out"), *tmp_path.glob("there"))}
    assert left == {"there"}


def test_a_federation_that_is_up_already_is_refused_before_any_host_is_asked(
    paths: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with (
        ControlSocket("zsim", {}),
        refused(RunError, "'zsim'", "up already", "--set federation=NAME"),
    ):
        hosts_commands.up(scenario=paths[0], hosts=paths[1], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with ControlSocket("zsim", {}), refused(HostsError, "h1", "reached"):
        hosts_commands.up(
            scenario=paths[0], hosts=paths[1], out=tmp_path / "out", set_=["federation=other"], insecure=True
        )


def test_certificates_that_are_missing_or_expired_are_told_before_any_host_is_asked(
    paths: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with refused(HostsError, "certs", "no certificates", "zsim certs init"):
        hosts_commands.up(scenario=paths[0], hosts=paths[1], out=tmp_path / "out")
    certify(paths, datetime.now(UTC) - timedelta(days=10))
    with refused(HostsError, "expired", "router.field", "h1", "estimator.drone1", "--renew"):
        hosts_commands.up(scenario=paths[0], hosts=paths[1], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def certify(paths: tuple[Path, Path], now: datetime) -> None:
    """Make certificates that are good for a day, and the access control beside them."""
    placed = inventory.load(paths[1])
    signer, folder = certificates.authority(placed.folder / "certs", now), placed.folder / "certs"
    enrolment = Enrolment(placed, scenario_file.load(paths[0]))
    for wanted in enrolment.certificates():
        certificates.issue(folder, signer, wanted, now, days=1.0)
    for host, name, _ in enrolment.access():
        (folder / host / f"{name}.access.json").write_text("{}")


def test_without_tls_as_the_command_line_says_it(paths: tuple[Path, Path]) -> None:
    placed = inventory.insecure(inventory.load(paths[1]))
    plan = HostPlan(placed, scenario_file.load(paths[0]), "abc")
    assert "--insecure" in plan.arguments("world")
    assert "tcp/127.0.0.1:7447" in plan.arguments("estimator.drone1")
    assert (plan.files("h1").keys(), plan.certificate_faults(datetime.now(UTC))) == ({"scenario.yaml"}, [])


def test_the_ports_of_a_host(plan: HostPlan) -> None:
    assert (sorted(plan.ports("h1")), plan.ports("h3")) == ([7447, 7448], [])
