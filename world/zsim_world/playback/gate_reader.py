"""A record as the gates of a run, one after the other, a few of them in memory at a time."""

from collections import deque
from collections.abc import Collection, Iterator
from typing import NamedTuple

import msgspec

from zsim.contract import keys
from zsim.contract.messages import REFUSALS
from zsim.record import Recorded, RecordReader


class Gate(NamedTuple):
    """What was said at a gate: stamped after the gate before, up to this one; in the order in which it was written."""

    t_ns: int
    said: list[Recorded]


class _Clock(msgspec.Struct):
    state: str


_decode = msgspec.msgpack.Decoder(_Clock).decode


class Tape:
    """Plays a record from any gate on.

    An answer to a gate is written a few gates later, since the world runs ahead of those who answer; it is played with
    the gate that it is stamped with. What comes later than that by its stamp (of a program that stamps nothing, or in
    realtime) is played where it was written.

    Args:
        reader: of the record.
        gate_ns: of the run.
        delay_ns: of its commands, by which the world may be ahead.
        wanted: keys.
    """

    def __init__(self, reader: RecordReader, gate_ns: int, delay_ns: int, wanted: Collection[str]) -> None:
        self._reader = reader
        self._gate_ns = gate_ns
        self._slack_ns = delay_ns + gate_ns
        self._keys = {*wanted, keys.CLOCK}

    def gates(self, from_ns: int = 0) -> Iterator[Gate]:
        """Yield the gates from the first one at or after `from_ns` on; a gate that the record lacks is left out."""
        for gate in self._all(from_ns):
            if gate.t_ns >= from_ns:
                yield gate

    def _all(self, from_ns: int) -> Iterator[Gate]:
        held: dict[int, list[Recorded]] = {}
        ticks: deque[int] = deque()
        newest = None
        # What answers the first gate, or was sampled for it, may stand in a chunk that begins before it.
        for recorded in self._reader.messages(self._keys, by_time=False, from_ns=max(0, from_ns - self._slack_ns)):
            if recorded.key != keys.CLOCK:
                held.setdefault(self._home(recorded.t_ns, newest), []).append(recorded)
            elif (newest is None or recorded.t_ns > newest) and _runs(recorded.payload):
                newest = recorded.t_ns
                ticks.append(newest)
                while ticks[0] + self._slack_ns <= newest:
                    yield self._take(ticks.popleft(), held)
        for t_ns in ticks:
            yield self._take(t_ns, held)

    def _home(self, t_ns: int, newest: int | None) -> int:
        """Return the gate at which a message is played that was written after the clock of gate `newest`."""
        due_ns = -(-t_ns // self._gate_ns) * self._gate_ns
        if newest is None:
            return due_ns
        writing_ns = newest + self._gate_ns
        return due_ns if newest - self._slack_ns < due_ns <= writing_ns else writing_ns

    def _take(self, t_ns: int, held: dict[int, list[Recorded]]) -> Gate:
        """Return a gate; what has waited longer, for a gate that the record lacks, comes with it."""
        due = sorted(gate_ns for gate_ns in held if gate_ns <= t_ns)
        return Gate(t_ns, [recorded for gate_ns in due for recorded in held.pop(gate_ns)])


def _runs(payload: bytes) -> bool:
    """Tell whether a clock is that of a gate: while a run waits for its start, none has been published."""
    try:
        return _decode(payload).state != "waiting"
    except REFUSALS:
        return False  # of somebody else
