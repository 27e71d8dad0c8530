"""`zsim fault`: what is typed becomes a request or is refused."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from refused import refused

from zsim.contract import keys
from zsim.contract.run_messages import Fault
from zsim.errors import SessionError
from zsim.scenario import scenario_file
from zsim.scenario.faults import COMMON, KINDS, OPTION_OF
from zsim.transport.session import Session
from zsim_deploy.cli import federation_commands
from zsim_deploy.cli.federation_commands import duration, row, selector

EXAMPLES = Path(__file__).parents[4] / "examples"


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a scenario with a sensor of the user's own."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    path = tmp_path / "mine.yaml"
    sensors, drones = "{my_uwb: {module: uwb_range}}", "[{name: d1, position_m: [0, 0, 0]}]"
    path.write_text(f"name: t\nduration_s: 1\nsensors: {sensors}\ndrones: {drones}\n")
    return path


@pytest.mark.parametrize("text", ["10s", "500ms", "2min", "3", "1.5 s", None])
def test_valid_durations_are_accepted(text: str | None):
    assert duration(text) == text


@pytest.mark.parametrize("text", ["", "s", "-1s", "10h", "1e3s", "nan"])
def test_invalid_durations_are_refused(text: str):
    with refused(typer.BadParameter, "10s", "500ms", "2min"):
        duration(text)


def added(monkeypatch: pytest.MonkeyPatch, parameters: list[str], **times: str) -> dict[str, Any]:
    """Return the arguments that `zsim fault add` sends to the world."""
    asked: list[dict[str, Any]] = []

    def request(link: object, op: str, args: dict[str, Any]) -> dict[str, Any]:
        asked.append(args)
        return {"id": 1, "from_ns": 0, "until_ns": None}

    monkeypatch.setattr(federation_commands, "connected", lambda _: nullcontext((None, None)))
    monkeypatch.setattr(federation_commands, "_ask", request)
    federation_commands.add(target="drone2", kind="gps_dropout", parameters=parameters, **times)
    return asked[0]


def test_typed_parameters_are_requested_from_the_world(monkeypatch: pytest.MonkeyPatch):
    typed = ["factor=3", "value_m=[2, 0, -1]", "place={controller.main: d1}", "rotor=all", "one_way=true"]
    values = {"factor": 3, "value_m": [2, 0, -1], "place": {"controller.main": "d1"}, "rotor": "all", "one_way": True}
    fault = {"kind": "gps_dropout", "target": "drone2"}
    assert added(monkeypatch, typed, for_="500ms") == {**fault, "for_s": 0.5, "at_s": None, **values}
    for name in {each.name for kind in KINDS.values() for each in kind.parameters}:
        assert added(monkeypatch, [f"{name}=1"], at="2min") == {**fault, "for_s": None, "at_s": 120.0, name: 1}


@pytest.mark.parametrize(
    ("given", "terms"),
    [
        (["factor"], ()),
        (["=3"], ()),
        (["a b=3"], ()),
        (["value=[1"], ()),
        (["target=drone2"], ("target", "TARGET")),
        (["kind=gps_stuck"], ("kind", "KIND")),
        (["for_s=2"], ("for_s", "--for")),
        (["at_s=2"], ("at_s", "--at")),
        (["factor=2", "factor=3"], ("factor", "twice", "once")),
    ],
)
def test_invalid_misplaced_or_repeated_parameters_are_refused(
    monkeypatch: pytest.MonkeyPatch, given: list[str], terms: tuple[str, ...]
):
    with refused(typer.BadParameter, *terms):
        added(monkeypatch, given)
    assert set(OPTION_OF) == set(COMMON)


@pytest.mark.parametrize("value", [10**20, [0, 10**24], {10**20: 1}, "\udcff"], ids=ascii)
def test_a_value_that_fits_into_no_message_is_refused(value: Any):
    nowhere: Any = SimpleNamespace()
    with refused(SessionError, "world/control", "fault_add", "64-bit"):
        Session.request(nowhere, keys.CONTROL, "fault_add", "zsim.fault", {"value": value})


@pytest.mark.parametrize(
    ("which", "args"),
    [
        ("all", {}),
        ("3", {"id": 3}),
        ("drone2", {"target": "drone2"}),
        ("gps_dropout", {"kind": "gps_dropout"}),
        ("my_uwb_bias", {"kind": "my_uwb_bias"}),
        ("other_bias", {"target": "other_bias"}),
    ],
)
def test_faults_are_cleared_by_number_target_or_kind(mine: Path, which: str, args: dict[str, object]):
    assert selector(which, scenario_file.to_text(scenario_file.load(mine))) == args


def test_a_row_shows_the_time_and_the_parameters_of_a_fault():
    fault = Fault(1, "gps_dropout", "drone1", {"probability": 0.5}, 2_000_000_000, None, "me")
    cells = [cell.strip() for cell in row(fault, 3_000_000_000)]
    assert cells == ["1", "active", "drone1", "gps_dropout", "2.00 to ... s", "probability=0.5"]
    assert row(fault, 0)[1].strip() == "planned"


@pytest.mark.parametrize("columns", [80, 120])
def test_the_list_of_kinds_fits_a_terminal(
    columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("COLUMNS", str(columns))
    federation_commands.kinds()
    text = capsys.readouterr().out
    assert list(dict.fromkeys(line.split()[0] for line in text.splitlines() if line[0] != " ")) == list(KINDS)
    assert max(map(len, text.splitlines())) <= columns
    named = {f"{parameter.name}:" for kind in KINDS.values() for parameter in kind.parameters}
    assert named <= set(text.split())  # no name is split across lines


def test_a_scenario_adds_the_kinds_of_its_own_sensors(mine: Path, capsys: pytest.CaptureFixture[str]):
    federation_commands.kinds(mine, trust=True)
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    own = [kind for kind in listed if kind not in KINDS]
    assert own == [f"my_uwb_{fault}" for fault in ("dropout", "stuck", "bias", "noise")]
    assert set(KINDS) < set(listed)
