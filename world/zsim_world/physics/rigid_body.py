"""One drone as a rigid body under rotors, drag, ground and pushes; one step of fourth-order Runge-Kutta."""

import math

from numpy.typing import NDArray

from zsim.math import rotation as rot
from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, add, axpy
from zsim_world.physics.fleet_arrays import AERO, STATE, VEHICLE, Aero, PerRotor, Row, of, put_of
from zsim_world.physics.ground import contact
from zsim_world.physics.obstacle_contact import Touch, touched
from zsim_world.physics.rotors import in_flow, lagged, wrench

NOTHING = (0.0, 0.0, 0.0)  # N or N m


@inlined
def vector(row: Row, at: int) -> Vector:
    """Return three numbers of a row."""
    return (row[at], row[at + 1], row[at + 2])


@inlined
def four(row: Row, at: int) -> Quaternion:
    """Return four numbers of a row."""
    return (row[at], row[at + 1], row[at + 2], row[at + 3])


@inlined
def put(row: NDArray, at: int, a: Vector) -> None:
    """Write three numbers into a row."""
    row[at], row[at + 1], row[at + 2] = a


@inlined
def put_four(row: NDArray, at: int, a: Quaternion) -> None:
    """Write four numbers into a row."""
    row[at], row[at + 1], row[at + 2], row[at + 3] = a


@inlined
def pose(state: NDArray) -> tuple[Vector, Vector, Quaternion, Vector]:
    """Return p_WB, v_WB, q_WB, w_WB_B of one drone's state."""
    return vector(state, STATE.p_WB), vector(state, STATE.v_WB), four(state, STATE.q_WB), vector(state, STATE.w_WB_B)


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

    m a = R z_B T - D (v - air) + ground + push - m g z_W
    I dw/dt = M - w × (I w)

    Args:
        grounded: a constant where it is called. False leaves the ground out, and then the result holds only where
            the ground is out of reach; so there is no branch in it, and several drones go at once (simd.py).
        row, rotors: parameters; anchor: of its contact points (ground.py).
        p_WB, v_WB, q_WB, w_WB_B: state; speeds, commands, decay: of the rotors, as for `rotors.wrench`.
        air_W: velocity of the air at the drone [m/s]; push_W: force of other drones [N].
        touch: what it touches besides, None: nothing; aero: its aerodynamics, None: none but `drag`.
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
        more = _flow(row, rotors, aero.numbers, axpy(v_WB, -1.0, air_W), q_WB, w_WB_B, speeds, commands, decay)
        force, moment = add(force, more[0]), add(moment, more[1])
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
    """Return the force in W [N] and the moment in B [N m] of the aerodynamics, u_W being the velocity in the air."""
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
    """Advance one drone's state (STATE.size + R,) by dt [s] in place, under a command (R,) [rad/s] to its rotors.

    The rotors' lag is integrated exactly, also inside the step; air and pushes of others are held over it.
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
    """Advance rotor speeds [rad/s] in place until `decay` is left of their lag."""
    for r in range(len(speeds.each)):
        put_of(speeds, r, lagged(of(speeds, 0, r), of(commands, 0, r), decay))


@inlined
def half_decay(lag_s: float, dt: float) -> float:
    """Return what is left of a rotor's distance to its commanded speed after half a step."""
    return math.exp(-0.5 * dt / lag_s)


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
    """Return p_WB, v_WB, q_WB, w_WB_B after dt [s], and whether the ground was out of reach; speeds stay.

    Args:
        grounded, row, rotors, anchor, air_W, push_W, touch, aero: as for `accelerations`.
        p, v, q, w: state; speeds, commands: of the rotors at the start; decay: of their lag, see `half_decay`.
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
