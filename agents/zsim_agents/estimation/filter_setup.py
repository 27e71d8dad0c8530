"""From a scenario to the rows of the filter before the first reading: noise, biases, gain, and how wide a start is.

The error state is position (3), velocity (3), small rotation of the attitude (3), all in the world frame, gyroscope
bias (3) in the body frame, accelerometer bias (3) where the drone has one, then the bias of every other channel that
has one.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from zsim.contract.keys import SENSORS
from zsim.math.rotation import LEVEL, matrix_from_rpy
from zsim.scenario.scenario import Drone, Environment, Estimation
from zsim.sensors.imu import BOARD_RATE_HZ, ImuConfig
from zsim.sensors.sensor import ErrorModel, Sensor
from zsim.sensors.sensor_catalogue import Sensors
from zsim_agents.estimation.dead_reckoning import ATTITUDE, GYRO_BIAS, POSITION, VELOCITY
from zsim_agents.estimation.filter_state import (
    BIAS,
    CHANNELS,
    COUNT,
    ESTIMATE,
    LAYOUT,
    MOMENT,
    NOMINAL,
    SENSOR,
    SETTING,
    VALUES_MAX,
    Rows,
)
from zsim_agents.estimation.kalman_update import DOF_MAX
from zsim_agents.estimation.madgwick import beta_for, levelling_time_s
from zsim_agents.estimation.measurement_update import HEADING_SIGMA_RAD
from zsim_agents.estimation.strapdown import MANOEUVRE_M_S2, MANOEUVRE_S, ZERO

Array = NDArray[np.float64]

LINK_S = (
    0.4  # s, chosen: what a radio, and telemetry that is sent now and then, add to the latency of an external drone
)
LEVELLING_S = 60.0  # s; long against manoeuvres of seconds, short against the gyroscope's drift
POSITION_SIGMA_M = 100.0  # m: a start anywhere on the field
VELOCITY_SIGMA_M_S = 1.0  # m/s: a start at rest, or in gentle flight
TILT_SIGMA_RAD = 0.05  # rad: ground that is level to 3 deg
GYRO_BIAS_MIN = math.radians(0.01)  # rad/s: bias that is allowed for where the scenario has none
GYRO_WALK_MIN = math.radians(1e-4)  # rad/s/sqrt(s), likewise
ACCEL_SIGMA_MIN = 0.02  # m/s^2 per sample: what sampling and the trapezoidal rule lose
GYRO_SIGMA_MIN = 2e-4  # rad/s per sample, likewise
JOLT_SIGMAS = 10.0  # of the accelerometer; the sum of three changes of pure noise is 3.4 on average, 1.5 in spread
JOLT_MIN_M_S2 = 1.0  # m/s^2 from one sample to the next, beyond the rotors in flight; touching the ground has tens
# A sensor refused for this long without a break is trusted again, its states losing their certainty [s].
# Height and velocity are lost quickly where they are wrong; a field may be disturbed in passing.
PATIENCE_S = {"gps": 10.0, "mag": 10.0, "baro": 5.0, "sonar": math.inf, "flow": 1.0}


class UpdateChannel(NamedTuple):
    """A quantity that an aiding sensor measures."""

    sensor: str
    field: str
    """Of the sensor's section in a scenario; it holds the error model."""
    axes: int
    sigma_min: float
    """Error of the model itself, so that a scenario without noise does not ask for infinite trust."""


AIDING = (  # in the order of the values of a reading
    UpdateChannel("gps", "position_m", 3, 0.01),  # m: interpolation of the past state
    UpdateChannel("gps", "velocity_m_s", 3, 0.01),  # m/s, likewise
    UpdateChannel("mag", "field_ut", 3, 0.02),  # uT: 1 mrad of an 18 uT horizontal field
    UpdateChannel("baro", "altitude_m", 1, 0.005),  # m
    UpdateChannel("sonar", "range_m", 1, 0.003),  # m
    UpdateChannel("flow", "velocity_m_s", 3, 0.005),  # m/s
)


class BiasPrior(NamedTuple):
    """Equal states of bias."""

    axes: int
    sigma: float
    """Standard deviation at the start, in the channel's unit."""
    walk: float
    """Random walk, per sqrt(s)."""


BiasPriors = dict[UpdateChannel | str, BiasPrior]
"""In the order of the error state: "gyro", "accel" if present, then aiding channels."""


def white_sigma(error: ErrorModel, rate_hz: float) -> float:
    """Return the standard deviation of the white part per sample, in the channel's unit.

    Noise, density * sqrt(rate) and the converter's rounding (uniform: quantum^2/12) in quadrature.
    """
    return math.sqrt(error.noise**2 + error.density**2 * rate_hz + error.quantum**2 / 12.0)


def has_bias(error: ErrorModel) -> bool:
    """Whether a filter must carry the channel's bias as a state."""
    return error.bias > 0.0 or error.bias_walk > 0.0


def accel_sigma(imu: ImuConfig) -> float:
    """Return the accelerometer's white noise per sample [m/s^2]."""
    return max(white_sigma(imu.accel_m_s2, BOARD_RATE_HZ), ACCEL_SIGMA_MIN)


def madgwick_beta(estimation: Estimation, imu: ImuConfig, gravity: float) -> float:
    """Return the gain [rad/s]: the scenario's, or what levels in `LEVELLING_S` under the IMU's noise."""
    if estimation.madgwick_beta is not None:
        return estimation.madgwick_beta
    return beta_for(LEVELLING_S, accel_sigma(imu) / gravity)


def tilt_density(beta: float, direction_sigma: float, gravity: float, period_s: float) -> float:
    """Return what Madgwick's accelerometer step adds to the tilt's error, per axis [rad^2/s].

    Noise turns each step of 2 beta dt to a random side (half its square per axis). An acceleration a is taken
    for a tilt a/g, towards which the attitude is pulled with the levelling time, at most with 2 beta; white
    noise of the same power at low frequency stands for it.
    """
    if beta == 0.0:
        return 0.0
    pull = min(MANOEUVRE_M_S2 / gravity / levelling_time_s(beta, direction_sigma), 2.0 * beta)
    return 2.0 * beta * beta * period_s + pull * pull * 2.0 * MANOEUVRE_S


def bias_priors(sensors: Sensors, estimation: Estimation) -> BiasPriors:
    """Return the biases that the filter estimates."""
    accel, gyro = sensors.imu.accel_m_s2, sensors.imu.gyro_deg_s
    sigma = max(math.radians(gyro.bias), GYRO_BIAS_MIN)
    priors: BiasPriors = {"gyro": BiasPrior(3, sigma, max(math.radians(gyro.bias_walk), GYRO_WALK_MIN))}
    if has_bias(accel):
        priors["accel"] = BiasPrior(3, accel.bias, accel.bias_walk)
    used = {"mag": estimation.magnetometer, "flow": estimation.flow}
    for channel in AIDING:
        error = _error_model(sensors, channel)
        if has_bias(error) and used.get(channel.sensor, True):
            priors[channel] = BiasPrior(channel.axes, error.bias, error.bias_walk)
    return priors


class ErrorState:
    """Places and beginning of an error state.

    Attributes:
        size: n.
        first: first state of each bias.
        walk: density of each bias' random walk [unit^2/s], (n,).
        covariance: at the start, (n, n).
    """

    def __init__(self, priors: BiasPriors) -> None:
        self.first: dict[UpdateChannel | str, int] = {}
        self.size = GYRO_BIAS
        for name, prior in priors.items():
            self.first[name] = self.size
            self.size += prior.axes
        variance, self.walk = np.zeros(self.size), np.zeros(self.size)
        variance[POSITION : POSITION + 3] = POSITION_SIGMA_M**2
        variance[VELOCITY : VELOCITY + 3] = VELOCITY_SIGMA_M_S**2
        variance[ATTITUDE : ATTITUDE + 3] = TILT_SIGMA_RAD**2, TILT_SIGMA_RAD**2, HEADING_SIGMA_RAD**2
        for name, prior in priors.items():
            span = slice(self.first[name], self.first[name] + prior.axes)
            variance[span], self.walk[span] = prior.sigma**2, prior.walk**2
        self.covariance = np.diag(variance)


def initial_rows(
    drones: Sequence[Drone], environment: Environment, estimation: Estimation, gate_s: float
) -> tuple[Rows, Array]:
    """Return the rows of drones before their first reading, and room for their estimates, (N, ESTIMATE.size).

    Args:
        drones: their mounts and error models are what the filter assumes.
        environment: gravity and magnetic field.
        estimation: settings.
        gate_s: interval of the gates [s].
    """
    states = [ErrorState(bias_priors(drone.sensors, estimation)) for drone in drones]
    count, size = len(drones), max(each.size for each in states)
    covariance, walk = np.zeros((count, size, size)), np.zeros((count, size))
    for i, each in enumerate(states):
        covariance[i, : each.size, : each.size], walk[i, : each.size] = each.covariance, each.walk
    setting = np.array([_setting(drone, environment, estimation, gate_s) for drone in drones], dtype=float)
    pairs = zip(drones, states, strict=True)
    layout = np.array([_layout(drone, estimation, gate_s, each) for drone, each in pairs], dtype=np.int64)
    rows = Rows(
        nominal=_nominal(setting),
        counts=np.zeros((count, COUNT.size), dtype=np.int64),
        covariance=covariance,
        bias=np.zeros((count, size)),
        history=np.zeros((count, layout[:, LAYOUT.history].max(), MOMENT.size)),
        setting=setting,
        layout=layout,
        walk=walk,
        limits=innovation_limits(estimation.gate_probability),
        joint=np.zeros((0, 0)),
        sighted=np.zeros((0, 0)),
    )
    return rows, np.zeros((count, ESTIMATE.size))


def innovation_limits(gate_probability: float) -> Array:
    """Return how large y^T S^-1 y may be, by the number of rows, (DOF_MAX + 1,)."""
    return np.append(0.0, chdtri(np.arange(1, DOF_MAX + 1), 1.0 - gate_probability))


def age_max_s(drone: Drone, gate_s: float) -> float:
    """Return the oldest age [s] at which a reading of a drone can be used."""
    latency_s = max(_section(drone.sensors, name).latency_ms for name in SENSORS) * 1e-3
    link_s = LINK_S if drone.is_external else 0.0
    return 2.0 * latency_s + 5.0 * gate_s + link_s


def _section(sensors: Sensors, name: str) -> Sensor:
    return getattr(sensors, name)


def _error_model(sensors: Sensors, channel: UpdateChannel) -> ErrorModel:
    return getattr(_section(sensors, channel.sensor), channel.field)


def _setting(drone: Drone, environment: Environment, estimation: Estimation, gate_s: float) -> list[float]:
    """Return the columns SETTING of a drone."""
    imu, gravity = drone.sensors.imu, environment.gravity_m_s2
    beta, direction_sigma = madgwick_beta(estimation, imu, gravity), accel_sigma(imu) / gravity
    gyro_sigma = max(math.radians(white_sigma(imu.gyro_deg_s, BOARD_RATE_HZ)), GYRO_SIGMA_MIN)
    row = [
        gravity,
        beta,
        1.0 / imu.rate_hz,
        imu.latency_ms * 1e-3 + gate_s + 5.0 * (1.0 / imu.rate_hz),
        max(JOLT_SIGMAS * accel_sigma(imu), JOLT_MIN_M_S2),
        age_max_s(drone, gate_s),
        math.radians(drone.yaw_deg),
        accel_sigma(imu) ** 2,
        gyro_sigma**2,
        tilt_density(beta, direction_sigma, gravity, 1.0 / imu.rate_hz),
        levelling_time_s(beta, direction_sigma),
        *environment.magnetic_field_ut,
    ]
    for name in SENSORS:
        row += _sensor_setting(name, drone.sensors)
    assert len(row) == SETTING.size
    return row


def _sensor_setting(name: str, sensors: Sensors) -> list[float]:
    """Return the columns SENSOR of one sensor."""
    section = _section(sensors, name)
    variance: list[float] = []
    for channel in AIDING:
        if channel.sensor == name:
            sigma = max(white_sigma(_error_model(sensors, channel), section.rate_hz), channel.sigma_min)
            variance += [sigma**2] * channel.axes
    variance += [0.0] * (VALUES_MAX - len(variance))
    R_BS = np.array(matrix_from_rpy(*map(math.radians, section.mount.rpy_deg)))
    row = [*variance, *section.mount.position_m, *R_BS.flat, *-R_BS[:, 2], PATIENCE_S.get(name, math.inf)]
    assert len(row) == SENSOR.size
    return row


def _layout(drone: Drone, estimation: Estimation, gate_s: float, states: ErrorState) -> list[int]:
    """Return the columns LAYOUT of a drone."""
    mount = drone.sensors.imu.mount
    entries = int(age_max_s(drone, gate_s) / gate_s) + 3
    displaced = mount.rpy_deg != ZERO or mount.position_m != ZERO
    aiding = any(isinstance(name, UpdateChannel) for name in states.first)
    flags = (displaced, "accel" in states.first, aiding, estimation.magnetometer, estimation.flow)
    row = [states.size, entries, *map(int, flags)]
    for name in SENSORS:
        row += _bias_places(name, states)
    assert len(row) == LAYOUT.size
    return row


def _bias_places(sensor: str, states: ErrorState) -> list[int]:
    """Return the columns BIAS of every channel of a sensor."""
    places: list[int] = []
    row = 0
    for channel in AIDING:
        if channel.sensor == sensor:
            if channel in states.first:
                places += [states.first[channel], row, channel.axes]
            row += channel.axes
    return places + [-1, 0, 0] * (CHANNELS - len(places) // BIAS.size)


def _nominal(setting: Array) -> Array:
    """Return the columns NOMINAL before the first reading, (N, NOMINAL.size)."""
    row = np.zeros((len(setting), NOMINAL.size))
    row[:, NOMINAL.q_WB : NOMINAL.q_WB + 4] = LEVEL
    row[:, NOMINAL.f_B + 2] = setting[:, SETTING.gravity]
    row[:, NOMINAL.t_first_gate] = math.nan
    row[:, NOMINAL.refused_since : NOMINAL.refused_since + len(SENSORS)] = math.nan
    row[:, NOMINAL.t_sample : NOMINAL.t_sample + len(SENSORS)] = -math.inf
    return row
