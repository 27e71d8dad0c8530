"""Joining a federation: the hub listens, routers forward, and all other processes connect to one of these.

`find_world` connects and reads `world/info`; it waits, with progress messages, until there is a world.
"""

import errno
import re
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial

from zsim.contract import keys, messages
from zsim.errors import DecodeError, NoListenerError, NoWorldError, SessionError
from zsim.transport import tls, zenoh_settings
from zsim.transport.session import Query, Session, config_of, open_session
from zsim.transport.tls import Identity, Permissions, permissions_of
from zsim.transport.zenoh_settings import Mode, Settings

ATTEMPT_S = 1.0  # limit of one attempt to connect, so that waiting can be reported and interrupted
PAUSE_S = 0.1  # between queries to a hub while no world answers; it may be starting, or be in another federation
ANSWER_S = 1.0  # time limit for an answer; a hub answers within milliseconds, unless it is still compiling
_OS_ERROR = re.compile(r"(?:os error |code: )(\d+)")
_OTHER = "choose another address with --listen, and pass it to the other commands with --connect"
_LISTEN_FAULTS = {  # by errno
    errno.EADDRINUSE: f"another process listens there; {_OTHER}",
    errno.EADDRNOTAVAIL: f"that is not an address of this machine (`ip address` lists them); {_OTHER}",
    errno.EACCES: f"this user may not open it; ports below 1024 need root; {_OTHER}",
    errno.EPERM: f"this process may not open it; {_OTHER}",
    errno.EINVAL: f"the address lacks its network interface; give it as in tcp/[fe80::1%eth0]:7447; {_OTHER}",
    errno.ENODEV: "this machine has no such network interface; `ip address` lists them",
    errno.EMFILE: "this process has too many files open; allow more with `ulimit -n`",
    errno.ENFILE: "this machine has too many files open; end other programs, or raise fs.file-max",
    errno.EAFNOSUPPORT: f"this machine has no addresses of that kind (IPv6 is off); {_OTHER}",
    errno.ENOMEM: "this machine has too little memory left",
}
_LISTEN_TEXTS = {  # parts of Zenoh's errors without an errno
    "lookup address": f"the name is not known on this machine; {_OTHER}",
    "invalid port": f"the port must be from 1 to 65535; {_OTHER}",
}


@contextmanager
def listen(
    endpoints: Sequence[str], federation: str, mode: Mode, identity: Identity | None = None
) -> Iterator[Session]:
    """Open the hub: a listening router, to which clients and other routers connect.

    A peer would suffice for clients, but does not forward between routers connected to it.

    Raises:
        SessionError: an endpoint is in use or malformed, or the identity is unusable.
    """
    with _listening(endpoints, federation, mode, identity or Identity(), zenoh_settings.hub(mode)) as session:
        session.use(mode)
        yield session


def route(
    endpoint: str, upstream: str, federation: str, mode: Mode = "lockstep", identity: Identity | None = None
) -> AbstractContextManager[Session]:
    """Open a router: it listens on an endpoint, and keeps trying to connect upstream to the world or another router.

    Errors as in `listen`.
    """
    identity = identity or Identity()
    return _listening([endpoint], federation, mode, identity, zenoh_settings.upstream(upstream, identity))


@contextmanager
def connect(
    endpoint: str,  # e.g. "tcp/192.168.1.2:7447"
    federation: str,
    mode: Mode = "lockstep",  # mode of the run, if known
    wait_s: float | None = None,  # how long to keep trying; None: 0.5 s
    # whether the run never waits for this client; it is then taken as dead after LEASE_READER_MS, even in lockstep
    reader: bool = False,
    identity: Identity | None = None,  # host and certificate; by default this host's name and no TLS
) -> Iterator[Session]:
    """Open a client of the hub (or of a router).

    Raises:
        NoListenerError: no process listens there within `wait_s`.
        SessionError: the endpoint is malformed, or one side refuses the other's certificate.
    """
    identity = identity or Identity()
    client = zenoh_settings.connecting(endpoint, identity, wait_s or 0.5)
    settings = zenoh_settings.common("client", mode, reader) | client
    with open_session(settings, federation, identity, partial(tls.no_link, identity, endpoint)) as session:
        yield session


def check_listening(endpoints: Sequence[str], identity: Identity | None = None) -> None:
    """Raise SessionError, without listening, if an endpoint is malformed, has port 0 or does not match the identity."""
    if any(endpoint.endswith(":0") for endpoint in endpoints):
        raise SessionError(f"cannot listen on {', '.join(endpoints)}: other processes cannot connect to port 0")
    identity = identity or Identity()
    config_of(zenoh_settings.listening(endpoints, identity), identity)


@contextmanager
def _listening(
    endpoints: Sequence[str], federation: str, mode: Mode, identity: Identity, others: Settings
) -> Iterator[Session]:
    check_listening(endpoints, identity)
    settings = zenoh_settings.common("router", mode) | zenoh_settings.listening(endpoints, identity) | others
    with open_session(settings, federation, identity, partial(no_listening, endpoints)) as session:
        if identity.access is not None:  # a router answers for itself, not for the world behind it
            rules = zenoh_settings.read_access(identity)

            def tell_permissions(query: Query) -> None:
                process = keys.leaf(query.expression)
                if keys.PROCESS_NAME.fullmatch(process):
                    query.reply(query.expression, messages.encode(permissions_of(rules, session.process, process)))
                query.end()

            session.declare_queryable(keys.access("*"), tell_permissions, complete=True)
        yield session


def no_listening(endpoints: Sequence[str], error: str) -> SessionError:
    """Return the error of a hub that could not listen, with the remedy; `error` is Zenoh's text."""
    match = _OS_ERROR.search(error)
    reason = _LISTEN_FAULTS.get(int(match[1]) if match else 0)
    if reason is None:
        reason = next((fault for text, fault in _LISTEN_TEXTS.items() if text in error), None)
    text = f"cannot listen on {', '.join(endpoints)}"
    return SessionError(f"{text}: {reason}" if reason else f"{text} ({error}); {_OTHER}")


@contextmanager
def find_world(
    endpoint: str,  # see `connect`
    federation: str,
    wait_s: float | None = None,  # how long to wait for a world; None: forever
    say: Callable[[str], None] = lambda text: None,  # called at growing intervals while waiting
    stopped: Callable[[], bool] = lambda: False,  # returns whether to stop waiting
    reader: bool = False,
    run_id: str | None = None,  # id of the only acceptable run; None: any
    identity: Identity | None = None,
) -> Iterator[tuple[Session, messages.Info]]:
    """Yield a session and the `world/info` of its run.

    Raises:
        NoWorldError: no world answered within `wait_s`, an answer is unusable, or `stopped` returned true.
        SessionError: waiting would not help: the endpoint is malformed, or a certificate is refused or not admitted.
        BadNameError: the contract does not allow the federation's name.
    """
    keys.name(federation, "federation")
    dial = partial(connect, endpoint, federation, reader=reader, identity=identity)
    limit_s = float("inf") if wait_s is None else wait_s
    start_s, next_say_s = time.monotonic(), 0.0
    link: Session | None = None
    info: messages.Info | None = None
    with ExitStack() as stack:
        while link is None or info is None:
            if stopped():
                raise NoWorldError(f"stopped while waiting for a world on {endpoint}")
            waited_s = time.monotonic() - start_s
            try:
                if link is None:
                    attempt_s = max(0.05, min(ATTEMPT_S, limit_s - waited_s))
                    link = stack.enter_context(dial(wait_s=attempt_s))
                if link.process and link.permissions is None:
                    link.permissions = read_permissions(link)
                info = read_info(link)
                if info is not None and run_id in (None, info.run_id):
                    break
                info = None
                time.sleep(PAUSE_S)
            except NoListenerError:
                pass
            if waited_s >= limit_s:
                reason = _no_answer(link, identity) if link is not None else _no_link(endpoint)
                raise NoWorldError(f"no world of federation {federation!r} on {endpoint} within {wait_s:g} s{reason}")
            if waited_s >= next_say_s:
                next_say_s = max(2 * next_say_s, 1.0)
                say(f"waiting for a world of {federation!r} on {endpoint} ({waited_s:.0f} s)")
        if info.mode == "realtime":
            permissions = link.permissions
            stack.pop_all().close()
            link = stack.enter_context(dial(mode="realtime", wait_s=5.0))
            link.permissions = permissions
        link.use(info.mode)
        yield link, info


def _no_answer(link: Session, identity: Identity | None) -> str:
    """Return why a hub that accepts connections might not answer; hubs of other versions or federations never do."""
    may_be = (
        ", but a process listens there: of another federation, a world that is starting, or a router without a world"
    )
    if identity is None or identity.tls is None or link.permissions is not None:
        return f"{may_be}; correct --federation, or wait longer"
    return (
        f"{may_be}, or it refuses this process or does not admit it; correct --federation, wait longer, "
        "or admit this process with `zsim certs init --operator NAME` and restart the world"
    )


def _no_link(endpoint: str) -> str:
    """Return why no session opened; a port that accepts connections may use TLS or another protocol."""
    hint = "; start one with `zsim world`"
    protocol, _, address = endpoint.partition("/")
    if protocol != "tcp":
        return hint
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_S).close()
    except (OSError, OverflowError, ValueError):
        return hint
    return (
        ", but the process that listens there refused the connection; for a world with TLS, use tls/ and --tls FOLDER"
    )


def read_permissions(link: Session) -> Permissions | None:
    """Return this process's permissions under access control at the other end; None without an answer.

    Raises:
        SessionError: this process is not admitted.
    """
    for sample in link.get(keys.access(link.process), timeout_s=ANSWER_S):
        permissions = messages.decode_as(Permissions, sample.payload, sample.key)
        if refusal := permissions.refusal():
            raise SessionError(refusal)
        return permissions
    return None


def read_info(link: Session) -> messages.Info | None:
    """Return the `world/info` with which the hub answers; None without an answer.

    Raises:
        NoWorldError: the answer cannot be decoded.
    """
    for sample in link.get(keys.INFO, timeout_s=ANSWER_S):
        try:
            return messages.decode(keys.INFO, sample.payload)
        except DecodeError as error:
            raise NoWorldError(f"{error}; does the world run another version of zsim?") from error
    return None
