"""Drones side by side: eight in the air take a step at once, an instruction for all of them (block.py)."""

from numpy.typing import NDArray

from zsim.math.compiled import inlined
from zsim_world.physics import rigid_body as body
from zsim_world.physics import simd
from zsim_world.physics.ground import drag_anchors
from zsim_world.physics.rigid_body import four, put, vector
from zsim_world.physics.simd import LANES
from zsim_world.state.fleet_arrays import Bodies
from zsim_world.state.vehicle import COLUMNS as PARAMETERS
from zsim_world.state.vehicle import CONTACT_REACH_M, SIZE

# Columns of a block
DECAY = PARAMETERS  # of a rotor's lag in half a tick
STATE = DECAY + 1  # rigid_body.py
COMMAND = STATE + body.COLUMNS  # rad/s (4)
AIR, PUSH = COMMAND + 4, COMMAND + 7  # m/s (3), N (3)
ACCEL = PUSH + 3  # m/s^2 in W (3), rad/s^2 in B (3)
CLEAR = ACCEL + 6  # 1 if the ground was out of reach in the whole step, so that its result holds
COLUMNS = CLEAR + 1


@inlined
def move(bodies: Bodies, dt: float) -> None:
    """Integrate every drone over one tick of dt [s]."""
    count = bodies.state.shape[0]
    for first in range(0, count, LANES):
        lanes = bodies.lanes[first // LANES]
        if _load(bodies, lanes, first):
            _step_block(lanes, bodies.anchor[0], dt)
        else:
            for k in range(LANES):
                lanes[LANES * CLEAR + k] = 0.0
        for i in range(first, min(first + LANES, count)):
            _take_over(bodies, lanes, i, i - first, dt)


@inlined
def accelerate(bodies: Bodies) -> None:
    """Note the accelerations of every drone in its present state."""
    count = bodies.state.shape[0]
    for first in range(0, count, LANES):
        lanes = bodies.lanes[first // LANES]
        if _load(bodies, lanes, first):
            _accelerate_block(lanes, bodies.anchor[0])
        for i in range(first, min(first + LANES, count)):
            if _in_reach(bodies, i):
                _accelerate_low(bodies, i)
            else:
                for c in range(6):
                    bodies.accel[i, c] = lanes[LANES * (ACCEL + c) + i - first]


@inlined
def line_up(bodies: Bodies) -> None:
    """Copy the state of all drones into the blocks, which keep it from then on."""
    for i in range(bodies.state.shape[0]):
        _put_state(bodies.lanes[i // LANES], i % LANES, bodies.state[i])


@inlined
def _put_state(lanes: NDArray, k: int, state: NDArray) -> None:
    for c in range(body.COLUMNS):
        lanes[LANES * (STATE + c) + k] = state[c]


@inlined
def _load(bodies: Bodies, lanes: NDArray, first: int) -> bool:
    """Give the drones from `first` on their commands, air and pushes; return whether any is out of the ground's reach.

    In a lane without a drone numbers mean nothing, and nobody looks at what becomes of them.
    """
    airborne = False
    for i in range(first, min(first + LANES, bodies.state.shape[0])):
        k = i - first
        simd.put_four(lanes, COMMAND, k, four(bodies.command[i], 0))
        simd.put(lanes, AIR, k, vector(bodies.air[i], 0))
        simd.put(lanes, PUSH, k, vector(bodies.push[i], 0))
        airborne |= not _in_reach(bodies, i)
    return airborne


@inlined
def _step_block(lanes: NDArray, anchor: NDArray, dt: float) -> None:
    """Take a step of dt [s] with all drones of the block, as in free air."""
    for k in range(LANES):
        p, v = simd.vector(lanes, STATE + body.POSITION, k), simd.vector(lanes, STATE + body.VELOCITY, k)
        q, w = simd.four(lanes, STATE + body.ATTITUDE, k), simd.vector(lanes, STATE + body.RATE, k)
        speed, command = simd.four(lanes, STATE + body.ROTOR, k), simd.four(lanes, COMMAND, k)
        air, push = simd.vector(lanes, AIR, k), simd.vector(lanes, PUSH, k)
        decay = lanes[LANES * DECAY + k]
        p, v, q, w, speed, clear = body.stepped(
            False, simd.row(lanes, k), anchor, p, v, q, w, speed, command, air, push, decay, dt
        )
        simd.put(lanes, STATE + body.POSITION, k, p)
        simd.put(lanes, STATE + body.VELOCITY, k, v)
        simd.put_four(lanes, STATE + body.ATTITUDE, k, q)
        simd.put(lanes, STATE + body.RATE, k, w)
        simd.put_four(lanes, STATE + body.ROTOR, k, speed)
        lanes[LANES * CLEAR + k] = 1.0 if clear else 0.0


@inlined
def _accelerate_block(lanes: NDArray, anchor: NDArray) -> None:
    """Find the accelerations of all drones of the block, as in free air."""
    for k in range(LANES):
        p, v = simd.vector(lanes, STATE + body.POSITION, k), simd.vector(lanes, STATE + body.VELOCITY, k)
        q, w = simd.four(lanes, STATE + body.ATTITUDE, k), simd.vector(lanes, STATE + body.RATE, k)
        speed, command = simd.four(lanes, STATE + body.ROTOR, k), simd.four(lanes, COMMAND, k)
        air, push = simd.vector(lanes, AIR, k), simd.vector(lanes, PUSH, k)
        a, alpha = body.accelerations(False, simd.row(lanes, k), anchor, p, v, q, w, speed, command, air, push)
        simd.put(lanes, ACCEL, k, a)
        simd.put(lanes, ACCEL + 3, k, alpha)


@inlined
def _accelerate_low(bodies: Bodies, i: int) -> None:
    """Note the accelerations of a drone that has the ground in reach."""
    p, v, q, w = body.pose(bodies.state[i])
    speed, command = four(bodies.state[i], body.ROTOR), four(bodies.command[i], 0)
    air, push = vector(bodies.air[i], 0), vector(bodies.push[i], 0)
    a, alpha = body.accelerations(True, bodies.vehicle[i], bodies.anchor[i], p, v, q, w, speed, command, air, push)
    put(bodies.accel[i], 0, a)
    put(bodies.accel[i], 3, alpha)


@inlined
def _take_over(bodies: Bodies, lanes: NDArray, i: int, k: int, dt: float) -> None:
    """Take over what became of drone i in lane k; where the ground was in reach, let it take its step again with it."""
    row, state, anchor = bodies.vehicle[i], bodies.state[i], bodies.anchor[i]
    if lanes[LANES * CLEAR + k] > 0.0:
        for c in range(body.COLUMNS):
            state[c] = lanes[LANES * (STATE + c) + k]
    else:
        if not _in_reach(bodies, i):  # the anchors were not moved while it was high
            drag_anchors(row, anchor, vector(state, body.POSITION), four(state, body.ATTITUDE))
        air, push, command = vector(bodies.air[i], 0), vector(bodies.push[i], 0), four(bodies.command[i], 0)
        body.step(row, anchor, state, command, air, push, dt)
        _put_state(lanes, k, state)
    if _in_reach(bodies, i):
        drag_anchors(row, anchor, vector(state, body.POSITION), four(state, body.ATTITUDE))


@inlined
def _in_reach(bodies: Bodies, i: int) -> bool:
    """Return whether drone i is so low that it could touch the ground."""
    return not bodies.state[i, body.POSITION + 2] > CONTACT_REACH_M * bodies.vehicle[i, SIZE]
