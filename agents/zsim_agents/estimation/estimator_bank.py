"""The estimators of many drones in one compiled kernel: to the bit what a DroneEstimator of each would say.

Readings are only written down when they come; the kernel handles them all at the end of the gate.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from zsim.contract.framing import GateMessages
from zsim.scenario.scenario import Drone, Environment, Estimation
from zsim_agents.estimation import estimator_rows as er
from zsim_agents.estimation.aiding import PATIENCE_S, Aid, aids
from zsim_agents.estimation.dead_reckoning import acceleration
from zsim_agents.estimation.error_state import ErrorState, innovation_limits
from zsim_agents.estimation.estimate import Estimate, age_max_s
from zsim_agents.estimation.estimator_fusion import YAW_STATE, close, set_variance
from zsim_agents.estimation.estimator_prior import (
    HEADING_SIGMA_RAD,
    bias_priors,
    madgwick_beta,
    process_noise,
    set_start,
)
from zsim_agents.estimation.madgwick import LEVEL, Vector, normalised
from zsim_agents.estimation.mount import mount_rotation
from zsim_agents.estimation.sensor_reader import GateReader
from zsim_agents.estimation.state_history import history_length
from zsim_agents.estimation.strapdown import ZERO, coast_after_s, jolt_m_s2

_READING = struct.Struct(f"{er.READING_COLUMNS}d")
_ROOM = 256  # readings of a gate, at first
_NONE = (0.0,) * 6
_IN_ORDER = [*[*enumerate(er.KINDS)][1:], (er.IMU, "imu")]  # as a DroneEstimator counts them


class EstimatorBank:
    """Fuse the sensors of several drones; `i` counts them in the order given.

    Sensors may come in any order between two gates. Duplicates are ignored; readings that are older than the
    sensor's last one, not finite, or outside of their gate are refused and counted.

    Args:
        drones: their mounts and error models are what the estimator believes.
        environment: gravity and magnetic field.
        estimation: settings.
        gate_s: interval of the gates [s].
    """

    def __init__(
        self, drones: Sequence[Drone], environment: Environment, estimation: Estimation, gate_s: float
    ) -> None:
        believed = [_Belief(drone, environment, estimation, gate_s) for drone in drones]
        self.rows = _rows(believed, estimation.gate_probability)
        self._make_room(_ROOM)
        self._came = 0
        self._reader = GateReader([drone.name for drone in drones])
        self._told = np.zeros((len(drones), er.ESTIMATE_COLUMNS))

    def imu(self, i: int, t_sample_s: float, accel_m_s2: Vector, gyro_rad_s: Vector) -> None:
        """Take a sample of an IMU in the sensor's axes."""
        self._keep(i, er.IMU, t_sample_s, t_sample_s, *accel_m_s2, *gyro_rad_s, 0.0, 0.0)

    def gps(
        self, i: int, t_s: float, t_sample_s: float, position_m: Vector, velocity_m_s: Vector, sigma_m: float, fix: int
    ) -> None:
        """Take a fix; `sigma_m` per axis counts where it is worse than what the scenario says."""
        self._keep(i, er.GPS, t_s, t_sample_s, *position_m, *velocity_m_s, sigma_m, fix)

    def mag(self, i: int, t_s: float, t_sample_s: float, field_ut: Vector) -> None:
        """Take the field in the sensor's axes."""
        self._keep(i, er.MAG, t_s, t_sample_s, *field_ut, 0.0, 0.0, 0.0, 0.0, 0.0)

    def baro(self, i: int, t_s: float, t_sample_s: float, altitude_m: float) -> None:
        """Take a barometric height over the world's origin."""
        self._keep(i, er.BARO, t_s, t_sample_s, altitude_m, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def sonar(self, i: int, t_s: float, t_sample_s: float, range_m: float, valid: bool) -> None:
        """Take a range to the ground; one marked as invalid says nothing and is not counted."""
        self._keep(i, er.SONAR, t_s, t_sample_s, range_m, 0.0, 0.0, 0.0, 0.0, 0.0, valid, 0.0)

    def flow(self, i: int, t_s: float, t_sample_s: float, velocity_m_s: Vector, quality: float) -> None:
        """Take a velocity in the heading frame; without quality, or before a heading is known, it is refused."""
        self._keep(i, er.FLOW, t_s, t_sample_s, *velocity_m_s, 0.0, 0.0, 0.0, quality, 0.0)

    def read_gate(self, gate: GateMessages) -> bool:
        """Take all sensors of a gate; False, and none, if one of its messages is not as the world writes it."""
        while self._came + len(gate) > len(self._readings):
            self._grow()
        came = self._reader.take(gate, self._readings, self._came)
        if came >= 0:
            self._came = came
        return came >= 0

    def close(self, t_s: float) -> list[Estimate]:
        """Use what has come since the last gate and return the estimates for `t_s`."""
        came, self._came = self._came, 0
        self.use(t_s, self._readings[:came])
        counts = self.rows.tally[:, er.USED :].tolist()
        return [_estimate(row, count) for row, count in zip(self._told.tolist(), counts, strict=True)]

    def use(self, t_s: float, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Use readings (M, READING_COLUMNS) and return the estimates for `t_s`, (N, ESTIMATE_COLUMNS)."""
        close(self.rows, t_s, readings, self._told)
        return self._told

    def warm_start(
        self,
        i: int,
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
        row, setting, P = self.rows.nominal[i], self.rows.setting[i], self.rows.covariance[i]
        row[er.P : er.P + 3], row[er.V : er.V + 3] = position_m, velocity_m_s
        row[er.V_BEFORE : er.V_BEFORE + 3] = velocity_m_s
        er.put_quaternion(row, er.Q, normalised((w, x, y, z)))
        state = er.reckoning(row)
        er.put(row, er.A, acceleration(state[2], state[5], setting[er.GRAVITY]))
        row[er.GYRO_OFF : er.GYRO_OFF + 3] = gyro_bias_rad_s
        P[:6, :6] = np.reshape(covariance, (6, 6))
        set_variance(P, YAW_STATE, yaw_sigma_rad**2)
        self.rows.tally[i, er.HEADING_KNOWN] = yaw_sigma_rad < HEADING_SIGMA_RAD

    def _keep(self, *reading: float) -> None:
        if self._came == len(self._readings):
            self._grow()
        _READING.pack_into(self._room, self._came * _READING.size, *reading)
        self._came += 1

    def _grow(self) -> None:
        former = self._readings
        self._make_room(2 * len(former))
        self._readings[: len(former)] = former

    def _make_room(self, readings: int) -> None:
        self._room = bytearray(readings * _READING.size)
        self._readings = np.frombuffer(self._room).reshape(readings, er.READING_COLUMNS)


class _Belief:
    """What is believed of one drone before its first reading, as the rows have it."""

    def __init__(self, drone: Drone, environment: Environment, estimation: Estimation, gate_s: float) -> None:
        imu, gravity, found = drone.sensors.imu, environment.gravity_m_s2, aids(drone.sensors)
        used = {"mag": estimation.magnetometer, "flow": estimation.flow}
        wanted = [aid for name, aid in found.items() if used.get(name, True)]
        beta = madgwick_beta(estimation, imu, gravity)
        noise, priors = process_noise(imu, beta, gravity), bias_priors(imu, wanted)
        self.states = ErrorState(priors)
        set_start(self.states.covariance)
        oldest_s = age_max_s(drone, gate_s)
        self.history = history_length(oldest_s, gate_s)
        mount = imu.mount
        aside = mount.rpy_deg != ZERO or mount.position_m != ZERO
        self.setting = [
            gravity, beta, 1.0 / imu.rate_hz, coast_after_s(imu, gate_s), jolt_m_s2(noise.accel_sigma), oldest_s,
            math.radians(drone.yaw_deg), noise.accel_sigma**2, noise.gyro_sigma**2, noise.tilt_density,
            noise.levelling_s, *environment.magnetic_field_ut, *mount_rotation(mount), *mount.position_m,
        ]  # fmt: skip
        self.fixed = [
            self.states.size, self.history, aside, self.states.with_accel_bias, self.states.aiding_biases,
            estimation.magnetometer, estimation.flow,
        ]  # fmt: skip
        for kind in er.KINDS:
            self.setting += _aid_setting(found.get(kind))
            self.fixed += self._bias_places(found.get(kind))

    def _bias_places(self, aid: Aid | None) -> list[int]:
        rows = aid.bias_rows if aid else []
        places: list[int] = []
        for channel, row in rows:
            if aid and channel in self.states.bias_index:
                places += [self.states.bias_index[channel], row, aid.biases[channel].size]
        return places + [-1, 0, 0] * ((er.BIAS_COLUMNS - len(places)) // 3)


def _aid_setting(aid: Aid | None) -> list[float]:
    if aid is None:
        return [0.0] * er.AID_COLUMNS
    variance = [*aid.variance, *_NONE[len(aid.variance) :]]
    return [*variance, *aid.arm, *aid.R_BS, *aid.down_B, PATIENCE_S[aid.name]]


def _rows(believed: Sequence[_Belief], gate_probability: float) -> er.Rows:
    count, size = len(believed), max(each.states.size for each in believed)
    covariance, walk = np.zeros((count, size, size)), np.zeros((count, size))
    for i, each in enumerate(believed):
        n = each.states.size
        covariance[i, :n, :n], walk[i, :n] = each.states.covariance, each.states.walk
    setting = np.array([each.setting for each in believed], dtype=float)
    nominal = np.zeros((count, er.NOMINAL_COLUMNS))
    nominal[:, er.Q : er.Q + 4] = LEVEL
    nominal[:, er.F + 2] = setting[:, er.GRAVITY]
    nominal[:, er.START] = nominal[:, er.REFUSED_SINCE : er.REFUSED_SINCE + len(er.KINDS)] = math.nan
    nominal[:, er.T_SAMPLE : er.T_SAMPLE + len(er.KINDS)] = -math.inf
    return er.Rows(
        nominal=nominal,
        tally=np.zeros((count, er.TALLY_COLUMNS), dtype=np.int64),
        covariance=covariance,
        bias=np.zeros((count, size)),
        history=np.zeros((count, max(each.history for each in believed), er.MOMENT_COLUMNS)),
        setting=setting,
        fixed=np.array([each.fixed for each in believed], dtype=np.int64),
        walk=walk,
        limits=innovation_limits(gate_probability),
    )


def _estimate(row: list[float], count: list[int]) -> Estimate:
    """Return a row of estimates and its drone's (used, refused) by kind as what is published."""
    half = len(er.KINDS)
    return Estimate(
        (row[0], row[1], row[2]),
        (row[3], row[4], row[5]),
        (row[6], row[7], row[8], row[9]),
        row[er.YAW],
        tuple(row[er.COVARIANCE : er.YAW_SIGMA]),
        row[er.YAW_SIGMA],
        (row[er.GYRO_BIAS_B], row[er.GYRO_BIAS_B + 1], row[er.GYRO_BIAS_B + 2]),
        {kind: (count[k], count[half + k]) for k, kind in _IN_ORDER},
    )
