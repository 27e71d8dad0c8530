"""A custom estimator that replaces the stock one, with gains that decrease to fixed values instead of a Kalman filter.

    zsim run scenarios/step.yaml --set estimation.algorithm=my_estimator:MyEstimator

The module is found on Python's path (`PYTHONPATH=examples`) or in the folder of the scenario file. The estimator's
methods are described in `zsim_agents.estimation.drone_estimator.DroneEstimator`.
"""

import math
from typing import Any

from zsim.contract import messages
from zsim.contract.keys import SENSORS
from zsim.scenario.scenario import Drone, Environment, Estimation
from zsim_agents.estimation.drone_estimator import StateEstimate

GPS_GAIN = 0.02  # minimum gain for a fix; the first 1 / GPS_GAIN fixes are averaged
HEIGHT_GAIN, HEADING_GAIN = 0.1, 0.05  # minimum gains for barometer and magnetometer samples
GPS_SIGMA_M, HEIGHT_SIGMA_M, SPEED_SIGMA_M_S, YAW_SIGMA_RAD = 2.0, 0.03, 0.1, 0.02  # with the noise of preset `paper`


class MyEstimator:
    """Position from GPS and flow sensor, height from the barometer, heading from gyro and magnetometer."""

    def __init__(self, drone: Drone, environment: Environment, estimation: Estimation, gate_s: float) -> None:
        east, north, _ = environment.magnetic_field_ut
        self._bearing = math.atan2(north, east)
        self._dt = gate_s
        self._p, self._v = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self._yaw = self._rate = 0.0
        self._used = dict.fromkeys(SENSORS, 0)

    def receive(self, sensor: str, message: Any) -> None:
        if sensor in self._used:
            self._used[sensor] += 1
            getattr(self, f"_on_{sensor}", lambda m: None)(message)

    def _on_imu(self, m: messages.Imu) -> None:
        self._rate = m.gyro_rad_s[2]

    def _on_mag(self, m: messages.Mag) -> None:
        seen = self._bearing - math.atan2(m.field_ut[1], m.field_ut[0])  # as if the drone were level
        gain = max(HEADING_GAIN, 1 / self._used["mag"])
        self._yaw += gain * math.remainder(seen - self._yaw, math.tau)

    def _on_flow(self, m: messages.Flow) -> None:
        c, s = math.cos(self._yaw), math.sin(self._yaw)
        forward, left, up = m.velocity_m_s
        self._v = [c * forward - s * left, s * forward + c * left, up]

    def _on_gps(self, m: messages.Gps) -> None:
        gain = self._gps_gain()
        for k in (0, 1):
            self._p[k] += gain * (m.position_m[k] - self._p[k])

    def _on_baro(self, m: messages.Baro) -> None:
        self._p[2] += max(HEIGHT_GAIN, 1 / self._used["baro"]) * (m.altitude_m - self._p[2])

    def _gps_gain(self) -> float:
        return max(GPS_GAIN, 1 / max(1, self._used["gps"]))

    def estimate(self, t_s: float) -> StateEstimate:
        self._yaw = math.remainder(self._yaw + self._rate * self._dt, math.tau)
        self._p = [p + v * self._dt for p, v in zip(self._p, self._v, strict=True)]
        return StateEstimate(
            position_m=self._p,
            velocity_m_s=self._v,
            orientation_wxyz=(math.cos(self._yaw / 2), 0.0, 0.0, math.sin(self._yaw / 2)),
            yaw_rad=self._yaw,
            covariance=self._covariance(),
            yaw_sigma_rad=YAW_SIGMA_RAD,
            sensors={name: (count, 0) for name, count in self._used.items()},
        )

    def snapshot(self) -> dict[str, Any]:
        """Return the complete state, from which a successor continues if this process dies."""
        return {"p": self._p, "v": self._v, "yaw": self._yaw, "rate": self._rate, "used": self._used}

    def restore(self, state: dict[str, Any]) -> None:
        self._p, self._v, self._yaw, self._rate, self._used = (
            state[name] for name in ("p", "v", "yaw", "rate", "used")
        )

    def _covariance(self) -> tuple[float, ...]:
        """Return a diagonal 6 x 6 matrix, row-major; `level` is the variance of filtered white GPS errors."""
        gain = self._gps_gain()
        level, up, speed = gain / (2 - gain) * GPS_SIGMA_M**2, HEIGHT_SIGMA_M**2, SPEED_SIGMA_M_S**2
        diagonal = (level, level, up, speed, speed, speed)
        return tuple(diagonal[i] if i == j else 0.0 for i in range(6) for j in range(6))
