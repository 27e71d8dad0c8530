"""Readers that take nothing: an event names whose link is closed, the terminal who else holds the world up."""

from contextlib import suppress

import msgspec

from zsim.contract import keys
from zsim.contract.run_messages import Health
from zsim.transport.link_watch import Awaited, ClosedLink, LinkWatch, SessionTokens
from zsim.transport.session import Session
from zsim_world.flight.coordinator import Coordinator
from zsim_world.journal.journal_entries import ReaderClosed
from zsim_world.journal.run_journal import RunJournal
from zsim_world.server.message_history import MessageHistory

SHOWN = 5  # expressions of one that subscribes to many
_decode_health = msgspec.msgpack.Decoder(Health).decode


class SlowReaders:
    """Hands the closed links to a world.

    Args:
        link: the listening session.
        tokens: of all processes.
        world: whose readers they were.
        history: has the health of those that publish it.
        journal: of what the world is handed.

    Attributes:
        watch: closes the links.
    """

    def __init__(
        self, link: Session, tokens: SessionTokens, world: Coordinator, history: MessageHistory, journal: RunJournal
    ) -> None:
        self._journal = journal
        self._world = world
        self._history = history
        self._own_host = link.host
        self.watch = LinkWatch(link, tokens, self._awaited)

    def _awaited(self) -> list[Awaited]:
        awaited = self._world.barrier.awaited()
        return [Awaited((each.name, *each.join.serves), each.join.pid) for each in awaited]

    def report(self) -> None:
        """Report the links that were closed since the last time."""
        while self.watch.closed:
            closed = self.watch.closed.popleft()
            far_host = closed.address.rpartition(":")[0].strip("[]")
            host = self._own_host if closed.process else far_host
            reads = [expression for name in closed.names for expression in self._reads(name)]
            text, data = _text(closed, host, reads), {**closed._asdict(), "host": host, "reads": reads}
            self._world.losses.reader_closed(text, data)
            self._journal.note(ReaderClosed(text, data))

    def _reads(self, name: str) -> tuple[str, ...]:
        """Return what a process subscribes to, by its health."""
        for _, payload in self._history.last(keys.process(name, "health")):
            with suppress(msgspec.MsgspecError):
                return _decode_health(payload).reads
        return ()

    def stuck(self) -> str:
        """Return which link takes nothing, as text."""
        named = self.watch.stuck()
        return f"the link takes nothing of {named[0]}" if named else "no link is known to be full"


def _text(closed: ClosedLink, host: str, reads: list[str]) -> str:
    names = ", ".join(closed.names) or "no process of the run"
    more = " …" if len(reads) > SHOWN else ""
    which = f", which reads {', '.join(reads[:SHOWN])}{more}," if reads else ""
    who = f"{closed.process or 'somebody'} at {closed.address} on {host}"
    held = f"{closed.held_bytes / 1e6:.1f} MB"
    return f"{who} ({names}){which} took nothing of {held}; its link is closed ({closed.times} so far)"
