"""From Zenoh's threads onto the loop: publications to whoever wants them, one subscription for each expression."""

import asyncio
from collections import deque
from collections.abc import Callable

from zsim.transport.session import Heard, Session, check_expression
from zsim_bridges.gateway.client_limits import Turnstile
from zsim_bridges.gateway.http.http_errors import TooManyError

Taker = Callable[[Heard], None]
CAME_MAX = 50_000  # messages of an expression that wait for the loop; then the oldest go
AT_ONCE = 500  # messages handed over before anybody else on the loop has a turn
EXPRESSIONS_MAX = 2_000  # of all clients together; each is a subscription that the world's hub looks at


class Feed:
    """Subscriptions that clients share, and that outlast the session of a run.

    Args:
        loop: on which everything but what Zenoh says is called.
        turnstile: through which streams come that are nothing but one subscription.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, turnstile: Turnstile) -> None:
        self._loop = loop
        self._turnstile = turnstile
        self._link: Session | None = None
        self._shared: dict[str, _Shared] = {}

    def attach(self, link: Session) -> None:
        """Hear what is said on a session."""
        self._link = link
        for expression, shared in self._shared.items():
            shared.undeclare = link.hear(expression, shared.hear)

    def detach(self) -> None:
        """Hear nothing until there is a session again: the one that there was goes."""
        self._link = None
        for shared in self._shared.values():
            shared.undeclare = _nothing

    def subscribe(self, expression: str, taker: Taker) -> Callable[[], None]:
        """Hand everything on an expression to a taker until the returned function is called.

        Raises:
            SessionError: it is no key expression.
            TooManyError: there are EXPRESSIONS_MAX others.
        """
        shared = self._shared.get(expression)
        if shared is None:
            check_expression(expression)
            if len(self._shared) >= EXPRESSIONS_MAX:
                raise TooManyError(f"subscribe: there are {EXPRESSIONS_MAX} expressions already; take one of them")
            shared = self._shared[expression] = _Shared(self._loop)
            if self._link is not None:
                shared.undeclare = self._link.hear(expression, shared.hear)
        shared.takers[taker] = None
        return lambda: self._leave(expression, taker)

    def stream(self, expression: str, taker: Taker) -> Callable[[], None]:
        """Do as `subscribe` for a connection that has nothing else, and count it among the clients.

        Raises:
            SessionError: it is no key expression.
            TooManyError: there are as many clients, or expressions, as may be.
        """
        self._turnstile.enter()
        try:
            end = self.subscribe(expression, taker)
        except BaseException:
            self._turnstile.leave()
            raise

        def leave() -> None:
            end()
            self._turnstile.leave()

        return leave

    def _leave(self, expression: str, taker: Taker) -> None:
        shared = self._shared.get(expression)
        if shared is None:
            return
        shared.takers.pop(taker, None)
        if not shared.takers:
            del self._shared[expression]
            shared.undeclare()


class _Shared:
    """One subscription: what comes in a rush is handed over together."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._came: deque[Heard] = deque(maxlen=CAME_MAX)
        self._due = False
        self.takers: dict[Taker, None] = {}
        self.undeclare: Callable[[], None] = _nothing

    def hear(self, heard: Heard) -> None:
        """Take a publication, in a thread of Zenoh's."""
        self._came.append(heard)
        if not self._due:
            self._due = True
            try:
                self._loop.call_soon_threadsafe(self._hand_over)
            except RuntimeError:
                return  # the loop is closed: nobody listens any more

    def _hand_over(self) -> None:
        self._due = False
        for _ in range(min(AT_ONCE, len(self._came))):
            heard = self._came.popleft()
            for taker in list(self.takers):
                taker(heard)
        if self._came and not self._due:
            self._due = True
            self._loop.call_soon(self._hand_over)


def _nothing() -> None:
    return
