"""The benchmark framework: statistics, tables, the page, requests to contenders, failures, and a short exchange."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from refused import has_terms, refused

from benchmarks import grid, lockstep, peers, recorder, table
from benchmarks.child import RefusedError, Server, result
from benchmarks.exchange.lap import Lap
from benchmarks.run import role_of
from benchmarks.sheet import Sheet, Spread, exponent, read
from benchmarks.table import figure, ratios, spread
from zsim.contract import keys
from zsim.contract.run_messages import Clock
from zsim.record import RecordWriter
from zsim_deploy.launch import role_launcher

ECHO = """
import json, sys
for line in sys.stdin:
    asked = json.loads(line)
    print(json.dumps({"refused": "too many"} if asked["drones"] > 9 else {"twice": 2 * asked["drones"]}), flush=True)
"""


def sheet() -> Sheet:
    made = Sheet("a", "steps/s")
    for ours, theirs in ((40.0, 10.0), (30.0, 20.0), (50.0, 10.0)):
        made.add("zsim", 1, ours)
        made.add("other", 1, theirs)
    made.add("zsim", 10, 7.0)
    made.refused = {"absent": "pip: none", "other@10": "not through after 60 s"}
    return made


def test_a_ratio_compares_each_repeat_with_the_same_repeat(tmp_path: Path) -> None:
    """A failed repeat is omitted together with its partner."""
    made = sheet()
    assert made.spread("zsim", 1) == Spread(40.0, 30.0, 50.0)
    assert made.ratio("zsim", "other", 1) == Spread(4.0, 1.5, 5.0)  # of 4, 1.5 and 5, not 40 / 10
    assert made.ratio("zsim", "other", 10) is None
    assert made.best(["zsim", "other"], 1) == "zsim"
    assert made.best(["other"], 10) is None
    made.write(tmp_path / "new" / "a.json")
    assert read(tmp_path / "new" / "a.json") == made
    failed = Sheet("a", "steps/s")
    for ours, theirs in ((40.0, None), (30.0, 10.0)):
        failed.add("zsim", 1, ours)
        failed.add("other", 1, theirs)
    assert failed.ratio("zsim", "other", 1) == Spread(3.0, 3.0, 3.0)
    assert failed.spread("other", 1) == Spread(10.0, 10.0, 10.0)


def test_rates_of_the_recorder_are_those_of_the_time_that_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RecordWriter(tmp_path / "run.mcap") as writer:
        for seq in range(10):
            writer.add_message(keys.CLOCK, Clock(20 * seq, seq, "run", seq, "running", 1.0), 100 * seq)
    counted = recorder.counted(tmp_path / "run.mcap", 300, 700)
    assert counted == ({}, 0, 10, 4, 180)
    flown = recorder.Flown(1.0, 2.0, 20.0, 10_000, 6_000, 4_000_000, {}, 0)
    monkeypatch.setattr(recorder, "fly", lambda *_: flown)
    made = Sheet("i", "of a core")
    recorder._measured(made, "lockstep")
    found = [made.spread(f"lockstep_{field}", recorder.DRONES) for field in recorder.FIELDS[:3]]
    assert found == [Spread(value, value, value) for value in (50.0, 3000.0, 2.0)]


@pytest.mark.parametrize("power", [0.0, 1.0, 1.7])
def test_the_exponent_of_a_power_law_is_found(power: float) -> None:
    assert exponent({size: 3.0 * size**power for size in (1, 3, 10, 100)}) == pytest.approx(power)


@pytest.mark.parametrize(
    ("value", "shown"), [(0.0, "0"), (0.08512, "0.0851"), (2.0, "2"), (845.6, "846"), (12345.0, "12 300")]
)
def test_figures_have_three_significant_digits(value: float, shown: str) -> None:
    assert figure(value) == shown


def test_a_contender_without_a_figure_has_a_row_with_the_reason() -> None:
    labels = {"zsim": "zsim", "other": "the other", "absent": "the absent"}
    lines = ratios(sheet(), labels, "zsim").splitlines()
    rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]
    assert rows[0] == ["", "N = 1", "N = 10"]
    assert rows[2] == ["zsim [steps/s]", "40 (30 to 50)", "7 (7 to 7)"]
    assert rows[3][:2] == ["the other", "0.25 (0.2 to 0.667)"]
    assert has_terms(rows[3][2], "60 s")
    assert has_terms(rows[4][1], "pip: none")
    assert rows[4][0] == "the absent"
    assert spread(None) == "–"


def test_only_the_measured_section_of_the_page_is_replaced() -> None:
    begin, end = "words\n<!-- measured: a -->\n", "<!-- end: a -->\nmore\n"
    text = f"{begin}old\n{end}"
    assert table.replaced(text, "a", "new\n") == f"{begin}new\n{end}"
    for part in "abcdef":  # the page has a section for every part
        table.replaced(table.PAGE.read_text(), part, "")
    with refused(ValueError, "measured: b"):
        table.replaced(text, "b", "new")


def test_a_failed_contender_is_reported_with_its_error() -> None:
    with refused(RefusedError, "code 1", "ValueError: no"):
        result([sys.executable, "-c", "raise ValueError('no')"], 30.0)
    with refused(RefusedError, "code 3", "too late"):
        result([sys.executable, "-c", "import sys; print('{}'); print('too late', file=sys.stderr); sys.exit(3)"], 30.0)
    with refused(RefusedError, "0.2 s"):
        result([sys.executable, "-c", "input() if False else __import__('time').sleep(60)"], 0.2)


def test_a_contender_answers_or_refuses_requests() -> None:
    server = Server([sys.executable, "-c", ECHO])
    try:
        assert server.ask({"drones": 4}, 30.0) == {"twice": 8}
        with pytest.raises(RefusedError, match="too many"):
            server.ask({"drones": 10}, 30.0)
    finally:
        server.close()


def test_a_peer_that_is_not_installed_has_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "STATE", tmp_path / "peers.json")
    assert has_terms(peers.missing("helics") or "", "make bench")
    peers.STATE.write_text(json.dumps({"helics": "pip: ERROR: none", "mosaik": None}))
    assert peers.missing("helics") == "pip: ERROR: none"
    assert peers.missing("mosaik") is None


def test_a_lap_counts_steps_after_the_warm_up() -> None:
    lap = Lap(seconds=0.02, warm_s=0.0)
    calls = 1
    while lap.more():
        calls += 1
    assert lap.steps == calls - 2  # the first call begins the warm-up, the second begins counting
    assert 0.0 < lap.steps_per_s <= lap.steps / 0.02


@pytest.mark.parametrize(("count", "clusters"), [(1, 0), (3, 1), (10, 3), (50, 16)])
def test_drones_are_on_a_grid_in_clusters_of_three(count: int, clusters: int) -> None:
    made = grid.scenario(count, duration_s=1.0)
    assert (len(made.drones), len(made.clusters)) == (count, clusters)
    places = {drone.position_m for drone in made.drones}
    assert len(places) == count
    assert all(x % grid.SPACING_M == 0.0 and y % grid.SPACING_M == 0.0 for x, y, _ in places)
    at = {drone.name: drone.position_m for drone in made.drones}
    for cluster in made.clusters:
        (ax, ay, _), (bx, by, _), (cx, cy, _) = (at[name] for name in cluster.drones)
        assert (bx - ax) * (cy - ay) - (cx - ax) * (by - ay) == grid.SPACING_M**2  # else it stays landed


@pytest.mark.parametrize("name", ["zsim", "zsim_lookahead", "zenoh_queue", "raw_tcp"])
def test_a_world_and_one_agent_exchange_steps(name: str) -> None:
    found = result(lockstep.command(lockstep.CONTENDERS[name], 1, 0.1), 60.0)
    assert found["steps"] > 3


@pytest.mark.parametrize(
    ("arguments", "role"),
    [
        (["record", "--out", "run", ""], "record"),
        (["estimator", "--connect", "tcp/127.0.0.1:1", "--", "drone1", ""], "estimator.drone1"),
        (None, "forkserver"),
    ],
)
def test_a_role_is_recognised_by_its_command_line(arguments: list[str] | None, role: str) -> None:
    command = (
        [*role_launcher.COMMAND, *arguments]
        if arguments
        else [sys.executable, "-P", "-m", "zsim_deploy.cli.forkserver"]
    )
    assert role_of(SimpleNamespace(cmdline=lambda: command)) == role  # pyright: ignore[reportArgumentType]
