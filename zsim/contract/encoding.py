"""Encodes messages from rows of numbers as msgpack, to the same bytes as `messages.encode`.

A layout is the constant part of the messages of a kind: names, array heads, and the places of the values.

    rows of numbers ── write ──▶ bytes ── read ──▶ rows of numbers

`write` and `read` are plain functions for compilation by their users, which avoids an object per message.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Struct
from msgspec import inspect as kinds_of
from numpy.typing import NDArray

LITERAL, FLOATS, INT, BOOL, TEXT = range(5)
GAP = 31  # bytes left free before each payload: what a record puts there, see `zsim.record.mcap_layout.MESSAGE`
INT_BYTES_MAX, FLOAT_BYTES = 9, 9
FLOAT64, FALSE, TRUE, MAP = 0xCB, 0xC2, 0xC3, 0x80  # msgpack's marks
UINT8, INT8 = 0xCC, 0xD0  # and those of 16, 32 and 64 bits after them
COUNT_MAX = 0x7F  # largest whole number that is its own mark
INFINITE = np.uint64(0x7FF0_0000_0000_0000)  # exponent of what is not finite


_WHOLE = {
    kinds_of.IntType: INT,
    kinds_of.BoolType: BOOL,
    kinds_of.LiteralType: TEXT,
    kinds_of.StrType: TEXT,
    kinds_of.UnionType: TEXT,
}
packed = msgspec.msgpack.Encoder().encode


class Program(NamedTuple):
    """The layouts of some kinds in the form used by `write`."""

    ops: NDArray[np.int64]  # (K, 3): what, and its two arguments
    first: NDArray[np.int64]  # (kinds + 1,), where the layout of each kind begins
    literals: NDArray[np.uint8]


class TextTable(NamedTuple):
    """Texts that may stand in a message, by number."""

    data: NDArray[np.uint8]
    ends: NDArray[np.int64]


class Layouts:
    """The layouts of messages of some kinds.

    A kind's whole numbers, truths and texts (by their number in Words) stand in one row, its floats in another, both
    in the order of its fields.

    Args:
        kinds: of messages, in the order in which `write` counts them; with the length of its array, where a kind has
            one that may be of several lengths.

    Raises:
        TypeError: a field is of a type that has no place here.
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

    def room(self, words: TextTable) -> int:
        """Return the maximum size of a message, including GAP [bytes]."""
        longest = int(np.diff(words.ends, prepend=0).max(initial=0))
        fixed = sum(size for op, _, size in self._ops if op == LITERAL)
        return GAP + fixed + self.floats * FLOAT_BYTES + self.ints * max(INT_BYTES_MAX, longest)

    def _add(self, kind: type[Struct], length: int = 0) -> None:
        fields: Any = kinds_of.type_info(kind)
        self._int = self._float = 0
        self._ops.append((LITERAL, len(self._literals), 0))
        self._literal(bytes([MAP | len(fields.fields)]))
        for field in fields.fields:
            self._literal(packed(field.encode_name))
            own = field.type
            if type(own) in _WHOLE:
                self._ops.append((_WHOLE[type(own)], self._int, 0))
                self._int += 1
                continue
            count = 1
            if isinstance(own, kinds_of.TupleType) or (isinstance(own, kinds_of.VarTupleType) and length):
                count = len(own.item_types) if isinstance(own, kinds_of.TupleType) else length
                self._literal(array_head(count))
            elif not isinstance(own, kinds_of.FloatType):
                raise TypeError(f"{kind.__name__}: {field.encode_name} is of a type that has no fixed place in a row")
            self._ops.append((FLOATS, self._float, count))
            self._float += count
        self.ints, self.floats = max(self.ints, self._int), max(self.floats, self._float)

    def _literal(self, data: bytes) -> None:
        op, place, size = self._ops[-1]
        if op == LITERAL:
            self._ops[-1] = (LITERAL, place, size + len(data))
        else:
            self._ops.append((LITERAL, len(self._literals), len(data)))
        self._literals += data


def array_head(size: int) -> bytes:
    return packed([0] * size)[:-size]


def words(texts: Iterable[str | None]) -> TextTable:
    """Return texts as `write` reads them."""
    parts = [packed(text) for text in texts]
    return TextTable(np.frombuffer(b"".join(parts), dtype=np.uint8), np.cumsum([len(part) for part in parts]))


def write(program: Program, words: TextTable, kind: int, ints: NDArray, bits: NDArray, out: NDArray, start: int) -> int:
    """Write one message into `out` from `start` on; return its end. To be compiled.

    Args:
        program, words: see Layouts.
        ints: its whole numbers (I,); bits: its floats (F,) as uint64.
        out: uint8, large enough.
    """
    at = np.uint64(start)  # a place without a sign is not looked at for being negative: bytes become words
    for k in range(program.first[kind], program.first[kind + 1]):
        op, place, size = program.ops[k, 0], program.ops[k, 1], program.ops[k, 2]
        if op == LITERAL:
            for i in range(np.uint64(size)):
                out[at + i] = program.literals[np.uint64(place) + i]
            at += np.uint64(size)
        elif op == FLOATS:
            for column in range(place, place + size):
                word = bits[column]
                out[at] = FLOAT64
                for i in range(8):
                    out[at + np.uint64(1 + i)] = (word >> np.uint64(56 - 8 * i)) & np.uint64(0xFF)
                at += np.uint64(FLOAT_BYTES)
        elif op == BOOL:
            out[at] = TRUE if ints[place] else FALSE
            at += np.uint64(1)
        elif op == TEXT:
            word = ints[place]
            for i in range(words.ends[word - 1] if word else 0, words.ends[word]):
                out[at] = words.data[i]
                at += np.uint64(1)
        else:
            value, size = ints[place], 1
            if value < -32 or value > 127:
                reach, free = (value, 8) if value > 0 else (-1 - value, 7)  # int8 reaches to -128, uint8 to 255
                power = 0 if reach < 1 << free else 1 if reach < 1 << free + 8 else 2 if reach < 1 << free + 24 else 3
                size = 1 << power
                out[at] = (UINT8 if value > 0 else INT8) + power
                at += np.uint64(1)
            for i in range(size):
                out[at] = (value >> (8 * (size - 1 - i))) & 0xFF
                at += np.uint64(1)
    return int(np.int64(at))


def read(program: Program, kind: int, data: NDArray, start: int, end: int, ints: NDArray, bits: NDArray) -> bool:
    """Read a message that `write` has written; return False for any other, which may still be valid.

    It reads finite floats, booleans and non-negative whole numbers, but no texts. To be compiled.

    Args:
        program: see Layouts.
        data: uint8; the message is what stands in [start, end).
        ints: takes its whole numbers (I,); bits: its floats (F,) as uint64.
    """
    at, stop = np.uint64(start), np.uint64(end)
    for k in range(program.first[kind], program.first[kind + 1]):
        op, place, size = program.ops[k, 0], program.ops[k, 1], program.ops[k, 2]
        if at + np.uint64(size if op == LITERAL else size * FLOAT_BYTES if op == FLOATS else 1) > stop:
            return False
        mark = np.int64(data[at])
        if op == LITERAL:
            for i in range(np.uint64(size)):
                if data[at + i] != program.literals[np.uint64(place) + i]:
                    return False
            at += np.uint64(size)
        elif op == FLOATS:
            for column in range(place, place + size):
                word = np.uint64(0)
                for i in range(8):
                    word |= np.uint64(data[at + np.uint64(1 + i)]) << np.uint64(56 - 8 * i)
                if data[at] != FLOAT64 or (word & INFINITE) == INFINITE:
                    return False
                bits[column] = word
                at += np.uint64(FLOAT_BYTES)
        elif op == BOOL and mark in (FALSE, TRUE):
            ints[place] = mark == TRUE
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
            ints[place] = value
            at += np.uint64(1 + size)
        else:
            return False
    return at == stop
