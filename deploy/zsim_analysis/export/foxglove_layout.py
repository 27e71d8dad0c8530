"""The layout for Foxglove: the scene, the cluster variables, the drones' states, and the log."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

from foxglove import layouts

from zsim_analysis.export.foxglove_topics import DRONES, ESTIMATES, FORMATIONS, GROUND, LOG, TRAILS

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
