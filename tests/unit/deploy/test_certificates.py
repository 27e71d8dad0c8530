"""The certificate authority and what it issues: purposes, names, validity, files, and renewal."""

import base64
import errno
import json
import os
import re
import shlex
import shutil
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from refused import has_terms, refused
from rights_table import KEYS, ROLES, keys_of
from rights_table import SCENARIO as RIGHTS_SCENARIO
from typer.testing import CliRunner

from zsim.errors import BadNameError, InventoryError, RunError, ZsimError
from zsim.scenario import roles, scenario_file
from zsim.transport.tls import Identity, own_fault
from zsim_deploy import certificates, inventory
from zsim_deploy.certificates import (
    DAYS,
    CertificateRequest,
    access_control,
    certificate_faults,
    exposed_keys,
    issue,
    renewal_reason,
)
from zsim_deploy.cli.cli import app
from zsim_deploy.hosts.doctor import check_hosts

SCENARIO = """
name: enrolled
duration_s: 4
drones:
  - {name: drone1, position_m: [0, 0, 0]}
  - {name: drone2, position_m: [2, 0, 0]}
clusters:
  - {name: main, drones: [drone1, drone2]}
"""
NOW = datetime(2026, 11, 1, 12, tzinfo=UTC)
ESTIMATOR = CertificateRequest("h1", "estimator.drone1", ("10.0.0.1",))


@pytest.fixture
def signer(tmp_path: Path) -> certificates.Authority:
    return certificates.authority(tmp_path, NOW)


def test_a_certificate_names_its_process_and_lasts_30_days(tmp_path: Path, signer) -> None:
    place = issue(tmp_path, signer, CertificateRequest("h1", "world", ("10.0.0.1", "lab.local")), NOW)
    made = x509.load_pem_x509_certificate((place / "certificate.pem").read_bytes())
    names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert made.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == "world"
    assert [str(name) for name in names.get_values_for_type(x509.IPAddress)] == ["10.0.0.1", "127.0.0.1", "::1"]
    assert names.get_values_for_type(x509.DNSName) == ["lab.local", "localhost"]
    assert made.not_valid_before_utc == NOW - timedelta(days=1)
    assert made.not_valid_after_utc == NOW + timedelta(days=30)
    purposes = made.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert set(purposes) == {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH}
    assert not made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    made.verify_directly_issued_by(signer.certificate)


def test_keys_are_on_p256_readable_by_their_owner_alone_and_never_shared(tmp_path: Path, signer) -> None:
    places = [issue(tmp_path, signer, CertificateRequest(host, "recorder"), NOW) for host in ("h1", "h2")]
    keys = [serialization.load_pem_private_key((place / "key.pem").read_bytes(), None) for place in places]
    for path in (tmp_path / "ca.key", *(place / "key.pem" for place in places)):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert all(isinstance(key, ec.EllipticCurvePrivateKey) and key.curve.name == "secp256r1" for key in keys)
    assert len({(tmp_path / "ca.key").read_bytes(), *((place / "key.pem").read_bytes() for place in places)}) == 3
    assert not list(tmp_path.rglob("*.new"))


def test_an_authority_is_kept_until_a_new_one_is_forced(tmp_path: Path, signer) -> None:
    issue(tmp_path, signer, ESTIMATOR, NOW)
    again = certificates.authority(tmp_path, NOW)
    assert again.certificate == signer.certificate
    assert renewal_reason(tmp_path, again.certificate, ESTIMATOR, NOW) is None
    other = certificates.authority(tmp_path, NOW, force=True)
    assert other.certificate != signer.certificate
    assert has_terms(renewal_reason(tmp_path, other.certificate, ESTIMATOR, NOW), "another", "authority")


@pytest.mark.parametrize("missing", ["ca.pem", "ca.key"])
def test_an_incomplete_authority_is_not_overwritten(tmp_path: Path, signer, missing: str) -> None:
    (tmp_path / missing).unlink()
    left = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with refused(RunError, str(missing), "missing", "--force"):
        certificates.authority(tmp_path, NOW)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == left


def test_an_unusable_authority_is_refused(tmp_path: Path, signer) -> None:
    with refused(RunError, "ca.pem", "authority", "expired", "2031-10-31", "--force"):
        certificates.authority(tmp_path, NOW + timedelta(days=1826))
    (tmp_path / "ca.key").write_text("nothing")
    with refused(RunError, "ca.key", "not a private key", "--force"):
        certificates.authority(tmp_path, NOW)
    certificates.authority(tmp_path / "other", NOW)
    shutil.copy(tmp_path / "other" / "ca.key", tmp_path / "ca.key")
    with refused(RunError, "ca.key", "not", "key", "ca.pem"):
        certificates.authority(tmp_path, NOW)
    with refused(RunError, "/proc/certs/ca.key", "written"):
        certificates.authority(Path("/proc/certs"), NOW)


def test_a_certificate_is_renewed_when_it_is_unusable(tmp_path: Path, signer) -> None:
    def reason(wanted: CertificateRequest = ESTIMATOR, days: float = 0.0) -> str | None:
        return renewal_reason(tmp_path, signer.certificate, wanted, NOW + timedelta(days=days))

    assert reason() == "new"
    place = issue(tmp_path, signer, ESTIMATOR, NOW)
    assert reason() is None
    (shown,) = certificates.show(tmp_path, NOW)
    assert (shown.process, shown.addresses) == (ESTIMATOR.process, ("10.0.0.1", "localhost", "127.0.0.1", "::1"))
    assert reason(ESTIMATOR._replace(addresses=("10.0.0.2",))) == "other addresses"
    assert reason(days=DAYS) == "expired on 2026-12-01"
    assert [each.fault for each in certificates.show(tmp_path, NOW + timedelta(days=DAYS))] == ["expired on 2026-12-01"]
    (place / "certificate.pem").write_text("nothing")
    assert has_terms(reason(), "read")


@pytest.mark.parametrize("left", ["ca.pem", "certificate.pem", "key.pem"])
def test_files_left_from_an_older_issue_are_reported_and_renewed(tmp_path: Path, signer, left: str) -> None:
    """An interrupted renewal leaves such a mixture."""
    older = (issue(tmp_path, signer, ESTIMATOR, NOW) / left).read_bytes()
    other = certificates.authority(tmp_path, NOW, force=True)
    place = issue(tmp_path, other, ESTIMATOR, NOW)
    assert renewal_reason(tmp_path, other.certificate, ESTIMATOR, NOW) is None
    (place / left).write_bytes(older)
    fault = "without its key" if left == "key.pem" else "of another authority"
    assert renewal_reason(tmp_path, other.certificate, ESTIMATOR, NOW) == fault
    assert [each.fault for each in certificates.show(tmp_path, NOW)] == [fault]
    issue(tmp_path, other, ESTIMATOR, NOW)
    assert renewal_reason(tmp_path, other.certificate, ESTIMATOR, NOW) is None


def of_no_curve() -> str:
    """Return a private key on a curve that does not exist."""
    encodings = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    key = ec.generate_private_key(ec.SECP256R1()).private_bytes(serialization.Encoding.DER, *encodings)
    p256 = bytes.fromhex("2a8648ce3d030107")  # 1.2.840.10045.3.1.7
    body = base64.b64encode(key.replace(p256, p256[:-1] + b"\x70")).decode()
    return f"-----BEGIN PRIVATE KEY-----\n{body}\n-----END PRIVATE KEY-----\n"


@pytest.mark.parametrize("content", ["", "nothing", "-----BEGIN PRIVATE KEY-----\n", of_no_curve()], ids=range(4))
def test_an_unreadable_key_is_replaced(tmp_path: Path, signer, content: str) -> None:
    place = issue(tmp_path, signer, ESTIMATOR, NOW)
    (place / "key.pem").write_text(content)
    assert has_terms(renewal_reason(tmp_path, signer.certificate, ESTIMATOR, NOW), "read")
    (shown,) = certificates.show(tmp_path, NOW)
    assert has_terms(shown.fault, "read")


@pytest.mark.parametrize(
    ("begin_days", "days", "terms"), [(0.0, 30.0, ()), (0.0, -0.5, ("expired",)), (2.0, 30.0, ("valid",))]
)
def test_a_process_checks_the_validity_of_its_own_certificate(
    tmp_path: Path, begin_days: float, days: float, terms: tuple[str, ...]
) -> None:
    now = datetime.now(UTC)
    signer = certificates.authority(tmp_path, now)
    folder = issue(tmp_path, signer, CertificateRequest("h1", "recorder"), now + timedelta(days=begin_days), days)
    fault = own_fault(Identity("h1", folder))
    assert has_terms(str(fault), "recorder", *terms) if terms else fault is None


def prepared(folder: Path, hosts: str) -> Path:
    """Write the inventory and the scenario into a new folder."""
    folder.mkdir()
    (folder / "hosts.yaml").write_text(hosts)
    (folder / "scenario.yaml").write_text(SCENARIO)
    return folder


def run(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, ["certs", *map(str, arguments)])


def init(folder: Path, *options: str) -> Any:
    """Run `zsim certs init`, raising its errors."""
    done = run("init", folder / "hosts.yaml", "--scenario", folder / "scenario.yaml", *options)
    if isinstance(done.exception, ZsimError):
        raise done.exception
    return done


LAB_HOSTS = """
hosts:
  h1: {address: 127.0.0.1, port: 1}
  h2: {address: 127.0.0.1, port: 1, router: field}
routers:
  field: {host: h2}
roles: {world: h1, "controller.*": h1, "estimator.*": h2}
"""
NAMES = ["world on h1", "recorder on h1", "estimator.drone1 on h2", "estimator.drone2 on h2"]


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """Return a folder, with a space in its name, that has an inventory and a scenario but no certificates."""
    return prepared(tmp_path / "our lab", LAB_HOSTS)


def lacking(lab: Path, now: datetime | None = None) -> list[str]:
    """Return the faults of the lab's certificates, without the folder with which each line begins."""
    placed = inventory.load(lab / "hosts.yaml")
    places = inventory.placement(placed, scenario_file.load(lab / "scenario.yaml"))
    found = certificate_faults(placed, places, now or datetime.now(UTC))
    assert all(line.startswith(f"{lab / 'certs'}: ") and "\n" not in line for line in found)
    return [line.removeprefix(f"{lab / 'certs'}: ") for line in found]


def advised(lab: Path, line: str) -> list[str]:
    """Return the arguments after `zsim certs` of the command that a line advises, with the lab's scenario."""
    (command,) = re.findall("`(.*)`", line)
    words = shlex.split(command)
    assert words[:2] == ["zsim", "certs"]
    return [str(lab / "scenario.yaml") if word == "FILE" else word for word in words[2:]]


def test_the_advice_for_missing_certificates_works_as_given(lab: Path) -> None:
    (line,) = lacking(lab)
    init_command = f"zsim certs init '{lab}/hosts.yaml' --scenario FILE"
    assert has_terms(line, "no certificates", init_command, "security.insecure")
    assert run(*advised(lab, line)).exit_code == 0
    assert lacking(lab) == []


def test_expired_certificates_are_named_and_the_advice_renews_them(lab: Path) -> None:
    init(lab, "--days", "20")
    later = datetime.now(UTC) + timedelta(days=20, minutes=1)
    (line,) = lacking(lab, later)
    assert re.search(r"expired on \d{4}-\d\d-\d\d: ", line)
    renew = f"zsim certs init '{lab}/hosts.yaml' --scenario FILE --renew"
    assert has_terms(line, "expired", ", ".join(NAMES), "2 more", renew)
    assert run(*advised(lab, line)).exit_code == 0
    assert lacking(lab, later) == []


@pytest.mark.parametrize(
    ("lost", "content", "terms"),
    [
        ("h2/estimator.drone1/key.pem", None, ("certificate missing", "estimator.drone1", "h2")),
        ("h2/router.field", None, ("certificate missing", "router.field", "h2")),
        ("h1/world.access.json", None, ("access control missing", "world", "h1")),
        ("h1/world/key.pem", "half a key", ("certificate", "read", "world", "h1")),
    ],
)
def test_missing_or_unreadable_files_are_named(
    lab: Path, lost: str, content: str | None, terms: tuple[str, ...]
) -> None:
    init(lab)
    path = lab / "certs" / lost
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    if content:
        path.write_text(content)
    (line,) = lacking(lab)
    assert has_terms(line, *terms)
    assert "--renew" not in line
    init(lab)
    assert lacking(lab) == []


def test_certificates_that_a_run_does_not_need_may_be_missing(lab: Path) -> None:
    """An estimator has a certificate for every host, so that it can be moved; a client's address is not checked."""
    init(lab)
    shutil.rmtree(lab / "certs/h1/estimator.drone1")
    shutil.rmtree(lab / "certs/operators")
    assert lacking(lab) == []
    (lab / "hosts.yaml").write_text(LAB_HOSTS.replace("127.0.0.1", "10.0.0.7"))
    (line,) = lacking(lab)
    assert has_terms(line, "other addresses", "world", "h1", "router.field", "h2")
    (lab / "certs/ca.pem").write_text("")
    (line,) = certificate_faults(inventory.load(lab / "hosts.yaml"), None, datetime.now(UTC))
    assert has_terms(line, f"{lab}/certs/ca.pem", "not a certificate")
    (lab / "hosts.yaml").write_text(LAB_HOSTS + "security: {insecure: true}\n")
    assert lacking(lab) == []


def test_the_doctor_checks_certificates_with_and_without_a_scenario(lab: Path) -> None:
    """The hosts cannot be reached, since nothing listens on port 1."""
    placed = inventory.load(lab / "hosts.yaml")
    places = inventory.placement(placed, scenario_file.load(lab / "scenario.yaml"))
    for given in (None, places):
        assert any(has_terms(line, "no certificates") for line in check_hosts(placed, given).faults)
    init(lab)
    (lab / "certs/h1/world/key.pem").chmod(0o644)
    for given in (None, places):
        found = check_hosts(placed, given)
        assert [line for line in found.faults if "certificate" in line] == []
        assert any(has_terms(line, "read", "other users") for line in found.warnings)
    shutil.rmtree(lab / "certs/h1/world")
    for given in (None, places):
        assert any(has_terms(line, "certificate missing", "world", "h1") for line in check_hosts(placed, given).faults)


# The commands


@pytest.mark.parametrize("days", ["0", "-1", "nan", "inf", "1e-9", "826"])
def test_an_invalid_lifetime_is_refused(lab: Path, days: str) -> None:
    done = init(lab, "--days", days)
    assert done.exit_code == 2
    assert has_terms(done.output, "0.05", "825")
    assert not (lab / "certs").exists()


def test_show_without_certificates_is_refused_with_advice(lab: Path) -> None:
    done = run("show", lab / "hosts.yaml")
    assert isinstance(done.exception, RunError)
    assert has_terms(str(done.exception), f"{lab}/certs", "certificates", f"'{lab}/hosts.yaml'", "--scenario", "FILE")
    assert done.stdout == ""


def test_show_advises_a_command_that_renews(lab: Path) -> None:
    init(lab)
    now = datetime.now(UTC)
    signer = certificates.authority(lab / "certs", now)
    assert run("show", lab / "hosts.yaml").stderr == ""
    for days, state in ((-0.5, "expired on "), (1.0, "expires soon")):
        issue(lab / "certs", signer, CertificateRequest("h1", "world", ("127.0.0.1",)), now, days)
        shown = run("show", lab / "hosts.yaml")
        (row,) = [line for line in shown.stdout.splitlines() if state in line]
        assert "world" in row
        assert has_terms(shown.stderr, "zsim certs init")
        assert run(*advised(lab, shown.stderr)).exit_code == 0
        assert run("show", lab / "hosts.yaml").stderr == ""


@pytest.mark.parametrize("mode", [0o644, 0o640])
def test_private_keys_that_others_can_read_cause_one_warning(lab: Path, mode: int) -> None:
    assert init(lab).stderr == ""
    placed = inventory.load(lab / "hosts.yaml")
    assert exposed_keys(placed) is None
    for path in ("ca.key", "h1/world/key.pem", "h2/router.field/key.pem"):
        (lab / "certs" / path).chmod(mode)
    (lab / "certs/ca.pem").chmod(0o644)
    assert has_terms(exposed_keys(placed), f"{lab}/certs/ca.key", "2", "read", "-R", "go=", f"'{lab}/certs'")
    for done in (init(lab), run("show", lab / "hosts.yaml")):
        assert done.exit_code == 0
        assert done.stderr == f"warning: {exposed_keys(placed)}\n"


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
    return prepared(tmp_path / "site", HOSTS)


def enrolment(folder: Path, *operators: str) -> tuple[list[CertificateRequest], dict[tuple[str, str], dict[str, Any]]]:
    """Return the required certificates, and the access control by host and process."""
    placed = inventory.load(folder / "hosts.yaml")
    wanted, access = certificates.enrolment(placed, scenario_file.load(folder / "scenario.yaml"), operators)
    return wanted, {(host, process): rules for host, process, rules in access}


def test_movable_processes_have_a_certificate_for_every_host(folder: Path) -> None:
    addresses = {"lab": "10.0.0.1", "onboard1": "10.1.0.1", "onboard2": "10.1.0.2", "hut": "hut.local"}
    placed = {"world": ["lab"], "router.field": ["lab"], "router.hill": ["hut"], "operator.anna": ["hut"]}
    movable = ("recorder", "estimator.drone1", "estimator.drone2", "controller.main")
    placed |= {name: [*addresses] for name in movable}
    wanted = {CertificateRequest(at, name, (addresses[at],)) for name, hosts in placed.items() for at in hosts}
    assert {*enrolment(folder, "main", "anna@hut")[0]} == {*wanted, CertificateRequest("operators", "operator.main")}


def test_the_driver_of_an_external_drone_is_certified_and_admitted(folder: Path) -> None:
    """The driver may run on any host that reaches its aircraft, and the scenario need not expect it."""
    assert not any("driver.drone2" in lets_in(rules) for rules in enrolment(folder)[1].values())
    external = SCENARIO.replace("position_m: [2, 0, 0]", "position_m: [2, 0, 0], body: external")
    (folder / "scenario.yaml").write_text(external)
    wanted, access = enrolment(folder)
    drivers = [each.host for each in wanted if each.process == "driver.drone2"]
    assert drivers == ["lab", "onboard1", "onboard2", "hut"]
    assert all("driver.drone2" in lets_in(rules) for rules in access.values())


def lets_in(rules: dict[str, Any]) -> set[str]:
    return {name for subject in rules["subjects"] for name in subject.get("cert_common_names", ())}


def publishes(rules: dict[str, Any], name: str) -> set[str]:
    """Return the drones and clusters about which a process of the given common name may publish."""
    found = [rule for rule in rules["rules"] if rule["id"] == f"{name} ingress put"]
    keys = [key.split("/") for rule in found for key in rule["key_exprs"]]
    return {parts[2] for parts in keys if parts[1] in ("drone", "cluster")}


def test_each_listening_process_admits_the_processes_that_connect_to_it(folder: Path) -> None:
    _, access = enrolment(folder, "main", "anna@hut")
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


def test_a_router_that_no_host_uses_admits_only_routers_and_the_world(folder: Path) -> None:
    (folder / "hosts.yaml").write_text(HOSTS.replace(", router: field", ""))
    assert lets_in(enrolment(folder)[1]["lab", "router.field"]) == {"router.hill", "world"}


def test_an_operator_may_have_certificates_for_several_hosts(folder: Path) -> None:
    wanted, access = enrolment(folder, "anna", "anna@hut", "anna")
    assert [each.host for each in wanted if each.process == "operator.anna"] == ["operators", "hut"]
    let_in = {process for (_, process), rules in access.items() if "operator.anna" in lets_in(rules)}
    assert let_in == {"world", "router.hill"}


@pytest.mark.parametrize("host", ["moon", ""])
def test_an_operator_at_an_unknown_host_is_refused(folder: Path, host: str) -> None:
    with refused(InventoryError, "hosts.yaml", "'anna'", f"'{host}'", "hosts", "onboard1", "onboard2"):
        enrolment(folder, f"anna@{host}")


@pytest.mark.parametrize("name", ["../../../oops", "a" * 33, "Anna", "", "operator.", "operator.a/b"])
def test_an_operator_with_an_invalid_name_is_refused(folder: Path, name: str) -> None:
    with refused(BadNameError, "operator", "1", "32", "0-9"):
        enrolment(folder, name)


def operators_of(folder: Path, host: str, process: str) -> set[str]:
    """Return the operators that the access control of a listening process admits."""
    rules = json.loads((folder / "certs" / host / f"{process}.access.json").read_text())
    return {name for name in lets_in(rules) if name.startswith("operator.")}


def test_enrolled_operators_stay_admitted(folder: Path) -> None:
    """An operator whose folder was deleted is no longer admitted."""
    init(folder)
    assert operators_of(folder, "lab", "world") == {"operator.main"}
    init(folder, "--operator", "anna@hut")
    assert operators_of(folder, "lab", "world") == {"operator.main"}
    assert has_terms(init(folder, "--operator", "ben").stdout, "1", "certificates", "21")
    assert operators_of(folder, "lab", "world") == {"operator.main", "operator.ben"}
    assert operators_of(folder, "hut", "router.hill") == {"operator.anna"}
    shutil.rmtree(folder / "certs/operators/operator.main")
    init(folder, "--operator", "a" * 32)  # the longest name
    assert operators_of(folder, "lab", "world") == {"operator.ben", f"operator.{'a' * 32}"}


def test_unwritable_access_control_is_reported_and_the_old_file_is_kept(
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


def test_init_creates_everything_once_and_show_lists_it(folder: Path) -> None:
    assert has_terms(init(folder).stdout, "20", "certificates", "0")
    made = {path: path.read_bytes() for path in (folder / "certs").rglob("*.pem")}
    assert has_terms(init(folder).stdout, "0", "certificates", "20")
    assert {path: path.read_bytes() for path in (folder / "certs").rglob("*.pem")} == made
    assert (folder / "certs" / "hut" / "router.hill.access.json").is_file()
    shown = CliRunner().invoke(app, ["certs", "show", str(folder / "hosts.yaml")], catch_exceptions=False).stdout
    assert len(shown.splitlines()) == 20
    assert has_terms(init(folder, "--renew").stdout, "20", "certificates", "0")
    assert (folder / "certs" / "ca.pem").read_bytes() == made[folder / "certs" / "ca.pem"]


ACTS = {"r": "reads", "p": "writes", "g": "asks", "a": "answers", "t": "tokens", "w": "watches"}
# The (flow, message) pairs, as the listening process sees them, that each act needs.
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
def test_the_access_control_gives_a_role_the_rights_of_the_table(scenario: Any, role: str, act: str) -> None:
    expressions = getattr(roles.rights_for(role, scenario), ACTS[act])
    rules = access_control(scenario, ROLES, {})
    asked = TOKENS if act in "tw" else KEYS
    assert {key for key in asked if roles.permits(expressions, key)} == keys_of(role, act)
    assert {key for key in asked if allows(rules, role, WIRE[act], key)} == keys_of(role, act)


def allows(rules: dict[str, Any], name: str, needed: tuple[tuple[str, str], ...], key: str) -> bool:
    """Tell whether Zenoh would allow a common name all the needed (flow, message) pairs on a key."""
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


def test_zenoh_accepts_the_rules_which_deny_everything_not_granted(scenario: Any) -> None:
    rules = access_control(scenario, ROLES, {"router.site": ["estimator.drone2"]}, ["world"])
    assert rules["default_permission"] == "deny"
    assert {rule["permission"] for rule in rules["rules"]} == {"allow"}
    zenoh.Config().insert_json5("access_control", json.dumps(rules))
    alone = access_control(scenario, ["estimator.drone1"], {})
    assert not any(allows(alone, "estimator.drone2", WIRE[act], key) for act in ACTS for key in KEYS)
    rules = access_control(scenario_file.from_text(RIGHTS_SCENARIO + "federation: lab2\n"), ROLES, {})
    assert all(key.startswith("lab2/") for rule in rules["rules"] for key in rule["key_exprs"])


def test_a_router_has_exactly_the_rights_of_the_processes_behind_it(scenario: Any) -> None:
    rules = access_control(scenario, (), {"router.site": ["estimator.drone1", "controller.main"]})
    for act in ACTS:
        asked = TOKENS if act in "tw" else KEYS
        allowed = {key for key in asked if allows(rules, "router.site", WIRE[act], key)}
        assert allowed == keys_of("estimator.drone1", act) | keys_of("controller.main", act)


@pytest.mark.parametrize(
    ("process", "like"),
    [("my.drone1", "estimator.drone1"), ("fence.main", "controller.main")],
)
def test_a_replacement_process_has_the_rights_of_the_one_it_replaces(scenario: Any, process: str, like: str) -> None:
    own = {f"{of}/{name}" for of in ("process", "view/estimates") for name in (like, process)}

    def of_others(name: str, act: str) -> set[str]:
        expressions = getattr(roles.rights_for(name, scenario), ACTS[act])
        return {expression for expression in expressions if not any(expression.startswith(key) for key in own)}

    assert all(of_others(process, act) == of_others(like, act) for act in ACTS)


@pytest.mark.parametrize(
    "process", ["world.spare", "recorder.spare", "fence.round", "console", "estimator.drone9", "controller.drone1"]
)
def test_a_process_of_unknown_purpose_may_read_only_common_messages(scenario: Any, process: str) -> None:
    found = roles.rights_for(process, scenario)
    assert set(found.reads) == {"world/info", "clock", "world/event", "world/faults", "world/radio"}
    assert all(key.startswith(f"process/{process}/") for key in found.writes)
