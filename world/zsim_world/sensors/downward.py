"""The effect of an obstacle or a drone below on sonar and optical flow. Compiled.

A flow camera measures the motion of its picture, from which the board computes a velocity with the distance measured by
the sonar. A picture with two motions, of the ground and of a drone below, gives that of the larger part, as does the
largest peak of a histogram of block motions (PX4/Flow, src/modules/flow/flow.c).
"""

import math

from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import inlined, noinline
from zsim.math.rotation import Vector, add, axpy, heading, rotate, scaled, subtract, z_axis
from zsim_world.physics.fleet_arrays import STATE, VEHICLE
from zsim_world.physics.rays import Scene, cast_ground, cast_hull, cast_parts
from zsim_world.physics.rigid_body import four, vector, velocity_at
from zsim_world.sensors.equations import SONAR_COSINE_MIN, BodyTruth, MountedSensor

# Of the picture, tangents of half of its view ahead and aside: 320 x 240 pixels, 64 deg across (data sheet of the
# AR.Drone 2.0); taken for every vehicle's
HALF_VIEW = (0.375, 0.5)
# Middles of the cells of a picture in 3 x 3, but the one in the middle; a hull that has more than half of all nine
# has the one in the middle and four of these
CELLS = ((-1.0, -1.0), (-1.0, 0.0), (-1.0, 1.0), (0.0, -1.0), (0.0, 1.0), (1.0, -1.0), (1.0, 0.0), (1.0, 1.0))
CELLS_MIN = 4


@inlined
def _beam(x: BodyTruth, s: MountedSensor) -> tuple[Vector, Vector]:
    """Return where a sensor is, and the unit vector along its -z, in W."""
    return add(x.p_WB, rotate(x.q_WB, s.p_BS)), scaled(rotate(x.q_WB, z_axis(s.q_BS)), -1.0)


@inlined
def _hull(state: NDArray, vehicle: NDArray, i: int, o: Vector, d: Vector, far: float) -> tuple[float, int]:
    """Return the distance [m] at which a ray meets the hull of a drone other than i, and whose; `far` and -1 if none.

    Args:
        state, vehicle: of all drones, as in Bodies.
    """
    nearest, whose = far, -1
    for j in range(state.shape[0]):
        if j != i:
            p, q = vector(state[j], STATE.p_WB), four(state[j], STATE.q_WB)
            met = cast_hull(p, q, vehicle[j, VEHICLE.hull_radius], o, d, nearest)
            if met < nearest:
                nearest, whose = met, j
    return nearest, whose


@noinline
def sonar_over(
    x: BodyTruth, s: MountedSensor, value: Vector, scene: Scene, state: NDArray, vehicle: NDArray, i: int
) -> Vector:
    """Return distance [m] and echo of a sonar from the first object in its beam, given those over the bare ground.

    As over the ground, there is no echo if the beam is too far from the vertical.

    Args:
        state, vehicle: of all drones, as in Bodies; i: whose sonar it is.
    """
    o, d = _beam(x, s)
    if -d[2] < SONAR_COSINE_MIN:
        return value
    distance, _ = _hull(state, vehicle, i, o, d, cast_parts(scene, o, d, value[0]))
    return (distance, 1.0, 0.0) if distance < value[0] else value


@noinline
def flow_over(
    x: BodyTruth,
    s: MountedSensor,
    ranging: MountedSensor,
    value: Vector,
    scene: Scene,
    state: NDArray,
    vehicle: NDArray,
    i: int,
) -> Vector:
    """Return the velocity [m/s] that a flow sensor reports, given that over the bare ground.

    It is the velocity relative to the surface in the picture, times the ratio of the distance measured by the sonar to
    that of the surface: correct if both see the same surface. The surface is the one in the middle of the picture, a
    drone's hull only if it covers most of the picture, with the velocity of the hull where the axis meets it.

    Args:
        ranging: the sonar; state, vehicle: of all drones, as in Bodies; i: whose sensor it is.
    """
    o, d = _beam(x, s)
    b, down = _beam(x, ranging)
    far = ranging.range_max
    if -d[2] < SONAR_COSINE_MIN or -down[2] < SONAR_COSINE_MIN:
        return value  # without a distance the board keeps the last one
    seen = cast_parts(scene, o, d, far)
    measured, _ = _hull(state, vehicle, i, b, down, cast_parts(scene, b, down, far))
    covered, whose = _hull(state, vehicle, i, o, d, seen)
    if whose >= 0 and not _covers(x, s, scene, state[whose], vehicle[whose, VEHICLE.hull_radius], o, far):
        covered, whose = seen, -1
    if covered >= far and measured >= far:
        return value
    seen, measured = cast_ground(o, d, covered), cast_ground(b, down, measured)
    if seen >= far or measured >= far or seen <= 0.0:
        return value
    u, v = value[0], value[1]
    if whose >= 0:
        arm = subtract(axpy(o, seen, d), vector(state[whose], STATE.p_WB))
        moving, psi = velocity_at(state[whose], arm), heading(x.q_WB)
        cos, sin = el.cos(psi), el.sin(psi)
        u, v = u - (cos * moving[0] + sin * moving[1]), v - (cos * moving[1] - sin * moving[0])
    return (u * measured / seen, v * measured / seen, value[2])


@inlined
def _covers(x: BodyTruth, s: MountedSensor, scene: Scene, hull: NDArray, radius: float, o: Vector, far: float) -> bool:
    """Tell whether the hull of a drone in the middle of the picture covers most of it."""
    cells, share = 0, 2.0 / 3.0
    for k in range(len(CELLS)):
        ahead, aside = share * HALF_VIEW[0] * CELLS[k][0], share * HALF_VIEW[1] * CELLS[k][1]
        per = 1.0 / math.sqrt(ahead * ahead + aside * aside + 1.0)
        d = rotate(x.q_WB, rotate(s.q_BS, (ahead * per, aside * per, -per)))
        free = cast_parts(scene, o, d, far)
        if cast_hull(vector(hull, STATE.p_WB), four(hull, STATE.q_WB), radius, o, d, free) < free:
            cells += 1
    return cells >= CELLS_MIN
