"""The table of `zsim up`: what a row says of a process, and which host is named as silent."""

import io
import time
from types import SimpleNamespace
from typing import Any

import pytest
from refused import has_terms
from rich.console import Console

from zsim_deploy.hosts.status_table import StatusTable, table


class Link:
    def __init__(self) -> None:
        self.round_trip_s, self.answered_s, self.silent = 0.004, 1.0, 0.0

    def silent_s(self) -> float:
        return self.silent


@pytest.fixture
def board():
    made = StatusTable(10.0, Console(file=io.StringIO(), width=200))
    member: Any = SimpleNamespace(
        name="estimator.d1", host="h1", pid=7, state="running", code=None, restarts=1, outcome=lambda: "exit code 2"
    )
    made.members, made.links = [member], {"h1": Link()}  # type: ignore[dict-item]
    return made


def printed(board: StatusTable) -> str:
    return board.console.file.getvalue()  # type: ignore[attr-defined]


def clock(t_s: float, **more: Any) -> dict[str, Any]:
    return {"t_s": t_s, "rate": 2.0, "state": "running", "phase": "", "waiting_for": [], **more}


def test_a_row_says_where_and_how_a_process_is(board, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    board.health({"name": "estimator.d1", "lag_ns": 20_000_000, "received": 100})
    now[0] = 101.0
    board.health({"name": "estimator.d1", "lag_ns": 40_000_000, "received": 350})
    row = board.rows()[0]
    assert row == {
        "role": "estimator.d1",
        "host": "h1",
        "pid": 7,
        "state": "running",
        "age_s": 0.0,
        "lag_ms": 40.0,
        "messages_per_s": 250.0,
        "round_trip_ms": 4.0,
        "restarts": 1,
    }
    now[0] = 110.0
    assert board.rows()[0]["lag_ms"] is None  # nobody knows by now


def test_who_is_waited_for_is_said(board):
    board.clock(clock(1.0, waiting_for=[{"name": "estimator.d1", "host": "h1", "since_wall_s": 3.2}]))
    assert has_terms(board.rows()[0]["state"], "waited for", "3 s")


def test_a_silent_host_is_named_once_with_its_roles_and_once_when_it_is_back(board):
    board.links["h1"].silent = 1.5
    board.report_silent_hosts()
    board.report_silent_hosts()
    (line,) = printed(board).splitlines()
    assert has_terms(line, "h1", "not answer", "1.5 s", "estimator.d1")
    assert has_terms(board.rows()[0]["state"], "silent", "2 s")
    assert board.rows()[0]["round_trip_ms"] is None
    board.links["h1"].silent = 0.0
    board.report_silent_hosts()
    (_, line) = printed(board).splitlines()
    assert has_terms(line, "h1", "again")


def test_what_always_answers_late_is_not_silent(board):
    board.links["h1"].round_trip_s, board.links["h1"].silent = 1.2, 1.2
    board.report_silent_hosts()
    assert printed(board) == ""
    assert board.rows()[0]["state"] == "running"
    board.links["h1"].silent = 4.0
    board.report_silent_hosts()
    assert has_terms(printed(board), "h1", "not answer", "4.0 s")


def test_the_start_is_told_with_where_the_time_went(board):
    board.stages_s = {"connect": 0.25, "check": 0.5}
    board.clock(clock(0.0, state="waiting"))
    assert "flies after" not in printed(board)
    board.clock(clock(1.2))
    board.clock(clock(2.4))
    assert printed(board).count("flies after") == 1
    assert has_terms(printed(board), "connect 0.2 s", "check 0.5 s", "processes")


def test_an_ended_process_says_how(board):
    board.members[0].state, board.members[0].code = "ended", 2
    assert has_terms(board.rows()[0]["state"], "ended", "code 2")
    console = Console(file=io.StringIO(), width=200)
    console.print(table(board.rows()))
    assert has_terms(console.file.getvalue(), "ended", "code 2")  # type: ignore[attr-defined]


@pytest.mark.parametrize("last_line", ["cannot open [/tmp/x]", "[/]", "[red]no"])
def test_what_a_process_said_is_shown_as_it_is(board, last_line):
    board.members[0].state, board.members[0].code, board.members[0].outcome = "ended", 1, lambda: last_line
    console = Console(file=io.StringIO(), width=200)
    console.print(table(board.rows()))
    assert f"ended ({last_line})" in console.file.getvalue()  # type: ignore[attr-defined]


def test_a_process_without_a_sign_of_life_is_shown_within_two_seconds(board, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    board.health({"name": "estimator.d1", "lag_ns": 0, "received": 100})
    now[0] = 101.9
    board.health({"name": "world", "lag_ns": 0, "received": 100})
    assert has_terms(board.rows()[0]["state"], "life")


def test_while_the_world_is_silent_only_the_world_is_said_to_be(board, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    world: Any = SimpleNamespace(name="world", host="h1", pid=8, state="running", code=None, restarts=0)
    board.members = [*board.members, world]
    board.health({"name": "estimator.d1", "lag_ns": 0, "received": 100})
    board.clock(clock(1.0))
    now[0] = 102.0
    states = [row["state"] for row in board.rows()]
    assert states[0] == "running"
    assert has_terms(states[1], "life", "2 s")


def test_who_waits_for_another_s_outputs_is_not_the_one_waited_for(board):
    waiting = {"name": "estimator.d1", "host": "h1", "since_wall_s": 3.2, "held_by": ["planner.d1"]}
    board.clock(clock(1.0, waiting_for=[waiting]))
    assert board.rows()[0]["state"] == "waits for planner.d1"
