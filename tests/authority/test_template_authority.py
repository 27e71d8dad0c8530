"""The template cluster against other implementations and closed forms.

Authorities: scipy's rotations (Kabsch by singular values); mechanics of point masses (a ring's moments of inertia,
Koenig's theorem on kinetic energy, as Belta and Kumar 2004 split it into group and shape); error propagation.
"""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.spaces.template_cluster import TemplateCluster, centred, euler_angles

N = 10
RADIUS_M = 3.0
TURNS = np.linspace(0.0, 2 * math.pi, N, endpoint=False)
RING = RADIUS_M * np.column_stack([np.cos(TURNS), np.sin(TURNS), np.zeros(N)])
LEVEL = np.zeros(4 * N)


def test_the_attitude_is_scipy_s_best_fit():
    rng = np.random.default_rng(1)
    for n, cases in ((3, 200), (5, 200), (10, 100), (30, 10)):
        for _ in range(cases):
            places = rng.normal(scale=4.0, size=(n, 3))
            p_W = Rotation.random(None, rng).apply(places + rng.normal(size=(n, 3)))
            c = TemplateCluster(places).forward(p_W, np.zeros(n))
            fitted = Rotation.align_vectors(centred(p_W), centred(places))[0]
            R_WC = Rotation.from_euler("ZYX", c[[5, 4, 3]])
            assert (R_WC * fitted.inv()).magnitude() < 1e-12


def test_angles_match_scipy_s_z_y_x_euler_angles():
    rng = np.random.default_rng(2)
    for _ in range(500):
        yaw, pitch, roll = rng.uniform(-3.1, 3.1), rng.uniform(-1.5, 1.5), rng.uniform(-3.1, 3.1)
        R = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        assert euler_angles(R) == pytest.approx((roll, pitch, yaw), abs=1e-12)


def test_inverse_undoes_forward_for_ten_thousand_formations():
    rng = np.random.default_rng(3)
    space, worst = TemplateCluster(RING), 0.0
    for _ in range(10_000):
        p_W, yaw = RING + rng.normal(scale=1.0, size=(N, 3)), rng.uniform(-math.pi, math.pi, N)
        worst = max(worst, float(np.abs(space.inverse(space.forward(p_W, yaw))[0] - p_W).max()))
    assert 0.0 < worst < 5e-13


def test_the_spread_of_a_ring_is_its_radius_over_the_root_of_two():
    """The moment of inertia of a ring about a diameter is n r^2 / 2."""
    space = TemplateCluster(RING)
    assert space.spread(LEVEL) == pytest.approx(RADIUS_M / math.sqrt(2), rel=1e-12)
    grown = LEVEL.copy()
    grown[space.index("w_1")] = 1.0
    assert space.spread(grown) == pytest.approx((RADIUS_M + 1.0) / math.sqrt(2), rel=1e-12)


def test_the_condition_of_a_level_ring_matches_its_closed_form():
    """Rotation about z and the mean heading are coupled: [[r^2 + 1, 1], [1, 1]] has the extreme eigenvalues."""
    trace, determinant = RADIUS_M**2 + 2, RADIUS_M**2
    root = math.sqrt(trace**2 - 4 * determinant)
    condition = math.sqrt((trace + root) / (trace - root))
    assert TemplateCluster(RING).condition(LEVEL) == pytest.approx(condition, rel=1e-12)


def test_kinetic_energy_splits_into_translation_rotation_and_shape():
    """The sum of v_i^2 is n v_C^2 + w . M w + n w_dot^2 where the robots stand on the template."""
    rng = np.random.default_rng(4)
    places = rng.normal(scale=3.0, size=(N, 3))
    space = TemplateCluster(places)
    for _ in range(100):
        c, c_dot = np.zeros(4 * N), rng.normal(size=4 * N)
        r_dot = space.motion(c, c_dot).reshape(N, 4)
        t, w = centred(places), c_dot[3:6]  # level: Euler rates are body rates
        turn = (np.cross(w, t) ** 2).sum()
        shape = N * (c_dot[6 + N :] ** 2).sum()
        assert (r_dot[:, :3] ** 2).sum() == pytest.approx(N * (c_dot[:3] ** 2).sum() + turn + shape, rel=1e-12)


def test_errors_of_many_robots_average_out():
    """Independent position errors sigma leave sigma / sqrt(n) in the centre and sigma / (r sqrt(n)) in yaw.

    The frame of a triad, in contrast, rests on three robots, whatever their number.
    """
    J = TemplateCluster(RING).jacobian(RING, np.zeros(N))
    sigma_m = 0.152  # of an estimate with GPS and flow
    sigmas = sigma_m * np.sqrt((J.reshape(4 * N, N, 4)[:, :, :3] ** 2).sum(axis=(1, 2)))
    assert sigmas[:3] == pytest.approx([sigma_m / math.sqrt(N)] * 3, rel=1e-12)
    assert sigmas[5] == pytest.approx(sigma_m / (RADIUS_M * math.sqrt(N)), rel=1e-12)
    tilt = sigma_m / (RADIUS_M * math.sqrt(N / 2))
    assert sigmas[3:5] == pytest.approx([tilt, tilt], rel=1e-12)
    assert sigmas[6 + N :] == pytest.approx([sigma_m / math.sqrt(N)] * (3 * N - 6), rel=1e-12)


def test_a_template_of_eight_is_better_conditioned_than_a_triad():
    """A prototype found medians of 13 and 34 over random formations, without a separate scale for phi."""
    rng, template, triad = np.random.default_rng(5), [], cluster_space(8)
    of_triad = []
    for _ in range(400):
        places, yaw = rng.normal(scale=3.0, size=(8, 3)), rng.uniform(-3.0, 3.0, 8)
        space = TemplateCluster(places)
        template.append(np.linalg.cond(space.inverse_jacobian(space.forward(places, yaw))))
        of_triad.append(np.linalg.cond(triad.inverse_jacobian(triad.forward(places, yaw))))
    assert np.median(template) == pytest.approx(13, rel=0.1)
    assert 30 < np.median(of_triad) < 45
