"""Balls: the hats, and obstacles that are spheres. Each pixel is covered as far as its ray meets the ball. Pure.

A ray belongs to a ball if it passes its centre nearer than the radius: exact for any place in the picture and any lens,
and smooth over one pixel at the edge, so that the centre of what is drawn is the centre of what is projected.
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
Field = NDArray[np.float32]
AMBIENT, DIFFUSE = 0.72, 0.28  # shares of the light from the sky and from the sun; chosen: matt foam outdoors
STEPS_MAX = 6  # instants of an exposure that are drawn of what moves over the picture
STEP_PX = 0.8  # px between two of them
ROUNDING = np.float32(0.5)
AXIS = np.array([0.0, 0.0, 1.0])
NEAR_M = 0.05  # nothing nearer is drawn


class Ball(NamedTuple):
    """A ball.

    Attributes:
        centre_K: its centre [m; K], (3,).
        way_K: how the centre moves during the exposure [m; K], (3,).
        pixel: of the centre, (2,).
        way_px: its way over the picture during the exposure [px].
        radius_m: its radius.
        colour: B, G, R, (3,).
    """

    centre_K: Array
    way_K: Array
    pixel: Array
    way_px: float
    radius_m: float
    colour: Array


class Balls(NamedTuple):
    """M balls of one size and colour, as of `Ball`: (M, 3), (M, 3), (M, 2), (M,)."""

    centres_K: Array
    ways_K: Array
    pixels: Array
    ways_px: Array
    radius_m: float
    colour: Array


class BallImage(NamedTuple):
    """What a ball makes of a part of the picture.

    Attributes:
        box: the part, u0, v0, u1, v1.
        light: what comes from the ball, and a half, by which it is rounded, (h, w, 3).
        passes: the share that comes from behind it, (h, w, 1).
    """

    box: list[int]
    light: Field
    passes: Field

    def lay(self, picture: Picture) -> None:
        """Draw it."""
        u0, v0, u1, v1 = self.box
        part = picture[v0:v1, u0:u1]
        part[:] = part * self.passes + self.light


def draw_ball(picture: Picture, view: View, ball: Ball, sun_K: Array) -> None:
    """Draw a ball as it is seen over an exposure."""
    way_px = np.array([ball.way_px])
    one = Balls(ball.centre_K[None], ball.way_K[None], ball.pixel[None], way_px, ball.radius_m, ball.colour)
    for image in ball_images(view, one, sun_K).values():
        image.lay(picture)


def ball_images(view: View, balls: Balls, sun_K: Array) -> dict[int, BallImage]:
    """Return what balls make of the picture over an exposure, by their numbers; of those that are in it.

    All pixels that may be a ball's are computed in one row, at the instants of the ball that moves most, since the
    balls are many and small.
    """
    boxes = _boxes(view, balls)
    if not boxes:
        return {}
    shown, radius = list(boxes), balls.radius_m
    centres, ways = balls.centres_K[shown], balls.ways_K[shown]
    pixels = _pixels(view, [*boxes.values()], centres, ways, sun_K)
    steps = min(STEPS_MAX, max(1, math.ceil(balls.ways_px[shown].max() / STEP_PX)))
    covered = _covered(pixels, centres, ways, radius, view.lens.fx, steps)
    shade = _shade(pixels, centres, radius, sun_K)
    light = (covered * shade)[:, None] * balls.colour.astype(np.float32) + ROUNDING
    return _split(boxes, light, (1 - covered)[:, None])


class _Pixels(NamedTuple):
    """The rays of the pixels of some balls, one ball after the other, by their parts along four vectors, (P,) each."""

    along: Field
    to_way: Field
    to_sun: Field
    to_axis: Field
    counts: list[int]

    def of_ball(self, values: Array) -> Field:
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


def _boxes(view: View, balls: Balls) -> dict[int, list[int]]:
    """Return the parts of the picture in which the balls are that it has, by their numbers."""
    x, y, z = balls.centres_K.T
    radius = balls.radius_m
    before = z >= radius + NEAR_M
    wide_px = view.lens.fx * radius / np.where(before, z - radius, np.inf) * (1 + np.hypot(x, y) / z)
    reach = (1.5 + balls.ways_px / 2 + wide_px)[:, None]
    boxes = view.boxes(balls.pixels - reach, balls.pixels + reach)
    return {i: box for i, box in enumerate(boxes) if before[i] and has_pixels(box)}


def _split(boxes: dict[int, list[int]], light: Field, passes: Field) -> dict[int, BallImage]:
    images: dict[int, BallImage] = {}
    start = 0
    for i, box in boxes.items():
        wide, high = box[2] - box[0], box[3] - box[1]
        end = start + wide * high
        images[i] = BallImage(box, light[start:end].reshape(high, wide, 3), passes[start:end].reshape(high, wide, 1))
        start = end
    return images


def _covered(pixels: _Pixels, centres: Array, ways: Array, radius: float, focal_px: float, steps: int) -> Field:
    """Return the share of each pixel that is covered: by how far its ray passes within the radius, as a mean."""
    shares = ((np.arange(steps) + 0.5) / steps - 0.5)[:, None]  # of the exposure, from its middle
    moved = centres + shares[..., None] * ways
    away2 = (moved * moved).sum(axis=-1)
    along = pixels.along + shares.astype(np.float32) * pixels.to_way
    beside2 = pixels.of_ball(away2) - along * along
    px_per_m = pixels.of_ball(focal_px / np.sqrt((centres * centres).sum(axis=-1)))
    px_per_m /= pixels.to_axis * np.sqrt(pixels.to_axis)  # mean of both directions
    within = (np.float32(radius) - np.sqrt(np.maximum(beside2, 0))) * px_per_m
    return np.minimum(np.maximum(within + ROUNDING, 0), 1).mean(axis=0)


def _shade(pixels: _Pixels, centres: Array, radius: float, sun_K: Array) -> Field:
    """Return how bright the ball is at each pixel; 1: under the sun."""
    rest = pixels.of_ball(radius**2 - (centres * centres).sum(axis=-1))
    meets = pixels.along - np.sqrt(np.maximum(pixels.along * pixels.along + rest, 0))
    cosine = (meets * pixels.to_sun - pixels.of_ball(centres @ sun_K)) * np.float32(DIFFUSE / radius)
    return np.float32(AMBIENT) + np.minimum(np.maximum(cosine, 0), np.float32(DIFFUSE))


SHIFT = 4  # fractional bits of OpenCV's coordinates: sixteenths of a pixel
FAR_PX = 16_000.0  # px, beyond which coordinates are cut: they are 32 bits with the fraction, and lines have to end
SIDES = 24  # of a cylinder
STILL = np.zeros(3)
PIECES = 8  # of an edge that a lens bends
OBSTACLE = np.array([92.0, 118.0, 146.0])  # B, G, R, chosen: weathered wood; never magenta


def draw_obstacle(
    picture: Picture, view: View, row: tuple[float, ...], motion: CameraMotion, brightness: float
) -> None:
    """Draw an obstacle, a row of zsim.scenario.obstacle."""
    if row[SHAPE] == SPHERE:
        centre = motion.points_K(np.array(row[CENTRE : CENTRE + 3]))
        if centre[2] > 0:
            ball = Ball(centre, STILL, view.pixels(centre), 0.0, row[HALF], brightness * OBSTACLE)
            draw_ball(picture, view, ball, SUN_W @ motion.R_WK)
        return
    for corners, normal in _faces(row):
        if normal @ (motion.p_WK - corners[0]) > 0:
            shade = brightness * (AMBIENT - 0.15 + (DIFFUSE + 0.15) * max(0.0, float(normal @ SUN_W)))
            fill(picture, view, motion.points_K(corners), shade * OBSTACLE)


@lru_cache(maxsize=1000)
def _faces(row: tuple[float, ...]) -> tuple[tuple[Array, Array], ...]:
    """Return the upright faces and the top of a box or cylinder: corners (M, 3) and the normal (3,), in W."""
    if row[SHAPE] == BOX:
        outline = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]) * row[HALF : HALF + 2]
    else:
        angles = 2 * math.pi * np.arange(SIDES) / SIDES
        outline = row[HALF] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    c, s = row[COSINE], row[SINE]
    foot = outline @ np.array([[c, s], [-s, c]]) + row[CENTRE : CENTRE + 2]
    low, high = row[CENTRE + 2] - row[HALF + 2], row[CENTRE + 2] + row[HALF + 2]
    faces = [(np.column_stack([foot, np.full(len(foot), high)]), np.array([0.0, 0.0, 1.0]))]
    for a, b in zip(foot, np.roll(foot, -1, axis=0), strict=True):
        corners = np.array([(*a, low), (*b, low), (*b, high), (*a, high)])
        dx, dy = b - a
        faces.append((corners, np.array([dy, -dx, 0.0]) / math.hypot(dx, dy)))
    return tuple(faces)


def fill(picture: Picture, view: View, corners_K: Array, colour: Array) -> None:
    """Fill a convex face, given by its corners (M, 3) [m; K], with a colour (B, G, R)."""
    seen = in_front(corners_K)
    if len(seen) < 3:
        return
    outline = view.pixels(_in_pieces(seen) if view.distorts else seen)
    lowest, highest = outline.min(axis=0), outline.max(axis=0)
    if (highest < 0).any() or lowest[0] > view.lens.width or lowest[1] > view.lens.height:
        return
    cv2.fillPoly(picture, [fixed(outline)], bgr(colour), cv2.LINE_AA, SHIFT)


def in_front(corners: Array) -> Array:
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
    """Return pixels as OpenCV takes them, with SHIFT fractional bits."""
    return np.rint(np.clip(pixels, -FAR_PX, FAR_PX) * (1 << SHIFT)).astype(np.int32)


def bgr(colour: Array) -> tuple[float, float, float]:
    """Return a colour as OpenCV takes it."""
    b, g, r = colour.tolist()
    return round(b), round(g), round(r)


def _in_pieces(corners: Array) -> Array:
    ends = np.roll(corners, -1, axis=0)
    shares = np.arange(PIECES)[:, None] / PIECES
    return (corners[:, None] + shares * (ends - corners)[:, None]).reshape(-1, 3)
