"""Hulls that touch, of drones and of obstacles, and the downwash on drones that fly below others."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import apart, inlined
from zsim.math.rotation import Vector, z_axis
from zsim.scenario import obstacle
from zsim.scenario.scenario import Environment
from zsim_world.physics.air import downwash, jet_reach
from zsim_world.physics.rigid_body import four
from zsim_world.physics.rotors import free_thrust
from zsim_world.state.fleet_arrays import STATE, VEHICLE, Bodies, NearPairs, PerRotor

DISTANCE_MIN_M = 1e-9  # m, so that two drones in one place have a direction
CLOSE = 1.0 + 1e-9  # of the square of a distance: more than rounding can make of it
STRAY_M = 0.25  # m, by which each drone may move before near pairs are found anew: 0.4 s at 0.6 m/s
APPROACH_M = 0.501  # m, by which a pair's distance may have changed by then: twice as much, and room for rounding


nearest: Any = inlined(obstacle.nearest)


@inlined
def hull_force(stiffness: float, damping: float, depth_m: float, closing_m_s: float) -> float:
    """Return the force [N] that parts two hulls dented by `depth_m`; never an attraction."""
    if depth_m <= 0.0:
        return 0.0
    return max(stiffness * depth_m + damping * closing_m_s, 0.0)


@inlined
def _apart(state: NDArray, i: int, j: int) -> Vector:
    """Return p_j - p_i [m]."""
    return (
        state[j, STATE.p_WB] - state[i, STATE.p_WB],
        state[j, STATE.p_WB + 1] - state[i, STATE.p_WB + 1],
        state[j, STATE.p_WB + 2] - state[i, STATE.p_WB + 2],
    )


@inlined
def _blow(bodies: Bodies, above: int, below: int, aside: float, drop: float) -> None:
    row, state = bodies.vehicle[above], bodies.state[above]
    thrust = free_thrust(row, PerRotor(state, STATE.size, 1, bodies.each)) * z_axis(four(state, STATE.q_WB))[2]
    bodies.air[below, 2] -= downwash(thrust, row[VEHICLE.air_density], row[VEHICLE.jet_start], drop, aside)


@inlined
def _touch(bodies: Bodies, i: int, j: int, d: Vector, distance: float) -> None:
    """Push drones i and j apart along d = p_j - p_i."""
    vehicle, state, closing = bodies.vehicle, bodies.state, 0.0
    for k in range(3):
        closing -= (state[j, STATE.v_WB + k] - state[i, STATE.v_WB + k]) * d[k] / distance
    # the softer of the two, so that a light drone stays within what its step can follow
    stiffness = min(vehicle[i, VEHICLE.hull_stiffness], vehicle[j, VEHICLE.hull_stiffness])
    damping = min(vehicle[i, VEHICLE.hull_damping], vehicle[j, VEHICLE.hull_damping])
    depth = vehicle[i, VEHICLE.hull_radius] + vehicle[j, VEHICLE.hull_radius] - distance
    force = hull_force(stiffness, damping, depth, closing) / distance
    for k in range(3):
        bodies.push[i, k] -= force * d[k]
        bodies.push[j, k] += force * d[k]


@inlined
def _meet(bodies: Bodies, i: int, j: int) -> float:
    """Let drones i < j act on each other; return the square of their distance [m^2]."""
    vehicle = bodies.vehicle
    dx, dy, dz = _apart(bodies.state, i, j)
    aside2 = dx * dx + dy * dy
    square = aside2 + dz * dz
    distance, hulls = math.inf, vehicle[i, VEHICLE.hull_radius] + vehicle[j, VEHICLE.hull_radius]
    if square < CLOSE * hulls * hulls:  # the root takes long, and most pairs are farther
        distance = max(math.sqrt(square), DISTANCE_MIN_M)
    contact = distance < hulls
    if contact:
        _touch(bodies, i, j, (dx, dy, dz), distance)
        if bodies.touching[i, j] == 0:
            bodies.touched[i, j] = 1
    bodies.touching[i, j] = 1 if contact else 0
    above = j if dz > 0.0 else i
    reach = jet_reach(vehicle[above, VEHICLE.jet_start], abs(dz))
    if aside2 < reach * reach:
        _blow(bodies, above, i + j - above, math.sqrt(aside2), abs(dz))
    return square


@inlined
def _strayed(state: NDArray, origin: NDArray) -> bool:
    """Return whether a drone has left the surroundings for which the near pairs were found."""
    for i in range(state.shape[0]):
        square = 0.0
        for k in range(3):
            square += (state[i, STATE.p_WB + k] - origin[i, k]) ** 2
        if not square < STRAY_M * STRAY_M:
            return True
    return False


@inlined
def _find_near(vehicle: NDArray, state: NDArray, touching: NDArray, near: NearPairs) -> None:
    """Note all pairs that can touch, blow on each other or be the closest before a drone strays; forget the others."""
    count, least = 0, math.inf
    for i in range(state.shape[0]):
        for k in range(3):
            near.origin[i, k] = state[i, STATE.p_WB + k]
        for j in range(i + 1, state.shape[0]):
            dx, dy, dz = _apart(state, i, j)
            aside = math.sqrt(dx * dx + dy * dy)
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            least = min(least, distance)
            hulls = vehicle[i, VEHICLE.hull_radius] + vehicle[j, VEHICLE.hull_radius]
            closest = max(least + APPROACH_M, hulls) + APPROACH_M
            start = max(vehicle[i, VEHICLE.jet_start], vehicle[j, VEHICLE.jet_start])
            jet = jet_reach(start, abs(dz) + APPROACH_M) + APPROACH_M
            if distance > closest and aside > jet:
                touching[i, j] = 0
            else:
                near.pair[count, 0], near.pair[count, 1] = i, j
                count += 1
    near.number[0] = count


@inlined
def meet_drones(bodies: Bodies) -> float:
    """Add downwash to `air`, the forces between hulls to `push`, and return the least distance [m].

    Only near pairs are looked at, in the order of all pairs: the result is that of all pairs, to the last bit. They are
    found anew when a drone has moved by STRAY_M since. `touching[i, j]` is 1 where i < j are in contact now; `touched`
    is set to 1 where contact begins.
    """
    near = bodies.near
    if _strayed(bodies.state, near.origin):
        _find_near(bodies.vehicle, bodies.state, bodies.touching, near)
    least = math.inf
    for n in range(near.number[0]):
        least = min(least, _meet(bodies, near.pair[n, 0], near.pair[n, 1]))
    return max(math.sqrt(least), DISTANCE_MIN_M)


def obstacle_rows(environment: Environment) -> NDArray[np.float64]:
    """Return the obstacles of a scenario, (M, obstacle.COLUMNS)."""
    return np.array([obstacle.row_of(each) for each in environment.obstacles]).reshape(-1, obstacle.COLUMNS)


@apart
def meet_obstacles(bodies: Bodies) -> None:
    """Add to `push` what obstacles push drones with, and note who touches which; a hull is a sphere.

    `bumping[i, m]` is 1 where they are in contact now; `bumped` is set to 1 where contact begins.
    """
    for i in range(bodies.state.shape[0]):
        for m in range(bodies.obstacle.shape[0]):
            depth = _push_off(bodies.vehicle[i], bodies.state[i], bodies.push[i], bodies.obstacle[m])
            if depth > 0.0 and bodies.bumping[i, m] == 0:
                bodies.bumped[i, m] = 1
            bodies.bumping[i, m] = 1 if depth > 0.0 else 0


@inlined
def _push_off(vehicle: NDArray, state: NDArray, push: NDArray, solid: NDArray) -> float:
    """Push one drone off one obstacle; return by how much its hull is dented [m], below 0 where they do not touch."""
    p, v = STATE.p_WB, STATE.v_WB
    distance, nx, ny, nz = nearest(solid, state[p], state[p + 1], state[p + 2])
    depth = vehicle[VEHICLE.hull_radius] - distance
    if depth > 0.0:
        closing = -(state[v] * nx + state[v + 1] * ny + state[v + 2] * nz)
        force = hull_force(vehicle[VEHICLE.hull_stiffness], vehicle[VEHICLE.hull_damping], depth, closing)
        push[0] += force * nx
        push[1] += force * ny
        push[2] += force * nz
    return depth
