"""What is published in a run, for clients: the last value of every key, and subscriptions that they share."""

import asyncio
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages
from zsim.errors import SessionError
from zsim.transport.session import RawSample, Session, check_expression
from zsim_bridges.gateway.access_check import ConnectionLimit
from zsim_bridges.gateway.client_messages import TooManyError

ECHOES_MAX = 256  # of a key; a paused world returns none, and clients may go on
DELETED = None
OWN_BYTES_MAX = 64_000_000  # of the values on clients' own keys
KEYS_MAX = 200_000  # kept; 1000 drones have about 12 000
WAITING_MAX = 50_000  # messages of an expression that wait for the loop, unless said otherwise
DELIVER_MAX = 500  # messages delivered before the other tasks of the loop run
EXPRESSIONS_MAX = 2_000  # of all clients together; each is a subscription that the world's session checks

Subscriber = Callable[[RawSample], None]


class EchoFilter:
    """Recognises values of clients that come back from the world after a newer value, by key.

    After two values in a row the first comes back when the second is there already; after a value and its deletion
    the value comes back. An echo that never comes is forgotten with the next of its key.

    Args:
        keys_max: number of keys with echoes that are waited for.
    """

    def __init__(self, keys_max: int) -> None:
        self._keys_max = keys_max
        self._waiting: dict[str, deque[int | None]] = {}

    def add(self, key: str, payload: bytes) -> None:
        """Expect the echo of a payload that is on its way to the world."""
        if key in self._waiting or len(self._waiting) < self._keys_max:
            self._waiting.setdefault(key, deque(maxlen=ECHOES_MAX)).append(hash(payload))

    def add_deletion(self, key: str) -> None:
        """Note that a key whose echoes are expected has no value any more."""
        if key in self._waiting:
            self._waiting[key].append(DELETED)

    def is_stale(self, key: str, payload: bytes) -> bool:
        """Return whether a payload from the world is an echo that a newer value or deletion has followed."""
        waiting = [*self._waiting.get(key, ())]
        if hash(payload) not in waiting:
            return False
        del self._waiting[key]
        newer = waiting[waiting.index(hash(payload)) + 1 :]
        if any(mark is not DELETED for mark in newer):
            self._waiting[key] = deque(newer, maxlen=ECHOES_MAX)
        return bool(newer)


class LastValues:
    """The last value of every key that has passed the world, or was published by clients here.

    Args:
        table: keys of the world's messages about the drones of the run, see `run_key_table`.
    """

    def __init__(self, table: tuple[str, ...]) -> None:
        self._table = table
        self._indices = {key: index for index, key in enumerate(self._table)}
        self._payloads: dict[str, bytes] = {}
        self._own_bytes = 0
        self._lock = threading.Lock()  # clients' thread and the world's both add to what is counted
        self._encodings: dict[str, tuple[bytes, str]] = {}
        self._echoes = EchoFilter(KEYS_MAX)
        self._of_gates: dict[int, tuple[GateMessages, int]] = {}

    def add(self, key: str, payload: bytes, encoding: str = "") -> None:
        """Store a message; of an encoding that is not its key's where one is given."""
        with self._lock:
            self._add(key, payload, encoding)

    def add_own(self, key: str, payload: bytes, encoding: str = "") -> None:
        """Store a message of a client here, which the world will return, too."""
        with self._lock:
            self._echoes.add(key, payload)
            self._add(key, payload, encoding)

    def _add(self, key: str, payload: bytes, encoding: str) -> None:
        if messages.type_of(key) is None and not self._has_room(key, payload):
            self._drop(key)
        elif key in self._payloads or len(self._payloads) < KEYS_MAX:
            self._payloads[key] = payload
            if encoding:
                self._encodings[key] = (payload, encoding)

    def _has_room(self, key: str, payload: bytes) -> bool:
        """Return whether a value of a client's own key may be kept, and count its bytes."""
        before = len(self._payloads.get(key, b""))
        more = len(payload) - before
        fits = self._own_bytes + more <= OWN_BYTES_MAX and (key in self._payloads or len(self._payloads) < KEYS_MAX)
        self._own_bytes += more if fits else 0
        return fits

    def drop(self, key: str) -> None:
        """Forget the value of a key that is deleted here."""
        with self._lock:
            self._echoes.add_deletion(key)
            self._drop(key)

    def _drop(self, key: str) -> None:
        dropped = self._payloads.pop(key, b"")
        if messages.type_of(key) is None:
            self._own_bytes -= len(dropped)
        self._encodings.pop(key, None)

    def encoding(self, key: str) -> str:
        """Return the encoding of a key's last value."""
        payload, encoding = self._encodings.get(key, (None, ""))
        return encoding if encoding and payload == self._payloads.get(key) else messages.encoding(key)

    def add_passed(self, key: str, payload: bytes) -> None:
        """Store one message that has passed the world."""
        with self._lock:
            if not self._echoes.is_stale(key, payload):
                self._add(key, payload, "")

    def add_gate(self, gate: GateMessages) -> None:
        """Store the world's messages of a gate, whose columns have been checked."""
        for m, place in enumerate(gate.which.tolist()):
            self._of_gates[place] = (gate, m)

    def matching(self, expression: str, prefix: str = "") -> list[tuple[str, bytes]]:
        """Return keys and payloads that an expression matches, in order of the keys.

        Args:
            expression: of keys with the prefix.
            prefix: that is put before each key to compare it; what is returned is without it.
        """
        if "*" not in expression:
            key = expression.removeprefix(prefix)
            payload = self._payload(key) if expression.startswith(prefix) else None
            return [(key, payload)] if payload is not None else []
        known = {*self._payloads, *(self._table[place] for place in list(self._of_gates))}  # filled in another thread
        matching = sorted(key for key in known if keys.matches(expression, prefix + key))
        return [(key, payload) for key in matching if (payload := self._payload(key)) is not None]

    def _payload(self, key: str) -> bytes | None:
        gate, m = self._of_gates.get(self._indices.get(key, -1), (None, 0))
        return gate.payload(m) if gate else self._payloads.get(key)


class SharedSubscriptions:
    """Subscriptions that clients share, and that outlast the session of a run.

    Args:
        loop: on which everything but Zenoh's callbacks is called.
        limit: of connections, in which streams count that are nothing but one subscription.
        waiting_max: messages of an expression that wait for the loop; then the oldest go.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, limit: ConnectionLimit, waiting_max: int = WAITING_MAX) -> None:
        self._loop = loop
        self._limit = limit
        self._waiting_max = waiting_max
        self._link: Session | None = None
        self._by_expression: dict[str, _SharedSubscription] = {}

    def attach(self, link: Session) -> None:
        """Subscribe on a session."""
        self._link = link
        for expression, shared in self._by_expression.items():
            with suppress(SessionError):  # no right to read it; as from keys without publishers, nothing comes
                shared.undeclare = link.declare_subscriber(expression, shared.on_publication)

    def detach(self) -> None:
        """Receive nothing until the next `attach`: the session closes."""
        self._link = None
        for shared in self._by_expression.values():
            shared.undeclare = _do_nothing

    def subscribe(self, expression: str, subscriber: Subscriber) -> Callable[[], None]:
        """Call a subscriber with every publication on an expression until the returned function is called.

        Raises:
            SessionError: it is no key expression.
            TooManyError: there are EXPRESSIONS_MAX others.
        """
        shared = self._by_expression.get(expression)
        if shared is None:
            check_expression(expression)
            if len(self._by_expression) >= EXPRESSIONS_MAX:
                raise TooManyError(f"subscribe: there are {EXPRESSIONS_MAX} expressions already; take one of them")
            shared = self._by_expression[expression] = _SharedSubscription(self._loop, self._waiting_max)
            if self._link is not None:
                shared.undeclare = self._link.declare_subscriber(expression, shared.on_publication)
        shared.subscribers[subscriber] = None
        return lambda: self._unsubscribe(expression, subscriber)

    def subscribe_stream(self, expression: str, subscriber: Subscriber) -> Callable[[], None]:
        """Subscribe for a connection that has nothing else, and count it among the clients.

        Raises:
            SessionError: it is no key expression.
            TooManyError: the limit of clients or of expressions is reached.
        """
        self._limit.enter()
        try:
            unsubscribe = self.subscribe(expression, subscriber)
        except BaseException:
            self._limit.leave()
            raise

        def leave() -> None:
            unsubscribe()
            self._limit.leave()

        return leave

    def _unsubscribe(self, expression: str, subscriber: Subscriber) -> None:
        shared = self._by_expression.get(expression)
        if shared is None:
            return
        shared.subscribers.pop(subscriber, None)
        if not shared.subscribers:
            del self._by_expression[expression]
            shared.undeclare()


class _SharedSubscription:
    """One subscription: publications that arrive close together are delivered together."""

    def __init__(self, loop: asyncio.AbstractEventLoop, waiting_max: int) -> None:
        self._loop = loop
        self._waiting: deque[RawSample] = deque(maxlen=waiting_max)
        self._scheduled = False
        self.subscribers: dict[Subscriber, None] = {}
        self.undeclare: Callable[[], None] = _do_nothing

    def on_publication(self, sample: RawSample) -> None:
        """Store a publication, in a thread of Zenoh's."""
        self._waiting.append(sample)
        if not self._scheduled:
            self._scheduled = True
            try:
                self._loop.call_soon_threadsafe(self._deliver)
            except RuntimeError:
                return  # the loop is closed

    def _deliver(self) -> None:
        self._scheduled = False
        for _ in range(min(DELIVER_MAX, len(self._waiting))):
            sample = self._waiting.popleft()
            for subscriber in list(self.subscribers):
                subscriber(sample)
        if self._waiting and not self._scheduled:
            self._scheduled = True
            self._loop.call_soon(self._deliver)


def _do_nothing() -> None:
    return
