"""A flight that falls short of its plan is marked wherever it is shown; one that follows it is not."""

from collections.abc import Callable, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
import synthetic_record
import typer
from refused import has_terms
from rich.console import Console
from synthetic_record import Flown

from zsim.contract import keys
from zsim.contract.flight_messages import ClusterState, Truth
from zsim.contract.run_messages import Clock, ClusterRequest, Event
from zsim_agents.formation.flight_check import HELD_ON_REQUEST
from zsim_agents.formation.flight_plan import WAITING
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_agents.formation.trajectory import WaypointTrajectory
from zsim_analysis.reading.formation import formations_of
from zsim_analysis.reading.recorded_flight import RecordedFlight, read_flight
from zsim_analysis.reading.shortfall import CRASHES, NOT_AS_PLANNED, Shortfall, marks_of, shortfalls, verdict, window
from zsim_analysis.report.figure_style import COLUMN_IN, PAGE_IN, VERMILION, legend_above, mark_figure, new_figure
from zsim_analysis.report.make_report import facts, figures, page
from zsim_analysis.report.summary import judge, table
from zsim_deploy.cli import run_commands

State = Callable[[float], dict[str, Any]]
SOON: tuple[str, ...] = ("clusters.main.plan.takeoff_s=1", "report.window_s=[4, 30]")
WINDOW_S = (4.0, 30.0)


def traffic(state: State, events: Sequence[Event] = (), duration_s: float = 30.0, overrides=SOON, **more: Any):
    """Yield a synthetic flight whose cluster states have the fields that `state` returns for the time in s."""
    flown = Flown(duration_s=duration_s, overrides=tuple(overrides), events=tuple(events), **more)
    for key, message, wall_ns in synthetic_record.traffic(flown):
        if isinstance(message, ClusterState):
            message = msgspec.structs.replace(message, **state(message.t_ns / 1e9))
        yield key, message, wall_ns


def flight_of(state: State, **options: Any) -> RecordedFlight:
    return synthetic_record.flight(traffic(state, **options))


def found(state: State, **options: Any) -> list[Shortfall]:
    return shortfalls(flight_of(state, **options), WINDOW_S)


def write(record: Path, state: State, events: Sequence[Event] = (), **options: Any) -> None:
    """Write a complete record."""
    flown = list(traffic(state, events, **options))
    clock = next(message for _, message, _ in reversed(flown) if isinstance(message, Clock))
    stopped = msgspec.structs.replace(clock, seq=clock.seq + 1, state="stopped")
    synthetic_record.record(record, [*flown, (keys.CLOCK, stopped, 0)])


def event(t_s: float, what: str, subject: str, by: str = "world", /, **data: Any) -> Event:
    return Event(round(t_s * 1e9), round(1000 * t_s), what, by, subject, what, data)


def numbered(*events: Event) -> tuple[Event, ...]:
    """Return events numbered as in a record without gaps."""
    return tuple(msgspec.structs.replace(each, seq=seq) for seq, each in enumerate(events))


def engaged(t_s: float) -> dict[str, Any]:
    return {"phase": "engaged"}


def refused(t_s: float) -> dict[str, Any]:
    """Return the state of a cluster that hovers because its trajectory is refused."""
    return {"phase": "engaged", "reason": f"the guard parts a and b; trajectory{WAITING}too fast" if t_s > 5 else ""}


def assembling(t_s: float) -> dict[str, Any]:
    return {"phase": "assembling", "reason": f"engage{WAITING}drone2 is flying"}


def engaged_between(start_s: float, end_s: float) -> State:
    return lambda t_s: {"phase": "engaged" if start_s <= t_s <= end_s else "assembling"}


def held_for(length_s: float) -> State:
    late = {"phase": "held", "reason": "drone2 is late"}
    return lambda t_s: late if 9.99 < t_s < 9.99 + length_s else {"phase": "engaged"}


def guarded(t_s: float) -> dict[str, Any]:
    return {"phase": "engaged", "reason": "guard"}


def waits_for_time(t_s: float) -> dict[str, Any]:
    return {"phase": "engaged", "reason": f"target{WAITING}over_s is 4 s" if t_s < 9 else ""}


def dropped(t_s: float) -> dict[str, Any]:
    """Return the state of a cluster whose landing drops the refused trajectory."""
    return refused(t_s) if t_s < 20 else {"phase": "landing"}


def by_phases(t_s: float) -> dict[str, Any]:
    phases = ((6.6, "taking_off"), (9.2, "assembling"), (17.0, "engaged"), (30.0, "held"))
    return {"phase": next(phase for end_s, phase in phases if t_s <= end_s)}


WAY = [{"at_s": 0, "values": {"x_c": 5}}, {"at_s": 5, "values": {"x_c": 8}}, {"at_s": 10, "values": {"x_c": 5}}]
TRAJECTORY = (*SOON, f"clusters.main.plan.trajectory={{start_s: 10, waypoints: {msgspec.json.encode(WAY).decode()}}}")
LATE = "clusters.main.plan.trajectory={start_s: 60, expressions: {x_c: '5*t'}}"
TIMED = (*SOON, "clusters.main.plan.target_over_s=4")


def along(from_s: float, to_s: float = 30.0) -> State:
    """Return the states of a formation that follows `WAY` in this interval and is refused its trajectory before."""
    space = cluster_space(3)
    at_target = np.array([5, -5, 15, 0, 0, np.pi / 2, 0, 0, 0, 4, 4, np.pi / 4])
    way = WaypointTrajectory(space, WAY, at_target)

    def state(t_s: float) -> dict[str, Any]:
        led = from_s <= t_s <= to_s
        reason = "" if led or t_s < 10 or t_s > to_s else f"trajectory{WAITING}a robot moves at 2.88 times its limits"
        return {"phase": "engaged", "desired": tuple(way.value(t_s - 10.0)[0] if led else at_target), "reason": reason}

    return state


def interrupted() -> State:
    led = along(10.0)
    return lambda t_s: {**led(t_s), **({"phase": "held"} if 13 < t_s < 16 else {})}


FALL = numbered(
    event(10.0, "fault", "drone1", id=1, kind="rotor_efficiency", target="drone1", source="scenario"),
    event(10.3, "emergency", "drone1", cause="tilt", commander="controller.main"),
    event(10.36, "flip", "drone1", commander="controller.main"),
    event(11.86, "impact", "drone1", speed_m_s=10.547, other="the ground", commander="controller.main"),
)
TOUCHDOWN = event(31.5, "touchdown", "drone1", other="the ground", commander="controller.main")
IMPACT = event(31.52, "impact", "drone1", other="the ground", speed_m_s=2.0)
CONTACTS = numbered(
    event(7, "collision", "drone1", other="drone2"),
    event(8, "collision", "drone2", other="drone1"),
    event(9, "collision", "drone3", other="drone1"),
    event(9.5, "collision", "drone3", other="mast"),
)


def landing(commander: str, cause: str) -> tuple[Event, ...]:
    return (event(12.0, "landing", "drone3", cause=cause, commander=commander),)


def refusals_before(commander: str, *at_s: float) -> tuple[Event, ...]:
    """Return a landing of drone3 at 12 s for lack of commands, after velocity commands refused at these times."""
    key = "drone/drone3/cmd/velocity"
    refusals = (event(t_s, "refused", key, commander, reason="age is 640 ms; must be <= 500 ms") for t_s in at_s)
    return numbered(*refusals, *landing(commander, "silence"))


def mission(*reports: dict[str, Any]) -> tuple[Event, ...]:
    events = [event(10 + k, "mission", "drone2", "mavlink.main", items=5, **each) for k, each in enumerate(reports)]
    return numbered(*events)


class Case(NamedTuple):
    """A flight, its shortfalls (kind, subject, time if known, "!" if the flight fails) and terms of the first one."""

    state: State
    shortfalls: tuple[str, ...]
    terms: tuple[str, ...]
    options: dict[str, Any]


def case(state: State, shortfalls: str = "", *terms: str, **options: Any) -> Case:
    return Case(state, tuple(filter(None, shortfalls.split("; "))), terms, options)


ACTIVE, FINISHED = {"state": "active", "done": 3}, {"state": "finished", "done": 5}
GEOFENCE = {"state": "aborted", "done": 3, "reason": "geofence", "failsafe": True}
HOLD = {"state": "aborted", "done": 2, "reason": "HOLD", "failsafe": False}
OVERRIDE = (event(8, "commander", "drone2", "console.1"), event(9.5, "release", "drone2", "console.1"))
LANDS, LATER = "clusters.main.plan.land_s=33.3333", "clusters.main.plan.takeoff_s=40"
LED: dict[str, Any] = {"overrides": TRAJECTORY}
REFUSED_FIRST = ("from 9.5 to 10 of 10 s", "refused from 10 to 19.48 s", "2.88")
FELL = ("10.3 s", "10.36 s", "10.5 m/s", "11.86 s", "scenario's", "rotor_efficiency since 10 s")
PAIRS = "collision drone1,drone2 7 !; collision drone3,drone1 9 !; collision drone3,mast 9.5 !"

CASES = {
    "as planned": case(engaged),
    "step refused to the end": case(refused, "plan main 5.02 !", "too fast"),
    "step granted": case(lambda t_s: {**refused(t_s), **({"reason": ""} if t_s > 8 else {})}),
    "step dropped by the landing": case(dropped, "plan main !; window main", "too fast"),
    "never engaged": case(assembling, "engagement main 1 !", "drone2"),
    "too short to engage": case(assembling, "early main", duration_s=12.0),
    "too short to take off": case(assembling, "early main", overrides=(LATER,)),
    "engaged in half of the window": case(engaged_between(17.01, 99.0), "window main", "50 %"),
    "phases": case(by_phases, "held main !; window main"),
    "too short for the trajectory": case(engaged, "early main 30", "trajectory at 60 s", overrides=(*SOON, LATE)),
    "too short for the landing": case(engaged, "early main 30", "landing at 33.33 s", overrides=(*SOON, LANDS)),
    "on the way to the target": case(engaged, "early main", climb_s=40.0),
    "at the target": case(engaged, climb_s=20.0),
    "moved by the guard": case(guarded, climb_s=40.0),
    "target in time": case(waits_for_time, overrides=TIMED, climb_s=3.9),
    "target late": case(waits_for_time, "plan main 4 !", "16 s after", "over_s is 4 s", overrides=TIMED, climb_s=20.0),
    "trajectory flown": case(along(10.0), **LED),
    "trajectory joined at once": case(along(10.5), **LED),
    "only the end of a trajectory": case(along(19.5), "plan main 10 !", *REFUSED_FIRST, **LED),
    "trajectory left": case(along(10.0, 14.0), "plan main !", "from 0 to 4.1 of 10 s", **LED),
    "trajectory interrupted": case(interrupted(), "held main !; plan main !; window main", **LED),
    "ended within the trajectory": case(along(10.0), "early main", "4 of 10 s", duration_s=14.0, **LED),
    "collisions": case(engaged, PAIRS, "at 7 s", "2 contacts", events=CONTACTS),
    "fall": case(engaged, "emergency drone1 10.3 !", *FELL, events=FALL),
    "touchdown": case(engaged, "touchdown drone1 31.5 !", "the ground", "in flight", "31.5 s", events=(TOUCHDOWN,)),
    "impact": case(engaged, "touchdown drone1 31.5 !", "2.0 m/s", events=(TOUCHDOWN, IMPACT)),
    "mission to its end": case(engaged, events=mission(ACTIVE, FINISHED)),
    "mission in part": case(engaged, "mission drone2", "drone2", "3 of 5", "the run ended", events=mission(ACTIVE)),
    "failsafe": case(engaged, "mission drone2 !", "3 of 5", "geofence", "at 11 s", events=mission(ACTIVE, GEOFENCE)),
    "mission ended by its pilot": case(engaged, "mission drone2", "2 of 5", "HOLD", events=mission(HOLD)),
    "silent controller": case(engaged, "landing drone3 12 !", events=landing("controller.main", "silence")),
    "refused controller": case(
        engaged,
        "landing drone3 12 !",
        "no command from controller.main took effect; refused: age is 640 ms",
        events=refusals_before("controller.main", 10.0),
    ),
    "silent long after a refusal": case(
        engaged, "landing drone3 12 !", "took effect)", events=refusals_before("controller.main", 2.0)
    ),
    "silent pilot": case(engaged, "landing drone3 12", events=landing("console.1", "silence")),
    "empty battery": case(engaged, "landing drone3 12 !", events=landing("console.1", "battery")),
    "flown by others": case(engaged, "override drone2", "console.1", "8 to 9.5 s", events=OVERRIDE),
    "held shortly": case(held_for(1.0), "held main 10; window main", "for 1 s", "drone2 is late"),
    "held for long": case(held_for(6.0), "held main 10 !; window main", "for 6 s", "drone2 is late"),
}


@pytest.mark.parametrize("name", CASES)
def test_the_shortfalls_of_a_flight_are_found(name: str) -> None:
    state, expected, terms, options = CASES[name]
    lines = found(state, **options)
    for line, each in zip(lines, expected, strict=True):
        kind, subject, *rest = each.split()
        assert (line.kind, line.subject.replace(" ", ""), line.fails) == (kind, subject, "!" in rest)
        assert rest[:1] in ([], ["!"]) or line.t_s == pytest.approx(float(rest[0]))
    assert not terms or has_terms(lines[0].text, *terms)


def test_texts_give_shares_and_durations_and_omit_irrelevant_causes() -> None:
    _, outside = found(by_phases)
    assert has_terms(outside.text, "engaged in 30 %", "held 50 %", "taking_off 10.1 %", "assembling 9.99 %")
    _, parted, _ = found(interrupted(), overrides=TRAJECTORY)
    assert has_terms(parted.text, "for 7.1 s in all", "from 6 to 10 of 10 s")
    (hit,) = found(engaged, events=(TOUCHDOWN, IMPACT))
    assert "in flight" not in hit.text  # the touchdown is part of the impact
    assert "touchdown" in CRASHES
    over = event(10.2, "fault_end", "drone1", id=1, kind="rotor_efficiency", target="drone1")
    (line,) = found(engaged, events=(FALL[0], over, *FALL[1:]))
    assert "rotor_efficiency" not in line.text


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
def test_a_hold_fails_the_flight_unless_others_fly_or_land_a_drone(events: tuple[Event, ...], fails: bool) -> None:
    line = next(line for line in found(held_for(4.0), events=events) if line.kind == "held")
    assert (line.subject, line.fails) == ("main", fails)


@pytest.mark.parametrize(
    ("away_m", "span_s", "others", "strayed"),
    [
        ((4.0, 3.5, 0.0), (16.0, 30.0), False, True),
        ((4.0, 2.5, 0.0), (16.0, 30.0), False, False),  # nearer than 5 m
        ((0.0, 0.0, 40.0), (16.0, 17.9), False, False),  # too brief
        ((0.0, 0.0, 40.0), (3.0, 11.0), False, False),  # on the way to its place
        ((0.0, 0.0, 40.0), (16.0, 30.0), True, False),  # flown by others
    ],
)
def test_a_drone_whose_true_position_strays_is_a_shortfall(
    away_m: tuple[float, float, float], span_s: tuple[float, float], others: bool, strayed: bool, tmp_path: Path
) -> None:
    def moved():
        for key, message, wall_ns in traffic(engaged_between(4.01, 99.0), events):
            is_away = span_s[0] <= message.t_ns / 1e9 <= span_s[1]
            if is_away and isinstance(message, Truth) and key == keys.truth("drone2"):
                position_m = tuple(np.add(message.position_m, away_m).tolist())
                message = msgspec.structs.replace(message, position_m=position_m)
            yield key, message, wall_ns

    events = [event(2.0, "commander", "drone2", "joystick" if others else "controller.main")]
    synthetic_record.record(tmp_path / "run.mcap", moved())
    for motion in (True, False):
        lines = shortfalls(read_flight(tmp_path / "run.mcap", motion=motion), WINDOW_S)
        kept = [line for line in lines if line.kind == "strayed"]
        assert [(line.subject, line.t_s, line.fails) for line in kept] == [("drone2", 16.0, True)] * strayed


def test_a_request_by_others_excuses_a_hold_and_a_left_trajectory() -> None:
    def state(t_s: float) -> dict[str, Any]:
        return {"phase": "held", "reason": HELD_ON_REQUEST} if t_s > 20 else {"phase": "engaged"}

    asked = ClusterRequest(20_000_000_000, 0, "hold", {}, "console.1", True)
    flight = flight_of(state)
    flight.clusters[0].requests += [asked, msgspec.structs.replace(asked, op="land", ok=False)]
    kinds = {line.kind: line for line in shortfalls(flight, WINDOW_S)}
    assert kinds.keys() == {"request", "window"}
    assert has_terms(kinds["request"].text, "hold at 20 s", "console.1")
    assert not any(line.fails for line in kinds.values())
    flight = flight_of(along(10.0, 14.0), overrides=TRAJECTORY)
    flight.clusters[0].requests.append(msgspec.structs.replace(asked, t_ns=14_000_000_000))
    assert {line.kind: line.fails for line in shortfalls(flight, WINDOW_S)} == {"plan": False, "request": False}


def test_a_final_emergency_without_an_event_is_a_shortfall() -> None:
    flight = flight_of(engaged)
    flight.tracks[1].states[-1] = "emergency"
    (line,) = shortfalls(flight, WINDOW_S)
    assert (line.kind, line.subject, line.fails) == ("emergency", "drone2", True)
    flight.events.append(event(29.0, "mode", "drone2", "console.1", mode="emergency"))
    assert shortfalls(flight, WINDOW_S) == []  # stopped on the ground: in the air, an event would be on record


EXPECTS_FENCE = 'processes.expect=["estimator.drone1", "fence.main"]'
DEATH, AWAITED, DROP = {"on_death": "drop"}, {"on_death": "wait"}, {}
DROPS_FENCE, LOSES_FENCE = "processes.on_death={fence: drop}", "processes.on_overdue={fence.main: drop}"


@pytest.mark.parametrize(
    ("events", "processes", "fails"),
    [
        ([("failure", "controller.main", {})], (), [True]),
        ([("failure", "controller.main", {})], ("processes.on_death={controller: drop}",), []),
        ([("overdue", "fence.main", {})], (EXPECTS_FENCE,), [True]),
        ([("overdue", "fence.main", {})], (EXPECTS_FENCE, LOSES_FENCE), []),
        ([("death", "fence.main", DEATH), ("drop", "fence.main", DROP)], (EXPECTS_FENCE,), [True]),
        ([("death", "fence.main", DEATH), ("drop", "fence.main", DROP)], (), []),
        ([("death", "fence.main", DEATH)], (EXPECTS_FENCE,), []),  # another process serves in its place
        ([("death", "fence.main", DEATH), ("drop", "fence.main", DROP)], (EXPECTS_FENCE, DROPS_FENCE), []),
        ([("death", "fence.main", AWAITED), ("drop", "fence.main", DROP)], (EXPECTS_FENCE,), [True]),
        ([("death", "fence.main", AWAITED), ("drop", "fence.main", DROP)], (EXPECTS_FENCE, LOSES_FENCE), []),
        ([("death", "fence.main", DEATH), ("drop", "fence.main", DROP)], (EXPECTS_FENCE, LOSES_FENCE), [True]),
        ([("death", "estimator.drone1", {"on_death": "restart"})], (), []),
        ([("death", "estimator.drone1", {"on_death": "end"})], (), [True]),
        ([("leave", "fence.main", {})], (EXPECTS_FENCE,), [False]),
        ([("leave", "estimator.drone1", {"fails": True})], (), [True]),
        ([("end", "world", {}), ("death", "fence.main", {"on_death": "end"})], (EXPECTS_FENCE,), []),
    ],
)
def test_the_loss_of_an_expected_process_is_a_shortfall(
    events: list[tuple[str, str, dict[str, Any]]], processes: tuple[str, ...], fails: list[bool]
) -> None:
    made = [
        Event(5_000_000_000, seq, kind, "world", subject, f"{subject} {kind}", data)
        for seq, (kind, subject, data) in enumerate(events, start=100)
    ]
    lines = [line for line in found(engaged, events=made, overrides=(*SOON, *processes)) if line.kind == "process"]
    assert [line.fails for line in lines] == fails
    assert all(line.subject in line.text and line.t_s == 5.0 for line in lines)


@pytest.mark.parametrize(
    ("asked", "length_s", "expected", "terms"),
    [
        (None, 30.0, (10.0, 30.0), ()),
        ((120, 320), 330.0, (120, 320), ()),
        ((120, 320), 200.0, (120, 200.0), ("inside",)),
        ((120, 320), 60.0, (20.0, 60.0), ("before",)),
        (None, 0.0, (0.0, 0.0), ()),
    ],
)
def test_the_window_of_the_statistics_is_fitted_to_the_run(
    asked: tuple[float, float] | None, length_s: float, expected: tuple[float, float], terms: tuple[str, ...]
) -> None:
    span_s, note = window(asked, length_s)
    assert span_s == pytest.approx(expected)
    assert has_terms(note, *terms) if terms else note == ""


# Presentation of shortfalls


def test_errors_cover_only_the_engaged_part_of_the_window() -> None:
    """While a formation is not engaged, estimate − desired is zero whatever the drones do."""
    whole, part, none = (
        formations_of(flight_of(state, est_amplitude=np.full(12, 0.2)))[0]
        for state in (engaged, engaged_between(16.0, 22.0), engaged_between(31.0, 32.0))
    )
    assert part.errors(WINDOW_S) == whole.errors((16.0, 22.0)) != whole.errors(WINDOW_S)
    assert part.engaged_share(WINDOW_S) == pytest.approx(301 / 1301)
    assert none.engaged_share(WINDOW_S) == 0.0
    assert {value for errors in none.errors(WINDOW_S).values() for value in msgspec.structs.astuple(errors)} == {None}


@pytest.mark.parametrize(
    ("state", "part"), [(engaged_between(17.0, 30.0), "50"), (engaged_between(2.0, 3.0), "no errors")]
)
def test_table_figures_and_page_state_the_part_the_errors_cover(state: State, part: str, tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", state)
    flight, formations, summary = judge(tmp_path / "run.mcap")
    assert summary.clusters["main"].engaged_share is not None
    assert part in summary.clusters["main"].part
    console = Console(width=200, file=StringIO())
    console.print(table(summary, "main"))
    assert summary.clusters["main"].part in console.file.getvalue()  # type: ignore[attr-defined]
    assert part in page(summary, [])
    if part == "50":  # one case suffices: the marks do not depend on the note
        assert all("window" in figure.drawing.get_suptitle() for figure in figures(flight, formations, summary))


@pytest.mark.parametrize(
    ("options", "planned"),
    [
        ({}, "yes"),
        ({"overrides": (*SOON, LATE)}, "as far as the run went"),
        ({"events": numbered(event(21.0, "emergency", "drone2", "console.1", cause="command"))}, "no"),
    ],
)
def test_the_head_of_a_page_states_whether_the_plan_was_flown(
    options: dict[str, Any], planned: str, tmp_path: Path
) -> None:
    write(tmp_path / "run.mcap", engaged, **options)
    summary = judge(tmp_path / "run.mcap")[-1]
    assert dict(facts(summary))["Flown as planned"] == planned
    if planned == "no":
        assert has_terms(summary.shortfalls[0].text, "drone2", "operator's", "emergency", "21 s", "console.1")


@pytest.mark.parametrize("reason", ["too fast", "allowed: " + "sin(beta) min(p, q) is 0.35 m, " * 12])
@pytest.mark.parametrize("width_in", [COLUMN_IN, PAGE_IN])
def test_the_mark_of_a_figure_is_complete_and_covers_nothing(reason: str, width_in: float) -> None:
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


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "name",
    ["step refused to the end", "never engaged", "collisions", "fall", "engaged in half of the window", "as planned"],
)
def test_the_verdict_is_the_same_with_and_without_a_report(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state, expected, terms, options = CASES[name]
    code = int(any("!" in each for each in expected))
    write(tmp_path / "run.mcap", state, **options)
    flight, formations, summary = judge(tmp_path / "run.mcap")
    assert verdict(tmp_path / "run.mcap").shortfalls == summary.shortfalls
    reported, plain = (end_of(tmp_path, report, capsys) for report in (True, False))
    assert reported == plain
    assert plain[0] == code
    assert summary.as_planned == (code == 0)
    assert any(fails and NOT_AS_PLANNED in mark for mark, fails in marks_of(summary.shortfalls)) == bool(code)
    assert (NOT_AS_PLANNED in (table(summary, "main").title or "")) == bool(code)
    if name == "step refused to the end":
        for figure in figures(flight, formations, summary):
            assert terms[0] in " ".join(figure.drawing.get_suptitle().split())  # the title may wrap
        assert terms[0] in page(summary, [])
        assert terms[0] in plain[1]


def end_of(folder: Path, report: bool, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, int]:
    """Return a run's exit code, its last line on standard error and the number of marked shortfalls."""
    outcome = type("Outcome", (), {"interrupted": False, "failed": False, "reason": "over"})()
    code = 0
    try:
        run_commands.conclude(outcome, folder, report)
    except typer.Exit as end:
        code = end.exit_code
    out, err = capsys.readouterr()
    return code, err.strip().rpartition("\n")[2], out.count(f"{NOT_AS_PLANNED}: ")
