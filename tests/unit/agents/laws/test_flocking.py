"""The flocking laws, integrated without a simulator, against the claims of their papers."""

import math

import numpy as np
import pytest

from zsim_agents.laws.olfati_saber import (
    alpha_force,
    beta_force,
    bump,
    deviation_energy,
    gamma_force,
    phi_alpha,
    phi_beta,
    sigma_norm,
)
from zsim_agents.laws.pilot import Heard
from zsim_agents.laws.vasarhelyi import braking, friction, repelled

D, R = 7.0, 8.4  # m, spacing and range in the paper


def test_the_lattice_force_is_that_of_the_paper() -> None:
    assert sigma_norm(D) == pytest.approx(14.2899, abs=1e-4)
    assert sigma_norm(R) == pytest.approx(18.3831, abs=1e-4)
    assert phi_alpha(sigma_norm(D), D, R) == 0.0
    assert phi_alpha(sigma_norm(5.0), D, R) < 0 < phi_alpha(sigma_norm(7.5), D, R)
    assert phi_alpha(sigma_norm(R), D, R) == phi_alpha(sigma_norm(9.0), D, R) == 0.0
    assert [bump(0.1, 0.2), bump(0.6, 0.2), bump(1.0, 0.2)] == pytest.approx([1.0, 0.5, 0.0])
    assert phi_beta(sigma_norm(3.0), 4.2) < phi_beta(sigma_norm(4.0), 4.2) <= 0.0
    assert phi_beta(sigma_norm(4.2), 4.2) == 0.0


def test_a_flock_forms_a_lattice_with_a_common_velocity() -> None:
    """All drones start within range; energy falls, velocities become the aim's and distances of neighbours become d."""
    rng, h, c1, c1_g = np.random.default_rng(2), 0.02, 1.0, 0.1
    p, v = rng.uniform(-8, 8, (7, 2)), rng.normal(0, 0.5, (7, 2))
    v_r = np.array([0.5, 0.0])
    first = deviation_energy(p, D, R)[0]
    for step in range(6000):
        heard = [Heard(str(j), p[j], v[j]) for j in range(7)]
        u = np.array([
            alpha_force(p[i], v[i], [each for j, each in enumerate(heard) if j != i], D, R, c1)
            + gamma_force(p[i], v[i], step * h * v_r, v_r, c1_g)
            for i in range(7)
        ])  # fmt: skip
        v = v + h * u
        p = p + h * v
    energy, sides = deviation_energy(p, D, R)
    assert np.abs(v - v_r).max() < 0.02
    assert np.mean(p, axis=0) == pytest.approx(6000 * h * v_r, abs=1.0)
    assert sides >= 7
    assert math.sqrt(energy) < 0.01 * D < math.sqrt(first)


def test_an_obstacle_brakes_only_motion_towards_it() -> None:
    along, away = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    assert beta_force(along, [(2.0, away)], 3.0, 1.0)[0] == 0.0
    towards = beta_force(-away, [(1.5, away)], 3.0, 1.0)
    assert towards[1] > beta_force(along, [(1.5, away)], 3.0, 1.0)[1] > 0.0
    assert not beta_force(-away, [(3.5, away)], 3.0, 1.0).any()


def test_a_drone_at_the_braking_speed_stops_within_the_distance() -> None:
    a, p, h = 2.0, 0.8, 1e-4
    assert braking(-1.0, a, p) == braking(0.0, a, p) == 0.0
    corner = a / (p * p)
    assert braking(corner * (1 - 1e-9), a, p) == pytest.approx(braking(corner * (1 + 1e-9), a, p), rel=1e-6)
    r, steepest = 10.0, 0.0
    speed = braking(r, a, p)
    for _ in range(200_000):
        r -= h * speed
        steepest = max(steepest, (speed - braking(r, a, p)) / h)
        speed = braking(r, a, p)
    assert 0.0 <= r < 1e-3
    assert steepest == pytest.approx(a, rel=1e-3)


def test_friction_reduces_a_difference_of_velocities() -> None:
    v_i, v_j = np.array([1.0, 0.0]), np.array([-1.0, 0.5])
    before = np.linalg.norm(v_j - v_i)
    after = np.linalg.norm(v_j - (v_i + friction(v_j - v_i, 0.5, 0.3)))
    assert after == pytest.approx(before - 0.3 * (before - 0.5))
    assert not friction(v_j - v_i, 3.0, 0.3).any()


def test_repulsion_ends_at_its_range() -> None:
    assert repelled(np.array([2.0, 0.0]), 3.0, 0.4) == pytest.approx([-0.4, 0.0])
    assert not repelled(np.array([3.0, 0.0]), 3.0, 0.4).any()
