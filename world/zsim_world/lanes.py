"""Drones side by side: eight in the air take a step at once, an instruction for all of them.

A block is a column of numbers for each of LANES drones, one array of its own: `lanes[LANES * column + k]` is drone k's.
Its length is a constant, so that the compiler needs neither a check of overlaps nor a rest. The operations are those
of one drone's step, in their order: the results are the same to the last bit.
"""

from numpy.typing import NDArray

from zsim_world import rigid_body as body
from zsim_world.arrays import Bodies
from zsim_world.compiled import inlined
from zsim_world.ground import drag_anchors
from zsim_world.rigid_body import four, vector
from zsim_world.rotation import Vector
from zsim_world.rotors import Four
from zsim_world.vehicle import COLUMNS as PARAMETERS
from zsim_world.vehicle import CONTACT_REACH_M, SIZE, Row

LANES = 8  # doubles in a register of 512 bit, or in two of 256
# Columns of a block: parameters of the drone (vehicle.py), its state (rigid_body.py), then
STATE = PARAMETERS
COMMAND = STATE + body.COLUMNS  # rad/s (4)
AIR, PUSH, DECAY = COMMAND + 4, COMMAND + 7, COMMAND + 10  # m/s (3), N (3), -
CLEAR = DECAY + 1  # 1 if the ground was out of reach in the whole step, so that its result holds
COLUMNS = CLEAR + 1


@inlined
def move(bodies: Bodies, dt: float) -> None:
    """Integrate every drone over one tick of dt [s]."""
    count, lanes = bodies.state.shape[0], bodies.lanes
    for first in range(0, count, LANES):
        if _load(bodies, first):
            _step_block(lanes, bodies.anchor[0], dt)
        else:
            for k in range(LANES):
                lanes[LANES * CLEAR + k] = 0.0
        for i in range(first, min(first + LANES, count)):
            _take_over(bodies, i, i - first, dt)


@inlined
def _load(bodies: Bodies, first: int) -> bool:
    """Fill the block with the drones from `first` on; return whether any is out of the ground's reach."""
    lanes, last, airborne = bodies.lanes, bodies.state.shape[0] - 1, False
    for k in range(LANES):
        i = min(first + k, last)
        for c in range(PARAMETERS):
            lanes[LANES * c + k] = bodies.vehicle[i, c]
        for c in range(body.COLUMNS):
            lanes[LANES * (STATE + c) + k] = bodies.state[i, c]
        for c in range(4):
            lanes[LANES * (COMMAND + c) + k] = bodies.command[i, c]
        for c in range(3):
            lanes[LANES * (AIR + c) + k] = bodies.air[i, c]
            lanes[LANES * (PUSH + c) + k] = bodies.push[i, c]
        lanes[LANES * DECAY + k] = bodies.decay[i]
        airborne |= not _in_reach(bodies, i)
    return airborne


@inlined
def _step_block(lanes: NDArray, anchor: NDArray, dt: float) -> None:
    """Take a step of dt [s] with all drones of the block, as in free air."""
    for k in range(LANES):
        p, v = _vector(lanes, STATE + body.POSITION, k), _vector(lanes, STATE + body.VELOCITY, k)
        q, w = _four(lanes, STATE + body.ATTITUDE, k), _vector(lanes, STATE + body.RATE, k)
        speed, command = _four(lanes, STATE + body.ROTOR, k), _four(lanes, COMMAND, k)
        air, push = _vector(lanes, AIR, k), _vector(lanes, PUSH, k)
        decay = lanes[LANES * DECAY + k]
        p, v, q, w, speed, clear = body.stepped(
            False, _row(lanes, k), anchor, p, v, q, w, speed, command, air, push, decay, dt
        )
        _put(lanes, STATE + body.POSITION, k, p)
        _put(lanes, STATE + body.VELOCITY, k, v)
        _put_four(lanes, STATE + body.ATTITUDE, k, q)
        _put(lanes, STATE + body.RATE, k, w)
        _put_four(lanes, STATE + body.ROTOR, k, speed)
        lanes[LANES * CLEAR + k] = 1.0 if clear else 0.0


@inlined
def _take_over(bodies: Bodies, i: int, k: int, dt: float) -> None:
    """Take over what became of drone i in lane k; where the ground was in reach, let it take its step again with it."""
    row, state, anchor = bodies.vehicle[i], bodies.state[i], bodies.anchor[i]
    if bodies.lanes[LANES * CLEAR + k] > 0.0:
        for c in range(body.COLUMNS):
            state[c] = bodies.lanes[LANES * (STATE + c) + k]
    else:
        if not _in_reach(bodies, i):  # the anchors were not moved while it was high
            drag_anchors(row, anchor, vector(state, body.POSITION), four(state, body.ATTITUDE))
        air, push, command = vector(bodies.air[i], 0), vector(bodies.push[i], 0), four(bodies.command[i], 0)
        body.step(row, anchor, state, command, air, push, dt)
    if _in_reach(bodies, i):
        drag_anchors(row, anchor, vector(state, body.POSITION), four(state, body.ATTITUDE))


@inlined
def _in_reach(bodies: Bodies, i: int) -> bool:
    """Return whether drone i is so low that it could touch the ground."""
    return not bodies.state[i, body.POSITION + 2] > CONTACT_REACH_M * bodies.vehicle[i, SIZE]


@inlined
def _row(lanes: NDArray, k: int) -> Row:
    """Return the parameters of the drone in lane k."""
    a, b, c, d = _four(lanes, 0, k), _four(lanes, 4, k), _four(lanes, 8, k), _four(lanes, 12, k)
    return a + b + c + d + _four(lanes, 16, k) + _vector(lanes, 20, k)


@inlined
def _vector(lanes: NDArray, at: int, k: int) -> Vector:
    return (lanes[LANES * at + k], lanes[LANES * (at + 1) + k], lanes[LANES * (at + 2) + k])


@inlined
def _four(lanes: NDArray, at: int, k: int) -> Four:
    a, b, c = _vector(lanes, at, k)
    return (a, b, c, lanes[LANES * (at + 3) + k])


@inlined
def _put(lanes: NDArray, at: int, k: int, a: Vector) -> None:
    lanes[LANES * at + k], lanes[LANES * (at + 1) + k], lanes[LANES * (at + 2) + k] = a


@inlined
def _put_four(lanes: NDArray, at: int, k: int, a: Four) -> None:
    _put(lanes, at, k, (a[0], a[1], a[2]))
    lanes[LANES * (at + 3) + k] = a[3]
