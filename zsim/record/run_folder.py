"""The folder of a run: its record, and what a person has to know of that."""

from pathlib import Path

from zsim.errors import RunError

RECORD = "run.mcap"


def record_in(folder: Path) -> Path:
    """Return the record in a run's folder.

    Raises:
        RunError: there is none.
    """
    record = folder / RECORD
    if not record.is_file():
        raise RunError(f"{folder}: holds no {RECORD}; give the folder of a run, as `zsim run` printed it")
    return record


def record_at(place: Path) -> Path:
    """Return the record that is a file, or in a run's folder.

    Raises:
        RunError: there is none.
    """
    if place.is_file():
        return place
    if not (place / RECORD).is_file():
        raise RunError(f"{place}: holds no {RECORD}; give the folder of a run, as `zsim run` printed it, or the file")
    return place / RECORD


def record_notes(complete: bool, damaged: int) -> list[str]:
    """Return what is to be said of a record that has been read.

    Args:
        complete: it was closed, not cut.
        damaged: how many of its chunks cannot be read.
    """
    notes = []
    if not complete:
        notes.append("the record was cut: its writer did not close it; everything up to the cut was read")
    if damaged:
        notes.append(f"{damaged} chunks of the record are damaged and were passed over")
    return notes
