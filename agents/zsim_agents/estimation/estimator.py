"""The estimator of one or several drones as an agent: receives sensor messages, publishes estimates at every gate."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from msgspec import UNSET, Struct

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import ViewEstimates, estimate_view
from zsim.contract.framing import GateMessages, key_table
from zsim.contract.snapshot import State
from zsim.errors import RunError
from zsim.math.compiled import COMPILES
from zsim.runtime.agent import Agent, Output
from zsim.runtime.inbox import Input
from zsim.scenario.scenario import Scenario
from zsim.schema import parameters
from zsim_agents.estimation.drone_estimator import EstimatorSet, estimator_class
from zsim_agents.estimation.estimator_bank import EstimatorBank
from zsim_agents.estimation.joint_filter import ClusterBanks


class Estimator(Agent):
    """Passes the messages on `drone/{d}/sensor/*` to the estimators: banks, or one object of another class per drone.

    The agent is named after the first of its drones, and also serves under the names of the others.

    Raises:
        RunError: the scenario lacks one of the drones, or none is given.
        DocumentError: the class named in the scenario cannot be loaded on this machine.
    """

    def __init__(self, info: messages.Info, scenario: Scenario, drones: str | Sequence[str]) -> None:
        super().__init__()
        names = (drones,) if isinstance(drones, str) else tuple(drones)
        known = [drone.name for drone in scenario.drones]
        for name in names or ("",):
            if name not in known:
                raise RunError(f"estimator: drone is {name!r}; must be one of {', '.join(known)}")
        self.name, *others = (f"estimator.{drone}" for drone in names)
        self.serves = tuple(others)
        self.period_ns = info.gate_ns
        self.writes = tuple(keys.estimate(drone) for drone in names)
        gate_s = info.gate_ns / 1e9
        settings = ([scenario.drone(drone) for drone in names], scenario.environment, scenario.estimation, gate_s)
        own_class = estimator_class(scenario.estimation.chosen(), "world/info: estimation.algorithm")
        self._build: Callable[[], Any] = partial(EstimatorBank, *settings)
        if own_class:
            own_class = parameters.bound(own_class, scenario.estimation.parameters, "estimation.parameters")
            self._build = partial(EstimatorSet, own_class, *settings)
        elif scenario.estimation.use_sightings is True:
            self._build = partial(ClusterBanks, scenario, names, gate_s)
        self._estimators = self._build()
        read = names
        if isinstance(self._estimators, ClusterBanks):
            read = tuple(self._estimators.drones)
            specs = [scenario.drone(drone) for drone in read]  # sightings not from the world come from detectors
            detected = (each.name for each in specs if each.sensors.sightings is UNSET or each.is_external)
            self.uncounted = tuple(map(keys.detections, detected))
        self.gate_keys = tuple(keys.status(drone) for drone in read)
        self.counted = read
        if own_class:
            self.reads = tuple(keys.sensors(drone) for drone in read)
        else:
            # One subscription per sensor lets the process sleep until `status`, the last message of a gate, and wake
            # up once. Users' sensors are read because `status` counts them.
            kinds = (*keys.SENSORS, *info.sensors_beside, "status")
            self.reads = (*(keys.sensor(drone, kind) for drone in read for kind in kinds), *self.uncounted)
        self._last: dict[str, flight_messages.Estimate] = {}
        self._view_key = keys.estimates_view(self.name)
        self.takes_gates = COMPILES and not own_class
        self._gate_start_ns = 0
        self._index = {drone: i for i, drone in enumerate(read)}
        self._names = names
        self._silent = {drone.name for drone in scenario.drones if drone.is_external}
        self._external = frozenset(self._silent)

    def deliver(self, t_ns: int, inputs: Sequence[Input]) -> None:
        self._gate_start_ns = t_ns - self.period_ns
        super().deliver(t_ns, inputs)

    def receive(self, key: str, message: Any) -> None:
        if isinstance(message, flight_messages.Status):
            self._silent.discard(keys.thing(key))
            return
        _, drone, what = keys.parts(key)
        if drone in self._index:
            # a message over a slow link has arrived since the last gate, whatever its time stamp
            t_arrival_s = max(message.t_ns, self._gate_start_ns) * 1e-9
            self._estimators.receive(self._index[drone], what.removeprefix("sensor/"), message, t_arrival_s)

    def receive_gate(self, gate: GateMessages) -> None:
        if not self._estimators.receive_gate(gate):
            super().receive_gate(gate)

    def step(self, t_ns: int) -> list[Output]:
        estimates = self._estimators.estimate(t_ns * 1e-9)
        named_estimates = zip(self._names, self.writes, estimates, strict=True)
        if self._external:  # a drone whose driver has been silent since the last gate gets no estimate
            named_estimates = [each for each in named_estimates if each[0] not in self._silent]
            self._silent = set(self._external)
        make: Any = flight_messages.Estimate  # Any: sequences in a StateEstimate are not typed by length
        source, self._last, outputs = self.source, {}, []
        for drone, key, estimate in named_estimates:
            self._last[drone] = message = make(t_ns, self.next_seq(key), *estimate, source=source)
            outputs.append(Output(key, message))
        return outputs

    def views(self, t_ns: int) -> list[Output]:
        views = tuple(estimate_view(drone, estimate) for drone, estimate in self._last.items())
        return [Output(self._view_key, ViewEstimates(t_ns, self.next_seq(self._view_key), views))]

    def rehearse(self) -> None:
        if isinstance(self._estimators, EstimatorSet):
            return
        bank, drone, t_ns, zero = self._build(), self._names[0], 1_000_000, (0.0, 0.0, 0.0)
        readings: dict[str, Struct] = {
            "imu": messages.Imu(t_ns, 0, t_ns, (0.0, 0.0, 9.8), zero),
            "gps": messages.Gps(t_ns, 0, t_ns, 0.0, 0.0, 0.0, zero, zero, 1.0, 3, 9),
            "mag": messages.Mag(t_ns, 0, t_ns, (0.0, 20.0, 0.0)),
            "baro": messages.Baro(t_ns, 0, t_ns, 101_325.0, 0.0),
        }
        payloads = [(keys.sensor(drone, sensor), messages.encode(message)) for sensor, message in readings.items()]
        bank.receive_gate(GateMessages.of(t_ns, 0, key_table(self.counted), payloads))
        bank.estimate(t_ns * 1e-9)

    def snapshot(self) -> State | None:
        return self._estimators.snapshot()

    def restore(self, state: State) -> None:
        self._estimators.restore(state)

    def warm_start_keys(self) -> tuple[str, ...]:
        return self.writes

    def warm_start(self, key: str, message: flight_messages.Estimate) -> None:
        self._estimators.warm_start(self.writes.index(key), message)
