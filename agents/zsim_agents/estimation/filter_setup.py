"""The initial rows of the filter from a scenario: noise, biases, gain and initial uncertainty.

The error state consists of position (3), velocity (3) and a small rotation of the attitude (3), all in the world frame;
gyroscope bias (3) and, if estimated, accelerometer bias (3), both in the body frame; the biases of other channels; and
the clones.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.keys import SENSORS
from zsim.math import elementary as el
from zsim.math.randomness import chi_square_quantile
from zsim.math.rotation import LEVEL, matrix_from_rpy
from zsim.scenario.scenario import Drone, Environment, Estimation
from zsim.scenario.surroundings import Surroundings
from zsim.sensors.sensor import ErrorModel, Sensor, scaled
from zsim.sensors.sensor_catalogue import Sensors
from zsim.sensors.stock_sensors import ImuConfig
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
    SETTING,
    VALUES_MAX,
    Rows,
)
from zsim_agents.estimation.kalman_update import DOF_MAX
from zsim_agents.estimation.measurement_update import HEADING_SIGMA_RAD, SET_DOWN_SIGMA_RAD
from zsim_agents.estimation.strapdown import (
    ATTITUDE,
    GYRO_BIAS,
    MANOEUVRE_M_S2,
    MANOEUVRE_S,
    POSITION,
    VELOCITY,
    ZERO,
    beta_for,
    levelling_time_s,
)

Array = NDArray[np.float64]

LINK_LATENCY_S = 0.4  # s; design choice: latency that a radio and sparse telemetry add for an external drone
LEVELLING_S = 60.0  # s; long compared with manoeuvres of seconds, short compared with the drift of the gyroscope
CLONE_EVERY_S = 0.1  # s; design choice: process noise over half of it is small compared with any sensor's noise
CLONE_SHARE_MIN = 0.01  # of a reading's variance; design choice: less process noise since its sampling is negligible
COMPASS_SIGMA_RAD = 2.0 * SET_DOWN_SIGMA_RAD  # rad; design choice: noisier readings do not initialise the heading
ROOF_DISTANCE_MAX_M = 0.01  # m; design choice: a drone that starts this close to an obstacle stands on it
POSITION_SIGMA_M = 100.0  # m: a start anywhere on the field
VELOCITY_SIGMA_M_S = 1.0  # m/s: a start at rest or in gentle flight
TILT_SIGMA_RAD = 0.05  # rad: ground that is level to within 3 deg
GYRO_BIAS_MIN = math.radians(0.01)  # rad/s: minimum of the bias's assumed standard deviation
GYRO_WALK_MIN = math.radians(1e-4)  # rad/s/sqrt(s): minimum of the assumed random walk
ACCEL_SIGMA_MIN = 0.02  # m/s^2 per sample: error of sampling and of the trapezoidal rule
GYRO_SIGMA_MIN = 2e-4  # rad/s per sample: the same error for the gyroscope
# Limit of the summed changes of three axes, in sigmas of the accelerometer: noise gives a mean of 3.4, sigma 1.5
JOLT_SIGMAS = 10.0
JOLT_MIN_M_S2 = 1.0  # m/s^2 between samples: above rotor vibration in flight; ground contact causes tens of m/s^2
# Time for which a sensor is refused continuously before the variances of the states it observes are increased, so that
# it is trusted again [s]. Wrong heights and velocities diverge quickly; a magnetic field may be disturbed temporarily.
PATIENCE_S = {"gps": 10.0, "mag": 10.0, "baro": 5.0, "sonar": math.inf, "flow": 1.0}


class UpdateChannel(NamedTuple):
    """A quantity that an aiding sensor measures.

    Attributes:
        field: field of the sensor's section of a scenario that contains the quantity's error model.
        sigma_min: error of the measurement model, so that a scenario without noise does not give infinite confidence.
    """

    sensor: str
    field: str
    axes: int
    sigma_min: float

    def error(self, sensors: Sensors) -> ErrorModel:
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


class Bias(NamedTuple):
    """Bias states: initial standard deviation, and random walk per sqrt(s), in the channel's unit.

    `decay_1_s` is the inverse of a Gauss-Markov process's correlation time; 0 for other biases.
    """

    axes: int
    sigma: float
    walk: float
    decay_1_s: float = 0.0


def initial_rows(
    drones: Sequence[Drone], environment: Environment, estimation: Estimation, gate_s: float
) -> tuple[Rows, Array]:
    """Return the initial rows of drones, and an array for their estimates, (N, ESTIMATE.size)."""
    setups = [DroneSetup(drone, environment, estimation, gate_s) for drone in drones]
    count, size = len(drones), max(each.size for each in setups)
    covariance, walk, decay = np.zeros((count, size, size)), np.zeros((count, size)), np.zeros((count, size))
    for i, each in enumerate(setups):
        covariance[i, : each.size, : each.size] = np.diag(each.variance)
        walk[i, : each.size], decay[i, : each.size] = each.walk, each.decay
    setting = np.array([each.setting() for each in setups], dtype=float)
    layout = np.array([each.layout() for each in setups], dtype=np.int64)
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
        clones=np.full((count, max(each.clones for each in setups), CLONE.size), math.nan),
        setting=setting,
        layout=layout,
        walk=walk,
        decay=decay,
        limits=innovation_limits(estimation.gate_probability),
        joint=np.zeros((0, 0)),
        sighted=np.zeros((0, 0)),
    )
    return rows, np.zeros((count, ESTIMATE.size))


class DroneSetup:
    """The parameters of one drone's rows, from the sections of a scenario.

    Attributes:
        clones: number of clones that late readings need; 0 if their noise far exceeds the process noise.
        biases: estimated biases in the order of the error state: "gyro"; "accel" if estimated; then those of aiding
            channels, named (channel, whether the bias is a Gauss-Markov process).
        first: index of each bias's first state.
        own: number of states before the clones.
        size: number of all states, n.
        variance: initial variances, (n,).
        walk, decay: random walk [unit^2/s] and decay [1/s] of each bias, zero elsewhere, (n,) each.
    """

    def __init__(self, drone: Drone, environment: Environment, estimation: Estimation, gate_s: float) -> None:
        self._drone, self._environment, self._estimation, self._gate_s = drone, environment, estimation, gate_s
        imu, self._gravity = drone.sensors.imu, environment.gravity_m_s2
        self._accel_sigma = accel_sigma(imu)
        self._gyro_sigma = max(math.radians(white_sigma(imu.gyro_deg_s, imu.rate_hz)), GYRO_SIGMA_MIN)
        self._beta = madgwick_beta(estimation, imu, self._gravity)
        self._direction_sigma = self._accel_sigma / self._gravity
        self._tilt_density = tilt_density(self._beta, self._direction_sigma, self._gravity, 1.0 / imu.rate_hz)
        latency_s = max(getattr(drone.sensors, name).latency_ms for name in SENSORS) * 1e-3
        self._age_max_s = 2.0 * latency_s + 5.0 * gate_s + (LINK_LATENCY_S if drone.is_external else 0.0)
        self.clones = self._clone_count()
        self.biases = biases_of(drone.sensors, estimation)
        self.first: dict[BiasName, int] = {}
        self.own = GYRO_BIAS
        for name, bias in self.biases.items():
            self.first[name] = self.own
            self.own += bias.axes
        self.size = self.own + self.clones * CLONED
        self.variance, self.walk, self.decay = np.zeros(self.size), np.zeros(self.size), np.zeros(self.size)
        self.variance[POSITION : POSITION + 3] = el.square(POSITION_SIGMA_M)
        self.variance[VELOCITY : VELOCITY + 3] = el.square(VELOCITY_SIGMA_M_S)
        self.variance[ATTITUDE : ATTITUDE + 3] = (
            el.square(TILT_SIGMA_RAD),
            el.square(TILT_SIGMA_RAD),
            el.square(HEADING_SIGMA_RAD),
        )
        for name, bias in self.biases.items():
            span = slice(self.first[name], self.first[name] + bias.axes)
            self.variance[span], self.walk[span], self.decay[span] = (
                el.square(bias.sigma),
                el.square(bias.walk),
                bias.decay_1_s,
            )

    def _clone_count(self) -> int:
        """Return the number of clones that late readings need, from the process noise during their delay.

        The noise is white acceleration and a random walk of the tilt, integrated per horizontal axis (Y. Bar-Shalom,
        X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 6.2).
        """
        sensors, longest_s = self._drone.sensors, 0.0
        white = el.square(self._accel_sigma) / sensors.imu.rate_hz  # m^2/s^3
        tilt = el.square(self._gyro_sigma) / sensors.imu.rate_hz + self._tilt_density
        walk = self._gravity * self._gravity * tilt  # m^2/s^5
        for channel in AIDING:
            section: Sensor = getattr(sensors, channel.sensor)
            delay_s = (section.latency_ms - sensors.imu.latency_ms) * 1e-3
            is_used = channel.sensor != "mag" and (channel.sensor != "flow" or self._estimation.flow)
            if delay_s <= self._gate_s or not is_used:
                continue
            if channel.field == "velocity_m_s":
                added_variance = white * delay_s + walk * el.power(delay_s, 3.0) / 3.0  # m^2/s^2
            else:
                added_variance = white * el.power(delay_s, 3.0) / 3.0 + walk * el.power(delay_s, 5.0) / 20.0  # m^2
            if added_variance > CLONE_SHARE_MIN * el.square(channel.sigma(sensors)):
                longest_s = max(longest_s, delay_s + self._gate_s)
        return math.ceil(longest_s / CLONE_EVERY_S) + 1 if longest_s else 0

    def _floor_m(self) -> float:
        """Return the height of the roof on which the drone starts [m]; 0 on the ground.

        The first heights come from the sonar alone, and would otherwise be wrong by the height of the roof. Above other
        obstacles, sonar readings are refused as outliers.
        """
        x, y, z = self._drone.position_m
        distance_m = float(Surroundings(self._environment).distances_m((x, y, z))[0])
        return z if abs(distance_m) < ROOF_DISTANCE_MAX_M else 0.0

    def setting(self) -> list[float]:
        """Return the drone's row of SETTING columns."""
        sensors, imu = self._drone.sensors, self._drone.sensors.imu
        row = [
            self._gravity,
            self._beta,
            1.0 / imu.rate_hz,
            imu.latency_ms * 1e-3 + self._gate_s + 5.0 * (1.0 / imu.rate_hz),
            max(JOLT_SIGMAS * self._accel_sigma, JOLT_MIN_M_S2),
            self._age_max_s,
            math.radians(self._drone.yaw_deg),
            el.square(self._accel_sigma),
            el.square(self._gyro_sigma),
            self._tilt_density,
            levelling_time_s(self._beta, self._direction_sigma),
            CLONE_EVERY_S,
            *self._environment.magnetic_field_ut,
            self._floor_m(),
        ]
        for name in SENSORS:  # the columns SENSOR
            section: Sensor = getattr(sensors, name)
            variance: list[float] = []
            correlated = 0.0
            for channel in AIDING:
                if channel.sensor == name:
                    variance += [el.square(channel.sigma(sensors))] * channel.axes
                    if channel.field == "position_m":
                        correlated = channel.error(sensors).correlated_sigma
            variance += [0.0] * (VALUES_MAX - len(variance))
            R_BS = np.array(matrix_from_rpy(*map(math.radians, section.mount.rpy_deg)))
            row += [*variance, *section.mount.position_m, *R_BS.flat, *-R_BS[:, 2]]
            row += [PATIENCE_S.get(name, math.inf), el.square(correlated)]
        assert len(row) == SETTING.size
        return row

    def layout(self) -> list[int]:
        """Return the drone's row of LAYOUT columns."""
        estimation, mag, mount = self._estimation, self._drone.sensors.mag.field_ut, self._drone.sensors.imu.mount
        # whether a single magnetometer reading gives a heading about as accurate as setting the drone down by eye
        horizontal_ut = el.length(self._environment.magnetic_field_ut[:2])
        sideways_ut = el.hypot(HEADING_CHANNEL.sigma(self._drone.sensors), el.hypot(mag.bias, mag.correlated_sigma))
        has_compass = estimation.magnetometer and sideways_ut <= COMPASS_SIGMA_RAD * horizontal_ut
        flags = (
            mount.rpy_deg != ZERO or mount.position_m != ZERO,
            "accel" in self.biases,
            any(isinstance(name, tuple) for name in self.biases) or self.clones > 0,
            self.decay.any(),
            estimation.magnetometer,
            has_compass,
            estimation.flow,
        )
        entries = int(self._age_max_s / self._gate_s) + 3
        row = [self.size, self.clones, self.own, entries, *map(int, flags)]
        for sensor in SENSORS:  # the columns BIAS of every channel
            bias_columns: list[int] = []
            value = 0
            for channel in AIDING:
                if channel.sensor == sensor:
                    names = ((channel, correlated) for correlated in (False, True))
                    bias_columns += [
                        x for name in names if name in self.first for x in (self.first[name], value, channel.axes)
                    ]
                    value += channel.axes
            row += bias_columns + [-1, 0, 0] * (CHANNELS - len(bias_columns) // BIAS.size)
        assert len(row) == LAYOUT.size
        return row


BiasName = str | tuple[UpdateChannel, bool]


def biases_of(sensors: Sensors, estimation: Estimation) -> dict[BiasName, Bias]:
    """Return the estimated biases.

    A Gauss-Markov process of an IMU channel is combined with the channel's other biases into a random walk of the same
    driving noise, which is never overconfident. A Gauss-Markov process of an aiding channel has states of its own.
    """

    def gauss_markov_walk(error: ErrorModel) -> float:  # driving noise per sqrt(s)
        return error.correlated_sigma * math.sqrt(2.0 / error.correlation_time_s)

    def as_walk(error: ErrorModel) -> Bias:
        if not error.correlated_sigma:
            return Bias(3, error.bias, error.bias_walk)
        sigma = el.hypot(error.bias, error.correlated_sigma)
        return Bias(3, sigma, el.hypot(error.bias_walk, gauss_markov_walk(error)))

    accel = as_walk(sensors.imu.accel_m_s2)
    gyro = as_walk(scaled(sensors.imu.gyro_deg_s, math.radians(1.0)))
    biases: dict[BiasName, Bias] = {"gyro": Bias(3, max(gyro.sigma, GYRO_BIAS_MIN), max(gyro.walk, GYRO_WALK_MIN))}
    if accel.sigma > 0.0 or accel.walk > 0.0:
        biases["accel"] = accel
    used = {"mag": estimation.magnetometer, "flow": estimation.flow}
    for channel in AIDING:
        if not used.get(channel.sensor, True):
            continue
        error = channel.error(sensors)
        if error.bias > 0.0 or error.bias_walk > 0.0:
            biases[channel, False] = Bias(channel.axes, error.bias, error.bias_walk)
        if error.correlated_sigma:
            sigma, decay_1_s = error.correlated_sigma, 1.0 / error.correlation_time_s
            biases[channel, True] = Bias(channel.axes, sigma, gauss_markov_walk(error), decay_1_s)
    return biases


def innovation_limits(gate_probability: float) -> Array:
    """Return the limits of y^T S^-1 y, for innovations y with covariance S, by the number of rows, (DOF_MAX + 1,)."""
    return np.array([0.0, *(chi_square_quantile(gate_probability, dof) for dof in range(1, DOF_MAX + 1))])


def white_sigma(error: ErrorModel, rate_hz: float) -> float:
    """Return the standard deviation of an error's white part per sample, in the channel's unit.

    It combines noise without a correlation time, density * sqrt(rate) and the converter's rounding
    (uniform: quantum^2/12) in quadrature.
    """
    noise = 0.0 if error.correlation_time_s else error.noise
    return math.sqrt(el.square(noise) + el.square(error.density) * rate_hz + el.square(error.quantum) / 12.0)


def accel_sigma(imu: ImuConfig) -> float:
    """Return the standard deviation of the accelerometer's white noise, at least ACCEL_SIGMA_MIN [m/s^2]."""
    return max(white_sigma(imu.accel_m_s2, imu.rate_hz), ACCEL_SIGMA_MIN)


def madgwick_beta(estimation: Estimation, imu: ImuConfig, gravity: float) -> float:
    """Return Madgwick's gain [rad/s]: the scenario's, or else the one that levels in LEVELLING_S under IMU noise."""
    if estimation.madgwick_beta is not None:
        return estimation.madgwick_beta
    return beta_for(LEVELLING_S, accel_sigma(imu) / gravity)


def tilt_density(beta: float, direction_sigma: float, gravity: float, period_s: float) -> float:
    """Return the tilt noise per axis added by Madgwick's accelerometer step [rad^2/s].

    Noise gives each step, of length 2 beta dt, a random direction, and so each axis half the squared length. An
    acceleration a acts as a tilt a/g, towards which the attitude is pulled with the levelling time, at a rate of at
    most 2 beta; it is modelled as white noise of the same power at low frequency.
    """
    if beta == 0.0:
        return 0.0
    pull = min(MANOEUVRE_M_S2 / gravity / levelling_time_s(beta, direction_sigma), 2.0 * beta)
    return 2.0 * beta * beta * period_s + pull * pull * 2.0 * MANOEUVRE_S
