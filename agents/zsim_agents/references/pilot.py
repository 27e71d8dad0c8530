"""The pilot of one drone that has a reference of its own: takes off, follows it by velocities, lands; takes requests.

What is flown is a function of simulated time and of the newest request.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import Estimate, Mode, ReferencePhase, Status, Velocity
from zsim.contract.run_messages import ClusterRequest, ControlAnswer, ControlRequest
from zsim.contract.snapshot import State
from zsim.runtime.agent import Agent, Output
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.flight_check import AGE_MAX_S, AIRBORNE, RESEND_S
from zsim_agents.formation.spaces.cluster_space import Array
from zsim_agents.references.flight import (
    Flight,
    FlightError,
    checked_flight,
    land_s_of,
    limits_of,
)
from zsim_agents.references.requests import DroneRequestError, read_request, requested_flight
from zsim_agents.references.tracking import velocity_towards

REQUESTS_MAX = 1000  # between two gates, as of a controller


class ReferencePilot(Agent):
    """Flies one drone along its reference.

    Raises:
        RunError: the drone has no reference, or it can never be flown.
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
        self._asked: tuple[float, str, dict[str, Any], list[float], list[float]] | None = None  # what is flown instead
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
            self._is_over = True  # also where somebody else has landed it: it stays there until it is asked
        if not self._is_over:
            outputs += self._commands(t_ns, t_s)
        place, rate = self._flight.value(t_s)
        phase, path_t_s = self._phase(t_s)
        outputs.append(
            Output(
                self._reference_key,
                flight_messages.Reference(
                    t_ns,
                    self.next_seq(self._reference_key),
                    phase,
                    _vector(place),
                    _vector(rate),
                    float(place[3]),
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
            return []  # the firmware holds its own place after a while
        velocity, yaw_rate = self._velocity(t_s, estimate, (t_ns - estimate.t_ns) * 1e-9)
        return [self.command(t_ns, self._drone, Velocity(0, 0, "", velocity, yaw_rate, "world"))]

    def _velocity(self, t_s: float, estimate: Estimate, age_s: float) -> tuple[tuple[float, float, float], float]:
        """Return the velocity [m/s, W] and yaw rate [rad/s] that lead to the reference, within the drone's limits."""
        place, _ = self._flight.value(t_s)
        _, ahead = self._flight.value(t_s + self._settings.lead_s)
        x, y, z = (at + moving * age_s for at, moving in zip(estimate.position_m, estimate.velocity_m_s, strict=True))
        here = x, y, z, estimate.yaw_rad
        return velocity_towards(place.tolist(), ahead.tolist(), here, self._limits, self._settings)

    def _mode(self, t_ns: int, mode: Any) -> list[Output]:
        """Return a mode command, repeated only after a while without effect."""
        if t_ns - self._mode_ns < RESEND_S * 1e9:
            return []
        self._mode_ns = t_ns
        return [self.command(t_ns, self._drone, Mode(0, 0, "", mode))]

    # Requests

    def control_keys(self) -> tuple[str, ...]:
        return (keys.drone_control(self._drone),)

    def control(self, key: str, request: ControlRequest) -> ControlAnswer:
        """Take a request, see `requests`; it acts from the next gate on."""
        if len(self._answered) >= REQUESTS_MAX:
            return ControlAnswer(ok=False, error=f"{key}: {REQUESTS_MAX} requests wait for the next gate; ask after it")
        try:
            result, error = self._take(request), ""
        except (DroneRequestError, FlightError) as fault:
            result, error = None, f"{request.op[:40]}: {fault}"
        answer = ControlAnswer(ok=not error, error=error, result=result)
        self._answered.append((request, answer))
        return answer

    def repeat(self, key: str, message: ClusterRequest) -> None:
        self.control(key, ControlRequest(message.op, message.args, message.source))

    def _take(self, request: ControlRequest) -> dict[str, Any] | None:
        asked = read_request(request.op, request.args)
        t_s = self._t_ns * 1e-9
        if asked == "land":
            if self._state not in AIRBORNE:
                raise DroneRequestError(f"{self._drone} is {self._state}; must be in the air")
            self._land_s, self._mode_ns = t_s, self._t_ns - round(RESEND_S * 1e9)
            return None
        if asked == "takeoff":
            if self._state != "landed" or self._estimate is None:
                raise DroneRequestError(f"{self._drone} is {self._state}; must be landed, and estimated")
            x, y, z = self._estimate.position_m
            hover = [x, y, z + self._spec.takeoff_height_m, self._estimate.yaw_rad]
            self._asked, self._flight = (t_s, "takeoff", {}, hover, [0.0] * 4), Flight(np.array(hover))
            self._takeoff_s, self._land_s, self._has_flown, self._is_over = t_s, math.inf, False, False
            self._mode_ns = self._t_ns - round(RESEND_S * 1e9)
            return None
        if self._state not in AIRBORNE or self._is_over or t_s >= self._land_s:
            state = "landed, or about to" if self._state in AIRBORNE else self._state
            raise DroneRequestError(f"{self._drone} is {state}; must fly its reference: ask for takeoff first")
        place, rate = self._flight.value(t_s)
        flight = requested_flight(asked, t_s, place, rate, self._spec, self._limits)
        self._flight, self._asked = flight, (t_s, request.op, request.args, place.tolist(), rate.tolist())
        return {"from_s": t_s, "until_s": flight.duration_s}

    def _requests_of_gate(self, t_ns: int) -> list[Output]:
        """Return on record what was asked since the last gate."""
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
            "asked": list(self._asked) if self._asked else None,
            "times": [self._takeoff_s, None if math.isinf(self._land_s) else self._land_s],
            "flags": [self._has_flown, self._is_over],
            "mode_ns": self._mode_ns,
            "t_ns": self._t_ns,
            "state": self._state,
            "estimate": None if self._estimate is None else messages.encode(self._estimate),
        }

    def restore(self, state: State) -> None:
        if state["asked"] is not None:
            t_s, op, args, place, rate = state["asked"]
            self._asked = t_s, op, args, place, rate
            at, moving = np.array(place), np.array(rate)
            asked = read_request(op, args)
            own = op == "takeoff"
            self._flight = Flight(at) if own else requested_flight(asked, t_s, at, moving, self._spec, self._limits)
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


def _vector(place: Array) -> tuple[float, float, float]:
    x, y, z = place[:3].tolist()
    return x, y, z
