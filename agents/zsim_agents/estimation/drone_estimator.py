"""The estimator of one drone: Madgwick attitude, strapdown dead reckoning, and an error-state EKF over both.

Every IMU sample moves the nominal state. At the end of a gate the covariance follows, the gate's other
measurements are judged and used in one stacked update, and the error found goes back into position, velocity,
Madgwick's quaternion and the biases.

Madgwick's accelerometer step assumes that a drone does not accelerate. A quadrotor's specific force lies
along its thrust, so the step pulls the tilt towards level whatever the true tilt. Hence two guards: the gain
is so small that the pull takes `estimator_prior.LEVELLING_S`, and the filter knows the pull as a first-order
loss of its tilt error, driven by the drone's accelerations, and puts the tilt right from what position and
velocity say.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from zsim.scenario.scenario import Drone, Environment, Estimation
from zsim_agents.estimation.aiding import VALUE_MAX, Aid, Measurement, aids
from zsim_agents.estimation.dead_reckoning import ATTITUDE, heading_and_sigma, plus
from zsim_agents.estimation.estimate import Estimate, age_max_s
from zsim_agents.estimation.estimator_prior import (
    HEADING_SIGMA_RAD,
    HEADING_WAIT_S,
    SET_DOWN_SIGMA_RAD,
    bias_priors,
    madgwick_beta,
    process_noise,
    set_start,
)
from zsim_agents.estimation.fusion import Fusion
from zsim_agents.estimation.madgwick import (
    Vector,
    heading,
    normalised,
    product,
    rotation,
    rotation_vector_quaternion,
    turn,
)
from zsim_agents.estimation.navigation_filter import NavigationFilter
from zsim_agents.estimation.state_history import StateHistory
from zsim_agents.estimation.strapdown import Strapdown

YAW = slice(ATTITUDE + 2, ATTITUDE + 3)


class DroneEstimator:
    """Fuse the sensors of one drone.

    Sensors may come in any order between two gates. Duplicates are ignored; readings that are older than the
    sensor's last one, not finite, or outside of their gate are refused and counted.

    Args:
        drone: its mounts and error models are what the estimator believes.
        environment: gravity and magnetic field.
        estimation: settings.
        gate_s: interval of the gates [s].
    """

    def __init__(self, drone: Drone, environment: Environment, estimation: Estimation, gate_s: float) -> None:
        imu, gravity = drone.sensors.imu, environment.gravity_m_s2
        self._field = environment.magnetic_field_ut
        self._set_down_yaw = math.radians(drone.yaw_deg)
        self._aids = aids(drone.sensors)
        self._magnetometer, self._flow = estimation.magnetometer, estimation.flow
        wanted = [aid for name, aid in self._aids.items() if self._wanted(name)]
        beta = madgwick_beta(estimation, imu, gravity)
        noise = process_noise(imu, beta, gravity)
        self.filter = NavigationFilter(noise, bias_priors(imu, wanted), estimation.gate_probability)
        """Read only; `y` and `S` are the innovations of its last update."""
        set_start(self.filter.P)
        self._strapdown = Strapdown(imu, self.filter.with_accel_bias, noise.accel_sigma, beta, gravity, gate_s)
        self._age_max_s = age_max_s(drone, gate_s)
        history = StateHistory(self._age_max_s, gate_s)
        self._fusion = Fusion(self.filter, self._strapdown, history, self._field)
        self._waiting: list[Measurement] = []
        self._start_s = math.nan
        self._heading_known = False

    def imu(self, t_sample_s: float, accel_m_s2: Vector, gyro_rad_s: Vector) -> None:
        """Move the nominal state to the sample's instant."""
        self._strapdown.imu(t_sample_s, accel_m_s2, gyro_rad_s)

    def gps(
        self,
        t_s: float,
        t_sample_s: float,
        position_m: Sequence[float],
        velocity_m_s: Sequence[float],
        sigma_m: float,
        fix: int,
    ) -> None:
        """Take a fix; `sigma_m` per axis counts where it is worse than what the scenario says."""
        aid = self._aids["gps"]
        if not fix or not abs(sigma_m) < VALUE_MAX:
            aid.refused += 1
            return
        variance = max(sigma_m * sigma_m, aid.variance[0])
        self._wait(aid, t_s, t_sample_s, (*position_m, *velocity_m_s), (variance,) * 3 + aid.variance[3:])

    def mag(self, t_s: float, t_sample_s: float, field_ut: Sequence[float]) -> None:
        """Take the field in the sensor's axes."""
        if self._magnetometer:
            aid = self._aids["mag"]
            self._wait(aid, t_s, t_sample_s, field_ut, aid.variance)

    def baro(self, t_s: float, t_sample_s: float, altitude_m: float) -> None:
        """Take a barometric height over the world's origin."""
        aid = self._aids["baro"]
        self._wait(aid, t_s, t_sample_s, (altitude_m,), aid.variance)

    def sonar(self, t_s: float, t_sample_s: float, range_m: float, valid: bool) -> None:
        """Take a range to the ground; one marked as invalid says nothing and is not counted."""
        if valid:
            aid = self._aids["sonar"]
            self._wait(aid, t_s, t_sample_s, (range_m,), aid.variance)

    def flow(self, t_s: float, t_sample_s: float, velocity_m_s: Sequence[float], quality: float) -> None:
        """Take a velocity in the heading frame; without quality, or before a heading is known, refuse it."""
        if not self._flow:
            return
        aid = self._aids["flow"]
        if quality > 0.0:
            self._wait(aid, t_s, t_sample_s, velocity_m_s, aid.variance)
        else:
            aid.refused += 1

    def close(self, t_s: float) -> Estimate:
        """Use what has come since the last gate and return the estimate for `t_s`."""
        strapdown = self._strapdown
        if not strapdown.running:
            strapdown.start(t_s)
        strapdown.coast(t_s)
        interval = strapdown.take_interval()
        if interval.dt > 0.0:
            self.filter.advance(strapdown, interval)
        if not self._heading_known:
            self._settle_heading(t_s)
        self._fusion.use(self._waiting, self._heading_known)
        self._waiting.clear()
        return self._estimate(t_s)

    def warm_start(
        self,
        position_m: Sequence[float],
        velocity_m_s: Sequence[float],
        orientation_wxyz: Sequence[float],
        covariance: Sequence[float],
        yaw_sigma_rad: float,
        gyro_bias_rad_s: Sequence[float],
    ) -> None:
        """Continue from a published estimate; call before the first reading.

        Tilt and biases, of which the estimate has no covariance, start as uncertain as in a cold start.
        """
        w, x, y, z = (float(part) for part in orientation_wxyz)
        self._strapdown.place(_vector(position_m), _vector(velocity_m_s), normalised((w, x, y, z)))
        self._strapdown.gyro_bias = _vector(gyro_bias_rad_s)
        for i in range(6):
            self.filter.P[i, :6] = covariance[6 * i : 6 * i + 6]
        self.filter.set_variance(YAW, yaw_sigma_rad**2)
        self._heading_known = yaw_sigma_rad < HEADING_SIGMA_RAD

    def _wanted(self, name: str) -> bool:
        return {"mag": self._magnetometer, "flow": self._flow}.get(name, True)

    def _wait(
        self, aid: Aid, t_s: float, t_sample_s: float, values: Sequence[float], variance: Sequence[float]
    ) -> None:
        """Keep a reading for the end of the gate, unless it cannot be used."""
        if aid.accept(t_s, t_sample_s, values, self._age_max_s):
            self._waiting.append(Measurement(aid, t_sample_s, values, variance))

    def _settle_heading(self, t_s: float) -> None:
        """Give the attitude its first heading: the magnetometer's, or the scenario's where there is none."""
        if math.isnan(self._start_s):
            self._start_s = t_s
        for measurement in self._waiting:
            if measurement.aid.name == "mag":
                self._turn_heading(self._angle_to_field(measurement))  # its certainty comes from the update
                return
        if not self._magnetometer or t_s - self._start_s > HEADING_WAIT_S:
            self._turn_heading(self._set_down_yaw - heading(self._strapdown.state[2]))
            self.filter.set_variance(YAW, SET_DOWN_SIGMA_RAD**2)

    def _angle_to_field(self, measurement: Measurement) -> float:
        """Return by how much the present heading is short of the one that the magnetometer sees."""
        field_B = turn(measurement.aid.R_BS, _vector(measurement.values))
        seen = turn(rotation(self._strapdown.state[2]), field_B)
        return math.atan2(self._field[1], self._field[0]) - math.atan2(seen[1], seen[0])

    def _turn_heading(self, angle: float) -> None:
        self._strapdown.turn_heading((math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle)))
        self._fusion.forget_past()
        self._heading_known = True

    def _estimate(self, t_s: float) -> Estimate:
        """Return the estimate for an instant that the IMU may not have reached yet."""
        strapdown, P = self._strapdown, self.filter.P
        p, v, q, a_W, w, _ = strapdown.state
        ahead = t_s - strapdown.t_s
        if ahead > 1e-9:
            p, v = plus(p, v, ahead), plus(v, a_W, ahead)
            turned = rotation_vector_quaternion((w[0] * ahead, w[1] * ahead, w[2] * ahead))
            q = normalised(product(q, turned))
            P = P.copy()
            P[:3] += ahead * P[3:6]
            P[:, :3] += ahead * P[:, 3:6]
        yaw, yaw_sigma = heading_and_sigma(q, P)
        return Estimate(p, v, q, yaw, _upper(P), yaw_sigma, strapdown.gyro_bias, self._counts())

    def _counts(self) -> dict[str, tuple[int, int]]:
        counts = {name: (aid.used, aid.refused) for name, aid in self._aids.items()}
        counts["imu"] = (self._strapdown.used, self._strapdown.refused)
        return counts


def _upper(P: np.ndarray) -> tuple[float, ...]:
    """Return the first 6 x 6 of a covariance row by row, symmetric to the last bit."""
    a, b, c, d, e, f = P[:6, :6].tolist()
    return (
        a[0], a[1], a[2], a[3], a[4], a[5],
        a[1], b[1], b[2], b[3], b[4], b[5],
        a[2], b[2], c[2], c[3], c[4], c[5],
        a[3], b[3], c[3], d[3], d[4], d[5],
        a[4], b[4], c[4], d[4], e[4], e[5],
        a[5], b[5], c[5], d[5], e[5], f[5],
    )  # fmt: skip


def _vector(values: Sequence[float]) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
