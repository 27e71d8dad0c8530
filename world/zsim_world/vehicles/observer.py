"""What the firmware believes: attitude, velocity, height, disturbance, from its own noisy sensors with fixed gains.

The velocity is in the heading frame (x forward, y left, z up). Tilt is corrected by the velocity, not by taking the
accelerometer for gravity: in flight a multirotor's specific force lies along its thrust whatever its tilt.
"""

import math

from numpy.typing import NDArray

from zsim.math import rotation as rot
from zsim.math.columns import Field, columns
from zsim.math.compiled import inlined
from zsim.math.rotation import Quaternion, Vector, axpy
from zsim.sensors.imu import BOARD_RATE_HZ
from zsim_world.physics.fleet_arrays import VEHICLE, PerRotor, of, put_of
from zsim_world.physics.rigid_body import four, put, put_four, vector
from zsim_world.physics.rotors import free_thrust, lagged
from zsim_world.sensors.sensor_set import FIELD_MIN_UT
from zsim_world.vehicles.observer_gains import GAIN

STEP_S = 1.0 / BOARD_RATE_HZ  # s

BELIEF = columns(  # and R rotor speeds, modelled [rad/s]
    "BeliefColumns",
    (
        Field("q_WB", "1", 4),
        Field("gyro_bias", "rad/s", 3),  # in B
        Field("v_H", "m/s", 3),
        Field("disturbance", "m/s^2", 3),
        Field("height", "m"),  # over the ground
        Field("baro_zero", "m"),
        Field("odometry", "m", 2),  # in W from power-up
        Field("w_WB_B", "rad/s", 3),
        Field("still_steps", "1"),
        Field("baro_samples", "1"),
        Field("mag_samples", "1"),
        Field("sonar_age", "1"),  # steps since the last good echo
        Field("lift_bias", "m/s^2"),  # of the accelerometer along the vertical
        Field("heading", "rad"),  # of q_WB
        Field("stand_height", "m"),  # at which it has landed on what is not the ground; 0 on the ground
    ),
)
DEVICE = columns(  # the newest sample of each sensor, and whether it is new
    "DeviceColumns",
    (
        Field("accel", "m/s^2", 3),
        Field("gyro", "rad/s", 3),
        Field("flow", "m/s", 3),
        Field("flow_quality", "1"),
        Field("mag", "uT", 3),
        Field("baro", "m"),
        Field("sonar", "m"),
        Field("sonar_valid", "1"),
        Field("new_flow", "1"),
        Field("new_mag", "1"),
        Field("new_baro", "1"),
        Field("new_sonar", "1"),
    ),
)
CALIBRATION = columns(  # what the board knows of its own mounts and of the place
    "CalibrationColumns",
    (
        Field("imu_turn", "1", 4),  # q_BS
        Field("mag_turn", "1", 4),  # q_BS
        Field("mag_bearing", "rad"),  # heading of the horizontal field, not a number where that gives none
        Field("sonar_min", "m"),
    ),
)

STILL_STEPS_MIN = 50.0  # what knowing a floor to be level to 0.05 rad is worth, at an accelerometer noise of 0.35 g
STILL_STEPS_SWAY = 400.0  # the gyro's bias is averaged slower: in a wind a standing drone sways on its feet
STILL_STEPS_MAX = 4000.0  # 20 s: the bias walks on, so older samples have less weight
FLOW_QUALITY_MIN = 0.3  # below, the picture shows more horizon than ground
FLOOR_MIN_M = 0.3  # m, chosen: a landing believed to be higher is on a roof; sonars measure from 0.25 m on or less
SONAR_AGE_MAX = 100.0  # steps, 0.5 s without echo: heights come from the barometer


@inlined
def _face(belief: NDArray, q: Quaternion) -> Quaternion:
    """Believe an attitude; return its heading frame in W, which all that follows is given."""
    put_four(belief, BELIEF.q_WB, q)
    belief[BELIEF.heading] = rot.heading(q)
    return rot.about_z(belief[BELIEF.heading])


@inlined
def _turn_by(belief: NDArray, own: Quaternion, r_H: Vector) -> Quaternion:
    """Turn the believed attitude by a small rotation vector [rad] given in the heading frame; return the new frame."""
    turn = rot.from_rotation_vector(rot.rotate(own, r_H))
    return _face(belief, rot.normalised(rot.multiply(turn, four(belief, BELIEF.q_WB))))


@inlined
def _take_bias(belief: NDArray, own: Quaternion, r_H: Vector) -> None:
    """Take a rate error [rad/s], given in the heading frame, out of the gyro's bias."""
    q_HB = rot.level(own, four(belief, BELIEF.q_WB))
    put(belief, BELIEF.gyro_bias, axpy(vector(belief, BELIEF.gyro_bias), -1.0, rot.rotate_back(q_HB, r_H)))


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
    each: tuple[int, ...],
) -> Quaternion:
    """Advance the belief by one step of 5 ms and take in what the devices have sampled since the last.

    Body rate, attitude and heading are at the end of the step already, as the gyro has them (simd_firmware.py).

    Args:
        belief: (BELIEF.size + R,) in place.
        own: the heading frame in W; turned: by how much it has turned in this step [rad].
        row: the vehicle's nominal parameters; gain: (GAIN.size,), observer_gains.py.
        device: (DEVICE.size,) newest samples; the marks of new ones are cleared.
        board: (CALIBRATION.size,).
        on_ground: standing: velocity zero, gravity is all that the accelerometer feels.

    Returns:
        the heading frame in W of the attitude now believed.
    """
    f_B = rot.rotate(four(board, CALIBRATION.imu_turn), vector(device, DEVICE.accel))
    if on_ground:
        own = _stand(belief, row, own, f_B, vector(belief, BELIEF.w_WB_B))
    else:
        _fly(belief, row, gain, own, f_B, turned, each)
        if device[DEVICE.new_flow] > 0.0 and device[DEVICE.flow_quality] >= FLOW_QUALITY_MIN:
            own = _see_flow(belief, gain, own, vector(device, DEVICE.flow))
        _measure_height(belief, gain, device, board[CALIBRATION.sonar_min])
    if device[DEVICE.new_baro] > 0.0:
        _see_baro(belief, gain, device[DEVICE.baro], on_ground)
    if device[DEVICE.new_mag] > 0.0 and not math.isnan(board[CALIBRATION.mag_bearing]):
        own = _see_mag(
            belief,
            gain,
            own,
            rot.rotate(four(board, CALIBRATION.mag_turn), vector(device, DEVICE.mag)),
            board[CALIBRATION.mag_bearing],
        )
    for k in range(DEVICE.new_flow, DEVICE.new_sonar + 1):
        device[k] = 0.0
    return own


@inlined
def _stand(belief: NDArray, row: NDArray, own: Quaternion, f_B: Vector, w: Vector) -> Quaternion:
    """Average gravity and the gyro's bias while standing; the first 20 s weigh alike. Return the new heading frame."""
    n = min(belief[BELIEF.still_steps] + 1.0, STILL_STEPS_MAX)
    belief[BELIEF.still_steps] = n
    q_HB = rot.level(own, four(belief, BELIEF.q_WB))
    f_H = rot.rotate(q_HB, f_B)
    s = 1.0 / (n * row[VEHICLE.gravity])
    own = _turn_by(belief, own, (f_H[1] * s, -f_H[0] * s, 0.0))
    put(belief, BELIEF.gyro_bias, axpy(vector(belief, BELIEF.gyro_bias), 1.0 / (n + STILL_STEPS_SWAY), w))
    put(belief, BELIEF.v_H, (0.0, 0.0, 0.0))
    put(belief, BELIEF.disturbance, (0.0, 0.0, 0.0))
    belief[BELIEF.lift_bias] += (f_H[2] - row[VEHICLE.gravity] - belief[BELIEF.lift_bias]) / n
    belief[BELIEF.height] = standing_height(belief, row)
    return own


@inlined
def standing_height(belief: NDArray, row: NDArray) -> float:
    """Return the believed height [m] of a drone that stands, on the ground or on what it has landed on."""
    return max(row[VEHICLE.stand_height], belief[BELIEF.stand_height])


@inlined
def _fly(
    belief: NDArray,
    row: NDArray,
    gain: NDArray,
    own: Quaternion,
    f_B: Vector,
    turned: float,
    each: tuple[int, ...],
) -> None:
    """Predict velocity, height and odometry by one step and take in the accelerometer."""
    q_HB = rot.level(own, four(belief, BELIEF.q_WB))
    up = lift(belief, row, each)
    c = row[VEHICLE.drag] / row[VEHICLE.mass]
    v, u = vector(belief, BELIEF.v_H), vector(belief, BELIEF.disturbance)
    a = axpy(axpy(u, -c, v), up, rot.z_axis(q_HB))
    a = (a[0], a[1], a[2] - row[VEHICLE.gravity])
    east = rot.rotate(own, axpy(v, 0.5 * STEP_S, a))
    belief[BELIEF.odometry] += STEP_S * east[0]
    belief[BELIEF.odometry + 1] += STEP_S * east[1]
    belief[BELIEF.height] += STEP_S * east[2]
    back = rot.about_z(-turned)
    v, u = rot.rotate(back, axpy(v, STEP_S, a)), rot.rotate(back, u)

    e = axpy(rot.rotate(q_HB, (f_B[0], f_B[1], f_B[2] - up)), -1.0, axpy(u, -c, v))
    put(belief, BELIEF.v_H, v)
    put(belief, BELIEF.disturbance, u)
    _correct(belief, gain, GAIN.accel_v, e)
    _lift_by(belief, gain, GAIN.lift_z, e[2] - belief[BELIEF.lift_bias])


@inlined
def lift(belief: NDArray, row: NDArray, each: tuple[int, ...]) -> float:
    """Return the modelled thrust over mass [m/s^2]."""
    return free_thrust(row, PerRotor(belief, BELIEF.size, 1, each)) / row[VEHICLE.mass]


@inlined
def _correct(belief: NDArray, gain: NDArray, at: int, e: Vector) -> None:
    """Correct horizontal velocity and disturbance by an innovation; the gains stand at `at`."""
    for k in range(2):
        belief[BELIEF.v_H + k] += gain[at] * e[k]
        belief[BELIEF.disturbance + k] += gain[at + 3] * e[k]


@inlined
def _correct_tilt(belief: NDArray, gain: NDArray, own: Quaternion, e: Vector) -> Quaternion:
    """Correct tilt and gyro bias by an innovation of the flow (the accelerometer's share of it is nothing)."""
    tilt, rate = gain[GAIN.flow_tilt], gain[GAIN.flow_rate]
    own = _turn_by(belief, own, (-tilt * e[1], tilt * e[0], 0.0))  # faster forward than believed: pitched farther so
    _take_bias(belief, own, (-rate * e[1], rate * e[0], 0.0))
    return own


@inlined
def _lift_by(belief: NDArray, gain: NDArray, at: int, e: float) -> None:
    """Correct height, climb, vertical disturbance and accelerometer bias by an innovation; the gains stand at `at`."""
    belief[BELIEF.height] += gain[at] * e
    belief[BELIEF.v_H + 2] += gain[at + 1] * e
    belief[BELIEF.disturbance + 2] += gain[at + 2] * e
    belief[BELIEF.lift_bias] += gain[at + 3] * e


@inlined
def _see_flow(belief: NDArray, gain: NDArray, own: Quaternion, flow_H: Vector) -> Quaternion:
    """Correct velocity, disturbance, tilt, bias and climb by a velocity seen; return the new heading frame."""
    e = axpy(flow_H, -1.0, vector(belief, BELIEF.v_H))
    _correct(belief, gain, GAIN.flow_v, e)
    own = _correct_tilt(belief, gain, own, e)
    _lift_by(belief, gain, GAIN.climb_z, e[2])
    return own


@inlined
def _measure_height(belief: NDArray, gain: NDArray, device: NDArray, sonar_min: float) -> None:
    """Take the height from the sonar where it has an echo, else from the barometer."""
    belief[BELIEF.sonar_age] += 1.0
    if device[DEVICE.new_sonar] > 0.0 and device[DEVICE.sonar_valid] > 0.0 and device[DEVICE.sonar] >= sonar_min:
        belief[BELIEF.sonar_age] = 0.0
        e = device[DEVICE.sonar] * rot.z_axis(four(belief, BELIEF.q_WB))[2] - belief[BELIEF.height]
        _lift_by(belief, gain, GAIN.sonar_z, e)
    if device[DEVICE.new_baro] > 0.0 and belief[BELIEF.sonar_age] > SONAR_AGE_MAX:
        _lift_by(belief, gain, GAIN.baro_z, device[DEVICE.baro] - belief[BELIEF.baro_zero] - belief[BELIEF.height])


@inlined
def _see_baro(belief: NDArray, gain: NDArray, altitude: float, on_ground: bool) -> None:
    """Learn what the barometer shows at height zero: on the ground, and in the air while the sonar gives the height."""
    if on_ground or belief[BELIEF.sonar_age] <= SONAR_AGE_MAX:
        n = belief[BELIEF.baro_samples] + 1.0
        belief[BELIEF.baro_samples] = n
        error = altitude - belief[BELIEF.height] - belief[BELIEF.baro_zero]
        belief[BELIEF.baro_zero] += max(1.0 / n, gain[GAIN.baro_zero]) * error


@inlined
def _see_mag(belief: NDArray, gain: NDArray, own: Quaternion, field_B: Vector, bearing: float) -> Quaternion:
    """Correct heading and the gyro's bias about the vertical; the first samples are averaged. Return the new frame."""
    field_H = rot.rotate(rot.level(own, four(belief, BELIEF.q_WB)), field_B)
    if field_H[0] * field_H[0] + field_H[1] * field_H[1] < FIELD_MIN_UT * FIELD_MIN_UT:
        return own
    n = belief[BELIEF.mag_samples] + 1.0
    belief[BELIEF.mag_samples] = n
    e = rot.wrapped(bearing - math.atan2(field_H[1], field_H[0]) - belief[BELIEF.heading])
    own = _turn_by(belief, own, (0.0, 0.0, max(1.0 / n, gain[GAIN.mag_psi]) * e))
    if 1.0 / n < gain[GAIN.mag_psi]:
        _take_bias(belief, own, (0.0, 0.0, gain[GAIN.mag_rate] * e))
    return own


@inlined
def model_rotors(belief: NDArray, decay: float, commands: PerRotor) -> None:
    """Advance the modelled rotors by one step under commands [rad/s]; decay: what is left of their lag after it."""
    speeds = PerRotor(belief, BELIEF.size, 1, commands.each)
    for r in range(len(commands.each)):
        put_of(speeds, r, lagged(of(speeds, 0, r), of(commands, 0, r), decay))
