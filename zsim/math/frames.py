"""Frames: the world's tangent plane on the Earth, and attitude as quaternion, matrix, heading and Euler angles.

World W is ENU (x east, y north, z up) at an origin given in WGS 84; body B is FLU (x forward, y left, z up).
Quaternions are Hamilton, w first, and turn body components into world components. Functions of ArrayLike accept any
leading shape.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zsim.math import elementary as el
from zsim.math.compiled import kernel

Array = NDArray[np.float64]

_sin, _cos, _asin, _atan2 = map(el.elementwise, (el.sin, el.cos, el.asin, el.atan2))

WGS84_A_M = 6_378_137.0  # m, semi-major axis, WGS 84 (NIMA TR8350.2, table 3.1)
WGS84_F = 1.0 / 298.257223563  # flattening, WGS 84 (NIMA TR8350.2, table 3.1)
_E2 = WGS84_F * (2.0 - WGS84_F)
_B_M = WGS84_A_M * (1.0 - WGS84_F)
_CURVATURE_M = (WGS84_A_M * WGS84_A_M - _B_M * _B_M) / _B_M
_STEPS = 4  # each reduces the error by a factor of about 300: 1e-15 rad after four for heights below 1000 km


def geodetic_to_enu(geodetic: ArrayLike, origin: tuple[float, float, float]) -> Array:
    """Return p_W [m] of points, shape (..., 3); points and origin are (latitude_deg, longitude_deg, height_m)."""
    d = (geodetic_to_ecef(geodetic) - geodetic_to_ecef(origin))[..., None, :]
    return (d * enu_rows(origin[0], origin[1])).sum(axis=-1)


def geodetic_to_ecef(geodetic: ArrayLike) -> Array:
    """Return the Earth-centred, Earth-fixed coordinates [m] of points (latitude_deg, longitude_deg, height_m)."""
    lat_deg, lon_deg, height = np.moveaxis(np.asarray(geodetic, dtype=float), -1, 0)
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    sine = _sin(lat)
    normal = WGS84_A_M / np.sqrt(1.0 - _E2 * sine * sine)
    level = (normal + height) * _cos(lat)
    up = (normal * (1.0 - _E2) + height) * sine
    return np.stack([level * _cos(lon), level * _sin(lon), up], axis=-1)


def enu_rows(latitude_deg: float, longitude_deg: float) -> Array:
    """Return the unit vectors east, north and up in Earth-fixed components, as rows, (3, 3)."""
    (ns, nc), (es, ec) = el.sin_cos(math.radians(latitude_deg)), el.sin_cos(math.radians(longitude_deg))
    return np.array(
        [
            [-es, ec, 0.0],
            [-ns * ec, -ns * es, nc],
            [nc * ec, nc * es, ns],
        ]
    )


def anchor(latitude_deg: float, longitude_deg: float, height_m: float) -> tuple[Array, Array]:
    """Return W's axes as rows in Earth-fixed components, (3, 3), and W's Earth-fixed origin [m], (3,)."""
    return enu_rows(latitude_deg, longitude_deg), geodetic_to_ecef((latitude_deg, longitude_deg, height_m))


@kernel()
def geodetic(position_m: Array, rows: Array, place_m: Array) -> Array:
    """Return WGS 84 latitude [deg], longitude [deg] and ellipsoidal height [m] of points in W.

    Use Bowring's iteration on the parametric latitude, accurate to 1e-9 m for heights between -10 km and 1000 km
    (Bowring, Survey Review 23 (1976) 323-327).

    Args:
        position_m: p_W, (n, 3).
        rows, place_m: the results of `anchor`.
    """
    coordinates = np.empty(position_m.shape)
    for i in range(position_m.shape[0]):
        e, n, u = position_m[i]
        x = place_m[0] + (e * rows[0, 0] + n * rows[1, 0] + u * rows[2, 0])
        y = place_m[1] + (e * rows[0, 1] + n * rows[1, 1] + u * rows[2, 1])
        z = place_m[2] + (e * rows[0, 2] + n * rows[1, 2] + u * rows[2, 2])
        level = el.hypot(x, y)
        lat = el.atan2(z, level * (1.0 - _E2))
        for _ in range(_STEPS):
            parametric = el.atan2((1.0 - WGS84_F) * el.sin(lat), el.cos(lat))
            s, c = el.sin(parametric), el.cos(parametric)
            lat = el.atan2(z + _CURVATURE_M * s * s * s, level - _E2 * WGS84_A_M * c * c * c)
        s = el.sin(lat)
        coordinates[i, 0] = math.degrees(lat)
        coordinates[i, 1] = math.degrees(el.atan2(y, x))
        coordinates[i, 2] = level * el.cos(lat) + z * s - WGS84_A_M * math.sqrt(1.0 - _E2 * s * s)
    return coordinates


def wrap_angle(angle_rad: ArrayLike) -> Array:
    """Return the angle in [-pi, pi)."""
    return (np.asarray(angle_rad, dtype=float) + np.pi) % (2.0 * np.pi) - np.pi


def quaternion_multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Return the Hamilton product p q (rotation by q, then by p), shape (..., 4)."""
    pw, px, py, pz = np.moveaxis(np.asarray(p, dtype=float), -1, 0)
    qw, qx, qy, qz = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def quaternion_conjugate(q: ArrayLike) -> Array:
    return np.asarray(q, dtype=float) * np.array([1.0, -1.0, -1.0, -1.0])


def rotation_matrix(q: ArrayLike) -> Array:
    """Return the rotation matrices R of unit quaternions, shape (..., 3, 3): v_W = R v_B."""
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(R: ArrayLike) -> Array:
    """Return the unit quaternions of rotation matrices (..., 3, 3), with either sign.

    Divides by the largest component, which is never small (Shepperd, J. Guidance and Control 1 (1978) 223-224).
    """
    R = np.asarray(R, dtype=float)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(R, (-2, -1), (0, 1))
    rows = [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, yx + xy, zx + xz],
        [xz - zx, yx + xy, 1 - xx + yy - zz, zy + yz],
        [yx - xy, zx + xz, zy + yz, 1 - xx - yy + zz],
    ]
    products = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)  # 4 q q^T
    largest = np.diagonal(products, axis1=-2, axis2=-1).argmax(axis=-1)
    q = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def principal_axes(covariance: ArrayLike) -> tuple[Array, Array]:
    """Return the standard deviations (..., 3) of covariances (..., 3, 3) along their axes, and the axes' quaternions.

    The quaternions turn components along the principal axes into components in the frame of the covariances.
    """
    variances, axes = np.linalg.eigh(np.asarray(covariance, dtype=float))  # noqa: TID251 - it is only displayed
    axes[..., :, 0] *= np.where(np.linalg.det(axes) < 0, -1.0, 1.0)[..., None]  # noqa: TID251
    return np.sqrt(np.maximum(variances, 0.0)), quaternion_from_matrix(axes)


def rotate(q: ArrayLike, v: ArrayLike) -> Array:
    """Return R(q) v: body components to world components."""
    return (rotation_matrix(q) * np.asarray(v, dtype=float)[..., None, :]).sum(axis=-1)


def quaternion_from_rpy(rpy_rad: ArrayLike) -> Array:
    """Return the quaternion of R = Rz(yaw) Ry(pitch) Rx(roll) for angles (..., 3) in the order roll, pitch, yaw."""
    half = 0.5 * np.asarray(rpy_rad, dtype=float)
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(_cos(half), -1, 0), np.moveaxis(_sin(half), -1, 0)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def rpy_from_quaternion(q: ArrayLike) -> Array:
    """Return roll, pitch, yaw [rad] of R = Rz(yaw) Ry(pitch) Rx(roll); pitch in [-pi/2, pi/2]."""
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    roll = _atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = _asin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    return np.stack([roll, pitch, heading(q)], axis=-1)


def heading(q: ArrayLike) -> Array:
    """Return the heading [rad]: the angle of the body's x axis from east, counter-clockwise seen from above."""
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    return _atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def turned_about_up(v: tuple[float, float, float], angle_rad: float) -> tuple[float, float, float]:
    """Return `v` turned about z, counter-clockwise seen from above; a heading turns it from the heading frame to W."""
    c, s = el.cos(angle_rad), el.sin(angle_rad)
    return c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]


def quaternion_from_heading(heading_rad: ArrayLike) -> Array:
    """Return the quaternion of a level body with a heading [rad]."""
    half = 0.5 * np.asarray(heading_rad, dtype=float)
    zero = np.zeros_like(half)
    return np.stack([_cos(half), zero, zero, _sin(half)], axis=-1)
