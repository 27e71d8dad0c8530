"""Gusts against the Dryden longitudinal form (MIL-HDBK-1797): spread, spectrum, correlation in time and space."""

import math

import numpy as np
import pytest
from scipy import signal

from zsim.math.compiled import kernel
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics import contacts
from zsim_world.physics.contacts import WIND
from zsim_world.sensors.noise import NoiseTable

TAU_S = 5.0  # L / V0 = 10 m / 2 m/s while the airspeed is below 2 m/s
SIGMA = 0.3  # m/s, so that |gust| of standing drones hardly ever exceeds V0
DT, DRONES = 0.1, 12


def windy(count, seed=1, **parameters):
    drones = [{"name": f"d{k}", "position_m": [2.0 * k, 0, 0]} for k in range(count)]
    environment = {"wind": {"gust_m_s": SIGMA, **parameters}}
    return resolve({"name": "t", "duration_s": 1, "seed": seed, "environment": environment, "drones": drones})


@kernel()
def blown(row, common, own, start):
    """Return gusts at standing drones, one per row of noise; common (T, 3), own (T, N, 3)."""
    out, gust = np.empty_like(own), start.copy()
    for k in range(len(own)):
        shared = (common[k, 0], common[k, 1], common[k, 2])
        for i in range(own.shape[1]):
            mine = (own[k, i, 0], own[k, i, 1], own[k, i, 2])
            contacts.advance_gust(row, (0.0, 0.0, 0.0), gust[i], shared, mine, DT)
        out[k] = gust
    return out


def gusts(seconds, seed=1, steady=(0.0, 0.0, 0.0)):
    """Return settled gusts at DRONES standing drones, at 10 Hz (samples, DRONES, 3)."""
    row = np.zeros(WIND.size)
    row[WIND.steady : WIND.steady + 3] = steady
    row[WIND.gust], row[WIND.length], row[WIND.speed_min], row[WIND.correlation] = SIGMA, 10.0, 2.0, 0.5
    rng, count = np.random.default_rng(seed), round(seconds / DT)
    numbers = rng.standard_normal((count, 3)), rng.standard_normal((count, DRONES, 3))
    return blown(row, *numbers, np.zeros((DRONES, 3)))[1000:]


@pytest.fixture(scope="module")
def record():
    return gusts(6000.0)


def independent(record):
    """Return a conservative count of the independent numbers in a series of 12 half-correlated drones."""
    return record.shape[0] * 0.1 / (2 * TAU_S) * 3 * 2


def test_gusts_have_zero_mean_and_the_specified_spread(record):
    n = independent(record)
    assert abs(record.mean()) < 4 * SIGMA / math.sqrt(n)
    assert record.std() == pytest.approx(SIGMA, abs=4 * SIGMA / math.sqrt(2 * n))


@pytest.mark.parametrize("lag_s", [1.0, 2.5, 5.0, 10.0])
def test_correlation_decays_exponentially_in_time(record, lag_s):
    k = round(lag_s / 0.1)
    measured = (record[k:] * record[:-k]).mean() / (record**2).mean()
    assert measured == pytest.approx(math.exp(-lag_s / TAU_S), abs=4 / math.sqrt(independent(record)))


def test_the_spectrum_matches_the_dryden_form(record):
    """S(f) = 4 sigma^2 tau / (1 + (2 pi f tau)^2), one-sided, from 0.01 to 1 Hz."""
    flat = record.reshape(len(record), -1).T
    f, measured = signal.welch(flat, fs=10.0, nperseg=2048)
    measured = measured.mean(axis=0)
    form = 4 * SIGMA**2 * TAU_S / (1 + (2 * np.pi * f * TAU_S) ** 2)
    for low, high in ((0.01, 0.05), (0.05, 0.2), (0.2, 1.0)):
        band = (f >= low) & (f < high)
        assert measured[band].sum() / form[band].sum() == pytest.approx(1.0, abs=0.06)


def test_correlation_between_drones_is_as_specified(record):
    cross = [(record[:, i] * record[:, j]).mean() for i in range(12) for j in range(i)]
    assert np.mean(cross) / SIGMA**2 == pytest.approx(0.5, abs=0.05)


def test_axes_are_uncorrelated(record):
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert abs((record[:, :, a] * record[:, :, b]).mean()) / SIGMA**2 < 0.08


def test_gusts_are_stationary_from_the_start():
    """The first gusts of many seeds already have the full spread and the correlation between drones."""
    first = np.array([NoiseTable(windy(2, seed), 1).gust for seed in range(400)])
    assert first.std() == pytest.approx(SIGMA, rel=0.1)
    assert (first[:, 0] * first[:, 1]).mean() / SIGMA**2 == pytest.approx(0.5, abs=0.12)


def test_faster_air_shortens_the_correlation_time():
    """At 10 m/s of steady wind the correlation time is L / V = 1 s."""
    fast = gusts(2000.0, steady=(10.0, 0.0, 0.0))
    measured = (fast[10:] * fast[:-10]).mean() / (fast**2).mean()
    assert measured == pytest.approx(math.exp(-1.0), abs=0.05)


def test_a_fleet_runs_the_same_gust_filter_every_5_ms():
    """The gusts of a fleet are replayed from its own random streams."""
    scenario = windy(2, seed=5)
    fleet, noise = Fleet(scenario), NoiseTable(scenario, 64)
    gust, row = noise.gust.copy(), fleet._w.wind
    for _ in range(10):
        fleet.advance()
    at = noise.at[6]
    common, own = noise.table[2, at:].reshape(-1, 3)[:40], noise.table[:2, at:].reshape(2, -1, 3)[:, :40]
    for k in range(40):
        for i in range(2):
            contacts.advance_gust(row, (0.0, 0.0, 0.0), gust[i], tuple(common[k]), tuple(own[i, k]), 0.005)
    np.testing.assert_allclose(fleet.wind_m_s, gust, atol=1e-7)  # the standing drones sway by micrometres


def test_drones_share_one_gust_only_at_full_correlation():
    for share, alike in ((1.0, True), (0.0, False)):
        fleet = Fleet(windy(2, gust_correlation=share))
        for _ in range(100):
            fleet.advance()
        a, b = fleet.wind_m_s
        assert np.allclose(a, b) == alike
