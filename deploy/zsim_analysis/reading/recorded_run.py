"""The record of a run, opened to be played back or flown again."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from zsim.contract import keys, messages
from zsim.errors import DecodeError, RecordError
from zsim.record import RecordReader
from zsim.record.run_folder import record_at
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario


class Opened(NamedTuple):
    """A record, and what its world said of the run."""

    reader: RecordReader
    info: messages.Info
    scenario: Scenario


@contextmanager
def opened(place: Path) -> Iterator[Opened]:
    """Yield the record in a run's folder, or in a file.

    Raises:
        RunError: there is none.
        RecordError: it is no record, or does not say which run it is of.
        ScenarioError: its scenario is none of this version.
    """
    with RecordReader(record_at(place)) as reader:
        info = _info(reader)
        yield Opened(reader, info, scenario_file.from_text(info.scenario))


def _info(reader: RecordReader) -> messages.Info:
    said = reader.last(keys.INFO)
    if said is None:
        raise RecordError(f"{reader.path}: has no world/info; it does not say which run it is of")
    try:
        return messages.decode(keys.INFO, said.payload)
    except DecodeError as error:
        raise RecordError(f"{reader.path}: {error}; the record is of another version") from error
