"""Finds magenta hats in a picture, from zsim or from a real camera: bearing and range of each, and how sure. Pure.

How magenta a pixel is is a number that is linear where a hat mixes with grass, sky or hull, and nothing for orange:
the share of a pixel that a hat covers is that number over the hat's own. Direction and range follow from the circle of
its outline, of which rotors may hide a part: a ball of radius r at a distance d has an apparent radius a with
sin a = r / d, wherever in the picture it is.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.contract.flight_messages import Seen
from zsim.sensors.camera_model import CameraPose, Lens
from zsim_agents.cameras.hat_outline import WHOLE_CENTRE, Outline, outline
from zsim_agents.cameras.rendering.view import View

Picture = NDArray[np.uint8]
Field = NDArray[np.float32]
Array = NDArray[np.float64]

LEVEL_MIN = 24  # of 255, of R - G: below it is noise
SHARE_MIN = 0.3  # of R - G over R: less is no magenta
BLUE_SHARE = 0.2  # of B - G over R - G: less is orange or red; the paper's magenta has 0.59
BLUE_WEIGHT = 1.5  # of what is missing of it, taken off
AREA_MIN_PX = 2  # at half of the resolution
BLOBS_MAX = 100  # the largest; more are no hats
ROOM_PX = 4  # about a blob, for its edge and what is behind it
CORE = 0.5  # of the most magenta, from which on a pixel is a hat's
CORE_MIN_PX = 12  # of pixels that a hat covers wholly; with fewer its own colour is taken from how blurred it is
BLUR_PX2 = 1.1  # px^2, variance of what lens, pixel, JPEG and a mean of nine make of a point; calibrated
ROUND_MIN = 0.3  # of the smaller variance over the larger; less is no ball
PIECE_GAP = 0.3  # of a ball's size, between two pieces of it; a guard before it is 0.2 wide
SHARE_OF_EDGE_MIN = 0.3  # visible; of less the circle is not known
DIAMETER_MIN_PX = 4.0  # px; the range of smaller ones errs to one side, by more than its sigma says
# Standard deviations, calibrated: px per px by which edge points are off, and px^2 over the diameter. Of a centre the
# second counts as far as a part is hidden, and px^3 over the diameter's square are added; of a diameter, px are.
CENTRE = 2.0, 6.5, 8.0
DIAMETER = 2.0, 4.6, 0.1

_x = np.linspace(1e-3, 60, 6000)
_PEAK = (1 - np.exp(-_x)) / _x  # of a blurred disc's middle over its own colour, times 1 / x, by x = r^2 / 2 s^2


class Box(NamedTuple):
    """A part of a picture: its upper left corner and its size [px]."""

    u: int
    v: int
    wide: int
    high: int

    def touches(self, other: "Box") -> bool:
        """Tell whether the other one is a piece of the same ball: nearer than a part of this one's size."""
        gap = 1 + PIECE_GAP * max(self.wide, self.high)
        across = max(self.u, other.u) - min(self.u + self.wide, other.u + other.wide)
        down = max(self.v, other.v) - min(self.v + self.high, other.v + other.high)
        return max(across, down) <= gap

    def with_other(self, other: "Box") -> "Box":
        """Return the part that holds both."""
        u, v = min(self.u, other.u), min(self.v, other.v)
        right, low = max(self.u + self.wide, other.u + other.wide), max(self.v + self.high, other.v + other.high)
        return Box(u, v, right - u, low - v)


class Blob(NamedTuple):
    """A hat in the picture: its circle, its size [px], and pixels per radian there."""

    circle: Outline
    diameter_px: float
    scale: float

    def sigmas_px(self) -> tuple[float, float]:
        """Return the standard deviations of the centre, per axis, and of the diameter."""
        circle, size, rough = self.circle, self.diameter_px, self.circle.rough_px
        hidden = max(0.0, circle.centre - WHOLE_CENTRE)
        centre = math.hypot(CENTRE[0] * circle.centre * rough, CENTRE[1] * hidden / size, CENTRE[2] / size**2)
        return centre, math.hypot(2 * circle.radius * math.hypot(DIAMETER[0] * rough, DIAMETER[1] / size), DIAMETER[2])


class HatDetector:
    """Finds hats in the pictures of one camera.

    Args:
        lens: of the camera.
        pose: of the camera in the body.
        diameter_m: of a hat.
    """

    def __init__(self, lens: Lens, pose: CameraPose, diameter_m: float) -> None:
        self._lens, self._R_BK, self._radius_m = lens, pose.R_BK, diameter_m / 2
        self._rays = View(lens).rays
        self._half = max(1, lens.width // 2), max(1, lens.height // 2)

    def seen(self, picture: Picture) -> tuple[Seen, ...]:
        """Return the hats in a picture of B, G, R, (height, width, 3), the largest first.

        Raises:
            ValueError: the picture has another size than the camera.
        """
        size = picture.shape[1], picture.shape[0]
        if size != (self._lens.width, self._lens.height):
            raise ValueError(f"picture is {size[0]} x {size[1]}; must be {self._lens.width} x {self._lens.height}")
        blobs = [self._blob(picture, box) for box in self._boxes(picture)]
        return tuple(self._sighting(blob) for blob in blobs if blob is not None)

    def _boxes(self, picture: Picture) -> list[Box]:
        """Return where something is magenta, at half of the resolution."""
        blue, green, red = cv2.split(cv2.resize(picture, self._half, interpolation=cv2.INTER_AREA))
        level = cv2.subtract(red, green)
        strong = cv2.addWeighted(level, 1.0, red, -SHARE_MIN, 0.5 - LEVEL_MIN)
        bluish = cv2.subtract(blue, green)
        mask = cv2.min(strong, cv2.addWeighted(bluish, 1.0, level, -BLUE_SHARE, 0.0))
        outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        boxes = [Box(*cv2.boundingRect(outline)) for outline in outlines]
        large = [box for box in boxes if box.wide * box.high >= AREA_MIN_PX]
        return joined(sorted(large, key=lambda box: (-box.wide * box.high, box))[:BLOBS_MAX])

    def _blob(self, picture: Picture, box: Box) -> Blob | None:
        """Return the hat in a box of the picture at half of its resolution; None if it is none, or not all of it."""
        u, v, wide, high = (2 * side for side in box)
        room = ROOM_PX + max(wide, high) // 6
        u0, v0, u1, v1 = u - room, v - room, u + wide + room, v + high + room
        if u <= 2 or v <= 2 or u + wide >= self._lens.width - 2 or v + high >= self._lens.height - 2:
            return None  # a part of a hat tells neither bearing nor range
        part = slice(max(v0, 0), v1), slice(max(u0, 0), u1)
        level = magenta(picture[part])
        sides = level[0], level[-1], level[1:-1, 0], level[1:-1, -1]
        behind = float(np.median(np.concatenate(sides)))
        noise = min(_deviation(side) for side in sides)  # of those that no hull crosses
        level -= np.float32(behind)
        return _outlined(level, noise, self._rays[part], self._lens.fx)

    def _sighting(self, blob: Blob) -> Seen:
        centre_px, diameter_px = blob.sigmas_px()
        range_m = self._radius_m / math.sin(blob.circle.radius_rad)
        x, y, z = (self._R_BK @ blob.circle.ray).tolist()
        return Seen((x, y, z), range_m, centre_px / blob.scale, range_m * diameter_px / blob.diameter_px)


def _deviation(values: Field) -> float:
    """Return the standard deviation of normally distributed values, of which some are not."""
    return 1.48 * float(np.median(np.abs(values - np.median(values))))


def joined(boxes: list[Box]) -> list[Box]:
    """Return boxes, the largest first, with the pieces of one ball, which a rotor guard crosses, as one."""
    whole: list[Box] = []
    for box in boxes:
        for i, other in enumerate(whole):
            if other.touches(box):
                whole[i] = other.with_other(box)
                break
        else:
            whole.append(box)
    return whole


def magenta(picture: Picture) -> Field:
    """Return how magenta each pixel is, (h, w): R - G, less where too little blue is in it."""
    blue, green, red = (channel.astype(np.float32) for channel in cv2.split(picture))
    level, bluish = red - green, blue - green
    lack = np.maximum(np.float32(BLUE_SHARE) * level - bluish, 0) * np.float32(BLUE_WEIGHT)
    return np.where(level > 0, np.maximum(level - lack, 0), level)


def _outlined(level: Field, noise: float, rays: Field, focal_px: float) -> Blob | None:
    """Return the hat of which each pixel has a level over what is behind it, (h, w)."""
    mean = cv2.blur(level, (3, 3), borderType=cv2.BORDER_REPLICATE)
    v, u = divmod(int(np.argmax(mean)), level.shape[1])
    peak = float(mean[v, u])
    if peak < max(LEVEL_MIN / 2, 2 * noise / 3):  # the mean of nine has a third of the noise
        return None
    cosine = float(rays[v, u, 2])
    core = (level > CORE * peak).astype(np.uint8)
    near = cv2.dilate(core, SQUARE_5).astype(np.uint8)
    covered = _shares(level, core, near, peak)
    oblique = cosine * cosine  # variance of a round one in the plane of the picture: cos^2 off the axis
    if _roundness(covered) / oblique < ROUND_MIN:
        return None
    scale = focal_px / (cosine * math.sqrt(cosine))  # between those along and across the way to the middle
    circle = outline(covered, noise / peak, rays, scale)
    if not circle.share >= SHARE_OF_EDGE_MIN:
        return None
    diameter_px = 2 * circle.radius_rad * scale
    return Blob(circle, diameter_px, scale) if diameter_px >= DIAMETER_MIN_PX else None


SQUARE_3, SQUARE_5 = (np.ones((side, side), np.uint8) for side in (3, 5))


def _shares(level: Field, core: Picture, near: Picture, peak: float) -> Field:
    """Return the share of each pixel that the hat covers: its level over the hat's own there, which shade changes."""
    inner = cv2.erode(core, SQUARE_3)
    count = int(inner.sum())
    own: Field | float
    if count > CORE_MIN_PX:
        side = 2 * round(math.sqrt(count) / 4) + 5
        total = cv2.blur(level * inner, (side, side), borderType=cv2.BORDER_CONSTANT)
        weight = cv2.blur(inner.astype(np.float32), (side, side), borderType=cv2.BORDER_CONSTANT)
        mean = np.float32((level * inner).sum() / count)
        own = np.where(weight > 1e-3, total / np.maximum(weight, 1e-3), mean)
    else:
        blurred = peak / float((level * near).sum()) * 2 * math.pi * BLUR_PX2
        own = peak / (1 - math.exp(-float(np.interp(-blurred, -_PEAK, _x))))
    return np.clip(level / own, 0, 1) * near


def _roundness(covered: Field) -> float:
    """Return the smaller variance of what is covered over the larger; 0 for nothing."""
    moments = cv2.moments(covered)
    area = moments["m00"]
    if area < 1:
        return 0.0
    uu, vv, uv = moments["mu20"] / area, moments["mu02"] / area, moments["mu11"] / area
    middle, half = (uu + vv) / 2, math.hypot((uu - vv) / 2, uv)
    return (middle - half) / max(middle + half, 1e-9)
