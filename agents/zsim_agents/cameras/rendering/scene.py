"""What a picture is drawn of: what stands still during a run, and what moves. Pure."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.contract.messages import DroneInfo, Info
from zsim.scenario.obstacle import row_of
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import Hats
from zsim.sensors.camera_model import CameraPose, Lens, camera_matrix, undistorted
from zsim.vehicles.vehicle import cross_layout

Array = NDArray[np.float64]
ARM_M = 0.1785  # m, of the AR.Drone, for records whose drones name no rotors
ROTOR_RADIUS_M = 0.10  # m, 8 inch propellers of the AR.Drone
SUN_AZIMUTH_RAD, SUN_ELEVATION_RAD = math.radians(215.0), math.radians(50.0)  # chosen: a winter noon seen from behind
SUN_W = np.array(
    [
        math.cos(SUN_ELEVATION_RAD) * math.cos(SUN_AZIMUTH_RAD),
        math.cos(SUN_ELEVATION_RAD) * math.sin(SUN_AZIMUTH_RAD),
        math.sin(SUN_ELEVATION_RAD),
    ]
)


class DroneLook(NamedTuple):
    """What a drone looks like: axes (R, 2), turns (R,) and radius of its rotors [m; B], and whether its hat is seen."""

    hubs_B: Array
    turns: Array
    radius_m: float
    has_hat: bool


class Scene(NamedTuple):
    """What stands still: looks of the drones, obstacles as rows of zsim.scenario.obstacle, hats, light of a day."""

    drones: tuple[DroneLook, ...]
    obstacles: tuple[tuple[float, ...], ...] = ()
    hats: Hats = Hats()
    light: float = 1.0


class DroneStates(NamedTuple):
    """N drones at an instant: position [m; W], velocity [m/s; W], attitude B to W (N, 4), rate [rad/s; B], (N, 3) each.

    `rotors` has the speeds of each drone's rotors [rad/s].
    """

    p_WB: Array
    v_WB: Array
    q_WB: Array
    w_WB_B: Array
    rotors: Sequence[Sequence[float]]


def scene_of(info: Info, scenario: Scenario) -> Scene:
    """Return what stands still in a run; the drones in the order of `info`."""
    environment = scenario.environment
    hats = Hats() if environment.hats is UNSET else environment.hats
    light = 1.0 if environment.light is UNSET else environment.light
    looks = tuple(_look(drone, drone.name not in hats.covered) for drone in info.drones)
    return Scene(looks, tuple(tuple(row_of(obstacle)) for obstacle in environment.obstacles), hats, light)


def default_look(has_hat: bool = True) -> DroneLook:
    """Return what the AR.Drone looks like."""
    return _look(DroneInfo("", ""), has_hat)


def _look(drone: DroneInfo, has_hat: bool) -> DroneLook:
    rotors = drone.rotors or cross_layout(ARM_M)
    radius_m = drone.rotors[0].radius_m if drone.rotors else ROTOR_RADIUS_M
    hubs = np.array([(rotor.x_m, rotor.y_m) for rotor in rotors])
    return DroneLook(hubs, np.array([float(rotor.turn) for rotor in rotors]), radius_m, has_hat)


Rays = NDArray[np.float32]
ORIGIN = np.zeros(3)


class CameraMotion(NamedTuple):
    """A camera in the world: its place and velocity [m, m/s; W], its rate [rad/s; K], rotation K to W (3, 3)."""

    p_WK: Array
    v_WK: Array
    w_WK_K: Array
    R_WK: Array

    def points_K(self, points_W: Array) -> Array:
        """Return points (..., 3) of W in K."""
        return (points_W - self.p_WK) @ self.R_WK

    def rates_K(self, points_K: Array, velocities_W: Array) -> Array:
        """Return how fast points (..., 3), which have velocities in W, move in K [m/s]."""
        return (velocities_W - self.v_WK) @ self.R_WK + points_K @ skew(self.w_WK_K)


def skew(a: Array) -> Array:
    """Return the matrix of a with which rows multiply to b @ skew(a) = b × a."""
    x, y, z = a.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def camera_motion(pose: CameraPose, bodies: DroneStates, R_WB: Array, carrier: int) -> CameraMotion:
    """Return where the camera is that one of the drones carries, whose attitude is R_WB (3, 3), and how it moves."""
    w_WB_B = bodies.w_WB_B[carrier]
    p_WK = bodies.p_WB[carrier] + R_WB @ pose.p_BK
    v_WK = bodies.v_WB[carrier] - R_WB @ (w_WB_B @ skew(pose.p_BK).T)
    return CameraMotion(p_WK, v_WK, pose.R_BK.T @ w_WB_B, R_WB @ pose.R_BK)


class View:
    """A lens with what can be computed of it once.

    Attributes:
        lens: of the camera.
        distorts: whether it has any distortion.
        rays: unit vectors of K through the pixels' middles, (height, width, 3).
    """

    def __init__(self, lens: Lens) -> None:
        self.lens = lens
        self.distorts = any((lens.k1, lens.k2, lens.p1, lens.p2, lens.k3))
        self._K = camera_matrix(lens)
        self._D = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
        self.plane = self._plane()
        norm = np.sqrt(1.0 + (self.plane * self.plane).sum(axis=-1, keepdims=True))
        whole = np.concatenate([self.plane, np.ones_like(norm)], axis=-1) / norm
        self.rays: Rays = np.ascontiguousarray(whole, np.float32)

    def _plane(self) -> Array:
        """Return where the rays of the pixels meet the plane z = 1 of K, (height, width, 2)."""
        lens = self.lens
        u, v = np.meshgrid(np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float))
        return np.stack(undistorted(lens, u, v), axis=-1)

    def pixels(self, points_K: Array) -> Array:
        """Return the pixels (..., 2) of points (..., 3) in front of the camera."""
        lens = self.lens
        if not self.distorts:
            x, y, z = np.moveaxis(points_K, -1, 0)
            return np.stack([x / z * lens.fx + lens.cx, y / z * lens.fy + lens.cy], axis=-1)
        flat, _ = cv2.projectPoints(points_K.reshape(-1, 1, 3), ORIGIN, ORIGIN, self._K, self._D)
        return np.asarray(flat, float).reshape(*points_K.shape[:-1], 2)

    def flow_px(self, points_K: Array, rates_K: Array) -> Array:
        """Return how fast points move over the picture [px/s], (..., 2), but for the lens's distortion."""
        z = points_K[..., 2:]
        return self.lens.fx * (rates_K[..., :2] - points_K[..., :2] / z * rates_K[..., 2:]) / z

    def boxes(self, lowest_px: Array, highest_px: Array) -> list[list[int]]:
        """Return the parts u0, v0, u1, v1 of the picture that hold rectangles, given by their corners (M, 2)."""
        size = self.lens.width, self.lens.height
        ends = np.concatenate([np.floor(lowest_px), np.ceil(highest_px) + 1], axis=1)
        return np.clip(ends, 0, size * 2).astype(int).tolist()


def has_pixels(box: list[int]) -> bool:
    """Tell whether a part of the picture has any."""
    return box[0] < box[2] and box[1] < box[3]
