"""Balls: the hats, and obstacles that are spheres. Each pixel is covered as far as its ray meets the ball. Pure.

A ray belongs to a ball if it passes its centre nearer than the radius: exact for any place in the picture and any lens,
and smooth over one pixel at the edge, so that the centre of what is drawn is the centre of what is projected.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim_agents.cameras.rendering.view import View, has_pixels

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Field = NDArray[np.float32]
AMBIENT, DIFFUSE = 0.72, 0.28  # shares of the light from the sky and from the sun; chosen: matt foam outdoors
STEPS_MAX = 6  # instants of an exposure that are drawn of what moves over the picture
STEP_PX = 0.8  # px between two of them
HALF = np.float32(0.5)
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
    light = (covered * shade)[:, None] * balls.colour.astype(np.float32) + HALF
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
    return np.minimum(np.maximum(within + HALF, 0), 1).mean(axis=0)


def _shade(pixels: _Pixels, centres: Array, radius: float, sun_K: Array) -> Field:
    """Return how bright the ball is at each pixel; 1: under the sun."""
    rest = pixels.of_ball(radius**2 - (centres * centres).sum(axis=-1))
    meets = pixels.along - np.sqrt(np.maximum(pixels.along * pixels.along + rest, 0))
    cosine = (meets * pixels.to_sun - pixels.of_ball(centres @ sun_K)) * np.float32(DIFFUSE / radius)
    return np.float32(AMBIENT) + np.minimum(np.maximum(cosine, 0), np.float32(DIFFUSE))
