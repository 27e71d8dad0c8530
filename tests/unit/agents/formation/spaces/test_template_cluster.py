"""The cluster of many robots on a template: round trips, Jacobians, its measure of singularity."""

import math

import numpy as np
import pytest

from zsim_agents.formation.spaces.cluster_space import SingularClusterError, robot_rates
from zsim_agents.formation.spaces.template_cluster import TemplateCluster, centred, fitted_rotation, shape_modes, turns

SIZES = (3, 5, 10, 30)
RING = np.array([(6 * math.cos(k * math.pi / 5), 6 * math.sin(k * math.pi / 5), 0.0) for k in range(10)])


def random_template(n, rng, flat=False):
    places = rng.normal(scale=4.0, size=(n, 3))
    places[:, 2] *= 0.0 if flat else 1.0
    return TemplateCluster(places)


def random_robots(space, rng, margin_min_m=0.5, bend_m=1.5):
    """Return robots around the template, anyhow placed and turned, that are not nearly singular."""
    while True:
        c = np.concatenate(
            [
                rng.normal(scale=10.0, size=3),
                rng.uniform(-math.pi, math.pi, 1),
                rng.uniform(-1.4, 1.4, 1),
                rng.uniform(-math.pi, math.pi, 1 + space.n),
                rng.normal(scale=bend_m / math.sqrt(space.n), size=3 * space.n - 6),
            ]
        )
        if space.margin(c) > margin_min_m:
            return space.inverse(c), c


@pytest.mark.parametrize("flat", [True, False], ids=["plane", "space"])
@pytest.mark.parametrize("n", SIZES)
def test_forward_and_inverse_undo_each_other(n, flat):
    rng = np.random.default_rng(n)
    space = random_template(n, rng, flat)
    for _ in range(300):
        (p_W, yaw), c = random_robots(space, rng)
        back = space.forward(p_W, yaw)
        assert np.abs(space.difference(back, c)).max() < 1e-10
        assert np.abs(space.inverse(back)[0] - p_W).max() < 1e-11


@pytest.mark.parametrize("n", SIZES)
def test_jacobians_are_inverse_to_each_other_and_agree_with_finite_differences(n):
    rng, step = np.random.default_rng(10 + n), 1e-6
    space = random_template(n, rng)
    for _ in range(30):
        (p_W, yaw), c = random_robots(space, rng)
        J = space.jacobian(p_W, yaw)
        assert np.abs(J @ space.inverse_jacobian(c) - np.eye(4 * n)).max() < 1e-10
        move = rng.normal(size=(n, 4))
        after = space.forward(p_W + step * move[:, :3], yaw + step * move[:, 3])
        before = space.forward(p_W - step * move[:, :3], yaw - step * move[:, 3])
        c_dot = space.difference(after, before) / (2 * step)
        assert np.abs(J @ move.ravel() - c_dot).max() < 1e-6
        v_W, yaw_rate = robot_rates(space, c, c_dot)
        assert np.abs(v_W - move[:, :3]).max() < 1e-6
        assert np.abs(yaw_rate - move[:, 3]).max() < 1e-6


@pytest.mark.parametrize("n", SIZES)
def test_the_short_way_to_the_robots_rates_is_that_of_the_matrix(n):
    rng = np.random.default_rng(20 + n)
    space = random_template(n, rng)
    _, c = random_robots(space, rng)
    c_dot = rng.normal(size=4 * n)
    assert np.abs(space.motion(c, c_dot) - space.inverse_jacobian(c) @ c_dot).max() < 1e-12


def test_names_are_as_many_as_robot_variables():
    space = TemplateCluster(RING)
    assert space.size == 40 == len(set(space.names))
    assert space.names[:8] == ("x_c", "y_c", "z_c", "roll", "pitch", "yaw", "phi_1", "phi_2")
    assert space.names[16:18] == ("w_1", "w_2")
    assert space.names[-1] == "w_24"
    wrapping = {name.rstrip("0123456789") for name, wraps in zip(space.names, space.angular, strict=True) if wraps}
    assert wrapping == {"roll", "yaw", "phi_"}
    assert [space.names[k] for k in space.tilts] == ["roll", "pitch"]


def test_the_template_itself_has_no_departures_and_w_1_is_its_growth():
    space = TemplateCluster(RING + np.array([7.0, -3.0, 2.0]))
    c = space.forward(RING + np.array([1.0, 2.0, 3.0]), np.zeros(10))
    expected = np.zeros(40)
    expected[:3] = 1.0, 2.0, 3.0
    assert np.abs(c - expected).max() < 1e-14
    expected[space.index("w_1")] = 1.5
    assert np.abs(space.inverse(expected)[0] - (RING * 7.5 / 6.0 + (1.0, 2.0, 3.0))).max() < 1e-13


def test_stretches_come_after_growth_and_shears_after_those():
    places = np.random.default_rng(3).normal(size=(8, 3)) * (5.0, 3.0, 2.0)
    space = TemplateCluster(places)
    t = space.t_C
    for axis in np.eye(3):  # each stretch of an axis is made of the first three modes
        stretch = (t * axis).ravel()
        assert np.abs(space.modes_C.reshape(24, 18).T[3:] @ stretch).max() < 1e-12


@pytest.mark.parametrize("n", SIZES)
def test_modes_neither_move_nor_turn_the_template_and_are_orthogonal(n):
    t = centred(np.random.default_rng(n).normal(size=(n, 3)))
    N = shape_modes(t).reshape(3 * n, -1)
    assert np.abs(N.T @ N - n * np.eye(3 * n - 6)).max() < 1e-12
    assert np.abs(turns(t).reshape(3, -1) @ N).max() < 1e-12
    assert np.abs(N.reshape(n, 3, -1).sum(axis=0)).max() < 1e-12


def test_the_cluster_moves_and_turns_as_one_body():
    rng = np.random.default_rng(4)
    space = random_template(10, rng)
    (p_W, yaw), c = random_robots(space, rng)
    turn, shift = 0.7, np.array([3.0, -4.0, 5.0])
    R = np.array([(math.cos(turn), -math.sin(turn), 0), (math.sin(turn), math.cos(turn), 0), (0, 0, 1)])
    centre = p_W.mean(axis=0)
    moved = space.forward((p_W - centre) @ R.T + centre + shift, yaw + turn)
    expected = np.zeros(40)
    expected[:3], expected[5] = shift, turn
    assert np.abs(space.difference(moved, c) - expected).max() < 1e-11


def test_no_robot_is_privileged():
    """Renumbering robots and template alike changes none of where the formation is and how it is turned."""
    rng = np.random.default_rng(5)
    places = rng.normal(scale=4.0, size=(10, 3))
    p_W, order = places + rng.normal(scale=0.5, size=(10, 3)), rng.permutation(10)
    c = TemplateCluster(places).forward(p_W, np.zeros(10))
    other = TemplateCluster(places[order]).forward(p_W[order], np.zeros(10))
    assert np.abs(c[:6] - other[:6]).max() < 1e-13
    assert np.linalg.norm(c[16:]) == pytest.approx(np.linalg.norm(other[16:]))


@pytest.mark.parametrize(
    "p_W",
    [np.zeros((10, 3)), np.outer(np.arange(10.0), (1, 1, 1)), np.full((10, 3), math.nan)],
    ids=["one place", "one line", "nan"],
)
def test_robots_without_a_frame_are_refused(p_W):
    space = TemplateCluster(RING)
    with pytest.raises(SingularClusterError, match="no frame"):
        space.forward(p_W, np.zeros(10))
    with pytest.raises(SingularClusterError, match="no frame"):
        space.jacobian(p_W, np.zeros(10))


@pytest.mark.parametrize(
    ("places", "finding"),
    [(RING[:2], "2 places; allowed: 3"), (np.outer(range(6), (1, 2, 0)), "one line"), (np.ones((5, 3)), "one line")],
)
def test_a_template_without_width_is_refused(places, finding):
    with pytest.raises(ValueError, match=finding):
        TemplateCluster(places)


def test_the_spread_falls_to_zero_where_the_robots_come_into_line():
    places = np.array([(3.0, 0, 0), (-3, 0, 0), (0, 2, 0), (0, -2, 0), (1, 0, 0), (-1, 0, 0)])
    space = TemplateCluster(places)
    spreads = []
    for width in (1.0, 0.5, 0.1, 1e-3):
        c = space.forward(places * (1.0, width, 1.0), np.zeros(6))
        spreads.append(space.spread(c) / width)
    assert spreads == pytest.approx([math.sqrt(8 / 6)] * 4, rel=1e-9)


def test_where_the_formation_is_singular_so_are_its_jacobians():
    """Towards a line the smallest singular value of J^-1 is the margin, counted over all robots: sqrt(n) margin."""
    space = TemplateCluster(RING)
    flat = space.forward(RING * (1.0, 1e-4, 1.0), np.zeros(10))
    assert space.margin(flat) == pytest.approx(1e-4 * 6 / math.sqrt(2), rel=1e-6)
    least = np.linalg.svd(space.inverse_jacobian(flat), compute_uv=False)[-1]
    assert least == pytest.approx(math.sqrt(10) * space.margin(flat), rel=1e-3)
    upright = np.zeros(40)
    upright[4] = math.pi / 2
    assert space.margin(upright) == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.svd(space.inverse_jacobian(upright), compute_uv=False)[-1] < 1e-12


@pytest.mark.parametrize("n", SIZES)
def test_the_condition_is_that_of_the_whole_matrix_in_its_measure(n):
    rng = np.random.default_rng(30 + n)
    for _ in range(10):
        space = TemplateCluster(rng.normal(scale=1.0, size=(n, 3)))
        (p_W, _), c = random_robots(space, rng, margin_min_m=0.2, bend_m=0.5)
        if np.linalg.norm(p_W - p_W.mean(axis=0), axis=1).max() > 4.0:
            continue
        measure = np.ones(4 * n)
        measure[6 : 6 + n] = math.sqrt(n)
        assert space.condition(c) == pytest.approx(np.linalg.cond(space.inverse_jacobian(c) * measure), rel=1e-9)


def test_neither_size_nor_number_of_robots_make_the_condition_worse():
    small, large = TemplateCluster(RING), TemplateCluster(10 * RING)
    assert small.condition(np.zeros(40)) == pytest.approx(large.condition(np.zeros(40)))
    turns_of_60 = np.linspace(0.0, 2 * math.pi, 60, endpoint=False)
    many = TemplateCluster(6 * np.column_stack([np.cos(turns_of_60), np.sin(turns_of_60), np.zeros(60)]))
    assert many.condition(np.zeros(240)) == pytest.approx(small.condition(np.zeros(40)))


@pytest.mark.parametrize("n", SIZES)
def test_a_specimen_is_a_formation_with_room(n):
    space = random_template(n, np.random.default_rng(40 + n))
    p_W, _ = space.inverse(space.specimen(2.0))
    assert np.linalg.norm(p_W[:, None] - p_W, axis=2)[np.triu_indices(n, 1)].min() > 2.0 - 1e-9
    assert p_W[:, 2].min() > 1.0


# The rotation that fits best


def test_a_reflection_is_not_answered_by_a_reflection():
    t = centred(np.random.default_rng(7).normal(size=(6, 3)))
    _, R = fitted_rotation(t.T @ (t * (1.0, 1.0, -1.0)))
    assert np.linalg.det(R) == pytest.approx(1.0)
