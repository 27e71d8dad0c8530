"""The faults that can be injected into a run: kinds, whom they strike, parameters with unit and limits. Pure.

A fault is given as a map: `kind`, `target`, `at_s`, `for_s`, and the parameters of its kind.
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from zsim.contract.messages import Fault

Target = Literal["drone", "world", "link", "radio", "process"]
Shape = Literal["number", "vector", "choice", "word", "flag", "places"]

ROTORS = ("front_left", "front_right", "rear_right", "rear_left")  # in the order of truth's rotor_rad_s
PROCESS_KILL = "process_kill"
ORIGIN = (0.0, 0.0, 0.0)  # m in W: where a process is that no `place` names


class FaultParameter(NamedTuple):
    """One number, vector, word or map of a kind.

    Attributes:
        unit: of the number or vector; empty for one without.
        least, most: limits, each of a vector's entries.
        above: whether `least` itself is not allowed.
        choices: of a word.
        default: where it is left out; `required` then says that it may not be.
        description: what it is, for tables.
    """

    name: str
    shape: Shape
    description: str
    unit: str = ""
    least: float = -1e9
    most: float = 1e9
    above: bool = False
    choices: tuple[str, ...] = ()
    default: Any = None
    required: bool = True


class FaultKind(NamedTuple):
    """One kind of fault.

    Attributes:
        strikes: what its target is: a drone; the world; a link "a/b" of two processes; the drones of a cluster, or of
            the world, on the radio; a process.
        description: what it does, for tables.
        lasts: "ends" needs `for_s`, "once" takes none, "any" takes it or lasts until it is cleared.
    """

    strikes: Target
    description: str
    parameters: tuple[FaultParameter, ...] = ()
    lasts: Literal["any", "ends", "once"] = "any"


def _number(name: str, said: str, unit: str, least: float = -1e9, most: float = 1e9, **more: Any) -> FaultParameter:
    return FaultParameter(name, "number", said, unit, least, most, **more)


def _vector(name: str, said: str, unit: str, most: float) -> FaultParameter:
    return FaultParameter(name, "vector", said, unit, -most, most)


_PROBABILITY = FaultParameter("probability", "number", "of each sample", "", 0.0, 1.0, default=1.0, required=False)
_FACTOR = _number("factor", "by which the standard deviation grows", "", 1.0, 1e6, above=True)
ROTOR = FaultParameter("rotor", "choice", "which", choices=(*ROTORS, "all"))  # of a vehicle: its own names, and all
_ONE_WAY = FaultParameter("one_way", "flag", "from the first to the second only", default=False, required=False)
_SENSORS = {
    "imu": "IMU",
    "gps": "GPS",
    "mag": "magnetometer",
    "baro": "barometer",
    "sonar": "sonar",
    "flow": "optical flow",
}
# The greatest values are chosen: about ten times what any such sensor can show, so that only slips are refused.
_BIASES = {
    "accel": _vector("value_m_s2", "in the sensor's axes", "m/s^2", 500.0),
    "gyro": _vector("value_deg_s", "in the sensor's axes", "deg/s", 5700.0),
    "gps": _vector("value_m", "east, north, up", "m", 1e5),
    "mag": _vector("value_ut", "in the sensor's axes", "uT", 1e4),
    "baro": _number("value_m", "of height", "m", -1e4, 1e4),
    "sonar": _number("value_m", "of range", "m", -1e4, 1e4),
    "flow": _vector("value_m_s", "forward, left, up", "m/s", 1e3),
}
_NAMES = {"accel": "accelerometer", "gyro": "gyroscope", **_SENSORS}

_RADIO = (
    _number("range_m", "distance at which every second message is lost", "m", 0.0, 1e6, above=True),
    _number("spread_m", "over which the loss grows", "m", 0.0, 1e6, above=True, default=5.0, required=False),
    FaultParameter(
        "place", "places", "of processes: a drone, or [x, y, z]; else the origin", "m", default={}, required=False
    ),
)

KINDS: dict[str, FaultKind] = {
    **{
        f"{sensor}_dropout": FaultKind("drone", f"samples of the {said} are lost", (_PROBABILITY,))
        for sensor, said in _SENSORS.items()
    },
    **{
        f"{sensor}_stuck": FaultKind("drone", f"the {said} shows one sample again and again")
        for sensor, said in _SENSORS.items()
    },
    **{
        f"{name}_bias": FaultKind("drone", f"the {_NAMES[name]} has a constant error more", (value,))
        for name, value in _BIASES.items()
    },
    **{f"{name}_noise": FaultKind("drone", f"the {_NAMES[name]} has more white noise", (_FACTOR,)) for name in _BIASES},
    "rotor_efficiency": FaultKind(
        "drone", "a rotor has lost thrust", (ROTOR, _number("value", "share of the thrust that is left", "", 0.0, 1.0))
    ),
    "rotor_stuck": FaultKind(
        "drone",
        "a rotor turns at one speed whatever it is told",
        (ROTOR, _number("speed_rad_s", "as it turns at the start, if left out", "rad/s", 0.0, 1e4, required=False)),
    ),
    "gust": FaultKind(
        "world",
        "the wind swells and ebbs: (1 - cos) / 2",
        (_vector("velocity_m_s", "at its peak, in W", "m/s", 100.0),),
        "ends",
    ),
    "link_delay": FaultKind(
        "link",
        "messages come later",
        (_number("delay_ms", "after it, a message comes at the next gate", "ms", 0.0, 60_000.0, above=True), _ONE_WAY),
    ),
    "link_jitter": FaultKind(
        "link",
        "messages come later, each by another time",
        (_number("jitter_ms", "most of it, evenly spread from 0", "ms", 0.0, 60_000.0, above=True), _ONE_WAY),
    ),
    "link_loss": FaultKind(
        "link", "messages are lost", (_number("probability", "of each message", "", 0.0, 1.0), _ONE_WAY)
    ),
    "link_cut": FaultKind("link", "no message comes", (_ONE_WAY,)),
    "radio": FaultKind("radio", "messages between a drone and others are lost with distance", _RADIO),
    PROCESS_KILL: FaultKind("process", "the process dies as by kill -9", lasts="once"),
}


def expected(p: FaultParameter) -> str:
    """Return in words what a parameter may be."""
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


def planned(given: Mapping[str, Any], number: int, source: str, now_ns: int, gate_ns: int) -> Fault:
    """Return the fault that a sound map asks for, in whole gates and with every parameter.

    It acts in the gates after `from_ns` up to `until_ns`: on what happens between these instants, and on messages that
    belong to those gates.

    Args:
        given: without flaws.
        number: its id.
        now_ns: when it begins where `at_s` is left out.
    """
    kind, at_s, for_s = KINDS[given["kind"]], given.get("at_s"), given.get("for_s")
    from_ns = now_ns if at_s is None else round(at_s * 1e9 / gate_ns) * gate_ns
    until_ns = None if for_s is None else from_ns + max(1, round(for_s * 1e9 / gate_ns)) * gate_ns
    if kind.lasts == "once":
        until_ns = from_ns + gate_ns
    parameters = {p.name: _plain(given.get(p.name), p) for p in kind.parameters}
    return Fault(number, given["kind"], given["target"], parameters, from_ns, until_ns, source)


def _plain(value: Any, p: FaultParameter) -> Any:
    """Return a value as it goes onto the wire: numbers as floats, so that the same fault is the same text."""
    if value is None:
        return p.default
    if p.shape == "number":
        return float(value)
    if p.shape == "vector":
        return [float(x) for x in value]
    if p.shape == "places":
        return {name: place if isinstance(place, str) else [float(x) for x in place] for name, place in value.items()}
    return value


def acts(fault: Fault, gate_ns: int) -> bool:
    """Tell whether a fault acts in the gate that ends at `gate_ns`."""
    return fault.from_ns < gate_ns and (fault.until_ns is None or gate_ns <= fault.until_ns)
