"""What a user or a scenario may ask of a formation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from zsim_agents.formation.expression import ExpressionError, finite_number
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, SingularClusterError
from zsim_agents.formation.trajectory import (
    ExpressionTrajectory,
    Reference,
    TrajectoryError,
    WaypointTrajectory,
    named_values,
)


class RefusalError(ValueError):
    """A request cannot be granted as things stand; the message is the reason."""


class RequestError(ValueError):
    """A request cannot be understood; the message names the field, finding and remedy."""


@dataclass(frozen=True)
class TakeOff:
    """Take all drones off and climb straight up to the assembly height."""


@dataclass(frozen=True)
class Engage:
    """Close the formation loop at the present estimate, or resume after a hold."""


@dataclass(frozen=True)
class Pause:
    """Stand still in formation until engaged again; `hold` on the wire."""


@dataclass(frozen=True)
class Land:
    """Land all drones where they are."""


@dataclass(frozen=True)
class Target:
    """Move the formation to values by name, in over_s or as fast as the limits let it."""

    values: Mapping[str, float] = field(default_factory=dict)
    over_s: float | None = None

    def goal(self, space: ClusterSpace, base: Array) -> Array:
        """Return the goal (4n,): base with the values put in; raises TrajectoryError."""
        if not self.values:
            raise TrajectoryError(f"target: no values; allowed: numbers by name of {', '.join(space.names)}")
        return named_values(space, self.values, "target", base)


@dataclass(frozen=True)
class Follow:
    """Bring the formation to the start of a trajectory, then follow it; `trajectory` on the wire.

    Attributes:
        expressions, constants, duration_s: see `ExpressionTrajectory`; or
        waypoints: see `WaypointTrajectory`.
        start_s: simulated time of the trajectory's t = 0; None: when the formation has got there. A
            formation that gets there later joins the trajectory in motion.
    """

    expressions: Mapping[str, str | float] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    duration_s: float | None = None
    waypoints: Sequence[Mapping[str, object]] = ()
    start_s: float | None = None

    def trajectory(self, space: ClusterSpace, base: Array) -> Reference:
        """Return the trajectory; raises ExpressionError or TrajectoryError."""
        if self.start_s is not None and finite_number(self.start_s) is None:
            raise TrajectoryError(f"trajectory: start_s is {self.start_s}; allowed: a finite number")
        if bool(self.expressions) == bool(self.waypoints):
            found = "both" if self.expressions else "neither"
            raise TrajectoryError(f"trajectory: found {found}; allowed: expressions or waypoints")
        if self.waypoints:
            return WaypointTrajectory(space, self.waypoints, base)
        return ExpressionTrajectory(space, self.expressions, base, self.constants, self.duration_s)


FlightRequest = TakeOff | Engage | Pause | Land | Target | Follow


def refuse(fault: str | None) -> None:
    """Raise a RefusalError if there is a fault."""
    if fault:
        raise RefusalError(fault)


def read_request(op: object, args: object = None) -> FlightRequest:
    """Return the request of an operation on the wire, e.g. ("target", {"values": {"z_c": 12.0}}).

    Raises:
        RequestError: unknown operation or field, or a field of a wrong type.
    """
    if not isinstance(op, str) or op not in _READERS:
        raise RequestError(f"op {str(op)[:40]!r} is unknown; allowed: {', '.join(_READERS)}")
    build, fields = _READERS[op]
    given = {} if args is None else args
    if not isinstance(given, Mapping):
        raise RequestError(f"{op}: args is {type(args).__name__}; allowed: a map of {', '.join(fields) or 'nothing'}")
    for name, value in given.items():
        if name not in fields:
            allowed = ", ".join(fields) or "none"
            raise RequestError(f"{op}: field {str(name)[:40]!r} is unknown; allowed: {allowed}")
        kind, fits = fields[name]
        if not fits(value):
            raise RequestError(f"{op}: {name} is {str(value)[:40]!r}; allowed: {kind}")
    return build(**{name: value for name, value in given.items() if value is not None})


def _seconds(value: object) -> bool:
    return value is None or finite_number(value) is not None


def _map(value: object) -> bool:
    return isinstance(value, Mapping)


def _list(value: object) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


REFUSALS = (RefusalError, TrajectoryError, ExpressionError, SingularClusterError)

_Fields = dict[str, tuple[str, Callable[[object], bool]]]
_TARGET: _Fields = {
    "values": ("a map of numbers by variable", _map),
    "over_s": ("a number of seconds", _seconds),
}
_TRAJECTORY: _Fields = {
    "expressions": ("a map of expressions by variable", _map),
    "constants": ("a map of numbers by name", _map),
    "duration_s": ("a number of seconds", _seconds),
    "waypoints": ("a list of waypoints", _list),
    "start_s": ("a number of seconds", _seconds),
}
_READERS: dict[str, tuple[Callable[..., Any], _Fields]] = {
    "takeoff": (TakeOff, {}),
    "engage": (Engage, {}),
    "hold": (Pause, {}),
    "land": (Land, {}),
    "target": (Target, _TARGET),
    "trajectory": (Follow, _TRAJECTORY),
}
