"""All traffic through the hub, received by one subscription or requested as a replay.

traffic = Traffic(link, run_key_table(info))
for entry in traffic.receive(): ...  # ReceivedSample(key, payload), or GateMessages about the run's drones
"""

from collections.abc import Callable, Iterable, Iterator, Sequence

from zsim.contract import keys
from zsim.contract.framing import GateMessages, decode_batch, pairs_of
from zsim.errors import DecodeError, NoWorldError
from zsim.transport.session import ReceivedSample, Session

Passed = ReceivedSample | GateMessages


class Traffic:
    """All messages except views and pictures, in the order in which they passed the hub.

    Args:
        table: keys of the world's messages about the run's drones, see `run_key_table`.
        refused: called for each batch, and each gate in a batch, that cannot be decoded.
    """

    def __init__(self, link: Session, table: tuple[str, ...], refused: Callable[[], None] = lambda: None) -> None:
        self._subscription = link.subscribe(keys.BATCH)
        self._table = table
        self._refused = refused

    def wake(self) -> None:
        """Make a waiting `receive` return; callable from any thread."""
        self._subscription.wake()

    def close(self) -> None:
        """Stop receiving; a waiting `receive` raises SessionError."""
        self._subscription.undeclare()

    def receive(self) -> list[Passed]:
        """Wait for the next messages; return an empty list when woken by `wake`.

        Raises:
            SessionError: the session or this subscription was closed meanwhile.
        """
        sample = self._subscription.receive()
        return list(self._opened(sample.payload)) if sample is not None else []

    def drain(self) -> Iterator[Passed]:
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
    for entry in passed:
        if isinstance(entry, GateMessages):
            yield from (ReceivedSample(key, payload) for key, payload in entry.pairs)
        else:
            yield entry


def replay(
    link: Session, process: str, from_ns: int, expressions: Sequence[str], timeout_s: float
) -> Iterator[tuple[str, bytes]]:
    """Yield (key, payload) of the messages stamped after `from_ns`, in the order in which they passed the world.

    The world keeps the messages of the last seconds and answers page by page.

    Args:
        process: name of the requesting process.
        from_ns: simulated time [ns]; -1 for all messages that the world still has.
        expressions: key expressions of the requested messages.
        timeout_s: wall time to wait for each page [s].

    Raises:
        NoWorldError: the world does not answer with a replay; messages already yielded are valid.
    """
    page: int | None = 0
    while page is not None:
        try:
            args = {"from_ns": from_ns, "keys": list(expressions), "page": page}
            answer = link.request(keys.replay(process), "replay", process, args, timeout_s)
            passed = pairs_of(answer.result) if answer.ok else []
        except DecodeError as error:
            raise NoWorldError(f"{process}: the world's replay is not usable: {error}") from error
        if not answer.ok:
            raise NoWorldError(answer.error)
        yield from passed
        page = answer.more
