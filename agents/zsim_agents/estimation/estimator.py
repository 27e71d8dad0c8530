"""The estimator of one drone, or of several, as an agent: sensors in, an estimate of each drone out at every gate.

Order of this file: the agent, `receive` by key, `step`, warm start.
"""

from collections.abc import Callable, Sequence
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages, key_table
from zsim.contract.views import estimate_view
from zsim.errors import RunError
from zsim.math.compiled import COMPILES
from zsim.runtime.agent import Agent, Output
from zsim.runtime.routing import Input
from zsim.scenario.scenario import Scenario
from zsim_agents.estimation.estimate import Estimate
from zsim_agents.estimation.estimator_set import estimators


class Estimator(Agent):
    """Feeds an EstimatorSet from `drone/{d}/sensor/*`.

    It has the name of the first of its drones and stands for the estimators of the others too.

    Args:
        info: of the run.
        scenario: the resolved one that the info carries.
        drones: a name, or several.

    Raises:
        RunError: the scenario has no such drone, or none is named.
    """

    def __init__(self, info: messages.Info, scenario: Scenario, drones: str | Sequence[str]) -> None:
        super().__init__()
        names = (drones,) if isinstance(drones, str) else tuple(drones)
        _check(names, scenario)
        self.name, *others = (f"estimator.{drone}" for drone in names)
        self.serves = tuple(others)
        self.period_ns = info.gate_ns
        self.reads = tuple(expression for drone in names for expression in _reads(drone))
        self.gate_keys = tuple(keys.status(drone) for drone in names)
        self.counted = names
        self.writes = tuple(keys.estimate(drone) for drone in names)
        specs = [scenario.drone(drone) for drone in names]
        self._settings = (specs, scenario.environment, scenario.estimation, info.gate_ns / 1e9)
        self._set = estimators(*self._settings)
        self._told: list[Estimate] = []
        self._view_key = keys.estimates_view(self.name)
        self.takes_gates = COMPILES
        self._since_ns = 0
        self._take = {key: take for i, drone in enumerate(names) for key, take in self._takers(i, drone)}

    def _takers(self, i: int, drone: str) -> list[tuple[str, Callable[[Any], None]]]:
        """Return what is to be done with a message of each key of a drone."""
        s = self._set
        by_kind: dict[str, Callable[[Any], None]] = {
            "imu": lambda m: s.imu(i, m.t_sample_ns * 1e-9, m.accel_m_s2, m.gyro_rad_s),
            "gps": lambda m: s.gps(
                i, self._arrived_s(m), m.t_sample_ns * 1e-9, m.position_m, m.velocity_m_s, m.sigma_m, m.fix
            ),
            "mag": lambda m: s.mag(i, self._arrived_s(m), m.t_sample_ns * 1e-9, m.field_ut),
            "baro": lambda m: s.baro(i, self._arrived_s(m), m.t_sample_ns * 1e-9, m.altitude_m),
            "sonar": lambda m: s.sonar(i, self._arrived_s(m), m.t_sample_ns * 1e-9, m.range_m, m.valid),
            "flow": lambda m: s.flow(i, self._arrived_s(m), m.t_sample_ns * 1e-9, m.velocity_m_s, m.quality),
            "status": lambda m: None,
        }
        return [(keys.sensor(drone, kind), take) for kind, take in by_kind.items()]

    def deliver(self, t_ns: int, inputs: Sequence[Input]) -> None:
        self._since_ns = t_ns - self.period_ns
        super().deliver(t_ns, inputs)

    def _arrived_s(self, message: Any) -> float:
        """Return when a reading came: as it says, or, when a slow link brings it, not before the last gate."""
        return max(message.t_ns, self._since_ns) * 1e-9

    def receive(self, key: str, message: Any) -> None:
        self._take[key](message)

    def receive_gate(self, gate: GateMessages) -> None:
        if not self._set.read_gate(gate):
            super().receive_gate(gate)

    def step(self, t_ns: int) -> list[Output]:
        self._told = self._set.close(t_ns * 1e-9)
        told = zip(self.writes, self._told, strict=True)
        return [
            Output(key, messages.Estimate(t_ns, self.next_seq(key), *estimate, source=self.source))
            for key, estimate in told
        ]

    def views(self, t_ns: int) -> list[Output]:
        shown = tuple(map(estimate_view, self.counted, self._told))
        return [Output(self._view_key, messages.ViewEstimates(t_ns, self.next_seq(self._view_key), shown))]

    def rehearse(self) -> None:
        drones, place, _, gate_s = self._settings
        twin, still, sigma_m, fix = estimators(*self._settings), (0.0, 0.0, 0.0), 1.0, 3
        sample = messages.encode(messages.Imu(0, 0, 0, still, still))
        twin.read_gate(GateMessages.of(0, 0, key_table(self.counted), [(keys.sensor(self.counted[0], "imu"), sample)]))
        for gate in range(1, 4):
            t_s = gate * gate_s
            twin.imu(0, t_s, (0.0, 0.0, place.gravity_m_s2), still)
            twin.mag(0, t_s, t_s, place.magnetic_field_ut)
            twin.gps(0, t_s, t_s, still, still, sigma_m, fix)
            twin.baro(0, t_s, t_s, 0.0)
            twin.sonar(0, t_s, t_s, drones[0].sensors.sonar.min_m, True)
            twin.flow(0, t_s, t_s, still, 1.0)
            twin.close(t_s)

    def warm_start_keys(self) -> tuple[str, ...]:
        return self.writes

    def warm_start(self, key: str, message: messages.Estimate) -> None:
        self._set.warm_start(
            self.writes.index(key),
            message.position_m,
            message.velocity_m_s,
            message.orientation_wxyz,
            message.covariance,
            message.yaw_sigma_rad,
            message.gyro_bias_rad_s,
        )


def _reads(drone: str) -> tuple[str, ...]:
    """One subscription per sensor: the process sleeps until status, the last of a gate, and wakes once."""
    return (*(keys.sensor(drone, kind) for kind in keys.SENSORS), keys.status(drone))


def _check(names: Sequence[str], scenario: Scenario) -> None:
    known = [drone.name for drone in scenario.drones]
    for name in names or ("",):
        if name not in known:
            raise RunError(f"estimator: drone is {name!r}; must be one of {', '.join(known)}")
