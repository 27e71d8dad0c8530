"""The controller's input at a gate: values of the estimates, extrapolation of old ones, and missing ones."""

import math

import numpy as np
import pytest

from zsim.contract import flight_messages, messages
from zsim.scenario import scenario_file
from zsim_agents.formation.controller import Controller

GATE_NS = 20_000_000
DRONES = ("d1", "d2", "d3")


@pytest.fixture
def controller() -> Controller:
    places = ([0, 3, 0], [-3, -3, 0], [3, -3, 0])
    drones = [{"name": name, "position_m": place} for name, place in zip(DRONES, places, strict=True)]
    clusters = [{"name": "c", "drones": list(DRONES)}]
    scenario = scenario_file.resolve({"name": "test", "duration_s": 10, "drones": drones, "clusters": clusters})
    origin = messages.Origin(0.0, 0.0, 0.0)
    info = messages.Info(
        0, 0, 1, "r", "zsim", "lockstep", 0.0, GATE_NS, 2_500_000, GATE_NS, 1, origin, (), (), "", "", "", ""
    )
    return Controller(info, scenario, "c")


def estimate(t_ns: int, drone: int) -> flight_messages.Estimate:
    """Return an estimate in which each number identifies the drone and the element."""
    first = 100.0 * drone
    covariance = tuple((first + i) ** 2 for i in range(36))
    p, v = (first + 1, first + 2, first + 3), (first + 4, first + 5, first + 6)
    return flight_messages.Estimate(
        t_ns, 0, p, v, (1.0, 0.0, 0.0, 0.0), first + 7, covariance, 0.1, (0.0, 0.0, 0.0), {}
    )


def test_each_value_of_an_estimate_has_its_place_in_the_input(controller):
    for drone, name in enumerate(DRONES):
        controller.receive(f"drone/{name}/estimate", estimate(GATE_NS, drone))
    gate = controller._gate(GATE_NS)
    firsts = np.array([[0.0], [100.0], [200.0]])
    assert gate.p_W.tolist() == (firsts + np.array([1, 2, 3])).tolist()
    assert gate.v_W.tolist() == (firsts + np.array([4, 5, 6])).tolist()
    assert gate.sigma_m.tolist() == (firsts + np.array([0, 7, 14])).tolist()
    assert gate.yaw.tolist() == [7.0, 107.0, 207.0]
    assert gate.age_s.tolist() == [0.0, 0.0, 0.0]


def test_an_old_estimate_is_extrapolated_and_a_missing_one_not_finite(controller):
    controller.receive("drone/d1/estimate", estimate(GATE_NS, 0))
    controller.receive("drone/d2/estimate", estimate(3 * GATE_NS, 1))
    gate = controller._gate(3 * GATE_NS)
    assert gate.age_s.tolist() == [pytest.approx(0.04), 0.0, math.inf]
    assert gate.p_W[0] == pytest.approx([1 + 0.04 * 4, 2 + 0.04 * 5, 3 + 0.04 * 6])
    assert gate.p_W[1].tolist() == [101.0, 102.0, 103.0]
    assert np.isnan(gate.p_W[2]).all()
    assert math.isinf(gate.sigma_m[2, 0])
    again = controller._gate(3 * GATE_NS)
    assert again.p_W[0] == pytest.approx(gate.p_W[0])
