"""References of drones in a scenario: files, pilots, and faults with their paths."""

from pathlib import Path
from typing import Any

import pytest
from refused import has_terms, refused

from zsim.contract import keys
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.consistency import unflown_plans
from zsim.scenario.roles import agent_names, permits, rights_for
from zsim.scenario.scenario_file import HEADER

HEAD = ",".join(HEADER)
PIECE = ",".join(["1.5", *(str(k) for k in range(32))])
FILES = {
    "good.csv": f"{HEAD},\n{PIECE},\n\n",
    "no_header.csv": PIECE,
    "short.csv": f"{HEAD}\n{PIECE}\n1,2,3\n",
    "nan.csv": f"{HEAD}\n{PIECE.replace('31', 'nan')}\n",
    "none.csv": f"{HEAD}\n",
    "still.csv": f"{HEAD}\n{PIECE.replace('1.5', '0')}\n",
}
ONE = [{"at_s": 0, "position_m": [0, 0, 2]}, {"at_s": 4, "position_m": [4, 0, 2]}]
EXCHANGE = {"drones": ["d1", "d2"], "stages": [{"start_s": 8, "over_s": 8, "places_m": [[0, 4, 2], [4, 4, 2]]}]}


@pytest.fixture(autouse=True)
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)


def resolve(reference: Any = None, **more: Any) -> Any:
    first = {"name": "d1", "position_m": [0, 0, 0]} | ({} if reference is None else {"reference": reference})
    document = {"name": "s", "duration_s": 30, "drones": [first, {"name": "d2", "position_m": [4, 0, 0]}]}
    return scenario_file.resolve({**document, **more})


def test_a_reference_file_is_read_into_pieces_and_not_needed_afterwards(tmp_path: Path) -> None:
    scenario = resolve({"file": "good.csv", "start_s": 10})
    (piece,) = scenario.drones[0].reference.pieces
    assert (piece.duration_s, piece.x, piece.yaw) == (
        1.5,
        [float(k) for k in range(8)],
        [float(k) for k in range(24, 32)],
    )
    (tmp_path / "good.csv").unlink()
    assert scenario_file.from_text(scenario_file.to_text(scenario)) == scenario


def test_a_drone_with_a_reference_has_a_pilot_for_it_alone() -> None:
    scenario = resolve({"waypoints": ONE, "start_s": 10})
    assert agent_names(scenario) == ["estimator.d1", "estimator.d2", "reference.d1"]
    rights = rights_for("reference.d1", scenario)
    assert permits(rights.writes, keys.command("d1", "velocity"))
    assert permits(rights.writes, keys.reference("d1"))
    assert permits(rights.answers, keys.drone_control("d1"))
    assert not permits(rights.writes, keys.command("d2", "velocity"))
    assert not permits(rights.reads, keys.truth("d1"))
    assert not permits(rights_for("reference.d2", scenario).writes, keys.command("d2", "velocity"))
    assert [name for name in agent_names(resolve(exchanges=[EXCHANGE])) if "reference" in name] == [
        "reference.d1",
        "reference.d2",
    ]


def test_a_scenario_without_references_does_not_mention_them() -> None:
    text = scenario_file.to_text(resolve())
    assert "reference" not in text
    assert "exchanges" not in text


@pytest.mark.parametrize(
    ("reference", "terms"),
    [
        ({"waypoints": ONE}, ("reference.start_s", "missing", "waypoints")),
        ({"start_s": 5}, ("reference.start_s", "5", "minimum_snap")),
        ({"waypoints": ONE, "start_s": 5, "takeoff_s": 6}, ("reference.start_s", "5", "6")),
        ({"waypoints": ONE, "start_s": 5, "land_s": 5}, ("reference.land_s", "5", "5")),
        ({"waypoints": ONE, "minimum_snap": ONE, "start_s": 5}, ("reference.minimum_snap", "waypoints", "pieces")),
        ({"waypoints": [ONE[1], ONE[0]], "start_s": 5}, ("reference.waypoints[1].at_s", "0", "4")),
        ({"minimum_snap": [ONE[0], ONE[0]], "start_s": 5}, ("reference.minimum_snap[1].at_s", "0", "0")),
        ({"minimum_snap": ONE[:1], "start_s": 5}, ("reference.minimum_snap", "1", "2")),
        ({"waypoints": ONE, "start_s": 5, "duration_s": 3}, ("reference.duration_s", "expressions")),
        ({"waypoints": ONE, "start_s": 5, "constants": {"f": 1}}, ("reference.constants", "expressions")),
        ({"file": "absent.csv", "start_s": 5}, ("reference.file", "absent.csv…")),
        ({"file": "no_header.csv", "start_s": 5}, ("reference.file", "duration", "33")),
        ({"file": "short.csv", "start_s": 5}, ("reference.file", "3", "3", "33")),
        ({"file": "nan.csv", "start_s": 5}, ("reference.file", "2", "33", "33")),
        ({"file": "none.csv", "start_s": 5}, ("reference.file", "none.csv…")),
        ({"file": "still.csv", "start_s": 5}, ("reference.pieces[0].duration_s", "0", "0")),
        ({"file": "good.csv", "pieces": [], "start_s": 5}, ("reference.file", "pieces")),
        ({"exprssions": {}}, ("reference.exprssions", "expressions")),
    ],
)  # fmt: skip
def test_an_invalid_reference_is_refused_with_field_and_value(
    reference: dict[str, Any], terms: tuple[str, ...]
) -> None:
    with pytest.raises(ScenarioError) as raised:
        resolve(reference)
    text = str(raised.value).replace("'", "")
    assert any(all(term.rstrip("…") in line for term in terms) for line in text.splitlines()), text


def test_only_existing_pilots_can_be_expected_or_killed() -> None:
    flown = {"waypoints": ONE, "start_s": 10}
    kill = {"kind": "process_kill", "at_s": 5}
    resolve(flown, faults=[{**kill, "target": "reference.d1"}], processes={"expect": ["reference.d1"]})
    with refused(ScenarioError, "processes.expect[0]", "'reference.d2'", "reference.NAME", "d1"):
        resolve(flown, processes={"expect": ["reference.d2"]})
    with refused(ScenarioError, "faults[0].target", "'reference.d2'"):
        resolve(flown, faults=[{**kill, "target": "reference.d2"}])


def test_references_after_the_end_of_the_run_are_reported() -> None:
    late = resolve({"waypoints": ONE, "start_s": 30})
    assert [has_terms(line, "drones.d1", "30", "30") for line in unflown_plans(late)] == [True]
    assert unflown_plans(resolve({"waypoints": ONE, "start_s": 29})) == []
    assert len(unflown_plans(resolve(exchanges=[EXCHANGE], duration_s=8))) == 2


def test_a_drone_has_only_one_source_of_setpoints() -> None:
    cluster = [{"name": "main", "drones": ["d1", "d2"]}]
    with refused(ScenarioError, "drones[0].reference", "'main'", "(drone 'd1')"):
        resolve({"waypoints": ONE, "start_s": 10}, clusters=cluster)
    with refused(ScenarioError, "exchanges[0].drones[0]", "'d1'", "drones[0].reference"):
        resolve({"waypoints": ONE, "start_s": 10}, exchanges=[EXCHANGE])
    with refused(ScenarioError, "exchanges[0].drones[1]", "'d2'", "'main'"):
        resolve(clusters=cluster, exchanges=[EXCHANGE])


@pytest.mark.parametrize(
    ("changed", "terms"),
    [
        ({"drones": ["d1", "d9"]}, ("exchanges[0].drones[1]", "'d9'", "d1", "d2")),
        ({"drones": ["d1"]}, ("exchanges[0].stages[0].places_m", "2", "1")),
        ({"drones": ["d1", "d1"]}, ("exchanges[0].drones[1]", "'d1'", "exchanges[0]")),
        ({"takeoff_s": 9}, ("exchanges[0].stages[0].start_s", "8", "9")),
        ({"land_s": 10}, ("exchanges[0].land_s", "10", "16")),
        ({"stages": [*EXCHANGE["stages"], *EXCHANGE["stages"]]}, ("exchanges[0].stages[1].start_s", "8", "16")),
    ],
)
def test_an_invalid_exchange_is_refused(changed: dict[str, Any], terms: tuple[str, ...]) -> None:
    with refused(ScenarioError, *terms):
        resolve(exchanges=[{**EXCHANGE, **changed}])
