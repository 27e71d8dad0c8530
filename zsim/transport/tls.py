"""Identity of a process on the network, diagnosis of failed TLS links, and permissions of a certificate.

Zenoh reports only that it could not connect. Repeating the handshake with Python's ssl and the same files reveals the
reason. Dates are checked here, so that the error can name an expired certificate.

Zenoh silently drops messages that access control does not permit. Therefore a listening process answers a get on
`@access/NAME` with `Permissions` for every client with a certificate of its authority, and the client raises an error
instead of sending.
"""

import contextlib
import ipaddress
import re
import socket
import ssl
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from msgspec import Struct

from zsim.errors import NoListenerError, SessionError

CERTIFICATES = AUTHORITY, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"  # files made by `zsim certs init`
DAYS = 30.0  # validity of a certificate
PROBE_S = 2.0  # timeout of each step of the handshake; a running listener answers within milliseconds
LATE_S = 1.0  # wait for a refusal: in TLS 1.3 a server checks the client's certificate after the client has finished
NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME, openssl/x509_vfy.h
ENCRYPTED = ("tls", "quic")  # protocols in Zenoh's wheel with certificates
NETWORKED = ("tcp", "udp", "ws")  # unencrypted protocols in Zenoh's wheel that leave the machine
REMEDY = "make new certificates with zsim certs init"
RENEW = f"{REMEDY} --renew"
ADDRESS_REMEDY = f"name that in the hosts file and {REMEDY}, or connect to another address"
Act = Literal["publish", "read", "ask"]
MESSAGES: dict[Act, str] = {"publish": "put", "read": "declare_subscriber", "ask": "query"}  # Zenoh's names
SHOWN_MAX = 4  # names or expressions shown in a line
OTHER_CERTIFICATE = "use that of a process that may, or of an operator (zsim certs init --operator NAME)"

_ENDPOINT = re.compile(r"(?:tls|quic)/\[?(?P<host>[^\]]*?)\]?:(?P<port>\d+)(?:[?#].*)?")
_UNRELATED = (18, 19, 20, 21)  # X509_V_ERR_: self-signed, self-signed in chain, no local issuer, unverified signature
_MISNAMED = (62, 64)  # X509_V_ERR_HOSTNAME_MISMATCH, X509_V_ERR_IP_ADDRESS_MISMATCH


class Identity(NamedTuple):
    """The identity of a process: its host, its certificate, and the processes that it admits."""

    host: str = socket.gethostname()  # name in its messages
    tls: Path | None = None  # folder with ca.pem, certificate.pem and key.pem; None: without TLS
    access: Path | None = None  # file with Zenoh's access-control rules, for a listening process; None admits all
    insecure: bool = False  # whether links may leave the machine without TLS
    process: str = ""  # required name in the certificate; empty: any

    @property
    def files(self) -> tuple[Path, Path, Path]:
        """The certificate of the common authority, that of the process, and its key."""
        assert self.tls is not None
        return self.tls / AUTHORITY, self.tls / CERTIFICATE, self.tls / KEY


def is_tls(endpoint: str) -> bool:
    return endpoint.partition("/")[0] in ENCRYPTED


def leaves_machine(endpoint: str) -> bool:
    """Return whether an endpoint's links may leave this machine unencrypted, as to any host name but localhost."""
    protocol, _, address = endpoint.partition("/")
    host = (address.rpartition(":")[0] or address).strip("[]")
    if protocol not in NETWORKED or host == "localhost":
        return False
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return True


def own_fault(identity: Identity) -> str | None:
    """Return the fault of a process's own files; None if they are valid."""
    for path in identity.files:
        try:
            with open(path, "rb") as file:
                file.read(1)
        except OSError as error:
            needed = f"{AUTHORITY}, {CERTIFICATE} and {KEY}, as created by zsim certs init"
            return f"{path}: cannot be read ({error.strerror}); --tls needs a folder with {needed}"
    try:
        certificate = _read_own(identity)
    except (ssl.SSLError, ValueError) as error:
        return f"{identity.tls}: certificate.pem, key.pem and ca.pem do not match ({_reason(error)}); {REMEDY}"
    if fault := _date_fault(certificate):
        return fault
    # under another name, access control would drop everything that this process sends
    actual, expected = _name(certificate), identity.process
    if expected in ("", actual):
        return None
    return f"{identity.tls}: the certificate is for {actual}; must be for {expected}; give the right --tls folder"


def own_name(identity: Identity) -> str:
    """Return the name in a process's own certificate, which must be valid according to `own_fault`."""
    return _name(_read_own(identity))


def no_link(identity: Identity, endpoint: str, error: str) -> SessionError:
    """Return the error of a client that could not connect; `error` is Zenoh's text."""
    if fault := peer_fault(identity, endpoint):
        return SessionError(f"cannot connect to {endpoint}: {fault}")
    return NoListenerError(f"nobody listens on {endpoint}; start a world there ({error})")


def peer_fault(identity: Identity, endpoint: str) -> str | None:
    """Return why a handshake with the process listening on an endpoint fails.

    None if it succeeds, or if no process listens or answers yet.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if identity.tls is None or match is None:
        return None
    host, address = match["host"], (match["host"], int(match["port"]))
    try:
        with (
            socket.create_connection(address, PROBE_S) as plain,
            _client(identity).wrap_socket(plain, server_hostname=host) as link,
        ):
            fault = _date_fault(link.getpeercert() or {})
            if fault is None:
                link.settimeout(LATE_S)
                with contextlib.suppress(TimeoutError):
                    link.recv(1)
            return fault
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in _UNRELATED:
            return f"the listener's certificate is from another authority than ours; {REMEDY} and use one set"
        if error.verify_code not in _MISNAMED:
            return f"the listener's certificate is refused ({error.verify_message}); {REMEDY}"
    except ssl.SSLError as error:
        return _error_text(error, endpoint)
    except OSError:
        return None
    try:
        context = _client(identity)
        context.check_hostname = False
        with socket.create_connection(address, PROBE_S) as plain, context.wrap_socket(plain) as link:
            alt_names = (link.getpeercert() or {}).get("subjectAltName", ())
    except OSError:
        return None
    names = ", ".join(str(name) for _, name in alt_names) or "no address"
    return f"the listener's certificate is for {names}; must be for {host}; {ADDRESS_REMEDY}"


def _client(identity: Identity) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    authority, certificate, key = identity.files
    context.load_verify_locations(authority)
    context.load_cert_chain(certificate, key)
    context.verify_flags |= NO_CHECK_TIME
    return context


def _error_text(error: ssl.SSLError, endpoint: str) -> str | None:
    """Return the text of a handshake error; None if the next attempt may succeed."""
    reason = error.reason or ""
    if "EXPIRED" in reason:
        return f"our certificate has expired by the listener's clock; {RENEW}"
    if "UNKNOWN_CA" in reason or "DECRYPT_ERROR" in reason:
        return f"our certificate is from another authority than the listener's; {REMEDY} and use one set"
    if "ALERT" in reason:
        return f"the listener refuses our certificate ({_reason(error)}); {REMEDY}"
    if "WRONG_VERSION" in reason or "RECORD_LAYER" in reason or "HTTP" in reason:
        return f"the listener does not use TLS; start it with --tls, or use tcp/ instead of {endpoint.split('/')[0]}/"
    return None


def _reason(error: Exception) -> str:
    reason = getattr(error, "reason", None) or str(error)
    return reason.lower().replace("_", " ")


def _date_fault(certificate: dict[str, Any]) -> str | None:
    """Return the fault of a certificate that has expired or is not yet valid; None if it is valid now."""
    if not certificate:
        return None
    now_s, subject = time.time(), f"the certificate of {_name(certificate)}"
    begin_s, end_s = (ssl.cert_time_to_seconds(certificate[each]) for each in ("notBefore", "notAfter"))
    if now_s > end_s:
        return f"{subject} expired on {time.strftime('%Y-%m-%d', time.gmtime(end_s))}; {RENEW}"
    if now_s < begin_s:
        since = time.strftime("%Y-%m-%d", time.gmtime(begin_s))
        return f"{subject} is valid from {since}; set the clock of this host"
    return None


def _name(certificate: dict[str, Any]) -> str:
    names = dict(pair for part in certificate["subject"] for pair in part)
    return names.get("commonName", "nobody")


def _read_own(identity: Identity) -> dict[str, Any]:
    """Return the content of a process's own certificate, read from a handshake with itself in memory.

    Raises:
        ssl.SSLError: key, certificate and authority do not match.
    """
    server_side = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server_side.load_cert_chain(*identity.files[1:])
    client_side = _client(identity)
    client_side.check_hostname = False
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    server = server_side.wrap_bio(to_server, to_client, server_side=True)
    client = client_side.wrap_bio(to_client, to_server)
    for side in (client, server, client):
        with contextlib.suppress(ssl.SSLWantReadError):
            side.do_handshake()
    return client.getpeercert() or {}


class Permissions(Struct, frozen=True):
    """Permissions that a listening process grants to another; expressions include the federation's name."""

    listener: str  # name of the listening process
    process: str  # name in the certificate
    allowed: dict[Act, tuple[str, ...]] = {}  # expressions by act; empty if not admitted
    known: tuple[str, ...] = ()  # names that are admitted, if this one is not

    def refusal(self) -> str | None:
        """Return why the process is not admitted; None if it is."""
        if self.allowed:
            return None
        return (
            f"certificate for {self.process} is not admitted by {self.listener}; must be for one of "
            f"{_shown(self.known)}; admit it with zsim certs init, and start {self.listener} again"
        )

    def denial(self, act: Act, expression: str, prefix: str) -> str:
        """Return the error for an action that is not permitted; keys are without the federation's prefix."""
        kind = expression.partition("/")[0]
        allowed = [each.removeprefix(prefix) for each in self.allowed.get(act, ())]
        alike_first = sorted(allowed, key=lambda each: each.partition("/")[0] != kind)
        permitted = f"only {_shown(alike_first)}; {OTHER_CERTIFICATE}"
        return f"certificate for {self.process} may not {act} {expression}: {permitted}"


def permissions_of(access: Mapping[str, Any], listener: str, process: str) -> Permissions:
    """Return the permissions that Zenoh's access control at a listening process grants to a certificate's name.

    Args:
        access: the content of an access.json that Zenoh has accepted.
        listener: name of the listening process.
        process: name in the certificate.
    """
    subjects = {each["id"] for each in access.get("subjects", ()) if process in each.get("cert_common_names", ())}
    policies = (each for each in access.get("policies", ()) if subjects & set(each["subjects"]))
    ids = {rule for policy in policies for rule in policy["rules"]}
    granted = [rule for rule in access.get("rules", ()) if rule["id"] in ids and rule["permission"] == "allow"]
    inbound = [rule for rule in granted if "ingress" in rule.get("flows", ("ingress",))]
    allowed: dict[Act, tuple[str, ...]] = {
        act: tuple(dict.fromkeys(key for rule in inbound if message in rule["messages"] for key in rule["key_exprs"]))
        for act, message in MESSAGES.items()
    }
    if any(allowed.values()):
        return Permissions(listener, process, allowed)
    names = (name for subject in access.get("subjects", ()) for name in subject.get("cert_common_names", ()))
    return Permissions(listener, process, known=tuple(names))


def _shown(names: Sequence[str]) -> str:
    remainder = len(names) - SHOWN_MAX
    return (", ".join(names[:SHOWN_MAX]) or "nothing") + (f" and {remainder} more" if remainder > 0 else "")
