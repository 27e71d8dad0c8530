"""From a scenario to the rows of the filter before the first reading: noise, biases, gain, and initial uncertainty.

The error state is position (3), velocity (3), small rotation of the attitude (3), all in the world frame, gyroscope
bias (3) in the body frame, accelerometer bias (3) where the drone has one, then the bias of every other channel that
has one, then the clones.
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
from zsim.sensors.sensor import ErrorModel, Sensor, scaled
from zsim.sensors.sensor_catalogue import Sensors
from zsim.sensors.stock_sensors import ImuConfig
from zsim_agents.estimation.dead_reckoning import (
    ATTITUDE,
    GYRO_BIAS,
    POSITION,
    VELOCITY,
    beta_for,
    levelling_time_s,
)
from zsim_agents.estimation.filter_state import (
    BIAS,
    CHANNELS,
    CLONE,
    CLONED,
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
from zsim_agents.estimation.measurement_update import HEADING_SIGMA_RAD, SET_DOWN_SIGMA_RAD
from zsim_agents.estimation.strapdown import MANOEUVRE_M_S2, MANOEUVRE_S, ZERO

Array = NDArray[np.float64]

LINK_S = 0.4  # s, chosen: what a radio and sparse telemetry add to the latency of an external drone
LEVELLING_S = 60.0  # s; long against manoeuvres of seconds, short against the gyroscope's drift
CLONE_EVERY_S = 0.1  # s, chosen: process noise of half of it is small to any sensor's noise
CLONED_FROM = 0.01  # of a reading's variance, chosen: less process noise since its instant is neglected
COMPASS_SIGMA_RAD = 2.0 * SET_DOWN_SIGMA_RAD  # chosen: a worse reading is used, but not to start with
POSITION_SIGMA_M = 100.0  # m: a start anywhere on the field
VELOCITY_SIGMA_M_S = 1.0  # m/s: a start at rest, or in gentle flight
TILT_SIGMA_RAD = 0.05  # rad: ground that is level to 3 deg
GYRO_BIAS_MIN = math.radians(0.01)  # rad/s: bias that is allowed for where the scenario has none
GYRO_WALK_MIN = math.radians(1e-4)  # rad/s/sqrt(s), likewise
ACCEL_SIGMA_MIN = 0.02  # m/s^2 per sample: lost by sampling and the trapezoidal rule
GYRO_SIGMA_MIN = 2e-4  # rad/s per sample, likewise
JOLT_SIGMAS = 10.0  # of the accelerometer; the sum of three changes of pure noise is 3.4 on average, 1.5 in spread
JOLT_MIN_M_S2 = 1.0  # m/s^2 from one sample to the next, beyond the rotors in flight; touching the ground has tens
# A sensor refused for this long without a break is trusted again, its states losing their certainty [s].
# Height and velocity are lost quickly where they are wrong; a field may be disturbed in passing.
PATIENCE_S = {"gps": 10.0, "mag": 10.0, "baro": 5.0, "sonar": math.inf, "flow": 1.0}


class UpdateChannel(NamedTuple):
    """A quantity that an aiding sensor measures.

    Attributes:
        field: of the sensor's section in a scenario, which holds the error model.
        sigma_min: error of the model itself, so that a scenario without noise does not give infinite trust.
    """

    sensor: str
    field: str
    axes: int
    sigma_min: float

    def error(self, sensors: Sensors) -> ErrorModel:
        """Return the channel's error model in a drone's sensors."""
        return getattr(getattr(sensors, self.sensor), self.field)

    def sigma(self, sensors: Sensors) -> float:
        """Return the standard deviation of the channel's white noise per sample."""
        section: Sensor = getattr(sensors, self.sensor)
        return max(white_sigma(self.error(sensors), section.rate_hz), self.sigma_min)


HEADING_CHANNEL = UpdateChannel("mag", "field_ut", 3, 0.02)  # uT: 1 mrad of an 18 uT horizontal field
AIDING = (  # in the order of the values of a reading
    UpdateChannel("gps", "position_m", 3, 0.01),  # m: interpolation of the past state
    UpdateChannel("gps", "velocity_m_s", 3, 0.01),  # m/s, likewise
    HEADING_CHANNEL,
    UpdateChannel("baro", "altitude_m", 1, 0.005),  # m
    UpdateChannel("sonar", "range_m", 1, 0.003),  # m
    UpdateChannel("flow", "velocity_m_s", 3, 0.005),  # m/s
)


class BiasPrior(NamedTuple):
    """Equal states of bias: standard deviation at the start, random walk per sqrt(s) in the channel's unit.

    `decay_1_s` of a Gauss-Markov process is 1 over its correlation time.
    """

    axes: int
    sigma: float
    walk: float
    decay_1_s: float = 0.0


class AidingBias(NamedTuple):
    """Names a bias of an aiding channel: constant or walking, or a Gauss-Markov process."""

    channel: UpdateChannel
    correlated: bool


BiasPriors = dict[AidingBias | str, BiasPrior]
"""In the order of the error state: "gyro", "accel" if present, then aiding channels."""


def initial_rows(
    drones: Sequence[Drone], environment: Environment, estimation: Estimation, gate_s: float
) -> tuple[Rows, Array]:
    """Return the rows of drones before their first reading, and room for their estimates, (N, ESTIMATE.size)."""
    clones = [_clone_count(drone.sensors, environment, estimation, gate_s) for drone in drones]
    states = [_ErrorState(bias_priors(d.sensors, estimation), k) for d, k in zip(drones, clones, strict=True)]
    count, size = len(drones), max(each.size for each in states)
    covariance, walk, decay = np.zeros((count, size, size)), np.zeros((count, size)), np.zeros((count, size))
    for i, each in enumerate(states):
        covariance[i, : each.size, : each.size] = each.covariance
        walk[i, : each.size], decay[i, : each.size] = each.walk, each.decay
    setting = np.array([_setting(drone, environment, estimation, gate_s) for drone in drones], dtype=float)
    pairs = zip(drones, states, strict=True)
    layout = np.array([_layout(drone, environment, estimation, gate_s, each) for drone, each in pairs], dtype=np.int64)
    nominal = np.zeros((count, NOMINAL.size))
    nominal[:, NOMINAL.q_WB : NOMINAL.q_WB + 4] = LEVEL
    nominal[:, NOMINAL.f_B + 2] = setting[:, SETTING.gravity]
    nominal[:, NOMINAL.t_first_gate] = math.nan
    nominal[:, NOMINAL.refused_since : NOMINAL.refused_since + len(SENSORS)] = math.nan
    nominal[:, NOMINAL.t_sample : NOMINAL.t_sample + len(SENSORS)] = -math.inf
    rows = Rows(
        nominal=nominal,
        counts=np.zeros((count, COUNT.size), dtype=np.int64),
        covariance=covariance,
        bias=np.zeros((count, size)),
        history=np.zeros((count, layout[:, LAYOUT.history].max(), MOMENT.size)),
        clones=np.full((count, max(clones), CLONE.size), math.nan),
        setting=setting,
        layout=layout,
        walk=walk,
        decay=decay,
        limits=innovation_limits(estimation.gate_probability),
        joint=np.zeros((0, 0)),
        sighted=np.zeros((0, 0)),
    )
    return rows, np.zeros((count, ESTIMATE.size))


class _ErrorState:
    """Layout and initial covariance of an error state.

    Attributes:
        own: states before the clones.
        size: n, clones included.
        first: first state of each bias.
        walk: density of each bias' random walk [unit^2/s], (n,).
        decay: of each bias [1/s], (n,).
        covariance: at the start, (n, n).
    """

    def __init__(self, priors: BiasPriors, clones: int) -> None:
        self.clones = clones
        self.first: dict[AidingBias | str, int] = {}
        self.own = GYRO_BIAS
        for name, prior in priors.items():
            self.first[name] = self.own
            self.own += prior.axes
        self.size = self.own + clones * CLONED
        variance, self.walk, self.decay = np.zeros(self.size), np.zeros(self.size), np.zeros(self.size)
        variance[POSITION : POSITION + 3] = POSITION_SIGMA_M**2
        variance[VELOCITY : VELOCITY + 3] = VELOCITY_SIGMA_M_S**2
        variance[ATTITUDE : ATTITUDE + 3] = TILT_SIGMA_RAD**2, TILT_SIGMA_RAD**2, HEADING_SIGMA_RAD**2
        for name, prior in priors.items():
            span = slice(self.first[name], self.first[name] + prior.axes)
            variance[span], self.walk[span], self.decay[span] = prior.sigma**2, prior.walk**2, prior.decay_1_s
        self.covariance = np.diag(variance)


def bias_priors(sensors: Sensors, estimation: Estimation) -> BiasPriors:
    """Return the biases that the filter estimates.

    A Gauss-Markov process of the IMU is combined with its other biases as a random walk, which gains as much over the
    correlation time and goes on growing: never overconfident. That of an aiding channel is a state by itself.
    """
    accel, gyro = sensors.imu.accel_m_s2, scaled(sensors.imu.gyro_deg_s, math.radians(1.0))
    sigma, walk = _as_walk(gyro)
    priors: BiasPriors = {"gyro": BiasPrior(3, max(sigma, GYRO_BIAS_MIN), max(walk, GYRO_WALK_MIN))}
    if _has_bias(accel) or accel.correlated_sigma:
        priors["accel"] = BiasPrior(3, *_as_walk(accel))
    used = {"mag": estimation.magnetometer, "flow": estimation.flow}
    for channel in AIDING:
        if not used.get(channel.sensor, True):
            continue
        error = channel.error(sensors)
        if _has_bias(error):
            priors[AidingBias(channel, False)] = BiasPrior(channel.axes, error.bias, error.bias_walk)
        if error.correlated_sigma:
            priors[AidingBias(channel, True)] = BiasPrior(
                channel.axes, error.correlated_sigma, _gauss_markov_walk(error), 1.0 / error.correlation_time_s
            )
    return priors


def _has_bias(error: ErrorModel) -> bool:
    return error.bias > 0.0 or error.bias_walk > 0.0


def _as_walk(error: ErrorModel) -> tuple[float, float]:
    """Return initial standard deviation and random walk of all biases of an IMU's channel together."""
    if not error.correlated_sigma:
        return error.bias, error.bias_walk
    return math.hypot(error.bias, error.correlated_sigma), math.hypot(error.bias_walk, _gauss_markov_walk(error))


def _gauss_markov_walk(error: ErrorModel) -> float:
    """Return the driving noise of a channel's Gauss-Markov process, per sqrt(s): sigma sqrt(2/T)."""
    sigma = error.correlated_sigma
    return sigma * math.sqrt(2.0 / error.correlation_time_s) if sigma else 0.0


def innovation_limits(gate_probability: float) -> Array:
    """Return the limits of y^T S^-1 y by the number of rows, (DOF_MAX + 1,)."""
    return np.append(0.0, chdtri(np.arange(1, DOF_MAX + 1), 1.0 - gate_probability))


def white_sigma(error: ErrorModel, rate_hz: float) -> float:
    """Return the standard deviation of the white part per sample, in the channel's unit.

    Noise, density * sqrt(rate) and the converter's rounding (uniform: quantum^2/12) in quadrature.
    """
    noise = 0.0 if error.correlation_time_s else error.noise
    return math.sqrt(noise**2 + error.density**2 * rate_hz + error.quantum**2 / 12.0)


def accel_sigma(imu: ImuConfig) -> float:
    """Return the accelerometer's white noise per sample [m/s^2]."""
    return max(white_sigma(imu.accel_m_s2, imu.rate_hz), ACCEL_SIGMA_MIN)


def gyro_sigma(imu: ImuConfig) -> float:
    """Return the gyroscope's white noise per sample [rad/s]."""
    return max(math.radians(white_sigma(imu.gyro_deg_s, imu.rate_hz)), GYRO_SIGMA_MIN)


def madgwick_beta(estimation: Estimation, imu: ImuConfig, gravity: float) -> float:
    """Return the gain [rad/s]: the scenario's, or the one that levels in `LEVELLING_S` under the IMU's noise."""
    if estimation.madgwick_beta is not None:
        return estimation.madgwick_beta
    return beta_for(LEVELLING_S, accel_sigma(imu) / gravity)


def tilt_density(beta: float, direction_sigma: float, gravity: float, period_s: float) -> float:
    """Return what Madgwick's accelerometer step adds to the tilt's error, per axis [rad^2/s].

    Noise turns each step of 2 beta dt to a random side (half its square per axis). An acceleration a is taken for a
    tilt a/g, towards which the attitude is pulled with the levelling time, at most with 2 beta; it is modelled as white
    noise of the same power at low frequency.
    """
    if beta == 0.0:
        return 0.0
    pull = min(MANOEUVRE_M_S2 / gravity / levelling_time_s(beta, direction_sigma), 2.0 * beta)
    return 2.0 * beta * beta * period_s + pull * pull * 2.0 * MANOEUVRE_S


def _clone_count(sensors: Sensors, environment: Environment, estimation: Estimation, gate_s: float) -> int:
    """Return how many clones late readings need; 0 where process noise is small compared to their noise."""
    longest_s = 0.0
    for channel in AIDING:
        section: Sensor = getattr(sensors, channel.sensor)
        late_s = (section.latency_ms - sensors.imu.latency_ms) * 1e-3
        is_used = channel.sensor != "mag" and (channel.sensor != "flow" or estimation.flow)
        if late_s <= gate_s or not is_used:
            continue
        position, velocity = _gained_variance(sensors.imu, environment, estimation, late_s)
        gained = velocity if channel.field == "velocity_m_s" else position
        if gained > CLONED_FROM * channel.sigma(sensors) ** 2:
            longest_s = max(longest_s, late_s + gate_s)
    return math.ceil(longest_s / CLONE_EVERY_S) + 1 if longest_s else 0


def _gained_variance(
    imu: ImuConfig, environment: Environment, estimation: Estimation, span_s: float
) -> tuple[float, float]:
    """Return what process noise adds to position [m^2] and velocity [m^2/s^2], per horizontal axis, over a time.

    White acceleration and a random walk of the tilt, integrated (Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation
    with Applications to Tracking and Navigation", 2001, section 6.2).
    """
    gravity = environment.gravity_m_s2
    beta, direction_sigma = madgwick_beta(estimation, imu, gravity), accel_sigma(imu) / gravity
    white = accel_sigma(imu) ** 2 / imu.rate_hz  # m^2/s^3
    tilt = gyro_sigma(imu) ** 2 / imu.rate_hz + tilt_density(beta, direction_sigma, gravity, 1.0 / imu.rate_hz)
    walk = gravity * gravity * tilt  # m^2/s^5
    return white * span_s**3 / 3.0 + walk * span_s**5 / 20.0, white * span_s + walk * span_s**3 / 3.0


def _age_max_s(drone: Drone, gate_s: float) -> float:
    """Return the oldest age [s] at which a reading of a drone can be used."""
    sections: list[Sensor] = [getattr(drone.sensors, name) for name in SENSORS]
    latency_s = max(section.latency_ms for section in sections) * 1e-3
    link_s = LINK_S if drone.is_external else 0.0
    return 2.0 * latency_s + 5.0 * gate_s + link_s


def _has_compass(drone: Drone, environment: Environment, estimation: Estimation) -> bool:
    """Tell whether one reading of the magnetometer gives a heading as good as setting the drone down by eye does."""
    horizontal_ut, error = math.hypot(*environment.magnetic_field_ut[:2]), drone.sensors.mag.field_ut
    sideways_ut = math.hypot(HEADING_CHANNEL.sigma(drone.sensors), math.hypot(error.bias, error.correlated_sigma))
    return estimation.magnetometer and sideways_ut <= COMPASS_SIGMA_RAD * horizontal_ut


def _setting(drone: Drone, environment: Environment, estimation: Estimation, gate_s: float) -> list[float]:
    """Return the columns SETTING of a drone."""
    imu, gravity = drone.sensors.imu, environment.gravity_m_s2
    beta, direction_sigma = madgwick_beta(estimation, imu, gravity), accel_sigma(imu) / gravity
    row = [
        gravity,
        beta,
        1.0 / imu.rate_hz,
        imu.latency_ms * 1e-3 + gate_s + 5.0 * (1.0 / imu.rate_hz),
        max(JOLT_SIGMAS * accel_sigma(imu), JOLT_MIN_M_S2),
        _age_max_s(drone, gate_s),
        math.radians(drone.yaw_deg),
        accel_sigma(imu) ** 2,
        gyro_sigma(imu) ** 2,
        tilt_density(beta, direction_sigma, gravity, 1.0 / imu.rate_hz),
        levelling_time_s(beta, direction_sigma),
        CLONE_EVERY_S,
        *environment.magnetic_field_ut,
    ]
    for name in SENSORS:
        row += _sensor_setting(name, drone.sensors)
    assert len(row) == SETTING.size
    return row


def _sensor_setting(name: str, sensors: Sensors) -> list[float]:
    """Return the columns SENSOR of one sensor."""
    section: Sensor = getattr(sensors, name)
    variance: list[float] = []
    correlated = 0.0
    for channel in AIDING:
        if channel.sensor == name:
            variance += [channel.sigma(sensors) ** 2] * channel.axes
            if channel.field == "position_m":
                correlated = channel.error(sensors).correlated_sigma
    variance += [0.0] * (VALUES_MAX - len(variance))
    R_BS = np.array(matrix_from_rpy(*map(math.radians, section.mount.rpy_deg)))
    mount, patience_s = (*section.mount.position_m, *R_BS.flat, *-R_BS[:, 2]), PATIENCE_S.get(name, math.inf)
    row = [*variance, *mount, patience_s, correlated**2]
    assert len(row) == SENSOR.size
    return row


def _layout(
    drone: Drone, environment: Environment, estimation: Estimation, gate_s: float, states: _ErrorState
) -> list[int]:
    """Return the columns LAYOUT of a drone."""
    mount = drone.sensors.imu.mount
    entries = int(_age_max_s(drone, gate_s) / gate_s) + 3
    displaced = mount.rpy_deg != ZERO or mount.position_m != ZERO
    aiding = any(isinstance(name, AidingBias) for name in states.first) or states.clones > 0
    own = (displaced, "accel" in states.first, aiding, states.decay.any())
    flags = (*own, estimation.magnetometer, _has_compass(drone, environment, estimation), estimation.flow)
    row = [states.size, states.clones, states.own, entries, *map(int, flags)]
    for name in SENSORS:
        row += _bias_places(name, states)
    assert len(row) == LAYOUT.size
    return row


def _bias_places(sensor: str, states: _ErrorState) -> list[int]:
    """Return the columns BIAS of every channel of a sensor."""
    places: list[int] = []
    row = 0
    for channel in AIDING:
        if channel.sensor == sensor:
            for correlated in (False, True):
                name = AidingBias(channel, correlated)
                if name in states.first:
                    places += [states.first[name], row, channel.axes]
            row += channel.axes
    return places + [-1, 0, 0] * (CHANNELS - len(places) // BIAS.size)
