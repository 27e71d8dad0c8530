"""Obstacles and surfaces around the drones: distances, directions, nearest points and crossings.

An obstacle is a solid, given by a row of numbers: shape, centre in W, cosine and sine of yaw, and half of its size
along its own axes (for a cylinder: radius, unused, half of the height; for a sphere: radius). Distances are negative
inside it.

A surface is a mesh of triangles without thickness; distances from it are unsigned. Its rim consists of the edges that
belong to only one triangle. All results are exact up to rounding, computed by plain operations in a fixed order, and
compiled if numba is installed.
"""

import base64
import binascii
import math
import zlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zsim.math import elementary as el
from zsim.math.compiled import inlined, kernel, noinline
from zsim.math.held import Held, hold
from zsim.math.rotation import Vector, add, axpy, cross, dot, scaled, subtract

# columns of an obstacle's row: shape, centre in W, cosine and sine of yaw, half of the size; see `row_of`
BOX, CYLINDER, SPHERE = range(3)
SHAPES = ("box", "cylinder", "sphere")
SHAPE, CENTRE, COSINE, SINE, HALF = 0, 1, 4, 5, 6
COLUMNS = 9
TINY = 1e-12  # m, minimum divisor, for points on an axis
PAIRS_MAX = 1_000_000  # pairs of points and obstacles compared at once
WIDE = 1e9  # m, half of a cylinder's unused side, which must never limit it

TRIANGLES_MAX = 40_000  # of all surfaces; keeps a resolved scenario below the file size limit of 4 MB
SINGLE = np.dtype("<f4")  # number format of packed triangles
TRIANGLE = 9  # numbers of a triangle: a corner and the two edges from it [m; W]
LEAF = 4  # maximum number of parts in a leaf; design choice: testing a box takes about as long as a triangle
DEPTH = 64  # maximum number of pending boxes while the tree is walked; each level halves the parts
MARGIN_M = 1e-6  # m, margin of boxes around their contents, against rounding
AREA_MIN_M2 = 1e-12  # m^2, minimum of twice a triangle's area; a smaller one has no defined normal and is left out
WELD_M = 1e-6  # m, grid on which corners are merged; design choice: about the single precision of a resolved scenario
EDGE = 1e-9  # relative widening of a triangle for crossings, so that no path slips between neighbours
FIRST_EDGE, FIRST_CORNER, FACE = 0, 3, 6  # features of a triangle: edges ab, bc, ca; corners a, b, c; interior

Array = NDArray[np.float64]


class Tree(NamedTuple):
    """A tree of K bounding boxes over P parts; the first box is the root."""

    bounds: NDArray  # (K, 6), minimum and maximum x, y, z [m]
    link: NDArray  # int32 (K, 2): second child (the first follows its parent) and 0; for a leaf, first part and count
    part: NDArray  # int32 (P,), indices of the parts in the order of the leaves
    waiting: NDArray  # int32 (DEPTH,), boxes pending during a walk
    away: NDArray  # (DEPTH,), their squared distances [m^2]


class Sheet(NamedTuple):
    """The triangles of all surfaces."""

    triangle: NDArray  # (T, TRIANGLE)
    rim: NDArray  # int8 (T, 6), 1 where an edge or corner is on the rim
    surface: NDArray  # int32 (T,), index of the surface
    tree: Tree


class Surroundings:
    """The obstacles and surfaces of a scenario's environment.

    Attributes:
        is_empty: whether there are neither obstacles nor surfaces.
    """

    def __init__(self, environment: Any) -> None:
        self._obstacles, sheet = environment.obstacles, sheet_of(environment)
        self._sheet = hold(sheet) if len(sheet.triangle) else None
        self.is_empty = not self._obstacles and self._sheet is None

    def distances_m(self, p_W: ArrayLike) -> Array:
        """Return the distances [m] of points (P, 3) from the nearest obstacle (negative inside) or surface, or inf."""
        distances = min_distances(self._obstacles, p_W)
        if self._sheet is not None:
            distances = np.minimum(distances, nearest_points(self._sheet, p_W, np.maximum(distances, 0.0))[0])
        return distances


def row_of(obstacle: Any) -> list[float]:
    """Return the row of a scenario's obstacle, whose position is that of its base, or of its centre for a sphere."""
    x, y, z = obstacle.position_m
    if obstacle.shape == "box":
        half = [0.5 * side for side in obstacle.size_m]
    elif obstacle.shape == "cylinder":
        half = [obstacle.radius_m, 0.0, 0.5 * obstacle.height_m]
    else:
        half = [obstacle.radius_m, 0.0, 0.0]
    yaw = math.radians(obstacle.yaw_deg)
    return [float(SHAPES.index(obstacle.shape)), x, y, z + half[2], el.cos(yaw), el.sin(yaw), *half]


def nearest(row: Sequence[float], x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return the distance of a point from an obstacle [m], negative inside, and the outward unit vector in W."""
    dx, dy, qz = x - row[CENTRE], y - row[CENTRE + 1], z - row[CENTRE + 2]
    c, s = row[COSINE], row[SINE]
    qx, qy = c * dx + s * dy, c * dy - s * dx
    r = max(math.sqrt(qx * qx + qy * qy), TINY)
    if row[SHAPE] == SPHERE:
        away = max(math.sqrt(qx * qx + qy * qy + qz * qz), TINY)
        distance, nx, ny, nz = away - row[HALF], qx / away, qy / away, qz / away
    else:
        round_ = row[SHAPE] == CYLINDER
        ax, ay = (r, 0.0) if round_ else (qx, qy)
        ox, oy, oz = abs(ax) - row[HALF], abs(ay) - (WIDE if round_ else row[HALF + 1]), abs(qz) - row[HALF + 2]
        largest = max(ox, oy, oz)
        if largest > 0.0:
            ox, oy, oz = max(ox, 0.0), max(oy, 0.0), max(oz, 0.0)
            distance = math.sqrt(ox * ox + oy * oy + oz * oz)
        else:  # inside: towards the nearest face
            distance = largest
            ox, oy, oz = 1.0 if ox == largest else 0.0, 1.0 if oy == largest else 0.0, 1.0 if oz == largest else 0.0
        length = max(math.sqrt(ox * ox + oy * oy + oz * oz), TINY)
        nx, ny, nz = math.copysign(ox, ax) / length, math.copysign(oy, ay) / length, math.copysign(oz, qz) / length
        if round_:
            nx, ny = nx * qx / r, nx * qy / r
    return distance, c * nx - s * ny, s * nx + c * ny, nz


def min_distances(obstacles: Iterable[Any], p_W: ArrayLike) -> NDArray[np.float64]:
    """Return the distance [m] of each point (P, 3) from the nearest obstacle, as `nearest` does; inf without any."""
    points, rows = np.asarray(p_W, dtype=float).reshape(-1, 3), np.array([*map(row_of, obstacles)]).reshape(-1, COLUMNS)
    minima, step = np.full(len(points), np.inf), max(1, PAIRS_MAX // max(len(rows), 1))
    for first in range(0, len(points) if len(rows) else 0, step):
        x, y, z = (points[first : first + step, None, k] - rows[:, CENTRE + k] for k in range(3))
        c, s, shape, half = rows[:, COSINE], rows[:, SINE], rows[:, SHAPE], rows[:, HALF:]
        r = np.sqrt(x * x + y * y)
        across = np.where(shape == BOX, np.abs(c * x + s * y), r) - half[:, 0]
        along = np.where(shape == BOX, np.abs(c * y - s * x) - half[:, 1], -np.inf)
        above = np.abs(z) - half[:, 2]
        largest = np.maximum(np.maximum(across, along), above)
        outside = np.sqrt(np.maximum(across, 0.0) ** 2 + np.maximum(along, 0.0) ** 2 + np.maximum(above, 0.0) ** 2)
        solid = np.where(largest > 0.0, outside, largest)
        minima[first : first + step] = np.where(shape == SPHERE, np.sqrt(r * r + z * z) - half[:, 0], solid).min(axis=1)
    return minima


def sheet_of(environment: Any) -> Sheet:
    """Return the triangles of all surfaces of a scenario's environment, with their tree."""
    each = [placed(surface) for surface in environment.surfaces or ()]
    triangle = np.concatenate([np.empty((0, TRIANGLE)), *each])
    surface_index = np.repeat(np.arange(len(each), dtype=np.int32), [len(part) for part in each])
    normal = np.stack([triangle[:, 4] * triangle[:, 8] - triangle[:, 5] * triangle[:, 7],
                       triangle[:, 5] * triangle[:, 6] - triangle[:, 3] * triangle[:, 8],
                       triangle[:, 3] * triangle[:, 7] - triangle[:, 4] * triangle[:, 6]], axis=1)  # fmt: skip
    sound = np.sqrt((normal * normal).sum(axis=1)) > AREA_MIN_M2
    triangle, surface_index = triangle[sound], surface_index[sound]
    corners = corners_of(triangle)
    tree = tree_over(corners.min(axis=1), corners.max(axis=1))
    return Sheet(triangle, _rim(corners), surface_index, tree)


def placed(surface: Any) -> Array:
    """Return the triangles of a scenario's surface in W, (T, 9): a corner and the two edges from it [m]."""
    s, c = el.sin_cos(math.radians(surface.yaw_deg))
    x, y, z = np.moveaxis(surface.scale * unpacked(surface.triangles).reshape(-1, 3, 3), 2, 0)
    corners = np.stack([c * x - s * y, s * x + c * y, z], axis=2) + np.array(surface.position_m)
    first = corners[:, 0]
    return np.concatenate([first, corners[:, 1] - first, corners[:, 2] - first], axis=1)


def packed(triangles: Array) -> str:
    """Return triangles as text: float32, zlib, base64."""
    return base64.b64encode(zlib.compress(triangles.astype(SINGLE).tobytes(), 9)).decode()


def unpacked(text: str) -> Array:
    """Return the triangles (T, 9) in a text from `packed`.

    Raises:
        ValueError: the text is invalid.
    """
    each = TRIANGLE * SINGLE.itemsize
    reader = zlib.decompressobj()
    try:
        data = reader.decompress(base64.b64decode(text, validate=True), TRIANGLES_MAX * each + 1)
    except (binascii.Error, zlib.error) as error:
        raise ValueError(f"contains no triangles ({error})") from error
    if len(data) > TRIANGLES_MAX * each:  # a short text may expand to any size
        raise ValueError(f"has more than {TRIANGLES_MAX} triangles; must have at most {TRIANGLES_MAX}")
    if not reader.eof:
        raise ValueError("contains no triangles (truncated)")
    if not data or len(data) % each:
        raise ValueError(f"has {len(data)} bytes; must have {each} for each triangle")
    triangles = np.frombuffer(data, SINGLE).astype(float).reshape(-1, TRIANGLE)
    if not np.isfinite(triangles).all():
        raise ValueError("has a number that is not finite; must be finite")
    return triangles


def corners_of(triangle: Array) -> Array:
    """Return the three corners of each triangle, (T, 3, 3) [m; W]."""
    first = triangle[:, :3]
    return np.stack([first, first + triangle[:, 3:6], first + triangle[:, 6:]], axis=1)


def outline_of(surface: Any) -> list[list[float]]:
    """Return the convex outline of a surface from above, counter-clockwise, as [x, y] [m; W].

    Monotone chain algorithm (A. M. Andrew, Information Processing Letters 9, 1979).
    """
    points = np.unique(np.round(corners_of(placed(surface))[..., :2].reshape(-1, 2), 2), axis=0).tolist()

    def chain(ordered: Iterable[list[float]]) -> list[list[float]]:
        hull: list[list[float]] = []
        for x, y in ordered:
            while len(hull) > 1:
                (ax, ay), (bx, by) = hull[-2:]
                if (bx - ax) * (y - ay) > (by - ay) * (x - ax):
                    break
                hull.pop()
            hull.append([x, y])
        return hull

    return [*chain(points)[:-1], *chain(reversed(points))[:-1]]


def _rim(corners: Array) -> NDArray[np.int8]:
    """Return 1 for each edge and corner of a triangle that is on the rim, otherwise 0, (T, 6)."""
    count = len(corners)
    if not count:
        return np.zeros((0, 6), dtype=np.int8)
    _, number = np.unique(np.rint(corners.reshape(-1, 3) / WELD_M), axis=0, return_inverse=True)
    number = number.reshape(count, 3)
    edges = np.sort(np.stack([number, np.roll(number, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    _, indices, uses = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    alone = uses[indices.ravel()] == 1
    on_rim = np.zeros(number.max() + 1, dtype=bool)
    on_rim[edges[alone].ravel()] = True
    return np.concatenate([alone.reshape(count, 3), on_rim[number]], axis=1).astype(np.int8)


def tree_over(low: Array, high: Array) -> Tree:
    """Return the tree over P boxes with minimum and maximum corners (P, 3) [m], halved along the longest side."""
    low, high = low - MARGIN_M, high + MARGIN_M
    part, middle = np.arange(len(low), dtype=np.int32), 0.5 * (low + high)
    bounds: list[Array] = []
    link: list[tuple[int, int]] = []
    waiting = [(0, len(part), -1)] if len(part) else []
    while waiting:
        first, end, parent = waiting.pop()
        if parent >= 0:
            link[parent] = (len(link), 0)
        own = part[first:end]
        bounds.append(np.concatenate([low[own].min(axis=0), high[own].max(axis=0)]))
        if end - first <= LEAF:
            link.append((first, end - first))
            continue
        axis = int(np.ptp(middle[own], axis=0).argmax())
        part[first:end] = own[np.argsort(middle[own, axis], kind="stable")]
        half = (first + end) // 2
        waiting += [(half, end, len(link)), (first, half, -1)]
        link.append((0, 0))
    links = np.array(link, dtype=np.int32).reshape(-1, 2)
    return Tree(np.array(bounds).reshape(-1, 6), links, part, np.empty(DEPTH, dtype=np.int32), np.empty(DEPTH))


class Nearest(NamedTuple):
    """The point of a sheet nearest to a given point."""

    distance: float  # m
    triangle: int  # index; -1: none within reach
    feature: int  # feature of the triangle that contains the point
    point: Vector


def nearest_points(sheet: Held, p_W: ArrayLike, far_m: ArrayLike) -> tuple[Array, Array]:
    """Return distances (P,) and positions (P, 3) [m] of the points of a held sheet nearest to points (P, 3).

    If no point is closer than `far_m`, return `far_m` and the given point instead.
    """
    points = np.ascontiguousarray(p_W, dtype=float).reshape(-1, 3)
    distances, positions = np.array(np.broadcast_to(far_m, len(points)), dtype=float), np.empty_like(points)
    _find_nearest(sheet, points, distances, positions)
    return distances, positions


@kernel()
def _find_nearest(held: Held, points: NDArray, distances: NDArray, positions: NDArray) -> None:
    """Fill `positions` (P, 3) with the points nearest to `points`; replace the limits in `distances` (P,)."""
    for k in range(points.shape[0]):
        nearest = nearest_point(held.content, (points[k, 0], points[k, 1], points[k, 2]), distances[k])
        distances[k] = nearest.distance
        for axis in range(3):
            positions[k, axis] = nearest.point[axis]


@noinline
def nearest_point(sheet: Sheet, x: Vector, far: float) -> Nearest:
    """Return the point nearest to x if closer than `far` [m]; of equally near points, the first found."""
    tree = sheet.tree
    best, index, feature, point = far * far, -1, FACE, x
    if tree.bounds.shape[0] > 0 and _square(tree.bounds[0], x) < best:
        tree.waiting[0], tree.away[0], depth = 0, 0.0, 1
        while depth > 0:
            depth -= 1
            node = tree.waiting[depth]
            if not tree.away[depth] < best:
                continue
            first, parts = tree.link[node, 0], tree.link[node, 1]
            if parts == 0:
                closer, other = node + 1, first
                at, beyond = _square(tree.bounds[closer], x), _square(tree.bounds[other], x)
                if beyond < at:
                    closer, other, at, beyond = other, closer, beyond, at
                if beyond < best:
                    tree.waiting[depth], tree.away[depth] = other, beyond
                    depth += 1
                if at < best:
                    tree.waiting[depth], tree.away[depth] = closer, at
                    depth += 1
                continue
            for n in range(first, first + parts):
                t = tree.part[n]
                candidate, candidate_feature = nearest_on(sheet.triangle[t], x)
                away = subtract(x, candidate)
                square = dot(away, away)
                if square < best:
                    best, index, feature, point = square, t, candidate_feature, candidate
    return Nearest(math.sqrt(best) if index >= 0 else far, index, feature, point)


@inlined
def nearest_on(row: NDArray, x: Vector) -> tuple[Vector, int]:
    """Return the point of a triangle nearest to x, and its feature.

    From the triangle's Voronoi regions (C. Ericson, "Real-Time Collision Detection", 2005, section 5.1.5).
    """
    a, ab, ac = (row[0], row[1], row[2]), (row[3], row[4], row[5]), (row[6], row[7], row[8])
    ax = subtract(x, a)
    a1, a2 = dot(ab, ax), dot(ac, ax)
    if a1 <= 0.0 and a2 <= 0.0:
        return a, FIRST_CORNER
    bx = subtract(ax, ab)
    b1, b2 = dot(ab, bx), dot(ac, bx)
    if b1 >= 0.0 and b2 <= b1:
        return add(a, ab), FIRST_CORNER + 1
    beside_ab = a1 * b2 - b1 * a2
    if beside_ab <= 0.0 and a1 >= 0.0 and b1 <= 0.0:
        return axpy(a, a1 / (a1 - b1), ab), FIRST_EDGE
    cx = subtract(ax, ac)
    c1, c2 = dot(ab, cx), dot(ac, cx)
    if c2 >= 0.0 and c1 <= c2:
        return add(a, ac), FIRST_CORNER + 2
    beside_ca = c1 * a2 - a1 * c2
    if beside_ca <= 0.0 and a2 >= 0.0 and c2 <= 0.0:
        return axpy(a, a2 / (a2 - c2), ac), FIRST_EDGE + 2
    beside_bc = b1 * c2 - c1 * b2
    if beside_bc <= 0.0 and b2 - b1 >= 0.0 and c1 - c2 >= 0.0:
        along = (b2 - b1) / ((b2 - b1) + (c1 - c2))
        return axpy(add(a, ab), along, subtract(ac, ab)), FIRST_EDGE + 1
    per = 1.0 / (beside_ab + beside_bc + beside_ca)
    return add(a, axpy(scaled(ab, beside_ca * per), beside_ab * per, ac)), FACE


@inlined
def _square(bounds: NDArray, x: Vector) -> float:
    """Return the squared distance of a point from a box [m^2]."""
    square = 0.0
    for k in range(3):
        excess = max(bounds[k] - x[k], x[k] - bounds[k + 3], 0.0)
        square += excess * excess
    return square


@noinline
def crosses(sheet: Sheet, start: Vector, end: Vector) -> bool:
    """Return whether the segment between two points crosses a triangle; an end in its plane is taken to be in front."""
    tree = sheet.tree
    if tree.bounds.shape[0] == 0:
        return False
    tree.waiting[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        node = tree.waiting[depth]
        separated = False
        for k in range(3):
            low, high = min(start[k], end[k]), max(start[k], end[k])
            separated |= high < tree.bounds[node, k] or low > tree.bounds[node, k + 3]
        if separated:
            continue
        first, parts = tree.link[node, 0], tree.link[node, 1]
        if parts == 0:
            tree.waiting[depth], tree.waiting[depth + 1] = first, node + 1
            depth += 2
            continue
        for n in range(first, first + parts):
            if _crosses_one(sheet.triangle[tree.part[n]], start, end):
                return True
    return False


@inlined
def _crosses_one(row: NDArray, start: Vector, end: Vector) -> bool:
    (side_start, normal), (side_end, _) = side_of(row, start), side_of(row, end)
    if (side_start >= 0.0) == (side_end >= 0.0):
        return False
    ab, ac = (row[3], row[4], row[5]), (row[6], row[7], row[8])
    at = subtract(axpy(start, side_start / (side_start - side_end), subtract(end, start)), (row[0], row[1], row[2]))
    square = dot(normal, normal)
    u, v = dot(cross(at, ac), normal) / square, dot(cross(ab, at), normal) / square
    return u >= -EDGE and v >= -EDGE and u + v <= 1.0 + EDGE


@inlined
def side_of(row: NDArray, x: Vector) -> tuple[float, Vector]:
    """Return the signed volume that x spans with a triangle, positive in front, and its normal; both unnormalised."""
    normal = cross((row[3], row[4], row[5]), (row[6], row[7], row[8]))
    return dot(normal, subtract(x, (row[0], row[1], row[2]))), normal
