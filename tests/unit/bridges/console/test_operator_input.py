"""What an operator types: ranges, expressions and waypoints."""

import math
from pathlib import Path

import numpy as np
import pytest
from refused import has_terms, refused

from zsim.scenario import scenario_file
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_agents.formation.trajectory import ExpressionTrajectory
from zsim_bridges.console import operator_input
from zsim_bridges.console.operator_input import primary_variables, slider_ranges

SCENARIOS = Path(__file__).parents[4] / "scenarios"


def test_every_variable_has_a_range_in_its_unit():
    scenario = scenario_file.load(SCENARIOS / "step.yaml")
    cluster = scenario.clusters[0]
    space = scenario_space(scenario, cluster)
    found = {each.name: each for each in slider_ranges(space, cluster, scenario)}
    assert list(found) == list(space.names)
    assert found["p"].low == cluster.gains.separation_min_m
    assert found["yaw"].unit == "deg"
    assert found["yaw"].to_si(90.0) == pytest.approx(math.pi / 2)
    assert found["yaw"].to_display(math.pi / 2 + math.tau) == 90.0
    assert found["z_c"].low > 0
    assert found["beta"].low > 0
    assert found["beta"].high < 180
    goal = {name: float(value) for name, value in cluster.plan.target.items()}
    assert all(found[n].refusal(found[n].to_display(v)) is None for n, v in goal.items())


def test_what_is_out_of_range_is_refused_with_what_is_allowed():
    scenario = scenario_file.load(SCENARIOS / "step.yaml")
    space = scenario_space(scenario, scenario.clusters[0])
    found = {each.name: each for each in slider_ranges(space, scenario.clusters[0], scenario)}
    assert has_terms(found["p"].refusal(0.5) or "", "p", "0.5")
    assert found["p"].refusal(math.nan) is not None
    assert found["p"].to_display(1.0) == 1.0  # as it is: only what is asked for must be within


@pytest.mark.parametrize(
    ("altitude_m", "separation_m"), [(100.0, 0.0), (1.0, 20.0), (0.8, 25.0), (1e-3, 1e9), (10_000.0, 19.95)]
)
def test_every_range_has_room_whatever_the_scenario_allows(altitude_m: float, separation_m: float):
    given = {"drones.drone1.limits.altitude_m": altitude_m, "clusters.main.gains.separation_min_m": separation_m}
    scenario = scenario_file.load(SCENARIOS / "step.yaml", [f"{path}={value}" for path, value in given.items()])
    cluster = scenario.clusters[0]
    for found in slider_ranges(scenario_space(scenario, cluster), cluster, scenario):
        assert found.low < found.high, found.name
        assert found.low <= found.start <= found.high


def test_of_many_variables_those_of_the_whole_are_shown():
    scenario = scenario_file.load(SCENARIOS / "grid30.yaml")
    space = scenario_space(scenario, scenario.clusters[0])
    assert primary_variables(space.names)[:6] == ["x_c", "y_c", "z_c", "roll", "pitch", "yaw"]
    assert len(primary_variables(space.names)) < 16


def test_expressions_are_read_with_their_constants():
    text = "# a circle\nx_c = R*cos(0.1*t)\n\ny_c = R*sin(0.1*t)\nR = 5"
    assert operator_input.parse_expressions(text, ("x_c", "y_c")) == {
        "expressions": {"x_c": "R*cos(0.1*t)", "y_c": "R*sin(0.1*t)"},
        "constants": {"R": 5.0},
    }


def test_expressions_of_angles_are_in_degrees_as_the_sliders_are():
    scenario = scenario_file.load(SCENARIOS / "step.yaml")
    space = scenario_space(scenario, scenario.clusters[0])
    text = "yaw = 90 + 6*t\nroll_deg = A\nx_c = 1\nA = 5"
    read = operator_input.parse_expressions(text, space.names, ("roll", "pitch", "yaw"))
    c, c_dot = ExpressionTrajectory(space, read["expressions"], np.zeros(space.size), read["constants"]).value(5.0)
    found = {name: c[space.index(name)] for name in ("yaw", "roll", "x_c")}
    assert found == pytest.approx({"yaw": math.radians(120.0), "roll": math.radians(5.0), "x_c": 1.0})
    assert c_dot[space.index("yaw")] == pytest.approx(math.radians(6.0))


def test_waypoints_are_read():
    assert operator_input.parse_waypoints("0: x_c = 1, p=4\n20.5: x_c=2", {}) == {
        "waypoints": [{"at_s": 0.0, "values": {"x_c": 1.0, "p": 4.0}}, {"at_s": 20.5, "values": {"x_c": 2.0}}]
    }


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("x_c", ("line 1", "'x_c'")),
        ("x_c = 5\nyc = 6", ("yc", "x_c")),
        ("x_c = 1\nradius = wide", ("line 2", "radius", "'wide'")),
        ("", ("trajectory",)),
    ],
)
def test_an_invalid_expression_is_refused_by_line_and_value(text: str, terms: tuple[str, ...]):
    with refused(operator_input.InputError, *terms):
        operator_input.parse_expressions(text, ("x_c",))


@pytest.mark.parametrize("text", ["x_c = 1", "0 x_c=1", "0: 5", "a: x_c = 1", ""])
def test_a_waypoint_that_is_none_is_refused_in_words(text: str):
    with pytest.raises(operator_input.InputError):
        operator_input.parse_waypoints(text, {})
