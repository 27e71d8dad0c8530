"""The joint filter against the truth over 12 seeds, and against the bound of an independently written Kalman filter.

Relative position has three degrees of freedom; its normalised squared error, averaged over runs, must lie in the 95 %
band of chi-square (Bar-Shalom, Li and Kirubarajan, section 5.4.2). The bound is the steady state of a filter for
position, velocity and attitude of level drones with all biases known: no estimator with the same sensors can be better.
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

from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.sensors.camera import SightingModel
from zsim_agents.estimation.joint_filter import JointBank
from zsim_world.fleet.fleet import Fleet
from zsim_world.sensors.sightings import DIAMETER_NOISE

SCENARIO = Path(__file__).parents[2] / "scenarios" / "step.yaml"
SIGHTED = ["sensors.front_camera={}", "sensors.sightings={}", "estimation.use_sightings=true"]
SEEDS = range(1, 13)
TAKEOFF_S, END_S, CONVERGED_S = 1.0, 32.0, 18.0
EVERY = 25  # gates from one comparison to the next
GATE_S = 0.02
ACCEL_M_S2, GYRO_RAD_S, IMU_S = 0.35, math.radians(0.01), 0.005  # per sample; preset paper
GRAVITY_M_S2 = 9.81
GPS_M, GPS_M_S, GPS_S = 2.0, 0.43, 0.2
FLOW_M_S, FLOW_S = 0.1, 1 / 15
BARO_M, BARO_S = 0.1, 0.04
MAG_UT, FIELD_UT, MAG_S = 0.94, 18.0, 0.04  # noise, and the horizontal field that gives the heading
SIGHTING_S = 1 / 15
FOCAL_PX, HAT_M = 354.55, 0.14
HAT_W_M, LENS_W_M = np.array([0.0, -0.03, 0.11]), np.array([0.0, 0.162, 0.012])  # on a drone that heads north
MODEL = SightingModel()
WITHIN = 0.6  # least share of instants in the band; the filter is cautious about errors of a few millimetres
NOT_ABOVE = 0.95  # least share of instants not above the band
Array = NDArray[np.float64]
pytestmark = pytest.mark.xdist_group("sightings")


class Relative(NamedTuple):
    """Errors of drones 2 and 3 relative to drone 1, at T instants after convergence in R flights."""

    error: Array  # (R, T, 2, 3) [m]
    covariance: Array  # (R, T, 2, 3, 3)
    places: Array  # (3, 3), true positions of the drones at the end, averaged over the flights [m]


@cache
def flown(*fields: str) -> Relative:
    parts = [fly(scenario_file.load(SCENARIO, [*SIGHTED, *fields], seed=seed)) for seed in SEEDS]
    error, covariance, places = (np.array([part[k] for part in parts]) for k in range(3))
    return Relative(error, covariance, places.mean(axis=0))


def fly(scenario: Scenario) -> Relative:
    """Take off and hover in gusts, heading north, so that drones 2 and 3 have drone 1 ahead."""
    fleet, bank = Fleet(scenario), JointBank(scenario.drones, scenario.environment, scenario.estimation, GATE_S)
    errors, covariances = [], []
    for gate in range(round(END_S / GATE_S) + 1):
        t_s = gate * GATE_S
        if gate:
            fleet.advance()
        for sample in samples_of(fleet):
            feed(bank, sample, fleet.gps_sigma_m[sample.drone])
        for each in fleet.observations.values():
            bank.receive(each.drone, "sightings", each.message(0), each.t_ns * 1e-9)
        estimates = bank.estimate(t_s)
        if abs(t_s - TAKEOFF_S) < GATE_S / 2:
            assert [fleet.takeoff(i) for i in range(3)] == [None] * 3
        if t_s > CONVERGED_S and gate % EVERY == 0:
            p = np.array([each.position_m for each in estimates]) - fleet.truth().position_m
            errors.append(p[1:] - p[0])
            covariances.append([relative(bank.rows.joint, bank.rows.covariance.shape[1], i) for i in (1, 2)])
    return Relative(np.array(errors), np.array(covariances), fleet.truth().position_m)


def relative(J: Array, n: int, i: int) -> Array:
    """Return the covariance of drone i's position relative to the first drone, (3, 3)."""
    a, b = slice(0, 3), slice(i * n, i * n + 3)
    return J[a, a] + J[b, b] - J[a, b] - J[b, a]


@pytest.mark.slow
@pytest.mark.parametrize("i", [pytest.param(0, marks=pytest.mark.soak), 1])
def test_relative_position_errors_match_the_filter_s_covariance(i: int) -> None:
    runs = flown()
    e, P = runs.error[:, :, i], runs.covariance[:, :, i]
    nees = np.einsum("rti,rti->rt", e, np.linalg.solve(P, e[..., None])[..., 0])
    low, high = band(3, len(SEEDS))
    means = nees.mean(axis=0)  # over runs, at instants half a second apart, about a correlation time
    assert np.mean((means > low) & (means < high)) >= WITHIN
    assert np.mean(means < high) >= NOT_ABOVE
    assert low < nees.mean() < high


@pytest.mark.slow
def test_relative_positions_come_close_to_the_bound() -> None:
    runs = flown()
    rms = math.sqrt(np.mean(np.sum(runs.error[..., :2] ** 2, axis=-1)))
    best = math.sqrt(np.mean(np.sum(bound(runs.places)[:, :2] ** 2, axis=-1)))
    assert 0.9 < rms / best < 1.15


def bound(places: Array) -> Array:
    """Return the least standard deviation of the relative positions per axis, (2, 3) [m]."""
    C, F, Q = np.diag(np.tile([4.0] * 3 + [1.0] * 3 + [0.0025] * 3, 3)), np.eye(27), np.zeros((27, 27))
    accel, gyro = ACCEL_M_S2**2 * IMU_S, GYRO_RAD_S**2 * IMU_S
    for first in (0, 9, 18):
        p, v, turn = (range(first + k, first + k + 3) for k in (0, 3, 6))
        F[p, v] = GATE_S
        F[v[0], turn[1]], F[v[1], turn[0]] = GRAVITY_M_S2 * GATE_S, -GRAVITY_M_S2 * GATE_S
        Q[p, p], Q[v, v], Q[turn, turn] = accel * GATE_S**3 / 3, accel * GATE_S, gyro * GATE_S
        Q[p, v] = Q[v, p] = accel * GATE_S**2 / 2
    for gate in range(1, round(CONVERGED_S / GATE_S)):
        C = F @ C @ F.T + Q
        due = [period for period in (GPS_S, FLOW_S, BARO_S, MAG_S, SIGHTING_S) if _is_due(gate, period)]
        for first in (0, 9, 18):
            C = _own_sensors(C, first, due)
        if SIGHTING_S in due:
            for i in (1, 2):
                C = _sighting(C, places, i)
    apart = [C[:3, :3] + C[k : k + 3, k : k + 3] - C[:3, k : k + 3] - C[k : k + 3, :3] for k in (9, 18)]
    return np.sqrt([np.diag(each) for each in apart])


def _is_due(gate: int, period_s: float) -> bool:
    return int(gate * GATE_S / period_s + 1e-9) > int((gate - 1) * GATE_S / period_s + 1e-9)


def _own_sensors(C: Array, first: int, due: list[float]) -> Array:
    states = np.eye(27)[first : first + 9]
    if GPS_S in due:
        C = _updated(C, states[:6], [GPS_M] * 3 + [GPS_M_S] * 3)
    if FLOW_S in due:
        C = _updated(C, states[3:6], [FLOW_M_S] * 3)
    if MAG_S in due:
        C = _updated(C, states[8:9], [MAG_UT / FIELD_UT])
    return _updated(C, states[2:3], [BARO_M]) if BARO_S in due else C


def _sighting(C: Array, places: Array, i: int) -> Array:
    """Return C after drone i, heading north, has seen the hat of the first drone."""
    to_hat = places[0] + HAT_W_M - places[i]
    d = to_hat - LENS_W_M
    away = float(np.linalg.norm(d))
    d = d / away
    side = np.cross(d, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    scale = FOCAL_PX / d[1] ** 1.5  # px/rad off the axis
    diameter_px = HAT_M / away * scale
    noise_px = MODEL.noise_px2 / diameter_px
    centre, diameter = math.hypot(MODEL.centre_px, noise_px), math.hypot(MODEL.diameter_px, DIAMETER_NOISE * noise_px)
    across, along = away * centre / scale, away * diameter / diameter_px
    H = np.zeros((3, 27))
    for k, axis in enumerate((d, side, np.cross(d, side))):
        H[k, :3], H[k, 6:9] = axis, np.cross(HAT_W_M, axis)
        H[k, 9 * i : 9 * i + 3], H[k, 9 * i + 6 : 9 * i + 9] = -axis, np.cross(axis, to_hat)
    return _updated(C, H, [along, across, across])


def _updated(C: Array, H: Array, sigmas: list[float]) -> Array:
    S = H @ C @ H.T + np.diag(np.square(sigmas))
    K = np.linalg.solve(S, H @ C).T
    C = C - K @ S @ K.T
    return (C + C.T) / 2
