"""Balls: the hats, and obstacles that are spheres. Each pixel is covered as far as its ray meets the ball. Pure.

A ray belongs to a ball if it passes its centre nearer than the radius: exact for any place in the picture and any lens,
and smooth over one pixel at the edge, so that the centre of what is drawn is the centre of what is projected.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim_agents.cameras.rendering.view import View

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Field = NDArray[np.float32]
AMBIENT, DIFFUSE = 0.72, 0.28  # shares of the light from the sky and from the sun; chosen: matt foam outdoors
STEPS_MAX = 6  # instants of an exposure that are drawn of what moves over the picture
STEP_PX = 0.8  # px between two of them
HALF = np.float32(0.5)
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


def draw_ball(picture: Picture, view: View, ball: Ball, sun_K: Array) -> None:
    """Draw a ball as it is seen over an exposure."""
    x, y, z = ball.centre_K.tolist()
    radius = ball.radius_m
    if z < radius + NEAR_M:
        return
    wide_px = view.lens.fx * radius / (z - radius) * (1 + math.hypot(x, y) / z)
    box = view.box(ball.pixel, 1.5 + ball.way_px / 2 + wide_px)
    if box is None:
        return
    u0, v0, u1, v1 = box
    covered, shade = _cover(view, view.rays[v0:v1, u0:u1], ball, sun_K)
    part = picture[v0:v1, u0:u1]
    colour = shade[..., None] * ball.colour.astype(np.float32)
    colour -= part
    colour *= covered[..., None]
    colour += part
    part[:] = colour + HALF  # rounded


def exposures(steps: int) -> Array:
    """Return the instants of an exposure that are drawn, as shares of it from its middle."""
    return (np.arange(steps) + 0.5) / steps - 0.5


def steps_of(way_px: float, step_px: float) -> int:
    """Return at how many instants of the exposure something is drawn that goes so far over the picture."""
    return min(STEPS_MAX, max(1, math.ceil(way_px / step_px)))


def _cover(view: View, rays: Field, ball: Ball, sun_K: Array) -> tuple[Field, Field]:
    """Return the share of each pixel that is covered, and how bright the ball is there (1: under the sun), (h, w)."""
    centre, radius = ball.centre_K, np.float32(ball.radius_m)
    away2 = float(centre @ centre)
    products = rays @ np.stack([centre, sun_K], axis=-1).astype(np.float32)
    along, to_sun = products[..., 0], products[..., 1]
    inside: Field = (along * along + (ball.radius_m**2 - away2)).astype(
        np.float32, copy=False
    )  # of half the chord, squared
    per_pixel = np.float32(view.lens.fx / math.sqrt(away2)) / (
        rays[..., 2] * np.sqrt(rays[..., 2])
    )  # px/m, mean of both
    steps = steps_of(ball.way_px, STEP_PX)
    if steps == 1:
        covered = _edge(radius, inside, per_pixel)
    else:
        covered = np.zeros_like(per_pixel)
        for share in exposures(steps):
            moved = centre + share * ball.way_K
            nearer = rays @ moved.astype(np.float32)
            covered += _edge(radius, np.float32(ball.radius_m**2 - moved @ moved) + nearer * nearer, per_pixel)
        covered /= np.float32(steps)
    meets = along - np.sqrt(np.maximum(inside, 0))
    cosine = (meets * to_sun - np.float32(centre @ sun_K)) * np.float32(DIFFUSE / ball.radius_m)
    return covered, np.float32(AMBIENT) + np.minimum(np.maximum(cosine, 0), np.float32(DIFFUSE))


def _edge(radius: np.float32, inside: Field, per_pixel: Field) -> Field:
    """Return the share of each pixel that is covered: by how far its ray passes within the radius."""
    beside = np.sqrt(np.maximum(radius * radius - inside, 0))
    return np.minimum(np.maximum(HALF + (radius - beside) * per_pixel, 0), 1)
