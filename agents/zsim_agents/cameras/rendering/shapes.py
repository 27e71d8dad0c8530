"""Balls and flat faces in the picture: hats and obstacles. Pure.

A ray belongs to a ball if it passes the centre nearer than the radius. This is exact anywhere in the picture and for
any lens, and smooth over one pixel at the edge, so that the centre of what is drawn is the projected centre. Faces are
clipped in front of the camera, curved by the lens, and shaded by the sun.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.scenario.obstacle import BOX, CENTRE, COSINE, HALF, SHAPE, SINE, SPHERE
from zsim_agents.cameras.rendering.scene import SUN_W, CameraMotion, View, has_pixels

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Levels = NDArray[np.float32]
AMBIENT, DIFFUSE = 0.72, 0.28  # shares of the light from the sky and from the sun; chosen: matt foam outdoors
STEPS_MAX = 6  # instants of an exposure that are drawn of a moving ball
STEP_PX = 0.8  # px between two of them
ROUNDING = np.float32(0.5)
AXIS = np.array([0.0, 0.0, 1.0])
NEAR_M = 0.05  # nothing nearer is drawn
SHIFT = 4  # fractional bits of OpenCV's coordinates: sixteenths of a pixel
FAR_PX = 16_000.0  # px; coordinates beyond are clipped: they have 32 bits with the fraction, and lines have to end
SIDES = 24  # of a cylinder
PIECES = 8  # of an edge that the lens bends
OBSTACLE = np.array([92.0, 118.0, 146.0])  # B, G, R, chosen: weathered wood; never magenta


class BallImage(NamedTuple):
    """A ball in a part of the picture.

    Attributes:
        box: the part, u0, v0, u1, v1.
        light: from the ball, plus a half for rounding, (h, w, 3).
        passes: the share of light from behind, (h, w, 1).
    """

    box: list[int]
    light: Levels
    passes: Levels

    def draw(self, picture: Picture) -> None:
        u0, v0, u1, v1 = self.box
        part = picture[v0:v1, u0:u1]
        part[:] = part * self.passes + self.light


def ball_images(
    view: View, centres_K: Array, ways_K: Array, radius_m: float, colour: Array, sun_K: Array
) -> dict[int, BallImage]:
    """Return the images over an exposure of those balls that are in the picture, by their index.

    All pixels that may be covered are computed in one array, at the instants of the ball that moves most, because balls
    are many and small.

    Args:
        centres_K, ways_K: centres and their motion during the exposure, (M, 3) [m; K].
        radius_m: of all balls.
        colour: B, G, R of all balls, (3,).
        sun_K: unit vector to the sun, (3,).
    """
    if not len(centres_K):
        return {}
    ways_px = np.hypot(*view.flow_px(centres_K, ways_K).T)
    boxes = _boxes(view, centres_K, ways_px, radius_m)
    if not boxes:
        return {}
    shown = list(boxes)
    centres, ways = centres_K[shown], ways_K[shown]
    pixels = _pixels(view, [*boxes.values()], centres, ways, sun_K)
    steps = min(STEPS_MAX, max(1, math.ceil(ways_px[shown].max() / STEP_PX)))
    covered = _covered(pixels, centres, ways, radius_m, view.lens.fx, steps)
    light = (covered * _shade(pixels, centres, radius_m, sun_K))[:, None] * colour.astype(np.float32) + ROUNDING
    passes = (1 - covered)[:, None]
    images: dict[int, BallImage] = {}
    start = 0
    for (i, box), count in zip(boxes.items(), pixels.counts, strict=True):
        size, part = (box[3] - box[1], box[2] - box[0]), slice(start, start + count)
        images[i] = BallImage(box, light[part].reshape(*size, 3), passes[part].reshape(*size, 1))
        start += count
    return images


def _boxes(view: View, centres_K: Array, ways_px: Array, radius_m: float) -> dict[int, list[int]]:
    """Return the parts of the picture that contain balls, by their index."""
    x, y, z = centres_K.T
    before = z >= radius_m + NEAR_M
    wide_px = view.lens.fx * radius_m / np.where(before, z - radius_m, np.inf) * (1 + np.hypot(x, y) / z)
    reach, pixels = (1.5 + ways_px / 2 + wide_px)[:, None], view.pixels(centres_K)
    boxes = view.boxes(pixels - reach, pixels + reach)
    return {i: box for i, box in enumerate(boxes) if before[i] and has_pixels(box)}


class _Pixels(NamedTuple):
    """Components of the rays of all balls' pixels, one ball after the other, along four vectors, (P,) each."""

    along: Levels
    to_way: Levels
    to_sun: Levels
    to_axis: Levels
    counts: list[int]

    def of_ball(self, values: Array) -> Levels:
        """Return values of the balls (..., M) for each pixel, (..., P)."""
        return np.repeat(values.astype(np.float32), self.counts, axis=-1)


def _pixels(view: View, boxes: list[list[int]], centres: Array, ways: Array, sun_K: Array) -> _Pixels:
    vectors = np.empty((len(boxes), 3, 4), np.float32)
    vectors[..., 0], vectors[..., 1], vectors[..., 2], vectors[..., 3] = centres, ways, sun_K, AXIS
    parts = [
        view.rays[v0:v1, u0:u1].reshape(-1, 3) @ each for (u0, v0, u1, v1), each in zip(boxes, vectors, strict=True)
    ]
    along, to_way, to_sun, to_axis = np.concatenate(parts).T
    return _Pixels(along, to_way, to_sun, to_axis, [len(part) for part in parts])


def _covered(pixels: _Pixels, centres: Array, ways: Array, radius: float, focal_px: float, steps: int) -> Levels:
    """Return the share of each pixel that is covered: how far its ray passes within the radius, averaged over time."""
    shares = ((np.arange(steps) + 0.5) / steps - 0.5)[:, None]  # of the exposure, from its middle
    moved = centres + shares[..., None] * ways
    away2 = (moved * moved).sum(axis=-1)
    along = pixels.along + shares.astype(np.float32) * pixels.to_way
    beside2 = pixels.of_ball(away2) - along * along
    px_per_m = pixels.of_ball(focal_px / np.sqrt((centres * centres).sum(axis=-1)))
    px_per_m /= pixels.to_axis * np.sqrt(pixels.to_axis)  # mean of both directions
    within = (np.float32(radius) - np.sqrt(np.maximum(beside2, 0))) * px_per_m
    return np.minimum(np.maximum(within + ROUNDING, 0), 1).mean(axis=0)


def _shade(pixels: _Pixels, centres: Array, radius: float, sun_K: Array) -> Levels:
    """Return the brightness of the ball at each pixel; 1 directly under the sun."""
    rest = pixels.of_ball(radius**2 - (centres * centres).sum(axis=-1))
    meets = pixels.along - np.sqrt(np.maximum(pixels.along * pixels.along + rest, 0))
    cosine = (meets * pixels.to_sun - pixels.of_ball(centres @ sun_K)) * np.float32(DIFFUSE / radius)
    return np.float32(AMBIENT) + np.minimum(np.maximum(cosine, 0), np.float32(DIFFUSE))


def draw_obstacle(
    picture: Picture, view: View, row: tuple[float, ...], motion: CameraMotion, brightness: float
) -> None:
    """Draw an obstacle, a row of zsim.scenario.obstacle."""
    if row[SHAPE] == SPHERE:
        centre_K = motion.points_K(np.array([row[CENTRE : CENTRE + 3]]))
        if centre_K[0, 2] > 0:
            still, colour = np.zeros((1, 3)), brightness * OBSTACLE
            for image in ball_images(view, centre_K, still, row[HALF], colour, SUN_W @ motion.R_WK).values():
                image.draw(picture)
        return
    for corners, normal in _faces(row):
        if normal @ (motion.p_WK - corners[0]) > 0:
            shade = brightness * (AMBIENT - 0.15 + (DIFFUSE + 0.15) * max(0.0, float(normal @ SUN_W)))
            _fill(picture, view, motion.points_K(corners), shade * OBSTACLE)


@lru_cache(maxsize=1000)
def _faces(row: tuple[float, ...]) -> tuple[tuple[Array, Array], ...]:
    """Return the upright faces and the top of a box or cylinder: corners (M, 3) and normal (3,) in W."""
    if row[SHAPE] == BOX:
        outline = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]) * row[HALF : HALF + 2]
    else:
        angles = 2 * math.pi * np.arange(SIDES) / SIDES
        outline = row[HALF] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    c, s = row[COSINE], row[SINE]
    foot = outline @ np.array([[c, s], [-s, c]]) + row[CENTRE : CENTRE + 2]
    low, high = row[CENTRE + 2] - row[HALF + 2], row[CENTRE + 2] + row[HALF + 2]
    faces = [(np.column_stack([foot, np.full(len(foot), high)]), AXIS)]
    for a, b in zip(foot, np.roll(foot, -1, axis=0), strict=True):
        corners = np.array([(*a, low), (*b, low), (*b, high), (*a, high)])
        dx, dy = b - a
        faces.append((corners, np.array([dy, -dx, 0.0]) / math.hypot(dx, dy)))
    return tuple(faces)


def _fill(picture: Picture, view: View, corners_K: Array, colour: Array) -> None:
    """Fill a convex face, given by its corners (M, 3) [m; K]."""
    seen = _in_front(corners_K)
    if len(seen) < 3:
        return
    if view.distorts:  # edges are curves
        steps = (np.roll(seen, -1, axis=0) - seen)[:, None]
        seen = (seen[:, None] + np.arange(PIECES)[:, None] / PIECES * steps).reshape(-1, 3)
    outline = view.pixels(seen)
    lowest, highest = outline.min(axis=0), outline.max(axis=0)
    if (highest < 0).any() or lowest[0] > view.lens.width or lowest[1] > view.lens.height:
        return
    cv2.fillPoly(picture, [fixed(outline)], bgr(colour), cv2.LINE_AA, SHIFT)


def _in_front(corners: Array) -> Array:
    """Return the part of a convex face in front of the camera, as corners (M, 3) [m; K]."""
    depth = corners[:, 2] - NEAR_M
    if (depth > 0).all():
        return corners
    kept: list[Array] = []
    for i, here in enumerate(depth):
        j = (i + 1) % len(corners)
        if here > 0:
            kept.append(corners[i])
        if (here > 0) != (depth[j] > 0):
            kept.append(corners[i] + (corners[j] - corners[i]) * (here / (here - depth[j])))
    return np.array(kept).reshape(-1, 3)


def fixed(pixels: Array) -> NDArray[np.int32]:
    """Return pixels as OpenCV's fixed-point numbers with SHIFT fractional bits."""
    return np.rint(np.clip(pixels, -FAR_PX, FAR_PX) * (1 << SHIFT)).astype(np.int32)


def bgr(colour: Array) -> tuple[float, float, float]:
    """Return a colour as OpenCV's scalar."""
    b, g, r = colour.tolist()
    return round(b), round(g), round(r)
