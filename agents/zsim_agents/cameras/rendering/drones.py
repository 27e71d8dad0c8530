"""The drones in one camera's picture: hulls, arms, motors, rotors as their blades sweep, and hats. Pure.

They look like the console's (zsim_bridges.console.airframe); lengths are the AR.Drone's, scaled by the arms.
All drones of a picture are computed together.
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim_agents.cameras.rendering.scene import (
    ARM_M,
    BLUR_MAX_PX,
    SUN_W,
    CameraMotion,
    DroneLook,
    DroneStates,
    Kernel,
    Scene,
    View,
    has_pixels,
    motion_blur_kernels,
    skew,
)
from zsim_agents.cameras.rendering.shapes import NEAR_M, SHIFT, BallImage, ball_images, bgr, fixed

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Fixed = NDArray[np.int32]
Colour = tuple[float, float, float, float]  # B, G, R, and an opaque fourth

MAGENTA = np.array([134.0, 0.0, 226.0])  # B, G, R of the paper's marker
COLOURS = {  # B, G, R; those of the console, the lower side of the hull in its own shade
    "cross": np.array([48.0, 44.0, 42.0]),
    "hull": np.array([96.0, 88.0, 84.0]),
    "hull_low": np.array([62.0, 57.0, 54.0]),
    "nose": np.array([24.0, 108.0, 240.0]),
    "rotor": np.array([30.0, 28.0, 28.0]),
}
RING = 1.31  # rotor radii, outer radius of a hull ring
RING_POINTS = 16
RING_Z_M, RING_HIGH_M = 0.022, 0.042  # m, middle and height of a ring
ARM_Z_M, ARM_WIDE_M = 0.004, 0.014  # m
ROTOR_Z_M, ROTOR_CHORD_M = 0.030, 0.016  # m
LENS_M = 0.013  # m, radius
MOTOR_WIDE_M = 0.034  # m
REACH_M = 0.36  # m, farthest point of the AR.Drone from its middle, rotors and hull
BODY_POINTS, NOSE_POINTS = 40, 20
SECTOR = 5  # points of a blade's sweep along the circle
BLADES = 2
BLADE_RAD = 0.3  # rad of the circle that a blade covers, at two thirds of its radius
OPACITY = 0.16, 0.9  # of a blade's sweep, least and most; chosen
DETAIL_PX = 14.0  # across; smaller drones are drawn without lens, motors and rotors
THICKNESS_MAX_PX = 80
SEEN_M = 300.0  # m; farther drones are less than a pixel
ROOM_M = 0.5  # m; no part is farther from the middle of a drone with arms of 0.18 m
BLURRED_PX = 2.0  # px of motion from which drones are blurred; hulls need not be as exact as hats
EDGE_PX = 3.0  # px by which smooth edges and the blur may exceed the lines


class DroneImager:
    """The drones of a scene as one camera sees them.

    Args:
        carrier: index of the drone that carries the camera.
        exposure_s: time of exposure [s].
        brightness: of the light, as the sensor has it.
    """

    def __init__(self, view: View, scene: Scene, carrier: int, exposure_s: float, brightness: float) -> None:
        self._view, self._looks, self._carrier = view, scene.drones, carrier
        self._exposure_s, self._brightness = exposure_s, brightness
        self._models = [_model(look, brightness) for look in scene.drones]
        self._hat, self._radius_m = np.array(scene.hats.position_m), scene.hats.diameter_m / 2
        self._kinds: list[int] = []  # for each drone, the first one that looks the same
        firsts: dict[tuple[bytes, bytes, float], int] = {}
        for i, look in enumerate(scene.drones):
            key = look.hubs_B.tobytes(), look.turns.tobytes(), look.radius_m
            self._kinds.append(firsts.setdefault(key, i))
        lens = view.lens
        slack = 1.5 if view.distorts else 1.05
        self._across = slack * (max(lens.cx, lens.width - lens.cx) / lens.fx)
        self._down = slack * (max(lens.cy, lens.height - lens.cy) / lens.fy)

    def images(
        self, motion: CameraMotion, t_s: float, bodies: DroneStates, R_WB: Array
    ) -> dict[int, tuple[float, list[BallImage | DroneImage]]]:
        """Return the drones that may be in the picture over an exposure about t_s [s], by their index.

        Returns:
            The distance from the camera [m], and the images of the drone (if it is wholly in front of the camera) and
            of its hat (if visible), in drawing order.
        """
        R_KB = motion.R_WK.T @ R_WB
        centres = motion.points_K(bodies.p_WB)
        ways = motion.rates_K(centres, bodies.v_WB) * self._exposure_s
        cameras_B = np.einsum("nji,nj->ni", R_KB, -centres)
        distances = np.sqrt((centres * centres).sum(axis=-1))
        in_view = self._in_view(centres, distances)
        kinds: defaultdict[int, list[int]] = defaultdict(list)
        for i in in_view:
            kinds[self._kinds[i]].append(i)
        drones: dict[int, DroneImage] = {}
        for kind, which in kinds.items():
            drones |= self._images(kind, which, _Poses(R_KB, centres, ways, cameras_B), t_s, bodies)
        hats = centres + R_KB @ self._hat
        hat_velocities = bodies.v_WB + np.einsum("nij,nj->ni", R_WB, bodies.w_WB_B @ -skew(self._hat).T)
        hat_ways = motion.rates_K(hats, hat_velocities) * self._exposure_s
        shown = [i for i in in_view if self._looks[i].has_hat and hats[i, 2] > NEAR_M]
        seen = {shown[k]: image for k, image in self.hats(hats[shown], hat_ways[shown], motion).items()}
        images: dict[int, tuple[float, list[BallImage | DroneImage]]] = {}
        for i in in_view:
            layers = [image for image in (drones.get(i), seen.get(i)) if image is not None]
            hat_is_behind = not cameras_B[i, 2] > self._hat[2] - self._radius_m
            images[i] = float(distances[i]), layers[::-1] if hat_is_behind else layers
        return images

    def hats(self, centres_K: Array, ways_K: Array, motion: CameraMotion) -> dict[int, BallImage]:
        """Return the images of hats in front of the camera by their index; arguments as of `ball_images`."""
        colour = self._brightness * MAGENTA
        return ball_images(self._view, centres_K, ways_K, self._radius_m, colour, SUN_W @ motion.R_WK)

    def _in_view(self, centres: Array, distances: Array) -> list[int]:
        room = ROOM_M * max(model.size for model in self._models)
        ahead = centres[:, 2] + room
        near = np.abs(centres[:, 0]) - 2 * room < self._across * ahead
        near &= np.abs(centres[:, 1]) - 2 * room < self._down * ahead
        near &= (distances < SEEN_M) & (ahead > 0)
        near[self._carrier] = False  # its own parts are not in its picture
        return np.flatnonzero(near).tolist()

    def _images(
        self, kind: int, which: list[int], poses: _Poses, t_s: float, bodies: DroneStates
    ) -> dict[int, DroneImage]:
        """Return the images of drones of one look, of those that are wholly in front of the camera."""
        look, model = self._looks[kind], self._models[kind]
        speeds = np.array([bodies.rotors[i] for i in which], float)
        blades = _blade_points(look, model.size, t_s, self._exposure_s, speeds)
        of_model = np.broadcast_to(model.points, (len(which), *model.points.shape))
        points_B = np.concatenate([of_model, blades], axis=1).transpose(0, 2, 1)
        points = poses.R_KB[which] @ points_B + poses.centres[which, :, None]
        whole = np.flatnonzero(points[:, 2].min(axis=1) > NEAR_M)
        if not len(whole):
            return {}
        near = np.array(which)[whole]
        pixels = fixed(self._view.pixels(points[whole].transpose(0, 2, 1)))
        ways_px = self._view.flow_px(poses.centres[near], poses.ways[near])
        scales = self._view.lens.fx * model.size / poses.centres[near, 2]
        turned = np.abs(speeds[whole]) * self._exposure_s  # rad, of each rotor
        rows = zip(
            self._boxes(pixels, ways_px, scales),
            pixels,
            scales.tolist(),
            _blurs(ways_px),
            (poses.cameras_B[near, 2] > 0.03 * model.size).tolist(),
            (poses.cameras_B[near, 0] > 0.1 * model.size).tolist(),
            np.clip(BLADE_RAD / np.maximum(turned.mean(axis=1), BLADE_RAD), *OPACITY).tolist(),
            (turned.min(axis=1) * BLADES >= 2 * math.pi).tolist(),
            strict=True,
        )
        return {i: DroneImage(model, *row) for i, row in zip(near.tolist(), rows, strict=True) if has_pixels(row[0])}

    def _boxes(self, pixels: Fixed, ways_px: Array, scales: Array) -> list[list[int]]:
        """Return the parts of the picture that contain drones, by the pixels of all their points in sixteenths."""
        u, v, wide, high = np.array([cv2.boundingRect(each) for each in pixels]).T / (1 << SHIFT)
        lowest, highest = np.stack([u, v], axis=-1), np.stack([u + wide, v + high], axis=-1)
        half_way = np.minimum(np.abs(ways_px), BLUR_MAX_PX) / 2
        room = EDGE_PX + half_way + np.minimum(MOTOR_WIDE_M * scales, THICKNESS_MAX_PX)[:, None] / 2
        return self._view.boxes(lowest - room, highest + room)


class _Poses(NamedTuple):
    """All drones in K: rotations B to K (N, 3, 3), centres and their motion over the exposure [m; K], cameras in B."""

    R_KB: Array
    centres: Array
    ways: Array
    cameras_B: Array


def _blurs(ways_px: Array) -> list[Kernel | None]:
    """Return the blur kernels of motions (M, 2) [px]; None for one that is too short to be seen."""
    blurs: list[Kernel | None] = [None] * len(ways_px)
    moved = np.flatnonzero(np.hypot(*ways_px.T) > BLURRED_PX).tolist()
    for i, kernel in zip(moved, motion_blur_kernels(ways_px[moved]) if moved else [], strict=True):
        blurs[i] = kernel
    return blurs


class _DroneModel(NamedTuple):
    """Points (P, 3) [m; B] of a drone part by part, its size relative to the AR.Drone, and its colours in the light."""

    points: Array
    parts: dict[str, slice]
    size: float
    colours: dict[str, Colour]


def _model(look: DroneLook, brightness: float) -> _DroneModel:
    size = float(np.hypot(*look.hubs_B.T).max()) / ARM_M
    angles = 2 * math.pi * np.arange(RING_POINTS) / RING_POINTS
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(RING_POINTS)], axis=-1)
    hubs = np.column_stack([look.hubs_B, np.zeros(len(look.hubs_B))])
    rings = hubs[:, None] + RING * look.radius_m * circle + np.array([0.0, 0.0, RING_Z_M * size])
    arms = np.stack([np.zeros_like(hubs), hubs], axis=1) + np.array([0.0, 0.0, ARM_Z_M * size])
    motors = np.stack([hubs, hubs + np.array([0.0, 0.0, ROTOR_Z_M * size])], axis=1)
    points = {
        "body": size * _ellipsoid(0.0, 0.28, 0.09, 0.065, BODY_POINTS),
        "nose": size * _ellipsoid(0.115, 0.105, 0.084, 0.065, NOSE_POINTS),
        "lens": size * np.array([[0.165, 0.0, 0.012]]),
        "arms": arms.reshape(-1, 3),
        "motors": motors.reshape(-1, 3),
        "rings": rings.reshape(-1, 3),
    }
    ends = np.cumsum([len(part) for part in points.values()]).tolist()
    parts = {name: slice(end - len(points[name]), end) for name, end in zip(points, ends, strict=True)}
    colours = {name: (*bgr(brightness * each), 255.0) for name, each in COLOURS.items()}
    return _DroneModel(np.concatenate([*points.values()]), parts, size, colours)


def _ellipsoid(middle: float, length: float, width: float, height: float, points: int) -> Array:
    """Return points of an ellipsoid that give its outline from any direction."""
    k = np.arange(points) + 0.5
    z = 1 - 2 * k / points  # Fibonacci's lattice
    r, angle = np.sqrt(1 - z * z), math.pi * (3 - math.sqrt(5)) * k
    unit = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)
    return unit * (length / 2, width / 2, height / 2) + (middle, 0.0, 0.012)


def _blade_points(look: DroneLook, size: float, t_s: float, exposure_s: float, speeds: Array) -> Array:
    """Return the sweeps of blades over an exposure, (..., R BLADES (SECTOR + 1), 3) [m; B]: hub, then the arc.

    The truth has no rotor angles: speed times time serves, since nobody can tell the difference.

    Args:
        speeds: of the rotors, (..., R) [rad/s].
    """
    middle = np.remainder(-look.turns * speeds * t_s, 2 * math.pi)
    sweep = np.clip(np.abs(speeds) * exposure_s, 2 * ROTOR_CHORD_M * size / look.radius_m, math.pi)
    blades, along = math.pi * np.arange(BLADES), np.linspace(-0.5, 0.5, SECTOR)
    angles = (middle[..., None] + blades)[..., None] + sweep[..., None, None] * along
    points = np.zeros((*angles.shape[:-1], SECTOR + 1, 3))
    points[..., 1:, 0] = look.radius_m * np.cos(angles)
    points[..., 1:, 1] = look.radius_m * np.sin(angles)
    points[..., :2] += look.hubs_B[:, None, None]
    points[..., 2] = ROTOR_Z_M * size
    return points.reshape(*speeds.shape[:-1], -1, 3)


class DroneImage(NamedTuple):
    """A drone to be drawn.

    Attributes:
        box: the part of the picture that contains it, u0, v0, u1, v1.
        pixels: of the model's points, then of its blades' sweeps, in sixteenths, (P + R BLADES (SECTOR + 1), 2).
        scale: px/m of the AR.Drone.
        blur: kernel of its motion during the exposure; None if it does not move.
        from_above: whether the camera is above its rotors.
        shows_lens: whether the camera is in front of it.
        opacity: of a blade's sweep.
        whole_turns: whether the blades of each rotor cover its whole circle.
    """

    model: _DroneModel
    box: list[int]
    pixels: Fixed
    scale: float
    blur: Kernel | None
    from_above: bool
    shows_lens: bool
    opacity: float
    whole_turns: bool

    def draw(self, picture: Picture) -> None:
        """Draw the drone without its hat; a moving one in a layer of its own, so that the background stays sharp."""
        u0, v0, u1, v1 = self.box
        part = picture[v0:v1, u0:u1]
        pixels = self.pixels - np.array([u0, v0], np.int32) * (1 << SHIFT)
        if self.blur is None:
            self._draw(part, pixels)
            return
        layer = np.zeros((*part.shape[:2], 4), np.uint8)  # the fourth channel is what the drone covers
        self._draw(layer, pixels)
        cv2.filter2D(layer, -1, self.blur, dst=layer, borderType=cv2.BORDER_REPLICATE)
        passes = cv2.bitwise_not(cv2.extractChannel(layer, 3))
        cv2.multiply(part, cv2.merge([passes] * 3), dst=part, scale=1 / 255)
        cv2.add(part, cv2.cvtColor(layer, cv2.COLOR_BGRA2BGR), dst=part)

    def _draw(self, picture: Picture, pixels: Fixed) -> None:
        scale, parts, colours = self.scale, self.model.parts, self.model.colours
        hull = colours["hull" if self.from_above else "hull_low"]
        detailed = 2 * REACH_M * scale > DETAIL_PX
        if detailed and not self.from_above:
            self._draw_rotors(picture, pixels)
        _lines(picture, pixels[parts["rings"]].reshape(-1, RING_POINTS, 2), True, hull, 0.6 * RING_HIGH_M * scale)
        _lines(picture, pixels[parts["arms"]].reshape(-1, 2, 2), False, colours["cross"], ARM_WIDE_M * scale)
        if detailed:
            _lines(picture, pixels[parts["motors"]].reshape(-1, 2, 2), False, colours["cross"], MOTOR_WIDE_M * scale)
        _fill_hull(picture, pixels[parts["body"]], hull)
        if self.shows_lens:
            _fill_hull(picture, pixels[parts["nose"]], colours["nose"])
            if detailed:
                u, v = pixels[parts["lens"]][0].tolist()
                radius = round(max(LENS_M * scale, 0.5) * (1 << SHIFT))
                cv2.circle(picture, (u, v), radius, colours["cross"], cv2.FILLED, cv2.LINE_AA, SHIFT)
        if detailed and self.from_above:
            self._draw_rotors(picture, pixels)

    def _draw_rotors(self, picture: Picture, pixels: Fixed) -> None:
        """Darken the sweeps of the blades."""
        swept = picture.copy()
        sectors = pixels[len(self.model.points) :].reshape(-1, SECTOR + 1, 2)
        circles = sectors[:, 1:].reshape(-1, BLADES * SECTOR, 2)
        for sweep in circles if self.whole_turns else sectors:
            cv2.fillConvexPoly(swept, sweep, self.model.colours["rotor"], cv2.LINE_AA, SHIFT)
        cv2.addWeighted(swept, self.opacity, picture, 1 - self.opacity, 0.0, dst=picture)


def _lines(picture: Picture, lines: Fixed, closed: bool, colour: Colour, wide_px: float) -> None:
    thickness = min(max(1, round(wide_px)), THICKNESS_MAX_PX)
    cv2.polylines(picture, [*lines], closed, colour, thickness, cv2.LINE_AA, SHIFT)


def _fill_hull(picture: Picture, pixels: Fixed, colour: Colour) -> None:
    cv2.fillConvexPoly(picture, cv2.convexHull(pixels), colour, cv2.LINE_AA, SHIFT)
