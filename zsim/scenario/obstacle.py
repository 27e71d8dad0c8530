"""Obstacles as solids: signed distance of a point and its direction. Pure; the world compiles it.

An obstacle is a row: its shape, centre in W, cosine and sine of its yaw, and half of its size along its own axes (of a
cylinder: radius, nothing, half of the height; of a sphere: radius).
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zsim.math import elementary as el

BOX, CYLINDER, SPHERE = range(3)
SHAPES = ("box", "cylinder", "sphere")
SHAPE, CENTRE, COSINE, SINE, HALF = 0, 1, 4, 5, 6
COLUMNS = 9
TINY = 1e-12  # m, so that a point on an axis has a direction
PAIRS_MAX = 1_000_000  # of points and obstacles that are compared at once
WIDE = 1e9  # m, half of the side that a cylinder does not have


def row_of(obstacle: Any) -> list[float]:
    """Return the row of an obstacle of a scenario, whose position is that of its base, or the centre of a sphere."""
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
    """Return the distance of a point from the surface [m], below 0 inside, and the outward unit vector in W."""
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
        most = max(ox, oy, oz)
        if most > 0.0:
            ox, oy, oz = max(ox, 0.0), max(oy, 0.0), max(oz, 0.0)
            distance = math.sqrt(ox * ox + oy * oy + oz * oz)
        else:  # inside: out by the nearest face
            distance = most
            ox, oy, oz = 1.0 if ox == most else 0.0, 1.0 if oy == most else 0.0, 1.0 if oz == most else 0.0
        length = max(math.sqrt(ox * ox + oy * oy + oz * oz), TINY)
        nx, ny, nz = math.copysign(ox, ax) / length, math.copysign(oy, ay) / length, math.copysign(oz, qz) / length
        if round_:
            nx, ny = nx * qx / r, nx * qy / r
    return distance, c * nx - s * ny, s * nx + c * ny, nz


def least_distances(obstacles: Iterable[Any], p_W: ArrayLike) -> NDArray[np.float64]:
    """Return the distance [m] of each point (T, 3) from the nearest of some obstacles of a scenario, as `nearest` does.

    inf where there are none.
    """
    points, rows = np.asarray(p_W, dtype=float).reshape(-1, 3), np.array([*map(row_of, obstacles)]).reshape(-1, COLUMNS)
    least, step = np.full(len(points), np.inf), max(1, PAIRS_MAX // max(len(rows), 1))
    for first in range(0, len(points) if len(rows) else 0, step):
        x, y, z = (points[first : first + step, None, k] - rows[:, CENTRE + k] for k in range(3))
        c, s, shape, half = rows[:, COSINE], rows[:, SINE], rows[:, SHAPE], rows[:, HALF:]
        r = np.sqrt(x * x + y * y)
        across = np.where(shape == BOX, np.abs(c * x + s * y), r) - half[:, 0]
        along = np.where(shape == BOX, np.abs(c * y - s * x) - half[:, 1], -np.inf)
        over = np.abs(z) - half[:, 2]
        most = np.maximum(np.maximum(across, along), over)
        outside = np.sqrt(np.maximum(across, 0.0) ** 2 + np.maximum(along, 0.0) ** 2 + np.maximum(over, 0.0) ** 2)
        solid = np.where(most > 0.0, outside, most)
        least[first : first + step] = np.where(shape == SPHERE, np.sqrt(r * r + z * z) - half[:, 0], solid).min(axis=1)
    return least
