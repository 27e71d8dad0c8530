"""Alarms, losses and preflight checks: what is shown, with its cause, and for how long."""

from typing import Any

import pytest
from refused import has_terms, without_tags

from zsim.contract.flight_messages import ViewCluster
from zsim.contract.run_messages import Event, Fault, Health
from zsim_bridges.console import run_condition
from zsim_bridges.console.console_tables import preflight_lines
from zsim_bridges.console.run_condition import (
    Alarm,
    AlarmBoard,
    Check,
    DroneCondition,
    Losses,
    RunCondition,
    drone_refusals,
    fleet_refusals,
    formation_refusals,
    preflight_checks,
    run_refusals,
)

DEAD, LOW = Alarm("red", "estimator.drone1", "dead"), Alarm("amber", "drone1", "battery", "17 %")
MEMBERS = ("drone1", "drone2", "drone3")
FIT = DroneCondition("drone1", "landed", 73.0, lag_ms=10.0, sigma_m=0.2, yaw_sigma_deg=3.0, tilt_deg=1.0)


def event(kind: str, subject: str, **data: Any) -> Event:
    return Event(1_000_000_000, 0, kind, "world", subject, f"{subject}: {kind}", data)


def shown(board: AlarmBoard, wall_s: float = 9.0) -> list[tuple[object, ...]]:
    return [(row["subject"], row["over_s"], row["acknowledged"], row["times"]) for row in board.rows(wall_s)]


@pytest.fixture
def board() -> AlarmBoard:
    return AlarmBoard()


@pytest.fixture
def losses() -> Losses:
    return Losses()


# The alarm board


def test_a_red_alarm_remains_until_it_is_acknowledged(board: AlarmBoard):
    board.update([DEAD, LOW], 1.0)
    board.update([], 4.0)
    assert shown(board) == [(DEAD.subject, 5.0, False, 1)]
    assert board.severity_of(DEAD.subject) is None  # the alarm is over
    board.update([LOW], 4.5)
    assert [row[0] for row in shown(board)] == [DEAD.subject, LOW.subject]  # red alarms come first
    board.update([DEAD], 5.0)
    assert shown(board) == [(DEAD.subject, None, False, 2)]
    board.update([], 6.0)
    board.acknowledge()
    assert shown(board) == []


def test_an_acknowledged_alarm_disappears_when_it_is_over(board: AlarmBoard):
    board.update([DEAD], 1.0)
    board.acknowledge()
    board.update([DEAD], 2.0)
    assert shown(board) == [(DEAD.subject, None, True, 1)]
    board.update([], 3.0)
    assert shown(board) == []
    board.update([DEAD], 4.0)
    assert shown(board) == [(DEAD.subject, None, False, 1)]


def test_an_acknowledged_alarm_that_becomes_red_is_new(board: AlarmBoard):
    board.update([LOW], 1.0)
    board.acknowledge()
    board.update([LOW._replace(severity="red")], 2.0)
    assert shown(board) == [("drone1", None, False, 1)]


# Lost processes


@pytest.mark.parametrize("kind", sorted(run_condition.LOSS_NAMES))
@pytest.mark.parametrize("back", sorted(run_condition.RETURN_KINDS))
def test_a_lost_process_remains_lost_until_it_returns(kind: str, back: str, losses: Losses):
    losses.note(event(kind, "detector.main", host="lab", pid=7))
    assert list(losses.current) == ["detector.main"]
    losses.note(event("drop", "detector.main"))  # the run continues without it, but it is still dead
    assert list(losses.current) == ["detector.main"]
    losses.note(event(back, "detector.main"))
    assert losses.current == {}


def test_a_process_whose_work_another_has_taken_over_is_no_longer_lost(losses: Losses):
    for name in ("estimator.drone1", "estimator.drone2", "controller.main"):
        losses.note(event("death", name, host="lab", pid=7))
    losses.note(event("join", "estimator.main", serves=["estimator.drone1", "estimator.drone2"]))
    assert list(losses.current) == ["controller.main"]


def test_a_process_that_publishes_its_health_is_no_longer_lost(losses: Losses):
    """The event of its restart may have been sent while the console had no link."""
    losses.note(event("death", "estimator.drone1", host="lab", pid=7))
    health = Health(0, 0, "estimator", "lab", 7, {}, 0, 0, 0, 0)
    losses.note_health("estimator.drone1", health)  # published before its death, received after it
    assert list(losses.current) == ["estimator.drone1"]
    losses.note_health("estimator.drone1", Health(0, 0, "estimator", "lab", 8, {}, 0, 0, 0, 0))
    assert losses.current == {}


def test_a_no_show_is_not_counted_as_lost(losses: Losses):
    losses.note(event("no_show", "estimator.drone1", host="lab", pid=9, incarnation=4))
    assert losses.current == {}


# Drones and formations


@pytest.mark.parametrize(
    ("change", "alarm"),
    [
        ({"state": "landing", "failsafe": "it has 2.1 % of charge"}, ("lands by itself", "it has 2.1 % of charge")),
        ({"state": "emergency", "failsafe": "tilted by more than 60 deg"}, ("emergency", "tilted by more than 60 deg")),
        ({"state": "emergency"}, ("emergency", "rotors stopped")),
        ({"tilt_deg": 178.0}, ("upside down", "tilted by 178°")),
    ],
)
def test_a_failsafe_and_a_drone_upside_down_are_alarms_with_their_cause(change: dict[str, Any], alarm: tuple[str, str]):
    assert run_condition.drone_alarms(FIT._replace(state="flying")) == []
    assert run_condition.drone_alarms(FIT._replace(**change)) == [Alarm("red", "drone1", *alarm)]
    assert run_condition.drone_alarms(FIT._replace(state="landing")) == []  # a commanded landing


@pytest.mark.parametrize(
    ("commanders", "roles", "found"),
    [
        (("controller.main", "console.run", "controller.main"), {}, {"drone2": "console.run"}),
        (("controller.main", "qgc", None), {}, {"drone2": "qgc"}),
        (("console.run",) * 3, {}, dict.fromkeys(MEMBERS, "console.run")),
        (("mine", "hers", "mine"), {"mine": "controller", "hers": "console"}, {"drone2": "hers"}),
        (("agents.main",) * 3, {}, {}),
        ((None,) * 3, {}, {}),
    ],
)
def test_foreign_commanders_are_those_other_than_the_controller(
    commanders: tuple[str | None, ...], roles: dict[str, str], found: dict[str, str]
):
    of_drones: dict[str, str | None] = dict(zip(MEMBERS, commanders, strict=True))
    assert run_condition.foreign_commanders("controller.main", MEMBERS, of_drones, roles) == found


def test_a_foreign_commander_or_a_large_deviation_raises_an_alarm():
    view = ViewCluster(0, 0, "engaged", ("p", "yaw"), (11.6, 3.0), (4.0, 0.0), "")
    foreign = {"main": {"drone2": "console.run"}}
    found = run_condition.formation_alarms({"main": ("engaged", "")}, foreign, {"main": view})
    assert [(each.severity, each.name) for each in found] == [
        ("amber", "other commanders"),
        ("red", "off reference"),
    ]
    assert has_terms(found[0].text, "drone2", "console.run")
    assert has_terms(found[1].text, "p", "11.6 m", "4.0 m")
    near = ViewCluster(0, 0, "engaged", ("p", "yaw"), (5.9, 3.0), (4.0, 0.0), "")
    assert run_condition.formation_alarms({"main": ("engaged", "")}, {}, {"main": near}) == []


def test_a_fault_alarm_shows_its_parameters_as_on_the_command_line():
    fault = Fault(1, "link_loss", "world/a", {"probability": 0.3, "one_way": False, "place": {}}, 0)
    assert run_condition.run_alarms({}, [fault], 0.0) == [
        Alarm("amber", "world/a", "link_loss", "probability=0.3 one_way=False")
    ]


# Preflight checks


def run(drone: DroneCondition, phase: str = "idle", foreign: str = "", in_formation: bool = True) -> RunCondition:
    checks = {drone.name: preflight_checks(drone, in_formation, foreign)}
    phases = {"main": (phase, "")} if in_formation else {}
    return RunCondition(
        "running", drones={drone.name: drone.state}, phases=phases, members={"main": MEMBERS}, checks=checks
    )


@pytest.mark.parametrize(
    ("change", "terms"),
    [
        ({"battery_percent": 2.0}, ("battery", "2 %", "10 %")),
        ({"tilt_deg": 178.0}, ("upright", "178°", "30°")),
        ({"sigma_m": None}, ("estimator", "estimate")),
        ({"sigma_m": 2.5}, ("σ", "2.5 m", "1 m")),
        ({"yaw_sigma_deg": 40.0}, ("heading", "40°", "15°")),
        ({"is_external": True}, ("link", "driver")),
        ({"is_external": True, "link_state": "lost", "link_age_s": 0.1}, ("link", "lost")),
        ({"is_external": True, "link_state": "armed", "link_age_s": 9.0}, ("link", "9 s")),
    ],
)
def test_take_off_is_refused_for_an_unfit_drone(change: dict[str, Any], terms: tuple[str, ...]):
    assert formation_refusals(run(FIT), "main")["takeoff"] == ""
    unfit = run(FIT._replace(**change))
    for refusal in (formation_refusals(unfit, "main")["takeoff"], fleet_refusals(unfit)["takeoff"]):
        assert has_terms(refusal, "drone1", *terms)
    assert has_terms(drone_refusals(unfit, "drone1")["takeoff"], *terms)
    assert drone_refusals(unfit, "drone1")["emergency"] == ""


def test_take_off_is_refused_while_another_process_flies_a_member():
    refusal = formation_refusals(run(FIT, foreign="console.2"), "main")["takeoff"]
    assert has_terms(refusal, "control", "console.2")


@pytest.mark.parametrize("change", [{"sigma_m": None}, {"battery_percent": 15.0}, {"lag_ms": 900.0}])
def test_a_drone_outside_formations_may_take_off_with_a_warning(change: dict[str, Any]):
    warned = run(FIT._replace(**change), in_formation=False)
    assert drone_refusals(warned, "drone1")["takeoff"] == fleet_refusals(warned, ["drone1"])["takeoff"] == ""
    assert "✗" in preflight_lines(warned.checks)


def test_the_check_of_a_fit_drone_lists_all_its_items():
    checks = preflight_checks(FIT._replace(is_external=True, link_state="armed", link_age_s=0.2), True)
    assert [check.name for check in checks] == ["battery", "upright", "estimator", "link", "control"]
    assert not any(check.blocks and not check.ok for check in checks)
    stray = FIT._replace(link_state="lost", link_age_s=9.0)  # anyone may publish a link of a drone that has none
    assert formation_refusals(run(stray), "main")["takeoff"] == ""
    lines = preflight_lines({"drone1": checks})
    assert has_terms(without_tags(lines), "✓", "73 %", "σ 0.20 m", "armed", "free")
    assert "<b>" not in preflight_lines({"drone1": (Check("control", "<b>x</b>", False),)}).partition("</b>")[2]


def test_before_the_first_clock_the_controls_of_time_wait_for_it():
    refusals = run_refusals(RunCondition())
    for op in ("pause", "resume", "step"):
        assert has_terms(refusals[op], "waiting", "clock")


@pytest.mark.parametrize(
    ("phase", "states", "terms"),
    [
        ("held", ("landed",) * 3, ("main is held", "Land")),
        ("held", ("flying",) * 3, ("main is held",)),
        ("landing", ("landing", "landed", "landed"), ("main is landing",)),
    ],
)
def test_a_refused_fleet_take_off_gives_the_true_reason(phase: str, states: tuple[str, ...], terms: tuple[str, ...]):
    found = RunCondition(
        "running",
        drones=dict(zip(MEMBERS, states, strict=True)),
        phases={"main": (phase, "")},
        members={"main": MEMBERS},
    )
    refusal = fleet_refusals(found)["takeoff"]
    assert has_terms(refusal, *terms)
    assert "nobody" not in refusal
