"""Rays against closed forms and against two independent casters, one by steps of free distance, one in numpy."""

import math
from typing import Any

import numpy as np
import pytest

from zsim.math.frames import quaternion_from_rpy
from zsim.math.rotation import Vector
from zsim.scenario.scenario import Obstacle
from zsim.scenario.surroundings import COLUMNS, nearest, row_of
from zsim_world.physics import rays
from zsim_world.physics.rays import TRIANGLE, cast, scene

FAR = 100.0
MM = 1e-3


def solids(*obstacles):
    return np.array([row_of(each) for each in obstacles]).reshape(-1, COLUMNS)


def box(at, size, yaw_deg=0.0):
    return Obstacle(name="box", shape="box", position_m=at, size_m=size, yaw_deg=yaw_deg)


def cylinder(at, radius, height):
    return Obstacle(name="cylinder", shape="cylinder", position_m=at, radius_m=radius, height_m=height)


def sphere(at, radius):
    return Obstacle(name="sphere", shape="sphere", position_m=at, radius_m=radius)


def vector(numbers) -> Vector:
    x, y, z = map(float, numbers)
    return x, y, z


def unit(*d) -> Vector:
    return vector(np.array(d) / np.linalg.norm(d))


def distance(held, o, d, far=FAR):
    return cast(held, vector(o), unit(*d), far)


def triangles(corners):
    """Return rows of triangles, corners (T, 3, 3)."""
    first = corners[:, 0]
    return np.concatenate([first, corners[:, 1] - first, corners[:, 2] - first], axis=1)


NOTHING = scene(np.empty((0, COLUMNS)), np.empty((0, TRIANGLE)))


@pytest.mark.parametrize(
    ("o", "d", "expected"),
    [
        ((0, 0, 2), (0, 0, -1), 2.0),
        ((0, 0, 2), (1, 0, -1), 2.0 * math.sqrt(2.0)),
        ((0, 0, 2), (1, 0, 0), FAR),
        ((0, 0, 2), (0, 0, 1), FAR),
        ((0, 0, -1), (0, 0, -1), FAR),  # there is nothing below the ground
        ((0, 0, 2), (1, 0, -0.01), FAR),  # beyond the range
    ],
)
def test_a_ray_meets_the_ground(o, d, expected):
    assert distance(NOTHING, o, d) == pytest.approx(expected, abs=1e-12)


CLOSED_FORMS = [
    (box((5, 0, 0), (2, 4, 6)), (0, 0, 1), (1, 0, 0), 4.0),
    (box((5, 0, 0), (2, 4, 6)), (0, 1.999, 1), (1, 0, 0), 4.0),
    (box((5, 0, 0), (2, 4, 6)), (0, 2.001, 1), (1, 0, 0), FAR),
    (box((5, 0, 0), (2, 2, 6), yaw_deg=45), (0, 0, 1), (1, 0, 0), 5.0 - math.sqrt(2.0)),
    (box((5, 0, 0), (2, 4, 6)), (5, 0, 9), (0, 0, -1), 3.0),
    (box((5, 0, 0), (2, 4, 6)), (5, 0, 3), (1, 0, 0), 0.0),  # from inside
    (box((5, 0, 0), (2, 4, 6)), (9, 0, 3), (1, 0, 0), FAR),  # behind
    (cylinder((5, 0, 0), 0.5, 3), (0, 0, 1), (1, 0, 0), 4.5),
    (cylinder((5, 0, 0), 0.5, 3), (0, 0.3, 1), (1, 0, 0), 4.6),
    (cylinder((5, 0, 0), 0.5, 3), (5, 0.2, 7), (0, 0, -1), 4.0),  # its top
    (cylinder((5, 0, 1), 0.5, 3), (5, 0.2, 0.5), (0, 0, 1), 0.5),  # its bottom, from below
    (cylinder((5, 0, 0), 0.5, 3), (0, 0, 3.001), (1, 0, 0), FAR),
    (sphere((5, 0, 2), 1), (0, 0, 2), (1, 0, 0), 4.0),
    (sphere((5, 0, 2), 1), (0, 0.6, 2), (1, 0, 0), 4.2),
    (sphere((5, 0, 2), 1), (0, 1.001, 2), (1, 0, 0), FAR),
]


@pytest.mark.parametrize(("obstacle", "o", "d", "expected"), CLOSED_FORMS)
def test_a_ray_meets_a_solid_as_in_closed_form(obstacle, o, d, expected):
    held = scene(solids(obstacle), np.empty((0, TRIANGLE)))
    assert distance(held, o, d) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("y", "expected"), [(0.0, 3.0), (0.49, 3.0), (0.51, FAR), (-0.51, FAR)])
def test_a_triangle_is_seen_from_both_sides(y, expected):
    held = scene(np.empty((0, COLUMNS)), triangles(np.array([[[3, -0.5, 0], [3, 0.5, 0], [3, 0, 50.0]]])))
    assert distance(held, (0, y, 0.2), (1, 0, 0)) == pytest.approx(expected)
    assert distance(held, (6, y, 0.2), (-1, 0, 0)) == pytest.approx(expected)


def test_a_hull_is_flat_and_turns_with_its_drone():
    level: Any = (1.0, 0.0, 0.0, 0.0)
    on_its_side: Any = tuple(quaternion_from_rpy(np.radians([0.0, 90.0, 0.0])).tolist())
    args: Any = (0.4, (0.0, 0.0, 2.0), (1.0, 0.0, 0.0), FAR)
    assert rays.cast_hull((5.0, 0.0, 2.0), level, *args) == pytest.approx(4.6)
    assert rays.cast_hull((5.0, 0.0, 2.0), on_its_side, *args) == pytest.approx(5.0 - 0.4 * rays.HULL_FLATNESS)
    assert rays.cast_hull((5.0, 0.0, 2.2), level, *args) == FAR


def stepped(rows, o, d):
    """Return where a ray meets solids or ground, by steps of the distance to the nearest surface."""
    t = 0.0
    for _ in range(20_000):
        p = [a + t * b for a, b in zip(o, d, strict=True)]
        free = min([p[2], *(nearest(row, *p)[0] for row in rows)])
        if free < 1e-7:
            return t
        t += free
        if t > FAR:
            break
    return FAR


def moeller_trumbore(corners, o, d):
    """Return the nearest hit of triangles (T, 3, 3), by solving a 3 x 3 system for each in numpy."""
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    system = np.stack([np.broadcast_to(-np.array(d), a.shape), e1, e2], axis=2)
    sound = np.abs(np.linalg.det(system)) > 1e-12
    t, u, v = np.linalg.solve(system[sound], (np.array(o) - a[sound])[..., None])[..., 0].T
    hits = t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0)]
    return min(hits.min(initial=FAR), FAR)


def test_rays_through_a_forest_agree_with_independent_casters():
    rng = np.random.default_rng(7)
    trunks = [cylinder((x, y, 0), r, h) for x, y, r, h in rng.uniform((-20, -20, 0.05, 1), (20, 20, 0.6, 8), (200, 4))]
    boxes = [
        box(vector(rng.uniform((-20, -20, 0), (20, 20, 0))), vector(rng.uniform(0.2, 3, 3)), rng.uniform(0, 360))
        for _ in range(30)
    ]
    balls = [sphere(vector(rng.uniform((-20, -20, 0), (20, 20, 6))), rng.uniform(0.1, 1)) for _ in range(30)]
    rows = solids(*trunks, *boxes, *balls)
    corners = rng.uniform((-20, -20, 0), (20, 20, 6), (300, 1, 3)) + rng.normal(0, 1, (300, 3, 3))
    held = scene(rows, triangles(corners))
    met = 0
    for _ in range(150):
        o, d = vector(rng.uniform((-25, -25, 0.1), (25, 25, 7))), unit(*rng.normal(0, (1, 1, 0.3)))
        expected = min(stepped(rows.tolist(), o, d), moeller_trumbore(corners, o, d))
        assert cast(held, o, d, FAR) == pytest.approx(expected, abs=MM)
        met += expected < FAR
    assert met > 80


def test_a_tree_gives_the_same_bits_as_a_list():
    """The tree gives the bits of a comparison with every part, also for no more parts than one leaf holds."""
    rng = np.random.default_rng(3)
    for count in (1, 4, 5, 64, 333):
        rows = solids(*(cylinder(vector(rng.uniform((-9, -9, 0), (9, 9, 0))), 0.3, 4) for _ in range(count)))
        held = scene(rows, np.empty((0, TRIANGLE)))
        for _ in range(200):
            o, d = vector(rng.uniform((-9, -9, 0), (9, 9, 4))), unit(*rng.normal(size=3))
            expected = rays.cast_ground(o, d, FAR)
            for row in rows:
                expected = rays.cast_solid(row, o, d, expected)
            assert cast(held, o, d, FAR) == expected
