"""Who reads what: a table made once from the key expressions of several readers, asked once per key.

    routes = RoutingTable([["drone/*/truth"], ["drone/drone1/sensor/imu", "**"]])
    routes.readers("drone/drone1/truth")      (0, 1)

Asking every expression about every key takes readers times keys, which is what a process of 1000 drones would do most
of its time. Here an expression is filed under its own text: those with wildcards for whole chunks are found by
putting the wildcards into the key, and only those with `**` or `$*` are compared one by one.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages, PerPattern
from zsim.errors import DecodeError

KEYS_MAX = 200_000  # whose readers are remembered; 1000 drones have about 15 000, other processes may make up any
_message = itemgetter(1)  # of an input
Input = tuple[str, Any]
"""A key and a message; or `keys.GATE` and a GateMessages."""


class RoutingTable:
    """The readers of every key.

    Args:
        expressions: key expressions of each reader; readers go by their place.
    """

    def __init__(self, expressions: Sequence[Sequence[str]]) -> None:
        self._filed: defaultdict[str, list[int]] = defaultdict(list)  # without wildcards, or with * only
        self._starred: dict[int, set[tuple[int, ...]]] = {}  # by number of chunks, where the wildcards stand
        self._compared: list[tuple[str, int]] = []
        self._known: dict[str, tuple[int, ...]] = {}
        for reader, own in enumerate(expressions):
            for expression in own:
                self._file(expression, reader)

    def _file(self, expression: str, reader: int) -> None:
        chunks = expression.split("/")
        if "**" in chunks or "$*" in expression:
            self._compared.append((expression, reader))
            return
        self._filed[expression].append(reader)
        starred = tuple(place for place, chunk in enumerate(chunks) if chunk == "*")
        if starred:
            self._starred.setdefault(len(chunks), set()).add(starred)

    def readers(self, key: str) -> tuple[int, ...]:
        """Return the places of those who read a key, in order."""
        readers = self._known.get(key)
        if readers is None:
            readers = tuple(sorted(set(self._find(key))))
            if len(self._known) < KEYS_MAX:
                self._known[key] = readers
        return readers

    def readers_of_any(self, of: Iterable[str]) -> tuple[int, ...]:
        """Return the places of those who read one of some keys at least, in order."""
        return tuple(sorted({reader for key in of for reader in self.readers(key)}))

    def _find(self, key: str) -> Iterator[int]:
        yield from self._filed.get(key, ())
        chunks = key.split("/")
        for starred in self._starred.get(len(chunks), ()):
            if not any(chunks[place].startswith("@") for place in starred):  # which no wildcard takes
                masked = ["*" if place in starred else chunk for place, chunk in enumerate(chunks)]
                yield from self._filed.get("/".join(masked), ())
        for expression, reader in self._compared:
            if keys.matches(expression, key):
                yield reader


class _Read(NamedTuple):
    """Who reads a message of a gate, its key, and its place there."""

    readers: tuple[int, ...]
    key: str
    place: int


class GateRouter:
    """Takes apart the messages of gates: of each only what somebody reads, decoded once for all its readers.

    Args:
        routes: of the readers.
    """

    def __init__(self, routes: RoutingTable) -> None:
        self._routes = routes
        self._read = PerPattern(self._read_of)

    def split(self, gate: GateMessages) -> Iterator[tuple[tuple[int, ...], str, Any]]:
        """Yield the readers, key and message of what is read, in order of publication.

        A message that is none of its key is left out, and so is a gate whose columns lead outside of its table.
        """
        for readers, key, place in self._read.of(gate):
            try:
                message = messages.decode(key, gate.payload(place))
            except DecodeError:
                continue  # not written by the world: as good as lost
            yield readers, key, message

    def _read_of(self, gate: GateMessages) -> list[_Read]:
        which, readers_of = gate.which.tolist(), self._routes.readers
        if not which or min(which) < 0 or max(which) >= len(gate.table):
            return []
        keys_of = map(gate.table.__getitem__, which)
        return [_Read(readers, key, m) for m, key in enumerate(keys_of) if (readers := readers_of(key))]


def canonical(entry: Input) -> tuple[int, str, int]:
    """Return what inputs are sorted by: time, key and number."""
    key, message = entry
    return message.t_ns, key, message.seq


def one_by_one(inputs: Sequence[Input], router: GateRouter) -> Sequence[Input]:
    """Return inputs with the messages of gates one by one, as far as they are read, in canonical order."""
    if GateMessages not in map(type, map(_message, inputs)):
        return inputs
    single: list[Input] = []
    for key, message in inputs:
        if type(message) is GateMessages:
            single += [(name, each) for _, name, each in router.split(message)]
        else:
            single.append((key, message))
    return sorted(single, key=canonical)
