"""The 3-D scene of a run: its newest views as nodes of viser, which sends only changes.

`RunScene` decides what is drawn, and `SceneNodes` draws it for all pages; the ground follows each page's own theme, and
the ring around the chosen drone belongs to one page.

Multirotors are meshes of simple solids in B: x ahead, y left, z up, origin at the centre of mass. They look like the
AR.Drone, scaled by the length of their arms, with their own rotors. Lengths are in metres; those of solids are the
AR.Drone's. The meshes are for display only and do not enter the simulation.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray
from trimesh.creation import annulus, box, capsule, cylinder, icosphere
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from zsim.contract.flight_messages import ViewDrones
from zsim.contract.messages import DroneInfo
from zsim.math import frames
from zsim.presentation import drone_colours, rgb
from zsim.scenario.scenario import Obstacle, Surface
from zsim.scenario.surroundings import corners_of, placed
from zsim.sensors.camera import Hats
from zsim.vehicles.vehicle import cross_layout
from zsim_bridges.console.histories import CanvasTrails
from zsim_bridges.console.page_cameras import PageCameras
from zsim_bridges.console.picture import (
    FULL_NAMES_MAX,
    Array,
    DronePoses,
    Ellipsoids,
    FlightPreview,
    FormationShape,
    drone_on_ray,
    drone_poses,
    ellipsoids,
    formation_shape,
    ghosts,
    radio_lines,
    reference_lines,
    rotor_angles,
    rotor_poses,
    shown_names,
)
from zsim_bridges.console.run_condition import ShownRun
from zsim_bridges.console.view_buffer import ViewBuffer

NAMED_MAX = 60  # maximum number of drones with names beside them; more names would overlap
NAME_SCALE_SMALL = 0.8  # relative size of the names if there are many drones
SOLID = (134, 142, 150)
EDGE = (96, 102, 118)  # edges of a surface's triangles, since shading hardly shows their slopes
GHOST, ELLIPSOID, WIND, SIDE = (77, 171, 247), (250, 176, 5), (21, 170, 191), (226, 0, 134)
PREVIEW = (217, 72, 15)
PREVIEW_PX = 3.0  # width of a previewed path
RADIO, ONE_WAY = (64, 192, 87), (250, 82, 82)  # radio links: bidirectional, one-way
RADIO_PX = 1.5
SIDE_PX = 2.0  # width of a formation's sides, at any distance
WIND_M_PER_M_S = 0.5  # length of the wind's arrow per unit of wind speed
WIND_MIN_M_S = 0.05  # a weaker wind has no arrow
WIND_ABOVE_M = 1.5  # height of the arrow above the highest drone
LABEL_B = np.array([0.0, 0.0, 0.32])  # m; position of a name relative to its drone
LABEL_ANCHOR = "center-center"  # anchor of a label
LABELS_MAX = 3  # maximum number of a formation's figures: p, q and beta
LUMINANCE_MIN = 0.12  # minimum luminance of a trail: a contrast of 2.5 with the ground of the dark theme (WCAG 2.2)
HIDDEN = (0.0, 0.0, -1000.0)  # m; position of hidden instances, since viser cannot hide them one by one
GROUND_HALF_M = 150.0  # half a side of the ground
FIELD_BELOW_M = 0.15  # depth of the field below the grid; a depth buffer cannot order closer surfaces
FIELD_THICKNESS_M = 0.02  # thickness of the field
LIGHT = ((206, 219, 196), (190, 200, 184), (138, 150, 132))  # colours of the field, the grid's cells and its sections
DARK = ((30, 35, 30), (84, 94, 82), (122, 134, 118))
CHOSEN = (25, 113, 194)
ARM_M = 0.1785  # distance from the centre to a rotor's axis
ROTOR_RADIUS_M = 0.10  # the AR.Drone's 8-inch propellers
RING_RADIUS_RATIO = 1.31  # of a hull ring to a rotor; half the hull's 0.515 m less the ring's offset of 0.126 m
ROTOR_Z_M = 0.030  # height of the rotors above the centre of mass, as drawn
COLOURS = {  # sRGB, 0 to 255; the greys are lighter than the AR.Drone's, to stand out in the dark theme too
    "cross": (104, 108, 116),
    "hull": (124, 129, 138),
    "nose": (240, 108, 24),  # the orange of the outdoor hull's nose
    "hat": (226, 0, 134),  # the paper's magenta marker
    "rotor": (96, 99, 105),
}


class RunScene:
    """The scene of one run, which replaces that of the previous run."""

    def __init__(self, server: viser.ViserServer, run: ShownRun, views: ViewBuffer, cameras: PageCameras) -> None:
        self._run = run
        self._views = views
        self._cameras = cameras
        self._members = {name: [run.names.index(each) for each in drones] for name, drones in run.members.items()}
        self._drawn_ghosts: dict[str, Any] = {}
        self.drones: DronePoses | None = None  # newest poses of the drones
        self.shapes: dict[str, FormationShape | None] = {}  # true shapes by formation; None if undefined
        self.previews: dict[str, Array] = {}  # paths (n, M, 3) [m] that formations would fly
        self.trails = CanvasTrails(len(run.names), is_replay=run.is_replay)
        robots = sum(space.n for space in run.spaces.values())
        arms_m = [drone.arm_m for drone in run.scenario.drones]
        self.nodes = SceneNodes(server, run.info.drones, arms_m, robots, len(run.spaces))
        self.nodes.obstacles(run.scenario.environment.obstacles)
        self.nodes.surfaces(run.scenario.environment.surfaces or ())
        self.nodes.references(reference_lines(run.scenario))
        cameras.restart()

    def clicked(self, event: viser.SceneClickEvent) -> str | None:
        if self.drones is None:
            return None
        return drone_on_ray(self.drones, self.nodes.radii_m, event.ray_origin, event.ray_direction)

    def store(self, view: ViewDrones) -> DronePoses:
        """Store and return the drones' newest poses, at which the cameras of new pages will be aimed."""
        drones = drone_poses(view, self._run.names)
        self.drones = drones
        self.trails.add(drones.t_ns / 1e9, drones.p_W)
        self.shapes = self.shapes_of(drones)
        self._cameras.set_target(self._camera_targets(drones))
        return drones

    def draw(self, view: ViewDrones, interval_max_s: float, chosen: str) -> DronePoses:
        """Draw a view of the drones, and return their poses.

        Rotors turn for at most `interval_max_s` between pictures; `chosen` is the formation whose figures are shown.
        """
        before_ns = self.drones.t_ns if self.drones is not None else 0
        drones = self.store(view)
        self.nodes.drones(drones, min(interval_max_s, max(0.0, (drones.t_ns - before_ns) / 1e9)))
        estimates = self._views.estimates().values()
        self.nodes.estimates(ellipsoids([each.estimate for each in estimates if each.is_fresh]))
        if self.shapes:
            self.nodes.shapes(list(self.shapes.values()), list(self.shapes).index(chosen))
        desired = {name: (view.phase, view.desired) for name, view in self._views.clusters.items()}
        if desired != self._drawn_ghosts:
            self._drawn_ghosts = desired
            poses = [ghosts(self._run.spaces[name], view) for name, view in self._views.clusters.items()]
            shown = [(np.zeros((0, 3)), np.zeros((0, 4))), *(each for each in poses if each is not None)]
            self.nodes.ghosts(np.concatenate([p_W for p_W, _ in shown]), np.concatenate([q for _, q in shown]))
        if self._views.radio is not None:
            self.nodes.radio(radio_lines(self._views.radio.hears, drones))
        self._cameras.follow(self._camera_targets(drones))
        return drones

    def preview(self, cluster: str, shown: FlightPreview | None) -> None:
        """Replace a formation's preview, or remove it (None)."""
        others = {name: paths_W for name, paths_W in self.previews.items() if name != cluster}
        self.previews = {**others, cluster: shown.paths_W} if shown else others
        self.nodes.previews(list(self.previews.values()))

    def draw_trails(self) -> None:
        if self.drones is not None:
            segments, owners, _ = self.trails.segments(self.drones.t_ns / 1e9, self.drones.p_W)
            self.nodes.trails(segments, owners)
            self.nodes.wind(self.drones)

    def shapes_of(self, drones: DronePoses) -> dict[str, FormationShape | None]:
        """Return the formations' true shapes by name; None if a drone is missing or the shape is singular."""
        present, yaw = drones.present, frames.heading(drones.q_WB)
        return {
            name: formation_shape(space, drones.p_W[members], yaw[members]) if present[members].all() else None
            for name, space in self._run.spaces.items()
            for members in [self._members[name]]
        }

    def _camera_targets(self, drones: DronePoses) -> Array:
        """Return the positions (n, 3) that cameras follow: those of the only formation, or of all drones."""
        members = next(iter(self._members.values())) if len(self._members) == 1 else slice(None)
        return drones.p_W[members][drones.present[members]]


class SceneNodes:
    """The nodes of a run of N drones; `robots` of them are in one of the `clusters` formations, each with a ghost."""

    def __init__(
        self,
        server: viser.ViserServer,
        drones: Sequence[DroneInfo],
        arms_m: Sequence[float],
        robots: int,
        clusters: int,
    ) -> None:
        self._scene = scene = server.scene
        names = tuple(drone.name for drone in drones)
        self._trail_node: Any = None
        self._trail_colours = linear(np.array([lightened(rgb(each)) for each in drone_colours(max(1, len(drones)))]))
        self._trails_shown = True
        scene.reset()
        scene.set_up_direction("+z")
        draw_ground(scene)
        scene.add_frame("/origin", axes_length=1.0, axes_radius=0.02, position=(0.0, 0.0, 0.01))
        scene.add_label("/origin/e", "east", position=(1.1, 0.0, 0.0))
        scene.add_label("/origin/n", "north", position=(0.0, 1.1, 0.0))
        shapes = [shape_of(*each) for each in zip(drones, arms_m, strict=True)]
        self.radii_m: Array = np.array([shape.reach_m for shape in shapes])  # (N,), from the centre

        self._airframes: list[tuple[NDArray[np.int64], Any]] = []  # one node for all drones that look alike
        for k, shape in enumerate(dict.fromkeys(shapes)):
            owners = np.array([i for i, other in enumerate(shapes) if other == shape])
            p, q, _ = _padded(len(owners))
            node = scene.add_batched_glb(f"/drones/{k}" if k else "/drones", coloured_glb(shape), q, p, lod="off")
            self._airframes.append((owners, node))
        self._rotors = _RotorNodes(drones, shapes, self._batch)
        ghost = drone_mesh(shapes[0])
        self._ghosts = self._batch("/ghosts", ghost, robots, GHOST, opacity=0.5) if robots else None
        self._ellipsoids = self._batch("/estimates", ball_mesh(), len(names), ELLIPSOID, opacity=0.35)
        if robots:
            self._preview_ends = self._batch("/preview_ends", ghost, robots, PREVIEW, opacity=0.6)
            self._preview_lines: Any = scene.add_line_segments(
                "/preview", np.tile(HIDDEN, (1, 2, 1)), PREVIEW, thickness=PREVIEW_PX, thickness_units="screen",
                visible=False,
            )  # fmt: skip
        self._names: list[Any] = []
        if len(names) <= NAMED_MAX:
            style: Any = {
                "anchor": "bottom-center",
                "font_screen_scale": NAME_SCALE_SMALL if len(names) > FULL_NAMES_MAX else 1.0,
            }
            texts = zip(names, shown_names(names), strict=True)
            self._names = [scene.add_label(f"/names/{name}", text, **style) for name, text in texts]
        self._wind = scene.add_arrows(
            "/wind", np.array([[(0, 0, 0), (1, 0, 0)]], float), WIND, shaft_radius=0.035, head_radius=0.1,
            head_length=0.22, visible=False,
        )  # fmt: skip
        self._radio: Any = None
        self._wind_label = scene.add_label("/wind_speed", "", visible=False, anchor="bottom-left")
        self._formation_sides: Any = None
        if clusters:
            p, q, _ = _padded(clusters)
            axes: Any = {"axes_length": 0.7, "axes_radius": 0.02}
            self._formation_frames: Any = scene.add_batched_axes("/formations/frames", q, p, **axes)
            self._value_labels = [
                scene.add_label(f"/formations/label{i}", "", visible=False, anchor=LABEL_ANCHOR)
                for i in range(LABELS_MAX)
            ]

    def _batch(self, name: str, mesh: "Mesh", count: int, colour: Any, opacity: float | None = None) -> Any:
        p, q, scales = _padded(count)
        return self._scene.add_batched_meshes_simple(
            name, mesh.vertices, mesh.faces, q, p, batched_scales=scales, batched_colors=colour, opacity=opacity,
            lod="off", flat_shading=opacity is None, cast_shadow=opacity is None, receive_shadow=False,
        )  # fmt: skip

    def obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        for each in obstacles:
            x, y, z = each.position_m
            turn = math.radians(each.yaw_deg) / 2
            style: Any = {"wxyz": (math.cos(turn), 0.0, 0.0, math.sin(turn)), "color": SOLID}
            name = f"/obstacles/{each.name}"
            height_m = each.height_m or 0.0
            if each.size_m is not None:
                self._scene.add_box(name, dimensions=each.size_m, position=(x, y, z + each.size_m[2] / 2), **style)
            elif each.shape == "cylinder":
                centre = (x, y, z + height_m / 2)
                self._scene.add_cylinder(name, radius=each.radius_m or 0.0, height=height_m, position=centre, **style)
            else:
                self._scene.add_icosphere(name, radius=each.radius_m or 0.0, position=(x, y, z), **style)

    def surfaces(self, surfaces: Sequence[Surface]) -> None:
        for each in surfaces:
            corners = corners_of(placed(each)).reshape(-1, 3).astype(np.float32)
            faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
            style: Any = {"color": SOLID, "flat_shading": True, "side": "double"}
            self._scene.add_mesh_simple(f"/surfaces/{each.name}", corners, faces, **style)
            self._scene.add_mesh_simple(f"/surfaces/{each.name}/edges", corners, faces, color=EDGE, wireframe=True)

    def references(self, lines: Array) -> None:
        """Draw the reference paths of single drones, as segments (M, 2, 3) [m; W]."""
        if len(lines):
            style: Any = {"thickness": SIDE_PX, "thickness_units": "screen"}
            self._scene.add_line_segments("/references", lines.astype(np.float32), GHOST, **style)

    def on_click(self, act: Callable[[viser.SceneClickEvent], None]) -> None:
        """Register a callback for each click in the scene.

        It is not registered on the drones' nodes: a page of viser 1.1.1 fails to open if a batched mesh is clickable.
        """
        self._scene.on_click()(act)

    def close(self) -> None:
        """Remove the callbacks; the nodes remain."""
        self._scene.remove_click_callback("all")

    def drones(self, drones: DronePoses, dt_s: float) -> None:
        """Move the drones, and turn their rotors for `dt_s`."""
        drones = drones._replace(p_W=np.where(drones.present[:, None], drones.p_W, HIDDEN))
        for owners, node in self._airframes:
            node.batched_positions, node.batched_wxyzs = drones.p_W[owners], drones.q_WB[owners]
        self._rotors.move(drones, dt_s)
        for label, p_W in zip(self._names, drones.p_W, strict=False):
            label.position = p_W + LABEL_B

    def wind(self, drones: DronePoses) -> None:
        """Draw the arrow of the wind above the drones."""
        speed = float(np.linalg.norm(drones.wind_W))
        present = drones.p_W[drones.present]
        has_wind = speed >= WIND_MIN_M_S and len(present) > 0
        self._wind.visible = self._wind_label.visible = has_wind
        if has_wind:
            start = np.array([*present[:, :2].mean(axis=0), present[:, 2].max() + WIND_ABOVE_M])
            self._wind.points = np.array([[start, start + WIND_M_PER_M_S * drones.wind_W]])
            self._wind_label.position, self._wind_label.text = start, f"wind {speed:.1f} m/s"

    def radio(self, lines: tuple[Array, Array]) -> None:
        """Draw the lines of bidirectional and of one-way radio links between drones."""
        points = np.concatenate([*lines, np.tile(HIDDEN, (1, 2, 1))]).astype(np.float32)
        count, bidirectional = len(points), len(lines[0])
        colours = np.tile(linear(np.array(RADIO)), (count, 2, 1))
        colours[bidirectional:] = linear(np.array(ONE_WAY))
        if self._radio is None:
            self._radio = self._scene.add_line_segments(
                "/radio", points, colours, thickness=RADIO_PX, thickness_units="screen"
            )
        else:
            self._radio.points, self._radio.colors = points, colours

    def estimates(self, ellipsoids: Ellipsoids) -> None:
        node = self._ellipsoids
        p, q, half_m = _padded(len(self.radii_m), ellipsoids.p_W, ellipsoids.wxyz)
        half_m[: len(ellipsoids.half_m)] = ellipsoids.half_m
        node.batched_positions, node.batched_wxyzs, node.batched_scales = p, q, half_m

    def ghosts(self, p_W: Array, q: Array) -> None:
        """Move the ghosts of the formations to their desired positions; missing ones are hidden."""
        if self._ghosts is not None:
            positions, attitudes, _ = _padded(len(self._ghosts.batched_positions), p_W, q)
            self._ghosts.batched_positions, self._ghosts.batched_wxyzs = positions, attitudes

    def previews(self, paths_W: Sequence[Array]) -> None:
        """Draw the previewed paths, each (n, M, 3) [m; W], and their ends."""
        lines = [np.stack((path[:, :-1], path[:, 1:]), axis=2).reshape(-1, 2, 3) for path in paths_W]
        ends = [path[:, -1] for path in paths_W]
        segments = np.asarray(np.concatenate(lines) if lines else np.tile(HIDDEN, (1, 2, 1)), np.float32)
        p_W = np.concatenate(ends) if ends else np.zeros((0, 3))
        self._preview_lines.points, self._preview_lines.visible = segments, bool(lines)
        p, q, _ = _padded(len(self._preview_ends.batched_positions), p_W)
        self._preview_ends.batched_positions, self._preview_ends.batched_wxyzs = p, q

    def shapes(self, shapes: Sequence[FormationShape | None], chosen: int) -> None:
        """Draw the frames and triangles of all formations, and the figures of the chosen one."""
        shown = [shape for shape in shapes if shape is not None]
        p_W, q = np.array([s.p_c for s in shown]).reshape(-1, 3), np.array([s.q_WC for s in shown]).reshape(-1, 4)
        frame_nodes = self._formation_frames
        frame_nodes.batched_positions, frame_nodes.batched_wxyzs, _ = _padded(len(shapes), p_W, q)
        points = np.array([side.ends_W for shape in shown for side in shape.sides]).reshape(-1, 2, 3)
        if self._formation_sides is not None:
            self._formation_sides.points = points
        elif len(points):
            self._formation_sides = self._scene.add_line_segments(
                "/formations/sides", points, SIDE, thickness=SIDE_PX, thickness_units="screen"
            )
        shape = shapes[chosen]
        texts = [] if shape is None else [(s.name, s.ends_W.mean(axis=0)) for s in shape.sides if s.name]
        texts += [(shape.corner[1], shape.corner[0])] if shape is not None and shape.corner else []
        for i, label in enumerate(self._value_labels):
            label.visible = i < len(texts)
            if label.visible:
                label.text, label.position = texts[i]

    def trails(self, segments: Array, owners: NDArray[np.int64]) -> None:
        if not len(segments):  # remove the old trails, as when a replay was rewound
            segments, owners = np.tile(HIDDEN, (1, 2, 1)), np.zeros(1, dtype=np.int64)
        colours = np.repeat(self._trail_colours[owners][:, None], 2, axis=1)
        if self._trail_node is None:
            self._trail_node = self._scene.add_line_segments(
                "/trails", segments, colours, thickness=2.0, thickness_units="screen", visible=self._trails_shown
            )
        else:
            self._trail_node.points, self._trail_node.colors = segments, colours

    def show(self, layer: str, visible: bool) -> None:
        self._trails_shown = visible if layer == "trails" else self._trails_shown
        node = {"ghosts": self._ghosts, "estimates": self._ellipsoids, "trails": self._trail_node}[layer]
        if node is not None:
            node.visible = visible


class _RotorNodes:
    """The rotors of all drones as one node, each rotor at its own size."""

    def __init__(self, drones: Sequence[DroneInfo], shapes: Sequence["DroneShape"], batch: Any) -> None:
        self._owners = np.repeat(np.arange(len(shapes)), [len(shape.hubs_B) for shape in shapes])
        self._rotor_indices = np.concatenate([np.arange(len(shape.hubs_B)) for shape in shapes])
        hubs = [(x, y, ROTOR_Z_M * shape.size) for shape in shapes for x, y in shape.hubs_B]
        rotors = [drone.rotors or cross_layout(ARM_M) for drone in drones]
        self._turns = np.array([float(rotor.turn) for layout in rotors for rotor in layout])
        self._hubs_B, self._angles = np.array(hubs), np.zeros(len(hubs))
        self._node = batch("/rotors", rotor_mesh(), len(hubs), COLOURS["rotor"])
        scales = [shape.radius_m / ROTOR_RADIUS_M for shape in shapes]
        self._node.batched_scales = np.tile(np.array(scales)[self._owners, None], (1, 3))

    def move(self, drones: DronePoses, dt_s: float) -> None:
        """Move the rotors with the drones, and turn them for `dt_s`."""
        speeds = drones.rotor[self._owners, self._rotor_indices]
        self._angles = rotor_angles(self._angles, speeds, self._turns, dt_s)
        p_W, q_WB = drones.p_W[self._owners], drones.q_WB[self._owners]
        self._node.batched_positions, self._node.batched_wxyzs = rotor_poses(p_W, q_WB, self._hubs_B, self._angles)


def _padded(count: int, p_W: Array | None = None, q: Array | None = None) -> tuple[Array, Array, Array]:
    """Return positions (count, 3), attitudes (count, 4) and scales (count, 3) of instances.

    The first positions and attitudes are `p_W` and `q`; further instances are level and, beyond `p_W`, hidden.
    """
    positions, attitudes = np.tile(np.array(HIDDEN), (count, 1)), np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
    if p_W is not None:
        positions[: len(p_W)] = p_W
    if q is not None:
        attitudes[: len(q)] = q
    return positions, attitudes, np.ones((count, 3))


class ChosenRing:
    """A ring around the chosen drone in the scene of one page; `radii_m` are the drones' radii, in the run's order."""

    def __init__(self, scene: viser.SceneApi, radii_m: Array) -> None:
        self._radii_m = radii_m
        self._chosen = -1
        mesh = ring_mesh()
        level, hidden = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array(HIDDEN).reshape(1, 3)
        self._node: Any = scene.add_batched_meshes_simple(
            "/chosen", mesh.vertices, mesh.faces, level, hidden, batched_scales=np.ones((1, 3)),
            batched_colors=CHOSEN, lod="off", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def move(self, drones: DronePoses, chosen: str) -> None:
        """Move the ring to the chosen drone; hide it while that drone is missing."""
        index = drones.names.index(chosen)
        self._node.batched_positions = drones.p_W[[index]] if drones.present[index] else np.reshape(HIDDEN, (1, 3))
        if index != self._chosen:
            self._chosen = index
            self._node.batched_scales = np.full((1, 3), self._radii_m[index])


def draw_ground(scene: viser.SceneApi, *, dark: bool = False) -> None:
    """Draw a field with a grid, replacing the previous ground.

    The field is opaque, and there is no sky: viser's grid plane, or a background image, would hide transparent objects.
    """
    field, cells, sections = DARK if dark else LIGHT
    position = (0.0, 0.0, -FIELD_BELOW_M - FIELD_THICKNESS_M / 2.0)
    scene.add_box(
        "/field", field, (2 * GROUND_HALF_M, 2 * GROUND_HALF_M, FIELD_THICKNESS_M), position=position, cast_shadow=False
    )
    scene.add_grid(
        "/ground", 2 * GROUND_HALF_M, 2 * GROUND_HALF_M, cell_size=1.0, section_size=5.0, cell_color=cells,
        section_color=sections, fade_distance=80.0, shadow_opacity=0.0,
    )  # fmt: skip


def luminance(colour: Sequence[float]) -> float:
    """Return the relative luminance (WCAG 2.2) of an sRGB colour with components from 0 to 255."""
    return float(np.dot((0.2126, 0.7152, 0.0722), linear(np.array(colour, float)) / 255.0))


def lightened(colour: Sequence[float]) -> Sequence[float]:
    """Return a colour mixed with white until it has enough contrast with the ground of the dark theme."""
    mixed = (np.array(colour) + fraction * (255.0 - np.array(colour)) for fraction in np.arange(0.0, 1.01, 0.05))
    return next(each.tolist() for each in mixed if luminance(each.tolist()) >= LUMINANCE_MIN)


def linear(colours: Array) -> NDArray[np.uint8]:
    """Convert sRGB colours, 0 to 255, to linear light, as viser expects for lines (IEC 61966-2-1, 5.3)."""
    share = colours / 255
    return np.round(255 * np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)).astype(np.uint8)


class Mesh(NamedTuple):
    """A surface: vertices (V, 3) [m; B], faces (F, 3)."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]


class DroneShape(NamedTuple):
    """The appearance of a drone: the positions (x, y) of its rotors' axes, and the rotors' radius [m]."""

    hubs_B: tuple[tuple[float, float], ...]
    radius_m: float

    @property
    def size(self) -> float:
        """Size relative to the AR.Drone, by the longest arm."""
        return max(math.hypot(x, y) for x, y in self.hubs_B) / ARM_M

    @property
    def reach_m(self) -> float:
        """Distance of the hull's outer edge from the centre [m]."""
        return self.size * ARM_M + RING_RADIUS_RATIO * self.radius_m


def shape_of(drone: DroneInfo, arm_m: float) -> DroneShape:
    """Return the appearance of a drone; if its rotors are not stated, it has four on arms of length `arm_m` [m]."""
    if not drone.rotors:
        hubs = tuple((rotor.x_m, rotor.y_m) for rotor in cross_layout(arm_m))
        return DroneShape(hubs, ROTOR_RADIUS_M * arm_m / ARM_M)
    return DroneShape(tuple((rotor.x_m, rotor.y_m) for rotor in drone.rotors), drone.rotors[0].radius_m)


@cache
def coloured_glb(shape: DroneShape) -> bytes:
    """Return a drone without its rotors as GLB, with one surface for each colour."""
    scene = trimesh.Scene()
    for name, solids in _solids(shape).items():
        solid = _joined(solids)
        solid.unmerge_vertices()  # otherwise shading would blur the edges
        material = PBRMaterial(baseColorFactor=(*COLOURS[name], 255), metallicFactor=0.0, roughnessFactor=0.75)
        solid.visual = TextureVisuals(material=material)
        scene.add_geometry(solid, geom_name=name)
    return bytes(scene.export(file_type="glb"))  # type: ignore[arg-type]


@cache
def drone_mesh(shape: DroneShape) -> Mesh:
    return _mesh([solid for solids in _solids(shape).values() for solid in solids])


def _solids(shape: DroneShape) -> dict[str, list[trimesh.Trimesh]]:
    """Return the solids of a drone by colour, built at the AR.Drone's size and then scaled."""
    hubs = [(x / shape.size, y / shape.size) for x, y in shape.hubs_B]
    radius = RING_RADIUS_RATIO * shape.radius_m / shape.size
    cross = []
    for x, y in hubs:
        beam = box((math.hypot(x, y), 0.014, 0.012))
        motor, foot = cylinder(0.017, 0.034, sections=12), cylinder(0.006, 0.058, sections=8)
        cross.append(_moved(beam, (x / 2, y / 2, 0.004), math.atan2(y, x)))
        cross += [_moved(motor, (x, y, ROTOR_Z_M / 2)), _moved(foot, (0.92 * x, 0.92 * y, -0.029))]
    to_forward = trimesh.transformations.rotation_matrix(math.pi / 2, (0, 1, 0))
    lens = cylinder(0.013, 0.03, sections=14)  # of the front camera
    lens.apply_transform(to_forward)
    rings = [annulus(radius - 0.016, radius, 0.042, sections=28) for _ in hubs]  # foam of the indoor hull
    body = capsule(height=0.19, radius=0.045, count=[14, 14])  # body with the battery, from nose to tail
    body.apply_transform(to_forward)
    body.apply_scale((1.0, 1.0, 0.72))
    nose = icosphere(subdivisions=2, radius=0.042)
    nose.apply_scale((1.25, 1.0, 0.78))
    solids = {
        "cross": [*cross, _moved(lens, (0.162, 0, 0.012))],
        "hull": [
            *(_moved(ring, (*hub, 0.022)) for ring, hub in zip(rings, hubs, strict=True)),
            _moved(body, (-body.centroid[0], 0, 0.012)),
        ],
        "nose": [_moved(nose, (0.115, 0, 0.012))],
    }
    for solid in (solid for part_solids in solids.values() for solid in part_solids):
        solid.apply_scale(shape.size)
    hats = Hats()  # not scaled: drones detect each other by their hats, and cameras assume this size
    return {**solids, "hat": [_moved(icosphere(subdivisions=3, radius=hats.diameter_m / 2), hats.position_m)]}


@cache
def rotor_mesh() -> Mesh:
    blades = [_moved(box((ROTOR_RADIUS_M, 0.016, 0.002)), (side * ROTOR_RADIUS_M / 2, 0, 0)) for side in (-1, 1)]
    for side, blade in zip((-1, 1), blades, strict=True):
        blade.apply_transform(trimesh.transformations.rotation_matrix(side * 0.2, (1, 0, 0)))
    return _mesh([*blades, cylinder(0.012, 0.012, sections=10)])


@cache
def ring_mesh() -> Mesh:
    return _mesh([annulus(0.93, 1.0, 0.03, sections=40)])


@cache
def ball_mesh() -> Mesh:
    return _mesh([icosphere(subdivisions=2)])


def _mesh(solids: list[trimesh.Trimesh]) -> Mesh:
    joined = _joined(solids)
    return Mesh(np.asarray(joined.vertices, np.float32), np.asarray(joined.faces, np.uint32))


def _joined(solids: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(solids)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def _moved(solid: trimesh.Trimesh, by_m: tuple[float, float, float], yaw: float = 0.0) -> trimesh.Trimesh:
    solid.apply_transform(trimesh.transformations.rotation_matrix(yaw, (0, 0, 1)))
    solid.apply_translation(by_m)
    return solid
