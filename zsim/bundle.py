"""Many messages of one publisher at one gate, encoded one behind the other in one buffer."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim import keys, messages
from zsim.batch import Batch
from zsim.encoding import GAP

_GAP = bytes(GAP)


class Bundle:
    """Messages in order of publication.

    Args:
        t_ns: gate [ns].
        seq: number of the gate.
        table: keys, the same object at every gate; it may grow.
        which: the place of each message's key in the table, (M,).
        stamps: t_ns of each [ns], (M,).
        ends: where each ends in the buffer, (M,); GAP bytes before each payload are free.
        buffer: owned by the bundle.
    """

    __slots__ = ("__dict__", "buffer", "ends", "seq", "stamps", "t_ns", "table", "which")

    def __init__(
        self,
        t_ns: int,
        seq: int,
        table: Sequence[str],
        which: NDArray[np.int64],
        stamps: NDArray[np.int64],
        ends: NDArray[np.int64],
        buffer: bytearray,
    ) -> None:
        self.t_ns, self.seq = t_ns, seq
        self.table = table
        self.which = which
        self.stamps = stamps
        self.ends = ends
        self.buffer = buffer

    def __len__(self) -> int:
        return len(self.which)

    @cached_property
    def encoded(self) -> Batch:
        """Keys and payloads, as on the wire."""
        data, table, start, found = bytes(self.buffer), self.table, 0, []
        for place, end in zip(self.which.tolist(), self.ends.tolist(), strict=True):
            found.append((table[place], data[start + GAP : end]))
            start = end
        return found

    def messages(self) -> Iterator[tuple[str, Any]]:
        """Yield keys and messages."""
        for key, payload in self.encoded:
            yield key, messages.decode(key, payload)


class KeyTable:
    """Keys in the order in which they were first met."""

    def __init__(self) -> None:
        self.keys: list[str] = []
        self._place: dict[str, int] = {}

    def bundle(self, t_ns: int, seq: int, passed: Batch) -> Bundle:
        """Return what came as keys and payloads; the stamp of each is that of the gate."""
        which = np.array([self._find(key) for key, _ in passed], dtype=np.int64)
        ends = np.cumsum([GAP + len(payload) for _, payload in passed])
        buffer = bytearray(b"".join([part for _, payload in passed for part in (_GAP, payload)]))
        return Bundle(t_ns, seq, self.keys, which, np.full(len(passed), t_ns), ends, buffer)

    def _find(self, key: str) -> int:
        place = self._place.get(key)
        if place is None:
            place = self._place[key] = len(self.keys)
            self.keys.append(key)
        return place


class Selection:
    """What an agent reads of bundles.

    Args:
        reads: key expressions.
    """

    def __init__(self, reads: Sequence[str]) -> None:
        self._reads = tuple(reads)
        self._wanted: dict[str, bool] = {}

    def of(self, bundle: Bundle) -> list[tuple[str, Any]]:
        """Return keys and messages.

        Raises:
            DecodeError: one is no message of its key.
        """
        return [(key, messages.decode(key, payload)) for key, payload in bundle.encoded if self.takes(key)]

    def takes(self, key: str) -> bool:
        """Tell whether a key is read."""
        wanted = self._wanted.get(key)
        if wanted is None:
            wanted = self._wanted[key] = any(keys.matches(expression, key) for expression in self._reads)
        return wanted
