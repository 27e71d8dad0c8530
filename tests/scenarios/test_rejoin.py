"""A drone that was landed in formation flight and took off again, far below the others, comes back on request."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zsim.contract import flight_messages, keys
from zsim.contract.run_messages import ControlAnswer, ControlRequest, Event
from zsim.runtime.bus import Bus
from zsim.scenario import scenario_file
from zsim_agents.formation.flight_data import HELD_ON_REQUEST
from zsim_agents.formation.spaces.cluster_space import closest_pair
from zsim_analysis.in_process import agents
from zsim_world.flight.world import World

STEP = Path(__file__).parents[2] / "scenarios" / "step.yaml"
SHORT = ("clusters.main.plan.takeoff_s=1", "clusters.main.plan.target.z_c=8")
OPERATOR, PRIORITY = "tester.one", 10
STEP_LIMIT_S = 90.0  # simulated; of one part of the flight
SEPARATION_M = 1.5  # of the centres; below it the controller raises its alarm


class OperatedFlight:
    """The shipped scenario in one process, and an operator who makes requests between gates."""

    def __init__(self) -> None:
        self.world = World(scenario_file.load(STEP, SHORT, duration_s=10 * STEP_LIMIT_S))
        self.states: dict[str, str] = {}
        self.places_m: dict[str, tuple[float, float, float]] = {}
        self.collisions: list[Event] = []
        self.closest_m: list[float] = []
        self.formation: Any = None
        (self._agents,) = agents(self.world)
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
        """Let a drone land or take off, as the console does: with an operator's priority, and given back."""
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


@pytest.mark.slow
def test_a_drone_that_was_landed_rejoins_its_formation() -> None:
    """Test 1 of the paper at a height of 8 m; the operator lands drone2 and lets it take off.

        formation ── engaged ──┤ held ...                      ┆ rejoining ├── engaged ──▶
        drone2    ── flying  ──┤ lands ├ takes off ├ hovers at 1 m ┆ over the ground, then up ┆

    Expected: the formation stays held, its drones where they were, until `rejoin`; then it is engaged again, all drones
    are where the paper's formation has them, and no two came near each other.
    """
    flight = OperatedFlight()
    flight.until(lambda: flight.formation is not None and flight.formation.phase == "engaged")
    flight.until(lambda: flight.formation.value[2] > 7.8)
    assert not flight.request("rejoin").ok
    flight.mode("drone2", "land")
    assert flight.formation.phase == "held"
    assert HELD_ON_REQUEST not in flight.formation.reason
    assert "drone2" in (flight.request("rejoin").error or "")
    flight.mode("drone2", "takeoff")
    flight.fly(5.0)
    assert flight.formation.phase == "held"
    assert flight.places_m["drone2"][2] < 2.0
    assert min(flight.places_m[name][2] for name in ("drone1", "drone3")) > 6.0

    assert flight.request("rejoin").ok
    flight.until(lambda: flight.formation.phase == "engaged")
    flight.fly(20.0)
    assert flight.formation.phase == "engaged"
    assert abs(np.array(flight.formation.value) - np.array(flight.formation.desired))[:3].max() < 0.5
    assert all(abs(p_m[2] - 8.0) < 0.5 for p_m in flight.places_m.values())
    assert flight.collisions == []
    assert min(flight.closest_m) > SEPARATION_M
