"""A session without Zenoh: a test fills its subscriptions and answers its requests; its publications are kept."""

import queue
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from msgspec import Struct

from zsim.contract import keys, messages
from zsim.contract.run_messages import ControlAnswer, ControlRequest, Event, Join
from zsim.transport.session import FarEnd, RawSample, ReceivedSample, Unanswered

PATIENCE_S = 120.0  # wall time after which a wait for a sample fails
UNANSWERED = Unanswered(False, "nobody answered")
BAD_UTF8 = b"\x83\xa4t_ns\x00\xa3seq\x00\xa6source\xa1\xff"
NESTED = b"\x83\xa4t_ns\x00\xa3seq\x00\xa1x" + b"\x91" * 5000 + b"\xc0"
"""A map with t_ns, seq and an unknown field, which holds 5000 nested lists."""


class FakeSubscription:
    def __init__(self, expression: str, without: tuple[str, ...] = ()) -> None:
        self.expression = expression
        self._without = without
        self._arrived: queue.SimpleQueue[ReceivedSample | None] = queue.SimpleQueue()

    def put(self, sample: ReceivedSample | None) -> None:
        is_left_out = sample and self._without and (sample.key.startswith(self._without) or keys.is_picture(sample.key))
        if not is_left_out:
            self._arrived.put(sample)

    def receive(self) -> ReceivedSample | None:
        return self._arrived.get(timeout=PATIENCE_S)

    def drain(self) -> Iterator[ReceivedSample]:
        while not self._arrived.empty():
            sample = self._arrived.get()
            if sample is not None:
                yield sample

    def wake(self) -> None:
        self._arrived.put(None)


class FakeQuery:
    """A request to a queryable, with the answer once it has been given."""

    def __init__(self, expression: str, payload: bytes) -> None:
        self.expression, self.payload = expression, payload
        self.answered: ControlAnswer | None = None

    def request(self) -> ControlRequest:
        return messages.decode_as(ControlRequest, self.payload, self.expression)

    def answer(self, answer: ControlAnswer) -> None:
        self.answered = answer


class FakeLink:
    """A session without Zenoh.

    Attributes:
        published: (key, payload) of each message published.
        on_publish: called with key and payload when a message is published; a test may answer for other processes here.
        on_request: returns the answer to a request, given its key and arguments.
        requests: (key, arguments) of each request.
        last: last values, by key, with which gets are answered.
        reads: stays empty; a session lists the expressions it subscribes to here.
        admits: whether an event `join` answers each join.
        ends: the session at the far end of each link, by its address.
    """

    host = "laptop"
    federation = "zsim"
    guarded = False

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes]] = []
        self.on_publish: Callable[[str, bytes], None] = lambda key, payload: None
        self.on_request: Callable[[str, dict[str, Any]], ControlAnswer] = lambda key, args: UNANSWERED
        self.requests: list[tuple[str, dict[str, Any]]] = []
        self.last: dict[str, bytes] = {}
        self.reads: list[str] = []
        self.admits = True
        self.ends: dict[str, FarEnd] = {}
        self._subscriptions: list[FakeSubscription] = []
        self._early: list[ReceivedSample] = []
        self._callbacks: list[tuple[str, Callable[[RawSample], None]]] = []
        self._on_link: Callable[[bool], None] = lambda up: None
        self._on_tokens: list[tuple[str, Callable[[str, bool], None]]] = []
        self._on_queries: dict[str, Callable[[Any], None]] = {}

    # For tests

    def ask(self, key: str, payload: bytes) -> "FakeQuery":
        """Send a request to the queryable on a key; return the query, which will hold the answer."""
        query = FakeQuery(key, payload)
        self._on_queries[key](query)
        return query

    def deliver(self, key: str, message: Struct | bytes) -> None:
        """Deliver a message to subscribers, including those that subscribe later."""
        sample = ReceivedSample(key, message if isinstance(message, bytes) else messages.encode(message))
        self._early.append(sample)
        for subscription in self._subscriptions:
            if keys.matches(subscription.expression, key):
                subscription.put(sample)
        for expression, callback in self._callbacks:
            if keys.matches(expression, key):
                callback(RawSample("PUT", sample.key, sample.payload, "", None))

    def cut(self, up: bool) -> None:
        """Establish the link (True) or cut it."""
        self._on_link(up)

    def show(self, key: str, alive: bool = True) -> None:
        """Let a liveliness token appear or disappear."""
        for expression, callback in self._on_tokens:
            if keys.matches(expression, key):
                callback(key, alive)

    def _admit(self, name: str, join: Join) -> None:
        data = {"incarnation": join.incarnation, "host": join.host, "pid": join.pid, "from_ns": 0, "done_ns": -1}
        event = messages.encode(Event(0, 0, "join", "world", name, "", data))
        for expression, callback in self._callbacks:
            if keys.matches(expression, keys.EVENT):
                callback(RawSample("PUT", keys.EVENT, event, "", None))

    def published_on(self, expression: str) -> list[Any]:
        """Return the messages published on keys that match an expression."""
        return [messages.decode(key, payload) for key, payload in self.published if keys.matches(expression, key)]

    # Interface of a session

    def subscribe(self, expression: str, without: tuple[str, ...] = ()) -> FakeSubscription:
        subscription = FakeSubscription(expression, without)
        self._subscriptions.append(subscription)
        for sample in self._early:
            if keys.matches(expression, sample.key):
                subscription.put(sample)
        return subscription

    def subscribe_remote(self, without: tuple[str, ...]) -> FakeSubscription:
        return self.subscribe("**", without)

    def declare_subscriber(self, expression: str, callback: Callable[[RawSample], None]) -> Callable[[], None]:
        self._callbacks.append((expression, callback))
        return lambda: self._callbacks.remove((expression, callback))

    def put(self, key: str, message: Struct) -> None:
        self.put_raw(key, messages.encode(message))

    def put_raw(self, key: str, payload: bytes) -> None:
        self.published.append((key, payload))
        self.on_publish(key, payload)
        if self.admits and key.endswith("/join"):
            self._admit(keys.thing(key), messages.decode(key, payload))

    def put_all(self, encoded: Sequence[tuple[str, bytes]]) -> None:
        for key, payload in encoded:
            self.put_raw(key, payload)

    def request(
        self, key: str, op: str, source: str, args: dict[str, Any] | None = None, timeout_s: float = 5.0
    ) -> ControlAnswer:
        self.requests.append((key, args or {}))
        return self.on_request(key, args or {})

    def get(self, expression: str, timeout_s: float = 2.0) -> list[ReceivedSample]:
        return [ReceivedSample(key, payload) for key, payload in self.last.items() if keys.matches(expression, key)]

    def get_surely(self, expression: str) -> list[ReceivedSample] | None:
        return self.get(expression)

    def far_ends(self) -> dict[str, FarEnd]:
        return dict(self.ends)

    def has_subscribers(self, key: str) -> bool:
        return True

    def tokens(self, expression: str, timeout_s: float = 1.0) -> list[str]:
        return []

    def on_link(self, callback: Callable[[bool], None]) -> None:
        self._on_link = callback

    def on_token(self, expression: str, callback: Callable[[str, bool], None]) -> None:
        self._on_tokens.append((expression, callback))

    def declare_queryable(self, expression: str, callback: Callable[[Any], None]) -> None:
        self._on_queries[expression] = callback

    def declare_process(self, name: str) -> None:
        return
