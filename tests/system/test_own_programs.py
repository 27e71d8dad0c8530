"""User programs of a scenario: started with the run, awaited, reported if they fail, and ended with the run."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from federation import Federation

import zsim
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim_analysis.in_process import InProcessFlight

EXAMPLES = Path(__file__).parents[2] / "examples"
ONE = "name: one\nduration_s: 1\ndrones: [{name: drone1, position_m: [0, 0, 0]}]\n"


def scenario(command: list[str], processes: dict[str, Any] | None = None, **more: Any) -> str:
    programs = {"my.main": {"command": command, **more}}
    return ONE + yaml.safe_dump({"programs": programs, "processes": processes or {}})


def test_a_program_in_the_folder_of_the_scenario_flies_a_drone(tmp_path: Path, forked: None) -> None:
    runs = [
        zsim.run(EXAMPLES / "plain_client.yaml", duration_s=5, processes=True, out=tmp_path / name, progress=False)
        for name in ("first", "second")
    ]
    for run in runs:
        assert run.truth("drone1").position_m_z.max() > 0.5
        assert "flying" in (run.folder / "logs" / "plain.client.log").read_text()
    assert runs[0].truth_sha256 == runs[1].truth_sha256


@pytest.mark.parametrize(
    ("command", "more", "processes", "code", "named"),
    [
        (["sleep", "600"], {"start_timeout_s": 0.5}, {}, 1, "my.main has not joined"),
        (["sleep", "600"], {"start_timeout_s": 0.5}, {"on_overdue": {"my.main": "drop"}}, 0, "my.main"),
        (["sh", "-c", "echo lost {name} >&2; exit 3"], {}, {}, 1, "exit code 3: lost my.main"),
        (["sh", "-c", "exit 3"], {"joins": False}, {"on_death": {"my.main": "drop"}}, 0, "my.main"),
        (["no-such-program"], {"joins": False}, {}, 1, "no-such-program"),
    ],
    ids=["never joins", "may stay away", "dies", "may die", "is not there"],
)
def test_a_failed_program_is_reported_and_fails_the_run_unless_allowed(
    federation: Federation,
    command: list[str],
    more: dict[str, Any],
    processes: dict[str, Any],
    code: int,
    named: str,
) -> None:
    run = federation.run(scenario(command, processes, **more))
    run.ends(with_code=code)
    assert named in run.text()


@pytest.mark.parametrize(
    ("programs", "field", "value"),
    [
        ({"my.main": {"command": []}}, "programs.my.main.command", "0"),
        ({"my.main": {"command": [""]}}, "programs.my.main.command[0]", "program"),
        ({"my.main": {"command": "python x.py"}}, "programs.my.main.command", "python x.py"),
        ({"My main": {"command": ["true"]}}, "programs.My main", "My main"),
        ({"estimator.drone1": {"command": ["true"]}}, "programs.estimator.drone1", "estimator"),
        ({"my.main": {"command": ["true"], "start_timeout_s": -1}}, "programs.my.main.start_timeout_s", "-1"),
    ],
)
def test_a_faulty_program_entry_is_refused_with_its_field(programs: dict[str, Any], field: str, value: str) -> None:
    with pytest.raises(ScenarioError) as raised:
        scenario_file.resolve({**yaml.safe_load(ONE), "programs": programs})
    assert any(f": {field} " in line and value in line for line in raised.value.faults), raised.value.faults


def test_one_process_refuses_a_scenario_with_programs() -> None:
    resolved = scenario_file.resolve(yaml.safe_load(scenario(["sleep", "600"])))
    with pytest.raises(ScenarioError) as raised:
        InProcessFlight(resolved)
    assert "my.main" in str(raised.value)
