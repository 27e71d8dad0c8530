"""References in cluster space: a value and its rate as functions of time.

Time is in seconds from the start of the reference; outside [0, duration_s], a reference stays at the nearer end. Angles
are continuous in time, not wrapped. Users give values by the names of variables, in metres and radians, or in degrees
as NAME_deg.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from zsim.contract.snapshot import State
from zsim.math.compiled import portable
from zsim.scenario.scenario import WAYPOINTS_MAX
from zsim_agents.formation.expression import Expression, ExpressionError, finite_number
from zsim_agents.formation.spaces.cluster_space import TAU, Array, ClusterSpace

DEGREES = "_deg"
ANGLE_MAX_RAD = TAU + 1e-3  # one turn, rounded up to four digits; a larger angle was probably meant in degrees


class TrajectoryError(ValueError):
    """A trajectory is not possible as written; the message names the value, finding and remedy.

    `at` is the path of the value within the target or trajectory; empty if no single value is wrong.
    """

    def __init__(self, finding: str, where: str = "", at: str = "") -> None:
        super().__init__(f"{where} {finding}" if where else finding)
        self.finding = finding
        self.at = at


class Variables(Protocol):
    """What a reference needs to know about its variables: those of a cluster space, or one drone's position."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def in_radians(self) -> Any: ...

    def index(self, name: str) -> int: ...

    def difference(self, c_to: Array, c_from: Array) -> Array: ...


class Reference(Protocol):
    """A motion in cluster space; duration_s is the time after which it is at rest; None if it never is.

    `value` returns c and its exact derivative c_dot, each (4n,), at t_s.
    """

    @property
    def duration_s(self) -> float | None: ...

    def value(self, t_s: float) -> tuple[Array, Array]: ...


@dataclass(frozen=True, eq=False)
class Hold:
    """A constant reference at c (4n,)."""

    c: Array
    duration_s: float | None = 0.0

    def value(self, t_s: float) -> tuple[Array, Array]:
        return self.c, np.zeros(self.c.size)


@dataclass(frozen=True, eq=False)
class Shifted:
    """A reference delayed by start_s."""

    of: Reference
    start_s: float

    @property
    def duration_s(self) -> float | None:
        own = self.of.duration_s
        return None if own is None else max(0.0, self.start_s + own)

    def value(self, t_s: float) -> tuple[Array, Array]:
        return self.of.value(t_s - self.start_s)


class ExpressionTrajectory:
    """Variables as expressions of t; variables without an expression stay at base (4n,).

    Args:
        expressions: text or a number by variable name, e.g. {"x_c": "5*cos(2*pi*f*t)", "p": 4, "yaw_deg": "6*t"}.
        constants: user constants by name, e.g. {"f": 0.01}.
        duration_s: end of the motion; None if it is endless.

    Attributes:
        arguments: constructor arguments by name, as plain values.

    Raises:
        ExpressionError, TrajectoryError: an unknown name, or a forbidden expression or duration.
    """

    def __init__(
        self,
        space: Variables,
        expressions: Mapping[str, str | float],
        base: Array,
        constants: Mapping[str, float] | None = None,
        duration_s: float | None = None,
    ) -> None:
        if duration_s is not None and not (finite_number(duration_s) or 0.0) > 0.0:
            raise TrajectoryError(f"trajectory: duration_s is {duration_s}; allowed: a finite number above 0")
        self.duration_s = duration_s
        self._base = base.copy()
        self._moving: list[tuple[Variable, Expression]] = []
        given = set[int]()
        for name, text in expressions.items():
            location = f"expressions: {name}", f".expressions.{name}"
            variable = variable_of(space, name, "expressions", ".expressions")
            _refuse_twice(space, variable, given, location)
            if not isinstance(text, str) and finite_number(text) is None:
                raise ExpressionError(f"{name}: found {str(text)[:40]!r}; allowed: text or a finite number")
            expression = Expression(name, text if isinstance(text, str) else repr(float(text)), constants)
            if expression.constant:
                value = expression(0.0)[0]
                _refuse_turns(space, variable, value, location)
                self._base[variable.entry] = value * variable.scale
            else:
                self._moving.append((variable, expression))
        self.arguments = {
            "expressions": dict(expressions), "base": base.copy(), "constants": dict(constants or {}),
            "duration_s": duration_s,
        }  # fmt: skip

    def value(self, t_s: float) -> tuple[Array, Array]:
        end = math.inf if self.duration_s is None else self.duration_s
        clamped = min(max(t_s, 0.0), end)
        c, c_dot = self._base.copy(), np.zeros_like(self._base)
        for (entry, scale), expression in self._moving:
            value, rate = expression(clamped)
            c[entry], c_dot[entry] = value * scale, rate * scale
        return c, c_dot if clamped == t_s else np.zeros_like(c)


class WaypointTrajectory:
    """Waypoints joined by cubics with PCHIP slopes: C1, at rest at both ends, without overshoot.

    A waypoint is {"at_s": 10.0, "values": {"x_c": 5.0, ...}}; variables that it does not name stay as in the previous
    waypoint, or before the first as in base. Angles that wrap take the shorter way round.

    Raises:
        TrajectoryError: a waypoint is not allowed; the text names it and its fault.
    """

    def __init__(self, space: Variables, waypoints: Sequence[Mapping[str, object]], base: Array) -> None:
        if not 1 <= len(waypoints) <= WAYPOINTS_MAX:
            raise TrajectoryError(f"trajectory: {len(waypoints)} waypoints; allowed: 1 to {WAYPOINTS_MAX}")
        self._times: list[float] = []
        points: list[Array] = []
        for number, waypoint in enumerate(waypoints, start=1):
            is_map = isinstance(waypoint, Mapping)
            given = waypoint.get("at_s") if is_map else waypoint
            at_s = finite_number(given) if is_map else None
            min_s = self._times[-1] if self._times else -1e-9
            if at_s is None or not at_s > min_s:
                bound = f" above {min_s:g}, that of the waypoint before" if self._times else ", 0 or more"
                finding = f"is {str(given)[:40]}; allowed: a number of seconds{bound}"
                raise TrajectoryError(finding, f"waypoint {number}: at_s", f".waypoints[{number - 1}].at_s")
            self._times.append(at_s)
            unknown = sorted(str(key)[:40] for key in waypoint if key not in ("at_s", "values"))
            if unknown:
                raise TrajectoryError(f"waypoint {number}: field {unknown[0]!r} is unknown; allowed: at_s, values")
            before, path = points[-1] if points else base, f".waypoints[{number - 1}].values"
            named = named_values(space, waypoint.get("values"), f"waypoint {number}", before, path)
            points.append(before + space.difference(named, before) if points else named)
        self._points = np.array(points)
        self._slopes = np.zeros_like(self._points)
        if len(points) > 2:
            from scipy.interpolate import PchipInterpolator  # imported here because it loads slowly

            self._slopes[1:-1] = PchipInterpolator(self._times, self._points)(self._times[1:-1], 1)
        self.duration_s: float | None = self._times[-1]
        self.arguments = {"waypoints": [dict(waypoint) for waypoint in waypoints], "base": base.copy()}

    def value(self, t_s: float) -> tuple[Array, Array]:
        next_index = bisect.bisect_right(self._times, t_s)
        if next_index in (0, len(self._times)):
            point = self._points[min(next_index, len(self._times) - 1)]
            return point.copy(), np.zeros_like(point)
        span = self._times[next_index] - self._times[next_index - 1]
        s = (t_s - self._times[next_index - 1]) / span
        start, step = self._points[next_index - 1], self._points[next_index] - self._points[next_index - 1]
        m0, m1 = self._slopes[next_index - 1] * span, self._slopes[next_index] * span
        c = start + s * (m0 + s * (3 * step - 2 * m0 - m1 + s * (m0 + m1 - 2 * step)))
        c_dot = (m0 + s * (6 * step - 4 * m0 - 2 * m1 + 3 * s * (m0 + m1 - 2 * step))) / span
        return c, c_dot


@dataclass(frozen=True, eq=False)
class Ramp:
    """A smooth transition from a state of motion onto another, possibly moving reference; see `ramp_onto`.

    c(t) = onto(t) + the initial offset, which a quintic reduces to zero with its first and second derivatives. From
    rest to a reference at rest, this is the minimum-jerk move. The ramp takes place during [start_s, start_s + over_s],
    in the time of `onto`; offset and offset_rate, (4n,), are c and c_dot at start_s minus those of `onto`.
    """

    onto: Reference
    start_s: float
    over_s: float
    offset: Array
    offset_rate: Array

    @property
    def duration_s(self) -> float | None:
        onto = self.onto.duration_s
        return None if onto is None else max(onto, self.start_s + self.over_s)

    def value(self, t_s: float) -> tuple[Array, Array]:
        c, c_dot = self.onto.value(t_s)
        s = max((t_s - self.start_s) / self.over_s, 0.0)
        if s >= 1.0:
            return c, c_dot
        value, rate = np.empty(c.size), np.empty(c.size)
        put_ramped(c, c_dot, self.offset, self.offset_rate, s, self.over_s, value, rate)
        return value, rate


@portable
def put_ramped(
    c: Array, c_dot: Array, offset: Array, offset_rate: Array, s: float, over_s: float, value: Array, rate: Array
) -> None:
    """Write c and c_dot plus the remaining offset and its rate at fraction s of a ramp of duration over_s."""
    offset_weight = 1.0 - s * s * s * (10.0 - s * (15.0 - 6.0 * s))
    offset_weight_rate = -30.0 * s * s * (1.0 - s) * (1.0 - s) / over_s
    rate_weight = s * (1.0 - s * s * (6.0 - s * (8.0 - 3.0 * s))) * over_s
    rate_weight_rate = 1.0 - s * s * (18.0 - s * (32.0 - 15.0 * s))
    for k in range(c.size):
        value[k] = c[k] + offset_weight * offset[k] + rate_weight * offset_rate[k]
        rate[k] = c_dot[k] + offset_weight_rate * offset[k] + rate_weight_rate * offset_rate[k]


def ramp_onto(space: ClusterSpace, c: Array, c_dot: Array, onto: Reference, start_s: float, over_s: float) -> Ramp:
    """Return the ramp from c and c_dot at start_s onto a reference in over_s; angles go the shorter way round."""
    c_onto, c_dot_onto = onto.value(start_s)
    return Ramp(onto, start_s, over_s, space.difference(c, c_onto), c_dot - c_dot_onto)


_KINDS: dict[str, Any] = {
    "hold": Hold,
    "shifted": Shifted,
    "ramp": Ramp,
    "expressions": ExpressionTrajectory,
    "waypoints": WaypointTrajectory,
}


def state_of(reference: Reference) -> State:
    """Return a reference as plain values; TypeError: its class is not defined in this module."""
    for kind, known_class in _KINDS.items():
        if type(reference) is known_class:
            arguments = getattr(reference, "arguments", None) or vars(reference)
            fields = {name: state_of(value) if name in ("of", "onto") else value for name, value in arguments.items()}
            return {"kind": kind, **fields}
    raise TypeError(f"reference: {type(reference).__name__} has no state; must be one of this module")


def reference_of(space: ClusterSpace, state: State) -> Reference:
    """Return the reference of a state; KeyError, TypeError, ValueError: the state is not from `state_of`."""
    fields = ((name, value) for name, value in state.items() if name != "kind")
    arguments = {name: reference_of(space, value) if name in ("of", "onto") else value for name, value in fields}
    kind = _KINDS[state["kind"]]
    make: Any = kind
    return make(space, **arguments) if kind in (ExpressionTrajectory, WaypointTrajectory) else make(**arguments)


class Variable(NamedTuple):
    entry: int  # index in c (4n,)
    scale: float  # factor from the user's unit to m or rad


def variable_of(space: Variables, name: object, where: str, at: str = "") -> Variable:
    """Return the variable that a name denotes; that of an angle may end in `_deg`. TrajectoryError: it is unknown."""
    text = str(name)
    angle = text.removesuffix(DEGREES)
    if text not in space.names and angle in space.names and space.in_radians[space.index(angle)]:
        return Variable(space.index(angle), math.radians(1.0))
    try:
        return Variable(space.index(text), 1.0)
    except ValueError as error:
        raise TrajectoryError(str(error), f"{where}:", at) from None


def named_values(space: Variables, values: object, where: str, base: Array, at: str = "") -> Array:
    """Return base (4n,) with values replaced by name: numbers, or expressions without t.

    Raises:
        TrajectoryError: not a mapping, an unknown or repeated name, not a finite number, an angle beyond one turn.
        ExpressionError: a text is not an expression.
    """
    if not isinstance(values, Mapping):
        raise TrajectoryError(f"found {str(values)[:40]!r}; allowed: numbers by name of variable", f"{where}:", at)
    c, given = base.copy(), set[int]()
    for name, value in values.items():
        variable = variable_of(space, name, where, at)
        location = f"{where}: {name}", f"{at}.{name}"
        _refuse_twice(space, variable, given, location)
        number = finite_number(value)
        if isinstance(value, str):
            expression = Expression(str(name), value)
            number = expression(0.0)[0] if expression.constant else None
        if number is None:
            raise TrajectoryError(
                f"is {str(value)[:40]}; allowed: a finite number, or an expression without t", *location
            )
        _refuse_turns(space, variable, number, location)
        c[variable.entry] = number * variable.scale
    return c


def _refuse_twice(space: Variables, variable: Variable, given: set[int], location: tuple[str, str]) -> None:
    """Raise TrajectoryError for a variable given twice, in two units; otherwise record it."""
    if variable.entry in given:
        name = space.names[variable.entry]
        raise TrajectoryError(f"is the same variable in a second unit; allowed: {name} or {name}{DEGREES}", *location)
    given.add(variable.entry)


def _refuse_turns(space: Variables, variable: Variable, value: float, location: tuple[str, str]) -> None:
    """Raise TrajectoryError for an angle beyond one turn, which was probably meant in degrees."""
    if not space.in_radians[variable.entry] or abs(value * variable.scale) <= ANGLE_MAX_RAD:
        return
    if variable.scale != 1.0:
        raise TrajectoryError(f"is {value:g} deg; allowed: -360 to 360 deg", *location)
    remedy = f"allowed: -6.283 to 6.283 rad, or degrees as {space.names[variable.entry]}{DEGREES}"
    raise TrajectoryError(f"is {value:g} rad; {remedy}", *location)
