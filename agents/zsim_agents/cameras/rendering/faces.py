"""Flat faces in the picture: clipped before the camera, curved by the lens, shaded by the sun. Pure."""

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.scenario.obstacle import BOX, CENTRE, COSINE, HALF, SHAPE, SINE, SPHERE
from zsim_agents.cameras.rendering.balls import AMBIENT, DIFFUSE, NEAR_M, Ball, draw_ball
from zsim_agents.cameras.rendering.scene import SUN_W
from zsim_agents.cameras.rendering.view import CameraMotion, View

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
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
