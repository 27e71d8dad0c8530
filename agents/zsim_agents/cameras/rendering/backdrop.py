"""Ground and sky as one grey picture, which a map turns into colours: warping one channel costs a third of three.

Greys up to 150 are the ground's, from HAZE on the sky's. The ground is a square tile about W's origin, repeated,
in levels of decreasing resolution: coarser ones are drawn far away to avoid aliasing.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim_agents.cameras.rendering.scene import SHIFT, CameraMotion, View

Grey = NDArray[np.uint8]
Array = NDArray[np.float64]
Points = list[tuple[float, float]]

TEXEL_M = 0.02  # m, of the finest level, chosen: a blade of grass is not seen, a line of 6 cm is
TILE = 1000  # texels of a side: 20 m, so that lines every metre go on over the seam
FACTORS = (1, 4, 20, 100)  # of the texels of each level over the finest
WINDOW = (3000, 2000, 1500, 1000)  # texels of a side that are kept of each level: 60 m, 160 m, 600 m, 2 km
MINIFIED_MAX = 2.0  # texels that a pixel may be deep on the ground before a coarser level is drawn
HEIGHT_MIN_M = 0.03  # m, of a camera over the ground
HAZE = 176  # grey
ZENITH = 0.6  # sine of the elevation from which on the sky is the bluest; chosen
SKY_SLOPE = (255 - HAZE) / ZENITH  # greys of the sky for a sine of 1
COLOURS = {  # B, G, R by grey; chosen: dry grass, white lines, a hazy blue sky
    0: (24, 36, 30),
    60: (52, 104, 92),
    100: (84, 138, 134),
    150: (226, 234, 232),
    176: (232, 222, 208),
    255: (214, 158, 98),
}


class Level(NamedTuple):
    """A level of the ground: its texels, the side of one, and how far it is drawn [m].

    `place` is the homography (3, 3) from (x, y, 1) of W [m] to texels, whose centres are at whole numbers.
    """

    texels: Grey
    texel_m: float
    reach_m: float
    place: Array


class Ground:
    """A ground in levels.

    Args:
        tile: greys up to 150, a square whose side is a multiple of 100; its middle is W's origin, its top north.
        texel_m: the side of one of its texels.
    """

    def __init__(self, tile: Grey, texel_m: float = TEXEL_M) -> None:
        self.tile_m = texel_m * len(tile)
        self.mean = round(float(tile.mean()))
        self.levels: list[Level] = []
        for factor, window in zip(FACTORS, WINDOW, strict=True):
            side = len(tile) // factor
            mean = tile.reshape(side, factor, side, factor).mean(axis=(1, 3))
            repeats = max(3, 2 * (window // side // 2) + 1)  # odd: W's origin stays in the middle
            texels = np.tile(np.rint(mean).astype(np.uint8), (repeats, repeats))
            scale, middle = 1 / (texel_m * factor), len(texels) / 2 - 0.5
            place = np.array([[scale, 0, middle], [0, -scale, middle], [0, 0, 1.0]])
            self.levels.append(Level(texels, texel_m * factor, self.tile_m * (repeats - 1) / 2, place))


@cache
def meadow() -> Ground:
    """Return a meadow with a line every metre, a wider one every fifth."""
    rng = np.random.default_rng(1)
    patches = sum(_patches(rng, cells) * share for cells, share in ((10, 12.0), (50, 10.0), (250, 8.0), (1000, 9.0)))
    tile = np.clip(70.0 + patches, 15, 110)
    step = round(1 / TEXEL_M)
    for every, width, grey in ((1, 1, 112.0), (5, 3, 144.0)):
        for start in range(0, TILE, every * step):
            at = [(start + k - width // 2) % TILE for k in range(width)]
            tile[at, :] = tile[:, at] = grey
    return Ground(np.rint(tile).astype(np.uint8))


def _patches(rng: np.random.Generator, cells: int) -> Array:
    """Return smooth periodic noise of unit variance over the tile."""
    coarse = np.pad(rng.standard_normal((cells, cells)), 2, mode="wrap")
    wide = TILE // cells
    fine = coarse if wide == 1 else cv2.resize(coarse, None, fx=wide, fy=wide, interpolation=cv2.INTER_CUBIC)
    inner = fine[2 * wide : 2 * wide + TILE, 2 * wide : 2 * wide + TILE]
    return inner / inner.std()


def colour_map(brightness: float) -> Grey:
    """Return B, G, R of each grey, (256, 1, 3)."""
    at = np.arange(256)
    channels = [np.interp(at, list(COLOURS), [colour[k] for colour in COLOURS.values()]) for k in range(3)]
    return np.rint(brightness * np.stack(channels, axis=-1)).astype(np.uint8)[:, None, :]


class Backdrop:
    """Draws ground and sky as a pinhole camera sees them; `view` is without distortion."""

    def __init__(self, view: View, ground: Ground) -> None:
        lens = view.lens
        self._ground = ground
        self._size = lens.width, lens.height
        self._focal_px = lens.fx
        self._K_inv = np.array(
            [[1 / lens.fx, 0, -lens.cx / lens.fx], [0, 1 / lens.fy, -lens.cy / lens.fy], [0, 0, 1.0]]
        )
        self._columns = np.arange(lens.width, dtype=np.float32)
        self._row_numbers = np.arange(lens.height, dtype=np.float32)[:, None]
        self.grey: Grey = np.empty((lens.height, lens.width), np.uint8)
        self._scratch = np.empty_like(self.grey)
        self._mask = np.empty_like(self.grey)

    def draw(self, motion: CameraMotion) -> Grey:
        """Return the picture, owned by this object."""
        height_m = max(float(motion.p_WK[2]), HEIGHT_MIN_M)
        to_W = motion.R_WK @ self._K_inv  # a pixel (u, v, 1) to its ray in W
        down = (-to_W[2]).tolist()  # descent of a ray with z = 1 in K
        limits = [math.inf]
        for level in self._ground.levels:  # a pixel at distance s covers a depth of s^2 / (f h) on the ground
            reach_m = math.sqrt(MINIFIED_MAX * level.texel_m * self._focal_px * height_m)
            limits.append(height_m / min(reach_m, 0.7 * level.reach_m))
        least, most = _extremes(self._size, down)
        first = next((i for i, limit in enumerate(limits[1:]) if least >= limit), None)
        if first is None:
            a, b, c = (-SKY_SLOPE * each for each in down)  # the sky, bluer the higher
            rows = _rows(half_plane(self._size, (a, b, c), 0.0), self._size)
            if rows is not None:
                upwards = np.float32(b) * self._row_numbers[slice(*rows)] + np.float32(c + HAZE)
                cv2.convertScaleAbs(upwards + np.float32(a) * self._columns, dst=self.grey[slice(*rows)])
            ground = half_plane(self._size, down, 0.0)
            if len(ground) >= 3:
                cv2.fillConvexPoly(self.grey, _fixed(ground), self._ground.mean, cv2.LINE_AA, SHIFT)
            first = len(self._ground.levels) - 1
        # homography from pixels to (x, y, 1) on the ground [m], in the nearest of the repeated tiles
        x, y = (p - self._ground.tile_m * round(p / self._ground.tile_m) for p in motion.p_WK[:2].tolist())
        to_ground = np.array([[height_m, 0, -x], [0, height_m, -y], [0, 0, -1.0]]) @ to_W
        for i in range(first, -1, -1):  # limits of `down` for a level and for the finer one
            if most > limits[i + 1]:
                self._draw_level(self._ground.levels[i], to_ground, down, limits[i + 1], limits[i])
        return self.grey

    def ground_rows(self, motion: CameraMotion, room: int) -> slice:
        """Return the rows that show ground, with so many more on either side."""
        down = (-motion.R_WK[2] @ self._K_inv).tolist()
        first, end = _rows(half_plane(self._size, down, 0.0), self._size) or (0, 0)
        return slice(max(0, first - room), min(self._size[1], end + room)) if first < end else slice(0, 0)

    def _draw_level(self, level: Level, to_ground: Array, down: Sequence[float], least: float, most: float) -> None:
        """Draw a level in the rows that are near enough for it and not all near enough for a finer one."""
        part = half_plane(self._size, down, least)
        rows = _rows(part, self._size)
        coarse = _rows(half_plane(self._size, [-each for each in down], -most), self._size) if most < math.inf else rows
        if rows is None or coarse is None:
            return
        v0, v1 = max(rows[0], coarse[0]), min(rows[1], coarse[1])
        if v1 - v0 < 1:
            return
        warp = level.place @ to_ground
        warp[:, 2] += v0 * warp[:, 1]
        is_all = _extremes(self._size, down)[0] >= least
        out, mask = self.grey[v0:v1], self._mask[v0:v1]
        drawn, flags = out if is_all else self._scratch[v0:v1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = self._size[0], v1 - v0
        cv2.warpPerspective(level.texels, warp, size, drawn, flags, cv2.BORDER_CONSTANT, self._ground.mean)
        if is_all:
            return
        mask.fill(0)
        cv2.fillConvexPoly(mask, _fixed([(u, v - v0) for u, v in part]), 255, cv2.LINE_8, SHIFT)
        cv2.copyTo(drawn, mask, out)


def _fixed(points: Points) -> NDArray[np.int32]:
    return np.rint(np.array(points) * (1 << SHIFT)).astype(np.int32)


def _rows(part: Points, size: tuple[int, int]) -> tuple[int, int] | None:
    """Return the first row of a part of the picture, and the one after its last."""
    if len(part) < 3:
        return None
    heights = [v for _, v in part]
    return max(0, math.floor(min(heights))), min(size[1], math.ceil(max(heights)) + 1)


def _rectangle(width: int, height: int) -> Points:
    return [(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)]


def _extremes(size: tuple[int, int], linear: Sequence[float]) -> tuple[float, float]:
    """Return the least and the greatest a u + b v + c in a picture."""
    a, b, c = linear
    at_corners = [a * u + b * v + c for u, v in _rectangle(*size)]
    return min(at_corners), max(at_corners)


def half_plane(size: tuple[int, int], linear: Sequence[float], least: float) -> Points:
    """Return the part of a picture where a u + b v + c >= least as a polygon, empty with fewer than three points."""
    a, b, c = linear
    corners = _rectangle(*size)
    over = [a * u + b * v + c - least for u, v in corners]
    points: Points = []
    for i in range(4):
        (u, v), (u1, v1), here, there = corners[i], corners[i - 3], over[i], over[i - 3]
        if here >= 0:
            points.append((u, v))
        if (here >= 0) != (there >= 0):
            share = here / (here - there)
            points.append((u + (u1 - u) * share, v + (v1 - v) * share))
    return points
