"""The ground z = 0: spring and damper under every contact point, with dry friction that holds a standing drone.

Friction is a spring to an anchor on the ground; where it would exceed the friction cone, the anchor is dragged along.
The anchor stays still within a step and moves after it, so that a step is a smooth function of the state.
"""

import math
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, add, cross, rotate, rotate_back
from zsim_world.physics.fleet_arrays import VEHICLE, Row

Pair = tuple[float, float]


POINTS = 8  # under which there may be ground: four feet, four corners of the hull's rim


@inlined
def contact_point(row: Row, k: int) -> Vector:
    """Return contact point k in B [m]: front left, front right, rear right, rear left; first the feet."""
    foot, x, y = k < 4, 1.0 if k % 4 < 2 else -1.0, 1.0 if k % 4 in (0, 3) else -1.0
    xy = row[VEHICLE.foot_xy] if foot else row[VEHICLE.rim_xy]
    return (x * xy, y * xy, -row[VEHICLE.foot_depth] if foot else row[VEHICLE.rim_height])


def contact_points(row: NDArray) -> np.ndarray:
    """Return all contact points in B [m], (POINTS, 3)."""
    return np.array([[float(x) for x in cast(Any, contact_point).py_func(row, k)] for k in range(POINTS)])


@inlined
def _tangential(row: Row, normal: float, gap: Pair, speed: Pair) -> Pair:
    """Return the friction force [N] of one point, within the cone."""
    fx = -row[VEHICLE.foot_stiffness] * gap[0] - row[VEHICLE.foot_damping] * speed[0]
    fy = -row[VEHICLE.foot_stiffness] * gap[1] - row[VEHICLE.foot_damping] * speed[1]
    size = math.sqrt(fx * fx + fy * fy)
    limit = row[VEHICLE.friction] * normal
    if size <= limit:
        return fx, fy
    return fx * limit / size, fy * limit / size


@inlined
def contact(
    row: Row, anchor: NDArray, p_WB: Vector, v_WB: Vector, q_WB: Quaternion, w_WB_B: Vector
) -> tuple[Vector, Vector]:
    """Return force in W [N] and moment in B [N m] of the ground on one drone.

    Args:
        row: the drone's parameters.
        anchor: (8, 2) anchors of the contact points on the ground [m].
        p_WB, v_WB, q_WB, w_WB_B: state of the drone [m, m/s, -, rad/s].
    """
    force, moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if p_WB[2] > row[VEHICLE.contact_reach]:
        return force, moment
    for k in range(POINTS):
        r_B = contact_point(row, k)
        r_W = rotate(q_WB, r_B)
        depth = -(p_WB[2] + r_W[2])
        if depth > 0.0:
            v = add(v_WB, rotate(q_WB, cross(w_WB_B, r_B)))
            normal = max(row[VEHICLE.foot_stiffness] * depth - row[VEHICLE.foot_damping] * v[2], 0.0)
            gap = (p_WB[0] + r_W[0] - anchor[k, 0], p_WB[1] + r_W[1] - anchor[k, 1])
            fx, fy = _tangential(row, normal, gap, (v[0], v[1]))
            f_W = (fx, fy, normal)
            force = add(force, f_W)
            moment = add(moment, cross(r_B, rotate_back(q_WB, f_W)))
    return force, moment


@inlined
def drag_anchors(row: NDArray, anchor: NDArray, p_WB: Vector, q_WB: Quaternion) -> None:
    """Move the anchors after a step: to the point itself in the air, along with it where it slides."""
    for k in range(POINTS):
        r_W = rotate(q_WB, contact_point(row, k))
        x, y = p_WB[0] + r_W[0], p_WB[1] + r_W[1]
        depth = -(p_WB[2] + r_W[2])
        gx, gy = x - anchor[k, 0], y - anchor[k, 1]
        size = math.sqrt(gx * gx + gy * gy)
        limit = row[VEHICLE.friction] * max(depth, 0.0)
        if size > limit:
            keep = 0.0 if size == 0.0 else limit / size
            anchor[k, 0], anchor[k, 1] = x - gx * keep, y - gy * keep
