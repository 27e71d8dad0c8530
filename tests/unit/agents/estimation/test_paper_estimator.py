"""The paper's estimator on flights with known truth, and the set of single-drone estimators."""

import math
from typing import Any

import numpy as np
import pytest
from refused import refused
from scipy.stats import chi2
from synthetic_flight import GATE_S, Flight, Reading, message, readings, scenario, seconds

from zsim.errors import DocumentError, UserCodeError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import ESTIMATORS, Scenario
from zsim_agents.estimation.drone_estimator import EstimatorSet, StateEstimate, estimator_class
from zsim_agents.estimation.paper_estimator import PaperEstimator

END_S = 60.0


def fly(core: Any, coming: list[Reading], end_s: float = END_S) -> list[tuple[float, StateEstimate]]:
    """Return the estimates at each gate."""
    rest, estimates = list(coming), []
    for gate in range(1, round(end_s / GATE_S) + 1):
        t_s = gate * GATE_S
        while rest and rest[0].t_s <= t_s + 1e-9:
            reading = rest.pop(0)
            core.receive(reading.sensor, message(reading))
        estimates.append((t_s, core.estimate(seconds(t_s))))
    return estimates


def paper(of: Scenario) -> PaperEstimator:
    return PaperEstimator(of.drones[0], of.environment, of.estimation, GATE_S)


def errors(flight: Flight, estimates: list[tuple[float, StateEstimate]]) -> np.ndarray:
    """Return the errors of position and velocity at each gate, (T, 6)."""
    t = np.array([t for t, _ in estimates])
    truth = np.hstack([flight.position(t), flight.velocity(t)])
    return np.array([np.concatenate([e.position_m, e.velocity_m_s]) for _, e in estimates]) - truth


def test_flights_are_followed_with_a_consistent_position_covariance():
    nees = []
    for seed in range(4):
        flight = Flight(seed)
        of = scenario(yaw_deg=math.degrees(flight.yaw_start))  # the initial heading is known
        estimates = fly(paper(of), readings(flight, of, seed, 40.0), 40.0)
        error = errors(flight, estimates)[round(20.0 / GATE_S) :]
        assert np.sqrt(np.mean(error[:, :3] ** 2, axis=0)).max() < 0.5  # m
        assert np.sqrt(np.mean(error[:, 3:] ** 2, axis=0)).max() < 0.2  # m/s, from single samples of velocity
        e, P = errors(flight, estimates)[-1, :3], np.reshape(estimates[-1][1].covariance, (6, 6))[:3, :3]
        nees.append(e @ np.linalg.solve(P, e))
    low, high = chi2.ppf([0.001, 0.999], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_fixes_of_a_moving_drone_reveal_the_heading():
    """The initial heading is 0.1 rad, two sigma, off; 2 m/s for a minute determine it more precisely."""
    of, speed = scenario(yaw_deg=0.0), 2.0
    core, rng = paper(of), np.random.default_rng(3)
    estimate = core.estimate(0.0)
    for gate in range(1, round(END_S / GATE_S) + 1):
        t_s = gate * GATE_S
        core.receive("imu", message(Reading(t_s, "imu", t_s, ((0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))))
        core.receive("flow", message(Reading(t_s, "flow", t_s, ((speed, 0.0, 0.0), 1.0))))
        if gate % 10 == 0:
            p = rng.normal(size=3) * 0.2 + (speed * t_s * math.cos(0.1), speed * t_s * math.sin(0.1), 0.0)
            core.receive("gps", message(Reading(t_s, "gps", t_s, (p, (0.0, 0.0, 0.0), 0.2, 3))))
        estimate = core.estimate(seconds(t_s))
    assert estimate.yaw_rad == pytest.approx(0.1, abs=4 * estimate.yaw_sigma_rad)
    assert estimate.yaw_sigma_rad < 0.02


def test_uncertainty_grows_without_a_velocity_or_a_fix():
    core = paper(scenario())
    core.receive("flow", message(Reading(0.0, "flow", 0.0, ((1.0, 0.0, 0.0), 0.0))))
    core.receive("gps", message(Reading(0.0, "gps", 0.0, ((5.0, 0.0, 0.0), (0.0, 0.0, 0.0), 2.0, 0))))
    before, after = core.estimate(0.0), core.estimate(10.0)
    assert tuple(after.velocity_m_s) == (0.0, 0.0, 0.0)
    assert np.ravel(after.covariance)[0] > np.ravel(before.covariance)[0] > 99.0**2


class Constant:
    """An estimator that returns a constant estimate."""

    given: Any = StateEstimate(np.zeros(3), [0, 0, 0], (1.0, 0.0, 0.0, 0.0), 0.0, np.eye(6), 1)

    def __init__(self, drone: Any, environment: Any, estimation: Any, gate_s: float) -> None:
        self.last: Any = None

    def receive(self, sensor: str, message: Any) -> None:
        pass

    def estimate(self, t_s: float) -> StateEstimate:
        return self.given

    def warm_start(self, last: Any) -> None:
        self.last = last


def set_of(kind: Any) -> EstimatorSet:
    of = scenario()
    return EstimatorSet(kind, of.drones, of.environment, of.estimation, GATE_S)


def test_numbers_of_any_kind_are_published_as_floats():
    (estimate,) = set_of(Constant).estimate(0.02)
    assert estimate.covariance == tuple(np.eye(6).ravel())
    assert {type(x) for x in (*estimate.position_m, *estimate.velocity_m_s, estimate.yaw_sigma_rad)} == {float}


@pytest.mark.parametrize(
    ("field", "value"), [("position_m", (0.0, math.nan, 0.0)), ("covariance", np.eye(3)), ("yaw_rad", math.inf)]
)
def test_an_invalid_estimate_is_refused_with_class_and_field(field: str, value: Any):
    wrong = type("Wrong", (Constant,), {"given": Constant.given._replace(**{field: value})})
    with refused(UserCodeError, f"{__name__}:Wrong.estimate", "drone1", field, "finite"):
        set_of(wrong).estimate(0.02)


def test_the_last_estimate_is_passed_to_estimators_that_can_use_it():
    both = set_of(Constant)
    both.warm_start(0, Constant.given)
    assert both._estimators[0].last is Constant.given  # type: ignore[attr-defined]
    set_of(PaperEstimator).warm_start(0, Constant.given)


def test_built_in_estimators_have_names_and_the_default_is_not_written():
    assert estimator_class(ESTIMATORS[0]) is None
    assert estimator_class("paper") is PaperEstimator
    with pytest.raises(DocumentError, match="algorithm"):
        estimator_class("zsim_agents.estimation.strapdown:Madgwick")
    assert "algorithm" not in scenario_file.to_text(scenario())
    chosen = scenario(estimation={"algorithm": "paper"})
    assert scenario_file.from_text(scenario_file.to_text(chosen)).estimation.chosen() == "paper"
