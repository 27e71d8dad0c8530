"""Input of an operator: ranges of cluster variables, texts of trajectories and waypoints, fault parameters. Pure.

Pages show lengths in metres and angles in degrees; requests have metres and radians.
"""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from zsim.scenario.faults import FaultKind, expected, typed_rest, unstated
from zsim.scenario.scenario import Cluster, Drone, Scenario
from zsim_agents.formation.spaces.cluster_space import ClusterSpace, unit
from zsim_agents.formation.trajectory import DEGREES

SIDEWAYS_M = 50.0  # around the drones' starts; chosen: as far as a page shows a formation well
HEIGHT_MIN_M, HEIGHT_MAX_M = 1.0, 30.0  # chosen: clear of the ground, and within sight
SIDE_MAX_M = 20.0  # of a formation; chosen
DISPLACEMENT_M = 5.0  # of a robot from its place in a template; chosen
TILT_MAX_DEG = 29.0  # of a formation; controllers take less than 30, flight_check.py
CORNER_DEG = 10.0  # least angle at a corner; at 0 and 180 degrees the robots are in line
DIGITS = 6  # of a displayed value: 5.1, not 5.1000000000000005
STEPS = {"m": 0.1, "deg": 1.0}
SHOWN_MAX = 16  # variables that a page shows one by one; of more, only those of the formation as a whole
WAYPOINT_STEP_S = 20.0  # from the first to the second prefilled waypoint
PREFILLED = ("x_c", "y_c", "z_c", "yaw")  # variables in prefilled waypoints, where a formation has them


def range_refusal(name: str, value: float, low: float, high: float, unit: str = "") -> str | None:
    """Return why a typed number may not be requested, None if it may; it is never clipped to a limit."""
    if low <= value <= high:
        return None
    in_unit = f" {unit}" if unit else ""
    return f"{name} is {value:g}{in_unit}; must be from {low:g} to {high:g}{in_unit}"


class SliderRange(NamedTuple):
    """The range of a cluster variable on a slider, in its unit, m or deg."""

    name: str
    unit: str
    low: float
    high: float
    step: float

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit}]"

    @property
    def start(self) -> float:
        """Position of the slider while the variable is unknown."""
        return min(max(0.0, self.low), self.high)

    def in_unit(self, value: float) -> float:
        """Return a value [m, rad] in the unit of the range; angles within ±180 degrees."""
        return math.degrees(math.remainder(value, math.tau)) if self.unit == "deg" else value

    def to_si(self, shown: float) -> float:
        return math.radians(shown) if self.unit == "deg" else shown

    def to_display(self, value: float) -> float:
        """Return a value [m, rad] in the unit of the range, rounded to its step; the limit if it is just beyond it.

        Limits need not be whole steps: those of sides come from the scenario.
        """
        shown = self.in_unit(value)
        rounded = round(round(shown / self.step) * self.step, DIGITS)
        within = min(max(rounded, self.low), self.high)
        return within if abs(shown - within) <= self.step / 2.0 else rounded

    def label_of(self, value: float) -> str:
        """Return the label; it contains the value [m, rad] if that is out of range."""
        shown, slack = self.in_unit(value), self.step / 2.0
        if self.low - slack <= shown <= self.high + slack:
            return self.label
        return f"{self.name} = {shown:.1f} {self.unit}: out of range"

    def refusal(self, shown: float) -> str | None:
        """Return why a value may not be requested, None if it may."""
        return range_refusal(self.name, shown, self.low, self.high, self.unit)


def height_range_m(drones: Iterable[Drone]) -> tuple[float, float]:
    """Return the range of heights to which some drones may be sent, below the lowest of their ceilings."""
    top_m = min(HEIGHT_MAX_M, *(drone.limits.altitude_m for drone in drones))
    return min(HEIGHT_MIN_M, top_m / 2.0), top_m


def slider_ranges(space: ClusterSpace, cluster: Cluster, scenario: Scenario) -> list[SliderRange]:
    """Return the ranges of all variables of a formation, in their order."""
    drones = [scenario.drone(name) for name in cluster.drones]
    x, y = (round(sum(drone.position_m[axis] for drone in drones) / len(drones)) for axis in range(2))
    apart_m = max(cluster.gains.separation_min_m, STEPS["m"])
    side = (apart_m, max(SIDE_MAX_M, 2.0 * apart_m))
    bounds = {
        "x_c": (x - SIDEWAYS_M, x + SIDEWAYS_M),
        "y_c": (y - SIDEWAYS_M, y + SIDEWAYS_M),
        "z_c": height_range_m(drones),
        **dict.fromkeys(("p", "q", "rho"), side),
        **dict.fromkeys(("roll", "pitch", "elevation"), (-TILT_MAX_DEG, TILT_MAX_DEG)),
        "beta": (CORNER_DEG, 180.0 - CORNER_DEG),
    }
    ranges = []
    for name in space.names:
        shown_in = "deg" if unit(name) == "rad" else "m"
        whole = (-180.0, 180.0) if shown_in == "deg" else (-DISPLACEMENT_M, DISPLACEMENT_M)
        stem = name.rpartition(".")[2].rstrip("0123456789").rstrip("_")
        low, high = bounds.get(name) or bounds.get(stem) or whole
        ranges.append(SliderRange(name, shown_in, float(low), float(high), STEPS[shown_in]))
    return ranges


def primary_variables(names: Sequence[str]) -> list[str]:
    """Return the variables that a page shows one by one: all if few; if many, those of the formation as a whole."""
    whole = ("x_c", "y_c", "z_c", "roll", "pitch", "yaw", "p", "q", "beta")
    return list(names) if len(names) <= SHOWN_MAX else [name for name in names if name in whole]


class InputError(ValueError):
    """An operator's text that cannot be parsed; the message has the line and what is allowed."""


def parse_expressions(text: str, names: Sequence[str], angles: Collection[str] = ()) -> dict[str, Any]:
    """Return the arguments of a trajectory of lines `variable = expression`; other names are constants.

    Args:
        names: of the formation's variables.
        angles: those of them whose expressions are in degrees; `NAME_deg` is the same as `NAME`.

    Raises:
        InputError: a line is neither.
    """
    by_variable: dict[str, str] = {}
    constants: dict[str, float] = {}
    for number, line in _lines(text):
        name, sign, value = (part.strip() for part in line.partition("="))
        if not sign or not name or not value:
            allowed = "VARIABLE = EXPRESSION, such as x_c = 5*cos(0.1*t)"
            raise InputError(f"line {number} is {line[:40]!r}; must be {allowed}")
        variable = name.removesuffix(DEGREES)
        if variable in angles:
            by_variable[f"{variable}{DEGREES}"] = value
        elif name in names:
            by_variable[name] = value
        else:
            constants[name] = _number(value, f"line {number}: {name} is not a variable, and as a constant")
    if not by_variable:
        raise InputError("trajectory is empty; must have at least one line VARIABLE = EXPRESSION")
    for name in constants:
        if not any(re.search(rf"\b{re.escape(name)}\b", expression) for expression in by_variable.values()):
            raise InputError(f"{name} is neither a variable nor used as a constant; variables are {', '.join(names)}")
    return {"expressions": by_variable, "constants": constants}


def parse_waypoints(text: str, ranges: Mapping[str, SliderRange]) -> dict[str, Any]:
    """Return the arguments of a trajectory of lines `seconds: variable = value, …`, values in the ranges' units.

    Raises:
        InputError: a line has another form.
    """
    points = []
    for number, line in _lines(text):
        at, colon, rest = line.partition(":")
        pairs = [(name.strip(), sign, value) for name, sign, value in (pair.partition("=") for pair in rest.split(","))]
        if not colon or not all(name and sign for name, sign, _ in pairs):
            raise InputError(f"line {number} is {line[:40]!r}; must be SECONDS: VARIABLE = VALUE, VARIABLE = VALUE, …")
        shown = {name: _number(value, f"line {number}: {name}") for name, _, value in pairs}
        values = {name: ranges[name].to_si(value) if name in ranges else value for name, value in shown.items()}
        points.append({"at_s": _number(at, f"line {number}: the time"), "values": values})
    if not points:
        raise InputError("waypoints are empty; must have at least one line SECONDS: VARIABLE = VALUE")
    return {"waypoints": points}


def waypoints_from(value: Sequence[float], ranges: Sequence[SliderRange]) -> str:
    """Return waypoints that begin where a formation is, in the units of the page."""
    pairs = [
        f"{each.name} = {round(each.in_unit(here), 2):g}"
        for each, here in zip(ranges, value, strict=True)
        if each.name in PREFILLED
    ]
    return "\n".join(f"{at_s:g}: {', '.join(pairs)}" for at_s in (0.0, WAYPOINT_STEP_S))


def is_apart(value: Sequence[float], other: Sequence[float], ranges: Sequence[SliderRange]) -> bool:
    """Return whether a formation's prefilled waypoints at one place differ from those at another by more than a step.

    Text that followed every estimate would change constantly.
    """
    return any(
        abs(round(each.in_unit(here - there), 2)) > each.step
        for each, here, there in zip(ranges, value, other, strict=True)
        if each.name in PREFILLED
    )


def parse_fault(text: str, name: str, kind: FaultKind) -> dict[str, Any]:
    """Return the parameters and times of a fault, typed as after TARGET KIND in a terminal.

    Every magnitude must be given, even one with a default: an empty text must not affect all samples.

    Raises:
        InputError: the text is not such a list, names something unknown to the kind, or omits a magnitude.
    """
    where = f"parameters are {text[:40]!r}"
    try:
        values = typed_rest(text)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
    known = [p.name for p in kind.parameters]
    for given in values:
        if given not in (*known, "at_s", "for_s"):
            allowed = ", ".join([*(f"{each}=VALUE" for each in known), "--at", "--for"])
            raise InputError(f"{where}; {given[:40]!r} is not known, allowed: {allowed}")
    missing = [f"{p.name} is missing; must be {expected(p)}" for p in unstated(kind, values)]
    if missing:
        raise InputError(f"{'; '.join(missing)} ({name})")
    return {given: value for given, value in values.items() if value is not None}


def _lines(text: str) -> list[tuple[int, str]]:
    """Return the lines with their numbers, without comments and blank lines."""
    numbered = enumerate(text.splitlines(), start=1)
    return [(number, line.strip()) for number, line in numbered if line.strip() and not line.lstrip().startswith("#")]


def _number(text: str, what: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{what} is {text.strip()[:40]!r}; must be a number") from None
