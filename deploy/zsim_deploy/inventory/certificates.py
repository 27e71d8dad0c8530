"""A small certificate authority: one for a federation, and a short-lived certificate for each process and host.

certs/ca.pem, certs/ca.key                                 the authority; the key stays where it was made
certs/HOST/PROCESS/ca.pem, certificate.pem, key.pem        of one process on one host, the folder of --tls
"""

import ipaddress
import os
from collections.abc import Iterable, Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from zsim.errors import RunError
from zsim.scenario.roles import OPERATOR
from zsim.transport.tls import AUTHORITY, CERTIFICATE, CERTIFICATES, DAYS, KEY

AUTHORITY_DAYS = 1825  # 5 years; its key never leaves the machine that made it
BACK = timedelta(days=1)  # hosts in the field have clocks that are hours off
EXPIRED = "expired on"  # a day
OPERATORS = "operators"  # folder of the operators that are at no host of the inventory
LOOPBACK = ("localhost", "127.0.0.1", "::1")


class CertificateRequest(NamedTuple):
    """A certificate that is to be there.

    Attributes:
        host: name of the host in the inventory; a folder.
        process: name of the process; the common name.
        addresses: of the host, IP or DNS.
    """

    host: str
    process: str
    addresses: tuple[str, ...] = ()


Root = x509.Certificate
"""The certificate of an authority."""


class CertificateStatus(NamedTuple):
    """A certificate that is there."""

    host: str
    process: str
    addresses: tuple[str, ...]
    until: datetime
    fault: str


class Authority(NamedTuple):
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def authority(folder: Path, now: datetime, force: bool = False) -> Authority:
    """Return the authority in a folder, made if there is none.

    Args:
        folder: of the certificates.
        now: wall time, with its zone.
        force: make another one; every certificate made before is of no use then.

    Raises:
        RunError: half of it is there, its time is over, or it cannot be read or written.
    """
    paths = (folder / AUTHORITY, folder / "ca.key")
    there = [path for path in paths if path.exists()]
    if force or not there:
        return _make_authority(folder, now)
    if len(there) == 1:
        missing = next(path for path in paths if path not in there)
        raise RunError(f"{missing}: is missing beside {there[0].name}; bring it here, or --force makes a new authority")
    pair = _read_authority(*paths)
    if now >= pair.certificate.not_valid_after_utc:
        day = pair.certificate.not_valid_after_utc.date()
        raise RunError(f"{paths[0]}: the authority expired on {day}; --force makes a new one")
    return pair


def issue(folder: Path, signer: Authority, wanted: CertificateRequest, now: datetime, days: float = DAYS) -> Path:
    """Make key and certificate of a process on a host; return the folder that they are in.

    Raises:
        RunError: they cannot be written.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    purposes = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]  # routers are both
    certificate = (
        _builder(wanted.process, signer.certificate.subject, key, now - BACK, now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.SubjectAlternativeName(list(_names(wanted.addresses))), critical=False)
        .add_extension(_identifier_of(signer), critical=False)
        .sign(signer.key, hashes.SHA256())
    )
    place = folder / wanted.host / wanted.process
    for name, content in zip(CERTIFICATES, (_pem(signer.certificate), _pem(certificate), _key_pem(key)), strict=True):
        write(place / name, content)
    return place


def root(folder: Path) -> Root:
    """Return the certificate of the authority in a folder; its key need not be there.

    Raises:
        RunError: there is none.
    """
    return _load(folder / AUTHORITY)


def renewal_reason(folder: Path, signer: Root, wanted: CertificateRequest, now: datetime) -> str | None:
    """Return why a certificate has to be made, None if the one that is there will do, with its key."""
    place = folder / wanted.host / wanted.process
    if not all((place / name).exists() for name in CERTIFICATES):
        return "new"
    try:
        certificate = x509.load_pem_x509_certificate((place / CERTIFICATE).read_bytes())
    except (OSError, ValueError):
        return "cannot be read"
    fault = _fault(place, certificate, signer, now)
    if fault:
        return fault
    if set(_addresses(certificate)) != {str(name.value) for name in _names(wanted.addresses)}:
        return "other addresses"
    return None


def show(folder: Path, now: datetime) -> list[CertificateStatus]:
    """Return every certificate in a folder, with what is wrong with it."""
    paths = sorted(folder.glob(f"*/*/{CERTIFICATE}"))
    if not paths:
        return []
    signer = root(folder)
    return [_shown(path.parent, signer, now) for path in paths]


def operators(folder: Path, hosts: Iterable[str]) -> Iterator[str]:
    """Yield the operators who have a certificate in a folder, as NAME or, at one of the hosts, NAME@HOST."""
    for host in (OPERATORS, *hosts):
        for path in sorted((folder / host).glob(f"{OPERATOR}.*/{CERTIFICATE}")):
            name = path.parent.name.removeprefix(f"{OPERATOR}.")
            yield name if host == OPERATORS else f"{name}@{host}"


def _shown(place: Path, signer: Root, now: datetime) -> CertificateStatus:
    certificate = _load(place / CERTIFICATE)
    fault = _fault(place, certificate, signer, now) or ""
    return CertificateStatus(
        place.parent.name, place.name, _addresses(certificate), certificate.not_valid_after_utc, fault
    )


def _fault(place: Path, certificate: x509.Certificate, signer: Root, now: datetime) -> str | None:
    """Return the fault of a certificate or of the files beside it; `certs init` may have been interrupted."""
    try:
        authority_there, key = (place / AUTHORITY).read_bytes(), (place / KEY).read_bytes()
        public = serialization.load_pem_private_key(key, password=None).public_key()
    except (OSError, ValueError, TypeError, UnsupportedAlgorithm):
        return "cannot be read"
    if not _signed_by(certificate, signer) or authority_there != _pem(signer):
        return "of another authority"
    if public != certificate.public_key():
        return "without its key"
    return f"{EXPIRED} {certificate.not_valid_after_utc.date()}" if now >= certificate.not_valid_after_utc else None


def _make_authority(folder: Path, now: datetime) -> Authority:
    key = ec.generate_private_key(ec.SECP256R1())
    name = _named("zsim certificate authority")
    usage = x509.KeyUsage(
        key_cert_sign=True,
        crl_sign=True,
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
    certificate = (
        _builder(name, name, key, now - BACK, now + timedelta(days=AUTHORITY_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    write(folder / "ca.key", _key_pem(key))
    write(folder / AUTHORITY, _pem(certificate))
    return Authority(certificate, key)


def _read_authority(certificate: Path, key: Path) -> Authority:
    try:
        read = serialization.load_pem_private_key(key.read_bytes(), password=None)
    except OSError as error:
        raise RunError(f"{key}: cannot be read ({error.strerror}); it belongs to who made it") from error
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise RunError(f"{key}: is no private key; --force makes a new authority") from error
    pair = Authority(_load(certificate), read) if isinstance(read, ec.EllipticCurvePrivateKey) else None
    if pair is None or pair.certificate.public_key() != pair.key.public_key():
        raise RunError(f"{key}: is not the key of {certificate.name}; --force makes a new authority")
    return pair


def _load(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}); zsim certs init makes it") from error
    except ValueError as error:
        raise RunError(f"{path}: is no certificate; zsim certs init makes it") from error


def _builder(
    subject: str | x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, start: datetime, end: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_named(subject) if isinstance(subject, str) else subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(start)
        .not_valid_after(end)
    )


def _named(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _identifier_of(signer: Authority) -> x509.AuthorityKeyIdentifier:
    return x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.key.public_key())


def _names(addresses: Iterable[str]) -> Iterator[x509.IPAddress | x509.DNSName]:
    for address in dict.fromkeys((*addresses, *LOOPBACK)):
        try:
            yield x509.IPAddress(ipaddress.ip_address(address.partition("%")[0]))
        except ValueError:
            yield x509.DNSName(address)


def _addresses(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def _signed_by(certificate: x509.Certificate, signer: Root) -> bool:
    try:
        certificate.verify_directly_issued_by(signer)
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def write(path: Path, content: bytes) -> None:
    """Put a file in its place at once and readable by its owner alone; half a key is no key.

    Raises:
        RunError: it cannot be written.
    """
    fresh = path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        fresh.unlink(missing_ok=True)
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(content)
        fresh.replace(path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror}); give another folder") from error
