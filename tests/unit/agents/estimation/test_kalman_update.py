"""Prediction, update and gates of the filter against filterpy and the chi-square distribution."""

import math

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter
from scipy.stats import chi2
from synthetic_flight import GATE_S, Flight, estimator, readings, scenario

from zsim.math.compiled import COMPILES
from zsim.math.rotation import matrix
from zsim_agents.estimation import measurement_update
from zsim_agents.estimation.dead_reckoning import corrected
from zsim_agents.estimation.filter_setup import innovation_limits
from zsim_agents.estimation.filter_state import NOMINAL, SETTING, Rows, reckoning
from zsim_agents.estimation.kalman_update import predicted_covariance, stacked_update
from zsim_agents.estimation.measurement_update import correct

LIMITS = np.full(7, 1e9)  # gates that nothing misses
GATE_PROBABILITY = 0.9999
ZERO = (0.0, 0.0, 0.0)


def problem(seed: int, n: int, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    H = rng.normal(size=(m, n)) * (rng.random((m, n)) < 0.4)
    return root @ root.T + 0.1 * np.eye(n), H, rng.uniform(0.01, 4.0, m), rng.normal(size=m)


@pytest.mark.parametrize(("n", "m"), [(12, 1), (12, 3), (12, 11), (15, 6), (15, 17)])
@pytest.mark.parametrize("seed", range(5))
def test_it_is_filterpys_update(seed: int, n: int, m: int):
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
def test_it_is_filterpys_prediction(seed: int):
    P, _, _, _ = problem(seed, 12, 3)
    rng = np.random.default_rng(seed)
    F = np.eye(12) + 0.02 * rng.normal(size=(12, 12)) * (rng.random((12, 12)) < 0.2)
    Q = np.diag(rng.uniform(0.0, 1e-3, 12))
    reference = ExtendedKalmanFilter(12, 3)
    reference.x, reference.P, reference.F, reference.Q = np.zeros(12), P, F, Q
    reference.predict()
    assert predicted_covariance(P, F, Q) == pytest.approx(reference.P, rel=1e-12, abs=1e-12)


def test_an_innovation_outside_of_its_gate_changes_nothing():
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


@pytest.mark.parametrize("seed", range(5))
def test_used_one_after_another_they_are_the_same_as_together(seed: int):
    """Independent measurements need no stack: filterpy's linear filter takes them row by row."""
    P, H, variance, y = problem(seed, 12, 7)
    reference = KalmanFilter(12, 1)
    reference.x, reference.P = np.zeros(12), P.copy()
    for row in range(7):
        reference.update(y[row], variance[row], H[row : row + 1])
    blocks = np.array([(i, 1) for i in range(7)])
    _, x, updated, _ = stacked_update(P, H, variance, y, blocks, LIMITS, np.zeros(7))
    assert x == pytest.approx(reference.x, rel=1e-9, abs=1e-11)
    assert updated == pytest.approx(reference.P, rel=1e-9, abs=1e-9 * np.abs(P).max())


@pytest.mark.parametrize(("size", "inside"), [(1, True), (1, False), (3, True), (3, False), (6, True), (6, False)])
def test_a_gate_is_the_quantile_of_chi_square(size: int, inside: bool):
    P, H, variance = np.eye(12), np.eye(size, 12), np.full(size, 0.25)
    limit = math.sqrt(chi2.ppf(GATE_PROBABILITY, size) * 1.25 / size)  # per row
    y, blocks = np.full(size, limit * (0.999 if inside else 1.001)), np.array([(0, size)])
    used, x, updated, _ = stacked_update(P, H, variance, y, blocks, innovation_limits(GATE_PROBABILITY), np.zeros(1))
    assert used == inside
    assert x.any() == inside
    assert (updated == P).all() != inside


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300])
def test_what_is_not_a_number_is_refused(bad: float):
    P, H = np.eye(12), np.eye(1, 12)
    blocks, limits = np.array([(0, 1)]), innovation_limits(GATE_PROBABILITY)
    with np.errstate(over="ignore", invalid="ignore"):
        used, x, updated, _ = stacked_update(P, H, np.ones(1), np.array([bad]), blocks, limits, np.zeros(1))
    assert not used
    assert not x.any()
    assert (updated == P).all()


def copy_of(rows: Rows) -> Rows:
    return Rows._make(array.copy() for array in rows)


def test_a_refused_measurement_leaves_no_trace_on_those_beside_it():
    rows = estimator(scenario()).bank.rows
    alone, both, P = copy_of(rows), copy_of(rows), np.eye(12)
    H, z, variance = np.zeros((4, 12)), np.array([50.0, 0.1, 0.2, 0.3]), np.full(4, 0.01)
    H[0, 2], H[1:, 3:6] = 1.0, np.eye(3)
    kinds, expected = np.array([3, 5]), np.zeros(4)
    P_both = correct(both, 0, P, H, z, expected, variance, np.array([(0, 1), (1, 3)]), kinds)
    P_alone = correct(alone, 0, P, H[1:], z[1:], expected[1:], variance[1:], np.array([(0, 3)]), kinds[1:])
    assert both.nominal[0, : NOMINAL.t_sample] == pytest.approx(alone.nominal[0, : NOMINAL.t_sample], nan_ok=True)
    assert P_both == pytest.approx(P_alone)


def test_a_gate_in_flight_is_filterpys_update():
    """A twin has the same past and the gate's IMU alone: what it lacks is what the other sensors gave."""
    of = scenario(estimation={"gate_probability": 1 - 1e-12})
    core, twin, gates = estimator(of), estimator(of), 0
    coming = [r for r in readings(Flight(3, start_s=0.5), of, 3, 8.0) if r.sensor in ("imu", *MODELS)]
    for gate in range(1, round(8.0 / GATE_S) + 1):
        t_s = gate * GATE_S
        twin.bank.rows = copy_of(core.bank.rows)
        now = [reading for reading in coming if t_s - GATE_S + 1e-9 < reading.t_s <= t_s + 1e-9]
        for reading in now:
            core.feed(reading)
            if reading.sensor == "imu":
                twin.feed(reading)
        core.close(t_s)
        twin.close(t_s)
        aiding = [reading for reading in now if reading.sensor != "imu"]
        if t_s > 1.0 and aiding and all(abs(reading.t_sample_s - t_s) < 1e-9 for reading in aiding):
            compare(core.bank.rows, twin.bank.rows, aiding)
            gates += 1
    assert gates > 40


def _gps(H, i, p, v, q, w, setting):
    return measurement_update.write_gps(H, i, p, v, matrix(q), w, ZERO, 0.0)


def _mag(H, i, p, v, q, w, setting):
    field = tuple(setting[SETTING.field_W : SETTING.field_W + 3].tolist())
    return measurement_update.write_mag(H, i, matrix(q), matrix((1.0, 0.0, 0.0, 0.0)), field)


def _baro(H, i, p, v, q, w, setting):
    return (measurement_update.write_baro(H, i, p, matrix(q), ZERO, 0.0),)


MODELS = {"gps": (_gps, [2.0] * 3 + [0.43] * 3), "mag": (_mag, [0.94] * 3), "baro": (_baro, [0.1])}


def compare(rows: Rows, before: Rows, aiding) -> None:
    """Take the step from `before` by filterpy, and compare the covariance and the corrected state."""
    n = before.covariance.shape[1]
    p, v, q, _, w, _ = state = reckoning(before.nominal[0])
    H, z, expected, sigma = np.zeros((32, n)), [], [], []
    for reading in aiding:
        model, sigmas = MODELS[reading.sensor]
        expected += model(H, len(z), p, v, q, w, before.setting[0])
        z += np.ravel(reading.values[:2] if reading.sensor == "gps" else reading.values[0]).tolist()
        sigma += sigmas
    reference = ExtendedKalmanFilter(n, len(z))
    reference.x, reference.P = np.zeros(n), before.covariance[0].copy()
    R = np.diag(np.square(sigma))
    reference.update(np.array(z), lambda x: H[: len(z)], lambda x: np.array(expected), R)
    wanted = corrected(state, reference.x, False, float(before.setting[0, SETTING.gravity]))
    assert rows.covariance[0] == pytest.approx(reference.P, rel=1e-9, abs=1e-10)
    for part, reached in zip(wanted, reckoning(rows.nominal[0]), strict=True):
        assert reached == pytest.approx(part, rel=1e-9, abs=1e-9)


def test_it_is_compiled_where_numba_is():
    assert hasattr(stacked_update, "py_func") == COMPILES
