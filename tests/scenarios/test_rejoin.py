"""A drone that landed during formation flight and took off again, far below the others, rejoins on request."""

from pathlib import Path

import numpy as np
import pytest
from operated_flight import STEP_LIMIT_S, OperatedFlight

from zsim.scenario import scenario_file
from zsim_agents.formation.flight_check import HELD_ON_REQUEST

STEP = Path(__file__).parents[2] / "scenarios" / "step.yaml"
SHORT = ("clusters.main.plan.takeoff_s=1", "clusters.main.plan.target.z_c=8")
SEPARATION_M = 1.5  # between centres; below it, the controller raises its alarm


@pytest.mark.slow
def test_a_landed_drone_rejoins_its_formation_on_request() -> None:
    """Test 1 of the paper at a height of 8 m; the operator lands drone2 and has it take off again.

        formation ── engaged ──┤ held ...                      ┆ rejoining ├── engaged ──▶
        drone2    ── flying  ──┤ lands ├ takes off ├ hovers at 1 m ┆ over the ground, then up ┆

    Expected: the formation stays held, its other drones in place, until `rejoin`; then it is engaged again, all drones
    are at their places in the paper's formation, and no two have come near each other.
    """
    flight = OperatedFlight(scenario_file.load(STEP, SHORT, duration_s=10 * STEP_LIMIT_S))
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
