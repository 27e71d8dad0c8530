"""The firmware's fixed observer gains: steady Kalman gains for the noises of its own sensors, computed once.

The design model of one horizontal axis (heading frame), driven by white noise:
    dv/dt = -c v + g tilt + u      c: drag over mass; u: disturbance (wind, collisions, model error)
    dtilt/dt = rate + noise        rate: error of the gyro's bias
    drate/dt = noise, du/dt = noise
measured by the accelerometer (u - c v: a multirotor's specific force across its thrust is its drag and disturbance)
and by the optical flow (v). Vertical: dz/dt = v, dv/dt = -c v + u, with a height and the accelerometer's bias besides
(u - c v + bias; across, a bias is one with a tilt). Heading: psi and rate.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from zsim.scenario import Drone, Environment, ErrorModel, Sensor, Sensors
from zsim_world.sensor_set import DEVICE_RATE_HZ, heading_sigma, radians, white_sigma

Array = NDArray[np.float64]

DISTURBANCE_WALK = 0.2  # m/s^2/sqrt(s): gusts of 0.5 m/s over 5 s on a drag of 0.58 1/s give 0.18
LIFT_WALK = 0.4  # m/s^2/sqrt(s): ground effect and downwash come faster than gusts
TILT_WALK = 6e-4  # rad/sqrt(s), least: vibration, rounding, and what a turn leaves
BIAS_WALK = 2e-5  # rad/s/sqrt(s), least: a bias of 0.1 deg/s is found within a minute
LIFT_BIAS_WALK = 3e-3  # m/s^2/sqrt(s), least: what the board's temperature does to its accelerometer
FLOORS = {"accel": 0.02, "gyro": 1e-4, "flow": 0.02, "baro": 0.02, "sonar": 0.01, "mag": 0.01}  # m/s^2 rad/s m/s m m rad

# Columns of the gain row: innovation -> state
ACCEL_V, ACCEL_TILT, ACCEL_RATE, ACCEL_U = 0, 1, 2, 3
FLOW_V, FLOW_TILT, FLOW_RATE, FLOW_U = 4, 5, 6, 7
LIFT_Z, LIFT_V, LIFT_U, LIFT_BIAS = 8, 9, 10, 11  # accelerometer, vertical
CLIMB_Z, CLIMB_V, CLIMB_U, CLIMB_BIAS = 12, 13, 14, 15  # flow, vertical
BARO_Z = 16  # and three more, as above
SONAR_Z = 20  # and three more
BARO_ZERO = 24
MAG_PSI, MAG_RATE = 25, 26
COLUMNS = 27


def gain_row(drone: Drone, environment: Environment) -> Array:
    """Return the gains of one drone, shape (COLUMNS,)."""
    s = drone.sensors
    field = math.hypot(*environment.magnetic_field_ut[:2])
    return _gains(
        drag_1_s=drone.drag_n_s_m * environment.air_density_kg_m3 / 1.225 / drone.mass_kg,
        gravity=environment.gravity_m_s2,
        accel=(_sigma(s.imu.accel_m_s2, DEVICE_RATE_HZ, "accel"), DEVICE_RATE_HZ),
        accel_walk=max(s.imu.accel_m_s2.bias_walk, LIFT_BIAS_WALK),
        gyro=_sigma(radians(s.imu.gyro_deg_s), DEVICE_RATE_HZ, "gyro"),
        gyro_walk=max(radians(s.imu.gyro_deg_s).bias_walk, BIAS_WALK),
        flow=(_sigma(s.flow.velocity_m_s, s.flow.rate_hz, "flow"), heard(s.flow)),
        baro=(_sigma(s.baro.altitude_m, s.baro.rate_hz, "baro"), heard(s.baro)),
        sonar=(_sigma(s.sonar.range_m, s.sonar.rate_hz, "sonar"), heard(s.sonar)),
        mag=(max(heading_sigma(s.mag, field), FLOORS["mag"]), heard(s.mag)),
    )


def heard(sensor: Sensor) -> float:
    """Return the rate [Hz] at which samples really come, at least one in a hundred."""
    return sensor.rate_hz * max(1.0 - sensor.dropout, 0.01)


def _sigma(model: ErrorModel, rate_hz: float, name: str) -> float:
    return max(math.hypot(white_sigma(model, rate_hz), model.quantum / math.sqrt(12.0)), FLOORS[name])


Meter = tuple[float, float]  # standard deviation of a sample, samples per second


@lru_cache(maxsize=256)
def _gains(
    drag_1_s: float,
    gravity: float,
    accel: Meter,
    accel_walk: float,
    gyro: float,
    gyro_walk: float,
    flow: Meter,
    baro: Meter,
    sonar: Meter,
    mag: Meter,
) -> Array:
    row = np.empty(COLUMNS)
    c, tilt_walk = drag_1_s, math.hypot(gyro / math.sqrt(DEVICE_RATE_HZ), TILT_WALK)
    across = np.array([[-c, gravity, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float)
    walks = np.array([0.0, tilt_walk, gyro_walk, DISTURBANCE_WALK])
    gain = steady_gains(across, walks, [([-c, 0, 0, 1], *accel), ([1, 0, 0, 0], *flow)])
    row[ACCEL_V : FLOW_U + 1] = gain.ravel()

    up = np.array([[0, 1, 0, 0], [0, -c, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float)
    walks = np.array([0.0, 0.0, LIFT_WALK, accel_walk])
    moving = [([0, -c, 1, 1], *accel), ([0, 1, 0, 0], *flow)]
    row[LIFT_Z:SONAR_Z] = steady_gains(up, walks, [*moving, ([1, 0, 0, 0], *baro)]).ravel()
    row[SONAR_Z:BARO_ZERO] = steady_gains(up, walks, [*moving, ([1, 0, 0, 0], *sonar)])[2]
    row[BARO_ZERO] = 1.0 / (10.0 * baro[1])  # ten seconds

    turn = np.array([[0, 1], [0, 0]], dtype=float)
    row[MAG_PSI : MAG_RATE + 1] = steady_gains(turn, np.array([tilt_walk, gyro_walk]), [([1, 0], *mag)])[0]
    row.setflags(write=False)
    return row


def steady_gains(a: Array, walks: Array, meters: list[tuple[list[float], float, float]]) -> Array:
    """Return the gain per sample of each meter in the steady state of a Kalman filter, shape (meters, states).

    A meter slower than the board counts as one of 200 Hz with as much information; its gain per sample is then that
    of the one covariance reached, P H^T / (H P H^T + sigma^2).

    Args:
        a: dx/dt = a x; walks: white noise on each state [unit/sqrt(s)].
        meters: (row of H, standard deviation of a sample, samples per second).
    """
    p = covariance(a, walks, meters)
    gains = [p @ np.array(h) / (np.array(h) @ p @ np.array(h) + sigma**2) for h, sigma, _ in meters]
    return np.array(gains)


def covariance(a: Array, walks: Array, meters: list[tuple[list[float], float, float]]) -> Array:
    """Return the steady covariance before an update, for the meters of `steady_gains`."""
    dt = 1.0 / DEVICE_RATE_HZ
    h = np.array([row for row, _, _ in meters], dtype=float)
    r = np.diag([sigma**2 * DEVICE_RATE_HZ / rate for _, sigma, rate in meters])
    # process noise over one step by Simpson's rule: exact to dt^5 for these chains
    q = np.diag(walks**2)
    half, full = expm(a * dt / 2), expm(a * dt)
    noise = dt / 6.0 * (q + 4.0 * half @ q @ half.T + full @ q @ full.T)
    return solve_discrete_are(full.T, h.T, noise, r)
