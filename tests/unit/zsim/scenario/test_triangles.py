"""Triangles of surfaces against brute force: nearest points, rims, ways that cross one, and distances with obstacles."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from zsim.math.held import hold
from zsim.scenario.scenario import Environment, Obstacle, Surface
from zsim.scenario.surface_file import packed
from zsim.scenario.triangles import Surroundings, corners_of, crosses, nearest_points, sheet_of


def rough(rows: int = 30, seed: int = 0) -> Any:
    """Return an environment with a turned height map of random heights, in cells of half a metre."""
    height = np.random.default_rng(seed).uniform(0.0, 3.0, (rows, rows))
    x = np.arange(rows, dtype=float) * 0.5
    p = np.stack([*np.meshgrid(x, x), height], axis=2)
    a, b, c, d = p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]
    triangles: Any = np.concatenate([np.concatenate(t, axis=2).reshape(-1, 9) for t in ((a, b, c), (a, c, d))])
    surface = Surface(name="rough", triangles=packed(triangles), position_m=(-6, -7, 0.5), yaw_deg=20, scale=1.5)
    return SimpleNamespace(obstacles=[], surfaces=[surface])


def brute_force(corners: np.ndarray, p: np.ndarray) -> float:
    """Return the least distance of a point from triangles (T, 3, 3): of the plane's foot within it, or of an edge."""
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


def test_the_nearest_point_is_that_of_brute_force():
    environment, rng = rough(), np.random.default_rng(1)
    sheet = sheet_of(environment)
    corners = corners_of(sheet.triangle)
    points = rng.uniform((-12, -12, -2), (20, 20, 8), (400, 3))
    distance, found = nearest_points(hold(sheet), points, np.inf)
    expected = np.array([brute_force(corners, p) for p in points])
    np.testing.assert_allclose(distance, expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - found, axis=1), expected, atol=1e-12)
    far = 0.7 * expected + 0.3 * np.median(expected)  # nothing is found beyond it
    np.testing.assert_allclose(nearest_points(hold(sheet), points, far)[0], np.minimum(far, expected), atol=1e-12)


def test_the_nearest_point_is_that_of_trimesh():
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


def test_a_way_crosses_what_a_plane_says_and_does_not_slip_between_two():
    """Of a plane in cells: a way crosses it if and only if its ends are on both sides, on its edges and corners too."""
    sheet = sheet_of(SimpleNamespace(obstacles=[], surfaces=[flat()]))
    rng = np.random.default_rng(4)
    starts = rng.uniform(-3.5, 3.5, (600, 3))
    ends = starts + rng.normal(0.0, 1.0, (600, 3))
    starts[:300, :2] = ends[:300, :2] = np.rint(2.0 * starts[:300, :2]) / 2.0  # upright, through corners
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


def test_distances_are_those_from_the_nearest_of_obstacles_and_surfaces():
    post = Obstacle(name="post", shape="cylinder", position_m=(0, 0, 0), radius_m=1, height_m=4)
    both = Surroundings(Environment(obstacles=[post], surfaces=[flat()]))
    points = [(0, 0, 2), (1.5, 0, 2), (2, 0, 0.25), (0, 0, -0.5), (9, 0, 0)]
    np.testing.assert_allclose(both.distances_m(points), [-1.0, 0.5, 0.25, 0.5, 5.0], atol=1e-9)
    nothing = Surroundings(Environment())
    assert nothing.is_empty
    assert np.isinf(nothing.distances_m(points)).all()
