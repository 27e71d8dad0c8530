"""Obstacles in closed form and triangles against brute force: distances, nearest points, rims and crossing paths."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refused import has_terms

from zsim.contract import keys
from zsim.errors import ScenarioError
from zsim.math.held import hold
from zsim.scenario import surroundings
from zsim.scenario.scenario import Environment, Obstacle, Scenario, Surface
from zsim.scenario.scenario_file import resolve
from zsim.scenario.surroundings import (
    Surroundings,
    corners_of,
    crosses,
    nearest,
    nearest_points,
    packed,
    row_of,
    sheet_of,
)
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim_world.fleet.fleet import Fleet
from zsim_world.run.world import World


def rough(rows: int = 30, seed: int = 0) -> Any:
    """Return an environment with a rotated height map of random heights in cells of half a metre, scaled by 1.5."""
    height = np.random.default_rng(seed).uniform(0.0, 3.0, (rows, rows))
    x = np.arange(rows, dtype=float) * 0.5
    p = np.stack([*np.meshgrid(x, x), height], axis=2)
    a, b, c, d = p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]
    triangles: Any = np.concatenate([np.concatenate(t, axis=2).reshape(-1, 9) for t in ((a, b, c), (a, c, d))])
    surface = Surface(name="rough", triangles=packed(triangles), position_m=(-6, -7, 0.5), yaw_deg=20, scale=1.5)
    return SimpleNamespace(obstacles=[], surfaces=[surface])


def brute_force(corners: np.ndarray, p: np.ndarray) -> float:
    """Return the least distance of a point from triangles (T, 3, 3): to its foot point within one, or to an edge."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    height = ((p - a) * normal).sum(axis=1)
    foot = p - height[:, None] * normal
    inside = np.ones(len(a), dtype=bool)
    least = np.inf
    for start, end in ((a, b), (b, c), (c, a)):
        way = end - start
        inside &= (np.cross(way, foot - start) * normal).sum(axis=1) >= 0.0
        share = np.clip(((p - start) * way).sum(axis=1) / (way * way).sum(axis=1), 0.0, 1.0)
        least = min(least, np.linalg.norm(p - start - share[:, None] * way, axis=1).min())
    return min(least, np.abs(height[inside]).min(initial=np.inf))


def test_the_nearest_point_matches_brute_force():
    environment, rng = rough(), np.random.default_rng(1)
    sheet = sheet_of(environment)
    corners = corners_of(sheet.triangle)
    points = rng.uniform((-12, -12, -2), (20, 20, 8), (400, 3))
    distance, found = nearest_points(hold(sheet), points, np.inf)
    expected = np.array([brute_force(corners, p) for p in points])
    np.testing.assert_allclose(distance, expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - found, axis=1), expected, atol=1e-12)
    far = 0.7 * expected + 0.3 * np.median(expected)  # search radius: nothing is found beyond it
    np.testing.assert_allclose(nearest_points(hold(sheet), points, far)[0], np.minimum(far, expected), atol=1e-12)


def test_the_nearest_point_matches_trimesh():
    trimesh = pytest.importorskip("trimesh")
    sheet = sheet_of(rough(12, seed=3))
    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners_of(sheet.triangle)))
    points = np.random.default_rng(2).uniform((-12, -12, -2), (10, 10, 8), (200, 3))
    each = np.repeat(points, len(mesh.triangles), axis=0)
    closest = trimesh.triangles.closest_point(np.tile(mesh.triangles, (len(points), 1, 1)), each)
    expected = np.linalg.norm(closest - each, axis=1).reshape(len(points), -1).min(axis=1)
    np.testing.assert_allclose(nearest_points(hold(sheet), points, np.inf)[0], expected, atol=1e-12)


def test_the_rim_of_a_height_map_is_its_outline():
    sheet = sheet_of(rough(30))
    assert sheet.rim[:, :3].sum() == 4 * 29
    middle = corners_of(sheet.triangle).mean(axis=1)
    inner = np.linalg.norm(middle[:, :2] - middle[:, :2].mean(axis=0), axis=1) < 9.0
    assert inner.any()
    assert not sheet.rim[inner].any()


def test_a_path_crosses_a_plane_even_on_the_edges_of_its_triangles():
    """A path crosses a gridded plane if and only if its ends are on either side, even through edges and corners."""
    sheet = sheet_of(SimpleNamespace(obstacles=[], surfaces=[flat()]))
    rng = np.random.default_rng(4)
    starts = rng.uniform(-3.5, 3.5, (600, 3))
    ends = starts + rng.normal(0.0, 1.0, (600, 3))
    starts[:300, :2] = ends[:300, :2] = np.rint(2.0 * starts[:300, :2]) / 2.0  # vertical, through corners
    ends = np.clip(ends, -3.9, 3.9)
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        assert crosses(sheet, tuple(start), tuple(end)) == ((start[2] >= 0.0) != (end[2] >= 0.0))
    assert not crosses(sheet, (5.0, 0.0, 1.0), (5.0, 0.0, -1.0))  # beside it


def flat() -> Surface:
    x = np.arange(-4.0, 4.01, 0.5)
    p = np.stack(np.broadcast_arrays(x[None, :], x[:, None], np.zeros((17, 17))), axis=2)
    a, b, c, d = p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]
    triangles: Any = np.concatenate([np.concatenate(t, axis=2).reshape(-1, 9) for t in ((a, b, c), (a, c, d))])
    return Surface(name="flat", triangles=packed(triangles))


def test_distances_are_to_the_nearest_of_obstacles_and_surfaces():
    post = Obstacle(name="post", shape="cylinder", position_m=(0, 0, 0), radius_m=1, height_m=4)
    both = Surroundings(Environment(obstacles=[post], surfaces=[flat()]))
    points = [(0, 0, 2), (1.5, 0, 2), (2, 0, 0.25), (0, 0, -0.5), (9, 0, 0)]
    np.testing.assert_allclose(both.distances_m(points), [-1.0, 0.5, 0.25, 0.5, 5.0], atol=1e-9)
    nothing = Surroundings(Environment())
    assert nothing.is_empty
    assert np.isinf(nothing.distances_m(points)).all()


BOX = {"name": "wall", "shape": "box", "position_m": [4, 0, 0], "size_m": [1, 6, 5]}
PILLAR = {"name": "pillar", "shape": "cylinder", "position_m": [4, 0.1, 0], "radius_m": 0.5, "height_m": 5}
BALL = {"name": "ball", "shape": "sphere", "position_m": [4, 0.1, 1.1], "radius_m": 0.6}


def row(shape: str, **given: Any) -> list[float]:
    return row_of(Obstacle(name="o", shape=shape, **given))  # type: ignore[arg-type]


R2 = math.sqrt(0.5)
BOX_ROW = row("box", position_m=(1, 2, 0), size_m=(2, 4, 6), yaw_deg=90)  # extends 4 m along x, 2 m along y
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
def test_distance_and_direction_to_a_solid(solid: list[float], point: Any, distance: float, away: Any):
    found = nearest(solid, *point)
    assert found[0] == pytest.approx(distance, abs=1e-9)
    assert found[1:] == pytest.approx(away, abs=1e-9)


@pytest.mark.parametrize(
    "solid", [BOX_ROW, ROUND, row("sphere", position_m=(0, 0, 2), radius_m=1)], ids=["box", "cylinder", "sphere"]
)
def test_the_direction_is_the_gradient_of_the_distance(solid: list[float]):
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
def test_a_drone_does_not_fly_through_an_obstacle(given: dict[str, Any]):
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
    # compared with the hull's 0.26 m; a ball turns the flat hull, which comes to lie on it
    assert 0.0 < max(depths) < (0.25 if given is BALL else 0.1)
    assert not fleet.touching[1]
    if given is BOX:
        assert fleet.truth().position_m[0, 0] < 3.5


def test_the_world_reports_a_collision_with_drone_and_obstacle():
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
        ({**PILLAR, "name": "d1"}, ('environment.obstacles[0].name', "'d1'")),
        ({**PILLAR, "position_m": [0.6, 0, 0]}, ('drones[0].position_m', '0.10', "'pillar'", '>=', '0.3', "'d1'")),
        ({**BOX, "shape": "cone"}, ('environment.obstacles[0].shape', "'cone'", 'box', 'cylinder', 'sphere')),
    ],
)  # fmt: skip
def test_an_invalid_obstacle_is_refused(given: dict[str, Any], terms: tuple[str, ...]):
    with pytest.raises(ScenarioError) as raised:
        scenario(given)
    (fault,) = raised.value.faults
    assert has_terms(fault, *terms)


def test_a_drone_may_start_and_take_off_from_a_roof():
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


def test_least_distances_match_nearest_even_when_computed_in_blocks(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(surroundings, "PAIRS_MAX", 7)
    solids = [
        Obstacle(name="box", shape="box", position_m=(1, 2, 0), size_m=(2, 1, 3), yaw_deg=30),
        Obstacle(name="pole", shape="cylinder", position_m=(-2, 1, 0.5), radius_m=0.4, height_m=2),
        Obstacle(name="ball", shape="sphere", position_m=(0, -2, 1), radius_m=0.8),
    ]
    points = np.random.default_rng(1).uniform((-4, -4, 0), (4, 4, 4), (200, 3))
    expected = [min(nearest(row_of(each), *point)[0] for each in solids) for point in points.tolist()]
    np.testing.assert_allclose(surroundings.min_distances(solids, points), expected, atol=1e-12)
    assert min(expected) < 0.0
    assert surroundings.min_distances([], points).min() == np.inf
