"""The estimator of one drone as an agent: sensors in, estimate out at every gate.

Order of this file: the agent, `receive` by message, `step`, warm start.
"""

from collections.abc import Callable
from typing import Any

from zsim import keys, messages
from zsim.agent import Agent, Output
from zsim.errors import RunError
from zsim.scenario import Scenario
from zsim_agents.drone_estimator import DroneEstimator


class Estimator(Agent):
    """Feeds a DroneEstimator from `drone/{d}/sensor/*`.

    Args:
        info: of the run.
        scenario: the resolved one that the info carries.
        drone: name.

    Raises:
        RunError: the scenario has no such drone.
    """

    def __init__(self, info: messages.Info, scenario: Scenario, drone: str) -> None:
        super().__init__()
        if drone not in {d.name for d in scenario.drones}:
            known = ", ".join(d.name for d in scenario.drones)
            raise RunError(f"estimator: drone is {drone!r}; must be one of {known}")
        self.name = f"estimator.{drone}"
        self.period_ns = info.gate_ns
        # One subscription per sensor: the process sleeps until status, the last of a gate, and wakes once.
        self.reads = (*(keys.sensor(drone, kind) for kind in keys.SENSORS), keys.status(drone))
        self.gate_keys = (keys.status(drone),)
        self.counted = (drone,)
        self._key = keys.estimate(drone)
        self._settings = (scenario.drone(drone), scenario.environment, scenario.estimation, info.gate_ns / 1e9)
        self._core = DroneEstimator(*self._settings)
        self._take: dict[type, Callable[[Any], None]] = {
            messages.Imu: self._on_imu,
            messages.Gps: self._on_gps,
            messages.Mag: self._on_mag,
            messages.Baro: self._on_baro,
            messages.Sonar: self._on_sonar,
            messages.Flow: self._on_flow,
            messages.Status: lambda message: None,
        }

    def receive(self, key: str, message: Any) -> None:
        self._take[type(message)](message)

    def _on_imu(self, m: messages.Imu) -> None:
        self._core.imu(m.t_sample_ns * 1e-9, m.accel_m_s2, m.gyro_rad_s)

    def _on_gps(self, m: messages.Gps) -> None:
        self._core.gps(m.t_ns * 1e-9, m.t_sample_ns * 1e-9, m.position_m, m.velocity_m_s, m.sigma_m, m.fix)

    def _on_mag(self, m: messages.Mag) -> None:
        self._core.mag(m.t_ns * 1e-9, m.t_sample_ns * 1e-9, m.field_ut)

    def _on_baro(self, m: messages.Baro) -> None:
        self._core.baro(m.t_ns * 1e-9, m.t_sample_ns * 1e-9, m.altitude_m)

    def _on_sonar(self, m: messages.Sonar) -> None:
        self._core.sonar(m.t_ns * 1e-9, m.t_sample_ns * 1e-9, m.range_m, m.valid)

    def _on_flow(self, m: messages.Flow) -> None:
        self._core.flow(m.t_ns * 1e-9, m.t_sample_ns * 1e-9, m.velocity_m_s, m.quality)

    def step(self, t_ns: int) -> list[Output]:
        estimate = self._core.close(t_ns * 1e-9)
        message = messages.Estimate(t_ns, self.next_seq(self._key), *estimate, source=self.name)
        return [Output(self._key, message)]

    def rehearse(self) -> None:
        drone, place, _, gate_s = self._settings
        twin, still, sigma_m, fix = DroneEstimator(*self._settings), (0.0, 0.0, 0.0), 1.0, 3
        for gate in range(1, 4):
            t_s = gate * gate_s
            twin.imu(t_s, (0.0, 0.0, place.gravity_m_s2), still)
            twin.mag(t_s, t_s, place.magnetic_field_ut)
            twin.gps(t_s, t_s, still, still, sigma_m, fix)
            twin.baro(t_s, t_s, 0.0)
            twin.sonar(t_s, t_s, drone.sensors.sonar.min_m, True)
            twin.flow(t_s, t_s, still, 1.0)
            twin.close(t_s)

    def warm_start_keys(self) -> tuple[str, ...]:
        return (self._key,)

    def warm_start(self, key: str, message: messages.Estimate) -> None:
        self._core.warm_start(
            message.position_m,
            message.velocity_m_s,
            message.orientation_wxyz,
            message.covariance,
            message.yaw_sigma_rad,
            message.gyro_bias_rad_s,
        )
