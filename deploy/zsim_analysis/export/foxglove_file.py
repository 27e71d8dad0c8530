"""Writes the Foxglove file of a record and its layout, in order of time and in bounded memory.

Foxglove reads all of it. Rerun draws no scenes; it has the transforms, poses, points, fixes, log and numbers.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.record import Recorded, RecordReader
from zsim.scenario.scenario import Scenario
from zsim.vehicles.vehicle import cross_layout
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_analysis.export.foxglove_layout import layout
from zsim_analysis.export.foxglove_scene import RotorDisc, instants, is_drawn
from zsim_analysis.export.foxglove_topics import FoxgloveFile
from zsim_analysis.export.selection import DecodedMessages, MessageSelection, subject
from zsim_analysis.reading.recorded_run import decode_or_none, scenario_of

LATEST_NS = 2**32 * 10**9  # Foxglove counts seconds in 32 bits
ARM_M = 0.1785  # m, the AR.Drone's, where the scenario is not known
ROTOR_RADIUS = 0.57  # of the arm, where the rotors are not known: 0.102 m at the AR.Drone's 0.1785 m


def convert(
    reader: RecordReader,
    selection: MessageSelection,
    path: Path,
    layout_path: Path,
    progress: Callable[[int, int], None],
) -> tuple[dict[str, int], int]:
    """Write the MCAP file and its layout; return messages by topic, and how many could not be read.

    Args:
        reader: of the record.
        selection: which of its messages.
        path: of the MCAP file, new.
        layout_path: of the layout, new.
        progress: called with the number of messages that have been read, and of how many.
    """
    wanted = [key for key in selection.keys(reader) if is_drawn(key)]
    total = sum(reader.topics()[key] for key in wanted)
    recorded = reader.last(keys.INFO)
    info = decode_or_none(recorded) if recorded else None
    scenario = scenario_of(info)
    drones = [subject(key) for key in wanted if key.startswith("drone/")]
    decoded = DecodedMessages(selection.messages(reader, wanted), _decode, lambda done: progress(done, total))
    file = FoxgloveFile(path, _rotors(info, scenario, dict.fromkeys(drones)), _spaces(scenario))
    try:
        for instant in instants(decoded):
            file.write(instant)
    finally:
        file.close()
    layout_path.write_text(layout(file.counts, file.variables()) + "\n", encoding="utf-8")
    return dict(sorted(file.counts.items())), decoded.refused


def _decode(recorded: Recorded) -> Any:
    return decode_or_none(recorded) if recorded.t_ns < LATEST_NS else None


def _rotors(info: Info | None, scenario: Scenario | None, present: dict[str, None]) -> dict[str, list[RotorDisc]]:
    """Return the rotors of every drone on record, in the order of the scenario.

    Of a drone whose rotors `world/info` does not name, they stand in a cross.
    """
    arms_m = {drone.name: drone.arm_m for drone in scenario.drones} if scenario else {}
    named = {drone.name: drone.rotors for drone in info.drones} if info else {}
    rotors = {}
    for name in sorted(present, key=list({**arms_m, **present}).index):
        arm_m = arms_m.get(name, ARM_M)
        cross = [RotorDisc(rotor.x_m, rotor.y_m, ROTOR_RADIUS * arm_m) for rotor in cross_layout(arm_m)]
        rotors[name] = [RotorDisc(each.x_m, each.y_m, each.radius_m) for each in named.get(name, ())] or cross
    return rotors


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
