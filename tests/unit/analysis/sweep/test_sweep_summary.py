"""The summary of a sweep: confidence intervals, distributions, and names of columns and fields."""

import math

import numpy as np
import pytest
import scipy.stats
from sweep_rows import made, plan, well

from zsim.math.randomness import stream
from zsim_analysis.sweep.design import SweepDesign
from zsim_analysis.sweep.sweep_summary import (
    LEVEL,
    RUNS_MIN,
    FormationParameter,
    SweepResults,
    distribution,
    field_name,
    mean_interval,
    parameters,
    share_interval,
)


@pytest.mark.parametrize("n", [RUNS_MIN, 10, 200])
def test_the_interval_of_a_mean_is_student_s_t_interval(n: int) -> None:
    samples = stream(n, "samples").normal(3.0, 2.0, n)
    found = mean_interval(samples)
    wanted = scipy.stats.t.interval(LEVEL, n - 1, samples.mean(), scipy.stats.sem(samples))
    assert (found.low, found.high) == pytest.approx(wanted, rel=1e-12)
    assert found.value == samples.mean()


@pytest.mark.parametrize("n", range(1, RUNS_MIN))
def test_few_samples_have_a_mean_but_no_interval(n: int) -> None:
    """For example, two runs with 0.044 m and 0.190 m would give 0.117 ± 0.935 m."""
    found = mean_interval(np.full(n, 4.0))
    assert found.value == 4.0
    assert math.isnan(found.low)
    assert math.isnan(found.high)


@pytest.mark.parametrize(("count", "of"), [(0, 1), (1, 1), (0, 30), (30, 30), (1, 30), (17, 30), (999, 1000)])
def test_the_interval_of_a_share_is_the_exact_binomial_one(count: int, of: int) -> None:
    found = share_interval(count, of)
    wanted = scipy.stats.binomtest(count, of).proportion_ci(LEVEL, "exact")
    assert (found.low, found.high) == pytest.approx((wanted.low, wanted.high), rel=1e-9)
    if count == 0:
        assert found.high == pytest.approx(1 - ((1 - LEVEL) / 2) ** (1 / of), rel=1e-12)


def test_a_distribution_ignores_values_that_are_not_finite() -> None:
    found = distribution(np.array([1.0, 2.0, 3.0, 4.0, np.nan, np.inf]))
    assert found is not None
    assert (found.runs, found.median, found.least, found.greatest) == (4, 2.5, 1.0, 4.0)
    assert found.std == pytest.approx(math.sqrt(5 / 3))
    assert found.samples == (1.0, 2.0, 3.0, 4.0)
    many = distribution(np.arange(RUNS_MIN, dtype=float))
    assert many is not None
    assert many.samples == ()
    assert distribution(np.array([np.nan])) is None


def test_formation_parameters_are_found_in_names_of_columns() -> None:
    columns = ["errors.x_c.est_std", "errors.x_c.true_rms", "errors.left.p.true_rms"]
    columns.append("clusters.a.b.errors.yaw.true_rms")
    found = parameters(columns, ["main", "a.b"])
    assert found == {
        "errors.x_c": FormationParameter("x_c", "main"),
        "errors.left.p": FormationParameter("left.p", "main"),
        "clusters.a.b.errors.yaw": FormationParameter("yaw", "a.b"),
    }
    assert parameters(columns[:1], ["main"]) == parameters(columns[:1], []) == {"errors.x_c": FormationParameter("x_c")}
    hostile = parameters(["clusters.errors.errors.x_c.est_std"], ["a", "errors"])
    assert hostile == {"clusters.errors.errors.x_c": FormationParameter("x_c", "errors")}
    assert [each.labelled("x_c (m)") for each in hostile.values()] == ["errors: x_c (m)"]


def test_values_of_a_failed_run_are_not_samples() -> None:
    of = plan("seed", runs=3)
    results = SweepResults(SweepDesign(of), [well(of, 0), made(of, 1, failure="x", min_separation_m=0.1), well(of, 2)])
    assert results.values("min_separation_m").tolist() == [2.0, 2.2]
    assert results.ended_well(0) == (2, 3)
    assert results.without_collision(0) == (2, 2)


def test_differences_are_between_runs_with_the_same_seed() -> None:
    """Effects of the seed on both runs cancel; pairs with a failed or unplanned run are omitted."""
    of = plan("seed=paired", "a.b=0,1,2", runs=18)
    of_seed = stream(3, "seed").normal(0.0, 5.0, 6)
    rows = [well(of, run) | {"metrics.m": of_seed[run // 3] + 0.25 * (run % 3)} for run in range(18)]
    rows[7] = rows[7] | {"as_planned": False}
    rows[4] = made(of, 4, failure="x")
    results = SweepResults(SweepDesign(of), rows)
    summary = results.summary()
    assert [results.differences("metrics.m", point).tolist() for point in range(3)] == [
        [],
        pytest.approx([0.25] * 4),
        pytest.approx([0.5] * 6),
    ]
    assert len(results.differences("errors.x_c.true_rms", 1)) == 4
    found = summary.points[2].differences["metrics.m"]
    assert (found.runs, found.mean.value) == (6, pytest.approx(0.5))
    assert found.mean.high - found.mean.low == pytest.approx(0.0, abs=1e-9)
    apart = summary.points[2].spreads["metrics.m"].mean
    assert apart.high - apart.low > 5
    assert {"min_separation_m", "errors.x_c.true_rms"} <= set(summary.points[1].differences)
    unpaired = plan("seed", "a.b=0,1,2", runs=12)
    results = SweepResults(SweepDesign(unpaired), [well(unpaired, run) for run in range(12)])
    assert not results.summary().points[2].differences


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("sensors.gps.position_m.noise", "GPS position noise (m)"),
        ("environment.wind.gust_m_s", "wind gust (m/s)"),
        ("sensors.imu.accel_m_s2.density", "IMU accelerometer density (m/s²/√Hz)"),
        ("sensors.imu.gyro_deg_s.bias_walk", "IMU gyroscope bias walk (deg/s/√s)"),
        ("sensors.gps.dropout", "GPS dropout"),
        ("drones.drone2.mass_kg", "drone2 mass (kg)"),
        ("drones[1].mass_kg", "drone 1 mass (kg)"),
        ("clusters.main.gains.proportional_1_s", "main gains proportional (1/s)"),
        ("clusters.main.plan.takeoff_s", "main plan take-off (s)"),
        ("clusters.main.plan.target.p", "main plan target p (m)"),
        ("clusters.main.plan.target.x_c", "main plan target x_c (m)"),
        ("clusters[0].plan.target.beta", "cluster 0 plan target beta (rad)"),
        ("clusters.main.plan.target.yaw_deg", "main plan target yaw (deg)"),
        ("clusters.main.plan.target[left.phi_2]", "main plan target left.phi_2 (rad)"),
        ("clusters.main.plan.trajectory.waypoints[0].values.w_1", "main plan trajectory waypoints 0 values w_1 (m)"),
        ("clusters.main.plan.trajectory.expressions.z_c", "main plan trajectory expressions z_c (m)"),
        ("clusters.main.plan.trajectory.constants.r", "main plan trajectory constants r"),
        ("clusters.plan.gains.proportional_1_s", "plan gains proportional (1/s)"),
        ("clusters.main.law_parameters.push_1_s", "main push (1/s)"),
        ("agents.pilot.parameters.gain_1_s", "pilot gain (1/s)"),
        ("agents.pilot.class", "pilot class"),
        ("sensors.preset", "sensors preset"),
        ("duration_s", "duration (s)"),
        ("seed", "seed"),
        ("metrics.overshoot_m", "overshoot (m)"),
    ],
)
def test_a_field_has_a_readable_name_with_a_unit(path: str, name: str) -> None:
    assert str(field_name(path)) == name
    words, _, unit = name.partition(" (")
    assert field_name(path).at("1.5") == f"{words} 1.5 {unit.removesuffix(')')}".rstrip()
