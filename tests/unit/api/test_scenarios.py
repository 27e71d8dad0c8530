"""A scenario in Python: reported faults, immutability, equivalence to YAML, and completion in editors."""

import inspect
from pathlib import Path
from typing import Any

import pytest
import yaml
from refused import refused

import zsim
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file

WRONG: dict[str, Any] = {
    "name": "wrong",
    "duration_s": -1,
    "drones": [{"name": "d1", "position_m": [0, 0, 0], "mass_kg": -1.4}, {"name": "d1", "position_m": [0, 0]}],
    "environment": {"wnd": 1},
    "clusters": [{"name": "main", "drones": ["d1", "d9"]}],
}
RIGHT: dict[str, Any] = {"name": "right", "duration_s": 5, "drones": [{"name": "d1", "position_m": [0, 0, 0]}]}


def test_a_scenario_is_refused_with_the_same_faults_as_its_yaml(tmp_path: Path) -> None:
    (tmp_path / "scenario").write_text(yaml.safe_dump(WRONG))
    with pytest.raises(ScenarioError) as of_yaml:
        scenario_file.load(tmp_path / "scenario")
    with pytest.raises(ScenarioError) as of_python:
        _ = zsim.Scenario(**WRONG).resolved
    assert of_python.value.faults == of_yaml.value.faults
    assert len(of_python.value.faults) >= 5


def test_a_scenario_is_not_changed_in_place() -> None:
    first = zsim.Scenario(**RIGHT)
    other = first.with_({"drones.d1.mass_kg": 0.5}, seed=7)
    assert (first["drones.d1.mass_kg"], first["seed"]) != (0.5, 7)
    assert (other["drones.d1.mass_kg"], other["seed"]) == (0.5, 7)
    RIGHT["drones"][0]["position_m"][0] = 9
    assert first["drones.d1.position_m"] == [0.0, 0.0, 0.0]
    RIGHT["drones"][0]["position_m"][0] = 0


def test_a_scenario_is_the_same_document_as_its_yaml(tmp_path: Path) -> None:
    made = zsim.Scenario(**RIGHT).with_({"environment.wind.gust_m_s": 1.0})
    made.save(tmp_path / "right.yaml")
    loaded = zsim.Scenario.load(tmp_path / "right.yaml")
    assert loaded.document() == made.document()
    assert loaded.resolved == made.resolved


def test_editors_complete_fields_and_paths() -> None:
    fields = inspect.signature(zsim.Scenario).parameters
    assert {*fields} == {*made_of(zsim.Scenario(**RIGHT))}
    assert {*fields} < {*inspect.signature(zsim.Scenario(**RIGHT).with_).parameters}
    paths = zsim.Scenario(**RIGHT)._ipython_key_completions_()
    assert {"environment.wind.gust_m_s", "drones.d1.position_m", "processes.expect"} <= {*paths}
    with refused(ScenarioError, "environment.wind.gust", "environment.wind.gust_m_s?"):
        zsim.Scenario(**RIGHT)["environment.wind.gust"]


def made_of(scenario: zsim.Scenario) -> tuple[str, ...]:
    return scenario.resolved.__struct_fields__
