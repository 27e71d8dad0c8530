"""Where all drones are in one camera's picture, computed together. Pure."""

import math
from collections import defaultdict
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim_agents.cameras.rendering import film
from zsim_agents.cameras.rendering.balls import NEAR_M, BallImage, Balls, ball_images
from zsim_agents.cameras.rendering.drones import (
    BLADES,
    MOTOR_WIDE_M,
    THICKNESS_MAX_PX,
    DroneImage,
    blade_points,
    drone_model,
)
from zsim_agents.cameras.rendering.faces import SHIFT, fixed
from zsim_agents.cameras.rendering.scene import SUN_W, DroneStates, Scene
from zsim_agents.cameras.rendering.view import CameraMotion, View, has_pixels, skew

Array = NDArray[np.float64]
MAGENTA = np.array([134.0, 0.0, 226.0])  # B, G, R of the paper's marker
SEEN_M = 300.0  # m; what is farther is less than a pixel
ROOM_M = 0.5  # m; a drone of which no part is farther from its middle, by its arms of 0.18 m
BLADE_RAD = 0.3  # rad, that a blade covers of the circle, at two thirds of its radius
OPACITY = 0.16, 0.9  # of what a blade sweeps over, least and most; chosen
SWEPT_PX = 2.0  # px, from which on drones are blurred by the motion; hulls need not be as exact as hats
EDGE_PX = 3.0  # px that OpenCV's smooth edges and the blur may be wider than the lines


class DroneImages(NamedTuple):
    """The drones over one exposure.

    Attributes:
        distances_m: of the drones from the camera.
        in_view: which of them may be in the picture.
        cameras_B: the camera in the body of each, (N, 3) [m].
        hats: of those in view, where their hats are seen.
        drones: what is to be drawn of each that is wholly before the camera.
    """

    distances_m: list[float]
    in_view: list[int]
    cameras_B: Array
    hats: dict[int, BallImage]
    drones: dict[int, DroneImage]


class _Poses(NamedTuple):
    """All drones in K: rotations B to K (N, 3, 3), centres and their ways during the exposure [m; K], cameras in B."""

    R_KB: Array
    centres: Array
    ways: Array
    cameras_B: Array


def hat_images(
    view: View, centres_K: Array, ways_K: Array, radius_m: float, brightness: float, sun_K: Array
) -> dict[int, BallImage]:
    """Return hats in front of the camera by their centres and how these move during the exposure, (M, 3) [m; K]."""
    if not len(centres_K):
        return {}
    ways_px = np.hypot(*view.flow_px(centres_K, ways_K).T)
    hats = Balls(centres_K, ways_K, view.pixels(centres_K), ways_px, radius_m, brightness * MAGENTA)
    return ball_images(view, hats, sun_K)


class DroneImager:
    """The drones of a scene as one camera sees them.

    Args:
        view: of the camera.
        scene: with the drones' looks.
        carrier: which of them carries the camera.
        exposure_s: time of exposure [s].
        brightness: of the light, as the sensor has it.
    """

    def __init__(self, view: View, scene: Scene, carrier: int, exposure_s: float, brightness: float) -> None:
        self._view, self._looks, self._carrier = view, scene.drones, carrier
        self._exposure_s, self._brightness = exposure_s, brightness
        self._models = [drone_model(look, brightness) for look in scene.drones]
        self._hat, self._radius_m = np.array(scene.hats.position_m), scene.hats.diameter_m / 2
        self._kinds: list[int] = []  # of each drone, the first that looks the same
        firsts: dict[tuple[bytes, bytes, float], int] = {}
        for i, look in enumerate(scene.drones):
            key = look.hubs_B.tobytes(), look.turns.tobytes(), look.radius_m
            self._kinds.append(firsts.setdefault(key, i))
        lens = view.lens
        self._edges = max(lens.cx, lens.width - lens.cx) / lens.fx, max(lens.cy, lens.height - lens.cy) / lens.fy
        self._slack = 1.5 if view.distorts else 1.05

    def images(self, motion: CameraMotion, t_s: float, bodies: DroneStates, R_WB: Array) -> DroneImages:
        """Return the drones, of attitudes R_WB (N, 3, 3), over an exposure about t_s [s]."""
        R_KB = motion.R_WK.T @ R_WB
        centres = motion.points_K(bodies.p_WB)
        hats = centres + R_KB @ self._hat
        hat_velocities = bodies.v_WB + np.einsum("nij,nj->ni", R_WB, bodies.w_WB_B @ -skew(self._hat).T)
        hat_ways = motion.rates_K(hats, hat_velocities) * self._exposure_s
        ways = motion.rates_K(centres, bodies.v_WB) * self._exposure_s
        cameras_B = np.einsum("nji,nj->ni", R_KB, -centres)
        distances = np.sqrt((centres * centres).sum(axis=-1))
        in_view = self._in_view(centres, distances)
        drones: dict[int, DroneImage] = {}
        for kind, which in self._by_kind(in_view).items():
            self._add(drones, kind, which, _Poses(R_KB, centres, ways, cameras_B), t_s, bodies)
        seen = self._hats([i for i in in_view if self._looks[i].has_hat], hats, hat_ways, SUN_W @ motion.R_WK)
        return DroneImages(distances.tolist(), in_view, cameras_B, seen, drones)

    def _hats(self, which: list[int], centres: Array, ways: Array, sun_K: Array) -> dict[int, BallImage]:
        shown = [i for i in which if centres[i, 2] > NEAR_M]
        images = hat_images(self._view, centres[shown], ways[shown], self._radius_m, self._brightness, sun_K)
        return {shown[k]: image for k, image in images.items()}

    def _in_view(self, centres: Array, distances: Array) -> list[int]:
        room = ROOM_M * max(model.size for model in self._models)
        across, down = (self._slack * edge for edge in self._edges)
        ahead = centres[:, 2] + room
        near = (np.abs(centres[:, 0]) - 2 * room < across * ahead) & (np.abs(centres[:, 1]) - 2 * room < down * ahead)
        near &= (distances < SEEN_M) & (ahead > 0)
        near[self._carrier] = False  # its own parts are not in its picture
        return np.flatnonzero(near).tolist()

    def _by_kind(self, which: list[int]) -> dict[int, list[int]]:
        groups: defaultdict[int, list[int]] = defaultdict(list)
        for i in which:
            groups[self._kinds[i]].append(i)
        return groups

    def _add(
        self, drones: dict[int, DroneImage], kind: int, which: list[int], poses: _Poses, t_s: float, bodies: DroneStates
    ) -> None:
        """Add the images of those drones of one look that are wholly before the camera."""
        points, speeds = self._points_K(kind, which, poses, t_s, bodies)
        whole = np.flatnonzero(points[:, 2].min(axis=1) > NEAR_M)
        if not len(whole):
            return
        model, near = self._models[kind], np.array(which)[whole]
        pixels = fixed(self._view.pixels(points[whole].transpose(0, 2, 1)))
        ways_px = self._view.flow_px(poses.centres[near], poses.ways[near])
        scales = self._view.lens.fx * model.size / poses.centres[near, 2]
        turned = np.abs(speeds[whole]) * self._exposure_s  # rad, of each rotor
        rows = zip(
            self._boxes(pixels, ways_px, scales),
            pixels,
            scales.tolist(),
            _sweeps(ways_px),
            (poses.cameras_B[near, 2] > 0.03 * model.size).tolist(),
            (poses.cameras_B[near, 0] > 0.1 * model.size).tolist(),
            np.clip(BLADE_RAD / np.maximum(turned.mean(axis=1), BLADE_RAD), *OPACITY).tolist(),
            (turned.min(axis=1) * BLADES >= 2 * math.pi).tolist(),
            strict=True,
        )
        drones.update(
            (i, DroneImage(model, *row)) for i, row in zip(near.tolist(), rows, strict=True) if has_pixels(row[0])
        )

    def _points_K(
        self, kind: int, which: list[int], poses: _Poses, t_s: float, bodies: DroneStates
    ) -> tuple[Array, Array]:
        """Return the points of drones of one look [m; K], (M, 3, P), and the speeds of their rotors, (M, R)."""
        look, model = self._looks[kind], self._models[kind]
        speeds = np.array([bodies.rotors[i] for i in which], float)
        blades = blade_points(look, model.size, t_s, self._exposure_s, speeds)
        of_model = np.broadcast_to(model.points, (len(which), *model.points.shape))
        points_B = np.concatenate([of_model, blades], axis=1).transpose(0, 2, 1)
        return poses.R_KB[which] @ points_B + poses.centres[which, :, None], speeds

    def _boxes(self, pixels: NDArray[np.int32], ways_px: Array, scales: Array) -> list[list[int]]:
        """Return the parts of the picture in which drones are, by the pixels of all their points, in sixteenths."""
        u, v, wide, high = np.array([cv2.boundingRect(each) for each in pixels]).T / (1 << SHIFT)
        lowest, highest = np.stack([u, v], axis=-1), np.stack([u + wide, v + high], axis=-1)
        half_way = np.minimum(np.abs(ways_px), film.SWEEP_MAX_PX) / 2
        room = EDGE_PX + half_way + np.minimum(MOTOR_WIDE_M * scales, THICKNESS_MAX_PX)[:, None] / 2
        return self._view.boxes(lowest - room, highest + room)


def _sweeps(ways_px: Array) -> list[NDArray[np.float32] | None]:
    """Return the kernels of ways (M, 2) [px]; None for one that is too short to be seen."""
    sweeps: list[NDArray[np.float32] | None] = [None] * len(ways_px)
    moved = np.flatnonzero(np.hypot(*ways_px.T) > SWEPT_PX).tolist()
    for i, kernel in zip(moved, film.sweep_kernels(ways_px[moved]) if moved else [], strict=True):
        sweeps[i] = kernel
    return sweeps
