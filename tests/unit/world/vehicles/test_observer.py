"""The fixed observer gains: steady Kalman filters, stable on their true schedule for any noise of a scenario."""

import itertools
import math

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from zsim.scenario.scenario_file import resolve
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim_world.vehicles import observer
from zsim_world.vehicles.observer import GAIN

PRESETS = {
    "paper": {"preset": "paper"},
    "as_printed": {"preset": "paper", "as_printed": True},
    "ardrone2": {"preset": "ardrone2"},
}


def row_of(sensors, **drone):
    drones = [{"name": "a", "position_m": [0, 0, 0], **drone}]
    scenario = resolve({"name": "t", "duration_s": 1, "sensors": sensors, "drones": drones})
    return observer.gain_row(ARDRONE2, scenario.drones[0], scenario.environment)


@pytest.mark.parametrize("sensors", PRESETS.values(), ids=PRESETS)
def test_observer_gains_give_a_stable_filter_on_its_true_schedule(sensors):
    """Errors of the horizontal design model shrink over one second of 200 accelerometer and 15 flow samples."""
    row = row_of(sensors)
    c, g = 0.249 / 0.429, 9.80665
    step = np.eye(4) + 0.005 * np.array([[-c, g, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    accel = np.eye(4) - np.outer(row[GAIN.accel_v : GAIN.accel_u + 1], [-c, 0, 0, 1])
    flow = np.eye(4) - np.outer(row[GAIN.flow_v : GAIN.flow_u + 1], [1, 0, 0, 0])
    second = np.eye(4)
    for k in range(200):
        second = accel @ step @ second
        if (15 * k) // 200 != (15 * (k + 1)) // 200:
            second = flow @ second
    assert np.abs(np.linalg.eigvals(second)).max() < 0.999


def test_the_steady_gain_of_a_scalar_filter_matches_the_closed_form():
    """A random walk of q per sqrt(s), measured at 200 Hz with sigma: p = (q' + sqrt(q'^2 + 4 q' r)) / 2."""
    q, r = 0.3**2 / 200, 0.5**2
    p = (q + math.sqrt(q * q + 4 * q * r)) / 2
    gain = observer.steady_gains(np.zeros((1, 1)), np.array([0.3]), [([1.0], 0.5, 200.0)])
    assert gain[0, 0] == pytest.approx(p / (p + r), rel=1e-9)


def test_the_covariance_solves_the_riccati_equation():
    """Checked against scipy's solver in a case that it can solve."""
    a = np.array([[-0.58, 9.8, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    walks, dt = np.array([0.0, 6e-4, 2e-5, 0.2]), 0.005
    meters = [([-0.58, 0, 0, 1], 0.35, 200.0), ([1, 0, 0, 0], 0.1, 15.0)]
    h = np.array([row for row, _, _ in meters])
    r = np.diag([0.35**2, 0.1**2 * 200 / 15])
    steps = [expm(a * dt * s) @ np.diag(walks**2) @ expm(a * dt * s).T for s in np.linspace(0, 1, 201)]
    noise = dt * np.trapezoid(steps, dx=1 / 200, axis=0)
    expected = solve_discrete_are(expm(a * dt).T, h.T, noise, r)
    np.testing.assert_allclose(observer.covariance(a, walks, meters), expected, rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize(
    ("accel", "flow", "rate", "drag"), list(itertools.product((0, 1e3), (0, 1e3), (0.01, 1000), (0, 2.0)))
)
def test_gains_are_finite_for_absurd_sensors(accel, flow, rate, drag):
    sensors = {
        "preset": "paper",
        "imu": {"accel_m_s2": {"noise": accel}, "gyro_deg_s": {"noise": accel}},
        "flow": {"rate_hz": rate, "velocity_m_s": {"noise": flow}},
        "baro": {"rate_hz": rate, "altitude_m": {"noise": flow}, "dropout": 1.0},
    }
    row = row_of(sensors, drag_n_s_m=drag)
    assert np.isfinite(row).all()
    assert np.abs(row[[GAIN.flow_v, GAIN.baro_z, GAIN.sonar_z, GAIN.mag_psi]]).max() <= 1.0
