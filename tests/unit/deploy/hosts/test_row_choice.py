"""Which rows the table of a run has, and in which order: of three processes, and of 200."""

import io
import random
from typing import Any

import pytest
from refused import refused
from rich.console import Console

from zsim.errors import RunError
from zsim_deploy.hosts.row_choice import RowChoice, RowOrder, needs_attention
from zsim_deploy.hosts.status_table import StatusTable

FIGURES = {"pid": 7, "lag_ms": 1.0, "messages_per_s": 50.0, "round_trip_ms": 1.0, "restarts": 0, "age_s": 0.5}


def row(role: str, host: str = "lab-pc", state: str = "running", **more: Any) -> dict[str, Any]:
    return {"role": role, "host": host, "state": state, **FIGURES, **more}


ROWS = [
    row("world"),
    row("estimator.drone1", "pi-1", age_s=3.0, state="no sign of life for 3 s"),
    row("estimator.drone12", "pi-2", lag_ms=20.0),
    row("controller.main", age_s=None, lag_ms=None, restarts=2, state="starting"),
]


def roles(choice: RowChoice) -> list[str]:
    return [each["role"].rpartition(".")[2] for each in choice.of(ROWS)]


@pytest.mark.parametrize(
    ("only", "shown"),
    [
        ([], ["world", "drone1", "drone12", "main"]),
        (["drone1*"], ["drone1", "drone12"]),
        (["drone1"], ["drone1"]),
        (["estimator.*2", "world"], ["world", "drone12"]),
        (["pi-?"], ["drone1", "drone12"]),
    ],
)
def test_patterns_are_of_roles_of_what_they_work_for_and_of_hosts(only: list[str], shown: list[str]) -> None:
    assert roles(RowChoice(only)) == shown


@pytest.mark.parametrize(
    ("sort", "shown"),
    [
        (RowOrder.AGE, ["main", "drone1", "world", "drone12"]),
        (RowOrder.LAG, ["main", "drone12", "world", "drone1"]),
        (RowOrder.RESTARTS, ["main", "world", "drone1", "drone12"]),
        (RowOrder.ROLE, ["main", "drone1", "drone12", "world"]),
        (RowOrder.HOST, ["world", "main", "drone1", "drone12"]),
        (RowOrder.ATTENTION, ["drone1", "main", "world", "drone12"]),
    ],
)
def test_the_greatest_figure_is_first(sort: RowOrder, shown: list[str]) -> None:
    assert roles(RowChoice(sort=sort)) == shown


def test_a_pattern_that_matches_nothing_is_refused() -> None:
    with refused(RunError, "role", "'drone9*'", "world", "estimator.drone1"):
        RowChoice(["drone*", "drone9*"]).check(ROWS)


def test_states_have_an_order_of_urgency() -> None:
    states = ["ended (exit code 2: x)", "no sign of life for 3 s", "host silent 3 s", "waited for 3 s"]
    states += ["waits for world", "starting", "running", "ended"]
    shuffled = random.Random(1).sample(states, len(states))
    assert sorted(shuffled, key=lambda state: needs_attention(row("world", state=state))) == states


def live(table: StatusTable, width: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width, height=24)
    table.console = console
    console.print(table._render())
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", [80, 120])
def test_of_200_processes_those_in_need_are_on_the_screen(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [row(f"estimator.formation-alpha-drone{i}", f"onboard-computer-{i}") for i in range(200)]
    rows[150]["state"], rows[199]["state"] = "ended (exit code 1: no such file)", "no sign of life for 12 s"
    table = StatusTable(10.0)
    monkeypatch.setattr(table, "rows", lambda: rows)
    shown = live(table, width)
    assert len(shown) <= 24
    first, second = [line for line in shown if "alpha-drone" in line][:2]
    assert first.split()[0].endswith("drone150")
    assert second.split()[0].endswith("drone199")
    assert "180 more" in shown[-1]


def test_where_all_processes_have_a_line_they_stay_in_their_places(monkeypatch: pytest.MonkeyPatch) -> None:
    table = StatusTable(10.0, choice=RowChoice(["drone1*", "world"]))
    monkeypatch.setattr(table, "rows", lambda: ROWS)
    names = [line.split()[0] for line in live(table, 100)[-3:]]
    assert names == ["world", "estimator.drone1", "estimator.drone12"]
