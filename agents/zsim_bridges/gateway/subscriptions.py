"""Subscriptions that clients share, one for each expression; publications pass from Zenoh's threads to the loop."""

import asyncio
from collections import deque
from collections.abc import Callable

from zsim.transport.samples import RawSample, check_expression
from zsim.transport.session import Session
from zsim_bridges.gateway.access_check import ConnectionLimit
from zsim_bridges.gateway.key_policy import TooManyError

Subscriber = Callable[[RawSample], None]
WAITING_MAX = 50_000  # messages of an expression that wait for the loop; then the oldest go
DELIVER_MAX = 500  # messages delivered before the other tasks of the loop run
EXPRESSIONS_MAX = 2_000  # of all clients together; each is a subscription that the world's session checks


class SharedSubscriptions:
    """Subscriptions that clients share, and that outlast the session of a run.

    Args:
        loop: on which everything but Zenoh's callbacks is called.
        limit: of connections, in which streams count that are nothing but one subscription.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, limit: ConnectionLimit) -> None:
        self._loop = loop
        self._limit = limit
        self._link: Session | None = None
        self._by_expression: dict[str, _SharedSubscription] = {}

    def attach(self, link: Session) -> None:
        """Subscribe on a session."""
        self._link = link
        for expression, shared in self._by_expression.items():
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
            shared = self._by_expression[expression] = _SharedSubscription(self._loop)
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

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._waiting: deque[RawSample] = deque(maxlen=WAITING_MAX)
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
