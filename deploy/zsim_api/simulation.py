"""A flight in this process that is stepped from Python, one gate at a time.

    sim = zsim.Simulation("step.yaml", agents=None)
    sim.step({"drone1": zsim.takeoff()})
    while sim.t_s < 10:
        sim.step({"drone1": zsim.velocity(0.5, 0, 0)})
    print(sim.truth.position_m[0])

The flight is bit-identical to that of `zsim run --in-process`, with the caller as one more participant.
"""

import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from msgspec import Struct, structs
from numpy.typing import NDArray

from zsim.contract import keys, messages
from zsim.contract.flight_messages import ClusterState, Estimate
from zsim.contract.framing import GateMessages
from zsim.contract.messages import Info
from zsim.contract.run_messages import ControlRequest, Event
from zsim.errors import RequestRefusedError, RunError
from zsim.output_folder import RECORD
from zsim.record import RecordWriter
from zsim.runtime.agent import Agent
from zsim.schema.checker import suggestion
from zsim.sensors.sensor import Sample
from zsim_analysis.in_process import CALLER, FlightObserver, InProcessFlight, OwnAgent, sequence_of_agents, with_agents
from zsim_api.commands import Command, PilotedDrone
from zsim_api.flight import calling
from zsim_api.scenarios import AnyScenario, scenario_of
from zsim_world.physics.fleet_arrays import STATE

Array = NDArray[np.float64]
GATES_HELD = 64  # maximum number of gates whose sensor messages are kept undecoded; design choice: 0.3 MB for 3 drones


class Truth(NamedTuple):
    """The true state of N drones, in the order of `Simulation.names`: read-only views, which change with every step."""

    position_m: Array  # (N, 3), W
    velocity_m_s: Array  # (N, 3), W
    orientation_wxyz: Array  # (N, 4), B to W
    angular_velocity_rad_s: Array  # (N, 3), B
    accel_m_s2: Array  # (N, 3), W
    rotor_rad_s: Array  # (N, R), 0 for rotors that a drone does not have


class Estimates(NamedTuple):
    """The newest estimates of N drones; NaN before the first one, or for a drone without an estimator."""

    position_m: Array  # (N, 3), W
    velocity_m_s: Array  # (N, 3), W
    orientation_wxyz: Array  # (N, 4), B to W
    yaw_rad: Array  # (N,)
    covariance: Array  # (N, 6, 6) of position and velocity, SI units
    yaw_sigma_rad: Array  # (N,)


def estimates_of(names: Sequence[str], by_drone: Mapping[str, Estimate]) -> Estimates:
    """Return the estimates of drones, in the order of `names`."""
    shapes = {"position_m": (3,), "velocity_m_s": (3,), "orientation_wxyz": (4,), "covariance": (6, 6)}
    columns = [np.full((len(names), *shapes.get(field, ())), np.nan) for field in Estimates._fields]
    for i, estimate in enumerate(map(by_drone.get, names)):
        for field, column in zip(Estimates._fields, columns, strict=True):
            if estimate is not None:
                column[i] = np.reshape(getattr(estimate, field), shapes.get(field, ()))
    return Estimates(*columns)


class Simulation:
    """World and agents of a scenario, stepped gate by gate.

    Timing: the commands of a `step` carry the stamp of the gate that the caller has just seen, at `t_s`, like those of
    an agent. They act from `t_s + command_delay_s` on. With the usual delay of one gate, their effect is visible not in
    the state after this step, but in the one after the next step.

    Args:
        scenario: path of a YAML file, `zsim.Scenario`, or a mapping as in YAML.
        seed, duration_s: replace those of the scenario.
        set: new values of the scenario's fields by path, as in `{"environment.wind.gust_m_s": 1.0}`.
        agents: "stock": the scenario's estimators and controllers; None: none; or a sequence of your own agents,
            classes or objects, which fly beside the stock ones, or alone with `stock=False`.
        law, estimator: classes that replace those of all clusters and drones.
        record: folder for the record, which `zsim.load` reads; None: no record.

    Raises:
        ScenarioError: with one line for every fault in the scenario.
        RunError, RecordError: the scenario cannot be flown in one process; the folder already contains a record.

    Attributes:
        names: names of the drones, in the order of all arrays.
        truth, sensors, estimates: see `Truth`, `Sensors`, `Estimates`.
        clusters: newest state of each cluster's controller, by cluster.
        events: events of the last step.
    """

    def __init__(
        self,
        scenario: AnyScenario,
        *,
        seed: int | None = None,
        duration_s: float | None = None,
        set: Mapping[str, Any] | None = None,
        agents: Literal["stock"] | Sequence[OwnAgent] | None = "stock",
        stock: bool = True,
        law: type | None = None,
        estimator: type | None = None,
        record: str | Path | None = None,
    ) -> None:
        folder = Path(record) if record is not None else None
        self.source = scenario_of(scenario).changed(
            seed=seed, duration_s=duration_s, set=set, law=law, estimator=estimator
        )
        own_agents = () if agents is None or agents == "stock" else sequence_of_agents(agents, "'stock', None, or ")
        self._own: Sequence[OwnAgent] = tuple(own_agents)
        self._stock = stock and agents is not None
        self._pristine = {i: _copied(each) for i, each in enumerate(self._own) if isinstance(each, Agent)}
        self._folder, self._writer = folder, None
        self.reset()

    def reset(self, seed: int | None = None, set: Mapping[str, Any] | None = None) -> Truth:
        """Start a new flight; return its initial state; raise RunError if the flight is recorded.

        Agents given as objects get their initial attributes back.

        Args:
            seed: for this and later flights; None: as before.
            set: fields of the scenario by path, for this and later flights; None: as before.
        """
        if self._writer is not None:
            raise RunError("reset: this simulation is recorded, and a record holds one flight; use a new Simulation")
        source = self.source.changed(seed=seed, set=set)
        resolved = source.resolved  # raises ScenarioError before anything is changed
        self.source = source
        for i, attributes in self._pristine.items():
            own = vars(self._own[i])
            own.clear()
            own |= copy.deepcopy(attributes)
        self._is_closed = False
        self.scenario, own = with_agents(resolved, self._own)
        self._flight = flight = InProcessFlight(self.scenario, None, None, own, stock=self._stock, steered=True)
        self.info: Info = flight.info
        self.names = [drone.name for drone in self.scenario.drones]
        self.gate_s = self.info.gate_ns / 1e9
        self.command_delay_s = self.info.command_delay_ns / 1e9
        self.clusters: dict[str, ClusterState] = {}
        self.events: list[Event] = []
        self.sensors = Sensors(self.names)
        self._index = {name: i for i, name in enumerate(self.names)}
        self._last_estimates: dict[str, Estimate] = {}
        self._estimates: Estimates | None = None
        bodies = flight.world.fleet.bodies
        state, accel = bodies.state[:], bodies.accel[:, 0:3]
        state.setflags(write=False)
        accel.setflags(write=False)
        parts = (state[:, 0:3], state[:, 3:6], state[:, 6:10], state[:, 10:13], accel, state[:, STATE.size :])
        self.truth = Truth(*parts)
        observers: list[FlightObserver] = [self]
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            self.source.keep_modules(self._folder)
            self._writer = RecordWriter(self._folder / RECORD)
            observers.append(self._writer)
        flight.start(observers)
        self._turn()
        return self.truth

    @property
    def t_s(self) -> float:
        """The simulated time of the newest gate [s]."""
        return self._flight.world.now_ns / 1e9

    @property
    def ended(self) -> str | None:
        """Why the flight is over; None while it continues."""
        return self._flight.world.ended

    @property
    def truth_sha256(self) -> str:
        """The SHA-256 of the truth of all gates so far, as in `zsim report`."""
        return self._flight.world.truth_hash.hexdigest()

    @property
    def estimates(self) -> Estimates:
        """The newest estimates of all drones."""
        if self._estimates is None:
            self._estimates = estimates_of(self.names, self._last_estimates)
        return self._estimates

    def state(self, drone: str) -> str:
        """Return the state of a drone's firmware: "landed", "hovering", "flying" and so on."""
        return self._flight.world.fleet.status(self._index_of(drone))[0]

    def step(self, commands: Mapping[str, Command | Sequence[Command]] = {}) -> Truth:
        """Fly one gate.

        Args:
            commands: one or several by drone, created by `zsim.velocity` and the like; see the class for their timing.
                A drone without a command keeps its last one for `silence.hover_s`, then hovers.

        Raises:
            RunError: the flight is over, or there is no drone of that name; nothing was sent.
            Exception: raised by one of your classes, after a line on stderr that says where; the flight is over.
        """
        world = self._flight.world
        if world.ended is not None:
            raise RunError(f"step: the flight is over ({world.ended}); reset() begins another one")
        sent: list[tuple[str, Command]] = []
        for drone, given in commands.items():
            self._index_of(drone)
            several: Any = given if isinstance(given, list | tuple) else (given,)
            sent += [(drone, command) for command in several]
        self.events = []
        self._flight.send(sent)
        self._turn()
        return self.truth

    def run(self, until_s: float | None = None) -> str | None:
        """Continue without commands until a simulated time [s], or the end of the flight; return `ended`."""
        until_ns = np.inf if until_s is None else round(until_s * 1e9)
        while self.ended is None and self._flight.world.now_ns < until_ns:
            self.step()
        return self.ended

    def ask(self, key: str, op: str, **args: Any) -> dict[str, Any]:
        """Ask the world, a controller or a pilot: `sim.ask("cluster/main/control", "target", values={…})`.

        Equivalent to `zsim ask`; the request takes effect between this gate and the next.

        Raises:
            RequestRefusedError: the request was refused, for the reason given.
        """
        answer = self._flight.control(key, ControlRequest(op, args, CALLER))
        if not answer.ok:
            raise RequestRefusedError(answer.error)
        return answer.result or {}

    def drone(self, name: str) -> PilotedDrone:
        """Return a drone that can be asked to fly somewhere, if it has a `reference` in the scenario.

        Raises:
            RunError: no drone has that name.
        """
        self._index_of(name)
        return PilotedDrone(name, self.ask)

    def inject(self, fault: Mapping[str, Any]) -> dict[str, Any]:
        """Inject a fault, as in a scenario's `faults`, from the next gate on; see docs/faults.md."""
        return self.ask(keys.CONTROL, "fault_add", **fault)

    def snapshot(self) -> Any:
        """Return the complete state of the flight, for `restore`.

        Raises:
            RunError: one of your agents has no `snapshot`, or the flight is over.
        """
        if self.ended is not None:
            raise RunError(f"snapshot: the flight is over ({self.ended}); must be taken before its end")
        return (self.source, self._flight.snapshot(), dict(self._last_estimates), dict(self.clusters))

    def restore(self, snapshot: Any) -> Truth:
        """Continue from a snapshot, bit-identically; raise RunError if the flight is recorded."""
        source, flight, estimates, clusters = snapshot
        if self._writer is not None:
            raise RunError("restore: this simulation is recorded, and a record cannot go back; use a new Simulation")
        if source != self.source:
            self.source = source
            self.reset()
        self._flight.restore(flight)
        self._last_estimates, self.clusters, self._estimates = dict(estimates), dict(clusters), None
        self.events = []
        self.sensors.forget()
        return self.truth

    def close(self) -> None:
        """End the flight and finish its record."""
        if self._is_closed:
            return
        self._flight.world.clock.stop("closed")
        self._end()

    def _end(self) -> None:
        self._is_closed = True
        try:
            calling(self._flight.end, self._folder)
        finally:
            if self._writer is not None:
                self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def __repr__(self) -> str:
        state = f"ended: {self.ended}" if self.ended else f"at {self.t_s:g} of {self.scenario.duration_s:g} s"
        return f"<Simulation {self.scenario.name}, {len(self.names)} drones, seed {self.scenario.seed}, {state}>"

    def _turn(self) -> None:
        self._estimates = None
        self._flight.turn(1)
        if self._flight.world.failure is not None:
            self._end()
            raise self._flight.world.failure

    def _index_of(self, drone: str) -> int:
        index = self._index.get(drone)
        if index is None:
            hint = suggestion(drone, self.names)
            raise RunError(f"no drone is named {drone!r}; {hint}must be one of {', '.join(self.names)}")
        return index

    # Observer of the flight

    def add_message(self, key: str, message: Any, wall_ns: int) -> None:
        """Receive a message; called by the flight."""
        kind = type(message)
        if kind is Estimate:
            self._last_estimates[keys.thing(key)] = message
        elif kind is ClusterState:
            self.clusters[keys.thing(key)] = message
        elif kind is Event:
            self.events.append(message)

    def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
        """Receive the world's messages of a gate; called by the flight."""
        self.sensors.add(gate)


class Sensors(Mapping[str, "Samples"]):
    """The newest samples of all drones by sensor: "imu", "gps", "mag", "baro", "sonar", "flow", or your own."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._gates: list[GateMessages] = []
        self._newest: dict[str, tuple[GateMessages, int]] = {}  # by key, undecoded: gate and index in it
        self._samples: dict[str, Samples] = {}

    def add(self, gate: GateMessages) -> None:
        self._gates.append(gate)
        if len(self._gates) > GATES_HELD:
            self._fold()

    def forget(self) -> None:
        self._gates, self._newest = [], {}
        self._samples.clear()

    def _fold(self) -> None:
        for gate in self._gates:
            for index, entry in enumerate(gate.which.tolist()):
                self._newest[gate.table[entry]] = (gate, index)
        self._gates.clear()

    def _update(self) -> None:
        self._fold()
        newest, self._newest = self._newest, {}
        for key, (gate, index) in newest.items():
            if not keys.is_sensor(key) or keys.is_status(key):
                continue
            message = messages.decode(key, gate.payload(index))
            if isinstance(message, Sample):
                _, drone, leaf = keys.parts(key)
                sensor = leaf.removeprefix("sensor/")
                if sensor not in self._samples:
                    self._samples[sensor] = Samples(type(message), len(self._names))
                self._samples[sensor].put(self._names.index(drone), message)

    def __getitem__(self, sensor: str) -> "Samples":
        self._update()
        if sensor not in self._samples:
            hint = suggestion(sensor, [*self._samples])
            available = ", ".join(self._samples) or "none yet"
            raise RunError(f"no sample of {sensor!r} was received; {hint}there are {available}")
        return self._samples[sensor]

    def __iter__(self) -> Iterator[str]:
        self._update()
        return iter(self._samples)

    def __len__(self) -> int:
        self._update()
        return len(self._samples)


class Samples:
    """The newest sample of one sensor of N drones: an attribute (N, …) for each field of its message, in its units.

    For a drone without a sample, integer fields (`t_sample_ns`, `t_ns`, `seq`) are -1, and all other fields NaN.
    """

    def __init__(self, kind: type[Struct], drones: int) -> None:
        self._fields = structs.fields(kind)
        self._count = drones
        self._columns: dict[str, NDArray[Any]] = {}

    def put(self, index: int, message: Struct) -> None:
        for name, value in structs.asdict(message).items():
            if name not in self._columns:
                is_integer = isinstance(value, int) and not isinstance(value, bool)
                shape = np.shape(value) if not isinstance(value, str) else ()
                kind = np.int64 if is_integer else object if isinstance(value, str) else np.float64
                self._columns[name] = np.full((self._count, *shape), -1 if is_integer else np.nan, dtype=kind)
            self._columns[name][index] = value

    def __getattr__(self, name: str) -> NDArray[Any]:
        columns = self.__dict__.get("_columns", {})
        if name not in columns:
            raise AttributeError(f"no field {name!r}; {suggestion(name, [*columns])}there are {', '.join(columns)}")
        return columns[name]

    def __dir__(self) -> list[str]:
        return [*self._columns]

    def __repr__(self) -> str:
        return f"<Samples of {self._count} drones: {', '.join(self._columns)}>"


def _copied(agent: Agent) -> dict[str, Any]:
    """Return a copy of the attributes of an agent; raise RunError if they cannot be copied."""
    try:
        return copy.deepcopy(vars(agent))
    except Exception as error:
        raise RunError(f"{type(agent).__qualname__} cannot be copied for reset() ({error}); give the class") from error
