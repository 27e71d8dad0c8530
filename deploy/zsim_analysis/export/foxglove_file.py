"""Writes the Foxglove file of a record and its layout, in order of time and in bounded memory.

Foxglove reads all of it. Rerun draws no scenes; it has the transforms, poses, points, fixes, log and numbers, and shows
them by a blueprint (rerun_blueprint).
"""

import re
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
from foxglove import layouts

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraInfo
from zsim.contract.messages import Info
from zsim.errors import NotTrustedError
from zsim.record import Recorded, RecordReader
from zsim.scenario.scenario import Scenario
from zsim.vehicles.vehicle import cross_layout
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_analysis.export.foxglove_scene import Instant, RotorDisc, instants, is_drawn
from zsim_analysis.export.foxglove_topics import DRONES, ESTIMATES, FORMATIONS, GROUND, LOG, TRAILS, FoxgloveFile
from zsim_analysis.export.selection import DecodedMessages, MessageSelection, subject
from zsim_analysis.reading.recorded_run import decode_or_none, scenario_of, search_modules

LATEST_NS = 2**32 * 10**9  # Foxglove counts seconds in 32 bits
ARM_M = 0.1785  # m, the AR.Drone's, where the scenario is not known
ROTOR_RADIUS = 0.57  # of the arm, where the rotors are not known: 0.102 m at the AR.Drone's 0.1785 m


class ConvertedRun(NamedTuple):
    """What was written of a run.

    Attributes:
        topics: messages by topic.
        variables: by cluster, the fields of its numbers.
        rotors: of every drone.
        refused: messages that could not be read.
    """

    topics: dict[str, int]
    variables: dict[str, tuple[str, ...]]
    rotors: dict[str, list[RotorDisc]]
    refused: int


def convert(
    reader: RecordReader,
    selection: MessageSelection,
    path: Path,
    layout_path: Path,
    progress: Callable[[int, int], None],
) -> ConvertedRun:
    """Write the MCAP file and its layout; return what is in the file, and how many messages could not be read.

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
    search_modules(reader.path, info)
    scenario = scenario_of(info)
    drones = [subject(key) for key in wanted if key.startswith("drone/")]
    decoded = DecodedMessages(selection.messages(reader, wanted), _decode, lambda done: progress(done, total))
    rotors = _rotors(info, scenario, dict.fromkeys(drones))
    file = FoxgloveFile(path, rotors, _spaces(scenario))
    with deferred_signals() as check:
        try:
            for instant in chain(_cameras_before(reader, selection, wanted), instants(decoded)):
                file.write(instant)
                check()
        finally:
            file.close()
    layout_path.write_text(layout(file.counts, file.variables()) + "\n", encoding="utf-8")
    return ConvertedRun(dict(sorted(file.counts.items())), file.variables(), rotors, decoded.refused)


def _cameras_before(reader: RecordReader, selection: MessageSelection, wanted: Iterable[str]) -> Iterator[Instant]:
    """Yield how cameras see by what they said before the first time that is selected: they may say it once only."""
    from_ns = round((selection.from_s or 0.0) * 1e9)
    of_cameras = [key for key in wanted if messages.type_of(key) is CameraInfo]
    known: dict[str, CameraInfo] = {}
    for recorded in reader.messages(of_cameras) if from_ns and of_cameras else ():
        if recorded.t_ns < from_ns and (info := _decode(recorded)) is not None:
            known[recorded.key] = msgspec.structs.replace(info, t_ns=from_ns)
    if known:
        yield Instant(from_ns, cameras=list(known.items()))


@contextmanager
def deferred_signals() -> Iterator[Callable[[], None]]:
    """Yield a function that handles the SIGINT or SIGTERM that has come since.

    What their handlers raise would, within a call of the library, be printed there and lost.
    """
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    former = {number: handler for number in numbers if callable(handler := signal.getsignal(number))}

    def check() -> None:
        if came:
            number = came.pop(0)
            former[signal.Signals(number)](number, None)

    for number in former:
        signal.signal(number, lambda signum, _: came.append(signum))
    try:
        yield check
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
    check()


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
        except (ValueError, NotTrustedError):
            continue
    return spaces


Line = Literal["solid", "dashed"]
CURVES: tuple[tuple[str, str, Line], ...] = (
    ("desired", "#000000", "dashed"),
    ("estimated", "#e69f00", "solid"),
    ("true", "#0072b2", "solid"),
)
PLOTS_MAX = 12  # variables that are plotted: those of the paper's three drones
TAB = 3  # plots in a tab
DRONE_PLOTS = (
    ("altitude (m)", "true_z_m"),
    ("error of the estimate (m)", "error_m"),
    ("battery (%)", "battery_percent"),
)
DRONES_MAX = 12  # drones that are plotted
PICTURES, CALIBRATION = "_camera/image", "_camera/calibration"  # ends of topics
PICTURES_MAX = 6  # cameras that are shown: those of the paper's three drones


def layout(topics: Iterable[str], variables: Mapping[str, Sequence[str]]) -> str:
    """Return the layout as JSON.

    Args:
        topics: of the file.
        variables: by cluster, the fields of its numbers.
    """
    present = set(topics)
    drones = sorted(
        topic.split("/")[2] for topic in present if topic.startswith("/drone/") and topic.endswith("/numbers")
    )
    tabs = [tab for cluster, fields in variables.items() for tab in _cluster_tabs(cluster, fields, len(variables) > 1)]
    tabs += [layouts.TabItem(title="drones", content=_drone_plots(drones[:DRONES_MAX]))] if drones else []
    pictures = sorted(topic for topic in present if topic.endswith(PICTURES))
    tabs += [layouts.TabItem(title="cameras", content=_pictures(pictures[:PICTURES_MAX]))] if pictures else []
    left = _column((3, _scene(present)), (1, layouts.LogPanel(config=layouts.LogConfig(topic_to_render=LOG))))
    parts = [(2, layouts.TabContainer(tabs=tabs))] if tabs else []
    right = _column(*parts, (1, _states(variables, drones[:DRONES_MAX])))
    items = [layouts.SplitItem(proportion=1, content=side) for side in (left, right)]
    return layouts.Layout(content=layouts.SplitContainer(direction="row", items=items)).to_json()


def _scene(topics: set[str]) -> layouts.ThreeDeePanel:
    shown = {
        topic: layouts.BaseRendererSceneUpdateTopicSettings(visible=True)
        for topic in (DRONES, GROUND, TRAILS, FORMATIONS, ESTIMATES)
        if topic in topics
    }
    camera = layouts.ThreeDeeCameraState(distance=35.0, phi=60.0, theta_offset=45.0, perspective=True)
    config = layouts.ThreeDeeConfig(follow_tf="world", camera_state=camera, topics=dict(shown))
    return layouts.ThreeDeePanel(config=config, title="scene")


def _cluster_tabs(cluster: str, fields: Sequence[str], several: bool) -> list[layouts.TabItem]:
    """Return tabs of three variables each: place, attitude, the drones' headings, and the shape, of the paper's."""
    names = [field.removeprefix("desired_") for field in fields if field.startswith("desired_")][:PLOTS_MAX]
    groups = [names[i : i + TAB] for i in range(0, len(names), TAB)]
    before = f"{cluster}: " if several else ""
    return [
        layouts.TabItem(
            title=before + ", ".join(group), content=_column(*((1, _variable(cluster, name)) for name in group))
        )
        for group in groups
    ]


def _variable(cluster: str, name: str) -> layouts.PlotPanel:
    series = [
        layouts.PlotSeries(
            value=_path(f"/cluster/{cluster}/variables", f"{what}_{name}"),
            label=what,
            color=tint,
            line_style=style,
            enabled=True,
        )
        for what, tint, style in CURVES
    ]
    return _plot(name, series)


def _drone_plots(drones: Sequence[str]) -> layouts.SplitContainer:
    panels = [
        _plot(
            title,
            [layouts.PlotSeries(value=_path(f"/drone/{d}/numbers", field), label=d, enabled=True) for d in drones],
        )
        for title, field in DRONE_PLOTS
    ]
    return _column(*((1, panel) for panel in panels))


def _pictures(topics: Sequence[str]) -> layouts.SplitContainer:
    """Return a panel for each camera, with what its pixels mean."""
    modes = {
        topic: layouts.ImageModeConfig(
            image_topic=topic, calibration_topic=f"{topic.removesuffix(PICTURES)}{CALIBRATION}"
        )
        for topic in topics
    }
    return _column(
        *(
            (1, layouts.ImagePanel(config=layouts.ImageConfig(image_mode=mode), title=topic.split("/", 2)[2]))
            for topic, mode in modes.items()
        )
    )


def _plot(title: str, series: list[layouts.PlotSeries]) -> layouts.PlotPanel:
    config = layouts.PlotConfig(paths=series, is_synced=True, x_axis_val="timestamp", show_legend=True)
    return layouts.PlotPanel(config=config, title=title)


def _states(clusters: Iterable[str], drones: Iterable[str]) -> layouts.StateTransitionsPanel:
    paths = [(_path(f"/cluster/{name}/variables", "phase"), name) for name in clusters]
    paths += [(_path(f"/drone/{name}/numbers", "state"), name) for name in drones]
    series = [layouts.StateTransitionsSeries(value=value, label=label, enabled=True) for value, label in paths]
    return layouts.StateTransitionsPanel(config=layouts.StateTransitionsConfig(paths=series, is_synced=True))


def _column(*parts: tuple[float, layouts.Content]) -> layouts.SplitContainer:
    items = [layouts.SplitItem(proportion=share, content=content) for share, content in parts]
    return layouts.SplitContainer(direction="column", items=items)


def _path(topic: str, field: str) -> str:
    """Return a message path; a topic with characters that have a meaning in paths is quoted."""
    return f"{topic}.{field}" if re.fullmatch(r"[\w/]+", topic) else f'"{topic}".{field}'
