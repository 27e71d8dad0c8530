"""The foreground of a camera's picture: drones, hats, obstacles and surfaces. No I/O.

A drone consists of hull, arms, motors, the sweeps of its rotor blades, and a hat. It looks as in the console
(zsim_bridges.console.scene), with the AR.Drone's dimensions scaled by the length of the arms. All drones in a picture
are computed together.

A ray hits a ball, such as a hat, if its distance from the ball's centre is at most the radius. This is exact anywhere
in the picture and for any lens; the edge is antialiased over one pixel, so that the drawn centre is the projected
centre. Faces of obstacles are clipped to the space in front of the camera, distorted by the lens, and shaded by the
sun.
"""

from __future__ import annotations

import math
from collections import defaultdict
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.scenario.surroundings import BOX, CENTRE, COSINE, HALF, SHAPE, SINE, SPHERE, corners_of
from zsim_agents.cameras.scene import (
    ARM_M,
    BLUR_MAX_PX,
    SHIFT,
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

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Fixed = NDArray[np.int32]
Colour = tuple[float, float, float, float]  # B, G, R and opacity

MAGENTA = np.array([134.0, 0.0, 226.0])  # B, G, R of the paper's marker
COLOURS = {  # B, G, R, as in the console, except for the darker underside of the hull
    "cross": np.array([48.0, 44.0, 42.0]),
    "hull": np.array([96.0, 88.0, 84.0]),
    "hull_low": np.array([62.0, 57.0, 54.0]),
    "nose": np.array([24.0, 108.0, 240.0]),
    "rotor": np.array([30.0, 28.0, 28.0]),
}
RING = 1.31  # outer radius of the hull's ring around a rotor, over the rotor radius
RING_POINTS = 16
RING_Z_M, RING_HEIGHT_M = 0.022, 0.042  # z of a ring at mid-height, and height of the ring
ARM_Z_M, ARM_WIDTH_M = 0.004, 0.014
ROTOR_Z_M, ROTOR_CHORD_M = 0.030, 0.016
LENS_M = 0.013  # radius of the lens on a drone's nose
MOTOR_WIDTH_M = 0.034
REACH_M = 0.36  # distance from the AR.Drone's centre to the farthest point of its rotors and hull
BODY_POINTS, NOSE_POINTS = 40, 20
SECTOR_POINTS = 5  # points along the arc of a blade's sweep
BLADES = 2
BLADE_RAD = 0.3  # angle that a blade covers at two thirds of its radius
OPACITY = 0.16, 0.9  # minimum and maximum opacity of a blade's sweep; tuned by eye
DETAIL_PX = 14.0  # width of a drone above which its lens, motors and rotors are drawn
THICKNESS_MAX_PX = 80
VISIBLE_MAX_M = 300.0  # distance beyond which drones are smaller than a pixel
EXTENT_MAX_M = 0.5  # upper bound on the distance of any part of an AR.Drone from its centre
BLUR_MIN_PX = 2.0  # motion above which drones are blurred; hulls need not be as exact as hats
EDGE_PX = 3.0  # distance by which antialiased edges and blur may extend beyond lines
Levels = NDArray[np.float32]
AMBIENT, DIFFUSE = 0.72, 0.28  # shares of the light from the sky and from the sun, for matt foam outdoors
STEPS_MAX = 6  # maximum number of times within an exposure at which a moving ball is drawn
STEP_PX = 0.8  # motion between consecutive times of drawing
ROUNDING = np.float32(0.5)
AXIS = np.array([0.0, 0.0, 1.0])
NEAR_M = 0.05  # depth below which nothing is drawn
FAR_PX = 16_000.0  # limit of coordinates: with SHIFT fractional bits they must fit 32 bits, and long lines are slow
SIDES = 24  # number of sides that approximate a cylinder
PIECES = 8  # number of straight segments that approximate an edge bent by the lens
OBSTACLE = np.array([92.0, 118.0, 146.0])  # B, G, R of weathered wood, far from magenta
SURFACE = np.array([102.0, 116.0, 124.0])  # B, G, R of stone, far from magenta
BENT_PX = 24.0  # size of a triangle above which the lens visibly bends its edges


class DroneImager:
    """Computes the images of a scene's drones in a camera on drone number `carrier`.

    `brightness` scales the colours; it is 1 on a clear day.
    """

    def __init__(self, view: View, scene: Scene, carrier: int, exposure_s: float, brightness: float) -> None:
        self._view, self._looks, self._carrier = view, scene.drones, carrier
        self._exposure_s, self._brightness = exposure_s, brightness
        self._models = [_model(look, brightness) for look in scene.drones]
        self._hat, self._radius_m = np.array(scene.hats.position_m), scene.hats.diameter_m / 2
        self._kinds: list[int] = []  # for each drone, the index of the first one that looks the same
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
        """Return the images of the drones that may be in the picture of an exposure centred on `t_s`, by drone index.

        Returns:
            For each drone, its distance from the camera [m], and the images of the drone (if entirely in front of the
            camera) and of its hat (if visible), in drawing order.
        """
        R_KB = motion.R_WK.T @ R_WB
        centres = motion.points_K(bodies.p_WB)
        displacements = motion.rates_K(centres, bodies.v_WB) * self._exposure_s
        cameras_B = np.einsum("nji,nj->ni", R_KB, -centres)
        distances = np.sqrt((centres * centres).sum(axis=-1))
        margin_m = EXTENT_MAX_M * max(model.size for model in self._models)
        depth_limit = centres[:, 2] + margin_m
        is_candidate = np.abs(centres[:, 0]) - 2 * margin_m < self._across * depth_limit
        is_candidate &= np.abs(centres[:, 1]) - 2 * margin_m < self._down * depth_limit
        is_candidate &= (distances < VISIBLE_MAX_M) & (depth_limit > 0)
        is_candidate[self._carrier] = False  # no part of the carrier appears in its own picture
        in_view: list[int] = np.flatnonzero(is_candidate).tolist()
        kinds: defaultdict[int, list[int]] = defaultdict(list)
        for i in in_view:
            kinds[self._kinds[i]].append(i)
        drones: dict[int, DroneImage] = {}
        for kind, indices in kinds.items():
            drones |= self._images(kind, indices, _Poses(R_KB, centres, displacements, cameras_B), t_s, bodies)
        hats = centres + R_KB @ self._hat
        hat_velocities = bodies.v_WB + np.einsum("nij,nj->ni", R_WB, bodies.w_WB_B @ -skew(self._hat).T)
        hat_displacements = motion.rates_K(hats, hat_velocities) * self._exposure_s
        shown = [i for i in in_view if self._looks[i].has_hat and hats[i, 2] > NEAR_M]
        seen = {shown[k]: image for k, image in self.hats(hats[shown], hat_displacements[shown], motion).items()}
        images: dict[int, tuple[float, list[BallImage | DroneImage]]] = {}
        for i in in_view:
            layers = [image for image in (drones.get(i), seen.get(i)) if image is not None]
            is_hat_behind = not cameras_B[i, 2] > self._hat[2] - self._radius_m
            images[i] = float(distances[i]), layers[::-1] if is_hat_behind else layers
        return images

    def hats(self, centres_K: Array, displacements_K: Array, motion: CameraMotion) -> dict[int, BallImage]:
        """Return the images of hats in front of the camera, by index; for the arguments see `ball_images`."""
        colour = self._brightness * MAGENTA
        return ball_images(self._view, centres_K, displacements_K, self._radius_m, colour, SUN_W @ motion.R_WK)

    def _images(
        self, kind: int, indices: list[int], poses: _Poses, t_s: float, bodies: DroneStates
    ) -> dict[int, DroneImage]:
        """Return the images of those drones in `indices`, all of one look, that are entirely in front of the camera."""
        look, model = self._looks[kind], self._models[kind]
        speeds = np.array([bodies.rotors[i] for i in indices], float)
        blades = _blade_points(look, model.size, t_s, self._exposure_s, speeds)
        model_points = np.broadcast_to(model.points, (len(indices), *model.points.shape))
        points_B = np.concatenate([model_points, blades], axis=1).transpose(0, 2, 1)
        points = poses.R_KB[indices] @ points_B + poses.centres[indices, :, None]
        in_front = np.flatnonzero(points[:, 2].min(axis=1) > NEAR_M)
        if not len(in_front):
            return {}
        visible = np.array(indices)[in_front]
        pixels = to_fixed_point(self._view.pixels(points[in_front].transpose(0, 2, 1)))
        displacements_px = self._view.flow_px(poses.centres[visible], poses.displacements[visible])
        scales = self._view.lens.fx * model.size / poses.centres[visible, 2]
        turns_rad = np.abs(speeds[in_front]) * self._exposure_s  # angle by which each rotor turns [rad]
        blurs: list[Kernel | None] = [None] * len(visible)
        blurred = np.flatnonzero(np.hypot(*displacements_px.T) > BLUR_MIN_PX).tolist()
        for i, kernel in zip(blurred, motion_blur_kernels(displacements_px[blurred]) if blurred else [], strict=True):
            blurs[i] = kernel
        rows = zip(
            self._boxes(pixels, displacements_px, scales),
            pixels,
            scales.tolist(),
            blurs,
            (poses.cameras_B[visible, 2] > 0.03 * model.size).tolist(),
            (poses.cameras_B[visible, 0] > 0.1 * model.size).tolist(),
            np.clip(BLADE_RAD / np.maximum(turns_rad.mean(axis=1), BLADE_RAD), *OPACITY).tolist(),
            (turns_rad.min(axis=1) * BLADES >= 2 * math.pi).tolist(),
            strict=True,
        )
        return {
            i: DroneImage(model, *parameters)
            for i, parameters in zip(visible.tolist(), rows, strict=True)
            if has_pixels(parameters[0])
        }

    def _boxes(self, pixels: Fixed, displacements_px: Array, scales: Array) -> list[list[int]]:
        """Return the box around each drone in the picture, from its points in sixteenths of a pixel."""
        u, v, width, height = np.array([cv2.boundingRect(each) for each in pixels]).T / (1 << SHIFT)
        lowest, highest = np.stack([u, v], axis=-1), np.stack([u + width, v + height], axis=-1)
        half_displacement = np.minimum(np.abs(displacements_px), BLUR_MAX_PX) / 2
        margin = EDGE_PX + half_displacement + np.minimum(MOTOR_WIDTH_M * scales, THICKNESS_MAX_PX)[:, None] / 2
        return self._view.boxes(lowest - margin, highest + margin)


class _Poses(NamedTuple):
    """Poses of all drones: rotations B to K (N, 3, 3), centres and their motion in the exposure, (N, 3) each [m; K].

    `cameras_B` is the position of the camera relative to each drone, (N, 3) [m; B].
    """

    R_KB: Array
    centres: Array
    displacements: Array
    cameras_B: Array


class _DroneModel(NamedTuple):
    """A drone's points, part by part, (P, 3) [m; B], its size relative to the AR.Drone, and its lit colours."""

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
    """Return points of an ellipsoid that outline it from any direction."""
    k = np.arange(points) + 0.5
    z = 1 - 2 * k / points  # Fibonacci lattice
    r, angle = np.sqrt(1 - z * z), math.pi * (3 - math.sqrt(5)) * k
    unit = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)
    return unit * (length / 2, width / 2, height / 2) + (middle, 0.0, 0.012)


def _blade_points(look: DroneLook, size: float, t_s: float, exposure_s: float, speeds: Array) -> Array:
    """Return the blades' sweeps in an exposure, (..., R BLADES (SECTOR_POINTS + 1), 3) [m; B]: hub, then arc, of each.

    The truth contains no rotor angles, so speed times time is used; the difference is invisible.

    Args:
        speeds: speeds of the rotors, (..., R) [rad/s].
    """
    middle = np.remainder(-look.turns * speeds * t_s, 2 * math.pi)
    sweep = np.clip(np.abs(speeds) * exposure_s, 2 * ROTOR_CHORD_M * size / look.radius_m, math.pi)
    blades, along = math.pi * np.arange(BLADES), np.linspace(-0.5, 0.5, SECTOR_POINTS)
    angles = (middle[..., None] + blades)[..., None] + sweep[..., None, None] * along
    points = np.zeros((*angles.shape[:-1], SECTOR_POINTS + 1, 3))
    points[..., 1:, 0] = look.radius_m * np.cos(angles)
    points[..., 1:, 1] = look.radius_m * np.sin(angles)
    points[..., :2] += look.hubs_B[:, None, None]
    points[..., 2] = ROTOR_Z_M * size
    return points.reshape(*speeds.shape[:-1], -1, 3)


class DroneImage(NamedTuple):
    """A drone to be drawn.

    Attributes:
        box: the part of the picture that contains the drone: u0, v0, u1, v1.
        pixels: coordinates of the model's points, then of its blades' sweeps, in sixteenths of a pixel,
            (P + R BLADES (SECTOR_POINTS + 1), 2).
        scale: factor from dimensions of the AR.Drone [m] to pixels, which includes the drone's relative size.
        blur: kernel of the drone's motion during the exposure; None if it hardly moves.
        is_from_above: whether the camera is above the drone's rotors.
        shows_lens: whether the camera is in front of the drone.
        opacity: opacity of a blade's sweep.
        covers_circle: whether the blades of each rotor cover the full circle during the exposure.
    """

    model: _DroneModel
    box: list[int]
    pixels: Fixed
    scale: float
    blur: Kernel | None
    is_from_above: bool
    shows_lens: bool
    opacity: float
    covers_circle: bool

    def draw(self, picture: Picture) -> None:
        """Draw the drone without its hat, on a separate layer if it is blurred, so that the background stays sharp."""
        u0, v0, u1, v1 = self.box
        part = picture[v0:v1, u0:u1]
        pixels = self.pixels - np.array([u0, v0], np.int32) * (1 << SHIFT)
        if self.blur is None:
            self._draw(part, pixels)
            return
        layer = np.zeros((*part.shape[:2], 4), np.uint8)  # the fourth channel is the share covered by the drone
        self._draw(layer, pixels)
        cv2.filter2D(layer, -1, self.blur, dst=layer, borderType=cv2.BORDER_REPLICATE)
        transmitted = cv2.bitwise_not(cv2.extractChannel(layer, 3))
        cv2.multiply(part, cv2.merge([transmitted] * 3), dst=part, scale=1 / 255)
        cv2.add(part, cv2.cvtColor(layer, cv2.COLOR_BGRA2BGR), dst=part)

    def _draw(self, picture: Picture, pixels: Fixed) -> None:
        scale, parts, colours = self.scale, self.model.parts, self.model.colours
        hull = colours["hull" if self.is_from_above else "hull_low"]
        detailed = 2 * REACH_M * scale > DETAIL_PX
        if detailed and not self.is_from_above:
            self._draw_rotors(picture, pixels)
        _lines(picture, pixels[parts["rings"]].reshape(-1, RING_POINTS, 2), True, hull, 0.6 * RING_HEIGHT_M * scale)
        _lines(picture, pixels[parts["arms"]].reshape(-1, 2, 2), False, colours["cross"], ARM_WIDTH_M * scale)
        if detailed:
            _lines(picture, pixels[parts["motors"]].reshape(-1, 2, 2), False, colours["cross"], MOTOR_WIDTH_M * scale)
        _fill_hull(picture, pixels[parts["body"]], hull)
        if self.shows_lens:
            _fill_hull(picture, pixels[parts["nose"]], colours["nose"])
            if detailed:
                u, v = pixels[parts["lens"]][0].tolist()
                radius = round(max(LENS_M * scale, 0.5) * (1 << SHIFT))
                cv2.circle(picture, (u, v), radius, colours["cross"], cv2.FILLED, cv2.LINE_AA, SHIFT)
        if detailed and self.is_from_above:
            self._draw_rotors(picture, pixels)

    def _draw_rotors(self, picture: Picture, pixels: Fixed) -> None:
        """Darken the sweeps of the blades."""
        swept = picture.copy()
        sectors = pixels[len(self.model.points) :].reshape(-1, SECTOR_POINTS + 1, 2)
        circles = sectors[:, 1:].reshape(-1, BLADES * SECTOR_POINTS, 2)
        for sweep in circles if self.covers_circle else sectors:
            cv2.fillConvexPoly(swept, sweep, self.model.colours["rotor"], cv2.LINE_AA, SHIFT)
        cv2.addWeighted(swept, self.opacity, picture, 1 - self.opacity, 0.0, dst=picture)


def _lines(picture: Picture, lines: Fixed, closed: bool, colour: Colour, width_px: float) -> None:
    thickness = min(max(1, round(width_px)), THICKNESS_MAX_PX)
    cv2.polylines(picture, [*lines], closed, colour, thickness, cv2.LINE_AA, SHIFT)


def _fill_hull(picture: Picture, pixels: Fixed, colour: Colour) -> None:
    cv2.fillConvexPoly(picture, cv2.convexHull(pixels), colour, cv2.LINE_AA, SHIFT)


class BallImage(NamedTuple):
    """A ball to be drawn.

    Attributes:
        box: the part of the picture that contains the ball: u0, v0, u1, v1.
        light: light from the ball, plus 0.5 for rounding, (h, w, 3).
        transmittance: share of the light from behind that passes the ball, (h, w, 1).
    """

    box: list[int]
    light: Levels
    transmittance: Levels

    def draw(self, picture: Picture) -> None:
        u0, v0, u1, v1 = self.box
        part = picture[v0:v1, u0:u1]
        part[:] = part * self.transmittance + self.light


def ball_images(
    view: View, centres_K: Array, displacements_K: Array, radius_m: float, colour: Array, sun_K: Array
) -> dict[int, BallImage]:
    """Return the images of those balls that are in the picture during an exposure, by index.

    Since balls are many and small, all pixels that may be covered are computed in one array, at as many times as the
    fastest ball in the picture requires.

    Args:
        centres_K, displacements_K: centres and their motion during the exposure, (M, 3) [m; K].
        radius_m: radius of all balls.
        colour: B, G, R of all balls, (3,).
        sun_K: unit vector to the sun, (3,).
    """
    if not len(centres_K):
        return {}
    displacements_px = np.hypot(*view.flow_px(centres_K, displacements_K).T)
    boxes = _boxes(view, centres_K, displacements_px, radius_m)
    if not boxes:
        return {}
    shown = list(boxes)
    centres, displacements = centres_K[shown], displacements_K[shown]
    vectors = np.empty((len(shown), 3, 4), np.float32)
    vectors[..., 0], vectors[..., 1], vectors[..., 2], vectors[..., 3] = centres, displacements, sun_K, AXIS
    parts = [
        view.rays[v0:v1, u0:u1].reshape(-1, 3) @ each
        for (u0, v0, u1, v1), each in zip(boxes.values(), vectors, strict=True)
    ]
    along, along_displacement, along_sun, along_axis = np.concatenate(parts).T
    pixels = _Pixels(along, along_displacement, along_sun, along_axis, [len(part) for part in parts])
    steps = min(STEPS_MAX, max(1, math.ceil(displacements_px[shown].max() / STEP_PX)))
    covered = _covered(pixels, centres, displacements, radius_m, view.lens.fx, steps)
    constant = pixels.per_pixel(radius_m**2 - (centres * centres).sum(axis=-1))  # constant term of a ray's intersection
    hit_distance = pixels.along - np.sqrt(np.maximum(pixels.along * pixels.along + constant, 0))
    cosine = (hit_distance * pixels.along_sun - pixels.per_pixel(centres @ sun_K)) * np.float32(DIFFUSE / radius_m)
    shade = np.float32(AMBIENT) + np.minimum(np.maximum(cosine, 0), np.float32(DIFFUSE))
    light = (covered * shade)[:, None] * colour.astype(np.float32) + ROUNDING
    transmittance = (1 - covered)[:, None]
    images: dict[int, BallImage] = {}
    start = 0
    for (i, box), count in zip(boxes.items(), pixels.counts, strict=True):
        size, part = (box[3] - box[1], box[2] - box[0]), slice(start, start + count)
        images[i] = BallImage(box, light[part].reshape(*size, 3), transmittance[part].reshape(*size, 1))
        start += count
    return images


def _boxes(view: View, centres_K: Array, displacements_px: Array, radius_m: float) -> dict[int, list[int]]:
    """Return the box in the picture around each ball that is in it, by index."""
    x, y, z = centres_K.T
    is_in_front = z >= radius_m + NEAR_M
    radius_px = view.lens.fx * radius_m / np.where(is_in_front, z - radius_m, np.inf) * (1 + np.hypot(x, y) / z)
    reach, pixels = (1.5 + displacements_px / 2 + radius_px)[:, None], view.pixels(centres_K)
    boxes = view.boxes(pixels - reach, pixels + reach)
    return {i: box for i, box in enumerate(boxes) if is_in_front[i] and has_pixels(box)}


class _Pixels(NamedTuple):
    """Rays through the P pixels of all balls, one ball after another, as components along four vectors, (P,) each.

    `counts` is the number of pixels of each ball.
    """

    along: Levels
    along_displacement: Levels
    along_sun: Levels
    along_axis: Levels
    counts: list[int]

    def per_pixel(self, values: Array) -> Levels:
        """Return values (..., M) of the balls, repeated for each of a ball's pixels, (..., P)."""
        return np.repeat(values.astype(np.float32), self.counts, axis=-1)


def _covered(
    pixels: _Pixels, centres: Array, displacements: Array, radius: float, focal_px: float, steps: int
) -> Levels:
    """Return the covered share of each pixel, averaged over time, from how far within the radius its ray passes."""
    fractions = ((np.arange(steps) + 0.5) / steps - 0.5)[:, None]  # time since mid-exposure over the exposure time
    positions = centres + fractions[..., None] * displacements
    distance2 = (positions * positions).sum(axis=-1)
    along = pixels.along + fractions.astype(np.float32) * pixels.along_displacement
    offset2 = pixels.per_pixel(distance2) - along * along
    px_per_m = pixels.per_pixel(focal_px / np.sqrt((centres * centres).sum(axis=-1)))
    px_per_m /= pixels.along_axis * np.sqrt(pixels.along_axis)  # geometric mean of the radial and tangential scales
    inside_px = (np.float32(radius) - np.sqrt(np.maximum(offset2, 0))) * px_per_m
    return np.minimum(np.maximum(inside_px + ROUNDING, 0), 1).mean(axis=0)


def draw_obstacle(
    picture: Picture, view: View, row: tuple[float, ...], motion: CameraMotion, brightness: float
) -> None:
    """Draw an obstacle, given as a row in the format of zsim.scenario.surroundings."""
    if row[SHAPE] == SPHERE:
        centre_K = motion.points_K(np.array([row[CENTRE : CENTRE + 3]]))
        if centre_K[0, 2] > 0:
            zero, colour = np.zeros((1, 3)), brightness * OBSTACLE
            for image in ball_images(view, centre_K, zero, row[HALF], colour, SUN_W @ motion.R_WK).values():
                image.draw(picture)
        return
    for corners, normal in _faces(row):
        if normal @ (motion.p_WK - corners[0]) > 0:
            shade = brightness * (AMBIENT - 0.15 + (DIFFUSE + 0.15) * max(0.0, float(normal @ SUN_W)))
            fill_face(picture, view, motion.points_K(corners), shade * OBSTACLE)


@lru_cache(maxsize=1000)
def _faces(row: tuple[float, ...]) -> tuple[tuple[Array, Array], ...]:
    """Return the top and the upright faces of a box or cylinder: corners (M, 3) [m; W] and normal (3,) [W]."""
    if row[SHAPE] == BOX:
        outline = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]) * row[HALF : HALF + 2]
    else:
        angles = 2 * math.pi * np.arange(SIDES) / SIDES
        outline = row[HALF] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    c, s = row[COSINE], row[SINE]
    foot = outline @ np.array([[c, s], [-s, c]]) + row[CENTRE : CENTRE + 2]
    low, high = row[CENTRE + 2] - row[HALF + 2], row[CENTRE + 2] + row[HALF + 2]
    faces = [(np.column_stack([foot, np.full(len(foot), high)]), AXIS)]
    for a, b in zip(foot, np.roll(foot, -1, axis=0), strict=True):
        corners = np.array([(*a, low), (*b, low), (*b, high), (*a, high)])
        dx, dy = b - a
        faces.append((corners, np.array([dy, -dx, 0.0]) / math.hypot(dx, dy)))
    return tuple(faces)


def fill_face(picture: Picture, view: View, corners_K: Array, colour: Array) -> None:
    """Fill a convex face, given by its corners (M, 3) [m; K]."""
    visible = _in_front(corners_K)
    if len(visible) < 3:
        return
    if view.distorts:  # straight edges become curves
        steps = (np.roll(visible, -1, axis=0) - visible)[:, None]
        visible = (visible[:, None] + np.arange(PIECES)[:, None] / PIECES * steps).reshape(-1, 3)
    outline = view.pixels(visible)
    lowest, highest = outline.min(axis=0), outline.max(axis=0)
    if (highest < 0).any() or lowest[0] > view.lens.width or lowest[1] > view.lens.height:
        return
    cv2.fillPoly(picture, [to_fixed_point(outline)], bgr(colour), cv2.LINE_AA, SHIFT)


def _in_front(corners: Array) -> Array:
    """Return the part of a convex face in front of the camera, as corners (M, 3) [m; K]."""
    depth = corners[:, 2] - NEAR_M
    if (depth > 0).all():
        return corners
    clipped: list[Array] = []
    for i, depth_i in enumerate(depth):
        j = (i + 1) % len(corners)
        if depth_i > 0:
            clipped.append(corners[i])
        if (depth_i > 0) != (depth[j] > 0):
            clipped.append(corners[i] + (corners[j] - corners[i]) * (depth_i / (depth_i - depth[j])))
    return np.array(clipped).reshape(-1, 3)


def to_fixed_point(pixels: Array) -> NDArray[np.int32]:
    """Return pixel coordinates as fixed-point numbers for OpenCV, with SHIFT fractional bits."""
    return np.rint(np.clip(pixels, -FAR_PX, FAR_PX) * (1 << SHIFT)).astype(np.int32)


def bgr(colour: Array) -> tuple[float, float, float]:
    """Return a colour (3,) as an OpenCV scalar."""
    b, g, r = colour.tolist()
    return round(b), round(g), round(r)


class SurfaceImager:
    """Draws surfaces for one camera: two-sided triangles (T, 9) in the format of zsim.scenario.surroundings.

    Each triangle has a uniform colour and is drawn, among drones and obstacles, in order of the distance to its centre.
    Edges are not antialiased, so that no gaps show between neighbours; exceptions are triangles that reach behind the
    camera, or whose edges the lens visibly bends.
    """

    def __init__(self, view: View, triangle: Array, brightness: float) -> None:
        self._view = view
        self._corners_W = corners_of(triangle)
        self._middles_W = self._corners_W.mean(axis=1)
        normals = np.cross(triangle[:, 3:6], triangle[:, 6:])
        self._normals_W = normals / np.linalg.norm(normals, axis=1)[:, None]
        self._brightness = brightness

    def visible_triangles(self, motion: CameraMotion) -> list[tuple[float, int]]:
        """Return the distance [m] and index of each triangle that may be visible, and keep its data for `draw`."""
        self._points_K = motion.points_K(self._corners_W)
        z = self._points_K[..., 2]
        is_ahead = (z > NEAR_M).all(axis=1)
        self._pixels = np.zeros((len(z), 3, 2))
        if is_ahead.any():
            self._pixels[is_ahead] = self._view.pixels(self._points_K[is_ahead])
        low, high = self._pixels.min(axis=1), self._pixels.max(axis=1)
        size = self._view.lens.width, self._view.lens.height
        is_inside = is_ahead & (high >= 0.0).all(axis=1) & (low <= size).all(axis=1)
        is_bent = self._view.distorts & ((high - low).max(axis=1) > BENT_PX)
        self._is_plain = is_inside & ~is_bent
        indices = np.flatnonzero(is_inside | (~is_ahead & (z > NEAR_M).any(axis=1)))
        offset = self._middles_W[indices] - motion.p_WK
        sides = np.where((self._normals_W[indices] * offset).sum(axis=1) > 0.0, -1.0, 1.0)  # the visible side
        lit = np.maximum(sides * (self._normals_W[indices] @ SUN_W), 0.0)
        self._shade = np.zeros(len(z))
        self._shade[indices] = self._brightness * (AMBIENT - 0.15 + (DIFFUSE + 0.15) * lit)
        distance = np.linalg.norm(offset, axis=1)
        return list(zip(distance.tolist(), indices.tolist(), strict=True))

    def draw(self, picture: NDArray[np.uint8], index: int) -> None:
        """Draw the triangle with the given index, which `visible_triangles` must have returned."""
        colour = self._shade[index] * SURFACE
        if self._is_plain[index]:
            cv2.fillConvexPoly(picture, to_fixed_point(self._pixels[index]), bgr(colour), cv2.LINE_8, SHIFT)
        else:
            fill_face(picture, self._view, self._points_K[index], colour)
