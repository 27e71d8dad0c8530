"""The firmware of one drone at 200 Hz: modes, velocity, attitude and rate loops, on its own belief alone.

Loops from inside out, each about three times slower than the one it contains:
    rotors   overdriven so that their lag halves (15 ms for the AR.Drone)
    rate     dw/dt = 28 (w_des - w)
    tilt     w_des = 9 (z_B × z_des): closed loop about 0.12 s, inside the 0.143 s that tum_ardrone fitted
    velocity a_des = 3 (v_des - v), vertically 4, disturbance and drag of the belief cancelled
    hold     v_des = 0.8 (p_hold - p), height 1.5
A velocity in the heading frame is held towards its own instant: while the drone yaws at r, it lags by r v / 3 across.
The inner gains follow from the rotors' lag, so that another aircraft flies too.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.flight_messages import DroneState
from zsim.math import rotation as rot
from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, axpy
from zsim.scenario.scenario import Drone
from zsim_world.physics.rigid_body import four, vector
from zsim_world.physics.rotors import Four
from zsim_world.state.vehicle import DRAG, GRAVITY, MASS, ROTOR_MIN, STAND_HEIGHT
from zsim_world.vehicles import observer as ob
from zsim_world.vehicles.attitude_control import (
    K_RATE,
    K_TILT,
    OVERDRIVE,
    ROTOR_DECAY,
    SLOPE,
    clipped,
    lag_shares,
    loop_gains,
)
from zsim_world.vehicles.observer import STEP_S

LANDED, TAKING_OFF, HOVERING, FLYING, LANDING, EMERGENCY = range(6)
MODES: tuple[DroneState, ...] = ("landed", "taking_off", "hovering", "flying", "landing", "emergency")

NONE, VELOCITY, VELOCITY_WORLD, ARDRONE, HOVER, ATTITUDE, ROTORS = range(7)  # kinds of setpoint
# Columns of the setpoint: kind, then
#   velocity: vx, vy, vz [m/s], yaw rate [rad/s]; ardrone: forward, left, up, yaw_left in [-1, 1];
#   attitude: w, x, y, z, thrust [N], yaw rate [rad/s]; rotors: four speeds [rad/s]
KIND, VALUE = 0, 1
SETPOINT_COLUMNS = 7

# Columns of the memory, one row per drone
MODE, STEPS, HOLD_XY, HOLD_Z, HOLDS_XY, HOLDS_Z, TOUCH = 0, 1, 2, 4, 5, 6, 7
MEMORY_COLUMNS = 8
RISING, HOLDING = 1.0, 2.0  # values of HOLDS_Z: the height held rises to that of the take-off, or stays

# Columns of the settings: limits of what a commander may ask, and the loop gains
SPEED, CLIMB, YAW_RATE, ALTITUDE, TAKEOFF_HEIGHT = 1, 2, 3, 4, 5  # m/s, m/s, rad/s, m, m
K_VELOCITY, K_CLIMB = 8, 9  # 1/s; drive.py has the others
SETTING_COLUMNS = 12

CLIMB_SHARE = 1 / 7  # of the rate gain, 4 1/s: thrust needs no tilt first
K_HOLD = 0.8  # 1/s, position on the own odometry
K_HEIGHT = 1.5  # 1/s
BRAKE_S = 0.6  # s, where a hold begins: about the stopping distance over speed
TILT_CUT_COSINE = 0.25  # beyond 75 deg the motors are cut, as the aircraft does when it is overturned
LIFT_SHARE_MIN = 0.15  # of the weight: thrust never asked below
SPIN_UP_S = 0.5  # s, rotors at their least before the climb
CLIMB_M_S = 0.6  # m/s, of a take-off
TAKEOFF_S_MAX = 20.0  # s, then it hovers where it is
ARRIVED_M, ARRIVED_M_S = 0.08, 0.2  # m, m/s: a take-off is over
DESCENT_M_S = 0.4  # m/s, of a landing near the ground
DESCENT_FAR_1_S = 0.3  # 1/s, faster by this per metre over FLARE_M
FLARE_M = 2.0  # m
TOUCH_SHARE = 0.6  # of the weight: the thrust has fallen below although the descent has stopped
TOUCH_M_S = 0.15  # m/s, a descent that has stopped
TOUCH_S = 0.25  # s, for which both hold before the rotors stop
LOW_BATTERY_PERCENT = 5.0  # %, lands; about half a minute of hover remains


def settings(drone: Drone) -> NDArray[np.float64]:
    """Return limits and loop gains of one drone, shape (SETTING_COLUMNS,)."""
    limits = drone.limits
    row = np.empty(SETTING_COLUMNS)
    row[SLOPE], row[YAW_RATE] = math.tan(math.radians(limits.tilt_deg)), math.radians(limits.yaw_rate_deg_s)
    row[SPEED], row[CLIMB] = limits.horizontal_speed_m_s, limits.vertical_speed_m_s
    row[ALTITUDE], row[TAKEOFF_HEIGHT] = limits.altitude_m, min(drone.takeoff_height_m, limits.altitude_m)
    row[K_RATE], row[K_TILT], row[K_VELOCITY] = loop_gains(drone.rotor_time_constant_s)
    row[K_CLIMB] = CLIMB_SHARE * row[K_RATE]
    row[ROTOR_DECAY], row[OVERDRIVE] = lag_shares(drone.rotor_time_constant_s)
    return row


class Wish(NamedTuple):
    """What the firmware has decided on for the next 5 ms."""

    driven: bool  # True: the drive is to find the command for the last three; False: it is given
    command: Four  # rad/s
    z_H: Vector  # along the body's z wanted, in the heading frame
    thrust_n: float
    yaw_rate: float  # rad/s


@inlined
def _commanded(command: Four) -> Wish:
    """Return the wish that the rotors turn at these speeds [rad/s]."""
    return Wish(False, command, (0.0, 0.0, 1.0), 0.0, 0.0)


@inlined
def decide(
    memory: NDArray,
    belief: NDArray,
    own: Quaternion,
    row: NDArray,
    setting: NDArray,
    setpoint: NDArray,
    silence_s: float,
    hover_s: float,
    land_s: float,
    charge_percent: float,
) -> Wish:
    """Return what the rotors are to do in the next 5 ms.

    Args:
        memory: modes and holds, in place; belief: observer.py.
        own: the heading frame in W of the attitude believed.
        row: the aircraft (vehicle.py); setting: limits and gains; setpoint: the commander's wish, cleared on landing.
        silence_s: time since the setpoint was sent; hover_s: hover after so much, and land land_s later.
        charge_percent: of the battery.
    """
    _change_mode(memory, belief, setpoint, silence_s, hover_s, land_s, charge_percent)
    mode = int(memory[MODE])
    wish = _commanded((0.0, 0.0, 0.0, 0.0))
    if mode in (TAKING_OFF, HOVERING, FLYING, LANDING):
        wish = _fly(mode, memory, belief, own, row, setting, setpoint)
    memory[STEPS] += 1.0
    return wish


@inlined
def stands(memory: NDArray) -> bool:
    """Return whether the firmware knows that it stands on the ground: landed, or spinning up."""
    spinning_up = memory[MODE] == TAKING_OFF and memory[STEPS] * STEP_S < SPIN_UP_S
    return memory[MODE] == LANDED or spinning_up


@inlined
def enter(memory: NDArray, belief: NDArray, mode: int) -> None:
    """Change the mode and forget the holds."""
    memory[MODE], memory[STEPS], memory[TOUCH] = mode, 0.0, 0.0
    memory[HOLDS_XY], memory[HOLDS_Z] = 0.0, 0.0
    if mode == LANDED:
        belief[ob.STILL_STEPS] = ob.STILL_STEPS_MIN


@inlined
def _change_mode(
    memory: NDArray,
    belief: NDArray,
    setpoint: NDArray,
    silence_s: float,
    hover_s: float,
    land_s: float,
    charge_percent: float,
) -> None:
    mode = int(memory[MODE])
    if mode in (LANDED, EMERGENCY):
        setpoint[KIND] = NONE
        return
    if rot.z_axis(four(belief, ob.ATTITUDE))[2] < TILT_CUT_COSINE:
        enter(memory, belief, EMERGENCY)
    elif mode != LANDING and charge_percent < LOW_BATTERY_PERCENT:
        enter(memory, belief, LANDING)
    elif mode in (HOVERING, FLYING):
        wanted = _wanted(int(setpoint[KIND]), silence_s, hover_s, land_s)
        if wanted != mode:
            enter(memory, belief, wanted)
    elif mode == TAKING_OFF:
        if _arrived(memory, belief):
            height = memory[HOLD_Z]
            enter(memory, belief, HOVERING)
            memory[HOLD_Z], memory[HOLDS_Z] = height, HOLDING
    elif memory[TOUCH] > TOUCH_S / STEP_S:
        enter(memory, belief, LANDED)
    if memory[MODE] not in (HOVERING, FLYING):
        setpoint[KIND] = NONE


@inlined
def _wanted(kind: int, silence_s: float, hover_s: float, land_s: float) -> int:
    """Return the mode in the air that a setpoint of this kind and the commander's silence ask for."""
    if kind == NONE:
        return HOVERING
    if silence_s >= hover_s + land_s:
        return LANDING
    return FLYING if kind != HOVER and silence_s < hover_s else HOVERING


@inlined
def _arrived(memory: NDArray, belief: NDArray) -> bool:
    if memory[STEPS] * STEP_S > TAKEOFF_S_MAX:
        return True
    near = memory[HOLDS_Z] == HOLDING and abs(memory[HOLD_Z] - belief[ob.HEIGHT]) < ARRIVED_M
    return near and abs(belief[ob.VELOCITY + 2]) < ARRIVED_M_S


@inlined
def _fly(
    mode: int,
    memory: NDArray,
    belief: NDArray,
    own: Quaternion,
    row: NDArray,
    setting: NDArray,
    setpoint: NDArray,
) -> Wish:
    """Return what the rotors are to do in the air, or on the way there."""
    kind = int(setpoint[KIND])
    if mode == FLYING and kind == ROTORS:
        return _commanded(clipped(row, four(setpoint, VALUE)))
    if stands(memory):
        low = row[ROTOR_MIN]
        return _commanded((low, low, low, low))
    if mode == FLYING and kind == ATTITUDE:
        z_des, lift, yaw_rate = _attitude_wish(own, setting, setpoint)
    else:
        z_des, lift, yaw_rate = _velocity_wish(mode, kind, memory, belief, own, row, setting, setpoint)
    return Wish(True, (0.0, 0.0, 0.0, 0.0), z_des, lift, yaw_rate)


@inlined
def _attitude_wish(own: Quaternion, setting: NDArray, setpoint: NDArray) -> tuple[Vector, float, float]:
    """Return wanted z_B in the heading frame, thrust [N] and yaw rate of an attitude setpoint."""
    q = rot.normalised(four(setpoint, VALUE))
    z_des = rot.rotate_back(own, rot.z_axis(q))
    yaw_rate = _clip(setpoint[VALUE + 5], setting[YAW_RATE])
    return z_des, setpoint[VALUE + 4], yaw_rate


@inlined
def _velocity_wish(
    mode: int,
    kind: int,
    memory: NDArray,
    belief: NDArray,
    own: Quaternion,
    row: NDArray,
    setting: NDArray,
    setpoint: NDArray,
) -> tuple[Vector, float, float]:
    """Return wanted z_B in the heading frame, thrust [N] and yaw rate of all modes that fly by velocity."""
    v = vector(belief, ob.VELOCITY)
    wish, yaw_rate = (0.0, 0.0, 0.0), 0.0
    if mode == FLYING:
        wish, yaw_rate = _asked_velocity(kind, own, setting, setpoint)
    else:
        wish = _held(memory, belief, own, wish)
    wish = (wish[0], wish[1], _climb(mode, wish[2], memory, belief, row, setting))
    # what the thrust must give: the acceleration wanted, less disturbance and drag, plus the weight
    f = axpy(vector(belief, ob.DISTURBANCE), -row[DRAG] / row[MASS], v)
    up = max(setting[K_CLIMB] * (wish[2] - v[2]) - f[2] + row[GRAVITY], LIFT_SHARE_MIN * row[GRAVITY])
    if mode == FLYING and kind == ARDRONE:
        across = setting[SLOPE]
        z = (across * _clip(setpoint[VALUE], 1.0), across * _clip(setpoint[VALUE + 1], 1.0), 1.0)
    else:
        z = (setting[K_VELOCITY] * (wish[0] - v[0]) - f[0], setting[K_VELOCITY] * (wish[1] - v[1]) - f[1], up)
    true_z = rot.z_axis(four(belief, ob.ATTITUDE))[2]
    return z, row[MASS] * up / max(true_z, 0.5), yaw_rate


@inlined
def _asked_velocity(kind: int, own: Quaternion, setting: NDArray, setpoint: NDArray) -> tuple[Vector, float]:
    """Return the commander's velocity in the heading frame [m/s] and yaw rate [rad/s], within the limits."""
    if kind == ARDRONE:
        climb = setting[CLIMB] * _clip(setpoint[VALUE + 2], 1.0)
        return (0.0, 0.0, climb), setting[YAW_RATE] * _clip(setpoint[VALUE + 3], 1.0)
    v = vector(setpoint, VALUE)
    if kind == VELOCITY_WORLD:
        v = rot.rotate_back(own, v)
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1])
    s = 1.0 if speed <= setting[SPEED] else setting[SPEED] / speed
    return (s * v[0], s * v[1], _clip(v[2], setting[CLIMB])), _clip(setpoint[VALUE + 3], setting[YAW_RATE])


@inlined
def _held(memory: NDArray, belief: NDArray, own: Quaternion, wish: Vector) -> Vector:
    """Return the wish with the horizontal velocity that holds the place of the own odometry."""
    v_W = rot.rotate(own, vector(belief, ob.VELOCITY))
    for k in range(2):
        if memory[HOLDS_XY] == 0.0:
            memory[HOLD_XY + k] = belief[ob.ODOMETRY + k] + BRAKE_S * v_W[k]
    memory[HOLDS_XY] = 1.0
    ex = memory[HOLD_XY] - belief[ob.ODOMETRY]
    ey = memory[HOLD_XY + 1] - belief[ob.ODOMETRY + 1]
    v = rot.rotate_back(own, (K_HOLD * ex, K_HOLD * ey, 0.0))
    return (v[0], v[1], wish[2])


@inlined
def _climb(mode: int, asked: float, memory: NDArray, belief: NDArray, row: NDArray, setting: NDArray) -> float:
    """Return the wanted vertical velocity [m/s]: take-off, landing, height hold, or what is asked."""
    height = belief[ob.HEIGHT]
    if mode == LANDING:
        return -_descent(memory, belief, row, setting)
    if mode == TAKING_OFF:
        return _ascent(memory, row, setting, height)
    if asked != 0.0:
        memory[HOLDS_Z] = 0.0
        return min(asked, K_HEIGHT * (setting[ALTITUDE] - height))
    if memory[HOLDS_Z] != HOLDING:
        ahead = height + belief[ob.VELOCITY + 2] / setting[K_CLIMB]
        memory[HOLD_Z], memory[HOLDS_Z] = max(ahead, 2.0 * row[STAND_HEIGHT]), HOLDING
    return _clip(K_HEIGHT * (memory[HOLD_Z] - height), setting[CLIMB])


@inlined
def _ascent(memory: NDArray, row: NDArray, setting: NDArray, height: float) -> float:
    """Return the vertical velocity of a take-off [m/s]: along a height that rises evenly."""
    if memory[HOLDS_Z] == 0.0:
        memory[HOLD_Z], memory[HOLDS_Z] = row[STAND_HEIGHT], RISING
    rising = 0.0
    if memory[HOLDS_Z] == RISING:
        rising = CLIMB_M_S
        memory[HOLD_Z] += rising * STEP_S
        if memory[HOLD_Z] >= setting[TAKEOFF_HEIGHT]:
            memory[HOLD_Z], memory[HOLDS_Z] = setting[TAKEOFF_HEIGHT], HOLDING
    return rising + _clip(K_HEIGHT * (memory[HOLD_Z] - height), setting[CLIMB])


@inlined
def _descent(memory: NDArray, belief: NDArray, row: NDArray, setting: NDArray) -> float:
    """Return the speed of descent [m/s], and count how long the ground has borne the weight."""
    borne = ob.lift(belief, row) < TOUCH_SHARE * row[GRAVITY] and belief[ob.VELOCITY + 2] > -TOUCH_M_S
    memory[TOUCH] = memory[TOUCH] + 1.0 if borne else 0.0
    faster = DESCENT_FAR_1_S * max(belief[ob.HEIGHT] - FLARE_M, 0.0)
    return min(DESCENT_M_S + faster, max(setting[CLIMB], DESCENT_M_S))


@inlined
def _clip(x: float, most: float) -> float:
    return min(max(x, -most), most)
