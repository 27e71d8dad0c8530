"""What stands in which column of a row of numbers: from one list of fields, for plain Python and for compiled code.

STATE = columns("State", (Field("p_WB", "m", 3), Field("q_WB", "1", 4), Field("energy", "J")))
row[STATE.p_WB : STATE.p_WB + 3]      row[STATE.energy]      np.zeros((count, STATE.size))
"""

from collections import namedtuple
from collections.abc import Iterable
from itertools import accumulate
from typing import Any, NamedTuple, Protocol, cast


class Field(NamedTuple):
    """Numbers of one name in a row: their unit ("1" for none), and how many there are."""

    name: str
    unit: str
    width: int = 1


class Columns(Protocol):
    """First columns by the names of their fields, and `size`."""

    def __getattr__(self, name: str) -> int: ...


def columns(name: str, fields: Iterable[Field]) -> Columns:
    """Return the first column of every field by its name, and the columns in all as `size`.

    It is a named tuple of integers: compiled code reads its attributes as constants.

    Raises:
        ValueError: two fields have one name.
    """
    listed = tuple(fields)
    first = [0, *accumulate(field.width for field in listed)]
    kind: Any = namedtuple(name, [*(field.name for field in listed), "size"])  # type: ignore[misc]
    return cast(Columns, kind(*first))
