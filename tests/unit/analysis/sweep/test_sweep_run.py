"""One run of a sweep, flown in this process: its row has the values of the report and the user's metrics."""

import errno
import itertools
import os
import pickle
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from effort import effort
from refused import has_terms, refused
from settling import settled, settling
from short_flight import ONE, diverge
from synthetic_record import Flown, traffic
from synthetic_record import flight as flight_of

from zsim.contract.fingerprint import fingerprint
from zsim.contract.framing import GateMessages
from zsim.errors import RecordError, ScenarioError
from zsim.record import mcap_layout, record_writer
from zsim.scenario import scenario_file
from zsim.schema import plugin
from zsim_analysis import in_process
from zsim_analysis.in_process import InProcessFlight
from zsim_analysis.reading.drone_errors import estimate_errors
from zsim_analysis.reading.formation import Formation, formations_of
from zsim_analysis.reading.recorded_flight import FlightReader
from zsim_analysis.report.summary import judge
from zsim_analysis.sweep.design import SweepDesign, make_plan, read_document
from zsim_analysis.sweep.sweep_run import Task, engaged_s, fly
from zsim_world.fleet.fleet import Fleet

PAIR = """
name: pair
seed: 3
duration_s: 6
sensors: {preset: paper}
environment: {wind: {gust_m_s: 0.3}}
drones:
  - {name: drone1, position_m: [2, 0, 0], yaw_deg: 90}
  - {name: drone2, position_m: [-2, 0, 0], yaw_deg: 90}
clusters:
  - {name: main, drones: [drone1, drone2], plan: {takeoff_s: 0.2}}
"""
DRONES = """drones:
  - {name: drone3, position_m: [8, 0, 0], yaw_deg: 90}
  - {name: drone4, position_m: [12, 0, 0], yaw_deg: 90}
"""
GROUNDED = """  - {name: errors, drones: [drone3, drone4], plan: {takeoff_s: 1000}}
"""


def task(text: str = ONE, run: int = 7, record: Path | None = None, varied: dict[str, Any] | None = None) -> Task:
    return Task(run, 1, varied or {}, scenario_file.from_text(text), str(record) if record else None)


def test_a_row_has_the_least_distance_from_obstacles(tmp_path: Path) -> None:
    ball = "environment: {obstacles: [{name: ball, shape: sphere, position_m: [0, 9, 3], radius_m: 1}]}\n"
    row = fly(task(ONE + ball, record=tmp_path / "000007"))
    distances_m = judge(tmp_path / "000007/run.mcap")[2].obstacle_distance_m
    assert row["min_obstacle_distance_m"] == min(distances_m.values()) > 1.0
    assert fly(task())["min_obstacle_distance_m"] is None


def test_a_row_has_the_values_of_the_report(tmp_path: Path) -> None:
    """The values are those from the record of `zsim run --in-process` and from the run's own record."""
    row = fly(task(PAIR, record=tmp_path / "000007", varied={"environment.wind.gust_m_s": 0.3}))
    in_process.fly(scenario_file.from_text(PAIR), tmp_path / "run.mcap", changed=("wind.gust_m_s=0.3",))
    for record in (tmp_path / "run.mcap", tmp_path / "000007/run.mcap"):
        _, _, summary = judge(record)
        assert row["truth_sha256"] == summary.truth_sha256
        for name in ("ended", "sim_s", "min_separation_m", "seed"):
            assert row[name] == getattr(summary, name)
        for parameter, errors in summary.errors.items():
            for each in ("est_std", "est_rms", "est_mean", "true_std", "true_rms", "true_mean"):
                assert row[f"errors.{parameter}.{each}"] == getattr(errors, each)
        assert datetime.fromisoformat(row["date"]) <= datetime.fromisoformat(summary.date or "") <= datetime.now(UTC)
    assert judge(tmp_path / "run.mcap")[2].changed == ["wind.gust_m_s=0.3"]
    assert summary.changed is None  # unknown: the scenario has no file
    assert len(summary.errors) == 8
    assert list(row)[:4] == ["run", "point", "seed", "environment.wind.gust_m_s"]
    assert (row["run"], row["failure"], row["collisions"], row["fingerprint"]) == (7, None, 0, fingerprint())
    assert row["engaged"] is True
    assert 4 < row["clusters.main.engaged_s"] < 6  # take-off is at 0.2 s, hover from 3.2 s
    text = (tmp_path / "000007/scenario.yaml").read_text()
    assert scenario_file.from_text(text) == scenario_file.from_text(PAIR)
    assert not list(tmp_path.glob("*.part"))


def test_a_cluster_that_was_never_engaged_has_no_errors() -> None:
    """One of two clusters stays on the ground, and its std of 0 must not count as a merit."""
    text = PAIR.replace("drones:\n", DRONES, 1) + GROUNDED
    row = fly(task(text))
    assert (row["failure"], row["engaged"]) == (None, False)
    assert 4 < row["clusters.main.engaged_s"] < 6
    assert row["clusters.errors.engaged_s"] is None
    assert row["errors.x_c.true_rms"] > 0
    grounded = {name: value for name, value in row.items() if name.startswith("clusters.errors.errors.")}
    assert "clusters.errors.errors.x_c.est_std" in grounded
    assert set(grounded.values()) == {None}


def test_a_run_with_a_falling_drone_is_unplanned_and_has_no_errors() -> None:
    """A rotor fails in formation: the drone flips, its firmware stops the rotors, and it hits the ground."""
    fault = "faults: [{kind: rotor_efficiency, target: drone1, at_s: 8, rotor: front_left, value: 0}]\n"
    row = fly(task(PAIR.replace("duration_s: 6", "duration_s: 13") + fault))
    assert (row["failure"], row["collisions"], row["crashed"], row["as_planned"]) == (None, 0, True, False)
    assert has_terms(row["shortfall"], "drone1", "emergency", "8…", "upside", "ground", "rotor_efficiency since 8 s")
    assert {value for name, value in row.items() if name.startswith("errors.")} == {None}


def test_a_run_with_an_infeasible_plan_is_a_row_with_the_factor() -> None:
    way = "[{at_s: 0, values: {x_c: 0}}, {at_s: 10, values: {x_c: 30}}, {at_s: 20, values: {x_c: 0}}]"
    plan = f"{{takeoff_s: 0.2, trajectory: {{start_s: 9, waypoints: {way}}}}}"
    row = fly(task(PAIR.replace("{takeoff_s: 0.2}", plan)))
    assert has_terms(row["failure"], "clusters[0].plan.trajectory", "3.00", "0.8", "3.75")
    assert row["as_planned"] is None


def test_engagement_counts_only_within_the_window() -> None:
    no = np.zeros((4, 0))
    phases = ["assembling", "engaged", "engaged", "held"]
    of = Formation("a", (), (), np.array([1.0, 2.0, 3.0, 4.0]), no, no, no, no, no, phases)
    assert engaged_s([of], (0.0, 9.0)) == {"a": 2.0}
    assert engaged_s([of], (2.5, 9.0)) == {"a": 3.0}
    assert engaged_s([of], (3.5, 9.0)) == {"a": None}


def test_a_run_that_diverges_is_a_row_with_the_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    diverge(monkeypatch)
    row = fly(task())
    assert has_terms(row["failure"], "d1", "0.120", "finite")
    assert row["sim_s"] == 0.1
    assert len(row["truth_sha256"]) == 64
    assert not [name for name in row if name.startswith("errors.")]


def test_a_run_that_raises_an_error_is_a_row_with_the_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = fly(task(ONE.replace("[]}", "[console.1]}")))
    assert has_terms(row["failure"], "world", "console.1", "processes.expect")
    assert (row["run"], row["seed"], row["truth_sha256"]) == (7, 3, None)

    def crash(fleet: Fleet) -> None:
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr(Fleet, "advance", crash)
    sent = pickle.loads(pickle.dumps(task(record=tmp_path / "000007")))
    assert fly(sent)["failure"] == "ZeroDivisionError: two lines"
    assert [path.name for path in tmp_path.iterdir()] == ["000007"]  # the record is kept


def test_a_full_disk_ends_the_sweep_instead_of_failing_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The incomplete record keeps the name that the error gives."""

    calls, write = itertools.count(), mcap_layout.write_all

    def full_after_two(file: Any, data: bytes) -> None:
        if next(calls) >= 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(file, data)

    monkeypatch.setattr(record_writer, "CHUNK_BYTES", 1000)
    monkeypatch.setattr(mcap_layout, "write_all", full_after_two)
    part = tmp_path / "000007.part"
    with refused(RecordError, "000007.part/run.mcap", os.strerror(errno.ENOSPC)):
        fly(task(record=tmp_path / "000007"))
    assert [path.name for path in tmp_path.iterdir()] == [part.name]
    monkeypatch.undo()
    row = fly(task(record=tmp_path / "000007"))
    assert (row["failure"], row["engaged"]) == (None, None)  # without a cluster
    assert [path.name for path in tmp_path.iterdir()] == ["000007"]
    (tmp_path / "runs").touch()
    with refused(RecordError, "runs/000007.part", os.strerror(errno.ENOTDIR)):
        fly(task(record=tmp_path / "runs/000007"))


SOURCE = """
import sys

def highest_m(flight):
    return flight.tracks[0].p_W[:, 2].max()

def several(flight):
    return {"drones": len(flight.tracks), "unknown_m": float("nan"), "nothing": None}

def crash(flight):
    raise ValueError("two\\nlines")

def leave(flight):
    sys.exit(3)

def words(flight):
    return {"drones": "one"}

def bad_name(flight):
    return {"a b": 1}

def many(flight):
    return dict.fromkeys((f"n{i}" for i in range(101)), 1.0)

number = 3
"""


@pytest.fixture
def beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with the user's module and a scenario."""
    monkeypatch.setenv(plugin.FOLDERS, "")
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "sweep_figures_of_mine.py").write_text(SOURCE)
    (tmp_path / "one.yaml").write_text(ONE)
    plugin.search(tmp_path)
    return tmp_path


def test_the_documented_metric_finds_overshoot_and_settling_time() -> None:
    """The error of side p is a sine of 1 m that ends at 6 s."""
    flight = flight_of(traffic(Flown(duration_s=10.0)))
    formation = formations_of(flight)[0]
    assert settling(flight) == {"settled_s": 0.0, "overshoot_m": pytest.approx(0.0, abs=1e-6)}
    wave = np.where(formation.t_s < 6.0, np.sin(2 * np.pi * formation.t_s / 4.0), 0.0)
    found = settled(formation.t_s, wave, engaged_s=0.0)
    assert found["overshoot_m"] == pytest.approx(1.0)
    assert found["settled_s"] == pytest.approx(5.66, abs=0.03)  # the sine falls below 0.5 m at 5 s + 2/3 s
    assert settled(formation.t_s, np.ones_like(wave), engaged_s=0.0)["settled_s"] is None


MEASURED_PAIR = PAIR.replace("duration_s: 6", "duration_s: 8") + "report: {metrics: 'effort:effort'}\n"


def test_commands_and_estimates_are_available_to_metrics() -> None:
    """Control effort and NEES, as in the documentation, equal those computed from the messages of the same flight."""
    found = fly(Task(0, 0, {}, scenario_file.from_text(MEASURED_PAIR)))
    assert found["metrics_failure"] is None
    commands: list[tuple[int, float]] = []

    class Commands:
        def add_message(self, key: str, message: Any, wall_ns: int) -> None:
            if key.endswith("/cmd/velocity"):
                commands.append((message.t_ns, float(np.sum(np.square(message.velocity_m_s)))))

        def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
            pass

    reader = FlightReader(answers=True)
    InProcessFlight(scenario_file.from_text(MEASURED_PAIR)).run([reader, Commands()])
    flight = reader.flight()
    engaged_s = formations_of(flight)[0].engaged_s
    assert engaged_s is not None
    squares = [square for t_ns, square in commands if t_ns >= engaged_s * 1e9]
    assert len(squares) > 100
    assert found["metrics.command_rms_m_s"] == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-6)
    errors = estimate_errors(flight)
    assert list(errors) == ["drone1", "drone2"]
    nees = np.concatenate([each.nees[each.t_s >= engaged_s] for each in errors.values()])
    assert found["metrics.nees"] == pytest.approx(np.nanmean(nees), rel=1e-12)
    assert effort(flight)["nees"] == found["metrics.nees"]


def measured(function: str) -> dict[str, object]:
    text = f"{ONE}\nreport: {{metrics: 'sweep_figures_of_mine:{function}'}}\n"
    return fly(Task(7, 0, {}, scenario_file.from_text(text)))


def test_a_metric_is_a_column_and_a_mapping_is_one_for_each_name(beside: Path) -> None:
    found = measured("highest_m")
    assert found["metrics_failure"] is None
    assert isinstance(found["metrics.highest_m"], float)
    found = measured("several")
    assert found["metrics_failure"] is None
    metrics = {name: value for name, value in found.items() if name.startswith("metrics.")}
    assert metrics == {"metrics.drones": 1.0, "metrics.unknown_m": None, "metrics.nothing": None}


@pytest.mark.parametrize(
    ("function", "terms"),
    [
        ("crash", ("ValueError", "two", "lines")),
        ("leave", ("SystemExit", "3")),
        ("words", ("drones", "number")),
        ("bad_name", ("'a b'", "63")),
        ("many", ("101", "100")),
        ("nowhere", ("function",)),
        ("number", ("function",)),
    ],
)
def test_an_error_in_a_metric_is_reported_in_one_line_beside_the_row(
    beside: Path, function: str, terms: tuple[str, ...]
) -> None:
    found = measured(function)
    assert found["failure"] is None
    assert isinstance(found["sim_s"], float)
    failure = found["metrics_failure"]
    assert isinstance(failure, str)
    assert "\n" not in failure
    assert has_terms(failure.replace(f"sweep_figures_of_mine:{function}", "NAME"), "report.metrics", *terms)
    assert not [name for name in found if name.startswith("metrics.")]


@pytest.mark.parametrize("function", ["sweep_figures_of_mine:nowhere", "no_such_module:f", "sweep_figures_of_mine"])
def test_a_missing_metric_is_refused_before_any_run(beside: Path, function: str) -> None:
    document, _ = read_document(beside / "one.yaml", [f"report.metrics={function}"])
    with refused(ScenarioError, "report.metrics", f"'{function}'"):
        make_plan("one.yaml", document, ["seed"], 2)
    own = "sweep_figures_of_mine:several"
    document, _ = read_document(beside / "one.yaml", [f"report.metrics={own}"])
    assert SweepDesign(make_plan("one.yaml", document, ["seed"], 2)).scenario(1).report.metrics == own
