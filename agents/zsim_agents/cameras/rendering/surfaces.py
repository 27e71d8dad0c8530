"""Surfaces in one camera's picture: triangles of one shade each, seen from both sides. Pure.

They are drawn from the farthest to the nearest by their middles, among drones and obstacles, without smoothed edges, so
that no gap shows between neighbours.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.scenario.triangles import corners_of
from zsim_agents.cameras.rendering.foreground import AMBIENT, DIFFUSE, NEAR_M, bgr, fill_face, fixed
from zsim_agents.cameras.rendering.scene import SHIFT, SUN_W, CameraMotion, View

SURFACE = np.array([102.0, 116.0, 124.0])  # B, G, R, chosen: stone; never magenta
BENT_PX = 24.0  # px, chosen: the lens bends the edges of larger triangles visibly
Array = NDArray[np.float64]


class SurfaceImager:
    """The surfaces before one camera, (T, 9) as in zsim.scenario.triangles."""

    def __init__(self, view: View, triangle: Array, brightness: float) -> None:
        self._view = view
        self._corners_W = corners_of(triangle)
        self._middles_W = self._corners_W.mean(axis=1)
        normals = np.cross(triangle[:, 3:6], triangle[:, 6:])
        self._normals_W = normals / np.linalg.norm(normals, axis=1)[:, None]
        self._brightness = brightness

    def shown(self, motion: CameraMotion) -> list[tuple[float, int]]:
        """Return distance [m] and number of each triangle of which something may be in the picture, and keep them."""
        self._points_K = motion.points_K(self._corners_W)
        z = self._points_K[..., 2]
        ahead = (z > NEAR_M).all(axis=1)
        self._pixels = np.zeros((len(z), 3, 2))
        if ahead.any():
            self._pixels[ahead] = self._view.pixels(self._points_K[ahead])
        low, high = self._pixels.min(axis=1), self._pixels.max(axis=1)
        size = self._view.lens.width, self._view.lens.height
        inside = ahead & (high >= 0.0).all(axis=1) & (low <= size).all(axis=1)
        bent = self._view.distorts & ((high - low).max(axis=1) > BENT_PX)
        self._is_plain = inside & ~bent
        chosen = np.flatnonzero(inside | (~ahead & (z > NEAR_M).any(axis=1)))
        away = self._middles_W[chosen] - motion.p_WK
        faces = np.where((self._normals_W[chosen] * away).sum(axis=1) > 0.0, -1.0, 1.0)  # the side that is seen
        lit = np.maximum(faces * (self._normals_W[chosen] @ SUN_W), 0.0)
        self._shade = np.zeros(len(z))
        self._shade[chosen] = self._brightness * (AMBIENT - 0.15 + (DIFFUSE + 0.15) * lit)
        distance = np.linalg.norm(away, axis=1)
        return list(zip(distance.tolist(), chosen.tolist(), strict=True))

    def draw(self, picture: NDArray[np.uint8], number: int) -> None:
        """Draw one of the triangles that are shown."""
        colour = self._shade[number] * SURFACE
        if self._is_plain[number]:
            cv2.fillConvexPoly(picture, fixed(self._pixels[number]), bgr(colour), cv2.LINE_8, SHIFT)
        else:
            fill_face(picture, self._view, self._points_K[number], colour)
