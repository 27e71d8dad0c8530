"""Which processes of a run are shown in a table, and in which order."""

from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from zsim.errors import RunError

Row = Mapping[str, Any]
NAMED_MAX = 8  # roles that a refusal names
LONGEST_S = float("inf")  # of who has never been heard of: shown before all others
ATTENTION = (  # beginnings of states, the most urgent first; then all others, and last those of NOTHING_AMISS
    "ended (",
    "lost",
    "no sign of life",
    "host silent",
    "waited for",
    "waits for",
)
NOTHING_AMISS = ("running", "ended")


class RowOrder(StrEnum):
    """By what rows are sorted; of figures the greatest is first."""

    ROLE = "role"
    HOST = "host"
    STATE = "state"
    AGE = "age"
    LAG = "lag"
    MESSAGES = "messages"
    RESTARTS = "restarts"
    ATTENTION = "attention"


def needs_attention(row: Row) -> int:
    """Return the rank of a row by its state: 0 is the most urgent."""
    state = row["state"]
    if state in NOTHING_AMISS:
        return len(ATTENTION) + 1 + NOTHING_AMISS.index(state)
    return next((rank for rank, begins in enumerate(ATTENTION) if state.startswith(begins)), len(ATTENTION))


def _greatest(field: str, unknown: float) -> Callable[[Row], float]:
    return lambda row: -(unknown if row.get(field) is None else row[field])


_KEYS: dict[RowOrder, Callable[[Row], Any]] = {
    RowOrder.ROLE: lambda row: row["role"],
    RowOrder.HOST: lambda row: row["host"],
    RowOrder.STATE: lambda row: row["state"],
    RowOrder.AGE: _greatest("age_s", LONGEST_S),
    RowOrder.LAG: _greatest("lag_ms", LONGEST_S),
    RowOrder.MESSAGES: _greatest("messages_per_s", 0.0),
    RowOrder.RESTARTS: _greatest("restarts", 0.0),
    RowOrder.ATTENTION: needs_attention,
}


class RowChoice(NamedTuple):
    """What of a table is shown.

    Attributes:
        only: patterns of roles (`estimator.*2`), of what they work for (`drone1*`) or of hosts; all rows if empty.
        sort: by what; as they come if None.
    """

    only: Sequence[str] = ()
    sort: RowOrder | None = None

    def of(self, rows: Sequence[Row]) -> list[Any]:
        """Return the rows that are shown, in their order; of equal ones the first stays first."""
        shown = [row for row in rows if not self.only or any(_matches(pattern, row) for pattern in self.only)]
        return shown if self.sort is None else sorted(shown, key=_KEYS[self.sort])

    def check(self, rows: Sequence[Row]) -> None:
        """Refuse a pattern that matches no row.

        Raises:
            RunError: with some roles that there are.
        """
        for pattern in self.only:
            if not any(_matches(pattern, row) for row in rows):
                roles = [row["role"] for row in rows]
                more = [f"and {len(roles) - NAMED_MAX} more"] if len(roles) > NAMED_MAX else []
                named = ", ".join([*roles[:NAMED_MAX], *more]) or "none"
                raise RunError(f"role is {pattern!r}; must match a role, what it works for, or a host: {named}")


def _matches(pattern: str, row: Row) -> bool:
    thing = row["role"].partition(".")[2]
    return any(fnmatchcase(name, pattern) for name in (row["role"], thing, row["host"]) if name)
