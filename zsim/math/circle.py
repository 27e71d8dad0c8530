"""How well a circle is known from points of its edge. Compiled; plain floats."""

import math

from zsim.math.compiled import portable

SINGULAR = 1e-9  # of a determinant, below which points do not tell a circle


@portable
def spread(n: float, x: float, y: float, xx: float, xy: float, yy: float) -> tuple[float, float]:
    """Return the standard deviations of centre, per axis, and radius of a circle, over that of each point on its edge.

    Least squares: (A^T A)^-1 with a row (x, y, 1) for every point in the direction (x, y) from the centre.

    Args:
        n: count of points.
        x, y, xx, xy, yy: sums over their directions and of products of these.
    """
    a, b, c = yy * n - y * y, xx * n - x * x, xx * yy - xy * xy
    determinant = max(xx * a - xy * (xy * n - x * y) + x * (xy * y - yy * x), SINGULAR)
    return math.sqrt(0.5 * max(a + b, 0.0) / determinant), math.sqrt(max(c, 0.0) / determinant)
