"""The cluster frame C and its Z-Y-X Euler angles, in plain floats because a gate has microseconds."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from zsim_agents.cluster_space import TAU, Array, SingularClusterError

Vector = tuple[float, float, float]

LENGTH_MIN_M = 1e-9  # a nanometre: below it a direction is rounding noise


def wrap_angle(angle: float) -> float:
    """Return the angle taken to [-pi, pi]."""
    return math.remainder(angle, TAU)


def cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Return a x b of two plain vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def rotation_WC(roll: float, pitch: float, yaw: float) -> Array:
    """Return R_WC = Rz(yaw) Ry(pitch) Rx(roll), (3, 3)."""
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    sy, cy = math.sin(yaw), math.cos(yaw)
    return np.array(
        [
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        ]
    )


def pitch_yaw(x_W: Sequence[float]) -> tuple[float, float]:
    """Return pitch and yaw of a frame from its x axis in W."""
    return math.atan2(-x_W[2], math.hypot(x_W[0], x_W[1])), math.atan2(x_W[1], x_W[0])


def euler_axes_C(roll: float, pitch: float) -> tuple[Vector, Vector, Vector]:
    """Return w_WC_C of a unit rate of roll, of pitch and of yaw."""
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    return (1.0, 0.0, 0.0), (0.0, cr, -sr), (-sp, sr * cp, cr * cp)


def euler_rates(roll: float, pitch: float) -> Array:
    """Return T (3, 3) with (roll', pitch', yaw') = T w_WC_C.

    Raises:
        SingularClusterError: pitch is at 90 degrees.
    """
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    if cp < LENGTH_MIN_M:
        raise SingularClusterError("pitch is 90 deg: roll and yaw of the formation are one rotation there")
    return np.array([(1.0, sr * sp / cp, cr * sp / cp), (0.0, cr, -sr), (0.0, sr / cp, cr / cp)])


def triad_axes(d2: Sequence[float], d3: Sequence[float]) -> tuple[Vector, Vector, Vector, float, float]:
    """Return the axes x, y, z of C in W, h = |d2 + d3| [m] and the area |d2 x d3| [m^2].

    x_C points from the middle of robots 2 and 3 to robot 1, z_C along d2 x d3; robot 2 is on the left.

    Args:
        d2, d3: P2 - P1 and P3 - P1, both in W [m].

    Raises:
        SingularClusterError: the three robots are in line or in one place.
    """
    m = (d2[0] + d3[0], d2[1] + d3[1], d2[2] + d3[2])
    normal = cross(d2, d3)
    h = math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    area = math.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    if not (h > LENGTH_MIN_M and area > LENGTH_MIN_M * h):  # also true for NaN
        raise SingularClusterError(
            "robots 1, 2 and 3 are in line or in one place: the formation has no frame"
        )
    x = (-m[0] / h, -m[1] / h, -m[2] / h)
    z = (normal[0] / area, normal[1] / area, normal[2] / area)
    return x, cross(z, x), z, h, area
