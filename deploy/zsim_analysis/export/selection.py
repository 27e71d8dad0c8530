"""Which messages of a record are exported, the tables that they become, and the rows of these in batches."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, Sightings
from zsim.contract.messages import REFUSALS
from zsim.record import Recorded, RecordReader
from zsim_analysis.export.message_columns import FieldColumns, fields, json_text, open_fields
from zsim_analysis.reading.recorded_run import decode_or_none

CELLS = 100_000  # of a batch: some 5 MB as Python objects
PROGRESS_EVERY = 10_000  # messages


class MessageSelection(NamedTuple):
    """Which keys and times are exported.

    Attributes:
        expressions: key expressions as Zenoh's; none: every key.
        from_s: simulated time of the first message [s], None: the start.
        to_s: of the last one.
    """

    expressions: tuple[str, ...] = ()
    from_s: float | None = None
    to_s: float | None = None

    def keys(self, reader: RecordReader) -> list[str]:
        """Return the selected keys on record."""
        every = not self.expressions
        return [key for key in reader.topics() if every or any(keys.matches(each, key) for each in self.expressions)]

    def messages(self, reader: RecordReader, wanted: list[str]) -> Iterator[Recorded]:
        """Yield the messages of some keys that are within the times, in order of simulated time."""
        first = _ns(self.from_s, 0)
        last = _ns(self.to_s, 2**64)
        return (message for message in reader.messages(frozenset(wanted)) if first <= message.t_ns <= last)


def _ns(seconds: float | None, otherwise: int) -> int:
    return otherwise if seconds is None else round(seconds * 1e9)


def subject(key: str) -> str:
    """Return the drone, cluster or process of a key; `world` where it is of all."""
    kind, whose, what = keys.parts(key)
    if kind == "view":
        return what or "world"
    return whose if what else "world"


class Foreign(Struct, frozen=True):
    """A message on a key that the contract does not know; `content` is its payload as JSON."""

    t_ns: int
    key: str
    content: str


def _content(payload: bytes) -> str:
    """Return the payload of a foreign message as JSON, as hexadecimal digits if it is not msgpack."""
    try:
        return json_text(msgspec.msgpack.decode(payload))
    except REFUSALS:
        return json_text({"hexadecimal": payload.hex()})


class Sighting(Struct, frozen=True):
    """A row of a hat that was seen in a picture, or of a picture in which none was: numbers are NaN then.

    `hats` tells how many were seen in the picture, `hat` which of them this is, from 0.
    """

    t_ns: int
    seq: int
    t_sample_ns: int
    source: str
    camera: str
    hats: int
    hat: int | None = None
    direction_B: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    range_m: float = math.nan
    sigma_direction_rad: float = math.nan
    sigma_range_m: float = math.nan


def hat_by_hat(decoded: Iterable[tuple[Recorded, Any]]) -> Iterator[tuple[Recorded, Any]]:
    """Yield messages, and for each of Sightings its rows."""
    for recorded, message in decoded:
        if not isinstance(message, Sightings):
            yield recorded, message
            continue
        source = message.source or ("world" if keys.is_sensor(recorded.key) else "")
        head = (message.t_ns, message.seq, message.t_sample_ns, source, message.camera, len(message.seen))
        for hat, seen in enumerate(message.seen):
            numbers = (seen.direction_B, seen.range_m, seen.sigma_direction_rad, seen.sigma_range_m)
            yield recorded, Sighting(*head, hat, *numbers)
        if not message.seen:
            yield recorded, Sighting(*head)


class TableSurvey:
    """The tables that a selection becomes, by a first look through the record.

    Attributes:
        wanted: the keys.
        pictures: messages that are selected and go into no table.
        kinds: the message type of each key of the contract.
        rows: messages by type, with those outside the times or unreadable; None: of foreign keys.
    """

    def __init__(self, reader: RecordReader, selection: MessageSelection) -> None:
        self._reader = reader
        self._selection = selection
        counts = reader.topics()
        chosen = selection.keys(reader)
        self.pictures = sum(counts[key] for key in chosen if messages.type_of(key) is CameraImage)
        if not selection.expressions:
            chosen = [key for key in chosen if not keys.is_accepted(key)]  # repeats of commands that are rows already
        self.wanted = [key for key in chosen if messages.type_of(key) is not CameraImage]
        if (info := reader.last(keys.INFO)) is not None:
            decode_or_none(info)  # from here on the messages of users' sensors are known
        self.kinds = {key: kind for key in self.wanted if (kind := messages.type_of(key))}
        self.rows: Counter[type[Struct] | None] = Counter()
        for key in self.wanted:
            self.rows[self.kinds.get(key)] += counts[key]
        self._names: dict[type[Struct], dict[str, dict[str, None]]] = {}
        self._read_names()

    def fields(self, kind: type[Struct]) -> tuple[FieldColumns, ...]:
        """Return the fields of a type's table."""
        names: dict[str, Sequence[str]] = {name: list(each) for name, each in self._names.get(kind, {}).items()}
        return fields(kind, names)

    def rows_within(self, kind: type[Struct]) -> int:
        """Return the messages of a type within the times; they are read through for it."""
        wanted = [key for key, of in self.kinds.items() if of is kind]
        return sum(1 for _ in self._selection.messages(self._reader, wanted))

    def decode(self, recorded: Recorded) -> Any:
        """Return the row of a message, None if it is not of the type of its key."""
        if recorded.key in self.kinds:
            return decode_or_none(recorded)
        return Foreign(recorded.t_ns, recorded.key, _content(recorded.payload))

    def _read_names(self) -> None:
        """Read the messages that have open fields."""
        opened = {kind: open_fields(kind) for kind in set(self.kinds.values())}
        wanted = [key for key, kind in self.kinds.items() if opened[kind]]
        for kind, opens in opened.items():
            self._names[kind] = {each.name: {} for each in opens}
        for message in self._selection.messages(self._reader, wanted) if wanted else ():
            decoded = decode_or_none(message)
            if decoded is None:
                continue
            kind = type(decoded)
            for name, field in opened[kind]:
                names = decoded.names if field == "named" else getattr(decoded, name)
                self._names[kind][name].update(dict.fromkeys(names))


class RowBatch(NamedTuple):
    """Some rows of one table, in order of time.

    Attributes:
        kind: of the messages.
        names: subject of each.
        messages: decoded.
        wall_ns: when each reached the recorder.
        only: the subject of all of them, where each has a table of its own.
    """

    kind: type[Struct]
    names: list[str]
    messages: list[Any]
    wall_ns: list[int]
    only: str = ""


class DecodedMessages:
    """Selected messages of a record with what they decode to, in order of simulated time.

    Args:
        messages: of the selection.
        decode: returns the message, None for one that is left out.
        progress: called now and then with the number of messages that have been read.

    Attributes:
        refused: messages that were left out so far.
    """

    def __init__(
        self, messages: Iterable[Recorded], decode: Callable[[Recorded], Any], progress: Callable[[int], None]
    ) -> None:
        self._messages = messages
        self._decode = decode
        self._progress = progress
        self.refused = 0

    def __iter__(self) -> Iterator[tuple[Recorded, Any]]:
        for count, recorded in enumerate(self._messages):
            if count % PROGRESS_EVERY == 0:
                self._progress(count)
            message = self._decode(recorded)
            if message is None:
                self.refused += 1
            else:
                yield recorded, message


def batches(
    decoded: Iterable[tuple[Recorded, Any]], columns: Callable[[type[Struct]], int], by_name: bool = False
) -> Iterator[RowBatch]:
    """Yield all rows; a table's batches come in order of time.

    Args:
        decoded: messages in order of time.
        columns: number of columns of a table: wide ones have fewer rows in a batch.
        by_name: whether each drone, cluster and process has tables of its own.
    """
    incomplete: dict[tuple[type[Struct], str], RowBatch] = {}
    for recorded, message in decoded:
        kind, name = type(message), subject(recorded.key)
        table = kind, name if by_name and kind is not Foreign else ""  # foreign names may be no names of files
        batch = incomplete.setdefault(table, RowBatch(kind, [], [], [], table[1]))
        batch.names.append(name)
        batch.messages.append(message)
        batch.wall_ns.append(recorded.wall_ns)
        if len(batch.names) * columns(kind) >= CELLS:
            yield incomplete.pop(table)
    yield from incomplete.values()
