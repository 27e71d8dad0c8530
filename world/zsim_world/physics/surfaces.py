"""Contact with ground (z = 0), obstacles and surfaces: spring and damper under every contact point, with dry friction.

Friction is a spring to an anchor on the surface; where it would exceed the friction cone, the anchor is dragged along.
The anchor is fixed within a step and moved after it, so that a step is a smooth function of the state.

At obstacles a drone is a rigid set of balls: the ground contact points, with radius zero, then balls along its hull and
one at its centre, so that neither a post nor an edge fits between them. A ball is pushed along the surface normal by
the same law. The distance to a convex solid acts as a potential, so springs and anchors never return more energy than
was put in. A drone has slots for the solids within its reach, each with an anchor per ball; they are updated after
every step and fixed during it.

At surfaces (sheets of triangles) each ball instead has a plane at the nearest point, found after every step and
then fixed. A sheet has no inside. A ball starts in front of it, and its side is stored: it changes sides when its path
from step to step crosses a triangle. Behind the sheet it is pushed back while the drone's centre is within
PENETRATION_MAX_M. A ball nearest to an outer edge is always in front. A closed mesh therefore acts from outside as a
solid; like a box, it can be penetrated where a wall is thinner than the dent of a collision.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import Field, columns, inlined, noinline
from zsim.math.rotation import Quaternion, Vector, add, axpy, cross, dot, norm, rotate, rotate_back, scaled, subtract
from zsim.scenario import surroundings
from zsim.scenario.scenario import Environment
from zsim.scenario.surroundings import FACE, Sheet, crosses, nearest_point, side_of
from zsim_world.physics.fleet_arrays import STATE, VEHICLE, Bodies, Row, four, vector

Pair = tuple[float, float]


POINTS = 8  # ground contact points: four feet, four corners of the hull's rim


@inlined
def contact_point(row: Row, k: int) -> Vector:
    """Return contact point k in B [m]: front left, front right, rear right, rear left; the feet come first."""
    foot, x, y = k < 4, 1.0 if k % 4 < 2 else -1.0, 1.0 if k % 4 in (0, 3) else -1.0
    xy = row[VEHICLE.foot_xy] if foot else row[VEHICLE.rim_xy]
    return (x * xy, y * xy, -row[VEHICLE.foot_depth] if foot else row[VEHICLE.rim_height])


def contact_points(row: NDArray) -> np.ndarray:
    """Return all contact points in B [m], (POINTS, 3)."""
    of_row = getattr(contact_point, "py_func", contact_point)  # not compiled, since it is rarely called
    return np.array([[float(x) for x in of_row(row, k)] for k in range(POINTS)])


@inlined
def _tangential(row: Row, normal: float, gap: Pair, speed: Pair) -> Pair:
    """Return the friction force [N] on one point, within the friction cone."""
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
    """Return the force in W [N] and moment in B [N m] that the ground exerts on one drone.

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
    """Move the anchors after a step: to a contact point that is in the air, and along with one that slides."""
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


HULL_BALLS = 16  # design choice: gaps of 2 cm between them on the AR.Drone; a thinner post meets the ball at the centre
BALLS = POINTS + HULL_BALLS + 1
BALL_SHARE = 0.35  # radius / height from feet to rim; design choice: in a landing tilted by 9 deg no hull ball touches
BELOW_RIM_SHARE = 0.05  # of the same height; design choice: more than a foot's sag, so the rim bears an upturned drone
FEET = 4  # number of feet, which come first among the contact points
SLOTS_MAX = 8  # solids within reach of one drone at a time; design choice: as many boxes as can meet in a corner
LOOKAHEAD_S = 0.01  # s; two of the longest steps: whatever a drone can touch within this time is within reach
_ANGLES = [2.0 * math.pi * (k + 0.5) / HULL_BALLS for k in range(HULL_BALLS)]
_COSINES = (
    *(el.cos(angle) for angle in _ANGLES),
    0.0,
)  # cosines of the directions of the hull balls; 0 for the ball at the centre
_SINES = (*(el.sin(angle) for angle in _ANGLES), 0.0)

nearest: Any = inlined(surroundings.nearest)


PLANE = columns(  # plane of a ball, at the nearest point of a surface
    "PlaneColumns",
    (
        Field("side", "1"),  # 1: in front; -1: behind, where the ball is pushed back; 0: no surface within reach
        Field("normal_W", "1", 3),  # points to the side where the ball is free
        Field("distance", "m"),  # signed distance of the ball's centre, negative behind the plane
        Field("surface", "1"),
        Field("centre_W", "m", 3),  # the ball's centre when the plane was found
        Field("anchor_W", "m", 3),
    ),
)


class Touch(NamedTuple):
    """The contacts of one drone other than with the ground."""

    obstacle: NDArray  # (M, surroundings.COLUMNS)
    solid: NDArray  # int32 (K,), indices in `obstacle` of those within reach; -1: empty slot
    anchor: NDArray  # (K, BALLS, 3), anchors of the balls [m; W]
    plane: NDArray  # (BALLS, PLANE.size); (0, PLANE.size) where there are no surfaces
    twist_W: Vector  # moment of other drones' hulls [N m]


def obstacle_rows(environment: Environment) -> NDArray[np.float64]:
    return np.array([surroundings.row_of(each) for each in environment.obstacles]).reshape(-1, surroundings.COLUMNS)


@inlined
def ball(row: Row, k: int) -> tuple[Vector, float]:
    """Return the centre in B and the radius [m] of ball k: four feet, four corners of the rim, the hull, its centre."""
    if k < POINTS:
        return contact_point(row, k), 0.0
    height = abs(row[VEHICLE.rim_height] + row[VEHICLE.foot_depth])
    radius = BALL_SHARE * height
    line = max(row[VEHICLE.hull_radius] - radius, 0.0)
    z = row[VEHICLE.rim_height] - BELOW_RIM_SHARE * height - radius
    return (line * _COSINES[k - POINTS], line * _SINES[k - POINTS], z), radius


@inlined
def _tangential_part(a: Vector, n: Vector) -> Vector:
    """Return the component of a vector perpendicular to the unit vector n."""
    return axpy(a, -dot(a, n), n)


@noinline
def touched(
    row: Row, touch: Touch, p_WB: Vector, v_WB: Vector, q_WB: Quaternion, w_WB_B: Vector
) -> tuple[Vector, Vector]:
    """Return the force in W [N] and moment in B [N m] of obstacles and surfaces on one drone, plus other hulls' moment.

    Args:
        row: the drone's parameters; touch: its contacts.
        p_WB, v_WB, q_WB, w_WB_B: state of the drone [m, m/s, -, rad/s].
    """
    force, moment = (0.0, 0.0, 0.0), rotate_back(q_WB, touch.twist_W)
    for s in range(touch.solid.shape[0]):
        if touch.solid[s] < 0:
            continue
        for k in range(BALLS):
            r_B, radius = ball(row, k)
            x = add(p_WB, rotate(q_WB, r_B))
            distance, nx, ny, nz = nearest(touch.obstacle[touch.solid[s]], x[0], x[1], x[2])
            depth, n = radius - distance, (nx, ny, nz)
            if depth > 0.0:
                v = add(v_WB, rotate(q_WB, cross(w_WB_B, r_B)))
                f_W = _contact_force(row, k, depth, n, subtract(x, vector(touch.anchor[s, k], 0)), v)
                force = add(force, f_W)
                moment = add(moment, cross(r_B, rotate_back(q_WB, f_W)))
    for k in range(touch.plane.shape[0]):
        plane = touch.plane[k]
        if plane[PLANE.side] != 0.0:
            r_B, radius = ball(row, k)
            x, n = add(p_WB, rotate(q_WB, r_B)), vector(plane, PLANE.normal_W)
            displacement = subtract(x, vector(plane, PLANE.centre_W))
            depth = radius - (plane[PLANE.distance] + dot(n, displacement))
            if depth > 0.0:
                v = add(v_WB, rotate(q_WB, cross(w_WB_B, r_B)))
                gap = subtract(x, vector(plane, PLANE.anchor_W))
                f_W = _contact_force(row, k, depth, n, gap, v)
                force = add(force, f_W)
                moment = add(moment, cross(r_B, rotate_back(q_WB, f_W)))
    return force, moment


@inlined
def _contact_force(row: Row, k: int, depth: float, n: Vector, gap: Vector, v: Vector) -> Vector:
    """Return the force in W [N] on ball k, which is `depth` [m] deep in a body with surface normal n.

    Args:
        gap: vector from the ball's anchor to its centre [m; W]; v: the ball's velocity [m/s; W].
    """
    hull = k >= POINTS
    stiffness = row[VEHICLE.hull_stiffness] if hull else row[VEHICLE.foot_stiffness]
    damping = row[VEHICLE.hull_damping] if hull else row[VEHICLE.foot_damping]
    normal = max(stiffness * depth - damping * dot(v, n), 0.0)
    friction = axpy(scaled(_tangential_part(gap, n), -stiffness), -damping, _tangential_part(v, n))
    size, limit = norm(friction), row[VEHICLE.friction] * normal
    return axpy(scaled(n, normal), 1.0 if size <= limit else limit / size, friction)


@inlined
def plane_depth(plane: NDArray, radius: float) -> float:
    """Return how deep [m] a ball was in a surface when its plane was found; at most 0 without contact."""
    return radius - plane[PLANE.distance] if plane[PLANE.side] != 0.0 else 0.0


@noinline
def meet_obstacles(bodies: Bodies) -> None:
    """Find the obstacles within each drone's reach, move the drone's anchors, and note hull contacts.

    `braced[i]` is set to 1 if there are any; `bumping[i, m]` is 1 if more than the feet is in contact now; `bumped`
    is set to 1 where such contact begins.
    """
    p, v = STATE.p_WB, STATE.v_WB
    for i in range(bodies.state.shape[0]):
        row, state = bodies.vehicle[i], bodies.state[i]
        reach = reach_of(row, vector(state, v))
        for m in range(bodies.obstacle.shape[0]):
            distance = nearest(bodies.obstacle[m], state[p], state[p + 1], state[p + 2])[0]
            hit = False
            if distance < reach:
                brace(bodies, i)
                s = _slot(bodies, i, m, distance)
                if s >= 0:
                    is_new = bodies.solid[i, s] != m
                    bodies.solid[i, s] = m
                    hit = _drag_anchors(row, bodies.obstacle[m], bodies.held[i, s], state, is_new)
            else:
                for s in range(bodies.solid.shape[1]):
                    if bodies.solid[i, s] == m:
                        bodies.solid[i, s] = -1
            note_bump(bodies, i, m, hit)


@inlined
def reach_of(row: NDArray, v_WB: Vector) -> float:
    """Return the distance [m] from a drone's centre within which contact is possible in the next steps."""
    reach = max(row[VEHICLE.contact_reach], row[VEHICLE.hull_radius]) + ball(row, POINTS)[1]
    return reach + LOOKAHEAD_S * norm(v_WB)


@inlined
def note_bump(bodies: Bodies, i: int, m: int, hit: bool) -> None:
    if hit and bodies.bumping[i, m] == 0:
        bodies.bumped[i, m] = 1
    bodies.bumping[i, m] = 1 if hit else 0


@inlined
def brace(bodies: Bodies, i: int) -> None:
    """Mark drone i as not in free air: it is stepped with all its contacts."""
    if bodies.braced[i] == 0:
        bodies.braced[i] = 1
        for k in range(3):
            bodies.twist[i, k] = 0.0


@inlined
def _slot(bodies: Bodies, i: int, m: int, distance: float) -> int:
    """Return the slot for obstacle m of drone i: its present one, or that of the farthest one; -1 if all are nearer."""
    solid, p = bodies.solid[i], STATE.p_WB
    x, y, z = bodies.state[i, p], bodies.state[i, p + 1], bodies.state[i, p + 2]
    chosen, farthest = -1, distance
    for s in range(solid.shape[0]):
        if solid[s] == m:
            return s
        slot_distance = math.inf if solid[s] < 0 else nearest(bodies.obstacle[solid[s]], x, y, z)[0]
        if slot_distance > farthest:
            chosen, farthest = s, slot_distance
    return chosen


@inlined
def _drag_anchors(row: NDArray, solid: NDArray, anchor: NDArray, state: NDArray, is_new: bool) -> bool:
    """Move the anchors of one drone on one obstacle after a step; return whether more than its feet touches it.

    An anchor is put at its ball's centre if there is no contact or `is_new`; otherwise it follows the ball within the
    friction cone.
    """
    p_WB, q_WB = vector(state, STATE.p_WB), four(state, STATE.q_WB)
    hit = False
    for k in range(BALLS):
        r_B, radius = ball(row, k)
        x = add(p_WB, rotate(q_WB, r_B))
        distance, nx, ny, nz = nearest(solid, x[0], x[1], x[2])
        hit |= distance < radius and k >= FEET
        drag(row, radius - distance, x, (nx, ny, nz), anchor[k], is_new)
    return hit


@inlined
def drag(row: Row, depth: float, x: Vector, n: Vector, anchor: NDArray, is_new: bool) -> None:
    """Move the anchor (3,) [m; W] of a ball at x, which is `depth` [m] deep in a body with surface normal n."""
    keep, gap = 0.0, (0.0, 0.0, 0.0)
    if depth > 0.0:
        if not is_new:
            gap = _tangential_part(subtract(x, vector(anchor, 0)), n)
        size, limit = norm(gap), row[VEHICLE.friction] * depth
        keep = 1.0 if size <= limit else limit / size
    for axis in range(3):
        anchor[axis] = x[axis] - keep * gap[axis]


PENETRATION_MAX_M = 1.0  # m; design choice: distance of a drone's centre from which a sheet no longer pushes it back
EDGE_DISTANCE_M = 1e-9  # m; within this distance of an edge or corner a ball keeps its normal
DISTANCE_MARGIN_M = 1e-6  # m; margin above the rounding error of a distance


@noinline
def meet_surfaces(bodies: Bodies, sheet: Sheet) -> None:
    """Find the planes of all drones' balls, move their anchors, and note which hulls touch which surfaces.

    `braced[i]` is set to 1 if a surface is within reach; `bumping` and `bumped` are as in `meet_obstacles`, in the
    columns after those of obstacles.
    """
    first = bodies.obstacle.shape[0]
    for i in range(bodies.state.shape[0]):
        row, state, planes = bodies.vehicle[i], bodies.state[i], bodies.plane[i]
        p_WB = vector(state, STATE.p_WB)
        reach = reach_of(row, vector(state, STATE.v_WB))
        for k in range(BALLS):
            if planes[k, PLANE.side] < 0.0:
                reach = max(reach, PENETRATION_MAX_M)
        away = nearest_point(sheet, p_WB, reach).distance
        if away < reach:
            brace(bodies, i)
            q_WB = four(state, STATE.q_WB)
            for k in range(BALLS):
                _follow(row, sheet, planes[k], k, p_WB, q_WB, away)
        else:
            for k in range(BALLS):
                planes[k, PLANE.side] = 0.0
        for m in range(first, bodies.bumping.shape[1]):
            hit = False
            for k in range(FEET, BALLS):
                if planes[k, PLANE.surface] == m - first and plane_depth(planes[k], ball(row, k)[1]) > 0.0:
                    hit = True
            note_bump(bodies, i, m, hit)


@inlined
def _follow(row: Row, sheet: Sheet, plane: NDArray, k: int, p_WB: Vector, q_WB: Quaternion, away: float) -> None:
    """Find the plane of ball k of a drone whose centre is `away` [m] from the nearest surface, and move its anchor.

    A ball without a plane starts in front of the surface, unless it is slightly behind as seen from the drone's
    centre, like the feet of a drone that stands on the surface.
    """
    r_B, radius = ball(row, k)
    x = add(p_WB, rotate(q_WB, r_B))
    closest = nearest_point(sheet, x, away + norm(r_B) + DISTANCE_MARGIN_M)
    is_new = plane[PLANE.side] == 0.0
    side = 1.0 if is_new else plane[PLANE.side]
    previous = p_WB if is_new else vector(plane, PLANE.centre_W)
    # a ball farther from the surface than this has not crossed it
    max_distance = row[VEHICLE.foot_depth] if is_new else norm(subtract(x, previous))
    if closest.distance <= max_distance and crosses(sheet, previous, x):
        side = -side
    triangle = sheet.triangle[closest.triangle]
    n = vector(plane, PLANE.normal_W)
    if closest.feature == FACE:
        volume, normal = side_of(triangle, x)
        n = scaled(normal, (side if volume >= 0.0 else -side) / norm(normal))
    else:
        if sheet.rim[closest.triangle, closest.feature] != 0:
            side = 1.0
        if closest.distance > EDGE_DISTANCE_M:
            n = scaled(subtract(x, closest.point), side / closest.distance)
    plane[PLANE.side], plane[PLANE.distance] = side, side * closest.distance
    plane[PLANE.surface] = sheet.surface[closest.triangle]
    for axis in range(3):
        plane[PLANE.normal_W + axis], plane[PLANE.centre_W + axis] = n[axis], x[axis]
    anchor = plane[PLANE.anchor_W : PLANE.anchor_W + 3]
    drag(row, plane_depth(plane, radius), x, n, anchor, is_new)
