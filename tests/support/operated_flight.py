"""A flight in one process with an operator's orders."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from zsim.contract import flight_messages, keys
from zsim.contract.run_messages import ControlAnswer, ControlRequest, Event
from zsim.runtime.bus import Bus
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import closest_pair
from zsim_agents.hosting import hosted
from zsim_world.run.world import World

OPERATOR, PRIORITY = "tester.one", 10
STEP_LIMIT_S = 90.0  # simulated time within which an awaited condition must hold


class OperatedFlight:
    """A flight of a scenario in one process, and an operator who makes requests between gates."""

    def __init__(self, scenario: Scenario) -> None:
        self.world = World(scenario)
        self.states: dict[str, str] = {}
        self.places_m: dict[str, tuple[float, float, float]] = {}
        self.collisions: list[Event] = []
        self.closest_m: list[float] = []
        self.formation: Any = None
        self._agents = hosted(self.world.info(), scenario, ["*"])
        self._bus = Bus(self.world, [self._agents], time.monotonic_ns, self._sink)
        self._bus.join()

    @property
    def t_s(self) -> float:
        return 0.0 if self.formation is None else self.formation.t_ns / 1e9

    def until(self, reached: Callable[[], bool]) -> None:
        """Fly on until a condition holds."""
        end_s = self.t_s + STEP_LIMIT_S
        while not reached():
            assert self._bus.turn()
            assert self.t_s < end_s, f"{self.formation.phase}: {self.formation.reason}"

    def mode(self, drone: str, mode: str) -> None:
        """Make a drone land or take off as the console does: acquire it with an operator's priority, and release it."""
        arguments = {"drone": drone}
        assert self.world.control(ControlRequest("acquire", {**arguments, "priority": PRIORITY}, OPERATOR)).ok
        message = flight_messages.Mode(self.formation.t_ns, 0, OPERATOR, mode)  # type: ignore[arg-type]
        self.world.handle(keys.command(drone, "mode"), message, time.monotonic_ns())
        state = {"land": "landed", "takeoff": "hovering"}[mode]
        self.until(lambda: self.states[drone] in (state, "flying" if mode == "takeoff" else state))
        assert self.world.control(ControlRequest("release", arguments, OPERATOR)).ok

    def request(self, op: str) -> ControlAnswer:
        return self._agents.control(keys.cluster_control("main"), ControlRequest(op, {}, OPERATOR))

    def fly(self, seconds: float) -> None:
        end_s = self.t_s + seconds
        self.until(lambda: self.t_s >= end_s)

    def _sink(self, key: str, message: Any) -> None:
        if isinstance(message, flight_messages.Status):
            self.states[keys.thing(key)] = message.state
        elif isinstance(message, flight_messages.Truth):
            self.places_m[keys.thing(key)] = message.position_m
        elif isinstance(message, Event) and message.kind == "collision":
            self.collisions.append(message)
        elif isinstance(message, flight_messages.ClusterState):
            self.formation = message
            if "landed" not in self.states.values():
                self.closest_m.append(closest_pair(np.array(list(self.places_m.values())))[0])
