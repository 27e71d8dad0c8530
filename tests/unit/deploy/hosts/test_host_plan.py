"""What a run puts on each host: processes, command lines, files."""

import asyncio
import shutil
import socket
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from local_host import LocalHost
from refused import has_terms, refused

from zsim.errors import HostsError, RunError
from zsim.scenario import scenario_file
from zsim_deploy import certificates, inventory
from zsim_deploy.cli import hosts_commands
from zsim_deploy.hosts.control_socket import ControlSocket
from zsim_deploy.hosts.host_plan import HostPlan, leftovers, port_faults, scp
from zsim_deploy.hosts.host_run import _refuse_unless_able
from zsim_deploy.inventory import Host

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


def test_where_what_runs(plan: HostPlan) -> None:
    assert list(plan.processes) == ["router.field", "world", "recorder", "estimator.drone1", "estimator.-d2"]
    assert plan.hosts() == ["h1"]
    assert (sorted(plan.ports("h1")), plan.ports("h3")) == ([7447, 7448], [])
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


def test_the_files_of_a_host_and_a_certificate_that_is_not_there(plan: HostPlan, tmp_path: Path) -> None:
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
    now, placed = datetime.now(UTC) - timedelta(days=10), inventory.load(paths[1])
    folder = placed.folder / "certs"
    wanted, access = certificates.enrolment(placed, scenario_file.load(paths[0]))
    signer = certificates.authority(folder, now)
    for each in wanted:
        certificates.issue(folder, signer, each, now, days=1.0)
    for host, name, _ in access:
        (folder / host / f"{name}.access.json").write_text("{}")
    with refused(HostsError, "expired", "router.field", "h1", "estimator.drone1", "--renew"):
        hosts_commands.up(scenario=paths[0], hosts=paths[1], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_without_tls_as_the_command_line_says_it(paths: tuple[Path, Path]) -> None:
    placed = inventory.insecure(inventory.load(paths[1]))
    plan = HostPlan(placed, scenario_file.load(paths[0]), "abc")
    assert "--insecure" in plan.arguments("world")
    assert "tcp/127.0.0.1:7447" in plan.arguments("estimator.drone1")
    assert (plan.files("h1").keys(), plan.certificate_faults(datetime.now(UTC))) == ({"scenario.yaml"}, [])


WAITS = "import sys; print('there', flush=True); sys.stdin.read()"


def local(folder: Path) -> LocalHost:
    return LocalHost(base=Path("/inventory"), folder=str(folder), user="pi", port=2222)


def run_of(folder: Path, run: str, *files: str) -> None:
    for file in files:
        path = folder / "runs" / run / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_records_and_keys_are_told_in_a_line_each(tmp_path: Path) -> None:
    assert asyncio.run(leftovers(local(tmp_path / "not there"), tmp_path)) == []
    folder = tmp_path / "our zsim"
    run_of(folder, "ghi", "scenario.yaml", "identity/world/ca.pem")
    assert asyncio.run(leftovers(local(folder), tmp_path)) == []
    run_of(folder, "abc", "run.mcap")
    run_of(folder, "def", "run.mcap", "identity/world/key.pem")
    records, keys = asyncio.run(leftovers(local(folder), Path("/inventory")))
    assert f"h1:{folder}/runs/abc/run.mcap, h1:{folder}/runs/def/run.mcap;" in records
    assert f"`scp -P 2222 'pi@127.0.0.1:{folder}/runs/abc/run.mcap' .`" in records
    assert f"`rm -r '{folder}/runs/def/identity'`" in keys


@pytest.mark.skipif(shutil.which("ps") is None, reason="needs ps (apt-get install procps)")
def test_a_run_that_goes_on_is_no_earlier_one(tmp_path: Path) -> None:
    run_of(tmp_path, "abcdef", "run.mcap", "identity/world/key.pem")
    words = [sys.executable, "-c", WAITS, "world", "--launched", "abcdef", "--host", "h1"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout
        process.stdout.readline()
        assert asyncio.run(leftovers(local(tmp_path), tmp_path)) == []
        process.communicate()
    assert len(asyncio.run(leftovers(local(tmp_path), tmp_path))) == 2


def test_the_way_of_a_copy_is_that_of_the_launcher() -> None:
    host = Host(address="::1", ssh="fe80::1", key="keys/a b", known_hosts="/etc/known")
    command = "scp -i '/lab/keys/a b' -o UserKnownHostsFile=/etc/known '[fe80::1]:.zsim/runs/1/run.mcap' ."
    assert scp(host, Path("/lab"), "~/.zsim/runs/1/run.mcap") == command
    assert scp(Host(address="h1"), Path(), "~/.zsim/runs/1/run.mcap") == "scp h1:.zsim/runs/1/run.mcap ."


def test_a_port_on_which_somebody_listens_is_a_line() -> None:
    link = LocalHost()
    with socket.create_server(("127.0.0.1", 0)) as taken, socket.create_server(("127.0.0.1", 0)) as free:
        numbers = [found.getsockname()[1] for found in (taken, free)]
        free.close()
        (line,) = asyncio.run(port_faults(link, sys.executable, numbers))
    assert has_terms(line, "h1", f"port {numbers[0]}", "in use")
    assert asyncio.run(port_faults(link, sys.executable, numbers[1:])) == []
    assert asyncio.run(port_faults(link, "/no/python", [])) == []


def test_a_host_whose_python_lacks_the_agents_takes_no_role(tmp_path: Path) -> None:
    bare = tmp_path / "python"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')
    bare.chmod(0o755)
    link = local(tmp_path)
    says = r"^h1: import zsim_agents.estimation.estimator failed: ModuleNotFoundError.*; controller.main cannot run on h1; install"
    with pytest.raises(HostsError, match=says):
        asyncio.run(_refuse_unless_able(link, str(bare), "controller.main"))
    asyncio.run(_refuse_unless_able(link, sys.executable, "controller.main"))
