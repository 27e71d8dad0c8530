"""Formations whose plans lead them into drones with references, as far as that is known before the flight."""

from typing import Any

import pytest
from refused import has_terms

from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim_agents.formation.engagement_setup import planned_motion
from zsim_agents.hosting import check_plans

TRIANGLE = [{"name": f"d{k}", "position_m": place} for k, place in enumerate([[0, 2, 0], [0, -2, 0], [4, 0, 0]])]
CIRCLE = {"start_s": 40, "expressions": {"x_c": "10*cos(t/20)", "y_c": "10*sin(t/20)", "z_c": "3", "yaw": "0"}}
SHAPE = {"p": 4, "q": 4, "beta": 1.0}


def scenario(plan: dict[str, Any], **reference: Any) -> Any:
    alone = {"name": "alone", "position_m": [30, 0, 0], "reference": reference}
    cluster = {"name": "main", "drones": ["d0", "d1", "d2"], "plan": {"takeoff_s": 1, **plan}}
    document = {"name": "t", "duration_s": 120, "drones": [*TRIANGLE, alone], "clusters": [cluster]}
    return scenario_file.resolve(document)


def hold(place: list[float], at_s: float = 0.0, **reference: Any) -> dict[str, Any]:
    return {
        "start_s": 20,
        "minimum_snap": [{"at_s": at_s, "position_m": [30, 0, 3]}, {"at_s": at_s + 30, "position_m": place}],
        **reference,
    }


@pytest.mark.parametrize(
    ("plan", "reference", "path"),
    [
        # no robot is at the centre of the formation
        ({"target": {"x_c": 12, "y_c": 0, "z_c": 3, "yaw": 0, **SHAPE}}, hold([12, 0, 3]), None),
        ({"target": {"x_c": 12, "y_c": 0, "z_c": 3, "yaw": 0, **SHAPE}}, hold([12, 0, 9]), None),
        ({"trajectory": CIRCLE, "target": SHAPE}, hold([0, 10, 3]), "clusters[0].plan.trajectory"),
        ({"trajectory": CIRCLE, "target": SHAPE}, hold([0, 10, 3], land_s=60), None),
        ({"trajectory": CIRCLE, "target": SHAPE, "land_s": 60}, hold([0, 10, 3]), None),
        ({"trajectory": CIRCLE, "target": SHAPE}, hold([0, 30, 3]), None),
    ],
)
def test_a_plan_is_compared_with_references_where_both_are_known(plan: Any, reference: Any, path: str | None) -> None:
    made = scenario(plan, **reference)
    if path is None:
        check_plans(made, "t.yaml")
        return
    with pytest.raises(ScenarioError) as refused:
        check_plans(made, "t.yaml")
    (line,) = refused.value.faults
    assert line.split(" ")[1] == path
    assert "alone" in line


def test_a_formation_at_its_target_is_where_each_of_its_robots_is_to_be() -> None:
    plan = {"target": {"x_c": 12, "y_c": 0, "z_c": 3, "yaw": 0, **SHAPE}}
    free = scenario(plan, **hold([12, 0, 9]))
    planned = planned_motion(free, free.clusters[0])
    assert planned is not None
    assert 4 < planned.from_s < 40
    for robot, place in enumerate(planned.places(100.0).tolist()):
        with pytest.raises(ScenarioError) as refused:
            check_plans(scenario(plan, **hold(place)), "t.yaml")
        assert has_terms(str(refused.value), "clusters[0].plan.target", "robot", str(robot + 1), "alone")
