"""The mapping between an FMU's variables and message fields: parses and checks texts such as `vx=velocity_m_s.0`.

    NAME = [WHOSE/] [MESSAGE.] FIELD [.INDEX]

WHOSE is a drone or a cluster (by default the FMU's drone), or a key up to its last `/`. MESSAGE is the last part of a
key: for inputs `estimate`, `truth`, a sensor, or `state` of a cluster; for outputs `velocity`, `attitude`, `rotors`,
`ardrone`, `mode`, `estimate`. Without it, an input is a field of the drone's estimate, an output a field of its
velocity command. `main/c` stands for the estimated variables c of the cluster `main`, `main/c_dot` for their commanded
rates.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Struct

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import Velocity
from zsim.contract.messages import Info
from zsim.errors import DecodeError, RunError, UserCodeError
from zsim.scenario.scenario import Scenario
from zsim.schema.checker import suggestion
from zsim_agents.formation.spaces.cluster_space import SingularClusterError, robot_rates
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_bridges.fmu.model import FmuModel, Kind, Unit, Variable

MODES = ("takeoff", "land", "emergency", "reset")
PER_VARIABLE_FIELDS = ("value", "desired", "desired_rate")  # of a cluster state: one number per cluster variable
# Cluster quantities that no message carries; True: an output of the FMU
FORMATION_QUANTITIES = {"c": False, "c_dot": True}
OWN_FIELDS = ("t_ns", "seq", "source", "frame")  # fields that the agent fills in
# Units by suffix of the field name: unit name, exponents of BASE_UNITS, factor to SI units
RAD, PER_S = (0, 0, 0, 0, 0, 0, 0, 1), (0, 0, -1, 0, 0, 0, 0, 1)
UNITS = {
    "_rad_s": Unit("rad/s", PER_S),
    "_m_s2": Unit("m/s2", (0, 1, -2, 0, 0, 0, 0, 0)),
    "_m_s": Unit("m/s", (0, 1, -1, 0, 0, 0, 0, 0)),
    "_m": Unit("m", (0, 1, 0, 0, 0, 0, 0, 0)),
    "_rad": Unit("rad", RAD),
    "_deg": Unit("deg", RAD, math.pi / 180.0),
    "_n": Unit("N", (1, 1, -2, 0, 0, 0, 0, 0)),
    "_pa": Unit("Pa", (1, -1, -2, 0, 0, 0, 0, 0)),
    "_ut": Unit("uT", (1, 0, -2, -1, 0, 0, 0, 0), 1e-6),
    "_ns": Unit("ns", (0, 0, 1, 0, 0, 0, 0, 0), 1e-9),
}
# The kinds of value that a receiver of each kind accepts; a boolean field also accepts an FMU's numbers (true if > 0)
ACCEPTED_KINDS: dict[Kind, tuple[Kind, ...]] = {
    "number": ("number", "integer", "boolean"),
    "integer": ("integer", "boolean"),
    "boolean": ("boolean",),
    "text": ("text",),
}


class Place(NamedTuple):
    """A field of the messages on a key, or some of its elements."""

    text: str  # as the user wrote it
    key: str
    field: str
    indices: tuple[int, ...] | None  # indices of the elements; None for a single value
    kind: Kind

    @property
    def size(self) -> int:
        return 1 if self.indices is None else len(self.indices)

    @property
    def unit(self) -> Unit | None:
        return next((unit for suffix, unit in UNITS.items() if self.field.endswith(suffix)), None)

    def read(self, message: Any) -> list[Any] | None:
        """Return the values of this place in a message; None if the message omits them."""
        value = getattr(message, self.field)
        if value is None:
            return None
        return [value] if self.indices is None else [value[i] for i in self.indices]


class MappedVariable(NamedTuple):
    """A variable and its place; `to_unit` converts values from the sender's to the receiver's unit, if they differ."""

    variable: Variable
    place: Place
    to_unit: Callable[[float], float] | None

    def converted(self, values: list[Any]) -> list[Any]:
        """Return the values in the receiver's unit."""
        if self.to_unit is not None:
            return [self.to_unit(value) for value in values]
        return values


class FmuMapping(NamedTuple):
    """The mapped inputs and outputs of an FMU, and notes on differing units."""

    inputs: list[MappedVariable]
    outputs: list[MappedVariable]
    notes: list[str]


def mapping_of(
    model: FmuModel, texts: Sequence[str], info: Info, drone: str | None, cluster_names: Callable[[str], Sequence[str]]
) -> FmuMapping:
    """Return the mapping that the texts `NAME=PLACE` describe.

    Args:
        drone: drone to which places without WHOSE refer; None: every place must have WHOSE.
        cluster_names: returns the names of a cluster's variables.

    Raises:
        RunError: a text is invalid; the error quotes it and states what was found and what is allowed.
    """
    mapping = FmuMapping([], [], [])
    parser = _PlaceParser(info, drone, cluster_names)
    for text in texts:
        name, equals, place_text = (part.strip() for part in text.partition("="))
        if not equals or not name or not place_text:
            raise RunError(f"--map is {text!r}; must be NAME=PLACE, such as vx=velocity_m_s.0")
        variable = model.variable(name)
        if variable.causality not in ("input", "output"):
            hint = "; set it with --param" if variable.causality == "parameter" else ""
            raise RunError(f"--map {text}: {name} is a {variable.causality}; must be an input or an output{hint}")
        is_output = variable.causality == "output"
        place = parser.parse(place_text, is_output, f"--map {text}")
        if place.size != variable.size:
            raise RunError(
                f"--map {text}: {name} has {variable.size} values, {place_text} has {place.size}; must be equal"
            )
        sender_kind, receiver_kind = (variable.kind, place.kind) if is_output else (place.kind, variable.kind)
        if sender_kind not in ACCEPTED_KINDS[receiver_kind] and not (
            is_output and receiver_kind == "boolean" and sender_kind != "text"
        ):
            raise RunError(
                f"--map {text}: {name} is {variable.type}, {place_text} is {place.kind}; "
                f"{sender_kind} cannot become {receiver_kind}"
            )
        convert, note = _conversion(variable, place, is_output)
        if note:
            mapping.notes.append(f"{name}={place_text}: {note}")
        (mapping.outputs if is_output else mapping.inputs).append(MappedVariable(variable, place, convert))
    _check_unique(mapping)
    return mapping


def _check_unique(mapping: FmuMapping) -> None:
    mapped: dict[tuple[str, str, int | None], str] = {}
    for variable, place, _ in mapping.outputs:
        for index in place.indices or (None,):
            target = (place.key, place.field, index)
            if target in mapped:
                raise RunError(
                    f"--map {variable.name}={place.text}: {mapped[target]} is already mapped there; must be unique"
                )
            mapped[target] = variable.name
    inputs: set[str] = set()
    for variable, place, _ in mapping.inputs:
        if variable.name in inputs:
            raise RunError(f"--map {variable.name}={place.text}: {variable.name} is mapped twice; must be mapped once")
        inputs.add(variable.name)


class _PlaceParser:
    """Parses places, given the drones and clusters of a run."""

    def __init__(self, info: Info, drone: str | None, cluster_names: Callable[[str], Sequence[str]]) -> None:
        self._drones = {each.name: each for each in info.drones}
        self._clusters = {each.name: each for each in info.clusters}
        self._drone = drone
        self._cluster_names = cluster_names

    def parse(self, text: str, is_output: bool, context: str) -> Place:
        whose, _, rest = text.rpartition("/")
        first, *path = rest.split(".")
        if whose in self._clusters and FORMATION_QUANTITIES.get(first) is is_output:
            names = self._cluster_names(whose)
            return self._elements_at(text, f"cluster/{whose}/{first}", first, path, "number", names, context)
        if whose in self._clusters:
            key = f"cluster/{whose}/{first}"
        elif whose in self._drones or not whose:
            drone = whose or self._drone
            if drone is None:
                known = ", ".join([*self._drones, *self._clusters])
                raise RunError(f"{context}: names no drone, and --drone is not given; must begin with one of {known}")
            message_key = self._drone_key(drone, first, is_output)
            if message_key is None:
                path.insert(0, first)
            key = message_key or (keys.command(drone, "velocity") if is_output else keys.estimate(drone))
        else:
            key = f"{whose}/{first}"
        kind, thing, _ = keys.parts(key)
        known = {"drone": self._drones, "cluster": self._clusters}.get(kind)
        if known is not None and thing not in known:
            allowed = f"{suggestion(thing, known)}must be one of {', '.join(known)}" if known else "the run has none"
            raise RunError(f"{context}: there is no {kind} {thing!r}; {allowed}")
        return self._field(text, key, path, is_output, context)

    def _drone_key(self, drone: str, leaf: str, is_output: bool) -> str | None:
        if is_output:
            candidates = [keys.command(drone, leaf), f"drone/{drone}/{leaf}"]
        else:
            candidates = [f"drone/{drone}/{leaf}", keys.sensor(drone, leaf)]
        return next((key for key in candidates if messages.type_of(key) is not None), None)

    def _field(self, text: str, key: str, path: list[str], is_output: bool, context: str) -> Place:
        kind = self._message(key, is_output, context)
        name, *rest = path or [""]
        if kind is flight_messages.Mode and is_output:
            if name not in MODES or rest:
                raise RunError(f"{context}: mode is {name!r}; must be one of {', '.join(MODES)}")
            return Place(text, key, name, None, "boolean")
        kinds = {each.name: each.type for each in _fields(kind) if not is_output or each.name not in OWN_FIELDS}
        if name not in kinds:
            hint = suggestion(name, kinds)
            raise RunError(f"{context}: {key} has no field {name!r}; {hint}must be one of {', '.join(kinds)}")
        field_type = kinds[name]
        if isinstance(field_type, msgspec.inspect.UnionType):
            non_null_types = [each for each in field_type.types if not isinstance(each, msgspec.inspect.NoneType)]
            field_type = non_null_types[0] if len(non_null_types) == 1 else field_type
        value_kind = _kind(field_type)
        if value_kind is not None:
            if rest:
                raise RunError(f"{context}: {name} is a single value; has no element {'.'.join(rest)}")
            return Place(text, key, name, None, value_kind)
        element_kind, names = self._elements(key, name, field_type)
        if element_kind is None:
            raise RunError(f"{context}: {name} of {key} has no fixed set of values; map another field")
        return self._elements_at(text, key, name, rest, element_kind, names, context)

    def _elements_at(
        self, text: str, key: str, field: str, rest: list[str], kind: Kind, names: Sequence[str], context: str
    ) -> Place:
        """Return the place of all elements of a field, or of the one whose name or number is in `rest`."""
        if not rest:
            return Place(text, key, field, tuple(range(len(names))), kind)
        element_name = ".".join(rest)  # the names of a group's variables contain a dot
        index = next((i for i, each in enumerate(names) if element_name in (each, str(i))), None)
        if index is None:
            hint = suggestion(element_name, names) if names[0] != "0" else ""
            allowed = f"0 to {len(names) - 1}" if names[0] == "0" else f"one of {', '.join(names)}"
            raise RunError(f"{context}: {element_name!r} is not an element of {field}; {hint}must be {allowed}")
        return Place(text, key, field, (index,), kind)

    def _message(self, key: str, is_output: bool, context: str) -> type[Struct]:
        kind = messages.type_of(key)
        if is_output:
            try:
                kind = messages.output_type(key)
            except DecodeError as error:
                raise RunError(f"{context}: {error}") from error
            if kind not in (*messages.COMMANDS, flight_messages.Estimate):
                allowed = ", ".join([*map(keys.leaf, messages.COMMANDS.values()), "estimate"])
                raise RunError(f"{context}: {kind.__name__} cannot be an output of an FMU; must be one of {allowed}")
        if kind is None:
            hint = "must be an estimate, truth, a sensor, or the state of a cluster"
            raise RunError(f"{context}: {key} is not a key of the contract; {hint}; see docs/protocol.md")
        return kind

    def _elements(self, key: str, field: str, field_type: Any) -> tuple[Kind | None, Sequence[str]]:
        """Return the kind and names of a field's elements; the kind is None if it or the number of elements varies."""
        _, thing, _ = keys.parts(key)
        if isinstance(field_type, msgspec.inspect.TupleType):
            kinds: set[Kind | None] = {_kind(each) for each in field_type.item_types}
            return (kinds.pop() if len(kinds) == 1 else None), _index_names(len(field_type.item_types))
        if not isinstance(field_type, msgspec.inspect.VarTupleType):
            return None, ()
        element_kind = _kind(field_type.item_type)
        if messages.type_of(key) is flight_messages.ClusterState and field in PER_VARIABLE_FIELDS:
            return element_kind, self._cluster_names(thing)
        if field in ("speed_rad_s", "rotor_rad_s"):
            return element_kind, _index_names(len(self._drones[thing].rotors))
        if field_type.min_length is not None and field_type.min_length == field_type.max_length:
            return element_kind, _index_names(field_type.min_length)
        return None, ()


def _index_names(count: int) -> Sequence[str]:
    return [str(i) for i in range(count)]


def _fields(kind: type[Struct]) -> Sequence[msgspec.inspect.Field]:
    struct_type = msgspec.inspect.type_info(kind)
    assert isinstance(struct_type, msgspec.inspect.StructType)
    return struct_type.fields


def _kind(field_type: Any) -> Kind | None:
    if isinstance(field_type, msgspec.inspect.FloatType):
        return "number"
    if isinstance(field_type, msgspec.inspect.IntType):
        return "integer"
    if isinstance(field_type, msgspec.inspect.BoolType):
        return "boolean"
    if isinstance(field_type, msgspec.inspect.StrType | msgspec.inspect.LiteralType):
        return "text"
    return None


def _conversion(variable: Variable, place: Place, is_output: bool) -> tuple[Callable[[float], float] | None, str]:
    """Return the conversion of values (or None), and a note on units that differ or cannot be compared (or "")."""
    variable_unit, field_unit = variable.unit, place.unit
    if variable_unit is None or field_unit is None or variable_unit.name == field_unit.name or place.kind != "number":
        return None, ""
    description = f"{variable.name} is in {variable_unit.name}, {place.field} in {field_unit.name}"
    if variable_unit.exponents is None:
        return None, f"{description}, not compared, since the FMU does not define its unit; values are passed unchanged"
    assert field_unit.exponents is not None
    if variable_unit.exponents[:-1] != field_unit.exponents[:-1]:  # many tools omit the exponent of rad
        return None, f"{description}, a different quantity; values are passed unchanged"
    if (variable_unit.factor, variable_unit.offset) == (field_unit.factor, field_unit.offset):
        return None, ""
    field_factor, factor, offset = field_unit.factor, variable_unit.factor, variable_unit.offset
    if is_output:
        return lambda value: (value * factor + offset) / field_factor, f"{description}; converted"
    return lambda value: (value * field_factor - offset) / factor, f"{description}; converted"


class Formation:
    """A formation's kinematics: cluster variables from estimates, and velocities from rates of these variables.

    An FMU can thus be a cluster-space controller without kinematics of its own: c in, c_dot out.

    Attributes:
        drones: names of the drones, in the order of the cluster's robots.
        names: names of the cluster variables, in the order of c.
    """

    def __init__(self, scenario: Scenario, cluster: str) -> None:
        config = scenario.cluster(cluster)
        self.cluster, self.drones = cluster, config.drones
        try:
            self._space = scenario_space(scenario, config)
        except ValueError as error:
            raise RunError(f"cluster {cluster}: {error}") from error
        self.names: Sequence[str] = self._space.names
        self._estimates = [keys.estimate(drone) for drone in self.drones]

    def c(self, latest: Mapping[str, Any]) -> list[float] | None:
        """Return c (4n,) from the newest estimates; None if an estimate is missing or the formation is singular."""
        estimates = [latest.get(key) for key in self._estimates]
        if None in estimates:
            return None
        p_W = np.array([estimate.position_m for estimate in estimates])  # type: ignore[union-attr]
        yaw = np.array([estimate.yaw_rad for estimate in estimates])  # type: ignore[union-attr]
        try:
            return self._space.forward(p_W, yaw).tolist()
        except SingularClusterError:
            return None

    def velocities(self, latest: Mapping[str, Any], c_dot: Sequence[float]) -> list[Velocity]:
        """Return the drones' velocity commands in W [m/s, rad/s] for rates c_dot (4n,); empty if `c` returns None.

        Raises:
            UserCodeError: the formation is singular for this motion.
        """
        c = self.c(latest)
        if c is None:
            return []
        try:
            v_W, yaw_rates = robot_rates(self._space, np.array(c), np.array(c_dot))
        except SingularClusterError as error:
            raise UserCodeError(f"cluster {self.cluster}: {error}") from error
        rates = zip(v_W.tolist(), yaw_rates.tolist(), strict=True)
        return [Velocity(0, 0, "", (x, y, z), yaw_rate, "world") for (x, y, z), yaw_rate in rates]
