"""The messages of a record that are not on disk yet: payloads one behind the other, the heads written all at once."""

from array import array
from collections.abc import Iterator, Sequence

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from zsim.contract.framing import GateMessages
from zsim.record.mcap_layout import HEAD, INDEX_ENTRY, INDEX_HEAD, MESSAGE, MESSAGE_HEAD

_SEQUENCE_MASK = 2**32 - 1  # MCAP counts messages of a channel in 32 bits


class OpenChunk:
    """Message records whose heads are still free, and what is to stand in them.

    Channels are counted from 1. Its memory is kept from chunk to chunk: to be given pages anew would take longer than
    all that is done here.

    Args:
        room: bytes that a chunk commonly has, with its last message.
        counted: messages that each channel had in earlier chunks.

    Attributes:
        size: bytes of its records.
        since_ns: wall clock of the first of its messages.
    """

    def __init__(self, room: int, counted: Sequence[int] = (0,)) -> None:
        self._counted = np.array(counted, dtype=np.int64)
        self._room = room
        self._data = bytearray(room)
        self._begin()

    def _begin(self) -> None:
        if len(self._data) > 2 * self._room:
            self._data = bytearray(self._room)
        self.size, self.since_ns = 0, 0
        self._channels, self._ends = array("q"), array("q")
        self._log, self._published = array("Q"), array("Q")

    def add(self, channel: int, payload: bytes, t_ns: int, wall_ns: int) -> None:
        """Take one message; its times are such as MCAP can hold."""
        start = self.size + MESSAGE.size
        if start == MESSAGE.size:
            self.since_ns = wall_ns
        self.size = end = start + len(payload)
        if end > len(self._data):
            self._make_room(end)
        self._data[start:end] = payload
        self._channels.append(channel)
        self._ends.append(end)
        self._log.append(t_ns)
        self._published.append(wall_ns)

    def add_gate(self, channels: bytes, gate: GateMessages, wall_ns: int) -> None:
        """Take the messages of a gate, in whose buffer there is room before each for its head.

        Args:
            channels: number of each message's, int64.
        """
        if not self.size:
            self.since_ns = wall_ns
        self._channels.frombytes(channels)
        self._ends.frombytes((gate.ends + self.size).tobytes())
        self._log.frombytes(gate.stamps.tobytes())
        self._published.extend([wall_ns] * len(gate))
        start, self.size = self.size, self.size + len(gate.buffer)
        if self.size > len(self._data):
            self._make_room(self.size)
        self._data[start : self.size] = gate.buffer

    def _make_room(self, size: int) -> None:
        self._data = self._data + bytes(max(size - len(self._data), self._room))

    def take(self) -> "Content":
        """Return all that came, and begin anew; what is returned holds until the next message."""
        columns = map(_column, (self._channels, self._ends, self._log, self._published))
        content = Content(memoryview(self._data)[: self.size], *columns)
        self._counted = content.write_heads(self._counted)
        self._begin()
        return content


class Content:
    """The records of a chunk; columns of M messages."""

    def __init__(self, data: memoryview, channels: NDArray, ends: NDArray, log: NDArray, published: NDArray) -> None:
        self.data = data
        self.first_ns, self.last_ns = int(log.min()), int(log.max())
        self._channels, self._ends, self._log, self._published = channels, ends, log, published
        self._starts = np.concatenate(([0], ends[:-1]))
        self._order = np.argsort(channels, kind="stable")  # channel by channel, each in the order of arrival

    def write_heads(self, counted: NDArray) -> NDArray:
        """Write the head of each message; return how many messages each channel has had by now.

        Args:
            counted: messages that channels have had before.
        """
        heads = np.empty(len(self._ends), dtype=MESSAGE_HEAD)
        heads["opcode"], heads["channel"] = int(Opcode.MESSAGE), self._channels
        heads["length"] = self._ends - self._starts - HEAD.size
        heads["log_time"], heads["publish_time"] = self._log, self._published
        came = np.bincount(self._channels, minlength=len(counted))
        before = np.pad(counted, (0, len(came) - len(counted)))
        rank = np.arange(len(heads)) - np.repeat(np.cumsum(came) - came, came)
        heads["sequence"][self._order] = (np.repeat(before, came) + rank) & _SEQUENCE_MASK
        places = np.ndarray(len(self.data) - MESSAGE.size + 1, MESSAGE_HEAD, self.data, strides=(1,))
        places[self._starts] = heads
        return before + came

    def indexes(self) -> Iterator[bytes]:
        """Yield the message index records."""
        places = self._starts[self._order].astype("Q")
        entries = np.column_stack((self._log[self._order], places)).astype("<u8").tobytes()
        came = np.bincount(self._channels)
        at = 0
        for channel in np.flatnonzero(came).tolist():
            size = INDEX_ENTRY * int(came[channel])
            yield HEAD.pack(Opcode.MESSAGE_INDEX, INDEX_HEAD.size + size) + INDEX_HEAD.pack(channel, size)
            yield entries[at : at + size]
            at += size


def _column(values: array) -> NDArray:
    return np.frombuffer(values, values.typecode)
