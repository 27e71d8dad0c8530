"""Clusters of clusters: the parent moves its groups as its robots, and the whole is exact."""

import math

import numpy as np
import pytest

from zsim_agents.formation.spaces.cluster_space import SingularClusterError
from zsim_agents.formation.spaces.scenario_space import NestedCluster, cluster_space
from zsim_agents.formation.spaces.template_cluster import TemplateCluster

SQUARE = np.array([(2.0, 2.0, 0.0), (-2.0, 2.0, 0.0), (-2.0, -2.0, 0.0), (2.0, -2.0, 0.0)])
PENTAGON = 8.0 * np.array([(math.cos(k * 0.4 * math.pi), math.sin(k * 0.4 * math.pi), 0.0) for k in range(5)])


def triads():
    """Three groups of three."""
    return NestedCluster(cluster_space(3), [(name, cluster_space(3)) for name in ("lead", "left", "right")])


def mixed():
    """A pair, a triad, a square on a template, and three triads, on a parent of four."""
    groups = [cluster_space(2), cluster_space(3), TemplateCluster(SQUARE), triads()]
    return NestedCluster(cluster_space(4), list(zip("abcd", groups, strict=True)))


def templates():
    """Five squares on a pentagon."""
    return NestedCluster(TemplateCluster(PENTAGON), [(name, TemplateCluster(SQUARE)) for name in "abcde"])


SPACES = {"triads": triads, "mixed": mixed, "templates": templates}


def random_robots(space, rng, margin_min_m=0.3):
    while True:
        p_W = space.inverse(space.specimen(2.0))[0] + rng.normal(scale=1.5, size=(space.n, 3))
        yaw = rng.uniform(-math.pi, math.pi, space.n)
        if space.margin(space.forward(p_W, yaw)) > margin_min_m:
            return p_W, yaw


@pytest.mark.parametrize("kind", SPACES)
def test_forward_and_inverse_undo_each_other(kind):
    space, rng = SPACES[kind](), np.random.default_rng(1)
    for _ in range(200):
        p_W, yaw = random_robots(space, rng)
        c = space.forward(p_W, yaw)
        p_back_W, yaw_back = space.inverse(c)
        assert np.abs(p_back_W - p_W).max() < 1e-9
        assert np.abs(np.angle(np.exp(1j * (yaw_back - yaw)))).max() < 1e-10
        assert np.abs(space.difference(space.forward(p_back_W, yaw_back), c)).max() < 1e-9


@pytest.mark.parametrize("kind", SPACES)
def test_jacobians_are_inverse_to_each_other_and_agree_with_finite_differences(kind):
    space, rng, step = SPACES[kind](), np.random.default_rng(2), 1e-6
    for _ in range(30):
        p_W, yaw = random_robots(space, rng, 1.0)
        c, J = space.forward(p_W, yaw), space.jacobian(p_W, yaw)
        assert np.abs(J @ space.inverse_jacobian(c) - np.eye(space.size)).max() < 1e-9
        move = rng.normal(size=(space.n, 4))
        after = space.forward(p_W + step * move[:, :3], yaw + step * move[:, 3])
        before = space.forward(p_W - step * move[:, :3], yaw - step * move[:, 3])
        c_dot = space.difference(after, before) / (2 * step)
        assert np.abs(J @ move.ravel() - c_dot).max() < 1e-5
        assert np.abs(space.motion(c, c_dot) - move.ravel()).max() < 1e-5


@pytest.mark.parametrize("kind", SPACES)
def test_the_short_way_to_the_robots_rates_is_that_of_the_matrix(kind):
    space, rng = SPACES[kind](), np.random.default_rng(3)
    c, c_dot = space.forward(*random_robots(space, rng)), rng.normal(size=space.size)
    assert np.abs(space.motion(c, c_dot) - space.inverse_jacobian(c) @ c_dot).max() < 1e-10


def test_names_are_those_of_the_parent_then_those_of_the_groups_by_name():
    space = triads()
    parent = cluster_space(3).names
    own = ("roll", "pitch", "phi_1", "phi_2", "phi_3", "p", "q", "beta")
    groups = [f"{name}.{variable}" for name in ("lead", "left", "right") for variable in own]
    assert space.names == (*parent, *groups)
    assert (space.n, space.size) == (9, 36)


def test_what_a_variable_is_does_not_depend_on_its_group():
    space, plain = triads(), cluster_space(3)
    for name in ("roll", "pitch", "phi_2", "beta", "q"):
        k, own = plain.index(name), space.index(f"left.{name}")
        assert space.angular[own] == plain.angular[k]
        assert space.in_radians[own] == plain.in_radians[k]
        assert space.neutral[own] == plain.neutral[k]
        assert (space.bounds[own] == plain.bounds[k]).all()
    assert [space.names[k] for k in space.tilts][:4] == ["roll", "pitch", "lead.roll", "lead.pitch"]
    assert len(mixed().tilts) == 2 + 1 + 2 + 2 + 8  # a pair has no roll


def test_the_parent_has_the_groups_centroids_and_headings():
    space, rng = triads(), np.random.default_rng(4)
    p_W, yaw = random_robots(space, rng)
    c = space.forward(p_W, yaw)
    own = [cluster_space(3).forward(p_W[k : k + 3], yaw[k : k + 3]) for k in (0, 3, 6)]
    parent = cluster_space(3).forward(np.array([part[:3] for part in own]), np.array([part[5] for part in own]))
    assert (c[:12] == parent).all()
    assert (space.inverse(c)[0].reshape(3, 3, 3).mean(axis=1) - [part[:3] for part in own]).max() < 1e-12
    assert c[space.index("right.p")] == np.linalg.norm(p_W[7] - p_W[6])


def test_a_heading_of_a_group_turns_the_group_and_nothing_else():
    space = triads()
    c = space.specimen(2.0)
    c_dot = np.zeros(space.size)
    c_dot[space.index("phi_2")] = 0.3
    r_dot = space.motion(c, c_dot).reshape(9, 4)
    assert np.abs(r_dot[[0, 1, 2, 6, 7, 8]]).max() < 1e-12
    p_W = space.inverse(c)[0][3:6]
    arm = p_W - p_W.mean(axis=0)
    turning = np.column_stack([-0.3 * arm[:, 1], 0.3 * arm[:, 0], np.zeros(3), np.full(3, 0.3)])
    assert np.abs(r_dot[3:6] - turning).max() < 1e-12


def test_the_least_of_parent_and_groups_is_the_measure():
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


def test_the_whole_is_singular_where_a_group_is():
    space = triads()
    for name, value in (("left.p", 0.0), ("left.beta", 0.0), ("right.pitch", math.pi / 2), ("q", 0.0), ("beta", 0.0)):
        c = space.specimen(2.0)
        c[space.index(name)] = value
        assert space.margin(c) == pytest.approx(0.0, abs=1e-12), name
        assert np.linalg.svd(space.inverse_jacobian(c), compute_uv=False)[-1] < 1e-12, name


def test_robots_without_a_frame_are_refused_in_any_group():
    space = triads()
    p_W, yaw = random_robots(space, np.random.default_rng(5))
    p_W[3:6] = p_W[3]
    with pytest.raises(SingularClusterError):
        space.forward(p_W, yaw)


def test_the_number_of_groups_must_fit_their_parent():
    with pytest.raises(ValueError, match="2; allowed: 3"):
        NestedCluster(cluster_space(3), [("a", cluster_space(3)), ("b", cluster_space(3))])
