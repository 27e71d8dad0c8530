"""The estimators of several drones behind one interface: a compiled bank, or one by one where nothing is compiled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from zsim.contract.framing import GateMessages
from zsim.math.compiled import COMPILES
from zsim.scenario.scenario import Drone, Environment, Estimation
from zsim_agents.estimation.estimate import Estimate
from zsim_agents.estimation.madgwick import Vector


class EstimatorSet(Protocol):
    """What fuses the sensors of several drones; `i` counts them. The methods are those of DroneEstimator."""

    def imu(self, i: int, t_sample_s: float, accel_m_s2: Vector, gyro_rad_s: Vector) -> None: ...

    def gps(
        self, i: int, t_s: float, t_sample_s: float, position_m: Vector, velocity_m_s: Vector, sigma_m: float, fix: int
    ) -> None: ...

    def mag(self, i: int, t_s: float, t_sample_s: float, field_ut: Vector) -> None: ...

    def baro(self, i: int, t_s: float, t_sample_s: float, altitude_m: float) -> None: ...

    def sonar(self, i: int, t_s: float, t_sample_s: float, range_m: float, valid: bool) -> None: ...

    def flow(self, i: int, t_s: float, t_sample_s: float, velocity_m_s: Vector, quality: float) -> None: ...

    def read_gate(self, gate: GateMessages) -> bool: ...

    def close(self, t_s: float) -> list[Estimate]: ...

    def warm_start(
        self,
        i: int,
        position_m: Sequence[float],
        velocity_m_s: Sequence[float],
        orientation_wxyz: Sequence[float],
        covariance: Sequence[float],
        yaw_sigma_rad: float,
        gyro_bias_rad_s: Sequence[float],
    ) -> None: ...


class OneByOne:
    """A DroneEstimator per drone; the arguments are those of EstimatorBank."""

    def __init__(
        self, drones: Sequence[Drone], environment: Environment, estimation: Estimation, gate_s: float
    ) -> None:
        from zsim_agents.estimation.drone_estimator import DroneEstimator

        self._cores = [DroneEstimator(drone, environment, estimation, gate_s) for drone in drones]

    def imu(self, i: int, t_sample_s: float, accel_m_s2: Vector, gyro_rad_s: Vector) -> None:
        self._cores[i].imu(t_sample_s, accel_m_s2, gyro_rad_s)

    def gps(
        self, i: int, t_s: float, t_sample_s: float, position_m: Vector, velocity_m_s: Vector, sigma_m: float, fix: int
    ) -> None:
        self._cores[i].gps(t_s, t_sample_s, position_m, velocity_m_s, sigma_m, fix)

    def mag(self, i: int, t_s: float, t_sample_s: float, field_ut: Vector) -> None:
        self._cores[i].mag(t_s, t_sample_s, field_ut)

    def baro(self, i: int, t_s: float, t_sample_s: float, altitude_m: float) -> None:
        self._cores[i].baro(t_s, t_sample_s, altitude_m)

    def sonar(self, i: int, t_s: float, t_sample_s: float, range_m: float, valid: bool) -> None:
        self._cores[i].sonar(t_s, t_sample_s, range_m, valid)

    def flow(self, i: int, t_s: float, t_sample_s: float, velocity_m_s: Vector, quality: float) -> None:
        self._cores[i].flow(t_s, t_sample_s, velocity_m_s, quality)

    def read_gate(self, gate: GateMessages) -> bool:
        return False

    def close(self, t_s: float) -> list[Estimate]:
        return [core.close(t_s) for core in self._cores]

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
        self._cores[i].warm_start(
            position_m, velocity_m_s, orientation_wxyz, covariance, yaw_sigma_rad, gyro_bias_rad_s
        )


def estimators(
    drones: Sequence[Drone], environment: Environment, estimation: Estimation, gate_s: float
) -> EstimatorSet:
    """Return what fuses the sensors of these drones fastest here; both give the same bits."""
    if COMPILES:
        from zsim_agents.estimation.estimator_bank import EstimatorBank

        return EstimatorBank(drones, environment, estimation, gate_s)
    return OneByOne(drones, environment, estimation, gate_s)
