"""Draws what a drone's camera sees, from the true poses of all drones. Pure: the same inputs give the same bits."""

import math
import zlib
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.math.frames import rotation_matrix
from zsim.math.random_streams import stream
from zsim.scenario.obstacle import nearest
from zsim.sensors.camera import Camera
from zsim.sensors.camera_model import Lens, camera_pose, lens_of
from zsim_agents.cameras.rendering.backdrop import Backdrop, Ground, colour_map, field
from zsim_agents.cameras.rendering.drones import SEEN_M, DroneImager, DroneImages, draw_drone, hat_images
from zsim_agents.cameras.rendering.scene import SUN_W, CameraMotion, DroneStates, Scene, View, camera_motion
from zsim_agents.cameras.rendering.shapes import draw_obstacle

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
SWEPT_PX = 0.8  # px, from which on the ground is blurred by the motion
WIDER_MAX = 2.0  # of the pinhole picture that a lens bends, over its own; rays beyond it repeat the edge


class Drawable(NamedTuple):
    """What is to be drawn: its distance, and which it is of its kind."""

    distance_m: float
    kind: str
    which: int


class Renderer:
    """One camera of one drone.

    Args:
        camera: its settings.
        scene: what stands still.
        carrier: which of the drones carries it.
        seed: of the noise.
        name: of the noise's random stream, e.g. "drone1/front".
        ground: None for a meadow with lines every metre.
    """

    def __init__(
        self, camera: Camera, scene: Scene, carrier: int, seed: int, name: str, ground: Ground | None = None
    ) -> None:
        gain = gain(scene.light)
        self._camera, self._scene, self._carrier = camera, scene, carrier
        self._exposure_s = camera.exposure_ms * 1e-3
        self._pose = camera_pose(camera)
        self._view = _view(lens_of(camera))
        self._brightness = scene.light * gain
        self._colours = colour_map(self._brightness)
        self._imager = DroneImager(self._view, scene, carrier, self._exposure_s, self._brightness)
        self._noise = None
        if camera.noise > 0:
            shape = self._view.lens.height, self._view.lens.width
            self._noise = Noise(seed, f"{name}/noise", shape, camera.noise * gain)
        self._bend: tuple[Picture, Picture] | None = None
        flat = self._view
        if self._view.distorts:
            flat, self._bend = _pinhole(self._view)
        self._backdrop = Backdrop(flat, ground or _field())

    def picture(self, number: int, t_s: float, bodies: DroneStates) -> Picture:
        """Return the picture of an exposure as B, G, R, (height, width, 3).

        Args:
            number: of the picture; its noise goes by it.
            t_s: the middle of the exposure [s].
            bodies: all drones then, in the scene's order.
        """
        R_WB = rotation_matrix(bodies.q_WB)
        motion = camera_motion(self._pose, bodies, R_WB[self._carrier], self._carrier)
        grey = self._backdrop.draw(motion)
        self._sweep(grey, motion)
        if self._bend is not None:
            grey = cv2.remap(grey, *self._bend, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        picture: Picture = cv2.applyColorMap(grey, self._colours)  # type: ignore[assignment]
        images = self._imager.images(motion, t_s, bodies, R_WB)
        for seen in sorted(self._order(motion, images), reverse=True):
            self._draw(picture, seen, motion, images)
        lens_blur(picture, self._camera.blur_px)
        if self._noise is not None:
            self._noise.add(picture, number)
        return picture

    def jpeg(self, number: int, t_s: float, bodies: DroneStates) -> bytes:
        """Return the picture of an exposure as JPEG; see `picture`."""
        return jpeg(self.picture(number, t_s, bodies), self._camera.jpeg_quality)

    def _sweep(self, grey: Picture, motion: CameraMotion) -> None:
        """Blur the ground by the motion of the middle of the picture's lower half over the exposure.

        The sky is smooth: its rows are left out, but for those that the horizon is blurred into.
        """
        ray_K = np.array([0.0, self._view.lens.height / 4 / self._view.lens.fy, 1.0])
        down = -float(motion.R_WK[2] @ ray_K)
        point_K = ray_K * (max(float(motion.p_WK[2]), 0.1) / down if down > 1e-3 else SEEN_M)
        way_px = self._view.flow_px(point_K, motion.rates_K(point_K, np.zeros(3))) * self._exposure_s
        if np.hypot(*way_px) < SWEPT_PX:
            return
        kernel = sweep_kernels(way_px[None])[0]
        part = grey[self._backdrop.ground_rows(motion, len(kernel))]
        if len(part):
            cv2.filter2D(part, -1, kernel, dst=part, borderType=cv2.BORDER_REPLICATE)

    def _order(self, motion: CameraMotion, images: DroneImages) -> list[Drawable]:
        """Return what may be in view, in any order."""
        seen = [Drawable(images.distances_m[i], "drone", i) for i in images.in_view]
        for i, row in enumerate(self._scene.obstacles):
            seen.append(Drawable(_distance(row, motion.p_WK), "obstacle", i))
        for i, place in enumerate(self._scene.hats.false_m):
            seen.append(Drawable(math.dist(place, motion.p_WK.tolist()), "hat", i))
        return seen

    def _draw(self, picture: Picture, seen: Drawable, motion: CameraMotion, images: DroneImages) -> None:
        if seen.kind == "obstacle":
            draw_obstacle(picture, self._view, self._scene.obstacles[seen.which], motion, self._brightness)
        elif seen.kind == "hat":
            self._false_hat(picture, np.array([self._scene.hats.false_m[seen.which]]), motion)
        else:
            self._drone(picture, seen.which, images)

    def _false_hat(self, picture: Picture, place_W: Array, motion: CameraMotion) -> None:
        centre_K = motion.points_K(place_W)
        if centre_K[0, 2] > 0:
            way_K = motion.rates_K(centre_K, np.zeros(3)) * self._exposure_s
            radius_m, sun_K = self._scene.hats.diameter_m / 2, SUN_W @ motion.R_WK
            for image in hat_images(self._view, centre_K, way_K, radius_m, self._brightness, sun_K).values():
                image.lay(picture)

    def _drone(self, picture: Picture, i: int, images: DroneImages) -> None:
        """Draw a drone and its hat: which of them is before the other depends on where the camera is."""
        image, hat, hats = images.drones.get(i), images.hats.get(i), self._scene.hats
        above = images.cameras_B[i, 2] > hats.position_m[2] - hats.diameter_m / 2
        if hat is not None and not above:
            hat.lay(picture)
        if image is not None:
            draw_drone(picture, image)
        if hat is not None and above:
            hat.lay(picture)


def _distance(row: tuple[float, ...], p_WK: Array) -> float:
    """Return how far the nearest point of an obstacle is, by which drones before it are drawn after it."""

    x, y, z = p_WK.tolist()
    return nearest(row, x, y, z)[0]


@cache
def _field() -> Ground:
    return field()


@cache
def _view(lens: Lens) -> View:
    return View(lens)


def _pinhole(view: View) -> tuple[View, tuple[Picture, Picture]]:
    """Return a view without distortion that holds all that a lens sees, and the map that bends its picture."""
    lens = view.lens
    half = np.abs(view.plane).max(axis=(0, 1)) * (lens.fx, lens.fy)
    most = np.array([lens.width, lens.height]) * WIDER_MAX / 2
    width, height = (int(2 * math.ceil(side + 2)) for side in np.minimum(half, most))
    flat = Lens(lens.fx, lens.fy, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0, width, height)
    at = (view.plane * (lens.fx, lens.fy) + (flat.cx, flat.cy)).astype(np.float32)
    return _view(flat), cv2.convertMaps(at[..., 0], at[..., 1], cv2.CV_16SC2)  # type: ignore[return-value]


MARGIN = 64  # px, by which the noise is larger than the picture
NOISE_MAX = 48.0  # grey levels, standard deviation: the most that the gain makes of the noise
SWEEP_MAX_PX = 24.0  # px; a longer way is blurred as this
SAMPLES_PER_PX = 8
FULL_COLOUR = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444  # hats are a few pixels wide
MIX = 0x9E3779B97F4A7C15  # 2^64 over the golden ratio, whose multiples spread (Knuth, TAOCP 3, 6.4)


def gain(light: float) -> float:
    """Return the sensor's gain, which makes up for half of the stops that the light lacks of a clear day; chosen."""
    return 1.0 / math.sqrt(light)


def sweep_kernels(ways_px: Array) -> list[NDArray[np.float32]]:
    """Return the kernels of motions by ways (N, 2) [px] over the picture: how long each pixel has had the light."""
    lengths = np.hypot(*ways_px.T)
    ways = ways_px * np.minimum(1.0, SWEEP_MAX_PX / np.maximum(lengths, 1e-9))[:, None]
    count = max(2, math.ceil(min(lengths.max(), SWEEP_MAX_PX) * SAMPLES_PER_PX))
    at = ways[:, :, None] * ((np.arange(count) + 0.5) / count - 0.5)  # (N, 2, count)
    halves = [math.ceil(way / 2) + 1 for way in np.abs(ways).max(axis=1).tolist()]
    most = max(halves)
    shares = np.maximum(1 - np.abs(np.arange(-most, most + 1) - at[..., None]), 0)  # of a point, in a column or row
    kernels = (shares[:, 1].transpose(0, 2, 1) @ shares[:, 0] / count).astype(np.float32)
    inner = [slice(most - half, most + half + 1) for half in halves]
    return [kernel[part, part] for kernel, part in zip(kernels, inner, strict=True)]


class Noise:
    """The noise of a sensor, made once, laid over each picture at another place.

    Args:
        seed, name: of the random stream; the same give the same noise.
        shape: of the picture, (height, width).
        sigma: grey levels, standard deviation.
    """

    def __init__(self, seed: int, name: str, shape: tuple[int, int], sigma: float) -> None:
        height, width = shape
        drawn = stream(seed, name).standard_normal((height + MARGIN, width + MARGIN, 3), np.float32)
        levels = np.rint(min(sigma, NOISE_MAX) * drawn)
        self._shape = shape
        self._key = zlib.crc32(name.encode()) ^ (seed & 0xFFFFFFFF)
        self._over = np.clip(levels, 0, 255).astype(np.uint8)
        self._under = np.clip(-levels, 0, 255).astype(np.uint8)

    def add(self, picture: Picture, number: int) -> None:
        """Add it to the picture of a number."""
        bits = ((number * 4 + 1) * MIX ^ self._key * MIX >> 7) & (2**64 - 1)
        v, u = bits >> 40 & (MARGIN - 1), bits >> 52 & (MARGIN - 1)
        height, width = self._shape
        over, under = self._over[v : v + height, u : u + width], self._under[v : v + height, u : u + width]
        if bits >> 60 & 1:
            over, under = under, over
        cv2.add(picture, over, dst=picture)
        cv2.subtract(picture, under, dst=picture)


def lens_blur(picture: Picture, sigma_px: float) -> None:
    """Blur a picture as the lens does."""
    if sigma_px < 0.2:
        return  # less than a pixel's own width
    side = 3 if sigma_px <= 0.7 else 2 * math.ceil(2.5 * sigma_px) + 1
    kernel = cv2.getGaussianKernel(side, sigma_px)
    cv2.sepFilter2D(picture, -1, kernel, kernel, dst=picture, borderType=cv2.BORDER_REPLICATE)


def jpeg(picture: Picture, quality: int) -> bytes:
    """Return a picture as JPEG."""
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality, *FULL_COLOUR])
    return data.tobytes()
