"""Many messages in one payload: packing, unpacking, and access without decoding each one.

    @gate, @gate/{drone}   the world's messages about its drones at one gate           GateMessages
    @batch                 [key, payload] of everything that passed the hub, in order  encode_batch, decode_batch

Sent singly, each message of a gate would wake every reader and the hub. These keys are outside the contract and begin
with `@`, which no wildcard of Zenoh matches: a subscriber to `**` receives only the single messages.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from operator import sub
from typing import Any, Generic, NoReturn, TypeVar

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.contract import keys, messages
from zsim.contract.encoding import GAP
from zsim.contract.messages import REFUSALS
from zsim.errors import DecodeError
from zsim.schema.message import Count

KINDS = (*keys.SENSORS, "truth", "status")  # of the messages about a drone
BATCH_MAX = 5_000  # messages of one batch; a flood of somebody's messages goes into several
Pairs = list[tuple[str, bytes]]  # keys and payloads, in the order in which they were published
_INT = np.dtype("<i8")
PATTERNS_MAX = 64  # of keys of a gate, remembered by a reader; sensors of six rates have fewer
T = TypeVar("T")


def key_table(drones: Sequence[str], own: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the keys of the world's messages about some drones, drone by drone in the order of KINDS.

    `own` names the users' sensors of the run, the sightings and the scanners; their keys follow those of KINDS.
    """
    kinds = (*KINDS, *own)
    return tuple(keys.truth(d) if kind == "truth" else keys.sensor(d, kind) for d in drones for kind in kinds)


def run_key_table(info: messages.Info) -> tuple[str, ...]:
    return key_table([drone.name for drone in info.drones], info.sensors_beside)


@lru_cache(maxsize=8)
def _places(table: tuple[str, ...]) -> dict[str, int]:
    return {key: place for place, key in enumerate(table)}


class _PackedGate(Struct, array_like=True, gc=False):
    """GateMessages on the wire; whole numbers as little-endian int64."""

    t_ns: Count
    seq: Count
    which: bytes
    stamps: bytes
    ends: bytes
    buffer: bytes


_encode = msgspec.msgpack.Encoder().encode
_decode_gate = msgspec.msgpack.Decoder(_PackedGate).decode
_decode_batch = msgspec.msgpack.Decoder(Pairs).decode


@dataclass(eq=False)
class GateMessages:
    """The world's messages about its drones at one gate, M of them in order of publication: columns and one buffer.

    Message m is on the key table[which[m]], is stamped stamps[m], and its payload is
    buffer[ends[m - 1] + GAP : ends[m]]. Columns that came over the wire may point outside of table and buffer:
    `check` them before they are followed, or compare as they are read.
    """

    t_ns: int  # gate [ns]
    seq: int  # number of the gate
    table: tuple[str, ...]  # keys; the same object at every gate
    which: NDArray[np.int64]  # place of each message's key in the table, (M,)
    stamps: NDArray[np.int64]  # t_ns of each [ns], (M,)
    ends: NDArray[np.int64]  # where each ends in the buffer, (M,); GAP bytes before each payload are free
    buffer: bytes | bytearray  # owned by this object
    first: Sequence[int] = ()  # where the messages of each drone begin, and their end, (N + 1,); empty if not known

    @classmethod
    def of(
        cls,
        t_ns: int,
        seq: int,
        table: tuple[str, ...],
        pairs: Sequence[tuple[str, bytes]],  # keys, which are in the table, and payloads
        stamps: Sequence[int] | None = None,  # t_ns of each [ns]; None stamps all with the gate
        first: Sequence[int] = (),
    ) -> "GateMessages":
        """Return encoded messages as one object."""
        places = _places(table)
        which = np.array([places[key] for key, _ in pairs], dtype=np.int64)
        ends = np.cumsum([GAP + len(payload) for _, payload in pairs])
        buffer = b"".join([bytes(GAP) + payload for _, payload in pairs])
        times = np.array([t_ns] * len(pairs) if stamps is None else stamps, dtype=np.int64)
        return cls(t_ns, seq, table, which, times, ends, buffer, first)

    @classmethod
    def unpack(cls, payload: bytes, table: tuple[str, ...]) -> "GateMessages":
        """Return the messages packed by `pack`, not yet checked; DecodeError if the payload is anything else."""
        try:
            p = _decode_gate(payload)
        except REFUSALS as error:
            _refuse(str(error))
        if not len(p.which) == len(p.stamps) == len(p.ends) or len(p.which) % _INT.itemsize:
            _refuse("its columns differ in length")
        which, stamps, ends = (np.frombuffer(column, _INT) for column in (p.which, p.stamps, p.ends))
        return cls(p.t_ns, p.seq, table, which, stamps, ends, p.buffer)

    def pack(self, first: int = 0, last: int | None = None) -> bytes:
        """Return messages [first, last) as one payload."""
        start = int(self.ends[first - 1]) if first else 0
        ends = self.ends[first:last] - start
        data = bytes(memoryview(self.buffer)[start : start + int(ends[-1])])
        which, stamps = self.which[first:last].tobytes(), self.stamps[first:last].tobytes()
        return _encode(_PackedGate(self.t_ns, self.seq, which, stamps, ends.tobytes(), data))

    def __len__(self) -> int:
        return len(self.which)

    def check(self) -> None:
        """Raise DecodeError for columns that point outside table or buffer, and for negative stamps."""
        which, stamps, ends = self.which.tolist(), self.stamps.tolist(), self.ends.tolist()
        if not ends or ends[-1] != len(self.buffer) or min(map(sub, ends, [0, *ends])) < GAP:
            _refuse("its payloads are not one behind the other")
        if min(which) < 0 or max(which) >= len(self.table):
            _refuse("a key is not in its table")
        if min(stamps) < 0:
            _refuse("a stamp is below 0")

    @cached_property
    def pairs(self) -> Pairs:
        data, table = bytes(self.buffer), self.table
        places: list[int] = self.which.tolist()
        bounds = pairwise([0, *self.ends.tolist()])
        return [(table[p], data[start + GAP : end]) for p, (start, end) in zip(places, bounds, strict=True)]

    def decoded(self) -> Iterator[tuple[str, Any]]:
        """Yield keys and messages; DecodeError if a message does not fit its key."""
        for key, payload in self.pairs:
            yield key, messages.decode(key, payload)

    def payload(self, m: int) -> bytes:
        start: int = self.ends.item(m - 1) if m else 0
        return bytes(self.buffer[start + GAP : self.ends.item(m)])


class PerPattern(Generic[T]):
    """A cache of what a reader derives by `learn` from the keys of a gate, since the same keys recur."""

    def __init__(self, learn: Callable[[GateMessages], T]) -> None:
        self._learn = learn
        self._table: Sequence[str] = ()
        self._known: dict[bytes, T] = {}

    def of(self, gate: GateMessages) -> T:
        if gate.table is not self._table:
            self._table = gate.table
            self._known.clear()
        pattern = gate.which.tobytes()
        known = self._known.get(pattern)
        if known is None:
            known = self._learn(gate)
            if len(self._known) < PATTERNS_MAX:
                self._known[pattern] = known
        return known


def _refuse(reason: str) -> NoReturn:
    raise DecodeError(f"{keys.GATE}: {reason}; must be the messages of a gate")


def encode_batch(passed: Pairs) -> bytes:
    return _encode(passed)


def decode_batch(payload: bytes) -> Pairs:
    """Return the [key, payload] pairs of a batch; DecodeError if it is not a batch."""
    try:
        return _decode_batch(payload)
    except REFUSALS as error:
        raise DecodeError(f"{keys.BATCH}: {error}; must be a list of [key, payload]") from error


def pairs_of(result: Any) -> Pairs:
    """Return the [key, payload] pairs in the result of an answer; DecodeError if the payload is anything else."""
    try:
        return msgspec.convert(result, Pairs, builtin_types=(bytes,))  # or texts would pass as base64
    except REFUSALS as error:
        raise DecodeError(f"result: {error}; must be a list of [key, payload]") from error
