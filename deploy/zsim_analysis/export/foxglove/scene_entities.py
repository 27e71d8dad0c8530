"""What is drawn: drones, their trails, the formation and where it is to be, and how sure the estimators are.

Foxglove shows, wherever one seeks to, the last message of a topic alone; so each message is the whole of what it shows.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from foxglove.messages import (
    Color,
    CubePrimitive,
    CylinderPrimitive,
    LinePrimitive,
    LinePrimitiveLineType,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
)

from zsim.math.frames import principal_axes
from zsim_analysis.export.columns import Values
from zsim_analysis.export.foxglove.instants import Instant
from zsim_analysis.export.foxglove.shapes import (
    DARK,
    GREY,
    MAGENTA,
    colour,
    drone_colour,
    point,
    pose,
    timestamp,
    vector,
)

WORLD = "world"
TRAIL_S = 20.0  # s of simulated time that a trail is long
TRAIL_STEP_NS = 500_000_000  # between two points of a trail, and two messages of trails
SIGMAS = 2.0  # half axes of an estimate's ellipsoid in standard deviations
LINE_PX = 2.0  # width of lines on the screen
ROTOR_RADIUS = 0.57  # of the arm: 0.102 m at the AR.Drone's 0.1785 m
GROUND_M, GROUND_STEP_M = 50, 5  # half width of the grid on the ground, and its spacing


def frame(drone: str) -> str:
    """Return the name of a drone's frame B."""
    return f"drone/{drone}"


def drones(t_ns: int, arms_m: Mapping[str, float]) -> SceneUpdate:
    """Return the drones, each in its own frame, given the distance from centre to rotor [m]: said once, they move."""
    made = [_drone(timestamp(t_ns), name, arm_m, drone_colour(i)) for i, (name, arm_m) in enumerate(arms_m.items())]
    return SceneUpdate(entities=made)


def _drone(at: Timestamp, name: str, arm_m: float, mark: str) -> SceneEntity:
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
        cylinders=_rotors(arm_m, mark),
        lines=[_arms(arm_m)],
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


def _rotors(arm_m: float, mark: str) -> list[CylinderPrimitive]:
    return [
        CylinderPrimitive(
            pose=pose((x, y, 0.2 * arm_m)),
            size=vector((2 * ROTOR_RADIUS * arm_m, 2 * ROTOR_RADIUS * arm_m, 0.03 * arm_m)),
            bottom_scale=1.0,
            top_scale=1.0,
            color=colour(mark, 0.5),
        )
        for x, y in _corners(arm_m)
    ]


def _arms(arm_m: float) -> LinePrimitive:
    front_left, front_right, rear_right, rear_left = _corners(arm_m)
    return LinePrimitive(
        type=LinePrimitiveLineType.LineList,
        pose=pose((0, 0, 0)),
        thickness=0.1 * arm_m,
        points=[point((x, y, 0)) for x, y in (front_left, rear_right, front_right, rear_left)],
        color=colour(DARK),
    )


def _corners(arm_m: float) -> list[tuple[float, float]]:
    """Return x and y in B of the rotors, in the contract's order."""
    side = arm_m / math.sqrt(2.0)
    return [(x * side, y * side) for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]


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


def estimates(instant: Instant, order: Mapping[str, int]) -> SceneUpdate:
    """Return the ellipsoids within which the estimators believe their drones to be, at two standard deviations."""
    at, entities = timestamp(instant.t_ns), []
    for name, estimate in instant.estimates.items():
        covariance = np.array(estimate.covariance).reshape(6, 6)[:3, :3]
        sigma_m, axes = principal_axes(covariance)
        shown = SpherePrimitive(
            pose=pose(estimate.position_m, axes),
            size=vector([2.0 * SIGMAS * each for each in sigma_m]),
            color=colour(drone_colour(order.get(name, 0)), 0.25),
        )
        entities.append(_entity(at, name, WORLD, spheres=[shown]))
    return SceneUpdate(entities=entities)


class Trails:
    """The last seconds of each drone's way."""

    def __init__(self) -> None:
        self._ways: dict[str, deque[Sequence[float]]] = {}
        self._length = round(TRAIL_S * 1e9) // TRAIL_STEP_NS + 1

    def update(self, instant: Instant, order: Mapping[str, int]) -> SceneUpdate:
        """Take where the drones are, return their trails."""
        at, entities = timestamp(instant.t_ns), []
        for name, truth in instant.truth.items():
            way = self._ways.setdefault(name, deque(maxlen=self._length))
            way.append(truth.position_m)
            trail = _line(way, colour(drone_colour(order.get(name, 0)), 0.7), LinePrimitiveLineType.LineStrip)
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
