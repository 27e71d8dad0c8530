"""Requests to a formation from a user or a scenario, and the plan of a scenario: requests with their due times."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from msgspec import UNSET

from zsim.contract.snapshot import State
from zsim.scenario.scenario import Cluster
from zsim_agents.formation.expression import ExpressionError, finite_number
from zsim_agents.formation.spaces.cluster_space import Array, ClusterSpace, SingularClusterError
from zsim_agents.formation.trajectory import (
    ExpressionTrajectory,
    Reference,
    TrajectoryError,
    WaypointTrajectory,
    named_values,
)

RETRY_S = 0.5  # period of retrying a refused request
WAITING = " of the plan waits: "  # separates the step from the reason in the note of a plan


class RefusalError(ValueError):
    """A request cannot be granted in the present state; the message gives the reason."""


class PlanError(ValueError):
    """A plan is impossible; the message begins with the path of the wrong value, starting at `plan`."""


class RequestError(ValueError):
    """A request is malformed; the message names the field, finding and remedy."""


REFUSALS = (RefusalError, TrajectoryError, ExpressionError, SingularClusterError)


class Order(Enum):
    """A request without parameters, by its name on the wire."""

    TAKE_OFF = "takeoff"  # all drones take off and climb vertically to the assembly height
    ENGAGE = "engage"  # close the formation's control loop at the present estimate, or resume after a hold
    PAUSE = "hold"  # hover in formation until engaged again, or stop rejoining
    REJOIN = "rejoin"  # lead each drone of a formation held by a fault back to its position individually
    LAND = "land"  # all drones land where they are


@dataclass(frozen=True)
class MoveTo:
    """Request to move to named values, in over_s or as fast as the limits allow; `target` on the wire."""

    values: Mapping[str, str | float] = field(default_factory=dict)
    over_s: float | None = None

    def goal(self, space: ClusterSpace, base: Array) -> Array:
        """Return base (4n,) with named values replaced; TrajectoryError, ExpressionError: a value is not allowed."""
        if not self.values:
            raise TrajectoryError(f"target: no values; allowed: numbers by name of {', '.join(space.names)}")
        return named_values(space, self.values, "target", base)


@dataclass(frozen=True)
class Follow:
    """Request to move to the start of a trajectory, then follow it; `trajectory` on the wire.

    Attributes:
        expressions, constants, duration_s: see `ExpressionTrajectory`.
        waypoints: see `WaypointTrajectory`; excludes expressions.
        start_s: simulated time of the trajectory's t = 0; None for the formation's arrival at its start. A formation
            that arrives after `start_s` joins the moving trajectory.
    """

    expressions: Mapping[str, str | float] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    duration_s: float | None = None
    waypoints: Sequence[Mapping[str, object]] = ()
    start_s: float | None = None

    def trajectory(self, space: ClusterSpace, base: Array) -> Reference:
        """Return the trajectory; ExpressionError, TrajectoryError: it is not allowed."""
        if self.start_s is not None and finite_number(self.start_s) is None:
            raise TrajectoryError(f"trajectory: start_s is {self.start_s}; allowed: a finite number")
        if bool(self.expressions) == bool(self.waypoints):
            count = "both" if self.expressions else "neither"
            raise TrajectoryError(f"trajectory: found {count}; allowed: expressions or waypoints")
        if self.waypoints:
            return WaypointTrajectory(space, self.waypoints, base)
        return ExpressionTrajectory(space, self.expressions, base, self.constants, self.duration_s)


@dataclass(frozen=True)
class Assemble:
    """Request to move each drone to an assigned position in a formation; `assemble` on the wire.

    The formation is given by names and values, as in `MoveTo`. A separate request engages it.
    """

    values: Mapping[str, str | float] = field(default_factory=dict)


FlightRequest = Order | MoveTo | Follow | Assemble


@dataclass(frozen=True)
class Scheduled:
    """A request due at simulated time at_s and repeated until it is granted.

    `path` is its path in the cluster's section of the scenario.
    """

    at_s: float
    request: FlightRequest
    path: str = "plan"


class FlightPlan:
    """Requests in order; each waits for the previous ones, except Order.LAND, which drops those before it.

    A restarted controller continues at the `resume_at` of its predecessor.

    Attributes:
        note: which step of the plan waits, and why; empty if none does.

    Raises:
        PlanError: a request is invalid (unknown name, bad expression), or times decrease.
    """

    def __init__(self, space: ClusterSpace, steps: Sequence[Scheduled] = ()) -> None:
        base, earlier_s = np.zeros(space.size), 0.0
        for step in steps:
            if not earlier_s <= step.at_s < math.inf:
                raise PlanError(f"{step.path} is {step.at_s:g}; allowed: {earlier_s:g} s or later")
            earlier_s = step.at_s
            try:
                if isinstance(step.request, MoveTo):
                    step.request.goal(space, base)
                elif isinstance(step.request, Assemble):
                    named_values(space, step.request.values, "assemble", base, ".values")
                elif isinstance(step.request, Follow):
                    step.request.trajectory(space, base).value(0.0)
            except REFUSALS as error:
                text, path = str(error), f"{step.path}: "
                if isinstance(error, TrajectoryError):
                    text = error.finding
                    path = f"{step.path}{error.at}{' ' if text.startswith('is ') else ': '}"
                elif isinstance(error, ExpressionError) and error.name:
                    text = error.finding
                    part = ".values" if isinstance(step.request, Assemble) else ""
                    part = ".expressions" if step.path.endswith("trajectory") else part
                    path = f"{step.path}{part}.{error.name}: "
                raise PlanError(f"{path}{text}") from None
        self._steps = tuple(steps)
        self._next = 0  # index of the first uncompleted step
        self._active = 0  # index of the first step of the reference being flown, else _next
        self._retry_s = -math.inf
        self.note = ""

    def run(self, t_s: float, request: Callable[[FlightRequest], str | None]) -> None:
        """Submit the requests due at `t_s` to `request`, which returns the reason for a refusal."""
        for index in range(len(self._steps) - 1, self._next, -1):
            step = self._steps[index]
            if step.at_s <= t_s and step.request is Order.LAND:
                self._go_to(index)
                break
        while self._next < len(self._steps) and t_s >= max(self._steps[self._next].at_s, self._retry_s):
            due = self._steps[self._next].request
            if refusal := request(due):
                self._retry_s = t_s + RETRY_S
                op = due.value if isinstance(due, Order) else _OPERATION_OF[type(due)]
                self.note = f"{op}{WAITING}{refusal}"
                return
            active = self._next + 1 if isinstance(due, Order) else self._active
            self._go_to(self._next + 1, active)

    @property
    def assembles(self) -> bool:
        """Whether an assembly is still ahead, so that the drones may start anywhere."""
        return any(isinstance(step.request, Assemble) for step in self._steps[self._next :])

    def resume_at(self, flying: bool) -> int:
        """Return the number of steps that a restart skips: the completed ones, except those being flown."""
        return self._active if flying else self._next

    def start_at(self, step: int) -> None:
        """Skip the steps completed before a restart."""
        self._go_to(min(step, len(self._steps)))

    def snapshot(self) -> State:
        return {"next": self._next, "flown": self._active, "try_s": self._retry_s, "note": self.note}

    def restore(self, state: State) -> None:
        self._next, self._active = state["next"], state["flown"]
        self._retry_s, self.note = state["try_s"], state["note"]

    def overrule(self) -> None:
        """Record that the reference no longer follows the plan."""
        self._active = self._next

    def clear(self) -> None:
        """Drop all uncompleted steps."""
        self._go_to(len(self._steps))

    def _go_to(self, step: int, active: int | None = None) -> None:
        self._next, self._active = step, step if active is None else active
        self._retry_s, self.note = -math.inf, ""


def waiting_step(reason: str) -> tuple[str, str] | None:
    """Return the waiting step of the plan and why it waits, from a cluster state's reason; None if no step waits."""
    before, separator, why = reason.rpartition(WAITING)
    return (before.rpartition("; ")[2], why) if separator else None


def plan_of(cluster: Cluster) -> list[Scheduled]:
    """Return the steps of a cluster's plan in order."""
    plan, steps = cluster.plan, []
    if plan.takeoff_s is not None:
        steps += [Scheduled(plan.takeoff_s, each, "plan.takeoff_s") for each in (Order.TAKE_OFF, Order.ENGAGE)]
        from_s = plan.takeoff_s
        if plan.assemblies is not UNSET:
            steps.pop()
            for index, each in enumerate(plan.assemblies):
                from_s, path = max(each.at_s, plan.takeoff_s), f"plan.assemblies[{index}]"
                steps.append(Scheduled(from_s, Assemble(each.values), path))
                steps.append(Scheduled(from_s, Order.ENGAGE, path))
        if plan.target:
            steps.append(Scheduled(from_s, MoveTo(plan.target, plan.target_over_s), "plan.target"))
        if trajectory := plan.trajectory:
            waypoints = [{"at_s": w.at_s, "values": w.values} for w in trajectory.waypoints]
            follow = Follow(trajectory.expressions, trajectory.constants, None, waypoints, trajectory.start_s)
            steps.append(Scheduled(from_s, follow, "plan.trajectory"))
    if plan.land_s is not None:
        steps.append(Scheduled(plan.land_s, Order.LAND, "plan.land_s"))
    return steps


_FIELDS = {  # fields of the requests with parameters, by operation on the wire
    "target": {"values": "a map of numbers by variable", "over_s": "a number of seconds"},
    "trajectory": {
        "expressions": "a map of expressions by variable",
        "constants": "a map of numbers by name",
        "duration_s": "a number of seconds",
        "waypoints": "a list of waypoints",
        "start_s": "a number of seconds",
    },
    "assemble": {"values": "a map of numbers by variable"},
}
_KINDS: dict[str, Callable[..., MoveTo | Follow | Assemble]] = {
    "target": MoveTo, "trajectory": Follow, "assemble": Assemble,
}  # fmt: skip
_OPERATION_OF = {kind: op for op, kind in _KINDS.items()}
OPERATIONS = (*(order.value for order in Order), *_FIELDS)


def read_request(op: object, args: object = None) -> FlightRequest:
    """Return the request of an operation on the wire, e.g. ("target", {"values": {"z_c": 12.0}}).

    Raises:
        RequestError: an unknown operation or field, or a field of the wrong type.
    """
    if not isinstance(op, str) or op not in OPERATIONS:
        raise RequestError(f"op {str(op)[:40]!r} is unknown; allowed: {', '.join(OPERATIONS)}")
    fields, arguments = _FIELDS.get(op, {}), {} if args is None else args
    if not isinstance(arguments, Mapping):
        raise RequestError(f"{op}: args is {type(args).__name__}; allowed: a map of {', '.join(fields) or 'nothing'}")
    for name, value in arguments.items():
        if name not in fields:
            allowed = ", ".join(fields) or "none"
            raise RequestError(f"{op}: field {str(name)[:40]!r} is unknown; allowed: {allowed}")
        if fields[name].startswith("a map"):
            is_valid = isinstance(value, Mapping)
        elif fields[name].startswith("a list"):
            is_valid = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        else:
            is_valid = value is None or finite_number(value) is not None
        if not is_valid:
            raise RequestError(f"{op}: {name} is {str(value)[:40]!r}; allowed: {fields[name]}")
    given: dict[str, Any] = {name: value for name, value in arguments.items() if value is not None}
    return _KINDS[op](**given) if op in _KINDS else Order(op)
