"""Messages kept by the world: last values for queries, and the last seconds for processes that must catch up.

It keeps the world's own messages and those of the participants, those of dead ones too.
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any

import msgspec

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Command
from zsim.contract.framing import Pairs, pairs_of
from zsim.contract.messages import REFUSALS
from zsim.contract.run_messages import ControlAnswer
from zsim.errors import DecodeError
from zsim.scenario import roles
from zsim.schema.message import Count

KEEP_NS = 5_000_000_000  # simulated time that a replay reaches back
KEEP_BYTES = 500_000_000  # payloads kept at most: those of 1000 drones are about 300 MB in KEEP_NS
FOREIGN_BYTES = 50_000_000  # of these, of messages that are none of the contract
LAST_MAX = 200_000  # keys of which the last value is kept: 1000 drones have about 12 000
PAGE_BYTES = 8_000_000  # payloads of one answer; who lacks more requests the next page
EXPRESSIONS_MAX = 1000  # of one replay; a controller of hundreds of drones reads two keys of each


class _ReplayArgs(msgspec.Struct):
    """The arguments of a replay; `page` is the field `more` of the answer before."""

    from_ns: int
    keys: Annotated[list[str], msgspec.Meta(max_length=EXPRESSIONS_MAX)]
    page: Count = 0


_Entry = tuple[int, int, Pairs, int, bool]
"""Messages that passed together: the world's clock then, their stamp, keys and payloads, bytes of the latter, and
whether they are of strangers."""


class MessageHistory:
    """Payloads as on the wire, by key.

    Args:
        keep_bytes: limit of the payloads kept for replays.
        page_bytes: limit of the payloads on one page.

    Attributes:
        passed: messages that recorders have not been sent yet, in order.
        last_values: of every key.
    """

    def __init__(self, keep_bytes: int = KEEP_BYTES, page_bytes: int = PAGE_BYTES) -> None:
        self.passed: list[tuple[str, bytes]] = []
        self.last_values: dict[str, bytes] = {}
        self._recent: deque[_Entry] = deque()
        self._now_ns = 0
        self._bytes = self._foreign_bytes = 0
        self._keep_bytes = keep_bytes
        self._page_bytes = page_bytes
        self._forgotten = 0

    def add(self, key: str, payload: bytes, t_ns: int) -> None:
        """Keep a message; t_ns is its stamp.

        Its age is judged by the world's clock at its arrival: a sender's stamp may be anything.
        """
        if key == keys.CLOCK:
            self._now_ns = t_ns
        if key in self.last_values or len(self.last_values) < LAST_MAX:
            self.last_values[key] = payload
        self._keep(t_ns, [(key, payload)], len(payload))

    def add_foreign(self, key: str, payload: bytes) -> None:
        """Keep, for recorders, a message outside of the contract or a refused one; it is not a last value.

        Beyond FOREIGN_BYTES nothing is kept, so that strangers push out nothing that a participant may lack.
        """
        if self._foreign_bytes + len(payload) <= FOREIGN_BYTES:
            self._foreign_bytes += len(payload)
            self._keep(self._now_ns, [(key, payload)], len(payload), foreign=True)

    def add_all(self, published: Pairs, t_ns: int) -> None:
        """Keep what the world itself publishes, all stamped t_ns, its newest gate."""
        self._now_ns = t_ns
        self.last_values.update(published)
        self._keep(t_ns, published, sum([len(payload) for _, payload in published]))

    def _keep(self, t_ns: int, passed: Pairs, size: int, foreign: bool = False) -> None:
        recent, now_ns = self._recent, self._now_ns
        recent.append((now_ns, t_ns, passed, size, foreign))
        self._bytes += size
        while self._bytes > self._keep_bytes or recent[0][0] < now_ns - KEEP_NS:
            _, _, oldest, its_size, was_foreign = recent.popleft()
            self._bytes -= its_size
            self._foreign_bytes -= its_size * was_foreign
            self._forgotten += len(oldest)

    def last(self, expression: str) -> Pairs:
        """Return the last value of every key that matches an expression."""
        if expression in self.last_values:
            return [(expression, self.last_values[expression])]
        return [(key, payload) for key, payload in list(self.last_values.items()) if keys.matches(expression, key)]

    def _each(self) -> Iterator[tuple[int, str, bytes]]:
        for _, t_ns, passed, _, _ in self._recent:
            for key, payload in passed:
                yield t_ns, key, payload

    def page(self, from_ns: int, wanted: Callable[[str], bool], start: int = 0) -> tuple[Pairs, int | None]:
        """Return a page of the messages stamped after from_ns on keys that are wanted.

        Args:
            start: 0, or where the page before ended.

        Returns:
            (key, payload) in order of arrival, and where the next page begins, None after the last one.
        """
        passed: list[tuple[str, bytes]] = []
        known: dict[str, bool] = {}
        size = 0
        for number, (t_ns, key, payload) in enumerate(self._each(), self._forgotten):
            if number < start or t_ns <= from_ns:
                continue
            if key not in known:
                known[key] = wanted(key)
            if not known[key]:
                continue
            size += len(payload)
            if passed and size > self._page_bytes:
                return passed, number
            passed.append((key, payload))
        return passed, None

    def replay(self, args: dict[str, Any], readable: Sequence[str]) -> ControlAnswer:
        """Answer a request for a replay with a page of the history.

        Args:
            args: of the request: from_ns, keys and page.
            readable: expressions of the keys that the requesting process may read.
        """
        try:
            replay = msgspec.convert(args, _ReplayArgs)
        except REFUSALS as error:
            return ControlAnswer(False, f"replay: needs from_ns (whole number) and keys (list of texts): {error}")
        passed, more = self.page(
            replay.from_ns,
            lambda key: roles.permits(replay.keys, key) and roles.permits(readable, key),
            replay.page,
        )
        return ControlAnswer(True, result=passed, more=more)

    def lost_outputs(self, kept: Any, done_ns: int) -> Pairs:
        """Return the outputs kept by a participant that have not arrived, each once, as after a cut link.

        Those of gates later than its newest done are left out: they are on their way, or its done will count them.

        Args:
            kept: the result of its answer.
            done_ns: newest gate that it has completed.

        Raises:
            DecodeError: the result is no list of [key, payload].
        """
        outputs: dict[Any, tuple[str, bytes]] = {}
        for key, payload in pairs_of(kept):
            identity = _identity(key, payload)
            if identity is not None and identity[1] <= done_ns:
                outputs[identity] = (key, payload)
        stamps = {(key, t_ns) for key, t_ns, _, _ in outputs}
        for t_ns, key, payload in self._each():
            if (key, t_ns) in stamps:
                outputs.pop(_identity(key, payload), None)
        return list(outputs.values())


def _identity(key: str, payload: bytes) -> tuple[str, int, int, str] | None:
    """Return (key, t_ns, seq, source), which identify an output; None for messages that no done counts."""
    kind = messages.type_of(key)
    if kind is None or not issubclass(kind, (Command, *messages.RELAYED)):
        return None
    try:
        message = messages.decode(key, payload)
    except DecodeError:
        return None
    return key, message.t_ns, message.seq, message.source
