"""Zenoh's settings for a session, and the limit of open files.

Settings are {path in Zenoh's configuration: JSON5}, explained in docs/decisions/0002. The limit of open files
(RLIMIT_NOFILE, `ulimit -n`) is checked in advance: Zenoh panics, or waits forever, if a socket or a thread's event
queue cannot be opened.
"""

import json
import sys
from collections.abc import Sequence
from typing import Any, Literal

from zsim.errors import SessionError
from zsim.transport import tls
from zsim.transport.tls import Identity

LEASE_LOCKSTEP_MS = 3_600_000  # a stopped or debugged process must not lose its link in lockstep
LEASE_REALTIME_MS = 1_000
# The run does not wait for a process that only reads, so its loss need not be noticed within a second.
LEASE_READER_MS = 10_000
CLOSE_AFTER_US = 3_600_000_000  # -1 means forever, and panics in 1.10.2
# A stopped reader (a recorder, `zsim echo`) fills its link and then blocks the hub for all, so it loses its link.
# A stopped participant does not: simulated time stops before its link is full.
HUB_CLOSE_AFTER_US = 10_000_000
CONNECT_RETRY_MS = 100
# Silent connections block new ones once this many are open, until they time out: with Zenoh's defaults, 100 and 10 s, a
# hundred of them blocked joins for 10 s. A handshake takes a few round trips: 2 s with TLS over a satellite link.
ACCEPT_PENDING, ACCEPT_MS = 1000, 3_000
SESSIONS_MAX = 4_000  # at a hub; Zenoh's default of 1000 is two too few for a run with 1000 drones
QUEUE_LOCKSTEP = 16  # batches of 48 kB; Zenoh's maximum (its default is 2)

_CLOSE_AFTER = "transport/link/tx/queue/congestion_control/block/wait_before_close"
_TLS = "transport/link/tls"
ACCESS = "access_control"
# Protocols in Zenoh's wheel; a client with any other would wait forever, since Zenoh reports only a timeout.
PROTOCOLS = (*tls.NETWORKED, *tls.ENCRYPTED, "unixsock-stream")

SESSION_FILES = 32  # open files of a process with a session; 22 measured, the rest for files read while it loads
CLIENT_FILES = 3  # open files of a hub for each process that connects; 2.2 measured, more while many connect at once
ROLE_FILES = 2  # open files of a launcher for each process that it starts: its standard input and its log
HOST_FILES = 2  # open files of a launcher for each host: its ssh connection, and a file being copied
WORKER_FILES = 4  # open files of a sweep for each worker: both ends of its pipe, and its sentinel
SERVER_FILES = 256  # open files of a gateway or console: a session, and 100 connections each for HTTP and lines
SPARE_CLIENTS = 4  # clients of a hub in addition to the run's processes: a console, `zsim echo`

Mode = Literal["lockstep", "realtime"]
Settings = dict[str, str]


def common(mode: str, timing: Mode, reader: bool = False) -> Settings:
    """Return the settings of every session; `mode` is client, peer or router; no gate waits for a `reader`."""
    lease = LEASE_READER_MS if reader else LEASE_REALTIME_MS if timing == "realtime" else LEASE_LOCKSTEP_MS
    return {
        "mode": json.dumps(mode),
        "scouting/multicast/enabled": "false",
        "scouting/gossip/enabled": "false",
        "connect/retry": f"{{period_init_ms: {CONNECT_RETRY_MS}, period_max_ms: {2 * CONNECT_RETRY_MS}}}",
        "transport/link/tx/lease": str(lease),
        "transport/shared_memory/enabled": "false",  # on by default; needs /dev/shm, and leaves segments there
        "timestamping/enabled": "false",  # on by default in routers; messages have their own time
        _CLOSE_AFTER: str(CLOSE_AFTER_US),
    }


def listening(endpoints: Sequence[str], identity: Identity) -> Settings:
    """Return the additional settings of a hub or router: it requires its port, and closes links of stalled readers.

    Raises:
        SessionError: endpoints and identity do not match, or a file of the identity is unusable.
    """
    return {
        "listen/endpoints": json.dumps(list(endpoints)),
        "listen/exit_on_failure": "true",
        "transport/unicast/accept_timeout": str(ACCEPT_MS),
        "transport/unicast/accept_pending": str(ACCEPT_PENDING),
        "transport/unicast/max_sessions": str(SESSIONS_MAX),
        _CLOSE_AFTER: str(HUB_CLOSE_AFTER_US),
        **_security(identity, endpoints, "listen on"),
    }


def connecting(endpoint: str, identity: Identity, wait_s: float) -> Settings:
    """Return the additional settings of a client, which tries to connect for `wait_s`. Errors as in `listening`."""
    return {
        "connect/endpoints": json.dumps([endpoint]),
        "connect/timeout_ms": str(int(1000 * wait_s)),
        **_security(identity, [endpoint], "connect to"),
    }


def hub(timing: Mode) -> Settings:
    """Return the additional settings of the hub, which has no upstream and opens without waiting for a peer.

    In lockstep its queues are as long as Zenoh allows, so that a link is closed before it is full (see link_watch). In
    realtime, long queues would only delay the messages on a slow link.

    A router keeps Zenoh's delay of half a second, in which it learns the queryables of its upstream.
    """
    queue = {"transport/link/tx/queue/size/data": str(QUEUE_LOCKSTEP)} if timing == "lockstep" else {}
    return {"scouting/delay": "0", **queue}


def upstream(endpoint: str, identity: Identity) -> Settings:
    return connecting(endpoint, identity, 0.0) | {"connect/exit_on_failure": "false", "connect/timeout_ms": "-1"}


def _security(identity: Identity, endpoints: Sequence[str], doing: str) -> Settings:
    """Return the settings of TLS, with certificates on both sides, and of access control."""
    for endpoint in endpoints:  # refuse combinations that are less secure than they look
        protocol, separator, _ = endpoint.partition("/")
        if separator and protocol not in PROTOCOLS:
            raise SessionError(f"endpoint is {endpoint!r}; its protocol must be one of {', '.join(PROTOCOLS)}")
        secure = tls.is_tls(endpoint)
        if secure and identity.tls is None:
            raise SessionError(f"{endpoint}: needs a certificate; give --tls a folder created by zsim certs init")
        if not secure and identity.tls is not None:
            raise SessionError(f"{endpoint}: is not encrypted; with --tls it must be tls/ADDRESS:PORT")
        if not secure and not identity.insecure and tls.leaves_machine(endpoint):
            raise SessionError(
                f"{endpoint}: is not encrypted and leaves this machine; give --tls and a tls/ endpoint (zsim certs "
                "init makes certificates), or --insecure on a private network"
            )
    if identity.access is not None and identity.tls is None:
        raise SessionError(f"{identity.access}: access control needs certificates; give --tls too")
    if identity.tls is None:
        return {}
    if fault := tls.own_fault(identity):
        raise SessionError(f"cannot {doing} {', '.join(endpoints)}: {fault}")
    authority, certificate, key = (json.dumps(str(path.resolve())) for path in identity.files)
    settings = {
        f"{_TLS}/root_ca_certificate": authority,
        f"{_TLS}/listen_certificate": certificate,
        f"{_TLS}/listen_private_key": key,
        f"{_TLS}/connect_certificate": certificate,
        f"{_TLS}/connect_private_key": key,
        f"{_TLS}/enable_mtls": "true",
    }
    if identity.access is not None:
        settings[ACCESS] = json.dumps(read_access(identity))
    return settings


def refusal(path: str, value: str, identity: Identity) -> str:
    """Return the error for a setting that Zenoh refuses: only endpoints and access control come from the user."""
    if path == ACCESS:
        return f"{identity.access}: is not a Zenoh access control file; must be an access.json of zsim certs init"
    endpoints = ", ".join(map(repr, json.loads(value)))
    return f"endpoint is {endpoints}; must be PROTOCOL/ADDRESS such as tcp/127.0.0.1:7447"


def read_access(identity: Identity) -> Any:
    """Return the access control in the identity's file; Zenoh checks its content.

    Raises:
        SessionError: the file cannot be read or is not JSON.
    """
    assert identity.access is not None
    try:
        return json.loads(identity.access.read_bytes())
    except OSError as error:
        fault = f"cannot be read ({error.strerror}); zsim certs init makes access.json"
        raise SessionError(f"{identity.access}: {fault}") from error
    except ValueError as error:
        fault = f"is not JSON ({error}); must be an access.json of zsim certs init"
        raise SessionError(f"{identity.access}: {fault}") from error


def hub_files(clients: int) -> int:
    return SESSION_FILES + CLIENT_FILES * (clients + SPARE_CLIENTS)


def launcher_files(roles: int, names: int) -> int:
    """Return the largest number of open files needed by a process of a run: its hub or its launcher.

    Args:
        roles: number of started processes, including the world.
        names: number of processes that the world waits for, possibly more than are started.
    """
    return max(hub_files(max(roles - 1, names)), SESSION_FILES + ROLE_FILES * roles)


def host_launcher_files(roles: int, hosts: int) -> int:
    return SESSION_FILES + ROLE_FILES * roles + HOST_FILES * hosts


def require_files(needed: int, purpose: str) -> None:
    """Raise the soft limit to the needed number of files; SessionError if the hard limit does not allow it.

    `purpose` names the cause in the error, e.g. "12 processes".
    """
    allowed = allow_files(needed)
    if allowed is not None and allowed < needed:
        raise SessionError(
            f"the limit of open files is {allowed}; must be {needed} for {purpose}: `ulimit -n {needed}`"
        )


def allow_files(count: int) -> int | None:
    """Raise the soft limit to the wanted number if the hard limit allows it; return the limit, None if unlimited."""
    if sys.platform == "win32":
        return None
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= count:
        return None if soft == resource.RLIM_INFINITY else soft
    soft = count if hard == resource.RLIM_INFINITY else min(hard, count)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return soft
