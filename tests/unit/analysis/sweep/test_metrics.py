"""Figures of a user's own: columns of a row, or the one line in it that says why there are none."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from effort import effort
from refused import has_terms, refused
from settling import settled, settling
from short_flight import ONE
from synthetic_record import Flown, traffic

from zsim.contract.framing import GateMessages
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.schema import plugin
from zsim_analysis.in_process import InProcessFlight
from zsim_analysis.reading.drone_errors import estimate_errors
from zsim_analysis.reading.flight import FlightReader
from zsim_analysis.reading.formation import formations_of
from zsim_analysis.sweep.design import SweepDesign, make_plan, read_document
from zsim_analysis.sweep.sweep_run import Task, fly

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
    """A folder with the user's module and a scenario."""
    monkeypatch.setenv(plugin.FOLDERS, "")
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "sweep_figures_of_mine.py").write_text(SOURCE)
    (tmp_path / "one.yaml").write_text(ONE)
    plugin.search(tmp_path)
    return tmp_path


def test_the_example_of_the_documentation() -> None:
    """The side p is too long by a sine of 1 m that ends at 6 s."""
    reader = FlightReader()
    for key, message, wall_ns in traffic(Flown(duration_s=10.0)):
        reader.add_message(key, message, wall_ns)
    flight = reader.flight()
    formation = formations_of(flight)[0]
    assert settling(flight) == {"settled_s": 0.0, "overshoot_m": pytest.approx(0.0, abs=1e-6)}
    wave = np.where(formation.t_s < 6.0, np.sin(2 * np.pi * formation.t_s / 4.0), 0.0)
    found = settled(formation.t_s, wave, engaged_s=0.0)
    assert found["overshoot_m"] == pytest.approx(1.0)
    assert found["settled_s"] == pytest.approx(5.66, abs=0.03)  # the sine falls below 0.5 m at 5 s + 2/3 s
    assert settled(formation.t_s, np.ones_like(wave), engaged_s=0.0)["settled_s"] is None


PAIR = """
name: pair
seed: 3
duration_s: 8
sensors: {preset: paper}
drones:
  - {name: drone1, position_m: [2, 0, 0], yaw_deg: 90}
  - {name: drone2, position_m: [-2, 0, 0], yaw_deg: 90}
clusters:
  - {name: main, drones: [drone1, drone2], plan: {takeoff_s: 0.2}}
report: {metrics: 'effort:effort'}
"""


def test_commands_and_estimates_are_there_for_metrics() -> None:
    """The example of the documentation: control effort and NEES are those of the messages of the same flight."""
    found = fly(Task(0, 0, {}, scenario_file.from_text(PAIR)))
    assert found["metrics_failure"] is None
    commands: list[tuple[int, float]] = []

    class Commands:
        def add_message(self, key: str, message: Any, wall_ns: int) -> None:
            if key.endswith("/cmd/velocity"):
                commands.append((message.t_ns, float(np.sum(np.square(message.velocity_m_s)))))

        def add_gate(self, gate: GateMessages, wall_ns: int) -> None:
            pass

    reader = FlightReader(answers=True)
    InProcessFlight(scenario_file.from_text(PAIR)).run([reader, Commands()])
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


def row(function: str) -> dict[str, object]:
    text = f"{ONE}\nreport: {{metrics: 'sweep_figures_of_mine:{function}'}}\n"
    return fly(Task(7, 0, {}, scenario_file.from_text(text)))


def test_a_number_is_a_column_of_the_function_s_name(beside: Path) -> None:
    found = row("highest_m")
    assert found["metrics_failure"] is None
    assert isinstance(found["metrics.highest_m"], float)


def test_a_mapping_is_a_column_for_each_name(beside: Path) -> None:
    found = row("several")
    assert found["metrics_failure"] is None
    assert {name: value for name, value in found.items() if name.startswith("metrics.")} == {
        "metrics.drones": 1.0,
        "metrics.unknown_m": None,
        "metrics.nothing": None,
    }


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
def test_what_goes_wrong_in_it_is_one_line_and_the_run_is_kept(
    beside: Path, function: str, terms: tuple[str, ...]
) -> None:
    found = row(function)
    assert found["failure"] is None
    assert isinstance(found["sim_s"], float)
    failure = found["metrics_failure"]
    assert isinstance(failure, str)
    assert "\n" not in failure
    assert has_terms(failure.replace(f"sweep_figures_of_mine:{function}", "NAME"), "report.metrics", *terms)
    assert not [name for name in found if name.startswith("metrics.")]


@pytest.mark.parametrize("function", ["sweep_figures_of_mine:nowhere", "no_such_module:f", "sweep_figures_of_mine"])
def test_a_function_that_is_not_there_is_refused_before_anything_flies(beside: Path, function: str) -> None:
    document, _ = read_document(beside / "one.yaml", [f"report.metrics={function}"])
    with refused(ScenarioError, "report.metrics", f"'{function}'"):
        make_plan("one.yaml", document, ["seed"], 2)


def test_a_plan_with_a_function_resolves(beside: Path) -> None:
    document, _ = read_document(beside / "one.yaml", ["report.metrics=sweep_figures_of_mine:several"])
    assert SweepDesign(make_plan("one.yaml", document, ["seed"], 2)).scenario(1).report.metrics == (
        "sweep_figures_of_mine:several"
    )
