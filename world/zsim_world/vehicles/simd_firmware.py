"""The boards' step: every drone's firmware sees and decides alone, then eight drives go side by side (block.py)."""

import math

import numpy as np
from numpy.typing import NDArray

from zsim.math import rotation as rot
from zsim.math.compiled import apart, inlined
from zsim_world.physics import simd
from zsim_world.physics.battery import percent
from zsim_world.physics.rigid_body import four, put, put_four, vector
from zsim_world.physics.rotors import Four
from zsim_world.physics.simd import LANES
from zsim_world.state.fleet_arrays import DT, SILENCE_HOVER, SILENCE_LAND, TICK, Boards, Bodies, Time
from zsim_world.state.vehicle import COLUMNS as PARAMETERS
from zsim_world.vehicles import attitude_control, firmware, observer

# Columns of a block
GAINS, MOUNT = PARAMETERS, PARAMETERS + 4  # of the drive (4); of the gyro (4)
GYRO, BIAS = MOUNT + 4, MOUNT + 7  # rad/s: the newest sample (3), and what is believed to be its bias (3)
ATTITUDE, BODY_RATE, ROTOR = BIAS + 3, BIAS + 7, BIAS + 10  # of the belief (4, 3, 4)
ANGLE, SINE, COSINE = ROTOR + 4, ROTOR + 5, ROTOR + 6  # of the step's turn [rad], and of half of it
NORTH, EAST, HEADING = COSINE + 1, COSINE + 2, COSINE + 3  # where the nose points, and the angle of that [rad]
OWN = HEADING + 1  # heading frame in W (4)
UPWARDS, LIFT, YAW_RATE = OWN + 4, OWN + 7, OWN + 8  # wanted: z_B in the heading frame (3), N, rad/s
DRIVEN, COMMAND = YAW_RATE + 1, YAW_RATE + 2  # 0 if the firmware itself has set the command [rad/s] (4)
COLUMNS = COMMAND + 4
STILL = (0.0, 0.0, 0.0, 0.0)  # rad/s

# Columns of the actuators, a row per drone: 0 where all is sound; by how much the speed of each rotor is less than
# commanded (4); the speed at which it turns whatever is commanded [rad/s] (4), below 0 for none
FAULTY, FACTOR, HELD = 0, 1, 5
ACTUATOR_COLUMNS = 9
FOLLOWS = -1.0  # rad/s, of a rotor that is not held


def sound_actuators(n: int) -> NDArray[np.float64]:
    """Return the rows of n drones whose rotors turn as commanded, (n, ACTUATOR_COLUMNS)."""
    rows = np.ones((n, ACTUATOR_COLUMNS))
    rows[:, FAULTY], rows[:, HELD:] = 0.0, FOLLOWS
    return rows


@inlined
def steer(time: Time, bodies: Bodies, boards: Boards) -> None:
    """Let the firmware of every drone see and act."""
    count = bodies.state.shape[0]
    for first in range(0, count, LANES):
        lanes, last, driven = boards.lanes[first // LANES], min(first + LANES, count), False
        for i in range(first, last):
            _line_up(boards, lanes, i, i - first)
        _turn(lanes, last - first)
        for i in range(first, last):
            driven |= _decide(time, bodies, boards, lanes, i, i - first)
        if driven:
            _drive(lanes)
        for i in range(first, last):
            _command(bodies, boards, i, simd.four(lanes, COMMAND, i - first))


@inlined
def _line_up(boards: Boards, lanes: NDArray, i: int, k: int) -> None:
    """Put into lane k what drone i's attitude follows from."""
    belief = boards.belief[i]
    simd.put(lanes, GYRO, k, vector(boards.device[i], observer.GYRO))
    simd.put(lanes, BIAS, k, vector(belief, observer.GYRO_BIAS))
    simd.put_four(lanes, ATTITUDE, k, four(belief, observer.ATTITUDE))


@inlined
def _turn(lanes: NDArray, count: int) -> None:
    """Turn the attitudes by what the gyros show; `count` lanes have a drone."""
    for k in range(LANES):
        mount, gyro, bias = simd.four(lanes, MOUNT, k), simd.vector(lanes, GYRO, k), simd.vector(lanes, BIAS, k)
        w = observer.body_rate(mount, gyro, bias)
        simd.put(lanes, BODY_RATE, k, w)
        lanes[LANES * ANGLE + k] = rot.norm(observer.step_turn(w))
    for k in range(count):
        half = 0.5 * lanes[LANES * ANGLE + k]
        lanes[LANES * SINE + k], lanes[LANES * COSINE + k] = math.sin(half), math.cos(half)
    for k in range(LANES):
        r, angle = observer.step_turn(simd.vector(lanes, BODY_RATE, k)), lanes[LANES * ANGLE + k]
        turn = rot.turn_about(r, angle, lanes[LANES * SINE + k], lanes[LANES * COSINE + k])
        q = rot.normalised(rot.multiply(simd.four(lanes, ATTITUDE, k), turn))
        simd.put_four(lanes, ATTITUDE, k, q)
        lanes[LANES * NORTH + k], lanes[LANES * EAST + k] = rot.forwards(q)
    for k in range(count):
        heading = math.atan2(lanes[LANES * NORTH + k], lanes[LANES * EAST + k])
        lanes[LANES * HEADING + k] = heading
        simd.put_four(lanes, OWN, k, rot.about_z(heading))


@inlined
def _decide(time: Time, bodies: Bodies, boards: Boards, lanes: NDArray, i: int, k: int) -> bool:
    """Let drone i see, and put what it wants into lane k; return whether the drive is to find its command."""
    memory, belief, row, setting = boards.memory[i], boards.belief[i], bodies.vehicle[i], boards.setting[i]
    own, turned = simd.four(lanes, OWN, k), lanes[LANES * HEADING + k] - belief[observer.HEADING]
    belief[observer.HEADING] = lanes[LANES * HEADING + k]
    put_four(belief, observer.ATTITUDE, simd.four(lanes, ATTITUDE, k))
    put(belief, observer.BODY_RATE, simd.vector(lanes, BODY_RATE, k))
    on_ground = firmware.stands(memory)
    gain, device, board = boards.gain[i], boards.device[i], boards.calibration[i]
    own = observer.observe(belief, own, turned, row, gain, device, board, on_ground)
    silence = (time.clock[TICK] - boards.set_tick[i]) * time.spans[DT]
    hover_s, land_s = time.spans[SILENCE_HOVER], time.spans[SILENCE_LAND]
    charge = percent(row, bodies.energy[i])
    wish = firmware.decide(memory, belief, own, row, setting, boards.setpoint[i], silence, hover_s, land_s, charge)

    simd.put_four(lanes, OWN, k, own)
    simd.put_four(lanes, ATTITUDE, k, four(belief, observer.ATTITUDE))
    simd.put_four(lanes, ROTOR, k, four(belief, observer.ROTOR))
    simd.put(lanes, UPWARDS, k, wish.z_H)
    lanes[LANES * LIFT + k], lanes[LANES * YAW_RATE + k] = wish.thrust_n, wish.yaw_rate
    lanes[LANES * DRIVEN + k] = 1.0 if wish.driven else 0.0
    simd.put_four(lanes, COMMAND, k, wish.command)
    return wish.driven


@inlined
def _drive(lanes: NDArray) -> None:
    """Find the commands of all drones of the block whose firmware has not set them itself."""
    for k in range(LANES):
        own, attitude = simd.four(lanes, OWN, k), simd.four(lanes, ATTITUDE, k)
        rate = simd.vector(lanes, BODY_RATE, k)
        rotor, gains, z = simd.four(lanes, ROTOR, k), simd.four(lanes, GAINS, k), simd.vector(lanes, UPWARDS, k)
        thrust, yaw_rate = lanes[LANES * LIFT + k], lanes[LANES * YAW_RATE + k]
        found = attitude_control.drive(simd.row(lanes, k), gains, own, attitude, rate, rotor, z, thrust, yaw_rate)
        set_itself, driven = simd.four(lanes, COMMAND, k), lanes[LANES * DRIVEN + k] > 0.0
        simd.put_four(lanes, COMMAND, k, found if driven else set_itself)


@inlined
def _command(bodies: Bodies, boards: Boards, i: int, command: Four) -> None:
    """Give the rotors of drone i their command, if there is charge for it, and let its firmware count on it."""
    observer.model_rotors(boards.belief[i], boards.setting[i, attitude_control.ROTOR_DECAY], command)
    charge = percent(bodies.vehicle[i], bodies.energy[i])
    put_four(bodies.command[i], 0, command if charge > 0.0 else STILL)
    if boards.actuator[i, FAULTY] != 0.0 and charge > 0.0:
        _weaken(bodies.command[i], boards.actuator[i])


@apart
def _weaken(command: NDArray, actuator: NDArray) -> None:
    """Make of a command to the rotors [rad/s] (4,), in place, what faulty ones do of it."""
    for k in range(4):
        held = actuator[HELD + k]
        command[k] = held if held >= 0.0 else actuator[FACTOR + k] * command[k]
