"""Drones in the picture: hull, arms, motors, nose, lens, and rotors as their blades sweep during the exposure. Pure.

They look like the console's (zsim_bridges.console.scene.airframe); lengths are the AR.Drone's, scaled by the arms.
"""

import math
from collections import defaultdict
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim_agents.cameras.rendering import renderer
from zsim_agents.cameras.rendering.scene import (
    ARM_M,
    SUN_W,
    CameraMotion,
    DroneLook,
    DroneStates,
    Scene,
    View,
    has_pixels,
    skew,
)
from zsim_agents.cameras.rendering.shapes import NEAR_M, SHIFT, BallImage, Balls, ball_images, bgr, fixed

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Fixed = NDArray[np.int32]
Colour = tuple[float, float, float, float]  # B, G, R, and all of the light

CROSS, HULL, HULL_LOW, NOSE, ROTOR = (  # B, G, R; as the console has them, the hull's lower side in its own shade
    np.array([48.0, 44.0, 42.0]),
    np.array([96.0, 88.0, 84.0]),
    np.array([62.0, 57.0, 54.0]),
    np.array([24.0, 108.0, 240.0]),
    np.array([30.0, 28.0, 28.0]),
)
RING = 1.31  # rotor radii, outer radius of a hull ring
RING_POINTS = 16
RING_Z_M, RING_HIGH_M = 0.022, 0.042  # m, middle and height of a ring
ARM_Z_M, ARM_WIDE_M = 0.004, 0.014  # m
ROTOR_Z_M, ROTOR_CHORD_M = 0.030, 0.016  # m
LENS_M = 0.013  # m, radius
MOTOR_WIDE_M = 0.034  # m
REACH_M = 0.36  # m, farthest point of the AR.Drone from its middle, rotors and hull
SECTOR = 5  # points of a blade's sweep along the circle
BLADES = 2
DETAIL_PX = 14.0  # across; of smaller ones neither rings nor rotors are told apart
THICKNESS_MAX_PX = 80


class Colours(NamedTuple):
    """The colours of a drone in the light of the day."""

    cross: Colour
    hull: Colour
    hull_low: Colour
    nose: Colour
    rotor: Colour


class DroneModel(NamedTuple):
    """A drone: points (P, 3) [m; B], part by part, how much larger it is than the AR.Drone, and its colours."""

    points: Array
    parts: dict[str, slice]
    rotors: int
    size: float
    colours: Colours


def _ellipsoid(middle: float, length: float, width: float, height: float, points: int) -> Array:
    """Return points of an ellipsoid whose outline in any direction is about its own."""
    k = np.arange(points) + 0.5
    z = 1 - 2 * k / points  # Fibonacci's lattice
    r, angle = np.sqrt(1 - z * z), math.pi * (3 - math.sqrt(5)) * k
    unit = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)
    return unit * (length / 2, width / 2, height / 2) + (middle, 0.0, 0.012)


_BODY_POINTS, _NOSE_POINTS = 40, 20
_BLADES = math.pi * np.arange(BLADES)  # rad, of each over the first
_SWEEP = np.linspace(-0.5, 0.5, SECTOR)


def drone_model(look: DroneLook, brightness: float) -> DroneModel:
    """Return a drone in light of a brightness."""
    size = float(np.hypot(*look.hubs_B.T).max()) / ARM_M
    angles = 2 * math.pi * np.arange(RING_POINTS) / RING_POINTS
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(RING_POINTS)], axis=-1)
    hubs = np.column_stack([look.hubs_B, np.zeros(len(look.hubs_B))])
    rings = hubs[:, None] + RING * look.radius_m * circle + np.array([0.0, 0.0, RING_Z_M * size])
    arms = np.stack([np.zeros_like(hubs), hubs], axis=1) + np.array([0.0, 0.0, ARM_Z_M * size])
    motors = np.stack([hubs, hubs + np.array([0.0, 0.0, ROTOR_Z_M * size])], axis=1)
    points = {
        "body": size * _ellipsoid(0.0, 0.28, 0.09, 0.065, _BODY_POINTS),
        "nose": size * _ellipsoid(0.115, 0.105, 0.084, 0.065, _NOSE_POINTS),
        "lens": size * np.array([[0.165, 0.0, 0.012]]),
        "arms": arms.reshape(-1, 3),
        "motors": motors.reshape(-1, 3),
        "rings": rings.reshape(-1, 3),
    }
    ends = np.cumsum([len(part) for part in points.values()]).tolist()
    parts = {name: slice(end - len(points[name]), end) for name, end in zip(points, ends, strict=True)}
    colours = Colours(*((*bgr(brightness * each), 255.0) for each in (CROSS, HULL, HULL_LOW, NOSE, ROTOR)))
    return DroneModel(np.concatenate([*points.values()]), parts, len(hubs), size, colours)


def blade_points(look: DroneLook, size: float, t_s: float, exposure_s: float, speeds: Array) -> Array:
    """Return what blades sweep over the exposure, (..., R BLADES (SECTOR + 1), 3) [m; B]: hub, then along the circle.

    Rotors have no angle in the truth: it is taken as their speed times the time, which nobody can tell from another.

    Args:
        speeds: of the rotors, (..., R) [rad/s].
    """
    middle = np.remainder(-look.turns * speeds * t_s, 2 * math.pi)
    sweep = np.clip(np.abs(speeds) * exposure_s, 2 * ROTOR_CHORD_M * size / look.radius_m, math.pi)
    angles = (middle[..., None] + _BLADES)[..., None] + sweep[..., None, None] * _SWEEP
    points = np.zeros((*angles.shape[:-1], SECTOR + 1, 3))
    points[..., 1:, 0] = look.radius_m * np.cos(angles)
    points[..., 1:, 1] = look.radius_m * np.sin(angles)
    points[..., :2] += look.hubs_B[:, None, None]
    points[..., 2] = ROTOR_Z_M * size
    return points.reshape(*speeds.shape[:-1], -1, 3)


class DroneImage(NamedTuple):
    """A drone as it is to be drawn.

    Attributes:
        model: what it looks like.
        box: the part of the picture that it is in, u0, v0, u1, v1.
        pixels: of the model's points, then of its blades' sweeps, in sixteenths, (P + R BLADES (SECTOR + 1), 2).
        scale: px/m of the AR.Drone.
        sweep: kernel of its motion during the exposure; None if it does not move.
        from_above: whether the camera is above its rotors.
        shows_lens: whether the camera is before it.
        opacity: of what a blade sweeps over.
        whole_turns: whether the blades of each rotor leave nothing of its circle out.
    """

    model: DroneModel
    box: list[int]
    pixels: Fixed
    scale: float
    sweep: NDArray[np.float32] | None
    from_above: bool
    shows_lens: bool
    opacity: float
    whole_turns: bool


def draw_drone(picture: Picture, drone: DroneImage) -> None:
    """Draw a drone but its hat; if it moves, its light and what it covers are blurred apart from what is behind."""
    u0, v0, u1, v1 = drone.box
    part = picture[v0:v1, u0:u1]
    pixels = drone.pixels - np.array([u0, v0], np.int32) * (1 << SHIFT)
    if drone.sweep is None:
        _draw(part, drone, pixels)
        return
    layer = np.zeros((*part.shape[:2], 4), np.uint8)
    _draw(layer, drone, pixels)
    cv2.filter2D(layer, -1, drone.sweep, dst=layer, borderType=cv2.BORDER_REPLICATE)
    passes = cv2.bitwise_not(cv2.extractChannel(layer, 3))
    cv2.multiply(part, cv2.merge([passes] * 3), dst=part, scale=1 / 255)
    cv2.add(part, cv2.cvtColor(layer, cv2.COLOR_BGRA2BGR), dst=part)


def _draw(picture: Picture, drone: DroneImage, pixels: Fixed) -> None:
    """Draw a drone over a picture, or into an empty layer of four channels, the last of which is what it covers."""
    scale, parts, colours = drone.scale, drone.model.parts, drone.model.colours
    hull = colours.hull if drone.from_above else colours.hull_low
    detailed = 2 * REACH_M * scale > DETAIL_PX
    if detailed and not drone.from_above:
        _rotors(picture, drone, pixels)
    _lines(picture, pixels[parts["rings"]].reshape(-1, RING_POINTS, 2), True, hull, 0.6 * RING_HIGH_M * scale)
    _lines(picture, pixels[parts["arms"]].reshape(-1, 2, 2), False, colours.cross, ARM_WIDE_M * scale)
    if detailed:
        _lines(picture, pixels[parts["motors"]].reshape(-1, 2, 2), False, colours.cross, MOTOR_WIDE_M * scale)
    _hull(picture, pixels[parts["body"]], hull)
    if drone.shows_lens:
        _hull(picture, pixels[parts["nose"]], colours.nose)
        if detailed:
            _dot(picture, pixels[parts["lens"]][0], LENS_M * scale, colours.cross)
    if detailed and drone.from_above:
        _rotors(picture, drone, pixels)


def _lines(picture: Picture, lines: Fixed, closed: bool, colour: Colour, wide_px: float) -> None:
    thickness = min(max(1, round(wide_px)), THICKNESS_MAX_PX)
    cv2.polylines(picture, [*lines], closed, colour, thickness, cv2.LINE_AA, SHIFT)


def _hull(picture: Picture, pixels: Fixed, colour: Colour) -> None:
    cv2.fillConvexPoly(picture, cv2.convexHull(pixels), colour, cv2.LINE_AA, SHIFT)


def _dot(picture: Picture, pixel: Fixed, radius_px: float, colour: Colour) -> None:
    u, v = pixel.tolist()
    cv2.circle(picture, (u, v), round(max(radius_px, 0.5) * (1 << SHIFT)), colour, cv2.FILLED, cv2.LINE_AA, SHIFT)


def _rotors(picture: Picture, drone: DroneImage, pixels: Fixed) -> None:
    """Darken what the blades sweep over."""
    swept = picture.copy()
    sectors = pixels[len(drone.model.points) :].reshape(-1, SECTOR + 1, 2)
    circles = sectors[:, 1:].reshape(-1, BLADES * SECTOR, 2)
    for sweep in circles if drone.whole_turns else sectors:
        cv2.fillConvexPoly(swept, sweep, drone.model.colours.rotor, cv2.LINE_AA, SHIFT)
    cv2.addWeighted(swept, drone.opacity, picture, 1 - drone.opacity, 0.0, dst=picture)


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
        half_way = np.minimum(np.abs(ways_px), renderer.SWEEP_MAX_PX) / 2
        room = EDGE_PX + half_way + np.minimum(MOTOR_WIDE_M * scales, THICKNESS_MAX_PX)[:, None] / 2
        return self._view.boxes(lowest - room, highest + room)


def _sweeps(ways_px: Array) -> list[NDArray[np.float32] | None]:
    """Return the kernels of ways (M, 2) [px]; None for one that is too short to be seen."""
    sweeps: list[NDArray[np.float32] | None] = [None] * len(ways_px)
    moved = np.flatnonzero(np.hypot(*ways_px.T) > SWEPT_PX).tolist()
    for i, kernel in zip(moved, renderer.sweep_kernels(ways_px[moved]) if moved else [], strict=True):
        sweeps[i] = kernel
    return sweeps
