"""Intersection of rays with ground, obstacles, triangles and drone hulls: exact, compiled, the same bits everywhere.

Every solid is convex, an intersection of slabs, a quadric or both, so a ray is inside from the last entry to the first
exit (Kay and Kajiya, SIGGRAPH 1986). Triangles are hit from both sides (Moeller and Trumbore, J. Graphics Tools 2
(1997)). Obstacles and triangles are the leaves of one bounding volume hierarchy, traversed from near to far. Drones
move and are few: the caller tests each ray against those within reach.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import inlined, noinline
from zsim.math.rotation import Quaternion, Vector, dot, rotate_back, subtract
from zsim.scenario.surroundings import (
    BOX,
    CENTRE,
    COLUMNS,
    COSINE,
    CYLINDER,
    HALF,
    SHAPE,
    SINE,
    SPHERE,
    TRIANGLE,
    Tree,
    corners_of,
    tree_over,
)

HUGE = 1e300  # replaces 1 / 0, so that no product is 0 times infinity
HULL_FLATNESS = 0.25  # height over width of a hull, rounded from the AR.Drone's: 0.13 m / 0.52 m

Array = NDArray[np.float64]


class Scene(NamedTuple):
    """The static scene: M obstacles, T triangles, and the tree over both."""

    solid: NDArray  # (M, COLUMNS), rows of zsim.scenario.surroundings
    triangle: NDArray  # (T, TRIANGLE), m, in W
    tree: Tree  # its parts: obstacle m is part m, triangle t is part M + t


def scene(solid: Array, triangle: Array) -> Scene:
    """Return the scene of obstacles, (M, COLUMNS), and triangles, (T, TRIANGLE)."""
    solid, triangle = solid.reshape(-1, COLUMNS), triangle.reshape(-1, TRIANGLE)
    corners = corners_of(triangle)
    boxes = [_bounds_of(row) for row in solid.tolist()]
    low = np.concatenate([np.array([low for low, _ in boxes]).reshape(-1, 3), corners.min(axis=1)])
    high = np.concatenate([np.array([high for _, high in boxes]).reshape(-1, 3), corners.max(axis=1)])
    return Scene(solid, triangle, tree_over(low, high))


def _bounds_of(row: Sequence[float]) -> tuple[list[float], list[float]]:
    """Return the minimum and maximum corners of an obstacle's bounding box."""
    half, c, s = row[HALF : HALF + 3], abs(row[COSINE]), abs(row[SINE])
    if row[SHAPE] == BOX:
        half = [c * half[0] + s * half[1], s * half[0] + c * half[1], half[2]]
    else:
        half = [half[0], half[0], half[0] if row[SHAPE] == SPHERE else half[2]]
    centre = row[CENTRE : CENTRE + 3]
    return [x - h for x, h in zip(centre, half, strict=True)], [x + h for x, h in zip(centre, half, strict=True)]


@inlined
def inverse(x: float) -> float:
    return 1.0 / x if x != 0.0 else HUGE


@inlined
def _slab(o: float, inverse_d: float, half: float) -> tuple[float, float]:
    """Return when a ray enters and leaves |x| <= half; `inverse_d`: 1 / its speed along x."""
    a, b = (-half - o) * inverse_d, (half - o) * inverse_d
    return (a, b) if a < b else (b, a)


@inlined
def _quadric(a: float, b: float, c: float) -> tuple[float, float]:
    """Return when a ray enters and leaves a t^2 + 2 b t + c <= 0; (1, 0) if never."""
    if a == 0.0:
        return (-HUGE, HUGE) if c <= 0.0 else (1.0, 0.0)
    under = b * b - a * c
    if under < 0.0:
        return 1.0, 0.0
    root = math.sqrt(under)
    q = -b - root if b > 0.0 else root - b  # both roots without cancellation
    if q == 0.0:
        return 0.0, 0.0
    first, second = c / q, q / a
    return (first, second) if first < second else (second, first)


@inlined
def _entry_distance(first: float, last: float, far: float) -> float:
    """Return where a ray that is in a solid from `first` to `last` enters it: 0 from inside, `far` if not before."""
    if first > last or last < 0.0:
        return far
    return min(max(first, 0.0), far)


@inlined
def cast_solid(row: NDArray, o: Vector, d: Vector, far: float) -> float:
    """Return the distance at which a ray from o along the unit vector d meets an obstacle; `far` if not before."""
    ox, oy, oz = o[0] - row[CENTRE], o[1] - row[CENTRE + 1], o[2] - row[CENTRE + 2]
    radius = row[HALF]
    if row[SHAPE] == SPHERE:
        along, square = ox * d[0] + oy * d[1] + oz * d[2], ox * ox + oy * oy + oz * oz
        first, last = _quadric(1.0, along, square - radius * radius)
        return _entry_distance(first, last, far)
    first, last = _slab(oz, inverse(d[2]), row[HALF + 2])
    if row[SHAPE] == CYLINDER:
        along, square = ox * d[0] + oy * d[1], ox * ox + oy * oy
        enter, leave = _quadric(d[0] * d[0] + d[1] * d[1], along, square - radius * radius)
        return _entry_distance(max(first, enter), min(last, leave), far)
    c, s = row[COSINE], row[SINE]
    enter, leave = _slab(c * ox + s * oy, inverse(c * d[0] + s * d[1]), radius)
    first, last = max(first, enter), min(last, leave)
    enter, leave = _slab(c * oy - s * ox, inverse(c * d[1] - s * d[0]), row[HALF + 1])
    return _entry_distance(max(first, enter), min(last, leave), far)


@inlined
def cast_triangle(row: NDArray, o: Vector, d: Vector, far: float) -> float:
    """Return the distance at which a ray meets a triangle; `far` if not before."""
    ax, ay, az, bx, by, bz = row[3], row[4], row[5], row[6], row[7], row[8]
    px, py, pz = d[1] * bz - d[2] * by, d[2] * bx - d[0] * bz, d[0] * by - d[1] * bx
    det = ax * px + ay * py + az * pz
    if det == 0.0:
        return far
    tx, ty, tz = o[0] - row[0], o[1] - row[1], o[2] - row[2]
    u = (tx * px + ty * py + tz * pz) / det
    if u < 0.0 or u > 1.0:
        return far
    qx, qy, qz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
    v = (d[0] * qx + d[1] * qy + d[2] * qz) / det
    if v < 0.0 or u + v > 1.0:
        return far
    t = (bx * qx + by * qy + bz * qz) / det
    return t if 0.0 <= t < far else far


@inlined
def cast_ground(o: Vector, d: Vector, far: float) -> float:
    """Return the distance at which a ray meets z = 0 from above; `far` if not before."""
    if d[2] >= 0.0 or o[2] < 0.0:
        return far
    return min(-o[2] / d[2], far)


@inlined
def cast_hull(p_WB: Vector, q_WB: Quaternion, radius: float, o: Vector, d: Vector, far: float) -> float:
    """Return the distance at which a ray meets a drone's hull, a spheroid flattened along its z axis, or `far`."""
    away = subtract(o, p_WB)
    along, square = dot(away, d), dot(away, away) - radius * radius
    if square > 0.0 and (along > 0.0 or along * along < square):
        return far  # it misses the sphere around the hull
    at, to = rotate_back(q_WB, away), rotate_back(q_WB, d)
    up = 1.0 / HULL_FLATNESS
    at, to = (at[0], at[1], up * at[2]), (to[0], to[1], up * to[2])
    first, last = _quadric(dot(to, to), dot(at, to), dot(at, at) - radius * radius)
    return _entry_distance(first, last, far)


@inlined
def _box(bounds: NDArray, o: Vector, inverse_d: Vector, far: float) -> float:
    """Return the distance at which a ray enters a box; `far` if not before."""
    first, last = 0.0, far
    for k in range(3):
        a, b = (bounds[k] - o[k]) * inverse_d[k], (bounds[k + 3] - o[k]) * inverse_d[k]
        if a > b:
            a, b = b, a
        first = a if a > first else first
        last = b if b < last else last
    return first if first <= last else far


@noinline
def cast_parts(scene: Scene, o: Vector, d: Vector, far: float) -> float:
    """Return the distance [m] at which a ray meets an obstacle or a triangle; arguments as for `cast`."""
    best, count, tree = far, scene.solid.shape[0], scene.tree
    waiting, entered = tree.waiting, tree.away  # boxes to visit, and the distances at which the ray enters them [m]
    if tree.bounds.shape[0] == 0:
        return best
    inverse_d = (inverse(d[0]), inverse(d[1]), inverse(d[2]))
    node, at, depth = 0, _box(tree.bounds[0], o, inverse_d, best), 0
    while True:
        while at < best:
            first, parts = tree.link[node, 0], tree.link[node, 1]
            if parts > 0:
                for n in range(first, first + parts):
                    m = tree.part[n]
                    if m < count:
                        best = cast_solid(scene.solid[m], o, d, best)
                    else:
                        best = cast_triangle(scene.triangle[m - count], o, d, best)
                break
            near, other = node + 1, first
            at, away = _box(tree.bounds[near], o, inverse_d, best), _box(tree.bounds[other], o, inverse_d, best)
            if away < at:
                near, other, at, away = other, near, away, at
            if away < best:
                waiting[depth], entered[depth] = other, away
                depth += 1
            node = near
        if depth == 0:
            return best
        depth -= 1
        node, at = waiting[depth], entered[depth]


@inlined
def cast(scene: Scene, o: Vector, d: Vector, far: float) -> float:
    """Return the distance [m] at which a ray meets the ground, an obstacle or a triangle; `far` if not before.

    Args:
        o, d: origin [m] and unit direction of the ray, in W.
    """
    return cast_parts(scene, o, d, cast_ground(o, d, far))
