"""A flight that did not do what its plan says is marked, wherever it is shown; one that did is not."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
import synthetic_record
import typer
from synthetic_record import Flown

from zsim.contract import keys, messages
from zsim.contract.flight_messages import ClusterState
from zsim.contract.run_messages import Clock, Event
from zsim.record import RecordWriter
from zsim_agents.formation.flight_plan import WAITS, waiting_step
from zsim_analysis.reading.flight import FlightReader
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.reading.shortfall import Shortfall, shortfalls
from zsim_analysis.reading.verdict import NOT_AS_PLANNED, marks_of, verdict
from zsim_analysis.report.figures.report_figures import figures
from zsim_analysis.report.make_report import judge, page
from zsim_analysis.report.tables import table
from zsim_deploy.cli import record_commands

State = Callable[[float], dict[str, Any]]
SOON: tuple[str, ...] = ("clusters.main.plan.takeoff_s=1", "report.window_s=[4, 30]")


def traffic(state: State, events: Sequence[Event] = (), duration_s: float = 30.0, overrides=SOON):
    """Yield a synthetic flight whose cluster states are other ones from `state`, by time [s]."""
    flown = Flown(duration_s=duration_s, overrides=tuple(overrides), events=tuple(events))
    for key, message, wall_ns in synthetic_record.traffic(flown):
        if isinstance(message, ClusterState):
            message = msgspec.structs.replace(message, **state(message.t_ns / 1e9))
        yield key, message, wall_ns


def flight_of(state: State, **options: Any) -> RecordedFlight:
    reader = FlightReader()
    for key, message, wall_ns in traffic(state, **options):
        reader.add_message(key, message, wall_ns)
    return reader.flight()


def found(state: State, **options: Any) -> list[Shortfall]:
    return shortfalls(flight_of(state, **options), (4.0, 30.0))


def refused(t_s: float) -> dict[str, Any]:
    """Return the state of a cluster that hovers, since its trajectory is refused."""
    return {"phase": "engaged", "reason": f"the guard parts a and b; trajectory{WAITS}too fast" if t_s > 5 else ""}


def test_a_flight_as_planned_has_none() -> None:
    assert found(lambda t_s: {"phase": "engaged"}) == []


def test_a_step_that_is_refused_to_the_end_is_one() -> None:
    (line,) = found(refused)
    assert (line.kind, line.subject, line.fails) == ("plan", "main", True)
    assert line.t_s == pytest.approx(5.02)
    assert line.text.endswith("too fast")


def test_a_step_that_the_landing_drops_is_one_and_a_granted_one_is_not() -> None:
    landing = found(lambda t_s: refused(t_s) if t_s < 20 else {"phase": "landing"})
    assert [line.kind for line in landing if line.fails] == ["plan"]
    assert found(lambda t_s: {**refused(t_s), **({"reason": ""} if t_s > 8 else {})}) == []


def test_a_formation_that_never_engages_is_one_but_not_a_run_that_ends_before() -> None:
    def assembling(t_s: float) -> dict[str, Any]:
        return {"phase": "assembling", "reason": f"engage{WAITS}drone2 is flying"}

    (line,) = found(assembling)
    assert (line.kind, line.fails) == ("engagement", True)
    assert "drone2" in line.text
    for options in ({"duration_s": 12.0}, {"overrides": ("clusters.main.plan.takeoff_s=40",)}):
        (early,) = found(assembling, **options)
        assert (early.kind, early.fails) == ("early", False)


def test_a_window_that_holds_the_take_off_is_marked() -> None:
    (line,) = found(lambda t_s: {"phase": "engaged" if t_s > 17 else "assembling"})
    assert (line.kind, line.fails) == ("window", False)
    assert "50 %" in line.text


def test_a_collision_is_one() -> None:
    contacts = [Event(k * 10**9, k, "collision", "world", "drone1", "drone1 and drone2 collide") for k in (7, 8)]
    (line,) = found(lambda t_s: {"phase": "engaged"}, events=contacts)
    assert (line.kind, line.t_s, line.fails) == ("collision", 7.0, True)


def test_the_step_is_read_from_the_reason() -> None:
    assert waiting_step(f"trajectory{WAITS}a: b; c") == ("trajectory", "a: b; c")
    held = f"held on request; target{WAITS}no"
    assert waiting_step(held) == ("target", "no")
    assert waiting_step("ready to engage") is None


@pytest.mark.usefixtures("unrendered")
def test_table_figures_page_and_exit_code_show_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RecordWriter(tmp_path / "run.mcap") as writer:
        for key, message, wall_ns in traffic(refused):
            writer.add(key, messages.encode(message), messages.encoding(key), message.t_ns, wall_ns)
    flight, formations, summary = judge(tmp_path / "run.mcap")
    assert not summary.as_planned
    assert any(fails and NOT_AS_PLANNED in mark for mark, fails in marks_of(summary.shortfalls))
    assert NOT_AS_PLANNED in (table(summary, "main").title or "")
    for figure in figures(flight, formations, summary):
        assert "too fast" in " ".join(figure.drawing.get_suptitle().split())  # on as many lines as it takes
    assert "too fast" in page(summary, [])
    outcome = type("Outcome", (), {"interrupted": False, "failed": False, "reason": "over"})()
    with pytest.raises(typer.Exit) as exit_:
        record_commands.conclude(outcome, tmp_path, True)
    assert exit_.value.exit_code == 1
    assert "too fast" in " ".join(capsys.readouterr().out.split())  # whatever the width of the terminal


CASES: dict[str, tuple[State, tuple[Event, ...], int]] = {
    "a refused step": (refused, (), 1),
    "never engaged": (lambda t_s: {"phase": "assembling"}, (), 1),
    "a collision": (
        lambda t_s: {"phase": "engaged"},
        (Event(7 * 10**9, 0, "collision", "world", "drone1", "drone1 and drone2 collide"),),
        1,
    ),
    "judged while not engaged": (lambda t_s: {"phase": "engaged" if t_s > 9 else "assembling"}, (), 0),
    "as planned": (lambda t_s: {"phase": "engaged"}, (), 0),
}


@pytest.mark.usefixtures("unrendered")
@pytest.mark.parametrize("what", CASES)
def test_the_verdict_is_the_same_with_and_without_a_report(
    what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state, events, code = CASES[what]
    write(tmp_path / "run.mcap", state, events)
    assert verdict(tmp_path / "run.mcap").shortfalls == judge(tmp_path / "run.mcap")[-1].shortfalls
    reported, plain = (end_of(tmp_path, report, capsys) for report in (True, False))
    assert reported == plain
    assert plain[0] == code


def write(record: Path, state: State, events: Sequence[Event]) -> None:
    """Write a record that is complete."""
    flown = list(traffic(state, events))
    clock = next(message for _, message, _ in reversed(flown) if isinstance(message, Clock))
    with RecordWriter(record) as writer:
        for key, message, wall_ns in flown:
            writer.add(key, messages.encode(message), messages.encoding(key), message.t_ns, wall_ns)
        stopped = msgspec.structs.replace(clock, seq=clock.seq + 1, state="stopped")
        writer.add(keys.CLOCK, messages.encode(stopped), messages.encoding(keys.CLOCK), clock.t_ns, 0)


def end_of(folder: Path, report: bool, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, int]:
    """Return a run's exit code, its last line on standard error, and how often what it did not do is marked."""
    outcome = type("Outcome", (), {"interrupted": False, "failed": False, "reason": "over"})()
    code = 0
    try:
        record_commands.conclude(outcome, folder, report)
    except typer.Exit as end:
        code = end.exit_code
    out, err = capsys.readouterr()
    return code, err.strip().rpartition("\n")[2], out.count(f"{NOT_AS_PLANNED}: ")
