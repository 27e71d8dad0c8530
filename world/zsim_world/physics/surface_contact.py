"""Contact of each ball of a drone with surfaces (sheets of triangles): a plane, found after every step and then held.

The plane is that of the nearest point, so that the force of surfaces.py is a smooth function of the state within a
step. A sheet has no inside. A ball starts in front of it and its side is stored: it changes sides when its path from
step to step crosses a triangle, and behind the sheet it is pushed back, however deep it is. Beside a rim a ball is
always free. A closed mesh therefore acts from outside as a solid; like a box, it can be penetrated where a wall is
thinner than the dent of a collision.
"""

from numpy.typing import NDArray

from zsim.math.compiled import inlined, noinline
from zsim.math.rotation import Quaternion, Vector, add, norm, rotate, scaled, subtract
from zsim.scenario.surroundings import FACE, Sheet, crosses, nearest_point, side_of
from zsim_world.physics.fleet_arrays import STATE, VEHICLE, Bodies, Row
from zsim_world.physics.surfaces import (
    BALLS,
    FEET,
    PLANE,
    ball,
    brace,
    drag,
    note_bump,
    plane_depth,
    reach_of,
)

LOST_M = 1.0  # m, chosen: depth at which a drone is beyond the sheet
TINY_M = 1e-9  # m; nearer to an edge or corner a ball keeps its normal
ROOM_M = 1e-6  # m, above the rounding error of a distance


@noinline
def meet_surfaces(bodies: Bodies, sheet: Sheet) -> None:
    """Find the planes of all drones' balls, move their anchors, and note which hulls touch which surface.

    `braced[i]` becomes 1 where a surface is in reach; `bumping` and `bumped` as in `meet_obstacles`, behind obstacles.
    """
    first = bodies.obstacle.shape[0]
    for i in range(bodies.state.shape[0]):
        row, state, planes = bodies.vehicle[i], bodies.state[i], bodies.plane[i]
        p_WB = _vector(state, STATE.p_WB)
        reach = reach_of(row, _vector(state, STATE.v_WB))
        for k in range(BALLS):
            if planes[k, PLANE.side] < 0.0:
                reach = max(reach, LOST_M)
        away = nearest_point(sheet, p_WB, reach).distance
        if away < reach:
            brace(bodies, i)
            q = STATE.q_WB
            q_WB = (state[q], state[q + 1], state[q + 2], state[q + 3])
            for k in range(BALLS):
                _follow(row, sheet, planes[k], k, p_WB, q_WB, away)
        else:
            for k in range(BALLS):
                planes[k, PLANE.side] = 0.0
        for thing in range(first, bodies.bumping.shape[1]):
            hit = False
            for k in range(FEET, BALLS):
                if planes[k, PLANE.surface] == thing - first and plane_depth(planes[k], ball(row, k)[1]) > 0.0:
                    hit = True
            note_bump(bodies, i, thing, hit)


@inlined
def _vector(row: NDArray, at: int) -> Vector:
    return (row[at], row[at + 1], row[at + 2])


@inlined
def _follow(row: Row, sheet: Sheet, plane: NDArray, k: int, p_WB: Vector, q_WB: Quaternion, away: float) -> None:
    """Find the plane of ball k of a drone whose centre is `away` [m] from the nearest surface, and move its anchor.

    A ball without a plane starts in front of the surface, unless it is slightly behind it as seen from the drone's
    centre, as the feet of a drone that stands on the surface are.
    """
    r_B, radius = ball(row, k)
    x = add(p_WB, rotate(q_WB, r_B))
    found = nearest_point(sheet, x, away + norm(r_B) + ROOM_M)
    is_new = plane[PLANE.side] == 0.0
    side = 1.0 if is_new else plane[PLANE.side]
    was = p_WB if is_new else _vector(plane, PLANE.centre_W)
    near = row[VEHICLE.foot_depth] if is_new else norm(subtract(x, was))  # else its way is too short
    if found.distance <= near and crosses(sheet, was, x):
        side = -side
    triangle = sheet.triangle[found.triangle]
    n = _vector(plane, PLANE.normal_W)
    if found.feature == FACE:
        volume, normal = side_of(triangle, x)
        n = scaled(normal, (side if volume >= 0.0 else -side) / norm(normal))
    else:
        if sheet.rim[found.triangle, found.feature] != 0:
            side = 1.0
        if found.distance > TINY_M:
            n = scaled(subtract(x, found.point), side / found.distance)
    plane[PLANE.side], plane[PLANE.distance] = side, side * found.distance
    plane[PLANE.surface] = sheet.surface[found.triangle]
    for axis in range(3):
        plane[PLANE.normal_W + axis], plane[PLANE.centre_W + axis] = n[axis], x[axis]
    anchor = plane[PLANE.anchor_W : PLANE.anchor_W + 3]
    drag(row, plane_depth(plane, radius), x, n, anchor, is_new)
