"""Alarms, faults and the check before a take-off: what is told, with its cause, and for how long."""

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


# The board


def test_a_red_alarm_that_is_over_stays_until_it_is_acknowledged(board: AlarmBoard):
    board.update([DEAD, LOW], 1.0)
    board.update([], 4.0)
    assert shown(board) == [(DEAD.subject, 5.0, False, 1)]
    assert board.severity_of(DEAD.subject) is None  # nothing is wrong with it now
    board.update([LOW], 4.5)
    assert [row[0] for row in shown(board)] == [DEAD.subject, LOW.subject]  # red ones first
    board.update([DEAD], 5.0)
    assert shown(board) == [(DEAD.subject, None, False, 2)]
    board.update([], 6.0)
    board.acknowledge()
    assert shown(board) == []


def test_an_alarm_that_was_acknowledged_stays_while_it_stands_and_goes_when_it_is_over(board: AlarmBoard):
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


# What is lost


@pytest.mark.parametrize("kind", sorted(run_condition.LOST))
@pytest.mark.parametrize("back", sorted(run_condition.BACK))
def test_what_is_lost_is_so_until_it_is_back(kind: str, back: str, losses: Losses):
    losses.note(event(kind, "detector.main", host="lab", pid=7))
    assert list(losses.now) == ["detector.main"]
    losses.note(event("drop", "detector.main"))  # the run goes on without it: it is dead all the same
    assert list(losses.now) == ["detector.main"]
    losses.note(event(back, "detector.main"))
    assert losses.now == {}


def test_a_process_whose_work_another_does_is_lost_no_longer(losses: Losses):
    for name in ("estimator.drone1", "estimator.drone2", "controller.main"):
        losses.note(event("death", name, host="lab", pid=7))
    losses.note(event("join", "estimator.main", serves=["estimator.drone1", "estimator.drone2"]))
    assert list(losses.now) == ["controller.main"]


def test_a_process_that_publishes_its_health_again_is_lost_no_longer(losses: Losses):
    """The event that it was started again may have come while the console had no link."""
    losses.note(event("death", "estimator.drone1", host="lab", pid=7))
    health = Health(0, 0, "estimator", "lab", 7, {}, 0, 0, 0, 0)
    losses.note_health("estimator.drone1", health)  # published before its death, received after it
    assert list(losses.now) == ["estimator.drone1"]
    losses.note_health("estimator.drone1", Health(0, 0, "estimator", "lab", 8, {}, 0, 0, 0, 0))
    assert losses.now == {}


def test_a_join_behind_which_nobody_is_makes_nobody_missing(losses: Losses):
    losses.note(event("no_show", "estimator.drone1", host="lab", pid=9, incarnation=4))
    assert losses.now == {}


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
def test_a_failsafe_and_a_drone_on_its_back_are_alarms_with_their_cause(change: dict[str, Any], alarm: tuple[str, str]):
    assert run_condition.drone_alarms(FIT._replace(state="flying")) == []
    assert run_condition.drone_alarms(FIT._replace(**change)) == [Alarm("red", "drone1", *alarm)]
    assert run_condition.drone_alarms(FIT._replace(state="landing")) == []  # as somebody has commanded


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
def test_who_flies_a_drone_instead_of_its_formation_s_controller(
    commanders: tuple[str | None, ...], roles: dict[str, str], found: dict[str, str]
):
    of_drones: dict[str, str | None] = dict(zip(MEMBERS, commanders, strict=True))
    assert run_condition.foreign_commanders("controller.main", MEMBERS, of_drones, roles) == found


def test_an_engaged_formation_with_a_drone_flown_by_hand_is_an_alarm_with_its_figures():
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


def test_an_alarm_of_a_fault_has_its_magnitudes_as_the_terminal_writes_them():
    fault = Fault(1, "link_loss", "world/a", {"probability": 0.3, "one_way": False, "place": {}}, 0)
    assert run_condition.run_alarms({}, [fault], 0.0) == [
        Alarm("amber", "world/a", "link_loss", "probability=0.3 one_way=False")
    ]


# Before a take-off


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
def test_no_take_off_is_offered_of_a_drone_that_is_not_fit(change: dict[str, Any], terms: tuple[str, ...]):
    assert formation_refusals(run(FIT), "main")["takeoff"] == ""
    unfit = run(FIT._replace(**change))
    for refusal in (formation_refusals(unfit, "main")["takeoff"], fleet_refusals(unfit)["takeoff"]):
        assert has_terms(refusal, "drone1", *terms)
    assert has_terms(drone_refusals(unfit, "drone1")["takeoff"], *terms)
    assert drone_refusals(unfit, "drone1")["emergency"] == ""


def test_who_else_flies_a_drone_keeps_its_formation_on_the_ground():
    refusal = formation_refusals(run(FIT, foreign="console.2"), "main")["takeoff"]
    assert has_terms(refusal, "control", "console.2")


@pytest.mark.parametrize("change", [{"sigma_m": None}, {"battery_percent": 15.0}, {"lag_ms": 900.0}])
def test_a_drone_of_no_formation_takes_off_with_a_warning(change: dict[str, Any]):
    warned = run(FIT._replace(**change), in_formation=False)
    assert drone_refusals(warned, "drone1")["takeoff"] == fleet_refusals(warned, ["drone1"])["takeoff"] == ""
    assert "✗" in preflight_lines(warned.checks)


def test_the_check_of_a_fit_drone_names_all_its_points():
    checks = preflight_checks(FIT._replace(is_external=True, link_state="armed", link_age_s=0.2), True)
    assert [check.name for check in checks] == ["battery", "upright", "estimator", "link", "control"]
    assert not any(check.blocks and not check.ok for check in checks)
    stray = FIT._replace(link_state="lost", link_age_s=9.0)  # anybody may publish the link of a drone that has none
    assert formation_refusals(run(stray), "main")["takeoff"] == ""
    lines = preflight_lines({"drone1": checks})
    assert has_terms(without_tags(lines), "✓", "73 %", "σ 0.20 m", "armed", "free")
    assert "<b>" not in preflight_lines({"drone1": (Check("control", "<b>x</b>", False),)}).partition("</b>")[2]


@pytest.mark.parametrize(
    ("phase", "states", "terms"),
    [
        ("held", ("landed",) * 3, ("main is held", "Land")),
        ("held", ("flying",) * 3, ("main is held",)),
        ("landing", ("landing", "landed", "landed"), ("main is landing",)),
    ],
)
def test_why_nobody_takes_off_is_true(phase: str, states: tuple[str, ...], terms: tuple[str, ...]):
    found = RunCondition(
        "running",
        drones=dict(zip(MEMBERS, states, strict=True)),
        phases={"main": (phase, "")},
        members={"main": MEMBERS},
    )
    refusal = fleet_refusals(found)["takeoff"]
    assert has_terms(refusal, *terms)
    assert "nobody" not in refusal
