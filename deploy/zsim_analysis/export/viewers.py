"""How viewers arrange a Foxglove file: a layout for Foxglove, a blueprint for Rerun.

Both show the scene, the log, plots of the clusters' variables and of the drones' numbers, and the cameras. Rerun by
itself neither draws scenes nor plots fields, so its blueprint contains meshes of the drones, placed at the recorded
poses, and names the field of each curve. A blueprint contains nothing of the flight: any Foxglove file with the same
name and drones can be viewed with it. Rerun's own library writes it, if installed (tested with 0.41).
"""

import os
import re
import shutil
from collections.abc import Collection, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import numpy as np
from foxglove import layouts

from zsim.presentation import colours_of, rgb
from zsim_analysis.export import foxglove_file
from zsim_analysis.export.foxglove_messages import BODY, PACKAGE, WORLD, RotorDisc, arm_of, tidy

CURVES: tuple[tuple[str, str, Literal["solid", "dashed"]], ...] = (
    ("desired", "#000000", "dashed"),
    ("estimated", "#e69f00", "solid"),
    ("true", "#0072b2", "solid"),
)
DRONE_PLOTS = {"altitude (m)": "true_z_m", "error of the estimate (m)": "error_m", "battery (%)": "battery_percent"}
PLOTS_MAX = 12  # maximum number of plotted variables per cluster: as many as the paper's three drones have
TAB = 3  # plots per tab
DRONES_MAX = 12  # maximum number of plotted drones
PICTURES, CALIBRATION = "_camera/image", "_camera/calibration"  # suffixes of topics
PICTURES_MAX = 6  # maximum number of cameras shown: as many as the paper's three drones have
TIMELINE = "message_log_time"  # Rerun's name for the MCAP file's log time: simulated time
ROTOR_CORNERS = 16  # corners of a rotor's disc
# position and target of the eye in W; design choice: they show the paper's formation from the ground to 15 m
EYE_M, TARGET_M = (14.0, -16.0, 14.0), (2.0, -2.0, 6.0)
SPEED = 1.0  # simulated seconds per second of wall time


class Curve(NamedTuple):
    """A curve: the topic, Rerun component and field of its numbers, and its name and look."""

    topic: str
    component: str
    field: str
    name: str
    colour: str
    style: Literal["solid", "dashed"] = "solid"


Plot = tuple[str, list[Curve]]  # title and curves


def variable_plots(variables: Mapping[str, Sequence[str]]) -> dict[str, list[Plot]]:
    """Return plots by cluster, for its first PLOTS_MAX variables; `variables`: numeric fields by cluster."""
    plots: dict[str, list[Plot]] = {}
    for cluster, fields in variables.items():
        topic, component = f"/cluster/{cluster}/variables", f"{PACKAGE}.Cluster_{tidy(cluster)}:message"
        names = [field.removeprefix("desired_") for field in fields if field.startswith("desired_")][:PLOTS_MAX]
        plots[cluster] = [
            (name, [Curve(topic, component, f"{what}_{name}", what, tint, style) for what, tint, style in CURVES])
            for name in names
        ]
    return plots


def drone_plots(topics: Collection[str], colours: Mapping[str, str]) -> list[Plot]:
    """Return the DRONE_PLOTS of the first drones with numbers, in the order of `colours`; empty if none has numbers."""
    numbers = {f"/drone/{name}/numbers": name for name in colours}
    drones = [(topic, name) for topic, name in numbers.items() if topic in topics][:DRONES_MAX]
    return [
        (title, [Curve(topic, f"{PACKAGE}.Drone:message", field, name, colours[name]) for topic, name in drones])
        for title, field in DRONE_PLOTS.items()
        if drones
    ]


def _pictures(topics: Collection[str]) -> list[str]:
    return sorted(topic for topic in topics if topic.endswith(PICTURES))[:PICTURES_MAX]


# Foxglove


def layout(run: foxglove_file.ConvertedRun) -> str:
    """Return a Foxglove layout for a file, as JSON."""
    states = [(_path(f"/cluster/{name}/variables", "phase"), name) for name in run.variables]
    tabs = []
    for cluster, plots in variable_plots(run.variables).items():
        prefix = f"{cluster}: " if len(run.variables) > 1 else ""
        for group in (plots[i : i + TAB] for i in range(0, len(plots), TAB)):
            title = prefix + ", ".join(name for name, _ in group)
            panels = [_plot(name, curves, coloured=True) for name, curves in group]
            tabs.append(layouts.TabItem(title=title, content=_column(*((1, panel) for panel in panels))))
    if plots := drone_plots(run.topics, dict(sorted(colours_of(run.rotors).items()))):
        panels = [_plot(title, curves, coloured=False) for title, curves in plots]
        tabs.append(layouts.TabItem(title="drones", content=_column(*((1, panel) for panel in panels))))
        states += [(_path(curve.topic, "state"), curve.name) for curve in plots[0][1]]
    if pictures := _pictures(run.topics):
        cameras = []
        for topic in pictures:
            calibration = f"{topic.removesuffix(PICTURES)}{CALIBRATION}"
            mode = layouts.ImageModeConfig(image_topic=topic, calibration_topic=calibration)
            config = layouts.ImageConfig(image_mode=mode)
            cameras.append((1, layouts.ImagePanel(config=config, title=topic.split("/", 2)[2])))
        tabs.append(layouts.TabItem(title="cameras", content=_column(*cameras)))
    shown = {
        topic: layouts.BaseRendererSceneUpdateTopicSettings(visible=True)
        for topic in (
            foxglove_file.DRONES,
            foxglove_file.GROUND,
            foxglove_file.TRAILS,
            foxglove_file.FORMATIONS,
            foxglove_file.ESTIMATES,
        )
        if topic in run.topics
    }
    camera = layouts.ThreeDeeCameraState(distance=35.0, phi=60.0, theta_offset=45.0, perspective=True)
    config = layouts.ThreeDeeConfig(follow_tf=WORLD, camera_state=camera, topics=dict(shown))
    scene = layouts.ThreeDeePanel(config=config, title="scene")
    left = _column((3, scene), (1, layouts.LogPanel(config=layouts.LogConfig(topic_to_render=foxglove_file.LOG))))
    series = [layouts.StateTransitionsSeries(value=value, label=label, enabled=True) for value, label in states]
    transitions = layouts.StateTransitionsPanel(config=layouts.StateTransitionsConfig(paths=series, is_synced=True))
    right = _column(*([(2, layouts.TabContainer(tabs=tabs))] if tabs else []), (1, transitions))
    items = [layouts.SplitItem(proportion=1, content=side) for side in (left, right)]
    return layouts.Layout(content=layouts.SplitContainer(direction="row", items=items)).to_json()


def _plot(title: str, curves: Sequence[Curve], coloured: bool) -> layouts.PlotPanel:
    """Return a panel whose curves have their own look or, if not `coloured`, a look chosen by Foxglove."""
    series = []
    for curve in curves:
        look: dict[str, Any] = {"color": curve.colour, "line_style": curve.style} if coloured else {}
        value = _path(curve.topic, curve.field)
        series.append(layouts.PlotSeries(value=value, label=curve.name, enabled=True, **look))
    config = layouts.PlotConfig(paths=series, is_synced=True, x_axis_val="timestamp", show_legend=True)
    return layouts.PlotPanel(config=config, title=title)


def _column(*parts: tuple[float, layouts.Content]) -> layouts.SplitContainer:
    items = [layouts.SplitItem(proportion=share, content=content) for share, content in parts]
    return layouts.SplitContainer(direction="column", items=items)


def _path(topic: str, field: str) -> str:
    """Return a message path; a topic with characters that are special in paths is quoted."""
    return f"{topic}.{field}" if re.fullmatch(r"[\w/]+", topic) else f'"{topic}".{field}'


# Rerun


def has_rerun() -> bool:
    return find_spec("rerun") is not None


def write_blueprint(path: Path, application: str, run: foxglove_file.ConvertedRun) -> None:
    """Write a Rerun blueprint for a file; `application` is Rerun's name for the file: the file name without suffix."""
    os.environ.setdefault("RUST_LOG", "error")  # otherwise Rerun warns about unusual file names
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    left = rrb.Vertical(_scene(run), rrb.TextLogView(name="log", origin=foxglove_file.LOG), row_shares=[3, 1])
    views = []
    for title, curves in plots(run):
        series: dict[Any, list[Any]] = {}  # the curves' visualizers by entity
        for curve in curves:
            source = VisualizerComponentMapping(
                target="Scalars:scalars",
                source_kind=ComponentSourceKind.SourceComponent,
                source_component=curve.component,
                selector=f".{curve.field}",
            )
            look = rr.SeriesLines(names=curve.name, colors=list(rgb(curve.colour)))
            series.setdefault(_entity(curve.topic), []).append(look.visualizer(mappings=[source]))
        views.append(rrb.TimeSeriesView(name=title, overrides=series, contents=list(series)))
    groups = [views[i : i + TAB] for i in range(0, len(views), TAB)]
    tabs: list[Any] = [rrb.Vertical(*group, name=", ".join(str(view.name) for view in group)) for group in groups]
    if pictures := _pictures(run.topics):
        tabs.append(rrb.Grid(*(rrb.Spatial2DView(name=topic, origin=topic) for topic in pictures), name="cameras"))
    blueprint = rrb.Blueprint(
        rrb.Horizontal(left, rrb.Tabs(*tabs)) if tabs else left,
        rrb.TimePanel(timeline=TIMELINE, playback_speed=SPEED, play_state="paused"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
    with TemporaryDirectory() as folder:  # Rerun accepts only paths in UTF-8
        new = Path(folder) / "new.rbl"
        blueprint.save(application.encode(errors="replace").decode(), new)
        shutil.copyfile(new, path)


def plots(run: foxglove_file.ConvertedRun) -> list[Plot]:
    several = len(run.variables) > 1
    by_cluster = variable_plots(run.variables).items()
    found = [
        (f"{cluster}: {name}" if several else name, curves) for cluster, each in by_cluster for name, curves in each
    ]
    return found + drone_plots(run.topics, colours_of(run.rotors))


def _scene(run: foxglove_file.ConvertedRun) -> Any:
    """Return the 3D view: the drones' meshes at their poses, and the points, all in W."""
    import rerun as rr
    import rerun.blueprint as rrb

    drawn: dict[Any, Any] = {}
    for name, tint in colours_of(run.rotors).items():
        if f"/drone/{name}/pose" in run.topics:
            mesh = drone_mesh(run.rotors[name], tint)
            shape: dict[str, Any] = {"vertex_positions": mesh.vertices_m, "vertex_colors": mesh.colours}
            drawn[_entity(f"/drone/{name}/pose")] = rr.Mesh3D(triangle_indices=mesh.triangles, **shape).visualizer()
    return rrb.Spatial3DView(
        name="scene",
        origin="/",
        contents=[
            *drawn,
            *(topic for topic in (foxglove_file.POINTS, foxglove_file.DESIRED) if topic in run.topics),
            "/tf",
        ],
        overrides=drawn,
        spatial_information=rrb.SpatialInformation(target_frame=WORLD),
        eye_controls=rrb.EyeControls3D(position=EYE_M, look_target=TARGET_M, eye_up=(0.0, 0.0, 1.0)),
    )


def _entity(topic: str) -> str:
    """Return Rerun's entity path for a topic, with dots escaped."""
    import rerun as rr

    return rr.new_entity_path(topic.strip("/").split("/"))


class DroneMesh(NamedTuple):
    """Triangles in the body frame: vertices (n, 3) [m; B], indices of corners (m, 3), RGBA colours (n, 4) 0 to 255."""

    vertices_m: np.ndarray
    triangles: np.ndarray
    colours: np.ndarray


def drone_mesh(rotors: Sequence[RotorDisc], colour: str) -> DroneMesh:
    """Return a drone as triangles: the boxes of its body, and a disc for each rotor in the drone's colour."""
    arm_m = arm_of(rotors)
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    box_triangles = np.array([triangle for a, b, c, d in faces for triangle in ((a, b, c), (a, c, d))])
    angles = np.arange(ROTOR_CORNERS) * 2 * np.pi / ROTOR_CORNERS
    rim = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(ROTOR_CORNERS)])
    numbers = np.arange(1, ROTOR_CORNERS + 1)
    disc_triangles = np.column_stack([np.zeros(ROTOR_CORNERS, int), numbers, np.roll(numbers, -1)])
    vertices = [arm_m * (corners * box.size + box.middle) for box in BODY]
    discs = [(disc, (disc.x_m, disc.y_m, 0.2 * arm_m)) for disc in rotors]
    vertices += [np.vstack([np.zeros(3), rim * disc.radius_m]) + middle_m for disc, middle_m in discs]
    triangles, tints = [box_triangles] * len(BODY) + [disc_triangles] * len(discs), [box.colour for box in BODY]
    tints += [colour] * len(discs)
    starts = np.cumsum([0, *(len(part) for part in vertices[:-1])])
    colours = [np.tile([*rgb(tint), 255], (len(part), 1)) for part, tint in zip(vertices, tints, strict=True)]
    return DroneMesh(
        np.concatenate(vertices),
        np.concatenate([part + start for part, start in zip(triangles, starts, strict=True)]),
        np.concatenate(colours).astype(np.uint8),
    )
