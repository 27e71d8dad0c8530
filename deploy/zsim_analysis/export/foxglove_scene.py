"""The scene of an instant: drones, their trails, the formation and where it is to be, and the estimates' uncertainty.

Foxglove shows, at any time, the last message of a topic alone; so each message is the whole of what it shows.
"""

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from foxglove.messages import (
    Color,
    CubePrimitive,
    CylinderPrimitive,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, CameraInfo, ClusterState, Estimate, Status, Truth
from zsim.contract.messages import Gps, Info
from zsim.contract.run_messages import Event
from zsim.math.frames import principal_axes
from zsim.presentation import colours_of
from zsim.record import Recorded
from zsim_analysis.export.message_columns import Values
from zsim_analysis.export.selection import subject

LEVEL = Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
MAGENTA, DARK, GREY = "#d4008f", "#30363d", "#8c959f"
DRAWN = (Truth, Estimate, Status, Gps, ClusterState, Event, CameraImage, CameraInfo)
WORLD = "world"
TRAIL_S = 20.0  # s of simulated time that a trail is long
TRAIL_STEP_NS = 500_000_000  # between two points of a trail, and two messages of trails
SIGMAS = 2.0  # half axes of an estimate's ellipsoid in standard deviations
LINE_PX = 2.0  # width of lines on the screen
GROUND_M, GROUND_STEP_M = 50, 5  # half width of the grid on the ground, and its spacing


class RotorDisc(NamedTuple):
    """A rotor as it is drawn: its place in B, and its radius."""

    x_m: float
    y_m: float
    radius_m: float


@dataclass
class Instant:
    """Messages stamped with one time; of several on a key the last, but all events, and all of cameras."""

    t_ns: int
    truth: dict[str, Truth] = field(default_factory=dict)
    estimates: dict[str, Estimate] = field(default_factory=dict)
    status: dict[str, Status] = field(default_factory=dict)
    gps: dict[str, Gps] = field(default_factory=dict)
    states: dict[str, ClusterState] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    pictures: list[tuple[str, CameraImage]] = field(default_factory=list)
    cameras: list[tuple[str, CameraInfo]] = field(default_factory=list)

    def add(self, key: str, message: Any) -> None:
        """Add a message of a type that is drawn."""
        match message:
            case Event():
                self.events.append(message)
            case CameraImage():
                self.pictures.append((key, message))
            case CameraInfo():
                self.cameras.append((key, message))
            case _:
                self._newest(type(message))[subject(key)] = message

    def _newest(self, kind: type) -> dict[str, Any]:
        newest: dict[type, dict[str, Any]] = {Truth: self.truth, Estimate: self.estimates, Status: self.status}
        newest |= {Gps: self.gps, ClusterState: self.states}
        return newest[kind]


def is_drawn(key: str) -> bool:
    """Return whether the messages of a key are drawn."""
    return messages.type_of(key) in DRAWN or key == keys.INFO


def instants(decoded: Iterable[tuple[Recorded, Any]]) -> Iterator[Instant]:
    """Gather messages, in order of time, by their time; `world/info` is left out."""
    drawn = ((recorded.key, message) for recorded, message in decoded if not isinstance(message, Info))
    for t_ns, group in groupby(drawn, key=lambda pair: pair[1].t_ns):
        instant = Instant(t_ns)
        for key, message in group:
            instant.add(key, message)
        yield instant


def timestamp(t_ns: int) -> Timestamp:
    return Timestamp(t_ns // 10**9, t_ns % 10**9)


def vector(v: Sequence[float] | Values) -> Vector3:
    x, y, z = map(float, v)
    return Vector3(x=x, y=y, z=z)


def point(v: Sequence[float] | Values) -> Point3:
    x, y, z = map(float, v)
    return Point3(x=x, y=y, z=z)


def quaternion(wxyz: Sequence[float] | Values) -> Quaternion:
    w, x, y, z = map(float, wxyz)
    return Quaternion(x=x, y=y, z=z, w=w)


def pose(position: Sequence[float] | Values, wxyz: Sequence[float] | Values | None = None) -> Pose:
    return Pose(position=vector(position), orientation=LEVEL if wxyz is None else quaternion(wxyz))


def rgb(text: str) -> tuple[float, float, float]:
    """Return red, green and blue, 0 to 1, of `#rrggbb`."""
    red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


def colour(text: str, opacity: float = 1.0) -> Color:
    """Return the colour of `#rrggbb`."""
    red, green, blue = rgb(text)
    return Color(r=red, g=green, b=blue, a=opacity)


def frame(drone: str) -> str:
    """Return the name of a drone's frame B."""
    return f"drone/{drone}"


def camera_frame(drone: str, camera: str) -> str:
    """Return the name of a camera's frame: x to the right of the picture, y down, z ahead."""
    return f"{frame(drone)}/{camera}_camera"


def drones(t_ns: int, rotors: Mapping[str, Sequence[RotorDisc]]) -> SceneUpdate:
    """Return the drones, each in its own frame, written once, as their frames move; `rotors` are theirs, by name."""
    at = timestamp(t_ns)
    return SceneUpdate(entities=[_drone(at, name, rotors[name], tint) for name, tint in colours_of(rotors).items()])


def _drone(at: Timestamp, name: str, discs: Sequence[RotorDisc], mark: str) -> SceneEntity:
    arm_m = max(math.hypot(disc.x_m, disc.y_m) for disc in discs)
    label = TextPrimitive(
        pose=pose((0, 0, 2 * arm_m)),
        billboard=True,
        font_size=12.0,
        scale_invariant=True,
        color=colour(mark),
        text=name,
    )
    return _entity(
        at,
        name,
        frame(name),
        cubes=_hull(arm_m),
        cylinders=[_rotor(disc, arm_m, mark) for disc in discs],
        lines=[_arms(discs, arm_m)],
        texts=[label],
        frame_locked=True,
    )


def _hull(arm_m: float) -> list[CubePrimitive]:
    hull = CubePrimitive(pose=pose((0, 0, 0)), size=vector((arm_m, 0.4 * arm_m, 0.3 * arm_m)), color=colour(DARK))
    nose = CubePrimitive(  # the hat over the battery and the camera, in the colour by which AR.Drones are known
        pose=pose((0.35 * arm_m, 0, 0.1 * arm_m)),
        size=vector((0.5 * arm_m, 0.3 * arm_m, 0.2 * arm_m)),
        color=colour(MAGENTA),
    )
    return [hull, nose]


def _rotor(disc: RotorDisc, arm_m: float, mark: str) -> CylinderPrimitive:
    return CylinderPrimitive(
        pose=pose((disc.x_m, disc.y_m, 0.2 * arm_m)),
        size=vector((2 * disc.radius_m, 2 * disc.radius_m, 0.03 * arm_m)),
        bottom_scale=1.0,
        top_scale=1.0,
        color=colour(mark, 0.5),
    )


def _arms(discs: Sequence[RotorDisc], arm_m: float) -> LinePrimitive:
    ends = [((0.0, 0.0, 0.0), (disc.x_m, disc.y_m, 0.0)) for disc in discs]
    return LinePrimitive(
        type=LinePrimitiveLineType.LineList,
        pose=pose((0, 0, 0)),
        thickness=0.1 * arm_m,
        points=[point(end) for pair in ends for end in pair],
        color=colour(DARK),
    )


def ground(t_ns: int) -> SceneUpdate:
    """Return a grid on the ground, lines every 5 m."""
    marks = range(-GROUND_M, GROUND_M + 1, GROUND_STEP_M)
    ends = [((a, -GROUND_M, 0), (a, GROUND_M, 0)) for a in marks] + [
        ((-GROUND_M, a, 0), (GROUND_M, a, 0)) for a in marks
    ]
    grid = _line([end for pair in ends for end in pair], colour(GREY, 0.4), LinePrimitiveLineType.LineList, 1.0)
    return SceneUpdate(entities=[_entity(timestamp(t_ns), "ground", WORLD, lines=[grid])])


def formations(instant: Instant, desired_m: Mapping[str, Values]) -> SceneUpdate:
    """Return for each cluster the outline of its drones, and as ghosts where they are to be.

    Args:
        instant: with truth and the states of the clusters.
        desired_m: by cluster, where its drones are to be (n, 3).
    """
    at, entities = timestamp(instant.t_ns), []
    for name, state in instant.states.items():
        lines, ghosts = [], []
        places = [instant.truth[drone].position_m for drone in state.drones if drone in instant.truth]
        if len(places) > 1:
            lines.append(_line(places, colour(DARK), LinePrimitiveLineType.LineLoop))
        if name in desired_m:
            lines.append(_line(desired_m[name], colour(MAGENTA, 0.6), LinePrimitiveLineType.LineLoop))
            ghosts = [
                SpherePrimitive(pose=pose(place), size=vector((0.5, 0.5, 0.2)), color=colour(MAGENTA, 0.3))
                for place in desired_m[name]
            ]
        entities.append(_entity(at, name, WORLD, lines=lines, spheres=ghosts))
    return SceneUpdate(entities=entities)


def estimates(instant: Instant, colours: Mapping[str, str]) -> SceneUpdate:
    """Return the ellipsoids within which the estimators believe their drones to be, at two standard deviations."""
    at, entities = timestamp(instant.t_ns), []
    for name, estimate in instant.estimates.items():
        covariance = np.array(estimate.covariance).reshape(6, 6)[:3, :3]
        sigma_m, axes = principal_axes(covariance)
        shown = SpherePrimitive(
            pose=pose(estimate.position_m, axes),
            size=vector([2.0 * SIGMAS * each for each in sigma_m]),
            color=colour(colours.get(name, GREY), 0.25),
        )
        entities.append(_entity(at, name, WORLD, spheres=[shown]))
    return SceneUpdate(entities=entities)


class DroneTrails:
    """The last seconds of each drone's path."""

    def __init__(self) -> None:
        self._paths: dict[str, deque[Sequence[float]]] = {}
        self._length = round(TRAIL_S * 1e9) // TRAIL_STEP_NS + 1

    def update(self, instant: Instant, colours: Mapping[str, str]) -> SceneUpdate:
        """Add the positions of an instant, return the trails."""
        at, entities = timestamp(instant.t_ns), []
        for name, truth in instant.truth.items():
            path = self._paths.setdefault(name, deque(maxlen=self._length))
            path.append(truth.position_m)
            trail = _line(path, colour(colours.get(name, GREY), 0.7), LinePrimitiveLineType.LineStrip)
            entities.append(_entity(at, name, WORLD, lines=[trail]))
        return SceneUpdate(entities=entities)


def _line(points: Iterable[Any], tint: Color, kind: LinePrimitiveLineType, width_px: float = LINE_PX) -> LinePrimitive:
    return LinePrimitive(
        type=kind,
        pose=pose((0, 0, 0)),
        thickness=width_px,
        scale_invariant=True,
        points=[point(each) for each in points],
        color=tint,
    )


def _entity(at: Timestamp, name: str, frame_id: str, **parts: Any) -> SceneEntity:
    return SceneEntity(timestamp=at, id=name, frame_id=frame_id, **parts)
