"""The console's forms and what each of their controls requests, on a fake page that records its controls."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from fake_gui import NOBODY, Gui, OrderHtml
from refused import has_terms, refused, without_tags

from zsim.contract.flight_messages import ViewCluster
from zsim.scenario import scenario_file
from zsim.scenario.faults import KINDS, Known, flaws
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.engagement_setup import gains_of
from zsim_agents.formation.flight_check import (
    HELD_ON_REQUEST,
    READY_TO_ENGAGE,
    REJOINING,
    SHAPE,
    place_fault,
)
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_agents.formation.trajectory import ExpressionTrajectory
from zsim_bridges.console.console_page import DRONE_MODES, SWITCHES, ConsolePage, DroneForm
from zsim_bridges.console.formation_form import (
    OPERATIONS,
    REST_S,
    STILL_S,
    FormationForm,
    parse_expressions,
    parse_waypoints,
    primary_variables,
    slider_ranges,
)
from zsim_bridges.console.orders import RequestOutcome
from zsim_bridges.console.picture import FlightPreview
from zsim_bridges.console.run_condition import RunCondition, ShownRun, fleet_refusals
from zsim_bridges.console.run_forms import DURATION_S, FaultForm, FleetForm, InputError, RunForm

SCENARIOS = Path(__file__).parents[4] / "scenarios"
LATER_S = 1e9  # wall time, long after any slider has moved
WAYPOINTS = "waypoints [s, m, deg]"


class FakeCommandClient:
    """Records the requests."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.shown: list[str] = []

    def request_world(self, op: str, **args: Any) -> None:
        self.asked.append(("world", op, args))

    def request_cluster(self, cluster: str, op: str, args_text: str = "", **args: Any) -> None:
        self.shown.append(args_text)
        self.asked.append((cluster, op, args))

    def send_mode(self, drones: list[str], mode: str) -> None:
        self.asked.append((tuple(drones), mode))


class Bench:
    """A page, its command client, and the outcomes of the requests that the forms themselves refuse."""

    def __init__(self, scenario: str = "step") -> None:
        self.gui: Any = Gui()
        self.client: Any = FakeCommandClient()
        self.outcomes: list[RequestOutcome] = []
        self.scenario = scenario_file.load(SCENARIOS / f"{scenario}.yaml")
        self.names = tuple(drone.name for drone in self.scenario.drones)
        self.cluster = self.scenario.clusters[0]
        self.space = scenario_space(self.scenario, self.cluster)

    def formation(self) -> FormationForm:
        return FormationForm(self.gui, self.client, self.outcomes.append, self.cluster, self.space, self.scenario)

    def faults(self) -> None:
        FaultForm(self.gui, self.client, self.outcomes.append, self.scenario)

    def view(self, **values: float) -> ViewCluster:
        c = [values.get(name, 0.0) for name in self.space.names]
        return ViewCluster(0, 0, "engaged", self.space.names, tuple(c), tuple(c), "")


@pytest.fixture
def bench() -> Bench:
    return Bench()


# The run and single drones


@pytest.mark.parametrize(
    ("label", "gates", "rate", "op", "args"),
    [
        ("Pause", 1.0, 1.0, "pause", {}),
        ("Resume", 1.0, 1.0, "resume", {}),
        ("Step", 7.0, 1.0, "step", {"gates": 7}),
        ("Step", 2.5, 1.0, "step", {"gates": 2.5}),  # sent as typed: the world refuses it
        ("Set rate", 1.0, 2.5, "rate", {"value": 2.5}),
        ("Set rate", 1.0, -1.0, "rate", {"value": -1.0}),
    ],
)
def test_each_button_of_the_run_requests_its_operation(
    bench: Bench, label: str, gates: float, rate: float, op: str, args: dict[str, Any]
):
    RunForm(bench.gui, bench.client, 1.0)
    bench.gui.at["gates"].value, bench.gui.at["rate"].value = gates, rate
    bench.gui.press(label)
    ((_, asked_op, asked),) = bench.client.asked
    assert (asked_op, asked) == (op, args)
    assert {name: type(value) for name, value in asked.items()} == {name: type(value) for name, value in args.items()}


@pytest.mark.parametrize(
    ("label", "mode"), [("Take off", "takeoff"), ("Reset", "reset"), ("Land", "land"), ("Emergency", "emergency")]
)
def test_only_the_drone_chosen_on_the_same_page_gets_the_mode(bench: Bench, label: str, mode: str):
    other: Any = Gui()
    form = DroneForm(bench.gui, bench.client, bench.names)
    DroneForm(other, bench.client, bench.names)
    bench.gui.at["drone"].put(bench.names[1])
    other.at["drone"].put(bench.names[2])
    button = bench.gui.at[f"{label} {bench.names[0]}"]
    assert (button.label, form.chosen) == (f"{label} {bench.names[1]}", bench.names[1])
    if isinstance(button, OrderHtml):  # the browser sends it as an order
        hold = {"zsim-hold": "1"} if mode == "emergency" else {}
        assert button.order == {"zsim-order": mode, "drone": bench.names[1], **hold}
    else:
        button.put(None)
        assert bench.client.asked == [((bench.names[1],), mode)]


def test_a_command_goes_to_the_selected_drones_that_can_obey_it(bench: Bench):
    returning: list[list[str]] = []
    back = returning.append
    form = DroneForm(bench.gui, bench.client, bench.names, request_return=lambda drones: back(list(drones)))
    first, second, third = bench.names
    button = {mode: bench.gui.at[f"{label} {first}"] for mode, label in DRONE_MODES.items()}
    form.select([first, third])
    assert button["land"].label == "Land 2 drones"
    form.refresh(RunCondition("running", drones={first: "flying", second: "flying", third: "landed"}))
    assert not button["land"].disabled  # one of the two is flying
    button["takeoff"].put(None)
    button["return"].put(None)
    assert bench.client.asked == [((third,), "takeoff")]
    for mode in ("land", "emergency"):
        order = button[mode]
        assert isinstance(order, OrderHtml)
        assert order.order["drone"] == f"{first},{third}"  # the browser sends an order to each
    assert returning == [[first]]
    form.select([])
    assert button["land"].label == f"Land {first}"


def test_a_previewed_flight_starts_only_on_request(bench: Bench):
    shown: list[FlightPreview | None] = []
    form = FormationForm(
        bench.gui,
        bench.client,
        bench.outcomes.append,
        bench.cluster,
        bench.space,
        bench.scenario,
        show_preview=shown.append,
    )
    c = tuple(bench.space.specimen(4.0).tolist())
    form.refresh(ViewCluster(0, 0, "engaged", bench.space.names, c, c, ""), 0.0)
    bench.gui.at["Preview first"].value = True
    assert form.request_target({"x_c": 7.0})
    assert form.request_target({"z_c": 9.0})
    assert bench.client.asked == []
    ways = [each.paths_W for each in shown if each is not None]
    assert len(ways) == 2
    assert ways[1][:, -1].mean(axis=0)[[0, 2]] == pytest.approx(
        [7.0, 9.0]
    )  # the second preview includes the first change
    bench.gui.press("Fly the preview")
    assert bench.client.asked == [(bench.cluster.name, "target", {"values": {"x_c": 7.0, "z_c": 9.0}})]
    assert shown[-1] is None
    form.request_target({"x_c": 8.0})
    bench.gui.press("Discard the preview")
    bench.gui.press("Fly the preview")
    assert len(bench.client.asked) == 1
    bench.gui.at["Preview first"].value = False
    form.request_target({"x_c": 8.0})
    assert len(bench.client.asked) == 2
    assert bench.outcomes == []


@pytest.mark.parametrize(("led", "single"), [(True, True), (True, False), (False, True)])
def test_take_off_all_starts_every_formation_and_every_single_drone(bench: Bench, led: bool, single: bool):
    scenario = mixed()
    drones = scenario.drones[0 if led else 4 : 6 if single else 4]
    clusters = scenario.clusters if led else []
    FleetForm(bench.gui, bench.client, msgspec.structs.replace(scenario, clusters=clusters, drones=drones))
    bench.gui.press("Take off all")
    formations = [("main", "takeoff", {}), ("other", "takeoff", {})]
    assert bench.client.asked == [*formations * led, *[(("d5", "d6"), "takeoff")] * single]


def test_a_drone_form_enables_what_the_state_allows_and_orders_in_silence(bench: Bench):
    bench.formation().offer(flown(silent_s=79.0))
    form, name = DroneForm(bench.gui, bench.client, bench.names), bench.names[0]

    def offered(**run: Any) -> set[str]:
        form.refresh(flown(**run))
        return {label for label in DRONE_MODES.values() if not bench.gui.at[f"{label} {name}"].disabled}

    assert offered() == {"Land", "Return", "Emergency"}
    assert offered(silent_s=79.0) == {"Land", "Emergency"}
    assert not any(bench.gui.at[label].disabled for label in ("Hold", "Land"))
    assert offered(ended="the run ended") == {"Emergency"}


def mixed() -> Scenario:
    """Return a scenario of two formations and two drones that belong to neither."""
    drones = [{"name": f"d{k}", "position_m": [3 * k, 0, 0]} for k in range(1, 7)]
    clusters = [{"name": "main", "drones": ["d1", "d2"]}, {"name": "other", "drones": ["d3", "d4"]}]
    return scenario_file.resolve({"name": "t", "duration_s": 1, "drones": drones, "clusters": clusters}, "mixed.yaml")


def flown(phase: str = "engaged", reason: str = "", **more: Any) -> RunCondition:
    """Return the condition of a run whose formation is in the given phase."""
    state = "landed" if phase == "idle" else "flying"
    drones = dict.fromkeys(("drone1", "drone2", "drone3"), state)
    return RunCondition(**{"clock": "running", "drones": drones, "phases": {"main": (phase, reason)}, **more})


@pytest.mark.parametrize(
    ("run", "off"),
    [
        (flown("idle"), {"Engage", "Hold", "Land"}),
        (flown("engaged"), {"Take off", "Engage"}),
        (flown("assembling", "drone2 is at z = 0.20 m"), {"Take off", "Engage", "Hold"}),
        (flown("assembling", READY_TO_ENGAGE), {"Take off", "Hold"}),
        (flown("held", HELD_ON_REQUEST), {"Take off", "Hold"}),
        (flown("held", "drone2 is in state landed"), {"Take off", "Engage", "Hold"}),
        (flown("held", f"{REJOINING}: drone2"), {"Take off", "Engage", "Rejoin"}),
        (
            flown("held", "drone2 is in state landed", drones={"drone2": "landed"}, members={"main": ("drone2",)}),
            {"Take off", "Engage", "Hold", "Rejoin"},
        ),
        (flown(silent_s=79.0), {"Take off", "Engage"}),
        (flown(ended="the run ended"), {"Take off", "Engage", "Hold", "Land"}),
        (flown(replayed=True), {"Take off", "Engage", "Hold", "Land"}),
    ],
)
def test_a_formation_form_enables_what_its_controller_would_grant(bench: Bench, run: RunCondition, off: set[str]):
    bench.formation().offer(run)
    locked = {label for label in OPERATIONS if bench.gui.at[label].visible and bench.gui.at[label].disabled}
    assert locked == off
    assert all(bench.gui.at[label].hint for label in locked)
    steered = run.outage() == "" and not run.replayed and run.phases["main"] in STEERED
    assert bench.gui.at["p [m]"].disabled is not steered
    flights = [bench.gui.at[label] for label in FLIGHTS]
    assert [bool(each.hint) for each in flights] == [each.disabled for each in flights] == [not steered] * len(FLIGHTS)


def test_other_variables_and_the_planned_trajectory_lock_like_the_sliders():
    grid, planned = Bench("grid30"), Bench("trajectory")
    for bench, label in ((grid, "Move it"), (planned, "Fly the scenario's")):
        form = bench.formation()
        for phase, locked in (("idle", True), ("engaged", False)):
            form.offer(flown(phase))
            assert bench.gui.at[label].disabled is locked


@pytest.mark.parametrize(
    ("states", "off"),
    [(("landed", "flying"), False), (("landed", "emergency"), True), (("landing", "landed"), True)],
)
def test_take_off_is_enabled_when_the_drones_can_take_off(bench: Bench, states: tuple[str, ...], off: bool):
    names = bench.names[: len(states)]
    run = flown("idle", drones=dict(zip(names, states, strict=True)), members={"main": names})
    bench.formation().offer(run)
    button = bench.gui.at["Take off"]
    assert button.disabled is off
    assert ("reset" in (button.hint or "")) is ("emergency" in states)
    assert fleet_refusals(run)["takeoff"] == (button.hint or "")
    stopped = flown("idle", drones={"d1": "emergency", "d2": "landed"}, members={"main": ("d1",)})
    for run, single, terms in (
        (stopped, [], ("d1", "reset")),
        (stopped, ["d2"], ()),  # d2 can take off
        (RunCondition(drones={"d2": "emergency"}), ["d2"], ("d2", "reset")),
    ):
        refusal = fleet_refusals(run, single)["takeoff"]
        assert has_terms(refusal, *terms) if terms else refusal == ""


@pytest.mark.parametrize(
    ("phase", "reason", "there"),
    [
        ("engaged", "", False),
        ("held", HELD_ON_REQUEST, False),
        ("held", "roll of the formation is 60.0 deg", True),
    ],
)
def test_rejoin_is_visible_only_while_a_fault_holds_the_formation(bench: Bench, phase: str, reason: str, there: bool):
    bench.formation().offer(flown(phase, reason))
    button = bench.gui.at["Rejoin"]
    assert (button.visible, button.disabled and button.visible) == (there, False)


FLIGHTS = ("Fly the expressions", "Fly the waypoints", "Waypoints from here")
STEERED = {("engaged", ""), ("held", HELD_ON_REQUEST)}


def test_pause_and_resume_replace_each_other(bench: Bench):
    form = RunForm(bench.gui, bench.client, 1.0)
    for clock, paused in (("running", False), ("paused", True), ("running", False)):
        form.refresh(RunCondition(clock=clock))
        assert (bench.gui.at["Resume"].visible, bench.gui.at["Pause"].visible) == (paused, not paused)
        assert bench.gui.at["Step"].disabled is not paused
    at_end = RunCondition("paused", replayed=True, at_end=True)
    for run in (at_end, at_end._replace(clock="stopped", ended="the record is over")):
        form.refresh(run)  # a replay at its end cannot continue
        assert bench.gui.at["Step"].disabled
        assert all(bench.gui.at[label].disabled for label in ("Pause", "Resume") if bench.gui.at[label].visible)
        assert has_terms(bench.gui.at["Step"].hint, "record")


def test_all_drones_in_emergency_are_reset_at_once(bench: Bench):
    form = FleetForm(bench.gui, bench.client, bench.scenario)
    form.refresh(flown())
    assert not bench.gui.at["Reset all"].visible
    form.refresh(flown(drones={"drone1": "emergency", "drone2": "landed", "drone3": "emergency"}))
    assert bench.gui.at["Reset all"].visible
    bench.gui.press("Reset all")
    assert bench.client.asked == [(("drone1", "drone3"), "reset")]


def test_a_slider_shows_but_does_not_request_a_value_out_of_range(bench: Bench):
    form = bench.formation()
    height, tilt, side = (bench.gui.at[label] for label in ("z_c [m]", "pitch [deg]", "p [m]"))
    limits = [(each.min, each.max) for each in (height, tilt, side)]
    assert has_terms(side.label, "p", "unknown")
    form.refresh(bench.view(z_c=0.1, pitch=math.radians(74.9), p=25.37), LATER_S)
    assert (height.value, tilt.value, side.value) == (0.1, 75.0, 25.4)
    assert (height.min, tilt.max, side.max) == (0.1, 75.0, 25.4)
    assert has_terms(side.label, "p", "25.4 m")
    tilt.put(60.0)
    form.send(LATER_S)
    assert bench.client.asked == []
    assert has_terms(bench.outcomes[0].refusal, "pitch", "60 deg")
    form.refresh(bench.view(z_c=3.0, p=4.0), LATER_S)
    assert [(each.min, each.max) for each in (height, tilt, side)] == limits
    assert side.label == "p [m]"


def test_suggested_waypoints_begin_at_the_formation_in_display_units(bench: Bench):
    form = bench.formation()
    form.refresh(bench.view(x_c=3.0, z_c=2.5, yaw=math.pi / 2), LATER_S)
    assert has_terms(bench.gui.at[WAYPOINTS].value, "0:", "x_c = 3", "z_c = 2.5", "yaw = 90")
    bench.gui.press("Fly the waypoints")
    ((_, op, args),) = bench.client.asked
    assert op == "trajectory"
    assert args["waypoints"][1]["values"]["yaw"] == pytest.approx(math.pi / 2)


def test_suggested_waypoints_follow_the_formation_until_edited(bench: Bench):
    form, text, shown = bench.formation(), bench.gui.at[WAYPOINTS], []
    for x_c in (-1.43, 5.0, 5.05, 5.05):  # unmoved by the noise of an estimate, but exact once the formation rests
        form.refresh(bench.view(x_c=x_c), LATER_S)
        shown.append(text.value)
    assert has_terms(shown[1], "x_c = 5")
    assert shown[1] == shown[2]
    assert has_terms(shown[3], "x_c = 5.05")
    text.put("20: x_c = 7")
    form.refresh(bench.view(x_c=9.0), LATER_S)
    assert text.value == "20: x_c = 7"
    bench.gui.press("Waypoints from here")
    form.refresh(bench.view(x_c=11.0), LATER_S)
    assert has_terms(text.value, "x_c = 11")


# Faults


@pytest.mark.parametrize(
    ("label", "magnitude", "asked"),
    [
        ("GPS lost", ("fixes lost [%]", 40.0), ("gps_dropout", "drone2", {"probability": 0.4})),
        (
            "Motor weak",
            ("thrust left [%]", 80.0),
            ("rotor_efficiency", "drone2", {"rotor": "front_left", "value": 0.8}),
        ),
        ("Gust", ("gust [m/s]", -6.0), ("gust", "world", {"velocity_m_s": [-6.0, 0.0, 0.0]})),
        (
            "Messages lost",
            ("msgs lost [%]", 25.0),
            ("link_loss", "world/estimator.drone2", {"probability": 0.25}),
        ),
        ("Kill estimator", None, ("process_kill", "estimator.drone2", {})),
    ],
)
def test_a_common_fault_has_the_labelled_target_and_magnitude(
    bench: Bench, label: str, magnitude: tuple[str, float] | None, asked: tuple[str, str, dict[str, Any]]
):
    form = FaultForm(bench.gui, bench.client, bench.outcomes.append, bench.scenario)
    bench.gui.at["drone"].put("drone2")
    if magnitude:
        bench.gui.at[magnitude[0]].put(magnitude[1])
    bench.gui.press(label)
    kind, target, parameters = asked
    lasting = {} if kind == "process_kill" else {"for_s": DURATION_S}
    assert bench.client.asked == [("world", "fault_add", {"kind": kind, "target": target, **lasting, **parameters})]
    told = without_tags(form._effects.content.replace("<br>", "\n"))
    struck = "drones" if target == "world" else target.rpartition("/")[2]
    assert has_terms(told, label, struck)
    assert has_terms(
        told, "Messages lost", "processes", "world", "not by radio"
    )  # a link between processes is not a radio link
    assert magnitude is None or has_terms(told, label, f"{magnitude[1]:g}")


def test_a_fault_without_a_duration_lasts_until_it_is_cleared(bench: Bench):
    bench.faults()
    bench.gui.at["for [s]"].value = -1.0
    bench.gui.press("GPS lost")
    assert bench.client.asked == []
    assert has_terms(bench.outcomes[0].refusal, "for", "-1 s", "from 0")
    bench.gui.at["for [s]"].value = 0.0
    bench.gui.press("GPS lost")
    bench.gui.press("Clear all faults")
    lasting = {"kind": "gps_dropout", "target": bench.names[0], "probability": 1.0}
    assert bench.client.asked == [("world", "fault_add", lasting), ("world", "fault_clear", {})]


def test_any_fault_can_be_typed_with_the_syntax_of_the_command_line(bench: Bench):
    bench.faults()
    bench.gui.at["kind"].put("accel_bias")
    bench.gui.at["target"].value = " drone3 "
    bench.gui.at["parameters"].value = "value_m_s2=[0.5, 0, 0] --for 5s --at=2min"
    bench.gui.press("Inject it")
    asked = {"kind": "accel_bias", "target": "drone3", "value_m_s2": [0.5, 0, 0], "for_s": 5.0, "at_s": 120.0}
    assert bench.client.asked == [("world", "fault_add", asked)]
    bench.gui.at["kind"].put("process_kill")
    bench.gui.press("Inject it")  # a kill has no duration
    assert bench.client.asked[1:] == [("world", "fault_add", {"kind": "process_kill", "target": "estimator.drone1"})]


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_choosing_a_kind_suggests_a_valid_target_and_its_parameters(bench: Bench, kind: str):
    bench.faults()
    bench.gui.at["kind"].put(kind)
    target, text = bench.gui.at["target"].value, bench.gui.at["parameters"].value
    known = Known(bench.names, ("main",), tuple(f"estimator.{name}" for name in bench.names))
    missing = {path for path, _ in flaws({"kind": kind, "target": target, "for_s": 1.0}, known)}
    assert "target" not in missing
    assert missing - {"for_s"} <= {word.partition("=")[0] for word in text.split()}


@pytest.mark.parametrize(
    ("kind", "text", "terms"),
    [
        ("gps_dropout", "", ("probability", "missing", "from 0 to 1")),
        ("gps_dropout", "--for 5s", ("probability", "missing", "from 0 to 1")),
        ("gps_dropout", "probability=", ("probability", "missing", "from 0 to 1")),
        ("rotor_efficiency", "", ("rotor", "missing", "front_left")),
        ("gust", "", ("velocity_m_s", "missing", "m/s")),
        *(
            (None, text, ("parameters",))
            for text in ("value", "'" * 3, "probability=1 probability=0", "probability=[", "probability: 1")
        ),
        *((None, f"probability=1 {text}", (text.split()[0], "10s")) for text in ("--for", "--for 10h", "--at soon")),
        *(
            (None, f"{name}=x", (repr(name), "known", "probability=VALUE", "--at", "--for"))
            for name in ("op", "self", "value")
        ),
    ],
)
def test_invalid_parameters_are_refused_and_inject_no_fault(
    bench: Bench, kind: str | None, text: str, terms: tuple[str, ...]
):
    bench.faults()
    if kind:
        bench.gui.at["kind"].put(kind)
    bench.gui.at["parameters"].value = text
    bench.gui.press("Inject it")
    assert bench.client.asked == []
    assert has_terms(bench.outcomes[0].refusal, *terms)


# A formation


def test_take_off_and_engage_are_requests_hold_and_land_are_orders(bench: Bench):
    bench.formation()
    for label in ("Take off", "Engage"):
        bench.gui.press(label)
    assert bench.client.asked == [(bench.cluster.name, "takeoff", {}), (bench.cluster.name, "engage", {})]
    orders: list[Any] = [bench.gui.at[label].order for label in ("Hold", "Land")]
    assert orders == [{"zsim-order": op, "cluster": bench.cluster.name} for op in ("hold", "land")]


def test_sliders_at_rest_are_sent_together_and_once(bench: Bench):
    form = bench.formation()
    bench.gui.at["p [m]"].put(5.0)
    bench.gui.at["z_c [m]"].put(4.0)
    form.send(0.0)  # the sliders are not yet at rest
    assert bench.client.asked == []
    form.send(LATER_S)
    form.send(LATER_S + REST_S)
    assert bench.client.asked == [(bench.cluster.name, "target", {"values": {"p": 5.0, "z_c": 4.0}})]
    bench.gui.at["p [m]"].put(6.0, NOBODY)  # the console moves it
    form.send(LATER_S + 2 * REST_S)
    assert len(bench.client.asked) == 1


def test_sliders_follow_the_formation_except_those_being_moved(bench: Bench):
    form = bench.formation()
    bench.gui.at["p [m]"].put(5.0)
    form.refresh(bench.view(p=7.0, q=8.0), LATER_S)
    assert bench.gui.at["p [m]"].value == 5.0
    assert bench.gui.at["q [m]"].value == 8.0
    form.send(LATER_S)
    for step in range(1, 20):
        form.refresh(bench.view(p=7.0 - 0.1 * step), LATER_S + step)
        assert bench.gui.at["p [m]"].value == 5.0  # the formation is on its way there
    form.refresh(bench.view(p=5.1), LATER_S + 19.0 + 2 * STILL_S)  # the formation stopped short of it
    assert bench.gui.at["p [m]"].value == 5.1


def test_a_move_has_the_requested_duration_and_is_shown_in_display_units(bench: Bench):
    form, over = bench.formation(), bench.gui.at["over [s]"]
    for over_s in (-5.0, 3601.0):
        over.value = over_s
        form.send(LATER_S)  # nothing is pending
        form.request_target({"p": 5.0})
        assert bench.client.asked == []
        assert has_terms(bench.outcomes.pop().refusal, "over", f"{over_s:g} s", "0 to 3600")
        assert bench.outcomes == []
    over.value = 20.0
    form.request_target({"p": 5.0, "yaw": 180.0})
    values = {"p": 5.0, "yaw": pytest.approx(math.pi)}
    assert bench.client.asked == [(bench.cluster.name, "target", {"values": values, "over_s": 20.0})]
    assert has_terms(bench.client.shown[0], "p 5 m", "yaw 180 deg")


def test_a_typed_number_is_refused_beyond_the_limit_and_sent_at_the_limit(bench: Bench):
    form = bench.formation()
    box = bench.gui.at["y_c [m]"]
    limit = form._ranges["y_c"].high
    box.put(500.0)
    form.send(LATER_S)
    assert bench.client.asked == []
    (outcome,) = bench.outcomes
    assert has_terms(outcome.refusal, "y_c", "500 m")
    box.put(limit)
    form.send(LATER_S)
    assert bench.client.asked == [(bench.cluster.name, "target", {"values": {"y_c": limit}})]


@pytest.mark.parametrize("side", ["p", "q"])
def test_the_shortest_side_on_a_slider_is_not_refused_for_rounding(bench: Bench, side: str):
    low = next(each.low for each in slider_ranges(bench.space, bench.cluster, bench.scenario) if each.name == side)
    gains, shape = gains_of(bench.cluster.gains), SHAPE
    c = bench.space.specimen(4.0)
    c[bench.space.index(side)], c[bench.space.index("z_c")] = low, 8.0
    refused = []
    for step in range(200):
        c[bench.space.index("x_c")], c[bench.space.index("yaw")] = -50.0 + 0.5 * step, 0.03 * step
        refused.append(place_fault(bench.space, c, gains, shape))
    assert set(refused) == {None}


def test_variables_without_a_slider_are_moved_one_at_a_time():
    bench = Bench("grid30")
    bench.formation()
    shown = primary_variables(bench.space.names)
    assert shown[:6] == ["x_c", "y_c", "z_c", "roll", "pitch", "yaw"]
    assert len(shown) < 16
    hidden = next(name for name in bench.space.names if f"{name} [m]" not in bench.gui.at and name.startswith("w"))
    value = next(control for label, control in bench.gui.at.items() if label.startswith("value ["))
    bench.gui.at["variable"].put(next(name for name in bench.space.names if name.startswith("phi")))
    assert value.label == "value [deg], -180 to 180"
    bench.gui.at["variable"].put(hidden)
    assert value.label == "value [m], -5 to 5"
    value.value = 0.5
    bench.gui.press("Move it")
    assert bench.client.asked == [(bench.cluster.name, "target", {"values": {hidden: 0.5}})]


def test_typed_trajectories_are_requested_unchanged(bench: Bench):
    bench.formation()
    bench.gui.at["expressions [m, deg]"].value = "# a circle\nx_c = R*cos(0.1*t)\n\nyaw = 6*t\nR = 5"
    bench.gui.press("Fly the expressions")
    bench.gui.at[WAYPOINTS].value = "0: x_c = 1, p=4\n20.5: x_c=5"
    bench.gui.press("Fly the waypoints")
    name = bench.cluster.name
    assert bench.client.asked == [
        (name, "trajectory", {"expressions": {"x_c": "R*cos(0.1*t)", "yaw_deg": "6*t"}, "constants": {"R": 5.0}}),
        (
            name,
            "trajectory",
            {"waypoints": [{"at_s": 0.0, "values": {"x_c": 1.0, "p": 4.0}}, {"at_s": 20.5, "values": {"x_c": 5.0}}]},
        ),
    ]


def test_the_planned_trajectory_is_flown_and_invalid_waypoints_are_refused(bench: Bench):
    planned = Bench("trajectory")
    planned.formation()
    planned.gui.press("Fly the scenario's")
    of = planned.cluster.plan.trajectory
    assert of is not None
    assert of.expressions
    args = {"expressions": of.expressions, "constants": of.constants}
    assert planned.client.asked == [(planned.cluster.name, "trajectory", args)]
    bench.formation()
    bench.gui.at[WAYPOINTS].value = "soon"
    bench.gui.press("Fly the waypoints")
    assert bench.client.asked == []
    assert bench.outcomes[0].request == f"{bench.cluster.name}: trajectory"


# The page


def test_each_switch_changes_the_scene(bench: Bench):
    shown: list[tuple[str, bool]] = []
    info: Any = SimpleNamespace(rate=2.0, drones=(), replay_of="")
    run = ShownRun(info, bench.scenario, {bench.cluster.name: bench.space})
    show = lambda *switched: shown.append(switched)  # noqa: E731
    page = ConsolePage(bench.gui, run, bench.client, bench.outcomes.append, show)
    assert bench.gui.at["rate"].value == 2.0
    assert page.chosen == bench.cluster.name
    for what, label in SWITCHES.items():
        bench.gui.at[label].put(False)
        assert shown[-1] == (what, False)


def test_every_variable_has_a_range_in_its_display_unit(bench: Bench):
    found = {each.name: each for each in slider_ranges(bench.space, bench.cluster, bench.scenario)}
    assert list(found) == list(bench.space.names)
    assert found["p"].low == bench.cluster.gains.separation_min_m
    assert found["yaw"].unit == "deg"
    assert found["yaw"].to_si(90.0) == pytest.approx(math.pi / 2)
    assert found["yaw"].to_display(math.pi / 2 + math.tau) == 90.0
    assert found["z_c"].low > 0
    assert 0 < found["beta"].low < found["beta"].high < 180
    goal = {name: float(value) for name, value in bench.cluster.plan.target.items()}
    assert all(found[n].refusal(found[n].to_display(v)) is None for n, v in goal.items())
    assert has_terms(found["p"].refusal(0.5) or "", "p", "0.5")
    assert found["p"].refusal(math.nan) is not None
    assert found["p"].to_display(1.0) == 1.0  # only requested values must be in range


@pytest.mark.parametrize(
    ("altitude_m", "separation_m"), [(100.0, 0.0), (1.0, 20.0), (0.8, 25.0), (1e-3, 1e9), (10_000.0, 19.95)]
)
def test_no_range_is_empty_whatever_the_limits_of_the_scenario(altitude_m: float, separation_m: float):
    given = {"drones.drone1.limits.altitude_m": altitude_m, "clusters.main.gains.separation_min_m": separation_m}
    scenario = scenario_file.load(SCENARIOS / "step.yaml", [f"{path}={value}" for path, value in given.items()])
    cluster = scenario.clusters[0]
    for found in slider_ranges(scenario_space(scenario, cluster), cluster, scenario):
        assert found.low < found.high, found.name
        assert found.low <= found.start <= found.high


def test_expressions_of_angles_are_in_degrees_like_the_sliders(bench: Bench):
    space = bench.space
    text = "yaw = 90 + 6*t\nroll_deg = A\nx_c = 1\nA = 5"
    read = parse_expressions(text, space.names, ("roll", "pitch", "yaw"))
    c, c_dot = ExpressionTrajectory(space, read["expressions"], np.zeros(space.size), read["constants"]).value(5.0)
    found = {name: c[space.index(name)] for name in ("yaw", "roll", "x_c")}
    assert found == pytest.approx({"yaw": math.radians(120.0), "roll": math.radians(5.0), "x_c": 1.0})
    assert c_dot[space.index("yaw")] == pytest.approx(math.radians(6.0))


@pytest.mark.parametrize(
    ("read", "texts"),
    [
        (
            lambda text: parse_expressions(text, ("x_c",)),
            {
                "x_c": ("line 1", "'x_c'"),
                "x_c = 5\nyc = 6": ("yc", "x_c"),
                "x_c = 1\nradius = wide": ("line 2", "radius", "'wide'"),
                "": ("trajectory",),
            },
        ),
        (
            lambda text: parse_waypoints(text, {}),
            dict.fromkeys(("x_c = 1", "0 x_c=1", "0: 5", "a: x_c = 1"), ("line 1",)) | {"": ("waypoints",)},
        ),
    ],
)
def test_an_invalid_trajectory_is_refused_with_its_line_and_value(read: Any, texts: dict[str, tuple[str, ...]]):
    for text, terms in texts.items():
        with refused(InputError, *terms):
            read(text)
