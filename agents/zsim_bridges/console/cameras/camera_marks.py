"""What is drawn on a camera's picture: where sightings fall on it, how large, and their ranges. Pure.

Frames: B of the drone; K of the camera, x right, y down, z ahead; pixels from the picture's upper left corner, whole
numbers in the middle of a pixel.
"""

import math
from collections.abc import Iterable

from msgspec import Struct

from zsim.contract.flight_messages import CameraInfo, Seen, Sightings
from zsim.math import rotation
from zsim.sensors.camera_model import Lens, pixel, undistorted

RADIUS_MIN_PX = 5.0  # of a circle: a smaller one is not seen
SIGMAS = 2.0  # of direction, that a circle leaves around a hat
FOLD_MAX = 1e-3  # focal lengths between a ray and what its pixel is the image of; beyond it the lens folds over
NORM_MIN = 1e-6  # of a quaternion or a direction
AGE_MAX_NS = 300_000_000  # simulated, between a picture and sightings that are drawn on it; chosen: 3 pictures of 10 Hz


class Mark(Struct, frozen=True):
    """A circle on a picture, and a text beside it."""

    u: float  # px, of its centre
    v: float
    radius: float  # px
    text: str


def is_usable(info: CameraInfo) -> bool:
    """Return whether what a camera says of itself can be computed with: another program may have sent it."""
    fx, fy = info.K[0], info.K[4]
    return fx > 0 and fy > 0 and math.sqrt(sum(q * q for q in info.orientation_wxyz)) > NORM_MIN


def lens_of(info: CameraInfo) -> Lens:
    """Return the lens that a camera says it has."""
    fx, _, cx, _, fy, cy, *_ = info.K
    return Lens(fx, fy, cx, cy, *info.D, info.width, info.height)


def field_of_view(info: CameraInfo) -> float:
    """Return the angle of view from top to bottom, without distortion [rad]."""
    return 2.0 * math.atan(info.height / 2.0 / info.K[4])


def sightings_of(picture_ns: int, candidates: Iterable[Sightings]) -> Sightings | None:
    """Return what belongs to a picture: what was seen at its time, or else nearest to it; None where all is old.

    Args:
        picture_ns: time of the picture's exposure.
        candidates: of its camera.
    """
    nearest = min(candidates, key=lambda each: abs(each.t_sample_ns - picture_ns), default=None)
    if nearest is None or abs(nearest.t_sample_ns - picture_ns) > AGE_MAX_NS:
        return None
    return nearest


def marks_of(info: CameraInfo, seen: Iterable[Seen], hat_m: float) -> tuple[Mark, ...]:
    """Return what is to be drawn of sightings that fall on a camera's picture.

    Args:
        info: of the camera; usable.
        seen: in B.
        hat_m: diameter of a hat [m].
    """
    lens, q_BK = lens_of(info), rotation.normalised(info.orientation_wxyz)
    marks = (_mark(lens, q_BK, each, hat_m) for each in seen)
    return tuple(mark for mark in marks if mark is not None)


def _mark(lens: Lens, q_BK: rotation.Quaternion, seen: Seen, hat_m: float) -> Mark | None:
    """Return a circle around a hat and 2 sigma of its direction, None where it is not on the picture."""
    place = _place(lens, rotation.rotate_back(q_BK, seen.direction_B))
    if place is None or seen.range_m <= 0:
        return None
    half_angle = hat_m / 2.0 / seen.range_m + SIGMAS * abs(seen.sigma_direction_rad)
    radius = min(max(lens.fx * half_angle, RADIUS_MIN_PX), float(lens.height))
    return Mark(round(place[0], 1), round(place[1], 1), round(radius, 1), range_text(seen))


def _place(lens: Lens, ray_K: rotation.Vector) -> tuple[float, float] | None:
    """Return the pixel of a ray, None where it is not on the picture.

    A polynomial of distortion folds over far outside of the field of view: a ray from there has a pixel on the picture
    that is that of another ray.
    """
    x, y, z = ray_K
    if z <= NORM_MIN * rotation.norm(ray_K):
        return None
    u, v = pixel(lens, x / z, y / z, 1.0)
    if not (-0.5 <= u <= lens.width - 0.5 and -0.5 <= v <= lens.height - 0.5):
        return None
    back = undistorted(lens, u, v)
    return (u, v) if math.dist(back, (x / z, y / z)) <= FOLD_MAX else None


def range_text(seen: Seen) -> str:
    """Return a range with its sigma: `4.1 ± 0.2 m`."""
    digits = 1 if seen.sigma_range_m >= 0.1 else 2
    return f"{seen.range_m:.{digits}f} ± {seen.sigma_range_m:.{digits}f} m"
