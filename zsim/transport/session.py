"""The only file that touches Zenoh: endpoints, settings, subscriptions, requests, liveliness.

Settings and their reasons are in docs/decisions/0002-zenoh-settings.md. Keys are given without the
federation's prefix; the session adds and removes it.
"""

import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, NamedTuple

os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1))")
os.environ.setdefault("RUST_LOG", "error")

import zenoh
import zenoh.ext
from msgspec import Struct

from zsim.contract import keys, messages
from zsim.contract.messages import ControlAnswer, ControlRequest
from zsim.errors import SessionError
from zsim.transport import tls, zenoh_settings
from zsim.transport.tls import Identity
from zsim.transport.zenoh_settings import Mode, Settings

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
QUEUE = 1_000_000  # messages; an unread queue that is full blocks the whole link


class Sample(NamedTuple):
    """One message off the wire, not decoded."""

    key: str
    payload: bytes


class Heard(NamedTuple):
    """A publication, or an answer to a get, as it stands on the wire.

    Attributes:
        kind: "PUT" or "DELETE"; "ERROR" for an answer that refuses, which has no key.
        key: without the prefix of the session that heard it.
        payload: as sent.
        encoding: Zenoh's text of it, e.g. "application/msgpack;Imu".
        timestamp: of Zenoh, as text; None where nobody stamped it.
        attachment: what was sent beside the payload; empty where nothing was.
    """

    kind: str
    key: str
    payload: bytes
    encoding: str
    timestamp: str | None
    attachment: bytes = b""


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
        self._prefix = f"{federation}/" if federation else ""
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._keepers: dict[str, zenoh.ext.AdvancedPublisher] = {}
        self._kept: list[Any] = []
        self._hearing: dict[int, Any] = {}
        self._boxes: list[Mailbox] = []
        self._bare: list[Session] = []
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

    def has_readers(self, key: str) -> bool:
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
        view = key.startswith("view/")
        drop = view or (self._realtime and keys.may_drop(key))
        control = zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK
        # A queue of its own: in one with others, a view that the hub passes on would wait behind a put that blocks.
        priority = zenoh.Priority.DATA_LOW if view else zenoh.Priority.DATA
        encoding = zenoh.Encoding(messages.encoding(key))
        with _named(key):
            publisher = self._raw.declare_publisher(
                self._prefix + key, encoding=encoding, congestion_control=control, priority=priority
            )
        self._publishers[key] = publisher
        return publisher

    def subscribe(self, expression: str) -> "Mailbox":
        """Return a mailbox that takes everything that others publish on an expression, in order.

        Raises:
            SessionError: it is no key expression.
        """
        with _named(expression):
            return self._kept_box(Mailbox(self._raw, self._prefix, expression))

    def subscribe_others(self, without: tuple[str, ...]) -> "Mailbox":
        """Return a mailbox that takes everything that other sessions publish, but on keys that begin so.

        Nothing wakes who waits for it.
        """
        return self._kept_box(Mailbox(self._raw, self._prefix, "**", without))

    def _kept_box(self, box: "Mailbox") -> "Mailbox":
        self._boxes.append(box)
        return box

    def on_message(self, expression: str, callback: Callable[[Sample], None]) -> None:
        """Call back, in a thread of Zenoh's, for the rare messages on an expression."""
        subscriber = self._raw.declare_subscriber(
            self._prefix + expression, lambda sample: callback(_sample(sample, self._prefix))
        )
        self._kept.append(subscriber)

    def hear(self, expression: str, callback: Callable[[Heard], None]) -> Callable[[], None]:
        """Call back, in a thread of Zenoh's, for everything on an expression until the returned function is called.

        Raises:
            SessionError: it is no key expression.
        """
        with _named(expression):
            subscriber = self._raw.declare_subscriber(
                self._prefix + expression, lambda sample: callback(_heard(sample, self._prefix))
            )
        self._hearing[id(subscriber)] = subscriber

        def stop() -> None:
            if self._hearing.pop(id(subscriber), None) is not None:
                subscriber.undeclare()

        return stop

    def bare(self) -> "Session":
        """Return the same session by whole keys, the federation's name included: for who passes on others' keys."""
        session = Session(self._raw, "", Identity(host=self.host))
        self._bare.append(session)
        return session

    def release(self) -> None:
        """Undeclare everything: what is declared when a Zenoh session closes keeps files and memory of it for ever."""
        hearing, self._hearing = self._hearing, {}
        declared = [*self._publishers.values(), *self._keepers.values(), *self._kept, *hearing.values()]
        for each in declared:
            with suppress(zenoh.ZError):  # undeclared already, or its session is gone
                each.undeclare()
        for box in self._boxes:
            with suppress(zenoh.ZError):
                box.close()
        for session in self._bare:
            session.release()

    def zid(self) -> str:
        """Return Zenoh's name of this session: hexadecimal digits."""
        return str(self._raw.info.zid())

    def put_as(self, key: str, payload: bytes, encoding: str = "", attachment: bytes = b"", drop: bool = False) -> None:
        """Publish a payload of any encoding on any of many keys, without keeping anything for the next time.

        Args:
            key, payload, encoding: of the publication.
            attachment: what goes beside the payload.
            drop: whether a full link loses it rather than waits.

        Raises:
            SessionError: it is no key.
        """
        beside: dict[str, Any] = {"attachment": attachment} if attachment else {}
        control = zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK
        with _named(key):
            self._raw.put(
                self._prefix + key, payload, encoding=zenoh.Encoding(encoding), congestion_control=control, **beside
            )

    def writer(self, key: str, encoding: str) -> Callable[[bytes, bytes], None]:
        """Return what publishes (payload, attachment) on one key, again and again; a full link loses it.

        Raises:
            SessionError: it is no key.
        """
        with _named(key):
            publisher = self._raw.declare_publisher(
                self._prefix + key,
                encoding=zenoh.Encoding(encoding),
                congestion_control=zenoh.CongestionControl.DROP,
            )
        self._kept.append(publisher)
        return lambda payload, attachment: publisher.put(payload, attachment=attachment)

    def put_kept(self, key: str, payload: bytes, encoding: str = "", attachment: bytes = b"") -> None:
        """Publish a payload for those too who subscribe later, as far as they ask (Zenoh's advanced subscribers do).

        Raises:
            SessionError: it is no key.
        """
        with _named(key):
            publisher = self._keepers.get(key) or self._declare_keeper(key, encoding)
            publisher.put(payload, attachment=attachment)

    def _declare_keeper(self, key: str, encoding: str) -> zenoh.ext.AdvancedPublisher:
        """Return a publisher that keeps its last sample; it numbers them, since no session here stamps times."""
        publisher = self._keepers[key] = zenoh.ext.declare_advanced_publisher(
            self._raw,
            self._prefix + key,
            encoding=zenoh.Encoding(encoding),
            cache=zenoh.ext.CacheConfig(1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            publisher_detection=True,
        )
        return publisher

    def delete(self, key: str) -> None:
        """Publish that a key has no value any more.

        Raises:
            SessionError: it is no key.
        """
        with _named(key):
            self._raw.delete(self._prefix + key)

    def inquire(
        self, expression: str, parameters: str = "", payload: bytes = b"", encoding: str = "", timeout_s: float = 2.0
    ) -> list[Heard]:
        """Return everything that is answered to a get, refusals too.

        Raises:
            SessionError: it is no key expression.
        """
        asked: dict[str, Any] = {"payload": payload, "encoding": zenoh.Encoding(encoding)} if payload else {}
        with _named(expression):
            selector = zenoh.Selector(self._prefix + expression, parameters)
            replies = self._raw.get(selector, timeout=timeout_s, **asked)
        return [_answered(reply, self._prefix) for reply in replies]

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
            SessionError: it is no key, or something among the arguments fits into no message.
        """
        try:
            payload = messages.encode(ControlRequest(op=op, args=args or {}, source=source))
        except (OverflowError, UnicodeEncodeError) as error:
            allowed = "must hold whole numbers of 64 bits, and text in UTF-8"
            raise SessionError(f"{key}: {op} cannot be sent ({error}); {allowed}") from error
        start_s = time.monotonic()
        with _named(key):
            replies = self._raw.get(self._prefix + key, payload=payload, timeout=timeout_s)
        for reply in replies:
            if reply.ok is not None:
                return messages.decode_as(ControlAnswer, reply.ok.payload.to_bytes(), key)
        late = time.monotonic() - start_s >= timeout_s
        what = f"no answer came within {timeout_s:g} s" if late else "nobody answers there"
        return ControlAnswer(ok=False, error=f"{key}: {what}; is it running?")

    def answer(self, expression: str, callback: Callable[["Query"], None], complete: bool = False) -> None:
        """Call back, in a thread of Zenoh's, for every get on an expression.

        Args:
            expression: what is answered on.
            callback: takes each get.
            complete: whether nobody else need be asked about it.
        """
        queryable = self._raw.declare_queryable(
            self._prefix + expression, lambda query: callback(Query(query, self._prefix)), complete=complete
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
        self.attachment = raw.attachment.to_bytes() if raw.attachment is not None else b""

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

    def reply_as(self, key: str, payload: bytes, attachment: bytes) -> None:
        """Reply with a payload that is no message of the contract, and end the query."""
        if self._raw is not None:
            self._raw.reply(self._prefix + key, payload, attachment=attachment)
        self.end()

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
    """Everything that others publish on one expression, in the order of its arrival on this session.

    Args:
        raw: the session.
        prefix: of its keys.
        expression: what to take.
        without: beginnings of keys to leave out; then what this session itself publishes is left out too.
    """

    def __init__(self, raw: zenoh.Session, prefix: str, expression: str, without: tuple[str, ...] = ()) -> None:
        self._raw = raw
        self._without = without
        self._prefix = prefix
        self._cut = len(prefix)
        self._key = None if "*" in expression else expression
        self.expression = expression
        self._wake_key = prefix + expression.replace("**", "wake").replace("*", "wake")
        origin = zenoh.Locality.REMOTE if without else zenoh.Locality.ANY
        self._handler_owner = raw.declare_subscriber(
            prefix + expression, zenoh.handlers.FifoChannel(QUEUE), allowed_origin=origin
        )
        self._handler = self._handler_owner.handler

    def receive(self) -> Sample | None:
        """Wait for one message; None when woken by `wake`.

        Raises:
            SessionError: the session, or the mailbox, was closed meanwhile.
        """
        try:
            return self._take(self._handler.recv())
        except zenoh.ZError as error:
            raise SessionError(f"{self.expression}: is closed") from error

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

    def close(self) -> None:
        """Take no more; a waiting `receive` raises SessionError."""
        self._handler_owner.undeclare()

    def _take(self, raw: zenoh.Sample) -> Sample | None:
        key = self._key or str(raw.key_expr)[self._cut :]
        if self._without and key.startswith(self._without):
            return None
        payload = raw.payload.to_bytes()
        return Sample(key, payload) if payload else None  # empty: a wake, or a deletion; no message is


def _heard(raw: zenoh.Sample, prefix: str) -> Heard:
    kind = "PUT" if raw.kind == zenoh.SampleKind.PUT else "DELETE"
    stamp = str(raw.timestamp) if raw.timestamp is not None else None
    beside = raw.attachment.to_bytes() if raw.attachment is not None else b""
    return Heard(kind, str(raw.key_expr).removeprefix(prefix), raw.payload.to_bytes(), str(raw.encoding), stamp, beside)


def _answered(reply: zenoh.Reply, prefix: str) -> Heard:
    if reply.ok is not None:
        return _heard(reply.ok, prefix)
    assert reply.err is not None
    return Heard("ERROR", "", reply.err.payload.to_bytes(), str(reply.err.encoding), None)


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
    with _listening("router", endpoints, federation, mode, identity or Identity(), zenoh_settings.hub()) as session:
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
    above = zenoh_settings.upstream(upstream, identity)
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
    chosen = zenoh_settings.common("client", mode, reader) | zenoh_settings.connecting(
        endpoint, identity, wait_s or 0.5
    )
    with _opened(chosen, federation, identity, partial(tls.no_link, identity, endpoint)) as session:
        yield session


def check_expression(expression: str) -> None:
    """Refuse what is no key expression.

    Raises:
        SessionError: with what was found and what is allowed.
    """
    with _named(expression):
        zenoh.KeyExpr(expression)


def check_listening(endpoints: Sequence[str], identity: Identity | None = None) -> None:
    """Refuse endpoints on which nobody can listen, without listening.

    Raises:
        SessionError: one is malformed, or identity and endpoints do not go together.
    """
    if any(endpoint.endswith(":0") for endpoint in endpoints):
        raise SessionError(f"cannot listen on {', '.join(endpoints)}: port 0 is no port that others could be told")
    identity = identity or Identity()
    _config(zenoh_settings.listening(endpoints, identity), identity)


@contextmanager
def _listening(
    mode: str, endpoints: Sequence[str], federation: str, timing: Mode, identity: Identity, others: Settings
) -> Iterator[Session]:
    shown = ", ".join(endpoints)
    check_listening(endpoints, identity)
    chosen = zenoh_settings.common(mode, timing) | zenoh_settings.listening(endpoints, identity) | others
    with _opened(chosen, federation, identity, lambda error: f"cannot listen on {shown} ({error})") as session:
        yield session


@contextmanager
def _opened(chosen: Settings, federation: str, identity: Identity, explain: Callable[[str], str]) -> Iterator[Session]:
    config = _config(chosen, identity)
    try:
        raw = zenoh.open(config)
    except zenoh.ZError as error:
        raise SessionError(explain(_brief(error))) from error
    session = Session(raw, federation, identity)
    try:
        yield session
    finally:
        session.release()
        raw.close()


def _config(chosen: Settings, identity: Identity) -> zenoh.Config:
    config = zenoh.Config()
    for path, value in chosen.items():
        try:
            config.insert_json5(path, value)
        except zenoh.ZError as error:
            raise SessionError(zenoh_settings.refusal(path, value, identity)) from error
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
