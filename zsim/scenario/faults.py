"""Faults that can be injected into a run: their kinds, the checks of their descriptions, and their typed form.

A fault is described by a map: `kind`, `target`, `at_s`, `for_s`, and the parameters of its kind. The same tables check
scenarios, requests and commands. In a terminal or the console, a fault is typed as
`drone2 gps_dropout probability=0.5 --for 10s`.
"""

import re
import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
from difflib import SequenceMatcher
from typing import Any, Literal, NamedTuple

from zsim.contract import keys
from zsim.contract.run_messages import Fault
from zsim.scenario.roles import AGENTS, PILOT
from zsim.schema import yaml_file
from zsim.schema.checker import Fault as Flaw
from zsim.schema.checker import listed, show, suggestion
from zsim.sensors.scanner import SCANNERS
from zsim.sensors.sensor import Channel, Declaration, SensorType
from zsim.sensors.sensor_catalogue import STOCK

Target = Literal["drone", "world", "link", "radio", "process"]
Shape = Literal["number", "vector", "choice", "word", "flag", "places"]

ROTORS = ("front_left", "front_right", "rear_right", "rear_left")  # in the order of `rotor_rad_s` in truth messages
PROCESS_KILL = "process_kill"
VECTOR_SIZE = 3  # numbers in a bias given as a list
ORIGIN = (0.0, 0.0, 0.0)  # m in W, position of a process that `place` omits and no drone carries
FOREVER_S = 1e6  # s, length of the longest scenario
UNGATED = ("world", "recorder", "console", "gateway", "router")  # roles outside the lockstep, which ignore faults
SIMILARITY_MIN = 0.85  # of difflib; design choice: words as long as "controller" may differ by one typing error
COMMON = ("kind", "target", "at_s", "for_s")  # fields of every fault; all others are parameters


class FaultParameter(NamedTuple):
    """A parameter of a kind of fault."""

    name: str
    shape: Shape
    description: str  # for tables
    unit: str = ""  # unit of the number or vector; empty if dimensionless
    least: float = -1e9  # limits of the number, or of each entry of the vector
    most: float = 1e9
    above: bool = False  # whether `least` itself is excluded
    choices: tuple[str, ...] = ()  # allowed words
    default: Any = None  # value if omitted
    required: bool = True  # whether it must be given
    mildest: float = 0.0  # value at which the fault has no effect


class FaultKind(NamedTuple):
    """One kind of fault."""

    # what it affects: a drone, the world, a link "a/b" between two processes, the radio of some drones, or a process
    strikes: Target
    description: str  # its effect, for tables
    parameters: tuple[FaultParameter, ...] = ()
    # "ends" requires `for_s`, "once" forbids it; "any" allows it, and without it the fault lasts until cleared
    lasts: Literal["any", "ends", "once"] = "any"
    sensor: str = ""  # affected sensor, if any, which not every drone has


def _number(
    name: str, description: str, unit: str, low: float = -1e9, high: float = 1e9, **options: Any
) -> FaultParameter:
    return FaultParameter(name, "number", description, unit, low, high, **options)


_PROBABILITY = FaultParameter("probability", "number", "of each sample", "", 0.0, 1.0, default=1.0, required=False)
_FACTOR = _number("factor", "by which the standard deviation grows", "", 1.0, 1e6, above=True, mildest=1.0)
ROTOR = FaultParameter("rotor", "choice", "which rotor", choices=(*ROTORS, "all"))  # a vehicle may name its own rotors
_ONE_WAY = FaultParameter("one_way", "flag", "from the first to the second only", default=False, required=False)

_RADIO = (
    _number("range_m", "distance at which half of the messages are lost", "m", 0.0, 1e6, above=True, mildest=1e6),
    _number("spread_m", "over which the loss grows", "m", 0.0, 1e6, above=True, default=5.0, required=False),
    FaultParameter(
        "place", "places", "of processes: a drone, or [x, y, z]; else the origin", "m", default={}, required=False
    ),
)


class SensorPart(NamedTuple):
    """Values of a sensor that a fault affects together."""

    sensor: str
    label: str  # name of the part in descriptions
    channel: Channel  # channel of its first numbers, to which a bias is added
    first: int  # index of its first number among the sensor's numbers
    width: int


def sensor_parts(sensors: Mapping[str, SensorType | Declaration]) -> dict[str, SensorPart]:
    """Return the parts of sensors by the prefix of their fault kinds: accel and gyro of an IMU, or a whole sensor."""
    parts: dict[str, SensorPart] = {}
    for name, sensor in sensors.items():
        first = 0
        for channel in sensor.channels:
            part = channel.part or name
            label = channel.label or sensor.label or name
            previous = parts.get(part, SensorPart(name, label, channel, first, 0))
            parts[part] = previous._replace(width=previous.width + channel.width)
            first += channel.width
    return parts


def _sensor_kinds(sensors: Mapping[str, SensorType | Declaration]) -> dict[str, FaultKind]:
    dropouts, stuck, biases, noises = {}, {}, {}, {}
    for name, sensor in sensors.items():
        label = sensor.label or name
        dropouts[f"{name}_dropout"] = FaultKind(
            "drone", f"samples of the {label} are lost", (_PROBABILITY,), sensor=name
        )
        stuck[f"{name}_stuck"] = FaultKind("drone", f"the {label} keeps repeating one sample", sensor=name)
    for name, part in sensor_parts(sensors).items():
        channel = part.channel
        unit = "" if channel.unit == "1" else re.sub(r"[^a-z0-9]+", "_", channel.unit.lower().replace("^", ""))
        shape: Shape = "vector" if channel.width == VECTOR_SIZE else "number"
        limits = -channel.bias_max, channel.bias_max
        bias = FaultParameter(f"value_{unit}".strip("_"), shape, channel.axes, channel.unit, *limits)
        text = f"the {part.label} has an additional constant error"
        biases[f"{name}_bias"] = FaultKind("drone", text, (bias,), sensor=part.sensor)
        noises[f"{name}_noise"] = FaultKind(
            "drone", f"the {part.label} has more white noise", (_FACTOR,), sensor=part.sensor
        )
    return dropouts | stuck | biases | noises


_DISTANCES = (Channel("noise_m", "m", axes="of every distance", bias_max=1e4),)
_SCANNERS = {name: Declaration(message.__name__, {}, _DISTANCES) for name, message in SCANNERS.items()}
KINDS: dict[str, FaultKind] = {
    **_sensor_kinds({**STOCK, **_SCANNERS}),
    "rotor_efficiency": FaultKind(
        "drone",
        "a rotor has lost thrust",
        (ROTOR, _number("value", "remaining share of the thrust", "", 0.0, 1.0, mildest=1.0)),
    ),
    "rotor_stuck": FaultKind(
        "drone",
        "a rotor turns at a constant speed, whatever its command",
        (
            ROTOR,
            _number("speed_rad_s", "if omitted, the speed at the fault's start", "rad/s", 0.0, 1e4, required=False),
        ),
    ),
    "gust": FaultKind(
        "world",
        "the wind rises and falls as (1 - cos) / 2",
        (FaultParameter("velocity_m_s", "vector", "at its peak, in W", "m/s", -100.0, 100.0),),
        "ends",
    ),
    "link_delay": FaultKind(
        "link",
        "messages arrive later",
        (
            _number(
                "delay_ms", "after this delay, a message arrives at the next gate", "ms", 0.0, 60_000.0, above=True
            ),
            _ONE_WAY,
        ),
    ),
    "link_jitter": FaultKind(
        "link",
        "messages arrive later, each by a different delay",
        (_number("jitter_ms", "maximum, uniformly distributed from 0", "ms", 0.0, 60_000.0, above=True), _ONE_WAY),
    ),
    "link_loss": FaultKind(
        "link", "messages are lost", (_number("probability", "of each message", "", 0.0, 1.0), _ONE_WAY)
    ),
    "link_cut": FaultKind("link", "no message arrives", (_ONE_WAY,)),
    "radio": FaultKind("radio", "messages over the radio are lost more often at larger distances", _RADIO),
    PROCESS_KILL: FaultKind("process", "the process dies as if by kill -9", lasts="once"),
}


def kinds_of(own: Mapping[str, Declaration]) -> dict[str, FaultKind]:
    return {**KINDS, **_sensor_kinds(own)} if own else KINDS


def expected(p: FaultParameter) -> str:
    unit = f" {p.unit}" if p.unit else ""
    if p.shape == "choice":
        return f"one of {', '.join(p.choices)}"
    if p.shape == "word":
        return "a name"
    if p.shape == "flag":
        return "true or false"
    if p.shape == "places":
        return "a map of process names, each with a drone or [x, y, z] in m"
    limits = f"> {p.least:g} and <= {p.most:g}" if p.above else f"from {p.least:g} to {p.most:g}"
    return f"[x, y, z], each {limits}{unit}" if p.shape == "vector" else f"{limits}{unit}"


def unstated(kind: FaultKind, parameters: Mapping[str, Any]) -> list[FaultParameter]:
    """Return the magnitudes that a fault of this kind omits, including those with a default."""
    return [
        p
        for p in kind.parameters
        if p.shape in ("number", "vector", "choice")
        and (p.required or p.default is not None)
        and parameters.get(p.name) is None
    ]


def planned(
    description: Mapping[str, Any],  # must have no flaws
    number: int,  # id of the fault
    source: str,
    now_ns: int,  # start of a fault without `at_s`
    gate_ns: int,
    kinds: Mapping[str, FaultKind] = KINDS,
) -> Fault:
    """Return the fault given by a valid description, with times rounded to whole gates and every parameter set.

    It acts in the gates after `from_ns` up to `until_ns`: on the motion between these times, and on the messages of
    those gates.
    """
    kind, at_s, for_s = kinds[description["kind"]], description.get("at_s"), description.get("for_s")
    from_ns = now_ns if at_s is None else round(at_s * 1e9 / gate_ns) * gate_ns
    until_ns = None if for_s is None else from_ns + max(1, round(for_s * 1e9 / gate_ns)) * gate_ns
    if kind.lasts == "once":
        until_ns = from_ns + gate_ns
    parameters = {p.name: _plain(description.get(p.name), p) for p in kind.parameters}
    return Fault(number, description["kind"], description["target"], parameters, from_ns, until_ns, source)


def _plain(value: Any, p: FaultParameter) -> Any:
    """Return a value as it is sent: numbers become floats, so that equal faults have equal texts."""
    if value is None:
        return p.default
    if p.shape == "number":
        return float(value)
    if p.shape == "vector":
        return [float(x) for x in value]
    if p.shape == "places":
        return {name: point if isinstance(point, str) else [float(x) for x in point] for name, point in value.items()}
    return value


def acts(fault: Fault, gate_ns: int) -> bool:
    """Return whether a fault acts in the gate that ends at `gate_ns`."""
    return fault.from_ns < gate_ns and (fault.until_ns is None or gate_ns <= fault.until_ns)


# Checks of a description


class Known(NamedTuple):
    """Valid names of targets, and the kinds of faults, in a run."""

    drones: tuple[str, ...]
    clusters: tuple[str, ...]
    processes: tuple[str, ...] = ()  # other than estimators and controllers
    kinds: Mapping[str, FaultKind] = KINDS
    # names by drone; empty if the module of its vehicle is not imported here
    rotors: Mapping[str, tuple[str, ...]] = {}
    external: tuple[str, ...] = ()  # drones whose bodies and sensors are not simulated
    sensors: Mapping[str, Collection[str]] = {}  # names by drone, where known
    unread: Collection[str] = ()  # sensors whose modules are faulty or not imported: their fault kinds are unknown

    def things(self) -> dict[str, tuple[str, ...]]:
        roles = {name: role.about for name, role in AGENTS.items() if name != PILOT}  # not every drone has a pilot
        return {name: self.drones if about == "drone" else self.clusters for name, about in roles.items()}

    def takes_part(self, process: str) -> bool:
        role, _, thing = process.partition(".")
        return thing in self.things().get(role, ()) or process in self.processes

    def example(self) -> str:
        return f"estimator.{self.drones[0]}" if self.drones else "estimator.drone1"


def flaws(fault: Any, known: Known) -> Iterator[Flaw]:
    """Yield the path and text of every flaw in a fault's description."""
    if not isinstance(fault, Mapping):
        yield "", f"is {show(fault)}; must be a map with kind and target"
        return
    name = fault.get("kind")
    kind = known.kinds.get(name) if isinstance(name, str) else None
    if kind is None or not isinstance(name, str):
        sensor, _, ending = name.rpartition("_") if isinstance(name, str) else ("", "", "")
        if sensor in known.unread and ending in ("dropout", "stuck", "bias", "noise"):
            return
        yield "kind", f"{_actual(fault, 'kind')}; {allowed_kinds(name, known.kinds)}"
        return
    params = {parameter.name: parameter for parameter in kind.parameters}
    for field in fault:
        if field not in COMMON and field not in params:
            allowed = ", ".join([*COMMON, *params])
            yield str(field)[:40], f"is not known; {suggestion(field, (*COMMON, *params))}allowed: {allowed} ({name})"
    faults = [*_target_flaws(fault, kind, known), *_time_flaws(fault, kind)]
    target = fault.get("target")
    rotors = known.rotors.get(target) if isinstance(target, str) else None
    for p in kind.parameters:
        if p is ROTOR and rotors is not None:  # rotors of the target's vehicle; any name if unknown
            p = p._replace(choices=(*rotors, "all")) if rotors else p._replace(shape="word")
        faults += _parameter_flaws(fault, p, known)
    for path, text in faults:
        yield path, text if text.endswith(f"({name})") else f"{text} ({name})"


def _actual(fault: Mapping[str, Any], field: str) -> str:
    return f"is {show(fault[field])}" if field in fault else "is missing"


def _target_flaws(fault: Mapping[str, Any], kind: FaultKind, known: Known) -> Iterator[Flaw]:
    actual, target = _actual(fault, "target"), fault.get("target")
    if kind.strikes == "link":
        yield from _link_flaws(actual, target, fault.get("one_way") is True, known)
    elif kind.strikes == "process":
        if not isinstance(target, str) or not known.takes_part(target):
            yield "target", f"{actual}; must be a process that takes part, such as {known.example()}"
        elif target.partition(".")[0] in UNGATED:
            yield (
                "target",
                f"{actual}, outside the lockstep; must be a process that takes part, such as {known.example()}",
            )
    else:
        allowed = {"drone": known.drones, "world": ("world",), "radio": ("world", *known.clusters)}[kind.strikes]
        if target not in allowed:
            yield "target", f"{actual}; must be {'one of ' if len(allowed) > 1 else ''}{listed(allowed)}"
        elif kind.strikes == "drone" and target in known.external:
            yield "target", f"{actual}, whose body is external; must be a drone that is simulated"
        elif kind.sensor and kind.sensor not in known.sensors.get(str(target), (kind.sensor,)):
            having = [drone for drone in known.drones if kind.sensor in known.sensors.get(drone, ())]
            allowed = f"a drone with one: {listed(having)}" if having else "left out: no drone has one"
            yield "target", f"{actual}, which has no sensor {kind.sensor}; must be {allowed}"


def _link_flaws(actual: str, target: Any, one_way: bool, known: Known) -> Iterator[Flaw]:
    names = target.split("/") if isinstance(target, str) else []
    if len(names) != 2 or names[0] == names[1]:
        yield "target", f"{actual}; must be two processes, such as world/{known.example()}"
        return
    for name in names:
        allowed = _allowed_instead(name, known)
        if allowed:
            yield "target", f"{actual}; {name[:48]!r} must be {allowed}"
    receiver = f"the world or a process that takes part, such as {known.example()}"
    if not any(name == "world" or known.takes_part(name) for name in names):
        yield "target", f"{actual}; one of them must be {receiver}"
    elif one_way and names[1] != "world" and names[1].partition(".")[0] in UNGATED:
        yield "target", f"{actual}, one way, and {names[1]!r} is outside the lockstep; the second must be {receiver}"


def _allowed_instead(name: str, known: Known) -> str | None:
    """Return what a process must be named instead; None if `name` is allowed, as most are, for users' processes."""
    if not keys.PROCESS_NAME.fullmatch(name):
        return "1 to 48 of a-z 0-9 _ . -"
    if name in known.processes:
        return None
    role, dot, thing = name.partition(".")
    things = known.things()
    if role in things and thing not in things[role]:
        return f"{role}.NAME of {listed(things[role])}"
    for own_role, names in {**things, "world": ("",)}.items():
        if thing in names and own_role not in role and SequenceMatcher(None, role, own_role).ratio() >= SIMILARITY_MIN:
            return f"{own_role}{dot}{thing}, or a less similar name"
    return None


def _time_flaws(fault: Mapping[str, Any], kind: FaultKind) -> Iterator[Flaw]:
    at_s, for_s = fault.get("at_s"), fault.get("for_s")
    if at_s is not None and not _within(at_s, 0.0, FOREVER_S):
        yield "at_s", f"is {show(at_s)}; must be from 0 to {FOREVER_S:g} s"
    if kind.lasts == "once" and for_s is not None:
        yield "for_s", f"is {show(for_s)}; must be left out"
    elif kind.lasts == "ends" and for_s is None:
        yield "for_s", "is missing; must be its duration in s"
    elif for_s is not None and not _within(for_s, 0.0, FOREVER_S, is_open=True):
        yield "for_s", f"is {show(for_s)}; must be > 0 and <= {FOREVER_S:g} s"


def _parameter_flaws(fault: Mapping[str, Any], p: FaultParameter, known: Known) -> Iterator[Flaw]:
    value = fault.get(p.name)
    if value is None:
        if p.required:
            yield p.name, f"is missing; must be {expected(p)}"
        return
    if p.shape == "places" and isinstance(value, Mapping):
        for process, position in value.items():
            path = f"{p.name}.{str(process)[:48]}"
            if allowed := _allowed_instead(process if isinstance(process, str) else "", known):
                yield path, f"names no process; must be {allowed}"
            if not _is_vector(position, -1e6, 1e6) and position not in known.drones:
                yield path, f"is {show(position)}; must be a drone or [x, y, z] in m"
        return
    is_sound = {
        "number": lambda: _within(value, p.least, p.most, p.above),
        "vector": lambda: _is_vector(value, p.least, p.most),
        "choice": lambda: value in p.choices,
        "word": lambda: isinstance(value, str),
        "flag": lambda: isinstance(value, bool),
        "places": lambda: False,
    }
    if not is_sound[p.shape]():
        yield p.name, f"is {show(value)}; must be {expected(p)}"


def _is_vector(value: Any, low: float, high: float) -> bool:
    return isinstance(value, list | tuple) and len(value) == 3 and all(_within(x, low, high) for x in value)


def _within(value: Any, low: float, high: float, is_open: bool = False) -> bool:
    """Return whether a value is a number within limits; integers may be arbitrarily large, NaN is never within."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and low <= value <= high and not (is_open and value == low)


# Faults as typed in a terminal or the console

DURATION_UNITS = {"ms": 1e-3, "s": 1.0, "min": 60.0, "": 1.0}  # s
OPTION_OF = {"target": "the argument TARGET", "kind": "the argument KIND", "for_s": "--for", "at_s": "--at"}
_OPTIONS = {"--for": "for_s", "--at": "at_s"}


def typed_duration_s(text: str) -> float:
    """Return the duration [s] given by a text such as 10s, 500ms or 2min; ValueError if it is not a duration."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(ms|s|min|)", text.strip())
    if not match:
        raise ValueError(f"is {text[:40]!r}; must be a duration such as 10s, 500ms or 2min")
    return float(match[1]) * DURATION_UNITS[match[2]]


def typed_parameters(texts: Sequence[str]) -> dict[str, Any]:
    """Return the parameters given by words NAME=VALUE, with values in YAML.

    Raises:
        ValueError: a word has another form, repeats a name, or names an argument or option.
    """
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not re.fullmatch("[a-z][a-z0-9_]*", name):
            raise ValueError(f"{text[:40]!r} is not a parameter; must be NAME=VALUE, see `zsim fault kinds`")
        if name in OPTION_OF:
            raise ValueError(f"{name} is not a parameter; give it with {OPTION_OF[name]}")
        if name in values:
            raise ValueError(f"{name} is given twice; must be given once")
        try:
            values[name] = yaml_file.value(value)
        except ValueError as error:
            raise ValueError(f"{name} {error}") from None
    return values


def typed_rest(text: str) -> dict[str, Any]:
    """Return the parameters and times typed after TARGET KIND in `zsim fault add`.

    Lists and maps need no quotes here, since no shell parses them.

    Raises:
        ValueError: the text is not of the form NAME=VALUE NAME=VALUE … --for DURATION --at DURATION.
    """
    times: dict[str, float] = {}
    assignments: list[str] = []
    pending = iter(_split(text))
    for part in pending:
        option, equals, value = part.partition("=")
        if option not in _OPTIONS:
            assignments.append(part)
            continue
        try:
            times[_OPTIONS[option]] = typed_duration_s(value if equals else next(pending, ""))
        except ValueError as error:
            raise ValueError(f"{option} {error}") from None
    return {**typed_parameters(assignments), **times}


def _split(text: str) -> list[str]:
    texts: list[str] = []
    depth = 0
    try:
        parts = shlex.split(text)
    except ValueError as error:
        raise ValueError(f"{text[:40]!r}: {str(error).lower()}; must be NAME=VALUE NAME=VALUE …") from None
    for part in parts:
        if depth > 0:
            texts[-1] += f" {part}"
        else:
            texts.append(part)
        depth += sum(part.count(each) for each in "[{") - sum(part.count(each) for each in "]}")
    return texts


def allowed_kinds(actual: Any, known: Collection[str]) -> str:
    """Return the part of an error text that says which kinds of faults are allowed instead of `actual`."""
    return f"{suggestion(actual, known)}must be one of the {len(known)} that `zsim fault kinds SCENARIO` lists"
