"""Draws what a drone's camera sees, from the true poses of all drones. Pure: the same inputs give the same bits."""

import math
import zlib
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.math.frames import rotation_matrix
from zsim.math.random_streams import stream
from zsim.scenario.obstacle import nearest
from zsim.sensors.camera import Camera
from zsim.sensors.camera_model import Lens, camera_pose, lens_of
from zsim_agents.cameras.rendering.backdrop import Backdrop, Ground, colour_map, meadow
from zsim_agents.cameras.rendering.foreground import SEEN_M, DroneImager, SurfaceImager, draw_obstacle
from zsim_agents.cameras.rendering.scene import (
    CameraMotion,
    DroneStates,
    Scene,
    View,
    camera_motion,
    motion_blur_kernels,
)

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
BLURRED_PX = 0.8  # px of motion from which the ground is blurred
WIDER_MAX = 2.0  # of the pinhole picture that a lens bends, over its own; rays beyond it repeat the edge
MARGIN = 64  # px, by which the noise is larger than the picture
NOISE_MAX = 48.0  # grey levels, standard deviation: the limit of the amplified noise
FULL_COLOUR = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444  # hats are a few pixels wide
MIX = 0x9E3779B97F4A7C15  # 2^64 over the golden ratio, whose multiples spread (Knuth, TAOCP 3, 6.4)


class Renderer:
    """One camera of one drone, the scene's `carrier`.

    Args:
        seed, name: of the noise's random stream, e.g. "drone1/front".
        ground: None for a meadow with lines every metre.
    """

    def __init__(
        self, camera: Camera, scene: Scene, carrier: int, seed: int, name: str, ground: Ground | None = None
    ) -> None:
        gain = 1.0 / math.sqrt(scene.light)  # makes up for half of the stops below a clear day; chosen
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
        self._bend: tuple[Picture, Picture] | None = None
        flat = self._view
        if self._view.distorts:
            flat, self._bend = _pinhole(self._view)
        self._backdrop = Backdrop(flat, ground or meadow())

    def jpeg(self, number: int, t_s: float, bodies: DroneStates) -> bytes:
        """Return the picture of an exposure as JPEG; see `picture`."""
        options = [cv2.IMWRITE_JPEG_QUALITY, self._camera.jpeg_quality, *FULL_COLOUR]
        return cv2.imencode(".jpg", self.picture(number, t_s, bodies), options)[1].tobytes()

    def picture(self, number: int, t_s: float, bodies: DroneStates) -> Picture:
        """Return the picture of an exposure as B, G, R, (height, width, 3).

        Args:
            number: of the picture; selects its noise.
            t_s: the middle of the exposure [s].
            bodies: all drones at that time, in the scene's order.
        """
        R_WB = rotation_matrix(bodies.q_WB)
        motion = camera_motion(self._pose, bodies, R_WB[self._carrier], self._carrier)
        grey = self._backdrop.draw(motion)
        self._blur_ground(grey, motion)
        if self._bend is not None:
            grey = cv2.remap(grey, *self._bend, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        picture: Picture = cv2.applyColorMap(grey, self._colours)  # type: ignore[assignment]
        drones, p_W = self._imager.images(motion, t_s, bodies, R_WB), motion.p_WK.tolist()
        things = [(distance_m, "drone", i) for i, (distance_m, _) in drones.items()]
        things += [(nearest(row, *p_W)[0], "obstacle", i) for i, row in enumerate(self._scene.obstacles)]
        things += [(math.dist(place, p_W), "hat", i) for i, place in enumerate(self._scene.hats.false_m)]
        if len(self._scene.surfaces):
            things += [(distance_m, "surface", i) for distance_m, i in self._surfaces.shown(motion)]
        for _, kind, which in sorted(things, reverse=True):  # the farthest first
            if kind == "obstacle":
                draw_obstacle(picture, self._view, self._scene.obstacles[which], motion, self._brightness)
            elif kind == "surface":
                self._surfaces.draw(picture, which)
            elif kind == "hat":
                centre_K = motion.points_K(np.array([self._scene.hats.false_m[which]]))
                if centre_K[0, 2] > 0:
                    way_K = motion.rates_K(centre_K, np.zeros(3)) * self._exposure_s
                    for image in self._imager.hats(centre_K, way_K, motion).values():
                        image.draw(picture)
            else:
                for layer in drones[which][1]:
                    layer.draw(picture)
        sigma_px = self._camera.blur_px
        if sigma_px >= 0.2:  # less is less than a pixel's own width
            side = 3 if sigma_px <= 0.7 else 2 * math.ceil(2.5 * sigma_px) + 1
            kernel = cv2.getGaussianKernel(side, sigma_px)
            cv2.sepFilter2D(picture, -1, kernel, kernel, dst=picture, borderType=cv2.BORDER_REPLICATE)
        if self._noise is not None:
            self._noise.add(picture, number)
        return picture

    def _blur_ground(self, grey: Picture, motion: CameraMotion) -> None:
        """Blur the ground by the motion of the middle of the picture's lower half over the exposure.

        The sky is smooth: its rows are left out, except those near the horizon.
        """
        ray_K = np.array([0.0, self._view.lens.height / 4 / self._view.lens.fy, 1.0])
        down = -float(motion.R_WK[2] @ ray_K)
        point_K = ray_K * (max(float(motion.p_WK[2]), 0.1) / down if down > 1e-3 else SEEN_M)
        way_px = self._view.flow_px(point_K, motion.rates_K(point_K, np.zeros(3))) * self._exposure_s
        if np.hypot(*way_px) < BLURRED_PX:
            return
        kernel = motion_blur_kernels(way_px[None])[0]
        part = grey[self._backdrop.ground_rows(motion, len(kernel))]
        if len(part):
            cv2.filter2D(part, -1, kernel, dst=part, borderType=cv2.BORDER_REPLICATE)


class _Noise:
    """The noise of a sensor, made once and laid over each picture at another offset; sigma in grey levels."""

    def __init__(self, seed: int, name: str, shape: tuple[int, int], sigma: float) -> None:
        height, width = shape
        drawn = stream(seed, name).standard_normal((height + MARGIN, width + MARGIN, 3), np.float32)
        levels = np.rint(min(sigma, NOISE_MAX) * drawn)
        self._shape = shape
        self._key = zlib.crc32(name.encode()) ^ (seed & 0xFFFFFFFF)
        self._over = np.clip(levels, 0, 255).astype(np.uint8)
        self._under = np.clip(-levels, 0, 255).astype(np.uint8)

    def add(self, picture: Picture, number: int) -> None:
        bits = ((number * 4 + 1) * MIX ^ self._key * MIX >> 7) & (2**64 - 1)
        v, u = bits >> 40 & (MARGIN - 1), bits >> 52 & (MARGIN - 1)
        height, width = self._shape
        over, under = self._over[v : v + height, u : u + width], self._under[v : v + height, u : u + width]
        if bits >> 60 & 1:
            over, under = under, over
        cv2.add(picture, over, dst=picture)
        cv2.subtract(picture, under, dst=picture)


view_of = cache(View)


def _pinhole(view: View) -> tuple[View, tuple[Picture, Picture]]:
    """Return a view without distortion that holds all that a lens sees, and the map that bends its picture."""
    lens = view.lens
    half = np.abs(view.plane).max(axis=(0, 1)) * (lens.fx, lens.fy)
    most = np.array([lens.width, lens.height]) * WIDER_MAX / 2
    width, height = (int(2 * math.ceil(side + 2)) for side in np.minimum(half, most))
    flat = Lens(lens.fx, lens.fy, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0, 0.0, 0.0, 0.0, width, height)
    at = (view.plane * (lens.fx, lens.fy) + (flat.cx, flat.cy)).astype(np.float32)
    return view_of(flat), cv2.convertMaps(at[..., 0], at[..., 1], cv2.CV_16SC2)  # type: ignore[return-value]
