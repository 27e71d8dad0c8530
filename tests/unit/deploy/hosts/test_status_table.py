"""The table of `zsim up`: the rows of processes, and which hosts are reported as silent."""

import io
import random
import time
from types import SimpleNamespace
from typing import Any

import pytest
from refused import has_terms, refused
from rich.console import Console

from zsim.errors import RunError
from zsim.presentation import FittedTable, shortened
from zsim_deploy.hosts.doctor import HostReport, NetworkPath, hosts_table, paths_table
from zsim_deploy.hosts.status_table import RowChoice, RowOrder, StatusTable, needs_attention, table


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


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return the monotonic time, which the test sets."""
    at = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: at[0])
    return at


def printed(board: StatusTable) -> str:
    return board.console.file.getvalue()  # type: ignore[attr-defined]


def clock(t_s: float, **more: Any) -> dict[str, Any]:
    return {"t_s": t_s, "rate": 2.0, "state": "running", "phase": "", "waiting_for": [], **more}


def test_a_row_shows_the_host_and_figures_of_a_process(board, now):
    board.health({"name": "estimator.d1", "lag_ns": 20_000_000, "received": 100})
    now[0] = 101.0
    board.health({"name": "estimator.d1", "lag_ns": 40_000_000, "received": 350})
    figures = {"age_s": 0.0, "lag_ms": 40.0, "messages_per_s": 250.0, "round_trip_ms": 4.0, "restarts": 1}
    assert board.rows()[0] == {"role": "estimator.d1", "host": "h1", "pid": 7, "state": "running", **figures}
    now[0] = 110.0
    assert board.rows()[0]["lag_ms"] is None  # too old to be shown


@pytest.mark.parametrize(("more", "terms"), [({}, ("waited for", "3 s")), ({"held_by": ["planner.d1"]}, ("waits for planner.d1",))])  # fmt: skip
def test_a_row_distinguishes_being_waited_for_from_waiting(board, more, terms):
    waiting = {"name": "estimator.d1", "host": "h1", "since_wall_s": 3.2, **more}
    board.clock(clock(1.0, waiting_for=[waiting]))
    assert has_terms(board.rows()[0]["state"], *terms)


def test_a_silent_host_is_reported_once_and_again_when_it_returns(board):
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


def test_a_host_that_always_answers_late_is_not_silent(board):
    board.links["h1"].round_trip_s, board.links["h1"].silent = 1.2, 1.2
    board.report_silent_hosts()
    assert printed(board) == ""
    assert board.rows()[0]["state"] == "running"
    board.links["h1"].silent = 4.0
    board.report_silent_hosts()
    assert has_terms(printed(board), "h1", "not answer", "4.0 s")


def test_the_start_is_reported_with_the_duration_of_its_stages(board):
    board.stages_s = {"connect": 0.25, "check": 0.5}
    board.clock(clock(0.0, state="waiting"))
    assert "flying after" not in printed(board)
    board.clock(clock(1.2))
    board.clock(clock(2.4))
    assert printed(board).count("flying after") == 1
    assert has_terms(printed(board), "connect 0.2 s", "check 0.5 s", "processes")


@pytest.mark.parametrize("last_line", ["exit code 2", "cannot open [/tmp/x]", "[/]", "[red]no"])
def test_an_ended_process_shows_its_outcome_without_markup(board, last_line):
    board.members[0].state, board.members[0].code, board.members[0].outcome = "ended", 2, lambda: last_line
    assert any(f"ended ({last_line})" in line for line in lines(table(board.rows()), 200))


def test_a_process_without_a_sign_of_life_is_shown_within_two_seconds(board, now):
    board.health({"name": "estimator.d1", "lag_ns": 0, "received": 100})
    now[0] = 101.9
    board.health({"name": "world", "lag_ns": 0, "received": 100})
    assert has_terms(board.rows()[0]["state"], "life")


def test_while_the_world_is_silent_only_the_world_is_shown_as_silent(board, now):
    world: Any = SimpleNamespace(name="world", host="h1", pid=8, state="running", code=None, restarts=0)
    board.members = [*board.members, world]
    board.health({"name": "estimator.d1", "lag_ns": 0, "received": 100})
    board.clock(clock(1.0))
    now[0] = 102.0
    estimator, world_state = (row["state"] for row in board.rows())
    assert estimator == "running"
    assert has_terms(world_state, "life", "2 s")


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
    return [each["role"].rpartition(".")[2] for each in choice.select(ROWS)]


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
def test_patterns_match_roles_their_subjects_and_hosts(only: list[str], shown: list[str]) -> None:
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
def test_rows_are_sorted_by_the_chosen_order(sort: RowOrder, shown: list[str]) -> None:
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
def test_of_200_processes_those_in_need_of_attention_are_on_the_screen(
    width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_rows_keep_their_order_when_all_of_them_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    table = StatusTable(10.0, choice=RowChoice(["drone1*", "world"]))
    monkeypatch.setattr(table, "rows", lambda: ROWS)
    names = [line.split()[0] for line in live(table, 100)[-3:]]
    assert names == ["world", "estimator.drone1", "estimator.drone12"]


COLUMNS = 80  # the default width of a terminal
ROLES = [f"estimator.formation-alpha-drone-{i:04}" for i in range(200)]
HOST = "onboard-computer-of-drone-0012"
LARGE = {"pid": 123456, "lag_ms": 1234.0, "messages_per_s": 12345.0, "round_trip_ms": 123.4, "restarts": 3}
FACTS = {"python": "3.11.2", "zsim": "0.1.0", "fingerprint": "0123456789", "cores": 128, "load": 100.1, "governors": []}


def lines(shown: FittedTable, width: int = COLUMNS) -> list[str]:
    console = Console(file=io.StringIO(), width=width)
    console.print(shown)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("name", "width", "text"),
    [("estimator.drone2", 16, "estimator.drone2"), ("estimator.drone2", 7, "…drone2"), ("d1", 1, "…")],
)
def test_a_long_name_is_shortened_at_its_beginning(name: str, width: int, text: str) -> None:
    assert shortened(name, width) == text


def test_processes_are_distinguishable_in_80_columns() -> None:
    rows = [{"role": role, "host": HOST, "state": "host silent 12 s", **LARGE} for role in ROLES]
    shown = lines(table(rows))[-len(ROLES) :]
    ends = [line.split()[0].removeprefix("…") for line in shown]
    assert len(set(ends)) == len(ROLES)
    assert all(role.endswith(end) for role, end in zip(ROLES, ends, strict=True))
    assert all(HOST[-4:] in line and "host silent 12 s" in line and "1234 ms" in line for line in shown)


def test_a_table_with_room_shows_whole_names() -> None:
    *_, row = lines(table([{"role": "estimator.drone2", "host": "lab-pc", "state": "running", **LARGE}]))
    assert row.split()[:2] == ["estimator.drone2", "lab-pc"]


def test_hosts_are_distinguishable_in_80_columns() -> None:
    hosts = [f"onboard-computer-of-drone-{i:04}" for i in range(3)]
    checked = lines(hosts_table({name: HostReport(FACTS, 0.001, 0.0) for name in hosts}))
    paths = lines(paths_table([NetworkPath(name, HOST, 7447, {"error": "no route " * 9}) for name in hosts]))
    for shown in (checked, paths):
        assert all(any(line.split() and line.split()[0].endswith(name[-6:]) for line in shown) for name in hosts)
