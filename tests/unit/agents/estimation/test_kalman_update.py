"""Prediction, update and gates of the filter against filterpy and the chi-square distribution."""

import math

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from scipy.stats import chi2

from zsim_agents.estimation.filter_setup import innovation_limits
from zsim_agents.estimation.kalman_update import predicted_covariance, stacked_update

LIMITS = np.full(7, 1e9)  # gates that accept every innovation
GATE_PROBABILITY = 0.9999


def problem(seed: int, n: int, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    H = rng.normal(size=(m, n)) * (rng.random((m, n)) < 0.4)
    return root @ root.T + 0.1 * np.eye(n), H, rng.uniform(0.01, 4.0, m), rng.normal(size=m)


@pytest.mark.parametrize(("n", "m"), [(12, 1), (12, 3), (12, 11), (15, 6), (15, 17)])
@pytest.mark.parametrize("seed", range(5))
def test_the_update_equals_that_of_filterpy(seed: int, n: int, m: int):
    P, H, variance, y = problem(seed, n, m)
    reference = ExtendedKalmanFilter(n, m)
    reference.x, reference.P = np.zeros(n), P.copy()
    reference.update(y, lambda x: H, lambda x: 0.0, np.diag(variance))
    blocks = np.array([(i, 1) for i in range(m)])
    used, x, updated, S = stacked_update(P, H, variance, y, blocks, LIMITS, np.zeros(m))
    assert used
    scale = np.abs(P).max()
    assert x == pytest.approx(reference.x, rel=1e-9, abs=1e-12)
    assert updated == pytest.approx(reference.P, rel=1e-9, abs=1e-11 * scale)
    assert pytest.approx(reference.S, rel=1e-12, abs=1e-12) == S


@pytest.mark.parametrize("seed", range(5))
def test_the_prediction_equals_that_of_filterpy(seed: int):
    P, _, _, _ = problem(seed, 12, 3)
    rng = np.random.default_rng(seed)
    F = np.eye(12) + 0.02 * rng.normal(size=(12, 12)) * (rng.random((12, 12)) < 0.2)
    Q = np.diag(rng.uniform(0.0, 1e-3, 12))
    reference = ExtendedKalmanFilter(12, 3)
    reference.x, reference.P, reference.F, reference.Q = np.zeros(12), P, F, Q
    reference.predict()
    assert predicted_covariance(P, F, Q) == pytest.approx(reference.P, rel=1e-12, abs=1e-12)


def test_an_innovation_outside_its_gate_changes_nothing():
    P, H, variance, y = problem(1, 12, 4)
    before = P.copy()
    y[2] = 1e3
    distances = np.zeros(4)
    blocks = np.array([(0, 2), (2, 2)])
    limits = np.array([0.0, 15.0, 18.0, 21.0, 23.0, 25.0, 27.0])
    used, x, after, _ = stacked_update(P, H, variance, y, blocks, limits, distances)
    assert not used
    assert distances[1] > 18.0
    assert not x.any()
    assert np.array_equal(after, before)


@pytest.mark.parametrize(("size", "inside"), [(1, True), (1, False), (3, True), (3, False), (6, True), (6, False)])
def test_a_gate_is_the_chi_square_quantile(size: int, inside: bool):
    P, H, variance = np.eye(12), np.eye(size, 12), np.full(size, 0.25)
    limit = math.sqrt(chi2.ppf(GATE_PROBABILITY, size) * 1.25 / size)  # per row
    y, blocks = np.full(size, limit * (0.999 if inside else 1.001)), np.array([(0, size)])
    used, x, updated, _ = stacked_update(P, H, variance, y, blocks, innovation_limits(GATE_PROBABILITY), np.zeros(1))
    assert used == inside
    assert x.any() == inside
    assert (updated == P).all() != inside


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300])
def test_a_value_that_is_not_finite_or_absurd_is_refused(bad: float):
    P, H = np.eye(12), np.eye(1, 12)
    blocks, limits = np.array([(0, 1)]), innovation_limits(GATE_PROBABILITY)
    with np.errstate(over="ignore", invalid="ignore"):
        used, x, updated, _ = stacked_update(P, H, np.ones(1), np.array([bad]), blocks, limits, np.zeros(1))
    assert not used
    assert not x.any()
    assert (updated == P).all()
