"""What the firmware believes: attitude, velocity, height, disturbance, from its own noisy sensors with fixed gains.

The velocity is in the heading frame (x forward, y left, z up). Tilt is corrected by the velocity, not by taking the
accelerometer for gravity: in flight a multirotor's specific force lies along its thrust whatever its tilt.
"""

import math

from numpy.typing import NDArray

from zsim.math import rotation as rot
from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, axpy
from zsim.scenario.sensor_presets import BOARD_RATE_HZ
from zsim_world.physics.rigid_body import four, put, put_four, vector
from zsim_world.physics.rotors import Four, lagged
from zsim_world.state.vehicle import DRAG, GRAVITY, MASS, STAND_HEIGHT, THRUST
from zsim_world.vehicles import observer_gains as g

STEP_S = 1.0 / BOARD_RATE_HZ  # s

# Columns of the belief, one row per drone
ATTITUDE, GYRO_BIAS, VELOCITY, DISTURBANCE = 0, 4, 7, 10  # B to W; rad/s in B; m/s; m/s^2
HEIGHT, BARO_ZERO, ODOMETRY = 13, 14, 15  # m over the ground; m; m in W from power-up (2)
BODY_RATE, ROTOR = 17, 20  # rad/s in B; rad/s, modelled (4)
STILL_STEPS, BARO_SAMPLES, MAG_SAMPLES, SONAR_AGE = 24, 25, 26, 27  # counts; steps since the last good echo
LIFT_BIAS = 28  # m/s^2, of the accelerometer along the vertical
HEADING = 29  # rad, of ATTITUDE
COLUMNS = 30

# Columns of the device registers: the newest sample of each sensor and whether it is new
ACCEL, GYRO, FLOW, FLOW_QUALITY, MAG, BARO, SONAR, SONAR_VALID = 0, 3, 6, 9, 10, 13, 14, 15
NEW_FLOW, NEW_MAG, NEW_BARO, NEW_SONAR = 16, 17, 18, 19
REGISTERS = 20

# Columns of the board's calibration: what it knows of its own mounts and of the place
IMU_TURN, MAG_TURN, MAG_BEARING, SONAR_MIN = 0, 4, 8, 9  # q_BS, q_BS, heading of the horizontal field [rad], m
CALIBRATION = 10

STILL_STEPS_MIN = 50.0  # what knowing a floor to be level to 0.05 rad is worth, at an accelerometer noise of 0.35 g
STILL_STEPS_SWAY = 400.0  # the gyro's bias is averaged slower: in a wind a standing drone sways on its feet
STILL_STEPS_MAX = 4000.0  # 20 s: the bias walks on, so older samples tell less
FLOW_QUALITY_MIN = 0.3  # below, the picture shows more horizon than ground
SONAR_AGE_MAX = 100.0  # steps, 0.5 s without echo: heights come from the barometer
MAG_MIN_UT = 1.0  # uT, a horizontal field that still gives a heading


@inlined
def _face(belief: NDArray, q: Quaternion) -> Quaternion:
    """Believe an attitude; return its heading frame in W, which all that follows is given."""
    put_four(belief, ATTITUDE, q)
    belief[HEADING] = rot.heading(q)
    return rot.about_z(belief[HEADING])


@inlined
def _turn_by(belief: NDArray, own: Quaternion, r_H: Vector) -> Quaternion:
    """Turn the believed attitude by a small rotation vector [rad] given in the heading frame; return the new frame."""
    turn = rot.from_rotation_vector(rot.rotate(own, r_H))
    return _face(belief, rot.normalised(rot.multiply(turn, four(belief, ATTITUDE))))


@inlined
def _take_bias(belief: NDArray, own: Quaternion, r_H: Vector) -> None:
    """Take a rate error [rad/s], given in the heading frame, out of the gyro's bias."""
    q_HB = rot.level(own, four(belief, ATTITUDE))
    put(belief, GYRO_BIAS, axpy(vector(belief, GYRO_BIAS), -1.0, rot.rotate_back(q_HB, r_H)))


@inlined
def body_rate(mount: Quaternion, gyro: Vector, bias: Vector) -> Vector:
    """Return the body rate [rad/s] that a gyro of this mount shows, less its bias."""
    return axpy(rot.rotate(mount, gyro), -1.0, bias)


@inlined
def step_turn(w: Vector) -> Vector:
    """Return the rotation vector [rad] of a step at this body rate [rad/s]."""
    return (w[0] * STEP_S, w[1] * STEP_S, w[2] * STEP_S)


@inlined
def observe(
    belief: NDArray,
    own: Quaternion,
    turned: float,
    row: NDArray,
    gain: NDArray,
    device: NDArray,
    board: NDArray,
    on_ground: bool,
) -> Quaternion:
    """Advance the belief by one step of 5 ms and take in what the devices have sampled since the last.

    Body rate, attitude and heading are at the end of the step already, as the gyro has them (steering.py).

    Args:
        belief: (COLUMNS,) in place.
        own: the heading frame in W; turned: by how much it has turned in this step [rad].
        row: the aircraft's nominal parameters (vehicle.py); gain: gains.py.
        device: (REGISTERS,) newest samples; the marks of new ones are cleared.
        board: (CALIBRATION,).
        on_ground: standing: velocity zero, gravity is all that the accelerometer feels.

    Returns:
        the heading frame in W of the attitude now believed.
    """
    f_B = rot.rotate(four(board, IMU_TURN), vector(device, ACCEL))
    if on_ground:
        own = _stand(belief, row, own, f_B, vector(belief, BODY_RATE))
    else:
        _fly(belief, row, gain, own, f_B, turned)
        if device[NEW_FLOW] > 0.0 and device[FLOW_QUALITY] >= FLOW_QUALITY_MIN:
            own = _see_flow(belief, gain, own, vector(device, FLOW))
        _measure_height(belief, gain, device, board[SONAR_MIN])
    if device[NEW_BARO] > 0.0:
        _see_baro(belief, gain, device[BARO], on_ground)
    if device[NEW_MAG] > 0.0:
        own = _see_mag(belief, gain, own, rot.rotate(four(board, MAG_TURN), vector(device, MAG)), board[MAG_BEARING])
    for k in range(NEW_FLOW, NEW_SONAR + 1):
        device[k] = 0.0
    return own


@inlined
def _stand(belief: NDArray, row: NDArray, own: Quaternion, f_B: Vector, w: Vector) -> Quaternion:
    """Average gravity and the gyro's bias while standing; the first 20 s weigh alike. Return the new heading frame."""
    n = min(belief[STILL_STEPS] + 1.0, STILL_STEPS_MAX)
    belief[STILL_STEPS] = n
    q_HB = rot.level(own, four(belief, ATTITUDE))
    f_H = rot.rotate(q_HB, f_B)
    s = 1.0 / (n * row[GRAVITY])
    own = _turn_by(belief, own, (f_H[1] * s, -f_H[0] * s, 0.0))
    put(belief, GYRO_BIAS, axpy(vector(belief, GYRO_BIAS), 1.0 / (n + STILL_STEPS_SWAY), w))
    put(belief, VELOCITY, (0.0, 0.0, 0.0))
    put(belief, DISTURBANCE, (0.0, 0.0, 0.0))
    belief[LIFT_BIAS] += (f_H[2] - row[GRAVITY] - belief[LIFT_BIAS]) / n
    belief[HEIGHT] = row[STAND_HEIGHT]
    return own


@inlined
def _fly(belief: NDArray, row: NDArray, gain: NDArray, own: Quaternion, f_B: Vector, turned: float) -> None:
    """Predict velocity, height and odometry by one step and take in the accelerometer."""
    q_HB = rot.level(own, four(belief, ATTITUDE))
    up = lift(belief, row)
    c = row[DRAG] / row[MASS]
    v, u = vector(belief, VELOCITY), vector(belief, DISTURBANCE)
    a = axpy(axpy(u, -c, v), up, rot.z_axis(q_HB))
    a = (a[0], a[1], a[2] - row[GRAVITY])
    east = rot.rotate(own, axpy(v, 0.5 * STEP_S, a))
    belief[ODOMETRY] += STEP_S * east[0]
    belief[ODOMETRY + 1] += STEP_S * east[1]
    belief[HEIGHT] += STEP_S * east[2]
    back = rot.about_z(-turned)
    v, u = rot.rotate(back, axpy(v, STEP_S, a)), rot.rotate(back, u)

    e = axpy(rot.rotate(q_HB, (f_B[0], f_B[1], f_B[2] - up)), -1.0, axpy(u, -c, v))
    put(belief, VELOCITY, v)
    put(belief, DISTURBANCE, u)
    _correct(belief, gain, g.ACCEL_V, e)
    _lift_by(belief, gain, g.LIFT_Z, e[2] - belief[LIFT_BIAS])


@inlined
def lift(belief: NDArray, row: NDArray) -> float:
    """Return the modelled thrust over mass [m/s^2]."""
    s = 0.0
    for k in range(4):
        s += belief[ROTOR + k] * belief[ROTOR + k]
    return row[THRUST] * s / row[MASS]


@inlined
def _correct(belief: NDArray, gain: NDArray, at: int, e: Vector) -> None:
    """Correct horizontal velocity and disturbance by an innovation; the gains stand at `at`."""
    for k in range(2):
        belief[VELOCITY + k] += gain[at] * e[k]
        belief[DISTURBANCE + k] += gain[at + 3] * e[k]


@inlined
def _correct_tilt(belief: NDArray, gain: NDArray, own: Quaternion, e: Vector) -> Quaternion:
    """Correct tilt and gyro bias by an innovation of the flow (the accelerometer's share of it is nothing)."""
    tilt, rate = gain[g.FLOW_TILT], gain[g.FLOW_RATE]
    own = _turn_by(belief, own, (-tilt * e[1], tilt * e[0], 0.0))  # faster forward than believed: pitched farther so
    _take_bias(belief, own, (-rate * e[1], rate * e[0], 0.0))
    return own


@inlined
def _lift_by(belief: NDArray, gain: NDArray, at: int, e: float) -> None:
    """Correct height, climb, vertical disturbance and accelerometer bias by an innovation; the gains stand at `at`."""
    belief[HEIGHT] += gain[at] * e
    belief[VELOCITY + 2] += gain[at + 1] * e
    belief[DISTURBANCE + 2] += gain[at + 2] * e
    belief[LIFT_BIAS] += gain[at + 3] * e


@inlined
def _see_flow(belief: NDArray, gain: NDArray, own: Quaternion, flow_H: Vector) -> Quaternion:
    """Correct velocity, disturbance, tilt, bias and climb by a velocity seen; return the new heading frame."""
    e = axpy(flow_H, -1.0, vector(belief, VELOCITY))
    _correct(belief, gain, g.FLOW_V, e)
    own = _correct_tilt(belief, gain, own, e)
    _lift_by(belief, gain, g.CLIMB_Z, e[2])
    return own


@inlined
def _measure_height(belief: NDArray, gain: NDArray, device: NDArray, sonar_min: float) -> None:
    """Take the height from the sonar where it has an echo, else from the barometer."""
    belief[SONAR_AGE] += 1.0
    if device[NEW_SONAR] > 0.0 and device[SONAR_VALID] > 0.0 and device[SONAR] >= sonar_min:
        belief[SONAR_AGE] = 0.0
        e = device[SONAR] * rot.z_axis(four(belief, ATTITUDE))[2] - belief[HEIGHT]
        _lift_by(belief, gain, g.SONAR_Z, e)
    if device[NEW_BARO] > 0.0 and belief[SONAR_AGE] > SONAR_AGE_MAX:
        _lift_by(belief, gain, g.BARO_Z, device[BARO] - belief[BARO_ZERO] - belief[HEIGHT])


@inlined
def _see_baro(belief: NDArray, gain: NDArray, altitude: float, on_ground: bool) -> None:
    """Learn what the barometer shows at height zero: on the ground, and in the air while the sonar gives the height."""
    if on_ground or belief[SONAR_AGE] <= SONAR_AGE_MAX:
        n = belief[BARO_SAMPLES] + 1.0
        belief[BARO_SAMPLES] = n
        belief[BARO_ZERO] += max(1.0 / n, gain[g.BARO_ZERO]) * (altitude - belief[HEIGHT] - belief[BARO_ZERO])


@inlined
def _see_mag(belief: NDArray, gain: NDArray, own: Quaternion, field_B: Vector, bearing: float) -> Quaternion:
    """Correct heading and the gyro's bias about the vertical; the first samples are averaged. Return the new frame."""
    field_H = rot.rotate(rot.level(own, four(belief, ATTITUDE)), field_B)
    if field_H[0] * field_H[0] + field_H[1] * field_H[1] < MAG_MIN_UT * MAG_MIN_UT:
        return own
    n = belief[MAG_SAMPLES] + 1.0
    belief[MAG_SAMPLES] = n
    e = rot.wrapped(bearing - math.atan2(field_H[1], field_H[0]) - belief[HEADING])
    own = _turn_by(belief, own, (0.0, 0.0, max(1.0 / n, gain[g.MAG_PSI]) * e))
    if 1.0 / n < gain[g.MAG_PSI]:
        _take_bias(belief, own, (0.0, 0.0, gain[g.MAG_RATE] * e))
    return own


@inlined
def model_rotors(belief: NDArray, decay: float, command: Four) -> None:
    """Advance the modelled rotors by one step under a command [rad/s]; decay: what is left of their lag after it."""
    put_four(belief, ROTOR, lagged(four(belief, ROTOR), command, decay))
