"""A plan that no formation of a scenario can fly is refused with what would fit; one that it can fly is not."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from refused import has_terms

from zsim.errors import RunError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.engagement_setup import check_plan

SCENARIOS = Path(__file__).parents[4] / "scenarios"
WAY = "[{at_s: 0, values: {x_c: 0, z_c: 3}}, {at_s: %g, values: {x_c: %g}}, {at_s: %g, values: {x_c: 0}}]"


def pair(plan: str, **drone: Any) -> Scenario:
    drones = [{"name": f"d{k}", "position_m": [0, 2 - 4 * k, 0], **drone} for k in range(2)]
    cluster = {"name": "main", "drones": ["d0", "d1"], "plan": yaml.safe_load(plan)}
    document = {"name": "t", "duration_s": 60, "drones": drones, "sensors": {"preset": "paper"}, "clusters": [cluster]}
    return scenario_file.resolve(document)


def way(m: float, half_s: float, start_s: float = 20) -> str:
    return f"{{takeoff_s: 2, trajectory: {{start_s: {start_s}, waypoints: {WAY % (half_s, m, 2 * half_s)}}}}}"


def refusal(scenario: Scenario) -> str:
    """Return why the plan of a scenario's first cluster is refused, "" where it is not."""
    try:
        check_plan(scenario, scenario.clusters[0])
    except RunError as error:
        return str(error)
    return ""


def factor(text: str) -> float:
    return float(re.findall(r"stretch its times by ([\d.]+)", text)[0])


@pytest.mark.parametrize("path", sorted(SCENARIOS.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_scenarios_of_this_product_can_be_flown(path: Path) -> None:
    scenario = scenario_file.load(path)
    assert [refusal(scenario)] * len(scenario.clusters) == [""] * len(scenario.clusters)
    for cluster in scenario.clusters:
        check_plan(scenario, cluster)


def test_a_trajectory_that_is_too_fast_is_refused_with_the_factor_that_fits() -> None:
    """A cubic from rest to rest over 30 m in 10 s has its peak at 1.5 × 3 m/s, three times the 1.5 m/s of the gains."""
    text = refusal(pair(way(30, 10)))
    assert has_terms(text, "clusters[0].plan.trajectory", "3.00", "0.8")
    assert factor(text) == pytest.approx(3.0 / 0.8, rel=0.01)
    assert refusal(pair(way(30, 10 * factor(text)))) == ""
    assert refusal(pair(way(30, 10 * factor(text) / 1.2))) != ""
    assert refusal(pair(way(7, 10))) == ""


def test_a_drone_that_is_slower_than_its_controller_asks_sets_the_limit() -> None:
    slow = pair(way(7, 10), limits={"horizontal_speed_m_s": 0.5})
    assert factor(refusal(slow)) == pytest.approx(1.5 * 0.7 / 0.5 / 0.8, rel=0.01)


def test_an_expression_is_judged_over_its_time() -> None:
    turns = "{{takeoff_s: 2, trajectory: {{start_s: 20, expressions: {{x_c: 0, y_c: 0, z_c: 3, yaw: {}*t}}}}}}"
    assert refusal(pair(turns.format(0.1))) == ""
    assert factor(refusal(pair(turns.format(2)))) > 1.0


def test_what_is_over_before_it_can_begin_is_refused_with_the_earliest_time() -> None:
    assert has_terms(refusal(pair(way(1, 1, start_s=1))), "clusters[0].plan.trajectory", "3 s", "5 s")
    far = "{takeoff_s: 2, trajectory: {start_s: 10, waypoints: [{at_s: 0, values: {x_c: 90}}, {at_s: 9, values: {x_c: 92}}]}}"
    assert has_terms(text := refusal(pair(far)), "clusters[0].plan.trajectory", "19 s")
    least_s = 5 + 15 / 8 * 90 / (0.8 * 1.5)
    assert least_s - 1 < float(re.findall(r"until (\d+) s", text)[0]) < 1.2 * least_s
    landing = "{takeoff_s: 2, land_s: 15, trajectory: {start_s: 20, expressions: {x_c: 0.1*t}}}"
    assert has_terms(refusal(pair(landing)), "clusters[0].plan.land_s", "15", "20 s")
    assert refusal(pair("{takeoff_s: 2, target: {x_c: 1}, land_s: 3}")).startswith("clusters[0].plan.land_s")


def test_a_target_that_is_too_far_for_its_time_is_refused_with_the_time_that_fits() -> None:
    """A quintic from rest to rest has its peak at 15/8 of its mean speed."""
    text = refusal(pair("{takeoff_s: 2, target: {x_c: 30}, target_over_s: 10}"))
    least_s = 15 / 8 * 30 / (0.8 * 1.5)
    assert has_terms(text, "clusters[0].plan.target_over_s", "10", f"{least_s / 10:.2g} times", f"{least_s:.1f} s")
    assert refusal(pair(f"{{takeoff_s: 2, target: {{x_c: 30}}, target_over_s: {least_s + 0.1:g}}}")) == ""
    assert refusal(pair("{takeoff_s: 2, target: {x_c: 30}}")) == ""


@pytest.mark.parametrize(
    ("target", "terms"),
    [
        ("{z_c: 0.1}", ("0.10 m", "0.5 m")),
        ("{p: 1.5}", ("1.500 m", "2 m")),
        ("{z_c: 150}", ("d0", "150.0 m", "100 m")),
        ("{pitch: 1.2}", ("pitch", "68.8 deg", "30 deg")),
    ],
)
def test_a_place_that_is_not_allowed_is_refused_in_a_target_and_on_a_trajectory(
    target: str, terms: tuple[str, ...]
) -> None:
    text = refusal(pair(f"{{takeoff_s: 2, target: {target}}}"))
    assert text.startswith("clusters[0].plan.target: ")
    trajectory = f"{{takeoff_s: 2, trajectory: {{start_s: 400, waypoints: [{{at_s: 0, values: {target}}}]}}}}"
    other = refusal(pair(trajectory))
    assert other.startswith("clusters[0].plan.trajectory: ")
    for each in (text, other):
        assert has_terms(each, *terms)


def test_a_plan_without_a_take_off_and_drones_that_make_no_formation_yet_are_not_judged() -> None:
    assert refusal(pair(way(30, 10).replace("takeoff_s: 2, ", ""))) == ""
