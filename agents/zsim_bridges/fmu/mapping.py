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
NUMBERED = ("value", "desired", "desired_rate")  # fields of a cluster state with one number per cluster variable
FORMATION = {"c": False, "c_dot": True}  # cluster quantities that no message carries; True: an output of the FMU
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
# The kinds of value that a receiver of each kind accepts
TAKES: dict[Kind, tuple[Kind, ...]] = {
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
        return next((unit for end, unit in UNITS.items() if self.field.endswith(end)), None)

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
    found = FmuMapping([], [], [])
    places = _Places(info, drone, cluster_names)
    for text in texts:
        name, equals, where = (part.strip() for part in text.partition("="))
        if not equals or not name or not where:
            raise RunError(f"--map is {text!r}; must be NAME=PLACE, such as vx=velocity_m_s.0")
        variable = model.variable(name)
        if variable.causality not in ("input", "output"):
            hint = "; set it with --param" if variable.causality == "parameter" else ""
            raise RunError(f"--map {text}: {name} is a {variable.causality}; must be an input or an output{hint}")
        is_output = variable.causality == "output"
        place = places.parse(where, is_output, f"--map {text}")
        if place.size != variable.size:
            raise RunError(f"--map {text}: {name} has {variable.size} values, {where} has {place.size}; must be equal")
        gives, takes = (variable.kind, place.kind) if is_output else (place.kind, variable.kind)
        if gives not in TAKES[takes] and not (is_output and takes == "boolean" and gives != "text"):
            raise RunError(
                f"--map {text}: {name} is {variable.type}, {where} is {place.kind}; {gives} cannot become {takes}"
            )
        convert, note = _conversion(variable, place, is_output)
        if note:
            found.notes.append(f"{name}={where}: {note}")
        (found.outputs if is_output else found.inputs).append(MappedVariable(variable, place, convert))
    _check_once(found)
    return found


def _check_once(found: FmuMapping) -> None:
    mapped: dict[tuple[str, str, int | None], str] = {}
    for variable, place, _ in found.outputs:
        for index in place.indices or (None,):
            target = (place.key, place.field, index)
            if target in mapped:
                raise RunError(
                    f"--map {variable.name}={place.text}: {mapped[target]} is already mapped there; must be unique"
                )
            mapped[target] = variable.name
    inputs: set[str] = set()
    for variable, place, _ in found.inputs:
        if variable.name in inputs:
            raise RunError(f"--map {variable.name}={place.text}: {variable.name} is mapped twice; must be mapped once")
        inputs.add(variable.name)


class _Places:
    """Parses places, given the drones and clusters of a run."""

    def __init__(self, info: Info, drone: str | None, cluster_names: Callable[[str], Sequence[str]]) -> None:
        self._drones = {each.name: each for each in info.drones}
        self._clusters = {each.name: each for each in info.clusters}
        self._drone = drone
        self._cluster_names = cluster_names

    def parse(self, text: str, is_output: bool, where: str) -> Place:
        whose, _, rest = text.rpartition("/")
        first, *path = rest.split(".")
        if whose in self._clusters and FORMATION.get(first) is is_output:
            names = self._cluster_names(whose)
            return self._elements_at(text, f"cluster/{whose}/{first}", first, path, "number", names, where)
        if whose in self._clusters:
            key = f"cluster/{whose}/{first}"
        elif whose in self._drones or not whose:
            drone = whose or self._drone
            if drone is None:
                known = ", ".join([*self._drones, *self._clusters])
                raise RunError(f"{where}: names no drone, and --drone is not given; must begin with one of {known}")
            found = self._drone_key(drone, first, is_output)
            if found is None:
                path.insert(0, first)
            key = found or (keys.command(drone, "velocity") if is_output else keys.estimate(drone))
        else:
            key = f"{whose}/{first}"
        kind, thing, _ = keys.parts(key)
        known = {"drone": self._drones, "cluster": self._clusters}.get(kind)
        if known is not None and thing not in known:
            hint = suggestion(thing, known)
            raise RunError(f"{where}: there is no {kind} {thing!r}; {hint}must be one of {', '.join(known) or 'none'}")
        return self._field(text, key, path, is_output, where)

    def _drone_key(self, drone: str, leaf: str, is_output: bool) -> str | None:
        if is_output:
            candidates = [keys.command(drone, leaf), f"drone/{drone}/{leaf}"]
        else:
            candidates = [f"drone/{drone}/{leaf}", keys.sensor(drone, leaf)]
        return next((key for key in candidates if messages.type_of(key) is not None), None)

    def _field(self, text: str, key: str, path: list[str], is_output: bool, where: str) -> Place:
        kind = self._message(key, is_output, where)
        name, *rest = path or [""]
        if kind is flight_messages.Mode and is_output:
            if name not in MODES or rest:
                raise RunError(f"{where}: mode is {name!r}; must be one of {', '.join(MODES)}")
            return Place(text, key, name, None, "boolean")
        kinds = {each.name: each.type for each in _fields(kind) if not is_output or each.name not in OWN_FIELDS}
        if name not in kinds:
            hint = suggestion(name, kinds)
            raise RunError(f"{where}: {key} has no field {name!r}; {hint}must be one of {', '.join(kinds)}")
        described = kinds[name]
        if isinstance(described, msgspec.inspect.UnionType):
            some = [each for each in described.types if not isinstance(each, msgspec.inspect.NoneType)]
            described = some[0] if len(some) == 1 else described
        value = _kind(described)
        if value is not None:
            if rest:
                raise RunError(f"{where}: {name} is a single value; has no element {'.'.join(rest)}")
            return Place(text, key, name, None, value)
        element, names = self._elements(key, name, described)
        if element is None:
            raise RunError(f"{where}: {name} of {key} has no fixed set of values; map another field")
        return self._elements_at(text, key, name, rest, element, names, where)

    def _elements_at(
        self, text: str, key: str, field: str, rest: list[str], kind: Kind, names: Sequence[str], where: str
    ) -> Place:
        """Return the place of all elements of a field, or of the one whose name or number is in `rest`."""
        if not rest:
            return Place(text, key, field, tuple(range(len(names))), kind)
        wanted = ".".join(rest)  # the names of a group's variables contain a dot
        index = next((i for i, each in enumerate(names) if wanted in (each, str(i))), None)
        if index is None:
            hint = suggestion(wanted, names) if names[0] != "0" else ""
            allowed = f"0 to {len(names) - 1}" if names[0] == "0" else f"one of {', '.join(names)}"
            raise RunError(f"{where}: {wanted!r} is not an element of {field}; {hint}must be {allowed}")
        return Place(text, key, field, (index,), kind)

    def _message(self, key: str, is_output: bool, where: str) -> type[Struct]:
        kind = messages.type_of(key)
        if is_output:
            try:
                kind = messages.output_type(key)
            except DecodeError as error:
                raise RunError(f"{where}: {error}") from error
            if kind not in (*messages.COMMANDS, flight_messages.Estimate):
                allowed = ", ".join([*map(keys.leaf, messages.COMMANDS.values()), "estimate"])
                raise RunError(f"{where}: {kind.__name__} cannot be an output of an FMU; must be one of {allowed}")
        if kind is None:
            hint = "must be an estimate, truth, a sensor, or the state of a cluster"
            raise RunError(f"{where}: {key} is not a key of the contract; {hint}; see docs/protocol.md")
        return kind

    def _elements(self, key: str, field: str, described: Any) -> tuple[Kind | None, Sequence[str]]:
        """Return the kind and names of a field's elements; the kind is None if it or the number of elements varies."""
        _, thing, _ = keys.parts(key)
        if isinstance(described, msgspec.inspect.TupleType):
            kinds: set[Kind | None] = {_kind(each) for each in described.item_types}
            return (kinds.pop() if len(kinds) == 1 else None), _numbered(len(described.item_types))
        if not isinstance(described, msgspec.inspect.VarTupleType):
            return None, ()
        element = _kind(described.item_type)
        if messages.type_of(key) is flight_messages.ClusterState and field in NUMBERED:
            return element, self._cluster_names(thing)
        if field in ("speed_rad_s", "rotor_rad_s"):
            return element, _numbered(len(self._drones[thing].rotors))
        if described.min_length is not None and described.min_length == described.max_length:
            return element, _numbered(described.min_length)
        return None, ()


def _numbered(count: int) -> Sequence[str]:
    return [str(i) for i in range(count)]


def _fields(kind: type[Struct]) -> Sequence[msgspec.inspect.Field]:
    described = msgspec.inspect.type_info(kind)
    assert isinstance(described, msgspec.inspect.StructType)
    return described.fields


def _kind(described: Any) -> Kind | None:
    if isinstance(described, msgspec.inspect.FloatType):
        return "number"
    if isinstance(described, msgspec.inspect.IntType):
        return "integer"
    if isinstance(described, msgspec.inspect.BoolType):
        return "boolean"
    if isinstance(described, msgspec.inspect.StrType | msgspec.inspect.LiteralType):
        return "text"
    return None


def _conversion(variable: Variable, place: Place, is_output: bool) -> tuple[Callable[[float], float] | None, str]:
    """Return the conversion of values (or None), and a note on units that differ or cannot be compared (or "")."""
    theirs, ours = variable.unit, place.unit
    if theirs is None or ours is None or theirs.name == ours.name or place.kind != "number":
        return None, ""
    found = f"{variable.name} is in {theirs.name}, {place.field} in {ours.name}"
    if theirs.exponents is None:
        return None, f"{found}, not compared, since the FMU does not define its unit; values are passed unchanged"
    assert ours.exponents is not None
    if theirs.exponents[:-1] != ours.exponents[:-1]:  # many tools omit the exponent of rad
        return None, f"{found}, a different quantity; values are passed unchanged"
    if (theirs.factor, theirs.offset) == (ours.factor, ours.offset):
        return None, ""
    own, factor, offset = ours.factor, theirs.factor, theirs.offset
    if is_output:
        return lambda value: (value * factor + offset) / own, f"{found}; converted"
    return lambda value: (value * own - offset) / factor, f"{found}; converted"


class Formation:
    """A formation's kinematics: cluster variables from estimates, and velocities from rates of these variables.

    An FMU can thus be a cluster space controller without kinematics of its own: c in, c_dot out.

    Attributes:
        drones: names of the drones, in the order of the cluster's robots.
        names: names of the cluster variables, in the order of c.
    """

    def __init__(self, scenario: Scenario, cluster: str) -> None:
        of = scenario.cluster(cluster)
        self.cluster, self.drones = cluster, of.drones
        try:
            self._space = scenario_space(scenario, of)
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
