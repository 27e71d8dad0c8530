"""One drone as a rigid body under rotor, drag, ground and contact forces, stepped by fourth-order Runge-Kutta.

It includes the rotors (lag, thrust, torque, power), the mixer, which finds rotor speeds for a thrust and a moment, and
the battery. Rotor r is at (x, y) in B, in units of rotor_unit; seen from above, it turns clockwise if its `turn` is 1.
`PerRotor` holds groups of numbers per rotor, in the order of fleet_arrays.ROTOR.
"""

import math

from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math import rotation as rot
from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, add, axpy, rotate
from zsim_world.physics.fleet_arrays import (
    AERO,
    ROTOR,
    STATE,
    VEHICLE,
    Aero,
    PerRotor,
    Row,
    four,
    lift_share,
    mixed,
    put,
    put_four,
    put_value,
    rotor_layout,
    value_of,
    vector,
)
from zsim_world.physics.surfaces import Touch, contact, touched

NOTHING = (0.0, 0.0, 0.0)  # zero force [N] or moment [N m]


@inlined
def pose(state: NDArray) -> tuple[Vector, Vector, Quaternion, Vector]:
    """Return p_WB, v_WB, q_WB, w_WB_B of one drone's state."""
    return vector(state, STATE.p_WB), vector(state, STATE.v_WB), four(state, STATE.q_WB), vector(state, STATE.w_WB_B)


@inlined
def velocity_at(state: NDArray, r_W: Vector) -> Vector:
    """Return the velocity in W [m/s] of a drone's point at r_W from its centre of mass."""
    turn_W = rot.rotate(four(state, STATE.q_WB), vector(state, STATE.w_WB_B))
    return add(vector(state, STATE.v_WB), rot.cross(turn_W, r_W))


@inlined
def accelerations(
    grounded: bool,
    row: Row,
    rotors: PerRotor,
    anchor: NDArray,
    p_WB: Vector,
    v_WB: Vector,
    q_WB: Quaternion,
    w_WB_B: Vector,
    speeds: PerRotor,
    commands: PerRotor,
    decay: float | None,
    air_W: Vector,
    push_W: Vector,
    touch: Touch | None = None,
    aero: Aero | None = None,
) -> tuple[Vector, Vector]:
    """Return a_WB in W [m/s^2] and the angular acceleration in B [rad/s^2].

    m a = T z_B - D (v - air) + ground + push - m g z_W
    I dw/dt = M - w × (I w)

    Args:
        grounded: a compile-time constant. False omits the ground, which is valid only out of its reach; without the
            branch, several drones can be computed at once (simd.py).
        row, rotors: the drone's parameters; anchor: anchors of its contact points (surfaces.py).
        p_WB, v_WB, q_WB, w_WB_B: state; speeds, commands, decay: as for `wrench`.
        air_W: velocity of the air at the drone [m/s]; push_W: force of other drones [N].
        touch: the drone's other contacts, None without any; aero: its aerodynamics, None if it has only `drag`.
    """
    ground = NOTHING, NOTHING
    if grounded:
        ground = contact(row, anchor, p_WB, v_WB, q_WB, w_WB_B)
    if touch is not None:
        others = touched(row, touch, p_WB, v_WB, q_WB, w_WB_B)
        ground = add(ground[0], others[0]), add(ground[1], others[1])
    ix, iy, iz = vector(row, VEHICLE.inertia)
    thrust, moment = wrench(row, rotors, q_WB, p_WB[2], w_WB_B, speeds, commands, decay)
    moment = add(moment, ground[1])
    force = add(add(ground[0], push_W), rot.rotate(q_WB, (0.0, 0.0, thrust)))
    force = axpy(force, -row[VEHICLE.drag], axpy(v_WB, -1.0, air_W))
    if aero is not None and len(aero.parts) > 1:
        flow = _flow(row, rotors, aero.numbers, axpy(v_WB, -1.0, air_W), q_WB, w_WB_B, speeds, commands, decay)
        force, moment = add(force, flow[0]), add(moment, flow[1])
    inv = 1.0 / row[VEHICLE.mass]
    wx, wy, wz = w_WB_B
    return (
        (force[0] * inv, force[1] * inv, force[2] * inv - row[VEHICLE.gravity]),
        (
            (moment[0] - (iz - iy) * wy * wz) / ix,
            (moment[1] - (ix - iz) * wz * wx) / iy,
            (moment[2] - (iy - ix) * wx * wy) / iz,
        ),
    )


@inlined
def _flow(
    row: Row,
    rotors: PerRotor,
    aero: Row,
    u_W: Vector,
    q_WB: Quaternion,
    w_WB_B: Vector,
    speeds: PerRotor,
    commands: PerRotor,
    decay: float | None,
) -> tuple[Vector, Vector]:
    """Return the aerodynamic force in W [N] and moment in B [N m] at the velocity u_W relative to the air [m/s]."""
    u = rot.rotate_back(q_WB, u_W)
    force, moment = in_flow(row, rotors, aero, u, w_WB_B, speeds, commands, decay)
    size, linear, quadratic = rot.norm(u), AERO.linear, AERO.quadratic
    drag = (
        -(aero[linear] + size * aero[quadratic]) * u[0],
        -(aero[linear + 1] + size * aero[quadratic + 1]) * u[1],
        -(aero[linear + 2] + size * aero[quadratic + 2]) * u[2],
    )
    return rot.rotate(q_WB, add(force, drag)), moment


@inlined
def _turned(q: Quaternion, s: float, dq: Quaternion) -> Quaternion:
    return (q[0] + s * dq[0], q[1] + s * dq[1], q[2] + s * dq[2], q[3] + s * dq[3])


@inlined
def _mean(a: Vector, b: Vector, c: Vector, d: Vector) -> Vector:
    """Return the Runge-Kutta mean (a + 2b + 2c + d) / 6."""
    s = 1.0 / 6.0
    return (
        (a[0] + 2.0 * (b[0] + c[0]) + d[0]) * s,
        (a[1] + 2.0 * (b[1] + c[1]) + d[1]) * s,
        (a[2] + 2.0 * (b[2] + c[2]) + d[2]) * s,
    )


@inlined
def step(
    row: NDArray,
    rotors: PerRotor,
    anchor: NDArray,
    state: NDArray,
    command: NDArray,
    air_W: Vector,
    push_W: Vector,
    dt: float,
    touch: Touch | None = None,
    aero: Aero | None = None,
) -> None:
    """Advance one drone's state (STATE.size + R,) by dt [s] in place under rotor commands (R,) [rad/s].

    The rotors' lag is integrated exactly, also within the step; air velocity and other drones' forces stay constant.
    """
    decay = half_decay(row[VEHICLE.rotor_lag], dt)
    speeds, commands = PerRotor(state, STATE.size, 1, rotors.each), PerRotor(command, 0, 1, rotors.each)
    p, v, q, w = pose(state)
    p, v, q, w, _ = stepped(
        True, row, rotors, anchor, p, v, q, w, speeds, commands, decay, air_W, push_W, dt, touch, aero
    )
    put(state, STATE.p_WB, p)
    put(state, STATE.v_WB, v)
    put_four(state, STATE.q_WB, q)
    put(state, STATE.w_WB_B, w)
    lag(speeds, commands, decay * decay)


@inlined
def lag(speeds: PerRotor, commands: PerRotor, decay: float) -> None:
    """Advance rotor speeds [rad/s] in place until only the fraction `decay` of their error is left."""
    for r in range(len(speeds.each)):
        put_value(speeds, r, lagged(value_of(speeds, 0, r), value_of(commands, 0, r), decay))


@inlined
def half_decay(lag_s: float, dt: float) -> float:
    """Return the fraction of a rotor's speed error that remains after half a step."""
    return el.exp(-0.5 * dt / lag_s)


@inlined
def stepped(
    grounded: bool,
    row: Row,
    rotors: PerRotor,
    anchor: NDArray,
    p: Vector,
    v: Vector,
    q: Quaternion,
    w: Vector,
    speeds: PerRotor,
    commands: PerRotor,
    decay: float,
    air_W: Vector,
    push_W: Vector,
    dt: float,
    touch: Touch | None = None,
    aero: Aero | None = None,
) -> tuple[Vector, Vector, Quaternion, Vector, bool]:
    """Return p_WB, v_WB, q_WB, w_WB_B after dt [s], and whether the ground was out of reach; speeds are unchanged.

    Args:
        grounded, row, rotors, anchor, air_W, push_W, touch, aero: as for `accelerations`.
        p, v, q, w: state; speeds, commands: of the rotors at the start; decay: see `half_decay`.
    """
    h, reach = 0.5 * dt, row[VEHICLE.contact_reach]

    a1, b1 = accelerations(
        grounded, row, rotors, anchor, p, v, q, w, speeds, commands, None, air_W, push_W, touch, aero
    )
    d1 = rot.rate(q, w)
    p2, v2, w2, q2 = axpy(p, h, v), axpy(v, h, a1), axpy(w, h, b1), _turned(q, h, d1)
    a2, b2 = accelerations(
        grounded, row, rotors, anchor, p2, v2, q2, w2, speeds, commands, decay, air_W, push_W, touch, aero
    )
    d2 = rot.rate(q2, w2)
    p3, v3, w3, q3 = axpy(p, h, v2), axpy(v, h, a2), axpy(w, h, b2), _turned(q, h, d2)
    a3, b3 = accelerations(
        grounded, row, rotors, anchor, p3, v3, q3, w3, speeds, commands, decay, air_W, push_W, touch, aero
    )
    d3 = rot.rate(q3, w3)
    p4, v4, w4, q4 = axpy(p, dt, v3), axpy(v, dt, a3), axpy(w, dt, b3), _turned(q, dt, d3)
    a4, b4 = accelerations(
        grounded, row, rotors, anchor, p4, v4, q4, w4, speeds, commands, decay * decay, air_W, push_W, touch, aero
    )
    d4 = rot.rate(q4, w4)

    s = dt / 6.0
    return (
        axpy(p, dt, _mean(v, v2, v3, v4)),
        axpy(v, dt, _mean(a1, a2, a3, a4)),
        rot.normalised(_turned(_turned(_turned(_turned(q, s, d1), 2.0 * s, d2), 2.0 * s, d3), s, d4)),
        axpy(w, dt, _mean(b1, b2, b3, b4)),
        (p[2] > reach) & (p2[2] > reach) & (p3[2] > reach) & (p4[2] > reach),
    )


LOW_SQUARE_MIN = 1e-12  # (rad/s)^2; lower bound of a squared speed limit, because the limit may be zero
GROUND_CLEARANCE_MIN = 0.5  # in rotor radii; smallest height for which the formula is used


@inlined
def lagged(speed: float, command: float, decay: float) -> float:
    """Return a rotor's speed [rad/s] after its error has decayed to the fraction `decay` = exp(-t / lag)."""
    return command + (speed - command) * decay


@inlined
def ground_effect(height_m: float, radius_m: float) -> float:
    """Return the ratio of the thrust near the ground to that in free air: 1 / (1 - (R / 4z)^2).

    Cheeseman and Bennett, ARC R&M 3021 (1955); z is the rotor's height, limited to at least R/2 (ratio 4/3).
    """
    z = max(height_m, GROUND_CLEARANCE_MIN * radius_m)
    ratio = radius_m / (4.0 * z)
    return 1.0 / (1.0 - ratio * ratio)


@inlined
def wrench(
    row: Row,
    rotors: PerRotor,
    q_WB: Quaternion,
    height_m: float,
    w_WB_B: Vector,
    speeds: PerRotor,
    commands: PerRotor,
    decay: float | None,
) -> tuple[float, Vector]:
    """Return the rotors' thrust along z_B [N] and moment in B [N m].

    Moment: arms × thrusts, drag torque k_M w^2, reaction to the rotors' own acceleration J dw/dt, and the
    gyroscopic moment of their spin when the body turns.

    Args:
        row, rotors: the drone's parameters.
        q_WB, height_m: attitude, and height of the centre of mass above the ground.
        w_WB_B: body rate [rad/s].
        speeds, commands: of the rotors [rad/s] at the start of the step; decay: fraction of their difference
            that remains, or None at the start.
    """
    unit, radius, inertia = row[VEHICLE.rotor_unit], row[VEHICLE.rotor_radius], row[VEHICLE.rotor_inertia]
    ex, ey = rotate(q_WB, (unit, 0.0, 0.0))[2], rotate(q_WB, (0.0, unit, 0.0))[2]
    slew = 1.0 / row[VEHICLE.rotor_lag]
    total, mx, my, mz, spin = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(len(rotors.each)):
        x, y, turn = rotor_layout(rotors, r)
        speed, command = value_of(speeds, 0, r), value_of(commands, 0, r)
        if decay is not None:
            speed = lagged(speed, command, decay)
        square = speed * speed
        force = row[VEHICLE.thrust] * square * ground_effect(height_m + x * ex + y * ey, radius)
        total += force
        mx += y * unit * force
        my -= x * unit * force
        mz += (turn * row[VEHICLE.torque]) * square + (turn * inertia) * ((command - speed) * slew)
        spin += turn * inertia * speed
    return total, (mx + w_WB_B[1] * spin, my - w_WB_B[0] * spin, mz)


@inlined
def in_flow(
    row: Row,
    rotors: PerRotor,
    aero: Row,
    u_B: Vector,
    w_WB_B: Vector,
    speeds: PerRotor,
    commands: PerRotor,
    decay: float | None,
) -> tuple[Vector, Vector]:
    """Return the force [N] and moment [N m] in B due to flow past the rotors (zsim.vehicles.vehicle.Aerodynamics).

    Translational lift is specified for rotors in flight; below a rotor's minimum speed it scales with the square of the
    rotor's speed.

    Args:
        aero: (AERO.size,); u_B: velocity of the centre of mass relative to the air, in B [m/s].
        row, rotors, w_WB_B, speeds, commands, decay: as for `wrench`.
    """
    unit, (wx, wy, wz) = row[VEHICLE.rotor_unit], w_WB_B
    fx, fy, fz, mx, my, mz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(len(rotors.each)):
        x, y, _ = rotor_layout(rotors, r)
        x, y = x * unit, y * unit
        speed, low = value_of(speeds, 0, r), value_of(rotors, ROTOR.low, r)
        if decay is not None:
            speed = lagged(speed, value_of(commands, 0, r), decay)
        ux, uy, uz = u_B[0] - wz * y, u_B[1] + wz * x, u_B[2] + wx * y - wy * x
        across = -aero[AERO.rotor_drag] * speed
        flying = min(speed * speed / max(low * low, LOW_SQUARE_MIN), 1.0)
        lift = aero[AERO.rotor_lift] * (ux * ux + uy * uy) * flying - aero[AERO.rotor_inflow] * speed * uz
        fx, fy, fz = fx + across * ux, fy + across * uy, fz + lift
        mx, my, mz = mx + y * lift, my - x * lift, mz + x * across * uy - y * across * ux
    return (fx, fy, fz), (mx, my, mz)


@inlined
def free_thrust(row: Row, speeds: PerRotor) -> float:
    """Return the thrust [N] far from the ground."""
    squares = 0.0
    for r in range(len(speeds.each)):
        squares += value_of(speeds, 0, r) * value_of(speeds, 0, r)
    return row[VEHICLE.thrust] * squares


@inlined
def mix(row: Row, rotors: PerRotor, thrust_n: float, moment: Vector, speeds: PerRotor) -> None:
    """Set rotor speeds [rad/s] that give a thrust [N] and a moment in B [N m] within the rotors' limits.

    Demands beyond the limits are reduced in this order: yaw first, then thrust, tilt last.
    """
    thrust = row[VEHICLE.thrust]
    low = thrust * row[VEHICLE.rotor_min] * row[VEHICLE.rotor_min]
    high = thrust * row[VEHICLE.rotor_max] * row[VEHICLE.rotor_max]
    roll, pitch = moment[0] / row[VEHICLE.rotor_unit], moment[1] / row[VEHICLE.rotor_unit]
    tilt_force, min_lift, max_lift = 0.0, lift_share(rotors, 0), lift_share(rotors, 0)
    for r in range(len(rotors.each)):
        by_roll, by_pitch, _, _ = mixed(rotors, r)
        tilt_force = max(tilt_force, abs(by_roll * roll + by_pitch * pitch))
        min_lift, max_lift = min(min_lift, lift_share(rotors, r)), max(max_lift, lift_share(rotors, r))
    # A mean must satisfy (low + tilt_force) / min_lift <= mean <= (high - tilt_force) / max_lift; reduce the tilt until
    # one exists.
    margin = (high * min_lift - low * max_lift) * (2.0 / (min_lift + max_lift))
    scale = margin / (2.0 * tilt_force) if 2.0 * tilt_force > margin else 1.0
    roll, pitch, tilt_force = roll * scale, pitch * scale, tilt_force * scale
    mean = min(max(row[VEHICLE.rotor_share] * thrust_n, (low + tilt_force) / min_lift), (high - tilt_force) / max_lift)
    yaw = moment[2] * thrust / row[VEHICLE.torque]
    sign, max_yaw = (1.0 if yaw >= 0.0 else -1.0), abs(yaw)
    for r in range(len(rotors.each)):
        by_roll, by_pitch, by_yaw, inverse = mixed(rotors, r)
        force, share = mean * lift_share(rotors, r) + by_roll * roll + by_pitch * pitch, sign * by_yaw
        margin = (high - force if share > 0.0 else low - force) * (sign * inverse)
        max_yaw = min(max_yaw, margin if share != 0.0 else max_yaw)
    for r in range(len(rotors.each)):
        by_roll, by_pitch, by_yaw, _ = mixed(rotors, r)
        force = mean * lift_share(rotors, r) + by_roll * roll + by_pitch * pitch
        put_value(speeds, r, math.sqrt(max(force + sign * by_yaw * max_yaw, low) / thrust))


@inlined
def power(row: NDArray, speeds: PerRotor) -> float:
    """Return the electric power [W] at given rotor speeds [rad/s].

    It is the shaft power, the sum of k_M w^3, divided by the efficiency, plus the power of the electronics.
    """
    cubes = 0.0
    for r in range(len(speeds.each)):
        speed = value_of(speeds, 0, r)
        cubes += speed * speed * speed
    return row[VEHICLE.torque] * cubes / row[VEHICLE.efficiency] + row[VEHICLE.electronics]


@inlined
def drained(row: NDArray, energy_j: float, speeds: PerRotor, dt: float) -> float:
    """Return the remaining battery energy [J] after dt [s], never below zero."""
    return max(energy_j - power(row, speeds) * dt, 0.0)


@inlined
def charge_percent(row: NDArray, energy_j: float) -> float:
    """Return the charge as a percentage of a full battery."""
    return 100.0 * energy_j / row[VEHICLE.capacity]
