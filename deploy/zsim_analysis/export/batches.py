"""The rows of all tables, gathered in batches while a record is read in order of time."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct

from zsim.contract.messages import REFUSALS
from zsim.record import Recorded, RecordReader
from zsim_analysis.export.columns import json_text
from zsim_analysis.export.selection import Selection, thing
from zsim_analysis.export.survey import Survey, decoded_or_none

CELLS = 100_000  # of a batch: some 5 MB as Python objects
PROGRESS_EVERY = 10_000  # messages


class Foreign(Struct, frozen=True):
    """A message on a key that the contract does not know; `content` is its payload as JSON."""

    t_ns: int
    key: str
    content: str


class Batch(NamedTuple):
    """Some rows of one table, in order of time.

    Attributes:
        kind: of the messages.
        names: whom each is about.
        messages: decoded.
        wall_ns: when each reached the recorder.
    """

    kind: type[Struct]
    names: list[str]
    messages: list[Any]
    wall_ns: list[int]


class Gathering:
    """Reads a selection of a record into batches.

    Attributes:
        refused: messages that are not what their key promises; they are left out.
    """

    def __init__(self, reader: RecordReader, selection: Selection, survey: Survey) -> None:
        self._reader = reader
        self._selection = selection
        self._survey = survey
        self.refused = 0

    def batches(self, columns: Callable[[type[Struct]], int], progress: Callable[[int], None]) -> Iterator[Batch]:
        """Yield all rows; a table's batches come in order of time.

        Args:
            columns: number of columns of a table: wide ones have fewer rows to a batch.
            progress: told now and then how many messages have been read.
        """
        open_: dict[type[Struct], Batch] = {}
        for count, message in enumerate(self._selection.messages(self._reader, self._survey.wanted)):
            if count % PROGRESS_EVERY == 0:
                progress(count)
            decoded = self._decoded(message)
            if decoded is None:
                self.refused += 1
                continue
            kind = type(decoded)
            batch = open_.setdefault(kind, Batch(kind, [], [], []))
            batch.names.append(thing(message.key))
            batch.messages.append(decoded)
            batch.wall_ns.append(message.wall_ns)
            if len(batch.names) * columns(kind) >= CELLS:
                yield open_.pop(kind)
        yield from open_.values()

    def _decoded(self, message: Recorded) -> Any:
        if message.key in self._survey.kinds:
            return decoded_or_none(message.key, message.payload)
        return Foreign(message.t_ns, message.key, _content(message.payload))


def _content(payload: bytes) -> str:
    """Return the payload of a foreign message as JSON, as hexadecimal digits if it is not msgpack."""
    try:
        return json_text(msgspec.msgpack.decode(payload))
    except REFUSALS:
        return json_text({"hexadecimal": payload.hex()})


def seconds(messages: Sequence[Any]) -> list[float]:
    """Return the simulated time of each message [s]."""
    return [message.t_ns / 1e9 for message in messages]
