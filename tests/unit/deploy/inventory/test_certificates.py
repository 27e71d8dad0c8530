"""The authority and what it issues: purposes, names, times, files, and when a certificate is made anew."""

import base64
import shutil
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from refused import has_terms, refused

from zsim.errors import RunError
from zsim.transport.tls import Identity, own_fault
from zsim_deploy.inventory import certificates
from zsim_deploy.inventory.certificates import DAYS, CertificateRequest, issue, renewal_reason

NOW = datetime(2026, 11, 1, 12, tzinfo=UTC)
ESTIMATOR = CertificateRequest("h1", "estimator.drone1", ("10.0.0.1",))


@pytest.fixture
def signer(tmp_path: Path) -> certificates.Authority:
    return certificates.authority(tmp_path, NOW)


def read(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def test_a_certificate_names_process_and_addresses_and_is_good_for_a_month(tmp_path: Path, signer) -> None:
    made = read(
        issue(tmp_path, signer, CertificateRequest("h1", "world", ("10.0.0.1", "lab.local")), NOW) / "certificate.pem"
    )
    names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert made.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == "world"
    assert [str(name) for name in names.get_values_for_type(x509.IPAddress)] == ["10.0.0.1", "127.0.0.1", "::1"]
    assert names.get_values_for_type(x509.DNSName) == ["lab.local", "localhost"]
    assert made.not_valid_before_utc == NOW - timedelta(days=1)
    assert made.not_valid_after_utc == NOW + timedelta(days=30)


def test_a_certificate_serves_both_ends_of_a_link_and_signs_nothing(tmp_path: Path, signer) -> None:
    made = read(issue(tmp_path, signer, ESTIMATOR, NOW) / "certificate.pem")
    purposes = made.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert set(purposes) == {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH}
    assert not made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    made.verify_directly_issued_by(signer.certificate)


def test_keys_are_p256_their_owner_s_alone_and_never_shared(tmp_path: Path, signer) -> None:
    places = [issue(tmp_path, signer, CertificateRequest(host, "recorder"), NOW) for host in ("h1", "h2")]
    keys = [serialization.load_pem_private_key((place / "key.pem").read_bytes(), None) for place in places]
    for path in (tmp_path / "ca.key", *(place / "key.pem" for place in places)):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert all(isinstance(key, ec.EllipticCurvePrivateKey) and key.curve.name == "secp256r1" for key in keys)
    assert len({(tmp_path / "ca.key").read_bytes(), *((place / "key.pem").read_bytes() for place in places)}) == 3
    assert not list(tmp_path.rglob("*.new"))


def test_an_authority_is_kept_until_another_is_forced(tmp_path: Path, signer) -> None:
    issue(tmp_path, signer, ESTIMATOR, NOW)
    again = certificates.authority(tmp_path, NOW)
    assert again.certificate == signer.certificate
    assert renewal_reason(tmp_path, again.certificate, ESTIMATOR, NOW) is None
    other = certificates.authority(tmp_path, NOW, force=True)
    assert other.certificate != signer.certificate
    assert has_terms(renewal_reason(tmp_path, other.certificate, ESTIMATOR, NOW), "another", "authority")


@pytest.mark.parametrize("missing", ["ca.pem", "ca.key"])
def test_half_an_authority_is_not_written_over(tmp_path: Path, signer, missing: str) -> None:
    (tmp_path / missing).unlink()
    left = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with refused(RunError, str(missing), "missing", "--force"):
        certificates.authority(tmp_path, NOW)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == left


def test_an_authority_of_no_use_is_a_line(tmp_path: Path, signer) -> None:
    with refused(RunError, "ca.pem", "authority", "expired", "2031-10-31", "--force"):
        certificates.authority(tmp_path, NOW + timedelta(days=1826))
    (tmp_path / "ca.key").write_text("nothing")
    with refused(RunError, "ca.key", "no private key", "--force"):
        certificates.authority(tmp_path, NOW)
    other = tmp_path / "other"
    certificates.authority(other, NOW)
    shutil.copy(other / "ca.key", tmp_path / "ca.key")
    with refused(RunError, "ca.key", "not", "key", "ca.pem"):
        certificates.authority(tmp_path, NOW)


def test_a_certificate_is_made_anew_when_it_would_not_do(tmp_path: Path, signer) -> None:
    assert renewal_reason(tmp_path, signer.certificate, ESTIMATOR, NOW) == "new"
    place = issue(tmp_path, signer, ESTIMATOR, NOW)
    assert renewal_reason(tmp_path, signer.certificate, ESTIMATOR, NOW) is None
    assert (
        renewal_reason(tmp_path, signer.certificate, ESTIMATOR._replace(addresses=("10.0.0.2",)), NOW)
        == "other addresses"
    )
    assert (
        renewal_reason(tmp_path, signer.certificate, ESTIMATOR, NOW + timedelta(days=DAYS)) == "expired on 2026-12-01"
    )
    (place / "certificate.pem").write_text("nothing")
    assert has_terms(renewal_reason(tmp_path, signer.certificate, ESTIMATOR, NOW), "read")


@pytest.mark.parametrize("left", ["ca.pem", "certificate.pem", "key.pem"])
def test_files_of_which_some_are_older_are_made_anew_and_shown(tmp_path: Path, signer, left: str) -> None:
    """As whoever renewed them leaves them when it is stopped in between."""
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


def test_a_certificate_and_the_key_of_another_one_are_made_anew(tmp_path: Path, signer) -> None:
    key = (issue(tmp_path, signer, ESTIMATOR, NOW) / "key.pem").read_bytes()
    place = issue(tmp_path, signer, ESTIMATOR, NOW)
    (place / "key.pem").write_bytes(key)
    assert has_terms(renewal_reason(tmp_path, signer.certificate, ESTIMATOR, NOW), "without", "key")


def of_no_curve() -> str:
    """Return a private key on a curve that there is not."""
    encodings = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    key = ec.generate_private_key(ec.SECP256R1()).private_bytes(serialization.Encoding.DER, *encodings)
    p256 = bytes.fromhex("2a8648ce3d030107")  # 1.2.840.10045.3.1.7
    body = base64.b64encode(key.replace(p256, p256[:-1] + b"\x70")).decode()
    return f"-----BEGIN PRIVATE KEY-----\n{body}\n-----END PRIVATE KEY-----\n"


@pytest.mark.parametrize("content", ["", "nothing", "-----BEGIN PRIVATE KEY-----\n", of_no_curve()], ids=range(4))
def test_a_key_that_is_none_is_made_anew(tmp_path: Path, signer, content: str) -> None:
    place = issue(tmp_path, signer, ESTIMATOR, NOW)
    (place / "key.pem").write_text(content)
    assert has_terms(renewal_reason(tmp_path, signer.certificate, ESTIMATOR, NOW), "read")
    (shown,) = certificates.show(tmp_path, NOW)
    assert has_terms(shown.fault, "read")


def test_what_is_there_is_shown(tmp_path: Path, signer) -> None:
    issue(tmp_path, signer, ESTIMATOR, NOW)
    issue(tmp_path, signer, CertificateRequest("h1", "world"), NOW, days=-0.5)
    shown = certificates.show(tmp_path, NOW)
    assert [(each.process, each.fault) for each in shown] == [
        ("estimator.drone1", ""),
        ("world", "expired on 2026-11-01"),
    ]
    assert shown[0].addresses == ("10.0.0.1", "localhost", "127.0.0.1", "::1")


def test_a_folder_that_cannot_be_written_is_a_line() -> None:
    with refused(RunError, "/proc/certs/ca.key", "written"):
        certificates.authority(Path("/proc/certs"), NOW)


@pytest.mark.parametrize(
    ("begin_days", "days", "terms"),
    [
        (0.0, 30.0, ()),
        (0.0, -0.5, ("recorder", "expired")),
        (2.0, 30.0, ("recorder", "valid")),
    ],
)
def test_a_process_judges_the_time_of_its_own_certificate(
    tmp_path: Path, begin_days: float, days: float, terms: tuple[str, ...]
) -> None:
    now = datetime.now(UTC)
    signer = certificates.authority(tmp_path, now)
    folder = issue(tmp_path, signer, CertificateRequest("h1", "recorder"), now + timedelta(days=begin_days), days)
    fault = own_fault(Identity("h1", folder))
    assert has_terms(str(fault), *terms) if terms else fault is None
