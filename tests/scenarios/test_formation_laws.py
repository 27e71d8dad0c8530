"""Pilots fly the formation laws: each law keeps its promises, with the same bits as processes and after a kill."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from refused import has_terms

import zsim
from zsim.errors import ScenarioError, UserCodeError
from zsim.scenario import scenario_file
from zsim.scenario.surroundings import packed
from zsim_analysis.board.measures import measures
from zsim_analysis.sweep.sweep_run import fly_scenario

BASE = """
name: laws
duration_s: 28
sensors:
  gps: {position_m: {noise: 0.05}}
drones:
  - {name: d1, position_m: [4, 1, 0]}
  - {name: d2, position_m: [2, 5, 0]}
  - {name: d3, position_m: [-5, 3, 0]}
  - {name: d4, position_m: [-3, -2, 0]}
  - {name: d5, position_m: [2, -5, 0]}
agents: {pilot: {class: consensus, parameters: {takeoff_s: 0.5}}}
report: {window_s: [24, 28], metrics: 'zsim_analysis.board.measures:measures'}
"""
MOVING: dict[str, Any] = {"centre_m": ["0.4*t", 1], "start_s": 8.0}


def scenario(law: str, **parameters: Any) -> Any:
    document = yaml.safe_load(BASE)
    document["agents"]["pilot"]["class"] = law
    document["agents"]["pilot"]["parameters"] |= parameters
    return document


@pytest.mark.parametrize(
    ("law", "parameters", "shape_m", "centre_m"),
    [
        ("consensus", MOVING, 0.25, 0.5),
        ("leader_follower", MOVING, 1.2, 1.5),  # lags by v / k per drone in between
        ("virtual_structure", MOVING, 0.25, 0.3),
        ("distance_based", MOVING, 0.25, 0.5),
        ("bearing_only", MOVING, 0.25, 1.0),  # only the two informed drones' pull sets its size
        ("olfati_saber", MOVING, 0.6, 1.0),
        ("vasarhelyi", MOVING, None, 1.5),
    ],
)
def test_each_law_keeps_its_shape_centre_and_separation(
    law: str, parameters: dict[str, Any], shape_m: float | None, centre_m: float
) -> None:
    flight, failure = fly_scenario(scenario_file.resolve(scenario(law, **parameters)))
    assert failure is None
    found = measures(flight)
    assert found["centre_error_m"] is not None
    assert found["centre_error_m"] < centre_m
    assert (found["shape_error_m"] is None) == (shape_m is None)
    assert (found["shape_error_m"] or 0.0) < (shape_m or 1.0)
    assert found["separation_m"] is not None
    assert found["separation_m"] > 1.5
    assert found["messages_per_drone_s"] == pytest.approx(10.0, rel=0.01)
    assert found["effort_m2_s"] is not None


def test_a_pilot_avoids_a_mapped_surface_with_the_same_bits_after_a_kill(tmp_path: Path, forked: None) -> None:
    """A wall of triangles stands between d3 and its flock, 2 m from d3; without the map, d3 flies into the wall.

    A pilot of this law has the state of a double integrator besides what it has heard.
    """
    a, b, c, d = [-3, 0, 0], [-3, 6, 0], [-3, 6, 4], [-3, 0, 4]
    wall = {"name": "wall", "triangles": packed(np.array([a + b + c, a + c + d]))}
    flock = {**scenario("olfati_saber"), "duration_s": 9, "report": {}, "environment": {"surfaces": [wall]}}
    flock["drones"] = flock["drones"][:3]
    file = tmp_path / "flock.yaml"
    file.write_text(yaml.safe_dump(flock))
    alone = zsim.run(file, out=tmp_path / "alone", progress=False)
    with zsim.Federation(file, out=tmp_path / "many") as flight:
        flight.wait_until(7.0)
        flight.kill("pilot.d3")
        run = flight.run()
    assert run.truth_sha256 == alone.truth_sha256
    assert "pilot.d3" in [*run.events[run.events.kind == "restart"].subject]
    assert alone.summary.obstacle_distance_m["d3"] > 1.0
    flock["agents"]["pilot"]["map"] = False
    file.write_text(yaml.safe_dump(flock))
    blind = zsim.run(file, out=tmp_path / "blind", progress=False)
    assert [*blind.events[blind.events.kind == "collision"].subject] == ["d3"]


@pytest.mark.parametrize(
    ("law", "parameters", "path", "terms"),
    [
        ("consensus", {"gain_1_s": 9}, "gain_1_s", ("9", "<= 5")),
        ("consensus", {"centre_m": ["2*q", 0]}, "centre_m[0]", ("2*q", "'q'")),
        ("distance_based", {"places_m": [[0, 0]]}, "places_m", ("1", "5")),
        ("vasarhelyi", {"centre_m": [0, "1/t"]}, "centre_m[1]", ("1/t", "t = 0")),
        ("bearing_only", {"informed": ["d9"]}, "informed", ("d9", "d1")),
        ("flock", {}, "class", ("flock", "vasarhelyi")),
    ],
)
def test_an_invalid_law_or_parameter_is_refused(
    law: str, parameters: dict[str, Any], path: str, terms: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "laws.yaml").write_text(yaml.safe_dump(scenario(law, **parameters)))
    with pytest.raises(ScenarioError) as raised:
        zsim.run(tmp_path / "laws.yaml", out=tmp_path / "run", progress=False)
    (line,) = raised.value.faults
    assert f".{path} " in line
    assert all(term in line for term in terms), line


def test_a_reference_undefined_in_flight_ends_the_run_with_field_and_time(tmp_path: Path) -> None:
    """No check at the start sees the pole at t = 0.5 s; the record is readable up to it."""
    document = {**scenario("virtual_structure", centre_m=["1/(t-0.5)", 0], start_s=8.0), "duration_s": 12}
    document["report"] = {}
    with pytest.raises(UserCodeError) as raised:
        zsim.run(document, out=tmp_path / "run", progress=False)
    assert has_terms(str(raised.value), "pilot.d1", "8.50", "parameters.centre_m[0]", "0.5")
    assert zsim.load(tmp_path / "run").truth("d1").index[-1] == pytest.approx(8.5, abs=0.1)
