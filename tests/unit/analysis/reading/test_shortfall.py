"""A flight that did not do what its plan says is marked, wherever it is shown; one that did is not."""

from collections.abc import Callable, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import synthetic_record
import typer
from refused import has_terms
from rich.console import Console
from synthetic_record import Flown

from zsim.contract import keys, messages
from zsim.contract.flight_messages import ClusterState, Truth
from zsim.contract.run_messages import Clock, ClusterRequest, Event
from zsim.record import RecordWriter
from zsim_agents.formation.flight_check import HELD_ON_REQUEST
from zsim_agents.formation.flight_plan import WAITS, waiting_step
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.trajectory import WaypointTrajectory
from zsim_analysis.reading.flight import FlightReader, read_flight
from zsim_analysis.reading.formation import formations_of
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.reading.shortfall import CRASHES, Shortfall, shortfalls
from zsim_analysis.reading.verdict import NOT_AS_PLANNED, marks_of, verdict
from zsim_analysis.report.figures.figure_mark import mark_figure
from zsim_analysis.report.figures.report_figures import figures
from zsim_analysis.report.make_report import facts, judge, page
from zsim_analysis.report.pages import COLUMN_IN, PAGE_IN, VERMILION, legend_above, new_figure
from zsim_analysis.report.tables import table
from zsim_deploy.cli import run_commands

State = Callable[[float], dict[str, Any]]
SOON: tuple[str, ...] = ("clusters.main.plan.takeoff_s=1", "report.window_s=[4, 30]")


def traffic(state: State, events: Sequence[Event] = (), duration_s: float = 30.0, overrides=SOON, **more: Any):
    """Yield a synthetic flight whose cluster states are other ones from `state`, by time [s]."""
    flown = Flown(duration_s=duration_s, overrides=tuple(overrides), events=tuple(events), **more)
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


def engaged_between(start_s: float, end_s: float) -> State:
    """Return the states of a cluster that is engaged for a part of a run, and assembles before and after."""
    return lambda t_s: {"phase": "engaged" if start_s <= t_s <= end_s else "assembling"}


LATE = "clusters.main.plan.trajectory={start_s: 60, expressions: {x_c: '5*t'}}"


@pytest.mark.parametrize(
    ("overrides", "step"), [(LATE, "trajectory at 60 s"), ("clusters.main.plan.land_s=33.3333", "landing at 33.33 s")]
)
def test_a_step_of_the_plan_for_which_the_run_was_too_short_is_named(overrides: str, step: str) -> None:
    (line,) = found(lambda t_s: {"phase": "engaged"}, overrides=(*SOON, overrides))
    assert (line.kind, line.subject, line.t_s, line.fails) == ("early", "main", 30.0, False)
    assert step in line.text


def test_a_run_that_ends_on_the_way_to_the_target_is_named() -> None:
    (line,) = found(lambda t_s: {"phase": "engaged"}, climb_s=40.0)
    assert (line.kind, line.subject, line.fails) == ("early", "main", False)
    assert found(lambda t_s: {"phase": "engaged"}, climb_s=20.0) == []
    assert found(lambda t_s: {"phase": "engaged", "reason": "guard"}, climb_s=40.0) == []


def test_errors_are_those_of_the_engaged_part_of_the_window() -> None:
    """Where it was not engaged, estimate − desired is zero whatever the drones did."""
    window_s = (4.0, 30.0)
    error = np.full(12, 0.2)
    whole, part, none = (
        formations_of(flight_of(state, est_amplitude=error))[0]
        for state in (lambda t_s: {"phase": "engaged"}, engaged_between(16.0, 22.0), engaged_between(31.0, 32.0))
    )
    assert part.errors(window_s) == whole.errors((16.0, 22.0))
    assert part.errors(window_s) != whole.errors(window_s)
    assert part.engaged_share(window_s) == pytest.approx(301 / 1301)
    assert none.engaged_share(window_s) == 0.0
    assert {value for errors in none.errors(window_s).values() for value in msgspec.structs.astuple(errors)} == {None}


@pytest.mark.usefixtures("unrendered")
@pytest.mark.parametrize(
    ("state", "part"), [(engaged_between(17.0, 30.0), "50"), (engaged_between(2.0, 3.0), "no errors")]
)
def test_table_figures_and_page_say_of_which_part_the_errors_are(state: State, part: str, tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", state, ())
    flight, formations, summary = judge(tmp_path / "run.mcap")
    assert summary.clusters["main"].engaged_share is not None
    assert part in summary.clusters["main"].part
    console = Console(width=200, file=StringIO())
    console.print(table(summary, "main"))
    assert summary.clusters["main"].part in console.file.getvalue()  # type: ignore[attr-defined]
    assert part in page(summary, [])
    assert all("window" in figure.drawing.get_suptitle() for figure in figures(flight, formations, summary))


def test_the_head_of_a_flight_that_was_cut_short_does_not_say_that_its_plan_was_flown(tmp_path: Path) -> None:
    answers = []
    for name, overrides in (("all", SOON), ("short", (*SOON, LATE))):
        write(tmp_path / name, lambda t_s: {"phase": "engaged"}, (), overrides=overrides)
        answers.append(dict(facts(judge(tmp_path / name)[-1]))["Flown as planned"])
    assert answers[0] == "yes" != answers[1]


@pytest.mark.parametrize("reason", ["too fast", "allowed: " + "sin(beta) min(p, q) is 0.35 m, " * 12])
def test_the_mark_of_a_figure_is_whole_and_covers_nothing(reason: str) -> None:
    for width_in in (COLUMN_IN, PAGE_IN):
        figure = new_figure(width_in, 2.0)
        axes = figure.subplots()
        for k in range(6):
            axes.plot([0, 1], [k, k], label=f"line {k}")
        legend_above(figure, axes, columns=2)
        lowest = figure.legend(handles=axes.lines[:2], loc="outside lower center")
        mark_figure(figure, "Not as planned", f"main: refused: {reason}", VERMILION)
        figure.draw_without_rendering()
        assert figure.get_suptitle().partition("\n")[0] == "Not as planned"
        (mark,), legend = figure.texts, figure.legends[0]
        above, middle, below = (each.get_window_extent() for each in (mark, legend, axes))
        axis = axes.get_tightbbox()
        assert axis is not None
        assert axis.y0 >= lowest.get_window_extent().y1
        assert 0 <= above.x0 <= above.x1 <= figure.bbox.width
        assert above.y1 <= figure.bbox.height
        assert above.y0 >= middle.y1
        assert middle.y0 >= below.y1


def test_a_collision_is_one_of_each_pair_with_both_names() -> None:
    contacts = numbered(
        event(7, "collision", "drone1", other="drone2"),
        event(8, "collision", "drone2", other="drone1"),
        event(9, "collision", "drone3", other="drone1"),
        event(9.5, "collision", "drone3", other="mast"),
    )
    lines = found(lambda t_s: {"phase": "engaged"}, events=contacts)
    assert [(line.kind, line.subject, line.t_s, line.fails) for line in lines] == [
        ("collision", "drone1, drone2", 7.0, True),
        ("collision", "drone3, drone1", 9.0, True),
        ("collision", "drone3, mast", 9.5, True),
    ]
    assert has_terms(lines[0].text, "at 7 s", "2 contacts")


def event(t_s: float, what: str, subject: str, by: str = "world", /, **data: Any) -> Event:
    return Event(round(t_s * 1e9), round(1000 * t_s), what, by, subject, what, data)


def numbered(*events: Event) -> tuple[Event, ...]:
    """Return events as a record has them that lacks none."""
    return tuple(msgspec.structs.replace(each, seq=seq) for seq, each in enumerate(events))


FALL = numbered(
    event(10.0, "fault", "drone1", id=1, kind="rotor_efficiency", target="drone1", source="scenario"),
    event(10.3, "emergency", "drone1", cause="tilt", commander="controller.main"),
    event(10.36, "flip", "drone1", commander="controller.main"),
    event(11.86, "impact", "drone1", speed_m_s=10.547, other="the ground", commander="controller.main"),
)


def test_a_fall_is_one_line_with_the_drone_the_times_and_the_fault() -> None:
    (line,) = found(lambda t_s: {"phase": "engaged"}, events=FALL)
    assert (line.kind, line.subject, line.t_s, line.fails) == ("emergency", "drone1", 10.3, True)
    assert has_terms(line.text, "10.3 s", "10.36 s", "10.5 m/s", "11.86 s", "scenario's", "rotor_efficiency since 10 s")


def test_a_touchdown_in_flight_is_one_and_a_crash_of_a_sweep() -> None:
    touchdown = event(31.5, "touchdown", "drone1", other="the ground", commander="controller.main")
    (line,) = found(lambda t_s: {"phase": "engaged"}, events=(touchdown,))
    assert (line.kind, line.subject, line.t_s, line.fails) == ("touchdown", "drone1", 31.5, True)
    assert has_terms(line.text, "drone1", "the ground", "in flight", "31.5 s")
    assert "touchdown" in CRASHES
    impact = event(31.52, "impact", "drone1", other="the ground", speed_m_s=2.0)
    (line,) = found(lambda t_s: {"phase": "engaged"}, events=(touchdown, impact))
    assert (line.kind, "in flight" in line.text, "2.0 m/s" in line.text) == ("touchdown", False, True)


@pytest.mark.parametrize(
    ("reports", "fails", "terms"),
    [
        ([{"state": "active", "done": 0}, {"state": "finished", "done": 5}], None, ()),
        ([{"state": "active", "done": 3}], False, ("flew 3 of 5 mission items", "the run ended")),
        (
            [{"state": "active", "done": 3}, {"state": "aborted", "done": 3, "reason": "geofence", "failsafe": True}],
            True,
            ("flew 3 of 5 mission items", "geofence", "at 11 s"),
        ),
        ([{"state": "aborted", "done": 2, "reason": "HOLD", "failsafe": False}], False, ("2 of 5", "HOLD")),
    ],
)
def test_a_mission_that_was_not_flown_to_its_end_is_one_and_fails_by_a_failsafe(
    reports: list[dict[str, Any]], fails: bool | None, terms: tuple[str, ...]
) -> None:
    events = [event(10 + k, "mission", "drone2", "mavlink.main", items=5, **each) for k, each in enumerate(reports)]
    lines = found(lambda t_s: {"phase": "engaged"}, events=numbered(*events))
    assert [(line.kind, line.subject, line.fails) for line in lines] == [("mission", "drone2", fails)] * bool(terms)
    assert all(has_terms(line.text, "drone2", *terms) for line in lines)


def test_a_fault_that_is_over_is_not_blamed() -> None:
    over = event(10.2, "fault_end", "drone1", id=1, kind="rotor_efficiency", target="drone1")
    (line,) = found(lambda t_s: {"phase": "engaged"}, events=(FALL[0], over, *FALL[1:]))
    assert "rotor_efficiency" not in line.text


def test_an_operator_s_emergency_is_reported_as_such_and_is_no_flight_as_planned(tmp_path: Path) -> None:
    stop = event(21.0, "emergency", "drone2", "console.1", cause="command")
    write(tmp_path / "run.mcap", lambda t_s: {"phase": "engaged"}, numbered(stop))
    summary = judge(tmp_path / "run.mcap")[-1]
    (line,) = summary.shortfalls
    assert (line.kind, line.subject, line.fails) == ("emergency", "drone2", True)
    assert has_terms(line.text, "drone2", "operator's", "emergency", "21 s", "console.1")
    assert dict(facts(summary))["Flown as planned"] == "no"


@pytest.mark.parametrize(
    ("commander", "cause", "fails"),
    [("controller.main", "silence", True), ("console.1", "silence", False), ("console.1", "battery", True)],
)
def test_a_landing_that_nobody_asked_for_fails_unless_its_pilot_let_it_be(
    commander: str, cause: str, fails: bool
) -> None:
    landing = event(12.0, "landing", "drone3", cause=cause, commander=commander)
    (line,) = found(lambda t_s: {"phase": "engaged"}, events=(landing,))
    assert (line.kind, line.subject, line.t_s, line.fails) == ("landing", "drone3", 12.0, fails)


def test_who_overrode_the_controller_is_reported_and_does_not_fail() -> None:
    flown = (event(8, "commander", "drone2", "console.1"), event(9.5, "release", "drone2", "console.1"))
    (line,) = found(lambda t_s: {"phase": "engaged"}, events=flown)
    assert (line.kind, line.subject, line.fails) == ("override", "drone2", False)
    assert has_terms(line.text, "console.1", "8 to 9.5 s")


@pytest.mark.parametrize(("length_s", "fails"), [(1.0, False), (6.0, True)])
def test_a_formation_that_a_fault_held_is_reported_and_fails_if_it_was_for_long(length_s: float, fails: bool) -> None:
    def held(t_s: float) -> dict[str, Any]:
        return {"phase": "held", "reason": "drone2 is late"} if 9.99 < t_s < 9.99 + length_s else {"phase": "engaged"}

    line = next(line for line in found(held) if line.kind == "held")
    assert (line.subject, line.t_s, line.fails) == ("main", pytest.approx(10.0), fails)
    assert has_terms(line.text, f"for {length_s:g} s", "drone2 is late")


@pytest.mark.parametrize(
    ("events", "fails"),
    [
        ((event(9.9, "mode", "drone2", "console.1", mode="land"),), False),
        ((event(9.9, "mode", "drone2", "controller.main", mode="land"),), True),
        ((event(9.9, "commander", "drone2", "console.1"), event(14, "release", "drone2", "console.1")), False),
        ((event(9.9, "commander", "drone2", "console.1"), event(11, "release", "drone2", "console.1")), True),
        ((event(9.9, "commander", "other", "console.1"), event(14, "release", "other", "console.1")), True),
    ],
)
def test_a_hold_while_others_fly_or_land_a_drone_of_the_formation_is_reported(
    events: tuple[Event, ...], fails: bool
) -> None:
    def held(t_s: float) -> dict[str, Any]:
        return {"phase": "held", "reason": "drone2 is late"} if 9.99 < t_s < 13.99 else {"phase": "engaged"}

    line = next(line for line in found(held, events=events) if line.kind == "held")
    assert (line.subject, line.fails) == ("main", fails)


@pytest.mark.parametrize(
    ("away_m", "span_s", "others", "strayed"),
    [
        ((4.0, 3.5, 0.0), (16.0, 30.0), False, True),
        ((4.0, 2.5, 0.0), (16.0, 30.0), False, False),  # nearer than 5 m
        ((0.0, 0.0, 40.0), (16.0, 17.9), False, False),  # too short
        ((0.0, 0.0, 40.0), (3.0, 11.0), False, False),  # on the way to its place
        ((0.0, 0.0, 40.0), (16.0, 30.0), True, False),  # flown by others
    ],
)
def test_a_drone_that_is_truly_far_from_its_place_is_one(
    away_m: tuple[float, float, float], span_s: tuple[float, float], others: bool, strayed: bool, tmp_path: Path
) -> None:
    events = [Event(2_000_000_000, 0, "commander", "joystick" if others else "controller.main", "drone2", "")]
    with RecordWriter(tmp_path / "run.mcap") as writer:
        for key, message, wall_ns in traffic(lambda t_s: {"phase": "engaged" if t_s > 4 else "assembling"}, events):
            if (
                isinstance(message, Truth)
                and key == keys.truth("drone2")
                and span_s[0] <= message.t_ns / 1e9 <= span_s[1]
            ):
                moved = tuple(np.add(message.position_m, away_m).tolist())
                message = msgspec.structs.replace(message, position_m=moved)
            writer.add_message(key, message, wall_ns)
    for motion in (True, False):
        lines = shortfalls(read_flight(tmp_path / "run.mcap", motion=motion), (4.0, 30.0))
        found = [line for line in lines if line.kind == "strayed"]
        assert [(line.subject, line.t_s, line.fails) for line in found] == [("drone2", 16.0, True)] * strayed


def test_what_others_asked_of_a_formation_is_reported_and_a_hold_on_request_is_no_fault() -> None:
    def state(t_s: float) -> dict[str, Any]:
        return {"phase": "held", "reason": HELD_ON_REQUEST} if t_s > 20 else {"phase": "engaged"}

    asked = ClusterRequest(20_000_000_000, 0, "hold", {}, "console.1", True)
    refused_one = msgspec.structs.replace(asked, op="land", ok=False)
    flight = flight_of(state)
    flight.clusters[0].requests += [asked, refused_one]
    kinds = {line.kind: line for line in shortfalls(flight, (4.0, 30.0))}
    assert kinds.keys() == {"request", "window"}
    assert has_terms(kinds["request"].text, "hold at 20 s", "console.1")
    assert not any(line.fails for line in kinds.values())


WAY = [{"at_s": 0, "values": {"x_c": 5}}, {"at_s": 5, "values": {"x_c": 8}}, {"at_s": 10, "values": {"x_c": 5}}]
TRAJECTORY = (
    *SOON,
    f"clusters.main.plan.trajectory={{start_s: 10, waypoints: {msgspec.json.encode(WAY).decode()}}}",
)


def test_a_trajectory_that_was_interrupted_is_reported_with_all_that_was_flown() -> None:
    led = along(10.0)

    def broken(t_s: float) -> dict[str, Any]:
        return {**led(t_s), **({"phase": "held"} if 13 < t_s < 16 else {})}

    line = next(line for line in found(broken, overrides=TRAJECTORY) if line.kind == "plan")
    assert has_terms(line.text, "for 7.1 s in all", "from 6 to 10 of 10 s")


def along(from_s: float, to_s: float = 30.0) -> State:
    """Return the states of a formation that is led along `WAY` in this time, and is refused that before."""
    space = cluster_space(3)
    at_target = np.array([5, -5, 15, 0, 0, np.pi / 2, 0, 0, 0, 4, 4, np.pi / 4])
    way = WaypointTrajectory(space, WAY, at_target)

    def state(t_s: float) -> dict[str, Any]:
        led = from_s <= t_s <= to_s
        reason = "" if led or t_s < 10 or t_s > to_s else f"trajectory{WAITS}a robot moves at 2.88 of its limits"
        return {"phase": "engaged", "desired": tuple(way.value(t_s - 10.0)[0] if led else at_target), "reason": reason}

    return state


def test_a_trajectory_of_which_only_the_end_was_flown_is_one() -> None:
    (line,) = found(along(19.5), overrides=TRAJECTORY)
    assert (line.kind, line.subject, line.t_s, line.fails) == ("plan", "main", 10.0, True)
    assert has_terms(line.text, "from 9.5 to 10 of 10 s", "refused from 10 to 19.48 s", "2.88")


def test_a_trajectory_that_was_flown_and_one_that_was_joined_at_once_are_none() -> None:
    assert found(along(10.0), overrides=TRAJECTORY) == []
    assert found(along(10.5), overrides=TRAJECTORY) == []


def test_a_trajectory_that_was_left_is_one_unless_others_asked_for_it() -> None:
    flight = flight_of(along(10.0, 14.0), overrides=TRAJECTORY)
    (line,) = shortfalls(flight, (4.0, 30.0))
    assert (line.kind, line.fails) == ("plan", True)
    assert has_terms(line.text, "from 0 to 4.1 of 10 s")
    flight.clusters[0].requests.append(ClusterRequest(14_000_000_000, 0, "hold", {}, "console.1", True))
    assert {line.kind: line.fails for line in shortfalls(flight, (4.0, 30.0))} == {"plan": False, "request": False}


def test_a_run_that_ends_within_its_trajectory_is_reported() -> None:
    (line,) = found(along(10.0), overrides=TRAJECTORY, duration_s=14.0)
    assert (line.kind, line.fails) == ("early", False)
    assert "4 of 10 s" in line.text


def test_a_target_that_was_due_earlier_is_one() -> None:
    overrides = (*SOON, "clusters.main.plan.target_over_s=4")

    def late(t_s: float) -> dict[str, Any]:
        return {"phase": "engaged", "reason": f"target{WAITS}over_s is 4 s" if t_s < 9 else ""}

    assert found(late, overrides=overrides, climb_s=3.9) == []
    (line,) = found(late, overrides=overrides, climb_s=20.0)
    assert (line.kind, line.t_s, line.fails) == ("plan", 4.0, True)
    assert has_terms(line.text, "16 s after", "over_s is 4 s")


def test_the_phases_outside_the_engagement_have_their_shares() -> None:
    phases = ((6.6, "taking_off"), (9.2, "assembling"), (17.0, "engaged"), (30.0, "held"))
    line = next(
        line
        for line in found(lambda t_s: {"phase": next(phase for end, phase in phases if t_s <= end)})
        if line.kind == "window"
    )
    assert has_terms(line.text, "engaged in 30 %", "held 50 %", "taking_off 10.1 %", "assembling 9.99 %")


def test_a_record_without_events_of_falls_shows_that_a_drone_ended_in_an_emergency() -> None:
    flight = flight_of(lambda t_s: {"phase": "engaged"})
    flight.tracks[1].states[-1] = "emergency"
    (line,) = shortfalls(flight, (4.0, 30.0))
    assert (line.kind, line.subject, line.fails) == ("emergency", "drone2", True)
    flight.events.append(event(29.0, "mode", "drone2", "console.1", mode="emergency"))
    assert shortfalls(flight, (4.0, 30.0)) == []  # stopped on the ground: in the air there would be an event of it


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
        run_commands.conclude(outcome, tmp_path, True)
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
    "a fall": (lambda t_s: {"phase": "engaged"}, FALL, 1),
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


def write(record: Path, state: State, events: Sequence[Event], **options: Any) -> None:
    """Write a record that is complete."""
    flown = list(traffic(state, events, **options))
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
        run_commands.conclude(outcome, folder, report)
    except typer.Exit as end:
        code = end.exit_code
    out, err = capsys.readouterr()
    return code, err.strip().rpartition("\n")[2], out.count(f"{NOT_AS_PLANNED}: ")


# Processes that were expected


def process_event(kind: str, subject: str, **data: Any) -> Event:
    return Event(5_000_000_000, 0, kind, "world", subject, f"{subject} {kind}", data)


EXPECTS_FENCE = 'processes.expect=["estimator.drone1", "fence.main"]'


@pytest.mark.parametrize(
    ("events", "processes", "fails"),
    [
        ([process_event("failure", "controller.main")], (), [True]),
        ([process_event("failure", "controller.main")], ("processes.on_death={controller: drop}",), []),
        ([process_event("overdue", "fence.main")], (EXPECTS_FENCE,), [True]),
        ([process_event("overdue", "fence.main")], (EXPECTS_FENCE, "processes.on_overdue={fence.main: drop}"), []),
        (
            [process_event("death", "fence.main", on_death="drop"), process_event("drop", "fence.main")],
            (EXPECTS_FENCE,),
            [True],
        ),
        ([process_event("death", "fence.main", on_death="drop"), process_event("drop", "fence.main")], (), []),
        ([process_event("death", "fence.main", on_death="drop")], (EXPECTS_FENCE,), []),  # another does its work
        (
            [process_event("death", "fence.main", on_death="drop"), process_event("drop", "fence.main")],
            (EXPECTS_FENCE, "processes.on_death={fence: drop}"),
            [],
        ),
        ([process_event("death", "estimator.drone1", on_death="restart")], (), []),
        ([process_event("death", "estimator.drone1", on_death="end")], (), [True]),
        ([process_event("leave", "fence.main")], (EXPECTS_FENCE,), [False]),
        ([process_event("leave", "estimator.drone1", fails=True)], (), [True]),
        ([process_event("end", "world"), process_event("death", "fence.main", on_death="end")], (EXPECTS_FENCE,), []),
    ],
)
def test_a_process_that_was_expected_and_is_lost_is_one(
    events: list[Event], processes: tuple[str, ...], fails: list[bool]
) -> None:
    numbered = [msgspec.structs.replace(event, seq=seq) for seq, event in enumerate(events, start=100)]
    lines = found(lambda t_s: {"phase": "engaged"}, events=numbered, overrides=(*SOON, *processes))
    assert [line.fails for line in lines if line.kind == "process"] == fails
    assert all(line.subject in line.text and line.t_s == 5.0 for line in lines if line.kind == "process")
