"""The drones' firmware, which runs at 200 Hz: modes and control loops, based only on its own state estimate.

Loops from the inside out, each about three times slower than the one that it contains, with the AR.Drone's values:
    rotors   overdriven so that their lag halves (15 ms)
    rate     dw/dt = 28 (w_des - w)
    tilt     w_des = 9 (z_B × z_des): closed-loop time constant about 0.12 s, below the 0.143 s that tum_ardrone fitted
    velocity a_des = 3 (v_des - v), vertically 4 (v_des - v); estimated disturbance and drag are cancelled
    hold     v_des = 0.8 (p_hold - p), vertically 1.5 (p_hold - p)
A velocity in the heading frame is tracked in the instantaneous frame: while the drone yaws at rate r, the velocity lags
by r v / 3 laterally. For any vehicle, the gains follow from the rotors' lag and the design parameters in
`zsim.vehicles.vehicle.Firmware`.

Observation and decision are computed drone by drone; the attitude update, the tilt loop and the rate loop, which have
no branches, for blocks of eight drones at once (physics/simd.py).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.flight_messages import DroneState
from zsim.math import elementary as el
from zsim.math import rotation as rot
from zsim.math.compiled import Field, columns, inlined, noinline
from zsim.math.rotation import Quaternion, Vector, axpy
from zsim.scenario.scenario import Drone
from zsim.vehicles.vehicle import ROTORS_MAX, Firmware, Vehicle
from zsim_world.physics.fleet_arrays import (
    CLOCK,
    ROTOR,
    SPAN,
    VEHICLE,
    Boards,
    Bodies,
    KernelTime,
    PerRotor,
    Row,
    four,
    put,
    put_four,
    put_value,
    value_of,
    vector,
)
from zsim_world.physics.rigid_body import charge_percent, mix
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
from zsim_world.vehicles import observer
from zsim_world.vehicles.observer import BELIEF, DEVICE, FLOOR_MIN_M, STEP_S, STILL_STEPS_MIN, lift, standing_height

DRIVE = columns(  # settings of the tilt and rate loops, the first columns of SETTING
    "DriveColumns",
    (
        Field("k_rate", "1/s"),
        Field("k_tilt", "1/s"),
        Field("overdrive", "1"),  # commanded change of a rotor's speed over the desired one
        Field("slope", "1"),  # tangent of the largest tilt
        Field("yaw_share", "1"),  # gain of the rate loop about the yaw axis over k_rate
        Field("body_rate", "rad/s"),  # largest body rate that the tilt loop demands
    ),
)
SETTING = columns(  # limits of commands, and the design parameters of vehicle.Firmware
    "SettingColumns",
    (
        Field("drive", "DRIVE", DRIVE.size),
        Field("rotor_decay", "1"),  # fraction of a rotor's speed error that remains after a step
        Field("k_velocity", "1/s"),
        Field("k_climb", "1/s"),
        Field("speed", "m/s"),
        Field("climb", "m/s"),
        Field("yaw_rate", "rad/s"),
        Field("altitude", "m"),
        Field("takeoff_height", "m"),
        Field("k_hold", "1/s"),
        Field("k_height", "1/s"),
        Field("brake", "s"),
        Field("tilt_cut", "1"),
        Field("lift_min", "1"),
        Field("spin_up", "s"),
        Field("ascent", "m/s"),
        Field("ascent_max", "s"),
        Field("arrived", "m"),
        Field("arrived_speed", "m/s"),
        Field("descent", "m/s"),
        Field("descent_far", "1/s"),
        Field("flare", "m"),
        Field("touch_share", "1"),
        Field("touch_speed", "m/s"),
        Field("touch", "s"),
        Field("low_battery", "%"),
    ),
)
LANDED, TAKING_OFF, HOVERING, FLYING, LANDING, EMERGENCY = range(6)
MODES: tuple[DroneState, ...] = ("landed", "taking_off", "hovering", "flying", "landing", "emergency")
NONE, VELOCITY, VELOCITY_WORLD, ARDRONE, HOVER, ATTITUDE, ROTORS = range(7)  # kinds of setpoint
# Values of a setpoint by its kind:
#   velocity: vx, vy, vz [m/s], yaw rate [rad/s]; ardrone: forward, left, up, yaw_left in [-1, 1];
#   attitude: w, x, y, z, thrust [N], yaw rate [rad/s]; rotors: speed of each rotor [rad/s]
SETPOINT = columns("SetpointColumns", (Field("kind", "1"), Field("value", "see above", ROTORS_MAX)))
MEMORY = columns(
    "MemoryColumns",
    (
        Field("mode", "1"),
        Field("steps", "1"),  # steps since this mode was entered
        Field("hold_xy", "m", 2),
        Field("hold_z", "m"),
        Field("holds_xy", "1"),
        Field("holds_z", "1"),  # 0: no; RISING: the held height rises to the take-off height; HOLDING: it is constant
        Field("touch", "1"),  # steps for which the ground has borne the weight
    ),
)
RISING, HOLDING = 1.0, 2.0
BOARD_LANES = columns(
    "BoardLanes",
    (
        Field("vehicle", "VEHICLE", VEHICLE.size),
        Field("drive", "DRIVE", DRIVE.size),
        Field("mount", "1", 4),  # q_BS of the gyro
        Field("gyro", "rad/s", 3),  # newest sample
        Field("bias", "rad/s", 3),  # estimated bias of the gyro
        Field("q_WB", "1", 4),  # estimated attitude
        Field("w_WB_B", "rad/s", 3),  # estimated body rate
        Field("angle", "rad"),  # rotation of the body in the step
        Field("sine", "1"),  # of half this angle
        Field("cosine", "1"),  # of half this angle
        Field("north", "1"),  # north component of the nose's direction
        Field("east", "1"),  # east component of the nose's direction
        Field("heading", "rad"),
        Field("own", "1", 4),  # orientation of the heading frame in W
        Field("z_H", "1", 3),  # desired z_B in the heading frame
        Field("thrust", "N"),
        Field("yaw_rate", "rad/s"),
        Field("driven", "1"),  # 0 if `decide` has already set the command
    ),
)
BOARD_ROTORS = columns(
    "BoardRotors",
    (Field("known", "ROTOR", ROTOR.size), Field("speed", "rad/s"), Field("command", "rad/s"), Field("drive", "rad/s")),
)
# followed by the fraction of its commanded speed that each of R rotors reaches, and the speed at which each is held
ACTUATOR = columns("ActuatorColumns", (Field("faulty", "1"),))
FOLLOWS = -1.0  # rad/s, marks a rotor that follows its commands
Gains = tuple[float, float, float, float, float, float]


def settings(vehicle: Vehicle, drone: Drone) -> NDArray[np.float64]:
    """Return the limits and loop gains of one drone, (SETTING.size,)."""
    limits, design, row = drone.limits, vehicle.firmware, np.empty(SETTING.size)
    k_rate, k_tilt, row[SETTING.k_velocity] = loop_gains(design, drone.rotor_time_constant_s)
    row[SETTING.rotor_decay], overdrive = lag_shares(design, drone.rotor_time_constant_s)
    slope = el.tan(math.radians(limits.tilt_deg))
    drive = (k_rate, k_tilt, overdrive, slope, design.yaw_share, design.body_rate_max_rad_s)
    row[SETTING.drive : SETTING.drive + DRIVE.size] = drive
    row[SETTING.k_climb] = design.climb_share * k_rate
    row[SETTING.speed], row[SETTING.climb] = limits.horizontal_speed_m_s, limits.vertical_speed_m_s
    row[SETTING.yaw_rate], row[SETTING.altitude] = math.radians(limits.yaw_rate_deg_s), limits.altitude_m
    row[SETTING.takeoff_height] = min(drone.takeoff_height_m, limits.altitude_m)
    row[SETTING.k_hold], row[SETTING.k_height], row[SETTING.brake] = design.hold_1_s, design.height_1_s, design.brake_s
    row[SETTING.tilt_cut], row[SETTING.lift_min] = design.tilt_cut_cosine, design.lift_share_min
    row[SETTING.spin_up], row[SETTING.ascent] = design.spin_up_s, design.takeoff_m_s
    row[SETTING.ascent_max], row[SETTING.arrived] = design.takeoff_s_max, design.arrived_m
    row[SETTING.arrived_speed], row[SETTING.descent] = design.arrived_m_s, design.descent_m_s
    row[SETTING.descent_far], row[SETTING.flare] = design.descent_far_1_s, design.flare_m
    row[SETTING.touch_share], row[SETTING.touch_speed] = design.touch_share, design.touch_m_s
    row[SETTING.touch], row[SETTING.low_battery] = design.touch_s, design.low_battery_percent
    return row


def loop_gains(design: Firmware, rotor_lag_s: float) -> tuple[float, float, float]:
    """Return the gains of the rate, tilt and velocity loops [1/s] for a given rotor lag."""
    rate = design.rate_per_lag / max(design.lag_lead * rotor_lag_s, design.lag_min_s)
    return rate, rate / design.loop_ratio, rate / el.square(design.loop_ratio)


def lag_shares(design: Firmware, rotor_lag_s: float) -> tuple[float, float]:
    """Return the fraction of a rotor's speed error left after a step, and the overdrive that shortens its lag."""
    decay = el.exp(-STEP_S / rotor_lag_s)
    return decay, (1.0 - el.exp(-STEP_S / (design.lag_lead * rotor_lag_s))) / (1.0 - decay)


def sound_actuators(drones: int, rotors: int) -> NDArray[np.float64]:
    """Return the rows of drones without rotor faults, (drones, ACTUATOR.size + 2 rotors)."""
    rows = np.ones((drones, ACTUATOR.size + 2 * rotors))
    rows[:, ACTUATOR.faulty], rows[:, ACTUATOR.size + rotors :] = 0.0, FOLLOWS
    return rows


def board_blocks(row: NDArray, rotors: NDArray, setting: NDArray, mounts: NDArray) -> NDArray[np.float64]:
    """Return the blocks of N boards, given parameters of vehicles and rotors, settings, and the gyros' q_BS (N, 4)."""
    each = rotors.shape[1] // ROTOR.size
    drive = setting[:, SETTING.drive : SETTING.drive + DRIVE.size]
    rotors_start = BOARD_LANES.size + BOARD_ROTORS.known * each
    constant = (
        (BOARD_LANES.vehicle, row),
        (BOARD_LANES.drive, drive),
        (BOARD_LANES.mount, mounts),
        (rotors_start, rotors),
    )
    level, unturned = np.tile(LEVEL, (len(row), 1)), np.ones((len(row), 1))
    start = ((BOARD_LANES.q_WB, level), (BOARD_LANES.cosine, unturned))
    return blocks(BOARD_LANES.size + BOARD_ROTORS.size * each, (*constant, *start))


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
def _rotors(lanes: NDArray, group: int, k: int, each: tuple[int, ...]) -> PerRotor:
    """Return the groups of numbers per rotor of the drone in lane k, from `group` on."""
    return lane_rotors(lanes, BOARD_LANES.size + group * len(each), k, each)


@inlined
def _line_up(boards: Boards, lanes: NDArray, i: int, k: int) -> None:
    """Copy the inputs of drone i's attitude update into lane k."""
    belief = boards.belief[i]
    put_lane_vector(lanes, BOARD_LANES.gyro, k, vector(boards.device[i], DEVICE.gyro))
    put_lane_vector(lanes, BOARD_LANES.bias, k, vector(belief, BELIEF.gyro_bias))
    put_lane_four(lanes, BOARD_LANES.q_WB, k, four(belief, BELIEF.q_WB))


@inlined
def _turn(lanes: NDArray, count: int) -> None:
    """Rotate the estimated attitudes by the gyro readings; the first `count` lanes hold drones."""
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
    """Run the observer and the decision of drone i, in lane k; return whether `drive` must compute its command."""
    each, memory, belief, row = bodies.each, boards.memory[i], boards.belief[i], bodies.vehicle[i]
    setting, heading = boards.setting[i], lanes[LANES * BOARD_LANES.heading + k]
    own, turned = lane_four(lanes, BOARD_LANES.own, k), heading - belief[BELIEF.heading]
    belief[BELIEF.heading] = heading
    put_four(belief, BELIEF.q_WB, lane_four(lanes, BOARD_LANES.q_WB, k))
    put(belief, BELIEF.w_WB_B, lane_vector(lanes, BOARD_LANES.w_WB_B, k))
    on_ground = is_standing(memory, setting)
    gain, device, board = boards.gain[i], boards.device[i], boards.calibration[i]
    own = observer.observe(belief, own, turned, row, gain, device, board, on_ground, each)
    silence = (time.clock[CLOCK.tick] - boards.set_tick[i]) * time.spans[SPAN.dt]
    hover_s, land_s = time.spans[SPAN.hover], time.spans[SPAN.land]
    charge = charge_percent(row, bodies.energy[i])
    rotors, commands = PerRotor(bodies.rotors[i], 0, 1, each), _rotors(lanes, BOARD_ROTORS.command, k, each)
    setpoint = boards.setpoint[i]
    decision = decide(commands, memory, belief, own, row, rotors, setting, setpoint, silence, hover_s, land_s, charge)
    put_lane_four(lanes, BOARD_LANES.own, k, own)
    put_lane_four(lanes, BOARD_LANES.q_WB, k, four(belief, BELIEF.q_WB))
    speeds = _rotors(lanes, BOARD_ROTORS.speed, k, each)
    for r in range(len(each)):
        put_value(speeds, r, belief[BELIEF.size + r])
    put_lane_vector(lanes, BOARD_LANES.z_H, k, decision.z_H)
    lanes[LANES * BOARD_LANES.thrust + k], lanes[LANES * BOARD_LANES.yaw_rate + k] = (
        decision.thrust_n,
        decision.yaw_rate,
    )
    lanes[LANES * BOARD_LANES.driven + k] = 1.0 if decision.driven else 0.0
    return decision.driven


@inlined
def _drive(lanes: NDArray, each: tuple[int, ...]) -> None:
    """Compute the commands of all drones of a block for which `decide` has not set them."""
    for k in range(LANES):
        own, attitude = lane_four(lanes, BOARD_LANES.own, k), lane_four(lanes, BOARD_LANES.q_WB, k)
        rate, z = lane_vector(lanes, BOARD_LANES.w_WB_B, k), lane_vector(lanes, BOARD_LANES.z_H, k)
        gains = lane_vector(lanes, BOARD_LANES.drive, k) + lane_vector(lanes, BOARD_LANES.drive + 3, k)
        thrust, yaw_rate = lanes[LANES * BOARD_LANES.thrust + k], lanes[LANES * BOARD_LANES.yaw_rate + k]
        rotors, speeds = _rotors(lanes, BOARD_ROTORS.known, k, each), _rotors(lanes, BOARD_ROTORS.speed, k, each)
        commands, driven_commands = (
            _rotors(lanes, BOARD_ROTORS.command, k, each),
            _rotors(lanes, BOARD_ROTORS.drive, k, each),
        )
        row = lane_row(lanes, k)
        drive(row, rotors, gains, own, attitude, rate, speeds, z, thrust, yaw_rate, driven_commands)
        driven = lanes[LANES * BOARD_LANES.driven + k] > 0.0
        for r in range(len(each)):
            put_value(commands, r, value_of(driven_commands, 0, r) if driven else value_of(commands, 0, r))


@inlined
def _command(bodies: Bodies, boards: Boards, i: int, commands: PerRotor) -> None:
    """Set the rotor commands of drone i, or zero if its battery is empty, and update its firmware's rotor model."""
    charged, command = bodies.energy[i] > 0.0, bodies.command[i]
    observer.model_rotors(boards.belief[i], boards.setting[i, SETTING.rotor_decay], commands)
    for r in range(len(commands.each)):
        command[r] = value_of(commands, 0, r) if charged else 0.0
    if boards.actuator[i, ACTUATOR.faulty] != 0.0 and charged:
        _weaken(bodies.command[i], boards.actuator[i])


@noinline
def _weaken(command: NDArray, actuator: NDArray) -> None:
    """Apply rotor faults to a command [rad/s], (R,), in place."""
    count = command.shape[0]
    for r in range(count):
        held = actuator[ACTUATOR.size + count + r]
        command[r] = held if held >= 0.0 else actuator[ACTUATOR.size + r] * command[r]


class Decision(NamedTuple):
    """The firmware's decision for the next 5 ms."""

    driven: bool  # True: `drive` computes the command from the fields below; False: it is already set
    z_H: Vector  # along the desired z_B, in the heading frame; not normalised
    thrust_n: float
    yaw_rate: float  # rad/s


COMMAND_IS_SET = Decision(False, (0.0, 0.0, 1.0), 0.0, 0.0)


@inlined
def decide(
    commands: PerRotor,
    memory: NDArray,
    belief: NDArray,
    own: Quaternion,
    row: NDArray,
    rotors: PerRotor,
    setting: NDArray,
    setpoint: NDArray,
    silence_s: float,
    hover_s: float,
    land_s: float,
    charge_percent: float,
) -> Decision:
    """Decide what the rotors do for the next 5 ms: set their commands [rad/s], or return thrust, z_B and yaw rate.

    Args:
        commands: rotor commands, set by this function unless `drive` must compute them.
        memory: mode and holds, modified in place; belief: the observer's estimate.
        own: orientation in W of the heading frame of the estimated attitude.
        row, rotors: parameters; setting: limits and gains; setpoint: cleared unless the drone hovers or flies.
        silence_s: age of the setpoint; hover_s: age from which to hover; land_s: further time from which to land.
        charge_percent: charge of the battery.
    """
    _change_mode(memory, belief, setting, setpoint, silence_s, hover_s, land_s, charge_percent)
    mode, decision = int(memory[MEMORY.mode]), COMMAND_IS_SET
    for r in range(len(commands.each)):
        put_value(commands, r, 0.0)
    if mode in (TAKING_OFF, HOVERING, FLYING, LANDING):
        decision = _fly(commands, mode, memory, belief, own, row, rotors, setting, setpoint)
    memory[MEMORY.steps] += 1.0
    return decision


@inlined
def is_standing(memory: NDArray, setting: NDArray) -> bool:
    """Return whether the firmware assumes that the drone stands on the ground: landed, or spinning up."""
    spinning_up = memory[MEMORY.mode] == TAKING_OFF and memory[MEMORY.steps] * STEP_S < setting[SETTING.spin_up]
    return memory[MEMORY.mode] == LANDED or spinning_up


@inlined
def enter(memory: NDArray, belief: NDArray, mode: int) -> None:
    """Change the mode and clear the holds; a drone that enters LANDED notes whether it is on an obstacle."""
    memory[MEMORY.mode], memory[MEMORY.steps], memory[MEMORY.touch] = mode, 0.0, 0.0
    memory[MEMORY.holds_xy], memory[MEMORY.holds_z] = 0.0, 0.0
    if mode == LANDED:
        belief[BELIEF.still_steps] = STILL_STEPS_MIN
        height = belief[BELIEF.height]
        belief[BELIEF.stand_height] = height if height > FLOOR_MIN_M else 0.0


@inlined
def _change_mode(
    memory: NDArray,
    belief: NDArray,
    setting: NDArray,
    setpoint: NDArray,
    silence_s: float,
    hover_s: float,
    land_s: float,
    charge_percent: float,
) -> None:
    mode = int(memory[MEMORY.mode])
    if mode in (LANDED, EMERGENCY):
        setpoint[SETPOINT.kind] = NONE
        return
    if rot.z_axis(four(belief, BELIEF.q_WB))[2] < setting[SETTING.tilt_cut]:
        enter(memory, belief, EMERGENCY)
    elif mode != LANDING and charge_percent < setting[SETTING.low_battery]:
        enter(memory, belief, LANDING)
    elif mode in (HOVERING, FLYING):
        new_mode = _next_mode(int(setpoint[SETPOINT.kind]), silence_s, hover_s, land_s)
        if new_mode != mode:
            enter(memory, belief, new_mode)
    elif mode == TAKING_OFF:
        if _has_arrived(memory, belief, setting):
            height = memory[MEMORY.hold_z]
            enter(memory, belief, HOVERING)
            memory[MEMORY.hold_z], memory[MEMORY.holds_z] = height, HOLDING
    elif memory[MEMORY.touch] > setting[SETTING.touch] / STEP_S:
        enter(memory, belief, LANDED)
    if memory[MEMORY.mode] not in (HOVERING, FLYING):
        setpoint[SETPOINT.kind] = NONE


@inlined
def _next_mode(kind: int, silence_s: float, hover_s: float, land_s: float) -> int:
    """Return the mode of a hovering or flying drone, given the kind and age of its setpoint."""
    if kind == NONE:
        return HOVERING
    if silence_s >= hover_s + land_s:
        return LANDING
    return FLYING if kind != HOVER and silence_s < hover_s else HOVERING


@inlined
def _has_arrived(memory: NDArray, belief: NDArray, setting: NDArray) -> bool:
    if memory[MEMORY.steps] * STEP_S > setting[SETTING.ascent_max]:
        return True
    error = abs(memory[MEMORY.hold_z] - belief[BELIEF.height])
    has_arrived = memory[MEMORY.holds_z] == HOLDING and error < setting[SETTING.arrived]
    return has_arrived and abs(belief[BELIEF.v_H + 2]) < setting[SETTING.arrived_speed]


@inlined
def _fly(
    commands: PerRotor,
    mode: int,
    memory: NDArray,
    belief: NDArray,
    own: Quaternion,
    row: NDArray,
    rotors: PerRotor,
    setting: NDArray,
    setpoint: NDArray,
) -> Decision:
    """Decide what the rotors do from take-off to touchdown."""
    kind = int(setpoint[SETPOINT.kind])
    if mode == FLYING and kind == ROTORS:
        for r in range(len(rotors.each)):
            put_value(commands, r, clipped(rotors, r, setpoint[SETPOINT.value + r]))
        return COMMAND_IS_SET
    if is_standing(memory, setting):
        for r in range(len(rotors.each)):
            put_value(commands, r, value_of(rotors, ROTOR.low, r))
        return COMMAND_IS_SET
    if mode == FLYING and kind == ATTITUDE:
        z_des, lift, yaw_rate = _from_attitude(own, setting, setpoint)
    else:
        z_des, lift, yaw_rate = _from_velocity(mode, kind, memory, belief, own, row, setting, setpoint, rotors.each)
    return Decision(True, z_des, lift, yaw_rate)


@inlined
def _from_attitude(own: Quaternion, setting: NDArray, setpoint: NDArray) -> tuple[Vector, float, float]:
    """Return the desired z_B in the heading frame, thrust [N] and yaw rate [rad/s] of an attitude setpoint."""
    q = rot.normalised(four(setpoint, SETPOINT.value))
    z_des = rot.rotate_back(own, rot.z_axis(q))
    yaw_rate = _clip(setpoint[SETPOINT.value + 5], setting[SETTING.yaw_rate])
    return z_des, setpoint[SETPOINT.value + 4], yaw_rate


@inlined
def _from_velocity(
    mode: int,
    kind: int,
    memory: NDArray,
    belief: NDArray,
    own: Quaternion,
    row: NDArray,
    setting: NDArray,
    setpoint: NDArray,
    each: tuple[int, ...],
) -> tuple[Vector, float, float]:
    """Return the desired z_B in the heading frame, thrust [N] and yaw rate [rad/s] in velocity-controlled modes."""
    v = vector(belief, BELIEF.v_H)
    v_des, yaw_rate = (0.0, 0.0, 0.0), 0.0
    if mode == FLYING:
        v_des, yaw_rate = _commanded_velocity(kind, own, setting, setpoint)
    else:
        v_des = _hold_velocity(memory, belief, own, setting, v_des)
    v_des = (v_des[0], v_des[1], _climb(mode, v_des[2], memory, belief, row, setting, each))
    # specific thrust: desired acceleration, less disturbance and drag, plus gravity
    f = axpy(vector(belief, BELIEF.disturbance), -row[VEHICLE.drag] / row[VEHICLE.mass], v)
    gravity, gain = row[VEHICLE.gravity], setting[SETTING.k_velocity]
    up = max(setting[SETTING.k_climb] * (v_des[2] - v[2]) - f[2] + gravity, setting[SETTING.lift_min] * gravity)
    if mode == FLYING and kind == ARDRONE:
        across = setting[SETTING.drive + DRIVE.slope]
        z = (across * _clip(setpoint[SETPOINT.value], 1.0), across * _clip(setpoint[SETPOINT.value + 1], 1.0), 1.0)
    else:
        z = (gain * (v_des[0] - v[0]) - f[0], gain * (v_des[1] - v[1]) - f[1], up)
    true_z = rot.z_axis(four(belief, BELIEF.q_WB))[2]
    return z, row[VEHICLE.mass] * up / max(true_z, 0.5), yaw_rate


@inlined
def _commanded_velocity(kind: int, own: Quaternion, setting: NDArray, setpoint: NDArray) -> tuple[Vector, float]:
    """Return the commanded velocity [m/s] in the heading frame and yaw rate [rad/s], within the limits."""
    if kind == ARDRONE:
        climb = setting[SETTING.climb] * _clip(setpoint[SETPOINT.value + 2], 1.0)
        return (0.0, 0.0, climb), setting[SETTING.yaw_rate] * _clip(setpoint[SETPOINT.value + 3], 1.0)
    v = vector(setpoint, SETPOINT.value)
    if kind == VELOCITY_WORLD:
        v = rot.rotate_back(own, v)
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1])
    s = 1.0 if speed <= setting[SETTING.speed] else setting[SETTING.speed] / speed
    yaw_rate = _clip(setpoint[SETPOINT.value + 3], setting[SETTING.yaw_rate])
    return (s * v[0], s * v[1], _clip(v[2], setting[SETTING.climb])), yaw_rate


@inlined
def _hold_velocity(memory: NDArray, belief: NDArray, own: Quaternion, setting: NDArray, v_des: Vector) -> Vector:
    """Return `v_des` with its horizontal part replaced by the velocity towards the held position, by odometry."""
    v_W = rot.rotate(own, vector(belief, BELIEF.v_H))
    for k in range(2):
        if memory[MEMORY.holds_xy] == 0.0:
            memory[MEMORY.hold_xy + k] = belief[BELIEF.odometry + k] + setting[SETTING.brake] * v_W[k]
    memory[MEMORY.holds_xy] = 1.0
    ex = memory[MEMORY.hold_xy] - belief[BELIEF.odometry]
    ey = memory[MEMORY.hold_xy + 1] - belief[BELIEF.odometry + 1]
    v = rot.rotate_back(own, (setting[SETTING.k_hold] * ex, setting[SETTING.k_hold] * ey, 0.0))
    return (v[0], v[1], v_des[2])


@inlined
def _climb(
    mode: int,
    commanded: float,
    memory: NDArray,
    belief: NDArray,
    row: NDArray,
    setting: NDArray,
    each: tuple[int, ...],
) -> float:
    """Return the desired vertical velocity [m/s] for take-off, landing, height hold or a commanded climb."""
    height = belief[BELIEF.height]
    if mode == LANDING:
        return -_descent(memory, belief, row, setting, each)
    if mode == TAKING_OFF:
        return _ascent(memory, belief, row, setting)
    if commanded != 0.0:
        memory[MEMORY.holds_z] = 0.0
        return min(commanded, setting[SETTING.k_height] * (setting[SETTING.altitude] - height))
    if memory[MEMORY.holds_z] != HOLDING:
        ahead = height + belief[BELIEF.v_H + 2] / setting[SETTING.k_climb]
        memory[MEMORY.hold_z], memory[MEMORY.holds_z] = max(ahead, 2.0 * row[VEHICLE.stand_height]), HOLDING
    return _clip(setting[SETTING.k_height] * (memory[MEMORY.hold_z] - height), setting[SETTING.climb])


@inlined
def _ascent(memory: NDArray, belief: NDArray, row: NDArray, setting: NDArray) -> float:
    """Return the vertical velocity [m/s] of a take-off, which follows a steadily rising height."""
    height, start_height = belief[BELIEF.height], standing_height(belief, row)
    final = min(setting[SETTING.takeoff_height] + (start_height - row[VEHICLE.stand_height]), setting[SETTING.altitude])
    if memory[MEMORY.holds_z] == 0.0:
        memory[MEMORY.hold_z], memory[MEMORY.holds_z] = start_height, RISING
    rising = 0.0
    if memory[MEMORY.holds_z] == RISING:
        rising = setting[SETTING.ascent]
        memory[MEMORY.hold_z] += rising * STEP_S
        if memory[MEMORY.hold_z] >= final:
            memory[MEMORY.hold_z], memory[MEMORY.holds_z] = final, HOLDING
    return rising + _clip(setting[SETTING.k_height] * (memory[MEMORY.hold_z] - height), setting[SETTING.climb])


@inlined
def _descent(memory: NDArray, belief: NDArray, row: NDArray, setting: NDArray, each: tuple[int, ...]) -> float:
    """Return the speed of descent [m/s], and count the steps for which the ground has borne the weight."""
    is_weak = lift(belief, row, each) < setting[SETTING.touch_share] * row[VEHICLE.gravity]
    is_borne = is_weak and belief[BELIEF.v_H + 2] > -setting[SETTING.touch_speed]
    memory[MEMORY.touch] = memory[MEMORY.touch] + 1.0 if is_borne else 0.0
    extra = setting[SETTING.descent_far] * max(belief[BELIEF.height] - setting[SETTING.flare], 0.0)
    return min(setting[SETTING.descent] + extra, max(setting[SETTING.climb], setting[SETTING.descent]))


@inlined
def _clip(x: float, limit: float) -> float:
    return min(max(x, -limit), limit)


@inlined
def drive(
    row: Row,
    rotors: PerRotor,
    gains: Gains,
    own: Quaternion,
    q_WB: Quaternion,
    w_WB_B: Vector,
    speeds: PerRotor,
    z_des: Vector,
    thrust_n: float,
    yaw_rate: float,
    commands: PerRotor,
) -> None:
    """Set rotor commands for a desired direction of z_B (heading frame), thrust [N] and yaw rate [rad/s].

    Branch-free, so that several drones are computed at once (`_drive`).

    Args:
        row, rotors: parameters; gains: the drone's columns of DRIVE.
        own: orientation of the heading frame in W.
        q_WB, w_WB_B, speeds: estimated attitude, body rate and rotor speeds.
        commands: rotor commands [rad/s], filled by this function.
    """
    k_rate, k_tilt, overdrive, slope, yaw_share, body_rate_max = gains
    q_HB = rot.level(own, q_WB)
    z_B = rot.rotate_back(q_HB, limited_tilt(z_des, slope))
    up_B = rot.rotate_back(q_HB, (0.0, 0.0, yaw_rate))
    w, wx, wy = w_WB_B, -k_tilt * z_B[1], k_tilt * z_B[0]
    size = math.sqrt(wx * wx + wy * wy)
    s = 1.0 if size <= body_rate_max else body_rate_max / size
    ix, iy, iz = vector(row, VEHICLE.inertia)
    moment = (
        ix * k_rate * (s * wx + up_B[0] - w[0]) + (iz - iy) * w[1] * w[2],
        iy * k_rate * (s * wy + up_B[1] - w[1]) + (ix - iz) * w[2] * w[0],
        iz * k_rate * yaw_share * (up_B[2] - w[2]) + (iy - ix) * w[0] * w[1],
    )
    mix(row, rotors, thrust_n, moment, commands)
    for r in range(len(rotors.each)):  # overdriven commands shorten the rotors' lag
        speed = value_of(speeds, 0, r)
        put_value(commands, r, clipped(rotors, r, speed + overdrive * (value_of(commands, 0, r) - speed)))


@inlined
def clipped(rotors: PerRotor, r: int, speed: float) -> float:
    """Return a speed [rad/s], clipped to the limits of rotor r."""
    return min(max(speed, value_of(rotors, ROTOR.low, r)), value_of(rotors, ROTOR.high, r))


@inlined
def limited_tilt(z: Vector, slope: float) -> Vector:
    """Return the unit vector along `z`, with the tangent of its tilt from the vertical limited to `slope`."""
    across = math.sqrt(z[0] * z[0] + z[1] * z[1])
    limit = max(z[2], 1e-3) * slope
    s = 1.0 if across <= limit else limit / across
    z = (s * z[0], s * z[1], max(z[2], 1e-3))
    return axpy((0.0, 0.0, 0.0), 1.0 / rot.norm(z), z)
