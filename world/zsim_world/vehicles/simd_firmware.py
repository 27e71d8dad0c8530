"""The step of the boards: observation and decision per drone; branch-free computations for eight drones at once.

Blocks of eight are explained in physics/simd.py.
"""

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math import rotation as rot
from zsim.math.compiled import Field, columns, inlined, noinline
from zsim_world.physics.fleet_arrays import (
    CLOCK,
    ROTOR,
    SPAN,
    VEHICLE,
    Boards,
    Bodies,
    KernelTime,
    PerRotor,
    of,
    put_of,
)
from zsim_world.physics.rigid_body import charge_percent, four, put, put_four, vector
from zsim_world.physics.simd import (
    LANES,
    LEVEL,
    blocks,
    lane_four,
    lane_rotors,
    lane_row,
    lane_vector,
    put_lane_four,
    put_lane_vector,
)
from zsim_world.vehicles import firmware, observer
from zsim_world.vehicles.firmware import DRIVE, SETTING
from zsim_world.vehicles.observer import BELIEF, DEVICE

BOARD_LANES = columns(
    "BoardLanes",
    (
        Field("vehicle", "VEHICLE", VEHICLE.size),
        Field("drive", "DRIVE", DRIVE.size),
        Field("mount", "1", 4),  # q_BS of the gyro
        Field("gyro", "rad/s", 3),  # the newest sample
        Field("bias", "rad/s", 3),  # what is believed to be its bias
        Field("q_WB", "1", 4),  # of the belief, as the next
        Field("w_WB_B", "rad/s", 3),
        Field("angle", "rad"),  # of the step's turn
        Field("sine", "1"),  # of half of it
        Field("cosine", "1"),
        Field("north", "1"),  # where the nose points
        Field("east", "1"),
        Field("heading", "rad"),
        Field("own", "1", 4),  # heading frame in W
        Field("z_H", "1", 3),  # wanted: z_B in the heading frame
        Field("thrust", "N"),
        Field("yaw_rate", "rad/s"),
        Field("driven", "1"),  # 0 if the firmware itself has set the command
    ),
)
BOARD_ROTORS = columns(
    "BoardRotors",
    (Field("known", "ROTOR", ROTOR.size), Field("speed", "rad/s"), Field("command", "rad/s"), Field("drive", "rad/s")),
)
ACTUATOR = (
    columns(  # and by how much the speed of each rotor is less than commanded (R); the one at which it is held (R)
        "ActuatorColumns", (Field("faulty", "1"),)
    )
)
FOLLOWS = -1.0  # rad/s, of a rotor that is not held


def sound_actuators(drones: int, rotors: int) -> NDArray[np.float64]:
    """Return the rows of drones without rotor faults, (drones, ACTUATOR.size + 2 rotors)."""
    rows = np.ones((drones, ACTUATOR.size + 2 * rotors))
    rows[:, ACTUATOR.faulty], rows[:, ACTUATOR.size + rotors :] = 0.0, FOLLOWS
    return rows


def board_blocks(row: NDArray, rotors: NDArray, setting: NDArray, mounts: NDArray) -> NDArray[np.float64]:
    """Return the blocks of N boards: parameters, those of their rotors, settings and mounts of the gyro (N, 4)."""
    each = rotors.shape[1] // ROTOR.size
    drive = setting[:, SETTING.drive : SETTING.drive + DRIVE.size]
    known = BOARD_LANES.size + BOARD_ROTORS.known * each
    constant = ((BOARD_LANES.vehicle, row), (BOARD_LANES.drive, drive), (BOARD_LANES.mount, mounts), (known, rotors))
    level, unturned = np.tile(LEVEL, (len(row), 1)), np.ones((len(row), 1))
    start = ((BOARD_LANES.q_WB, level), (BOARD_LANES.cosine, unturned))
    return blocks(BOARD_LANES.size + BOARD_ROTORS.size * each, (*constant, *start))


@inlined
def _rotors(lanes: NDArray, group: int, k: int, each: tuple[int, ...]) -> PerRotor:
    """Return a group of numbers per rotor of the drone in lane k, and those after it."""
    return lane_rotors(lanes, BOARD_LANES.size + group * len(each), k, each)


@inlined
def steer(time: KernelTime, bodies: Bodies, boards: Boards) -> None:
    count, each = bodies.state.shape[0], bodies.each
    for first in range(0, count, LANES):
        lanes, last, driven = boards.lanes[first // LANES], min(first + LANES, count), False
        for i in range(first, last):
            _line_up(boards, lanes, i, i - first)
        _turn(lanes, last - first)
        for i in range(first, last):
            driven |= _decide(time, bodies, boards, lanes, i, i - first)
        if driven:
            _drive(lanes, each)
        for i in range(first, last):
            _command(bodies, boards, i, _rotors(lanes, BOARD_ROTORS.command, i - first, each))


@inlined
def _line_up(boards: Boards, lanes: NDArray, i: int, k: int) -> None:
    """Copy the inputs of drone i's attitude update into lane k."""
    belief = boards.belief[i]
    put_lane_vector(lanes, BOARD_LANES.gyro, k, vector(boards.device[i], DEVICE.gyro))
    put_lane_vector(lanes, BOARD_LANES.bias, k, vector(belief, BELIEF.gyro_bias))
    put_lane_four(lanes, BOARD_LANES.q_WB, k, four(belief, BELIEF.q_WB))


@inlined
def _turn(lanes: NDArray, count: int) -> None:
    """Rotate the attitudes by the gyro readings; `count` lanes have a drone."""
    for k in range(LANES):
        mount, gyro = lane_four(lanes, BOARD_LANES.mount, k), lane_vector(lanes, BOARD_LANES.gyro, k)
        bias = lane_vector(lanes, BOARD_LANES.bias, k)
        w = observer.body_rate(mount, gyro, bias)
        put_lane_vector(lanes, BOARD_LANES.w_WB_B, k, w)
        lanes[LANES * BOARD_LANES.angle + k] = rot.norm(observer.step_turn(w))
    for k in range(count):
        half = 0.5 * lanes[LANES * BOARD_LANES.angle + k]
        lanes[LANES * BOARD_LANES.sine + k], lanes[LANES * BOARD_LANES.cosine + k] = el.sin(half), el.cos(half)
    for k in range(LANES):
        r, angle = observer.step_turn(lane_vector(lanes, BOARD_LANES.w_WB_B, k)), lanes[LANES * BOARD_LANES.angle + k]
        turn = rot.turn_about(r, angle, lanes[LANES * BOARD_LANES.sine + k], lanes[LANES * BOARD_LANES.cosine + k])
        q = rot.normalised(rot.multiply(lane_four(lanes, BOARD_LANES.q_WB, k), turn))
        put_lane_four(lanes, BOARD_LANES.q_WB, k, q)
        lanes[LANES * BOARD_LANES.north + k], lanes[LANES * BOARD_LANES.east + k] = rot.forwards(q)
    for k in range(count):
        heading = el.atan2(lanes[LANES * BOARD_LANES.north + k], lanes[LANES * BOARD_LANES.east + k])
        lanes[LANES * BOARD_LANES.heading + k] = heading
        put_lane_four(lanes, BOARD_LANES.own, k, rot.about_z(heading))


@inlined
def _decide(time: KernelTime, bodies: Bodies, boards: Boards, lanes: NDArray, i: int, k: int) -> bool:
    """Run observer and decision of drone i for lane k; return whether the drive must compute its command."""
    each, memory, belief, row = bodies.each, boards.memory[i], boards.belief[i], bodies.vehicle[i]
    setting, heading = boards.setting[i], lanes[LANES * BOARD_LANES.heading + k]
    own, turned = lane_four(lanes, BOARD_LANES.own, k), heading - belief[BELIEF.heading]
    belief[BELIEF.heading] = heading
    put_four(belief, BELIEF.q_WB, lane_four(lanes, BOARD_LANES.q_WB, k))
    put(belief, BELIEF.w_WB_B, lane_vector(lanes, BOARD_LANES.w_WB_B, k))
    on_ground = firmware.stands(memory, setting)
    gain, device, board = boards.gain[i], boards.device[i], boards.calibration[i]
    own = observer.observe(belief, own, turned, row, gain, device, board, on_ground, each)
    silence = (time.clock[CLOCK.tick] - boards.set_tick[i]) * time.spans[SPAN.dt]
    hover_s, land_s = time.spans[SPAN.hover], time.spans[SPAN.land]
    charge = charge_percent(row, bodies.energy[i])
    rotors, commands = PerRotor(bodies.rotors[i], 0, 1, each), _rotors(lanes, BOARD_ROTORS.command, k, each)
    setpoint = boards.setpoint[i]
    decision = firmware.decide(
        commands, memory, belief, own, row, rotors, setting, setpoint, silence, hover_s, land_s, charge
    )
    put_lane_four(lanes, BOARD_LANES.own, k, own)
    put_lane_four(lanes, BOARD_LANES.q_WB, k, four(belief, BELIEF.q_WB))
    speeds = _rotors(lanes, BOARD_ROTORS.speed, k, each)
    for r in range(len(each)):
        put_of(speeds, r, belief[BELIEF.size + r])
    put_lane_vector(lanes, BOARD_LANES.z_H, k, decision.z_H)
    lanes[LANES * BOARD_LANES.thrust + k], lanes[LANES * BOARD_LANES.yaw_rate + k] = (
        decision.thrust_n,
        decision.yaw_rate,
    )
    lanes[LANES * BOARD_LANES.driven + k] = 1.0 if decision.driven else 0.0
    return decision.driven


@inlined
def _drive(lanes: NDArray, each: tuple[int, ...]) -> None:
    """Compute the commands of all drones of the block whose firmware has not set them itself."""
    for k in range(LANES):
        own, attitude = lane_four(lanes, BOARD_LANES.own, k), lane_four(lanes, BOARD_LANES.q_WB, k)
        rate, z = lane_vector(lanes, BOARD_LANES.w_WB_B, k), lane_vector(lanes, BOARD_LANES.z_H, k)
        drive = BOARD_LANES.drive
        gains = lane_vector(lanes, drive, k) + lane_vector(lanes, drive + 3, k)
        thrust, yaw_rate = lanes[LANES * BOARD_LANES.thrust + k], lanes[LANES * BOARD_LANES.yaw_rate + k]
        rotors, speeds = _rotors(lanes, BOARD_ROTORS.known, k, each), _rotors(lanes, BOARD_ROTORS.speed, k, each)
        commands, wanted = _rotors(lanes, BOARD_ROTORS.command, k, each), _rotors(lanes, BOARD_ROTORS.drive, k, each)
        row = lane_row(lanes, k)
        firmware.drive(row, rotors, gains, own, attitude, rate, speeds, z, thrust, yaw_rate, wanted)
        driven = lanes[LANES * BOARD_LANES.driven + k] > 0.0
        for r in range(len(each)):
            put_of(commands, r, of(wanted, 0, r) if driven else of(commands, 0, r))


@inlined
def _command(bodies: Bodies, boards: Boards, i: int, commands: PerRotor) -> None:
    """Set the rotor commands of drone i, if its battery allows, and update its firmware's rotor model."""
    charged, command = bodies.energy[i] > 0.0, bodies.command[i]
    observer.model_rotors(boards.belief[i], boards.setting[i, SETTING.rotor_decay], commands)
    for r in range(len(commands.each)):
        command[r] = of(commands, 0, r) if charged else 0.0
    if boards.actuator[i, ACTUATOR.faulty] != 0.0 and charged:
        _weaken(bodies.command[i], boards.actuator[i])


@noinline
def _weaken(command: NDArray, actuator: NDArray) -> None:
    """Apply rotor faults to a command [rad/s] (R,), in place."""
    count = command.shape[0]
    for r in range(count):
        held = actuator[ACTUATOR.size + count + r]
        command[r] = held if held >= 0.0 else actuator[ACTUATOR.size + r] * command[r]
