"""Finds magenta hats in a picture, from zsim or from a real camera: bearing and range of each, and how sure. Pure.

How magenta a pixel is is a number that is linear where a hat mixes with grass, sky or hull, and nothing for orange:
the share of a pixel that a hat covers is that number over the hat's own. Its direction is the middle of what it
covers on the sphere of directions, its range follows from how much that is: a ball of radius r at a distance d covers
2 pi (1 - cos a) with sin a = r / d, wherever in the picture it is.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.contract.camera_messages import Seen
from zsim.sensors.camera_model import CameraPose, Lens
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
LOST = 1.026  # of a covered area over what is measured of it: noise and shade are cut at the full share; calibrated
ROUND = 0.92  # of one that nothing hides and no motion blurs; rounder ones are as good
DIRECTION_PX = 0.075, 0.002  # standard deviation of a centre [px] of a small one, and per diameter; calibrated
DIAMETER_PX = 0.12, 0.006, 0.8  # of a diameter [px]: at least, per diameter, and per 1/diameter; calibrated
DIAMETER_MIN_PX = 4.0  # px; the range of smaller ones errs to one side, by more than its sigma says
WHOLE = 0.93  # of the area of what is magenta over that of its convex hull, of one that nothing crosses
OVAL = 0.25, 0.5  # of a diameter, per lack of roundness: of centre and diameter; calibrated

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
    """A hat in the picture: the sum of what it covers times rays (3,), solid angle [sr], and its figures in pixels."""

    ray_sum: Array
    solid_angle_sr: float
    sigma_centre_px: float
    sigma_diameter_px: float
    diameter_px: float


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
        along = np.gradient(self._rays, axis=1), np.gradient(self._rays, axis=0)
        self._solid = np.linalg.norm(np.cross(*along), axis=-1).astype(np.float32)  # sr, of each pixel
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
        frame = np.concatenate([level[0], level[-1], level[1:-1, 0], level[1:-1, -1]])
        behind = float(np.median(frame))
        noise = 1.48 * float(np.median(np.abs(frame - behind)))  # of a normal distribution
        level -= np.float32(behind)
        return _measured(level, noise, self._rays[part], self._solid[part], self._lens.fx)

    def _sighting(self, blob: Blob) -> Seen:
        direction_K = blob.ray_sum / np.linalg.norm(blob.ray_sum)
        cosine = 1 - blob.solid_angle_sr / (2 * math.pi)
        range_m = self._radius_m / math.sqrt(max(1 - cosine * cosine, 1e-12))
        per_px = float(direction_K[2]) / self._lens.fx  # rad; between those across and along the way to the middle
        x, y, z = (self._R_BK @ direction_K).tolist()
        sigma_range_m = range_m * blob.sigma_diameter_px / blob.diameter_px
        return Seen((x, y, z), range_m, blob.sigma_centre_px * per_px, sigma_range_m)


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


def _measured(level: Field, noise: float, rays: Field, solid: Field, focal_px: float) -> Blob | None:
    """Return the hat of which each pixel has a level over what is behind it, (h, w)."""
    mean = cv2.blur(level, (3, 3), borderType=cv2.BORDER_REPLICATE)
    v, u = divmod(int(np.argmax(mean)), level.shape[1])
    peak = float(mean[v, u])
    if peak < max(LEVEL_MIN / 2, 2 * noise / 3):  # the mean of nine has a third of the noise
        return None
    core = (level > CORE * peak).astype(np.uint8)
    near = cv2.dilate(core, SQUARE_5).astype(np.uint8)
    covered = _shares(level, core, near, peak)
    weights = (covered * solid).astype(np.float64)
    solid_angle = LOST * float(weights.sum())
    area = float(covered.sum())
    if not 0 < solid_angle < math.pi or area < 1:
        return None
    oblique = float(rays[v, u, 2]) ** 2  # variance of a round one in the plane of the picture: cos^2 off the axis
    roundness = min(1.0, _roundness(covered, area) / oblique)
    if roundness < ROUND_MIN:
        return None
    lack = max(0.0, ROUND - roundness) + max(0.0, WHOLE - _wholeness(core))
    diameter = 2 * math.sqrt(area / math.pi)
    if diameter < DIAMETER_MIN_PX:
        return None
    count = float(near.sum())
    of_noise = noise * math.sqrt(count) / (peak * area)  # of the covered area, relative
    ray_sum = np.tensordot(weights, rays, axes=((0, 1), (0, 1)))
    centre_px = math.hypot(
        DIRECTION_PX[0], DIRECTION_PX[1] * diameter, of_noise * math.sqrt(count / 6), OVAL[0] * lack * diameter
    )
    floor, share, small = DIAMETER_PX
    diameter_px = math.hypot(
        floor, share * diameter, small / diameter, of_noise * diameter / 2, OVAL[1] * lack * diameter
    )
    return Blob(ray_sum, solid_angle, centre_px, diameter_px, diameter)


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


def _roundness(covered: Field, area: float) -> float:
    """Return the smaller variance of what is covered over the larger."""
    moments = cv2.moments(covered)
    uu, vv, uv = moments["mu20"] / area, moments["mu02"] / area, moments["mu11"] / area
    middle, half = (uu + vv) / 2, math.hypot((uu - vv) / 2, uv)
    return (middle - half) / max(middle + half, 1e-9)


def _wholeness(core: Picture) -> float:
    """Return the area of a blob over that of its convex hull."""
    hull = cv2.convexHull(cv2.findNonZero(core))
    area = cv2.contourArea(hull) + cv2.arcLength(hull, True) / 2 + 1  # through the middles of the outermost pixels
    return float(core.sum()) / area
