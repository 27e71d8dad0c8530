"""Whether a flight did what its plan says: read from its record without its motion, for those who want no report."""

from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct

from zsim.record import Completeness
from zsim_analysis.reading.flight import read_flight
from zsim_analysis.reading.formation import window
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.reading.shortfall import Shortfall, shortfalls

NOT_AS_PLANNED = "NOT AS PLANNED"


class Verdict(Struct, frozen=True):
    """What a record lacks, and what its flight did not do of its plan."""

    completeness: Completeness
    shortfalls: list[Shortfall]


def verdict(record: Path) -> Verdict:
    """Return the verdict on the flight of a record: the same as that of its report.

    Raises:
        RecordError: no such record.
    """
    flight = read_flight(record, motion=False)
    return Verdict(flight.completeness, shortfalls(flight, window_of(flight)[0]))


def window_of(flight: RecordedFlight) -> tuple[tuple[float, float], str]:
    """Return the window of a flight's statistics [s], and a note where it is not the one of the scenario."""
    asked = flight.scenario.report.window_s if flight.scenario else None
    return window(asked, flight.last_ns / 1e9)


def marks_of(lines: Sequence[Shortfall]) -> list[tuple[str, bool]]:
    """Return a line for each shortfall, and whether the flight fails by it."""
    return [(f"{NOT_AS_PLANNED if each.fails else 'note'}: {each.text}", each.fails) for each in lines]
