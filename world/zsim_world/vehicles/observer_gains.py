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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from zsim.math.columns import Field, columns
from zsim.scenario.scenario import Drone, Environment
from zsim.sensors.imu import BOARD_RATE_HZ
from zsim.sensors.sensor import ErrorModel, Sensor, noise_sigma, scaled
from zsim.vehicles.vehicle import Vehicle
from zsim_world.physics.fleet_arrays import REFERENCE_DENSITY_KG_M3
from zsim_world.sensors.sensor_set import heading_sigma

Array = NDArray[np.float64]

DEG = math.pi / 180.0  # rad

# Least and largest standard deviation of a sample that the design counts with: none is trusted blindly, and beyond the
# largest a meter is as good as none
SIGMAS = {
    "accel": (0.02, 50.0),  # m/s^2
    "gyro": (1e-4, 1.0),  # rad/s
    "flow": (0.02, 10.0),  # m/s
    "baro": (0.02, 100.0),  # m
    "sonar": (0.01, 10.0),  # m
    "mag": (0.01, 3.0),  # rad
}
DOUBLINGS = 24  # 2^24 steps of 5 ms are a day
SAMPLE_RATE_MIN_HZ = 0.1  # Hz, a meter is not counted with less often

GAIN = columns(  # innovation -> state, in the units of the states over that of the innovation
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
        Field("lift_z", "", 4),  # accelerometer, vertical: height, climb, disturbance, bias
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
    """What the gains of one drone follow from."""

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
    """Return the gains of one drone, shape (GAIN.size,)."""
    s, walks = drone.sensors, vehicle.firmware
    field = math.hypot(*environment.magnetic_field_ut[:2])
    gyro = _sigma(scaled(s.imu.gyro_deg_s, DEG), s.imu.rate_hz, "gyro")
    design = ObserverDesign(
        drag_1_s=drone.drag_n_s_m * environment.air_density_kg_m3 / REFERENCE_DENSITY_KG_M3 / drone.mass_kg,
        gravity_m_s2=environment.gravity_m_s2,
        accel=(_sigma(s.imu.accel_m_s2, s.imu.rate_hz, "accel"), BOARD_RATE_HZ),
        accel_walk=max(s.imu.accel_m_s2.bias_walk, walks.lift_bias_walk),
        tilt_walk=math.hypot(gyro / math.sqrt(BOARD_RATE_HZ), walks.tilt_walk),
        gyro_walk=max(scaled(s.imu.gyro_deg_s, DEG).bias_walk, walks.bias_walk),
        flow=(_sigma(s.flow.velocity_m_s, s.flow.rate_hz, "flow"), sample_rate(s.flow)),
        baro=(_sigma(s.baro.altitude_m, s.baro.rate_hz, "baro"), sample_rate(s.baro)),
        sonar=(_sigma(s.sonar.range_m, s.sonar.rate_hz, "sonar"), sample_rate(s.sonar)),
        mag=(_within(heading_sigma(s.mag, field), "mag"), sample_rate(s.mag)),
        disturbance_walk=walks.disturbance_walk,
        lift_walk=walks.lift_walk,
    )
    return _gains(design)


def sample_rate(sensor: Sensor) -> float:
    """Return the rate [Hz] at which samples really come."""
    return max(sensor.rate_hz * (1.0 - sensor.dropout), SAMPLE_RATE_MIN_HZ)


def _sigma(model: ErrorModel, rate_hz: float, name: str) -> float:
    return _within(math.hypot(noise_sigma(model, rate_hz), model.quantum / math.sqrt(12.0)), name)


def _within(sigma: float, name: str) -> float:
    least, most = SIGMAS[name]
    return min(max(sigma, least), most)


@lru_cache(maxsize=256)
def _gains(d: ObserverDesign) -> Array:
    row = np.empty(GAIN.size)
    row[GAIN.accel_v : GAIN.lift_z] = _across(d).ravel()
    row[GAIN.lift_z : GAIN.sonar_z] = _upwards(d, d.baro).ravel()
    row[GAIN.sonar_z : GAIN.baro_zero] = _upwards(d, d.sonar)[2]
    row[GAIN.baro_zero] = 1.0 / (10.0 * d.baro[1])  # ten seconds
    row[GAIN.mag_psi : GAIN.mag_rate + 1] = _turning(d)[0]
    row = np.array([float(f"{x:.9g}") for x in row])  # nine digits: the same bits whatever the BLAS
    row.setflags(write=False)
    return row


def _across(d: ObserverDesign) -> Array:
    c = d.drag_1_s
    a = np.array([[-c, d.gravity_m_s2, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float)
    walks = np.array([0.0, d.tilt_walk, d.gyro_walk, d.disturbance_walk])
    return steady_gains(a, walks, [([-c, 0, 0, 1], *d.accel), ([1, 0, 0, 0], *d.flow)])


def _upwards(d: ObserverDesign, height: Meter) -> Array:
    """Return the gains of accelerometer, flow and a meter of the height."""
    c = d.drag_1_s
    a = np.array([[0, 1, 0, 0], [0, -c, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float)
    walks = np.array([0.0, 0.0, d.lift_walk, d.accel_walk])
    moving = [([0, -c, 1, 1], *d.accel), ([0, 1, 0, 0], *d.flow)]
    return steady_gains(a, walks, [*moving, ([1, 0, 0, 0], *height)])


def _turning(d: ObserverDesign) -> Array:
    a = np.array([[0, 1], [0, 0]], dtype=float)
    return steady_gains(a, np.array([d.tilt_walk, d.gyro_walk]), [([1, 0], *d.mag)])


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
    dt = 1.0 / BOARD_RATE_HZ
    h = np.array([row for row, _, _ in meters], dtype=float)
    r = np.diag([sigma**2 * BOARD_RATE_HZ / rate for _, sigma, rate in meters])
    # process noise over one step by Simpson's rule: exact to dt^5 for these chains
    q = np.diag(walks**2)
    half, full = (np.asarray(expm(a * s), dtype=np.float64) for s in (dt / 2, dt))
    noise = dt / 6.0 * (q + 4.0 * half @ q @ half.T + full @ q @ full.T)
    return _riccati(full, h.T @ np.linalg.solve(r, h), noise)


def _riccati(f: Array, information: Array, noise: Array) -> Array:
    """Return the steady prior covariance of x' = f x + noise, seen with `information` = H^T R^-1 H in every step.

    Structure-preserving doubling, 2^k steps after k rounds (Chu, Fan, Lin and Wang, Int. J. Control 77 (2004) 767-788):
    scipy's solver fails on chains whose meters differ by ten decades.
    """
    a, g, p = f.T, information, noise
    for _ in range(DOUBLINGS):
        back = np.linalg.solve(np.eye(len(a)) + g @ p, np.hstack([a, g]))
        turned, spread = back[:, : len(a)], back[:, len(a) :]
        g, p, a = g + a @ spread @ a.T, p + a.T @ p @ turned, a @ turned
    return 0.5 * (p + p.T)
