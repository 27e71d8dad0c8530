"""From Zenoh's threads onto the loop: publications to whoever wants them, one subscription for each expression."""

import asyncio
from collections import deque
from collections.abc import Callable

from zsim.transport.session import Heard, Session, check_expression
from zsim_bridges.gateway.client_limits import ConnectionLimit
from zsim_bridges.gateway.http.http_errors import TooManyError

Subscriber = Callable[[Heard], None]
WAITING_MAX = 50_000  # messages of an expression that wait for the loop; then the oldest go
DELIVER_MAX = 500  # messages handed over before anybody else on the loop has a turn
EXPRESSIONS_MAX = 2_000  # of all clients together; each is a subscription that the world's hub looks at


class SharedSubscriptions:
    """Subscriptions that clients share, and that outlast the session of a run.

    Args:
        loop: on which everything but what Zenoh says is called.
        turnstile: through which streams come that are nothing but one subscription.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, turnstile: ConnectionLimit) -> None:
        self._loop = loop
        self._limit = turnstile
        self._link: Session | None = None
        self._by_expression: dict[str, _SharedSubscription] = {}

    def attach(self, link: Session) -> None:
        """Hear what is said on a session."""
        self._link = link
        for expression, shared in self._by_expression.items():
            shared.undeclare = link.hear(expression, shared.on_publication)

    def detach(self) -> None:
        """Hear nothing until there is a session again: the one that there was goes."""
        self._link = None
        for shared in self._by_expression.values():
            shared.undeclare = _do_nothing

    def subscribe(self, expression: str, taker: Subscriber) -> Callable[[], None]:
        """Hand everything on an expression to a taker until the returned function is called.

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
                shared.undeclare = self._link.hear(expression, shared.on_publication)
        shared.subscribers[taker] = None
        return lambda: self._unsubscribe(expression, taker)

    def subscribe_stream(self, expression: str, taker: Subscriber) -> Callable[[], None]:
        """Do as `subscribe` for a connection that has nothing else, and count it among the clients.

        Raises:
            SessionError: it is no key expression.
            TooManyError: there are as many clients, or expressions, as may be.
        """
        self._limit.enter()
        try:
            end = self.subscribe(expression, taker)
        except BaseException:
            self._limit.leave()
            raise

        def leave() -> None:
            end()
            self._limit.leave()

        return leave

    def _unsubscribe(self, expression: str, taker: Subscriber) -> None:
        shared = self._by_expression.get(expression)
        if shared is None:
            return
        shared.subscribers.pop(taker, None)
        if not shared.subscribers:
            del self._by_expression[expression]
            shared.undeclare()


class _SharedSubscription:
    """One subscription: what comes in a rush is handed over together."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._waiting: deque[Heard] = deque(maxlen=WAITING_MAX)
        self._scheduled = False
        self.subscribers: dict[Subscriber, None] = {}
        self.undeclare: Callable[[], None] = _do_nothing

    def on_publication(self, heard: Heard) -> None:
        """Take a publication, in a thread of Zenoh's."""
        self._waiting.append(heard)
        if not self._scheduled:
            self._scheduled = True
            try:
                self._loop.call_soon_threadsafe(self._deliver)
            except RuntimeError:
                return  # the loop is closed: nobody listens any more

    def _deliver(self) -> None:
        self._scheduled = False
        for _ in range(min(DELIVER_MAX, len(self._waiting))):
            heard = self._waiting.popleft()
            for taker in list(self.subscribers):
                taker(heard)
        if self._waiting and not self._scheduled:
            self._scheduled = True
            self._loop.call_soon(self._deliver)


def _do_nothing() -> None:
    return
