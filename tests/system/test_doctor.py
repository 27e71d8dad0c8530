"""`zsim doctor` on a lab of hosts: its measurements, despite login greetings and slow links, and its faults."""

import socket
from pathlib import Path
from typing import Any

import pytest
import yaml
from forked_commands import Completed, run_here
from lab import LAUNCHER, Lab
from refused import has_terms

ROOT = Path(__file__).parents[2]
STEP = ROOT / "scenarios/step.yaml"
ROLES: dict[str, str | list[str]] = {"world": "h1", "controller.*": "h1", "estimator.*": "h2"}

pytestmark = pytest.mark.slow


def doctor(lab: Lab, hosts: Path, *options: str) -> Completed:
    """Run `zsim doctor` for the step scenario on the launcher's host."""
    with lab.inside(LAUNCHER):
        return run_here("doctor", str(STEP), "--hosts", str(hosts), *options)


def faults(done: Completed) -> list[str]:
    """Return the reported faults, without warnings."""
    return [line for line in done.stderr.splitlines() if not line.startswith("warning: ")]


def rows(text: str) -> dict[tuple[str, ...], list[str]]:
    """Return the rest of each row of the table of paths by its from, to and port."""
    below = text.partition("bandwidth")[2].splitlines()[1:]
    words = [line.split() for line in below]
    return {tuple(row[:3]): row[3:] for row in words if len(row) > 3 and row[2].isdigit()}


def test_a_router_host_is_measured_despite_login_greetings(lab: Lab) -> None:
    """h2's estimators connect to the router on h3, which connects to the world on h1."""
    for name in lab.names:
        (lab.folder / name / ".bashrc").write_text("echo 'Welcome to lab'\necho '17'\n")
    routers: dict[str, dict[str, Any]] = {"field": {"host": "h3"}}
    done = doctor(lab, lab.inventory(ROLES, routers=routers, through={"h2": "field"}, insecure=True))
    assert done.code == 0, done.stderr
    assert "ready" in done.stdout.splitlines()[-1]
    assert set(rows(done.stdout)) == {("h2", "h3", "7448"), ("h3", "h1", "7447")}


@pytest.mark.soak
def test_a_slow_link_is_measured(lab: Lab) -> None:
    lab.slow("h2", 150)
    done = doctor(lab, lab.inventory(ROLES, insecure=True))
    assert done.code == 0, done.stderr
    ((path, found),) = rows(done.stdout).items()
    assert path == ("h2", "h1", "7447")
    assert 300.0 <= float(found[0]) < 1000.0
    assert found[1] == "ms"


def test_a_port_in_use_is_reported(lab: Lab) -> None:
    with lab.inside("h1"), socket.create_server((lab.address("h1"), 7447)):
        done = doctor(lab, lab.inventory(ROLES, insecure=True))
    assert done.code == 2
    (line,) = faults(done)
    assert has_terms(line, "h1: ", "7447")


def test_what_a_host_lacks_is_reported_with_a_remedy(lab: Lab) -> None:
    (lab.folder / "h3" / "zsim").touch()  # a file in place of its folder
    hosts = lab.inventory(ROLES, insecure=True)
    document = yaml.safe_load(hosts.read_text())
    del document["hosts"]["h1"]["python"]
    document["hosts"]["h2"]["python"] = "/tmp"
    hosts.write_text(yaml.safe_dump(document))
    done = doctor(lab, hosts)
    assert done.code == 2
    h1, h2, h3 = faults(done)
    assert has_terms(h1, "h1: ", str(lab.host_folder("h1")), f"`zsim push --hosts {hosts}`")
    assert has_terms(h2, "h2: ", "/tmp", "hosts.h2.python", f"`zsim push --hosts {hosts}`")
    assert has_terms(h3, "h3: ", str(lab.host_folder("h3")), "hosts.h3.folder")


def test_hosts_without_certificates_are_not_ready(lab: Lab) -> None:
    hosts = lab.inventory(ROLES)
    done = doctor(lab, hosts)
    assert done.code == 2
    (line,) = faults(done)
    assert has_terms(line, f"{lab.folder}/certs: ", f"`zsim certs init {hosts} --scenario FILE`", "security.insecure")
    assert "ready" not in done.stdout
    assert run_here("certs", "init", str(hosts), "--scenario", str(STEP)).code == 0
    done = doctor(lab, hosts)
    assert done.code == 0, done.stderr
