"""Bodies in blocks of eight drones, computed together by SIMD instructions.

Processors operate on eight numbers with one instruction (single instruction, multiple data) if these are adjacent in
memory. So the drones are divided into blocks of LANES; a block is an array in which the values of a column are adjacent
for all its drones: `block[LANES * column + lane]`. The compiler vectorises a branch-free loop over the lanes of a
block; the loop's length and the columns are constants, so that neither an overlap check nor a remainder loop is needed.
The operations of each drone keep their order, so the results are the same to the last bit in any block.

Equations with branches, such as ground contact, are computed per drone: a block is stepped as in free air, and drones
with the ground or an obstacle in reach, or in contact with another drone, are stepped again with these contacts.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import Field, columns, inlined, noinline
from zsim.math.rotation import Quaternion, Vector
from zsim_world.physics import rigid_body as body
from zsim_world.physics.fleet_arrays import AERO, ROTOR, STATE, VEHICLE, Aero, Bodies, PerRotor, Row, four, put, vector
from zsim_world.physics.surfaces import Touch, drag_anchors

LANES = 8  # number of doubles in one 512-bit register, or in two 256-bit registers
LEVEL = (1.0, 0.0, 0.0, 0.0)  # attitude of a lane without a drone

# Every block begins with the parameters of its drones. A block of bodies ends with groups of numbers per rotor.
BODY_LANES = columns(
    "BodyLanes",
    (
        Field("vehicle", "VEHICLE", VEHICLE.size),
        Field("decay", "1"),  # fraction of a rotor's speed error left after half a tick
        Field("state", "STATE", STATE.size),
        Field("air", "m/s", 3),
        Field("push", "N", 3),
        Field("accel", "m/s^2, rad/s^2", 6),  # acceleration in W, angular acceleration in B
        Field("aero", "AERO", AERO.size),
        Field("clear", "1"),  # 1 if the ground was out of reach in the whole step, so that the step's result is valid
    ),
)
BODY_ROTORS = columns(
    "BodyRotors", (Field("known", "ROTOR", ROTOR.size), Field("speed", "rad/s"), Field("command", "rad/s"))
)


def blocks(count: int, parts: Iterable[tuple[int, NDArray[np.float64]]]) -> NDArray[np.float64]:
    """Return the blocks of N drones, (blocks, LANES * count), with some columns filled; the rest is 0.

    Args:
        count: number of columns of a block.
        parts: pairs of a first column and the numbers (N, any) from there on. Lanes without a drone, which are
            computed too, get those of the last drone, to avoid division by 0 in Python.
    """
    column_parts = list(parts)
    drones = len(column_parts[0][1])
    number = -(-drones // LANES)
    drone = np.minimum(np.arange(number * LANES), drones - 1).reshape(number, LANES)
    filled = np.zeros((number, count, LANES))
    for first, values in column_parts:
        filled[:, first : first + values.shape[1]] = values[drone].swapaxes(1, 2)
    return filled.reshape(number, -1)


def body_blocks(row: NDArray, rotors: NDArray, decay: NDArray, aero: NDArray) -> NDArray[np.float64]:
    """Return the blocks of N level bodies: parameters, rotors, their `half_decay` (N, 1), aerodynamics."""
    each = rotors.shape[1] // ROTOR.size
    rotors_start = BODY_LANES.size + BODY_ROTORS.known * each
    level = (BODY_LANES.state + STATE.q_WB, np.tile(LEVEL, (len(row), 1)))
    parts = (
        (BODY_LANES.vehicle, row),
        (BODY_LANES.decay, decay),
        (BODY_LANES.aero, aero),
        level,
        (rotors_start, rotors),
    )
    return blocks(BODY_LANES.size + BODY_ROTORS.size * each, parts)


@inlined
def lane_row(block: NDArray, k: int) -> Row:
    """Return the parameters of the drone in lane k, VEHICLE.size of them."""
    a, b, c, d = lane_four(block, 0, k), lane_four(block, 4, k), lane_four(block, 8, k), lane_four(block, 12, k)
    e, f, g, h = lane_four(block, 16, k), lane_four(block, 20, k), lane_four(block, 24, k), lane_four(block, 28, k)
    return a + b + c + d + e + f + g + h


@inlined
def _lane_aero(block: NDArray, k: int, parts: tuple[int, ...]) -> Aero:
    """Return the aerodynamics of the drone in lane k of a block of bodies."""
    a, b = lane_four(block, BODY_LANES.aero, k), lane_four(block, BODY_LANES.aero + 4, k)
    return Aero(parts, a + b + (block[LANES * (BODY_LANES.aero + 8) + k],))


@inlined
def lane_vector(block: NDArray, at: int, k: int) -> Vector:
    return (block[LANES * at + k], block[LANES * (at + 1) + k], block[LANES * (at + 2) + k])


@inlined
def lane_four(block: NDArray, at: int, k: int) -> Quaternion:
    a, b, c = lane_vector(block, at, k)
    return (a, b, c, block[LANES * (at + 3) + k])


@inlined
def put_lane_vector(block: NDArray, at: int, k: int, a: Vector) -> None:
    block[LANES * at + k], block[LANES * (at + 1) + k], block[LANES * (at + 2) + k] = a


@inlined
def put_lane_four(block: NDArray, at: int, k: int, a: Quaternion) -> None:
    put_lane_vector(block, at, k, (a[0], a[1], a[2]))
    block[LANES * (at + 3) + k] = a[3]


@inlined
def lane_rotors(block: NDArray, at: int, k: int, each: tuple[int, ...]) -> PerRotor:
    """Return the groups of numbers per rotor of the drone in lane k, from column `at` on."""
    return PerRotor(block, LANES * at + k, LANES, each)


@inlined
def _group(group: int, each: tuple[int, ...]) -> int:
    """Return the first column of a group in a block of bodies."""
    return BODY_LANES.size + group * len(each)


@inlined
def move(bodies: Bodies, dt: float) -> None:
    count = bodies.state.shape[0]
    for first in range(0, count, LANES):
        lanes = bodies.lanes[first // LANES]
        if _load(bodies, lanes, first):
            _step_block(lanes, bodies.each, bodies.aero_parts, bodies.anchor[0], dt)
        else:
            for k in range(LANES):
                lanes[LANES * BODY_LANES.clear + k] = 0.0
        for i in range(first, min(first + LANES, count)):
            _copy_result(bodies, lanes, i, i - first, dt)


@inlined
def accelerate(bodies: Bodies) -> None:
    count = bodies.state.shape[0]
    for first in range(0, count, LANES):
        lanes = bodies.lanes[first // LANES]
        if _load(bodies, lanes, first):
            _accelerate_block(lanes, bodies.each, bodies.aero_parts, bodies.anchor[0])
        for i in range(first, min(first + LANES, count)):
            if bodies.braced[i] != 0:
                _accelerate_braced(bodies, i)
            elif _in_reach(bodies, i):
                _accelerate_alone(bodies, i, None)
            else:
                for c in range(6):
                    bodies.accel[i, c] = lanes[LANES * (BODY_LANES.accel + c) + i - first]


@inlined
def line_up(bodies: Bodies) -> None:
    """Copy the state of all drones into the blocks, which keep it up to date from then on."""
    for i in range(bodies.state.shape[0]):
        _put_state(bodies.lanes[i // LANES], i % LANES, bodies.state[i], bodies.each)


@inlined
def lead(bodies: Bodies, dt: float) -> None:
    """Move the external drones at their velocities for one tick of dt [s], overriding the physics."""
    for e in range(bodies.external.shape[0]):
        i, pose = bodies.external[e], bodies.pose[e]
        for c in range(3):
            pose[STATE.p_WB + c] += pose[STATE.v_WB + c] * dt
        for c in range(pose.shape[0]):
            bodies.state[i, c] = pose[c]
        _put_state(bodies.lanes[i // LANES], i % LANES, pose, bodies.each)


@inlined
def _put_state(lanes: NDArray, k: int, state: NDArray, each: tuple[int, ...]) -> None:
    for c in range(STATE.size):
        lanes[LANES * (BODY_LANES.state + c) + k] = state[c]
    for r in range(len(each)):
        lanes[LANES * (_group(BODY_ROTORS.speed, each) + r) + k] = state[STATE.size + r]


@inlined
def _load(bodies: Bodies, lanes: NDArray, first: int) -> bool:
    """Copy commands, air and forces into a block; return whether any of its drones is out of reach of the ground.

    `first`: index of the block's first drone. The results of lanes without a drone are never read.
    """
    airborne, at = False, _group(BODY_ROTORS.command, bodies.each)
    for i in range(first, min(first + LANES, bodies.state.shape[0])):
        k = i - first
        for r in range(len(bodies.each)):
            lanes[LANES * (at + r) + k] = bodies.command[i, r]
        put_lane_vector(lanes, BODY_LANES.air, k, vector(bodies.air[i], 0))
        put_lane_vector(lanes, BODY_LANES.push, k, vector(bodies.push[i], 0))
        airborne |= not _in_reach(bodies, i)
    return airborne


@inlined
def _pose(lanes: NDArray, k: int) -> tuple[Vector, Vector, Quaternion, Vector]:
    at = BODY_LANES.state
    p, v = lane_vector(lanes, at + STATE.p_WB, k), lane_vector(lanes, at + STATE.v_WB, k)
    return p, v, lane_four(lanes, at + STATE.q_WB, k), lane_vector(lanes, at + STATE.w_WB_B, k)


@inlined
def _step_block(lanes: NDArray, each: tuple[int, ...], parts: tuple[int, ...], anchor: NDArray, dt: float) -> None:
    """Step all drones of the block by dt [s], as in free air."""
    for k in range(LANES):
        p, v, q, w = _pose(lanes, k)
        rotors = lane_rotors(lanes, _group(BODY_ROTORS.known, each), k, each)
        speeds = lane_rotors(lanes, _group(BODY_ROTORS.speed, each), k, each)
        commands = lane_rotors(lanes, _group(BODY_ROTORS.command, each), k, each)
        air, push = lane_vector(lanes, BODY_LANES.air, k), lane_vector(lanes, BODY_LANES.push, k)
        decay, row = lanes[LANES * BODY_LANES.decay + k], lane_row(lanes, k)
        aero = _lane_aero(lanes, k, parts)
        p, v, q, w, clear = body.stepped(
            False, row, rotors, anchor, p, v, q, w, speeds, commands, decay, air, push, dt, None, aero
        )
        put_lane_vector(lanes, BODY_LANES.state + STATE.p_WB, k, p)
        put_lane_vector(lanes, BODY_LANES.state + STATE.v_WB, k, v)
        put_lane_four(lanes, BODY_LANES.state + STATE.q_WB, k, q)
        put_lane_vector(lanes, BODY_LANES.state + STATE.w_WB_B, k, w)
        body.lag(speeds, commands, decay * decay)
        lanes[LANES * BODY_LANES.clear + k] = 1.0 if clear else 0.0


@inlined
def _accelerate_block(lanes: NDArray, each: tuple[int, ...], parts: tuple[int, ...], anchor: NDArray) -> None:
    for k in range(LANES):
        p, v, q, w = _pose(lanes, k)
        rotors = lane_rotors(lanes, _group(BODY_ROTORS.known, each), k, each)
        speeds = lane_rotors(lanes, _group(BODY_ROTORS.speed, each), k, each)
        commands = lane_rotors(lanes, _group(BODY_ROTORS.command, each), k, each)
        air, push = lane_vector(lanes, BODY_LANES.air, k), lane_vector(lanes, BODY_LANES.push, k)
        row, aero = lane_row(lanes, k), _lane_aero(lanes, k, parts)
        a, alpha = body.accelerations(
            False, row, rotors, anchor, p, v, q, w, speeds, commands, None, air, push, None, aero
        )
        put_lane_vector(lanes, BODY_LANES.accel, k, a)
        put_lane_vector(lanes, BODY_LANES.accel + 3, k, alpha)


@inlined
def _accelerate_alone(bodies: Bodies, i: int, touch: Touch | None) -> None:
    """Compute the accelerations of a drone near the ground or in contact with anything."""
    each, row, anchor = bodies.each, bodies.vehicle[i], bodies.anchor[i]
    p, v, q, w = body.pose(bodies.state[i])
    rotors, speeds = PerRotor(bodies.rotors[i], 0, 1, each), PerRotor(bodies.state[i], STATE.size, 1, each)
    commands, air, push = PerRotor(bodies.command[i], 0, 1, each), vector(bodies.air[i], 0), vector(bodies.push[i], 0)
    aero = Aero(bodies.aero_parts, bodies.aero[i])
    a, alpha = body.accelerations(True, row, rotors, anchor, p, v, q, w, speeds, commands, None, air, push, touch, aero)
    put(bodies.accel[i], 0, a)
    put(bodies.accel[i], 3, alpha)


@noinline
def _accelerate_braced(bodies: Bodies, i: int) -> None:
    _accelerate_alone(bodies, i, _touch(bodies, i))


@inlined
def _touch(bodies: Bodies, i: int) -> Touch:
    return Touch(bodies.obstacle, bodies.solid[i], bodies.held[i], bodies.plane[i], vector(bodies.twist[i], 0))


@inlined
def _step_alone(bodies: Bodies, i: int, touch: Touch | None, dt: float) -> None:
    """Step a drone near the ground or in contact with anything."""
    row, state, anchor = bodies.vehicle[i], bodies.state[i], bodies.anchor[i]
    air, push = vector(bodies.air[i], 0), vector(bodies.push[i], 0)
    rotors = PerRotor(bodies.rotors[i], 0, 1, bodies.each)
    aero = Aero(bodies.aero_parts, bodies.aero[i])
    body.step(row, rotors, anchor, state, bodies.command[i], air, push, dt, touch, aero)


@noinline
def _step_braced(bodies: Bodies, i: int, dt: float) -> None:
    _step_alone(bodies, i, _touch(bodies, i), dt)


@inlined
def _copy_result(bodies: Bodies, lanes: NDArray, i: int, k: int, dt: float) -> None:
    """Copy the result of lane k to drone i; if it was not in free air, step it again."""
    row, state, anchor = bodies.vehicle[i], bodies.state[i], bodies.anchor[i]
    if lanes[LANES * BODY_LANES.clear + k] > 0.0 and bodies.braced[i] == 0:
        for c in range(STATE.size):
            state[c] = lanes[LANES * (BODY_LANES.state + c) + k]
        for r in range(len(bodies.each)):
            state[STATE.size + r] = lanes[LANES * (_group(BODY_ROTORS.speed, bodies.each) + r) + k]
    else:
        if not _in_reach(bodies, i):  # its anchors were not moved while it was high
            drag_anchors(row, anchor, vector(state, STATE.p_WB), four(state, STATE.q_WB))
        if bodies.braced[i] != 0:
            _step_braced(bodies, i, dt)
        else:
            _step_alone(bodies, i, None, dt)
        _put_state(lanes, k, state, bodies.each)
    if _in_reach(bodies, i):
        drag_anchors(row, anchor, vector(state, STATE.p_WB), four(state, STATE.q_WB))


@inlined
def _in_reach(bodies: Bodies, i: int) -> bool:
    """Return whether drone i is so low that it could touch the ground."""
    return not bodies.state[i, STATE.p_WB + 2] > bodies.vehicle[i, VEHICLE.contact_reach]
