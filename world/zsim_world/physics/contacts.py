"""Effects of air and other drones on a drone: wind, gusts, downwash, and contact between hulls, treated as spheres.

Gusts have the Dryden longitudinal form and are correlated between drones.
"""

import math

from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import Field, columns, inlined, noinline
from zsim.math.rotation import Vector, axpy, cross, dot, norm, scaled, subtract, z_axis
from zsim_world.physics.fleet_arrays import STATE, VEHICLE, Bodies, NearPairs, PerRotor, Row, four
from zsim_world.physics.rigid_body import free_thrust, velocity_at
from zsim_world.physics.surfaces import brace

WIND = columns(
    "WindColumns",
    (
        Field("steady", "m/s", 3),
        Field("gust", "m/s"),  # standard deviation per axis
        Field("length", "m"),
        Field("speed_min", "m/s"),
        Field("correlation", "1"),  # correlation between drones
    ),
)
JET_SPREAD = 0.107  # growth of a round jet's 1/e width (Fischer et al., Mixing in Inland and Coastal Waters, 1979)
JET_WIDTHS = 3.0  # beyond three widths the jet has about 1e-4 of its core speed


@inlined
def gust_decay(length_m: float, airspeed_m_s: float, speed_min_m_s: float, dt: float) -> float:
    """Return exp(-dt / tau) with the correlation time tau = L / max(airspeed, V0) of the Dryden form.

    MIL-HDBK-1797, longitudinal: S(w) = 2 sigma^2 tau / (1 + (tau w)^2), the spectrum of a first-order filter.
    """
    return el.exp(-dt * max(airspeed_m_s, speed_min_m_s) / length_m)


@inlined
def gust_noise(correlation: float, common: float, own: float) -> float:
    """Return a standard normal variate with the given correlation between drones."""
    return math.sqrt(correlation) * common + math.sqrt(1.0 - correlation) * own


@inlined
def advance_gust(wind: Row, v_WB: Vector, gust: NDArray, common: Vector, own: Vector, dt: float) -> None:
    """Advance the gust (3,) [m/s] at one drone by dt, in place, by exact discretisation of the filter.

    Args:
        wind: wind parameters (WIND.size,); load them once for many drones, so that square roots are computed once.
        v_WB: the drone's velocity [m/s].
        common, own: standard normal variates: shared by all drones, and this drone's own.
    """
    square = 0.0
    for k in range(3):
        relative = v_WB[k] - wind[WIND.steady + k] - gust[k]
        square += relative * relative
    decay = gust_decay(wind[WIND.length], math.sqrt(square), wind[WIND.speed_min], dt)
    noise_gain = wind[WIND.gust] * math.sqrt(1.0 - decay * decay)
    share = wind[WIND.correlation]
    for k in range(3):
        gust[k] = decay * gust[k] + noise_gain * gust_noise(share, common[k], own[k])


@inlined
def jet_reach(start_m: float, below_m: float) -> float:
    """Return the radius [m] of a jet at a distance below its start, given its width at the start."""
    return JET_WIDTHS * (start_m + JET_SPREAD * below_m)


@inlined
def downwash(thrust_n: float, density: float, start_m: float, below_m: float, aside_m: float) -> float:
    """Return the downward speed [m/s] of the air below a hovering drone.

    The far wake of momentum theory, 2 v_h = 2 sqrt(T / (2 rho A)), as a turbulent round jet of constant momentum:
    w = 2 v_h (b0 / b) exp(-(r / b)^2), b = b0 + 0.107 z, A = pi b0^2, b0 = sqrt(n) R for n rotors of radius R.

    Args:
        thrust_n, start_m: thrust and b0 of the drone above.
        density: air density [kg/m^3].
        below_m, aside_m: position relative to the drone above, both >= 0.
    """
    width = start_m + JET_SPREAD * below_m
    if aside_m > JET_WIDTHS * width or thrust_n <= 0.0:
        return 0.0
    disc = math.pi * start_m * start_m
    core = 2.0 * math.sqrt(thrust_n / (2.0 * density * disc)) * start_m / width
    ratio = aside_m / width
    return core * el.exp(-ratio * ratio)


DISTANCE_MIN_M = 1e-9  # m; lower bound, because two drones at the same position would cause a division by zero
ROUNDING_MARGIN = 1.0 + 1e-9  # factor on a squared distance that covers any rounding error
STRAY_M = 0.25  # m; displacement of a drone after which the near pairs are updated; 0.4 s at 0.6 m/s
APPROACH_M = 0.501  # m; largest change of a pair's distance by then: twice STRAY_M, plus a margin for rounding


@inlined
def hull_force(stiffness: float, damping: float, depth_m: float, closing_m_s: float) -> float:
    """Return the force [N] that separates two hulls overlapping by `depth_m`; never an attraction."""
    if depth_m <= 0.0:
        return 0.0
    return max(stiffness * depth_m + damping * closing_m_s, 0.0)


@inlined
def _displacement(state: NDArray, i: int, j: int) -> Vector:
    return (
        state[j, STATE.p_WB] - state[i, STATE.p_WB],
        state[j, STATE.p_WB + 1] - state[i, STATE.p_WB + 1],
        state[j, STATE.p_WB + 2] - state[i, STATE.p_WB + 2],
    )


@inlined
def _add_downwash(bodies: Bodies, above: int, below: int, aside: float, drop: float) -> None:
    row, state = bodies.vehicle[above], bodies.state[above]
    thrust = free_thrust(row, PerRotor(state, STATE.size, 1, bodies.each)) * z_axis(four(state, STATE.q_WB))[2]
    bodies.air[below, 2] -= downwash(thrust, row[VEHICLE.air_density], row[VEHICLE.jet_start], drop, aside)


@noinline
def _touch(bodies: Bodies, i: int, j: int, d: Vector, distance: float) -> None:
    """Separate the hulls of drones i and j, d = p_j - p_i: spring and damper along d, dry friction across it.

    Both forces act at one point, a = (R_i - dent) n from i, so that linear and angular momentum are conserved.
    """
    n = scaled(d, 1.0 / distance)
    first, second = bodies.vehicle[i], bodies.vehicle[j]
    share = distance / (first[VEHICLE.hull_radius] + second[VEHICLE.hull_radius])
    arms = scaled(n, share * first[VEHICLE.hull_radius]), scaled(n, -share * second[VEHICLE.hull_radius])
    v = subtract(velocity_at(bodies.state[j], arms[1]), velocity_at(bodies.state[i], arms[0]))
    # The smaller values are used, so that the time step stays short enough for a light drone.
    stiffness = min(first[VEHICLE.hull_stiffness], second[VEHICLE.hull_stiffness])
    damping = min(first[VEHICLE.hull_damping], second[VEHICLE.hull_damping])
    depth = first[VEHICLE.hull_radius] + second[VEHICLE.hull_radius] - distance
    normal = hull_force(stiffness, damping, depth, -dot(v, n))
    slip = axpy(v, -dot(v, n), n)
    # Slip decays like the approach, although a tangential force meets less inertia because it also turns the hulls.
    linear_mobility = 1.0 / first[VEHICLE.mass] + 1.0 / second[VEHICLE.mass]
    angular_mobility = dot(arms[0], arms[0]) / _min_inertia(first) + dot(arms[1], arms[1]) / _min_inertia(second)
    viscous, limit = (
        damping * linear_mobility / (linear_mobility + angular_mobility),
        min(first[VEHICLE.friction], second[VEHICLE.friction]) * normal,
    )
    speed = norm(slip)
    across = viscous if viscous * speed <= limit else limit / speed
    f_W = axpy(scaled(n, normal), -across, slip)
    brace(bodies, i)
    brace(bodies, j)
    twists = cross(arms[0], f_W), cross(arms[1], f_W)
    for k in range(3):
        bodies.push[i, k] -= f_W[k]
        bodies.push[j, k] += f_W[k]
        bodies.twist[i, k] -= twists[0][k]
        bodies.twist[j, k] += twists[1][k]


@inlined
def _min_inertia(row: NDArray) -> float:
    return min(row[VEHICLE.inertia], row[VEHICLE.inertia + 1], row[VEHICLE.inertia + 2])


@inlined
def _meet(bodies: Bodies, i: int, j: int) -> float:
    """Let drones i < j act on each other; return the square of their distance [m^2]."""
    vehicle = bodies.vehicle
    dx, dy, dz = _displacement(bodies.state, i, j)
    aside2 = dx * dx + dy * dy
    square = aside2 + dz * dz
    distance, hulls = math.inf, vehicle[i, VEHICLE.hull_radius] + vehicle[j, VEHICLE.hull_radius]
    if square < ROUNDING_MARGIN * hulls * hulls:  # most pairs are farther apart, and the square root is costly
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
        _add_downwash(bodies, above, i + j - above, math.sqrt(aside2), abs(dz))
    return square


@inlined
def _strayed(state: NDArray, origin: NDArray) -> bool:
    """Return whether a drone has moved too far for the near pairs to remain valid."""
    for i in range(state.shape[0]):
        square = 0.0
        for k in range(3):
            square += (state[i, STATE.p_WB + k] - origin[i, k]) ** 2
        if not square < STRAY_M * STRAY_M:
            return True
    return False


@inlined
def _may_see(radius: float, eye: NDArray, aside: float, dz: float, distance: float) -> bool:
    """Return whether a hull dz above a drone may enter its downward view, a cone of limited range, before one strays.

    Args:
        dz: negative if the hull is below the drone [m].
        eye: row of the looking drone in `NearPairs.eye`.
    """
    margin, cosine = radius + eye[0] + APPROACH_M, eye[2]
    return cosine * aside + math.sqrt(1.0 - cosine * cosine) * dz < margin and distance < eye[1] + margin


@inlined
def _find_near(vehicle: NDArray, state: NDArray, touching: NDArray, near: NearPairs) -> None:
    """Find the pairs that may touch, be in downwash or be the closest, and the drones that may see one below them.

    The result is valid until a drone strays.
    """
    count, min_distance = 0, math.inf
    for i in range(state.shape[0]):
        near.above[i] = 0
        for k in range(3):
            near.origin[i, k] = state[i, STATE.p_WB + k]
    for i in range(state.shape[0]):
        for j in range(i + 1, state.shape[0]):
            dx, dy, dz = _displacement(state, i, j)
            aside = math.sqrt(dx * dx + dy * dy)
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            min_distance = min(min_distance, distance)
            hulls = vehicle[i, VEHICLE.hull_radius] + vehicle[j, VEHICLE.hull_radius]
            closest = max(min_distance + APPROACH_M, hulls) + APPROACH_M
            if _may_see(vehicle[j, VEHICLE.hull_radius], near.eye[i], aside, dz, distance):
                near.above[i] = 1
            if _may_see(vehicle[i, VEHICLE.hull_radius], near.eye[j], aside, -dz, distance):
                near.above[j] = 1
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
    """Add downwash to `air`, hull forces to `push`, moments to `twist`; return the smallest distance of two drones [m].

    Only near pairs are examined, in the order of all pairs, which gives the same bits as examining all. The near pairs
    are updated when a drone has moved by STRAY_M. `touching[i, j]` is 1 where i < j are in contact now; `touched` is
    set to 1 where contact begins.
    """
    near = bodies.near
    if _strayed(bodies.state, near.origin):
        _find_near(bodies.vehicle, bodies.state, bodies.touching, near)
    min_square = math.inf
    for n in range(near.number[0]):
        min_square = min(min_square, _meet(bodies, near.pair[n, 0], near.pair[n, 1]))
    return max(math.sqrt(min_square), DISTANCE_MIN_M)
