"""Sensor errors against closed forms: Gauss-Markov process, Allan deviation, noise at the sensor's own rate.

IEEE Std 952-1997, annex C: white noise of density N has the Allan deviation N / sqrt(tau), a random walk K has
K sqrt(tau / 3), a Gauss-Markov process of sigma and T peaks at tau = 1.89 T with 0.617 sigma.
"""

import math
from typing import Any

import numpy as np
import pytest
from fleet_samples import samples_of
from numpy.typing import NDArray

from zsim.math.randomness import stream
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import Fleet
from zsim_world.sensors import sensor_set
from zsim_world.sensors.sensor_set import BARO, FAULT, read

Array = NDArray[np.float64]
RATE_HZ = 50.0


def scenario(**sensors: Any):
    drones = [{"name": f"d{k}", "position_m": [3.0 * k, 0.0, 0.0]} for k in range(40)]
    return resolve({"name": "t", "duration_s": 1, "drones": drones, "sensors": {"preset": "paper", **sensors}})


def errors(model: dict[str, float], samples: int) -> Array:
    """Return successive errors of a barometer with this error model at RATE_HZ."""
    of = scenario(baro={"rate_hz": RATE_HZ, "altitude_m": {"noise": 0.0, **model}})
    sensors = sensor_set.fleet_sensors(of)
    config, found = sensor_set.config(sensors)[0, BARO], np.zeros((samples, 6))
    width = sensor_set.noise_width(1, sensor_set.channels(of.drones[0].sensors, "baro"))
    noise, bias, fault = stream(5, "errors").standard_normal((samples, width)), np.zeros(12), np.zeros(FAULT.size)
    for value, numbers in zip(found, noise, strict=True):
        assert read(1, value, config, bias, fault, numbers)
    return found[:, 0]


def allan(x: Array, tau_s: float) -> float:
    """Return the overlapping Allan deviation of samples at RATE_HZ."""
    m = round(tau_s * RATE_HZ)
    sums = np.concatenate(([0.0], np.cumsum(x)))
    means = (sums[m:] - sums[:-m]) / m
    return math.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2))


@pytest.mark.parametrize("tau_s", [0.1, 1.0, 10.0])
def test_white_noise_has_the_allan_deviation_of_its_density(tau_s: float):
    assert allan(errors({"density": 0.02}, 100_000), tau_s) == pytest.approx(0.02 / math.sqrt(tau_s), rel=0.1)


@pytest.mark.parametrize("tau_s", [0.3, 3.0])
def test_a_random_walk_has_its_allan_deviation(tau_s: float):
    assert allan(errors({"bias_walk": 0.02}, 200_000), tau_s) == pytest.approx(0.02 * math.sqrt(tau_s / 3.0), rel=0.1)


def test_the_allan_deviation_of_a_bias_instability_has_its_peak():
    x = errors({"bias_instability": 0.1, "correlation_s": 0.5}, 200_000)
    found = [allan(x, tau_s) for tau_s in (0.2, 0.94, 5.0)]
    assert found[1] == pytest.approx(0.617 * 0.1, rel=0.05)
    assert max(found[0], found[2]) < found[1]
    assert x.std() == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize("lag_s", [0.0, 0.2, 1.0, 3.0])
def test_the_autocorrelation_decays_with_the_correlation_time(lag_s: float):
    x = errors({"noise": 0.1, "density": 0.002, "correlation_s": 1.0}, 400_000)
    lag = round(lag_s * RATE_HZ)
    found = np.mean(x[lag:] * x[: x.size - lag])
    white = 0.002**2 * RATE_HZ if lag == 0 else 0.0
    assert found == pytest.approx(
        0.01 * math.exp(-lag_s) + white, abs=0.01 * 4.0 * math.sqrt(2.0 / (400_000 / RATE_HZ))
    )


def test_correlated_errors_are_stationary_from_the_first_sample():
    of = scenario(gps={"position_m": {"noise": 2.0, "correlation_s": 3.0}, "rate_hz": 5.0})
    fleet, fixes = Fleet(of), []
    for _ in range(200):
        fleet.advance()
        fixes += [(s.drone, s.values[3:6]) for s in samples_of(fleet) if s.sensor == "gps"]
    truth = fleet.truth().position_m
    by_drone = np.array([[p - truth[i] for drone, p in fixes if drone == i] for i in range(40)])  # (40, samples, 3)
    bound = 4.0 * math.sqrt(2.0 / 120)  # for the three axes of 40 drones
    for sample in (0, 10, -1):
        assert np.mean(by_drone[:, sample] ** 2) == pytest.approx(4.0, rel=bound)
    both = np.mean(by_drone[:, 0] * by_drone[:, 15])  # 3 s apart
    assert both == pytest.approx(4.0 * math.exp(-1.0), abs=4.0 * bound)


def test_correlated_errors_leave_other_drones_noise_unchanged():
    drones: list[dict[str, Any]] = [{"name": name, "position_m": [3.0 * k, 0, 0]} for k, name in enumerate("ab")]
    document = {"name": "t", "duration_s": 1, "drones": drones, "sensors": {"preset": "paper"}}
    plain = Fleet(resolve(document))
    drones[1] = {**drones[1], "sensors": {"gps": {"position_m": {"correlation_s": 10.0}}}}
    other = Fleet(resolve({**document, "drones": drones}))
    for _ in range(50):
        plain.advance()
        other.advance()
        of_first = [[s for s in samples_of(fleet) if s.drone == 0] for fleet in (plain, other)]
        assert of_first[0] == of_first[1]


@pytest.mark.parametrize("rate_hz", [200.0, 50.0])
def test_the_noise_density_of_the_imu_applies_at_its_own_rate(rate_hz: float):
    models = {"accel_m_s2": {"noise": 0.0, "density": 0.004}, "gyro_deg_s": {"noise": 0.0, "density": 0.01}}
    of = scenario(imu={"rate_hz": rate_hz, **models})
    fleet, found = Fleet(of), []
    for _ in range(150):
        fleet.advance()
        found += [s.values for s in samples_of(fleet) if s.sensor == "imu" and s.t_sample_ns > 10**9]
    sigma = np.std(found, axis=0)
    bound = 4.0 * math.sqrt(0.5 / len(found))
    assert sigma[:3] == pytest.approx(0.004 * math.sqrt(rate_hz), rel=bound)
    assert sigma[3:] == pytest.approx(math.radians(0.01) * math.sqrt(rate_hz), rel=bound)
