"""One process's access to a federation: publications, subscriptions, queries, requests, liveliness and links.

Keys are given without the federation's prefix; the session adds and removes it. This is the only file that imports
zenoh.
"""

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import zenoh
import zenoh.ext
from msgspec import Struct

from zsim.contract import keys, messages
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.errors import RequestRefusedError, RunError, SessionError
from zsim.transport import tls, zenoh_settings
from zsim.transport.tls import Act, Identity, Permissions
from zsim.transport.zenoh_settings import SESSION_FILES, Mode, Settings, require_files

QUEUE_MAX = 1_000_000  # messages; a subscription that is not read blocks the whole link once its queue is full


class ReceivedSample(NamedTuple):
    """A received message, not decoded; its key is without the federation's prefix."""

    key: str
    payload: bytes


class FarEnd(NamedTuple):
    """A session at the other end of a link."""

    session: str  # its Zenoh identifier
    is_router: bool  # whether other sessions may be reached through it


class RawSample(NamedTuple):
    """A publication, or a reply to a query, with all of Zenoh's metadata."""

    kind: str  # "PUT" or "DELETE"; "ERROR" for a refusal, which has no key
    key: str  # without the prefix of the session that received it
    payload: bytes  # as sent
    encoding: str  # as Zenoh's text, e.g. "application/msgpack;Imu"
    timestamp: str | None  # Zenoh's timestamp as text; None if no session added one
    attachment: bytes = b""  # sent with the payload; empty if absent


def _raw_sample(sample: zenoh.Sample, prefix: str) -> RawSample:
    """Return a Zenoh sample without the prefix of its key."""
    return RawSample(
        kind="PUT" if sample.kind == zenoh.SampleKind.PUT else "DELETE",
        key=str(sample.key_expr).removeprefix(prefix),
        payload=sample.payload.to_bytes(),
        encoding=str(sample.encoding),
        timestamp=str(sample.timestamp) if sample.timestamp is not None else None,
        attachment=sample.attachment.to_bytes() if sample.attachment is not None else b"",
    )


def check_expression(expression: str) -> None:
    """Raise SessionError if a text is not a key expression."""
    with _key_errors(expression):
        zenoh.KeyExpr(expression)


@contextmanager
def _key_errors(expression: str) -> Iterator[None]:
    """Convert Zenoh's refusal of a key to a SessionError in the contract's terms."""
    try:
        yield
    except zenoh.ZError as error:
        stripped = re.sub("//+", "/", expression.strip("/"))
        allowed = "must be names with / between them, * for any name, ** for any number of them"
        instead = f"must be {stripped}" if stripped not in (expression, "") else allowed
        raise SessionError(f"key is {expression!r} ({_first_sentence(error).split('`: ')[-1]}); {instead}") from error


def _first_sentence(error: BaseException) -> str:
    """Return the first sentence of a Zenoh error without its source location."""
    return str(error).split(" at ", 1)[0].split("\n", 1)[0][:240]


class Subscription:
    """All messages published on one expression, in order of arrival at this session.

    Args:
        raw: Zenoh session.
        prefix: prefix of the federation's keys.
        expression: key expression to receive.
        without: prefixes of keys to exclude; if given, also excludes pictures and this session's own messages.
    """

    def __init__(self, raw: zenoh.Session, prefix: str, expression: str, without: tuple[str, ...] = ()) -> None:
        self._raw = raw
        self._without = without
        self._prefix_length = len(prefix)
        self._key = None if "*" in expression else expression
        self.expression = expression
        self._wake_key = prefix + expression.replace("**", "wake").replace("*", "wake")
        origin = zenoh.Locality.REMOTE if without else zenoh.Locality.ANY
        channel = zenoh.handlers.FifoChannel(QUEUE_MAX)
        self._subscriber = raw.declare_subscriber(prefix + expression, channel, allowed_origin=origin)
        self._handler = self._subscriber.handler

    def receive(self) -> ReceivedSample | None:
        """Wait for one message; return None when woken by `wake`.

        Raises:
            SessionError: the session or this subscription was closed meanwhile.
        """
        try:
            return self._take(self._handler.recv())
        except zenoh.ZError as error:
            raise SessionError(f"the subscription to {self.expression} is closed") from error

    def drain(self) -> Iterator[ReceivedSample]:
        """Yield received messages without waiting."""
        while (raw := self._handler.try_recv()) is not None:
            sample = self._take(raw)
            if sample is not None:
                yield sample

    def wake(self) -> None:
        """Make a waiting `receive` return None; callable from any thread."""
        try:
            self._raw.put(self._wake_key, b"", allowed_destination=zenoh.Locality.SESSION_LOCAL)
        except zenoh.ZError:
            return  # closed: no `receive` is waiting

    def undeclare(self) -> None:
        """Stop receiving; a waiting `receive` raises SessionError."""
        self._subscriber.undeclare()

    def _take(self, raw: zenoh.Sample) -> ReceivedSample | None:
        key = self._key or str(raw.key_expr)[self._prefix_length :]
        if self._without and (key.startswith(self._without) or keys.is_picture(key)):
            return None
        payload = raw.payload.to_bytes()
        return ReceivedSample(key, payload) if payload else None  # empty: a wake or a deletion, never a message


class Query:
    """A query to be answered once.

    Attributes:
        payload, attachment: as sent; empty if absent.
    """

    def __init__(self, raw: zenoh.Query, prefix: str) -> None:
        self._raw: zenoh.Query | None = raw
        self._prefix = prefix
        # queried keys, without the session's prefix
        self.expression = str(raw.key_expr).removeprefix(prefix)
        self.payload = raw.payload.to_bytes() if raw.payload is not None else b""
        self.attachment = raw.attachment.to_bytes() if raw.attachment is not None else b""

    def request(self) -> ControlRequest:
        """Decode the request in its payload; DecodeError if there is no valid one."""
        return messages.decode_as(ControlRequest, self.payload, self.expression)

    def reply(self, key: str, payload: bytes) -> None:
        if self._raw is not None:
            self._raw.reply(self._prefix + key, payload, encoding=zenoh.Encoding(messages.encoding(key)))

    def reply_raw(self, key: str, payload: bytes, attachment: bytes) -> None:
        """Reply with a payload outside the contract, and end the query."""
        if self._raw is not None:
            self._raw.reply(self._prefix + key, payload, attachment=attachment)
        self.end()

    def answer(self, answer: ControlAnswer) -> None:
        if self._raw is not None:
            encoding = zenoh.Encoding("application/msgpack;ControlAnswer")
            self._raw.reply(self._prefix + self.expression, messages.encode(answer), encoding=encoding)
        self.end()

    def end(self) -> None:
        """End the query; Zenoh informs its sender when the last reference is dropped."""
        if self._raw is not None:
            self._raw.drop()
            self._raw = None


class Unanswered(ControlAnswer, frozen=True):
    """The reason for a missing answer, in place of the answer."""


def result_of(answer: ControlAnswer) -> Any:
    """Return the result of a request; RequestRefusedError if it is refused, RunError if no answer came."""
    if answer.ok:
        return answer.result
    raise (RunError if isinstance(answer, Unanswered) else RequestRefusedError)(answer.error)


class Session:
    """A Zenoh session; `open_session` opens and closes it."""

    def __init__(self, raw: zenoh.Session, federation: str, identity: Identity) -> None:
        self._raw = raw
        self.federation = federation  # first part of all keys
        self.host = identity.host  # name of this process's host in its messages
        # the name in its certificate; empty without one
        self.process = tls.own_name(identity) if identity.tls is not None else ""
        self.guarded = identity.access is not None  # whether access control is enforced here
        # what access control at the other end permits this process; None if unknown or without access control
        self.permissions: Permissions | None = None
        self.reads: list[str] = []  # expressions currently subscribed to
        self._prefix = f"{federation}/" if federation else ""
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._cached_publishers: dict[str, zenoh.ext.AdvancedPublisher] = {}
        self._matching: dict[str, bool] = {}
        self._declared: dict[int, Callable[[], Any]] = {}  # functions that undeclare a declaration, by its id
        self._realtime = False

    def use(self, mode: Mode) -> None:
        """Set the treatment of sensor messages on a full link: BLOCK in lockstep, DROP in realtime."""
        self._realtime = mode == "realtime"

    def unprefixed(self) -> "Session":
        """Return the same session with full keys, prefix included, for bridges between federations."""
        session = Session(self._raw, "", Identity(host=self.host))
        self._declared[id(session)] = session.undeclare_all
        return session

    def zid(self) -> str:
        return str(self._raw.info.zid())

    def undeclare_all(self) -> None:
        """Undeclare everything: declarations left when a Zenoh session closes leak file descriptors and memory."""
        for undeclare in list(self._declared.values()):
            with suppress(zenoh.ZError):  # already undeclared, or its session is closed
                undeclare()

    def _keep(self, declared: Any) -> Any:
        self._declared[id(declared)] = declared.undeclare
        return declared

    def _refusal(self, act: Act, expression: str) -> str | None:
        """Return why access control at the other end would drop an action; None if it permits the action."""
        if self.permissions is None:
            return None
        with _key_errors(expression):
            requested = zenoh.KeyExpr(self._prefix + expression)
            if any(zenoh.KeyExpr(each).includes(requested) for each in self.permissions.allowed.get(act, ())):
                return None
        return self.permissions.denial(act, expression, self._prefix)

    def _check(self, act: Act, expression: str) -> None:
        if fault := self._refusal(act, expression):
            raise SessionError(fault)

    # Publishing

    def put(self, key: str, message: Struct) -> None:
        """Publish a message on its key; SessionError if this process's certificate does not permit that."""
        self.put_raw(key, messages.encode(message))

    def put_raw(self, key: str, payload: bytes) -> None:
        """Publish an encoded payload; the encoding follows from the key."""
        publisher = self._publishers.get(key) or self._declare(key)
        publisher.put(payload)

    def put_all(self, encoded: Sequence[tuple[str, bytes]]) -> None:
        for key, payload in encoded:  # `put_raw` inlined: thousands of messages per gate
            publisher = self._publishers.get(key) or self._declare(key)
            publisher.put(payload)

    def _declare(self, key: str) -> zenoh.Publisher:
        self._check("publish", key)
        view = key.startswith("view/") or keys.is_picture(key)
        flow = _flow(view, view or (self._realtime and keys.may_drop(key)))
        with _key_errors(key):
            encoding = zenoh.Encoding(messages.encoding(key))
            publisher = self._raw.declare_publisher(self._prefix + key, encoding=encoding, **flow)
        self._publishers[key] = self._keep(publisher)
        return publisher

    def has_subscribers(self, key: str) -> bool:
        """Return whether one of our keys has subscribers; cached, since querying Zenoh at each gate is too slow."""
        if key in self._matching:
            return self._matching[key]
        publisher = self._publishers.get(key) or self._declare(key)

        def note(status: Any) -> None:
            self._matching[key] = status.matching

        self._matching[key] = False
        self._keep(publisher.declare_matching_listener(zenoh.handlers.Callback(note, indirect=False)))
        status: Any = publisher.matching_status  # a bool in Zenoh's stub, but in fact an object with one
        if status.matching:  # never set to False here: the listener's thread may have noted a subscriber meanwhile
            self._matching[key] = True
        return self._matching[key]

    def put_sample(self, key: str, payload: bytes, encoding: str) -> None:
        """Publish a payload of any encoding without declaring a publisher, for publishing on many keys.

        Raises:
            SessionError: `key` is not a valid key.
        """
        picture = keys.is_picture(key)
        with _key_errors(key):
            self._raw.put(self._prefix + key, payload, encoding=zenoh.Encoding(encoding), **_flow(picture, picture))

    def declare_publisher(self, key: str, encoding: str) -> Callable[[bytes, bytes], None]:
        """Return a function that publishes (payload, attachment) on one key; a full link drops the message.

        Raises:
            SessionError: `key` is not a valid key, or this process's certificate does not permit publishing there.
        """
        self._check("publish", key)
        with _key_errors(key):
            publisher = self._raw.declare_publisher(
                self._prefix + key, encoding=zenoh.Encoding(encoding), congestion_control=zenoh.CongestionControl.DROP
            )
        self._keep(publisher)
        return lambda payload, attachment: publisher.put(payload, attachment=attachment)

    def put_cached(self, key: str, payload: bytes, encoding: str = "", attachment: bytes = b"") -> None:
        """Publish a payload, and keep it for later subscribers that query it, as Zenoh's advanced subscribers do.

        Samples are numbered, since sessions here add no timestamps.

        Raises:
            SessionError: `key` is not a valid key.
        """
        with _key_errors(key):
            if key not in self._cached_publishers:
                publisher = zenoh.ext.declare_advanced_publisher(
                    self._raw,
                    self._prefix + key,
                    encoding=zenoh.Encoding(encoding),
                    cache=zenoh.ext.CacheConfig(1),
                    sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
                    publisher_detection=True,
                )
                self._cached_publishers[key] = self._keep(publisher)
            self._cached_publishers[key].put(payload, attachment=attachment)

    def delete(self, key: str) -> None:
        """Publish that a key no longer has a value; SessionError if the key is invalid."""
        with _key_errors(key):
            self._raw.delete(self._prefix + key)

    # Subscribing

    def subscribe(self, expression: str) -> Subscription:
        """Return a subscription to all messages on an expression, in order.

        Raises:
            SessionError: it is not a key expression, or this process's certificate does not permit reading it.
        """
        self._check("read", expression)
        with _key_errors(expression):
            subscription = self._keep(Subscription(self._raw, self._prefix, expression))
        self.reads.append(expression)
        return subscription

    def subscribe_remote(self, without: tuple[str, ...]) -> Subscription:
        """Return a subscription to all messages of other sessions, except pictures and keys with these prefixes.

        A waiting `receive` cannot be woken.
        """
        self.reads.append("**")
        return self._keep(Subscription(self._raw, self._prefix, "**", without))

    def declare_subscriber(self, expression: str, callback: Callable[[RawSample], None]) -> Callable[[], None]:
        """Call back, on a Zenoh thread, for every message on an expression until the returned function is called.

        Raises:
            SessionError: it is not a key expression, or this process's certificate does not permit reading it.
        """
        self._check("read", expression)
        with _key_errors(expression):
            subscriber = self._raw.declare_subscriber(
                self._prefix + expression, lambda sample: callback(_raw_sample(sample, self._prefix))
            )
        self._keep(subscriber)
        self.reads.append(expression)

        def undeclare() -> None:
            if self._declared.pop(id(subscriber), None) is not None:
                self.reads.remove(expression)
                subscriber.undeclare()

        return undeclare

    # Queries and requests

    def query(
        self, expression: str, parameters: str = "", payload: bytes = b"", encoding: str = "", timeout_s: float = 2.0
    ) -> list[RawSample]:
        """Return all replies to a query, refusals included; SessionError if `expression` is not a key expression."""
        body: dict[str, Any] = {"payload": payload, "encoding": zenoh.Encoding(encoding)} if payload else {}
        with _key_errors(expression):
            selector = zenoh.Selector(self._prefix + expression, parameters)
            replies = self._raw.get(selector, timeout=timeout_s, **body)
        samples = []
        for reply in replies:
            if reply.ok is not None:
                samples.append(_raw_sample(reply.ok, self._prefix))
            elif reply.err is not None:
                samples.append(RawSample("ERROR", "", reply.err.payload.to_bytes(), str(reply.err.encoding), None))
        return samples

    def get(self, expression: str, timeout_s: float = 2.0) -> list[ReceivedSample]:
        """Return the last values of the keys that match an expression."""
        replies = self.query(expression, timeout_s=timeout_s)
        return [ReceivedSample(reply.key, reply.payload) for reply in replies if reply.kind != "ERROR"]

    def get_surely(self, expression: str) -> list[ReceivedSample] | None:
        """Return the last values of the keys that match an expression; None if a process refused or was late."""
        replies = self.query(expression)
        if any(reply.kind == "ERROR" for reply in replies):  # Zenoh's own "Timeout" among them
            return None
        return [ReceivedSample(reply.key, reply.payload) for reply in replies]

    def request(
        self, key: str, op: str, source: str, args: dict[str, Any] | None = None, timeout_s: float = 5.0
    ) -> ControlAnswer:
        """Send a request to `key` and return its answer; `Unanswered` if none comes, or access control forbids it.

        Raises:
            SessionError: `key` is not a valid key, or the arguments cannot be encoded.
            DecodeError: the answer is not a ControlAnswer.
        """
        try:
            payload = messages.encode(ControlRequest(op=op, args=args or {}, source=source))
        except (OverflowError, UnicodeEncodeError) as error:
            allowed = "integers must be 64-bit, and text must be valid UTF-8"
            raise SessionError(f"{key}: {op} cannot be sent ({error}); {allowed}") from error
        if fault := self._refusal("ask", key):
            return Unanswered(ok=False, error=fault)
        start_s = time.monotonic()
        for reply in self.query(key, payload=payload, timeout_s=timeout_s):
            if reply.kind != "ERROR":
                return messages.decode_as(ControlAnswer, reply.payload, key)
        is_timeout = time.monotonic() - start_s >= timeout_s
        cause = f"no answer came within {timeout_s:g} s" if is_timeout else "no process answers there"
        return Unanswered(ok=False, error=f"{key}: {cause}; is the process that serves it running?")

    def declare_queryable(self, expression: str, callback: Callable[[Query], None], complete: bool = False) -> None:
        """Call back for every query, on a Zenoh thread; `complete` means that no other process needs to be queried."""
        queryable = self._raw.declare_queryable(
            self._prefix + expression, lambda query: callback(Query(query, self._prefix)), complete=complete
        )
        self._keep(queryable)

    # Liveliness and links

    def declare_process(self, name: str) -> None:
        """Declare the liveliness token of a process, and a token that assigns this session to it."""
        self.declare_token(keys.session_token(name, self.zid()))
        self.declare_token(keys.token(name))

    def declare_token(self, key: str) -> None:
        """Declare a liveliness token; it disappears with this session."""
        self._keep(self._raw.liveliness().declare_token(self._prefix + key))

    def on_token(self, expression: str, callback: Callable[[str, bool], None]) -> None:
        """Call back with (key, alive) whenever a token appears or disappears, and for each existing one."""

        def forward(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            callback(str(sample.key_expr).removeprefix(self._prefix), alive)

        self._keep(self._raw.liveliness().declare_subscriber(self._prefix + expression, forward, history=True))

    def tokens(self, expression: str, timeout_s: float = 1.0) -> list[str]:
        replies = self._raw.liveliness().get(self._prefix + expression, timeout=timeout_s)
        return [str(r.ok.key_expr).removeprefix(self._prefix) for r in replies if r.ok is not None]

    def on_link(self, callback: Callable[[bool], None]) -> None:
        """Call back with True for each transport to another process, present or new, and with False when one closes."""
        listener = self._raw.info.declare_transport_events_listener(
            lambda event: callback(event.kind == zenoh.SampleKind.PUT), history=True
        )
        self._keep(listener)

    def far_ends(self) -> dict[str, FarEnd]:
        """Return the session at the far end of each link, by its address there, e.g. "192.168.1.2:41000"."""
        routers = {str(each) for each in self._raw.info.routers_zid()}
        return {
            str(link.dst).partition("/")[2]: FarEnd(str(link.zid), str(link.zid) in routers)
            for link in self._raw.info.links()
        }

    def links(self) -> int:
        return len(self._raw.info.peers_zid()) + len(self._raw.info.routers_zid())


@contextmanager
def open_session(
    settings: Settings, federation: str, identity: Identity, explain: Callable[[str], SessionError]
) -> Iterator[Session]:
    """Open a Zenoh session, and close it with all its declarations.

    Args:
        explain: converts Zenoh's error text to the error to raise.

    Raises:
        SessionError: it cannot be opened, or the limit of open files is too low.
    """
    require_files(SESSION_FILES, "a session")
    config = config_of(settings, identity)
    try:
        raw = zenoh.open(config)
    except BaseException as error:
        # a Rust panic, whose class no module exports: out of threads or memory
        if not isinstance(error, zenoh.ZError) and type(error).__name__ != "PanicException":
            raise
        raise explain(_first_sentence(error)) from error
    session = Session(raw, federation, identity)
    try:
        yield session
    finally:
        session.undeclare_all()
        with suppress(zenoh.ZError):  # a stopped process at the far end does not read its remaining messages
            raw.close()


def _flow(view: bool, drop: bool) -> dict[str, Any]:
    """Return the treatment of a key's messages on a full link.

    Views have their own queue: in a shared one, a view forwarded by the hub would wait behind a blocked put.
    """
    return {
        "congestion_control": zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK,
        "priority": zenoh.Priority.DATA_LOW if view else zenoh.Priority.DATA,
    }


def config_of(settings: Settings, identity: Identity) -> zenoh.Config:
    """Return the configuration of a session; SessionError if Zenoh refuses a setting."""
    config = zenoh.Config()
    for path, value in settings.items():
        try:
            config.insert_json5(path, value)
        except zenoh.ZError as error:
            raise SessionError(zenoh_settings.refusal(path, value, identity)) from error
    return config
