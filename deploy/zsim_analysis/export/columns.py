"""Selected messages of a record as tables: which keys and times, which columns, and rows in batches.

The columns of a message of the contract follow from its type: vectors become a column per component, variables and
sensors a column per name, and content without a fixed shape becomes JSON text. All table formats use these columns.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, Struct, inspect
from numpy.typing import NDArray

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, Sightings
from zsim.contract.messages import REFUSALS
from zsim.record import Recorded, RecordReader
from zsim.scenario.faults import ROTORS
from zsim.sensors.sensor import sensor_of
from zsim_analysis.reading.recorded_run import decode_or_none

CELLS = 100_000  # cells per batch: about 5 MB as Python objects
PROGRESS_EVERY = 10_000  # messages between two calls of `progress`
INTEGER_MAX = 2**63 - 1
QUATERNION, NON_WORD = "_wxyz", r"\W"
COUNTS = ("used", "refused")  # an estimate's counts of a sensor's samples
_NUMERIC = inspect.IntType | inspect.FloatType

Kind = Literal["whole", "number", "flag", "text"]
Values = NDArray[Any] | list[Any]


class MessageSelection(NamedTuple):
    """Keys and times to be exported."""

    expressions: tuple[str, ...] = ()  # key expressions as in Zenoh; empty: every key
    from_s: float | None = None  # first simulated time to export [s]; None: that of the start
    to_s: float | None = None  # last simulated time to export [s]; None: that of the end

    def keys(self, reader: RecordReader) -> list[str]:
        every = not self.expressions
        return [key for key in reader.topics() if every or any(keys.matches(each, key) for each in self.expressions)]

    def messages(self, reader: RecordReader, selected_keys: list[str]) -> Iterator[Recorded]:
        """Yield the messages on `selected_keys` within the selected times, in order of simulated time."""
        first = 0 if self.from_s is None else round(self.from_s * 1e9)
        last = 2**64 if self.to_s is None else round(self.to_s * 1e9)
        return (message for message in reader.messages(frozenset(selected_keys)) if first <= message.t_ns <= last)


def subject(key: str) -> str:
    """Return the drone, cluster or process that a key is about; `world` if it is about none."""
    kind, owner, leaf = keys.parts(key)
    return (leaf or "world") if kind == "view" else owner if leaf else "world"


class RowBatch(NamedTuple):
    """Rows of one table, in order of time."""

    kind: type[Struct]  # type of the messages
    only: str  # the subject of all rows if each subject has its own table; otherwise empty
    names: list[str]  # subject of each row
    messages: list[Any]  # decoded messages
    wall_ns: list[int]  # wall time at which each reached the recorder


class Columns(NamedTuple):
    name: str  # name of the field, unique in the table
    kind: Kind  # kind of all its columns
    columns: tuple[str, ...]  # names of the columns
    # returns a value per row, or a table (rows, columns), with None or NaN for missing values
    values: Callable[[RowBatch], Values]
    names: tuple[str, ...] = ()  # names of variables with a column each; empty for other fields
    keys: Mapping[str, slice] = {}  # columns of each key of a map field; empty for other fields


def table_columns(kind: type[Struct], names: Mapping[str, Sequence[str]]) -> tuple[Columns, ...]:
    """Return the columns of a message type's table, given the names or keys that occur in each open field."""
    open_kinds = open_fields(kind)
    hidden = {"t_ns", "seq", *(["names"] if "named" in open_kinds.values() else [])}  # column names carry the `names`
    shown_fields = [field for field in _fields(kind) if field.name not in hidden]
    return (
        Columns("name", "text", ("name",), lambda batch: batch.names),
        Columns("t_s", "number", ("t_s",), lambda batch: [message.t_ns / 1e9 for message in batch.messages]),
        Columns("t_ns", "whole", ("t_ns",), lambda batch: [message.t_ns for message in batch.messages]),
        *([_plain("seq", "whole")] if "seq" in kind.__struct_fields__ else []),
        *(
            each
            for field in shown_fields
            for each in _columns(field, open_kinds.get(field.name), names.get(field.name, ()))
        ),
        Columns("wall_ns", "whole", ("wall_ns",), lambda batch: np.array(batch.wall_ns, np.uint64).astype(np.int64)),
    )


def column_values(table: Iterable[Columns], batch: RowBatch) -> Iterator[tuple[str, Kind, Values]]:
    """Yield name, kind and values of every column of a batch, in the order of the table."""
    for each in table:
        values = each.values(batch)
        separate = values.T if isinstance(values, np.ndarray) and values.ndim == 2 else [values]
        for name, column in zip(each.columns, separate, strict=True):
            yield name, each.kind, column


def as_array(kind: Kind, values: Values) -> NDArray[Any]:
    """Return values as int64, float64, bool or objects; integers with missing values become float64 with NaN."""
    if kind == "text":
        return np.array(values, object)
    if kind == "whole" and not any(value is None for value in values):
        return np.array(values, np.int64)
    return np.array(values, bool if kind == "flag" else np.float64)


def open_fields(kind: type[Struct]) -> dict[str, Literal["named", "numbers", "pairs"]]:
    """Return the fields of a message whose columns depend on its content: named variables, maps of numbers or pairs."""
    open_kinds: dict[str, Literal["named", "numbers", "pairs"]] = {}
    for field in _fields(kind):
        match field.type:
            case inspect.VarTupleType(item_type=item, min_length=minimum) if isinstance(item, _NUMERIC) and not minimum:
                if "names" in kind.__struct_fields__:
                    open_kinds[field.name] = "named"
            case inspect.DictType(value_type=value) if isinstance(value, _NUMERIC):
                open_kinds[field.name] = "numbers"
            case inspect.DictType(value_type=inspect.TupleType(item_types=items)) if len(items) == len(COUNTS):
                open_kinds[field.name] = "pairs"
    return open_kinds


def table_name(kind: type[Struct]) -> str:
    """Return the name of a message's table: cluster_state for ClusterState, sensor_NAME for a user's sensor."""
    if sensor := sensor_of(kind):
        return f"sensor_{sensor}"
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", kind.__name__).lower()


def _fields(kind: type[Struct]) -> Iterable[inspect.Field]:
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    return info.fields


def _columns(field: inspect.Field, open_kind: str | None, names: Sequence[str]) -> list[Columns]:
    name, info = field.name, field.type
    if open_kind and not names:
        return []
    if open_kind:
        return [_open(name, names, open_kind)]
    if isinstance(info, inspect.UnionType):
        alternatives = [each for each in info.types if not isinstance(each, inspect.NoneType)]
        info = alternatives[0] if len(alternatives) == 1 else info
    match info:
        case inspect.IntType():
            return [_plain(name, "whole", convert=lambda value: value if abs(value or 0) <= INTEGER_MAX else None)]
        case inspect.FloatType():
            return [_plain(name, "number")]
        case inspect.BoolType():
            return [_plain(name, "flag")]
        case inspect.StrType() | inspect.LiteralType():
            return [_plain(name, "text")]
    if components := _components(name, info):
        count = len(components)

        def vectors(batch: RowBatch) -> Values:
            return np.array([getattr(m, name)[:count] for m in batch.messages], np.float64).reshape(-1, count)

        return [Columns(name, "number", tuple(components), vectors)]
    if isinstance(info, inspect.StructType) and all(isinstance(part.type, _NUMERIC) for part in info.fields):
        return [_plain(f"{name}_{part.name}", "number", f"{name}.{part.name}") for part in info.fields]
    return [Columns(name, "text", (name,), lambda batch: [json_text(getattr(m, name)) for m in batch.messages])]


def _plain(name: str, kind: Kind, path: str = "", convert: Callable[[Any], Any] = lambda value: value) -> Columns:
    """Return the column of a field, or of the value at `path` within the message, converted by `convert`."""
    get = attrgetter(path or name)

    def values(batch: RowBatch) -> Values:
        return [None if (value := get(message)) is UNSET else convert(value) for message in batch.messages]

    return Columns(name, kind, (name,), values)


def _open(name: str, names: Sequence[str], kind: str) -> Columns:
    """Return a column for each name or key of an open field, or two for pairs: FIELD_KEY_used and FIELD_KEY_refused.

    Messages may differ in their `names`.
    """
    ends = [f"_{end}" for end in COUNTS] if kind == "pairs" else [""]
    columns = tuple(f"{name}_{re.sub(NON_WORD, '_', each)}{end}" for each in names for end in ends)
    slices = {each: slice(i * len(ends), (i + 1) * len(ends)) for i, each in enumerate(names)}

    def values(batch: RowBatch) -> Values:
        table = np.full((len(batch.messages), len(columns)), np.nan)
        for row, message in zip(table, batch.messages, strict=True):
            content = getattr(message, name)
            if kind == "named":  # all at once, as large formations have thousands
                row[[slices[each].start for each in message.names]] = content
                continue
            for each, value in content.items():
                row[slices[each]] = value
        return table

    if kind == "named":
        return Columns(name, "number", columns, values, names=tuple(names))
    return Columns(name, "number", columns, values, keys=slices)


def _components(name: str, info: inspect.Type) -> list[str]:
    """Return the columns of a field with a fixed number of elements; empty for any other field."""
    if isinstance(info, inspect.VarTupleType) and info.min_length == info.max_length == 36:
        parts = [f"{i}{j}" for i in range(6) for j in range(6)]
    elif isinstance(info, inspect.VarTupleType) and info.min_length == len(ROTORS):  # of more rotors, the first four
        parts = list(ROTORS)
    elif not isinstance(info, inspect.TupleType) or not all(isinstance(each, _NUMERIC) for each in info.item_types):
        parts = []
    else:
        return component_names(name, len(info.item_types))
    return [f"{name}_{part}" for part in parts]


def component_names(name: str, count: int) -> list[str]:
    """Return the columns of a vector: `_x` to `_z` for three numbers, `_w` to `_z` for a quaternion, else indices."""
    if name.endswith(QUATERNION) and count == len("wxyz"):
        return [f"{name.removesuffix(QUATERNION)}_{part}" for part in "wxyz"]
    return [f"{name}_{part}" for part in ("xyz" if count == 3 else range(count))]


def json_text(value: Any) -> str:
    """Return a value as JSON, in which values of types unknown to JSON become their repr."""
    try:
        return msgspec.json.encode(value, enc_hook=repr).decode()
    except REFUSALS:  # e.g. keys that are not text
        return msgspec.json.encode(repr(value)).decode()


class Foreign(Struct, frozen=True):
    """A message on a key that is not in the contract; `content` is its payload as JSON."""

    t_ns: int
    key: str
    content: str


class Sighting(Struct, frozen=True):
    """A row for a hat seen in a picture, or for a picture without hats, with NaN for the numbers of a hat.

    `hats` is the number of hats in the picture, `hat` the index of this one, from 0.
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


class TableSurvey:
    """The tables of a selection, found in a first pass over the record: the `table_keys`, and `kinds`, their types.

    `pictures` is the number of pictures, which are in no table. `rows` counts messages by type (None for foreign keys),
    including those that are outside the selected times or cannot be decoded.
    """

    def __init__(self, reader: RecordReader, selection: MessageSelection) -> None:
        self._reader = reader
        self._selection = selection
        counts = reader.topics()
        chosen = selection.keys(reader)
        self.pictures = sum(counts[key] for key in chosen if messages.type_of(key) is CameraImage)
        if not selection.expressions:
            chosen = [key for key in chosen if not keys.is_accepted(key)]  # these repeat commands, which have rows
        self.table_keys = [key for key in chosen if messages.type_of(key) is not CameraImage]
        if (info := reader.last(keys.INFO)) is not None:
            decode_or_none(info)  # registers the message types of users' sensors
        self.kinds = {key: kind for key in self.table_keys if (kind := messages.type_of(key))}
        self.rows: Counter[type[Struct] | None] = Counter()
        for key in self.table_keys:
            self.rows[self.kinds.get(key)] += counts[key]
        fields_by_kind = {kind: open_fields(kind) for kind in set(self.kinds.values())}
        self._names: dict[type[Struct], dict[str, dict[str, None]]] = {  # names in the open fields of all messages
            kind: {field: {} for field in open_kinds} for kind, open_kinds in fields_by_kind.items()
        }
        open_keys = [key for key, kind in self.kinds.items() if fields_by_kind[kind]]
        for recorded in selection.messages(reader, open_keys) if open_keys else ():
            if (message := decode_or_none(recorded)) is not None:
                for field, open_kind in fields_by_kind[type(message)].items():
                    names = message.names if open_kind == "named" else getattr(message, field)
                    self._names[type(message)][field].update(dict.fromkeys(names))
        self._tables: dict[type[Struct], tuple[Columns, ...]] = {}

    def table(self, kind: type[Struct]) -> tuple[Columns, ...]:
        if kind not in self._tables:
            names = {field: list(each) for field, each in self._names.get(kind, {}).items()}
            self._tables[kind] = table_columns(kind, names)
        return self._tables[kind]

    def width(self, kind: type[Struct]) -> int:
        return sum(len(each.columns) for each in self.table(kind))

    def rows_within(self, kind: type[Struct]) -> int:
        """Return the number of messages of a type within the selected times, by reading them all."""
        matching_keys = [key for key, key_kind in self.kinds.items() if key_kind is kind]
        return sum(1 for _ in self._selection.messages(self._reader, matching_keys))

    def decode(self, recorded: Recorded) -> Any:
        """Return the message, as a Foreign if its key is outside the contract; None if it is not of its key's type."""
        if recorded.key in self.kinds:
            return decode_or_none(recorded)
        try:
            content = json_text(msgspec.msgpack.decode(recorded.payload))
        except REFUSALS:
            content = json_text({"hexadecimal": recorded.payload.hex()})
        return Foreign(recorded.t_ns, recorded.key, content)


class DecodedMessages:
    """Selected messages of a record with their decoded content; those for which `decode` returns None are left out."""

    def __init__(
        self, messages: Iterable[Recorded], decode: Callable[[Recorded], Any], progress: Callable[[int], None]
    ) -> None:
        self._messages = messages
        self._decode = decode
        self._progress = progress
        self.refused = 0  # number of messages left out so far

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
    decoded: Iterable[tuple[Recorded, Any]], width: Callable[[type[Struct]], int], by_name: bool = False
) -> Iterator[RowBatch]:
    """Yield the rows of all tables from messages in order of time; each table keeps this order.

    Batches of wide tables have fewer rows. With `by_name`, each drone, cluster and process has its own tables.
    """
    incomplete: dict[tuple[type[Struct], str], RowBatch] = {}
    for recorded, message in decoded:
        name, rows = subject(recorded.key), [message]
        if isinstance(message, Sightings):
            source = message.source or ("world" if keys.is_sensor(recorded.key) else "")
            common_fields = (message.t_ns, message.seq, message.t_sample_ns, source, message.camera, len(message.seen))
            rows = [
                Sighting(
                    *common_fields,
                    hat,
                    sighting.direction_B,
                    sighting.range_m,
                    sighting.sigma_direction_rad,
                    sighting.sigma_range_m,
                )
                for hat, sighting in enumerate(message.seen)
            ] or [Sighting(*common_fields)]
        for row in rows:
            kind = type(row)
            only = name if by_name and kind is not Foreign else ""  # foreign names may be invalid as file names
            batch = incomplete.setdefault((kind, only), RowBatch(kind, only, [], [], []))
            batch.names.append(name)
            batch.messages.append(row)
            batch.wall_ns.append(recorded.wall_ns)
            if len(batch.names) * width(kind) >= CELLS:
                yield incomplete.pop((kind, only))
    yield from incomplete.values()
