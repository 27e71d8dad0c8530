"""The only file that touches Zenoh: endpoints, settings, subscriptions, requests, liveliness.

Settings and their reasons are in docs/decisions/0002-zenoh-settings.md. Keys are given without the
federation's prefix; the session adds and removes it.
"""

import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1))")
os.environ.setdefault("RUST_LOG", "error")

import zenoh
from msgspec import Struct

from zsim import batch, messages, settings, tls
from zsim.errors import SessionError
from zsim.identity import Identity
from zsim.messages import ControlAnswer, ControlRequest
from zsim.settings import Mode, Settings

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
QUEUE = 1_000_000  # messages; an unread queue that is full blocks the whole link


class Sample(NamedTuple):
    """One message off the wire, not decoded."""

    key: str
    payload: bytes


class Session:
    """One process's access to a federation.

    Attributes:
        federation: prefix of all keys.
        host: the name of this process's host, as its messages give it.
        guarded: whether access control decides here who may do what.
    """

    def __init__(self, raw: zenoh.Session, federation: str, identity: Identity) -> None:
        self._raw = raw
        self.federation = federation
        self.host = identity.host
        self.guarded = identity.access is not None
        self._prefix = f"{federation}/"
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._kept: list[Any] = []
        self._heard: dict[str, bool] = {}
        self._realtime = False

    def use(self, mode: Mode) -> None:
        """Choose what a full link does to sensors: BLOCK in lockstep, DROP in realtime."""
        self._realtime = mode == "realtime"

    def put(self, key: str, message: Struct) -> None:
        """Publish a message on its key."""
        self.put_raw(key, messages.encode(message))

    def put_all(self, encoded: Sequence[tuple[str, bytes]]) -> None:
        """Publish many encoded payloads in one go."""
        for key, payload in encoded:
            publisher = self._publishers.get(key) or self._declare(key)
            publisher.put(payload)

    def heard(self, key: str) -> bool:
        """Tell whether anybody subscribes to a key of ours."""
        if key not in self._heard:
            self._listen_for_readers(key)
        return self._heard[key]

    def _listen_for_readers(self, key: str) -> None:
        """Keep up to date whether a key is subscribed to: asked at each gate, Zenoh takes long for it."""
        publisher = self._publishers.get(key) or self._declare(key)

        def note(status: Any) -> None:
            self._heard[key] = status.matching

        handler = zenoh.handlers.Callback(note, indirect=False)
        self._kept.append(publisher.declare_matching_listener(handler))
        status: Any = publisher.matching_status  # the stub says bool; it is an object that has one
        self._heard[key] = status.matching

    def put_raw(self, key: str, payload: bytes) -> None:
        """Publish an encoded payload; the encoding follows from the key."""
        publisher = self._publishers.get(key) or self._declare(key)
        publisher.put(payload)

    def _declare(self, key: str) -> zenoh.Publisher:
        drop = key.startswith("view/") or (self._realtime and ("/sensor/" in key or key.startswith(batch.GATE)))
        control = zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK
        encoding = zenoh.Encoding(messages.encoding(key))
        with _named(key):
            publisher = self._raw.declare_publisher(self._prefix + key, encoding=encoding, congestion_control=control)
        self._publishers[key] = publisher
        return publisher

    def subscribe(self, expression: str) -> "Mailbox":
        """Return a mailbox that takes everything that others publish on an expression, in order.

        Raises:
            SessionError: it is no key expression.
        """
        with _named(expression):
            return Mailbox(self._raw, self._prefix, expression)

    def on_message(self, expression: str, callback: Callable[[Sample], None]) -> None:
        """Call back, in a thread of Zenoh's, for the rare messages on an expression."""
        subscriber = self._raw.declare_subscriber(
            self._prefix + expression, lambda sample: callback(_sample(sample, self._prefix))
        )
        self._kept.append(subscriber)

    def declare_token(self, key: str) -> None:
        """Show that this process lives; the token goes with it."""
        self._kept.append(self._raw.liveliness().declare_token(self._prefix + key))

    def on_token(self, expression: str, callback: Callable[[str, bool], None]) -> None:
        """Call back with (key, alive) whenever a token appears or goes, and for those that are there."""

        def forward(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            callback(str(sample.key_expr).removeprefix(self._prefix), alive)

        subscriber = self._raw.liveliness().declare_subscriber(self._prefix + expression, forward, history=True)
        self._kept.append(subscriber)

    def tokens(self, expression: str, timeout_s: float = 1.0) -> list[str]:
        """Return the keys of the tokens that are there now."""
        replies = self._raw.liveliness().get(self._prefix + expression, timeout=timeout_s)
        return [str(r.ok.key_expr).removeprefix(self._prefix) for r in replies if r.ok is not None]

    def get(self, expression: str, timeout_s: float = 2.0) -> list[Sample]:
        """Return the last values that are answered on an expression.

        Raises:
            SessionError: it is no key expression.
        """
        with _named(expression):
            replies = self._raw.get(self._prefix + expression, timeout=timeout_s)
        return [_sample(reply.ok, self._prefix) for reply in replies if reply.ok is not None]

    def request(
        self, key: str, op: str, source: str, args: dict[str, Any] | None = None, timeout_s: float = 5.0
    ) -> ControlAnswer:
        """Ask `key` to do something; an answer that never comes is an answer that says so.

        Raises:
            SessionError: it is no key.
        """
        payload = messages.encode(ControlRequest(op=op, args=args or {}, source=source))
        start_s = time.monotonic()
        with _named(key):
            replies = self._raw.get(self._prefix + key, payload=payload, timeout=timeout_s)
        for reply in replies:
            if reply.ok is not None:
                return messages.decode_as(ControlAnswer, reply.ok.payload.to_bytes(), key)
        late = time.monotonic() - start_s >= timeout_s
        what = f"no answer came within {timeout_s:g} s" if late else "nobody answers there"
        return ControlAnswer(ok=False, error=f"{key}: {what}; is it running?")

    def answer(self, expression: str, callback: Callable[["Query"], None]) -> None:
        """Call back, in a thread of Zenoh's, for every get on an expression."""
        queryable = self._raw.declare_queryable(
            self._prefix + expression, lambda query: callback(Query(query, self._prefix))
        )
        self._kept.append(queryable)

    def on_link(self, callback: Callable[[bool], None]) -> None:
        """Call back with True when a transport to another process opens and False when one closes."""

        def forward(event: zenoh.TransportEvent) -> None:
            callback(event.kind == zenoh.SampleKind.PUT)

        self._kept.append(self._raw.info.declare_transport_events_listener(forward, history=True))

    def links(self) -> int:
        """Return how many other processes this one has a transport to."""
        return len(self._raw.info.peers_zid()) + len(self._raw.info.routers_zid())


class Query:
    """A request to be answered once."""

    def __init__(self, raw: zenoh.Query, prefix: str) -> None:
        self._raw: zenoh.Query | None = raw
        self._prefix = prefix
        self.expression = str(raw.key_expr).removeprefix(prefix)
        self.payload = raw.payload.to_bytes() if raw.payload is not None else b""

    def request(self) -> ControlRequest:
        """Return the request in it; DecodeError if it is none."""
        return messages.decode_as(ControlRequest, self.payload, self.expression)

    def takes(self, key: str) -> bool:
        """Tell whether the query's expression takes a key."""
        return zenoh.KeyExpr(self.expression).intersects(zenoh.KeyExpr(key))

    def reply(self, key: str, payload: bytes) -> None:
        """Add one reply."""
        if self._raw is not None:
            self._raw.reply(self._prefix + key, payload, encoding=zenoh.Encoding(messages.encoding(key)))

    def answer(self, answer: ControlAnswer) -> None:
        """Reply to a request and end it."""
        if self._raw is not None:
            encoding = zenoh.Encoding("application/msgpack;ControlAnswer")
            self._raw.reply(self._prefix + self.expression, messages.encode(answer), encoding=encoding)
        self.end()

    def end(self) -> None:
        """End the query; Zenoh tells the asker when the last reference goes."""
        if self._raw is not None:
            self._raw.drop()
            self._raw = None


class Mailbox:
    """Everything that others publish on one expression, in the order of its arrival on this session."""

    def __init__(self, raw: zenoh.Session, prefix: str, expression: str) -> None:
        self._raw = raw
        self._prefix = prefix
        self._cut = len(prefix)
        self._key = None if "*" in expression else expression
        self.expression = expression
        self._wake_key = prefix + expression.replace("**", "wake").replace("*", "wake")
        self._handler_owner = raw.declare_subscriber(prefix + expression, zenoh.handlers.FifoChannel(QUEUE))
        self._handler = self._handler_owner.handler

    def receive(self) -> Sample | None:
        """Wait for one message; None when woken by `wake`.

        Raises:
            SessionError: the session was closed meanwhile.
        """
        try:
            return self._take(self._handler.recv())
        except zenoh.ZError as error:
            raise SessionError(f"{self.expression}: the session is closed") from error

    def drain(self) -> Iterator[Sample]:
        """Yield what has arrived, without waiting."""
        while (raw := self._handler.try_recv()) is not None:
            sample = self._take(raw)
            if sample is not None:
                yield sample

    def wake(self) -> None:
        """Let a waiting `receive` return None; callable from any thread."""
        try:
            self._raw.put(self._wake_key, b"", allowed_destination=zenoh.Locality.SESSION_LOCAL)
        except zenoh.ZError:
            return  # closed: nobody waits any more

    def _take(self, raw: zenoh.Sample) -> Sample | None:
        payload = raw.payload.to_bytes()
        if not payload:  # a wake, or a deletion; no message of the contract is empty
            return None
        return Sample(self._key or str(raw.key_expr)[self._cut :], payload)


def _sample(raw: zenoh.Sample, prefix: str) -> Sample:
    return Sample(str(raw.key_expr).removeprefix(prefix), raw.payload.to_bytes())


@contextmanager
def listen(
    endpoints: Sequence[str], federation: str, mode: Mode, identity: Identity | None = None
) -> Iterator[Session]:
    """Open the hub: a router that listens, to which every other role is a client.

    A peer would do for clients, but carries nothing between two routers that both connect to it.

    Raises:
        SessionError: an endpoint is taken or malformed, or the identity is of no use.
    """
    with _listening("router", endpoints, federation, mode, identity or Identity(), settings.hub()) as session:
        session.use(mode)
        yield session


@contextmanager
def route(
    endpoint: str, upstream: str, federation: str, mode: Mode = "lockstep", identity: Identity | None = None
) -> Iterator[Session]:
    """Open a router: it listens on an endpoint, and tries for ever to reach the world, or another router, upstream.

    Raises:
        SessionError: an endpoint is taken or malformed, or the identity is of no use.
    """
    identity = identity or Identity()
    above = settings.upstream(upstream, identity)
    with _listening("router", [endpoint], federation, mode, identity, above) as session:
        yield session


@contextmanager
def connect(
    endpoint: str,
    federation: str,
    mode: Mode = "lockstep",
    wait_s: float | None = None,
    reader: bool = False,
    identity: Identity | None = None,
) -> Iterator[Session]:
    """Open a client of the hub (or of a router).

    Args:
        endpoint: e.g. "tcp/192.168.1.2:7447".
        federation: prefix of all keys.
        mode: of the run, where it is known already.
        wait_s: how long to try; None tries once.
        reader: it does not gate; in lockstep too, a silence of LEASE_READER_MS is its death.
        identity: host and certificate; without, this host's name and no TLS.

    Raises:
        SessionError: nobody listens there within `wait_s`, or a certificate, here or there, is refused.
    """
    identity = identity or Identity()
    chosen = settings.common("client", mode, reader) | settings.connecting(endpoint, identity, wait_s or 0.5)
    with _opened(chosen, federation, identity, partial(tls.no_link, identity, endpoint)) as session:
        yield session


def check_listening(endpoints: Sequence[str], identity: Identity | None = None) -> None:
    """Refuse endpoints on which nobody can listen, without listening.

    Raises:
        SessionError: one is malformed, or identity and endpoints do not go together.
    """
    if any(endpoint.endswith(":0") for endpoint in endpoints):
        raise SessionError(f"cannot listen on {', '.join(endpoints)}: port 0 is no port that others could be told")
    identity = identity or Identity()
    _config(settings.listening(endpoints, identity), identity)


@contextmanager
def _listening(
    mode: str, endpoints: Sequence[str], federation: str, timing: Mode, identity: Identity, others: Settings
) -> Iterator[Session]:
    shown = ", ".join(endpoints)
    check_listening(endpoints, identity)
    chosen = settings.common(mode, timing) | settings.listening(endpoints, identity) | others
    with _opened(chosen, federation, identity, lambda error: f"cannot listen on {shown} ({error})") as session:
        yield session


@contextmanager
def _opened(chosen: Settings, federation: str, identity: Identity, explain: Callable[[str], str]) -> Iterator[Session]:
    config = _config(chosen, identity)
    try:
        raw = zenoh.open(config)
    except zenoh.ZError as error:
        raise SessionError(explain(_brief(error))) from error
    try:
        yield Session(raw, federation, identity)
    finally:
        raw.close()


def _config(chosen: Settings, identity: Identity) -> zenoh.Config:
    config = zenoh.Config()
    for path, value in chosen.items():
        try:
            config.insert_json5(path, value)
        except zenoh.ZError as error:
            raise SessionError(settings.refusal(path, value, identity)) from error
    return config


@contextmanager
def _named(expression: str) -> Iterator[None]:
    """Refuse a key that Zenoh refuses in words of the contract's."""
    try:
        yield
    except zenoh.ZError as error:
        bare = re.sub("//+", "/", expression.strip("/"))
        allowed = "must be names with / between them, * for any name, ** for any number of them"
        instead = f"must be {bare}, without / at its ends" if bare not in (expression, "") else allowed
        raise SessionError(f"key is {expression!r} ({_brief(error).split('`: ')[-1]}); {instead}") from error


def _brief(error: Exception) -> str:
    """Return the first sentence of a Zenoh error without its source location."""
    return str(error).split(" at ", 1)[0].split("\n", 1)[0][:160]
