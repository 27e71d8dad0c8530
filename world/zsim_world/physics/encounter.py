"""What drones do to each other: hulls that touch, and the downwash on those that fly below."""

import math

from numpy.typing import NDArray

from zsim.math.compiled import inlined
from zsim.math.rotation import Vector, z_axis
from zsim_world.physics.rigid_body import ATTITUDE, POSITION, ROTOR, VELOCITY, four
from zsim_world.physics.rotors import Four
from zsim_world.state.fleet_arrays import Near
from zsim_world.state.vehicle import AIR_DENSITY, HULL_DAMPING, HULL_RADIUS, HULL_STIFFNESS, ROTOR_RADIUS, THRUST

JET_START = 2.0  # rotor radii, width at which a Gaussian jet of speed 2 v_h carries the thrust of four rotors
JET_SPREAD = 0.107  # growth of a round jet's 1/e width (Fischer et al., Mixing in Inland and Coastal Waters, 1979)
JET_WIDTHS = 3.0  # beyond three widths the jet is 1e-4 of its core
DISTANCE_MIN_M = 1e-9  # m, so that two drones in one place have a direction
STRAY_M = 0.25  # m, by which each drone may move before near pairs are found anew: 0.4 s at 0.6 m/s
APPROACH_M = 0.501  # m, by which a pair's distance may have changed by then: twice as much, and room for rounding


@inlined
def jet_reach(radius_m: float, below_m: float) -> float:
    """Return how far aside [m] of a drone of rotors of this radius its jet blows, so much below it."""
    return JET_WIDTHS * (JET_START * radius_m + JET_SPREAD * below_m)


@inlined
def downwash(thrust_n: float, density: float, radius_m: float, below_m: float, aside_m: float) -> float:
    """Return the downward speed [m/s] of the air below a hovering drone.

    The far wake of momentum theory, 2 v_h = 2 sqrt(T / (2 rho A)), as a turbulent round jet that keeps its momentum:
    w = 2 v_h (b0 / b) exp(-(r / b)^2), b = b0 + 0.107 z, b0 = 2 R.

    Args:
        thrust_n: of the drone above; density: of the air [kg/m^3]; radius_m: of each of its four rotors.
        below_m, aside_m: where, from the drone above, both >= 0.
    """
    start = JET_START * radius_m
    width = start + JET_SPREAD * below_m
    if aside_m > JET_WIDTHS * width or thrust_n <= 0.0:
        return 0.0
    disc = 4.0 * math.pi * radius_m * radius_m
    core = 2.0 * math.sqrt(thrust_n / (2.0 * density * disc)) * start / width
    ratio = aside_m / width
    return core * math.exp(-ratio * ratio)


@inlined
def hull_force(stiffness: float, damping: float, depth_m: float, closing_m_s: float) -> float:
    """Return the force [N] that parts two hulls dented by `depth_m`; never an attraction."""
    if depth_m <= 0.0:
        return 0.0
    return max(stiffness * depth_m + damping * closing_m_s, 0.0)


@inlined
def _free_thrust(row: NDArray, speed: Four) -> float:
    s = 0.0
    for k in range(4):
        s += speed[k] * speed[k]
    return row[THRUST] * s


@inlined
def _apart(state: NDArray, i: int, j: int) -> Vector:
    """Return p_j - p_i [m]."""
    return (
        state[j, POSITION] - state[i, POSITION],
        state[j, POSITION + 1] - state[i, POSITION + 1],
        state[j, POSITION + 2] - state[i, POSITION + 2],
    )


@inlined
def _blow(vehicle: NDArray, state: NDArray, above: int, below: int, aside: float, drop: float, air: NDArray) -> None:
    thrust = _free_thrust(vehicle[above], four(state[above], ROTOR)) * z_axis(four(state[above], ATTITUDE))[2]
    air[below, 2] -= downwash(thrust, vehicle[above, AIR_DENSITY], vehicle[above, ROTOR_RADIUS], drop, aside)


@inlined
def _touch(vehicle: NDArray, state: NDArray, i: int, j: int, d: Vector, distance: float, push: NDArray) -> None:
    """Push drones i and j apart along d = p_j - p_i."""
    closing = 0.0
    for k in range(3):
        closing -= (state[j, VELOCITY + k] - state[i, VELOCITY + k]) * d[k] / distance
    # the softer of the two, so that a light drone stays within what its step can follow
    stiffness = min(vehicle[i, HULL_STIFFNESS], vehicle[j, HULL_STIFFNESS])
    damping = min(vehicle[i, HULL_DAMPING], vehicle[j, HULL_DAMPING])
    depth = vehicle[i, HULL_RADIUS] + vehicle[j, HULL_RADIUS] - distance
    force = hull_force(stiffness, damping, depth, closing) / distance
    for k in range(3):
        push[i, k] -= force * d[k]
        push[j, k] += force * d[k]


@inlined
def _meet(
    vehicle: NDArray,
    state: NDArray,
    i: int,
    j: int,
    air: NDArray,
    push: NDArray,
    touching: NDArray,
    touched: NDArray,
) -> float:
    """Let drones i < j act on each other; return their distance [m]."""
    dx, dy, dz = _apart(state, i, j)
    aside2 = dx * dx + dy * dy
    distance = max(math.sqrt(aside2 + dz * dz), DISTANCE_MIN_M)
    contact = distance < vehicle[i, HULL_RADIUS] + vehicle[j, HULL_RADIUS]
    if contact:
        _touch(vehicle, state, i, j, (dx, dy, dz), distance, push)
        if touching[i, j] == 0:
            touched[i, j] = 1
    touching[i, j] = 1 if contact else 0
    above = j if dz > 0.0 else i
    reach = jet_reach(vehicle[above, ROTOR_RADIUS], abs(dz))
    if aside2 < reach * reach:
        _blow(vehicle, state, above, i + j - above, math.sqrt(aside2), abs(dz), air)
    return distance


@inlined
def _strayed(state: NDArray, origin: NDArray) -> bool:
    """Return whether a drone has left the surroundings for which the near pairs were found."""
    for i in range(state.shape[0]):
        square = 0.0
        for k in range(3):
            square += (state[i, POSITION + k] - origin[i, k]) ** 2
        if not square < STRAY_M * STRAY_M:
            return True
    return False


@inlined
def _find_near(vehicle: NDArray, state: NDArray, touching: NDArray, near: Near) -> None:
    """Note all pairs that can touch, blow on each other or be the closest before a drone strays; forget the others."""
    count, least = 0, math.inf
    for i in range(state.shape[0]):
        for k in range(3):
            near.origin[i, k] = state[i, POSITION + k]
        for j in range(i + 1, state.shape[0]):
            dx, dy, dz = _apart(state, i, j)
            aside = math.sqrt(dx * dx + dy * dy)
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            least = min(least, distance)
            closest = max(least + APPROACH_M, vehicle[i, HULL_RADIUS] + vehicle[j, HULL_RADIUS]) + APPROACH_M
            radius = max(vehicle[i, ROTOR_RADIUS], vehicle[j, ROTOR_RADIUS])
            jet = jet_reach(radius, abs(dz) + APPROACH_M) + APPROACH_M
            if distance > closest and aside > jet:
                touching[i, j] = 0
            else:
                near.pair[count, 0], near.pair[count, 1] = i, j
                count += 1
    near.noted[0] = count


@inlined
def encounters(
    vehicle: NDArray, state: NDArray, air: NDArray, push: NDArray, touching: NDArray, touched: NDArray, near: Near
) -> float:
    """Add downwash to `air`, the forces between hulls to `push`, and return the least distance [m].

    Only near pairs are looked at, in the order of all pairs: the result is that of all pairs, to the last bit. They are
    found anew when a drone has moved by STRAY_M since.

    Args:
        vehicle, state: parameters and state, a row per drone.
        air: (N, 3) velocity of the air [m/s], added to.
        push: (N, 3) force [N], added to.
        touching: (N, N) 1 where i < j are in contact now, updated; touched: (N, N) set to 1 where contact begins.
        near: what was found last.
    """
    if _strayed(state, near.origin):
        _find_near(vehicle, state, touching, near)
    least = math.inf
    for n in range(near.noted[0]):
        i, j = near.pair[n, 0], near.pair[n, 1]
        least = min(least, _meet(vehicle, state, i, j, air, push, touching, touched))
    return least
