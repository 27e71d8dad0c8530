"""The estimator's covariance against its errors, over 12 seeds of the simulated world with gusts.

The normalised estimation error squared e^T P^-1 e of position and velocity has a chi-square distribution
with 6 degrees of freedom if the covariance is right. Its mean over runs must lie in the 95 % band of that
distribution (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation",
section 5.4.2).
"""

import math
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from consistency import band, feed
from fleet_samples import samples_of
from numpy.typing import NDArray
from scipy.stats import chi2

from zsim.math.frames import heading, wrap_angle
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.estimator_bank import EstimatorBank
from zsim_world.fleet.fleet import Fleet

SCENARIO = Path(__file__).parents[2] / "scenarios" / "step.yaml"  # three drones, preset paper, gusts of 0.5 m/s
SEEDS = range(1, 13)
TAKEOFF_S, FLYING_S, END_S = 2.0, 8.0, 32.0  # s
CONVERGED_S = 14.0  # s
HEIGHT_M, CIRCLE_M, CIRCLE_RAD_S = 4.0, 2.0, 0.4  # a circle beside the start makes the drones manoeuvre
GAIN_1_S, SPEED_M_S = 0.6, 1.0

Array = NDArray[np.float64]


class Runs(NamedTuple):
    """Errors and covariances of R drones (three per seed) at T gates after convergence."""

    error: Array  # (R, T, 6), position [m] and velocity [m/s]
    covariance: Array  # (R, T, 6, 6)
    heading_error: Array  # (R, T) [rad]
    heading_sigma: Array  # (R, T) [rad]

    def nees(self, part: slice = slice(0, 6)) -> Array:
        """Return the normalised squared error (R, T) of a part of the state."""
        e, P = self.error[..., part], self.covariance[..., part, part]
        return np.einsum("rti,rti->rt", e, np.linalg.solve(P, e[..., None])[..., 0])


CASES = {
    "paper": [],
    "as printed": ["sensors.as_printed=true"],
    "ardrone2": ["sensors.preset=ardrone2"],
}


@pytest.fixture(scope="module", params=["paper", pytest.param("as printed", marks=pytest.mark.soak), "ardrone2"])
def runs(request: pytest.FixtureRequest) -> Runs:
    return flown(request.param)


@cache
def flown(case: str) -> Runs:
    flights = [fly(scenario_file.load(SCENARIO, CASES[case], seed=seed)) for seed in SEEDS]
    return Runs(*(np.concatenate(parts) for parts in zip(*flights, strict=True)))


def fly(scenario: Scenario) -> Runs:
    """Take off and fly circles on the estimates, as a controller would."""
    fleet = Fleet(scenario)
    gate_s = scenario.time.gate_ms / 1000.0
    bank = EstimatorBank(scenario.drones, scenario.environment, scenario.estimation, gate_s)
    rows = []
    for gate in range(round(END_S / gate_s) + 1):
        if gate:
            fleet.advance()
        t = gate * gate_s
        for sample in samples_of(fleet):
            feed(bank, sample, fleet.gps_sigma_m[sample.drone])
        estimates = bank.estimate(t)
        steer(fleet, scenario, estimates, t, gate_s)
        if t > CONVERGED_S:
            rows.append(compare(fleet, estimates))
    return Runs(*(np.stack(parts, 1) for parts in zip(*rows, strict=True)))


def steer(fleet: Fleet, scenario: Scenario, estimates: list[StateEstimate], t: float, gate_s: float) -> None:
    for i, (drone, estimate) in enumerate(zip(scenario.drones, estimates, strict=True)):
        if abs(t - TAKEOFF_S) < gate_s / 2.0:
            assert fleet.takeoff(i) is None
        elif t > FLYING_S:
            angle = CIRCLE_RAD_S * (t - FLYING_S)
            circle = (CIRCLE_M * math.sin(angle), CIRCLE_M * (1.0 - math.cos(angle)), HEIGHT_M)
            away = np.add(drone.position_m, circle) - estimate.position_m
            v = np.clip(GAIN_1_S * away, -SPEED_M_S, SPEED_M_S)
            c, s = math.cos(estimate.yaw_rad), math.sin(estimate.yaw_rad)
            ahead, left = c * v[0] + s * v[1], c * v[1] - s * v[0]
            assert fleet.set_velocity(i, (ahead, left, v[2]), yaw_rate_rad_s=0.1 * i) is None


def compare(fleet: Fleet, estimates: list[StateEstimate]) -> tuple[Array, Array, Array, Array]:
    """Return the fields of `Runs` for one gate."""
    truth = fleet.truth()
    p = np.array([e.position_m for e in estimates]) - truth.position_m
    v = np.array([e.velocity_m_s for e in estimates]) - truth.velocity_m_s
    yaw = np.array([e.yaw_rad for e in estimates]) - heading(truth.orientation_wxyz)
    P = np.array([e.covariance for e in estimates]).reshape(-1, 6, 6)
    return np.hstack([p, v]), P, wrap_angle(yaw), np.array([e.yaw_sigma_rad for e in estimates])


@pytest.mark.slow
class TestConsistency:
    """All checks use the same flights, one fixture per set of sensors."""

    def test_the_mean_nees_over_the_flight_is_in_the_band(self, runs: Runs):
        """One drone per seed, as the runs must be independent; then all three, whose sensors are independent."""
        low, high = band(6, len(SEEDS))
        assert low < runs.nees()[::3].mean() < high
        low, high = band(6, 3 * len(SEEDS))
        assert low < runs.nees().mean() < high

    def test_the_mean_nees_at_most_instants_is_in_the_band(self, runs: Runs):
        """19 of 20 instants are expected in the band; as neighbours are correlated, 17 suffice."""
        low, high = band(6, len(SEEDS))
        means = runs.nees()[::3, ::45].mean(0)
        assert len(means) == 20
        assert np.count_nonzero((low < means) & (means < high)) >= 17

    @pytest.mark.parametrize("part", [slice(0, 3), slice(3, 6)], ids=["position", "velocity"])
    def test_position_and_velocity_are_each_in_the_band(self, runs: Runs, part: slice):
        low, high = band(3, len(SEEDS))
        assert low < runs.nees(part)[::3].mean() < high

    def test_errors_are_small_and_match_the_estimated_sigma(self, runs: Runs):
        rms = np.sqrt((runs.error**2).mean((0, 1)))
        sigma = np.sqrt(np.einsum("rtii->rti", runs.covariance).mean((0, 1)))
        assert rms == pytest.approx(sigma, rel=0.25)
        assert rms[:2].max() < 0.30  # m; 0.2 m after 14 s of averaging, which converges to 0.16 m
        assert rms[2] < 0.03  # m

    def test_heading_errors_are_small_and_match_the_estimated_sigma(self, runs: Runs):
        rms = math.sqrt((runs.heading_error**2).mean())
        assert rms < 0.01  # rad
        assert rms == pytest.approx(math.sqrt((runs.heading_sigma**2).mean()), rel=0.3)


@pytest.mark.parametrize("case", CASES)
def test_the_covariance_covers_a_fall_to_the_ground(case: str):
    """The rotors stop at 1 m; the impact falls between two IMU samples, and the covariance must allow for it."""
    scenario = scenario_file.load(SCENARIO, CASES[case], seed=1)
    fleet = Fleet(scenario)
    gate_s = scenario.time.gate_ms / 1000.0
    bank = EstimatorBank(scenario.drones, scenario.environment, scenario.estimation, gate_s)
    nees, heights = [], []
    for gate in range(round(12.0 / gate_s)):
        fleet.advance()
        for sample in samples_of(fleet):
            feed(bank, sample, fleet.gps_sigma_m[sample.drone])
        error, P, _, _ = compare(fleet, bank.estimate(fleet.t_ns * 1e-9))
        if gate == round(1.0 / gate_s):
            assert [fleet.takeoff(i) for i in range(3)] == [None] * 3
        if gate == round(8.0 / gate_s):
            assert [fleet.emergency(i) for i in range(3)] == [None] * 3
        if gate > round(8.0 / gate_s):
            nees.append(np.einsum("ri,ri->r", error, np.linalg.solve(P, error[..., None])[..., 0]))
        heights.append(fleet.truth().position_m[0, 2])
    assert max(heights) > 0.9
    assert heights[-1] < 0.1
    assert np.max(nees) < chi2.ppf(1.0 - 1e-7, 6)
