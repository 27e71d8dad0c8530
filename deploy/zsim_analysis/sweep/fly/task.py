"""One run of a sweep, as it is handed to whoever flies it."""

from typing import Any

from msgspec import Struct

from zsim.scenario.scenario import Scenario


class Task(Struct, frozen=True):
    """What to fly.

    Attributes:
        run: its number.
        point: of the grid.
        varied: values by path, without the seed.
        scenario: resolved, its seed being the run's.
        record: folder for the record, None to keep none.
    """

    run: int
    point: int
    varied: dict[str, Any]
    scenario: Scenario
    record: str | None = None
