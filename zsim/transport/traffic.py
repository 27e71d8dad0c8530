"""Everything that passes the hub, taken in by one subscription: batches are taken apart here and nowhere else.

traffic = Traffic(link, run_key_table(info))
for entry in traffic.receive(): ...     ReceivedSample(key, payload), or GateMessages of the world's drones
"""

from collections.abc import Callable, Iterable, Iterator

from zsim.contract import keys
from zsim.contract.framing import GateMessages, decode_batch
from zsim.errors import DecodeError
from zsim.transport.session import ReceivedSample, Session

Passed = ReceivedSample | GateMessages


class Traffic:
    """What others and the world publish, in the order in which it passed the hub; views do not pass it.

    Args:
        link: an open session.
        table: keys of the world's messages about the drones of the run, see `run_key_table`.
        refused: called for each batch, or part of one, that cannot be read.
    """

    def __init__(self, link: Session, table: tuple[str, ...], refused: Callable[[], None] = lambda: None) -> None:
        self._subscription = link.subscribe(keys.BATCH)
        self._table = table
        self._refused = refused

    def wake(self) -> None:
        """Let a waiting `receive` return; callable from any thread."""
        self._subscription.wake()

    def close(self) -> None:
        """Take no more; a waiting `receive` raises SessionError."""
        self._subscription.undeclare()

    def receive(self) -> list[Passed]:
        """Wait for what passes next; nothing when woken by `wake`.

        Raises:
            SessionError: the session, or this subscription, was closed meanwhile.
        """
        sample = self._subscription.receive()
        return list(self._opened(sample.payload)) if sample is not None else []

    def drain(self) -> Iterator[Passed]:
        """Yield what has passed, without waiting."""
        for sample in self._subscription.drain():
            yield from self._opened(sample.payload)

    def _opened(self, payload: bytes) -> Iterator[Passed]:
        try:
            passed = decode_batch(payload)
        except DecodeError:
            self._refused()
            return
        for key, message in passed:
            if key != keys.GATE:
                yield ReceivedSample(key, message)
                continue
            try:
                gate = GateMessages.unpack(message, self._table)
                gate.check()
            except DecodeError:
                self._refused()
                continue
            yield gate


def samples(passed: Iterable[Passed]) -> Iterator[ReceivedSample]:
    """Yield messages one by one."""
    for entry in passed:
        if isinstance(entry, GateMessages):
            yield from (ReceivedSample(key, payload) for key, payload in entry.pairs)
        else:
            yield entry
