"""Who reads what: a table made once from the key expressions of several readers, asked once per key.

    routes = RoutingTable([["drone/*/truth"], ["drone/drone1/sensor/imu", "**"]])
    routes.readers("drone/drone1/truth")      (0, 1)

Asking every expression about every key takes readers times keys, which is what a process of 1000 drones would do most
of its time. Here an expression is filed under its own text: those with wildcards for whole chunks are found by
putting the wildcards into the key, and only those with `**` or `$*` are compared one by one.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages
from zsim.errors import DecodeError

KEYS_MAX = 200_000  # whose readers are remembered; 1000 drones have about 15 000, other processes may make up any
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


class Routed(NamedTuple):
    """A message of a gate, and the places of those who read it."""

    readers: tuple[int, ...]
    key: str
    message: Any


class GateRouter:
    """Takes apart the messages of gates: of each only what somebody reads, decoded once for all its readers.

    Args:
        routes: of the readers.
        without: places of readers that take gates as a whole.
    """

    def __init__(self, routes: RoutingTable, without: Sequence[int] = ()) -> None:
        self._routes = routes
        self._without = frozenset(without)
        self._table: Sequence[str] = ()
        self._readers: list[tuple[int, ...]] = []
        self._is_read: NDArray[np.bool_] = np.zeros(0, dtype=np.bool_)

    def split(self, gate: GateMessages) -> Iterator[Routed]:
        """Yield the messages that are read, in order of publication; one that is no message of its key is left out.

        So is a gate whose columns lead outside of its table.
        """
        if gate.table is not self._table:
            self._learn(gate.table)
        if not len(gate) or not 0 <= int(gate.which.min()) <= int(gate.which.max()) < len(self._readers):
            return
        read = np.flatnonzero(self._is_read[gate.which])
        places: list[int] = gate.which[read].tolist()
        for m, place in zip(read.tolist(), places, strict=True):
            key = gate.table[place]
            try:
                message = messages.decode(key, gate.payload(m))
            except DecodeError:
                continue  # not written by the world: as good as lost
            yield Routed(self._readers[place], key, message)

    def _learn(self, table: Sequence[str]) -> None:
        """Look up once who reads which key of a table."""
        self._table = table
        readers = [self._routes.readers(key) for key in table]
        self._readers = [tuple(r for r in each if r not in self._without) for each in readers]
        self._is_read = np.array([bool(each) for each in self._readers], dtype=np.bool_)


def in_order(inputs: Sequence[Input]) -> list[Input]:
    """Return inputs in canonical order: by time, key and number."""
    return sorted(inputs, key=lambda entry: (entry[1].t_ns, entry[0], entry[1].seq))


def one_by_one(inputs: Sequence[Input], router: GateRouter) -> Sequence[Input]:
    """Return inputs with the messages of gates one by one, as far as they are read, in canonical order."""
    if not any(type(message) is GateMessages for _, message in inputs):
        return inputs
    single: list[Input] = []
    for key, message in inputs:
        if type(message) is GateMessages:
            single += [(routed.key, routed.message) for routed in router.split(message)]
        else:
            single.append((key, message))
    return in_order(single)
