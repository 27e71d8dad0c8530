"""Cluster spaces: properties that every kind must have, then names, measures and singular shapes of each kind."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import refused

from zsim.scenario.scenario import ROBOTS_MAX
from zsim_agents.formation.spaces.cluster_space import (
    ClusterSpace,
    SingularClusterError,
    closest_pair,
    robot_rates,
    unit,
)
from zsim_agents.formation.spaces.scenario_space import NestedCluster, cluster_space
from zsim_agents.formation.spaces.template_cluster import TemplateCluster, centred, fitted_rotation, shape_modes, turns

TRIADS = (2, 3, 4, 5, 8)
TEMPLATES = (3, 5, 10, 30)
TRIANGLE = np.array([(0.0, 1.5, 1.0), (-1.5, -1.5, 1.0), (1.5, -1.5, 1.0)])  # take-off positions, m
RING = np.array([(6 * math.cos(k * math.pi / 5), 6 * math.sin(k * math.pi / 5), 0.0) for k in range(10)])
SQUARE = np.array([(2.0, 2.0, 0.0), (-2.0, 2.0, 0.0), (-2.0, -2.0, 0.0), (2.0, -2.0, 0.0)])
PENTAGON = 8.0 * np.array([(math.cos(k * 0.4 * math.pi), math.sin(k * 0.4 * math.pi), 0.0) for k in range(5)])
STEP = 1e-6


def template(n: int, flat: bool = False) -> TemplateCluster:
    places = np.random.default_rng(n).normal(scale=4.0, size=(n, 3))
    return TemplateCluster(places * (1.0, 1.0, 0.0 if flat else 1.0))


def triads() -> NestedCluster:
    return NestedCluster(cluster_space(3), [(name, cluster_space(3)) for name in ("lead", "left", "right")])


def mixed() -> NestedCluster:
    """Return a pair, a triad, a square template and three triads, nested in a parent of four."""
    groups = [cluster_space(2), cluster_space(3), TemplateCluster(SQUARE), triads()]
    return NestedCluster(cluster_space(4), list(zip("abcd", groups, strict=True)))


SPACES: dict[str, Callable[[], ClusterSpace]] = {
    **{f"triad {n}": lambda n=n: cluster_space(n) for n in TRIADS},
    **{f"template {n}": lambda n=n: template(n) for n in TEMPLATES},
    **{f"plane {n}": lambda n=n: template(n, flat=True) for n in TEMPLATES},
    "nested triads": triads,
    "nested mixed": mixed,
    "nested templates": lambda: NestedCluster(
        TemplateCluster(PENTAGON), [(n, TemplateCluster(SQUARE)) for n in "abcde"]
    ),
}


def random_robots(space: ClusterSpace, rng: np.random.Generator, margin_min_m: float = 0.3):
    """Return positions and headings of a formation with a random orientation that is not nearly singular."""
    while True:
        if isinstance(space, TemplateCluster):
            angles = rng.uniform(-math.pi, math.pi, 2 + space.n)
            bends = rng.normal(scale=1.5 / math.sqrt(space.n), size=3 * space.n - 6)
            c = np.concatenate(
                [rng.normal(scale=10.0, size=3), angles[:1], rng.uniform(-1.4, 1.4, 1), angles[1:], bends]
            )
            p_W, yaw = space.inverse(c)
        else:
            spread_m = 1.5 if isinstance(space, NestedCluster) else 5.0
            start = space.inverse(space.specimen(2.0))[0] if isinstance(space, NestedCluster) else 0.0
            p_W, yaw = start + rng.normal(scale=spread_m, size=(space.n, 3)), rng.uniform(-math.pi, math.pi, space.n)
        if space.margin(space.forward(p_W, yaw)) > margin_min_m:
            return p_W, yaw


@pytest.mark.parametrize("kind", SPACES)
def test_forward_and_inverse_are_inverse_to_each_other(kind):
    space, rng = SPACES[kind](), np.random.default_rng(1)
    assert space.size == 4 * space.n == len(set(space.names))
    assert [space.index(name) for name in space.names] == list(range(space.size))
    for _ in range(200):
        p_W, yaw = random_robots(space, rng)
        c = space.forward(p_W, yaw)
        p_back_W, yaw_back = space.inverse(c)
        assert np.abs(p_back_W - p_W).max() < 1e-10
        assert np.abs(np.angle(np.exp(1j * (yaw_back - yaw)))).max() < 1e-10
        assert np.abs(space.difference(space.forward(p_back_W, yaw_back), c)).max() < 1e-9


@settings(deadline=None, max_examples=300, derandomize=True)
@given(st.data(), st.sampled_from(TRIADS))
def test_forward_of_inverse_returns_any_cluster(data, n):
    space = cluster_space(n)
    low, high = np.array(space.bounds).T
    lower = np.where(np.isfinite(low), low + 0.05, -100.0)
    upper = np.where(np.isfinite(high), high - 0.05, 100.0)
    lower[low == 0.0], upper[high == math.inf] = 0.05, 100.0
    lower[space.angular], upper[space.angular] = -math.pi, math.pi
    c = np.array([data.draw(st.floats(a, b)) for a, b in zip(lower, upper, strict=True)])
    back = space.forward(*space.inverse(c))
    # the shape is ill-conditioned if lengths differ by a factor of 1000 and beta is small
    assert np.abs(space.difference(back, c)).max() < 1e-6


@pytest.mark.parametrize("kind", SPACES)
def test_jacobians_are_inverse_to_each_other_and_agree_with_finite_differences(kind):
    space, rng = SPACES[kind](), np.random.default_rng(2)
    for _ in range(30):
        p_W, yaw = random_robots(space, rng, 1.0)
        c, J = space.forward(p_W, yaw), space.jacobian(p_W, yaw)
        assert np.abs(J @ space.inverse_jacobian(c) - np.eye(space.size)).max() < 1e-9
        move = rng.normal(size=(space.n, 4))
        after = space.forward(p_W + STEP * move[:, :3], yaw + STEP * move[:, 3])
        before = space.forward(p_W - STEP * move[:, :3], yaw - STEP * move[:, 3])
        c_dot = space.difference(after, before) / (2 * STEP)
        most = 1e-5 if isinstance(space, NestedCluster) else 1e-6
        assert np.abs(J @ move.ravel() - c_dot).max() < most
        v_W, yaw_rate = robot_rates(space, c, c_dot)
        assert np.abs(np.column_stack([v_W, yaw_rate]) - move).max() < most
        assert np.abs(space.motion(c, c_dot) - space.inverse_jacobian(c) @ c_dot).max() < 1e-10


@pytest.mark.parametrize("kind", [kind for kind in SPACES if "nested" not in kind])  # those have another origin
def test_the_cluster_moves_and_turns_as_one_body(kind):
    """Translation and rotation about z change only x_c, y_c, z_c and yaw."""
    space = SPACES[kind]()
    p_W, yaw = random_robots(space, np.random.default_rng(3))
    turn, shift = 0.7, np.array([3.0, -4.0, 5.0])
    R = np.array([(math.cos(turn), -math.sin(turn), 0), (math.sin(turn), math.cos(turn), 0), (0, 0, 1)])
    centre = p_W.mean(axis=0)
    moved = space.forward((p_W - centre) @ R.T + centre + shift, yaw + turn)
    expected = np.zeros(space.size)
    expected[:3], expected[space.index("yaw")] = shift, turn
    assert np.abs(space.difference(moved, space.forward(p_W, yaw)) - expected).max() < 1e-11


@pytest.mark.parametrize("kind", SPACES)
def test_the_specimen_keeps_the_minimum_distance(kind):
    space = SPACES[kind]()
    p_W, _ = space.inverse(space.specimen(2.0))
    assert closest_pair(p_W)[0] > 2.0 - 1e-9
    assert p_W[:, 2].min() > (-math.inf if isinstance(space, NestedCluster) else 1.0)


@pytest.mark.parametrize("kind", SPACES)
@pytest.mark.parametrize("value", [1.0, math.nan], ids=["one place", "nan"])
def test_robots_without_a_frame_are_refused(kind, value):
    space = SPACES[kind]()
    p_W, yaw = np.full((space.n, 3), value), np.zeros(space.n)
    for method in (space.forward, space.jacobian):
        with pytest.raises(SingularClusterError):
            method(p_W, yaw)
    if kind == "nested triads":  # a singular group suffices
        p_W, yaw = random_robots(space, np.random.default_rng(5))
        p_W[3:6] = p_W[3]
        with pytest.raises(SingularClusterError):
            space.forward(p_W, yaw)


@pytest.mark.parametrize(
    ("space", "method", "arguments", "terms"),
    [
        (cluster_space(3), "forward", (np.outer(np.arange(3.0), (1, 1, 1)), np.zeros(3)), ("robots 1, 2 and 3",)),
        (cluster_space(3), "inverse", (np.zeros(12),), ("no direction",)),
        (cluster_space(2), "forward", (np.ones((2, 3)), np.zeros(2)), ("robots 1 and 2",)),
        (cluster_space(2), "jacobian", (np.array([(0.0, 0, 0), (0, 0, 3)]), np.zeros(2)), ("above",)),
        (cluster_space(4), "jacobian", (np.vstack([TRIANGLE, TRIANGLE[0] + (0, 0, 3)]), np.zeros(4)), ("robot 4",)),
        (TemplateCluster(RING), "forward", (np.outer(np.arange(10.0), (1, 1, 1)), np.zeros(10)), ("no frame",)),
    ],
)
def test_singular_formations_are_refused_with_the_reason(space, method, arguments, terms):
    with refused(SingularClusterError, *terms):
        getattr(space, method)(*arguments)


@pytest.mark.parametrize(
    ("make", "finding"),
    [
        *[(lambda n=n: cluster_space(n), "2 to 64") for n in (0, 1, ROBOTS_MAX + 1)],
        (lambda: TemplateCluster(RING[:2]), "template: 2 "),
        (lambda: TemplateCluster(np.outer(range(6), (1, 2, 0))), "template: .*collinear"),
        (lambda: TemplateCluster(np.ones((5, 3))), "template: .*collinear"),
        (lambda: NestedCluster(cluster_space(3), [(name, cluster_space(3)) for name in "ab"]), "2; allowed: 3"),
        (lambda: cluster_space(3).index("gamma"), r"'gamma'.*x_c, y_c"),
    ],
)
def test_impossible_spaces_and_names_are_refused(make, finding):
    with pytest.raises(ValueError, match=finding):
        make()


# Names and their meaning


def test_small_clusters_have_the_variables_of_the_paper_in_order():
    names = ["x_c", "y_c", "z_c", "roll", "pitch", "yaw", "phi_1", "phi_2", "phi_3", "p", "q", "beta"]
    assert list(cluster_space(3).names) == names
    wrapping = [name for name, wraps in zip(names, cluster_space(3).angular, strict=True) if wraps]
    assert wrapping == ["roll", "yaw", "phi_1", "phi_2", "phi_3"]
    assert cluster_space(4).names[-3:] == ("rho_4", "azimuth_4", "elevation_4")
    assert cluster_space(2).names == ("x_c", "y_c", "z_c", "pitch", "yaw", "phi_1", "phi_2", "p")


def test_a_template_has_headings_and_deformations():
    space = TemplateCluster(RING)
    assert space.names[:8] == ("x_c", "y_c", "z_c", "roll", "pitch", "yaw", "phi_1", "phi_2")
    assert (*space.names[16:18], space.names[-1]) == ("w_1", "w_2", "w_24")
    wrapping = {name.rstrip("0123456789") for name, wraps in zip(space.names, space.angular, strict=True) if wraps}
    assert wrapping == {"roll", "yaw", "phi_"}
    assert [space.names[k] for k in space.tilts] == ["roll", "pitch"]


def test_nested_names_are_of_the_parent_then_of_the_groups():
    space, plain = triads(), cluster_space(3)
    own = ("roll", "pitch", "phi_1", "phi_2", "phi_3", "p", "q", "beta")
    assert space.names == (*plain.names, *(f"{name}.{each}" for name in ("lead", "left", "right") for each in own))
    for name in ("roll", "pitch", "phi_2", "beta", "q"):  # the kind of a variable does not depend on its group
        k, nested = plain.index(name), space.index(f"left.{name}")
        for attribute in ("angular", "in_radians", "neutral"):
            assert getattr(space, attribute)[nested] == getattr(plain, attribute)[k]
        assert (space.bounds[nested] == plain.bounds[k]).all()
    assert [space.names[k] for k in space.tilts][:4] == ["roll", "pitch", "lead.roll", "lead.pitch"]
    assert len(mixed().tilts) == 2 + 1 + 2 + 2 + 8  # a pair has no roll


def test_units_follow_from_names_in_any_space():
    lengths = ["x_c", "y_c", "z_c", "p", "q", "rho_4", "w_12", "left.p", "a.w_1", "a.b.rho_5"]
    angles = ["roll", "pitch", "yaw", "phi_1", "beta", "azimuth_4", "elevation_4", "left.beta", "p.phi_2", "w.roll"]
    assert {unit(name) for name in lengths} == {"m"}
    assert {unit(name) for name in angles} == {"rad"}


def test_roll_lowers_the_right_side_and_pitch_lowers_robot_1():
    space = cluster_space(3)
    assert space.forward(TRIANGLE, np.zeros(3))[3:6] == pytest.approx([0.0, 0.0, math.pi / 2])
    assert abs(space.forward(TRIANGLE[[0, 2, 1]], np.zeros(3))[3]) == pytest.approx(math.pi)
    c = np.array([0, 0, 10, 0.1, 0, 0, 0, 0, 0, 4, 4, 0.8])
    z = space.inverse(c)[0][:, 2]
    assert z[1] > z[0] > z[2]
    c[3:5] = 0.0, 0.1
    z = space.inverse(c)[0][:, 2]
    assert z[0] < z[1] == pytest.approx(z[2])


def test_the_template_has_zero_deformation_and_w_1_scales_it():
    space = TemplateCluster(RING + np.array([7.0, -3.0, 2.0]))
    c = space.forward(RING + np.array([1.0, 2.0, 3.0]), np.zeros(10))
    expected = np.zeros(40)
    expected[:3] = 1.0, 2.0, 3.0
    assert np.abs(c - expected).max() < 1e-14
    expected[space.index("w_1")] = 1.5
    assert np.abs(space.inverse(expected)[0] - (RING * 7.5 / 6.0 + (1.0, 2.0, 3.0))).max() < 1e-13


@pytest.mark.parametrize("n", TEMPLATES)
def test_shape_modes_are_orthogonal_to_rigid_motions_and_each_other(n):
    t = centred(np.random.default_rng(n).normal(size=(n, 3)))
    N = shape_modes(t).reshape(3 * n, -1)
    assert np.abs(N.T @ N - n * np.eye(3 * n - 6)).max() < 1e-12
    assert np.abs(turns(t).reshape(3, -1) @ N).max() < 1e-12
    assert np.abs(N.reshape(n, 3, -1).sum(axis=0)).max() < 1e-12
    for axis in np.eye(3) if n > 3 else ():  # stretching along an axis is a combination of the first three modes
        assert np.abs(N.T[3:] @ (t * axis).ravel()).max() < 1e-11


def test_no_robot_of_a_template_is_privileged():
    """Renumbering robots and template alike changes neither position nor orientation of the formation."""
    rng = np.random.default_rng(5)
    places = rng.normal(scale=4.0, size=(10, 3))
    p_W, order = places + rng.normal(scale=0.5, size=(10, 3)), rng.permutation(10)
    c = TemplateCluster(places).forward(p_W, np.zeros(10))
    other = TemplateCluster(places[order]).forward(p_W[order], np.zeros(10))
    assert np.abs(c[:6] - other[:6]).max() < 1e-13
    assert np.linalg.norm(c[16:]) == pytest.approx(np.linalg.norm(other[16:]))
    t = centred(places)
    _, R = fitted_rotation(t.T @ (t * (1.0, 1.0, -1.0)))  # a reflection is fitted by a rotation, not by a reflection
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_the_parent_is_formed_by_the_groups_centroids_and_headings():
    space, rng = triads(), np.random.default_rng(4)
    p_W, yaw = random_robots(space, rng)
    c = space.forward(p_W, yaw)
    own = [cluster_space(3).forward(p_W[k : k + 3], yaw[k : k + 3]) for k in (0, 3, 6)]
    parent = cluster_space(3).forward(np.array([part[:3] for part in own]), np.array([part[5] for part in own]))
    assert (c[:12] == parent).all()
    assert (space.inverse(c)[0].reshape(3, 3, 3).mean(axis=1) - [part[:3] for part in own]).max() < 1e-12
    assert c[space.index("right.p")] == np.linalg.norm(p_W[7] - p_W[6])


def test_the_heading_of_a_group_turns_only_that_group():
    space = triads()
    c, c_dot = space.specimen(2.0), np.zeros(space.size)
    c_dot[space.index("phi_2")] = 0.3
    r_dot = space.motion(c, c_dot).reshape(9, 4)
    assert np.abs(r_dot[[0, 1, 2, 6, 7, 8]]).max() < 1e-12
    p_W = space.inverse(c)[0][3:6]
    arm = p_W - p_W.mean(axis=0)
    turning = np.column_stack([-0.3 * arm[:, 1], 0.3 * arm[:, 0], np.zeros(3), np.full(3, 0.3)])
    assert np.abs(r_dot[3:6] - turning).max() < 1e-12


def test_differences_of_wrapping_angles_are_the_shortest():
    space = cluster_space(3)
    a, b = np.zeros(12), np.zeros(12)
    a[5], b[5] = 3.0, -3.0  # yaw
    a[0], b[0] = 30.0, -30.0  # x_c is not an angle
    difference = space.difference(a, b)
    assert difference[[0, 5]] == pytest.approx([60.0, 6.0 - 2 * math.pi])
    assert space.wrapped(np.full(12, 7.0))[5] == pytest.approx(7.0 - 2 * math.pi)
    table = np.random.default_rng(4).normal(scale=20.0, size=(50, 12))
    assert space.wrapped(table).tolist() == [space.wrapped(row).tolist() for row in table]


# Measures of singularity


def test_the_margin_is_zero_at_each_singularity():
    space = cluster_space(3)
    good = np.array([0, 0, 10, 0, 0, 0, 0, 0, 0, 4.0, 4.0, math.pi / 2])
    assert space.margin(good) == pytest.approx(4.0)
    for name, value in (("p", 0.0), ("q", 0.0), ("beta", 0.0), ("beta", math.pi), ("pitch", math.pi / 2)):
        c = good.copy()
        c[space.index(name)] = value
        assert space.margin(c) == pytest.approx(0.0, abs=1e-12), name
    c = np.concatenate([good[:9], [0.0], good[9:], [3.0, 1.0, math.pi / 2]])
    assert cluster_space(4).margin(c) == pytest.approx(0.0, abs=1e-12)


def test_the_condition_depends_on_neither_size_nor_number_of_robots():
    space = cluster_space(3)
    c = [np.array([0, 0, 10, 0, 0, 0, 0, 0, 0, length, length, math.pi / 4]) for length in (4.0, 40.0)]
    assert space.condition(c[0]) == pytest.approx(space.condition(c[1]))
    small, large = TemplateCluster(RING), TemplateCluster(10 * RING)
    assert small.condition(np.zeros(40)) == pytest.approx(large.condition(np.zeros(40)))
    turns_of_60 = np.linspace(0.0, 2 * math.pi, 60, endpoint=False)
    many = TemplateCluster(6 * np.column_stack([np.cos(turns_of_60), np.sin(turns_of_60), np.zeros(60)]))
    assert many.condition(np.zeros(240)) == pytest.approx(small.condition(np.zeros(40)))


@pytest.mark.parametrize("n", TEMPLATES)
def test_the_condition_of_a_template_is_that_of_the_weighted_matrix(n):
    rng, judged = np.random.default_rng(30 + n), 0
    for _ in range(10):
        space = TemplateCluster(rng.normal(scale=1.0, size=(n, 3)))
        c = np.concatenate([np.zeros(3), rng.uniform(-1.0, 1.0, 3 + n), rng.normal(0, 0.5 / math.sqrt(n), 3 * n - 6)])
        p_W = space.inverse(c)[0]
        if space.margin(c) > 0.2 and np.linalg.norm(p_W - p_W.mean(axis=0), axis=1).max() < 4.0:
            measure = np.ones(4 * n)
            measure[6 : 6 + n] = math.sqrt(n)
            assert space.condition(c) == pytest.approx(np.linalg.cond(space.inverse_jacobian(c) * measure), rel=1e-9)
            judged += 1
    assert judged


def test_the_spread_falls_to_zero_as_the_robots_approach_a_line():
    places = np.array([(3.0, 0, 0), (-3, 0, 0), (0, 2, 0), (0, -2, 0), (1, 0, 0), (-1, 0, 0)])
    space, widths = TemplateCluster(places), (1.0, 0.5, 0.1, 1e-3)
    spreads = [space.spread(space.forward(places * (1.0, width, 1.0), np.zeros(6))) / width for width in widths]
    assert spreads == pytest.approx([math.sqrt(8 / 6)] * 4, rel=1e-9)


def test_the_jacobian_is_singular_where_the_template_is():
    """As the robots approach a line, the smallest singular value of J^-1 approaches sqrt(n) margin."""
    space = TemplateCluster(RING)
    flat = space.forward(RING * (1.0, 1e-4, 1.0), np.zeros(10))
    assert space.margin(flat) == pytest.approx(1e-4 * 6 / math.sqrt(2), rel=1e-6)
    least = np.linalg.svd(space.inverse_jacobian(flat), compute_uv=False)[-1]
    assert least == pytest.approx(math.sqrt(10) * space.margin(flat), rel=1e-3)
    upright = np.zeros(40)
    upright[4] = math.pi / 2
    assert space.margin(upright) == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.svd(space.inverse_jacobian(upright), compute_uv=False)[-1] < 1e-12


def test_a_nested_measure_is_the_least_of_parent_and_groups():
    space = triads()
    c = space.specimen(2.0)
    wide = space.spread(c)
    c[space.index("left.p")] = 0.5
    assert space.spread(c) == pytest.approx(0.5 * math.sin(c[space.index("left.beta")]))
    assert space.spread(c) < wide
    c[space.index("left.pitch")] = 1.2
    assert space.margin(c) == pytest.approx(space.spread(c) * math.cos(1.2))
    c[space.index("q")] = 0.01
    assert space.spread(c) < 0.011
    for name, value in (("left.p", 0.0), ("left.beta", 0.0), ("right.pitch", math.pi / 2), ("q", 0.0), ("beta", 0.0)):
        c = space.specimen(2.0)
        c[space.index(name)] = value
        assert space.margin(c) == pytest.approx(0.0, abs=1e-12), name
        assert np.linalg.svd(space.inverse_jacobian(c), compute_uv=False)[-1] < 1e-12, name


@pytest.mark.parametrize("n", TRIADS)
def test_the_closest_pair_is_the_first_with_the_least_finite_distance(n):
    rng = np.random.default_rng(n)
    for _ in range(100):
        p_W = rng.integers(-2, 3, size=(n, 3)).astype(float)  # many pairs are equally close
        p_W[rng.integers(n), 0] = rng.choice([0.0, math.nan, math.inf, 1e6])
        pairs = [(math.sqrt(((p_W[i] - p_W[j]) ** 2).sum()), i, j) for i in range(n) for j in range(i + 1, n)]
        assert closest_pair(p_W) == min((pair for pair in pairs if math.isfinite(pair[0])), default=(math.inf, 0, 1))
