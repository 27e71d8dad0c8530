"""What an estimator believes before its first reading: noise, biases, gain and start, from a scenario."""

from __future__ import annotations

import math
from collections.abc import Sequence

from zsim.scenario.scenario import Estimation, ImuConfig
from zsim.scenario.sensor_presets import BOARD_RATE_HZ
from zsim_agents.estimation.aiding import Aid
from zsim_agents.estimation.dead_reckoning import ATTITUDE, POSITION, VELOCITY
from zsim_agents.estimation.error_state import Array, BiasPrior, ProcessNoise, set_variance
from zsim_agents.estimation.madgwick import beta_for, levelling_time_s
from zsim_agents.estimation.sensor_noise import has_bias, white_sigma
from zsim_agents.estimation.strapdown import MANOEUVRE_M_S2, MANOEUVRE_S

LEVELLING_S = 60.0  # s; long against manoeuvres of seconds, short against the gyroscope's drift

POSITION_SIGMA_M = 100.0  # m: a start anywhere on the field
VELOCITY_SIGMA_M_S = 1.0  # m/s: a start at rest, or in gentle flight
TILT_SIGMA_RAD = 0.05  # rad: ground that is level to 3 deg
HEADING_SIGMA_RAD = 0.5  # rad: before the first reading of the magnetometer, which turns the attitude to it
SET_DOWN_SIGMA_RAD = 0.05  # rad: how well a drone is set down by eye, where there is no magnetometer
HEADING_WAIT_S = 1.0  # s without a magnetometer's reading, after which the heading of the scenario is taken
GYRO_BIAS_MIN = math.radians(0.01)  # rad/s: bias that is allowed for where the scenario has none
GYRO_WALK_MIN = math.radians(1e-4)  # rad/s/sqrt(s), likewise
ACCEL_SIGMA_MIN = 0.02  # m/s^2 per sample: what sampling and the trapezoidal rule lose
GYRO_SIGMA_MIN = 2e-4  # rad/s per sample, likewise


def accel_sigma(imu: ImuConfig) -> float:
    """Return the accelerometer's white noise per sample [m/s^2]."""
    return max(white_sigma(imu.accel_m_s2, BOARD_RATE_HZ), ACCEL_SIGMA_MIN)


def madgwick_beta(estimation: Estimation, imu: ImuConfig, gravity: float) -> float:
    """Return the gain [rad/s]: the scenario's, or what levels in `LEVELLING_S` under the IMU's noise."""
    if estimation.madgwick_beta is not None:
        return estimation.madgwick_beta
    return beta_for(LEVELLING_S, accel_sigma(imu) / gravity)


def process_noise(imu: ImuConfig, beta: float, gravity: float) -> ProcessNoise:
    """Return the noise of dead reckoning with an IMU and a Madgwick gain [rad/s]."""
    direction_sigma = accel_sigma(imu) / gravity
    return ProcessNoise(
        accel_sigma=accel_sigma(imu),
        gyro_sigma=max(math.radians(white_sigma(imu.gyro_deg_s, BOARD_RATE_HZ)), GYRO_SIGMA_MIN),
        tilt_density=tilt_density(beta, direction_sigma, gravity, 1.0 / imu.rate_hz),
        levelling_s=levelling_time_s(beta, direction_sigma),
    )


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


def bias_priors(imu: ImuConfig, aids: Sequence[Aid]) -> dict[str, BiasPrior]:
    """Return the bias states in their order: gyroscope, accelerometer, then the other sensors."""
    accel, gyro = imu.accel_m_s2, imu.gyro_deg_s
    sigma = max(math.radians(gyro.bias), GYRO_BIAS_MIN)
    priors = {"gyro": BiasPrior(3, sigma, max(math.radians(gyro.bias_walk), GYRO_WALK_MIN))}
    if has_bias(accel):
        priors["accel"] = BiasPrior(3, accel.bias, accel.bias_walk)
    for aid in aids:
        priors.update(aid.biases)
    return priors


def set_start(P: Array) -> None:
    """Give position, velocity and attitude in a covariance (n, n) the uncertainty of a start."""
    set_variance(P, slice(POSITION, POSITION + 3), POSITION_SIGMA_M**2)
    set_variance(P, slice(VELOCITY, VELOCITY + 3), VELOCITY_SIGMA_M_S**2)
    set_variance(P, slice(ATTITUDE, ATTITUDE + 2), TILT_SIGMA_RAD**2)
    set_variance(P, slice(ATTITUDE + 2, ATTITUDE + 3), HEADING_SIGMA_RAD**2)
