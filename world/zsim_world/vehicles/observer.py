"""The firmware's estimate of attitude, velocity, height and disturbance, from its noisy sensors, with fixed gains.

The velocity is in the heading frame (x forward, y left, z up). Tilt is corrected by the measured velocity, since in
flight the accelerometer does not show the direction of gravity: a multirotor's specific force is along its thrust at
any tilt.

The gains are steady-state Kalman gains for the noise of the drone's sensors, computed once. Design model of one
horizontal axis (heading frame), driven by white noise:
    dv/dt = -c v + g tilt + u      c: drag over mass; u: disturbance (wind, collisions, model error)
    dtilt/dt = rate + noise        rate: error of the gyro's bias
    drate/dt = noise, du/dt = noise
measured by the accelerometer (u - c v: a multirotor's specific force across its thrust is drag and disturbance) and by
the optical flow (v). Vertical axis: dz/dt = v, dv/dt = -c v + u, with a measured height (z) and the accelerometer's
bias as a further state (it measures u - c v + bias; horizontally, a bias is indistinguishable from a tilt). Heading:
dpsi/dt = rate + noise, drate/dt = noise, measured by the magnetometer (psi).
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math import linear
from zsim.math import rotation as rot
from zsim.math.compiled import Field, columns, inlined
from zsim.math.rotation import Quaternion, Vector, axpy
from zsim.scenario.scenario import Drone, Environment
from zsim.sensors.sensor import ErrorModel, Sensor, noise_sigma, scaled
from zsim.sensors.stock_sensors import BOARD_RATE_HZ
from zsim.vehicles.vehicle import Vehicle
from zsim_world.physics.fleet_arrays import (
    REFERENCE_DENSITY_KG_M3,
    VEHICLE,
    PerRotor,
    four,
    put,
    put_four,
    put_value,
    value_of,
    vector,
)
from zsim_world.physics.rigid_body import free_thrust, lagged
from zsim_world.sensors.sensor_set import FIELD_MIN_UT, heading_sigma

STEP_S = 1.0 / BOARD_RATE_HZ  # s

BELIEF = columns(  # followed by R modelled rotor speeds [rad/s]
    "BeliefColumns",
    (
        Field("q_WB", "1", 4),
        Field("gyro_bias", "rad/s", 3),  # in B
        Field("v_H", "m/s", 3),
        Field("disturbance", "m/s^2", 3),
        Field("height", "m"),  # above the ground
        Field("baro_zero", "m"),  # the barometer's reading at height zero
        Field("odometry", "m", 2),  # displacement in W since power-up
        Field("w_WB_B", "rad/s", 3),
        Field("still_steps", "1"),
        Field("baro_samples", "1"),
        Field("mag_samples", "1"),
        Field("sonar_age", "1"),  # steps since the last good echo
        Field("lift_bias", "m/s^2"),  # vertical bias of the accelerometer
        Field("heading", "rad"),  # heading of q_WB
        Field("stand_height", "m"),  # height of a drone that has landed on an obstacle; 0 on the ground
    ),
)
DEVICE = columns(  # newest sample of each sensor, and flags of new samples
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
CALIBRATION = columns(  # mounts and site, as known to the board
    "CalibrationColumns",
    (
        Field("imu_turn", "1", 4),  # q_BS
        Field("mag_turn", "1", 4),  # q_BS
        Field("mag_bearing", "rad"),  # heading of the horizontal field; NaN if it is too weak
        Field("sonar_min", "m"),
    ),
)

# Steps, weight of the prior that the floor is level to 0.05 rad, at an accelerometer noise of 0.35 g
STILL_STEPS_MIN = 50.0
STILL_STEPS_SWAY = 400.0  # steps, added to slow the averaging of the gyro's bias: in wind, a standing drone sways
STILL_STEPS_MAX = 4000.0  # steps, 20 s: the bias walks, so older samples get less weight
FLOW_QUALITY_MIN = 0.3  # below this quality, the picture shows more horizon than ground
FLOOR_MIN_M = 0.3  # m, design choice: a landing above this is on an obstacle; sonars measure from 0.25 m or less
SONAR_AGE_MAX = 100.0  # steps, 0.5 s; after this time without an echo, the height comes from the barometer


@inlined
def _turn_by(belief: NDArray, own: Quaternion, r_H: Vector) -> Quaternion:
    """Rotate the estimated attitude by a small rotation vector [rad; heading frame]; return the new heading frame."""
    turn = rot.from_rotation_vector(rot.rotate(own, r_H))
    q = rot.normalised(rot.multiply(turn, four(belief, BELIEF.q_WB)))
    put_four(belief, BELIEF.q_WB, q)
    belief[BELIEF.heading] = rot.heading(q)
    return rot.about_z(belief[BELIEF.heading])


@inlined
def _correct_bias(belief: NDArray, own: Quaternion, r_H: Vector) -> None:
    """Correct the gyro's bias by a rate error [rad/s; heading frame]."""
    q_HB = rot.level(own, four(belief, BELIEF.q_WB))
    put(belief, BELIEF.gyro_bias, axpy(vector(belief, BELIEF.gyro_bias), -1.0, rot.rotate_back(q_HB, r_H)))


@inlined
def body_rate(mount: Quaternion, gyro: Vector, bias: Vector) -> Vector:
    """Return the body rate [rad/s] measured by a gyro with the mount q_BS, less its bias."""
    return axpy(rot.rotate(mount, gyro), -1.0, bias)


@inlined
def step_turn(w: Vector) -> Vector:
    """Return the rotation vector [rad] of one step at a body rate [rad/s]."""
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
    """Advance the estimate by one step of 5 ms and process the sensors' new samples.

    The firmware has already advanced body rate, attitude and heading to the end of the step by the gyro (firmware.py).

    Args:
        belief: the estimate, (BELIEF.size + R,), modified in place.
        own: orientation of the heading frame in W; turned: change of heading in this step [rad].
        row: the vehicle's nominal parameters; gain: row of gains, see `gain_row`.
        device: newest samples, (DEVICE.size,); the flags of new samples are cleared.
        board: mounts and site, (CALIBRATION.size,).
        on_ground: whether the drone stands, so that its velocity is zero and its accelerometer measures only gravity.

    Returns:
        the orientation in W of the heading frame of the new estimated attitude.
    """
    f_B = rot.rotate(four(board, CALIBRATION.imu_turn), vector(device, DEVICE.accel))
    if on_ground:
        own = _stand(belief, row, own, f_B, vector(belief, BELIEF.w_WB_B))
    else:
        _fly(belief, row, gain, own, f_B, turned, each)
        if device[DEVICE.new_flow] > 0.0 and device[DEVICE.flow_quality] >= FLOW_QUALITY_MIN:
            own = _fuse_flow(belief, gain, own, vector(device, DEVICE.flow))
        _measure_height(belief, gain, device, board[CALIBRATION.sonar_min])
    if device[DEVICE.new_baro] > 0.0:
        _fuse_baro(belief, gain, device[DEVICE.baro], on_ground)
    if device[DEVICE.new_mag] > 0.0 and not math.isnan(board[CALIBRATION.mag_bearing]):
        own = _fuse_mag(
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
    """Average gravity and the gyro's bias while standing, evenly for the first 20 s; return the new heading frame."""
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
    """Return the estimated height [m] of a drone standing on the ground or on an obstacle."""
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
    """Predict velocity, height and odometry after one step, and correct the estimate by the accelerometer."""
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
    """Return the modelled thrust per mass [m/s^2]."""
    return free_thrust(row, PerRotor(belief, BELIEF.size, 1, each)) / row[VEHICLE.mass]


@inlined
def _correct(belief: NDArray, gain: NDArray, at: int, e: Vector) -> None:
    """Correct horizontal velocity and disturbance by an innovation, with gains from column `at` on."""
    for k in range(2):
        belief[BELIEF.v_H + k] += gain[at] * e[k]
        belief[BELIEF.disturbance + k] += gain[at + 3] * e[k]


@inlined
def _lift_by(belief: NDArray, gain: NDArray, at: int, e: float) -> None:
    """Correct height, climb rate, vertical disturbance and bias by an innovation, with gains from column `at` on."""
    belief[BELIEF.height] += gain[at] * e
    belief[BELIEF.v_H + 2] += gain[at + 1] * e
    belief[BELIEF.disturbance + 2] += gain[at + 2] * e
    belief[BELIEF.lift_bias] += gain[at + 3] * e


@inlined
def _fuse_flow(belief: NDArray, gain: NDArray, own: Quaternion, flow_H: Vector) -> Quaternion:
    """Correct velocity, disturbance, tilt, bias and climb rate by a flow velocity; return the new heading frame."""
    e = axpy(flow_H, -1.0, vector(belief, BELIEF.v_H))
    _correct(belief, gain, GAIN.flow_v, e)
    tilt, rate = gain[GAIN.flow_tilt], gain[GAIN.flow_rate]  # the accelerometer does not correct these
    # a drone that is faster forward than estimated is pitched further forward than estimated
    own = _turn_by(belief, own, (-tilt * e[1], tilt * e[0], 0.0))
    _correct_bias(belief, own, (-rate * e[1], rate * e[0], 0.0))
    _lift_by(belief, gain, GAIN.climb_z, e[2])
    return own


@inlined
def _measure_height(belief: NDArray, gain: NDArray, device: NDArray, sonar_min: float) -> None:
    """Correct the height by the sonar or, after SONAR_AGE_MAX without a good echo, by the barometer."""
    belief[BELIEF.sonar_age] += 1.0
    if device[DEVICE.new_sonar] > 0.0 and device[DEVICE.sonar_valid] > 0.0 and device[DEVICE.sonar] >= sonar_min:
        belief[BELIEF.sonar_age] = 0.0
        e = device[DEVICE.sonar] * rot.z_axis(four(belief, BELIEF.q_WB))[2] - belief[BELIEF.height]
        _lift_by(belief, gain, GAIN.sonar_z, e)
    if device[DEVICE.new_baro] > 0.0 and belief[BELIEF.sonar_age] > SONAR_AGE_MAX:
        _lift_by(belief, gain, GAIN.baro_z, device[DEVICE.baro] - belief[BELIEF.baro_zero] - belief[BELIEF.height])


@inlined
def _fuse_baro(belief: NDArray, gain: NDArray, altitude: float, on_ground: bool) -> None:
    """Estimate the barometer's reading at height zero: on the ground, and in the air while the sonar has an echo."""
    if on_ground or belief[BELIEF.sonar_age] <= SONAR_AGE_MAX:
        n = belief[BELIEF.baro_samples] + 1.0
        belief[BELIEF.baro_samples] = n
        error = altitude - belief[BELIEF.height] - belief[BELIEF.baro_zero]
        belief[BELIEF.baro_zero] += max(1.0 / n, gain[GAIN.baro_zero]) * error


@inlined
def _fuse_mag(belief: NDArray, gain: NDArray, own: Quaternion, field_B: Vector, bearing: float) -> Quaternion:
    """Correct heading and vertical gyro bias; average the first samples. Return the new heading frame."""
    field_H = rot.rotate(rot.level(own, four(belief, BELIEF.q_WB)), field_B)
    if field_H[0] * field_H[0] + field_H[1] * field_H[1] < FIELD_MIN_UT * FIELD_MIN_UT:
        return own
    n = belief[BELIEF.mag_samples] + 1.0
    belief[BELIEF.mag_samples] = n
    e = rot.wrapped(bearing - el.atan2(field_H[1], field_H[0]) - belief[BELIEF.heading])
    own = _turn_by(belief, own, (0.0, 0.0, max(1.0 / n, gain[GAIN.mag_psi]) * e))
    if 1.0 / n < gain[GAIN.mag_psi]:
        _correct_bias(belief, own, (0.0, 0.0, gain[GAIN.mag_rate] * e))
    return own


@inlined
def model_rotors(belief: NDArray, decay: float, commands: PerRotor) -> None:
    """Advance the modelled rotors by one step under commands [rad/s]; `decay`: fraction of the speed error left."""
    speeds = PerRotor(belief, BELIEF.size, 1, commands.each)
    for r in range(len(commands.each)):
        put_value(speeds, r, lagged(value_of(speeds, 0, r), value_of(commands, 0, r), decay))


Array = NDArray[np.float64]

DEG = math.pi / 180.0  # rad

# Smallest and largest standard deviation of a sample in the design: no meter is trusted fully, and one beyond the
# largest has practically no effect
SIGMAS = {
    "accel": (0.02, 50.0),  # m/s^2
    "gyro": (1e-4, 1.0),  # rad/s
    "flow": (0.02, 10.0),  # m/s
    "baro": (0.02, 100.0),  # m
    "sonar": (0.01, 10.0),  # m
    "mag": (0.01, 3.0),  # rad
}
DOUBLINGS = 24  # 2^24 steps of 5 ms are a day
SAMPLE_RATE_MIN_HZ = 0.1  # Hz, lower bound of a meter's sample rate in the design

GAIN = columns(  # innovation -> state, in the unit of the state over that of the innovation
    "GainColumns",
    (
        Field("accel_v", ""),
        Field("accel_tilt", ""),
        Field("accel_rate", ""),
        Field("accel_u", ""),
        Field("flow_v", ""),
        Field("flow_tilt", ""),
        Field("flow_rate", ""),
        Field("flow_u", ""),
        Field("lift_z", "", 4),  # accelerometer, vertical: height, climb rate, disturbance, bias
        Field("climb_z", "", 4),  # flow, vertical, as above
        Field("baro_z", "", 4),
        Field("sonar_z", "", 4),
        Field("baro_zero", ""),
        Field("mag_psi", ""),
        Field("mag_rate", ""),
    ),
)
Meter = tuple[float, float]  # standard deviation of a sample, samples per second


class ObserverDesign(NamedTuple):
    """The parameters that determine the gains of a drone."""

    drag_1_s: float
    gravity_m_s2: float
    accel: Meter  # m/s^2
    accel_walk: float  # m/s^2/sqrt(s)
    tilt_walk: float  # rad/sqrt(s)
    gyro_walk: float  # rad/s/sqrt(s)
    flow: Meter  # m/s
    baro: Meter  # m
    sonar: Meter  # m
    mag: Meter  # rad
    disturbance_walk: float  # m/s^2/sqrt(s)
    lift_walk: float  # m/s^2/sqrt(s)


def gain_row(vehicle: Vehicle, drone: Drone, environment: Environment) -> Array:
    s, walks = drone.sensors, vehicle.firmware
    field = el.length(environment.magnetic_field_ut[:2])
    gyro = _sigma(scaled(s.imu.gyro_deg_s, DEG), s.imu.rate_hz, "gyro")
    design = ObserverDesign(
        drag_1_s=drone.drag_n_s_m * environment.air_density_kg_m3 / REFERENCE_DENSITY_KG_M3 / drone.mass_kg,
        gravity_m_s2=environment.gravity_m_s2,
        accel=(_sigma(s.imu.accel_m_s2, s.imu.rate_hz, "accel"), BOARD_RATE_HZ),
        accel_walk=max(s.imu.accel_m_s2.bias_walk, walks.lift_bias_walk),
        tilt_walk=el.hypot(gyro / math.sqrt(BOARD_RATE_HZ), walks.tilt_walk),
        gyro_walk=max(scaled(s.imu.gyro_deg_s, DEG).bias_walk, walks.bias_walk),
        flow=(_sigma(s.flow.velocity_m_s, s.flow.rate_hz, "flow"), sample_rate(s.flow)),
        baro=(_sigma(s.baro.altitude_m, s.baro.rate_hz, "baro"), sample_rate(s.baro)),
        sonar=(_sigma(s.sonar.range_m, s.sonar.rate_hz, "sonar"), sample_rate(s.sonar)),
        mag=(_clipped(heading_sigma(s.mag, field), "mag"), sample_rate(s.mag)),
        disturbance_walk=walks.disturbance_walk,
        lift_walk=walks.lift_walk,
    )
    return _gains(design)


def sample_rate(sensor: Sensor) -> float:
    """Return the rate [Hz] of samples that do not drop out."""
    return max(sensor.rate_hz * (1.0 - sensor.dropout), SAMPLE_RATE_MIN_HZ)


def _sigma(model: ErrorModel, rate_hz: float, name: str) -> float:
    return _clipped(el.hypot(noise_sigma(model, rate_hz), model.quantum / math.sqrt(12.0)), name)


def _clipped(sigma: float, name: str) -> float:
    low, high = SIGMAS[name]
    return min(max(sigma, low), high)


@lru_cache(maxsize=256)
def _gains(d: ObserverDesign) -> Array:
    c, g = d.drag_1_s, d.gravity_m_s2
    across = np.array([[-c, g, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float)
    walks = np.array([0.0, d.tilt_walk, d.gyro_walk, d.disturbance_walk])
    horizontal = steady_gains(across, walks, [([-c, 0, 0, 1], *d.accel), ([1, 0, 0, 0], *d.flow)])

    up = np.array([[0, 1, 0, 0], [0, -c, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float)
    walks = np.array([0.0, 0.0, d.lift_walk, d.accel_walk])
    moving = [([0, -c, 1, 1], *d.accel), ([0, 1, 0, 0], *d.flow)]
    by_baro = steady_gains(up, walks, [*moving, ([1, 0, 0, 0], *d.baro)])
    by_sonar = steady_gains(up, walks, [*moving, ([1, 0, 0, 0], *d.sonar)])

    turning = np.array([[0, 1], [0, 0]], dtype=float)
    by_mag = steady_gains(turning, np.array([d.tilt_walk, d.gyro_walk]), [([1, 0], *d.mag)])

    row = np.empty(GAIN.size)
    row[GAIN.accel_v : GAIN.lift_z] = horizontal.ravel()
    row[GAIN.lift_z : GAIN.sonar_z] = by_baro.ravel()
    row[GAIN.sonar_z : GAIN.baro_zero] = by_sonar[2]
    row[GAIN.baro_zero] = 1.0 / (10.0 * d.baro[1])  # an average over ten seconds
    row[GAIN.mag_psi : GAIN.mag_rate + 1] = by_mag[0]
    row = np.array([float(f"{x:.9g}") for x in row])  # nine digits: the same bits with any BLAS
    row.setflags(write=False)
    return row


def steady_gains(a: Array, walks: Array, meters: list[tuple[list[float], float, float]]) -> Array:
    """Return the gain per sample of each meter in the steady state of a Kalman filter, (meters, states).

    A meter slower than the board is treated as a 200 Hz meter with the same information; its gain per sample is then
    P H^T / (H P H^T + sigma^2) with the resulting covariance.

    Args:
        a: dx/dt = a x; walks: white noise on each state [unit/sqrt(s)].
        meters: (row of H, standard deviation of a sample, samples per second).
    """
    p = covariance(a, walks, meters)
    gains = []
    for h, sigma, _ in meters:
        ph = linear.product(p, h)
        gains.append(ph / (float((h * ph).sum()) + sigma * sigma))
    return np.array(gains)


def covariance(a: Array, walks: Array, meters: list[tuple[list[float], float, float]]) -> Array:
    """Return the steady covariance before an update, for the meters of `steady_gains`."""
    dt = 1.0 / BOARD_RATE_HZ
    h = np.array([row for row, _, _ in meters], dtype=float)
    r = np.diag([sigma * sigma * BOARD_RATE_HZ / rate for _, sigma, rate in meters])
    # process noise over one step by Simpson's rule: exact to dt^5 for these chains
    q = np.diag(walks * walks)
    half, full = (linear.exponential(a * s) for s in (dt / 2, dt))
    noise = dt / 6.0 * (q + 4.0 * _propagated(half, q) + _propagated(full, q))
    return _riccati(full, linear.product(h.T, linear.solve(r, h)), noise)


def _propagated(f: Array, p: Array) -> Array:
    """Return F P F^T."""
    return linear.product(linear.product(f, p), f.T)


def _riccati(f: Array, information: Array, noise: Array) -> Array:
    """Return the steady prior covariance of x' = f x + noise, measured with `information` = H^T R^-1 H in every step.

    Structure-preserving doubling, 2^k steps after k rounds (Chu, Fan, Lin and Wang, Int. J. Control 77 (2004) 767-788):
    scipy's solver fails on chains with meters that differ by ten orders of magnitude.
    """
    a, g, p = f.T, information, noise
    for _ in range(DOUBLINGS):
        solution = linear.solve(np.eye(len(a)) + linear.product(g, p), np.hstack([a, g]))
        transformed, spread = solution[:, : len(a)], solution[:, len(a) :]
        g, p = g + _propagated(a, spread), p + linear.product(linear.product(a.T, p), transformed)
        a = linear.product(a, transformed)
    return 0.5 * (p + p.T)
