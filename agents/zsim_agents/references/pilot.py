"""The pilot of one drone with its own reference: it takes off, tracks the reference by velocity commands, and lands.

Until the first request on `drone/{d}/control`, it flies as the scenario states. Requests:

takeoff, land
hold: come to rest and hover
goto {position_m, yaw_deg, speed_m_s}: fly to a position at a cruise speed (default: the limits) and stop there
goto {places_m, yaw_deg, speed_m_s, radius_m}: fly through positions, passing each within radius_m; 0: stop at each
goto {position_m, yaw_deg, over_s}: fly to a position on a minimum-snap path in over_s, or more if the limits require it
follow {minimum_snap: [...], fit: true, ...}: fly to the start of a path, then along it; fields: FOLLOW_FIELDS
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct, convert

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import Estimate, Mode, ReferencePhase, Status, Velocity
from zsim.contract.run_messages import ClusterRequest, ControlAnswer, ControlRequest
from zsim.contract.snapshot import State
from zsim.runtime.agent import Agent, Output
from zsim.scenario.scenario import PATHS, POINTS_MAX, Drone, DroneReference, Position, Scenario
from zsim.schema.checker import faults, show
from zsim.schema.quantities import NonNegative, Positive, Real
from zsim_agents.formation.flight_check import AGE_MAX_S, AIRBORNE, RESEND_S
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.formation.trajectory import TrajectoryError
from zsim_agents.references.cruise import UNLIMITED, Cruise, cruise_through, cruise_to_rest, velocity_towards
from zsim_agents.references.flight import (
    HEIGHT_MIN_M,
    SHARE,
    Flight,
    FlightError,
    Leg,
    approach_to,
    checked_flight,
    fitted_path,
    land_s_of,
    limits_of,
)
from zsim_agents.references.path import EndMotion, PathLimits, move

REQUESTS_MAX = 1000  # maximum number of requests between two gates, as for a controller
WITHOUT_ARGUMENTS = ("takeoff", "land", "hold")
OPERATIONS = (*WITHOUT_ARGUMENTS, "goto", "follow")
EXPRESSION_FIELDS = ("constants", "duration_s")
# the other fields of a reference are allowed in scenarios only
FOLLOW_FIELDS = (*PATHS, *EXPRESSION_FIELDS, "origin_m", "time_scale", "fit")


class ReferencePilot(Agent):
    """Flies one drone along its reference.

    Raises:
        RunError: the drone has no reference, or its flight is impossible.
    """

    def __init__(self, info: messages.Info, scenario: Scenario, drone: str) -> None:
        super().__init__()
        self.name = f"reference.{drone}"
        self.period_ns = info.gate_ns
        self._drone, self._scenario = drone, scenario
        self._spec = scenario.drone(drone)
        self._settings = scenario.piloted()[drone]
        self._limits = limits_of(self._spec, scenario.environment.gravity_m_s2)
        self._status_key, self._estimate_key = keys.status(drone), keys.estimate(drone)
        self.reads = self.gate_keys = (self._status_key, self._estimate_key)
        self._reference_key, self._request_key = keys.reference(drone), keys.drone_request(drone)
        self.writes, self.repeats = (self._reference_key,), (self._request_key,)
        self._flight = checked_flight(scenario, drone)
        # the last granted request
        self._last_request: tuple[float, str, dict[str, Any], list[float], list[float]] | None = None
        self._takeoff_s, self._land_s = self._settings.takeoff_s, land_s_of(self._settings)
        self._has_flown = self._is_over = False
        self._mode_ns = -round(RESEND_S * 1e9)
        self._state, self._estimate = "landed", None
        self._t_ns = 0
        self._answered: list[tuple[ControlRequest, ControlAnswer]] = []  # since the last gate

    def receive(self, key: str, message: Any) -> None:
        if type(message) is Status:
            self._state = message.state
        elif type(message) is Estimate and (self._estimate is None or message.t_ns >= self._estimate.t_ns):
            self._estimate = message

    def step(self, t_ns: int) -> list[Output]:
        self._t_ns, t_s = t_ns, t_ns * 1e-9
        outputs = self._requests_of_gate(t_ns)
        if self._state in AIRBORNE:
            self._has_flown = self._has_flown or not self._is_over
        elif self._has_flown and self._state in ("landed", "emergency"):
            self._is_over = True  # regardless of who landed the drone: it takes off again only on request
        if not self._is_over:
            outputs += self._commands(t_ns, t_s)
        position, rate = self._flight.value(t_s)
        phase, path_t_s = self._phase(t_s)
        outputs.append(
            Output(
                self._reference_key,
                flight_messages.Reference(
                    t_ns,
                    self.next_seq(self._reference_key),
                    phase,
                    _vector(position),
                    _vector(rate),
                    float(position[3]),
                    float(rate[3]),
                    path_t_s,
                    self.source,
                ),
            )
        )
        return outputs

    def _phase(self, t_s: float) -> tuple[ReferencePhase, float | None]:
        if self._is_over or t_s >= self._land_s:
            return "over", None
        return self._flight.phase(t_s) if self._state in AIRBORNE else ("waiting", None)

    def _commands(self, t_ns: int, t_s: float) -> list[Output]:
        if self._state == "landed":
            return self._mode(t_ns, "takeoff") if self._takeoff_s <= t_s < self._land_s else []
        if self._state not in AIRBORNE:
            return []
        if t_s >= self._land_s:
            return self._mode(t_ns, "land")
        estimate = self._estimate
        if estimate is None or t_ns - estimate.t_ns > AGE_MAX_S * 1e9:
            return []  # without commands, the firmware soon holds the position by itself
        velocity, yaw_rate = self._velocity(t_s, estimate, (t_ns - estimate.t_ns) * 1e-9)
        return [self.command(t_ns, self._drone, Velocity(0, 0, "", velocity, yaw_rate, "world"))]

    def _velocity(self, t_s: float, estimate: Estimate, age_s: float) -> tuple[tuple[float, float, float], float]:
        """Return the velocity [m/s; W] and yaw rate [rad/s] that track the reference within the drone's limits."""
        position, _ = self._flight.value(t_s)
        _, future_rate = self._flight.value(t_s + self._settings.lead_s)
        x, y, z = (
            coordinate + speed * age_s
            for coordinate, speed in zip(estimate.position_m, estimate.velocity_m_s, strict=True)
        )
        current = x, y, z, estimate.yaw_rad
        return velocity_towards(position.tolist(), future_rate.tolist(), current, self._limits, self._settings)

    def _mode(self, t_ns: int, mode: Any) -> list[Output]:
        """Return a mode command, or nothing if the last one was sent less than RESEND_S ago."""
        if t_ns - self._mode_ns < RESEND_S * 1e9:
            return []
        self._mode_ns = t_ns
        return [self.command(t_ns, self._drone, Mode(0, 0, "", mode))]

    # Requests

    def control_keys(self) -> tuple[str, ...]:
        return (keys.drone_control(self._drone),)

    def control(self, key: str, request: ControlRequest) -> ControlAnswer:
        """Handle a request, which takes effect at the next gate."""
        if len(self._answered) >= REQUESTS_MAX:
            error = f"{key}: {REQUESTS_MAX} requests are already waiting for the next gate; repeat the request after it"
            return ControlAnswer(ok=False, error=error)
        try:
            result, error = self._handle(request), ""
        except (DroneRequestError, FlightError) as fault:
            result, error = None, f"{request.op[:40]}: {fault}"
        answer = ControlAnswer(ok=not error, error=error, result=result)
        self._answered.append((request, answer))
        return answer

    def repeat(self, key: str, message: ClusterRequest) -> None:
        self.control(key, ControlRequest(message.op, message.args, message.source))

    def _handle(self, request: ControlRequest) -> dict[str, Any] | None:
        parsed = read_request(request.op, request.args)
        t_s = self._t_ns * 1e-9
        if parsed == "land":
            if self._state not in AIRBORNE:
                raise DroneRequestError(f"{self._drone} is {self._state}; must be in the air")
            self._land_s, self._mode_ns = t_s, self._t_ns - round(RESEND_S * 1e9)
            return None
        if parsed == "takeoff":
            if self._state != "landed" or self._estimate is None:
                raise DroneRequestError(f"{self._drone} is {self._state}; must be landed and have an estimate")
            x, y, z = self._estimate.position_m
            hover = [x, y, z + self._spec.takeoff_height_m, self._estimate.yaw_rad]
            self._last_request, self._flight = (t_s, "takeoff", {}, hover, [0.0] * 4), Flight(np.array(hover))
            self._takeoff_s, self._land_s, self._has_flown, self._is_over = t_s, math.inf, False, False
            self._mode_ns = self._t_ns - round(RESEND_S * 1e9)
            return None
        if self._state not in AIRBORNE or self._is_over or t_s >= self._land_s:
            state = "about to land, or past its landing time" if self._state in AIRBORNE else self._state
            raise DroneRequestError(f"{self._drone} is {state}; must be flying its reference: request takeoff first")
        position, rate = self._flight.value(t_s)
        flight = requested_flight(parsed, t_s, position, rate, self._spec, self._limits)
        self._flight, self._last_request = flight, (t_s, request.op, request.args, position.tolist(), rate.tolist())
        return {"from_s": t_s, "until_s": flight.duration_s}

    def _requests_of_gate(self, t_ns: int) -> list[Output]:
        """Return the requests answered since the last gate as outputs, so that they are recorded."""
        answered, self._answered = self._answered, []
        return [
            Output(
                self._request_key,
                ClusterRequest(
                    t_ns, self.next_seq(self._request_key), r.op, r.args, r.source, a.ok, a.error, self.source
                ),
            )
            for r, a in answered
        ]

    # Restarts

    def snapshot(self) -> State | None:
        return {
            "asked": list(self._last_request) if self._last_request else None,
            "times": [self._takeoff_s, None if math.isinf(self._land_s) else self._land_s],
            "flags": [self._has_flown, self._is_over],
            "mode_ns": self._mode_ns,
            "t_ns": self._t_ns,
            "state": self._state,
            "estimate": None if self._estimate is None else messages.encode(self._estimate),
        }

    def restore(self, state: State) -> None:
        if state["asked"] is not None:
            t_s, op, args, position, rate = state["asked"]
            self._last_request = t_s, op, args, position, rate
            start, start_rate = np.array(position), np.array(rate)
            parsed = read_request(op, args)
            is_takeoff = op == "takeoff"
            self._flight = (
                Flight(start)
                if is_takeoff
                else requested_flight(parsed, t_s, start, start_rate, self._spec, self._limits)
            )
        self._takeoff_s, land_s = state["times"]
        self._land_s = math.inf if land_s is None else land_s
        self._has_flown, self._is_over = state["flags"]
        self._mode_ns, self._t_ns, self._state = state["mode_ns"], state["t_ns"], state["state"]
        payload = state["estimate"]
        self._estimate = None if payload is None else messages.decode(self._estimate_key, payload)

    def warm_start_keys(self) -> tuple[str, ...]:
        return (self._reference_key,)

    def warm_start(self, key: str, message: flight_messages.Reference) -> None:
        self._is_over = self._has_flown = message.phase == "over"


def _vector(position: Array) -> tuple[float, float, float]:
    x, y, z = position[:3].tolist()
    return x, y, z


class DroneRequestError(ValueError):
    """A request is invalid or cannot be carried out now; the text states the field, the finding and the remedy."""


class Goto(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A position [m; W] to fly to, or several in sequence."""

    position_m: Position | None = None
    places_m: Annotated[list[Position], Meta(max_length=POINTS_MAX)] = []
    yaw_deg: Real | None = None
    speed_m_s: Positive | None = None
    radius_m: NonNegative = 0.0
    over_s: NonNegative = 0.0

    def positions(self) -> list[Position]:
        return self.places_m if self.position_m is None else [self.position_m]


DroneRequest = Literal["takeoff", "land", "hold"] | Goto | DroneReference


def read_request(op: str, args: Mapping[str, Any]) -> DroneRequest:
    """Return a request from its operation and arguments.

    Raises:
        DroneRequestError: `op` is not in OPERATIONS, or its arguments are not allowed.
    """
    if op not in OPERATIONS:
        raise DroneRequestError(f"is unknown; allowed: {', '.join(OPERATIONS)}")
    if op in WITHOUT_ARGUMENTS:
        if args:
            raise DroneRequestError(f"{next(iter(args))!s:.40} is given, but the request takes no arguments")
        return op  # type: ignore[return-value]
    kind = Goto if op == "goto" else DroneReference
    invalid = [f"{path} {text}" for path, text in faults(dict(args), kind)]
    if invalid:
        raise DroneRequestError("; ".join(invalid[:3]))
    parsed = convert(dict(args), kind)
    if isinstance(parsed, DroneReference) and len(parsed.paths()) != 1:
        given = " and ".join(parsed.paths()) or "none"
        raise DroneRequestError(f"has {given} of {', '.join(PATHS)}; must have one")
    if isinstance(parsed, DroneReference) and (unused := list(_unused(parsed, args))):
        raise DroneRequestError(f"{'; '.join(unused[:3])}; allowed: {', '.join(FOLLOW_FIELDS)}")
    if isinstance(parsed, Goto):
        if (parsed.position_m is None) != bool(parsed.places_m):
            found = "is given together with" if parsed.places_m else "is missing, and so is"
            raise DroneRequestError(f"position_m {found} places_m; must have one of them")
        if parsed.over_s and (parsed.places_m or parsed.speed_m_s):
            other = "places_m" if parsed.places_m else "speed_m_s"
            raise DroneRequestError(f"over_s ({parsed.over_s:g}) and {other} are both given; leave one of them out")
    return parsed


def _unused(reference: DroneReference, args: Mapping[str, Any]) -> Iterator[str]:
    """Yield the faults of the fields that are not allowed in a request."""
    for name, value in args.items():
        if name not in FOLLOW_FIELDS:
            yield f"{name} is {show(value)}; must be left out of a request"
        elif name in EXPRESSION_FIELDS and not reference.expressions:
            yield f"{name} is {show(value)}; must be left out without expressions"


def requested_flight(
    request: Any, t_s: float, position: Array, rate: Array, drone: Drone, limits: PathLimits
) -> Flight:
    """Return the flight requested at `t_s`; it begins with the current position and rate, both (4,).

    Raises:
        FlightError: the flight is impossible.
    """
    begin = EndMotion(rate, np.zeros(4), np.zeros(4)) if rate.any() else None
    if isinstance(request, DroneReference):
        path = fitted_path(request, limits, float(position[3]), drone.limits.altitude_m)
        approach = approach_to(position, path, limits, begin)
        path_s = t_s + (approach.duration_s or 0.0)
        return Flight(position, (Leg(t_s, approach, "approaching"), Leg(path_s, path, "path")))
    usable = limits.share(SHARE)
    if not isinstance(request, Goto):
        return Flight(position, (Leg(t_s, cruise_to_rest(position, usable, rate), "approaching"),))
    yaw = float(position[3]) if request.yaw_deg is None else math.radians(request.yaw_deg)
    low, high = HEIGHT_MIN_M, drone.limits.altitude_m
    for k, (_, _, z) in enumerate(request.positions()):
        if not low <= z <= high:
            field = f"places_m[{k}][2]" if request.places_m else "position_m[2]"
            raise FlightError(field, f"is {z:g}; must be >= {low:g} and <= {high:g}")
    goals = [np.array([*each, yaw]) for each in request.positions()]
    if request.over_s:
        try:
            approach = move(position, goals[0], usable, request.over_s, begin)
        except TrajectoryError as error:
            raise FlightError("", str(error)) from None
    else:
        speeds = UNLIMITED if request.speed_m_s is None else Cruise(*(request.speed_m_s,) * 3)
        approach = cruise_through(position, goals, usable, rate, speeds, request.radius_m)
    return Flight(position, (Leg(t_s, approach, "approaching"),))
