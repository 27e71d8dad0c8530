"""Reads a record in order of time and writes what is seen of it, in bounded memory."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.errors import ZsimError
from zsim.record import RecordReader
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_analysis.export.batches import PROGRESS_EVERY
from zsim_analysis.export.foxglove.foxglove_layout import layout
from zsim_analysis.export.foxglove.instants import instants, is_drawn
from zsim_analysis.export.foxglove.topic_writer import FoxgloveFile
from zsim_analysis.export.selection import Selection, thing
from zsim_analysis.export.survey import decoded_or_none

LATEST_NS = 2**32 * 10**9  # Foxglove counts seconds in 32 bits
ARM_M = 0.1785  # m, the AR.Drone's, where the scenario is not known


def convert(
    reader: RecordReader, selection: Selection, path: Path, layout_path: Path, progress: Callable[[int, int], None]
) -> tuple[dict[str, int], int]:
    """Write the MCAP file and its layout; return messages by topic, and how many could not be read.

    Args:
        reader: of the record.
        selection: which of its messages.
        path: of the MCAP file, new.
        layout_path: of the layout, new.
        progress: told how many messages have been read, of how many.
    """
    wanted = [key for key in selection.keys(reader) if is_drawn(key)]
    scenario = _scenario(reader)
    drones = [thing(key) for key in wanted if key.startswith("drone/")]
    source = _Decoding(reader, selection, wanted, progress)
    file = FoxgloveFile(path, _arms_m(scenario, dict.fromkeys(drones)), _spaces(scenario))
    try:
        for instant in instants(source):
            file.write(instant)
    finally:
        file.close()
    layout_path.write_text(layout(file.counts, file.variables()) + "\n", encoding="utf-8")
    return dict(sorted(file.counts.items())), source.refused


class _Decoding:
    """Yields keys and messages in order of time, and counts what cannot be read."""

    def __init__(
        self, reader: RecordReader, selection: Selection, wanted: list[str], progress: Callable[[int, int], None]
    ) -> None:
        self._messages = selection.messages(reader, wanted)
        self._progress = progress
        topics = reader.topics()
        self._total = sum(topics[key] for key in wanted)
        self.refused = 0

    def __iter__(self) -> Iterator[tuple[str, Any]]:
        for count, message in enumerate(self._messages):
            if count % PROGRESS_EVERY == 0:
                self._progress(count, self._total)
            decoded = decoded_or_none(message.key, message.payload)
            if decoded is None or message.t_ns >= LATEST_NS:
                self.refused += 1
            else:
                yield message.key, decoded


def _scenario(reader: RecordReader) -> Scenario | None:
    """Return the scenario on record, None if there is none that this version reads."""
    found = reader.last(keys.INFO)
    info = decoded_or_none(found.key, found.payload) if found else None
    try:
        return scenario_file.from_text(info.scenario) if isinstance(info, Info) else None
    except ZsimError:
        return None


def _arms_m(scenario: Scenario | None, seen: dict[str, None]) -> dict[str, float]:
    """Return the arm of every drone on record [m], in the order of the scenario."""
    known = {drone.name: drone.arm_m for drone in scenario.drones} if scenario else {}
    return {name: known.get(name, ARM_M) for name in sorted(seen, key=list({**known, **seen}).index)}


def _spaces(scenario: Scenario | None) -> dict[str, ClusterSpace]:
    spaces: dict[str, ClusterSpace] = {}
    if scenario is None:
        return spaces
    for cluster in scenario.clusters:
        try:
            spaces[cluster.name] = scenario_space(scenario, cluster)
        except ValueError:
            continue
    return spaces
