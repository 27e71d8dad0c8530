"""Renders the picture of a drone's camera from the true poses of all drones.

Rendering is deterministic: equal inputs give bit-identical pictures.

The backdrop of ground and sky is a grey picture, which a colour map converts to colours: warping one channel takes a
third of the time of warping three. Greys up to 150 are ground, and greys from HAZE on are sky. The ground repeats a
square tile around W's origin, in levels of decreasing resolution: coarser ones are drawn far away to avoid aliasing.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.math.frames import rotation_matrix
from zsim.math.randomness import stream
from zsim.scenario.surroundings import nearest
from zsim.sensors.camera import Camera
from zsim.sensors.camera_model import Lens, camera_pose, lens_of
from zsim_agents.cameras.foreground import VISIBLE_MAX_M, DroneImager, SurfaceImager, draw_obstacle, to_fixed_point
from zsim_agents.cameras.scene import SHIFT, CameraMotion, DroneStates, Scene, View, camera_motion, motion_blur_kernels

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
BLUR_MIN_PX = 0.8  # minimum motion for which the ground is blurred
WIDENING_MAX = 2.0  # maximum ratio of the undistorted to the final picture's size; beyond it, edge pixels are repeated
MARGIN = 64  # pixels by which the noise image exceeds the picture
NOISE_MAX = 48.0  # maximum standard deviation of the amplified noise, in grey levels
# No chroma subsampling: it would blur the colour of hats a few pixels wide
FULL_COLOUR = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
MIX = 0x9E3779B97F4A7C15  # 2^64 over the golden ratio: its multiples mod 2^64 are evenly spread (Knuth, TAOCP 3, 6.4)
view_of = cache(View)
Grey = NDArray[np.uint8]
Points = list[tuple[float, float]]
TEXEL_M = 0.02  # side of a texel of the finest level, which shows a line 6 cm wide but no blade of grass
TILE = 1000  # texels along a side of the tile: 20 m, so that lines every metre continue across the seam
FACTORS = (1, 4, 20, 100)  # size of the texels of each level over that of the finest
WINDOW = (3000, 2000, 1500, 1000)  # minimum texels along a side of each level's ground: 60 m, 160 m, 600 m, 2 km
MINIFIED_MAX = 2.0  # depth of ground covered by a pixel, in texels, beyond which a coarser level is drawn
HEIGHT_MIN_M = 0.03  # minimum height of the camera above the ground
HAZE = 176  # grey of the horizon
ZENITH = 0.6  # sine of the elevation above which the sky is bluest; tuned by eye
SKY_SLOPE = (255 - HAZE) / ZENITH  # increase of the sky's grey per unit of the sine of the elevation
COLOURS = {  # B, G, R by grey: dry grass, white lines, a hazy blue sky
    0: (24, 36, 30),
    60: (52, 104, 92),
    100: (84, 138, 134),
    150: (226, 234, 232),
    176: (232, 222, 208),
    255: (214, 158, 98),
}


class Renderer:
    """Renders the pictures of a camera on drone number `carrier` of a scene.

    Args:
        seed, name: seed and name of the noise's random stream; the name is e.g. "drone1/front".
        ground: the ground; None for a meadow with lines every metre.
    """

    def __init__(
        self, camera: Camera, scene: Scene, carrier: int, seed: int, name: str, ground: Ground | None = None
    ) -> None:
        # Compensates for half, in stops, of the loss of light relative to a clear day
        gain = 1.0 / math.sqrt(scene.light)
        self._camera, self._scene, self._carrier = camera, scene, carrier
        self._exposure_s = camera.exposure_ms * 1e-3
        self._pose = camera_pose(camera)
        self._view = view_of(lens_of(camera))
        self._brightness = scene.light * gain
        self._colours = colour_map(self._brightness)
        self._surfaces = SurfaceImager(self._view, scene.surfaces, self._brightness)
        self._imager = DroneImager(self._view, scene, carrier, self._exposure_s, self._brightness)
        shape = self._view.lens.height, self._view.lens.width
        self._noise = _Noise(seed, f"{name}/noise", shape, camera.noise * gain) if camera.noise > 0 else None
        self._distortion_map: tuple[Picture, Picture] | None = None
        flat = self._view
        if self._view.distorts:
            flat, self._distortion_map = _pinhole(self._view)
        self._backdrop = Backdrop(flat, ground or meadow())

    def jpeg(self, number: int, t_s: float, bodies: DroneStates) -> bytes:
        """Return the picture of an exposure as a JPEG; for the arguments see `picture`."""
        options = [cv2.IMWRITE_JPEG_QUALITY, self._camera.jpeg_quality, *FULL_COLOUR]
        return cv2.imencode(".jpg", self.picture(number, t_s, bodies), options)[1].tobytes()

    def picture(self, number: int, t_s: float, bodies: DroneStates) -> Picture:
        """Return the picture of an exposure, (height, width, 3), in B, G, R.

        Args:
            number: number of the picture, which selects its noise.
            t_s: middle of the exposure [s].
            bodies: states of all drones at `t_s`, in the scene's order.
        """
        R_WB = rotation_matrix(bodies.q_WB)
        motion = camera_motion(self._pose, bodies, R_WB[self._carrier], self._carrier)
        grey = self._backdrop.draw(motion)
        self._blur_ground(grey, motion)
        if self._distortion_map is not None:
            grey = cv2.remap(grey, *self._distortion_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        picture: Picture = cv2.applyColorMap(grey, self._colours)  # type: ignore[assignment]
        drones, p_W = self._imager.images(motion, t_s, bodies, R_WB), motion.p_WK.tolist()
        layers = [(distance_m, "drone", i) for i, (distance_m, _) in drones.items()]
        layers += [(nearest(row, *p_W)[0], "obstacle", i) for i, row in enumerate(self._scene.obstacles)]
        layers += [(math.dist(position, p_W), "hat", i) for i, position in enumerate(self._scene.hats.false_m)]
        if len(self._scene.surfaces):
            layers += [(distance_m, "surface", i) for distance_m, i in self._surfaces.visible_triangles(motion)]
        for _, kind, index in sorted(layers, reverse=True):  # farthest first
            if kind == "obstacle":
                draw_obstacle(picture, self._view, self._scene.obstacles[index], motion, self._brightness)
            elif kind == "surface":
                self._surfaces.draw(picture, index)
            elif kind == "hat":
                centre_K = motion.points_K(np.array([self._scene.hats.false_m[index]]))
                if centre_K[0, 2] > 0:
                    displacement_K = motion.rates_K(centre_K, np.zeros(3)) * self._exposure_s
                    for image in self._imager.hats(centre_K, displacement_K, motion).values():
                        image.draw(picture)
            else:
                for layer in drones[index][1]:
                    layer.draw(picture)
        sigma_px = self._camera.blur_px
        if sigma_px >= 0.2:  # a smaller blur is invisible
            side = 3 if sigma_px <= 0.7 else 2 * math.ceil(2.5 * sigma_px) + 1
            kernel = cv2.getGaussianKernel(side, sigma_px)
            cv2.sepFilter2D(picture, -1, kernel, kernel, dst=picture, borderType=cv2.BORDER_REPLICATE)
        if self._noise is not None:
            self._noise.add(picture, number)
        return picture

    def _blur_ground(self, grey: Picture, motion: CameraMotion) -> None:
        """Blur all ground by the motion, during the exposure, of the ground at the centre of the picture's lower half.

        Rows of sky, which is smooth, are skipped, except those near the horizon.
        """
        ray_K = np.array([0.0, self._view.lens.height / 4 / self._view.lens.fy, 1.0])
        down = -float(motion.R_WK[2] @ ray_K)
        point_K = ray_K * (max(float(motion.p_WK[2]), 0.1) / down if down > 1e-3 else VISIBLE_MAX_M)
        displacement_px = self._view.flow_px(point_K, motion.rates_K(point_K, np.zeros(3))) * self._exposure_s
        if np.hypot(*displacement_px) < BLUR_MIN_PX:
            return
        kernel = motion_blur_kernels(displacement_px[None])[0]
        part = grey[self._backdrop.ground_rows(motion, len(kernel))]
        if len(part):
            cv2.filter2D(part, -1, kernel, dst=part, borderType=cv2.BORDER_REPLICATE)


class _Noise:
    """Noise of an image sensor, drawn once, added to each picture at a pseudo-random offset; sigma in grey levels."""

    def __init__(self, seed: int, name: str, shape: tuple[int, int], sigma: float) -> None:
        height, width = shape
        drawn = stream(seed, name).standard_normal((height + MARGIN, width + MARGIN, 3), np.float32)
        levels = np.rint(min(sigma, NOISE_MAX) * drawn)
        self._shape = shape
        self._key = zlib.crc32(name.encode()) ^ (seed & 0xFFFFFFFF)
        self._positive = np.clip(levels, 0, 255).astype(np.uint8)
        self._negative = np.clip(-levels, 0, 255).astype(np.uint8)

    def add(self, picture: Picture, number: int) -> None:
        bits = ((number * 4 + 1) * MIX ^ self._key * MIX >> 7) & (2**64 - 1)
        v, u = bits >> 40 & (MARGIN - 1), bits >> 52 & (MARGIN - 1)
        height, width = self._shape
        positive, negative = (
            self._positive[v : v + height, u : u + width],
            self._negative[v : v + height, u : u + width],
        )
        if bits >> 60 & 1:
            positive, negative = negative, positive
        cv2.add(picture, positive, dst=picture)
        cv2.subtract(picture, negative, dst=picture)


def _pinhole(view: View) -> tuple[View, tuple[Picture, Picture]]:
    """Return an undistorted view of the lens's field of view, up to WIDENING_MAX, and the map that distorts it."""
    lens = view.lens
    half = np.abs(view.plane).max(axis=(0, 1)) * (lens.fx, lens.fy)
    half_max = np.array([lens.width, lens.height]) * WIDENING_MAX / 2
    width, height = (int(2 * math.ceil(side + 2)) for side in np.minimum(half, half_max))
    undistorted = Lens(lens.fx, lens.fy, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0, 0.0, 0.0, 0.0, width, height)
    source_px = (view.plane * (lens.fx, lens.fy) + (undistorted.cx, undistorted.cy)).astype(np.float32)
    return view_of(undistorted), cv2.convertMaps(source_px[..., 0], source_px[..., 1], cv2.CV_16SC2)  # type: ignore[return-value]


class Level(NamedTuple):
    """A level of the ground: its texels, the side of a texel [m], and the distance up to which the level extends [m].

    `to_texels` is the homography (3, 3) from (x, y, 1) [m; W] to texels, whose centres have integer coordinates.
    """

    texels: Grey
    texel_m: float
    reach_m: float
    to_texels: Array


class Ground:
    """The ground, as levels of decreasing resolution.

    Args:
        tile: square of greys up to 150, centred on W's origin, north up; its side is a multiple of 100 texels.
        texel_m: side of a texel.
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
            to_texels = np.array([[scale, 0, middle], [0, -scale, middle], [0, 0, 1.0]])
            self.levels.append(Level(texels, texel_m * factor, self.tile_m * (repeats - 1) / 2, to_texels))


@cache
def meadow() -> Ground:
    """Return a meadow with lines every metre, every fifth of them wider."""
    rng = np.random.default_rng(1)
    patches = sum(_patches(rng, cells) * share for cells, share in ((10, 12.0), (50, 10.0), (250, 8.0), (1000, 9.0)))
    tile = np.clip(70.0 + patches, 15, 110)
    step = round(1 / TEXEL_M)
    for every, width, grey in ((1, 1, 112.0), (5, 3, 144.0)):
        for start in range(0, TILE, every * step):
            lines = [(start + k - width // 2) % TILE for k in range(width)]
            tile[lines, :] = tile[:, lines] = grey
    return Ground(np.rint(tile).astype(np.uint8))


def _patches(rng: np.random.Generator, cells: int) -> Array:
    """Return smooth, periodic noise of unit variance for a tile, with `cells` cells per side."""
    coarse = np.pad(rng.standard_normal((cells, cells)), 2, mode="wrap")
    factor = TILE // cells
    fine = coarse if factor == 1 else cv2.resize(coarse, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    inner = fine[2 * factor : 2 * factor + TILE, 2 * factor : 2 * factor + TILE]
    return inner / inner.std()


def colour_map(brightness: float) -> Grey:
    """Return B, G, R of each grey at a given brightness, (256, 1, 3)."""
    greys = np.arange(256)
    channels = [np.interp(greys, list(COLOURS), [colour[k] for colour in COLOURS.values()]) for k in range(3)]
    return np.rint(brightness * np.stack(channels, axis=-1)).astype(np.uint8)[:, None, :]


class Backdrop:
    """Draws ground and sky as a pinhole camera sees them, through an undistorted view."""

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
        """Return the picture, which the next call overwrites."""
        height_m = max(float(motion.p_WK[2]), HEIGHT_MIN_M)
        to_W = motion.R_WK @ self._K_inv  # from a pixel (u, v, 1) to its ray in W
        down = (-to_W[2]).tolist()  # coefficients of (u, v, 1): descent in W of the pixel's ray with z = 1 in K
        limits = [math.inf]
        for level in self._ground.levels:  # from height h, a pixel at distance s covers s^2 / (f h) of ground in depth
            reach_m = math.sqrt(MINIFIED_MAX * level.texel_m * self._focal_px * height_m)
            limits.append(height_m / min(reach_m, 0.7 * level.reach_m))
        descent_min, descent_max = _extremes(self._size, down)
        first = next((i for i, limit in enumerate(limits[1:]) if descent_min >= limit), None)
        if first is None:
            a, b, c = (-SKY_SLOPE * each for each in down)  # the sky: bluer with elevation
            rows = _rows(half_plane(self._size, (a, b, c), 0.0), self._size)
            if rows is not None:
                upwards = np.float32(b) * self._row_numbers[slice(*rows)] + np.float32(c + HAZE)
                cv2.convertScaleAbs(upwards + np.float32(a) * self._columns, dst=self.grey[slice(*rows)])
            ground = half_plane(self._size, down, 0.0)
            if len(ground) >= 3:
                cv2.fillConvexPoly(self.grey, to_fixed_point(np.array(ground)), self._ground.mean, cv2.LINE_AA, SHIFT)
            first = len(self._ground.levels) - 1
        # homography from pixels to (x, y, 1) on the ground [m], relative to the nearest repetition of the tile
        x, y = (p - self._ground.tile_m * round(p / self._ground.tile_m) for p in motion.p_WK[:2].tolist())
        to_ground = np.array([[height_m, 0, -x], [0, height_m, -y], [0, 0, -1.0]]) @ to_W
        for i in range(first, -1, -1):  # limits[i + 1] and limits[i]: minimum descent for this and the next finer level
            if descent_max > limits[i + 1]:
                self._draw_level(self._ground.levels[i], to_ground, down, limits[i + 1], limits[i])
        return self.grey

    def ground_rows(self, motion: CameraMotion, margin: int) -> slice:
        """Return the rows that show ground, plus `margin` rows on either side."""
        down = (-motion.R_WK[2] @ self._K_inv).tolist()
        first, end = _rows(half_plane(self._size, down, 0.0), self._size) or (0, 0)
        return slice(max(0, first - margin), min(self._size[1], end + margin)) if first < end else slice(0, 0)

    def _draw_level(
        self, level: Level, to_ground: Array, down: Sequence[float], descent_min: float, descent_max: float
    ) -> None:
        """Draw a level in the rows that are near enough for it, except rows entirely near enough for the finer one."""
        part = half_plane(self._size, down, descent_min)
        rows = _rows(part, self._size)
        coarse = (
            _rows(half_plane(self._size, [-each for each in down], -descent_max), self._size)
            if descent_max < math.inf
            else rows
        )
        if rows is None or coarse is None:
            return
        v0, v1 = max(rows[0], coarse[0]), min(rows[1], coarse[1])
        if v1 - v0 < 1:
            return
        warp = level.to_texels @ to_ground
        warp[:, 2] += v0 * warp[:, 1]
        covers_rows = _extremes(self._size, down)[0] >= descent_min
        out, mask = self.grey[v0:v1], self._mask[v0:v1]
        drawn, flags = out if covers_rows else self._scratch[v0:v1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = self._size[0], v1 - v0
        cv2.warpPerspective(level.texels, warp, size, drawn, flags, cv2.BORDER_CONSTANT, self._ground.mean)
        if covers_rows:
            return
        mask.fill(0)
        cv2.fillConvexPoly(mask, to_fixed_point(np.array(part) - (0, v0)), 255, cv2.LINE_8, SHIFT)
        cv2.copyTo(drawn, mask, out)


def _rows(part: Points, size: tuple[int, int]) -> tuple[int, int] | None:
    """Return the first row of a part of the picture, and the row after its last one; None if it is empty."""
    if len(part) < 3:
        return None
    heights = [v for _, v in part]
    return max(0, math.floor(min(heights))), min(size[1], math.ceil(max(heights)) + 1)


def _rectangle(width: int, height: int) -> Points:
    return [(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)]


def _extremes(size: tuple[int, int], linear: Sequence[float]) -> tuple[float, float]:
    """Return the minimum and maximum of a u + b v + c in a picture."""
    a, b, c = linear
    at_corners = [a * u + b * v + c for u, v in _rectangle(*size)]
    return min(at_corners), max(at_corners)


def half_plane(size: tuple[int, int], linear: Sequence[float], threshold: float) -> Points:
    """Return the polygon in a picture where a u + b v + c >= `threshold`; with fewer than three points, it is empty."""
    a, b, c = linear
    corners = _rectangle(*size)
    excess = [a * u + b * v + c - threshold for u, v in corners]
    points: Points = []
    for i in range(4):
        (u, v), (u1, v1), value, next_value = corners[i], corners[i - 3], excess[i], excess[i - 3]
        if value >= 0:
            points.append((u, v))
        if (value >= 0) != (next_value >= 0):
            share = value / (value - next_value)
            points.append((u + (u1 - u) * share, v + (v1 - v) * share))
    return points
