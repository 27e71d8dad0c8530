"""The record of a run, opened to be played back or flown again, and its messages decoded."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from zsim.contract import keys, messages
from zsim.errors import DecodeError, RecordError, ZsimError
from zsim.record import Recorded, RecordReader
from zsim.record.record_reader import record_at
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario


class RecordedRun(NamedTuple):
    """An open record, and the run's `world/info` and scenario on it."""

    reader: RecordReader
    info: messages.Info
    scenario: Scenario


@contextmanager
def open_run(place: Path) -> Iterator[RecordedRun]:
    """Yield the record in a run's folder, or in a file.

    Raises:
        RunError: there is none.
        RecordError: it is no record, or has no world/info.
        ScenarioError: this version cannot read its scenario.
    """
    with RecordReader(record_at(place)) as reader:
        info = _info(reader)
        yield RecordedRun(reader, info, scenario_file.from_text(info.scenario))


def _info(reader: RecordReader) -> messages.Info:
    recorded = reader.last(keys.INFO)
    if recorded is None:
        raise RecordError(f"{reader.path}: has no world/info; it does not say which run it is of")
    try:
        return messages.decode(keys.INFO, recorded.payload)
    except DecodeError as error:
        raise RecordError(f"{reader.path}: {error}; the record is of another version") from error


def scenario_of(info: messages.Info | None) -> Scenario | None:
    """Return the scenario of a run; None without `world/info`, or if this version cannot read the scenario."""
    try:
        return scenario_file.from_text(info.scenario) if info else None
    except ZsimError:
        return None


def decode_or_none(recorded: Recorded) -> Any:
    """Return the message of a key of the contract, None if its payload is not of the key's type."""
    try:
        return messages.decode(recorded.key, recorded.payload)
    except DecodeError:
        return None


def command_age_ms(path: Path) -> dict[str, float] | None:
    """Return p50, p99 and max [ms] of the wall time from a drone's status to the command that answers it.

    Both times are those at which the recorder received the messages. For runs whose world ended before it reported
    its own figures; None when no command answers a status on record.
    """
    with RecordReader(path) as reader:
        wanted = {key for key in reader.topics() if keys.leaf(key) in ("status", "velocity")}
        status_wall_ns: dict[tuple[str, int], int] = {}
        ages_ns = []
        for message in reader.messages(wanted, by_time=False):
            instant = (keys.thing(message.key), message.t_ns)
            if keys.leaf(message.key) == "status":
                status_wall_ns[instant] = message.wall_ns
            elif instant in status_wall_ns:
                ages_ns.append(message.wall_ns - status_wall_ns[instant])
    if not ages_ns:
        return None
    ages = np.array(ages_ns) / 1e6
    p50, p99 = np.percentile(ages, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(ages.max())}
