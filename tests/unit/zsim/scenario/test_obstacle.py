"""Obstacles: distances in closed form, hulls that are stopped, events, what a scenario may say."""

import math
from typing import Any

import numpy as np
import pytest
from refused import has_terms

from zsim.contract import keys
from zsim.errors import ScenarioError
from zsim.scenario import obstacle
from zsim.scenario.obstacle import nearest, row_of
from zsim.scenario.scenario import Obstacle, Scenario
from zsim.scenario.scenario_file import resolve
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim_world.fleet.fleet import Fleet
from zsim_world.run.world import World

BOX = {"name": "wall", "shape": "box", "position_m": [4, 0, 0], "size_m": [1, 6, 5]}
PILLAR = {"name": "pillar", "shape": "cylinder", "position_m": [4, 0.1, 0], "radius_m": 0.5, "height_m": 5}
BALL = {"name": "ball", "shape": "sphere", "position_m": [4, 0.1, 1.1], "radius_m": 0.6}


def row(shape: str, **given: Any) -> list[float]:
    return row_of(Obstacle(name="o", shape=shape, **given))  # type: ignore[arg-type]


R2 = math.sqrt(0.5)
BOX_ROW = row("box", position_m=(1, 2, 0), size_m=(2, 4, 6), yaw_deg=90)  # 4 along x, 2 along y
ROUND = row("cylinder", position_m=(0, 0, 1), radius_m=1, height_m=2)


@pytest.mark.parametrize(
    ("solid", "point", "distance", "away"),
    [
        (BOX_ROW, (4, 2, 3), 1.0, (1, 0, 0)),
        (BOX_ROW, (1, 0, 3), 1.0, (0, -1, 0)),
        (BOX_ROW, (1, 2, 8), 2.0, (0, 0, 1)),
        (BOX_ROW, (4, 4, 3), math.sqrt(2), (R2, R2, 0)),
        (BOX_ROW, (2.9, 2, 3), -0.1, (1, 0, 0)),
        (ROUND, (3, 0, 2), 2.0, (1, 0, 0)),
        (ROUND, (0, -3, 2), 2.0, (0, -1, 0)),
        (ROUND, (0, 0, 3.5), 0.5, (0, 0, 1)),
        (ROUND, (0, 2, 4), math.sqrt(2), (0, R2, R2)),
        (ROUND, (0.9, 0, 2), -0.1, (1, 0, 0)),
        (row("sphere", position_m=(0, 0, 2), radius_m=1), (0, 2, 4), 2 * math.sqrt(2) - 1, (0, R2, R2)),
        (row("sphere", position_m=(0, 0, 2), radius_m=1), (0, 0, 1.5), -0.5, (0, 0, -1)),
    ],
)
def test_distance_and_direction(solid: list[float], point: Any, distance: float, away: Any):
    found = nearest(solid, *point)
    assert found[0] == pytest.approx(distance, abs=1e-9)
    assert found[1:] == pytest.approx(away, abs=1e-9)


@pytest.mark.parametrize(
    "solid", [BOX_ROW, ROUND, row("sphere", position_m=(0, 0, 2), radius_m=1)], ids=["box", "cylinder", "sphere"]
)
def test_the_direction_is_the_slope_of_the_distance(solid: list[float]):
    rng = np.random.default_rng(1)
    for p in rng.uniform(-5, 6, (300, 3)):
        d, *away = nearest(solid, *p)
        assert math.hypot(*away) == pytest.approx(1.0)
        if d > 0.0:
            assert nearest(solid, *(p + 0.01 * np.array(away)))[0] == pytest.approx(d + 0.01, abs=1e-9)


def scenario(*obstacles: Any, **more: Any) -> Scenario:
    drones = [{"name": "d1", "position_m": [0, 0, 0]}, {"name": "d2", "position_m": [0, 8, 0]}]
    document = {"name": "t", "duration_s": 30, "drones": drones, "processes": {"expect": []}}
    return resolve({**document, "environment": {"obstacles": list(obstacles)}, **more})


@pytest.mark.parametrize("given", [BOX, PILLAR, BALL], ids=lambda o: o["shape"])
def test_a_drone_that_flies_into_an_obstacle_does_not_get_through(given: dict[str, Any]):
    flown = scenario(given)
    fleet, solid = Fleet(flown), row_of(flown.environment.obstacles[0])
    assert fleet.takeoff(0) is None
    began, depths = [], []
    for gate in range(600):
        if gate > 250:
            fleet.set_velocity(0, (1.0, 0.0, 0.0), 0.0, "world")
        fleet.advance()
        began += fleet.bumps()
        depths.append(ARDRONE2.airframe.hull_radius_m - nearest(solid, *fleet.truth().position_m[0])[0])
    assert began[0] == (0, 0)
    # of the hull's 0.26 m; a ball turns the flat hull, which comes to lie on it
    assert 0.0 < max(depths) < (0.25 if given is BALL else 0.1)
    assert not fleet.touching[1]
    if given is BOX:
        assert fleet.truth().position_m[0, 0] < 3.5


def test_the_world_says_who_runs_into_what():
    world = World(scenario(BOX), run_id="r")
    for gate in range(600):
        if gate == 1:
            world.fleet.takeoff(0)
        if gate > 250:
            world.fleet.set_velocity(0, (1.0, 0.0, 0.0), 0.0, "world")
        world.advance(0)
    said = [m for key, m in world.take_outbox() if key == keys.EVENT and m.kind == "collision"]
    assert (said[0].subject, said[0].data) == ("d1", {"other": "wall"})
    assert has_terms(said[0].text, "d1", "wall")


def test_an_obstacle_out_of_reach_changes_nothing():
    near, far = Fleet(scenario()), Fleet(scenario(BOX))
    for fleet in (near, far):
        fleet.takeoff(0)
        for _ in range(200):
            fleet.advance()
    assert (near.bodies.state == far.bodies.state).all()


@pytest.mark.parametrize(
    ("given", "terms"),
    [
        ({**BOX, "size_m": None}, ('environment.obstacles[0].size_m', 'missing', 'box')),
        ({**BALL, "height_m": 2}, ('environment.obstacles[0].height_m', 'given', 'sphere')),
        ({**PILLAR, "name": "d1"}, ('environment.obstacles[0].name', "'d1'", 'another')),
        ({**PILLAR, "position_m": [0.6, 0, 0]}, ('drones[0].position_m', '0.10', "'pillar'", '>=', '0.3', "'d1'")),
        ({**BOX, "shape": "cone"}, ('environment.obstacles[0].shape', "'cone'", 'box', 'cylinder', 'sphere')),
    ],
)  # fmt: skip
def test_what_an_obstacle_cannot_be(given: dict[str, Any], terms: tuple[str, ...]):
    with pytest.raises(ScenarioError) as raised:
        scenario(given)
    (fault,) = raised.value.faults
    assert has_terms(fault, *terms)


def test_a_drone_may_start_on_a_roof_and_takes_off_from_it():
    roof = {"name": "roof", "shape": "box", "position_m": [0, 0, 0], "size_m": [3, 3, 2.5]}
    drones = [{"name": "d1", "position_m": [0.5, 0.2, 2.5]}]
    document = {"name": "t", "duration_s": 30, "drones": drones, "environment": {"obstacles": [roof]}}
    fleet, frame = Fleet(resolve(document)), ARDRONE2.airframe
    for _ in range(50):
        fleet.advance()
    standing_m = 2.5 + frame.foot_depth_m - frame.foot_sag_m
    np.testing.assert_allclose(fleet.truth().position_m[0], (0.5, 0.2, standing_m), atol=1e-4)
    assert fleet.takeoff(0) is None
    for _ in range(400):
        fleet.advance()
    assert fleet.status(0)[0] == "hovering"
    assert fleet.truth().position_m[0, 2] == pytest.approx(2.5 + ARDRONE2.takeoff_height_m, abs=0.15)


def test_least_distances_are_those_of_nearest_in_blocks_too(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(obstacle, "PAIRS_MAX", 7)
    solids = [
        Obstacle(name="box", shape="box", position_m=(1, 2, 0), size_m=(2, 1, 3), yaw_deg=30),
        Obstacle(name="pole", shape="cylinder", position_m=(-2, 1, 0.5), radius_m=0.4, height_m=2),
        Obstacle(name="ball", shape="sphere", position_m=(0, -2, 1), radius_m=0.8),
    ]
    points = np.random.default_rng(1).uniform((-4, -4, 0), (4, 4, 4), (200, 3))
    expected = [min(nearest(row_of(each), *point)[0] for each in solids) for point in points.tolist()]
    np.testing.assert_allclose(obstacle.least_distances(solids, points), expected, atol=1e-12)
    assert min(expected) < 0.0
    assert obstacle.least_distances([], points).min() == np.inf
