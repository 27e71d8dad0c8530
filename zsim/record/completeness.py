"""Completeness of a record: every gate, every sequence number on the world's keys, and the end of the run.

The world numbers its messages without gaps, so that the record shows which are missing. Messages of other processes are
not counted: those that never reached the world do not belong in the record.
"""

from collections.abc import Callable, Container
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.contract import keys, messages, run_messages
from zsim.errors import DecodeError
from zsim.record.record_reader import MessageSpans, RecordReader, shown


class GateGap(Struct, frozen=True):
    """Consecutive missing gates: their count, and the times of the first and the last [ns]."""

    gates: int
    from_ns: int
    to_ns: int

    def __str__(self) -> str:
        if self.gates == 1:
            return f"1 at {self.from_ns / 1e9:.2f} s"
        return f"{self.gates} from {self.from_ns / 1e9:.2f} to {self.to_ns / 1e9:.2f} s"


class GateCount:
    """Counts the gates of a run by its clock messages, added in the order in which the world published them.

    Args:
        previous: clock message after which counting begins; None for the start of the run.
    """

    def __init__(self, previous: run_messages.Clock | None = None) -> None:
        self.gates = 0  # number of gates so far
        self.gaps: list[GateGap] = []  # gaps so far
        self.ended = False  # whether the last clock message stated the end of the run
        self._step, self._seq = (previous.step, previous.seq) if previous else (-1, -1)

    def add(self, clock: run_messages.Clock) -> GateGap | None:
        """Count the gate of a clock message; return the gates missing before it, or None.

        No gate is missing if the sequence number is the next one, even if a replay has jumped in time.
        """
        gap, missing = None, clock.step - self._step - 1
        if missing > 0 and clock.seq != self._seq + 1:
            gate_ns = clock.t_ns // clock.step
            gap = GateGap(missing, clock.t_ns - missing * gate_ns, clock.t_ns - gate_ns)
            self.gaps.append(gap)
        self.gates += clock.step != self._step
        self.ended = clock.state == "stopped"
        self._step, self._seq = clock.step, clock.seq
        return gap

    def misses(self, clock: run_messages.Clock) -> bool:
        return clock.seq > self._seq + 1


class Completeness(Struct, frozen=True):
    """What a record contains and what it lacks."""

    gates: int = 0  # gates in the record
    gaps: tuple[GateGap, ...] = ()  # missing gates
    messages_missing: int = 0  # missing messages of the world by sequence number, including those of missing gates
    ended: bool = True  # whether the record contains the end of the run
    closed: bool = True  # whether its writer has closed it
    last_ns: int = 0  # time of the last gate
    damaged: tuple[str, ...] = ()  # unreadable parts, with their positions

    @property
    def complete(self) -> bool:
        return not self.faults()

    @property
    def gates_missing(self) -> int:
        return sum(gap.gates for gap in self.gaps)

    def faults(self) -> list[str]:
        faults = []
        if self.gaps:
            total = self.gates + self.gates_missing
            faults.append(
                f"{self.gates_missing} of {total} gates are missing: {shown([str(gap) for gap in self.gaps])}"
            )
        elif self.messages_missing:
            faults.append(f"{self.messages_missing} messages of the world are missing")
        if not self.ended:
            faults.append(f"the end of the run is missing; the record ends at {self.last_ns / 1e9:.2f} s")
        if self.damaged:
            faults.append(f"damaged: {shown(self.damaged)}")
        if not self.closed:
            faults.append("it was cut off: its writer did not close it")
        return faults

    def __str__(self) -> str:
        return f"incomplete: {'; '.join(faults)}" if (faults := self.faults()) else f"complete: {self.gates} gates"


class _Numbered(Struct):
    seq: int


UNREAD = -1  # replaces a sequence number that is not encoded as zsim's encoder would
_WIDTH = np.full(256, -1, dtype=np.int64)  # bytes after the first of a MessagePack unsigned integer, by its first byte
_WIDTH[:0x80] = 0
_WIDTH[[0xCC, 0xCD, 0xCE, 0xCF]] = 1, 2, 4, 8
_T_NS, _SEQ = (np.frombuffer(msgspec.msgpack.encode(name), np.uint8) for name in ("t_ns", "seq"))
_MAP_16 = 0xDE  # first byte of a map of more than 15 fields
SECOND_NS = 1_000_000_000
_PADDING_BYTES = 1 << 5  # bytes of padding; the first two fields of a message always end within this length


def sequence_numbers(spans: MessageSpans) -> NDArray[np.int64]:
    """Return `seq` of each message, (M,); UNREAD for messages that do not begin with `t_ns` and `seq`."""
    data = np.frombuffer(spans.content + bytes(_PADDING_BYTES), np.uint8)
    start = spans.start
    first = start + np.where(data[start] == _MAP_16, 3, 1)
    width = _WIDTH[data[first + len(_T_NS)]]
    second = first + len(_T_NS) + 1 + width
    is_readable = (data[first[:, None] + np.arange(len(_T_NS))] == _T_NS).all(axis=1) & (width >= 0)
    is_readable &= (data[second[:, None] + np.arange(len(_SEQ))] == _SEQ).all(axis=1)
    tag = data[second + len(_SEQ)].astype(np.int64)
    width = _WIDTH[tag]
    value = second + len(_SEQ) + 1
    is_readable &= (width >= 0) & (value + width <= spans.end)
    numbers = np.where(is_readable & (width == 0), tag, UNREAD)
    for size in (1, 2, 4, 8):
        rows = np.flatnonzero(is_readable & (width == size))
        written = data[value[rows, None] + np.arange(size)]
        numbers[rows] = np.ascontiguousarray(written).view(f">u{size}")[:, 0].astype(np.int64)
    return numbers


class _Numbers:
    """Collects the sequence numbers of some channels' messages, in any order."""

    def __init__(self) -> None:
        self._channels: list[NDArray[np.int64]] = []
        self._numbers: list[NDArray[np.int64]] = []
        self._decode = msgspec.msgpack.Decoder(_Numbered).decode

    def add(self, spans: MessageSpans, rows: NDArray[np.bool_]) -> None:
        read = np.where(rows, sequence_numbers(spans), 0)
        for m in np.flatnonzero(read < 0).tolist():  # from another encoder, or garbage without a number
            with suppress(*messages.REFUSALS, OverflowError):
                read[m] = self._decode(spans.content[spans.start[m] : spans.end[m]]).seq
        rows = rows & (read >= 0)
        self._channels.append(spans.channel[rows])
        self._numbers.append(read[rows])

    def missing(self) -> int:
        """Return the count of missing numbers below the highest one of each channel."""
        if not self._numbers:
            return 0
        channel, number = np.concatenate(self._channels), np.concatenate(self._numbers)
        order = np.lexsort((number, channel))
        channel, number = channel[order], number[order]
        is_new, is_last = np.ones((2, len(channel)), dtype=bool)
        is_last[:-1] = channel[1:] != channel[:-1]
        is_new[1:] = is_last[:-1] | (number[1:] != number[:-1])
        return int(number[is_last].sum() + is_last.sum() - is_new.sum())


def completeness(
    reader: RecordReader,
    keys_beside: Container[str] = (),  # keys whose messages are passed to `take`, which saves reading the record twice
    # keys of which at least the last message and the first in every simulated second are passed to `take`
    keys_sampled: Container[str] = (),
    # called with key and payload of each of these messages, in the order in which they were written
    take: Callable[[str, bytes], None] = lambda key, payload: None,
) -> Completeness:
    """Return the completeness of a record, reading all of it and verifying every checksum."""
    info: messages.Info | None = None
    with suppress(DecodeError):
        info = messages.decode(keys.INFO, last.payload) if (last := reader.last(keys.INFO)) else None
    # the record of a replay has the replay's clock messages, but the sequence numbers of the replayed run
    is_replay = info is not None and bool(info.replay_of)
    external = {drone.name for drone in (info.drones if info else ()) if drone.body is not msgspec.UNSET}
    names = reader.channels()
    numbered = {n for n, key in names.items() if not is_replay and _is_numbered(key, external)}
    clock_channels = {n for n, key in names.items() if key == keys.CLOCK}
    extra = {n for n, key in names.items() if key in keys_beside}
    sampled = {n for n, key in names.items() if key in keys_sampled}
    numbers = _Numbers()
    clocks: list[run_messages.Clock] = []
    decode = msgspec.msgpack.Decoder(run_messages.Clock).decode
    for spans in reader.spans(numbered | clock_channels | extra | sampled):
        is_clock = np.isin(spans.channel, list(clock_channels))
        numbers.add(spans, np.isin(spans.channel, list(numbered)))
        selected = np.flatnonzero(np.isin(spans.channel, list(extra)) | _one_each_second(spans, sampled))
        for m in selected[np.argsort(spans.start[selected])].tolist():
            take(names[spans.channel.item(m)], spans.content[spans.start.item(m) : spans.end.item(m)])
        for start, end in zip(spans.start[is_clock].tolist(), spans.end[is_clock].tolist(), strict=True):
            with suppress(*messages.REFUSALS):  # another program's garbage is recorded as received
                clocks.append(decode(spans.content[start:end]))
    gates = GateCount()
    for clock in sorted(clocks, key=lambda clock: (clock.seq if is_replay else clock.t_ns, clock.seq)):
        gates.add(clock)
    return Completeness(
        gates=gates.gates,
        gaps=tuple(gates.gaps),
        messages_missing=numbers.missing(),
        ended=gates.ended,
        closed=reader.complete,
        last_ns=max((clock.t_ns for clock in clocks), default=0),
        damaged=reader.damaged or (("the name of a key, or an index",) if reader.differs() else ()),
    )


def _one_each_second(spans: MessageSpans, channels: set[int]) -> NDArray[np.bool_]:
    """Return which messages, (M,), are the first of their channel in a second, or its first or last in `spans`."""
    second, last = spans.t_ns // SECOND_NS, len(spans.channel) - 1
    changes = np.ones(last + 2, bool)  # whether the channel changes before each message, and after the last
    changes[1:-1] = spans.channel[1:] != spans.channel[:-1]
    begins = changes[:-1].copy()
    begins[1:] |= second[1:] != second[:-1]
    return (begins | changes[1:]) & np.isin(spans.channel, list(channels))


def record_completeness(path: Path) -> Completeness:
    """Return the completeness of the record at a path.

    Raises:
        RecordError: the record is missing or cannot be read.
    """
    with RecordReader(path) as reader:
        return completeness(reader)


def _is_numbered(key: str, external: Container[str]) -> bool:
    """Return whether only the world publishes on a key, numbering without gaps; False for keys of external drones."""
    group, drone, topic = keys.parts(key)
    if group != "drone":
        return key == keys.EVENT
    return keys.is_accepted(key) or (drone not in external and (topic == "truth" or topic.startswith("sensor/")))
