"""Links of a router to readers that take nothing: closed as at the world, which they would hold up through the router.

A router does not know the run. Who is not waited for has said so when it joined, or shows no token of its session.
"""

from collections.abc import Callable
from contextlib import suppress

from zsim.contract import keys, messages
from zsim.contract.run_messages import Join
from zsim.errors import DecodeError
from zsim.transport.link_watch import Awaited, ClosedLink, LinkWatch
from zsim.transport.session import RawSample, Session
from zsim.transport.session_tokens import SessionTokens

JOINS_MAX = 10_000  # remembered; names cost a stranger nothing


class RouterLinks:
    """Watches the links of a router.

    Args:
        link: its session.
        say: takes a line for each link that was closed.

    Attributes:
        watch: closes the links.
    """

    def __init__(self, link: Session, say: Callable[[str], None]) -> None:
        self._say = say
        self._tokens = SessionTokens(link)
        self._joins: dict[str, Join] = {}
        self._tokens.watch()
        link.declare_subscriber(keys.process("*", "join"), self._on_join)
        self.watch = LinkWatch(link, self._tokens, self.awaited)

    def _on_join(self, sample: RawSample) -> None:
        with suppress(DecodeError):
            join = messages.decode_as(Join, sample.payload, sample.key)
            if len(self._joins) >= JOINS_MAX:
                self._joins.clear()
            self._joins[keys.thing(sample.key)] = join

    def awaited(self) -> list[Awaited]:
        """Return who must lose nothing; callable from any thread."""
        joins = self._joins.copy()
        awaited = [Awaited((name,), 0) for name in self._tokens.shown() if name not in joins]
        for name, join in joins.items():
            if (join.period_ns > 0 or join.slack_ns > 0) and self._tokens.is_alive(name):
                awaited.append(Awaited((name, *join.serves), join.pid))
        return awaited

    def report(self) -> None:
        """Show the links that were closed since the last time."""
        while self.watch.closed:
            self._say(_text(self.watch.closed.popleft()))


def _text(closed: ClosedLink) -> str:
    who = f"{closed.process or 'somebody'} at {closed.address} ({', '.join(closed.names) or 'no process of the run'})"
    return f"{who} took nothing of {closed.held_bytes / 1e6:.1f} MB; its link is closed ({closed.times} so far)"
