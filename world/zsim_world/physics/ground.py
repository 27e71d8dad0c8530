"""The ground z = 0: spring and damper under every contact point, with dry friction that holds a standing drone.

Friction is a spring to an anchor on the ground; where it would exceed the friction cone, the anchor is dragged along.
The anchor stays still within a step and moves after it, so that a step is a smooth function of the state.
"""

import math

from numpy.typing import NDArray

from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, add, cross, rotate, rotate_back
from zsim_world.state.vehicle import (
    CONTACT_POINTS_B,
    CONTACT_REACH_M,
    FOOT_DAMPING,
    FOOT_STIFFNESS,
    FRICTION,
    SIZE,
    Row,
)

Pair = tuple[float, float]


@inlined
def _point(row: Row, k: int) -> Vector:
    s = row[SIZE]
    return (s * CONTACT_POINTS_B[k, 0], s * CONTACT_POINTS_B[k, 1], s * CONTACT_POINTS_B[k, 2])


@inlined
def _tangential(row: Row, normal: float, gap: Pair, speed: Pair) -> Pair:
    """Return the friction force [N] of one point, within the cone."""
    fx = -row[FOOT_STIFFNESS] * gap[0] - row[FOOT_DAMPING] * speed[0]
    fy = -row[FOOT_STIFFNESS] * gap[1] - row[FOOT_DAMPING] * speed[1]
    size = math.sqrt(fx * fx + fy * fy)
    limit = FRICTION * normal
    if size <= limit:
        return fx, fy
    return fx * limit / size, fy * limit / size


@inlined
def contact(
    row: Row, anchor: NDArray, p_WB: Vector, v_WB: Vector, q_WB: Quaternion, w_WB_B: Vector
) -> tuple[Vector, Vector]:
    """Return force in W [N] and moment in B [N m] of the ground on one drone.

    Args:
        row: the drone's parameters (vehicle.py).
        anchor: (8, 2) anchors of the contact points on the ground [m].
        p_WB, v_WB, q_WB, w_WB_B: state of the drone [m, m/s, -, rad/s].
    """
    force, moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if p_WB[2] > CONTACT_REACH_M * row[SIZE]:
        return force, moment
    for k in range(CONTACT_POINTS_B.shape[0]):
        r_B = _point(row, k)
        r_W = rotate(q_WB, r_B)
        depth = -(p_WB[2] + r_W[2])
        if depth > 0.0:
            v = add(v_WB, rotate(q_WB, cross(w_WB_B, r_B)))
            normal = max(row[FOOT_STIFFNESS] * depth - row[FOOT_DAMPING] * v[2], 0.0)
            gap = (p_WB[0] + r_W[0] - anchor[k, 0], p_WB[1] + r_W[1] - anchor[k, 1])
            fx, fy = _tangential(row, normal, gap, (v[0], v[1]))
            f_W = (fx, fy, normal)
            force = add(force, f_W)
            moment = add(moment, cross(r_B, rotate_back(q_WB, f_W)))
    return force, moment


@inlined
def drag_anchors(row: NDArray, anchor: NDArray, p_WB: Vector, q_WB: Quaternion) -> None:
    """Move the anchors after a step: to the point itself in the air, along with it where it slides."""
    for k in range(CONTACT_POINTS_B.shape[0]):
        r_W = rotate(q_WB, _point(row, k))
        x, y = p_WB[0] + r_W[0], p_WB[1] + r_W[1]
        depth = -(p_WB[2] + r_W[2])
        gx, gy = x - anchor[k, 0], y - anchor[k, 1]
        size = math.sqrt(gx * gx + gy * gy)
        limit = FRICTION * max(depth, 0.0)
        if size > limit:
            keep = 0.0 if size == 0.0 else limit / size
            anchor[k, 0], anchor[k, 1] = x - gx * keep, y - gy * keep
