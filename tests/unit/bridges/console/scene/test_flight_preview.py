"""What a formation would fly: the ways of its drones, from where it is."""

from pathlib import Path

import numpy as np
import pytest
from refused import has_terms

from zsim.scenario import scenario_file
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_bridges.console.picture import PreviewError, preview_of

SCENARIO = scenario_file.load(Path(__file__).parents[5] / "scenarios" / "step.yaml")
SPACE = scenario_space(SCENARIO, SCENARIO.clusters[0])
BASE = SPACE.specimen(4.0)
APART_M = 2.0


def changed(**values: float) -> np.ndarray:
    c = BASE.copy()
    for name, value in values.items():
        c[SPACE.index(name)] = value
    return c


def test_the_way_to_a_target_begins_where_the_formation_is_and_ends_there():
    preview = preview_of(SPACE, "target", {"values": {"x_c": BASE[0] + 3.0, "yaw_deg": 90.0}}, BASE, APART_M)
    assert np.allclose(preview.paths_W[:, 0], SPACE.inverse(BASE)[0])
    goal = changed(x_c=BASE[0] + 3.0, yaw=np.pi / 2)
    assert np.allclose(preview.paths_W[:, -1], SPACE.inverse(goal)[0])
    assert "less than" not in preview.text


def test_the_way_of_a_trajectory_has_its_beginning_and_its_figures():
    waypoints = [
        {"at_s": 0.0, "values": {"x_c": 1.0, "z_c": 8.0}},
        {"at_s": 20.0, "values": {"x_c": 21.0, "z_c": 12.0}},
    ]
    preview = preview_of(SPACE, "trajectory", {"waypoints": waypoints}, BASE, APART_M)
    assert np.allclose(preview.paths_W[:, 0], SPACE.inverse(BASE)[0])
    assert np.allclose(preview.paths_W[:, -1], SPACE.inverse(changed(x_c=21.0, z_c=12.0))[0])
    # a cubic from rest to rest is 1.5 times as fast in its middle as on the whole: 1.5 * hypot(20, 4) / 20
    assert has_terms(preview.text, "20 s", "heights 8.0 to 12.0 m", "1.5 m/s at most")


def test_drones_that_would_come_too_near_are_named():
    preview = preview_of(SPACE, "target", {"values": {"p": 1.0}}, BASE, APART_M)
    assert has_terms(preview.text, "1.0 m apart", "less than the 2 m")


@pytest.mark.parametrize(
    ("op", "args", "finding"),
    [
        ("target", {"values": {"speed": 1.0}}, "speed"),
        ("trajectory", {"expressions": {"x_c": "5*cos("}}, "x_c"),
        ("trajectory", {"waypoints": []}, "expressions or waypoints"),
    ],
)
def test_what_no_formation_can_fly_has_no_preview(op: str, args: dict[str, object], finding: str):
    with pytest.raises(PreviewError) as refused:
        preview_of(SPACE, op, args, BASE, APART_M)
    assert finding in str(refused.value)
