"""Readers that take nothing: an event names whose link is closed, the terminal who else holds the world up."""

from collections.abc import Iterator
from contextlib import contextmanager

from zsim.transport.link_watch import ClosedLink, LinkWatch
from zsim_world.flight.coordinator import Coordinator
from zsim_world.journal.journal_entries import ReaderClosed
from zsim_world.journal.run_journal import RunJournal

SHOWN = 5  # expressions of one that subscribes to many


class SlowReaders:
    """Hands the closed links to a world.

    Args:
        watch: closes them.
        world: whose readers they were.
        host: the name of this one.
        journal: of what the world is handed.
    """

    def __init__(self, watch: LinkWatch, world: Coordinator, host: str, journal: RunJournal) -> None:
        self._journal = journal
        self._watch = watch
        self._world = world
        self._own_host = host

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Let the links be watched meanwhile."""
        with self._watch:
            yield

    def report(self) -> None:
        """Report the links that were closed since the last time."""
        while self._watch.closed:
            closed = self._watch.closed.popleft()
            far_host = closed.address.rpartition(":")[0].strip("[]")
            host = self._own_host if closed.process else far_host
            text, data = _text(closed, host), {**closed._asdict(), "host": host}
            self._world.handle_slow_reader(text, data)
            self._journal.note(ReaderClosed(text, data))

    def stuck(self) -> str:
        """Return which link takes nothing, as text."""
        named = self._watch.stuck()
        return f"the link takes nothing of {named[0]}" if named else "no link is known to be full"


def _text(closed: ClosedLink, host: str) -> str:
    names = ", ".join(closed.names) or "no process of the run"
    more = " …" if len(closed.reads) > SHOWN else ""
    reads = ", ".join(closed.reads[:SHOWN]) + more if closed.reads else "what is not known"
    who = f"{closed.process or 'somebody'} at {closed.address} on {host}"
    held = f"{closed.held_bytes / 1e6:.1f} MB"
    return f"{who} ({names}), which reads {reads}, took nothing of {held}; its link is closed ({closed.times} so far)"
