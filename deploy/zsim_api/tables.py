"""Messages of a record as tables: numpy arrays by column, and pandas frames of them where pandas is installed.

Columns have the names that `zsim export` gives them: `position_m_x`, `value_p`. The index is simulated time, `t_s`.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from zsim.contract.messages import REFUSALS
from zsim.record import RecordReader
from zsim_analysis.export.columns import (
    DecodedMessages,
    Kind,
    MessageSelection,
    TableSurvey,
    as_array,
    batches,
    column_values,
    component_names,
    json_text,
    subject,
)

if TYPE_CHECKING:
    from pandas import DataFrame

Table = dict[str, NDArray[Any]]  # columns of equal length (K,), in order of simulated time
INDEX = "t_s"
STAMPS = ("t_ns", "seq", "wall_ns")  # metadata columns of a message


def read_tables(record: Path, wanted: Collection[str]) -> dict[str, Table]:
    """Return all messages of some keys, by key, in one pass over the record.

    Columns are those of the export, without `name`, which is the same in all rows. Messages of a key outside the
    contract, and pictures, have a column for each field, or for each element of a field that is a list of numbers.

    Args:
        record: file.
        wanted: one key, or the same one of several drones.
    """
    with RecordReader(record) as reader:
        selection = MessageSelection(tuple(wanted))
        survey = TableSurvey(reader, selection)
        by_subject = {subject(key): key for key in wanted}
        parts: dict[str, dict[str, list[NDArray[Any]]]] = {key: {} for key in wanted if key in survey.kinds}
        decoded = DecodedMessages(selection.messages(reader, [*parts]), survey.decode, lambda _: None)
        for batch in batches(decoded, survey.width, by_name=True):
            for name, kind, values in column_values(survey.table(batch.kind)[1:], batch):
                parts[by_subject[batch.only]].setdefault(name, []).append(as_array(kind, values))
        own = {key: _own_table(reader, key) for key in wanted if key not in parts}
    joined = {key: {name: np.concatenate(each) for name, each in columns.items()} for key, columns in parts.items()}
    return {**joined, **own}


def frame(table: Mapping[str, NDArray[Any]], index: Sequence[str] = (INDEX,)) -> "DataFrame":
    """Return a table as a pandas DataFrame with one or more columns as its index; without pandas a dict of arrays."""
    try:
        from pandas import DataFrame
    except ModuleNotFoundError:
        return {**{name: table[name] for name in index}, **table}  # type: ignore[return-value]
    return DataFrame(dict(table)).set_index(list(index) if len(index) > 1 else index[0])


def _own_table(reader: RecordReader, key: str) -> Table:
    t_ns, wall_ns, contents = [], [], []
    for recorded in reader.messages({key}):
        try:
            content = msgspec.msgpack.decode(recorded.payload)
        except REFUSALS:
            content = {"hexadecimal": recorded.payload.hex()}
        is_map = isinstance(content, dict) and all(isinstance(name, str) for name in content)
        contents.append(content if is_map else {"content": content})
        t_ns.append(recorded.t_ns)
        wall_ns.append(recorded.wall_ns)
    stamps = np.array(t_ns, np.uint64)
    table: Table = {INDEX: stamps / 1e9, "t_ns": stamps.astype(np.int64)}
    for name in dict.fromkeys(name for content in contents for name in content if name != "t_ns"):
        table |= _own_columns(
            f"content_{name}" if name in (INDEX, "wall_ns") else name, [content.get(name) for content in contents]
        )
    return {**table, "wall_ns": np.array(wall_ns, np.uint64).astype(np.int64)}


def _own_columns(name: str, values: Sequence[Any]) -> Table:
    known = [value for value in values if value is not None]
    width = len(known[0]) if known and isinstance(known[0], list) else 0
    if width and all(_is_vector(value, width) for value in known):
        rows = np.array([value or [np.nan] * width for value in values], np.float64)
        return dict(zip(component_names(name, width), rows.T, strict=True))
    kind = _kind(known)
    if kind == "text":
        values = [value if isinstance(value, str | bytes | None) else json_text(value) for value in values]
    elif kind == "flag" and len(known) < len(values):
        return {name: np.array(values, object)}
    return {name: as_array(kind, list(values))}


def _is_vector(value: Any, width: int) -> bool:
    return isinstance(value, list) and len(value) == width and _kind(value) in ("whole", "number")


def _kind(values: Sequence[Any]) -> Kind:
    """Return the kind of column that can hold all of these values; a text column holds anything."""
    if values and all(isinstance(value, bool) for value in values):
        return "flag"
    if values and all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        whole = all(isinstance(value, int) and abs(value) < 2**63 for value in values)
        return "whole" if whole else "number"
    return "text"
