"""Runs per hour: the paths that peers follow, workers that answer requests for flights, and the table."""

import sys
from pathlib import Path

import numpy as np
import pytest
from refused import has_terms, refused

from benchmarks import runs_per_hour
from benchmarks.child import RefusedError, Server
from benchmarks.monte_carlo import zsim_sweep
from benchmarks.monte_carlo.way import Way, read, write
from benchmarks.sheet import Sheet

FLYER = """
from benchmarks.monte_carlo.worker import Flown, serve
def build(way, given):
    def fly(seed):
        if seed > 9:
            raise ValueError("seed")
        return Flown(given.flights * way.span_s, float("nan") if seed < 0 else 0.1 * seed, 2.0)
    return fly
serve(build, flights=3, batch=False)
"""


def way(points: int) -> Way:
    rng = np.random.default_rng(1)
    return Way(rng.normal(size=(points, 3, 3)), rng.normal(size=(points, 3, 3)), rng.normal(size=(points, 3)))


def sheet() -> Sheet:
    made = Sheet("f", "runs per hour", notes={"sweep_runs": 12})
    for ours, theirs in ((1000.0, 2000.0), (800.0, 2400.0), (1200.0, 1200.0)):
        made.add("zsim", 2, ours)
        made.add("zsim_cpu_s", 2, 4.5)
        made.add("zsim_closest_m", 2, 2.47)
        made.add("crazyflow", 2, theirs)
        made.add("crazyflow_cpu_s", 2, 0.15)
        made.add("crazyflow_rms_m", 2, 0.08)
        made.add("crazyflow_closest_m", 2, 2.46)
    made.refused = {"pybullet": "pip: none", "rotorpy@2": "no answer within 300 s"}
    return made


def test_a_path_is_read_as_written(tmp_path: Path) -> None:
    made = way(51)
    write(made, tmp_path / "way.npz")
    found = read(tmp_path / "way.npz")
    assert all(np.array_equal(a, b) for a, b in zip(made, found, strict=True))
    assert found.span_s == pytest.approx(1.0)
    assert [found.at(t_s) for t_s in (0.0, 0.019, 0.02, 0.06, 0.99, 5.0)] == [0, 0, 1, 3, 49, 50]


def test_a_worker_reports_its_flights_and_refuses_failed_ones(tmp_path: Path) -> None:
    write(way(51), tmp_path / "way.npz")
    server = Server([sys.executable, "-c", FLYER, str(tmp_path / "way.npz"), "1", "--flights", "2"])
    try:
        found = server.ask({"seed": 4}, 30.0)
        assert found["flights"] == pytest.approx(2.0)
        assert found["rms_m"] == pytest.approx(0.4)
        assert 0.0 <= found["cpu_s"] < 5.0
        with refused(RefusedError, "diverged"):
            server.ask({"seed": -1}, 30.0)
        with refused(RefusedError, "ValueError: seed"):
            server.ask({"seed": 10}, 30.0)
    finally:
        server.close()


def test_the_table_compares_equal_repeats_and_names_missing_peers() -> None:
    page = runs_per_hour.page(sheet())
    assert has_terms(page, "zsim sweep", "1 000 (800 to 1 200)", "4.5 (4.5 to 4.5)", "–", "2.47", "12 runs")
    assert has_terms(page, "crazyflow", "2 000 (1 200 to 2 400)", "2 (1 to 3)", "0.15 (0.15 to 0.15)")
    assert has_terms(page, "world alone / crazyflow", "–", "–")
    assert has_terms(page, "PID", "not measured", "pip: none")
    assert has_terms(page, "EKF", "not measured", "300 s")
    assert has_terms(page, "MuJoCo", "not flown")


@pytest.mark.soak
def test_the_world_alone_follows_the_path_of_a_flight(tmp_path: Path) -> None:
    flown = zsim_sweep.flown_way(duration_s=40.0)
    assert flown.span_s == pytest.approx(40.0)
    assert flown.p_W[-1, :, 2].min() > 3.0  # they have taken off
    assert np.allclose(np.diff(flown.p_W, axis=0), 0.02 * flown.v_W[1:], atol=2e-3)
    write(flown, tmp_path / "way.npz")
    command = [sys.executable, "-m", "benchmarks.monte_carlo.zsim_fleet", str(tmp_path / "way.npz"), "0"]
    server = Server([*command, "--flights", "2"])
    try:
        found = server.ask({"seed": 1}, 60.0)
    finally:
        server.close()
    assert found["flights"] == 2.0
    assert found["rms_m"] < 0.2
    assert found["closest_m"] > 2.0


def test_a_sweep_that_does_not_end_in_time_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zsim_sweep, "TIMEOUT_S", 0.1)
    with refused(RefusedError, "not finished", "0.1 s"):
        zsim_sweep.fly(runs=1, workers=1)


def test_a_sweep_is_timed_with_the_cpu_time_of_its_workers() -> None:
    found = zsim_sweep.fly(runs=1, workers=1, duration_s=1.0)
    assert found["wall_s"] > 0.1
    assert found["cpu_s"] > 0.1
    assert found["closest_m"] == pytest.approx(3.0, abs=0.05)  # their distance on the ground
