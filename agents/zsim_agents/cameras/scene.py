"""The scene of a picture, and the motion and the lens of the camera. No I/O.

Frames: W, world (east, north, up); B, body of a drone; K, camera (x right, y down, z ahead).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.contract.messages import DroneInfo, Info
from zsim.scenario.scenario import Scenario
from zsim.scenario.surroundings import TRIANGLE, row_of, sheet_of
from zsim.sensors.camera import Hats
from zsim.sensors.camera_model import CameraPose, Lens, camera_matrix, undistorted
from zsim.vehicles.vehicle import cross_layout

cv2.setNumThreads(1)  # leaves the other cores to the world and the agents, and makes pictures bit-identical everywhere
Array = NDArray[np.float64]
Kernel = NDArray[np.float32]
ARM_M = 0.1785  # arm length of the AR.Drone, for records that do not give the rotors of a drone
ROTOR_RADIUS_M = 0.10  # the AR.Drone's propellers have a diameter of 8 inches
SUN_AZIMUTH_RAD, SUN_ELEVATION_RAD = math.radians(215.0), math.radians(50.0)  # from east; afternoon, in the south-west
SUN_W = np.array(
    [
        math.cos(SUN_ELEVATION_RAD) * math.cos(SUN_AZIMUTH_RAD),
        math.cos(SUN_ELEVATION_RAD) * math.sin(SUN_AZIMUTH_RAD),
        math.sin(SUN_ELEVATION_RAD),
    ]
)
BLUR_MAX_PX = 24.0  # maximum length of motion blur; longer motions are blurred by this length
SAMPLES_PER_PX = 8  # samples of a motion per pixel of its blur kernel
ORIGIN = np.zeros(3)
SHIFT = 4  # fractional bits of coordinates for OpenCV: sixteenths of a pixel


class DroneLook(NamedTuple):
    """Appearance of a drone: rotor hubs (R, 2) [m; B], directions of rotation (R,), rotor radius, and any hat."""

    hubs_B: Array
    turns: Array
    radius_m: float
    has_hat: bool


NO_TRIANGLE = np.empty((0, TRIANGLE))


class Scene(NamedTuple):
    """The constant parts of a run's scene.

    Obstacles and surfaces are rows in the format of zsim.scenario.surroundings; a clear day has light 1.
    """

    drones: tuple[DroneLook, ...]
    obstacles: tuple[tuple[float, ...], ...] = ()
    hats: Hats = Hats()
    light: float = 1.0
    surfaces: Array = NO_TRIANGLE


class DroneStates(NamedTuple):
    """States of N drones at one time: position [m; W], velocity [m/s; W] and angular velocity [rad/s; B], (N, 3) each.

    `q_WB` is the attitude, B to W, (N, 4); `rotors` contains the speeds of each drone's rotors [rad/s].
    """

    p_WB: Array
    v_WB: Array
    q_WB: Array
    w_WB_B: Array
    rotors: Sequence[Sequence[float]]


def scene_of(info: Info, scenario: Scenario) -> Scene:
    """Return the scene of a run, with the drones in the order of `info`."""
    environment = scenario.environment
    hats = Hats() if environment.hats is UNSET else environment.hats
    light = 1.0 if environment.light is UNSET else environment.light
    looks = tuple(_look(drone, drone.name not in hats.covered) for drone in info.drones)
    obstacles = tuple(tuple(row_of(obstacle)) for obstacle in environment.obstacles)
    return Scene(looks, obstacles, hats, light, sheet_of(environment).triangle)


def default_look(has_hat: bool = True) -> DroneLook:
    return _look(DroneInfo("", ""), has_hat)


def _look(drone: DroneInfo, has_hat: bool) -> DroneLook:
    rotors = drone.rotors or cross_layout(ARM_M)
    radius_m = drone.rotors[0].radius_m if drone.rotors else ROTOR_RADIUS_M
    hubs = np.array([(rotor.x_m, rotor.y_m) for rotor in rotors])
    return DroneLook(hubs, np.array([float(rotor.turn) for rotor in rotors]), radius_m, has_hat)


class CameraMotion(NamedTuple):
    """Position and velocity of a camera [m, m/s; W], angular velocity [rad/s; K] and rotation K to W (3, 3)."""

    p_WK: Array
    v_WK: Array
    w_WK_K: Array
    R_WK: Array

    def points_K(self, points_W: Array) -> Array:
        """Convert points (..., 3) from W to K."""
        return (points_W - self.p_WK) @ self.R_WK

    def rates_K(self, points_K: Array, velocities_W: Array) -> Array:
        """Return the velocities relative to the camera [m/s; K] of points (..., 3) with given velocities [m/s; W]."""
        return (velocities_W - self.v_WK) @ self.R_WK + points_K @ skew(self.w_WK_K)


def skew(a: Array) -> Array:
    """Return the matrix with b @ skew(a) = b × a for rows b."""
    x, y, z = a.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def camera_motion(pose: CameraPose, bodies: DroneStates, R_WB: Array, carrier: int) -> CameraMotion:
    """Return the motion of a camera on drone number `carrier`, whose attitude is R_WB (3, 3)."""
    w_WB_B = bodies.w_WB_B[carrier]
    p_WK = bodies.p_WB[carrier] + R_WB @ pose.p_BK
    v_WK = bodies.v_WB[carrier] - R_WB @ (w_WB_B @ skew(pose.p_BK).T)
    return CameraMotion(p_WK, v_WK, pose.R_BK.T @ w_WB_B, R_WB @ pose.R_BK)


class View:
    """A lens with its precomputed rays.

    Attributes:
        plane: intersections of the pixels' rays with the plane z = 1 of K, (height, width, 2).
        rays: unit vectors in K through the centres of the pixels, (height, width, 3).
    """

    def __init__(self, lens: Lens) -> None:
        self.lens = lens
        self._D = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
        self.distorts = bool(self._D.any())
        self._K = camera_matrix(lens)
        u, v = np.meshgrid(np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float))
        x, y = undistorted(lens, u.ravel(), v.ravel())
        self.plane: Array = np.stack([x, y], axis=-1).reshape(lens.height, lens.width, 2)
        norm = np.sqrt(1.0 + (self.plane * self.plane).sum(axis=-1, keepdims=True))
        unit_rays = np.concatenate([self.plane, np.ones_like(norm)], axis=-1) / norm
        self.rays: NDArray[np.float32] = np.ascontiguousarray(unit_rays, np.float32)

    def pixels(self, points_K: Array) -> Array:
        """Return the pixel coordinates (..., 2) of points (..., 3) [m; K] in front of the camera."""
        lens = self.lens
        if not self.distorts:
            x, y, z = np.moveaxis(points_K, -1, 0)
            return np.stack([x / z * lens.fx + lens.cx, y / z * lens.fy + lens.cy], axis=-1)
        flat, _ = cv2.projectPoints(points_K.reshape(-1, 1, 3), ORIGIN, ORIGIN, self._K, self._D)
        return np.asarray(flat, float).reshape(*points_K.shape[:-1], 2)

    def flow_px(self, points_K: Array, rates_K: Array) -> Array:
        """Return the optical flow of moving points [px/s], (..., 2), ignoring lens distortion."""
        z = points_K[..., 2:]
        return self.lens.fx * (rates_K[..., :2] - points_K[..., :2] / z * rates_K[..., 2:]) / z

    def boxes(self, lowest_px: Array, highest_px: Array) -> list[list[int]]:
        """Return boxes (u0, v0, u1, v1), clipped to the picture, around rectangles given by two corners (M, 2)."""
        size = self.lens.width, self.lens.height
        ends = np.concatenate([np.floor(lowest_px), np.ceil(highest_px) + 1], axis=1)
        return np.clip(ends, 0, size * 2).astype(int).tolist()


def has_pixels(box: list[int]) -> bool:
    return box[0] < box[2] and box[1] < box[3]


def motion_blur_kernels(displacements_px: Array) -> list[Kernel]:
    """Return the blur kernels of motions during an exposure, (N, 2) [px]: the share of the time spent in each pixel."""
    lengths = np.hypot(*displacements_px.T)
    clipped = displacements_px * np.minimum(1.0, BLUR_MAX_PX / np.maximum(lengths, 1e-9))[:, None]
    count = max(2, math.ceil(min(lengths.max(), BLUR_MAX_PX) * SAMPLES_PER_PX))
    positions = clipped[:, :, None] * ((np.arange(count) + 0.5) / count - 0.5)  # (N, 2, count)
    halves = [math.ceil(extent / 2) + 1 for extent in np.abs(clipped).max(axis=1).tolist()]
    half_max = max(halves)
    # per sample, by column and row
    shares = np.maximum(1 - np.abs(np.arange(-half_max, half_max + 1) - positions[..., None]), 0)
    kernels = (shares[:, 1].transpose(0, 2, 1) @ shares[:, 0] / count).astype(np.float32)
    inner = [slice(half_max - half, half_max + half + 1) for half in halves]
    return [kernel[part, part] for kernel, part in zip(kernels, inner, strict=True)]
