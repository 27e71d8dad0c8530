"""What a run lacks of certificates is told before it starts, with the command that makes it; and open private keys."""

import re
import shlex
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from refused import has_terms
from typer.testing import CliRunner

from zsim.errors import RunError
from zsim.scenario import scenario_file
from zsim_deploy.cli.cli import app
from zsim_deploy.hosts.doctor import check_hosts
from zsim_deploy.inventory import certificates, inventory
from zsim_deploy.inventory.certificates import CertificateRequest, issue
from zsim_deploy.inventory.enrolment import certificate_faults, exposed_keys

SCENARIO = """
name: pair
duration_s: 4
drones:
  - {name: drone1, position_m: [0, 0, 0]}
  - {name: drone2, position_m: [2, 0, 0]}
clusters:
  - {name: main, drones: [drone1, drone2]}
"""
HOSTS = """
hosts:
  h1: {address: 127.0.0.1, port: 1}
  h2: {address: 127.0.0.1, port: 1, router: field}
routers:
  field: {host: h2}
roles: {world: h1, "controller.*": h1, "estimator.*": h2}
"""
NAMES = ["world on h1", "recorder on h1", "estimator.drone1 on h2", "estimator.drone2 on h2"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder whose name a shell would take for two, with inventory, scenario and no certificates."""
    found = tmp_path / "our lab"
    found.mkdir()
    (found / "hosts.yaml").write_text(HOSTS)
    (found / "scenario.yaml").write_text(SCENARIO)
    return found


def run(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, ["certs", *map(str, arguments)])


def init(folder: Path, *options: str) -> Any:
    return run("init", folder / "hosts.yaml", "--scenario", folder / "scenario.yaml", *options)


def lacking(folder: Path, now: datetime | None = None) -> list[str]:
    """Return what the scenario of a folder lacks, without the folder of the certificates that each line begins with."""
    placed = inventory.load(folder / "hosts.yaml")
    places = inventory.placement(placed, scenario_file.load(folder / "scenario.yaml"))
    found = certificate_faults(placed, places, now or datetime.now(UTC))
    assert all(line.startswith(f"{folder / 'certs'}: ") and "\n" not in line for line in found)
    return [line.removeprefix(f"{folder / 'certs'}: ") for line in found]


def advised(folder: Path, line: str) -> list[str]:
    """Return the words after `zsim certs` of the command that a line advises, for the scenario of a folder."""
    (command,) = re.findall("`(.*)`", line)
    words = shlex.split(command)
    assert words[:2] == ["zsim", "certs"]
    return [str(folder / "scenario.yaml") if word == "FILE" else word for word in words[2:]]


def test_nothing_is_lacking_after_init(folder: Path) -> None:
    assert init(folder).exit_code == 0
    assert lacking(folder) == []


def test_without_certificates_the_advice_works_as_it_is_given(folder: Path) -> None:
    (line,) = lacking(folder)
    init_command = f"zsim certs init '{folder}/hosts.yaml' --scenario FILE"
    assert has_terms(line, "no certificates", init_command, "security.insecure")
    assert run(*advised(folder, line)).exit_code == 0
    assert lacking(folder) == []


def test_certificates_whose_time_is_over_are_named_and_the_advice_renews_them(folder: Path) -> None:
    init(folder, "--days", "20")
    later = datetime.now(UTC) + timedelta(days=20, minutes=1)
    (line,) = lacking(folder, later)
    assert re.search(r"expired on \d{4}-\d\d-\d\d: ", line)
    renew = f"zsim certs init '{folder}/hosts.yaml' --scenario FILE --renew"
    assert has_terms(line, "expired", ", ".join(NAMES), "2 more", renew)
    assert run(*advised(folder, line)).exit_code == 0
    assert lacking(folder, later) == []


@pytest.mark.parametrize(
    ("lost", "terms"),
    [
        ("h2/estimator.drone1/key.pem", ("certificate missing", "estimator.drone1", "h2")),
        ("h2/router.field", ("certificate missing", "router.field", "h2")),
        ("h1/world.access.json", ("access control missing", "world", "h1")),
    ],
)
def test_what_is_missing_is_named(folder: Path, lost: str, terms: tuple[str, ...]) -> None:
    init(folder)
    path = folder / "certs" / lost
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    (line,) = lacking(folder)
    assert has_terms(line, *terms)
    assert "--renew" not in line
    init(folder)
    assert lacking(folder) == []


def test_what_no_process_of_the_run_needs_may_be_missing(folder: Path) -> None:
    """An estimator has one for every host, so that it can be moved."""
    init(folder)
    shutil.rmtree(folder / "certs/h1/estimator.drone1")
    shutil.rmtree(folder / "certs/operators")
    assert lacking(folder) == []


def test_who_listens_needs_a_certificate_for_its_address_and_a_client_does_not(folder: Path) -> None:
    init(folder)
    (folder / "hosts.yaml").write_text(HOSTS.replace("127.0.0.1", "10.0.0.7"))
    (line,) = lacking(folder)
    assert has_terms(line, "other addresses", "world", "h1", "router.field", "h2")


@pytest.mark.parametrize("content", ["", "half a key"])
def test_a_key_that_is_none_is_named_and_init_makes_it_anew(folder: Path, content: str) -> None:
    init(folder)
    key = folder / "certs/h1/world/key.pem"
    key.write_text(content)
    (line,) = lacking(folder)
    assert has_terms(line, "certificate", "read", "world", "h1")
    assert "1 certificates made" in init(folder).stdout
    assert lacking(folder) == []


def test_an_authority_that_is_none_is_a_line(folder: Path) -> None:
    init(folder)
    (folder / "certs/ca.pem").write_text("")
    placed = inventory.load(folder / "hosts.yaml")
    (line,) = certificate_faults(placed, None, datetime.now(UTC))
    assert has_terms(line, f"{folder}/certs/ca.pem", "no certificate")


def test_an_insecure_inventory_needs_none(folder: Path) -> None:
    (folder / "hosts.yaml").write_text(HOSTS + "security: {insecure: true}\n")
    assert lacking(folder) == []


def test_the_doctor_tells_of_certificates_with_and_without_a_scenario(folder: Path) -> None:
    """Its hosts are none: nobody listens on port 1."""
    placed = inventory.load(folder / "hosts.yaml")
    places = inventory.placement(placed, scenario_file.load(folder / "scenario.yaml"))
    for given in (None, places):
        assert any(has_terms(line, "no certificates") for line in check_hosts(placed, given).faults)
    init(folder)
    (folder / "certs/h1/world/key.pem").chmod(0o644)
    for given in (None, places):
        found = check_hosts(placed, given)
        assert [line for line in found.faults if "certificate" in line] == []
        assert any(has_terms(line, "read", "others") for line in found.warnings)
    shutil.rmtree(folder / "certs/h1/world")
    for given in (None, places):
        assert any(has_terms(line, "certificate missing", "world", "h1") for line in check_hosts(placed, given).faults)


# The commands


@pytest.mark.parametrize("days", ["0", "-1", "nan", "inf", "1e-9", "826"])
def test_a_lifetime_that_is_none_is_refused_in_a_line(folder: Path, days: str) -> None:
    done = init(folder, "--days", days)
    assert done.exit_code == 2
    assert has_terms(done.output, "0.05", "825")
    assert not (folder / "certs").exists()


def test_show_without_certificates_is_a_line(folder: Path) -> None:
    done = run("show", folder / "hosts.yaml")
    assert isinstance(done.exception, RunError)
    assert has_terms(
        str(done.exception), f"{folder}/certs", "certificates", f"'{folder}/hosts.yaml'", "--scenario", "FILE"
    )
    assert done.stdout == ""


def test_show_advises_a_command_that_mends(folder: Path) -> None:
    init(folder)
    now = datetime.now(UTC)
    signer = certificates.authority(folder / "certs", now)
    assert run("show", folder / "hosts.yaml").stderr == ""
    for days, state in ((-0.5, "expired on "), (1.0, "ends soon")):
        issue(folder / "certs", signer, CertificateRequest("h1", "world", ("127.0.0.1",)), now, days)
        shown = run("show", folder / "hosts.yaml")
        (row,) = [line for line in shown.stdout.splitlines() if state in line]
        assert "world" in row
        assert has_terms(shown.stderr, "zsim certs init")
        assert run(*advised(folder, shown.stderr)).exit_code == 0
        assert run("show", folder / "hosts.yaml").stderr == ""


@pytest.mark.parametrize("mode", [0o644, 0o640])
def test_private_keys_that_others_can_read_are_warned_of_in_a_line(folder: Path, mode: int) -> None:
    assert init(folder).stderr == ""
    placed = inventory.load(folder / "hosts.yaml")
    assert exposed_keys(placed) is None
    for path in ("ca.key", "h1/world/key.pem", "h2/router.field/key.pem"):
        (folder / "certs" / path).chmod(mode)
    (folder / "certs/ca.pem").chmod(0o644)
    assert has_terms(exposed_keys(placed), f"{folder}/certs/ca.key", "2", "read", "-R", "go=", f"'{folder}/certs'")
    for done in (init(folder), run("show", folder / "hosts.yaml")):
        assert done.exit_code == 0
        assert done.stderr == f"warning: {exposed_keys(placed)}\n"
