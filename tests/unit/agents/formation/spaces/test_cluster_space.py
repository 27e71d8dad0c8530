"""Cluster space: round trips, Jacobians against finite differences, singular shapes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsim.scenario.scenario import ROBOTS_MAX
from zsim_agents.formation.spaces.cluster_space import SingularClusterError, closest_pair, robot_rates, unit
from zsim_agents.formation.spaces.scenario_space import cluster_space

SIZES = (2, 3, 4, 5, 8)
TRIANGLE = np.array([(0.0, 1.5, 1.0), (-1.5, -1.5, 1.0), (1.5, -1.5, 1.0)])  # where the drones take off


def random_robots(n, rng, margin_min_m=0.2):
    """Return positions and headings of robots that are not nearly singular."""
    space = cluster_space(n)
    while True:
        p_W, yaw = rng.normal(scale=5.0, size=(n, 3)), rng.uniform(-math.pi, math.pi, n)
        if space.margin(space.forward(p_W, yaw)) > margin_min_m:
            return p_W, yaw


def turned(a, b):
    """Return the difference of headings on the circle."""
    return np.angle(np.exp(1j * (a - b)))


@pytest.mark.parametrize("n", SIZES)
def test_names_are_unique_and_as_many_as_robot_variables(n):
    space = cluster_space(n)
    assert space.size == 4 * n == len(space.names) == len(set(space.names))
    assert [space.index(name) for name in space.names] == list(range(4 * n))
    assert space.forward(*random_robots(n, np.random.default_rng(1))).shape == (4 * n,)


def test_three_robots_have_the_variables_of_the_paper_in_its_order():
    names = ["x_c", "y_c", "z_c", "roll", "pitch", "yaw", "phi_1", "phi_2", "phi_3", "p", "q", "beta"]
    assert list(cluster_space(3).names) == names
    wrapping = [name for name, wraps in zip(names, cluster_space(3).angular, strict=True) if wraps]
    assert wrapping == ["roll", "yaw", "phi_1", "phi_2", "phi_3"]


def test_further_robots_add_distance_azimuth_and_elevation():
    assert cluster_space(4).names[-3:] == ("rho_4", "azimuth_4", "elevation_4")
    assert cluster_space(2).names == ("x_c", "y_c", "z_c", "pitch", "yaw", "phi_1", "phi_2", "p")


@pytest.mark.parametrize("n", SIZES)
def test_forward_then_inverse_returns_the_robots(n):
    rng, space = np.random.default_rng(n), cluster_space(n)
    for _ in range(1000):
        p_W, yaw = random_robots(n, rng)
        p_back_W, yaw_back = space.inverse(space.forward(p_W, yaw))
        assert np.abs(p_back_W - p_W).max() < 1e-11
        assert np.abs(turned(yaw_back, yaw)).max() < 1e-12


@settings(deadline=None, max_examples=300, derandomize=True)
@given(st.data(), st.sampled_from(SIZES))
def test_inverse_then_forward_returns_the_cluster(data, n):
    space = cluster_space(n)
    low, high = np.array(space.bounds).T
    lower = np.where(np.isfinite(low), low + 0.05, -100.0)
    upper = np.where(np.isfinite(high), high - 0.05, 100.0)
    lower[low == 0.0], upper[high == math.inf] = 0.05, 100.0
    lower[space.angular], upper[space.angular] = -math.pi, math.pi
    c = np.array([data.draw(st.floats(a, b)) for a, b in zip(lower, upper, strict=True)])
    back = space.forward(*space.inverse(c))
    # the shape is ill-conditioned where lengths differ by 1000 and beta is small
    assert np.abs(space.difference(back, c)).max() < 1e-6


@pytest.mark.parametrize("n", SIZES)
def test_jacobians_are_inverse_to_each_other(n):
    rng, space = np.random.default_rng(10 + n), cluster_space(n)
    for _ in range(300):
        p_W, yaw = random_robots(n, rng)
        product = space.jacobian(p_W, yaw) @ space.inverse_jacobian(space.forward(p_W, yaw))
        assert np.abs(product - np.eye(4 * n)).max() < 1e-9


@pytest.mark.parametrize("n", SIZES)
def test_jacobians_agree_with_finite_differences(n):
    rng, space, step = np.random.default_rng(20 + n), cluster_space(n), 1e-6
    for _ in range(50):
        p_W, yaw = random_robots(n, rng, margin_min_m=1.0)
        move = rng.normal(size=(n, 4))
        after = space.forward(p_W + step * move[:, :3], yaw + step * move[:, 3])
        before = space.forward(p_W - step * move[:, :3], yaw - step * move[:, 3])
        c_dot = space.difference(after, before) / (2 * step)
        assert np.abs(space.jacobian(p_W, yaw) @ move.ravel() - c_dot).max() < 1e-6
        v_W, yaw_rate = robot_rates(space, space.forward(p_W, yaw), c_dot)
        assert np.abs(v_W - move[:, :3]).max() < 1e-6
        assert np.abs(yaw_rate - move[:, 3]).max() < 1e-6


@pytest.mark.parametrize("n", SIZES)
def test_the_cluster_moves_and_turns_as_one_body(n):
    """Translation and a turn about z change x_c, y_c, z_c and yaw alone."""
    space = cluster_space(n)
    p_W, yaw = random_robots(n, np.random.default_rng(30 + n))
    turn, shift = 0.7, np.array([3.0, -4.0, 5.0])
    R = np.array([(math.cos(turn), -math.sin(turn), 0), (math.sin(turn), math.cos(turn), 0), (0, 0, 1)])
    centre = p_W.mean(axis=0)
    moved = space.forward((p_W - centre) @ R.T + centre + shift, yaw + turn)
    expected = np.zeros(4 * n)
    expected[:3], expected[space.index("yaw")] = shift, turn
    assert np.abs(space.difference(moved, space.forward(p_W, yaw)) - expected).max() < 1e-12


def test_robot_2_is_left_and_robot_3_right_of_robot_1():
    c = cluster_space(3).forward(TRIANGLE, np.zeros(3))
    assert c[3:6] == pytest.approx([0.0, 0.0, math.pi / 2])
    mirrored = cluster_space(3).forward(TRIANGLE[[0, 2, 1]], np.zeros(3))
    assert abs(mirrored[3]) == pytest.approx(math.pi)


def test_roll_lowers_the_right_and_pitch_lowers_robot_1():
    space = cluster_space(3)
    c = np.array([0, 0, 10, 0.1, 0, 0, 0, 0, 0, 4, 4, 0.8])
    z = space.inverse(c)[0][:, 2]
    assert z[1] > z[0] > z[2]
    c[3:5] = 0.0, 0.1
    z = space.inverse(c)[0][:, 2]
    assert z[0] < z[1] == pytest.approx(z[2])


@pytest.mark.parametrize(
    "p_W",
    [np.zeros((3, 3)), np.array([(0.0, 0, 0), (1, 1, 1), (2, 2, 2)]), np.full((3, 3), math.nan)],
    ids=["one place", "one line", "nan"],
)
def test_robots_without_a_frame_are_refused(p_W):
    space = cluster_space(3)
    with pytest.raises(SingularClusterError, match="robots 1, 2 and 3"):
        space.forward(p_W, np.zeros(3))
    with pytest.raises(SingularClusterError):
        space.jacobian(p_W, np.zeros(3))


def test_other_singular_formations_are_refused_by_name():
    with pytest.raises(SingularClusterError, match="robots 1 and 2"):
        cluster_space(2).forward(np.ones((2, 3)), np.zeros(2))
    with pytest.raises(SingularClusterError, match="above each other"):
        cluster_space(2).jacobian(np.array([(0.0, 0, 0), (0, 0, 3)]), np.zeros(2))
    with pytest.raises(SingularClusterError, match="robot 4"):
        cluster_space(4).jacobian(np.vstack([TRIANGLE, TRIANGLE[0] + (0, 0, 3)]), np.zeros(4))
    with pytest.raises(SingularClusterError, match="no direction"):
        cluster_space(3).inverse(np.zeros(12))


@pytest.mark.parametrize("n", [0, 1, ROBOTS_MAX + 1])
def test_impossible_numbers_of_robots_are_refused(n):
    with pytest.raises(ValueError, match="2 to 64"):
        cluster_space(n)


def test_units_follow_from_names_in_any_space():
    lengths = ["x_c", "y_c", "z_c", "p", "q", "rho_4", "w_12", "left.p", "a.w_1", "a.b.rho_5"]
    angles = ["roll", "pitch", "yaw", "phi_1", "beta", "azimuth_4", "elevation_4", "left.beta", "p.phi_2", "w.roll"]
    assert {unit(name) for name in lengths} == {"m"}
    assert {unit(name) for name in angles} == {"rad"}


def test_an_unknown_name_is_refused_with_those_allowed():
    with pytest.raises(ValueError, match=r"'gamma'.*x_c, y_c"):
        cluster_space(3).index("gamma")


def test_differences_of_wrapping_angles_go_the_short_way():
    space = cluster_space(3)
    a, b = np.zeros(12), np.zeros(12)
    a[5], b[5] = 3.0, -3.0  # yaw
    a[0], b[0] = 30.0, -30.0  # x_c is no angle
    difference = space.difference(a, b)
    assert difference[5] == pytest.approx(6.0 - 2 * math.pi)
    assert difference[0] == 60.0
    assert space.wrapped(np.full(12, 7.0))[5] == pytest.approx(7.0 - 2 * math.pi)


def test_a_table_is_wrapped_as_its_rows_are():
    space = cluster_space(3)
    table = np.random.default_rng(4).normal(scale=20.0, size=(50, 12))
    assert space.wrapped(table).tolist() == [space.wrapped(row).tolist() for row in table]


def test_the_margin_falls_to_zero_at_each_singularity():
    space = cluster_space(3)
    good = np.array([0, 0, 10, 0, 0, 0, 0, 0, 0, 4.0, 4.0, math.pi / 2])
    assert space.margin(good) == pytest.approx(4.0)
    for name, value in (("p", 0.0), ("q", 0.0), ("beta", 0.0), ("beta", math.pi), ("pitch", math.pi / 2)):
        c = good.copy()
        c[space.index(name)] = value
        assert space.margin(c) == pytest.approx(0.0, abs=1e-12), name
    four = cluster_space(4)
    c = np.concatenate([good[:9], [0.0], good[9:], [3.0, 1.0, math.pi / 2]])
    assert four.margin(c) == pytest.approx(0.0, abs=1e-12)


def test_a_larger_formation_is_not_judged_nearer_to_singularity():
    space = cluster_space(3)
    conditions = []
    for length in (4.0, 40.0):
        c = np.array([0, 0, 10, 0, 0, 0, 0, 0, 0, length, length, math.pi / 4])
        conditions.append(space.condition(c))
    assert conditions[0] == pytest.approx(conditions[1])


def test_the_closest_pair_is_found():
    assert closest_pair(np.array([(0.0, 0, 0), (5, 0, 0), (5, 1, 0)])) == (1.0, 1, 2)


@pytest.mark.parametrize("n", SIZES)
def test_the_closest_pair_is_the_first_of_the_least_distances_that_are_finite(n):
    rng = np.random.default_rng(n)
    for _ in range(100):
        p_W = rng.integers(-2, 3, size=(n, 3)).astype(float)  # many pairs are equally near
        p_W[rng.integers(n), 0] = rng.choice([0.0, math.nan, math.inf, 1e6])
        pairs = [(math.sqrt(((p_W[i] - p_W[j]) ** 2).sum()), i, j) for i in range(n) for j in range(i + 1, n)]
        finite = [pair for pair in pairs if math.isfinite(pair[0])]
        expected = min(finite, default=(math.inf, 0, 1))
        assert closest_pair(p_W) == expected
