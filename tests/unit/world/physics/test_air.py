"""Gusts: the filter's exact discretisation and what drones share."""

import math

import numpy as np
import pytest

from zsim_world.physics import contacts
from zsim_world.physics.contacts import WIND

CALM = (0.0, 0.0, 0.0)


def parameters(gust=1.0, length=10.0, slowest=2.0, correlation=0.5, steady=CALM):
    row = np.zeros(WIND.size)
    row[WIND.steady : WIND.steady + 3] = steady
    row[WIND.gust], row[WIND.length] = gust, length
    row[WIND.speed_min], row[WIND.correlation] = slowest, correlation
    return row


@pytest.mark.parametrize(("airspeed", "tau"), [(0.0, 5.0), (1.9, 5.0), (4.0, 2.5)])
def test_correlation_time_is_length_over_airspeed(airspeed, tau):
    assert math.isclose(contacts.gust_decay(10.0, airspeed, 2.0, 0.1), math.exp(-0.1 / tau), rel_tol=1e-12)


def test_without_fresh_noise_a_gust_decays():
    gust = np.array([1.0, -2.0, 0.5])
    contacts.blow(parameters(), CALM, gust, CALM, CALM, 0.5)
    # airspeed 2.29 m/s: correlation time 10 / 2.29
    decay = math.exp(-0.5 * math.sqrt(1 + 4 + 0.25) / 10.0)
    np.testing.assert_allclose(gust, np.array([1.0, -2.0, 0.5]) * decay, rtol=1e-12)


def test_steady_wind_and_motion_count_as_airspeed():
    gust = np.array([1.0, 0.0, 0.0])
    contacts.blow(parameters(steady=(6.0, 0.0, 0.0)), (-1.0, 0.0, 0.0), gust, CALM, CALM, 0.5)
    assert math.isclose(gust[0], math.exp(-0.5 * 8.0 / 10.0), rel_tol=1e-12)


def test_variance_stays_whatever_the_step():
    """sigma^2 = decay^2 sigma^2 + fresh^2: one normal number of size 1 adds sigma sqrt(1 - decay^2)."""
    for dt in (0.005, 0.1, 20.0):
        gust = np.zeros(3)
        contacts.blow(parameters(gust=0.7, correlation=0.0), CALM, gust, CALM, (1.0, 1.0, 1.0), dt)
        decay = math.exp(-dt / 5.0)
        np.testing.assert_allclose(gust, 0.7 * math.sqrt(1 - decay**2), rtol=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_shared_noise_has_unit_variance_and_the_share_asked(share):
    assert contacts.gust_noise(share, 1.0, 0.0) ** 2 == pytest.approx(share)
    assert contacts.gust_noise(share, 1.0, 0.0) ** 2 + contacts.gust_noise(share, 0.0, 1.0) ** 2 == pytest.approx(1.0)
