"""Camera model: projection by a pinhole camera with Brown-Conrady distortion, and its inverse.

Camera frame K: x to the right in the picture, y down, z in the viewing direction. Pixel coordinates (u, v) start at the
upper left of the picture, with integers at pixel centres, as in OpenCV (calib3d, "Detailed description").
"""

import math
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import portable
from zsim.math.frames import quaternion_from_matrix
from zsim.math.linear import product
from zsim.math.rotation import Quaternion, matrix_from_rpy
from zsim.sensors.camera import Camera

Array = NDArray[np.float64]
Number = TypeVar("Number", float, NDArray[np.float64])
R_SK = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # columns: K's axes in components of the mount S
UNDISTORT_STEPS = 12  # Newton steps; enough for 1e-6 px in any picture that does not fold
FOLD_GRID, FOLD_PX = 25, 1e-3  # grid points per side and samples per ray; maximum error of a pixel's ray [px]


class Lens(NamedTuple):
    """Intrinsics: focal lengths and centre [px], distortion, and the picture's size [px]."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    width: int
    height: int


class CameraPose(NamedTuple):
    """The pose of a camera in the body: position [m; B], and the rotation from K to B, (3, 3)."""

    p_BK: Array
    R_BK: Array

    @property
    def q_BK(self) -> Quaternion:
        w, x, y, z = quaternion_from_matrix(self.R_BK).tolist()
        return w, x, y, z


def lens_of(camera: Camera) -> Lens:
    """Return a lens with square pixels, the camera's diagonal field of view, and a centred optical axis."""
    half_px = el.hypot(camera.width_px, camera.height_px) / 2
    focal_px = half_px / el.tan(math.radians(camera.diagonal_deg) / 2)
    centre = (camera.width_px - 1) / 2, (camera.height_px - 1) / 2
    k1, k2, p1, p2, k3 = map(float, camera.distortion)  # floats: compiled functions specialise by type
    return Lens(focal_px, focal_px, *centre, k1, k2, p1, p2, k3, camera.width_px, camera.height_px)


def camera_pose(camera: Camera) -> CameraPose:
    R_BS = np.array(matrix_from_rpy(*map(math.radians, camera.mount.rpy_deg)))
    return CameraPose(np.array(camera.mount.position_m), product(R_BS, R_SK))


def camera_matrix(lens: Lens) -> Array:
    """Return the camera matrix of OpenCV, (3, 3)."""
    return np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])


@portable
def distorted(lens: Lens, x: Number, y: Number) -> tuple[Number, Number]:
    """Return where the lens images the ray (x, y, 1) of K in the picture plane, in focal lengths."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    return (
        x * radial + 2.0 * lens.p1 * x * y + lens.p2 * (r2 + 2.0 * x * x),
        y * radial + lens.p1 * (r2 + 2.0 * y * y) + 2.0 * lens.p2 * x * y,
    )


@portable
def undistorted(lens: Lens, u: Number, v: Number) -> tuple[Number, Number]:
    """Return x and y of the ray (x, y, 1) of K that the lens images on a pixel, by Newton's method."""
    a, b = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
    x, y = a, b
    for _ in range(UNDISTORT_STEPS):
        at_x, at_y = distorted(lens, x, y)
        xx, xy, yy = distortion_slopes(lens, x, y)
        miss_x, miss_y, determinant = a - at_x, b - at_y, xx * yy - xy * xy
        x, y = x + (yy * miss_x - xy * miss_y) / determinant, y + (xx * miss_y - xy * miss_x) / determinant
    return x, y


@portable
def distortion_slopes(lens: Lens, x: Number, y: Number) -> tuple[Number, Number, Number]:
    """Return the Jacobian of `distorted`, which is symmetric: its elements xx, xy and yy."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    slope = 2.0 * (lens.k1 + r2 * (2.0 * lens.k2 + 3.0 * r2 * lens.k3))
    xx = radial + slope * x * x + 2.0 * lens.p1 * y + 6.0 * lens.p2 * x
    yy = radial + slope * y * y + 6.0 * lens.p1 * y + 2.0 * lens.p2 * x
    return xx, slope * x * y + 2.0 * lens.p1 * x + 2.0 * lens.p2 * y, yy


def folds(lens: Lens) -> bool:
    """Return whether the distortion folds the picture, so that some pixel corresponds to no unique ray."""
    u, v = np.meshgrid(*(np.linspace(0.0, side - 1.0, FOLD_GRID) for side in (lens.width, lens.height)))
    with np.errstate(all="ignore"):
        x, y = undistorted(lens, u.ravel(), v.ravel())
        share = np.linspace(0.0, 1.0, FOLD_GRID)[:, None]
        xx, xy, yy = distortion_slopes(lens, (share * x).ravel(), (share * y).ravel())
        at_x, at_y = distorted(lens, x, y)
        off_u, off_v = lens.fx * at_x + lens.cx - u.ravel(), lens.fy * at_y + lens.cy - v.ravel()
        off_px = np.sqrt(off_u * off_u + off_v * off_v)
    return not (np.all(off_px < FOLD_PX) and np.all(xx * yy - xy * xy > 0.0) and np.all(xx > 0.0))


@portable
def pixel(lens: Lens, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the pixel [px], possibly outside the picture, of a point in K in front of the camera (z > 0)."""
    at_x, at_y = distorted(lens, x / z, y / z)
    return lens.fx * at_x + lens.cx, lens.fy * at_y + lens.cy


SINGULAR = 1e-9  # minimum determinant; below it the points do not determine a circle


@portable
def spread(n: float, x: float, y: float, xx: float, xy: float, yy: float) -> tuple[float, float]:
    """Return the standard deviations of a fitted circle's centre, per axis, and radius, over that of its edge points.

    They follow from the least-squares covariance (A^T A)^-1, where A has a row (x, y, 1) for each edge point in the
    direction (x, y) from the centre.

    Args:
        n: number of points.
        x, y, xx, xy, yy: sums over the points of the direction's components and their products.
    """
    a, b, c = yy * n - y * y, xx * n - x * x, xx * yy - xy * xy
    determinant = max(xx * a - xy * (xy * n - x * y) + x * (xy * y - yy * x), SINGULAR)
    return math.sqrt(0.5 * max(a + b, 0.0) / determinant), math.sqrt(max(c, 0.0) / determinant)
