"""A camera's view: points of K to pixels, the rays of its pixels, and how points move in K. Pure."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.sensors.camera_model import CameraPose, Lens, camera_matrix, undistorted
from zsim_agents.cameras.rendering.scene import DroneStates

Array = NDArray[np.float64]
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
