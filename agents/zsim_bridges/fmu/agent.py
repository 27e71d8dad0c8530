"""An FMU as an agent: at a gate it reads messages, makes a communication step and sends commands or an estimate.

At gate t, the FMU receives the newest values of its inputs and steps from t to t + period; its outputs are then
published with the time stamp t, like any agent's outputs at that gate.
"""

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

from msgspec.structs import replace

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import Estimate, Mode, Status, state_refusal
from zsim.contract.messages import Info
from zsim.contract.snapshot import State
from zsim.errors import RunError, UserCodeError, printable
from zsim.math import elementary as el
from zsim.runtime.agent import Agent, Output
from zsim.scenario.scenario import Scenario
from zsim_bridges.fmu.mapping import FORMATION_QUANTITIES, Formation, MappedVariable, mapping_of
from zsim_bridges.fmu.model import FmuInstance, FmuModel, Inputs, Variable

Frame = Literal["heading", "world"]
LEVEL = (1.0, 0.0, 0.0, 0.0)
COVARIANCE = tuple(float(i == j) for i in range(6) for j in range(6))
# Defaults of fields that an FMU may omit, by message. If it provides only some elements of a vector, the others keep
# their defaults, or are 0 without one.
DEFAULTS: dict[str, dict[str, Any]] = {
    "velocity": {"velocity_m_s": (0.0, 0.0, 0.0), "yaw_rate_rad_s": 0.0},
    "attitude": {"orientation_wxyz": LEVEL, "yaw_rate_rad_s": 0.0},
    "ardrone": {"forward": 0.0, "left": 0.0, "up": 0.0, "yaw_left": 0.0, "hover": False},
    "rotors": {},
    "estimate": {
        "orientation_wxyz": LEVEL,
        "yaw_rad": 0.0,
        "covariance": COVARIANCE,
        "yaw_sigma_rad": 0.1,
        "gyro_bias_rad_s": (0.0, 0.0, 0.0),
        "sensors": {},
    },
}


class Fmu:
    """Factory for an FMU agent: `zsim.run("step.yaml", agents=[zsim.Fmu("controller.fmu", "drone1", {...})])`.

    Args:
        path: path of the FMU, which must be for co-simulation with FMI 2 or 3.
        drone: drone to which entries of `map` without a drone or cluster refer; None if there are no such entries.
        map: message fields by variable, `{"vx": "velocity_m_s.0"}`, or texts `vx=velocity_m_s.0`; see docs/fmu.md.
        name: process name (default: `fmu.` and the drone's name, or `fmu.main`); replaces a stock agent of this name.
        period_s: communication step [s], a multiple of the gate period; default: the FMU's suggestion, or the gate
            period.
        param: start values of parameters and inputs, by variable name.
        takeoff_s: simulated time [s] at which the commanded drones take off; None if another process commands this.
        frame: frame of the velocity commands.
        log: whether to print the FMU's whole log, not only warnings and errors.
        say: receives lines about the FMU; by default they go to standard error.
    """

    def __init__(
        self,
        path: str | Path,
        drone: str | None = None,
        map: Mapping[str, str] | Sequence[str] = (),
        *,
        name: str = "",
        period_s: float | None = None,
        param: Mapping[str, Any] = {},
        takeoff_s: float | None = None,
        frame: Frame = "heading",
        log: bool = False,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.path = Path(path)
        self.drone = drone
        self.map = [f"{name}={place}" for name, place in map.items()] if isinstance(map, Mapping) else list(map)
        self.name, self.period_s, self.param = name, period_s, dict(param)
        self.frame: Frame = frame
        self.takeoff_s, self.log, self.say = takeoff_s, log, say

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle; its path is absolute, so that a process in another folder finds the file."""
        return {**vars(self), "path": self.path.resolve()}

    def __call__(self, info: Info, scenario: Scenario) -> "FmuAgent":
        """Return the agent that runs the FMU.

        Raises:
            RunError: the file, its variables, the mapping, the drone or the period cannot be used.
        """
        return FmuAgent(self, info, scenario)


class FmuAgent(Agent):
    """The agent that runs an FMU."""

    def __init__(self, fmu: Fmu, info: Info, scenario: Scenario) -> None:
        super().__init__()
        drones = [drone.name for drone in info.drones]
        if fmu.drone is not None and fmu.drone not in drones:
            raise RunError(f"--drone is {fmu.drone!r}; must be one of {', '.join(drones)}")
        self._model = model = FmuModel(fmu.path)
        self.name = fmu.name or f"fmu.{fmu.drone or 'main'}"
        self._say = fmu.say or _print
        self.period_ns = _period_ns(model, fmu.period_s, info)
        formation = cache(partial(Formation, scenario))
        mapping = mapping_of(model, fmu.map, info, fmu.drone, lambda cluster: formation(cluster).names)
        if not mapping.outputs:
            output_names = [each.name for each in model.variables.values() if each.causality == "output"]
            if not output_names:
                raise RunError(f"{fmu.path}: the FMU has no output; must have at least one")
            raise RunError(f"{fmu.path}: maps no output; must map at least one of {', '.join(output_names)}")
        self._inputs = mapping.inputs
        self._formations = {
            key: formation(keys.thing(key))
            for key in (link.place.key for link in (*mapping.inputs, *mapping.outputs))
            if keys.parts(key)[2] in FORMATION_QUANTITIES
        }
        self._writers = _writers(mapping.outputs, fmu.frame, self._formations)
        self._output_variables = [link.variable for writer in self._writers for link in writer.links]
        self._commanded = sorted({drone for writer in self._writers for drone in writer.commanded})
        self._takeoff_ns = None if fmu.takeoff_s is None else round(fmu.takeoff_s * 1e9)
        self._latest: dict[str, Any] = {}
        self._states: dict[str, Any] = {}  # firmware states, by drone
        self._active_flags: set[str] = set()  # modes whose outputs were true at the last step
        self._has_started = False
        self._declare_keys(info)
        for line in mapping.notes:
            self._say(f"{self.name}: {fmu.path.name}: {line}")
        if not model.can_restore:
            self._say(f"{self.name}: {fmu.path.name} cannot save its state; a restart begins anew")
        self._instance = FmuInstance(model, self.name, lambda line: self._say(f"{self.name}: {line}"), fmu.log)
        self._instance.write([_parameter(model, name, value) for name, value in fmu.param.items()])

    def _declare_keys(self, info: Info) -> None:
        reads = {link.place.key for link in self._inputs} - self._formations.keys()
        reads |= {keys.estimate(drone) for formation in self._formations.values() for drone in formation.drones}
        drone_keys = [key for key in (*reads, *(writer.key for writer in self._writers)) if key.startswith("drone/")]
        involved_drones = {*map(keys.thing, drone_keys), *self._commanded}
        drones = [drone.name for drone in info.drones if drone.name in involved_drones or not involved_drones]
        statuses = [keys.status(drone) for drone in drones]
        self.counted = tuple(
            drone for drone in drones if any(keys.is_sensor(key) and keys.thing(key) == drone for key in reads)
        )
        relayed_keys = [key for key in reads if messages.type_of(key) in messages.RELAYED]
        individual_keys = [
            key for key in (*reads, *statuses) if not (keys.is_sensor(key) and keys.thing(key) in self.counted)
        ]
        self.reads = tuple(sorted({*individual_keys, *map(keys.sensors, self.counted)}))
        self.gate_keys = (*statuses, *sorted(relayed_keys))
        self.writes = tuple(writer.key for writer in self._writers if not writer.commanded)
        self._read_keys = reads

    def receive(self, key: str, message: Any) -> None:
        if key in self._read_keys:
            self._latest[key] = message
        if type(message) is Status:
            self._states[keys.thing(key)] = message.state

    def step(self, t_ns: int) -> list[Output]:
        t_s = t_ns / 1e9
        inputs = self._input_values()
        if not self._has_started:
            self._instance.start(t_s, inputs)
            self._has_started = True
        else:
            self._instance.write(inputs)
        self._instance.step(t_s, self.period_ns / 1e9)
        output_values = self._instance.read(self._output_variables)
        for variable, values in zip(self._output_variables, output_values, strict=True):
            for value in values:
                if isinstance(value, float) and not math.isfinite(value):
                    raise UserCodeError(f"{self._model.path}: output {variable.name} is {value}; must be finite")
        outputs = self._takeoff_commands(t_ns)
        start = 0
        for writer in self._writers:
            values = output_values[start : start + len(writer.links)]
            start += len(writer.links)
            outputs += writer.outputs(self, t_ns, values)
        return outputs

    def _input_values(self) -> Inputs:
        """Return values for the inputs whose messages have arrived; the other inputs keep the values they have."""
        values = []
        for link in self._inputs:
            place = link.place
            message = self._latest.get(place.key)
            field_values = place.read(message) if message is not None else None
            if place.key in self._formations and (c := self._formations[place.key].c(self._latest)) is not None:
                field_values = [c[i] for i in place.indices or ()]
            if field_values is not None:
                values.append((link.variable, link.converted(field_values)))
        return values

    def _takeoff_commands(self, t_ns: int) -> list[Output]:
        if self._takeoff_ns is None or t_ns < self._takeoff_ns:
            return []
        self._takeoff_ns = None
        grounded = [drone for drone in self._commanded if self._states.get(drone) == "landed"]
        return [self.mode(t_ns, keys.command(drone, "mode"), "takeoff") for drone in grounded]

    def mode(self, t_ns: int, key: str, mode: Any) -> Output:
        return Output(key, Mode(t_ns, self.next_seq(key), self.source, mode))

    def motion_commands(self, t_ns: int, formation: Formation, c_dot: Sequence[float]) -> list[Output]:
        """Return velocity commands that yield cluster rates c_dot (4n,), for the drones that accept setpoints."""
        outputs = []
        for drone, command in zip(formation.drones, formation.velocities(self._latest, c_dot), strict=False):
            if self.accepts_setpoints(drone):
                key = keys.command(drone, "velocity")
                outputs.append(Output(key, replace(command, t_ns=t_ns, seq=self.next_seq(key), source=self.source)))
        return outputs

    def accepts_setpoints(self, drone: str) -> bool:
        return state_refusal(drone, self._states.get(drone, "landed"), "setpoint") is None

    def record_edge(self, flag: str, is_set: bool) -> bool:
        """Record a flag and return whether it has become true since the last step."""
        was_set = flag in self._active_flags
        (self._active_flags.add if is_set else self._active_flags.discard)(flag)
        return is_set and not was_set

    def snapshot(self) -> State | None:
        if not self._model.can_restore or not self._has_started:
            return None
        return {
            "fmu": self._instance.state(),
            "latest": [[key, messages.encode(message)] for key, message in sorted(self._latest.items())],
            "states": dict(self._states),
            "raised": sorted(self._active_flags),
            "takeoff_ns": self._takeoff_ns,
        }

    def restore(self, state: State) -> None:
        self._instance.restore(state["fmu"])
        self._has_started = True
        self._latest = {key: messages.decode(key, payload) for key, payload in state["latest"]}
        self._states, self._active_flags = dict(state["states"]), set(state["raised"])
        self._takeoff_ns = state["takeoff_ns"]


class _Writer:
    """Builds the messages on one key from the FMU's outputs."""

    def __init__(self, key: str, links: Sequence[MappedVariable], frame: Frame) -> None:
        self.key, self.links = key, links
        self.commanded = [keys.thing(key)] if keys.is_command(key) else []
        self._kind = messages.output_type(key)
        self._drone = keys.thing(key)
        leaf = keys.leaf(key)
        fields = {"frame": frame} if self._kind is flight_messages.Velocity else {}
        self._fields = {**DEFAULTS.get(leaf, {}), **fields}
        self._is_mode = self._kind is Mode
        mapped = {link.place.field for link in links}
        self._has_attitude, self._has_yaw = "orientation_wxyz" in mapped, "yaw_rad" in mapped
        if not self._is_mode:
            self._check_complete(leaf)

    def _check_complete(self, leaf: str) -> None:
        sizes = {"velocity_m_s": 3, "position_m": 3, "thrust_n": 1}
        required_fields = {"attitude": ("thrust_n",), "estimate": ("position_m", "velocity_m_s")}.get(leaf, ())
        for field in required_fields:
            mapped_count = sum(link.place.size for link in self.links if link.place.field == field)
            if mapped_count < sizes[field]:
                raise RunError(
                    f"{self.key}: {mapped_count} of {sizes[field]} values of {field} are mapped; all must be"
                )

    def outputs(self, agent: FmuAgent, t_ns: int, values: Sequence[Sequence[Any]]) -> list[Output]:
        if self._is_mode:
            return [
                agent.mode(t_ns, self.key, link.place.field)
                for link, (value,) in zip(self.links, values, strict=True)
                if agent.record_edge(f"{self._drone}.{link.place.field}", value > 0)
            ]
        if self.commanded and not agent.accepts_setpoints(self._drone):
            return []
        fields: dict[str, Any] = dict(self._fields)
        for link, output_values in zip(self.links, values, strict=True):
            place, field_values = link.place, link.converted(list(output_values))
            if place.kind == "boolean":
                field_values = [value > 0 for value in field_values]
            elif place.kind == "number":
                field_values = [float(value) for value in field_values]
            if place.indices is None:
                fields[place.field] = field_values[0]
                continue
            elements = list(fields.get(place.field, ()))
            elements += [0.0] * (max(place.indices) + 1 - len(elements))
            for index, value in zip(place.indices, field_values, strict=True):
                elements[index] = value
            fields[place.field] = tuple(elements)
        if self._kind is Estimate:
            self._complete_attitude(fields)
        return [Output(self.key, self._kind(t_ns=t_ns, seq=agent.next_seq(self.key), source=agent.source, **fields))]

    def _complete_attitude(self, fields: dict[str, Any]) -> None:
        """Derive the heading from the attitude, or a level attitude from the heading, if only one is mapped."""
        if self._has_yaw and not self._has_attitude:
            half = fields["yaw_rad"] / 2
            fields["orientation_wxyz"] = (el.cos(half), 0.0, 0.0, el.sin(half))
        elif self._has_attitude and not self._has_yaw:
            w, x, y, z = fields["orientation_wxyz"]
            fields["yaw_rad"] = el.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


class _FormationWriter:
    """Builds a formation's velocity commands from c_dot, whose elements are 0 where the FMU provides none."""

    def __init__(self, key: str, links: Sequence[MappedVariable], formation: Formation) -> None:
        self.key, self.links, self.commanded = key, links, formation.drones
        self._formation = formation

    def outputs(self, agent: FmuAgent, t_ns: int, values: Sequence[Sequence[Any]]) -> list[Output]:
        c_dot = [0.0] * len(self._formation.names)
        for link, output_values in zip(self.links, values, strict=True):
            for index, value in zip(link.place.indices or (), output_values, strict=True):
                c_dot[index] = float(value)
        return agent.motion_commands(t_ns, self._formation, c_dot)


def _writers(
    outputs: Sequence[MappedVariable], frame: Frame, formations: Mapping[str, Formation]
) -> "list[_Writer | _FormationWriter]":
    by_key: dict[str, list[MappedVariable]] = {}
    for link in outputs:
        by_key.setdefault(link.place.key, []).append(link)
    return [
        _FormationWriter(key, links, formations[key]) if key in formations else _Writer(key, links, frame)
        for key, links in by_key.items()
    ]


def _period_ns(model: FmuModel, period_s: float | None, info: Info) -> int:
    """Return the communication step [ns]; raise a RunError if the FMU or the gate period does not permit it."""
    gate_s = info.gate_ns / 1e9
    requested_s = period_s if period_s is not None else model.step_s
    if model.is_step_fixed and period_s is not None and not math.isclose(period_s, model.step_s or 0.0):
        raise RunError(f"--period is {period_s:g} s; {model.path} accepts only {model.step_s:g} s, by its description")
    if requested_s is None:
        return info.gate_ns
    gates = round(requested_s / gate_s)
    if gates >= 1 and math.isclose(gates * gate_s, requested_s, rel_tol=1e-9):
        return gates * info.gate_ns
    if period_s is not None or model.is_step_fixed:
        subject = (
            f"--period is {requested_s:g} s"
            if period_s is not None
            else f"{model.path}: its fixed step is {requested_s:g} s"
        )
        raise RunError(f"{subject}; must be a multiple of the gate, {gate_s:g} s (time.gate_ms of the scenario)")
    return info.gate_ns


def _parameter(model: FmuModel, name: str, value: Any) -> tuple[Variable, list[Any]]:
    variable = model.variable(name)
    if variable.causality not in ("parameter", "input", "structuralParameter"):
        raise RunError(f"--param {name}: is a {variable.causality}; must be a parameter or an input")
    texts = value.split(",") if isinstance(value, str) and variable.kind != "text" else [value]
    values = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else texts
    if len(values) != variable.size:
        raise RunError(f"--param {name}: has {len(values)} values; must have {variable.size}")
    try:
        return variable, [_typed(each, variable) for each in values]
    except ValueError:
        raise RunError(f"--param {name} is {value!r}; must be a value of {variable.type} ({variable.kind})") from None


def _typed(value: Any, variable: Variable) -> Any:
    if variable.kind == "text":
        return str(value)
    if variable.kind == "boolean":
        if str(value).lower() not in ("true", "false", "1", "0"):
            raise ValueError
        return str(value).lower() in ("true", "1")
    return int(value) if variable.kind == "integer" else float(value)


def _print(line: str) -> None:
    print(printable(line), file=sys.stderr, flush=True)
