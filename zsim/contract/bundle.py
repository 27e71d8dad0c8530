"""Many messages of the world at one gate, encoded one behind the other in one buffer."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from operator import sub
from typing import Any, NoReturn

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.contract import keys, messages
from zsim.contract.batch import GATE, Batch
from zsim.contract.encoding import GAP
from zsim.contract.messages import REFUSALS, Count
from zsim.errors import DecodeError

KINDS = (*keys.SENSORS, "truth", "status")  # what the world says of a drone
PATTERNS_MAX = 1000  # kept; sensors of a few rates have some dozens
_INT = np.dtype("<i8")


def table_of(drones: Sequence[str]) -> tuple[str, ...]:
    """Return the keys on which the world speaks of some drones, drone by drone."""
    return tuple(keys.truth(d) if kind == "truth" else keys.sensor(d, kind) for d in drones for kind in KINDS)


class _Packed(Struct, array_like=True, gc=False):
    """A bundle on its way; whole numbers as little-endian int64."""

    t_ns: Count
    seq: Count
    which: bytes
    stamps: bytes
    ends: bytes
    buffer: bytes


_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(_Packed).decode


class Bundle:
    """Messages in order of publication.

    Args:
        t_ns: gate [ns].
        seq: number of the gate.
        table: keys; the same object at every gate.
        which: the place of each message's key in the table, (M,).
        stamps: t_ns of each [ns], (M,).
        ends: where each ends in the buffer, (M,); GAP bytes before each payload are free.
        buffer: owned by the bundle.
        first: where the messages of each drone begin, and their end, (N + 1,); empty where that is not known.
    """

    def __init__(
        self,
        t_ns: int,
        seq: int,
        table: Sequence[str],
        which: NDArray[np.int64],
        stamps: NDArray[np.int64],
        ends: NDArray[np.int64],
        buffer: bytes | bytearray,
        first: Sequence[int] = (),
    ) -> None:
        self.t_ns, self.seq = t_ns, seq
        self.table = table
        self.which = which
        self.stamps = stamps
        self.ends = ends
        self.buffer = buffer
        self.first = first

    @classmethod
    def of(cls, t_ns: int, seq: int, table: Sequence[str], said: Batch) -> "Bundle":
        """Return encoded messages as a bundle, all stamped t_ns."""
        ends = np.cumsum([GAP + len(payload) for _, payload in said])
        which = np.array([table.index(key) for key, _ in said])
        buffer = b"".join([bytes(GAP) + payload for _, payload in said])
        return cls(t_ns, seq, table, which, np.full(len(said), t_ns), ends, buffer)

    def __len__(self) -> int:
        return len(self.which)

    @cached_property
    def encoded(self) -> Batch:
        """Keys and payloads, as on the wire."""
        data, table = bytes(self.buffer), self.table
        places: list[int] = self.which.tolist()
        bounds = pairwise([0, *self.ends.tolist()])
        return [(table[p], data[start + GAP : end]) for p, (start, end) in zip(places, bounds, strict=True)]

    def is_sound(self) -> bool:
        """Tell whether its columns lead nowhere outside of it, and its stamps are times."""
        which, stamps, ends = self.which.tolist(), self.stamps.tolist(), self.ends.tolist()
        if not ends or ends[-1] != len(self.buffer) or min(map(sub, ends, [0, *ends])) < GAP:
            return False
        return min(which) >= 0 and max(which) < len(self.table) and min(stamps) >= 0

    def payload(self, m: int) -> bytes:
        """Return the payload of one message."""
        start = int(self.ends[m - 1]) if m else 0
        return bytes(self.buffer[start + GAP : int(self.ends[m])])

    def messages(self) -> Iterator[tuple[str, Any]]:
        """Yield keys and messages."""
        for key, payload in self.encoded:
            yield key, messages.decode(key, payload)

    def packed(self, first: int = 0, last: int | None = None) -> bytes:
        """Return messages [first, last) as one payload."""
        start = int(self.ends[first - 1]) if first else 0
        ends = self.ends[first:last] - start
        data = bytes(memoryview(self.buffer)[start : start + int(ends[-1])])
        which, stamps = self.which[first:last].tobytes(), self.stamps[first:last].tobytes()
        return _encode(_Packed(self.t_ns, self.seq, which, stamps, ends.tobytes(), data))


def unpacked(payload: bytes, table: Sequence[str]) -> Bundle:
    """Return the bundle in a payload.

    Its columns may still lead outside of it: whoever follows them looks.

    Raises:
        DecodeError: it is none.
    """
    try:
        p = _decode(payload)
    except REFUSALS as error:
        _refuse(str(error))
    if not len(p.which) == len(p.stamps) == len(p.ends) or len(p.which) % _INT.itemsize:
        _refuse("its columns differ in length")
    which, stamps, ends = (np.frombuffer(column, _INT) for column in (p.which, p.stamps, p.ends))
    return Bundle(p.t_ns, p.seq, table, which, stamps, ends, p.buffer)


def _refuse(reason: str) -> NoReturn:
    raise DecodeError(f"{GATE}: {reason}; must be the messages of a gate")


class Selection:
    """What an agent reads of bundles.

    Args:
        reads: key expressions.
    """

    def __init__(self, reads: Sequence[str]) -> None:
        self._reads = tuple(reads)
        self._wanted: dict[str, bool] = {}
        self._table: Sequence[str] = ()
        self._found: dict[bytes, list[tuple[int, str]]] = {}

    def of(self, bundle: Bundle) -> list[tuple[str, Any]]:
        """Return keys and messages.

        Raises:
            DecodeError: one is no message of its key.
        """
        if bundle.table is not self._table:
            self._table = bundle.table
            self._found.clear()
        pattern = bundle.which.tobytes()
        found = self._found.get(pattern)
        if found is None:
            found = self._find(bundle, pattern)
        return [(key, messages.decode(key, bundle.payload(m))) for m, key in found]

    def _find(self, bundle: Bundle, pattern: bytes) -> list[tuple[int, str]]:
        """Return places and keys of what is read; the same pattern of sensors comes again and again."""
        table = bundle.table
        places: list[int] = bundle.which.tolist()
        if not all(0 <= place < len(table) for place in places):
            _refuse("a key is not in its table")
        found = [(m, table[place]) for m, place in enumerate(places) if self.takes(table[place])]
        if len(self._found) < PATTERNS_MAX:
            self._found[pattern] = found
        return found

    def takes(self, key: str) -> bool:
        """Tell whether a key is read."""
        wanted = self._wanted.get(key)
        if wanted is None:
            wanted = self._wanted[key] = any(keys.matches(expression, key) for expression in self._reads)
        return wanted
