"""The circle of a ball of which something hides a part: through what is left of its edge. Compiled.

The edge is looked for from outside inwards, in directions all around a point of the ball. The best circle through half
of the points in a row tells which others are on the same one. Circles are fitted by least squares to
x^2 + y^2 = 2 a x + 2 b y + c (I. Kasa, IEEE Trans. Instrum. Meas. 25, 1976) in the plane that touches the unit sphere
where the ball is: there it is a circle wherever in the picture it stands.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import Field, columns, portable
from zsim.math.rotation import Vector, add, cross, dot, norm, scaled
from zsim.sensors.camera_model import spread

DIRECTIONS = 32
STEP_PX = 0.5  # along a direction
EDGE = 0.5  # of a pixel, covered by the ball
BLUR_PX2 = 1.1  # px^2, variance of what blurs an edge; half of a pixel is covered within a curved one; calibrated
# px, px^2 over the radius, px over the noise of the share: as far as an edge point may be from its circle; calibrated
NEAR_PX, NEAR_PX2, NEAR_NOISE = 0.2, 1.0, 6.0
POINTS_MIN = 5  # of a circle
REFINEMENTS = 3  # of which points are on it
OUTSIDE = 3.0  # cost of a point outside of a circle, over that of one inside: a ball may be hidden, but not stand out
WHOLE_CENTRE = math.sqrt(2.0 / DIRECTIONS)  # Outline.centre of a ball that nothing hides
SINGULAR = 1e-9  # of a determinant over what it is of points all around

EDGE_POINT = columns("EdgePointColumns", (Field("x", "px"), Field("y", "px"), Field("on", "1")))


class Outline(NamedTuple):
    """The circle of a ball on the sphere of directions.

    Attributes:
        ray: to its centre, a unit vector of K.
        radius_rad: its apparent radius; not a number where there is no circle.
        share: of its edge, that is visible.
        rough_px: root mean square distance of edge points from it.
        centre, radius: standard deviations of the centre, per axis, and of the radius over that of an edge point.
    """

    ray: Vector
    radius_rad: float
    share: float
    rough_px: float
    centre: float
    radius: float


NONE = Outline((0.0, 0.0, 1.0), math.nan, 0.0, 0.0, 0.0, 0.0)
Circle = tuple[float, float, float]  # middle and radius [px]


def rehearse() -> None:
    """Load or compile what is needed of it, with a picture of nothing: the first hat is not to wait for it."""
    outline(np.zeros((3, 3), np.float32), 0.0, np.ones((3, 3, 3), np.float32), 1.0)


@portable
def outline(covered: NDArray, noise: float, rays: NDArray, scale: float) -> Outline:
    """Return the circle of a ball.

    Args:
        covered: share of each pixel that the ball covers, float32 (h, w).
        noise: its standard deviation.
        rays: unit vectors of K through the pixels, float32 (h, w, 3).
        scale: pixels per radian there.
    """
    u, v = _middle(covered)
    ahead = _ray(rays, u, v)
    right = cross((0.0, 1.0, 0.0), ahead)
    right = scaled(right, 1.0 / norm(right))
    down = cross(ahead, right)
    points = np.empty((DIRECTIONS, EDGE_POINT.size))
    count = 0
    for k in range(DIRECTIONS):
        turn = 2.0 * math.pi * k / DIRECTIONS
        cosine, sine = math.cos(turn), math.sin(turn)
        away = _edge(covered, u, v, cosine, sine)
        if away > 0.0:
            ray = _ray(rays, u + away * cosine, v + away * sine)
            ahead_px = dot(ray, ahead) / scale
            points[count, 0], points[count, 1], points[count, 2] = (
                dot(ray, right) / ahead_px,
                dot(ray, down) / ahead_px,
                1.0,
            )
            count += 1
    points = points[:count]
    if count < POINTS_MIN or not _choose(points, noise):
        return NONE
    x, y, r = _fitted(points, 0, count)
    centre, radius, rough = _spread(points, x, y, r)
    ray = add(ahead, add(scaled(right, x / scale), scaled(down, y / scale)))
    radius_rad = math.atan((r + BLUR_PX2 / (2.0 * r)) / scale)
    return Outline(
        scaled(ray, 1.0 / norm(ray)), radius_rad, points[:, EDGE_POINT.on].sum() / DIRECTIONS, rough, centre, radius
    )


@portable
def _middle(covered: NDArray) -> tuple[float, float]:
    """Return the middle of what is covered [px]."""
    area, across, along = 1e-9, 0.0, 0.0
    for v in range(covered.shape[0]):
        for u in range(covered.shape[1]):
            share = float(covered[v, u])
            area, across, along = area + share, across + share * u, along + share * v
    return across / area, along / area


@portable
def _between(picture: NDArray, u: float, v: float) -> float:
    """Return what a picture (h, w) has at a point between its pixels, 0 outside of them."""
    if u < 0.0 or v < 0.0 or u >= picture.shape[1] - 1 or v >= picture.shape[0] - 1:
        return 0.0
    i, j = int(u), int(v)
    a, b = u - i, v - j
    above = (1.0 - a) * picture[j, i] + a * picture[j, i + 1]
    return (1.0 - b) * above + b * ((1.0 - a) * picture[j + 1, i] + a * picture[j + 1, i + 1])


@portable
def _ray(rays: NDArray, u: float, v: float) -> Vector:
    """Return the unit vector through a point between pixels, or through the nearest there is."""
    u = min(max(u, 0.0), rays.shape[1] - 1.001)
    v = min(max(v, 0.0), rays.shape[0] - 1.001)
    ray = _between(rays[:, :, 0], u, v), _between(rays[:, :, 1], u, v), _between(rays[:, :, 2], u, v)
    return scaled(ray, 1.0 / norm(ray))


@portable
def _edge(covered: NDArray, u: float, v: float, cosine: float, sine: float) -> float:
    """Return how far from a point the edge is, coming from outside [px]; 0 if nothing is covered, or all of the way."""
    steps = int(math.hypot(float(covered.shape[0]), float(covered.shape[1])) / STEP_PX)
    outer = 0.0
    for step in range(steps, -1, -1):
        away = step * STEP_PX
        share = _between(covered, u + away * cosine, v + away * sine)
        if share > EDGE:
            return away + STEP_PX * (share - EDGE) / (share - outer)
        outer = share
    return 0.0


@portable
def _fitted(points: NDArray, first: int, count: int) -> Circle:
    """Return the circle through those of `count` points in a row, from `first` on, that are on it."""
    n, mx, my = 0.0, 0.0, 0.0
    for k in range(count):
        x, y, on = points[(first + k) % len(points)]
        n, mx, my = n + on, mx + on * x, my + on * y
    mx, my = mx / n, my / n
    xx, xy, yy, xz, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        x, y, on = points[(first + k) % len(points)]
        x, y = x - mx, y - my
        z = x * x + y * y
        xx, xy, yy = xx + on * x * x, xy + on * x * y, yy + on * y * y
        xz, yz, zz = xz + on * x * z, yz + on * y * z, zz + on * z
    determinant = xx * yy - xy * xy
    if determinant <= SINGULAR * (xx + yy) * (xx + yy):
        return mx, my, 0.0  # they are on a line
    a, b = (xz * yy - yz * xy) / (2.0 * determinant), (yz * xx - xz * xy) / (2.0 * determinant)
    return mx + a, my + b, math.sqrt(a * a + b * b + zz / n)


@portable
def _near_px(r: float, noise: float) -> float:
    """Return how far an edge point may be from its circle."""
    return NEAR_PX + NEAR_PX2 / r + NEAR_NOISE * noise


@portable
def _cost(points: NDArray, circle: Circle, noise: float) -> float:
    """Return how badly a circle explains all points."""
    x, y, r = circle
    if r <= 0.0:
        return math.inf
    near, total = _near_px(r, noise), 0.0
    for k in range(len(points)):
        off = math.hypot(points[k, 0] - x, points[k, 1] - y) - r
        total += OUTSIDE if off > near else min(abs(off) / near, 1.0)
    return total


@portable
def _choose(points: NDArray, noise: float) -> bool:
    """Mark the points that are on the circle which most of them share; False if they are too few."""
    count = len(points)
    least, best = math.inf, (0.0, 0.0, 0.0)
    for first in range(count):
        circle = _fitted(points, first, count // 2 + 1)
        cost = _cost(points, circle, noise)
        if cost < least:
            least, best = cost, circle
    near = np.empty(count)
    for _ in range(REFINEMENTS):
        x, y, r = best
        if r <= 0.0:
            return False
        for k in range(count):
            off = abs(math.hypot(points[k, 0] - x, points[k, 1] - y) - r)
            near[k] = 1.0 if off < _near_px(r, noise) else 0.0
        for k in range(count):  # beside a point that is hidden the edge is blurred
            points[k, EDGE_POINT.on] = near[k] * near[k - 1] * near[(k + 1) % count]
        if points[:, EDGE_POINT.on].sum() < POINTS_MIN:
            return False
        best = _fitted(points, 0, count)
    return best[2] > 0.0


@portable
def _spread(points: NDArray, x: float, y: float, r: float) -> tuple[float, float, float]:
    """Return the standard deviations of centre and radius over that of an edge point, and the roughness [px]."""
    n, sx, sy, sxx, sxy, syy, rough = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(points)):
        if points[k, EDGE_POINT.on] != 0.0:
            dx, dy = points[k, EDGE_POINT.x] - x, points[k, EDGE_POINT.y] - y
            rough += (math.hypot(dx, dy) - r) ** 2
            dx, dy = dx / r, dy / r
            n, sx, sy = n + 1.0, sx + dx, sy + dy
            sxx, sxy, syy = sxx + dx * dx, sxy + dx * dy, syy + dy * dy
    centre, radius = spread(n, sx, sy, sxx, sxy, syy)
    return centre, radius, math.sqrt(rough / n)
