"""The estimator's covariance against its errors where readings are late, correlated, or carry no heading.

On flights with known truth, over several seeds, the mean of e^T P^-1 e lies in the 95 % band of chi-square (Bar-Shalom,
Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", section 5.4.2).
"""

import math
from typing import Any

import numpy as np
import pytest
from consistency import band
from synthetic_flight import Circle, Flight, estimator, fly, readings, scenario

from zsim.math.frames import wrap_angle

SEEDS = range(4)  # few suffice: a fault exceeds the band by a factor of 3 to 1000
HEADED = range(6)
FLYING_S, STANDING_S = 10.0, 1000.0  # instant of the start [s]: within the flight, or after it
PRECISE = {"position_m": {"noise": 0.02}, "velocity_m_s": {"noise": 0.43}}
LATE = {
    "fixes at once": {"gps": {**PRECISE}},
    "fixes at 0.5 s": {"gps": {"latency_ms": 500, **PRECISE}},
    "fixes at 1 s": {"gps": {"latency_ms": 1000, **PRECISE}},
    "fixes at 2 s": {"gps": {"latency_ms": 2000, **PRECISE}},
    "velocities": {"gps": {"latency_ms": 1000, "velocity_m_s": {"noise": 0.02}}},
    "barometer": {"baro": {"latency_ms": 1000, "altitude_m": {"noise": 0.02}}},
    "sonar": {"sonar": {"latency_ms": 1000, "max_m": 30.0}},
    "flow": {"flow": {"latency_ms": 1000, "velocity_m_s": {"noise": 0.02}}},
}
CORRELATED = {
    "position": {"gps": {"position_m": {"noise": 2.0, "correlation_s": 20.0}}},
    "position, quickly": {"gps": {"position_m": {"noise": 2.0, "correlation_s": 0.1}}},
    "barometer": {
        "baro": {"altitude_m": {"noise": 0.5, "density": 0.02, "correlation_s": 60.0}},
        "sonar": {"max_m": 0.5},
    },
    "flow": {"flow": {"velocity_m_s": {"noise": 0.1, "correlation_s": 5.0}}},
    "accelerometer": {
        "imu": {"accel_m_s2": {"noise": 0, "density": 0.002, "bias_instability": 0.05, "correlation_s": 30}}
    },
}


def mean_nees(sensors: dict[str, Any], end_s: float, after_s: float) -> float:
    of = scenario(sensors=sensors)
    means = []
    for seed in SEEDS:
        flight = Circle(seed)
        estimates = [each for each in fly(estimator(of), readings(flight, of, seed, end_s), end_s) if each[0] > after_s]
        t = np.array([t for t, _ in estimates])
        truth = np.hstack([flight.position(t), flight.velocity(t)])
        e = np.array([[*each.position_m, *each.velocity_m_s] for _, each in estimates]) - truth
        P = np.array([each.covariance for _, each in estimates]).reshape(-1, 6, 6)
        means.append(np.mean(np.einsum("ti,ti->t", e, np.linalg.solve(P, e[..., None])[..., 0])))
    return float(np.mean(means))


def cases(of: dict[str, Any], *others: str) -> list[Any]:
    """Return cases by name; `others`, which exercise no code of their own, run only in the soak."""
    return [pytest.param(name, marks=[pytest.mark.soak] if name in others else []) for name in of]


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(LATE, "fixes at once", "fixes at 0.5 s", "fixes at 2 s"))
def test_late_readings_are_weighted_consistently(case: str):
    low, high = band(6, len(SEEDS))
    assert low < mean_nees(LATE[case], 30.0, 15.0) < high


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(CORRELATED, "position, quickly", "accelerometer"))
def test_correlated_errors_are_not_averaged_away(case: str):
    low, high = band(6, len(SEEDS))
    assert low < mean_nees(CORRELATED[case], 40.0, 10.0) < high


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "start_s"),
    [
        ((0.0, 0.0, 0.0), STANDING_S),
        ((0.0, 1.0, -45.0), FLYING_S),
        *(
            pytest.param(*case, marks=pytest.mark.soak)
            for case in (
                ((0.0, 0.0, 0.0), FLYING_S),
                ((0.0, 0.0, -45.0), FLYING_S),
                ((0.0, 0.0, -45.0), STANDING_S),
                ((0.0, 1.0, -45.0), STANDING_S),
            )
        ),
    ],
)
def test_a_field_without_heading_leaves_that_of_the_set_down(field: tuple[float, ...], start_s: float):
    end_s, errors, sigmas = 30.0, [], []
    of = scenario(environment={"magnetic_field_ut": list(field)}, yaw_deg=30.0)
    for seed in HEADED:
        flight = Flight(seed, start_s=start_s)
        flight.yaw_start = math.radians(30.0) + 0.05 * np.random.default_rng(seed).standard_normal()
        estimates = fly(estimator(of), readings(flight, of, seed, end_s), end_s)
        errors.append(wrap_angle(estimates[-1][1].yaw_rad - flight.heading(np.array([end_s]))[0]))
        sigmas.append(estimates[-1][1].yaw_sigma_rad)
    low, high = band(1, len(HEADED))
    assert low < np.mean(np.square(errors) / np.square(sigmas)) < high
    assert max(sigmas) < 0.06


def test_without_a_compass_heading_sigma_grows_by_the_gyroscope_bias():
    """A bias b that nothing measures turns the heading of a standing drone by b t: sigma^2 = set-down^2 + (b t)^2."""
    of = scenario(
        sensors={"imu": {"gyro_deg_s": {"noise": 0.01, "bias": 0.1}}},
        environment={"magnetic_field_ut": [0.0, 0.0, 0.0]},
        estimation={"flow": False},
    )
    flight = Flight(1, start_s=1000.0)
    estimates = fly(estimator(of), readings(flight, of, 1, 60.0), 60.0)
    for t, estimate in (estimates[k] for k in (500, 1500, 2900)):
        expected = math.hypot(0.05, math.radians(0.1) * (t - 1.0))
        assert estimate.yaw_sigma_rad == pytest.approx(expected, rel=0.1)
