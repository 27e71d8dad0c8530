"""Forests, corridors, meshes, height maps and clouds: what becomes of them, and what is refused."""

from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pytest

from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario_file import resolve
from zsim.scenario.surroundings import nearest, row_of

FOREST = {"trees": 60, "area_m": [-15, -15, 15, 15], "gap_m": 1.0, "clear_m": 3.0}
CORRIDOR = {"segments": 8, "turn_deg": 60, "start_m": [-2, 0]}
STARTS = ((0.0, 0.0), (4.0, 0.0))


def document(seed: int = 1, **environment: Any) -> dict[str, Any]:
    drones = [{"name": f"d{i}", "position_m": [x, y, 0]} for i, (x, y) in enumerate(STARTS)]
    return {"name": "t", "seed": seed, "duration_s": 1, "environment": environment, "drones": drones}


def obstacles(**given: Any) -> Any:
    return resolve(document(**given)).environment.obstacles


def faults_of(**environment: Any) -> list[str]:
    with pytest.raises(ScenarioError) as refused:
        resolve(document(**environment))
    return [line.removeprefix("scenario: environment.").split(" ")[0] for line in refused.value.faults]


def test_trunks_are_clear_of_each_other_and_of_the_starts():
    trees = obstacles(forest=FOREST)
    assert len({tree.name for tree in trees}) == 60
    places = np.array([tree.position_m[:2] for tree in trees])
    assert np.abs(places).max() <= 15
    for a, b in combinations(trees, 2):
        assert np.hypot(*np.subtract(a.position_m, b.position_m)[:2]) >= a.radius_m + b.radius_m + 1.0
    for tree in trees:
        assert min(np.hypot(*np.subtract(tree.position_m[:2], start)) for start in STARTS) >= tree.radius_m + 3.0


@pytest.mark.parametrize("part", [{"forest": FOREST}, {"corridor": CORRIDOR}])
def test_the_seed_decides_and_may_be_its_own(part: dict[str, Any]):
    ((name, settings),) = part.items()
    assert obstacles(seed=1, **part) == obstacles(seed=1, **part) != obstacles(seed=2, **part)
    fixed = {name: settings | {"seed": 5}}
    assert obstacles(seed=1, **fixed) == obstacles(seed=2, **fixed)


def test_the_resolved_text_has_each_of_them_beside_those_that_are_given():
    ball = {"name": "ball", "shape": "sphere", "position_m": [0, 0, 9], "radius_m": 1}
    made = resolve(document(forest=FOREST, corridor=CORRIDOR | {"start_m": [30, 0]}, obstacles=[ball]))
    assert len(made.environment.obstacles) == 1 + 60 + 16
    assert scenario_file.from_text(scenario_file.to_text(made)) == made


def test_a_corridor_is_as_wide_as_told_and_closed_at_its_bends():
    """Along its middle the nearest wall is half of the width away; along the inner faces none is missing."""
    walls = list(obstacles(corridor=CORRIDOR))
    rows = [row_of(wall) for wall in walls]
    lefts, rights = ([wall for wall in walls if wall.name.endswith(side)] for side in ("left", "right"))
    for left, right in zip(lefts, rights, strict=True):
        yaw = np.radians(left.yaw_deg)
        across = np.array([-np.sin(yaw), np.cos(yaw)])
        apart = np.subtract(left.position_m, right.position_m)[:2] @ across
        assert apart == pytest.approx(3.0 + 0.2, abs=5e-3)
    for first, second in pairwise(lefts):  # the ends of two walls are within one another
        yaw = np.radians(first.yaw_deg)
        end = np.array(first.position_m[:2]) + 0.5 * (first.size_m[0] - 0.2) * np.array([np.cos(yaw), np.sin(yaw)])
        assert nearest(rows[walls.index(second)], float(end[0]), float(end[1]), 1.0)[0] < 0.0


@pytest.mark.parametrize(
    ("section", "change", "field"),
    [
        ("forest", {"trees": 0}, "trees"),
        ("forest", {"trees": 1001}, "trees"),
        ("forest", {"trees": 900}, "trees"),  # do not fit
        ("forest", {"area_m": [5, 0, -5, 1]}, "area_m"),
        ("forest", {"radius_m": [0.3, 0.2]}, "radius_m"),
        ("forest", {"height_m": [0, 2]}, "height_m[0]"),
        ("forest", {"gap_m": -1}, "gap_m"),
        ("forest", {"clear_m": "much"}, "clear_m"),
        ("forest", {"seed": -1}, "seed"),
        ("forest", {"colour": 1}, "colour"),
        ("corridor", {"segments": 0}, "segments"),
        ("corridor", {"turn_deg": 91}, "turn_deg"),
        ("corridor", {"width_m": 0}, "width_m"),
        ("corridor", {"wall_m": -1}, "wall_m"),
        ("corridor", {"length_m": 0}, "length_m"),
        ("corridor", {"height_m": 0}, "height_m"),
        ("corridor", {"start_m": [0]}, "start_m"),
        ("corridor", {"heading_deg": "east"}, "heading_deg"),
        ("corridor", {"seed": 0.5}, "seed"),
    ],
)
def test_what_is_refused(section: str, change: dict[str, Any], field: str):
    base = {"forest": FOREST, "corridor": CORRIDOR}[section]
    assert faults_of(**{section: base | change}) == [f"{section}.{field}"]


def test_together_they_are_no_more_than_a_world_takes():
    big = {"forest": FOREST | {"trees": 999, "area_m": [-300, -300, 300, 300]}, "corridor": CORRIDOR}
    assert faults_of(**big) == ["obstacles"]
