"""The certificate authority of a federation: certificates of its processes on its hosts, and their access rights.

certs/ca.pem, certs/ca.key                             the authority; the key stays on the machine where it was made
certs/HOST/PROCESS/ca.pem, certificate.pem, key.pem    files of one process on one host; --tls takes their folder
certs/HOST/PROCESS.access.json                         access control of a listening process

Zenoh enforces access control at the listening process (the world or a router), by the common name in the peer's
certificate, in both directions. A key expression is allowed if a rule's expression includes it.
Source: docs.rs/zenoh-config, AclConfig.
"""

import ipaddress
import os
import shlex
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from zsim.contract import keys
from zsim.errors import InventoryError, RunError, file_fault
from zsim.scenario import roles as rights
from zsim.scenario.roles import OPERATOR, ROUTER, WORLD, Rights, drivers_of
from zsim.scenario.scenario import Scenario
from zsim.transport.tls import AUTHORITY, CERTIFICATE, CERTIFICATES, DAYS, KEY
from zsim_deploy import inventory as inv
from zsim_deploy.inventory import InventoryFile

AUTHORITY_DAYS = 1825  # lifetime of an authority, 5 years; its key never leaves the machine where it was made
AUTHORITY_KEY = "ca.key"
# Certificates are back-dated by this, because clocks of hosts in the field may be hours off.
BACKDATE = timedelta(days=1)
EXPIRED = "expired on"  # start of a fault text; a date follows
OPERATORS = "operators"  # folder, in place of HOST, for operators without a host in the inventory
LOOPBACK = ("localhost", "127.0.0.1", "::1")
SHOWN_MAX = 4  # maximum number of names listed in a fault; usually all certificates are missing at once
READABLE_BY_OTHERS = stat.S_IRGRP | stat.S_IROTH

Root = x509.Certificate
"""The certificate of an authority."""


class CertificateRequest(NamedTuple):
    """A required certificate."""

    host: str  # name of the host in the inventory, and of its folder
    process: str  # name of the process, which is the common name
    addresses: tuple[str, ...] = ()  # addresses of the host: IP addresses or DNS names


class CertificateStatus(NamedTuple):
    host: str
    process: str
    addresses: tuple[str, ...]
    until: datetime
    fault: str


class Authority(NamedTuple):
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def folder_of(inventory_file: InventoryFile) -> Path:
    return inventory_file.folder / Path(inventory_file.inventory.security.certificates).expanduser()


def init_command(inventory_file: InventoryFile, renew: bool = False) -> str:
    """Return the command that makes the certificates of an inventory."""
    return f"zsim certs init {inventory_file.shell_path} --scenario FILE{' --renew' if renew else ''}"


def authority(folder: Path, now: datetime, force: bool = False) -> Authority:
    """Return the authority in a folder, created if the folder has none.

    `force`: create a new one, which invalidates all earlier certificates. Raise RunError if the authority is
    incomplete, its key and certificate do not match, it has expired, or it cannot be read or written.
    """
    certificate_path, key_path = folder / AUTHORITY, folder / AUTHORITY_KEY
    existing = [path for path in (certificate_path, key_path) if path.exists()]
    if force or not existing:
        return _make_authority(folder, now)
    if len(existing) == 1:
        missing = key_path if existing == [certificate_path] else certificate_path
        raise RunError(
            f"{missing}: is missing beside {existing[0].name}; copy it here, or --force makes a new authority"
        )
    try:
        with file_fault(key_path, "cannot be read", "run this as the user who made it"):
            key = serialization.load_pem_private_key(key_path.read_bytes(), password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise RunError(f"{key_path}: is not a private key; --force makes a new authority") from error
    if (
        not isinstance(key, ec.EllipticCurvePrivateKey)
        or (certificate := root(folder)).public_key() != key.public_key()
    ):
        raise RunError(f"{key_path}: is not the key of {certificate_path.name}; --force makes a new authority")
    if now >= certificate.not_valid_after_utc:
        day = certificate.not_valid_after_utc.date()
        raise RunError(f"{certificate_path}: the authority expired on {day}; --force makes a new one")
    return Authority(certificate, key)


def _make_authority(folder: Path, now: datetime) -> Authority:
    name = _name("zsim certificate authority")
    unused = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement")
    denied = dict.fromkeys(("digital_signature", *unused, "encipher_only", "decipher_only"), False)
    key, builder = _key_and_builder(name, name, now, AUTHORITY_DAYS)
    certificate = (
        builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.KeyUsage(key_cert_sign=True, crl_sign=True, **denied), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    write(folder / AUTHORITY_KEY, _key_pem(key))
    write(folder / AUTHORITY, _pem(certificate))
    return Authority(certificate, key)


def issue(folder: Path, signer: Authority, request: CertificateRequest, now: datetime, days: float = DAYS) -> Path:
    """Make the key and certificate of a process on a host; return their folder."""
    purposes = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]  # a router is both
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.key.public_key())
    key, builder = _key_and_builder(_name(request.process), signer.certificate.subject, now, days)
    certificate = (
        builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.SubjectAlternativeName(list(_alternative_names(request.addresses))), critical=False)
        .add_extension(issuer, critical=False)
        .sign(signer.key, hashes.SHA256())
    )
    process_folder = folder / request.host / request.process
    for file, content in zip(CERTIFICATES, (_pem(signer.certificate), _pem(certificate), _key_pem(key)), strict=True):
        write(process_folder / file, content)
    return process_folder


def _key_and_builder(
    subject: x509.Name, issuer: x509.Name, now: datetime, days: float
) -> tuple[ec.EllipticCurvePrivateKey, x509.CertificateBuilder]:
    key = ec.generate_private_key(ec.SECP256R1())
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number())
    return key, builder.not_valid_before(now - BACKDATE).not_valid_after(now + timedelta(days=days))


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _alternative_names(addresses: Iterable[str]) -> Iterator[x509.IPAddress | x509.DNSName]:
    for address in dict.fromkeys((*addresses, *LOOPBACK)):
        try:
            yield x509.IPAddress(ipaddress.ip_address(address.partition("%")[0]))
        except ValueError:
            yield x509.DNSName(address)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    form = serialization.PrivateFormat.PKCS8
    return key.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption())


def write(path: Path, content: bytes) -> None:
    """Write a file atomically, readable only by its owner."""
    temporary = path.with_name(f".{path.name}.new")
    with file_fault(path, "cannot be written", "give another folder"):
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        temporary.unlink(missing_ok=True)
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(content)
        temporary.replace(path)


def root(folder: Path) -> Root:
    """Return the certificate of the authority in a folder; raise RunError if it cannot be read."""
    return _load(folder / AUTHORITY)


def show(folder: Path, now: datetime) -> list[CertificateStatus]:
    statuses = []
    for path in sorted(folder.glob(f"*/*/{CERTIFICATE}")):
        certificate, process_folder = _load(path), path.parent
        fault, until = _fault(process_folder, certificate, root(folder), now) or "", certificate.not_valid_after_utc
        statuses.append(
            CertificateStatus(process_folder.parent.name, process_folder.name, _addresses(certificate), until, fault)
        )
    return statuses


def operators(folder: Path, hosts: Iterable[str]) -> Iterator[str]:
    """Yield the operators with a certificate in a folder, as NAME or, if at one of the hosts, as NAME@HOST."""
    for host in (OPERATORS, *hosts):
        for path in sorted((folder / host).glob(f"{OPERATOR}.*/{CERTIFICATE}")):
            name = path.parent.name.removeprefix(f"{OPERATOR}.")
            yield name if host == OPERATORS else f"{name}@{host}"


def renewal_reason(folder: Path, signer: Root, request: CertificateRequest, now: datetime) -> str | None:
    """Return why a certificate must be made; None if a valid one for these addresses and its key exist."""
    process_folder = folder / request.host / request.process
    if not all((process_folder / name).exists() for name in CERTIFICATES):
        return "new"
    try:
        certificate = x509.load_pem_x509_certificate((process_folder / CERTIFICATE).read_bytes())
    except (OSError, ValueError):
        return "cannot be read"
    if fault := _fault(process_folder, certificate, signer, now):
        return fault
    expected = {str(name.value) for name in _alternative_names(request.addresses)}
    return None if set(_addresses(certificate)) == expected else "other addresses"


def _fault(process_folder: Path, certificate: x509.Certificate, signer: Root, now: datetime) -> str | None:
    """Return the fault of a certificate or of the files beside it, for instance after an interrupted `certs init`."""
    try:
        authority_pem, key = (process_folder / AUTHORITY).read_bytes(), (process_folder / KEY).read_bytes()
        public = serialization.load_pem_private_key(key, password=None).public_key()
    except (OSError, ValueError, TypeError, UnsupportedAlgorithm):
        return "cannot be read"
    try:
        certificate.verify_directly_issued_by(signer)
    except (InvalidSignature, ValueError, TypeError):
        return "of another authority"
    if authority_pem != _pem(signer):
        return "of another authority"
    if public != certificate.public_key():
        return "without its key"
    return f"{EXPIRED} {certificate.not_valid_after_utc.date()}" if now >= certificate.not_valid_after_utc else None


def _load(path: Path) -> x509.Certificate:
    try:
        with file_fault(path, "cannot be read", "zsim certs init makes it"):
            return x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError as error:
        raise RunError(f"{path}: is not a certificate; zsim certs init makes it") from error


def _addresses(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def certificate_faults(
    inventory_file: InventoryFile, hosts_by_process: Mapping[str, str] | None, now: datetime
) -> list[str]:
    """Return a line for each fault of a run's certificates and access control.

    `hosts_by_process`: host of each process to start, with or without routers; None: only the world and the routers.
    """
    if inventory_file.inventory.security.insecure:
        return []
    folder = folder_of(inventory_file)
    if hosts_by_process is None:
        hosts_by_process = inv.spread(inventory_file.inventory.roles, [WORLD])
    routers = {f"{ROUTER}.{name}": router.host for name, router in inventory_file.inventory.routers.items()}
    processes_by_fault: dict[str, list[str]] = {}
    try:
        if not (folder / AUTHORITY).exists():
            remedy = (
                f"make them with `{init_command(inventory_file)}`, or set security.insecure on a network of your own"
            )
            return [f"{folder}: has no certificates; {remedy}"]
        signer = root(folder)
        for name, host in {**hosts_by_process, **routers}.items():
            request = CertificateRequest(host, name, (inventory_file.inventory.hosts[host].address,))
            listens = name == WORLD or name in routers
            reason, fault = renewal_reason(folder, signer, request, now), None
            if reason == "new":
                fault = "certificate missing"
            elif reason == "other addresses":
                fault = "certificate for other addresses" if listens else None  # a client's addresses are not checked
            elif reason:
                fault = f"certificate {reason}"
            elif listens and not (folder / host / f"{name}.access.json").exists():
                fault = "access control missing"
            if fault:
                processes_by_fault.setdefault(fault, []).append(f"{name} on {host}")
    except RunError as error:
        return [str(error)]
    except OSError as error:
        return [f"{folder}: cannot be read ({error.strerror}); run this as the user who made it"]
    lines = []
    for fault, processes in processes_by_fault.items():
        further = f" and {len(processes) - SHOWN_MAX} more" if len(processes) > SHOWN_MAX else ""
        remedy = f"make them with `{init_command(inventory_file, renew=EXPIRED in fault)}`"
        lines.append(f"{folder}: {fault}: {', '.join(processes[:SHOWN_MAX])}{further}; {remedy}")
    return lines


def exposed_keys(inventory_file: InventoryFile) -> str | None:
    """Return a warning about private keys that other users can read; None if there are none."""
    if inventory_file.inventory.security.insecure:
        return None
    folder = folder_of(inventory_file)
    exposed = []
    for path in (folder / AUTHORITY_KEY, *folder.glob(f"*/*/{KEY}")):
        with suppress(OSError):
            exposed += [path] if path.stat().st_mode & READABLE_BY_OTHERS else []
    if not exposed:
        return None
    further = f" and {len(exposed) - 1} other private keys" if len(exposed) > 1 else ""
    return (
        f"{min(exposed)}{further} can be read by other users of this machine; chmod -R go= {shlex.quote(str(folder))}"
    )


def enrolment(
    inventory_file: InventoryFile, scenario: Scenario, operators: Sequence[str] = ()
) -> tuple[list[CertificateRequest], list[tuple[str, str, dict[str, Any]]]]:
    """Return the required certificates, and the (host, process, access control) of every listening process.

    Every process of the scenario but the world gets a certificate for every host, so that it can be moved there.

    Args:
        operators: people and programs that observe and command, each as NAME or NAME@HOST; at a host they connect as
            its roles do: through its router if it has one, otherwise to the world. An operator may be at several hosts.

    Raises:
        InventoryError: a process has no host, or the host of an operator is unknown.
        BadNameError: a name is not allowed by the contract.
    """
    hosts, routers = inventory_file.inventory.hosts, inventory_file.inventory.routers
    hosts_by_process = inv.placement(inventory_file, scenario)
    operator_hosts: dict[tuple[str, str | None], None] = {}  # (name, host) of the operators, in order
    for name, at, host in (text.partition("@") for text in operators):
        name = keys.name(name.removeprefix(f"{OPERATOR}."), OPERATOR)
        if at and host not in hosts:
            hint = f"must be one of hosts: {', '.join(hosts)}"
            raise InventoryError([f"{inventory_file.source}: operator {name!r} is at {host!r}; {hint}"])
        operator_hosts[f"{OPERATOR}.{name}", host or None] = None
    # Any host may run any process of the scenario, and any driver, even one that the scenario does not expect.
    movable = [name for name in hosts_by_process if name != WORLD]
    movable += [name for name in drivers_of(scenario) if name not in hosts_by_process]
    required = [
        (hosts_by_process[WORLD], WORLD),
        *((router.host, f"{ROUTER}.{name}") for name, router in routers.items()),
    ]
    required += [(host, name) for name in movable for host in hosts]
    required += [(host or OPERATORS, name) for name, host in operator_hosts]
    requests = [CertificateRequest(at, name, (hosts[at].address,) if at in hosts else ()) for at, name in required]

    def operators_at(router: str | None) -> list[str]:
        return list(
            dict.fromkeys(
                operator
                for operator, operator_host in operator_hosts
                if (hosts[operator_host].router if operator_host else None) == router
            )
        )

    def clients_of(router: str) -> list[str]:
        """Return the processes that may connect to a router: every role if it has hosts, as any role can move there."""
        has_hosts = any(host.router == router for host in hosts.values())
        return [*(movable if has_hosts else []), *operators_at(router)]

    def downstream(router: str | None) -> list[str]:
        return [name for name, below in routers.items() if below.upstream == router]

    def processes_behind(router: str) -> list[str]:
        return [*clients_of(router), *(process for name in downstream(router) for process in processes_behind(name))]

    def below(router: str | None) -> dict[str, list[str]]:
        """Return the routers that connect to a router, or to the world (None), with the processes behind each."""
        return {f"{ROUTER}.{name}": processes for name in downstream(router) if (processes := processes_behind(name))}

    rules = access_control(scenario, [*movable, *operators_at(None)], below(None))
    access = [(hosts_by_process[WORLD], WORLD, rules)]
    for name, router in routers.items():
        upstream = f"{ROUTER}.{router.upstream}" if router.upstream else WORLD
        rules = access_control(scenario, clients_of(name), below(name), [upstream])
        access.append((router.host, f"{ROUTER}.{name}", rules))
    return requests, access


# Rights as Zenoh's rules, as seen by the listening process: (flow, messages, field of Rights with the keys)
_WIRE: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("ingress", ("declare_subscriber",), "reads"),
    ("egress", ("put",), "reads"),
    ("ingress", ("put",), "writes"),
    ("ingress", ("query",), "asks"),
    ("egress", ("reply",), "asks"),
    ("ingress", ("declare_queryable", "reply"), "answers"),
    ("egress", ("query",), "answers"),
    ("ingress", ("liveliness_token",), "tokens"),
    ("ingress", ("liveliness_query", "declare_liveliness_subscriber"), "watches"),
    ("egress", ("liveliness_token",), "watches"),
)
# Declarations may go to every named process, which would otherwise send nothing; they have no payload.
_DECLARATIONS = ("declare_subscriber", "declare_queryable", "liveliness_query", "declare_liveliness_subscriber")
_MESSAGES = (*_DECLARATIONS, "put", "delete", "query", "reply", "liveliness_token")
ANYONE = "anyone"  # any peer with a certificate of the authority, because a subject without conditions matches all
# Any peer may query its own rights; see zsim.transport.tls.
_ACCESS_QUERY = (("ingress", "query"), ("egress", "reply"))


def access_control(
    scenario: Scenario, clients: Iterable[str], routers: Mapping[str, Iterable[str]], above: Iterable[str] = ()
) -> dict[str, Any]:
    """Return the `access_control` section of Zenoh's configuration for a listening process.

    Everything beyond the rights of these processes is denied; any other process may only query its own rights.

    Args:
        clients: names of the processes that connect to the listening process.
        routers: names of the routers that connect to it, with the names of the processes behind each.
        above: name of the world or the router to which the listening process itself connects, if any.
    """
    granted = {name: rights.rights_for(name, scenario) for name in clients}
    for name, processes in routers.items():
        granted[name] = rights.combined(rights.rights_for(process, scenario) for process in processes)
    granted |= dict.fromkeys(above, rights.ALL_RIGHTS)
    entries = [(name, _rules(name, right, scenario.federation)) for name, right in granted.items()]
    queries = [
        _rule(ANYONE, (flow,), (message,), (keys.access("*"),), scenario.federation) for flow, message in _ACCESS_QUERY
    ]
    subjects = [{"id": name, "cert_common_names": [name]} for name, _ in entries]
    entries.append((ANYONE, queries))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for _, rules in entries for rule in rules],
        "subjects": [*subjects, {"id": ANYONE}],
        "policies": [{"subjects": [name], "rules": [rule["id"] for rule in rules]} for name, rules in entries],
    }


def _rules(name: str, right: Rights, federation: str) -> list[dict[str, Any]]:
    if right == rights.ALL_RIGHTS:
        return [_rule(name, ("ingress", "egress"), _MESSAGES, rights.EVERYTHING, federation)]
    granted = [(flow, messages, getattr(right, field)) for flow, messages, field in _WIRE]
    rules = [
        _rule(name, (flow,), messages, expressions, federation)
        for flow, messages, expressions in granted
        if expressions
    ]
    return [*rules, _rule(name, ("egress",), _DECLARATIONS, rights.EVERYTHING, federation)]


def _rule(
    name: str, flows: tuple[str, ...], messages: tuple[str, ...], expressions: Iterable[str], federation: str
) -> dict[str, Any]:
    return {
        "id": f"{name} {' '.join(flows)} {' '.join(messages)}",
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": [f"{federation}/{expression}" for expression in expressions],
    }
