"""Observations and actions of policies, the same in a training environment and in a process of a flight.

A trained policy flies as an agent:

    class Trained(zsim.PolicyAgent):
        observe, action, step_s = "estimate", "velocity", 0.1

        def policy(self, observations):
            return {drone: model.predict(seen)[0] for drone, seen in observations.items()}

    zsim.run(env.scenario, agents=[Trained])    # or: zsim agent MODULE:Trained, on any host
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Literal, Protocol, get_args

import numpy as np
from msgspec import inspect
from numpy.typing import ArrayLike, NDArray

from zsim.contract import keys
from zsim.contract.flight_messages import Estimate, Status
from zsim.contract.flight_messages import Truth as TruthMessage
from zsim.contract.messages import Info
from zsim.errors import RunError, UserCodeError
from zsim.runtime.agent import Agent, Output
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Drone, Radio, Scenario
from zsim.schema import plugin
from zsim.sensors.sensor import Sample
from zsim.vehicles.vehicle import vehicle_of
from zsim_agents.formation.spaces.cluster_space import SingularClusterError, robot_rates, unit
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_api.commands import Command, attitude, rotors, takeoff, velocity
from zsim_api.simulation import Estimates, Samples, Truth, estimates_of

Observe = Literal["truth", "estimate", "sensors"]
Action = Literal["velocity", "attitude", "rotors", "cluster"]
Floats = NDArray[np.float32]
OBSERVATION_MAX = 1e6  # bound on observations, in their units; beyond the reach of any flight
AIRBORNE = ("hovering", "flying")


class Flown(Protocol):
    """The state of a flight at a gate: a `zsim.Simulation`, or the messages that an agent has received."""

    @property
    def names(self) -> Sequence[str]: ...
    @property
    def truth(self) -> Truth: ...
    @property
    def estimates(self) -> Estimates: ...
    @property
    def sensors(self) -> Mapping[str, Samples]: ...
    def state(self, drone: str) -> str: ...


class Interface:
    """Observations and commands of an environment's agents: drones, or clusters if `action` is "cluster".

    An observation (K,) of "truth" or "estimate" holds, for each drone of the agent, position [m] and velocity
    [m/s] in W, orientation (w, x, y, z; B to W) and, for "truth", angular velocity in B [rad/s]; then, for each other
    drone, position and velocity relative to the agent's first drone, in W. An observation of "sensors" holds the
    floating-point fields of the newest sample of every sensor, in the order of the contract; 0 before the first one.

    An action (A,) has values from -1 to 1, scaled to the limits of the drone's firmware and rotors (see `bounds`). For
    each drone of the agent, these are, for "velocity": forward, left, up [m/s], yaw rate [rad/s]; for "attitude": roll,
    pitch [rad], thrust [N], yaw rate [rad/s]; for "rotors": their speeds [rad/s]. For "cluster", they are the rates of
    all variables of the cluster's space [m/s, rad/s].

    Args:
        scenario: the resolved scenario.
        observe: "truth", "estimate" or "sensors".
        action: "velocity", "attitude", "rotors" or "cluster".
        step_s: time between two actions [s], a multiple of the gate; None: one gate.

    Raises:
        RunError: the arguments do not fit each other or the scenario.

    Attributes:
        agents: names of the drones, or of the clusters.
        gates: number of gates between two actions.
    """

    def __init__(self, scenario: Scenario, observe: Observe, action: Action, step_s: float | None = None) -> None:
        for option, value, allowed in (("observe", observe, get_args(Observe)), ("action", action, get_args(Action))):
            if value not in allowed:
                raise RunError(f"{option} is {value!r}; must be one of {', '.join(allowed)}")
        gate_s = scenario.time.gate_ms / 1e3
        self.gates = round((step_s or gate_s) / gate_s)
        if self.gates < 1 or abs(self.gates * gate_s - (step_s or gate_s)) > 1e-9:
            raise RunError(f"step_s is {step_s:g}; must be a multiple of the scenario's gate, {gate_s:g} s")
        if action == "cluster" and observe == "sensors":
            raise RunError("observe is 'sensors' with action 'cluster'; must be 'truth' or 'estimate'")
        if action == "cluster" and not scenario.clusters:
            raise RunError(f"action is 'cluster', but scenario {scenario.name!r} has no cluster")
        self.observe, self.action = observe, action
        self._drones = {drone.name: drone for drone in scenario.drones}
        self.names = list(self._drones)
        drones_by_cluster = {cluster.name: list(cluster.drones) for cluster in scenario.clusters}
        self._members = drones_by_cluster if action == "cluster" else {name: [name] for name in self.names}
        self.agents = list(self._members)
        self._indices = {agent: [self.names.index(drone) for drone in self._members[agent]] for agent in self.agents}
        self._spaces = {each.name: scenario_space(scenario, each) for each in scenario.clusters}
        self._sensed = {name: _readings(drone) for name, drone in self._drones.items()}

    def size(self, agent: str) -> int:
        """Return the length K of an observation."""
        if self.observe == "sensors":
            return sum(width for drone in self._members[agent] for _, _, width in self._sensed[drone])
        own, others = len(self._members[agent]), len(self.names) - len(self._members[agent])
        return own * (13 if self.observe == "truth" else 10) + 6 * others

    def bounds(self, agent: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the commands (A,) that correspond to actions of -1 and of 1, in the units of the class docstring."""
        low: list[float] = []
        high: list[float] = []
        for drone in (self._drones[name] for name in self._members[agent]):
            limits = drone.limits
            speed, climb = limits.horizontal_speed_m_s, limits.vertical_speed_m_s
            yaw_rate, tilt = np.radians(limits.yaw_rate_deg_s), np.radians(limits.tilt_deg)
            count = len(vehicle_of(drone.model).rotors)
            if self.action == "attitude":
                low += [-tilt, -tilt, 0.0, -yaw_rate]
                high += [tilt, tilt, count * drone.thrust_n_s2 * drone.rotor_max_rad_s**2, yaw_rate]
            elif self.action == "rotors":
                low += [0.0] * count
                high += [drone.rotor_max_rad_s] * count
            elif self.action == "velocity":
                high += [speed, speed, climb, yaw_rate]
                low += [-speed, -speed, -climb, -yaw_rate]
        if self.action == "cluster":
            limits_of_drones = [self._drones[name].limits for name in self._members[agent]]
            speed = min(each.horizontal_speed_m_s for each in limits_of_drones)
            yaw_rate_max = min(np.radians(each.yaw_rate_deg_s) for each in limits_of_drones)
            high = [speed if unit(name) == "m" else yaw_rate_max for name in self._spaces[agent].names]
            low = [-each for each in high]
        return np.array(low), np.array(high)

    def observations(self, flown: Flown) -> dict[str, Floats]:
        """Return the observation of every agent."""
        if self.observe == "sensors":
            observed = {drone: self._samples(flown, drone) for drone in self.names}
            return {agent: np.concatenate([observed[name] for name in self._members[agent]]) for agent in self.agents}
        states = flown.truth if self.observe == "truth" else flown.estimates
        parts = [states.position_m, states.velocity_m_s, states.orientation_wxyz]
        parts += [states.angular_velocity_rad_s] if isinstance(states, Truth) else []
        flat = np.concatenate(parts, axis=1).ravel()
        selected, origins, ends = self._layout
        observed = flat[selected]
        observed -= np.append(flat, 0.0)[origins]
        return dict(zip(self.agents, np.split(_bounded(observed), ends), strict=True))

    @cached_property
    def _layout(self) -> tuple[NDArray[np.intp], NDArray[np.intp], list[int]]:
        """The layout of all observations in sequence: indices into the drones' flattened rows, indices of the values to
        subtract (-1 for none), and the ends of the agents' observations.
        """
        width = 13 if self.observe == "truth" else 10
        selected: list[int] = []
        origins: list[int] = []
        ends: list[int] = []
        for indices in self._indices.values():
            own = [width * i + j for i in indices for j in range(width)]
            others = [i for i in range(len(self.names)) if i not in indices]
            selected += own + [width * i + j for i in others for j in range(6)]
            origins += [-1] * len(own) + [width * indices[0] + j for _ in others for j in range(6)]
            ends.append(len(selected))
        return np.array(selected), np.array(origins), ends[:-1]

    def begin(self, flown: Flown) -> dict[str, Command] | None:
        """Return the commands for take-off; None once all drones are in the air and a policy may begin."""
        states = {name: flown.state(name) for name in self.names}
        if all(state in AIRBORNE for state in states.values()):
            return None
        return {name: takeoff() for name, state in states.items() if state == "landed"}

    def commands(self, flown: Flown, actions: Mapping[str, ArrayLike], by: str = "step") -> dict[str, Command]:
        """Return the commands by drone for the actions of agents; an agent without an action sends none.

        Raises:
            UserCodeError: an action is for an unknown agent, of the wrong shape or not finite; `by` names its source.
        """
        commands: dict[str, Command] = {}
        for agent, values in actions.items():
            if agent not in self._bounds:
                raise UserCodeError(f"{by}: action is for {agent!r}; must be for one of {', '.join(self.agents)}")
            low, high = self._bounds[agent]
            action = np.asarray(values, np.float32)
            if action.shape != low.shape:
                raise UserCodeError(f"{by}: action of {agent} has shape {action.shape}; must be {low.shape}")
            if not np.isfinite(action).all():
                raise UserCodeError(f"{by}: action of {agent} is {action.tolist()}; must be finite")
            command = low + (np.minimum(np.maximum(action, -1.0), 1.0).astype(np.float64) + 1.0) / 2.0 * (high - low)
            if self.action == "cluster":
                commands |= self._cluster_commands(agent, flown, command)
            else:
                commands[agent] = self._drone_command(command)
        return commands

    @cached_property
    def _bounds(self) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        return {agent: self.bounds(agent) for agent in self.agents}

    def _drone_command(self, action: NDArray[np.float64]) -> Command:
        if self.action == "rotors":
            return rotors(action)
        if self.action == "velocity":
            return velocity(*action.tolist())
        roll, pitch, thrust_n, yaw_rate = action.tolist()
        (sr, sp), (cr, cp) = np.sin([roll / 2, pitch / 2]), np.cos([roll / 2, pitch / 2])
        return attitude((cr * cp, sr * cp, cr * sp, -sr * sp), thrust_n, yaw_rate)  # the product q_pitch ⊗ q_roll

    def _cluster_commands(self, cluster: str, flown: Flown, c_dot: NDArray[np.float64]) -> dict[str, Command]:
        """Return velocity commands for the drones of a cluster; zero if the cluster's shape is singular."""
        states = flown.truth if self.observe == "truth" else flown.estimates
        indices, space = self._indices[cluster], self._spaces[cluster]
        w, x, y, z = states.orientation_wxyz[indices].T
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        try:
            v_W, yaw_rates = robot_rates(space, space.forward(states.position_m[indices], yaw), c_dot)
        except SingularClusterError:
            v_W, yaw_rates = np.zeros((len(indices), 3)), np.zeros(len(indices))
        rates = zip(self._members[cluster], v_W.tolist(), yaw_rates.tolist(), strict=True)
        return {name: velocity(vx, vy, vz, yaw_rate, frame="world") for name, (vx, vy, vz), yaw_rate in rates}

    def _samples(self, flown: Flown, drone: str) -> Floats:
        index = self.names.index(drone)
        parts: list[NDArray[Any]] = []
        received = {*flown.sensors}
        for sensor, field, width in self._sensed[drone]:
            column = getattr(flown.sensors[sensor], field)[index] if sensor in received else np.zeros(width)
            parts.append(np.atleast_1d(np.asarray(column, np.float64)))
        return _bounded(np.concatenate(parts))


def _readings(drone: Drone) -> list[tuple[str, str, int]]:
    """Return the sensor, field and width of every floating-point field that a drone's sensors measure."""
    readings = []
    for name, kind, settings in drone.sensors.sections():
        if getattr(settings, "rate_hz", 1.0) == 0:
            continue
        info = inspect.type_info(kind.message)
        assert isinstance(info, inspect.StructType)
        for field in info.fields:
            match field.type:
                case inspect.FloatType():
                    readings.append((name, field.name, 1))
                case inspect.TupleType(item_types=items) if all(isinstance(each, inspect.FloatType) for each in items):
                    readings.append((name, field.name, len(items)))
    return readings


def _bounded(numbers: NDArray[np.float64]) -> Floats:
    """Clip numbers to the bounds of an observation; NaN becomes 0."""
    clipped = np.minimum(np.maximum(numbers, -OBSERVATION_MAX), OBSERVATION_MAX)
    clipped[np.isnan(clipped)] = 0.0
    return clipped.astype(np.float32)


class PolicyAgent(Agent):
    """A policy as an agent of a flight; it lets the drones take off, and acts once all are in the air.

    Attributes:
        observe, action, step_s: those of the environment in which the policy was trained.
    """

    observe: Observe = "truth"
    action: Action = "velocity"
    step_s: float | None = None

    def policy(self, observations: dict[str, Floats]) -> Mapping[str, ArrayLike]:
        """Return an action for each agent's observation; see `zsim.Interface` for both."""
        raise NotImplementedError

    def bind(self, info: Info, name: str = "", radio: Radio | None = None) -> None:
        """Prepare for the run that `world/info` describes."""
        scenario = scenario_file.from_text(info.scenario)
        self.interface = Interface(scenario, self.observe, self.action, self.step_s)
        drones = self.interface.names
        self.period_ns = self.interface.gates * info.gate_ns
        self.gate_keys = tuple(map(keys.status, drones))
        key_of = {"truth": keys.truth, "estimate": keys.estimate, "sensors": lambda drone: f"drone/{drone}/sensor/*"}
        drone_keys = tuple(map(key_of[self.observe], drones))
        self.reads = (*self.gate_keys, *drone_keys)
        if self.observe == "estimate":
            self.gate_keys = (*self.gate_keys, *drone_keys)
        self.counted = tuple(drones) if self.observe == "sensors" else ()
        self._received = _Received(drones, max(len(drone.rotors) for drone in info.drones))
        self._has_begun = False
        super().bind(info, name, radio)

    def receive(self, key: str, message: Any) -> None:
        """Store a message for the observations."""
        self._received.put(key, message)

    def step(self, t_ns: int) -> list[Output]:
        """Return the commands at a gate."""
        commands = None if self._has_begun else self.interface.begin(self._received)
        if commands is None:
            self._has_begun = True
            source = f"{plugin.full_name(type(self))}.policy"
            actions = self.policy(self.interface.observations(self._received))
            if not isinstance(actions, Mapping):
                raise UserCodeError(f"{source} returns a {type(actions).__name__}; must be a map of actions by agent")
            commands = self.interface.commands(self._received, actions, source)
        return [self.command(t_ns, drone, command) for drone, command in commands.items()]


class _Received:
    """The state of a flight according to the messages that an agent has received."""

    def __init__(self, names: Sequence[str], rotors_max: int) -> None:
        self.names = names
        self.sensors: dict[str, Samples] = {}
        self._index = {name: i for i, name in enumerate(names)}
        self._states: dict[str, str] = dict.fromkeys(names, "")
        self._estimates: dict[str, Estimate] = {}
        widths = (3, 3, 4, 3, 3, rotors_max)
        self.truth = Truth(*(np.zeros((len(names), width)) for width in widths))

    @property
    def estimates(self) -> Estimates:
        return estimates_of(self.names, self._estimates)

    def state(self, drone: str) -> str:
        return self._states[drone]

    def put(self, key: str, message: Any) -> None:
        drone = keys.thing(key)
        if isinstance(message, Status):
            self._states[drone] = message.state
        elif isinstance(message, Estimate):
            self._estimates[drone] = message
        elif isinstance(message, TruthMessage):
            for name, column in zip(Truth._fields, self.truth, strict=True):
                numbers = getattr(message, name)
                column[self._index[drone], : len(numbers)] = numbers
        elif isinstance(message, Sample):
            sensor = keys.leaf(key)
            if sensor not in self.sensors:
                self.sensors[sensor] = Samples(type(message), len(self.names))
            self.sensors[sensor].put(self._index[drone], message)
