"""The control law: formula, saturation and integral, and the guard of the distance between robots."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsim_agents.formation.control_law import FormationGains, ProportionalLaw, guard, load, near_pairs
from zsim_agents.formation.spaces.scenario_space import cluster_space

SPACE = cluster_space(3)
GOAL = np.array([5, -5, 15, 0, 0, math.pi / 2, 0, 0, 0, 4, 4, math.pi / 4])  # paper, equation (3)
AT_REST = np.zeros((3, 3))
GAINS = FormationGains()
DT_S = 0.02


def command_at(c, c_des, rate=None, law=None):
    law = law or ProportionalLaw(SPACE, GAINS)
    p_W, _ = SPACE.inverse(c)
    return law.command(c, p_W, AT_REST, c_des, np.zeros(12) if rate is None else rate, DT_S)


def cluster_rate(c, command):
    r_dot = np.hstack([command.v_W, command.yaw_rate[:, None]]).ravel()
    return SPACE.jacobian(*SPACE.inverse(c)) @ r_dot


def offset(**changes):
    c = GOAL.copy()
    for name, value in changes.items():
        c[SPACE.index(name)] += value
    return c


def test_the_cluster_rate_is_feed_forward_plus_gain_times_error():
    command = command_at(GOAL, GOAL)
    assert np.abs(command.v_W).max() < 1e-12
    assert (command.factor, command.guarded, command.alarmed) == (1.0, (), ())
    rate = np.array([0.1, -0.2, 0.05, 0, 0, 0.02, 0, 0, 0, 0.03, 0, 0])
    c = offset(x_c=-0.3, yaw=0.1, p=-0.2, beta=0.05)
    expected = rate + 0.6 * SPACE.difference(GOAL, c)
    assert cluster_rate(c, command_at(c, GOAL, rate)) == pytest.approx(expected, abs=1e-12)
    c, c_des = offset(yaw=3.0 - math.pi / 2), offset(yaw=-3.0 - math.pi / 2)
    assert cluster_rate(c, command_at(c, c_des))[5] == pytest.approx(0.6 * (2 * math.pi - 6.0))


@settings(deadline=None, max_examples=200, derandomize=True)
@given(st.lists(st.floats(-30.0, 30.0), min_size=12, max_size=12))
def test_saturation_keeps_the_limits_and_the_direction_in_cluster_space(errors):
    gains = dataclasses.replace(GAINS, separation_min_m=0.0, separation_alarm_m=0.0)  # the law without its guard
    law = ProportionalLaw(SPACE, gains)
    error = np.array(errors) * np.where(SPACE.in_radians, 0.1, 1.0)
    p_W, _ = SPACE.inverse(GOAL)
    wanted = error * gains.k_1_s
    command = law.command(GOAL, p_W, AT_REST, GOAL, wanted, DT_S)
    assert load(command.v_W, command.yaw_rate, gains.limits) <= 1.0 + 1e-9
    if not command.guarded:
        assert cluster_rate(GOAL, command) == pytest.approx(command.factor * wanted, abs=1e-9)


@pytest.mark.parametrize(
    ("rate", "limited"),
    [
        ({"x_c": 10.0}, lambda c: math.hypot(*c.v_W[0, :2]) / GAINS.speed_max_m_s),
        ({"z_c": 10.0}, lambda c: c.v_W[0, 2] / GAINS.climb_max_m_s),
        ({"phi_2": 10.0}, lambda c: c.yaw_rate[1] / GAINS.yaw_rate_max_rad_s),
    ],
)
def test_each_limit_is_reached_and_not_exceeded(rate, limited):
    rates = np.zeros(12)
    for name, value in rate.items():
        rates[SPACE.index(name)] = value
    command = command_at(GOAL, GOAL, rates)
    assert limited(command) == pytest.approx(1.0)
    assert command.factor < 1.0


def test_the_integral_grows_with_the_error_up_to_its_clamp():
    law = ProportionalLaw(SPACE, GAINS)
    c = offset(x_c=-0.5, yaw=-0.2)
    command_at(c, GOAL, law=law)
    assert law.integral[[0, 5]] == pytest.approx([0.05 * 0.02 * 0.5, 0.05 * 0.02 * 0.2])
    for _ in range(3000):
        command_at(c, GOAL, law=law)
    assert law.integral[[0, 5]] == pytest.approx([GAINS.integral_max_m_s, GAINS.integral_max_rad_s])
    law.reset()
    near = offset(p=-1.5, q=-1.5)  # robots 2 and 3 at 1.9 m: the integral is frozen while saturated or guarded
    assert command_at(offset(x_c=-50.0), GOAL, law=law).factor < 1.0
    assert command_at(near, near - 0.01, law=law).guarded
    assert not law.integral.any()


# The guard


def pair(distance, v_1=(0, 0, 0), v_2=(0, 0, 0)):
    p_W = np.array([(0.0, 0.0, 5.0), (distance, 0.0, 5.0)])
    v_cmd_W = np.array([v_1, v_2], dtype=float)
    return guard(p_W, np.zeros((2, 3)), v_cmd_W, GAINS.limits)


@pytest.mark.parametrize(
    ("distance", "v_1", "v_2"),
    [(20.0, (2, 0, 0), (-2, 0, 0)), (2.5, (-1, 0, 0), (1, 0, 0)), (2.5, (0, 2, 0), (0, 2, 0))],
)
def test_the_guard_ignores_robots_that_are_distant_or_separating(distance, v_1, v_2):
    v_W, guarded, alarmed = pair(distance, v_1, v_2)
    assert v_W.tolist() == [list(v_1), list(v_2)]
    assert (guarded, alarmed) == ((), ())


def test_the_guard_lets_robots_approach_to_the_minimum_distance():
    v_W, guarded, _ = pair(3.0, (2, 0.5, 0), (-2, 0, 0.3))
    assert guarded == ((0, 1),)
    assert v_W[1, 0] - v_W[0, 0] == pytest.approx(-(3.0 - GAINS.separation_min_m) / GAINS.guard_horizon_s)
    assert v_W[0, 1:].tolist() == [0.5, 0.0]  # components perpendicular to the line are unchanged
    assert v_W[1, 1:].tolist() == [0.0, 0.3]


def test_the_guard_separates_robots_that_are_too_close():
    v_W, guarded, alarmed = pair(1.4)
    assert (guarded, alarmed) == (((0, 1),), ((0, 1),))
    assert v_W[1, 0] - v_W[0, 0] == pytest.approx(0.6)
    assert v_W.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
    assert (pair(1.49)[2], pair(1.51)[2]) == (((0, 1),), ())
    v_W, _, _ = pair(0.0)
    assert v_W[1, 0] - v_W[0, 0] == pytest.approx(GAINS.separation_min_m)


def test_the_guard_allows_for_the_stopping_distance():
    p_W = np.array([(0.0, 0, 5), (2.5, 0, 5)])
    towards = np.array([(1.0, 0, 0), (-1.0, 0, 0)])
    v_W, guarded, _ = guard(p_W, towards, np.zeros((2, 3)), GAINS.limits)
    assert guarded
    assert v_W[1, 0] - v_W[0, 0] == pytest.approx(2 * GAINS.response_s - 0.5)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(2, 6))
def test_guarded_robots_never_collide_whatever_is_commanded(seed, n):
    """Robots with a velocity lag of 0.3 s are driven at random towards each other for 20 s."""
    rng = np.random.default_rng(seed)
    p_W = np.zeros((n, 3))
    p_W[:, 0] = 3.0 * np.arange(n)
    v_W = np.zeros((n, 3))
    wanted, least = np.zeros((n, 3)), math.inf
    for step in range(400):
        if step % 40 == 0:
            wanted = rng.uniform(-1.5, 1.5, (n, 3)) - 0.3 * (p_W - p_W.mean(axis=0))
        v_cmd_W, _, _ = guard(p_W, v_W, wanted, GAINS.limits)
        v_cmd_W = v_cmd_W / max(load(v_cmd_W, np.zeros(n), GAINS.limits), 1.0)
        v_W = v_W + (v_cmd_W - v_W) * 0.05 / 0.3
        p_W = p_W + v_W * 0.05
        least = min(least, *(math.dist(p_W[i], p_W[j]) for i in range(n) for j in range(i)))
    assert least > GAINS.separation_alarm_m


@pytest.mark.parametrize("n", [2, 3, 10])
def test_near_pairs_are_complete_and_ordered(n):
    rng = np.random.default_rng(n)
    for _ in range(100):
        p_W = rng.integers(-2, 3, size=(n, 3)).astype(float)
        p_W[rng.integers(n), 0] = rng.choice([0.5, math.nan, math.inf])
        expected = [[i, j] for j in range(n) for i in range(j) if not np.linalg.norm(p_W[i] - p_W[j]) >= 2.0]
        assert near_pairs(p_W, 2.0).tolist() == expected
