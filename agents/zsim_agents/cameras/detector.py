"""Finds magenta hats in a simulated or real picture: bearing and range of each, with standard deviations. No I/O.

A pixel's magenta level is zero for orange, and varies linearly with the share of the pixel that a hat covers in front
of grass, sky or hull: the covered share is the pixel's level divided by that of the hat alone. Direction and range
follow from the hat's circular outline, which rotors may partly hide: wherever a ball of radius r at a distance d is in
the picture, its apparent radius is the angle a with sin a = r / d.

Edge points are found by searching inwards from outside, in all directions around the centroid of the covered pixels.
A circle is fitted to every run of consecutive points that contains just over half of them; the circle that best
explains all points determines which of them lie on the outline. Circles x^2 + y^2 = 2 a x + 2 b y + c are fitted by
least squares (I. Kasa, IEEE Trans. Instrum. Meas. 25, 1976) in the tangent plane of the unit sphere at the ball, where
the outline is a circle wherever the ball is in the picture.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.contract.flight_messages import Seen
from zsim.math.compiled import Field, columns, portable
from zsim.math.rotation import Vector, add, cross, dot, norm, scaled
from zsim.sensors.camera import PictureError, frame_of
from zsim.sensors.camera_model import CameraPose, Lens, spread
from zsim_agents.cameras.scene import View

Picture = NDArray[np.uint8]
Levels = NDArray[np.float32]

PIXELS_MAX = 1920 * 1080 * 2  # maximum number of pixels to decode, twice the limit for a camera in a scenario
# R - G of magenta is at least LEVEL_MIN + SHARE_MIN R, out of 255; smaller differences are noise
LEVEL_MIN = 24
SHARE_MIN = 0.3
BLUE_SHARE = 0.2  # minimum (B - G) / (R - G) of magenta (the paper's has 0.59); lower values are orange or red
BLUE_WEIGHT = 1.5  # reduction of the magenta level per unit of missing blue
AREA_MIN_PX = 2  # minimum area of a region's box at half the resolution
BLOBS_MAX = 100  # maximum number of regions to examine, the largest first
MARGIN_PX = 4  # margin around a region, for its edge and the background
CORE = 0.5  # minimum level of a hat's pixels, as a fraction of the maximum level
CORE_MIN_PX = 12  # number of fully covered pixels above which they give the hat's level; otherwise the blur gives it
POINT_BLUR_PX2 = 1.1  # variance of a point's blur by lens, pixel, JPEG and the mean of nine pixels [px^2]; calibrated
ROUND_MIN = 0.3  # minimum ratio of the smaller to the larger principal variance of a ball's image
PIECE_GAP = 0.3  # maximum gap between two pieces of a ball over the ball's size; a rotor guard leaves a gap of 0.2
SHARE_OF_EDGE_MIN = 0.3  # minimum visible share of a hat's edge
DIAMETER_MIN_PX = 4.0  # minimum diameter of a hat [px]; the range of smaller hats has a bias that exceeds its sigma
# Calibrated coefficients of the standard deviations of centre and diameter [px], whose terms are added in quadrature:
# of the edge's roughness [1]; of 1 / diameter [px^2] (for the centre, times the hidden part); of 1 / diameter^2 [px^3]
# (centre), or a constant [px] (diameter).
CENTRE = 2.0, 6.5, 8.0
DIAMETER = 2.0, 4.6, 0.1
SQUARE_3, SQUARE_5 = (np.ones((side, side), np.uint8) for side in (3, 5))

DIRECTIONS = 32
STEP_PX = 0.5  # step of the search along a direction
EDGE = 0.5  # covered share of a pixel at the edge of a ball
EDGE_BLUR_PX2 = 1.1  # variance of the blur that moves a curved edge inwards [px^2]; calibrated
# Calibrated terms of an edge point's maximum distance from its circle: constant [px], divided by the radius [px^2], and
# multiplied by the noise of the covered share [px]
TOLERANCE_PX, TOLERANCE_PX2, TOLERANCE_NOISE = 0.2, 1.0, 6.0
POINTS_MIN = 5  # minimum number of points on a circle
REFINEMENTS = 3  # number of refinements of the set of points on a circle
OUTSIDE = 3.0  # cost of a point outside the circle (at most 1 inside): part of a ball may be hidden, but none protrudes
UNOBSTRUCTED_CENTRE = math.sqrt(2.0 / DIRECTIONS)  # Outline.centre of an unobstructed ball
SINGULAR = 1e-9  # points are collinear up to this ratio of the determinant to the squared trace of their second moments

EDGE_POINT = columns("EdgePointColumns", (Field("x", "px"), Field("y", "px"), Field("on", "1")))

_x = np.linspace(1e-3, 60, 6000)
# Ratio of the peak of a blurred disc to its unblurred level, divided by x = r^2 / (2 s^2); radius r, blur sigma s
_PEAK = (1 - np.exp(-_x)) / _x


def decoded(data: bytes, width: int, height: int) -> Picture:
    """Return the pixels of a JPEG, (height, width, 3), in B, G, R.

    The size is read from the header before decoding, to bound the memory that an untrusted picture takes.

    Raises:
        PictureError: `data` is not a whole JPEG, differs from the announced size, or has too many pixels.
    """
    _, found_width, found_height = frame_of(data)
    if (found_width, found_height) != (width, height):
        found = f"{found_width} x {found_height}"
        raise PictureError(f"data is a JPEG of {found}; must be {width} x {height}, as in the camera's info")
    if width * height > PIXELS_MAX:
        raise PictureError(f"picture has {width * height} pixels; must have at most {PIXELS_MAX}")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise PictureError(f"data ({len(data)} bytes) is a JPEG that cannot be decoded ({error.code})") from error
    if picture is None or picture.shape != (height, width, 3):
        raise PictureError(f"data ({len(data)} bytes) is a JPEG that cannot be decoded; must be whole")
    return picture  # type: ignore[return-value]


class _Box(NamedTuple):
    """A rectangular part of a picture: upper left corner and size [px]."""

    u: int
    v: int
    width: int
    height: int

    def touches(self, other: "_Box") -> bool:
        """Return whether the gap to another box is so small, for this box's size, that both are parts of one ball."""
        gap = 1 + PIECE_GAP * max(self.width, self.height)
        across = max(self.u, other.u) - min(self.u + self.width, other.u + other.width)
        down = max(self.v, other.v) - min(self.v + self.height, other.v + other.height)
        return max(across, down) <= gap

    def union(self, other: "_Box") -> "_Box":
        """Return the smallest box that contains both boxes."""
        u, v = min(self.u, other.u), min(self.v, other.v)
        right, bottom = (
            max(self.u + self.width, other.u + other.width),
            max(self.v + self.height, other.v + other.height),
        )
        return _Box(u, v, right - u, bottom - v)


class HatDetector:
    """Finds hats of a given diameter [m] in the pictures of one camera."""

    def __init__(self, lens: Lens, pose: CameraPose, diameter_m: float) -> None:
        self._lens, self._R_BK, self._radius_m = lens, pose.R_BK, diameter_m / 2
        self._rays = View(lens).rays
        self._half = max(1, lens.width // 2), max(1, lens.height // 2)

    def seen(self, picture: Picture) -> tuple[Seen, ...]:
        """Return the hats in a picture of the camera, (height, width, 3) in B, G, R, roughly largest first."""
        found = [self._hat(picture, box) for box in self._boxes(picture)]
        return tuple(hat for hat in found if hat is not None)

    def _boxes(self, picture: Picture) -> list[_Box]:
        """Return boxes around magenta regions at half the resolution, in order of their largest pieces."""
        blue, green, red = cv2.split(cv2.resize(picture, self._half, interpolation=cv2.INTER_AREA))
        level = cv2.subtract(red, green)
        strong = cv2.addWeighted(level, 1.0, red, -SHARE_MIN, 0.5 - LEVEL_MIN)
        bluish = cv2.subtract(blue, green)
        mask = cv2.min(strong, cv2.addWeighted(bluish, 1.0, level, -BLUE_SHARE, 0.0))
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        boxes = [_Box(*cv2.boundingRect(contour)) for contour in contours]
        large = [box for box in boxes if box.width * box.height >= AREA_MIN_PX]
        merged: list[_Box] = []  # unites the pieces into which a rotor guard divides a ball
        for box in sorted(large, key=lambda box: (-box.width * box.height, box))[:BLOBS_MAX]:
            for i, other in enumerate(merged):
                if other.touches(box):
                    merged[i] = other.union(box)
                    break
            else:
                merged.append(box)
        return merged

    def _hat(self, picture: Picture, box: _Box) -> Seen | None:
        """Return the hat in a box at half the resolution; None if it cannot be measured, or the border cuts it off."""
        u, v, width, height = (2 * side for side in box)
        margin = MARGIN_PX + max(width, height) // 6
        u0, v0, u1, v1 = u - margin, v - margin, u + width + margin, v + height + margin
        if u <= 2 or v <= 2 or u + width >= self._lens.width - 2 or v + height >= self._lens.height - 2:
            return None  # a truncated hat gives neither bearing nor range
        part = slice(max(v0, 0), v1), slice(max(u0, 0), u1)
        blue, green, red = (channel.astype(np.float32) for channel in cv2.split(picture[part]))
        level, bluish = red - green, blue - green  # the magenta level is R - G, reduced where blue is missing
        missing_blue = np.maximum(np.float32(BLUE_SHARE) * level - bluish, 0) * np.float32(BLUE_WEIGHT)
        level = np.where(level > 0, np.maximum(level - missing_blue, 0), level)
        sides = level[0], level[-1], level[1:-1, 0], level[1:-1, -1]
        background = float(np.median(np.concatenate(sides)))
        noise = min(_deviation(side) for side in sides)  # a hull may cross some sides, but not all
        level -= np.float32(background)
        found = _find_outline(level, noise, self._rays[part], self._lens.fx)
        if found is None:
            return None
        circle, scale = found
        diameter_px, roughness_px = 2 * circle.radius_rad * scale, circle.rough_px
        hidden = max(0.0, circle.centre - UNOBSTRUCTED_CENTRE)
        centre_px = math.hypot(
            CENTRE[0] * circle.centre * roughness_px, CENTRE[1] * hidden / diameter_px, CENTRE[2] / diameter_px**2
        )
        size_px = math.hypot(
            2 * circle.radius * math.hypot(DIAMETER[0] * roughness_px, DIAMETER[1] / diameter_px), DIAMETER[2]
        )
        range_m = self._radius_m / math.sin(circle.radius_rad)
        x, y, z = (self._R_BK @ circle.ray).tolist()
        return Seen((x, y, z), range_m, centre_px / scale, range_m * size_px / diameter_px)


def _deviation(values: Levels) -> float:
    """Return a robust estimate of the standard deviation of normally distributed values with outliers."""
    return 1.48 * float(np.median(np.abs(values - np.median(values))))


class Outline(NamedTuple):
    """The outline of a ball: a circle on the unit sphere of directions.

    Attributes:
        ray: unit vector to the circle's centre, in K.
        radius_rad: the ball's apparent radius; NaN if no circle was found.
        share: visible share of the circle.
        rough_px: root mean square distance from the circle of the edge points that belong to it.
        centre, radius: standard deviations of the centre, per axis, and of the radius, over that of an edge point.
    """

    ray: Vector
    radius_rad: float
    share: float
    rough_px: float
    centre: float
    radius: float


def _find_outline(level: Levels, noise: float, rays: Levels, focal_px: float) -> tuple[Outline, float] | None:
    """Return a hat's outline and the pixels per radian there, or None; `level` is relative to the background."""
    mean = cv2.blur(level, (3, 3), borderType=cv2.BORDER_REPLICATE)
    v, u = divmod(int(np.argmax(mean)), level.shape[1])
    peak = float(mean[v, u])
    if peak < max(LEVEL_MIN / 2, 2 * noise / 3):  # the mean of nine pixels has a third of a pixel's noise
        return None
    cosine = float(rays[v, u, 2])
    core = (level > CORE * peak).astype(np.uint8)
    dilated = cv2.dilate(core, SQUARE_5).astype(np.uint8)
    covered = _covered(level, core, dilated, peak)
    oblique = cosine * cosine  # ratio of the principal variances of a ball's image at this angle from the optical axis
    if _roundness(covered) / oblique < ROUND_MIN:
        return None
    scale = focal_px / (cosine * math.sqrt(cosine))  # geometric mean of the radial and tangential scales
    circle = outline(covered, noise / peak, np.ascontiguousarray(rays), scale)  # contiguous as in `rehearse`
    is_reliable = circle.share >= SHARE_OF_EDGE_MIN and 2 * circle.radius_rad * scale >= DIAMETER_MIN_PX
    return (circle, scale) if is_reliable else None


def _covered(level: Levels, core: Picture, dilated: Picture, peak: float) -> Levels:
    """Return the covered share of each pixel: its level over that of the hat alone, which varies with the shading."""
    inner = cv2.erode(core, SQUARE_3)
    count = int(inner.sum())
    hat_level: Levels | float
    if count > CORE_MIN_PX:
        side = 2 * round(math.sqrt(count) / 4) + 5
        total = cv2.blur(level * inner, (side, side), borderType=cv2.BORDER_CONSTANT)
        weight = cv2.blur(inner.astype(np.float32), (side, side), borderType=cv2.BORDER_CONSTANT)
        mean = np.float32((level * inner).sum() / count)
        hat_level = np.where(weight > 1e-3, total / np.maximum(weight, 1e-3), mean)
    else:
        blurred = peak / float((level * dilated).sum()) * 2 * math.pi * POINT_BLUR_PX2
        hat_level = peak / (1 - math.exp(-float(np.interp(-blurred, -_PEAK, _x))))
    return np.clip(level / hat_level, 0, 1) * dilated


def _roundness(covered: Levels) -> float:
    """Return the ratio of the smaller to the larger principal variance of the covered area; 0 below one pixel."""
    moments = cv2.moments(covered)
    area = moments["m00"]
    if area < 1:
        return 0.0
    uu, vv, uv = moments["mu20"] / area, moments["mu02"] / area, moments["mu11"] / area
    middle, half = (uu + vv) / 2, math.hypot((uu - vv) / 2, uv)
    return (middle - half) / max(middle + half, 1e-9)


NONE = Outline((0.0, 0.0, 1.0), math.nan, 0.0, 0.0, 0.0, 0.0)
Circle = tuple[float, float, float]  # x and y of the centre, radius [px]


def rehearse() -> None:
    """Load or compile the kernels by processing an empty picture, so that the first hat is not delayed."""
    outline(np.zeros((3, 3), np.float32), 0.0, np.ones((3, 3, 3), np.float32), 1.0)


@portable
def outline(covered: NDArray, noise: float, rays: NDArray, scale: float) -> Outline:
    """Return the outline of a ball; NONE if no circle explains the edge points.

    Args:
        covered: share of each pixel that the ball covers, float32 (h, w).
        noise: standard deviation of that share.
        rays: unit vectors through the pixels, in K, float32 (h, w, 3).
        scale: pixels per radian at the ball.
    """
    u, v = _centroid(covered)
    ahead = _ray(rays, u, v)
    right = cross((0.0, 1.0, 0.0), ahead)
    right = scaled(right, 1.0 / norm(right))
    down = cross(ahead, right)
    points = np.empty((DIRECTIONS, EDGE_POINT.size))
    count = 0
    for k in range(DIRECTIONS):
        angle = 2.0 * math.pi * k / DIRECTIONS
        cosine, sine = math.cos(angle), math.sin(angle)
        distance_px = _edge(covered, u, v, cosine, sine)
        if distance_px > 0.0:
            ray = _ray(rays, u + distance_px * cosine, v + distance_px * sine)
            ahead_px = dot(ray, ahead) / scale
            points[count, 0], points[count, 1], points[count, 2] = (
                dot(ray, right) / ahead_px,
                dot(ray, down) / ahead_px,
                1.0,
            )
            count += 1
    points = points[:count]
    if count < POINTS_MIN or not _mark_best_circle(points, noise):
        return NONE
    x, y, r = _fit_circle(points, 0, count)
    centre, radius, roughness_px = _spread(points, x, y, r)
    ray = add(ahead, add(scaled(right, x / scale), scaled(down, y / scale)))
    radius_rad = math.atan((r + EDGE_BLUR_PX2 / (2.0 * r)) / scale)
    return Outline(
        scaled(ray, 1.0 / norm(ray)),
        radius_rad,
        points[:, EDGE_POINT.on].sum() / DIRECTIONS,
        roughness_px,
        centre,
        radius,
    )


@portable
def _centroid(covered: NDArray) -> tuple[float, float]:
    """Return the centroid of the covered pixels [px]."""
    area, across, along = 1e-9, 0.0, 0.0
    for v in range(covered.shape[0]):
        for u in range(covered.shape[1]):
            share = float(covered[v, u])
            area, across, along = area + share, across + share * u, along + share * v
    return across / area, along / area


@portable
def _interpolated(picture: NDArray, u: float, v: float) -> float:
    """Return the bilinearly interpolated value of a picture (h, w); 0 outside."""
    if u < 0.0 or v < 0.0 or u >= picture.shape[1] - 1 or v >= picture.shape[0] - 1:
        return 0.0
    i, j = int(u), int(v)
    a, b = u - i, v - j
    above = (1.0 - a) * picture[j, i] + a * picture[j, i + 1]
    return (1.0 - b) * above + b * ((1.0 - a) * picture[j + 1, i] + a * picture[j + 1, i + 1])


@portable
def _ray(rays: NDArray, u: float, v: float) -> Vector:
    """Return the interpolated unit vector through a point, which is clamped to the picture."""
    u = min(max(u, 0.0), rays.shape[1] - 1.001)
    v = min(max(v, 0.0), rays.shape[0] - 1.001)
    ray = _interpolated(rays[:, :, 0], u, v), _interpolated(rays[:, :, 1], u, v), _interpolated(rays[:, :, 2], u, v)
    return scaled(ray, 1.0 / norm(ray))


@portable
def _edge(covered: NDArray, u: float, v: float, cosine: float, sine: float) -> float:
    """Return the distance from a point to the outermost edge in a direction [px]; 0 if there is no edge."""
    steps = int(math.hypot(float(covered.shape[0]), float(covered.shape[1])) / STEP_PX)
    outer = 0.0
    for step in range(steps, -1, -1):
        distance_px = step * STEP_PX
        share = _interpolated(covered, u + distance_px * cosine, v + distance_px * sine)
        if share > EDGE:
            return distance_px + STEP_PX * (share - EDGE) / (share - outer)
        outer = share
    return 0.0


@portable
def _fit_circle(points: NDArray, first: int, count: int) -> Circle:
    """Return the circle fitted to the marked points among `count` consecutive ones from `first` on, cyclically."""
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
        return mx, my, 0.0  # collinear
    a, b = (xz * yy - yz * xy) / (2.0 * determinant), (yz * xx - xz * xy) / (2.0 * determinant)
    return mx + a, my + b, math.sqrt(a * a + b * b + zz / n)


@portable
def _tolerance_px(r: float, noise: float) -> float:
    """Return the maximum distance of an edge point from its circle of radius r [px]."""
    return TOLERANCE_PX + TOLERANCE_PX2 / r + TOLERANCE_NOISE * noise


@portable
def _cost(points: NDArray, circle: Circle, noise: float) -> float:
    """Return the cost of explaining all points by a circle."""
    x, y, r = circle
    if r <= 0.0:
        return math.inf
    tolerance_px, total = _tolerance_px(r, noise), 0.0
    for k in range(len(points)):
        deviation_px = math.hypot(points[k, 0] - x, points[k, 1] - y) - r
        total += OUTSIDE if deviation_px > tolerance_px else min(abs(deviation_px) / tolerance_px, 1.0)
    return total


@portable
def _mark_best_circle(points: NDArray, noise: float) -> bool:
    """Mark the points on the circle that explains all best; return False if they are too few or collinear."""
    count = len(points)
    min_cost, best = math.inf, (0.0, 0.0, 0.0)
    for first in range(count):
        circle = _fit_circle(points, first, count // 2 + 1)
        cost = _cost(points, circle, noise)
        if cost < min_cost:
            min_cost, best = cost, circle
    is_near = np.empty(count)
    for _ in range(REFINEMENTS):
        x, y, r = best
        if r <= 0.0:
            return False
        for k in range(count):
            deviation_px = abs(math.hypot(points[k, 0] - x, points[k, 1] - y) - r)
            is_near[k] = 1.0 if deviation_px < _tolerance_px(r, noise) else 0.0
        for k in range(count):  # blur makes edge points next to hidden ones unreliable
            points[k, EDGE_POINT.on] = is_near[k] * is_near[k - 1] * is_near[(k + 1) % count]
        if points[:, EDGE_POINT.on].sum() < POINTS_MIN:
            return False
        best = _fit_circle(points, 0, count)
    return best[2] > 0.0


@portable
def _spread(points: NDArray, x: float, y: float, r: float) -> tuple[float, float, float]:
    """Return the fields `centre`, `radius` and `rough_px` of an `Outline`."""
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
