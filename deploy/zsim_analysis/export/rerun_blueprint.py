"""A blueprint for Rerun beside a Foxglove file: what its viewer shows of that file, and where.

Rerun reads of the file transforms, poses, points, fixes, pictures, log and numbers; it draws no scenes and plots no
fields by itself. So the blueprint has the drones' meshes, which stand at the poses on record, and names the field
of each curve. It holds nothing of the flight: any Foxglove file of the same name and drones can be seen
with it. Made by Rerun's own library where it is installed; established with 0.41.
"""

import os
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from zsim.presentation import colours_of
from zsim_analysis.export.foxglove_file import CURVES, DRONE_PLOTS, DRONES_MAX, PICTURES, PICTURES_MAX, PLOTS_MAX, TAB
from zsim_analysis.export.foxglove_messages import PACKAGE, tidy
from zsim_analysis.export.foxglove_scene import DARK, MAGENTA, WORLD, RotorDisc, rgb
from zsim_analysis.export.foxglove_topics import DESIRED, LOG, POINTS

TIMELINE = "message_log_time"  # Rerun's name of the MCAP file's log time: simulated time
ROTOR_CORNERS = 16  # of a rotor's disc
EYE_M, TARGET_M = (14.0, -16.0, 14.0), (2.0, -2.0, 6.0)  # chosen: the paper's formation from the ground to 15 m
SPEED = 1.0  # simulated per wall second


class Curve(NamedTuple):
    """A curve: entity, component and field of the numbers on record, its name and its colour."""

    entity: str
    component: str
    field: str
    name: str
    colour: str


class DroneMesh(NamedTuple):
    """Triangles in the body frame: vertices (n, 3) [m; B], corners (m, 3) by vertex, colours (n, 4) 0 to 255."""

    vertices_m: np.ndarray
    triangles: np.ndarray
    colours: np.ndarray


def is_available() -> bool:
    """Return whether Rerun's library is installed."""
    return find_spec("rerun") is not None


def write_blueprint(
    path: Path,
    application: str,
    topics: Iterable[str],
    variables: Mapping[str, Sequence[str]],
    rotors: Mapping[str, Sequence[RotorDisc]],
) -> None:
    """Write the blueprint.

    Args:
        path: new.
        application: that the blueprint is for; Rerun takes the name of an MCAP file without its end for that.
        topics: of that file.
        variables: by cluster, the fields of its numbers.
        rotors: of every drone, in the order of the scenario.
    """
    os.environ.setdefault("RUST_LOG", "error")  # else Rerun warns of the entry name that it derives from an odd name
    import rerun.blueprint as rrb

    present = set(topics)
    left = rrb.Vertical(_scene(present, rotors), rrb.TextLogView(name="log", origin=LOG), row_shares=[3, 1])
    plots = [
        rrb.TimeSeriesView(name=title, overrides=_series(curves), contents=list(_series(curves)))
        for title, curves in panels(present, variables, colours_of(rotors))
    ]
    tabs = [
        rrb.Vertical(*plots[i : i + TAB], name=", ".join(str(plot.name) for plot in plots[i : i + TAB]))
        for i in range(0, len(plots), TAB)
    ]
    pictures = [topic for topic in sorted(present) if topic.endswith(PICTURES)][:PICTURES_MAX]
    tabs += (
        [rrb.Grid(*(rrb.Spatial2DView(name=topic, origin=topic) for topic in pictures), name="cameras")]
        if pictures
        else []
    )
    blueprint = rrb.Blueprint(
        rrb.Horizontal(left, rrb.Tabs(*tabs)) if tabs else left,
        rrb.TimePanel(timeline=TIMELINE, playback_speed=SPEED, play_state="paused"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
    with TemporaryDirectory() as folder:  # Rerun takes no path that is not UTF-8
        new = Path(folder) / "new.rbl"
        blueprint.save(application.encode(errors="replace").decode(), new)
        shutil.copyfile(new, path)


def panels(
    topics: Collection[str], variables: Mapping[str, Sequence[str]], colours: Mapping[str, str]
) -> list[tuple[str, list[Curve]]]:
    """Return title and curves of every plot: the clusters' variables, then the drones' numbers."""
    found = [
        (name if len(variables) == 1 else f"{cluster}: {name}", _variable(cluster, name))
        for cluster, fields in variables.items()
        for name in [each.removeprefix("desired_") for each in fields if each.startswith("desired_")][:PLOTS_MAX]
    ]
    numbers = {f"/drone/{drone}/numbers": drone for drone in colours}
    drones = [topic for topic in numbers if topic in topics]
    component = f"{PACKAGE}.Drone:message"
    return found + [
        (
            title,
            [Curve(topic, component, field, numbers[topic], colours[numbers[topic]]) for topic in drones[:DRONES_MAX]],
        )
        for title, field in DRONE_PLOTS
        if drones
    ]


def _variable(cluster: str, name: str) -> list[Curve]:
    component = f"{PACKAGE}.Cluster_{tidy(cluster)}:message"
    return [
        Curve(f"/cluster/{cluster}/variables", component, f"{what}_{name}", what, colour) for what, colour, _ in CURVES
    ]


def _series(curves: Sequence[Curve]) -> dict[Any, list[Any]]:
    """Return the visualizers of curves by their entity."""
    import rerun as rr
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    series: dict[Any, list[Any]] = {}
    for curve in curves:
        source = VisualizerComponentMapping(
            target="Scalars:scalars",
            source_kind=ComponentSourceKind.SourceComponent,
            source_component=curve.component,
            selector=f".{curve.field}",
        )
        look = rr.SeriesLines(names=curve.name, colors=[round(255 * part) for part in rgb(curve.colour)])
        series.setdefault(_entity(curve.entity), []).append(look.visualizer(mappings=[source]))
    return series


def _scene(topics: set[str], rotors: Mapping[str, Sequence[RotorDisc]]) -> Any:
    """Return the view in space: the drones' meshes at their poses, the points, everything in W."""
    import rerun as rr
    import rerun.blueprint as rrb

    meshes = {
        _entity(f"/drone/{name}/pose"): drone_mesh(discs, colours_of(rotors)[name])
        for name, discs in rotors.items()
        if f"/drone/{name}/pose" in topics
    }
    drawn: dict[Any, Any] = {
        path: rr.Mesh3D(
            vertex_positions=mesh.vertices_m, triangle_indices=mesh.triangles, vertex_colors=mesh.colours
        ).visualizer()
        for path, mesh in meshes.items()
    }
    return rrb.Spatial3DView(
        name="scene",
        origin="/",
        contents=[*meshes, *(topic for topic in (POINTS, DESIRED) if topic in topics), "/tf"],
        overrides=drawn,
        spatial_information=rrb.SpatialInformation(target_frame=WORLD),
        eye_controls=rrb.EyeControls3D(position=EYE_M, look_target=TARGET_M, eye_up=(0.0, 0.0, 1.0)),
    )


def _entity(topic: str) -> str:
    """Return Rerun's entity path of a topic, in which a point is escaped."""
    import rerun as rr

    return rr.new_entity_path(topic.strip("/").split("/"))


def drone_mesh(rotors: Sequence[RotorDisc], colour: str) -> DroneMesh:
    """Return a drone as triangles: a dark hull with its nose, and a disc for each rotor in the drone's colour."""
    arm_m = max(float(np.hypot(disc.x_m, disc.y_m)) for disc in rotors)
    parts = [
        _box((0.0, 0.0, 0.0), (arm_m, 0.4 * arm_m, 0.3 * arm_m), DARK),
        _box((0.35 * arm_m, 0.0, 0.1 * arm_m), (0.5 * arm_m, 0.3 * arm_m, 0.2 * arm_m), MAGENTA),
        *(_disc((disc.x_m, disc.y_m, 0.2 * arm_m), disc.radius_m, colour) for disc in rotors),
    ]
    starts = np.cumsum([0, *(len(part.vertices_m) for part in parts[:-1])])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=True)]
    return DroneMesh(
        np.concatenate([part.vertices_m for part in parts]),
        np.concatenate(triangles),
        np.concatenate([part.colours for part in parts]),
    )


def _box(middle_m: Sequence[float], size_m: Sequence[float], colour: str) -> DroneMesh:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = np.array([triangle for a, b, c, d in faces for triangle in ((a, b, c), (a, c, d))])
    return DroneMesh(corners * size_m + middle_m, triangles, _tint(colour, len(corners)))


def _disc(middle_m: Sequence[float], radius_m: float, colour: str) -> DroneMesh:
    angles = np.arange(ROTOR_CORNERS) * 2 * np.pi / ROTOR_CORNERS
    rim = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(ROTOR_CORNERS)]) * radius_m
    rim_numbers = np.arange(1, ROTOR_CORNERS + 1)
    triangles = np.column_stack([np.zeros(ROTOR_CORNERS, int), rim_numbers, np.roll(rim_numbers, -1)])
    return DroneMesh(np.vstack([np.zeros(3), rim]) + middle_m, triangles, _tint(colour, ROTOR_CORNERS + 1))


def _tint(colour: str, count: int) -> np.ndarray:
    return np.tile([*(round(255 * part) for part in rgb(colour)), 255], (count, 1)).astype(np.uint8)
