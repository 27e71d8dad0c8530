"""The ground and the sky as one grey picture, which a map turns into colours: a warp of one channel costs a third.

Greys up to LIGHTEST are the ground's, from HAZE on the sky's. The ground is a square tile about W's origin, repeated,
in levels that each average several pixels of the one before: far away the coarser ones are drawn, lest it glitters.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim_agents.cameras.rendering.view import CameraMotion, View

Grey = NDArray[np.uint8]
Array = NDArray[np.float64]

TEXEL_M = 0.02  # m, of the finest level, chosen: a blade of grass is not seen, a line of 6 cm is
TILE = 1000  # texels of a side: 20 m, so that lines every metre go on over the seam
FACTORS = (1, 4, 20, 100)  # of the texels of each level over the finest
WINDOW = (3000, 2000, 1500, 1000)  # texels of a side that are kept of each level: 60 m, 160 m, 600 m, 2 km
MINIFIED_MAX = 2.0  # texels that a pixel may be deep on the ground before a coarser level is drawn
HEIGHT_MIN_M = 0.03  # m, of a camera over the ground
DARKEST, LIGHTEST, HAZE = 0, 150, 176  # greys
SHADOW = 34  # greys darker, chosen
ZENITH = 0.6  # sine of the elevation from which on the sky is the bluest; chosen
COLOURS = {  # B, G, R by grey; chosen: dry grass, white lines, a hazy blue sky
    0: (24, 36, 30),
    60: (52, 104, 92),
    100: (84, 138, 134),
    150: (226, 234, 232),
    176: (232, 222, 208),
    255: (214, 158, 98),
}


class Level(NamedTuple):
    """A level of the ground: its window, the size of a texel [m], and how far it is drawn at most [m]."""

    texels: Grey
    texel_m: float
    reach_m: float


class Ground:
    """A ground.

    Args:
        tile: greys up to LIGHTEST, a square whose side is a multiple of 100; its middle is W's origin, its top north.
        texel_m: the side of one of its texels.
    """

    def __init__(self, tile: Grey, texel_m: float = TEXEL_M) -> None:
        self.tile_m = texel_m * len(tile)
        self.mean = round(float(tile.mean()))
        self.levels = [self._level(tile, texel_m, f, window) for f, window in zip(FACTORS, WINDOW, strict=True)]

    def _level(self, tile: Grey, texel_m: float, factor: int, window: int) -> Level:
        side = len(tile) // factor
        mean = tile.reshape(side, factor, side, factor).mean(axis=(1, 3))
        repeats = max(3, 2 * (window // side // 2) + 1)  # odd: W's origin stays in the middle
        texels = np.tile(np.rint(mean).astype(np.uint8), (repeats, repeats))
        return Level(texels, texel_m * factor, self.tile_m * (repeats - 1) / 2)


def field(seed: int = 1) -> Ground:
    """Return a meadow with a line at every metre, and a wider one at every fifth."""
    rng = np.random.default_rng(seed)
    patches = sum(_patches(rng, cells) * share for cells, share in ((10, 12.0), (50, 10.0), (250, 8.0), (1000, 9.0)))
    tile = np.clip(70.0 + patches, 15, 110)
    step = round(1 / TEXEL_M)
    for every, width, grey in ((1, 1, 112.0), (5, 3, 144.0)):
        for start in range(0, TILE, every * step):
            at = [(start + k - width // 2) % TILE for k in range(width)]
            tile[at, :] = tile[:, at] = grey
    return Ground(np.rint(tile).astype(np.uint8))


def _patches(rng: np.random.Generator, cells: int) -> Array:
    """Return smooth noise of unit variance over the tile, which repeats."""
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


RAMP_STEPS = 128  # greys of the sky for a sine of 1
RAMP_END = 16  # beyond any w of a ray with z = 1 in K, of a lens of 150 deg at most, rolled in any way
_HEIGHTS = np.arange(-RAMP_END * RAMP_STEPS, RAMP_END * RAMP_STEPS) / (ZENITH * RAMP_STEPS)
SKY_RAMP = np.tile(np.rint(HAZE + (255 - HAZE) * np.clip(_HEIGHTS, 0, 1)).astype(np.uint8), (4, 1))


class Backdrop:
    """Draws ground and sky as a pinhole sees them.

    Args:
        view: of the camera, without distortion.
        ground: what it sees.
    """

    def __init__(self, view: View, ground: Ground) -> None:
        lens = view.lens
        self._ground = ground
        self._size = lens.width, lens.height
        self._focal_px = lens.fx
        self._K_inv = np.array(
            [[1 / lens.fx, 0, -lens.cx / lens.fx], [0, 1 / lens.fy, -lens.cy / lens.fy], [0, 0, 1.0]]
        )
        self._corners = np.array([(u, v, 1.0) for u, v in _rectangle(*self._size)])
        self.grey: Grey = np.empty((lens.height, lens.width), np.uint8)
        self._scratch = np.empty_like(self.grey)
        self._mask = np.empty_like(self.grey)

    def draw(self, motion: CameraMotion) -> Grey:
        """Return the picture, owned by this object."""
        height_m = max(float(motion.p_WK[2]), HEIGHT_MIN_M)
        to_W = motion.R_WK @ self._K_inv  # a pixel (u, v, 1) to its ray in W
        down = -to_W[2]  # how far it goes down, of a ray with z = 1 in K
        at_corners = self._corners @ down
        reaches = [self._reach(level, height_m) for level in self._ground.levels]
        least = float(at_corners.min())
        first = next((i for i, reach in enumerate(reaches) if least >= height_m / reach), None)
        if first is None:
            self._sky(down)
            self._fill(down, 0.0, self._ground.mean)
            first = len(reaches) - 1
        limits = [math.inf, *(height_m / reach for reach in reaches)]  # of `down`, of each level and the one before
        for i in range(first, -1, -1):
            if at_corners.max() > limits[i + 1]:
                self._lay(self._ground.levels[i], to_W, motion.p_WK, height_m, limits[i + 1], limits[i])
        return self.grey

    def _reach(self, level: Level, height_m: float) -> float:
        """Return how far a level is drawn [m]: a pixel is s^2 / (f h) deep on the ground at a distance s."""
        return min(math.sqrt(MINIFIED_MAX * level.texel_m * self._focal_px * height_m), 0.7 * level.reach_m)

    def _sky(self, down: Array) -> None:
        """Draw the sky, bluer the higher; only the rows that have some."""
        rows = _rows(half_plane(self._size, -down, 0.0), self._size)
        if rows is None:
            return
        a, b, c = -down * RAMP_STEPS
        warp = np.array([[a, b, c + b * rows[0] + RAMP_END * RAMP_STEPS], [0.0, 0.0, 1.0]])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        out = self.grey[rows[0] : rows[1]]
        cv2.warpAffine(SKY_RAMP, warp, (out.shape[1], out.shape[0]), out, flags, cv2.BORDER_CONSTANT, 255)

    def _fill(self, down: Array, least: float, grey: int) -> None:
        part = half_plane(self._size, down, least)
        if len(part) >= 3:
            cv2.fillConvexPoly(self.grey, _fixed(part), grey, cv2.LINE_AA, SHIFT)

    def _lay(self, level: Level, to_W: Array, p_WK: Array, height_m: float, least: float, most: float) -> None:
        """Draw a level in the rows where the ground is near enough for it, and not all near enough for a finer one."""
        part = half_plane(self._size, -to_W[2], least)
        rows = _rows(part, self._size)
        coarse = _rows(half_plane(self._size, to_W[2], -most), self._size) if most < math.inf else rows
        if rows is None or coarse is None:
            return
        v0, v1 = max(rows[0], coarse[0]), min(rows[1], coarse[1])
        if v1 - v0 < 1:
            return
        warp = self._to_texels(level, to_W, p_WK, height_m) @ np.array([[1.0, 0, 0], [0, 1.0, v0], [0, 0, 1.0]])
        out = self.grey[v0:v1]
        if (self._corners[:, :2] @ -to_W[2, :2]).min() - to_W[2, 2] >= least:  # all of the picture
            self._warp(level, warp, out)
            return
        drawn, mask = self._scratch[v0:v1], self._mask[v0:v1]
        self._warp(level, warp, drawn)
        mask.fill(0)
        cv2.fillConvexPoly(mask, _fixed(part - (0, v0)), 255, cv2.LINE_8, SHIFT)
        cv2.copyTo(drawn, mask, out)

    def _warp(self, level: Level, warp: Array, out: Grey) -> None:
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = out.shape[1], out.shape[0]
        value = self._ground.mean
        cv2.warpPerspective(level.texels, warp, size, out, flags, cv2.BORDER_CONSTANT, value)

    def _to_texels(self, level: Level, to_W: Array, p_WK: Array, height_m: float) -> Array:
        """Return the homography from pixels to texels of a level; of the repeated tiles the nearest are taken."""
        x, y = (float(p) - self._ground.tile_m * round(float(p) / self._ground.tile_m) for p in p_WK[:2])
        to_ground = np.array([[height_m, 0, -x], [0, height_m, -y], [0, 0, -1.0]])  # d of W to (x, y, 1) times -d_z
        middle = len(level.texels) / 2 - 0.5  # of the window, where W's origin is, in OpenCV's whole middles of texels
        place = np.array([[1 / level.texel_m, 0, middle], [0, -1 / level.texel_m, middle], [0, 0, 1.0]])
        return place @ to_ground @ to_W


SHIFT = 4  # fractional bits of OpenCV's coordinates: sixteenths of a pixel


def _fixed(points: Array) -> NDArray[np.int32]:
    return np.rint(points * (1 << SHIFT)).astype(np.int32)


def _rows(part: Array, size: tuple[int, int]) -> tuple[int, int] | None:
    """Return the first row that a part of the picture has, and the first that it does not have any more."""
    if len(part) < 3:
        return None
    return max(0, math.floor(part[:, 1].min())), min(size[1], math.ceil(part[:, 1].max()) + 1)


def _rectangle(width: int, height: int) -> Array:
    return np.array([(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)])


def half_plane(size: tuple[int, int], linear: Array, least: float) -> Array:
    """Return the part of a picture where a u + b v + c >= least, as a polygon (M, 2); fewer than three are none."""
    corners = _rectangle(*size)
    over = corners @ linear[:2] + (linear[2] - least)
    points: list[Array] = []
    for i in range(4):
        j = (i + 1) % 4
        if over[i] >= 0:
            points.append(corners[i])
        if (over[i] >= 0) != (over[j] >= 0):
            points.append(corners[i] + (corners[j] - corners[i]) * (over[i] / (over[i] - over[j])))
    return np.array(points).reshape(-1, 2)
