"""The nominal state of one drone: moved by every IMU sample, put right by the filter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zsim.scenario.scenario import ImuConfig
from zsim_agents.estimation.dead_reckoning import (
    ACCEL_BIAS,
    GYRO_BIAS,
    Reckoning,
    acceleration,
    arm_acceleration,
    corrected,
    plus,
    reckon,
)
from zsim_agents.estimation.madgwick import LEVEL, Quaternion, Vector, product, turn
from zsim_agents.estimation.mount import mount_rotation
from zsim_agents.estimation.state_history import Moment

ZERO: Vector = (0.0, 0.0, 0.0)
ACCEL_MAX_M_S2 = 500.0  # m/s^2, 50 g: no MEMS accelerometer of a drone reads more
GYRO_MAX_RAD_S = 100.0  # rad/s, 5700 deg/s: likewise
MANOEUVRE_M_S2 = 0.3  # m/s^2, standard deviation of the acceleration in gusts of 0.5 m/s (0.16) and in transit
MANOEUVRE_S = 0.5  # s, its correlation time
LOST_TURN_RAD_S = 0.5  # rad/s, standard deviation of the rate that a missing gyroscope sample hides
COAST_TURN_DENSITY = LOST_TURN_RAD_S**2 * 2.0 * MANOEUVRE_S  # rad^2/s
JOLT_SIGMAS = 10.0  # of the accelerometer; the sum of three changes of pure noise is 3.4 on average, 1.5 in spread
JOLT_MIN_M_S2 = 1.0  # m/s^2 from one sample to the next, beyond the rotors in flight; touching the ground has tens
COAST_VELOCITY_DENSITY = 1.0  # m^2/s^3: 1 m/s after 1 s without an IMU


class Interval(NamedTuple):
    """What has happened between two gates, for the covariance."""

    dt: float
    """Length [s]."""
    v_before: Vector
    """Velocity at its start [m/s]; with the one at its end it gives the mean acceleration."""
    square_s2: float
    """Sum of the squared steps of the IMU [s^2]."""
    lost_velocity: float
    """Variance of velocity to add for missing samples [m^2/s^2]."""
    lost_turn: float
    """Variance of attitude to add for missing samples [rad^2]."""


class Strapdown:
    """Position, velocity and attitude by dead reckoning.

    Args:
        imu: its rate, mount and latency.
        with_accel_bias: whether the filter estimates one.
        accel_sigma: white noise of the accelerometer per sample [m/s^2].
        beta: Madgwick's gain [rad/s].
        gravity: [m/s^2].
        gate_s: interval of the gates [s].
    """

    def __init__(
        self, imu: ImuConfig, with_accel_bias: bool, accel_sigma: float, beta: float, gravity: float, gate_s: float
    ) -> None:
        self.t_s = 0.0
        self.state: Reckoning = (ZERO, ZERO, LEVEL, ZERO, ZERO, (0.0, 0.0, gravity))
        self.gyro_bias, self.accel_bias = ZERO, ZERO
        self.p_corrected, self.v_corrected = ZERO, ZERO
        self.used = 0
        self.refused = 0
        self.running = False
        self._with_accel_bias, self._beta, self.gravity = with_accel_bias, beta, gravity
        self._period_s = 1.0 / imu.rate_hz
        self._coast_after_s = coast_after_s(imu, gate_s)
        self._R_BS, self._arm = mount_rotation(imu.mount), imu.mount.position_m
        self._mounted_aside = imu.mount.rpy_deg != ZERO or self._arm != ZERO
        self._jolt_m_s2 = jolt_m_s2(accel_sigma)
        self._interval_from(0.0)

    def start(self, t_s: float) -> None:
        """Begin at an instant."""
        self.t_s = t_s
        self.running = True
        self._interval_from(t_s)

    def imu(self, t_sample_s: float, accel: Vector, gyro: Vector) -> None:
        """Move to the sample's instant; ignore a duplicate, refuse and count a late or impossible sample.

        Args:
            t_sample_s: instant of the sample [s].
            accel: specific force [m/s^2; S].
            gyro: body rate [rad/s; S].
        """
        ax, ay, az = accel
        wx, wy, wz = gyro
        # Written out, because it runs at every sample; NaN fails each comparison.
        if not (
            -ACCEL_MAX_M_S2 < ax < ACCEL_MAX_M_S2
            and -ACCEL_MAX_M_S2 < ay < ACCEL_MAX_M_S2
            and -ACCEL_MAX_M_S2 < az < ACCEL_MAX_M_S2
            and -GYRO_MAX_RAD_S < wx < GYRO_MAX_RAD_S
            and -GYRO_MAX_RAD_S < wy < GYRO_MAX_RAD_S
            and -GYRO_MAX_RAD_S < wz < GYRO_MAX_RAD_S
        ):
            self.refused += 1
            return
        if not self.running:
            self.start(t_sample_s - self._period_s)
        dt = t_sample_s - self.t_s
        if dt <= 0.0:
            self.refused += dt < 0.0
            return
        if dt > 1.5 * self._period_s:
            self._lose(dt - self._period_s)
        if self._mounted_aside:
            accel, gyro = self._of_body(accel, gyro, dt)
        bx, by, bz = self.state[5]
        self.state = reckon(self.state, accel, gyro, self.accel_bias, self.gyro_bias, self._beta, self.gravity, dt)
        fx, fy, fz = self.state[5]
        jolt = abs(fx - bx) + abs(fy - by) + abs(fz - bz)
        if jolt > self._jolt_m_s2:
            hidden = 0.5 * jolt * dt  # what a step anywhere between two samples hides
            self._lost_velocity += hidden * hidden
        self.t_s = t_sample_s
        self._square_s2 += dt * dt
        self.used += 1

    def coast(self, t_s: float) -> None:
        """Go on without an IMU if none came for long: velocity and attitude held, their certainty fading."""
        dt = t_s - self.t_s
        if dt <= self._coast_after_s:
            return
        p, v, q, _, _, f_B = self.state
        self.state = (plus(p, v, dt), v, q, ZERO, ZERO, f_B)
        self.t_s = t_s
        self._lost_velocity += COAST_VELOCITY_DENSITY * dt
        self._lost_turn += COAST_TURN_DENSITY * dt

    def take_interval(self) -> Interval:
        """Return what has happened since the last call."""
        taken = Interval(self.t_s - self._from_s, self._v_before, self._square_s2, self._lost_velocity, self._lost_turn)
        self._interval_from(self.t_s)
        return taken

    def correct(self, error: np.ndarray) -> None:
        """Put an error of the filter into the state and the biases."""
        self.state = corrected(self.state, error, self._with_accel_bias, self.gravity)
        self._v_before = self.state[1]
        values = error.tolist()
        self.p_corrected = _plus_three(self.p_corrected, values, 0)
        self.v_corrected = _plus_three(self.v_corrected, values, 3)
        self.gyro_bias = _plus_three(self.gyro_bias, values, GYRO_BIAS)
        if self._with_accel_bias:
            self.accel_bias = _plus_three(self.accel_bias, values, ACCEL_BIAS)

    def place(self, p: Vector, v: Vector, q: Quaternion) -> None:
        """Set position, velocity and attitude."""
        _, _, _, _, w, f_B = self.state
        self.state = (p, v, q, acceleration(q, f_B, self.gravity), w, f_B)
        self._v_before = v

    def turn_heading(self, turn_z: Quaternion) -> None:
        """Turn the attitude about the world's z axis."""
        p, v, q, _, _, _ = self.state
        self.place(p, v, product(turn_z, q))

    def moment(self) -> Moment:
        """Return the present instant for the history."""
        p, v, q, _, w, _ = self.state
        return Moment(self.t_s, p, v, q, w, self.p_corrected, self.v_corrected)

    def _interval_from(self, t_s: float) -> None:
        self._from_s = t_s
        self._v_before = self.state[1]
        self._square_s2 = self._lost_velocity = self._lost_turn = 0.0

    def _lose(self, missing_s: float) -> None:
        """Count samples that did not come as motion unseen."""
        velocity, turned = MANOEUVRE_M_S2 * missing_s, LOST_TURN_RAD_S * missing_s
        self._lost_velocity += velocity * velocity
        self._lost_turn += turned * turned

    def _of_body(self, accel: Vector, gyro: Vector, dt: float) -> tuple[Vector, Vector]:
        """Return a sample of a turned or displaced IMU as one of the centre of mass, in body axes."""
        accel, gyro = turn(self._R_BS, accel), turn(self._R_BS, gyro)
        w = plus(gyro, self.gyro_bias, -1.0)
        return plus(accel, arm_acceleration(w, self.state[4], self._arm, dt), -1.0), gyro


def coast_after_s(imu: ImuConfig, gate_s: float) -> float:
    """Return after how long without an IMU dead reckoning goes on without one [s]."""
    return imu.latency_ms * 1e-3 + gate_s + 5.0 * (1.0 / imu.rate_hz)


def jolt_m_s2(accel_sigma: float) -> float:
    """Return the change of specific force from one sample to the next that is more than noise and rotors [m/s^2]."""
    return max(JOLT_SIGMAS * accel_sigma, JOLT_MIN_M_S2)


def _plus_three(a: Vector, values: list[float], first: int) -> Vector:
    return a[0] + values[first], a[1] + values[first + 1], a[2] + values[first + 2]
