"""Many messages at once as bytes: those of a gate, written from rows of numbers, and several in one payload.

    @gate, @gate/{drone}   the world's messages about its drones at one gate         GateMessages
    @batch                 [key, payload] of the messages through the hub, in order  encode_batch, decode_batch

If the messages of a gate were sent one by one, each would wake every reader and the hub. These keys are outside the
contract and begin with `@`, which no wildcard of Zenoh matches: a subscriber to `**` receives only the single messages.

    rows of numbers ── write ──▶ bytes ── read ──▶ rows of numbers

A layout is the constant part of a kind of message: names, array heads, and the positions of the values. `write` and
`read`, plain functions for their callers to compile, need no object per message; `write` gives the same
bytes as `messages.encode`.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from operator import sub
from typing import Any, Generic, NamedTuple, NoReturn, TypeVar

import msgspec
import numpy as np
from msgspec import Struct
from msgspec import inspect as kinds_of
from numpy.typing import NDArray

from zsim.contract import keys, messages
from zsim.contract.messages import REFUSALS
from zsim.errors import DecodeError
from zsim.schema.message import Count

KINDS = (*keys.SENSORS, "truth", "status")  # kinds of messages about a drone
BATCH_MAX = 5_000  # maximum number of messages per batch; more are split into several batches
Pairs = list[tuple[str, bytes]]  # keys and payloads in order of publication
_INT = np.dtype("<i8")
PATTERNS_MAX = 64  # maximum number of gates' key patterns cached by a reader; sensors with six rates have fewer
T = TypeVar("T")

LITERAL, FLOATS, INT, BOOL, TEXT = range(5)  # parts of a layout
GAP = 31  # bytes reserved before each payload for a record's message head, `zsim.record.mcap_layout.MESSAGE`
INT_BYTES_MAX, FLOAT_BYTES = 9, 9
FLOAT64, FALSE, TRUE, MAP = 0xCB, 0xC2, 0xC3, 0x80  # msgpack's type bytes
UINT8, INT8 = 0xCC, 0xD0  # followed by the type bytes for 16, 32 and 64 bits
COUNT_MAX = 0x7F  # largest integer that is its own type byte
INFINITE = np.uint64(0x7FF0_0000_0000_0000)  # exponent bits of infinities and NaN
_encode = msgspec.msgpack.Encoder().encode
_SCALAR_OPS = {
    kinds_of.IntType: INT,
    kinds_of.BoolType: BOOL,
    kinds_of.LiteralType: TEXT,
    kinds_of.StrType: TEXT,
    kinds_of.UnionType: TEXT,
}


def key_table(drones: Sequence[str], own: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the keys of the world's messages about `drones`, drone by drone, each in the order of KINDS.

    `own` names the run's user sensors, sightings and scanners, whose keys follow those of KINDS.
    """
    kinds = (*KINDS, *own)
    return tuple(keys.truth(d) if kind == "truth" else keys.sensor(d, kind) for d in drones for kind in kinds)


def run_key_table(info: messages.Info) -> tuple[str, ...]:
    return key_table([drone.name for drone in info.drones], info.sensors_beside)


@lru_cache(maxsize=8)
def _key_indices(table: tuple[str, ...]) -> dict[str, int]:
    return {key: index for index, key in enumerate(table)}


class _PackedGate(Struct, array_like=True, gc=False):
    """GateMessages as sent; the columns are little-endian int64."""

    t_ns: Count
    seq: Count
    which: bytes
    stamps: bytes
    ends: bytes
    buffer: bytes


_decode_gate = msgspec.msgpack.Decoder(_PackedGate).decode
_decode_batch = msgspec.msgpack.Decoder(Pairs).decode


@dataclass(eq=False)
class GateMessages:
    """The world's M messages about its drones at one gate, in order of publication, as columns and one buffer.

    Message m has the key table[which[m]], the stamp stamps[m] and the payload buffer[ends[m - 1] + GAP : ends[m]].
    Columns received from another process may point outside table and buffer: `check` them, or check each index before
    using it.
    """

    t_ns: int  # gate [ns]
    seq: int  # number of the gate
    table: tuple[str, ...]  # keys; the same object at every gate
    which: NDArray[np.int64]  # index of each message's key in the table, (M,)
    stamps: NDArray[np.int64]  # t_ns of each message [ns], (M,)
    ends: NDArray[np.int64]  # end of each payload in the buffer, (M,); GAP bytes before each payload are reserved
    buffer: bytes | bytearray  # owned by this object
    first: Sequence[int] = ()  # index of each drone's first message, then M, (N + 1,); empty if unknown

    @classmethod
    def of(
        cls,
        t_ns: int,
        seq: int,
        table: tuple[str, ...],
        pairs: Sequence[tuple[str, bytes]],  # keys in the table, and payloads
        stamps: Sequence[int] | None = None,  # t_ns of each message [ns]; None: the gate's
        first: Sequence[int] = (),
    ) -> "GateMessages":
        """Return encoded messages as one object."""
        indices = _key_indices(table)
        which = np.array([indices[key] for key, _ in pairs], dtype=np.int64)
        ends = np.cumsum([GAP + len(payload) for _, payload in pairs])
        buffer = b"".join([bytes(GAP) + payload for _, payload in pairs])
        times = np.array([t_ns] * len(pairs) if stamps is None else stamps, dtype=np.int64)
        return cls(t_ns, seq, table, which, times, ends, buffer, first)

    @classmethod
    def unpack(cls, payload: bytes, table: tuple[str, ...]) -> "GateMessages":
        """Return the messages packed by `pack`, unchecked; raise DecodeError for any other payload."""
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
            _refuse("its payloads are not contiguous")
        if min(which) < 0 or max(which) >= len(self.table):
            _refuse("a key is not in its table")
        if min(stamps) < 0:
            _refuse("a stamp is negative")

    @cached_property
    def pairs(self) -> Pairs:
        data, table = bytes(self.buffer), self.table
        indices: list[int] = self.which.tolist()
        bounds = pairwise([0, *self.ends.tolist()])
        return [(table[p], data[start + GAP : end]) for p, (start, end) in zip(indices, bounds, strict=True)]

    def decoded(self) -> Iterator[tuple[str, Any]]:
        """Yield keys and messages; raise DecodeError if a message does not fit its key."""
        for key, payload in self.pairs:
            yield key, messages.decode(key, payload)

    def payload(self, m: int) -> bytes:
        start: int = self.ends.item(m - 1) if m else 0
        return bytes(self.buffer[start + GAP : self.ends.item(m)])


class PerPattern(Generic[T]):
    """A cache of what `learn` derives from the keys of a gate's messages, since the same sequences of keys recur."""

    def __init__(self, learn: Callable[[GateMessages], T]) -> None:
        self._learn = learn
        self._table: Sequence[str] = ()
        self._learned: dict[bytes, T] = {}

    def of(self, gate: GateMessages) -> T:
        if gate.table is not self._table:
            self._table = gate.table
            self._learned.clear()
        pattern = gate.which.tobytes()
        learned = self._learned.get(pattern)
        if learned is None:
            learned = self._learn(gate)
            if len(self._learned) < PATTERNS_MAX:
                self._learned[pattern] = learned
        return learned


def _refuse(reason: str) -> NoReturn:
    raise DecodeError(f"{keys.GATE}: {reason}; must be the messages of a gate")


def encode_batch(passed: Pairs) -> bytes:
    return _encode(passed)


def decode_batch(payload: bytes) -> Pairs:
    """Return the [key, payload] pairs of a batch; raise DecodeError if the payload is no batch."""
    try:
        return _decode_batch(payload)
    except REFUSALS as error:
        raise DecodeError(f"{keys.BATCH}: {error}; must be a list of [key, payload]") from error


def pairs_of(result: Any) -> Pairs:
    """Return the [key, payload] pairs in the result of an answer; raise DecodeError for any other result."""
    try:
        return msgspec.convert(result, Pairs, builtin_types=(bytes,))  # otherwise texts would pass as base64
    except REFUSALS as error:
        raise DecodeError(f"result: {error}; must be a list of [key, payload]") from error


class Program(NamedTuple):
    """The layouts of some kinds of messages, in the form used by `write` and `read`."""

    ops: NDArray[np.int64]  # (K, 3): operation and its two arguments
    first: NDArray[np.int64]  # (kinds + 1,), index of the first operation of each kind, then K
    literals: NDArray[np.uint8]


class TextTable(NamedTuple):
    """Encoded texts that a message may contain, referred to by index."""

    data: NDArray[np.uint8]
    ends: NDArray[np.int64]


class Layouts:
    """The layouts of some kinds of messages.

    One row holds a message's integers, booleans and texts (as indices into a TextTable), another its floats, both in
    the order of its fields.

    Args:
        kinds: message classes, in the order in which `write` numbers them; a class with an array of variable length is
            paired with that length.

    Raises:
        TypeError: a field has a type without a fixed layout.
    """

    def __init__(self, kinds: Iterable[type[Struct] | tuple[type[Struct], int]]) -> None:
        self._literals = bytearray()
        self._ops: list[tuple[int, int, int]] = []
        self.ints = self.floats = self._int = self._float = 0
        first = [0]
        for kind in kinds:
            self._add(*kind) if isinstance(kind, tuple) else self._add(kind)
            first.append(len(self._ops))
        ops, literals = np.array(self._ops, dtype=np.int64), np.frombuffer(bytes(self._literals), dtype=np.uint8)
        self.program = Program(ops, np.array(first), literals)

    def room(self, texts: TextTable) -> int:
        """Return an upper bound on the size of a message, including GAP [bytes]."""
        longest = int(np.diff(texts.ends, prepend=0).max(initial=0))
        fixed = sum(size for op, _, size in self._ops if op == LITERAL)
        return GAP + fixed + self.floats * FLOAT_BYTES + self.ints * max(INT_BYTES_MAX, longest)

    def _add(self, kind: type[Struct], length: int = 0) -> None:
        fields: Any = kinds_of.type_info(kind)
        self._int = self._float = 0
        self._ops.append((LITERAL, len(self._literals), 0))
        self._literal(bytes([MAP | len(fields.fields)]))
        for field in fields.fields:
            self._literal(_encode(field.encode_name))
            own = field.type
            if type(own) in _SCALAR_OPS:
                self._ops.append((_SCALAR_OPS[type(own)], self._int, 0))
                self._int += 1
                continue
            count = 1
            if isinstance(own, kinds_of.TupleType) or (isinstance(own, kinds_of.VarTupleType) and length):
                count = len(own.item_types) if isinstance(own, kinds_of.TupleType) else length
                self._literal(array_head(count))
            elif not isinstance(own, kinds_of.FloatType):
                raise TypeError(f"{kind.__name__}: {field.encode_name} has a type without a fixed layout")
            self._ops.append((FLOATS, self._float, count))
            self._float += count
        self.ints, self.floats = max(self.ints, self._int), max(self.floats, self._float)

    def _literal(self, data: bytes) -> None:
        op, offset, size = self._ops[-1]
        if op == LITERAL:
            self._ops[-1] = (LITERAL, offset, size + len(data))
        else:
            self._ops.append((LITERAL, len(self._literals), len(data)))
        self._literals += data


def array_head(size: int) -> bytes:
    return _encode([0] * size)[:-size]


def text_table(texts: Iterable[str | None]) -> TextTable:
    """Return the table of some texts for `write`."""
    parts = [_encode(text) for text in texts]
    return TextTable(np.frombuffer(b"".join(parts), dtype=np.uint8), np.cumsum([len(part) for part in parts]))


def write(program: Program, texts: TextTable, kind: int, ints: NDArray, bits: NDArray, out: NDArray, start: int) -> int:
    """Write one message into `out` at `start`; return its end. To be compiled by the caller.

    Args:
        program: `program` of Layouts; texts: table of its texts; kind: index of the message's class in the Layouts.
        ints: the message's integers, (I,); bits: its floats as uint64, (F,).
        out: bytes (uint8), with at least `Layouts.room` of them from `start` on.
    """
    at = np.uint64(start)  # unsigned indices need no test for negative values: byte loops become word copies
    for k in range(program.first[kind], program.first[kind + 1]):
        op, offset, size = program.ops[k, 0], program.ops[k, 1], program.ops[k, 2]
        if op == LITERAL:
            for i in range(np.uint64(size)):
                out[at + i] = program.literals[np.uint64(offset) + i]
            at += np.uint64(size)
        elif op == FLOATS:
            for column in range(offset, offset + size):
                word = bits[column]
                out[at] = FLOAT64
                for i in range(8):
                    out[at + np.uint64(1 + i)] = (word >> np.uint64(56 - 8 * i)) & np.uint64(0xFF)
                at += np.uint64(FLOAT_BYTES)
        elif op == BOOL:
            out[at] = TRUE if ints[offset] else FALSE
            at += np.uint64(1)
        elif op == TEXT:
            word = ints[offset]
            for i in range(texts.ends[word - 1] if word else 0, texts.ends[word]):
                out[at] = texts.data[i]
                at += np.uint64(1)
        else:
            value, size = ints[offset], 1
            if value < -32 or value > 127:
                mag, free = (value, 8) if value > 0 else (-1 - value, 7)  # int8 from -128, uint8 up to 255
                power = 0 if mag < 1 << free else 1 if mag < 1 << free + 8 else 2 if mag < 1 << free + 24 else 3
                size = 1 << power
                out[at] = (UINT8 if value > 0 else INT8) + power
                at += np.uint64(1)
            for i in range(size):
                out[at] = (value >> (8 * (size - 1 - i))) & 0xFF
                at += np.uint64(1)
    return int(np.int64(at))


def read(program: Program, kind: int, data: NDArray, start: int, end: int, ints: NDArray, bits: NDArray) -> bool:
    """Read a message written by `write`; return False for any other, even if valid.

    Reads finite floats, booleans and non-negative integers, but no texts. To be compiled by the caller.

    Args:
        program: `program` of Layouts; kind: index of the message's class in the Layouts.
        data: bytes (uint8), with the message in [start, end).
        ints, bits: filled by this function with the message's integers, (I,), and its floats as uint64, (F,).
    """
    at, stop = np.uint64(start), np.uint64(end)
    for k in range(program.first[kind], program.first[kind + 1]):
        op, offset, size = program.ops[k, 0], program.ops[k, 1], program.ops[k, 2]
        if at + np.uint64(size if op == LITERAL else size * FLOAT_BYTES if op == FLOATS else 1) > stop:
            return False
        mark = np.int64(data[at])
        if op == LITERAL:
            for i in range(np.uint64(size)):
                if data[at + i] != program.literals[np.uint64(offset) + i]:
                    return False
            at += np.uint64(size)
        elif op == FLOATS:
            for column in range(offset, offset + size):
                word = np.uint64(0)
                for i in range(8):
                    word |= np.uint64(data[at + np.uint64(1 + i)]) << np.uint64(56 - 8 * i)
                if data[at] != FLOAT64 or (word & INFINITE) == INFINITE:
                    return False
                bits[column] = word
                at += np.uint64(FLOAT_BYTES)
        elif op == BOOL and mark in (FALSE, TRUE):
            ints[offset] = mark == TRUE
            at += np.uint64(1)
        elif op == INT and (mark <= COUNT_MAX or UINT8 <= mark < INT8):
            size = 0 if mark <= COUNT_MAX else 1 << (mark - UINT8)
            value = mark if size == 0 else np.int64(0)
            if at + np.uint64(1 + size) > stop:
                return False
            for i in range(size):
                value = (value << 8) | np.int64(data[at + np.uint64(1 + i)])
            if value < 0:
                return False
            ints[offset] = value
            at += np.uint64(1 + size)
        else:
            return False
    return at == stop
