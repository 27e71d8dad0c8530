"""The paper's estimator: Madgwick's attitude filter, and an extended Kalman filter for dead reckoning and GPS.

I. Mas, S. Curi, R. Sánchez Peña, "Open-source Multi-UAV Simulator for the ROS Environment", section III: Madgwick's
filter computes the attitude from gyroscopes and accelerometers; an extended Kalman filter, used "due to the non-linear
dynamics", fuses dead reckoning with GPS fixes into a position estimate. The heading is not measured: it starts at the
scenario's value, and only GPS fixes of a moving drone correct it.

Dead reckoning integrates the velocity u that the aircraft measures in its heading frame:

    x = (p_WB, yaw)      p' = Rz(yaw) u      yaw' = rate of Madgwick's heading      z = p_WB
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim.contract.messages import Gps, Imu
from zsim.contract.snapshot import State
from zsim.math import elementary as el
from zsim.math import frames, linear
from zsim.math.rotation import Quaternion, Vector
from zsim.scenario.scenario import Drone, Environment, Estimation
from zsim.sensors.sensor import ErrorModel, noise_sigma
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.kalman_update import joseph
from zsim_agents.estimation.strapdown import madgwick_step

YAW = 3  # index in the state
POSITION_SIGMA_M = 100.0  # initial standard deviation, for a start anywhere on the field
YAW_SIGMA_RAD = 0.05  # initial standard deviation: the accuracy of setting a drone down by eye
DRIFT_S = 1.0  # time over which the gyroscope's bias, which is not estimated, is assumed constant
SPEED_SIGMA_M_S = 1.0  # standard deviation per axis of an unknown velocity
IMU_GAP_MAX_S = 0.1  # after a gap of this length or longer, only one IMU period is integrated


class PaperEstimator:
    """Estimates the state of one drone; see `zsim_agents.estimation.drone_estimator.DroneEstimator`."""

    def __init__(self, drone: Drone, environment: Environment, estimation: Estimation, gate_s: float) -> None:
        gyro, flow = drone.sensors.imu.gyro_deg_s, drone.sensors.flow
        gyro_sigma = noise_sigma(gyro, drone.sensors.imu.rate_hz)
        self._gyro_sigma, self._gyro_bias = math.radians(gyro_sigma), math.radians(gyro.bias)  # rad/s
        self._fix_variance_factor = correlation_factor(drone.sensors.gps.position_m, drone.sensors.gps.rate_hz)
        self._imu_period_s = 1.0 / drone.sensors.imu.rate_hz
        beta = estimation.madgwick_beta
        self._beta = math.sqrt(0.75) * (self._gyro_sigma + self._gyro_bias) if beta is None else beta  # Madgwick eq. 50
        self._q_BS = frames.quaternion_from_rpy(np.radians(drone.sensors.imu.mount.rpy_deg))
        self._speed_sigma, self._flow_period_s = noise_sigma(flow.velocity_m_s, flow.rate_hz), 1.0 / flow.rate_hz
        yaw = math.radians(drone.yaw_deg)
        self._q = _quaternion(frames.quaternion_from_heading(yaw))
        self._t_imu_s = math.nan
        self._velocity: Vector | None = None
        self._fix: Gps | None = None
        self._t_s = math.nan
        self._used = {"imu": 0, "gps": 0, "flow": 0}
        self._filter = DeadReckoningFilter(yaw)

    def receive(self, sensor: str, message: Any) -> None:
        """Receive a reading of the IMU, the GPS receiver or the aircraft's velocity sensor; others are ignored."""
        if sensor in self._used:
            self._used[sensor] += 1
        if sensor == "imu":
            self._update_attitude(message)
        elif sensor == "flow":
            self._velocity = message.velocity_m_s if message.quality > 0.0 else None
        elif sensor == "gps" and message.fix:
            self._fix = message

    def estimate(self, t_s: float) -> StateEstimate:
        """Predict to the end of the gate, `t_s` [s], correct with a fix if one has arrived, and return the estimate."""
        dt = 0.0 if math.isnan(self._t_s) else t_s - self._t_s
        self._t_s = t_s
        yaw = float(frames.heading(self._q))
        position = self._velocity_variance() * self._flow_period_s * dt  # a velocity error lasts one flow period
        drift = (el.square(self._gyro_sigma) * self._imu_period_s + el.square(self._gyro_bias) * DRIFT_S) * dt
        noise = np.diag([position, position, position, drift])
        self._filter.reckon(self._velocity or (0.0, 0.0, 0.0), yaw, noise, dt)
        if self._fix:
            self._filter.correct(self._fix, self._fix_variance_factor)
            self._fix = None
        heading_correction = frames.quaternion_from_heading(self._filter.x[YAW] - yaw)
        self._q = _quaternion(frames.quaternion_multiply(heading_correction, self._q))
        yaw = float(self._filter.x[YAW])
        velocity = linear.product(rotation_z(yaw), self._velocity or (0.0, 0.0, 0.0))
        covariance = np.zeros((6, 6))
        covariance[:3, :3], covariance[3:, 3:] = self._filter.P[:3, :3], self._velocity_variance() * np.eye(3)
        return StateEstimate(
            position_m=self._filter.x[:3],
            velocity_m_s=velocity,
            orientation_wxyz=self._q,
            yaw_rad=float(frames.heading(self._q)),
            covariance=covariance,
            yaw_sigma_rad=math.sqrt(self._filter.P[YAW, YAW]),
            sensors={name: (count, 0) for name, count in self._used.items()},
        )

    def snapshot(self) -> State:
        """Return the state, which contains no fix, since fixes are used at the end of their gate."""
        filter_ = {"x": self._filter.x, "P": self._filter.P}
        times = {"t_imu_s": self._t_imu_s, "t_s": self._t_s}
        return {**filter_, **times, "q": self._q, "velocity": self._velocity, "used": self._used}

    def restore(self, state: State) -> None:
        self._filter.x, self._filter.P = state["x"], state["P"]
        self._t_imu_s, self._t_s = state["t_imu_s"], state["t_s"]
        self._q, self._velocity = tuple(state["q"]), state["velocity"] and tuple(state["velocity"])
        self._used = state["used"]

    def _update_attitude(self, sample: Imu) -> None:
        t_s = sample.t_sample_ns * 1e-9
        dt = t_s - self._t_imu_s
        if dt <= 0.0:
            return
        if not dt < IMU_GAP_MAX_S:
            dt = self._imu_period_s
        self._t_imu_s = t_s
        self._q = madgwick_step(
            self._q, self._to_body(sample.gyro_rad_s), self._to_body(sample.accel_m_s2), self._beta, dt
        )

    def _to_body(self, v_S: Vector) -> Vector:
        x, y, z = frames.rotate(self._q_BS, v_S).tolist()
        return x, y, z

    def _velocity_variance(self) -> float:
        """Return the variance per axis of the velocity that dead reckoning uses [m^2/s^2]."""
        return el.square(self._speed_sigma if self._velocity else SPEED_SIGMA_M_S)


class DeadReckoningFilter:
    """Estimates x = (p_WB, yaw), with covariance P (4, 4), from dead reckoning and GPS fixes.

    The equations are those of filterpy's ExtendedKalmanFilter, in Joseph form.
    """

    def __init__(self, yaw: float) -> None:
        self.x = np.array([0.0, 0.0, 0.0, yaw])
        self.P = np.diag([el.square(POSITION_SIGMA_M)] * 3 + [el.square(YAW_SIGMA_RAD)])

    def reckon(self, u: Vector, yaw: float, Q: NDArray[np.float64], dt: float) -> None:
        """Predict over `dt` [s] with the velocity u [m/s; heading frame] and the new heading `yaw` [rad].

        Madgwick's filter gives `yaw`; Q is the covariance of the process noise, (4, 4).
        """
        step = linear.product(rotation_z(yaw), u) * dt
        self.x = np.append(self.x[:3] + step, yaw)
        F = np.eye(4)
        F[:2, YAW] = -step[1], step[0]  # d(Rz(yaw) u)/d yaw
        self.P = linear.product(linear.product(F, self.P), F.T) + Q

    def correct(self, fix: Gps, variance_factor: float) -> None:
        """Use a GPS fix, with its variance multiplied by a factor."""
        H, variance = np.eye(3, 4), np.full(3, el.square(fix.sigma_m) * variance_factor)
        K = linear.solve(self.P[:3, :3] + np.diag(variance), self.P[:3]).T  # P H^T S^-1 for symmetric P and S
        self.x = self.x + linear.product(K, np.array(fix.position_m) - self.x[:3])
        self.P = joseph(self.P, H, variance, K)


def correlation_factor(error: ErrorModel, rate_hz: float) -> float:
    """Return the factor by which the correlation of an error raises the variance of a mean of samples.

    The mean of n samples of a Gauss-Markov process has the variance sigma^2/n times (1 + a)/(1 - a), where a is the
    correlation of successive samples (G. V. Bayley, J. M. Hammersley, "The 'effective' number of independent
    observations in an autocorrelated time series", Supplement to the Journal of the Royal Statistical Society 8, 1946).
    White noise in the error lowers the factor.
    """
    if not error.correlated_sigma:
        return 1.0
    a = el.exp(-1.0 / (rate_hz * error.correlation_time_s))
    correlated_share = el.square(error.correlated_sigma / noise_sigma(error, rate_hz))
    return 1.0 + correlated_share * 2.0 * a / (1.0 - a)


def rotation_z(yaw: float) -> NDArray[np.float64]:
    """Return Rz(yaw), (3, 3)."""
    c, s = el.cos(yaw), el.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _quaternion(q: NDArray[np.float64]) -> Quaternion:
    w, x, y, z = q.tolist()
    return w, x, y, z
