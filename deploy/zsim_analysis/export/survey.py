"""A first look through a record: how many rows each table has, and the columns that depend on what was said."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from msgspec import Struct

from zsim.contract import messages
from zsim.errors import DecodeError
from zsim.record import RecordReader
from zsim_analysis.export.columns import Field, fields, open_fields
from zsim_analysis.export.selection import Selection


class Survey:
    """What the tables of a selection will be.

    Attributes:
        wanted: the keys.
        kinds: the message type of each key of the contract.
        rows: messages by type, before those that are outside the times or cannot be read; None: of foreign keys.
    """

    def __init__(self, reader: RecordReader, selection: Selection) -> None:
        self._reader = reader
        self._selection = selection
        self.wanted = selection.keys(reader)
        self.kinds = {key: kind for key in self.wanted if (kind := messages.type_of(key))}
        counts = reader.topics()
        self.rows: Counter[type[Struct] | None] = Counter()
        for key in self.wanted:
            self.rows[self.kinds.get(key)] += counts[key]
        self._found: dict[type[Struct], dict[str, dict[str, None]]] = {}
        self._look()

    def fields(self, kind: type[Struct]) -> tuple[Field, ...]:
        """Return the fields of a type's table."""
        found: dict[str, Sequence[str]] = {name: list(seen) for name, seen in self._found.get(kind, {}).items()}
        return fields(kind, found)

    def rows_within(self, kind: type[Struct]) -> int:
        """Return the messages of a type within the times; they are read through for it."""
        wanted = [key for key, of in self.kinds.items() if of is kind]
        return sum(1 for _ in self._selection.messages(self._reader, wanted))

    def _look(self) -> None:
        """Read those messages through that have open fields."""
        opened = {kind: open_fields(kind) for kind in set(self.kinds.values())}
        wanted = [key for key, kind in self.kinds.items() if opened[kind]]
        for kind, opens in opened.items():
            self._found[kind] = {each.name: {} for each in opens}
        for message in self._selection.messages(self._reader, wanted) if wanted else ():
            decoded = decoded_or_none(message.key, message.payload)
            if decoded is None:
                continue
            kind = type(decoded)
            for name, how in opened[kind]:
                said = decoded.names if how == "named" else getattr(decoded, name)
                self._found[kind][name].update(dict.fromkeys(said))


def decoded_or_none(key: str, payload: bytes) -> Any:
    """Return the message of a key of the contract, None if it is not what its key promises."""
    try:
        return messages.decode(key, payload)
    except DecodeError:
        return None
